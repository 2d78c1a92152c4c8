"""The RL stage: a policy with privileged state learns the task in simulation, one jitted call per iteration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from vatmart_jax.envs import Env, EnvState, TrialStart
from vatmart_jax.envs.observation import relabel
from vatmart_jax.envs.rewards import reward_terms
from vatmart_jax.envs.scripted_policy import scripted_action
from vatmart_jax.errors import UserError
from vatmart_jax.rl.agent import Agent
from vatmart_jax.rl.hindsight import Episode, hindsight
from vatmart_jax.rl.replay_buffer import ReplayBuffer
from vatmart_jax.rl.td3 import TD3, TD3Config
from vatmart_jax.trajectory import WAYPOINTS


@dataclass(frozen=True)
class ExplorationConfig:
    """The RL stage."""

    td3: TD3Config = field(default_factory=TD3Config)
    iterations: int = 120
    """batches of trials"""
    start_pool_size: int = 4096
    """starts known to be free (and to grasp, when pulling) that trials begin at"""
    noise: tuple[float, float] = (0.2, 0.03)
    """exploration noise, share of the action range: first and last iteration, geometric between"""
    random_action_prob: float = 0.1
    """share of uniformly random actions, decaying as the noise does"""
    warmup_iters: int = 4
    """iterations before the policy acts: half of the trials take random actions, half are the scripted policy's"""
    tracking_penalty: float = 1000.0
    """pulling: penalty per unit length that the hand is from where it was sent, see `Env.tracking_error`; the
    paper has none"""
    hindsight_low: float = 0.5
    """relabelled tasks reach down to this share of the smallest task"""


class ExplorationState(struct.PyTreeNode, kw_only=True):
    """What the RL stage carries between iterations; a pytree of arrays."""

    agent: Any  # the state of the agent
    replay: ReplayBuffer
    key: jax.Array
    iteration: jax.Array  # [] int32


class ExplorationLoop:
    """An agent with hindsight on one environment."""

    def __init__(self, env: Env, config: ExplorationConfig, agent: Agent | None = None):
        """agent: default TD3 as `config` has it."""
        self.env, self.config = env, config
        self.agent: Agent = agent or TD3(config.td3, env.observation_size, env.action_size)
        self.train_iteration = jax.jit(self._train_iteration)
        self.rollout = jax.jit(self._rollout, static_argnames="terminate_on_failure")

    def init(self, key: jax.Array) -> ExplorationState:
        """Consumes the key."""
        kt, ks = jax.random.split(key)
        env = self.env
        replay = ReplayBuffer.create(self.config.td3.buffer_size, env.observation_size, env.action_size)
        return ExplorationState(agent=self.agent.init(kt), replay=replay, key=ks, iteration=jnp.zeros((), jnp.int32))

    def _rollout(
        self,
        policy: Any,
        pool: TrialStart | None,
        key: jax.Array,
        *,
        noise: jax.Array | float,
        random: jax.Array | float = 0.0,
        scripted: jax.Array | float = 0.0,
        terminate_on_failure: bool = True,
    ) -> tuple[EnvState, Episode]:
        """One batch of trials; from the pool if there is one, else from random starts. Consumes the key.

        noise: share of the action range; random: share of uniform actions; scripted: share of trials that the
        scripted policy makes, with the same noise. Without `terminate_on_failure` trials that cannot succeed
        are acted out too: perception learns from them.
        """
        kr, ke = jax.random.split(key)
        begun = self.env.reset(kr, pool)
        if not terminate_on_failure:
            begun = begun.replace(done=jnp.zeros_like(begun.done))

        def step(state: EnvState, key: jax.Array):
            kp, kx = jax.random.split(key)
            action = self.agent.explore(policy, state.obs, kp, noise=noise, random=random)
            shown = scripted_action(self.env, state)
            shown = jnp.clip(shown + noise * jax.random.normal(kx, shown.shape), -1, 1)
            action = jnp.where(jnp.arange(len(action))[:, None] < scripted * len(action), shown, action)
            after = self.env.step(state, action, terminate_on_failure=terminate_on_failure)
            cost = self.env.tracking_cost(after, self.config.tracking_penalty)
            record = Episode(
                obs=state.obs,
                action=action,
                reward=after.reward - cost,
                next_obs=after.obs,
                done=after.done,
                active=~state.done & ~after.physics.diverged,
                before=state.displacement,
                after=after.displacement,
                distance=after.info["tip_distance"],
                grasp_held=after.grasp_held,
                cost=cost,
            )
            return after, record

        return jax.lax.scan(step, begun, jax.random.split(ke, WAYPOINTS))

    def _train_iteration(
        self, state: ExplorationState, pool: TrialStart, curiosity
    ) -> tuple[ExplorationState, EnvState, dict]:
        """Trials, storing, hindsight, updates.

        curiosity: None, or a function of the final EnvState that returns a penalty [B] for successful trajectories
        (a `jax.tree_util.Partial`, so that what it closes over is traced). Returns the final EnvState and metrics.
        """
        config, env = self.config, self.env
        key, kr, kh, kl = jax.random.split(state.key, 4)
        progress = jnp.minimum(state.iteration / max(1, config.iterations - 1), 1.0)
        first, last = config.noise
        decay = (last / first) ** progress
        warm = state.iteration < config.warmup_iters
        random = jnp.where(warm, 1.0, config.random_action_prob * decay)
        scripted = jnp.where(warm, 0.5, 0.0)
        policy = self.agent.acting_params(state.agent)
        final, episode = self._rollout(policy, pool, kr, noise=first * decay, random=random, scripted=scripted)
        penalty = jnp.zeros_like(final.reward) if curiosity is None else curiosity(final)
        ended = episode.active & episode.done & final.success
        episode = episode.replace(reward=episode.reward - penalty * ended)
        replay = state.replay.insert(*episode.transitions())
        goals = (config.hindsight_low * env.task.goal_range[0], 1.1 * env.task.goal_range[1])
        copies = hindsight(
            episode, kh, goals=goals, tolerance=env.config.tolerance,
            reward=partial(reward_terms, config=env.config.reward), relabel=relabel, curiosity=penalty,
        )  # fmt: skip
        replay = replay.insert(*copies)
        agent, losses = self.agent.update(state.agent, replay, kl)
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
        return (
            ExplorationState(agent=agent, replay=replay, key=key, iteration=state.iteration + 1),
            final,
            metrics,
        )


def start_pool(env: Env, key: jax.Array, size: int, progress: Callable[[int], None] = lambda done: None) -> TrialStart:
    """`size` starts that are free, grasp when pulling, and leave the longest task's way free. Consumes the key.

    Raises UserError where fewer than one in two hundred random starts will do: the data does not fit the task.
    """

    @jax.jit
    def attempt(key: jax.Array) -> tuple[TrialStart, jax.Array]:
        state = env.reset(key)
        return state.start, state.valid & env.path_is_free(state.start)

    kept: list[TrialStart] = []
    found = tried = 0
    while found < size:
        key, sub = jax.random.split(key)
        start, good = jax.device_get(attempt(sub))  # on the host, where a number of rows is no program of its own
        good = np.flatnonzero(good)
        kept.append(jax.tree.map(lambda x: x[good], start))  # noqa: B023
        found += len(good)
        tried += len(start.view)
        progress(min(found, size))
        if tried >= 20 * env.config.num_envs and found < tried / 200:
            raise UserError(
                f"only {found} of {tried} random starts of task {env.task.name} are free, hold and have a free way: "
                "the objects do not fit the gripper; look at the conversion's report"
            )
    return jax.tree.map(lambda *parts: jnp.asarray(np.concatenate(parts)[:size]), *kept)
