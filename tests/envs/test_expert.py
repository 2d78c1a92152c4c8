import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vatmart_jax import rotations as rot
from vatmart_jax.envs.contact_candidates import grasps, promising_contacts
from vatmart_jax.envs.env import TASKS, Env, EnvConfig
from vatmart_jax.envs.scripted_policy import expert_start, run_expert

KEY = jax.random.key(0)


def jit(f):
    return jax.jit(f, compiler_options={"xla_backend_optimization_level": 0})


@pytest.mark.parametrize("task", list(TASKS))
def test_the_expert_does_what_is_asked_in_most_trials(cabinets, task):
    env = Env(*cabinets, TASKS[task], config=EnvConfig(batch=16))
    start = env.sample(KEY, 16)
    final = jit(lambda start, key: run_expert(env, start, key))(start, KEY)
    assert final.success.mean() >= 0.7
    np.testing.assert_array_equal(final.start.view, start.view)
    np.testing.assert_array_equal(final.start.task, start.task)


def test_pushes_start_on_faces_against_the_motion(cabinets):
    bank, views = cabinets
    env = Env(bank, views, TASKS["push-drawer"], config=EnvConfig(batch=16, guided_share=1.0))
    start = env.sample(KEY, 200)
    normals = np.asarray(env.views.contact_normals)[start.view, start.contact]
    opens = np.asarray(env._scenes.axis)[env.views.scene[start.view]]
    assert ((normals * opens).sum(-1) > 0.5).all()


def test_a_view_that_shows_nowhere_to_push_is_no_trial(cabinets):
    bank, views = cabinets
    task = TASKS["push-drawer"]
    drawers = np.flatnonzero(bank.joint_type == task.joint_type)
    bank, views = bank.select(drawers), views.of_scenes(drawers)
    inside = views.select(slice(None))
    inside.contact_normals[0] *= -1  # the camera sees the back of the front
    assert not promising_contacts(bank, inside, task.opening)[0].any()


def test_handles_are_grasped_from_the_front_across_their_thin_side(cabinets):
    bank, views = cabinets
    env = Env(bank, views, TASKS["pull-drawer"], config=EnvConfig(batch=16, guided_share=1.0))
    up, across = grasps(env.bank, env.views)
    np.testing.assert_allclose((up * across).sum(-1), 0, atol=1e-5)
    start = env.approach(KEY, jnp.arange(len(env.views)), jnp.full(len(env.views), 0.2), 1.0)
    handle = np.asarray(env.views.contact_handle)[start.view, start.contact]
    assert handle.any()
    cosine = (np.asarray(start.rotation)[:, :, 2] * up[start.view, start.contact]).sum(-1)
    assert (cosine[handle] > np.cos(env.config.grasp_cone) - 1e-4).all()
    fingers = np.abs((np.asarray(start.rotation)[:, :, 1] * across[start.view, start.contact]).sum(-1))
    assert np.median(fingers[handle]) > 0.9


def test_the_expert_takes_the_first_valid_of_its_candidates(cabinets):
    env = Env(*cabinets, TASKS["push-door"], config=EnvConfig(batch=16))
    start = env.sample(KEY, 16)
    chosen = jit(lambda s, k: expert_start(env, s, k))(start, KEY)
    assert jit(env.is_free)(chosen).all()
    np.testing.assert_allclose(rot.rotate(chosen.rotation.swapaxes(1, 2), chosen.rotation[:, :, 2])[:, 2], 1, atol=1e-5)
