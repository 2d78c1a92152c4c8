"""A replay buffer on device, and hindsight relabelling of whole batches of trials."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct


@struct.dataclass
class Transition:
    """N steps."""

    obs: jax.Array  # [N, 33]
    action: jax.Array  # [N, 6]
    reward: jax.Array  # [N]
    next_obs: jax.Array  # [N, 33]
    done: jax.Array  # [N] float, 1 where nothing follows


@struct.dataclass
class Replay:
    """A ring of the last `capacity` steps."""

    data: Transition  # [capacity, ...]
    inserted: jax.Array  # [] int32, ever

    @classmethod
    def create(cls, capacity: int, observation: int, action: int) -> Replay:
        zeros = jnp.zeros
        data = Transition(
            zeros((capacity, observation)), zeros((capacity, action)), zeros(capacity),
            zeros((capacity, observation)), zeros(capacity),
        )  # fmt: skip
        return cls(data, jnp.zeros((), jnp.int32))

    @property
    def capacity(self) -> int:
        return self.data.reward.shape[0]

    def insert(self, steps: Transition, keep: jax.Array) -> Replay:
        """Store the steps with keep [N] true; where they exceed the capacity, the last ones stay."""
        order = jnp.cumsum(keep) - 1
        count = jnp.sum(keep)
        stored = keep & (order >= count - self.capacity)
        rows = jnp.where(stored, (self.inserted + order) % self.capacity, self.capacity)
        data = jax.tree.map(lambda ring, new: ring.at[rows].set(new, mode="drop"), self.data, steps)
        return Replay(data, self.inserted + count)

    def sample(self, key: jax.Array, n: int) -> Transition:
        """n steps, uniform with replacement. Consumes the key."""
        filled = jnp.clip(self.inserted, 1, self.capacity)
        rows = jax.random.randint(key, (n,), 0, filled)
        return jax.tree.map(lambda ring: ring[rows], self.data)


@struct.dataclass
class Episode:
    """B trials of K steps, time first."""

    obs: jax.Array  # [K, B, 33]
    action: jax.Array  # [K, B, 6]
    reward: jax.Array  # [K, B]
    next_obs: jax.Array  # [K, B, 33]
    done: jax.Array  # [K, B] bool, after the step
    active: jax.Array  # [K, B] bool, the step was made
    before: jax.Array  # [K, B] how far the part had moved before the step
    after: jax.Array  # [K, B] and after it
    distance: jax.Array  # [K, B] fingertips to contact, after the step
    held: jax.Array  # [K, B] bool, after the step
    cost: jax.Array  # [K, B] taken off the reward, whatever the task

    def transitions(self) -> tuple[Transition, jax.Array]:
        """All K * B steps and which were made."""
        steps = Transition(self.obs, self.action, self.reward, self.next_obs, self.done.astype(jnp.float32))
        return jax.tree.map(_flat, steps), _flat(self.active)


def hindsight(
    episode: Episode,
    key: jax.Array,
    goals: tuple[float, float],
    tolerance: float,
    reward: Callable[..., dict[str, jax.Array]],
    curiosity: jax.Array,
) -> tuple[Transition, jax.Array]:
    """One relabelled copy of every step: the task becomes what some step from this one on achieved (Andrychowicz 2017).

    goals: (smallest, largest) task that is worth learning; reward: terms of (task, before, after, distance, success);
    curiosity: [B] penalty, taken off relabelled successes as off real ones. Observation entries 1 and 2 are the task
    and what is left of it. Returns K * B steps and which to keep. Consumes the key.
    """
    steps, batch = episode.active.shape
    left = jnp.flip(jnp.cumsum(jnp.flip(episode.active, 0), 0), 0)  # steps made from this one on
    ahead = jnp.floor(jax.random.uniform(key, (steps, batch)) * left).astype(jnp.int32)
    future = jnp.minimum(jnp.arange(steps)[:, None] + ahead, steps - 1)
    goal = jnp.take_along_axis(episode.after, future, 0)
    keep = episode.active & episode.held & (goal >= goals[0]) & (goal <= goals[1]) & (episode.before < goal)
    success = (jnp.abs(goal - episode.after) <= tolerance * goal) & episode.held
    terms = reward(goal, episode.before, episode.after, episode.distance, success)
    total = sum(terms.values()) - episode.cost - curiosity * success
    relabel = lambda obs, moved: obs.at[..., 1].set(goal).at[..., 2].set(goal - moved)  # noqa: E731
    last = jnp.arange(steps)[:, None] == steps - 1
    copies = Transition(
        relabel(episode.obs, episode.before),
        episode.action,
        total,
        relabel(episode.next_obs, episode.after),
        (success | last | ~episode.held).astype(jnp.float32),
    )
    return jax.tree.map(_flat, copies), _flat(keep)


def _flat(x: jax.Array) -> jax.Array:
    return x.reshape(-1, *x.shape[2:])
