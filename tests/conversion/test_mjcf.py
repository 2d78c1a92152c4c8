"""Models move as their URDFs say, and MuJoCo takes them without complaint."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yourdfpy
from generated import box, joint, made, read_with_hulls

from conversion.config import MjcfConfig
from conversion.mjcf import COLLISION_GROUP, VISUAL_GROUP, Mjcf, to_mjcf
from conversion.model import ConvertedObject, ConvexShape, ObjectError
from mjcf_assets.procedural.generate import generate

REAL = ("45194", "103480", "101612", "11826", "10144", "12249", "22301", "12428")


def model_of(converted: ConvertedObject, **settings) -> mujoco.MjModel:
    return to_mjcf(converted, MjcfConfig(**settings)).compile()


@pytest.fixture(scope="module")
def generated_folders(tmp_path_factory) -> list[Path]:
    out = tmp_path_factory.mktemp("generated")
    generate(out, 8, seed=11)
    return sorted(p for p in out.iterdir() if p.is_dir())


def cupboard() -> ConvertedObject:
    return made(
        "cupboard",
        {
            "base": [box("body", (0, 0, 0), (1, 1, 1))],
            "link_0": [box("door", (-0.1, 0, 0), (-0.05, 1, 1)), box("handle-1", (-0.2, 0.8, 0.4), (-0.15, 0.9, 0.6))],
            "link_1": [box("front", (-0.1, 0, 1), (-0.05, 1, 1.3))],
            "wheel": [box("wheel", (0.4, 0.4, -0.2), (0.6, 0.6, 0))],
        },
        [
            joint("link_0", "revolute", (0, 0, 1), 0, 1.5),
            joint("link_1", "prismatic", (-1, 0, 0), 0.1, 0.6),
            joint("wheel", "continuous", (0, 1, 0), -np.inf, np.inf),
        ],
    )


def check_kinematics(folder: Path, count: int) -> None:
    """Poses in MuJoCo of a written and read model against yourdfpy's."""
    converted = read_with_hulls(folder)
    mjcf = to_mjcf(converted, MjcfConfig())
    model, oracle = mjcf.compile(), yourdfpy.URDF.load(str(folder / "mobility.urdf"), load_meshes=False)
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    moving = {j.name: j for j in oracle.robot.joints if j.name in oracle.actuated_joint_names}
    for _ in range(count):
        values = {}
        for name, j in moving.items():
            low, high = (-4.0, 4.0) if j.type == "continuous" else sorted((j.limit.lower, j.limit.upper))
            values[name] = rng.uniform(low, high)
            if low < high:
                data.qpos[model.joint(name).qposadr[0]] = values[name]
        oracle.update_cfg(values)
        mujoco.mj_kinematics(model, data)
        for link in oracle.robot.links:
            pose, body = oracle.get_transform(link.name), data.body(link.name)
            assert body.xpos == pytest.approx(pose[:3, 3], abs=1e-6)
            assert body.xmat.reshape(3, 3) == pytest.approx(pose[:3, :3], abs=1e-6)


@pytest.mark.parametrize("name", REAL)
def test_links_of_real_objects_stand_where_the_urdf_puts_them(real_objects, name):
    check_kinematics(real_objects / name, 20)


def test_links_of_generated_objects_stand_where_the_urdf_puts_them(generated_folders):
    for folder in generated_folders:
        check_kinematics(folder, 20)


def test_names_groups_limits_and_keyframes_are_those_of_the_object():
    model = model_of(cupboard())
    assert [model.body(i).name for i in range(1, model.nbody)] == ["base", "link_0", "link_1", "wheel"]
    assert model.joint("joint_link_0").range == pytest.approx([0, 1.5])
    assert model.joint("joint_link_1").type[0] == mujoco.mjtJoint.mjJNT_SLIDE
    assert model.jnt_limited.tolist() == [1, 1, 0]
    assert model.geom("link_0/handle-1").group[0] == VISUAL_GROUP
    visual, collision = model.geom_group == VISUAL_GROUP, model.geom_group == COLLISION_GROUP
    assert visual.sum() == collision.sum() == 5
    assert not model.geom_contype.any()
    assert model.geom_conaffinity[collision].all() and not model.geom_conaffinity[visual].any()
    assert model.key("closed").qpos == pytest.approx([0, 0.1, 0])
    assert model.key("open").qpos == pytest.approx([1.5, 0.6, 0])


def test_flags_set_damping_friction_and_weight():
    model = model_of(cupboard(), density=100.0, friction=0.7, joint_damping=3.0, joint_friction=0.2)
    assert model.dof_damping == pytest.approx(3.0)
    assert model.dof_frictionloss == pytest.approx(0.2)
    assert model.geom_friction[model.geom_group == COLLISION_GROUP, 0] == pytest.approx(0.7)
    assert model.body("link_1").mass[0] == pytest.approx(100 * 0.05 * 1 * 0.3, rel=0.02)


def test_visual_meshes_stand_where_the_urdf_puts_them(generated_folders):
    converted = read_with_hulls(generated_folders[0])
    model = model_of(converted)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    poses = converted.obj.link_poses()
    for link in converted.obj.links.values():
        for visual in {v.name: v for v in reversed(link.visuals)}.values():
            geom = model.geom(f"{link.name}/{visual.name}")
            mesh = model.mesh(geom.dataid[0])
            local = model.mesh_vert[mesh.vertadr[0] : mesh.vertadr[0] + mesh.vertnum[0]]
            seen = local @ data.geom_xmat[geom.id].reshape(3, 3).T + data.geom_xpos[geom.id]
            wanted = visual.vertices @ poses[link.name][:3, :3].T + poses[link.name][:3, 3]
            assert seen.min(axis=0) == pytest.approx(wanted.min(axis=0), abs=1e-5)
            assert seen.max(axis=0) == pytest.approx(wanted.max(axis=0), abs=1e-5)


def swing(model: mujoco.MjModel) -> None:
    """1,000 steps under the forces that take every joint from limit to limit and a little into them."""
    data = mujoco.MjData(model)
    limited = model.jnt_limited.astype(bool)
    low, high = np.where(limited, model.jnt_range[:, 0], -3.0), np.where(limited, model.jnt_range[:, 1], 3.0)
    data.qpos[:] = low
    passed = []
    for step in range(1000):
        goal = low + (high - low) * (0.5 - 0.55 * np.cos(step * model.opt.timestep * 2 * np.pi))
        data.qacc[:] = 900 * (goal - data.qpos) - 60 * data.qvel
        mujoco.mj_inverse(model, data)
        data.qfrc_applied[:] = data.qfrc_inverse
        mujoco.mj_step(model, data)
        passed.append(data.qpos.copy())
    assert not any(w.number for w in data.warning)
    assert (np.ptp(passed, axis=0) > 0.9 * (high - low)).all()


def test_joints_swing_from_limit_to_limit_without_a_warning(generated_folders):
    for folder in generated_folders:
        swing(model_of(read_with_hulls(folder)))


@pytest.mark.parametrize("name", REAL)
def test_joints_of_real_objects_swing_without_a_warning(real_objects, name):
    model = model_of(read_with_hulls(real_objects / name))
    if model.nv:
        swing(model)


def test_a_model_loads_in_mjx():
    from mujoco import mjx

    assert mjx.put_model(model_of(cupboard())).nq == 3


def test_doors_without_latches_stay_where_they_are_put():
    """Weight is compensated, so a flap on a horizontal hinge does not fall open."""
    flap = made(
        "flap",
        {"base": [box("body", (0, 0, 0), (1, 1, 1))], "lid": [box("lid", (0.1, 0, 0), (1, 1, 0.1))]},
        [joint("lid", "revolute", (0, -1, 0), -1.5, 1.5, (0, 0, 1))],
    )
    model = model_of(flap)
    data = mujoco.MjData(model)
    data.qpos[0] = 0.5
    mujoco.mj_step(model, data, 500)
    assert data.qpos[0] == pytest.approx(0.5, abs=1e-3)


@pytest.mark.parametrize("name", ["world", "a b", 'quo"te', "<tag>", "ünï", "a/b", "-", "1"])
def test_any_link_name_becomes_a_body(name):
    converted = made(
        name,
        {name: [box("body", (0, 0, 0), (1, 1, 1))], "x": [box("x", (1, 0, 0), (2, 1, 1))]},
        [replace(joint("x", "revolute", (0, 0, 1), 0, 1), parent=name)],
    )
    assert model_of(converted).body("world_" if name == "world" else name).id == 1


def test_links_without_geometry_and_helpers_keep_their_bodies():
    empty = made(
        "empty",
        {"base": [box("body", (0, 0, 0), (1, 1, 1))], "ghost": [], "tip": [box("tip", (2, 0, 0), (3, 1, 1))]},
        [
            joint("ghost", "revolute", (0, 0, 1), 0, 1),
            replace(joint("tip", "revolute", (0, 1, 0), 0, 1), parent="ghost"),
        ],
    )
    model = model_of(replace(empty, hulls={"base": empty.hulls["base"], "ghost": [], "tip": empty.hulls["tip"]}))
    assert model.nq == 2
    mujoco.mj_step(model, mujoco.MjData(model), 100)


def test_boxes_stand_where_their_corners_are():
    converted = made("one", {"base": [box("body", (0, 0, 0), (1, 2, 3))]}, [])
    pose = np.eye(4)
    pose[:3, 3] = (0.5, 1, 1.5)
    corners = converted.hulls["base"][0].vertices
    hull = ConvexShape(vertices=corners, is_handle=False, box_pose=pose, box_size=np.array([0.5, 1, 1.5]))
    model = model_of(replace(converted, hulls={"base": [hull]}))
    geom = model.geom("base/hull_0")
    assert geom.type[0] == mujoco.mjtGeom.mjGEOM_BOX
    assert geom.pos == pytest.approx(pose[:3, 3]) and geom.size == pytest.approx([0.5, 1, 1.5])


def test_a_written_model_opens_from_its_folder(tmp_path):
    mjcf = to_mjcf(cupboard(), MjcfConfig())
    mjcf.write(tmp_path)
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml")).nq == 3


def test_what_mujoco_refuses_is_said_in_one_line():
    with pytest.raises(ObjectError, match="MuJoCo does not compile the model: ") as caught:
        Mjcf(xml="<mujoco><worldbody><geom size='-1'/></worldbody></mujoco>", assets={}).compile()
    assert "\n" not in str(caught.value)
