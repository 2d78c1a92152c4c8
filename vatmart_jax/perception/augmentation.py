"""A scene mirrored left to right, turned about the vertical and scaled, with all that happens in it.

Mirrored and turned scenes are exact: the gripper is its own mirror image. A scaled one takes the gripper's size along,
which is small beside it. Training augments with them; at inference predictions are averaged over several (test-time
augmentation).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vatmart_jax.trajectory import WAYPOINTS

# Left and right swapped: of a vector's xyz, and of an Euler residual, whose rotation R becomes S R S with
# S = diag(1, -1, 1) in the gripper's own mirrored frame.
_MIRROR = np.array([1, -1, 1], np.float32)
_MIRROR_TRAJECTORY = np.concatenate([_MIRROR, _MIRROR, np.tile(np.concatenate([_MIRROR, -_MIRROR]), WAYPOINTS)])


class SceneTransform(NamedTuple):
    """Mirrored left to right where `mirrored`, then turned by `yaw` about z, then `scale` times as large about the
    origin of the object frame; three scalars."""

    mirrored: jax.Array  # [] bool
    yaw: jax.Array  # [] rad
    scale: jax.Array  # [] > 0

    def directions(self, v: jax.Array) -> jax.Array:
        """Vectors [..., 3] mirrored and turned, of the same length."""
        return jnp.where(self.mirrored, v * _MIRROR, v) @ self._rotation

    def points(self, p: jax.Array) -> jax.Array:
        """Points [..., 3]."""
        return self.directions(p) * self.scale

    def trajectory(self, trajectory: jax.Array) -> jax.Array:
        """Trajectories [..., 30], see trajectory.pack_trajectory."""
        trajectory = jnp.where(self.mirrored, trajectory * _MIRROR_TRAJECTORY, trajectory)
        triples = trajectory.reshape(*trajectory.shape[:-1], -1, 3)
        number = jnp.arange(triples.shape[-2])[:, None]  # two of the start rotation, then a move and Euler angles
        is_euler, is_move = (number >= 3) & (number % 2 == 1), (number >= 2) & (number % 2 == 0)
        triples = jnp.where(is_euler, triples, triples @ self._rotation) * jnp.where(is_move, self.scale, 1.0)
        return triples.reshape(trajectory.shape)

    def goal(self, goal: jax.Array, slides: bool) -> jax.Array:
        """Goals [...]: angles stay, the lengths of slides grow with the scene."""
        return goal * self.scale if slides else goal

    @property
    def _rotation(self) -> jax.Array:
        cos, sin, zero = jnp.cos(self.yaw), jnp.sin(self.yaw), jnp.zeros_like(self.yaw)
        return jnp.array([[cos, sin, zero], [-sin, cos, zero], [zero, zero, zero + 1]])  # of row vectors


def tta_transforms(count: int, yaw: float = 0.2) -> SceneTransform:
    """`count` exact transforms [count] for test-time augmentation: the identity first, then every other one mirrored,
    turned by up to `yaw` (rad), within what training augments with."""
    number = np.arange(count)
    turned = yaw * np.sin(2.4 * number)  # 2.4 rad: no two of a few are alike
    return SceneTransform(jnp.asarray(number % 2 == 1), jnp.asarray(turned, jnp.float32), jnp.ones(count))
