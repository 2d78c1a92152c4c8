"""Procedural objects: they read like PartNet-Mobility's, are deterministic, and open without hitting themselves."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yourdfpy
from penetration import penetration_depth, posed

from conversion.model import ArticulatedObject
from conversion.part_detection import detect_parts
from conversion.readers.partnet_mobility import read_object
from mjcf_assets.output_folder import GeneratorError
from mjcf_assets.procedural.categories import CATEGORIES, Category
from mjcf_assets.procedural.categories.appliances import microwave, refrigerator
from mjcf_assets.procedural.categories.storage import storage_furniture
from mjcf_assets.procedural.components import Joint, Link, Style, porthole, rotate_about_y
from mjcf_assets.procedural.generate import CYCLE, generate
from mjcf_assets.procedural.solids import Mesh, Rect, box

COUNT = 60
TRAINING = {name for name in CYCLE if CATEGORIES[name].test_shape_every}


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("generated")
    generate(out, COUNT, seed=0)
    return out


@pytest.fixture(scope="module")
def objects(folder) -> list[ArticulatedObject]:
    return [read_object(p) for p in sorted(folder.glob("9*"))]


def test_every_category_has_objects_and_training_categories_have_test_shapes(folder):
    splits = json.loads((folder / "splits.json").read_text())
    assert set(splits["train"]) == set(splits["test_shapes"]) == TRAINING
    assert set(splits["test_categories"]) == set(CYCLE) - TRAINING
    ids = [i for split in splits.values() for group in split.values() for i in group]
    assert sorted(ids) == sorted(p.name for p in folder.glob("9*")) and len(set(ids)) == COUNT


def test_folders_hold_the_files_of_a_real_one(folder):
    for path in folder.glob("9*"):
        names = {p.name for p in path.iterdir()}
        assert names == {
            "mobility.urdf", "textured_objs", "semantics.txt", "meta.json", "mobility_v2.json", "bounding_box.json",
        }  # fmt: skip
        urdf = yourdfpy.URDF.load(str(path / "mobility.urdf"), load_meshes=False)
        links = [line.split()[0] for line in (path / "semantics.txt").read_text().splitlines()]
        assert links == [link.name for link in urdf.robot.links][1:]
        nodes = json.loads((path / "mobility_v2.json").read_text())
        assert [f"link_{n['id']}" for n in nodes] == links
        used = {v.geometry.mesh.filename for link in urdf.robot.links for v in link.visuals}
        assert used == {f"textured_objs/{p.name}" for p in (path / "textured_objs").iterdir()}


def test_object_depends_on_seed_and_index_alone(folder, tmp_path):
    """The same bytes in a shorter run, others with another seed."""
    ids = generate(tmp_path / "a", 5, seed=0)
    for name in ids:
        for file in (tmp_path / "a" / name).rglob("*.*"):
            assert file.read_bytes() == (folder / name / file.relative_to(tmp_path / "a" / name)).read_bytes()
    other = generate(tmp_path / "b", 1, seed=1)[0]
    urdf = (tmp_path / "b" / other / "mobility.urdf").read_text()
    assert urdf.replace(other, ids[0]) != (folder / ids[0] / "mobility.urdf").read_text()


def test_every_object_has_the_doors_and_drawers_it_says(folder, objects):
    for obj in objects:
        lines = (folder / obj.id / "semantics.txt").read_text().splitlines()
        expected = {x.split()[0] for x in lines if x.split()[2] in ("door", "rotation_door", "drawer")}
        found, _ = detect_parts(obj)
        assert {p.link for p in found} == expected and expected
        assert all(p.closed == 0 and p.sign == 1 for p in found)


def test_fronts_face_the_camera_and_open_towards_it(objects):
    """The object frame's front is -x: what opens comes forward, or for the lids of washing machines, up.

    Leaves in a frame may open away as well, and some furniture is used from the side.
    """
    otherwise = {"Door": [], "StorageFurniture": []}
    for obj in objects:
        for part in detect_parts(obj)[0]:
            vertices = np.concatenate([v.vertices for v in obj.links[part.link].visuals])
            middle = np.append(vertices.mean(0), 1)
            closed, ajar = (
                (obj.link_poses({part.joint: part.closed + part.sign * q})[part.link] @ middle)[:3] for q in (0.0, 0.1)
            )
            moved = ajar - closed
            sideways = abs(moved[1]) > abs(moved[0])
            if obj.category in otherwise:
                otherwise[obj.category].append(sideways or moved[0] > 0)
            if obj.category == "Door":
                assert not sideways
            elif not (obj.category == "StorageFurniture" and sideways):
                assert moved[0] < 0 or (obj.category == "WashingMachine" and moved[2] > 0)
    assert 0.2 < np.mean(otherwise["Door"]) < 0.6 and np.mean(otherwise["StorageFurniture"]) < 0.2


def test_turned_furniture_opens_where_its_front_is():
    body = Link("heavy furniture_body", "cabinet_frame")
    front = Link("slider drawer", "drawer", body, Joint(np.array([0.0, 0.5, 1]), np.array([0.0, 0, 1]), 0.4))
    front.add("drawer_front", box((-0.5, 0, 0.9), (0.5, 1, 1)))
    rotate_about_y([front, body], np.pi / 2)
    np.testing.assert_allclose(front.joint.axis, [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(front.joint.origin, [1, 0.5, 0], atol=1e-12)
    np.testing.assert_allclose(front.leaves[0][1][0].vertices.mean(0), [0.95, 0.5, 0], atol=1e-12)


def test_objects_fill_about_a_unit_sphere(objects):
    for obj in objects:
        poses = obj.link_poses()
        points = np.concatenate(
            [v.vertices @ poses[k][:3, :3].T + poses[k][:3, 3] for k, x in obj.links.items() for v in x.visuals]
        )
        size = np.ptp(points, axis=0)
        assert 1.95 < np.linalg.norm(size) < 2.1 and 1.0 < size.max() < 2.0
        assert np.abs((points.min(0) + points.max(0)) / 2).max() < 0.1


def test_meshes_are_closed_and_wound_outwards(folder):
    for path in sorted(folder.glob("9*"))[:10]:
        for file in (path / "textured_objs").iterdir():
            mesh = trimesh.load(file, process=True)
            assert isinstance(mesh, trimesh.Trimesh) and mesh.is_watertight and mesh.volume > 0, file


def test_parts_swing_free(objects):
    """No vertex of a part enters a leaf of the rest by more than 3 mm, from closed to open."""
    for obj in objects:
        for part in detect_parts(obj)[0]:
            moving = set(obj.subtree(part.link))
            for share in (0.0, 0.1, 0.5, 1.0):
                poses = obj.link_poses({part.joint: part.closed + part.sign * share * part.joint_range})
                points = np.concatenate([posed(v.vertices, poses[k]) for k in moving for v in obj.links[k].visuals])
                for k, link in obj.links.items():
                    for v in link.visuals if k not in moving else ():
                        assert penetration_depth(points, Mesh(posed(v.vertices, poses[k]), v.faces)) < 3e-3, (
                            obj.id,
                            part.link,
                            share,
                            k,
                            v.name,
                        )


@pytest.mark.parametrize("side", ["left", "right", "bottom", "top"])
def test_portholes_are_closed_meshes_that_swing_free_of_their_panel(side):
    cell = Rect(-0.4, -0.3, 0.4, 0.3)
    hollow = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        style, body = Style.sample(rng, {"bar": 1, "none": 1}, {"slab": 1}), Link("heavy body", "frame")
        link = porthole(rng, style, body, cell, z=0.5, side=side, leaf="leaf")
        (panel,), (leaf,) = body.leaves[0][1], link.leaves[0][1]
        for mesh in (panel, leaf):
            solid = trimesh.Trimesh(mesh.vertices, mesh.faces)
            assert solid.is_watertight and solid.volume > 0
        hollow += np.ptp(leaf.vertices[:, 2]) > style.front + 1e-9
        for q in np.linspace(0, 1, 9) * link.joint.upper:
            turn = trimesh.transformations.rotation_matrix(q, link.joint.axis, link.joint.origin)
            assert penetration_depth(trimesh.transform_points(leaf.vertices, turn), panel) < 3e-3, (seed, q)
    assert 0 < hollow < 20


def test_portholes_are_where_the_style_has_them():
    drawn = {}
    for seed in range(60):
        rng = np.random.default_rng(seed)
        wanted = Style.sample(np.random.default_rng(seed), {"bar": 1}, {"slab": 1}).porthole
        body = storage_furniture(rng)[-1]
        drawn.setdefault(wanted, []).append(any(name == "frame" for name, _ in body.leaves))
    assert all(drawn[True]) and not any(drawn[False]) and len(drawn[True]) > 3


def test_fronts_are_boards_or_sheets():
    drawn = {False: 0, True: 0}
    for seed in range(40):
        style = Style.sample(np.random.default_rng(seed), {"bar": 1}, {"slab": 1})
        for maker in (refrigerator, microwave):
            link = next(x for x in maker(np.random.default_rng(seed)) if x.name == "door")
            if style.porthole and maker is microwave:
                continue  # may be hollow
            thick = max(np.ptp(m.vertices[:, 2]) for m in link.leaves[0][1])
            assert thick <= style.sheet + 1e-9 if style.sheet else thick > 0.02
            drawn[bool(style.sheet)] += 1
    assert 0.15 < drawn[True] / sum(drawn.values()) < 0.45


@pytest.mark.parametrize(("count", "seed"), [(0, 0), (100_000, 0), (3, -1)])
def test_arguments_out_of_range_are_refused(tmp_path, count, seed):
    with pytest.raises(GeneratorError, match=f"--count {count} --seed {seed}: expected"):
        generate(tmp_path / "out", count, seed)
    assert not (tmp_path / "out").exists()


def test_a_folder_of_other_objects_is_left_alone(tmp_path):
    (tmp_path / "45194").mkdir()
    (tmp_path / "45194" / "mobility.urdf").write_text("")
    with pytest.raises(GeneratorError, match=r"holds other objects \(45194"):
        generate(tmp_path, 2, 0)
    assert [p.name for p in tmp_path.iterdir()] == ["45194"]


def test_a_set_of_chosen_categories_shares_no_id_with_the_cycle_and_does_not_depend_on_the_others(tmp_path):
    generate(tmp_path / "a", 6, seed=0, categories=["Safe", "Box"])
    generate(tmp_path / "b", 3, seed=0, categories=["Box"])
    ids = {p.name for p in (tmp_path / "a").glob("8*")}
    assert len(ids) == 6
    splits = json.loads((tmp_path / "a" / "splits.json").read_text())
    assert len(splits["test_categories"]["Safe"]) == 3
    assert sorted(splits["train"]["Box"] + splits["test_shapes"]["Box"]) == sorted(
        ids - {*splits["test_categories"]["Safe"]}
    )
    for file in (tmp_path / "b").glob("8*/**/*.*"):
        assert file.read_bytes() == (tmp_path / "a" / file.relative_to(tmp_path / "b")).read_bytes()


def test_numbers_of_categories_are_unique_and_only_the_papers_are_in_the_cycle():
    numbers = [category.number for category in CATEGORIES.values()]
    assert len(set(numbers)) == len(numbers) and all(1 <= n < 100 for n in numbers)
    assert set(CATEGORIES) - set(CYCLE) == {"Box"}


def test_a_new_category_is_a_function_and_an_entry(tmp_path, monkeypatch):
    def cube(rng: np.random.Generator) -> list[Link]:
        body = Link("heavy cube", "cube")
        body.add("cube", box((0, 0, 0), (1, 1, rng.uniform(1, 2))))
        return [body]

    monkeypatch.setitem(CATEGORIES, "Cube", Category(cube, number=99, test_shape_every=2))
    ids = generate(tmp_path, 2, seed=0, categories=["Cube"])
    assert json.loads((tmp_path / "splits.json").read_text())["test_shapes"] == {"Cube": [ids[1]]}
    assert (tmp_path / ids[0] / "semantics.txt").read_text() == "link_0 heavy cube\n"


@pytest.mark.parametrize("categories", [[], ["Sofa"], "Box"])
def test_unknown_categories_are_refused(tmp_path, categories):
    with pytest.raises(GeneratorError, match="expected some of StorageFurniture"):
        generate(tmp_path / "out", 2, 0, categories)
    assert not (tmp_path / "out").exists()
