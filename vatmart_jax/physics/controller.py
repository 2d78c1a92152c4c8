"""The path of actuator targets from one waypoint to the next."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from vatmart_jax.physics.config import PhysicsConfig
from vatmart_jax.physics.gripper import HAND_JOINTS
from vatmart_jax.trajectory import min_jerk


def waypoint_controls(previous: jax.Array, target: jax.Array, config: PhysicsConfig) -> jax.Array:
    """Actuator targets [B, nu], from the previous to the next -> [B, T, nu], one row per physics step.

    Minimum jerk over the first share of the steps, then hold; fingers at once.
    """
    steps = config.steps_per_waypoint
    moving = max(1, round(steps * config.ramp_fraction))
    s = min_jerk(jnp.arange(1, steps + 1) / moving)[:, None]
    path = previous[:, None] + s * (target - previous)[:, None]
    fingers = target[:, None, len(HAND_JOINTS) :]
    fingers = jnp.broadcast_to(fingers, (*path.shape[:2], fingers.shape[-1]))
    return jnp.concatenate([path[..., : len(HAND_JOINTS)], fingers], -1)
