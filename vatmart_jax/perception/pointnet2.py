"""PointNet++ (single-scale grouping, segmentation) in pure JAX.

Which points are sampled, grouped and interpolated depends on a cloud alone, not on the weights: `group` computes it
once per view, and every pass of the network reuses it. Query points (contact candidates, or the cloud itself for a
heat map) are not sampled; their features are interpolated and, where the config has local groups, joined by a feature
of the points around each of them, which resolves handles that the coarse levels miss.

Source: Qi et al. 2017; sizes as in VAT-Mart's and Where2Act's released networks.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import ClassVar

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.struct import PyTreeNode

from vatmart_jax.perception.augmentation import SceneTransform
from vatmart_jax.perception.encoder import EncoderConfig
from vatmart_jax.perception.layers import Params, SharedMLP, apply, init
from vatmart_jax.perception.point_ops import ball_query, compact, farthest_points, take, three_nearest


@dataclass(frozen=True)
class SetAbstraction:
    """One set abstraction level."""

    num_centroids: int  # farthest-point samples of the level below
    radius: float  # of a group, unit lengths
    max_neighbors: int  # points of a group
    widths: tuple[int, ...]  # of the network shared by all points of all groups


@dataclass(frozen=True)
class LocalGroup:
    """A group of the cloud's points about every query."""

    radius: float  # unit lengths
    max_neighbors: int
    widths: tuple[int, ...]


@dataclass(frozen=True)
class PointNet2Config(EncoderConfig):
    """Sizes of one PointNet++; the defaults are the paper's."""

    kind: ClassVar[str] = "pointnet2"

    n_points: int = 10_000
    """Points of a view that training sees; inference takes any number."""
    levels: tuple[SetAbstraction, ...] = (
        SetAbstraction(1024, 0.1, 32, (32, 32, 64)),
        SetAbstraction(256, 0.2, 32, (64, 64, 128)),
        SetAbstraction(64, 0.4, 32, (128, 128, 256)),
        SetAbstraction(16, 0.8, 32, (256, 256, 512)),
    )
    """Set abstraction, finest first."""
    propagation: tuple[tuple[int, ...], ...] = ((128, 128, 128), (256, 128), (256, 256), (256, 256))
    """Widths of the feature propagation into each level, finest (the queries) first."""
    feature_dim: int = 128
    """Width of a query's feature."""
    local_groups: tuple[LocalGroup, ...] = ()
    """Groups about the queries themselves; the paper has none."""
    global_context: tuple[int, ...] = ()
    """Widths of a network over all of the second level's centroids as each query sees them; the paper has none."""

    def build(self) -> PointNet2Encoder:
        return PointNet2Encoder(self)

    def __post_init__(self) -> None:
        if len(self.levels) != len(self.propagation):
            raise ValueError(f"{len(self.levels)} levels need as many propagations, not {len(self.propagation)}")
        if self.global_context and len(self.levels) < 2:
            raise ValueError("global_context needs two levels: it reads the centroids of the second")


SMALL = PointNet2Config(
    n_points=4096,
    levels=(
        SetAbstraction(256, 0.15, 16, (32, 32, 64)),
        SetAbstraction(64, 0.3, 16, (64, 64, 128)),
        SetAbstraction(16, 0.7, 16, (128, 128, 256)),
    ),
    propagation=((128, 128), (128, 128), (256, 128)),
    local_groups=(LocalGroup(0.06, 16, (32, 32, 64)), LocalGroup(0.15, 32, (32, 32, 64))),
    global_context=(32, 64),
)
"""A ninth of the paper's arithmetic per view, for two CPU cores."""


class PointGroups(PyTreeNode, kw_only=True):
    """The index structure of one view: N points, C queries, L levels with M_1 > ... > M_L centroids (M_0 = N).

    Indices are int16 where they fit, else int32; a batch of views has a leading dimension everywhere.
    """

    queries: jax.Array  # [C, 3] float32
    centroids: tuple[jax.Array, ...]  # L of [M_l], into level l - 1
    neighbors: tuple[jax.Array, ...]  # L of [M_l, k_l], into level l - 1
    nearest: tuple[jax.Array, ...]  # L of [T, 3], into level l; T = C for l = 1, else M_{l-1}
    weights: tuple[jax.Array, ...]  # L of [T, 3] float16, inverse distances that sum to 1
    local_groups: tuple[jax.Array, ...]  # one of [C, k] for each of the config's, into the cloud


@dataclass(frozen=True)
class PointNet2Encoder:
    """PointNet++ as a PointEncoder."""

    config: PointNet2Config

    @property
    def num_points(self) -> int:
        return self.config.n_points

    @property
    def feature_dim(self) -> int:
        return self.config.feature_dim

    @property
    def num_local_points(self) -> int:
        return sum(local.max_neighbors for local in self.config.local_groups)

    def prepare(self, points: jax.Array, queries: jax.Array) -> PointGroups:
        return group(points, queries, self.config)

    def transform(self, prepared: PointGroups, transform: SceneTransform) -> PointGroups:
        """Neighbours stay neighbours; a scaled scene has groups of scaled radius."""
        return prepared.replace(queries=transform.points(prepared.queries))

    def init(self, key: jax.Array) -> Params:
        points, queries = jnp.zeros((self.num_points, 3)), jnp.zeros((1, 3))
        shapes = jax.eval_shape(self.prepare, points, queries)
        prepared = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shapes)
        return init(PointNet2(self.config), key, points, prepared)

    def apply(
        self, params: Params, points: jax.Array, prepared: PointGroups, query_index: jax.Array | None = None
    ) -> jax.Array:
        return apply(PointNet2(self.config), params, points, prepared, query_index)

    def local_offsets(
        self, points: jax.Array, prepared: PointGroups, query_index: jax.Array | None = None
    ) -> jax.Array:
        return jnp.concatenate(local_offsets(points, prepared, query_index), -2)


def group(points: jax.Array, queries: jax.Array, config: PointNet2Config) -> PointGroups:
    """The PointGroups of a cloud [N, 3] and queries [C, 3]. Jits, and vmaps over views.

    Points should be in random order (see `ball_query`).
    """
    points, queries = points.astype(jnp.float32), queries.astype(jnp.float32)
    centroids, neighbors, nearest, weights = [], [], [], []
    below, targets = points, queries
    for level in config.levels:
        chosen = farthest_points(below, level.num_centroids)
        xyz = below[chosen]
        members = ball_query(below, xyz, level.radius, level.max_neighbors)
        closest, weight = three_nearest(targets, xyz)
        centroids.append(compact(chosen, len(below)))
        neighbors.append(compact(members, len(below)))
        nearest.append(compact(closest, level.num_centroids))
        weights.append(weight.astype(jnp.float16))
        below = targets = xyz
    local_groups = tuple(
        compact(ball_query(points, queries, a.radius, a.max_neighbors), len(points)) for a in config.local_groups
    )
    return PointGroups(
        queries=queries,
        centroids=tuple(centroids),
        neighbors=tuple(neighbors),
        nearest=tuple(nearest),
        weights=tuple(weights),
        local_groups=local_groups,
    )


def local_offsets(
    points: jax.Array, point_groups: PointGroups, query_index: jax.Array | None = None
) -> tuple[jax.Array, ...]:
    """Offsets [Q, k, 3] from queries to the points of each group about them.

    points: [N, 3]. query_index: [Q] int into the queries, None for all.
    """
    of_query = (lambda x: x) if query_index is None else (lambda x: take(x, query_index))
    place = of_query(point_groups.queries)[:, None]
    return tuple(take(points.astype(jnp.float32), of_query(members)) - place for members in point_groups.local_groups)


class PointNet2(nn.Module):
    """Features of the queries of one view; vmap it over views."""

    config: PointNet2Config

    @nn.compact
    def __call__(self, points: jax.Array, point_groups: PointGroups, query_index: jax.Array | None = None) -> jax.Array:
        """points: [N, 3]. query_index: [Q] int into the queries, None for all. Returns [Q, feature_dim]."""
        levels, number = self.config.levels, itertools.count()

        def mlp(widths: tuple[int, ...]) -> SharedMLP:
            # A module's initial values follow from its name: these are the names that trained parameters have.
            return SharedMLP(widths, name=f"Shared_{next(number)}")

        xyz = points.astype(jnp.float32)
        skips, centroids = [xyz], [xyz]
        for level, chosen, members in zip(levels, point_groups.centroids, point_groups.neighbors, strict=True):
            centres = take(xyz, chosen)
            offset = (take(xyz, members) - centres[:, None]) / level.radius
            grouped = jnp.concatenate([offset, take(skips[-1], members)], -1)
            skips.append(mlp(level.widths)(grouped).max(-2))
            xyz = centres
            centroids.append(xyz)
        skips[0] = point_groups.queries if query_index is None else take(point_groups.queries, query_index)
        features = skips[-1]
        for depth in reversed(range(len(levels))):
            nearest, weights = point_groups.nearest[depth], point_groups.weights[depth]
            if depth == 0 and query_index is not None:
                nearest, weights = take(nearest, query_index), take(weights, query_index)
            interpolated = jnp.sum(take(features, nearest) * weights[..., None].astype(jnp.float32), -2)
            features = mlp(self.config.propagation[depth])(jnp.concatenate([interpolated, skips[depth]], -1))
        parts = [features]
        for kind, offset in zip(
            self.config.local_groups, local_offsets(points, point_groups, query_index), strict=True
        ):
            offset = offset / kind.radius
            # A query with no point near has one from elsewhere, at a distance that means nothing.
            inside = jnp.sum(offset**2, -1, keepdims=True) <= 1.01
            parts.append(jnp.where(inside, mlp(kind.widths)(offset), 0.0).max(-2))
        if self.config.global_context:
            # A dense layer of a centroid's feature and its offset from the query, the sum of what each contributes.
            width, *more = self.config.global_context
            place = nn.Dense(width, use_bias=False, name="context_place")
            seen = nn.Dense(width, name="context_seen")(skips[2]) + place(centroids[2])
            parts.append(mlp(tuple(more))(nn.relu(seen - place(skips[0])[:, None])).max(-2))
        return mlp((self.config.feature_dim,))(jnp.concatenate(parts, -1))
