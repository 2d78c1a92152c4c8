"""Executed trajectories and their outcomes: what the perception networks are trained on."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax.struct import PyTreeNode

from vatmart_jax.trajectory import TRAJECTORY


class Interactions(PyTreeNode, kw_only=True):
    """M executed trajectories and their outcomes; rows with view -1 are empty."""

    view: jax.Array  # [M] int32, index into GroupedViews
    contact: jax.Array  # [M] int32, index into that view's contacts
    goal: jax.Array  # [M] commanded displacement > 0, rad or unit lengths
    trajectory: jax.Array  # [M, 30] see trajectory.pack_trajectory
    displacement: jax.Array  # [M] how far the part moved in the task's direction, unit of `goal`
    valid: jax.Array  # [M] bool, success was possible: free start, grasp made and kept, physics sound
    from_proposal: jax.Array  # [M] bool, the networks proposed it; if not, it is of the policy or the scripted one

    @classmethod
    def empty(cls, capacity: int) -> Interactions:
        """A buffer of `capacity` empty rows."""
        return cls(
            view=jnp.full(capacity, -1, jnp.int32),
            contact=jnp.zeros(capacity, jnp.int32),
            goal=jnp.zeros(capacity),
            trajectory=jnp.zeros((capacity, TRAJECTORY)),
            displacement=jnp.zeros(capacity),
            valid=jnp.zeros(capacity, bool),
            from_proposal=jnp.zeros(capacity, bool),
        )

    def insert(self, new: Interactions, at: jax.Array | int) -> Interactions:
        """The buffer with `new` written from row `at` on, around its end."""
        rows = (at + jnp.arange(len(new.view))) % len(self.view)
        return jax.tree.map(lambda old, value: old.at[rows].set(value), self, new)

    def success(self, tolerance: float) -> jax.Array:
        """[M] bool, the part moved by the goal within the fraction `tolerance` of it."""
        return self.valid & (jnp.abs(self.displacement - self.goal) <= tolerance * self.goal)
