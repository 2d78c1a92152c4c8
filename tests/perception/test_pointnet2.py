"""Point operations against plain NumPy and SciPy; the network's invariances."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from vatmart_jax.perception.point_ops import ball_query, farthest_points, three_nearest
from vatmart_jax.perception.pointnet2 import LocalGroup, PointNet2, PointNet2Config, SetAbstraction, group

TINY = PointNet2Config(
    n_points=200,
    levels=(SetAbstraction(40, 0.3, 8, (16, 16)), SetAbstraction(8, 0.8, 8, (16, 32))),
    propagation=((16,), (32,)),
    local_groups=(LocalGroup(0.2, 8, (16,)),),
    global_context=(8, 16),
)


NETWORK = PointNet2(TINY)
grouped = jax.jit(lambda points, queries: group(points, queries, TINY))
initial = jax.jit(NETWORK.init)
apply = jax.jit(NETWORK.apply)


def cloud(seed: int, n: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-0.5, 0.5, (n, 3)).astype(np.float32)


def farthest_points_numpy(points: np.ndarray, count: int) -> np.ndarray:
    chosen, square = [0], np.full(len(points), np.inf)
    while len(chosen) < count:
        square = np.minimum(square, ((points - points[chosen[-1]]) ** 2).sum(-1))
        chosen.append(int(square.argmax()))
    return np.array(chosen)


@pytest.mark.parametrize(("n", "count"), [(50, 50), (1000, 128)])
def test_farthest_points_are_those_of_a_plain_loop(n: int, count: int) -> None:
    points = cloud(n, n)
    assert (farthest_points_numpy(points, count) == np.asarray(farthest_points(jnp.asarray(points), count))).all()


def test_farthest_points_beyond_the_cloud_repeat_some() -> None:
    points = cloud(0, 20)
    found = np.asarray(farthest_points(jnp.asarray(points), 30))
    assert set(found) == set(range(20))


@pytest.mark.parametrize(("n", "radius", "count"), [(31, 0.3, 4), (1000, 0.1, 16), (1000, 0.5, 32), (4096, 0.2, 64)])
def test_a_ball_holds_the_first_points_inside_in_order(n: int, radius: float, count: int) -> None:
    points, centres = cloud(n, n), cloud(n + 1, 64)
    found = np.asarray(ball_query(jnp.asarray(points), jnp.asarray(centres), radius, count))
    for row, inside in zip(found, cKDTree(points).query_ball_point(centres, radius), strict=True):
        inside = np.sort(inside)[:count]
        expected = np.full(count, inside[0] if len(inside) else 0)
        expected[: len(inside)] = inside
        assert (row == expected).all()


@pytest.mark.parametrize(("n", "m"), [(5, 3), (500, 100)])
def test_interpolation_weights_are_inverse_square_distances_of_the_three_nearest(n: int, m: int) -> None:
    targets, sources = cloud(1, n), cloud(2, m)
    index, weights = map(np.asarray, three_nearest(jnp.asarray(targets), jnp.asarray(sources)))
    distance, expected = cKDTree(sources).query(targets, 3)
    assert (index == expected).all()
    inverse = 1 / (distance**2 + 1e-8)
    np.testing.assert_allclose(weights, inverse / inverse.sum(1, keepdims=True), rtol=1e-3)


def test_grouping_of_a_batch_is_that_of_each_view_and_is_compact() -> None:
    points, queries = (jnp.stack([jnp.asarray(cloud(seed, n)) for seed in (1, 2)]) for n in (200, 10))
    batch = jax.jit(jax.vmap(grouped))(points, queries)
    alone = grouped(points[1], queries[1])
    for a, b in zip(jax.tree.leaves(batch), jax.tree.leaves(alone), strict=True):
        np.testing.assert_array_equal(a[1], b)
    assert batch.neighbors[0].dtype == jnp.int16 and batch.weights[0].dtype == jnp.float16
    wide = PointNet2Config(n_points=40_000, levels=(SetAbstraction(4, 0.1, 4, (4,)),), propagation=((4,),))
    assert (
        jax.eval_shape(lambda: group(jnp.zeros((40_000, 3)), jnp.zeros((1, 3)), wide)).neighbors[0].dtype == jnp.int32
    )


def test_features_of_chosen_queries_are_those_of_all() -> None:
    points, queries = jnp.asarray(cloud(1, 200)), jnp.asarray(cloud(2, 30))
    point_groups = grouped(points, queries)
    params = initial(jax.random.key(0), points, point_groups)
    every = apply(params, points, point_groups)
    some = apply(params, points, point_groups, jnp.array([3, 17, 3]))
    assert every.shape == (30, 128)
    np.testing.assert_allclose(some, every[jnp.array([3, 17, 3])], rtol=1e-5, atol=1e-6)


def test_queries_do_not_change_each_other() -> None:
    points, queries = jnp.asarray(cloud(1, 200)), jnp.asarray(cloud(2, 30))
    params = initial(jax.random.key(0), points, grouped(points, queries))
    every = apply(params, points, grouped(points, queries))
    few = apply(params, points, grouped(points, queries[:5]))
    np.testing.assert_allclose(few, every[:5], rtol=1e-5, atol=1e-6)


def test_what_lies_around_a_query_changes_its_feature_and_what_lies_far_off_does_not() -> None:
    points, queries = jnp.asarray(cloud(1, 200)), jnp.asarray(cloud(2, 30))
    near = jnp.argmin(((points - queries[0]) ** 2).sum(-1))
    point_groups = grouped(points, queries)
    params = initial(jax.random.key(0), points, point_groups)
    alone = replace(point_groups, local_groups=tuple(jnp.full_like(a, near) for a in point_groups.local_groups))
    lonely = apply(params, points, replace(alone, queries=queries + 10.0))
    far = apply(params, points, replace(point_groups, queries=queries + 10.0))
    assert float(jnp.abs(apply(params, points, alone)[0] - apply(params, points, point_groups)[0]).max()) > 1e-4
    np.testing.assert_array_equal(lonely, far)


def test_every_parameter_has_a_gradient() -> None:
    points, queries = jnp.asarray(cloud(1, 200)), jnp.asarray(cloud(2, 30))
    point_groups = grouped(points, queries)
    params = initial(jax.random.key(0), points, point_groups)
    gradients = jax.jit(jax.grad(lambda p: jnp.sum(apply(p, points, point_groups) ** 2)))(params)
    assert all(float(jnp.abs(g).max()) > 0 for g in jax.tree.leaves(gradients))


def test_levels_and_propagations_must_match() -> None:
    with pytest.raises(ValueError, match="2 levels need as many propagations, not 1"):
        PointNet2Config(levels=TINY.levels, propagation=((16,),))
    with pytest.raises(ValueError, match="global_context needs two levels"):
        PointNet2Config(levels=TINY.levels[:1], propagation=((16,),), global_context=(8,))
