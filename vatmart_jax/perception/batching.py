"""Batches for the perception networks: drawn from the buffer, relabelled, augmented; all on device."""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax.struct import PyTreeNode

from vatmart_jax.perception.augmentation import SceneTransform
from vatmart_jax.perception.config import AugmentationConfig, PerceptionConfig, TaskSpec
from vatmart_jax.perception.encoder import PointEncoder, Prepared
from vatmart_jax.perception.grouped_views import GroupedViews
from vatmart_jax.perception.interaction_buffer import Interactions


class ViewIndex(NamedTuple):
    """Which rows of Interactions belong to which view, the networks' own proposals apart from the others."""

    rows: jax.Array  # [M] int32, rows sorted by view and kind, empty ones last
    start: jax.Array  # [V, 2] int32, where a view's rows of either kind begin
    count: jax.Array  # [V, 2] int32
    total: jax.Array  # [] int32, rows that are not empty


class Batch(PyTreeNode, kw_only=True):
    """V views of a step, Q samples and R actionability queries each."""

    points: jax.Array  # [V, N, 3]
    contacts: jax.Array  # [V, C, 3] the views' contact candidates
    prepared: Prepared  # what the encoder prepared, [V, ...]
    contact: jax.Array  # [V, Q + R] int, index into contacts: of the samples, then of the queries
    trajectory: jax.Array  # [V, Q, 30]
    goal: jax.Array  # [V, Q] the scorer's
    label: jax.Array  # [V, Q] float, success at that goal
    achieved: jax.Array  # [V, Q] the cVAE's goal: the displacement, where it lies in the goal range
    weight: jax.Array  # [V, Q] float, 1 where the cVAE learns from the row
    query_goal: jax.Array  # [V, R]
    displacement: jax.Array  # [V, Q] how far the part moved, unit of the goals
    joints: tuple[jax.Array, jax.Array] | None  # [V, 3] axes and anchors, where the networks have a flow to learn

    @property
    def contact_points(self) -> jax.Array:
        """[V, Q + R, 3] object frame."""
        return jnp.take_along_axis(self.contacts, self.contact[..., None], 1)


@partial(jax.jit, static_argnames=("num_views",))
def index_by_view(samples: Interactions, num_views: int) -> ViewIndex:
    """The rows of each view, without host work."""
    place = jnp.where(samples.view < 0, 2 * num_views, 2 * samples.view + samples.from_proposal)
    count = jnp.zeros(2 * num_views + 1, jnp.int32).at[place].add(1)
    start = jnp.cumsum(count) - count
    start, count = (a[:-1].reshape(num_views, 2) for a in (start, count))
    return ViewIndex(jnp.argsort(place).astype(jnp.int32), start, count, count.sum())


def draw_batch(
    key: jax.Array,
    grouped_views: GroupedViews,
    samples: Interactions,
    index: ViewIndex,
    *,
    config: PerceptionConfig,
    spec: TaskSpec,
) -> Batch:
    """Views, as often as trials were made in them, and samples of both kinds of each, uniformly and with replacement.

    Trials are balanced over categories and objects, so views are. Consumes the key.
    """
    k_view, k_kind, k_row, k_goal, k_query, k_augment = jax.random.split(key, 6)
    shape = (config.views_per_batch, config.samples_per_view)
    view = samples.view[index.rows[jax.random.randint(k_view, (config.views_per_batch,), 0, index.total)]]
    count = index.count[view][:, None]
    proposed = jax.random.bernoulli(k_kind, config.proposal_fraction, shape)
    kind = jnp.where((count > 0).all(-1), proposed, count[..., 1] > 0).astype(jnp.int32)
    count, start = (jnp.take_along_axis(a[view], kind, 1) for a in (index.count, index.start))
    offset = jnp.floor(jax.random.uniform(k_row, shape) * count).astype(jnp.int32)
    row = index.rows[start + jnp.minimum(offset, count - 1)]
    displacement, valid, commanded = samples.displacement[row], samples.valid[row], samples.goal[row]
    low, high = spec.goal_range
    achieved = valid & (displacement >= low) & (displacement <= high)
    goal = jnp.where(achieved, relabel(k_goal, displacement, commanded, config=config, spec=spec), commanded)
    label = valid & (jnp.abs(displacement - goal) <= spec.tolerance * goal)
    queries = jax.random.randint(
        k_query, (config.views_per_batch, config.actionability_queries), 0, grouped_views.contacts.shape[1]
    )
    of_views = lambda tree: jax.tree.map(lambda a: a[view], tree)
    batch = Batch(
        points=grouped_views.points[view].astype(jnp.float32),
        contacts=grouped_views.contacts[view],
        prepared=of_views(grouped_views.prepared),
        contact=jnp.concatenate([samples.contact[row], queries], -1),
        trajectory=samples.trajectory[row],
        goal=goal,
        label=label.astype(jnp.float32),
        achieved=jnp.where(achieved, displacement, low),
        weight=achieved.astype(jnp.float32),
        query_goal=commanded[:, : config.actionability_queries],
        displacement=displacement,
        joints=of_views(grouped_views.joints) if config.networks.flow_hidden else None,
    )
    return augment(k_augment, batch, config.augmentation, encoder=config.networks.encoder.build(), slides=spec.slides)


def relabel(
    key: jax.Array, displacement: jax.Array, commanded: jax.Array, *, config: PerceptionConfig, spec: TaskSpec
) -> jax.Array:
    """Goals [...] for trajectories that moved the part by `displacement`: near it, shifted off it, or as commanded.

    The paper's negatives are shifted by at least a tenth, which its own tolerance still counts as success; here a
    shifted goal lies outside the tolerance. Consumes the key.
    """
    k_kind, k_near, k_side, k_shift = jax.random.split(key, 4)
    uniform = lambda key, low, high: low + (high - low) * jax.random.uniform(key, displacement.shape)
    low, high = spec.goal_range
    kind = jax.random.uniform(k_kind, displacement.shape)
    lower, upper = displacement / (1 + spec.tolerance), displacement / (1 - spec.tolerance)
    near = jnp.clip(uniform(k_near, lower, upper), low, high)
    down = uniform(k_shift, jnp.maximum(low, lower - spec.relabel_range), lower)
    up = uniform(k_shift, upper, jnp.minimum(high, upper + spec.relabel_range))
    side = jax.random.bernoulli(k_side, 0.5, displacement.shape)
    can_down, can_up = lower > low, upper < high
    off = jnp.where((side & can_down) | ~can_up, down, up)
    off = jnp.where(can_down | can_up, off, commanded)
    is_near = kind < config.relabel_fraction
    is_off = kind < config.relabel_fraction + config.negative_fraction
    return jnp.where(is_near, near, jnp.where(is_off, off, commanded))


def augment(key: jax.Array, batch: Batch, config: AugmentationConfig, *, encoder: PointEncoder, slides: bool) -> Batch:
    """Every view by a random transform. Consumes the key."""
    k_mirror, k_yaw, k_scale = jax.random.split(key, 3)
    views = batch.points.shape[:1]
    mirrored = jax.random.bernoulli(k_mirror, 0.5, views) & config.mirror
    yaw = jax.random.uniform(k_yaw, views, minval=-config.yaw, maxval=config.yaw)
    limit = math.log1p(config.scale)
    scale = jnp.exp(jax.random.uniform(k_scale, views, minval=-limit, maxval=limit))
    one = partial(transform_view, encoder=encoder, slides=slides)
    return jax.vmap(one)(batch, SceneTransform(mirrored, yaw, scale))


def transform_view(batch: Batch, transform: SceneTransform, *, encoder: PointEncoder, slides: bool) -> Batch:
    """One view of a Batch, mirrored, turned and scaled with all that belongs to it."""
    joints = batch.joints
    if joints is not None:
        axis, anchor = transform.directions(joints[0]), transform.points(joints[1])
        # The mirror image of a rotation goes the other way about the mirrored axis.
        joints = (axis if slides else jnp.where(transform.mirrored, -axis, axis)), anchor
    return batch.replace(
        points=transform.points(batch.points),
        contacts=transform.points(batch.contacts),
        prepared=encoder.transform(batch.prepared, transform),
        trajectory=transform.trajectory(batch.trajectory),
        goal=transform.goal(batch.goal, slides),
        achieved=transform.goal(batch.achieved, slides),
        query_goal=transform.goal(batch.query_goal, slides),
        displacement=transform.goal(batch.displacement, slides),
        joints=joints,
    )
