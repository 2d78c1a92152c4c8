"""A training run from random policy to trained priors, resumable at any moment: the loop over its stages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from vatmart_jax.data.banks import SLIDE
from vatmart_jax.envs import Env, Task
from vatmart_jax.perception import trainer as perception
from vatmart_jax.perception.config import PerceptionConfig, TaskSpec, for_task
from vatmart_jax.perception.grouped_views import network_points
from vatmart_jax.perception.interaction_buffer import Interactions
from vatmart_jax.perception.networks import Networks
from vatmart_jax.perception.predictor import TTAPredictor
from vatmart_jax.pipeline.exploration import ExplorationLoop
from vatmart_jax.pipeline.run_dir import RunDir
from vatmart_jax.pipeline.settings import Settings
from vatmart_jax.pipeline.stage_timer import StageTimer
from vatmart_jax.pipeline.stages import STAGES, Stage, StageContext
from vatmart_jax.pipeline.train_state import TrainState
from vatmart_jax.reporting import NullReporter, Reporter

SECONDS_BETWEEN_CHECKPOINTS = 20.0


class PipelineTrainer:
    """One run on one environment. `train()` does what is left of it."""

    def __init__(
        self, run: RunDir, env: Env, settings: Settings, *, seed: int, reporter: Reporter | None = None,
        seconds_between_checkpoints: float = SECONDS_BETWEEN_CHECKPOINTS,
    ):  # fmt: skip
        """Raises UserError for unknown stages, and where the views have fewer points than the networks need."""
        self._run, self._reporter = run, reporter or NullReporter()
        self._seed, self._between_checkpoints = jax.random.key(seed), seconds_between_checkpoints
        self.stages: tuple[Stage, ...] = tuple(STAGES.get(name) for name in settings.schedule.stages)
        config = perception_config(settings, env.task)
        network_points(env.views, config.networks.encoder)  # too few: refused before hours of exploration
        self.context = StageContext(
            env=env,
            settings=settings,
            perception=config,
            spec=task_spec(env.task, settings.env.tolerance),
            predictor=TTAPredictor(Networks(config.networks)),
            explorer=ExplorationLoop(env, settings.explore),
            reporter=self._reporter,
            key=self.key,
        )
        self._timer = StageTimer()

    def key(self, purpose: str, index: int | jax.Array = 0) -> jax.Array:
        """A key for one use, the same whenever the run is resumed."""
        return jax.random.fold_in(jax.random.fold_in(self._seed, hash_of(purpose)), index)

    def init_state(self) -> TrainState:
        """Nothing done yet."""
        return TrainState(
            explore=self.context.explorer.init(self.key("policy")),
            perception=perception.init_state(self.key("networks"), self.context.perception),
            samples=Interactions.empty(self.context.settings.schedule.buffer_size),
            stored=jnp.int32(0),
            stage=jnp.int32(0),
            done=jnp.int32(0),
            seconds=jnp.zeros(len(self.stages) + 1),
        )

    def train(self, begun: TrainState | None = None) -> TrainState:
        """All stages that are left; returns the final state.

        begun: where a run starts that has no checkpoint yet, such as another run's trials; default the beginning.
        """
        state = self._run.restore(begun or self.init_state())
        for number in range(int(state.stage), len(self.stages)):
            self._timer.lap()
            state = self._train_stage(self.stages[number], state)
            state = self._timed(state).replace(stage=jnp.int32(number + 1), done=jnp.int32(0))
            self._run.save(state)
        return state

    def run_seconds(self, state: TrainState) -> dict[str, float]:
        """Seconds per stage, less those of compiling, which are all in `compile`."""
        names = (*(stage.name for stage in self.stages), "compile")
        return {name: round(float(s), 1) for name, s in zip(names, state.seconds, strict=True)}

    def _train_stage(self, stage: Stage, state: TrainState) -> TrainState:
        total = stage.num_units(self.context.settings)
        for unit in range(int(state.done), total):
            state, metrics = stage.run_unit(self.context, state, unit)
            state = self._tick(stage, state, unit + 1, total, metrics)
        return state

    def _tick(self, stage: Stage, state: TrainState, done: int, total: int, metrics: Mapping[str, Any]) -> TrainState:
        """One unit of a stage is done: log, report, checkpoint."""
        metrics = {name: float(value) for name, value in metrics.items()}
        step = int(metrics.pop("step", done))
        state = self._timed(state.replace(done=jnp.int32(done)))
        seconds = round(float(state.seconds.sum()), 2)
        self._run.log({"stage": stage.name, "step": step, "seconds": seconds, **metrics})
        shown = {name: metrics[name] for name in stage.shown if name in metrics}
        self._reporter.progress(stage.name, done, total, shown)
        self._run.save(state, self._between_checkpoints)
        return state

    def _timed(self, state: TrainState) -> TrainState:
        lap = self._timer.lap()
        return state.replace(seconds=state.seconds.at[state.stage].add(lap.working).at[-1].add(lap.compiling))


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
    """A 31-bit number of a short text, the same everywhere; the keys of recorded runs depend on it."""
    value = 0
    for character in text.encode():
        value = (value * 131 + character) % (2**31 - 1)
    return value
