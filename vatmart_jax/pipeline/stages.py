"""The stages of a run: each says how many units of work it has, and does one.

The loop over units, logging, timing and checkpoints are the trainer's. A stage that is registered here and named in
`schedule.stages` runs as these do.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from vatmart_jax.envs import Env, EnvState, TrialStart
from vatmart_jax.perception import trainer as perception
from vatmart_jax.perception.config import PerceptionConfig, TaskSpec
from vatmart_jax.perception.grouped_views import GroupedViews, group_views
from vatmart_jax.perception.interaction_buffer import Interactions
from vatmart_jax.perception.layers import Params
from vatmart_jax.perception.objectives import OBJECTIVES
from vatmart_jax.perception.objectives import STAGES as TRAINING_STAGES
from vatmart_jax.perception.predictor import TTAPredictor, score_trajectories
from vatmart_jax.pipeline.exploration import ExplorationLoop, start_pool
from vatmart_jax.pipeline.proposal_rollouts import ProposalTrials, interactions_of, select_curious
from vatmart_jax.pipeline.settings import Settings
from vatmart_jax.pipeline.train_state import TrainState
from vatmart_jax.registry import Registry
from vatmart_jax.reporting import Reporter

Metrics = Mapping[str, Any]
"""Scalars by name; `step`, where there is one, is logged in place of the unit's number."""


@dataclass(frozen=True, kw_only=True)
class StageContext:
    """What the stages of a run share. What is costly is made when it is first used."""

    env: Env
    settings: Settings
    perception: PerceptionConfig
    spec: TaskSpec
    predictor: TTAPredictor
    explorer: ExplorationLoop
    reporter: Reporter
    key: Callable[..., jax.Array]
    """(purpose, index) -> a key for one use, the same whenever the run is resumed"""

    @cached_property
    def views(self) -> GroupedViews:
        """The environment's views as the networks read them."""
        show = lambda done, total: self.reporter.progress("group views", done, total)
        grouped = group_views(self.env.views, self.perception.networks.encoder, show)
        return replace(grouped.padded(self.env.num_views), joints=self.env.joints())

    @cached_property
    def pool(self) -> TrialStart:
        """Starts known to be free."""
        size = self.settings.explore.start_pool_size
        show = lambda done: self.reporter.progress("find starts", done, size)
        return start_pool(self.env, self.key("pool"), size, show)

    @cached_property
    def proposal_trials(self) -> ProposalTrials:
        return ProposalTrials(self.env, self.views, self.predictor, self.perception.num_proposals)

    @cached_property
    def _penalty(self) -> Callable[..., jax.Array]:
        # Made once: jit compares what is static in a Partial by identity, and another one is another program.
        return partial(_curiosity_penalty, self.predictor)

    def curiosity_penalty(self, params: Params, weight: float) -> jax.tree_util.Partial:
        """A function of final states for `ExplorationLoop.train_iteration`; weight 0 costs nothing."""
        return jax.tree_util.Partial(self._penalty, params, self.views, jnp.float32(weight))

    def success(self, samples: Interactions) -> jax.Array:
        """[B] bool"""
        return samples.success(self.env.config.tolerance)

    def train_jointly(self, state: TrainState, steps: int) -> tuple[TrainState, dict[str, float]]:
        """All heads for `steps` gradient steps, within a round of curiosity or finetuning."""
        config = replace(self.perception, learning_rate=self.settings.schedule.finetune_learning_rate)
        last: dict[str, float] = {}
        if steps:
            trained = perception.train(
                state.perception, self.views, state.samples, config, self.spec, stage="joint", steps=steps,
                on_metrics=lambda _, metrics: last.update(metrics),
            )  # fmt: skip
            state = state.replace(perception=trained)
            last.pop("step")
        return state, last


class Stage(Protocol):
    """One stage of a run."""

    @property
    def name(self) -> str: ...

    @property
    def shown(self) -> tuple[str, ...]:
        """Metrics for the console and the curves."""
        ...

    def num_units(self, settings: Settings) -> int:
        """Units of work; after each the run may be killed and go on. 0: the stage is left out."""
        ...

    def run_unit(self, ctx: StageContext, state: TrainState, unit: int) -> tuple[TrainState, Metrics]:
        """Do unit `unit`, from 0. The result depends on the arguments alone."""
        ...


STAGES: Registry[Stage] = Registry("stage")


@dataclass(frozen=True)
class Explore:
    """Reinforcement learning: one iteration a unit. The later trials are samples too."""

    name: str = "explore"
    shown: tuple[str, ...] = ("success", "reward", "valid")

    def num_units(self, settings: Settings) -> int:
        return settings.explore.iterations

    def run_unit(self, ctx: StageContext, state: TrainState, unit: int) -> tuple[TrainState, Metrics]:
        late = round(ctx.settings.schedule.late_fraction * ctx.settings.explore.iterations)
        # Weighed by nothing, and not None: the stage `curiosity` runs the same program.
        unpenalised = ctx.curiosity_penalty(state.perception.params, 0.0)
        explored, final, metrics = ctx.explorer.train_iteration(state.explore, ctx.pool, unpenalised)
        state = state.replace(explore=explored)
        return (state.with_samples(interactions_of(final)) if unit >= late else state), metrics


@dataclass(frozen=True)
class Collect:
    """Trials of the finished policy from random starts, failures included: one batch a unit."""

    name: str = "collect"
    shown: tuple[str, ...] = ("success", "valid")

    def num_units(self, settings: Settings) -> int:
        return settings.schedule.collect_batches

    def run_unit(self, ctx: StageContext, state: TrainState, unit: int) -> tuple[TrainState, Metrics]:
        schedule, agent = ctx.settings.schedule, ctx.explorer.agent
        final, _ = ctx.explorer.rollout(
            agent.acting_params(state.explore.agent),
            None,
            ctx.key("collect", unit),
            noise=schedule.collect_noise,
            scripted=schedule.collect_scripted_fraction,
            terminate_on_failure=False,
        )
        samples = interactions_of(final)
        metrics = {
            "success": ctx.success(samples).mean(),
            "valid": samples.valid.mean(),
            "in_collision": final.in_collision.mean(),
            "diverged": final.physics.diverged.sum(),
        }
        return state.with_samples(samples), metrics


@dataclass(frozen=True)
class Learn:
    """A stage of perception training: the gradient steps between two log lines a unit."""

    name: str
    steps: Callable[[Settings], int]

    @property
    def shown(self) -> tuple[str, ...]:
        """Of the objective that the stage is there for, which its list ends with."""
        objectives = TRAINING_STAGES.get(self.name).objectives or OBJECTIVES.names()
        return ("loss", *OBJECTIVES.get(objectives[-1]).curves)

    def num_units(self, settings: Settings) -> int:
        return -(-self.steps(settings) // settings.perception.log_every)

    def run_unit(self, ctx: StageContext, state: TrainState, unit: int) -> tuple[TrainState, Metrics]:
        metrics: dict[str, float] = {}
        trained = perception.train(
            state.perception, ctx.views, state.samples, ctx.perception, ctx.spec, stage=self.name,
            steps=self.steps(ctx.settings), limit=ctx.perception.log_every,
            on_metrics=lambda _, found: metrics.update(found),
        )  # fmt: skip
        return state.replace(perception=trained), metrics


@dataclass(frozen=True)
class Curiosity:
    """Exploration penalised by the scorer's confidence, then perception on what it found: one round a unit."""

    name: str = "curiosity"
    shown: tuple[str, ...] = ("success", "reward", "novel", "curiosity", "loss")

    def num_units(self, settings: Settings) -> int:
        return settings.schedule.curiosity_rounds

    def run_unit(self, ctx: StageContext, state: TrainState, unit: int) -> tuple[TrainState, Metrics]:
        schedule, params = ctx.settings.schedule, state.perception.params
        penalty = ctx.curiosity_penalty(params, schedule.curiosity_weight)
        metrics: dict[str, Any] = {}
        for _ in range(schedule.curiosity_iterations):
            explored, final, metrics = ctx.explorer.train_iteration(state.explore, ctx.pool, penalty)
            found = interactions_of(final)
            score = score_trajectories(
                ctx.predictor,
                params,
                ctx.views,
                found.view,
                found.contact,
                goal=found.goal,
                trajectory=found.trajectory,
            )
            state = state.replace(explore=explored)
            state = state.with_samples(select_curious(found, score, ctx.env.config.tolerance))
            success = ctx.success(found)
            metrics["novel"] = (success & (score < 0.5)).sum() / jnp.maximum(success.sum(), 1)
        state, losses = ctx.train_jointly(state, schedule.curiosity_steps)
        return state, metrics | losses


@dataclass(frozen=True)
class Finetune:
    """The networks' own proposals are executed, labelled and trained on jointly: one round a unit."""

    name: str = "finetune"
    shown: tuple[str, ...] = ("success", "loss", "score_loss")

    def num_units(self, settings: Settings) -> int:
        return settings.schedule.finetune_rounds

    def run_unit(self, ctx: StageContext, state: TrainState, unit: int) -> tuple[TrainState, Metrics]:
        schedule = ctx.settings.schedule
        rates = []
        for batch in range(schedule.finetune_batches):
            key = ctx.key("finetune", unit * schedule.finetune_batches + batch)
            _, found, chosen = ctx.proposal_trials.explore(state.perception.params, key)
            rates.append(float(ctx.success(found)[chosen].mean()))
            state = state.with_samples(found)
        state, losses = ctx.train_jointly(state, schedule.finetune_steps)
        return state, {"success": float(np.mean(rates))} | losses


def _flow_steps(settings: Settings) -> int:
    return settings.schedule.flow_steps if settings.perception.networks.flow_hidden else 0


for _stage in (
    Explore(),
    Collect(),
    Learn("flow", _flow_steps),
    Learn("scorer", lambda settings: settings.schedule.scorer_steps),
    Learn("proposal", lambda settings: settings.schedule.proposal_steps),
    Learn("actionability", lambda settings: settings.schedule.actionability_steps),
    Curiosity(),
    Finetune(),
):
    STAGES.register(_stage.name, _stage)


def _curiosity_penalty(
    predictor: TTAPredictor, params: Params, views: GroupedViews, weight: jax.Array, final: EnvState
) -> jax.Array:
    """[B] the paper's curiosity reward with its sign turned: weight times the scorer's confidence."""
    start = final.start

    def penalty() -> jax.Array:
        return weight * score_trajectories(
            predictor, params, views, start.view, start.contact, goal=start.goal, trajectory=final.trajectory
        )

    return jax.lax.cond(weight > 0, penalty, lambda: jnp.zeros_like(start.goal))
