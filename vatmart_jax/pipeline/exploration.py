"""The RL stage: a TD3 policy with privileged state learns the task in simulation, one jitted call per iteration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from vatmart_jax.envs.env import ACTION, OBSERVATION, Env, EnvState, Start, reward_terms
from vatmart_jax.envs.scripted_policy import expert_action
from vatmart_jax.errors import UserError
from vatmart_jax.rl.replay_buffer import Episode, Replay, hindsight
from vatmart_jax.rl.td3 import TD3, TD3Config, TD3State
from vatmart_jax.trajectory import WAYPOINTS


@dataclass(frozen=True)
class ExploreConfig:
    """The RL stage."""

    td3: TD3Config = field(default_factory=TD3Config)
    iterations: int = 120
    """batches of trials"""
    pool: int = 4096
    """starts known to be free (and to grasp, when pulling) that trials begin at"""
    noise: tuple[float, float] = (0.2, 0.03)
    """exploration noise, share of the action range: first and last iteration, geometric between"""
    random: float = 0.1
    """share of uniformly random actions, decaying as the noise does"""
    warmup: int = 4
    """iterations before the policy acts: half of the trials take random actions, half are the scripted expert's"""
    strain: float = 1000.0
    """pulling: penalty per unit length that the hand is from where it was sent, see `Env.strain`; the paper has none"""
    hindsight_low: float = 0.5
    """relabelled tasks reach down to this share of the smallest task"""


@struct.dataclass
class ExploreState:
    """What the RL stage carries between iterations; a pytree of arrays."""

    td3: TD3State
    replay: Replay
    key: jax.Array
    iteration: jax.Array  # [] int32


class Explorer:
    """TD3 with hindsight on one environment."""

    def __init__(self, env: Env, config: ExploreConfig):
        self.env, self.config = env, config
        self.td3 = TD3(config.td3, OBSERVATION, ACTION)
        self.iterate = jax.jit(self._iterate)
        self.run = jax.jit(self._run, static_argnames="abandon")

    def init(self, key: jax.Array) -> ExploreState:
        """Consumes the key."""
        kt, ks = jax.random.split(key)
        replay = Replay.create(self.config.td3.capacity, OBSERVATION, ACTION)
        return ExploreState(self.td3.init(kt), replay, ks, jnp.zeros((), jnp.int32))

    def _run(
        self, policy, pool: Start | None, key: jax.Array, noise, random, expert: Any = 0.0, abandon: bool = True
    ) -> tuple[EnvState, Episode]:
        """One batch of trials; from the pool if there is one, else from random starts. Consumes the key.

        noise: share of the action range; random: share of uniform actions; expert: share of trials that the scripted
        expert makes, with the same noise. Without `abandon` trials that cannot succeed are acted out too: perception
        learns from them.
        """
        kr, ke = jax.random.split(key)
        begun = self.env.reset(kr, pool)
        if not abandon:
            begun = begun.replace(done=jnp.zeros_like(begun.done))

        def step(state: EnvState, key: jax.Array):
            kp, kx = jax.random.split(key)
            action = self.td3.explore(policy, state.obs, kp, noise, random)
            shown = expert_action(self.env, state)
            shown = jnp.clip(shown + noise * jax.random.normal(kx, shown.shape), -1, 1)
            action = jnp.where(jnp.arange(len(action))[:, None] < expert * len(action), shown, action)
            after = self.env.step(state, action, abandon)
            cost = self.config.strain * self.env.task.opening * self.env.strain(after)
            record = Episode(
                state.obs, action, after.reward - cost, after.obs, after.done, ~state.done & ~after.physics.diverged,
                state.moved, after.moved, after.info["tip_distance"], after.held, cost,
            )  # fmt: skip
            return after, record

        return jax.lax.scan(step, begun, jax.random.split(ke, WAYPOINTS))

    def _iterate(self, state: ExploreState, pool: Start, curiosity) -> tuple[ExploreState, EnvState, dict]:
        """Trials, storing, hindsight, updates.

        curiosity: None, or a function of the final EnvState that returns a penalty [B] for successful trajectories
        (a `jax.tree_util.Partial`, so that what it closes over is traced). Returns the final EnvState and metrics.
        """
        config, env = self.config, self.env
        key, kr, kh, kl = jax.random.split(state.key, 4)
        progress = jnp.minimum(state.iteration / max(1, config.iterations - 1), 1.0)
        first, last = config.noise
        decay = (last / first) ** progress
        warm = state.iteration < config.warmup
        random = jnp.where(warm, 1.0, config.random * decay)
        expert = jnp.where(warm, 0.5, 0.0)
        final, episode = self._run(state.td3.policy, pool, kr, first * decay, random, expert)
        penalty = jnp.zeros_like(final.reward) if curiosity is None else curiosity(final)
        ended = episode.active & episode.done & final.success
        episode = episode.replace(reward=episode.reward - penalty * ended)
        replay = state.replay.insert(*episode.transitions())
        goals = (config.hindsight_low * env.task.low, 1.1 * env.task.high)
        replay = replay.insert(*hindsight(episode, kh, goals, env.config.tolerance, reward_terms, penalty))
        td3, losses = self.td3.learn(state.td3, replay, kl)
        made = episode.active.sum()
        metrics = {
            "success": final.success.sum() / jnp.maximum(final.valid.sum(), 1),
            "valid": final.valid.mean(),
            "diverged": final.physics.diverged.sum(),
            "reward": jnp.where(episode.active, episode.reward, 0).sum() / jnp.maximum(made, 1),
            "tip_distance": jnp.where(episode.active, episode.distance, 0).sum() / jnp.maximum(made, 1),
            "waypoints": made / jnp.maximum(final.valid.sum(), 1),
            "curiosity": (penalty * final.success).sum() / jnp.maximum(final.success.sum(), 1),
            **losses,
        }
        return ExploreState(td3, replay, key, state.iteration + 1), final, metrics


def start_pool(env: Env, key: jax.Array, size: int, progress: Callable[[int], None] = lambda done: None) -> Start:
    """`size` starts that are free, grasp when pulling, and leave the longest task's way free. Consumes the key.

    Raises UserError where fewer than one in two hundred random starts will do: the data does not fit the task.
    """

    @jax.jit
    def attempt(key: jax.Array) -> tuple[Start, jax.Array]:
        state = env.reset(key)
        return state.start, state.valid & env.leaves_way(state.start)

    kept: list[Start] = []
    found = tried = 0
    while found < size:
        key, sub = jax.random.split(key)
        start, good = attempt(sub)
        good = jnp.flatnonzero(good)
        kept.append(jax.tree.map(lambda x: x[good], start))  # noqa: B023
        found += len(good)
        tried += len(start.view)
        progress(min(found, size))
        if tried >= 20 * env.config.batch and found < tried / 200:
            raise UserError(
                f"only {found} of {tried} random starts of task {env.task.name} are free, hold and have a free way: "
                "the objects do not fit the gripper; look at the conversion's report"
            )
    return jax.tree.map(lambda *parts: jnp.concatenate(parts)[:size], *kept)
