"""Training the perception networks on samples of interaction.

Clouds and samples stay on device. A step draws some views, some samples of each, and encodes each view once for all
of its samples. Whole stretches of steps are one dispatch; nothing is compiled anew when samples come in.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct
from optax.contrib import muon

from vatmart_jax.perception import losses
from vatmart_jax.perception.augmentation import SceneTransform
from vatmart_jax.perception.grouped_views import GroupedViews
from vatmart_jax.perception.networks import (
    Features,
    Networks,
    NetworksConfig,
    Params,
    articulation_flow,
    pack_flow,
    unpack_flow,
)
from vatmart_jax.perception.pointnet2 import PointGroups
from vatmart_jax.perception.predictor import TTAPredictor
from vatmart_jax.trajectory import WAYPOINTS


@struct.dataclass
class Interactions:
    """M executed trajectories and what they did; rows with view -1 are empty."""

    view: jax.Array  # [M] int32, index into Clouds
    contact: jax.Array  # [M] int32, index into that view's contacts
    goal: jax.Array  # [M] commanded displacement > 0, rad or unit lengths
    trajectory: jax.Array  # [M, 30] see geometry.pack_trajectory
    displacement: jax.Array  # [M] how far the part moved in the task's sense, unit of `goal`
    valid: jax.Array  # [M] bool, success was possible: free start, grasp made and kept, physics sound
    from_proposal: jax.Array  # [M] bool, the networks proposed it; if not, it is the policy's or an expert's

    @classmethod
    def empty(cls, capacity: int) -> Interactions:
        """A buffer of `capacity` empty rows."""
        zeros = jnp.zeros(capacity)
        return cls(
            jnp.full(capacity, -1, jnp.int32), jnp.zeros(capacity, jnp.int32), zeros,
            jnp.zeros((capacity, 6 + 6 * WAYPOINTS)), zeros, jnp.zeros(capacity, bool), jnp.zeros(capacity, bool),
        )  # fmt: skip

    def insert(self, new: Interactions, at: jax.Array | int) -> Interactions:
        """The buffer with `new` written from row `at` on, around its end."""
        rows = (at + jnp.arange(len(new.view))) % len(self.view)
        return jax.tree.map(lambda old, value: old.at[rows].set(value), self, new)

    def success(self, tolerance: float) -> jax.Array:
        """[M] bool, the commanded task was done."""
        return self.valid & (jnp.abs(self.displacement - self.goal) <= tolerance * self.goal)


@dataclass(frozen=True)
class PerceptionConfig:
    """What training the networks needs to know. Tasks are in rad (doors) or unit lengths (drawers)."""

    networks: NetworksConfig = field(default_factory=NetworksConfig)
    low: float = 0.1
    """smallest task"""
    high: float = 0.7
    """largest task"""
    tolerance: float = 0.15
    """success: the part moved by the task within this share of it"""
    views_per_batch: int = 8
    """views per step"""
    samples_per_view: int = 48
    """samples per view and step"""
    actionability_queries: int = 16
    """random contacts per view and step, for actionability; at most `queries`"""
    num_proposals: int = 100
    """trajectories proposed at a probe"""
    top_k: int = 5
    """the probe's actionability is the mean score of so many best proposals"""
    proposal_fraction: float = 0.5
    """share of a view's samples that are of the networks' own proposals, where it has both kinds"""
    relabel_fraction: float = 0.5
    """share of the scorer's rows whose task is what the trajectory achieved, within the tolerance"""
    negative_fraction: float = 0.3
    """share whose task is shifted off that; the rest keep the commanded task, failed starts and grasps among them"""
    shift: float = 0.45
    """largest shift; the paper has 0.45 for drawers and 45 degrees for doors"""
    yaw: float = 0.25
    """augmentation: views turn about the vertical by up to this much (rad), either way"""
    mirror: bool = True
    """augmentation: half of the views are mirrored left to right"""
    scale: float = 0.2
    """augmentation: views, and what happens in them, grow or shrink by up to this share"""
    task_is_length: bool = False
    """drawers: tasks grow with the view, parts move along their axis and do not turn"""
    learning_rate: float = 2e-3
    """after 100 steps of warm-up; falls along a cosine to a fiftieth at the stage's end"""
    encoder_lr_scale: float = 1.0
    """share of that for encoder and course, where there is one, in the stages `scorer` and `proposal`, whose fresh
    heads undo some of what a long `flow` stage has taught them"""
    muon: bool = True
    """Muon for all matrices: their momentum made orthogonal, at the size of Adam's steps; the paper has Adam"""
    weight_decay: float = 1e-4
    """decoupled, as in AdamW"""
    score_weight: float = 5.0
    """of the scorer's cross-entropy"""
    position_weight: float = 50.0
    """of the L1 of waypoint moves, per unit length"""
    euler_weight: float = 50.0
    """of the L1 of waypoint Euler residuals, per rad"""
    rotation_weight: float = 5.0
    """of the squared 6D distance of start rotations"""
    kl_weight: float = 1.0
    """of the KL divergence; at 0.05 the decoder's samples ignore contact and task"""
    free_bits: float = 6.0
    """nats of it that cost nothing, so that the posterior does not collapse before the decoder has learned to listen"""
    flow_weight: float = 50.0
    """of the L1 of the touched point's course, and of its hinge where the networks tell it"""
    flow_noise: float = 0.15
    """the scorer learns with courses off by about this share, as they are on objects that it has not seen"""
    actionability_weight: float = 5.0
    """of the L1 of actionability"""
    log_every: int = 50
    """steps between two reports"""

    def __post_init__(self) -> None:
        if self.actionability_queries > self.samples_per_view:
            raise ValueError(f"probes ({self.actionability_queries}) must not exceed queries ({self.samples_per_view})")


@struct.dataclass
class PerceptionState:
    """All that training carries; a pytree, so that a checkpoint of it resumes bit for bit."""

    params: Params
    optimizer: optax.OptState
    step: jax.Array  # [] int32, steps done of the stage that is running, 0 between stages
    key: jax.Array  # [2] uint32


STAGES: dict[str, tuple[str, ...]] = {
    "flow": ("flow",),
    "scorer": ("flow", "scorer"),
    "proposal": ("flow", "scorer", "proposal"),
    "actionability": ("actionability",),
    "joint": ("flow", "scorer", "proposal", "actionability"),
}
"""The heads that each stage trains; those not named stay as they are. A shared encoder learns wherever the course does.

The scorer goes on learning beside the proposals, which would otherwise bend a shared encoder away from it; with
actionability it rests, for it makes the targets.
"""


class Index(NamedTuple):
    """Which rows of Samples belong to which view, those of policy and expert apart from the networks' own."""

    rows: jax.Array  # [M] int32, rows sorted by view and kind, empty ones last
    start: jax.Array  # [V, 2] int32, where a view's rows of either kind begin
    count: jax.Array  # [V, 2] int32
    total: jax.Array  # [] int32, rows that are not empty


class Batch(NamedTuple):
    """V views of a step, Q samples and R probes each."""

    points: jax.Array  # [V, N, 3]
    point_groups: PointGroups
    which: jax.Array  # [V, Q + R] contacts of the samples, then of the probes
    trajectory: jax.Array  # [V, Q, 30]
    task: jax.Array  # [V, Q] the scorer's
    label: jax.Array  # [V, Q] float, success at that task
    achieved: jax.Array  # [V, Q] the cVAE's task
    weight: jax.Array  # [V, Q] float, 1 where the cVAE learns from the row
    probe_task: jax.Array  # [V, R]
    joints: tuple[jax.Array, jax.Array] | None  # [V, 3] axes and anchors, where the networks have a course to learn


def begin(key: jax.Array, config: PerceptionConfig) -> PerceptionState:
    """Fresh networks. Consumes the key."""
    key, init = jax.random.split(key)
    params = Networks(config.networks).init(init)
    return PerceptionState(params, _moments(config, params), jnp.int32(0), jax.random.key_data(key))


def train(
    state: PerceptionState,
    grouped_views: GroupedViews,
    samples: Interactions,
    config: PerceptionConfig,
    stage: str,
    steps: int,
    on_metrics: Callable[[PerceptionState, dict[str, float]], None] = lambda state, metrics: None,
    *,
    limit: int | None = None,
) -> PerceptionState:
    """Train one of STAGES to its end, or for `limit` steps, from the step where `state` stands.

    `on_metrics` gets the state, which may be saved to resume from, and the mean of every raw loss over the last
    `log_every` steps. At the stage's end the returned state's step is back at 0. Raises ValueError where there are no samples.
    """
    index = _index(samples, len(grouped_views))
    if int(index.total) == 0:
        raise ValueError(f"nothing to train the {stage} stage on: the buffer has no samples")
    if config.networks.flow_hidden and grouped_views.joints is None:
        raise ValueError("the networks' course has nothing to learn from: the clouds come without joints")
    done = int(state.step)
    if done == 0:  # the moments of the last stage belong to other losses
        state = replace(state, optimizer=_moments(config, state.params))
    end = steps if limit is None else min(steps, done + limit)
    while done < end:
        count = min(config.log_every, end - done)
        state, sums = _steps(config, stage, state, grouped_views, samples, index, count, steps)
        done += count
        on_metrics(state, {"step": done} | {name: float(value) / count for name, value in sums.items()})
    return replace(state, step=jnp.int32(0)) if done == steps else state


@partial(jax.jit, static_argnames=("n_views",))
def _index(samples: Interactions, n_views: int) -> Index:
    place = jnp.where(samples.view < 0, 2 * n_views, 2 * samples.view + samples.from_proposal)
    count = jnp.zeros(2 * n_views + 1, jnp.int32).at[place].add(1)
    start = jnp.cumsum(count) - count
    start, count = (a[:-1].reshape(n_views, 2) for a in (start, count))
    return Index(jnp.argsort(place).astype(jnp.int32), start, count, count.sum())


def _draw(
    key: jax.Array, grouped_views: GroupedViews, samples: Interactions, index: Index, config: PerceptionConfig
) -> Batch:
    """Views, as often as trials were made in them, and samples of both kinds of each, uniformly and with replacement.

    Trials are balanced over categories and objects, so views are. Consumes the key.
    """
    k_view, k_kind, k_row, k_task, k_probe, k_augment = jax.random.split(key, 6)
    shape = (config.views_per_batch, config.samples_per_view)
    view = samples.view[index.rows[jax.random.randint(k_view, (config.views_per_batch,), 0, index.total)]]
    count = index.count[view][:, None]
    proposed = jax.random.bernoulli(k_kind, config.proposal_fraction, shape)
    kind = jnp.where((count > 0).all(-1), proposed, count[..., 1] > 0).astype(jnp.int32)
    count, start = (jnp.take_along_axis(a[view], kind, 1) for a in (index.count, index.start))
    offset = jnp.floor(jax.random.uniform(k_row, shape) * count).astype(jnp.int32)
    row = index.rows[start + jnp.minimum(offset, count - 1)]
    moved, valid, commanded = samples.displacement[row], samples.valid[row], samples.goal[row]
    achieved = valid & (moved >= config.low) & (moved <= config.high)
    task = jnp.where(achieved, _relabelled(k_task, moved, commanded, config), commanded)
    label = valid & (jnp.abs(moved - task) <= config.tolerance * task)
    probes = jax.random.randint(
        k_probe, (config.views_per_batch, config.actionability_queries), 0, grouped_views.contacts.shape[1]
    )
    return _augmented(
        k_augment,
        config,
        Batch(
            grouped_views.points[view].astype(jnp.float32),
            jax.tree.map(lambda a: a[view], grouped_views.point_groups),
            jnp.concatenate([samples.contact[row], probes], -1),
            samples.trajectory[row],
            task,
            label.astype(jnp.float32),
            jnp.where(achieved, moved, config.low),
            achieved.astype(jnp.float32),
            commanded[:, : config.actionability_queries],
            jax.tree.map(lambda a: a[view], grouped_views.joints) if config.networks.flow_hidden else None,
        ),
    )


def _relabelled(key: jax.Array, moved: jax.Array, commanded: jax.Array, config: PerceptionConfig) -> jax.Array:
    """Tasks [...] for trajectories that moved the part by `moved`: near it, shifted off it, or as commanded.

    The paper's negatives are shifted by at least a tenth, which its own tolerance still calls a success; here a
    shifted task lies outside the tolerance.
    """
    k_kind, k_near, k_side, k_shift = jax.random.split(key, 4)
    uniform = lambda key, low, high: low + (high - low) * jax.random.uniform(key, moved.shape)
    kind = jax.random.uniform(k_kind, moved.shape)
    lower, upper = moved / (1 + config.tolerance), moved / (1 - config.tolerance)
    near = jnp.clip(uniform(k_near, lower, upper), config.low, config.high)
    down = uniform(k_shift, jnp.maximum(config.low, lower - config.shift), lower)
    up = uniform(k_shift, upper, jnp.minimum(config.high, upper + config.shift))
    side = jax.random.bernoulli(k_side, 0.5, moved.shape)
    can_down, can_up = lower > config.low, upper < config.high
    off = jnp.where((side & can_down) | ~can_up, down, up)
    off = jnp.where(can_down | can_up, off, commanded)
    return jnp.where(
        kind < config.relabel_fraction,
        near,
        jnp.where(kind < config.relabel_fraction + config.negative_fraction, off, commanded),
    )


def _augmented(key: jax.Array, config: PerceptionConfig, batch: Batch) -> Batch:
    """Every view by a random transform. Consumes the key."""
    k_mirror, k_yaw, k_scale = jax.random.split(key, 3)
    views = batch.points.shape[:1]
    mirrored = jax.random.bernoulli(k_mirror, 0.5, views) & config.mirror
    yaw = jax.random.uniform(k_yaw, views, minval=-config.yaw, maxval=config.yaw)
    limit = math.log1p(config.scale)
    scale = jnp.exp(jax.random.uniform(k_scale, views, minval=-limit, maxval=limit))
    transform = SceneTransform(mirrored, yaw, scale)
    return jax.vmap(partial(transformed, task_is_length=config.task_is_length))(batch, transform)


def transformed(batch: Batch, transform: SceneTransform, task_is_length: bool = False) -> Batch:
    """One view of a Batch, mirrored, turned and scaled with all that belongs to it."""
    if batch.joints is not None:
        axis, anchor = transform.directions(batch.joints[0]), transform.points(batch.joints[1])
        # The mirror image of a turn goes the other way about the mirrored axis.
        axis = axis if task_is_length else jnp.where(transform.mirrored, -axis, axis)
        batch = batch._replace(joints=(axis, anchor))
    return batch._replace(
        points=transform.points(batch.points),
        point_groups=replace(batch.point_groups, queries=transform.points(batch.point_groups.queries)),
        trajectory=transform.trajectory(batch.trajectory),
        task=transform.task(batch.task, task_is_length),
        achieved=transform.task(batch.achieved, task_is_length),
        probe_task=transform.task(batch.probe_task, task_is_length),
    )


def _loss(
    params: Params, batch: Batch, key: jax.Array, config: PerceptionConfig, stage: str
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """The weighted sum of a stage's losses, and each of them raw. Consumes the key."""
    networks, heads = Networks(config.networks), _heads(config, stage)
    k_posterior, k_proposals, k_course = jax.random.split(key, 3)
    f = jax.vmap(networks.features, (None, 0, 0, 0))(params, batch.points, batch.point_groups, batch.which)
    contact = jnp.take_along_axis(batch.point_groups.queries, batch.which[..., None], 1)
    n = batch.task.shape[1]
    of_samples, of_probes = Features(*(x[:, :n] for x in f)), Features(*(x[:, n:] for x in f))
    total, metrics, flow = jnp.float32(0), {}, None
    if "flow" in heads:
        task = jnp.concatenate([batch.task, batch.probe_task], -1)
        truth = flow_target(contact, *batch.joints, task, hinge=not config.task_is_length)  # pyright: ignore
        said = networks.flow(params, f, contact, task)
        flow = _disturbed(k_course, said[:, :n], config.flow_noise)
        off = said - truth
        loss = jnp.abs(off).mean()
        total += config.flow_weight * loss
        if config.networks.predict_axis:  # the arc alone teaches slowly where its axis is
            axis, arm = networks.joint_axis(params, f, contact, task)
            true_axis, true_arm = axis_target(contact, *batch.joints)  # pyright: ignore
            axis_loss = jnp.abs(axis - true_axis).mean() + 2 * jnp.abs(arm - true_arm).mean()
            total += config.flow_weight * axis_loss
            metrics |= {"axis_loss": axis_loss}
        places, _ = unpack_flow(off)
        metrics |= {"flow_loss": loss, "flow_error": jnp.linalg.norm(places[..., -1, :], axis=-1).mean()}
    if "scorer" in heads:
        logits = networks.score(params, of_samples, contact[:, :n], batch.task, batch.trajectory, flow)
        loss = losses.score_loss(logits, batch.label)
        total += config.score_weight * loss
        accuracy = jnp.mean((logits > 0) == (batch.label > 0.5))
        metrics |= {"score_loss": loss, "score_accuracy": accuracy, "positives": batch.label.mean()}
    if "proposal" in heads:
        where = (contact[:, :n], batch.achieved)
        mean, log_variance = networks.posterior(params, of_samples, *where, batch.trajectory)
        z = mean + jnp.exp(0.5 * log_variance) * jax.random.normal(k_posterior, mean.shape)
        decoded = networks.decode(params, of_samples, *where, z)
        move, turn, rotation = losses.reconstruction_losses(decoded, batch.trajectory, batch.weight)
        kl = losses.kl_loss(mean, log_variance, batch.weight)
        total += config.position_weight * move + config.euler_weight * turn
        total += config.rotation_weight * rotation + config.kl_weight * jnp.maximum(kl, config.free_bits)
        metrics |= {"position_loss": move, "euler_loss": turn, "rotation_loss": rotation, "kl_loss": kl}
    if "actionability" in heads:
        where = (contact[:, n:], batch.probe_task)
        logits = networks.actionability(params, of_probes, *where)
        itself = Features(*(x[None] for x in of_probes))
        _, scores = TTAPredictor(networks).propose(params, itself, *where, k_proposals, config.num_proposals)
        target = jax.lax.stop_gradient(losses.actionability_target(scores, config.top_k))
        loss = losses.actionability_loss(logits, target)
        total += config.actionability_weight * loss
        metrics |= {"actionability_loss": loss, "actionability_target": target.mean()}
    return total, metrics | {"loss": total}


def flow_target(contact: jax.Array, axis: jax.Array, anchor: jax.Array, task: jax.Array, hinge: bool) -> jax.Array:
    """[V, Q, 15] what `Networks.flow` should say of contacts [V, Q, 3] and tasks [V, Q] where the joints are axis
    and anchor [V, 3]."""
    return articulation_flow(axis[:, None], anchor[:, None] - contact, task, hinge)


def axis_target(contact: jax.Array, axis: jax.Array, anchor: jax.Array) -> tuple[jax.Array, jax.Array]:
    """What `Networks.hinge` should say of contacts [V, Q, 3] where the hinges are axis and anchor [V, 3]: the axis
    [V, 1, 3], and the way [V, Q, 3] from the contact to the nearest point on it."""
    axis, arm = axis[:, None], anchor[:, None] - contact
    return axis, arm - axis * jnp.sum(axis * arm, -1, keepdims=True)


def _disturbed(key: jax.Array, flow: jax.Array, share: float) -> jax.Array:
    """Courses [V, Q, 15] longer or shorter, bent aside and turned otherwise by about `share`. Consumes the key."""
    k_length, k_side, k_turn = jax.random.split(key, 3)
    places, turn = unpack_flow(flow)
    length = jnp.linalg.norm(places[..., -1:, :], axis=-1, keepdims=True)
    aside = jnp.arange(1, WAYPOINTS + 1)[:, None] / WAYPOINTS * length
    normal = lambda key, of: jax.random.normal(key, of.shape)
    places = places * jnp.exp(share * normal(k_length, length)) + share * aside * normal(k_side, places[..., :1, :])
    turn = turn + share * jnp.linalg.norm(turn, axis=-1, keepdims=True) * normal(k_turn, turn)
    return pack_flow(places, turn)


def _heads(config: PerceptionConfig, stage: str) -> tuple[str, ...]:
    """The heads of a stage that these networks have."""
    return tuple(head for head in STAGES[stage] if head != "flow" or config.networks.flow_hidden)


def _trained(config: PerceptionConfig, stage: str) -> set[str]:
    """Names in the parameters of the networks that a stage trains."""
    heads = _heads(config, stage)
    names = {name for head in heads for name in (("posterior", "decoder") if head == "proposal" else (head,))}
    if config.networks.separate_encoders or "flow" in STAGES[stage]:
        names |= set(Networks(config.networks).encoders(*heads))
    return names


def _optimizer(config: PerceptionConfig) -> optax.GradientTransformation:
    """Its updates are to be subtracted, times the learning rate."""
    clip, decay = optax.clip_by_global_norm(1.0), optax.add_decayed_weights(config.weight_decay)
    if config.muon:  # it subtracts by itself, hence -1; Adam's updates have an RMS of 1 at first, of about 0.2 later
        return optax.chain(clip, muon(-1.0, consistent_rms=0.5), decay)
    # As one vector: an update per parameter compiles twice as long.
    return optax.flatten(optax.chain(clip, optax.scale_by_adam(), decay))


@partial(jax.jit, static_argnames=("config",))
def _moments(config: PerceptionConfig, params: Params) -> optax.OptState:
    return _optimizer(config).init(params)


def _learning_rate(config: PerceptionConfig, step: jax.Array, steps: int) -> jax.Array:
    warm = jnp.minimum(1, (step + 1) / jnp.minimum(100, 1 + steps // 5))
    return config.learning_rate * warm * (0.02 + 0.98 * 0.5 * (1 + jnp.cos(jnp.pi * step / steps)))


@partial(jax.jit, static_argnames=("config", "stage"))
def _steps(
    config: PerceptionConfig,
    stage: str,
    state: PerceptionState,
    grouped_views: GroupedViews,
    samples: Interactions,
    index: Index,
    count: int,
    steps: int,
) -> tuple[PerceptionState, dict[str, jax.Array]]:
    """`count` steps of a stage of `steps`, both traced, and the sums of their metrics."""
    trained = _trained(config, stage)
    slower = {"encoder", "flow"} if config.networks.flow_hidden and stage in ("scorer", "proposal") else set()
    shares = {name: config.encoder_lr_scale if name in slower else 1.0 for name in trained}

    def step(state: PerceptionState) -> tuple[PerceptionState, dict[str, jax.Array]]:
        key, k_draw, k_loss = jax.random.split(jax.random.wrap_key_data(state.key), 3)
        batch = _draw(k_draw, grouped_views, samples, index, config)
        # Only what a stage trains is differentiated, and only that is changed: no momentum or decay for the rest.
        part = {name: p for name, p in state.params.items() if name in trained}
        rest = jax.lax.stop_gradient(state.params)
        loss = lambda part: _loss(rest | part, batch, k_loss, config, stage)
        (_, metrics), gradients = jax.value_and_grad(loss, has_aux=True)(part)
        gradients = {name: gradients.get(name, jax.tree.map(jnp.zeros_like, p)) for name, p in state.params.items()}
        updates, optimizer = _optimizer(config).update(gradients, state.optimizer, state.params)
        rate = _learning_rate(config, state.step, steps)
        updates = {name: optax.tree.scale(shares[name], updates[name]) for name in part}  # pyright: ignore[reportIndexIssue, reportOptionalSubscript]
        moved = jax.tree.map(lambda p, u: p - rate * u, part, updates)
        return PerceptionState(state.params | moved, optimizer, state.step + 1, jax.random.key_data(key)), metrics

    def body(_: int, carry: tuple[PerceptionState, dict]) -> tuple[PerceptionState, dict]:
        state, sums = carry
        state, metrics = step(state)
        return state, jax.tree.map(jnp.add, sums, metrics)

    zeros = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(step, state)[1])
    return jax.lax.fori_loop(0, count, body, (state, zeros))
