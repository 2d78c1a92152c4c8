import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vatmart_jax import rotations as rot
from vatmart_jax.envs import EnvConfig, get_task, make_env
from vatmart_jax.envs.contact_candidates import candidate_contacts, canonical_grasps
from vatmart_jax.envs.scripted_policy import run_scripted_policy, scripted_start

TASKS = ("push-door", "pull-door", "push-drawer", "pull-drawer")
KEY = jax.random.key(0)


def jit(f):
    return jax.jit(f, compiler_options={"xla_backend_optimization_level": 0})


@pytest.mark.parametrize("task", TASKS)
def test_the_expert_does_what_is_asked_in_most_trials(cabinets, task):
    env = make_env(*cabinets, task, config=EnvConfig(num_envs=16))
    start = env.sample(KEY, 16)
    final = run_scripted_policy(env, start, KEY)
    assert final.success.mean() >= 0.7
    np.testing.assert_array_equal(final.start.view, start.view)
    np.testing.assert_array_equal(final.start.goal, start.goal)


def test_pushes_start_on_faces_against_the_motion(cabinets):
    bank, views = cabinets
    env = make_env(bank, views, "push-drawer", config=EnvConfig(num_envs=16, guided_fraction=1.0))
    start = env.sample(KEY, 200)
    normals = np.asarray(env.views.contact_normals)[start.view, start.contact]
    opens = np.asarray(env.scene_table.axis)[env.views.scene[start.view]]
    assert ((normals * opens).sum(-1) > 0.5).all()


def test_a_view_that_shows_nowhere_to_push_is_no_trial(cabinets):
    bank, views = cabinets
    task = get_task("push-drawer")
    drawers = np.flatnonzero(bank.joint_type == task.joint_type)
    bank, views = bank.select(drawers), views.of_scenes(drawers)
    inside = views.select(slice(None))
    inside.contact_normals[0] *= -1  # the camera sees the back of the front
    assert not candidate_contacts(bank, inside, task)[0].any()


def test_handles_are_grasped_from_the_front_across_their_thin_side(cabinets):
    bank, views = cabinets
    env = make_env(bank, views, "pull-drawer", config=EnvConfig(num_envs=16, guided_fraction=1.0))
    up, across = canonical_grasps(env.bank, env.views)
    np.testing.assert_allclose((up * across).sum(-1), 0, atol=1e-5)
    start = env.sample_approach(KEY, jnp.arange(len(env.views)), jnp.full(len(env.views), 0.2), 1.0)
    handle = np.asarray(env.views.contact_handle)[start.view, start.contact]
    assert handle.any()
    cosine = (np.asarray(start.rotation)[:, :, 2] * up[start.view, start.contact]).sum(-1)
    assert (cosine[handle] > np.cos(env.config.grasp_approach_cone) - 1e-4).all()
    fingers = np.abs((np.asarray(start.rotation)[:, :, 1] * across[start.view, start.contact]).sum(-1))
    assert np.median(fingers[handle]) > 0.9


def test_the_expert_takes_the_first_valid_of_its_candidates(cabinets):
    env = make_env(*cabinets, "push-door", config=EnvConfig(num_envs=16))
    start = env.sample(KEY, 16)
    chosen = jit(lambda s, k: scripted_start(env, s, k))(start, KEY)
    assert jit(env.is_collision_free)(chosen).all()
    np.testing.assert_allclose(rot.rotate(chosen.rotation.swapaxes(1, 2), chosen.rotation[:, :, 2])[:, 2], 1, atol=1e-5)
