"""The paper's trajectories of 30 numbers, and the time law between waypoints, on device.

A trajectory is the 6D rotation of the gripper at its start pose and WAYPOINTS residuals (xyz, Euler XYZ).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from vatmart_jax.rotations import matrix_from_rot6d, rot6d_from_matrix

WAYPOINTS = 4  # after the start pose; the paper's five include it
TRAJECTORY = 6 + 6 * WAYPOINTS


def min_jerk(u: jax.Array) -> jax.Array:
    """Quintic from 0 to 1 with zero speed and acceleration at both ends; u is clipped to [0, 1]."""
    u = jnp.clip(u, 0, 1)
    return u**3 * (10 - 15 * u + 6 * u * u)


def pack_trajectory(start: jax.Array, residuals: jax.Array) -> jax.Array:
    """Start frames [..., 3, 3] and residuals [..., 4, 6] -> the paper's [..., 30] numbers.

    A residual is the move of the fingertip centre (object frame, unit lengths) and the change of the hand's Euler
    angles (in the start frame, rad) from one waypoint to the next; zeros stay (padding).
    """
    return jnp.concatenate([rot6d_from_matrix(start), residuals.reshape(*residuals.shape[:-2], -1)], -1)


def unpack_trajectory(trajectory: jax.Array) -> tuple[jax.Array, jax.Array]:
    """[..., 30] -> start frames [..., 3, 3] (orthonormalised) and residuals [..., 4, 6]."""
    residuals = trajectory[..., 6:].reshape(*trajectory.shape[:-1], WAYPOINTS, 6)
    return matrix_from_rot6d(trajectory[..., :6]), residuals


def since_start(trajectory: jax.Array) -> jax.Array:
    """[..., 30] -> [..., 4, 6]: after each waypoint, the fingertips' move and the Euler angles since the start pose."""
    return jnp.cumsum(trajectory[..., 6:].reshape(*trajectory.shape[:-1], WAYPOINTS, 6), -2)
