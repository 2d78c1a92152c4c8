"""Environments of several splits: one physics, the same shapes, one compilation."""

from __future__ import annotations

from functools import partial

import jax
import numpy as np
import pytest

from vatmart_jax.envs import Env, EnvConfig, make_env, make_envs
from vatmart_jax.errors import UserError

KEY = jax.random.key(0)
CONFIG = EnvConfig(num_envs=8)


@pytest.fixture(scope="module")
def envs(cabinets) -> dict[str, Env]:
    bank, views = cabinets
    splits = {name: bank.split == name for name in ("train", "test_shapes", "test_categories", "extra")}
    return make_envs(bank, views, splits, "push-drawer", config=CONFIG, required=("train",))


def test_a_program_compiled_for_one_split_serves_the_others(envs):
    traces = 0

    @partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
    def first_step(env: Env, key: jax.Array):
        nonlocal traces
        traces += 1
        state = env.reset(key)
        return env.step(state, jax.numpy.zeros((8, env.action_size)))

    assert list(envs) == ["train", "test_shapes", "test_categories"]  # nothing of the other one
    assert len({id(env.physics) for env in envs.values()}) == 1
    assert len({len(env.views) for env in envs.values()}) > 1
    for name, env in envs.items():
        state = first_step(env, KEY)
        assert (env.bank.split[np.asarray(state.physics.scene)] == name).all()
    assert traces == 1


def test_views_that_fill_a_table_up_never_appear(envs):
    for env in envs.values():
        assert env.view_table.scene.shape == (3,)
        view = np.asarray(env.sample(KEY, 2000).view)
        assert set(view) == set(range(len(env.views)))
        assert all(len(x) == len(env.views) for x in env.joints())


def test_an_environment_of_several_splits_is_that_of_its_split_alone(cabinets, envs):
    bank, views = cabinets
    chosen = np.flatnonzero(bank.split == "train")
    alone = make_env(bank.select(chosen), views.of_scenes(chosen), "push-drawer", config=CONFIG)
    a, b = alone.reset(KEY), envs["train"].reset(KEY)
    np.testing.assert_allclose(a.obs, b.obs, atol=1e-6)
    np.testing.assert_array_equal(a.start.view, b.start.view)


def test_a_required_split_without_the_part_is_named(cabinets):
    bank, views = cabinets
    with pytest.raises(UserError, match=r"split extra: the data has no drawer \(slide\), which task push-drawer needs"):
        make_envs(bank, views, {"extra": bank.split == "extra"}, "push-drawer", required=("extra",))
    assert make_envs(bank, views, {"extra": bank.split == "extra"}, "push-drawer") == {}
