"""MuJoCo Warp on CPU against the C implementation, and on its own."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from pushes import BATCH, EVERYONE, Pushes, assert_bitwise

from vatmart_jax.data.banks import HINGE, SLIDE
from vatmart_jax.errors import UserError
from vatmart_jax.physics import BACKENDS, make_physics
from vatmart_jax.physics.gripper import PART

warp = pytest.importorskip("vatmart_jax.physics.backend_warp", exc_type=ImportError)


class WarpPushes(Pushes):
    def __init__(self, cabinets, kind: int, collision: str = "hull"):
        super().__init__(cabinets, kind, collision)
        self.in_c = (self.reset, self.rollout)
        self.use(make_physics(self.bank, "warp"))


@pytest.fixture(scope="module")
def doors(cabinets) -> WarpPushes:
    return WarpPushes(cabinets, HINGE)


@pytest.mark.parametrize("collision", ["hull", "box"])
@pytest.mark.parametrize("kind", [HINGE, SLIDE], ids=["hinge", "slide"])
def test_pushes_of_different_scenes_end_as_in_c(cabinets, kind, collision):
    pushes = WarpPushes(cabinets, kind, collision)
    ours = pushes.pushed(rollouts=3)
    pushes.reset, pushes.rollout = pushes.in_c
    theirs = pushes.pushed(rollouts=3)
    assert ours.in_contact.sum() >= BATCH / 2 and not ours.diverged.any()
    assert len(set(np.asarray(ours.scene).tolist())) == 3
    np.testing.assert_array_equal(ours.in_contact, theirs.in_contact)
    np.testing.assert_allclose(ours.qpos, theirs.qpos, atol={"hull": 0.02, "box": 1e-3}[collision])
    assert np.median(np.abs(ours.qpos - theirs.qpos)[:, PART]) < 1e-4


def test_start_poses_touch_what_they_touch_in_c(doors):
    scene, pose, qpos = doors.starts()
    inside = pose.copy()
    inside[::2, :3] += 0.5 * (doors.bank.part_pos[scene[::2]] - inside[::2, :3])
    for poses in (pose, inside):
        ours, theirs = doors.reset(scene, poses, qpos), doors.in_c[0](scene, poses, qpos)
        np.testing.assert_array_equal(ours.in_contact, theirs.in_contact)
    assert ours.in_contact.any() and not ours.in_contact.all()


def test_the_state_carries_everything_from_call_to_call(doors):
    ctrl = doors.controls()
    whole = doors.rollout(doors.reset(*doors.starts()), ctrl, EVERYONE)
    half = doors.reset(*doors.starts())
    for part in np.split(ctrl, 2, axis=1):
        half = doors.rollout(half, part, EVERYONE)
    assert_bitwise(whole, half)


def test_simulations_that_blow_up_are_marked_and_never_touch_others(doors):
    scene, pose, qpos = doors.starts()
    sound = doors.rollout(doors.reset(scene, pose, qpos), doors.controls(), EVERYONE)
    bad_pose, bad_qpos = pose.copy(), qpos.copy()
    bad_qpos[1, 4], bad_pose[4, 0] = np.nan, np.inf
    begun = doors.reset(scene, bad_pose, bad_qpos)
    np.testing.assert_array_equal(begun.diverged, np.isin(np.arange(BATCH), [1, 4]))
    # Finite now, but not for long.
    begun = replace(begun, qvel=begun.qvel.at[6].set(1e30).at[7, 3].set(1e12))
    after = doors.rollout(begun, doors.controls(), EVERYONE)
    bad = np.isin(np.arange(BATCH), [1, 4, 6, 7])
    np.testing.assert_array_equal(after.diverged, bad)
    assert_bitwise(after, sound, ~bad)
    assert_bitwise(replace(after, diverged=begun.diverged), begun, bad)
    # Their worlds are as new.
    assert_bitwise(doors.rollout(doors.reset(scene, pose, qpos), doors.controls(), EVERYONE), sound)


def test_constraints_without_room_are_divergence(cabinets, monkeypatch, capfd):
    monkeypatch.setattr(warp, "_ROWS", 4)
    pushes = WarpPushes(cabinets, HINGE)
    state = pushes.pushed(rollouts=2)
    assert state.diverged.any()
    # A contact has six rows: whoever got by touched nothing.
    touched = np.asarray(pushes.in_c[1](pushes.in_c[0](*pushes.starts()), pushes.controls(), EVERYONE).in_contact)
    assert (np.asarray(state.diverged) | ~touched).all()
    assert capfd.readouterr().out == ""


def test_contacts_without_room_are_divergence_from_the_start_on(cabinets, monkeypatch):
    monkeypatch.setattr(warp, "_CONTACTS", 0)
    monkeypatch.setattr(warp, "_CONTACTS_AT_LEAST", 1)
    pushes = WarpPushes(cabinets, HINGE)
    scene, pose, qpos = pushes.starts()
    assert not pushes.reset(scene, pose, qpos).diverged.any()
    pose[:, :3] = pushes.bank.part_pos[scene]
    assert pushes.reset(scene, pose, qpos).diverged.all()


def test_without_the_package_the_error_names_the_extra(cabinets, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco_warp", None)
    monkeypatch.delitem(sys.modules, "vatmart_jax.physics.backend_warp")
    monkeypatch.setitem(BACKENDS._entries, "warp", "vatmart_jax.physics.backend_warp:WarpPhysics")
    with pytest.raises(UserError, match=r"pip install 'vatmart-jax\[warp\]'"):
        make_physics(cabinets[0].select(cabinets[0].joint_type == HINGE), "warp")
