"""Lids: hinges about a horizontal axis, pushed shut from above and pulled open at handles or at their free edge."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from lidded_boxes import lidded_boxes

from vatmart_jax.envs import EnvConfig, get_task, make_env
from vatmart_jax.envs.contact_candidates import candidate_contacts, canonical_grasps
from vatmart_jax.envs.scripted_policy import run_scripted_policy

TRIALS = 48


@pytest.fixture(scope="module")
def boxes():
    return lidded_boxes()


@pytest.mark.parametrize("task", ["push-lid", "pull-lid"])
def test_the_scripted_policy_moves_every_kind_of_lid(boxes, task):
    env = make_env(*boxes, task, config=EnvConfig(num_envs=TRIALS))
    final = run_scripted_policy(env, env.sample(jax.random.key(0), TRIALS), jax.random.key(1))
    handles = env.bank.object_id[np.asarray(final.physics.scene)]
    rates = {name: float(np.asarray(final.success)[handles == name].mean()) for name in np.unique(handles)}
    assert set(rates) == {"front", "none", "top"}, rates
    assert final.success.mean() >= 0.8 and min(rates.values()) >= 0.6, rates


def test_the_joint_frame_of_a_lid_is_right_handed_about_its_horizontal_axis(boxes):
    for task in ("push-lid", "pull-lid"):
        env = make_env(*boxes, task, config=EnvConfig(num_envs=TRIALS))
        state = env.begin_trials(env.sample(jax.random.key(0), TRIALS))
        frame = np.asarray(state.frame)
        np.testing.assert_allclose(np.linalg.det(frame), 1, atol=1e-4)
        np.testing.assert_allclose(frame[:, :, 2], [[0, env.task.direction, 0]] * TRIALS, atol=1e-5)
        assert (env.task.direction * frame[:, 2, 0] > -0.3).all()  # the contact rises as the lid opens


def test_lids_are_pushed_on_their_outside_and_grasped_at_handles_or_the_edge(boxes):
    bank, views = boxes
    has_handle = views.contact_handle.any(1)
    push = candidate_contacts(bank, views, get_task("push-lid"))
    assert push[:, :8].mean() > 0.9  # all but those beside the hinge
    assert not push[bank.object_id[views.scene] == "front", 8:].any()
    pull = candidate_contacts(bank, views, get_task("pull-lid"))
    assert not pull[:, :8].any() and pull[:, 8:].all()
    grasps = canonical_grasps(bank, views, "normal")
    edge = ~has_handle
    # The fingers straddle the lid: they close across its plane, which the hand is in.
    np.testing.assert_allclose(grasps.approach[edge, 8:], -views.contact_normals[edge, 8:], atol=1e-6)
    across = (grasps.closing[edge, 8:] * views.contact_normals[edge, :8]).sum(-1)
    assert (np.abs(across) > 0.95).all()
