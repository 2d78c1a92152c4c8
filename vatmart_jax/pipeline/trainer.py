"""The stages of a training run, from random policy to evaluated priors; resumable at any moment."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vatmart_jax.data.banks import SLIDE
from vatmart_jax.envs import Env, Task, TrialStart
from vatmart_jax.perception import trainer as perception
from vatmart_jax.perception.config import PerceptionConfig, TaskSpec, for_task
from vatmart_jax.perception.grouped_views import GroupedViews, group_views, network_points
from vatmart_jax.perception.interaction_buffer import Interactions
from vatmart_jax.perception.networks import Networks
from vatmart_jax.perception.predictor import TTAPredictor, score_trajectories
from vatmart_jax.perception.trainer import PerceptionState
from vatmart_jax.pipeline.exploration import ExplorationLoop, ExplorationState, start_pool
from vatmart_jax.pipeline.presets import Settings
from vatmart_jax.pipeline.proposal_rollouts import ProposalTrials, curious, interactions_of
from vatmart_jax.pipeline.run_dir import RunDir
from vatmart_jax.pipeline.stage_timer import StageTimer

STAGES = ("explore", "collect", "flow", "scorer", "proposal", "actionability", "curiosity", "finetune")
_SECONDS_BETWEEN_CHECKPOINTS = 20.0

Report = Callable[[str, int, int, dict[str, float]], None]  # stage, done, total, metrics


@struct.dataclass
class TrainState:
    """All that a run carries; a pytree of arrays, so that a checkpoint of it resumes bit for bit."""

    explore: ExplorationState
    perception: PerceptionState
    samples: Interactions
    stored: jax.Array  # [] int32, samples ever
    stage: jax.Array  # [] int32, index into STAGES
    done: jax.Array  # [] int32, units of that stage
    seconds: jax.Array  # [len(STAGES) + 1] spent per stage and, last, compiling; restarts included

    def with_samples(self, new: Interactions) -> TrainState:
        """Trials stored, in place of the oldest where the buffer is full."""
        return self.replace(samples=self.samples.insert(new, self.stored), stored=self.stored + len(new.view))


class PipelineTrainer:
    """One run on one environment. `train()` does what is left of it."""

    def __init__(self, run: RunDir, env: Env, settings: Settings, seed: int, report: Report):
        self._run, self._env, self._settings, self._report = run, env, settings, report
        self._seed = jax.random.key(seed)
        self.config = perception_config(settings, env.task)
        self._spec = task_spec(env.task, settings.env.tolerance)
        self._ensemble = TTAPredictor(Networks(self.config.networks))
        self._explorer = ExplorationLoop(env, settings.explore)
        self._pool: TrialStart | None = None
        self._grouped_views: GroupedViews | None = None
        self._score = partial(score_trajectories, self._ensemble)
        self._clock = StageTimer()
        network_points(env.views, self.config.networks.encoder)  # too few: said before hours of exploration

    def key(self, purpose: str, index: int | jax.Array = 0) -> jax.Array:
        """A key for one use, the same whenever the run is resumed."""
        return jax.random.fold_in(jax.random.fold_in(self._seed, hash_of(purpose)), index)

    def init_state(self) -> TrainState:
        """Nothing done yet."""
        return TrainState(
            explore=self._explorer.init(self.key("policy")),
            perception=perception.init_state(self.key("networks"), self.config),
            samples=Interactions.empty(self._settings.schedule.buffer_size),
            stored=jnp.int32(0),
            stage=jnp.int32(0),
            done=jnp.int32(0),
            seconds=jnp.zeros(len(STAGES) + 1),
        )

    def train(self, begun: TrainState | None = None) -> TrainState:
        """All stages that are left; returns the final state.

        begun: where a run starts that has no checkpoint yet, such as another run's trials; default the beginning.
        """
        progress = self._run.restore(begun or self.init_state())
        for stage in range(int(progress.stage), len(STAGES)):
            self._clock.lap()
            progress = getattr(self, f"_{STAGES[stage]}")(progress)
            progress = self._timed(progress).replace(stage=jnp.int32(stage + 1), done=jnp.int32(0))
            self._run.save(progress)
        return progress

    def grouped_views(self) -> GroupedViews:
        """The environment's views as the networks read them."""
        if self._grouped_views is None:
            grouped_views = group_views(
                self._env.views,
                self.config.networks.encoder,
                lambda done, total: self._report("group views", done, total, {}),
            )
            self._grouped_views = replace(grouped_views, joints=self._env.joints())
        return self._grouped_views

    def pool(self) -> TrialStart:
        if self._pool is None:
            size = self._settings.explore.start_pool_size
            self._pool = start_pool(
                self._env, self.key("pool"), size, lambda done: self._report("find starts", done, size, {})
            )
        return self._pool

    def _tick(self, progress: TrainState, stage: str, done: int, total: int, metrics: dict[str, Any]) -> TrainState:
        """One unit of a stage is done: log, report, checkpoint."""
        metrics = {name: float(value) for name, value in metrics.items()}
        progress = self._timed(progress.replace(done=jnp.int32(done)))
        seconds = float(progress.seconds.sum())
        self._run.log({"stage": stage, "step": done, "seconds": round(seconds, 2), **metrics})
        self._report(stage, done, total, metrics)
        self._run.save(progress, _SECONDS_BETWEEN_CHECKPOINTS)
        return progress

    def _timed(self, progress: TrainState) -> TrainState:
        lap = self._clock.lap()
        seconds = progress.seconds.at[progress.stage].add(lap.working).at[-1].add(lap.compiling)
        return progress.replace(seconds=seconds)

    def _explore(self, progress: TrainState) -> TrainState:
        total = self._settings.explore.iterations
        late = round(self._settings.schedule.late_fraction * total)
        for done in range(int(progress.done), total):
            state, final, metrics = self._explorer.train_iteration(progress.explore, self.pool(), None)
            progress = progress.replace(explore=state)
            if done >= late:
                progress = progress.with_samples(interactions_of(final))
            progress = self._tick(progress, "explore", done + 1, total, metrics)
        return progress

    def _collect(self, progress: TrainState) -> TrainState:
        schedule = self._settings.schedule
        for done in range(int(progress.done), schedule.collect_batches):
            final, _ = self._explorer.rollout(
                progress.explore.td3.policy, None, self.key("collect", done), schedule.collect_noise, 0.0,
                schedule.collect_scripted_fraction, terminate_on_failure=False,
            )  # fmt: skip
            samples = interactions_of(final)
            metrics = {
                "success": samples.success(self._env.config.tolerance).mean(),
                "valid": samples.valid.mean(),
                "in_collision": final.in_collision.mean(),
                "diverged": final.physics.diverged.sum(),
            }
            progress = self._tick(
                progress.with_samples(samples), "collect", done + 1, schedule.collect_batches, metrics
            )
        return progress

    def _flow(self, progress: TrainState) -> TrainState:
        return self._learn(
            progress, "flow", self._settings.schedule.flow_steps if self.config.networks.flow_hidden else 0
        )

    def _scorer(self, progress: TrainState) -> TrainState:
        return self._learn(progress, "scorer", self._settings.schedule.scorer_steps)

    def _proposal(self, progress: TrainState) -> TrainState:
        return self._learn(progress, "proposal", self._settings.schedule.proposal_steps)

    def _actionability(self, progress: TrainState) -> TrainState:
        return self._learn(progress, "actionability", self._settings.schedule.actionability_steps)

    def _learn(self, progress: TrainState, stage: str, steps: int) -> TrainState:
        """One stage of perception training, resumable between its steps."""
        if steps == 0:
            return progress

        def tick(state: PerceptionState, metrics: dict[str, float]) -> None:
            nonlocal progress
            done = int(metrics.pop("step"))
            progress = self._tick(progress.replace(perception=state), stage, done, steps, metrics)

        state = perception.train(
            progress.perception, self.grouped_views(), progress.samples, self.config, self._spec,
            stage=stage, steps=steps, on_metrics=tick,
        )  # fmt: skip
        return progress.replace(perception=state)

    def _round(self, progress: TrainState, steps: int) -> tuple[TrainState, dict[str, float]]:
        """Joint perception training within a round of curiosity or finetuning."""
        config = replace(self.config, learning_rate=self._settings.schedule.finetune_learning_rate)
        last: dict[str, float] = {}
        if steps:
            state = perception.train(
                progress.perception, self.grouped_views(), progress.samples, config, self._spec,
                stage="joint", steps=steps, on_metrics=lambda _, metrics: last.update(metrics),
            )  # fmt: skip
            progress = progress.replace(perception=state)
            last.pop("step")
        return progress, last

    def _curiosity(self, progress: TrainState) -> TrainState:
        schedule = self._settings.schedule
        for done in range(int(progress.done), schedule.curiosity_rounds):
            params = progress.perception.params
            penalty = jax.tree_util.Partial(
                partial(_curiosity_penalty, self._ensemble), params, self.grouped_views(), schedule.curiosity_weight
            )
            metrics: dict[str, Any] = {}
            for _ in range(schedule.curiosity_iterations):
                state, final, metrics = self._explorer.train_iteration(progress.explore, self.pool(), penalty)
                found = interactions_of(final)
                score = self._score(
                    params,
                    self.grouped_views(),
                    found.view,
                    found.contact,
                    goal=found.goal,
                    trajectory=found.trajectory,
                )
                surprising = curious(found, score, self._env.config.tolerance)
                progress = progress.replace(explore=state).with_samples(surprising)
                success = found.success(self._env.config.tolerance)
                metrics["novel"] = (success & (score < 0.5)).sum() / jnp.maximum(success.sum(), 1)
            progress, losses = self._round(progress, schedule.curiosity_steps)
            progress = self._tick(progress, "curiosity", done + 1, schedule.curiosity_rounds, metrics | losses)
        return progress

    def _finetune(self, progress: TrainState) -> TrainState:
        schedule = self._settings.schedule
        if schedule.finetune_rounds == 0:
            return progress
        trials = ProposalTrials(self._env, self.grouped_views(), self._ensemble, self.config.num_proposals)
        for done in range(int(progress.done), schedule.finetune_rounds):
            rates = []
            for batch in range(schedule.finetune_batches):
                key = self.key("finetune", done * schedule.finetune_batches + batch)
                _, found, chosen = trials.explore(progress.perception.params, key)
                rates.append(float(found.success(self._env.config.tolerance)[chosen].mean()))
                progress = progress.with_samples(found)
            progress, losses = self._round(progress, schedule.finetune_steps)
            metrics = {"success": float(np.mean(rates))} | losses
            progress = self._tick(progress, "finetune", done + 1, schedule.finetune_rounds, metrics)
        return progress


def perception_config(settings: Settings, task: Task) -> PerceptionConfig:
    """The settings' perception config with the networks of the task."""
    networks = for_task(settings.perception.networks, slides=task.joint_type == SLIDE)
    return replace(settings.perception, networks=networks)


def task_spec(task: Task, tolerance: float) -> TaskSpec:
    """What training the networks needs to know of a task."""
    return TaskSpec(
        goal_range=task.goal_range,
        tolerance=tolerance,
        relabel_range=task.relabel_range,
        slides=task.joint_type == SLIDE,
    )


def hash_of(text: str) -> int:
    """A 31-bit number of a short text, the same everywhere."""
    value = 0
    for character in text.encode():
        value = (value * 131 + character) % (2**31 - 1)
    return value


def _curiosity_penalty(
    predictor: TTAPredictor, params: Any, grouped_views: GroupedViews, weight: jax.Array, final
) -> jax.Array:
    """[B] the paper's curiosity reward with its sign turned: weight times the scorer's confidence."""
    start = final.start
    score = score_trajectories(
        predictor, params, grouped_views, start.view, start.contact, goal=start.goal, trajectory=final.trajectory
    )
    return weight * score


def run_seconds(progress: TrainState) -> dict[str, float]:
    """Seconds per stage, less those of compiling, which are all in `compile`."""
    return {stage: round(float(s), 1) for stage, s in zip((*STAGES, "compile"), progress.seconds, strict=True)}


__all__ = ["STAGES", "PipelineTrainer", "TrainState", "perception_config", "run_seconds"]
