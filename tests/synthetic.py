"""A toy world with a known answer: boxes whose front slides inwards, as far as the gripper pushes along its normal."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from vatmart_jax.perception.config import TaskSpec
from vatmart_jax.perception.encoder import EncoderConfig
from vatmart_jax.perception.grouped_views import GroupedViews, group_points
from vatmart_jax.perception.interaction_buffer import Interactions

SPEC = TaskSpec(goal_range=(0.1, 0.5), tolerance=0.15, relabel_range=0.45, slides=False)
"""The task of these boxes. They have one size, and are never scaled."""


def boxes(seed: int, views: int, config: EncoderConfig, contacts: int = 32) -> tuple[GroupedViews, np.ndarray]:
    """Boxes seen from the front; contacts lie on the front. Returns also the front's inward normals [V, 3]."""
    rng = np.random.default_rng(seed)
    points, touch, normals = [], [], []
    for _ in range(views):
        size, yaw = rng.uniform(0.3, 0.6, 3), rng.uniform(-1, 1)
        turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        centre = rng.uniform(-0.2, 0.2, 3)

        def face(axis: int, side: int, n: int, size=size, turn=turn, centre=centre) -> np.ndarray:
            p = rng.uniform(-1, 1, (n, 3)) * size
            p[:, axis] = side * size[axis]
            return p @ turn.T + centre

        n = config.n_points // 3
        cloud = np.concatenate([face(0, -1, config.n_points - 2 * n), face(2, 1, n), face(1, int(np.sign(yaw)), n)])
        points.append(rng.permutation(cloud))
        touch.append(face(0, -1, contacts))
        normals.append(turn[:, 0])
    clouds, queries = np.stack(points).astype(np.float16), np.stack(touch).astype(np.float32)
    return group_points(clouds, queries, config.build()), np.stack(normals)


def outcome(
    grouped_views: GroupedViews, normals: np.ndarray, view, contact, trajectory
) -> tuple[np.ndarray, np.ndarray]:
    """(moved, valid) of trajectories [..., 30]: valid where the hand comes along the normal, to the upper half."""
    n = normals[view]
    while n.ndim < np.ndim(trajectory):
        n = n[..., None, :]
    trajectory = np.asarray(trajectory)
    moves = trajectory[..., 6:].reshape(*trajectory.shape[:-1], 4, 6)[..., :3].sum(-2)
    point = np.asarray(grouped_views.contacts)[view, contact]
    upper = point[..., 2] > np.asarray(grouped_views.contacts)[..., 2].mean(-1)[view]
    upper = upper.reshape(upper.shape + (1,) * (np.ndim(trajectory) - 1 - upper.ndim))
    return np.maximum((moves * n).sum(-1), 0), ((trajectory[..., :3] * n).sum(-1) > 0.9) & upper


def samples(seed: int, grouped_views: GroupedViews, normals: np.ndarray, count: int, task=(0.1, 0.5)) -> Interactions:
    """Noisy pushes along the normal, and what they did."""
    rng = np.random.default_rng(seed)
    view, contact = rng.integers(0, len(grouped_views), count), rng.integers(0, grouped_views.contacts.shape[1], count)
    n = normals[view]
    up = n + rng.normal(size=n.shape) * 0.25
    up /= np.linalg.norm(up, axis=-1, keepdims=True)
    forward = np.cross(up, [0, 0, 1])
    forward /= np.linalg.norm(forward, axis=-1, keepdims=True)
    commanded = rng.uniform(*task, count)
    share = rng.dirichlet(np.full(4, 3.0), count)
    total = (n + rng.normal(size=n.shape) * 0.2) * (commanded * rng.uniform(0.7, 1.4, count))[:, None]
    residuals = np.concatenate([share[..., None] * total[:, None], rng.normal(size=(count, 4, 3)) * 0.05], -1)
    trajectory = np.concatenate([up, forward, residuals.reshape(count, -1)], -1).astype(np.float32)
    moved, valid = outcome(grouped_views, normals, view, contact, trajectory)
    return Interactions(
        view=jnp.asarray(view, jnp.int32),
        contact=jnp.asarray(contact, jnp.int32),
        goal=jnp.asarray(commanded, jnp.float32),
        trajectory=jnp.asarray(trajectory),
        displacement=jnp.asarray(moved, jnp.float32),
        valid=jnp.asarray(valid),
        from_proposal=jnp.zeros(count, bool),
    )
