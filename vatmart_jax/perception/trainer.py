"""Training the perception networks on samples of interaction.

Views and samples stay on device. A step draws some views, some samples of each, and encodes each view once for all
of its samples. Whole stretches of steps are one dispatch; nothing is compiled again when samples or the learning rate
change.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax.struct import PyTreeNode

from vatmart_jax.perception.batching import ViewIndex, draw_batch, index_by_view
from vatmart_jax.perception.config import PerceptionConfig, TaskSpec
from vatmart_jax.perception.grouped_views import GroupedViews
from vatmart_jax.perception.interaction_buffer import Interactions
from vatmart_jax.perception.layers import Params
from vatmart_jax.perception.networks import Networks
from vatmart_jax.perception.objectives import STAGES, Metrics, network_labels, stage_loss
from vatmart_jax.perception.optimizer import make_optimizer


class PerceptionState(PyTreeNode, kw_only=True):
    """All that training carries; a pytree, so that a checkpoint of it resumes bit for bit."""

    params: Params
    optimizer: optax.OptState
    step: jax.Array  # [] int32, steps done of the stage that is running, 0 between stages
    key: jax.Array  # [2] uint32


class LearningRateSchedule(PyTreeNode, kw_only=True):
    """What may change without another compilation."""

    learning_rate: jax.Array  # [] float32, after warm-up
    total: jax.Array  # [] int32, steps of the stage
    count: jax.Array  # [] int32, steps of it to do now

    def rate(self, step: jax.Array) -> jax.Array:
        """The learning rate of a step: warm-up, then a cosine to a fiftieth."""
        warm = jnp.minimum(1, (step + 1) / jnp.minimum(100, 1 + self.total // 5))
        return self.learning_rate * warm * (0.02 + 0.98 * 0.5 * (1 + jnp.cos(jnp.pi * step / self.total)))


def init_state(key: jax.Array, config: PerceptionConfig) -> PerceptionState:
    """Fresh networks. Consumes the key."""
    key, init = jax.random.split(key)
    params = Networks(config.networks).init(init)
    return PerceptionState(
        params=params,
        optimizer=_init_optimizer(_program(config), params),
        step=jnp.int32(0),
        key=jax.random.key_data(key),
    )


def train(
    state: PerceptionState,
    grouped_views: GroupedViews,
    samples: Interactions,
    config: PerceptionConfig,
    spec: TaskSpec,
    *,
    stage: str,
    steps: int,
    limit: int | None = None,
    on_metrics: Callable[[PerceptionState, dict[str, float]], None] = lambda state, metrics: None,
) -> PerceptionState:
    """Train one of STAGES to its end, or for `limit` steps, from the step where `state` stands.

    `on_metrics` gets the state, which may be saved to resume from, and the mean of every raw loss over the last
    `log_every` steps. At the stage's end the returned state's step is back at 0. Raises ValueError where there are no
    samples.
    """
    index = index_by_view(samples, len(grouped_views))
    if int(index.total) == 0:
        raise ValueError(f"nothing to train the {stage} stage on: the buffer has no samples")
    if config.networks.flow_hidden and grouped_views.joints is None:
        raise ValueError("the flow head has no labels: the views come without joints")
    done, program = int(state.step), _program(config)
    if done == 0:  # the moments of the last stage belong to other losses
        state = replace(state, optimizer=_init_optimizer(program, state.params))
    end = steps if limit is None else min(steps, done + limit)
    while done < end:
        count = min(config.log_every, end - done)
        schedule = LearningRateSchedule(
            learning_rate=jnp.float32(config.learning_rate), total=jnp.int32(steps), count=jnp.int32(count)
        )
        state, sums = _compiled_steps()(
            state, grouped_views, samples, index, schedule, config=program, spec=spec, stage=stage
        )
        done += count
        on_metrics(state, {"step": done} | {name: float(value) / count for name, value in sums.items()})
    return replace(state, step=jnp.int32(0)) if done == steps else state


def train_steps(
    state: PerceptionState,
    grouped_views: GroupedViews,
    samples: Interactions,
    index: ViewIndex,
    schedule: LearningRateSchedule,
    *,
    config: PerceptionConfig,
    spec: TaskSpec,
    stage: str,
) -> tuple[PerceptionState, Metrics]:
    """`schedule.count` steps of a stage, and the sums of their metrics. The learning rate is the schedule's."""
    labels, optimizer = network_labels(config.networks, stage), _optimizer(config)
    factors = {name: {"full": 1.0, "slow": config.encoder_lr_scale}[label] for name, label in labels.items()}

    def step(state: PerceptionState) -> tuple[PerceptionState, Metrics]:
        key, k_draw, k_loss = jax.random.split(jax.random.wrap_key_data(state.key), 3)
        batch = draw_batch(k_draw, grouped_views, samples, index, config=config, spec=spec)
        # Only what a stage trains is differentiated, and only that is changed: no momentum or decay for the rest.
        trained = {name: params for name, params in state.params.items() if name in labels}
        frozen = jax.lax.stop_gradient(state.params)
        loss = lambda trained: stage_loss(frozen | trained, batch, k_loss, config=config, spec=spec, stage=stage)
        (_, metrics), gradients = jax.value_and_grad(loss, has_aux=True)(trained)
        gradients = {name: gradients.get(name, jax.tree.map(jnp.zeros_like, p)) for name, p in state.params.items()}
        updates: Any
        updates, opt_state = optimizer.update(gradients, state.optimizer, state.params)
        rate = schedule.rate(state.step)
        updates = {name: optax.tree.scale(factors[name], updates[name]) for name in trained}
        moved = jax.tree.map(lambda p, u: p - rate * u, trained, updates)
        state = PerceptionState(
            params=state.params | moved, optimizer=opt_state, step=state.step + 1, key=jax.random.key_data(key)
        )
        return state, metrics

    def body(_: int, carry: tuple[PerceptionState, Metrics]) -> tuple[PerceptionState, Metrics]:
        state, sums = carry
        state, metrics = step(state)
        return state, jax.tree.map(jnp.add, sums, metrics)

    zeros = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(step, state)[1])
    return jax.lax.fori_loop(0, schedule.count, body, (state, zeros))


@cache
def _compiled_steps() -> Callable[..., tuple[PerceptionState, Metrics]]:
    # On CPUs LLVM's first level makes steps as fast as its third, in a sixth less time.
    options = {"xla_backend_optimization_level": 1} if jax.default_backend() == "cpu" else None
    return jax.jit(train_steps, static_argnames=("config", "spec", "stage"), compiler_options=options)


def _program(config: PerceptionConfig) -> PerceptionConfig:
    """The config as far as it decides what is compiled: the learning rate is an argument of the program."""
    return replace(config, learning_rate=0.0, log_every=0)


def _optimizer(config: PerceptionConfig) -> optax.GradientTransformation:
    return make_optimizer(use_muon=config.muon, weight_decay=config.weight_decay)


@partial(jax.jit, static_argnames=("config",))
def _init_optimizer(config: PerceptionConfig, params: Params) -> optax.OptState:
    return _optimizer(config).init(params)


__all__ = ["STAGES", "Interactions", "LearningRateSchedule", "PerceptionState", "init_state", "train", "train_steps"]
