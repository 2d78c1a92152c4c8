"""Scenes stand where the URDF says, move as it says, and leave their part the room it had."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import yourdfpy
from generated import box, joint, made, read_with_hulls
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from conversion.model import ConvertedObject, ConvexShape, ObjectError
from conversion.scenes import other_values, scene_bank, scene_specs
from mjcf_assets.procedural.generate import generate
from vatmart_jax.data.banks import SceneBank, SceneTable
from vatmart_jax.data.part_kinds import HINGE, SLIDE

# One of each quirk: ranges that exclude 0, go below it, or start past it; buttons on a door; a plain cabinet.
REAL = ("103480", "12428", "11826", "101564", "45194", "8877")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("generated")
    generate(out, 10, seed=3)
    return out


@pytest.fixture(scope="module")
def objects(folder) -> list[ConvertedObject]:
    return [read_with_hulls(p) for p in sorted(folder.glob("9*"))]


@pytest.fixture(scope="module")
def bank(objects) -> SceneBank:
    return bank_of(objects, 3)


def bank_of(objects: list[ConvertedObject], variants: int, collision: str = "hull") -> SceneBank:
    return scene_bank([spec for o in objects for spec in scene_specs(o, variants, seed=0)], collision)


def part_pose(bank: SceneBank, s: int, q: float) -> np.ndarray:
    """[4, 4] of the part's frame in the object frame, by the bank's own conventions."""
    pose, move = np.eye(4), np.eye(4)
    pose[:3, :3] = Rotation.from_quat(bank.part_quat[s], scalar_first=True).as_matrix()
    pose[:3, 3] = bank.part_pos[s]
    if bank.joint_type[s] == SLIDE:
        move[:3, 3] = q * bank.axis[s]
    else:
        move[:3, :3] = Rotation.from_rotvec(q * bank.axis[s]).as_matrix()
    return pose @ move


def solids(bank: SceneBank, s: int, q: float) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Vertices of static hulls and of the part's, object frame."""
    out = []
    for start, frame in ((bank.static_start, np.eye(4)), (bank.part_start, part_pose(bank, s, q))):
        rows = range(start[s], start[s + 1])
        points = []
        for r in rows:
            turn = Rotation.from_quat(bank.instance_quat[r], scalar_first=True)
            own = turn.apply(bank.hull(bank.instance_shape[r]).astype(float)) + bank.instance_pos[r]
            points.append(own @ frame[:3, :3].T + frame[:3, 3])
        out.append(points)
    return out[0], out[1]


def check_against_urdf(folder: Path, converted: ConvertedObject, bank: SceneBank, seed: int) -> None:
    """Every hull of every Scene at five openings stands where yourdfpy puts its link."""
    urdf = yourdfpy.URDF.load(str(folder / "mobility.urdf"), load_meshes=False, build_scene_graph=True)
    parts = {p.link: p for p in converted.parts}
    for s in range(len(bank)):
        part = parts[bank.part[s]]
        values = other_values(converted, part, int(bank.variant[s]), seed)
        assert bank.joint[s] == part.joint and bank.joint[s] not in values
        for q in np.linspace(0, bank.joint_range[s], 5):
            config = values | {part.joint: bank.urdf_closed[s] + bank.urdf_sign[s] * q}
            urdf.update_cfg({k: config[k] for k in urdf.actuated_joint_names})
            pose = urdf.get_transform(part.link, converted.obj.root)
            np.testing.assert_allclose(part_pose(bank, s, q), pose, atol=1e-9)
            moving = set(converted.obj.subtree(part.link))
            expected = ([], [])
            for group, hulls in converted.hulls.items():
                pose = urdf.get_transform(group, converted.obj.root)
                expected[group in moving].extend(h.vertices @ pose[:3, :3].T + pose[:3, 3] for h in hulls)
            for got, want in zip(solids(bank, s, q), expected, strict=True):
                np.testing.assert_allclose(np.concatenate(got), np.concatenate(want), atol=1e-6)


def test_scenes_agree_with_the_urdf(folder, objects, bank):
    for converted in objects:
        own = bank.select(bank.object_id == converted.obj.id)
        check_against_urdf(folder / converted.obj.id, converted, own, seed=0)


@pytest.mark.parametrize("name", REAL)
def test_scenes_of_real_objects_agree_with_the_urdf(real_objects, name):
    converted = read_with_hulls(real_objects / name)
    bank = bank_of([converted], 2)
    assert len(bank) >= len(converted.parts) > 0
    check_against_urdf(real_objects / name, converted, bank, seed=0)


def test_axes_point_so_that_positive_opens(bank):
    """Doors and drawers of generated objects come towards -x, lids of washing machines go up.

    Leaves in a frame open to either side, and furniture that is used from the side opens there.
    """
    axis = np.asarray(SceneTable.from_bank(bank).axis)
    for s in range(len(bank)):
        closed, ajar = (np.concatenate(solids(bank, s, q)[1]).mean(0) for q in (0.0, 0.05))
        moved = ajar - closed
        sideways = abs(moved[1]) > abs(moved[0]) and bank.category[s] == "StorageFurniture"
        either = bank.category[s] == "Door" and abs(moved[0]) > abs(moved[1])
        assert moved[0] < 0 or moved[2] > 0 or sideways or either
        np.testing.assert_allclose(np.linalg.norm(axis[s]), 1, atol=1e-6)
        if bank.joint_type[s] == SLIDE:
            expected = [0, np.sign(moved[1]), 0] if sideways else [-1, 0, 0]
            np.testing.assert_allclose(axis[s], expected, atol=1e-6)


def test_every_part_has_its_scenes_and_variant_0_first(objects, bank):
    for converted in objects:
        for part in converted.parts:
            own = (bank.object_id == converted.obj.id) & (bank.part == part.link)
            variants = bank.variant[own].tolist()
            assert variants[0] == 0 and variants == sorted(set(variants)) and len(variants) <= 3
            assert set(bank.joint_type[own]) == {SLIDE if part.kind == "drawer" else HINGE}
            assert set(bank.part_kind[own]) == {part.kind}
            assert set(bank.split[own]) == {"train"} and set(bank.category[own]) == {converted.obj.category}


def test_variants_move_other_joints_only(objects):
    moved = 0
    for converted in objects:
        for part in converted.parts:
            closed = other_values(converted, part, 0, seed=0)
            assert all(closed[p.joint] == p.closed for p in converted.parts if p is not part)
            assert part.joint not in closed
            other = other_values(converted, part, 1, seed=0)
            assert set(other) == set(closed)
            moved += sum(other[k] != closed[k] for k in closed)
            for j in converted.obj.joints.values():
                if j.limited and j.name in other:
                    assert j.lower - 1e-9 <= other[j.name] <= j.upper + 1e-9
    assert moved > 10


def depth(points: np.ndarray, hull: np.ndarray) -> float:
    """How deep the deepest of the points lies in a hull."""
    planes = ConvexHull(hull).equations
    return float(np.maximum(-(points @ planes[:, :3].T + planes[:, 3]).max(axis=1), 0).max())


def overlap(bank: SceneBank, s: int, q: float) -> float:
    """Deepest vertex of a static hull in the part's hulls or the other way round."""
    static, moving = solids(bank, s, q)
    near = [(a, b) for a in static for b in moving if (a.min(0) < b.max(0)).all() and (b.min(0) < a.max(0)).all()]
    return max((max(depth(a, b), depth(b, a)) for a, b in near), default=0.0)


def test_variants_leave_the_part_its_room(bank):
    """Over the part's whole way nothing reaches deeper into it than with all else closed."""
    for s in np.flatnonzero(bank.variant > 0):
        base = np.flatnonzero(
            (bank.object_id == bank.object_id[s]) & (bank.part == bank.part[s]) & (bank.variant == 0)
        )[0]
        for q in np.linspace(0, bank.joint_range[s], 9):
            assert overlap(bank, s, q) <= max(overlap(bank, base, q), 0) + 3e-3, (bank.object_id[s], bank.part[s], q)


def test_a_joint_in_the_way_stays_closed():
    """A flap that would swing through a drawer's way is opened in no variant, one beside it is."""
    converted = made(
        "flaps",
        {
            "base": [box("body-1", (0, -1, 0), (0.5, 1, 0.5))],
            "drawer": [box("drawer_front-2", (-0.05, -0.3, 0.1), (-0.001, 0.3, 0.4))],
            "near": [box("door-3", (-0.1, -0.3, -0.05), (-0.06, 0.3, 0))],
            "far": [box("door-4", (-0.1, 0.5, -0.05), (-0.06, 0.9, 0))],
        },
        [
            joint("drawer", "prismatic", (-1, 0, 0), 0, 0.5),
            joint("near", "prismatic", (0, 0, 1), 0, 0.4),
            joint("far", "prismatic", (0, 0, 1), 0, 0.4),
        ],
    )
    drawer = next(p for p in converted.parts if p.link == "drawer")
    values = [other_values(converted, drawer, k, seed=0) for k in range(1, 20)]
    assert max(v["joint_near"] for v in values) < 0.15
    assert max(v["joint_far"] for v in values) > 0.2


def test_shapes_are_shared_between_scenes_and_variants(objects, bank):
    total = sum(len(h) for o in objects for h in o.hulls.values())
    assert len(bank.hull_start) - 1 == total < len(bank.instance_shape)


def test_handles_are_marked(objects, bank):
    for converted in objects:
        for part in converted.parts:
            s = np.flatnonzero((bank.object_id == converted.obj.id) & (bank.part == part.link))[0]
            rows = slice(bank.part_start[s], bank.part_start[s + 1])
            handles = sum(h.is_handle for g in converted.obj.subtree(part.link) for h in converted.hulls.get(g, ()))
            assert bank.instance_handle[rows].sum() == handles


def test_scenes_do_not_depend_on_their_neighbours(objects, bank):
    alone = bank_of([objects[5]], 3)
    together = bank.select(bank.object_id == objects[5].obj.id)
    for field in fields(SceneBank):
        np.testing.assert_array_equal(getattr(alone, field.name), getattr(together, field.name), field.name)


def test_banks_come_back_from_their_file(bank, tmp_path):
    bank.save(tmp_path / "scenes.npz")
    loaded = SceneBank.load(tmp_path / "scenes.npz")
    for field in fields(SceneBank):
        np.testing.assert_array_equal(getattr(loaded, field.name), getattr(bank, field.name))
    chosen = np.array([4, 1])
    for new, old in enumerate(chosen):
        for a, b in zip(solids(loaded.select(chosen), new, 0.1), solids(bank, old, 0.1), strict=True):
            np.testing.assert_array_equal(np.concatenate(a), np.concatenate(b))


def test_objects_without_parts_give_an_empty_bank():
    converted = made("block", {"base": [box("body-1", (0, 0, 0), (1, 1, 1))]}, [])
    bank = bank_of([converted], 2)
    assert len(bank) == 0 and bank.part_quat.shape == (0, 4) and len(bank.static_start) == 1


def boxed(hull: ConvexShape) -> ConvexShape:
    """Its axis-aligned bounding box."""
    low, high = hull.vertices.min(0), hull.vertices.max(0)
    pose = np.eye(4)
    pose[:3, 3] = (low + high) / 2
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    vertices = corners * (high - low) / 2 + pose[:3, 3]
    return ConvexShape(vertices=vertices, is_handle=hull.is_handle, box_pose=pose, box_size=(high - low) / 2)


def test_box_banks_place_the_same_corners(objects):
    as_boxes = [replace(o, hulls={g: [boxed(h) for h in hulls] for g, hulls in o.hulls.items()}) for o in objects[:3]]
    boxes, hulls = (bank_of(as_boxes, 2, kind) for kind in ("box", "hull"))
    assert len(boxes.hull_vertices) == 0 and len(boxes.box_size) == len(hulls.hull_start) - 1
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    for r in range(len(boxes.instance_shape)):
        turn = [Rotation.from_quat(b.instance_quat[r], scalar_first=True) for b in (boxes, hulls)]
        own = turn[0].apply(corners * boxes.box_size[boxes.instance_shape[r]]) + boxes.instance_pos[r]
        want = turn[1].apply(hulls.hull(hulls.instance_shape[r])) + hulls.instance_pos[r]
        np.testing.assert_allclose(own, want, atol=1e-6)


def test_a_box_bank_of_hulls_is_refused(objects):
    with pytest.raises(ObjectError, match=f"{objects[0].obj.id}: .* convert with --collision box"):
        bank_of(objects, 1, "box")
