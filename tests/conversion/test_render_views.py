"""Views show what a camera in the picture would see: checked by MuJoCo's own kinematics and rays."""

from __future__ import annotations

from dataclasses import fields, replace

import mujoco
import numpy as np
import pytest
import trimesh
from generated import box, joint, made, read_with_hulls

from conversion.config import MjcfConfig, ViewConfig
from conversion.mjcf import VISUAL_GROUP, to_mjcf
from conversion.model import ConvertedObject
from conversion.render_views import DISTANCE, render_views
from conversion.scenes import other_values, scene_bank, scene_specs
from mjcf_assets.procedural.generate import generate
from vatmart_jax.data.banks import SceneBank, ViewBank
from vatmart_jax.data.part_kinds import PART_KINDS

REAL = ("45194", "101564", "7167")
VISUALS = np.array([k == VISUAL_GROUP for k in range(6)], np.uint8)


@pytest.fixture(scope="module")
def objects(tmp_path_factory) -> list[ConvertedObject]:
    out = tmp_path_factory.mktemp("generated")
    generate(out, 10, seed=4)
    return [read_with_hulls(p) for p in sorted(out.glob("9*"))]


@pytest.fixture(scope="module")
def bank(objects) -> SceneBank:
    return bank_of(objects)


@pytest.fixture(scope="module")
def seen(objects, bank) -> ViewBank:
    out, skipped = views_of(objects, 2, 3000, 200)
    assert not skipped
    return out


def bank_of(objects: list[ConvertedObject], variants: int = 2) -> SceneBank:
    return scene_bank([spec for o in objects for spec in scene_specs(o, variants, seed=0)], "hull")


def views_of(
    objects: list[ConvertedObject], views: int, points: int, contacts: int, variants: int = 2, jobs: int = 1
) -> tuple[ViewBank, list[tuple[int, str]]]:
    """Views of every Scene, of training objects as many as of others."""
    config = ViewConfig(views=views, train_factor=1, points=points, contacts=contacts)
    return render_views(objects, variants, 0, config, jobs)


def camera(view: ViewBank, v: int, centre: np.ndarray) -> np.ndarray:
    """Where the camera stands, from the documented meaning of azimuth and elevation."""
    turn = trimesh.transformations.rotation_matrix(view.azimuth[v], [0, 0, 1])[:3, :3]
    return centre + DISTANCE * turn @ [-np.cos(view.elevation[v]), 0, np.sin(view.elevation[v])]


class World:
    """An object as a MuJoCo model of visual meshes, set to what a view shows."""

    def __init__(self, converted: ConvertedObject):
        self.converted = converted
        self.model = to_mjcf(converted, MjcfConfig()).compile()
        self.data = mujoco.MjData(self.model)

    def show(self, bank: SceneBank, s: int, q: float) -> set[int]:
        """Poses the object; returns the bodies that move with the part."""
        part = next(p for p in self.converted.parts if p.link == bank.part[s])
        values = other_values(self.converted, part, int(bank.variant[s]), seed=0)
        values[part.joint] = float(bank.urdf_closed[s] + bank.urdf_sign[s] * q)
        for name, value in values.items():
            self.data.qpos[self.model.joint(name).qposadr[0]] = value
        mujoco.mj_kinematics(self.model, self.data)
        return {self.model.body(k).id for k in self.converted.obj.subtree(part.link)}

    def cast(self, origin: np.ndarray, towards: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(distance, body) of the first visual on the way to each point [n, 3]."""
        geom = np.zeros(1, np.int32)
        out = []
        for point in towards:
            ray = (point - origin) / np.linalg.norm(point - origin)
            d = mujoco.mj_ray(self.model, self.data, origin, ray, VISUALS, 1, -1, geom)
            out.append((d, self.model.geom_bodyid[geom[0]] if geom[0] >= 0 else -1))
        d, body = zip(*out, strict=True)
        return np.array(d), np.array(body)


def centre(converted: ConvertedObject, bank: SceneBank, s: int) -> np.ndarray:
    """Middle of the object's bounding box with the part closed."""
    part = next(p for p in converted.parts if p.link == bank.part[s])
    values = other_values(converted, part, int(bank.variant[s]), seed=0) | {part.joint: part.closed}
    poses = converted.obj.link_poses(values)
    points = np.concatenate(
        [v.vertices @ poses[k][:3, :3].T + poses[k][:3, 3] for k, x in converted.obj.links.items() for v in x.visuals]
    )
    return (points.min(0) + points.max(0)) / 2


def check_against_mujoco(objects, bank: SceneBank, seen: ViewBank, n: int) -> None:
    worlds = {o.obj.id: World(o) for o in objects}
    rng = np.random.default_rng(0)
    for v in range(len(seen)):
        s = int(seen.scene[v])
        world = worlds[bank.object_id[s]]
        moving = list(world.show(bank, s, float(seen.joint_pos[v])))
        eye = camera(seen, v, centre(world.converted, bank, s))
        some = rng.choice(len(seen.contacts[v]), n)
        contacts = seen.contacts[v][some].astype(float)
        d, body = world.cast(eye, contacts)
        reached = np.abs(d - np.linalg.norm(contacts - eye, axis=1)) < 1e-4
        # A few rays pass an edge on the other side in another precision.
        assert (reached & np.isin(body, moving)).mean() > 0.98
        some = rng.choice(len(seen.points[v]), n)
        points = seen.points[v][some].astype(float)
        d, body = world.cast(eye, points)
        reached = np.abs(d - np.linalg.norm(points - eye, axis=1)) < 5e-3
        assert reached.mean() > 0.95
        assert (np.isin(body, moving) == seen.part_mask[v][some])[reached].mean() > 0.99


def test_masks_and_depths_agree_with_mujoco(objects, bank, seen):
    check_against_mujoco(objects, bank, seen, 100)


@pytest.mark.parametrize("name", REAL)
def test_masks_and_depths_of_real_objects_agree_with_mujoco(real_objects, name):
    converted = read_with_hulls(real_objects / name)
    bank = bank_of([converted])
    seen, skipped = views_of([converted], 1, 3000, 200)
    assert len(seen) == 2 * (len(bank) - len(skipped)) > 0
    check_against_mujoco([converted], bank, seen, 200)


def test_points_lie_on_the_visual_surface(objects, bank, seen):
    """Within 1e-3, rounding to 16 bits included; contacts, in 32 bits, within 1e-6."""
    by_id = {o.obj.id: o for o in objects}
    for v in range(0, len(seen), 5):
        s = int(seen.scene[v])
        converted = by_id[bank.object_id[s]]
        part = next(p for p in converted.parts if p.link == bank.part[s])
        values = other_values(converted, part, int(bank.variant[s]), seed=0)
        values[part.joint] = float(bank.urdf_closed[s] + bank.urdf_sign[s] * seen.joint_pos[v])
        poses = converted.obj.link_poses(values)
        meshes = [
            trimesh.Trimesh(x.vertices @ poses[k][:3, :3].T + poses[k][:3, 3], x.faces, process=False)
            for k, link in converted.obj.links.items()
            for x in link.visuals
        ]
        surface = trimesh.util.concatenate(meshes)
        for points, tolerance in ((seen.points[v][:300], 1e-3), (seen.contacts[v][:100], 1e-6)):
            _, distance, face = trimesh.proximity.closest_point(surface, points.astype(float))
            assert distance.max() < tolerance
        normals = np.abs((surface.face_normals[face] * seen.contact_normals[v][:100]).sum(1))
        assert np.median(normals) > 0.999


def test_contact_normals_are_unit_and_face_the_camera(objects, bank, seen):
    by_id = {o.obj.id: o for o in objects}
    for v in range(len(seen)):
        s = int(seen.scene[v])
        eye = camera(seen, v, centre(by_id[bank.object_id[s]], bank, s))
        n, p = seen.contact_normals[v].astype(float), seen.contacts[v].astype(float)
        np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1, atol=1e-5)
        assert ((n * (eye - p)).sum(1) > -1e-5).all()


def test_cameras_and_openings_are_the_papers(bank, seen):
    assert (np.abs(seen.azimuth) <= np.pi / 2).all() and np.ptp(seen.azimuth) > 2
    assert (seen.elevation >= np.pi / 6).all() and (seen.elevation <= np.pi / 3).all()
    assert (seen.direction == 1).sum() * 2 == (seen.direction == -1).sum() * 2 == len(seen)
    width = bank.joint_range[seen.scene]
    low = np.array([PART_KINDS.get(kind).goal_range[0] for kind in bank.part_kind[seen.scene]])
    room = np.where(seen.direction > 0, width - seen.joint_pos, seen.joint_pos)
    assert (room >= np.minimum(low, width) - 1e-6).all()
    assert (seen.joint_pos >= 0).all() and (seen.joint_pos <= width + 1e-6).all()


def test_contacts_on_handles_are_marked(objects, bank, seen):
    """In the frame of the part: marked contacts lie on a handle's surface, the others off it."""
    by_id = {o.obj.id: o for o in objects}
    marked = 0
    for v in range(len(seen)):
        s = int(seen.scene[v])
        obj = by_id[bank.object_id[s]].obj
        visuals = [x for k in obj.subtree(bank.part[s]) for x in obj.links[k].visuals if x.is_handle]
        if len(obj.subtree(bank.part[s])) > 1 or not visuals:
            continue
        value = float(bank.urdf_closed[s] + bank.urdf_sign[s] * seen.joint_pos[v])
        part = next(p for p in by_id[obj.id].parts if p.link == bank.part[s])
        values = other_values(by_id[obj.id], part, int(bank.variant[s]), seed=0) | {part.joint: value}
        pose = obj.link_poses(values)[part.link]
        local = (seen.contacts[v].astype(float) - pose[:3, 3]) @ pose[:3, :3]
        handle = trimesh.util.concatenate([trimesh.Trimesh(x.vertices, x.faces, process=False) for x in visuals])
        distance = trimesh.proximity.closest_point(handle, local)[1]
        assert (distance[seen.contact_handle[v]] < 1e-5).all()
        assert (distance[~seen.contact_handle[v]] > 1e-5).all()
        marked += seen.contact_handle[v].sum()
    assert marked > 20


def test_points_come_in_random_order_and_repeat_only_after_all(objects):
    one = [replace(objects[0], parts=objects[0].parts[:1])]
    few, _ = views_of(one, 1, 500, 64, variants=1)
    many, _ = views_of(one, 1, 150_000, 64, variants=1)
    np.testing.assert_array_equal(few.points, many.points[:, :500])
    for points, mask in zip(many.points, many.part_mask, strict=True):
        matches = np.flatnonzero((points[1:-20] == points[0]).all(axis=1)) + 1
        again = next(k for k in matches if (points[k : k + 20] == points[:20]).all())
        np.testing.assert_array_equal(points[again:], np.resize(points[:again], (len(points) - again, 3)))
        # Any stretch is a fair sample of the picture.
        assert 5000 < again < 120_000
        assert abs(mask[: again // 4].mean() - mask[:again].mean()) < 0.03


def test_views_do_not_depend_on_jobs_or_order(objects, bank, seen):
    both = [objects[7], objects[2]]
    again, skipped = views_of(both, 2, 3000, 200, jobs=2)
    assert not skipped
    scenes = [np.flatnonzero(bank.object_id == o.obj.id) for o in both]
    want = [seen.of_scenes(own) for own in scenes]
    want = ViewBank.concatenate(want, [len(own) for own in scenes])
    for field in fields(ViewBank):
        np.testing.assert_array_equal(getattr(again, field.name), getattr(want, field.name), field.name)


def test_banks_come_back_from_their_file(seen, tmp_path):
    seen.save(tmp_path / "views.npz")
    loaded = ViewBank.load(tmp_path / "views.npz")
    for field in fields(ViewBank):
        a, b = getattr(loaded, field.name), getattr(seen, field.name)
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


def test_a_part_out_of_sight_is_skipped_with_a_reason():
    converted = made(
        "chest",
        {
            "base": [box("body-1", (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))],
            "inner": [box("drawer_front-2", (-0.2, -0.2, -0.2), (0.2, 0.2, 0.2))],
            "outer": [box("drawer_front-3", (-0.6, -0.2, -0.2), (-0.51, 0.2, 0.2))],
        },
        [joint("inner", "prismatic", (-1, 0, 0), 0, 0.15), joint("outer", "prismatic", (-1, 0, 0), 0, 0.5)],
    )
    bank = bank_of([converted], variants=1)
    seen, skipped = views_of([converted], 2, 100, 50, variants=1)
    hidden = int(np.flatnonzero(bank.part == "inner")[0])
    assert skipped == [(hidden, "chest inner: fewer than 32 pixels of it in 20 views")]
    assert set(seen.scene) == {1 - hidden} and len(seen) == 4


def test_views_of_no_scene_are_an_empty_bank():
    converted = made("block", {"base": [box("body-1", (0, 0, 0), (1, 1, 1))]}, [])
    seen, skipped = views_of([converted], 2, 100, 50, variants=1)
    assert len(seen) == 0 and seen.points.shape == (0, 100, 3) and not skipped


def test_training_objects_have_more_views_and_the_others_the_first_of_them(objects):
    config = ViewConfig(views=1, train_factor=3, points=100, contacts=50)
    one = replace(objects[0], parts=objects[0].parts[:1])
    many, _ = render_views([replace(one, split="train")], 1, 0, config)
    few, _ = render_views([replace(one, split="test_shapes")], 1, 0, config)
    assert (len(many), len(few)) == (6, 2)
    np.testing.assert_array_equal(many.points[[0, 3]], few.points)


def test_no_objects_give_an_empty_bank():
    assert len(render_views([], 1, 0, ViewConfig(points=10, contacts=5))[0]) == 0
