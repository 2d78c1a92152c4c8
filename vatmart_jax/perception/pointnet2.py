"""PointNet++ (single-scale grouping, segmentation) in pure JAX.

Which points are sampled, grouped and interpolated depends on a cloud alone, not on the weights: `group` finds it once
per view, and every pass of the network reuses it. Points that the network is asked about (`queries`: contact
candidates, or the cloud itself for a heat map) are not sampled; their features are interpolated and, where the config
says so, joined by what lies around each of them, which shows a handle that coarse levels miss.

Source: Qi et al. 2017; sizes as in VAT-Mart's and Where2Act's released networks.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct


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
class PointNet2Config:
    """Sizes of one PointNet++; the defaults are the paper's."""

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

    def __post_init__(self) -> None:
        if len(self.levels) != len(self.propagation):
            raise ValueError(f"{len(self.levels)} levels need as many propagations, not {len(self.propagation)}")
        if self.global_context and len(self.levels) < 2:
            raise ValueError("a context needs two levels, for it is made of the second's centroids")


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


@struct.dataclass
class PointGroups:
    """The index structure of one view: N points, C queries, L levels with M_1 > ... > M_L centroids (M_0 = N).

    Indices are int16 where they fit, else int32; a batch of views has a leading dimension everywhere.
    """

    queries: jax.Array  # [C, 3] float32
    centroids: tuple[jax.Array, ...]  # L of [M_l], into level l - 1
    neighbors: tuple[jax.Array, ...]  # L of [M_l, k_l], into level l - 1
    nearest: tuple[jax.Array, ...]  # L of [T, 3], into level l; T = C for l = 1, else M_{l-1}
    weights: tuple[jax.Array, ...]  # L of [T, 3] float16, inverse distances that sum to 1
    local_groups: tuple[jax.Array, ...]  # one of [C, k] for each of the config's, into the cloud


def farthest_points(points: jax.Array, count: int) -> jax.Array:
    """Indices [count] int32 of points [N, 3]: the first point, then each time the one farthest from all before.

    Of equally far points the one with the lowest index. Points repeat where count > N.
    """
    x, y, z = points.T
    order = jnp.arange(len(points), dtype=jnp.int32)

    def add(i: int, carry: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        chosen, square, last = carry
        square = jnp.minimum(square, (x - x[last]) ** 2 + (y - y[last]) ** 2 + (z - z[last]) ** 2)
        # A maximum and a minimum vectorise on CPU, an argmax does not: 9 ms against 77 for 1,024 of 10,000.
        last = jnp.min(jnp.where(square == square.max(), order, len(points)))
        return chosen.at[i].set(last), square, last

    start = (jnp.zeros(count, jnp.int32), jnp.full(len(points), jnp.inf), jnp.int32(0))
    return jax.lax.fori_loop(1, count, add, start)[0]


def ball_query(points: jax.Array, centres: jax.Array, radius: float, count: int) -> jax.Array:
    """Indices [M, count] int32 of the first `count` points [N, 3] closer than radius to centres [M, 3].

    Where there are fewer, the first repeats (as in the reference CUDA code); where there is none, index 0. Points in
    random order make this a random choice among those inside.
    """
    inside = _square_distances(centres, points) < radius * radius
    inside = jnp.pad(inside, ((0, 0), (0, -len(points) % 32))).reshape(len(centres), -1, 32)
    # No sort: hits become bits of 32-bit words, and the k-th hit is found by counting bits. On CPU `top_k` of the
    # masked indices takes 1.7 s where this takes 60 ms (1,024 centres, 10,000 points).
    words = jnp.sum(inside.astype(jnp.uint32) << jnp.arange(32, dtype=jnp.uint32), -1, dtype=jnp.uint32)
    total = jnp.cumsum(_bits(words), -1)
    rank = jnp.arange(count)
    rank = jnp.where(rank < total[:, -1:], rank, 0)
    word = jnp.sum(total[:, None] <= rank[..., None], -1)
    word = jnp.where(total[:, -1:] > 0, word, 0)
    rank = rank - jnp.take_along_axis(total - _bits(words), word, 1)
    bits = jnp.take_along_axis(words, word, 1)
    bit = jnp.zeros_like(rank)
    for half in (16, 8, 4, 2, 1):
        low = bits & jnp.uint32((1 << half) - 1)
        above = rank >= _bits(low)
        rank = jnp.where(above, rank - _bits(low), rank)
        bits = jnp.where(above, bits >> half, low)
        bit = jnp.where(above, bit + half, bit)
    return jnp.where(total[:, -1:] > 0, word * 32 + bit, 0).astype(jnp.int32)


def three_nearest(targets: jax.Array, sources: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The three sources [M, 3] nearest to each target [T, 3], M >= 3: indices [T, 3] int32 and weights [T, 3].

    Weights are proportional to the inverse squared distance and sum to 1, as in the reference CUDA code.
    """
    x, y, z = targets.T

    def insert(j: int, carry: tuple[tuple[jax.Array, ...], tuple[jax.Array, ...]]) -> tuple:
        (a, b, c), (i, k, m) = carry
        d = (x - sources[j, 0]) ** 2 + (y - sources[j, 1]) ** 2 + (z - sources[j, 2]) ** 2
        first, second, third = d < a, d < b, d < c
        where = jnp.where
        return (
            (where(first, d, a), where(first, a, where(second, d, b)), where(second, b, where(third, d, c))),
            (where(first, j, i), where(first, i, where(second, j, k)), where(second, k, where(third, j, m))),
        )

    far, none = jnp.full(len(targets), jnp.inf), jnp.zeros(len(targets), jnp.int32)
    square, index = jax.lax.fori_loop(0, len(sources), insert, ((far,) * 3, (none,) * 3))
    inverse = 1 / (jnp.stack(square, -1) + 1e-8)
    return jnp.stack(index, -1), inverse / inverse.sum(-1, keepdims=True)


def group(points: jax.Array, queries: jax.Array, config: PointNet2Config) -> PointGroups:
    """The Grouping of a cloud [N, 3] and queries [C, 3]. Jits, and vmaps over views.

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
        centroids.append(_compact(chosen, len(below)))
        neighbors.append(_compact(members, len(below)))
        nearest.append(_compact(closest, level.num_centroids))
        weights.append(weight.astype(jnp.float16))
        below = targets = xyz
    local_groups = tuple(
        _compact(ball_query(points, queries, a.radius, a.max_neighbors), len(points)) for a in config.local_groups
    )
    return PointGroups(queries, tuple(centroids), tuple(neighbors), tuple(nearest), tuple(weights), local_groups)


def local_offsets(
    points: jax.Array, point_groups: PointGroups, which: jax.Array | None = None
) -> tuple[jax.Array, ...]:
    """Offsets [Q, k, 3] from queries to the points of each group about them.

    points: [N, 3]. which: [Q] int into the queries, None for all.
    """
    of_query = (lambda x: x) if which is None else (lambda x: _take(x, which))
    place = of_query(point_groups.queries)[:, None]
    return tuple(_take(points.astype(jnp.float32), of_query(members)) - place for members in point_groups.local_groups)


class SharedMLP(nn.Module):
    """Dense layers with ReLU, the same for every point [..., d] -> [..., widths[-1]].

    Without normalisation: batch statistics would be mutable state and tie a view's features to its batch, and layer
    normalisation took a quarter more time here and learned no better.
    """

    widths: tuple[int, ...]

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        for width in self.widths:
            x = nn.relu(nn.Dense(width, kernel_init=nn.initializers.he_normal())(x))
        return x


class PointNet2(nn.Module):
    """Features of the queries of one view; vmap it over views."""

    config: PointNet2Config

    @nn.compact
    def __call__(self, points: jax.Array, point_groups: PointGroups, which: jax.Array | None = None) -> jax.Array:
        """points: [N, 3]. which: [Q] int into the queries, None for all. Returns [Q, feature_dim]."""
        levels, number = self.config.levels, itertools.count()

        def mlp(widths: tuple[int, ...]) -> SharedMLP:
            # A module's initial values follow from its name: these are the names that trained parameters have.
            return SharedMLP(widths, name=f"Shared_{next(number)}")

        xyz = points.astype(jnp.float32)
        skips, centroids = [xyz], [xyz]
        for level, chosen, members in zip(levels, point_groups.centroids, point_groups.neighbors, strict=True):
            centres = _take(xyz, chosen)
            offset = (_take(xyz, members) - centres[:, None]) / level.radius
            grouped = jnp.concatenate([offset, _take(skips[-1], members)], -1)
            skips.append(mlp(level.widths)(grouped).max(-2))
            xyz = centres
            centroids.append(xyz)
        skips[0] = point_groups.queries if which is None else _take(point_groups.queries, which)
        features = skips[-1]
        for depth in reversed(range(len(levels))):
            nearest, weights = point_groups.nearest[depth], point_groups.weights[depth]
            if depth == 0 and which is not None:
                nearest, weights = _take(nearest, which), _take(weights, which)
            tta_transforms = jnp.sum(_take(features, nearest) * weights[..., None].astype(jnp.float32), -2)
            features = mlp(self.config.propagation[depth])(jnp.concatenate([tta_transforms, skips[depth]], -1))
        parts = [features]
        for kind, offset in zip(self.config.local_groups, local_offsets(points, point_groups, which), strict=True):
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


def _take(x: jax.Array, index: jax.Array) -> jax.Array:
    return x.at[index].get(mode="promise_in_bounds")


def _square_distances(a: jax.Array, b: jax.Array) -> jax.Array:
    # Differences, not |a|^2 + |b|^2 - 2ab: the latter loses points on a ball's rim to rounding.
    return sum((a[:, None, i] - b[None, :, i]) ** 2 for i in range(3))  # pyright: ignore[reportReturnType]


def _bits(words: jax.Array) -> jax.Array:
    return jax.lax.population_count(words).astype(jnp.int32)


def _compact(index: jax.Array, size: int) -> jax.Array:
    return index.astype(jnp.int16 if size <= np.iinfo(np.int16).max else jnp.int32)
