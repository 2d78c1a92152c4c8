"""A replay buffer on device."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct


class Transition(struct.PyTreeNode, kw_only=True):
    """N steps."""

    obs: jax.Array  # [N, 33]
    action: jax.Array  # [N, 6]
    reward: jax.Array  # [N]
    next_obs: jax.Array  # [N, 33]
    done: jax.Array  # [N] float, 1 where nothing follows


class ReplayBuffer(struct.PyTreeNode):
    """A ring of the last `capacity` steps."""

    data: Transition  # [capacity, ...]
    inserted: jax.Array  # [] int32, ever

    @classmethod
    def create(cls, capacity: int, observation: int, action: int) -> ReplayBuffer:
        zeros = jnp.zeros
        data = Transition(
            obs=zeros((capacity, observation)),
            action=zeros((capacity, action)),
            reward=zeros(capacity),
            next_obs=zeros((capacity, observation)),
            done=zeros(capacity),
        )
        return cls(data, jnp.zeros((), jnp.int32))

    @property
    def capacity(self) -> int:
        return self.data.reward.shape[0]

    def insert(self, steps: Transition, keep: jax.Array) -> ReplayBuffer:
        """Store the steps with keep [N] true; where they exceed the capacity, the last ones stay."""
        order = jnp.cumsum(keep) - 1
        count = jnp.sum(keep)
        stored = keep & (order >= count - self.capacity)
        rows = jnp.where(stored, (self.inserted + order) % self.capacity, self.capacity)
        data = jax.tree.map(lambda ring, new: ring.at[rows].set(new, mode="drop"), self.data, steps)
        return ReplayBuffer(data, self.inserted + count)

    def sample(self, key: jax.Array, n: int) -> Transition:
        """n steps, uniform with replacement. Consumes the key."""
        filled = jnp.clip(self.inserted, 1, self.capacity)
        rows = jax.random.randint(key, (n,), 0, filled)
        return jax.tree.map(lambda ring: ring[rows], self.data)
