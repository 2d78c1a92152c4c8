"""The 33 numbers that the policy sees."""

from __future__ import annotations

import jax

GOAL, REMAINING = 1, 2  # entries of an observation


def relabel(obs: jax.Array, goal: jax.Array, displacement: jax.Array) -> jax.Array:
    """Observations [..., 33] as they would be with goals [...] at displacements [...] of the part."""
    return obs.at[..., GOAL].set(goal).at[..., REMAINING].set(goal - displacement)
