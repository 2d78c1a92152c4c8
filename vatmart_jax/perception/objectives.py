"""What the networks are trained for: one Objective per head, and the stages that train several of them together.

To add one: a head in `heads.HEADS` if it needs parameters of its own (named in `NetworksConfig.extra_heads`), an
Objective in OBJECTIVES, and a stage in STAGES; the stage `joint` trains it too.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import jax
import jax.numpy as jnp

from vatmart_jax.perception import losses
from vatmart_jax.perception.articulation_flow import axis_target, flow_target, perturb_flow, unpack_flow
from vatmart_jax.perception.batching import Batch
from vatmart_jax.perception.config import NetworksConfig, PerceptionConfig, TaskSpec
from vatmart_jax.perception.layers import Params
from vatmart_jax.perception.networks import Features, Networks
from vatmart_jax.perception.predictor import TTAPredictor
from vatmart_jax.registry import Registry

Metrics = dict[str, jax.Array]


@dataclass(frozen=True, kw_only=True)
class LossContext:
    """All that a loss may read. Shapes: V views, Q samples and R actionability queries of each."""

    config: PerceptionConfig
    spec: TaskSpec
    networks: Networks
    params: Params
    batch: Batch
    keys: Mapping[str, jax.Array]
    features: Features  # [V, Q + R, F] of samples, then queries
    flow: jax.Array | None  # [V, Q + R, 15] predicted, where the networks have a flow head

    @property
    def contact(self) -> jax.Array:
        """[V, Q + R, 3]"""
        return self.batch.contact_points

    @property
    def goal(self) -> jax.Array:
        """[V, Q + R] of samples, then queries."""
        return jnp.concatenate([self.batch.goal, self.batch.query_goal], -1)

    @property
    def num_samples(self) -> int:
        """Q"""
        return self.batch.goal.shape[1]

    @property
    def sample_features(self) -> Features:
        """[V, Q, F]"""
        return Features(*(x[:, : self.num_samples] for x in self.features))

    @property
    def sample_contact(self) -> jax.Array:
        """[V, Q, 3]"""
        return self.contact[:, : self.num_samples]


@dataclass(frozen=True, kw_only=True)
class Objective:
    """A loss, and the networks that it trains."""

    name: str
    networks: tuple[str, ...]
    """names in the parameters"""
    loss: Callable[[LossContext], tuple[jax.Array, Metrics]]
    """the weighted loss, and its terms raw"""
    curves: tuple[str, ...]
    """the metrics that pictures and the console show"""
    encoder: Literal["scorer", "proposal", "actionability"] = "scorer"
    """whose encoder it reads, where each head has its own"""
    applies: Callable[[NetworksConfig], bool] = lambda networks: True
    """whether these networks have what it trains"""


@dataclass(frozen=True, kw_only=True)
class TrainingStage:
    """Objectives that are trained together; networks of no objective stay as they are."""

    objectives: tuple[str, ...] | None
    """the last is the one that the stage is there for; None: all that are registered"""
    encoder: Literal["full", "slow", "frozen"]
    """the learning rate of an encoder that all heads share and of the flow head: as the others', times
    `encoder_lr_scale` where there is a flow head, or none"""


OBJECTIVES: Registry[Objective] = Registry("perception objective")
STAGES: Registry[TrainingStage] = Registry("perception stage")
# The scorer goes on learning beside the proposals, which would otherwise bend a shared encoder away from it; with
# actionability it rests, for it makes the targets.
STAGES.register("flow", TrainingStage(objectives=("flow",), encoder="full"))
STAGES.register("scorer", TrainingStage(objectives=("flow", "scorer"), encoder="slow"))
STAGES.register("proposal", TrainingStage(objectives=("flow", "scorer", "proposal"), encoder="slow"))
STAGES.register("actionability", TrainingStage(objectives=("actionability",), encoder="frozen"))
STAGES.register("joint", TrainingStage(objectives=None, encoder="full"))


def stage_objectives(networks: NetworksConfig, stage: str) -> tuple[Objective, ...]:
    """The objectives of a stage that these networks have. Raises UserError for an unknown stage."""
    names = STAGES.get(stage).objectives
    found = (OBJECTIVES.get(name) for name in (OBJECTIVES.names() if names is None else names))
    return tuple(objective for objective in found if objective.applies(networks))


def network_labels(networks: NetworksConfig, stage: str) -> dict[str, str]:
    """`full` or `slow` by the name of each network that a stage trains; those left out are frozen."""
    objectives, encoder = stage_objectives(networks, stage), STAGES.get(stage).encoder
    labels = {name: "full" for objective in objectives for name in objective.networks}
    if networks.separate_encoders:
        return labels | {f"{objective.encoder}_encoder": "full" for objective in objectives}
    if encoder == "frozen":
        return labels
    if encoder == "slow" and networks.flow_hidden:
        return labels | {"encoder": "slow", "flow": "slow"}
    return labels | {"encoder": "full"}


def stage_loss(
    params: Params, batch: Batch, key: jax.Array, *, config: PerceptionConfig, spec: TaskSpec, stage: str
) -> tuple[jax.Array, Metrics]:
    """The weighted sum of a stage's losses, and each of them raw. Consumes the key."""
    objectives = stage_objectives(config.networks, stage)
    context = _context(params, batch, key, config=config, spec=spec)
    total, metrics = jnp.float32(0), {}
    for objective in objectives:
        loss, own = objective.loss(context)
        total += loss
        metrics |= own
    return total, metrics | {"loss": total}


def _context(params: Params, batch: Batch, key: jax.Array, *, config: PerceptionConfig, spec: TaskSpec) -> LossContext:
    networks = Networks(config.networks)
    k_proposal, k_actionability, k_scorer = jax.random.split(key, 3)
    keys = {name: jax.random.fold_in(key, zlib.crc32(name.encode())) for name in OBJECTIVES.names()}
    keys |= {"proposal": k_proposal, "actionability": k_actionability, "scorer": k_scorer}
    features = jax.vmap(networks.features, (None, 0, 0, 0))(params, batch.points, batch.prepared, batch.contact)
    context = LossContext(
        config=config, spec=spec, networks=networks, params=params, batch=batch, keys=keys, features=features, flow=None
    )
    if not config.networks.flow_hidden:
        return context
    return replace(context, flow=networks.flow(params, features, context.contact, context.goal))


def _flow_loss(ctx: LossContext) -> tuple[jax.Array, Metrics]:
    assert ctx.flow is not None and ctx.batch.joints is not None  # `applies`, and `train` checks the views
    axis, anchor = ctx.batch.joints
    error = ctx.flow - flow_target(ctx.contact, axis, anchor, ctx.goal, hinge=not ctx.spec.slides)
    loss, weight = jnp.abs(error).mean(), ctx.config.flow_weight
    total, metrics = weight * loss, {}
    if ctx.config.networks.predict_axis:  # the arc alone teaches slowly where its axis is
        predicted_axis, predicted_arm = ctx.networks.joint_axis(ctx.params, ctx.features, ctx.contact, ctx.goal)
        true_axis, true_arm = axis_target(ctx.contact, axis, anchor)
        axis_loss = jnp.abs(predicted_axis - true_axis).mean() + 2 * jnp.abs(predicted_arm - true_arm).mean()
        total += weight * axis_loss
        metrics = {"axis_loss": axis_loss}
    displacements, _ = unpack_flow(error)
    flow_error = jnp.linalg.norm(displacements[..., -1, :], axis=-1).mean()
    return total, metrics | {"flow_loss": loss, "flow_error": flow_error}


def _score_loss(ctx: LossContext) -> tuple[jax.Array, Metrics]:
    batch, flow = ctx.batch, None
    if ctx.flow is not None:
        flow = perturb_flow(ctx.keys["scorer"], ctx.flow[:, : ctx.num_samples], ctx.config.flow_noise)
    logits = ctx.networks.score(
        ctx.params, ctx.sample_features, ctx.sample_contact, batch.goal, batch.trajectory, flow=flow
    )
    loss = losses.score_loss(logits, batch.label)
    accuracy = jnp.mean((logits > 0) == (batch.label > 0.5))
    metrics = {"score_loss": loss, "score_accuracy": accuracy, "positives": batch.label.mean()}
    return ctx.config.score_weight * loss, metrics


def _proposal_loss(ctx: LossContext) -> tuple[jax.Array, Metrics]:
    batch, config = ctx.batch, ctx.config
    where = ctx.sample_features, ctx.sample_contact, batch.achieved
    mean, log_variance = ctx.networks.posterior(ctx.params, *where, batch.trajectory)
    z = mean + jnp.exp(0.5 * log_variance) * jax.random.normal(ctx.keys["proposal"], mean.shape)
    decoded = ctx.networks.decode(ctx.params, *where, z)
    position, euler, rotation = losses.reconstruction_losses(decoded, batch.trajectory, batch.weight)
    kl = losses.kl_loss(mean, log_variance, batch.weight)
    total = config.position_weight * position + config.euler_weight * euler
    total += config.rotation_weight * rotation + config.kl_weight * jnp.maximum(kl, config.free_bits)
    return total, {"position_loss": position, "euler_loss": euler, "rotation_loss": rotation, "kl_loss": kl}


def _actionability_loss(ctx: LossContext) -> tuple[jax.Array, Metrics]:
    config, n = ctx.config, ctx.num_samples
    features, contact = Features(*(x[:, n:] for x in ctx.features)), ctx.contact[:, n:]
    logits = ctx.networks.actionability(ctx.params, features, contact, ctx.batch.query_goal)
    _, scores = TTAPredictor(ctx.networks).propose_and_score(
        ctx.params, Features(*(x[None] for x in features)), contact, ctx.batch.query_goal, ctx.keys["actionability"],
        config.num_proposals,
    )  # fmt: skip
    target = jax.lax.stop_gradient(losses.actionability_target(scores, config.top_k))
    loss = losses.actionability_loss(logits, target)
    return config.actionability_weight * loss, {"actionability_loss": loss, "actionability_target": target.mean()}


for _objective in (
    Objective(
        name="flow",
        networks=("flow",),
        loss=_flow_loss,
        curves=("flow_error",),
        applies=lambda networks: bool(networks.flow_hidden),
    ),
    Objective(name="scorer", networks=("scorer",), loss=_score_loss, curves=("score_loss",)),
    Objective(
        name="proposal",
        networks=("posterior", "decoder"),
        loss=_proposal_loss,
        curves=("position_loss", "euler_loss", "rotation_loss", "kl_loss"),
        encoder="proposal",
    ),
    Objective(
        name="actionability",
        networks=("actionability",),
        loss=_actionability_loss,
        curves=("actionability_loss", "actionability_target"),
        encoder="actionability",
    ),
):
    OBJECTIVES.register(_objective.name, _objective)
