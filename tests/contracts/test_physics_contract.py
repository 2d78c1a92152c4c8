"""What every implementation of the physics keeps to."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from pushes import BATCH, EVERYONE, STEPS, Pushes, assert_bitwise

from vatmart_jax.data.banks import HINGE
from vatmart_jax.physics import BACKENDS


@pytest.fixture(scope="module", params=BACKENDS.names())
def pushes(request, cabinets) -> Pushes:
    """Doors. MJX is quick with boxes."""
    if request.param == "warp":
        pytest.importorskip("mujoco_warp", exc_type=ImportError)
    return Pushes(cabinets, HINGE, "box" if request.param == "jax" else "hull", request.param)


def test_the_state_has_the_grippers_sizes(pushes):
    state = pushes.pushed()
    gripper = pushes.physics.gripper
    assert state.qpos.shape == state.qvel.shape == (BATCH, gripper.num_qpos)
    np.testing.assert_array_equal(state.joint_pos, state.qpos[:, 0])
    assert gripper.name == pushes.physics.config.gripper == "panda"


def test_a_recorded_rollout_ends_as_one_that_is_not(pushes):
    before, ctrl, active = pushes.pushed(), pushes.controls(1), np.arange(BATCH) % 3 != 0
    rollout = jax.jit(pushes.physics.rollout, static_argnames="record_every")
    after, qpos = rollout(before, ctrl, active, record_every=STEPS // 3)
    assert qpos.shape == (3, BATCH, pushes.physics.gripper.num_qpos)
    np.testing.assert_array_equal(qpos[-1], after.qpos)
    np.testing.assert_allclose(after.qpos, pushes.rollout(before, ctrl, active).qpos, atol=1e-3)
    assert (np.asarray(qpos[0] != qpos[1])).any(1)[active].all()
    with pytest.raises(ValueError, match=f"record_every 7: not a divisor of the {STEPS} steps"):
        rollout(before, ctrl, active, record_every=7)


def test_inactive_simulations_stay_bitwise_the_same(pushes):
    before, active = pushes.pushed(), np.arange(BATCH) % 3 != 0
    after = pushes.rollout(before, pushes.controls(1), active)
    assert_bitwise(after, before, ~active)
    assert (np.asarray(after.qpos)[active] != np.asarray(before.qpos)[active]).any(1).all()
    assert_bitwise(after, pushes.rollout(before, pushes.controls(1), EVERYONE), active)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_bad_controls_mark_only_their_simulation_and_never_spread(pushes, bad):
    before, ctrl = pushes.pushed(), pushes.controls(1)
    sound = pushes.rollout(before, ctrl, EVERYONE)
    ctrl[2, STEPS // 2, 3] = bad
    after = pushes.rollout(before, ctrl, EVERYONE)
    np.testing.assert_array_equal(after.diverged, np.arange(BATCH) == 2)
    assert_bitwise(after, sound, np.arange(BATCH) != 2)
    assert_bitwise(after.replace(diverged=before.diverged), before, [2])
    # It stays as it is, whatever comes.
    again = pushes.rollout(after, pushes.controls(2), EVERYONE)
    assert_bitwise(again, after, [2])
    assert all(np.isfinite(leaf).all() for leaf in (again.qpos, again.qvel))


def test_ten_rollouts_with_changing_scenes_compile_once(pushes):
    traces = 0

    @jax.jit
    def trial(scene, pose, qpos, ctrl):
        nonlocal traces
        traces += 1
        state = pushes.physics.reset(scene, pose, qpos)
        state, _ = jax.lax.scan(lambda s, c: (pushes.physics.rollout(s, c, ~s.diverged), None), state, ctrl)
        return state.qpos

    seen = set()
    for seed in range(10):
        starts = pushes.starts(seed)
        seen.add(tuple(starts[0].tolist()))
        found = trial(*starts, pushes.controls(seed)[None].repeat(2, 0))
        assert np.isfinite(found).all()
    assert len(seen) == 10
    assert (traces, trial._cache_size()) == (1, 1)
    alone = pushes.reset(*starts)
    for _ in range(2):
        alone = pushes.rollout(alone, pushes.controls(9), EVERYONE)
    np.testing.assert_array_equal(found, alone.qpos)


def test_vmap_over_a_leading_axis_equals_separate_calls(pushes):
    if type(pushes.physics).__name__ == "MjxPhysics":
        pytest.skip("XLA rounds differently at another batch size")
    states = [pushes.reset(*pushes.starts(seed)) for seed in (0, 1)]
    both = jax.jit(jax.vmap(pushes.physics.reset))(*map(np.stack, zip(pushes.starts(0), pushes.starts(1), strict=True)))
    ctrl, active = np.stack([pushes.controls(0), pushes.controls(1)]), np.ones((2, BATCH), bool)
    both = jax.jit(jax.vmap(pushes.physics.rollout))(both, ctrl, active)
    for k in (0, 1):
        assert_bitwise(jax.tree.map(lambda x, k=k: x[k], both), pushes.rollout(states[k], ctrl[k], active[k]))
    one_start = jax.jit(jax.vmap(pushes.physics.rollout, (None, 0, None)))(states[0], ctrl, active[0])
    for k in (0, 1):
        assert_bitwise(jax.tree.map(lambda x, k=k: x[k], one_start), pushes.rollout(states[0], ctrl[k], active[0]))
