"""The paper's extrinsic reward (section 4.1), and a penalty on what the hand's controller fails to track."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp

REWARD_TERMS = ("guidance", "distance", "far", "success")


@dataclass(frozen=True, kw_only=True)
class RewardConfig:
    """Coefficients of the reward terms."""

    guidance: float = 300.0
    """per rad or unit length that the part comes closer to the goal"""
    distance: float = 150.0
    """penalty per unit length from the fingertips to the contact point"""
    far: float = 300.0
    """penalty where that distance is above `far_distance`"""
    far_distance: float = 0.1
    """unit lengths"""
    success: float = 500.0


PAPER = RewardConfig()


def reward_terms(
    goal: jax.Array,
    before: jax.Array,
    after: jax.Array,
    distance: jax.Array,
    success: jax.Array,
    config: RewardConfig = PAPER,
) -> dict[str, jax.Array]:
    """The reward of a step, term by term, [B] each.

    goal: [B]; before, after: [B] displacement of the part; distance: [B] fingertips to contact point, after the step;
    success: [B] bool.
    """
    return {
        "guidance": config.guidance * (jnp.abs(goal - before) - jnp.abs(goal - after)),
        "distance": -config.distance * distance,
        "far": -config.far * (distance > config.far_distance),
        "success": config.success * success,
    }


def tracking_cost(error: jax.Array, grasps: bool, penalty: float) -> jax.Array:
    """[B] cost of a tracking error [B] in unit lengths; a push has none, for it must press on the part."""
    return penalty * grasps * error
