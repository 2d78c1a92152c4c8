import os
import subprocess
import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from pushes import APPROACH, BATCH, EVERYONE, GRIPPER, STEPS, Pushes, assert_bitwise
from scipy.spatial.transform import Rotation

from vatmart_jax import rotations as rot
from vatmart_jax.data.banks import HINGE, SLIDE
from vatmart_jax.errors import UserError
from vatmart_jax.physics import PhysicsConfig, make_physics
from vatmart_jax.physics.backend_c import CPhysics
from vatmart_jax.physics.controller import waypoint_controls
from vatmart_jax.physics.gripper import PART
from vatmart_jax.physics.scene_model import scene_model, template


@pytest.fixture(scope="module")
def doors(cabinets) -> Pushes:
    return Pushes(cabinets, HINGE)


@pytest.mark.parametrize("collision", ["hull", "box"])
@pytest.mark.parametrize("kind", [HINGE, SLIDE], ids=["hinge", "slide"])
def test_a_batch_of_different_scenes_is_bit_identical_to_plain_mujoco_on_each_alone(cabinets, kind, collision):
    pushes = Pushes(cabinets, kind, collision)
    state = pushes.pushed(rollouts=3)
    assert len(set(np.asarray(state.scene).tolist())) == 3
    assert state.in_contact.sum() >= BATCH / 2 and not state.diverged.any()
    slots = (int(np.diff(pushes.bank.static_start).max()), int(np.diff(pushes.bank.part_start).max()))
    scene, pose, qpos = pushes.starts()
    for i in range(BATCH):
        model = scene_model(pushes.bank, scene[i], pushes.physics.config, slots)
        data = mujoco.MjData(model)
        data.qpos[:], data.mocap_pos[1], data.mocap_quat[1] = qpos[i], pose[i, :3], pose[i, 3:]
        for k in range(3):
            for ctrl in pushes.controls(k)[i]:
                data.ctrl[:] = ctrl
                mujoco.mj_step(model, data)
        alone = np.concatenate([data.qpos, data.qvel, data.qacc_warmstart])
        np.testing.assert_array_equal(np.asarray(state.backend_state)[i].view(np.float64), alone)
        np.testing.assert_array_equal(state.qpos[i], data.qpos.astype(np.float32))
        assert abs(data.qpos[PART] - qpos[i, PART]) > 1e-4 or not state.in_contact[i]


def test_unused_slots_change_nothing_but_rounding(doors):
    scene, pose, qpos = doors.starts()
    ctrl = doors.controls()
    for i in np.flatnonzero(scene == 0):
        model = scene_model(doors.bank, 0, doors.physics.config)
        data = mujoco.MjData(model)
        data.qpos[:], data.mocap_pos[1], data.mocap_quat[1] = qpos[i], pose[i, :3], pose[i, 3:]
        for row in ctrl[i]:
            data.ctrl[:] = row
            mujoco.mj_step(model, data)
        np.testing.assert_allclose(doors.pushed().qpos[i], data.qpos, atol=1e-6)


def test_a_simulation_that_blows_up_is_marked_and_its_place_is_as_new_afterwards(doors):
    scene, pose, qpos = doors.starts()
    bad_pose, bad_qpos = pose.copy(), qpos.copy()
    bad_qpos[1, 4] = np.nan
    bad_pose[4, 0] = np.nan
    begun = doors.reset(scene, bad_pose, bad_qpos)
    state = doors.rollout(begun, doors.controls(), EVERYONE)
    np.testing.assert_array_equal(begun.diverged, state.diverged)
    np.testing.assert_array_equal(state.diverged, np.isin(np.arange(BATCH), [1, 4]))
    sound = doors.pushed()
    assert_bitwise(state, sound, ~np.asarray(state.diverged))
    # A fresh pool has never seen a NaN.
    fresh = CPhysics(doors.bank, PhysicsConfig())
    assert_bitwise(sound, fresh.rollout(fresh.reset(scene, pose, qpos), doors.controls(), EVERYONE))


def test_divergence_is_noticed_every_time_and_said_nowhere_else(doors, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    scene, pose, qpos = doors.starts()
    qpos[4, 2], qpos[5, 3] = 1e11, np.nan  # MuJoCo calls more than 1e10 bad
    mine = lambda message: None
    mujoco.set_mju_user_warning(mine)
    try:
        for seed in range(3):
            state = doors.rollout(doors.reset(scene, pose, qpos), doors.controls(seed), EVERYONE)
            np.testing.assert_array_equal(state.diverged, np.isin(np.arange(BATCH), [4, 5]))
        assert mujoco.get_mju_user_warning() is mine
    finally:
        mujoco.set_mju_user_warning(None)
    assert not list(tmp_path.iterdir())
    assert capfd.readouterr().err == ""


def test_threads_do_not_change_results(cabinets, doors):
    for threads in (1, 5):
        pushes = Pushes(cabinets, HINGE)
        pushes.use(CPhysics(pushes.bank, PhysicsConfig(), threads))
        assert_bitwise(pushes.pushed(rollouts=2), doors.pushed(rollouts=2))


def test_hands_inside_an_object_are_in_contact_from_the_start_and_others_are_not(doors):
    scene, pose, qpos = doors.starts()
    assert not doors.reset(scene, pose, qpos).in_contact.any()
    inside = pose.copy()
    up = np.asarray(rot.matrix_from_quat(jnp.asarray(pose[:, 3:])))[:, :, 2]
    inside[::2, :3] += 0.08 * up[::2]
    np.testing.assert_array_equal(doors.reset(scene, inside, qpos).in_contact, np.arange(BATCH) % 2 == 0)


def test_parts_have_the_configured_inertia_and_stay_within_their_range(cabinets):
    margin = 0.01
    for kind in (HINGE, SLIDE):
        pushes = Pushes(cabinets, kind)
        inertia = [np.asarray(row).ravel()[0] for row in pushes.physics._template.fields["dof_M0"]]
        np.testing.assert_allclose(inertia, PhysicsConfig().part_inertia[kind], rtol=1e-6)
        scene, pose, qpos = pushes.starts()
        ctrl = np.zeros((BATCH, STEPS, GRIPPER.num_ctrl), np.float32)
        ctrl[..., APPROACH] = 1.0  # far behind the closed part
        state = pushes.reset(scene, pose, qpos)
        for _ in range(4):
            state = pushes.rollout(state, ctrl, EVERYONE)
        assert (state.qpos[:, PART] > -margin).all()
        assert (state.qpos[:, PART] < pushes.bank.joint_range[scene] + margin).all()


def test_hand_targets_put_the_fingertips_where_asked(doors):
    rng = np.random.default_rng(0)
    frames = jnp.asarray(Rotation.random(5, random_state=1).as_matrix(), jnp.float32)
    move, euler = (jnp.asarray(rng.uniform(-0.5, 0.5, (5, 3)), jnp.float32) for _ in range(2))
    target = jax.jit(GRIPPER.targets)(move, euler, frames, jnp.zeros(5))
    model = scene_model(doors.bank, 0, PhysicsConfig())
    data = mujoco.MjData(model)
    hand = model.body("hand").id
    for i in range(5):
        data.mocap_pos[1], data.mocap_quat[1] = [1, 2, 3], rot.quat_from_matrix(frames[i])
        data.qpos[GRIPPER.hand_qpos] = target[i, :6]
        mujoco.mj_kinematics(model, data)
        turned = data.xmat[hand].reshape(3, 3)
        started = np.array([1, 2, 3]) + GRIPPER.tip_offset * np.asarray(frames[i])[:, 2]
        np.testing.assert_allclose(data.xpos[hand] + GRIPPER.tip_offset * turned[:, 2], started + move[i], atol=1e-5)
        np.testing.assert_allclose(turned, frames[i] @ rot.matrix_from_euler(euler[i]), atol=1e-5)


def test_the_free_hand_arrives_within_a_waypoint(doors):
    config = doors.physics.config
    scene, pose, qpos = doors.starts()
    pose[:, :3] = [-3, 0, 0]
    rng = np.random.default_rng(0)
    target = np.concatenate([rng.uniform(-0.3, 0.3, (BATCH, 3)), rng.uniform(-0.7, 0.7, (BATCH, 3))], -1)
    target = np.concatenate([target, np.full((BATCH, 2), GRIPPER.max_opening)], -1).astype(np.float32)
    ctrl = waypoint_controls(jnp.zeros((BATCH, GRIPPER.num_ctrl)), jnp.asarray(target), config)
    assert ctrl.shape == (BATCH, config.steps_per_waypoint, GRIPPER.num_ctrl)
    np.testing.assert_allclose(ctrl[:, -1], target, atol=1e-6)
    state = doors.rollout(doors.reset(scene, pose, qpos), ctrl, EVERYONE)
    np.testing.assert_allclose(state.qpos[:, GRIPPER.hand_qpos], target[:, :6], atol=1e-3)
    np.testing.assert_allclose(state.qpos[:, 7:], target[:, 6:], atol=1e-3)
    np.testing.assert_array_equal(state.qpos[:, PART], qpos[:, PART])


def test_banks_of_both_joint_types_and_unknown_implementations_are_refused(cabinets):
    with pytest.raises(ValueError, match="all of one joint type"):
        template(cabinets[0], PhysicsConfig())
    with pytest.raises(ValueError, match="all of one joint type"):
        template(cabinets[0].select(np.zeros(0, int)), PhysicsConfig())
    with pytest.raises(UserError, match="impl 'sapien' is not known; use one of c, warp, jax"):
        make_physics(cabinets[0], "sapien")


def test_halving_the_time_step_hardly_moves_the_part(cabinets):
    """The study's bound (docs/physics.md) on a handful of pushes."""
    moved = []
    for share in (1, 2):
        pushes = Pushes(cabinets, HINGE)
        config = replace(PhysicsConfig(), timestep=0.004 / share)
        physics = CPhysics(pushes.bank, config)
        state = physics.reset(*pushes.starts())
        moved.append(physics.rollout(state, pushes.controls().repeat(share, 1), EVERYONE).qpos[:, PART])
    assert np.median(np.abs(moved[0] - moved[1])) < 5e-3


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="CPUs are not assigned here")
@pytest.mark.parametrize(
    "first",
    [
        "from vatmart_jax.host_threads import allow_callbacks as f",
        "from vatmart_jax.physics import default_impl as f",
        "from vatmart_jax.cli.common import prepare_jax as f",
    ],
)
def test_a_single_cpu_does_not_wait_for_itself(first: str) -> None:
    program = f"""
import os; os.sched_setaffinity(0, {{min(os.sched_getaffinity(0))}})
{first}; f()
import jax, jax.numpy as jnp, numpy as np
x = jnp.full((512, 512), 1e-3)
twice = lambda x: jax.pure_callback(lambda x: 2 * np.asarray(x), jax.ShapeDtypeStruct(x.shape, x.dtype), x @ x).sum()
for _ in range(5): float(jax.jit(twice)(x))
"""
    environment = {name: value for name, value in os.environ.items() if name != "NPROC"}
    subprocess.run([sys.executable, "-c", program], env=environment, check=True, timeout=120)
