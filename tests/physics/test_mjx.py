from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pushes import APPROACH, BATCH, EVERYONE, STEPS, Pushes, assert_bitwise
from scipy.spatial import ConvexHull

from vatmart_jax.data.banks import HINGE, SceneBank
from vatmart_jax.physics import PhysicsConfig, make_physics
from vatmart_jax.physics.backend_c import CPhysics
from vatmart_jax.physics.backend_mjx import CollisionSlots, MjxPhysics, _nearest_slots
from vatmart_jax.physics.gripper import PART
from vatmart_jax.physics.mjx_boxes import Boxes


class MjxPushes(Pushes):
    """The pushes of `pushes`, by MJX; `c` is the reference."""

    def __init__(self, cabinets, kind, collision="hull"):
        super().__init__(cabinets, kind, collision)
        self.c = self.physics
        self.use(make_physics(self.bank, "jax"))

    def steady(self) -> np.ndarray:
        """[BATCH, STEPS, 8]: forwards by 0.15."""
        ctrl = np.zeros((BATCH, STEPS, 8), np.float32)
        ctrl[..., APPROACH] = 0.15 * np.linspace(0, 1, STEPS)
        return ctrl


@pytest.fixture(scope="module")
def doors(cabinets) -> MjxPushes:
    return MjxPushes(cabinets, HINGE, "box")


def test_boxes_end_where_the_c_implementation_puts_them(doors):
    pushed = 0
    for seed in range(4):
        start = doors.starts(seed)
        ours, theirs = doors.reset(*start), doors.c.reset(*start)
        np.testing.assert_array_equal(ours.in_contact, theirs.in_contact)
        for _ in range(2):
            ours = doors.rollout(ours, doors.steady(), EVERYONE)
            theirs = doors.c.rollout(theirs, doors.steady(), EVERYONE)
        assert not ours.diverged.any()
        apart = np.abs(np.asarray(ours.qpos - theirs.qpos))
        assert np.median(apart[:, PART]) < 2e-3 and apart.max() < 0.05
        assert np.mean(np.asarray(ours.in_contact == theirs.in_contact)) > 0.8
        pushed += int((np.abs(np.asarray(theirs.qpos)[:, PART] - start[2][:, PART]) > 0.02).sum())
    assert pushed > 2 * BATCH


def test_a_hand_at_its_force_limit_moves_as_in_c(doors):
    scene, pose, qpos = doors.starts()
    pose[:, :3] = [-5, 0, 0]
    ctrl = np.tile(np.array([1, -1, 2, 0.5, 0, 0, 0.04, 0.04], np.float32), (BATCH, STEPS, 1))
    ours = doors.rollout(doors.reset(scene, pose, qpos), ctrl, EVERYONE)
    theirs = doors.c.rollout(doors.c.reset(scene, pose, qpos), ctrl, EVERYONE)
    np.testing.assert_allclose(ours.qpos, theirs.qpos, atol=1e-4)
    np.testing.assert_allclose(ours.qvel, theirs.qvel, atol=1e-3)


def test_hands_inside_an_object_are_in_contact_from_the_start(doors):
    scene, pose, qpos = doors.starts()
    inside = pose.copy()
    inside[::2, :3] = doors.bank.part_pos[scene[::2]] + [0.1, 0, 0]
    for start in ((scene, pose, qpos), (scene, inside, qpos)):
        np.testing.assert_array_equal(doors.reset(*start).in_contact, doors.c.reset(*start).in_contact)


def test_controls_that_are_merely_hard_do_not_spread(doors):
    before, ctrl = doors.pushed(), doors.controls(1)
    sound = doors.rollout(before, ctrl, EVERYONE)
    ctrl[2, STEPS // 2, 3] = 1e30  # the actuator's force is limited
    after = doors.rollout(before, ctrl, EVERYONE)
    assert_bitwise(after, sound, np.arange(BATCH) != 2)
    assert all(np.isfinite(leaf).all() for leaf in (after.qpos, after.qvel))


def test_bad_starts_are_marked_and_stay_as_they_are(doors):
    scene, pose, qpos = doors.starts()
    qpos[1, 4], pose[4, 0] = np.nan, np.nan
    begun = doors.reset(scene, pose, qpos)
    state = doors.rollout(begun, doors.controls(), EVERYONE)
    for s in (begun, state):
        np.testing.assert_array_equal(s.diverged, np.isin(np.arange(BATCH), [1, 4]))
        assert not s.in_contact[1] and not s.in_contact[4]
    assert_bitwise(state, doors.pushed(), ~np.asarray(state.diverged))


def test_each_box_gets_its_nearest_slots():
    rng = np.random.default_rng(0)
    n, few = 40, 3
    quat = rng.normal(size=(n, 4))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    pos, half = rng.uniform(-1, 1, (n, 3)), np.full((n, 3), 0.02)
    slots = CollisionSlots(*map(jnp.asarray, (pos, quat, half, np.arange(n), pos, half)))
    boxes = rng.uniform(-1, 1, (2, 3))
    eyes = np.tile(np.eye(3), (2, 1, 1))
    placed = Boxes(jnp.asarray(boxes), jnp.asarray(eyes), jnp.full((2, 3), 0.02))
    found = _nearest_slots(slots, slots.boxes, placed, few)
    for box, chosen in zip(boxes, np.asarray(found.mesh).reshape(2, few), strict=True):
        nearest = np.argsort(np.linalg.norm(pos - box, axis=1))
        assert set(chosen[:1]) <= set(nearest[:few]) and set(chosen) <= set(nearest[: 2 * few])


def bevelled(bank: SceneBank) -> SceneBank:
    """The same bank with the corners of every third hull cut: hulls of different sizes."""
    hulls = []
    for shape in range(len(bank.hull_start) - 1):
        hull = bank.hull(shape)
        if shape % 3 == 0:
            half = hull.max(0)
            hull = np.concatenate(
                [hull * np.where(np.arange(3) == axis, 1 - 0.3 * half.min() / half, 1) for axis in range(3)]
            )
            hull = hull[ConvexHull(hull).vertices]
        hulls.append(hull.astype(np.float32))
    start = np.cumsum([0, *map(len, hulls)]).astype(np.int32)
    return replace(bank, hull_vertices=np.concatenate(hulls), hull_start=start)


@pytest.mark.slow
def test_hulls_of_different_sizes_end_where_the_c_implementation_puts_them(cabinets):
    pushes = Pushes((bevelled(cabinets[0]), cabinets[1]), HINGE)
    ours = MjxPhysics(pushes.bank, PhysicsConfig())
    start = pushes.starts()
    ctrl = np.zeros((BATCH, STEPS, 8), np.float32)
    ctrl[..., APPROACH] = 0.15 * np.linspace(0, 1, STEPS)
    both = (ours, CPhysics(pushes.bank, PhysicsConfig()))
    ends = [jax.jit(p.rollout)(jax.jit(p.reset)(*start), ctrl, EVERYONE) for p in both]
    apart = np.abs(np.asarray(ends[0].qpos - ends[1].qpos))[:, PART]
    assert (np.abs(np.asarray(ends[1].qpos)[:, PART] - start[2][:, PART]) > 0.02).sum() >= BATCH / 2
    assert np.median(apart) < 2e-3 and apart.max() < 0.05
