"""From fingertip poses to actuator targets of the free-flying hand."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from vatmart_jax import rotations as rot
from vatmart_jax.physics.scene_model import TIP, PhysicsConfig
from vatmart_jax.trajectory import min_jerk


def hand_target(move: jax.Array, euler: jax.Array, start: jax.Array, fingers: jax.Array) -> jax.Array:
    """Actuator targets [B, 8] that put the fingertip centre at `move` from where it started, the hand turned.

    move: [B, 3] object frame; euler: [B, 3] hand's intrinsic XYZ angles in its start frame; start: [B, 3, 3] that
    frame; fingers: [B] opening of each finger.
    """
    # The slides carry the hand's origin, which is TIP behind the fingertips.
    turned = rot.matrix_from_euler(euler)[..., :, 2]
    slides = rot.unrotate(start, move) - TIP * (turned - jnp.array([0.0, 0.0, 1.0]))
    return jnp.concatenate([slides, euler, fingers[:, None], fingers[:, None]], -1)


def waypoint_controls(previous: jax.Array, target: jax.Array, config: PhysicsConfig) -> jax.Array:
    """[B, 8] to [B, 8] -> [B, T, 8]: minimum jerk over the first share of the steps, then hold; fingers at once."""
    steps = config.steps_per_waypoint
    moving = max(1, round(steps * config.move_share))
    s = min_jerk(jnp.arange(1, steps + 1) / moving)[:, None]
    path = previous[:, None] + s * (target - previous)[:, None]
    return jnp.concatenate([path[..., :6], jnp.broadcast_to(target[:, None, 6:], (*path.shape[:2], 2))], -1)
