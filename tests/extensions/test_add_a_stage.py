"""A stage of one's own, in one file: registered, named in the schedule, resumed and logged as the others are."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import pytest
from tiny import TINY

from vatmart_jax.envs import TASKS, make_env
from vatmart_jax.errors import UserError
from vatmart_jax.pipeline.proposal_rollouts import interactions_of
from vatmart_jax.pipeline.run_dir import RunDir, read_metrics
from vatmart_jax.pipeline.stages import STAGES
from vatmart_jax.pipeline.trainer import PipelineTrainer
from vatmart_jax.reporting import NullReporter

pytestmark = pytest.mark.usefixtures("quick_to_compile")


@dataclass(frozen=True)
class RandomTrials:
    """Uniform random actions fill the sample buffer: two batches."""

    name: str = "random-trials"
    shown: tuple[str, ...] = ("valid",)

    def num_units(self, settings):
        return 2

    def run_unit(self, ctx, state, unit):
        policy = ctx.explorer.agent.acting_params(state.explore.agent)
        key = ctx.key("random-trials", unit)
        final, _ = ctx.explorer.rollout(policy, None, key, noise=0.0, random=1.0, terminate_on_failure=False)
        return state.with_samples(interactions_of(final)), {"valid": final.valid.mean()}


@pytest.fixture
def settings():
    STAGES.register("random-trials", RandomTrials())
    yield replace(TINY, schedule=replace(TINY.schedule, stages=("random-trials", "actionability")))
    STAGES.unregister("random-trials")


class Killed(Exception):
    pass


class Killer(NullReporter):
    def progress(self, stage, done, total, metrics=None):
        if (stage, done) == ("random-trials", 1):
            raise Killed


def test_a_stage_of_ones_own_runs_is_logged_and_goes_on_where_it_was_killed(settings, cabinets, tmp_path):
    env = make_env(*cabinets, TASKS["push-drawer"], "c", settings.env, settings.physics)
    with RunDir(tmp_path / "run", {"a": 1}) as run, pytest.raises(Killed):
        PipelineTrainer(run, env, settings, seed=0, reporter=Killer()).train()
    with RunDir(tmp_path / "run", {"a": 1}) as run:
        trainer = PipelineTrainer(run, env, settings, seed=0, seconds_between_checkpoints=0.0)
        state = trainer.train()
    rows = read_metrics(tmp_path / "run")
    assert [(row["stage"], row["step"]) for row in rows] == [
        ("random-trials", 1), ("random-trials", 2), ("actionability", 3),
    ]  # fmt: skip
    assert int(state.stored) == 2 * settings.env.num_envs
    assert list(trainer.run_seconds(state)) == ["random-trials", "actionability", "compile"]
    assert all(0 <= row["valid"] <= 1 for row in rows[:2])
    assert jax.tree.all(jax.tree.map(lambda x: bool(jax.numpy.isfinite(x).all()), state.perception.params))


def test_an_unknown_stage_is_refused_with_the_known_ones(cabinets, tmp_path):
    settings = replace(TINY, schedule=replace(TINY.schedule, stages=("explore", "dream")))
    env = make_env(*cabinets, TASKS["push-drawer"], "c", settings.env, settings.physics)
    with RunDir(tmp_path / "run", {}) as run, pytest.raises(UserError, match="stage 'dream' is not known; use one of"):
        PipelineTrainer(run, env, settings, seed=0)
