"""Hindsight relabelling of whole batches of trials: what a trial did not do for its own goal it did for another."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct

from vatmart_jax.rl.replay_buffer import Transition

Relabel = Callable[[jax.Array, jax.Array, jax.Array], jax.Array]
"""(obs [..., O], goal [...], displacement [...]) -> the observations as they were for that goal."""


class Episode(struct.PyTreeNode, kw_only=True):
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
    grasp_held: jax.Array  # [K, B] bool, after the step
    cost: jax.Array  # [K, B] taken off the reward, whatever the task

    def transitions(self) -> tuple[Transition, jax.Array]:
        """All K * B steps and which were made."""
        steps = Transition(
            obs=self.obs,
            action=self.action,
            reward=self.reward,
            next_obs=self.next_obs,
            done=self.done.astype(jnp.float32),
        )
        return jax.tree.map(_flat, steps), _flat(self.active)


def hindsight(
    episode: Episode,
    key: jax.Array,
    *,
    goals: tuple[float, float],
    tolerance: float,
    reward: Callable[..., dict[str, jax.Array]],
    relabel: Relabel,
    curiosity: jax.Array,
) -> tuple[Transition, jax.Array]:
    """One relabelled copy of every step: the goal becomes what some step from this one on achieved (Andrychowicz 2017).

    goals: (smallest, largest) goal that is worth learning; reward: terms of (goal, before, after, distance, success);
    relabel: the environment's, which writes another goal into observations; curiosity: [B] penalty, taken off
    relabelled successes as off real ones. Returns K * B steps and which to keep. Consumes the key.
    """
    steps, batch = episode.active.shape
    left = jnp.flip(jnp.cumsum(jnp.flip(episode.active, 0), 0), 0)  # steps made from this one on
    ahead = jnp.floor(jax.random.uniform(key, (steps, batch)) * left).astype(jnp.int32)
    future = jnp.minimum(jnp.arange(steps)[:, None] + ahead, steps - 1)
    goal = jnp.take_along_axis(episode.after, future, 0)
    keep = episode.active & episode.grasp_held & (goal >= goals[0]) & (goal <= goals[1]) & (episode.before < goal)
    success = (jnp.abs(goal - episode.after) <= tolerance * goal) & episode.grasp_held
    terms = reward(goal, episode.before, episode.after, episode.distance, success)
    total = sum(terms.values()) - episode.cost - curiosity * success
    last = jnp.arange(steps)[:, None] == steps - 1
    copies = Transition(
        obs=relabel(episode.obs, goal, episode.before),
        action=episode.action,
        reward=total,
        next_obs=relabel(episode.next_obs, goal, episode.after),
        done=(success | last | ~episode.grasp_held).astype(jnp.float32),
    )
    return jax.tree.map(_flat, copies), _flat(keep)


def _flat(x: jax.Array) -> jax.Array:
    return x.reshape(-1, *x.shape[2:])
