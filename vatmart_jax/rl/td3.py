"""TD3 (Fujimoto et al. 2018): twin critics as one vmapped ensemble, target smoothing, delayed policy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import optax
from flax import struct

from vatmart_jax.rl.networks import Critic, Policy
from vatmart_jax.rl.replay_buffer import ReplayBuffer, Transition


@dataclass(frozen=True)
class TD3Config:
    """Defaults found by measuring (docs/learning.md); the `paper` preset has the paper's."""

    hidden: int = 512
    batch_size: int = 256
    learning_rate: float = 3e-4
    discount: float = 0.9
    tau: float = 0.01
    policy_delay: int = 2
    target_noise: float = 0.1
    target_noise_clip: float = 0.2
    reward_scale: float = 0.01
    """rewards of hundreds make values of hundreds, which Adam reaches slowly"""
    pre_tanh_l2: float = 0.01
    """penalty for the squares of what actions are the tanh of: where that is large, no gradient comes back and the
    policy is stuck for good; the paper has 0"""
    buffer_size: int = 100_000
    grad_steps_per_iter: int = 64
    """gradient steps per batch of trials"""


class TD3State(struct.PyTreeNode):
    """Everything that training carries; a pytree of arrays."""

    policy: Any
    critics: Any  # leading axis 2
    target_policy: Any  # running mean of the policy; what a run keeps
    target_critics: Any
    policy_opt: optax.OptState
    critic_opt: optax.OptState
    updates: jax.Array  # [] int32


class TD3:
    """The agent `td3`: functions of TD3State."""

    name: ClassVar[str] = "td3"
    config_type: ClassVar[type] = TD3Config

    def __init__(self, config: TD3Config, observation_size: int, action_size: int):
        self.config, self.observation_size, self.action_size = config, observation_size, action_size
        self._policy, self._critic = Policy(config.hidden, action_size), Critic(config.hidden)
        self._optimizer = optax.adam(config.learning_rate)

    def init(self, key: jax.Array) -> TD3State:
        """Consumes the key."""
        kp, kc = jax.random.split(key)
        obs, action = (jnp.zeros((1, n)) for n in (self.observation_size, self.action_size))
        policy = self._policy.init(kp, obs)
        critics = jax.vmap(lambda k: self._critic.init(k, obs, action))(jax.random.split(kc, 2))
        opt = self._optimizer
        return TD3State(policy, critics, policy, critics, opt.init(policy), opt.init(critics), jnp.zeros((), jnp.int32))

    def act(self, policy: Any, obs: jax.Array) -> jax.Array:
        """[B, 33] -> [B, 6] in [-1, 1]."""
        return jnp.tanh(self._raw(policy, obs))

    def acting_params(self, state: TD3State) -> Any:
        """The policy of the last step."""
        return state.policy

    def policy_params(self, state: TD3State) -> Any:
        """The running mean of the policy, which succeeds more often than the last step."""
        return state.target_policy

    def _raw(self, policy: Any, obs: jax.Array) -> jax.Array:
        return self._policy.apply(policy, obs)  # pyright: ignore[reportReturnType]

    def explore(
        self, policy: Any, obs: jax.Array, key: jax.Array, *, noise: jax.Array | float, random: jax.Array | float
    ) -> jax.Array:
        """Actions with Gaussian noise (share of the range); a share `random` of them uniform. Consumes the key."""
        kn, ku, kr = jax.random.split(key, 3)
        action = self.act(policy, obs)
        action = jnp.clip(action + noise * jax.random.normal(kn, action.shape), -1, 1)
        uniform = jax.random.uniform(ku, action.shape, minval=-1.0)
        return jnp.where(jax.random.uniform(kr, (len(obs), 1)) < random, uniform, action)

    def update(self, state: TD3State, replay: ReplayBuffer, key: jax.Array) -> tuple[TD3State, dict[str, jax.Array]]:
        """`grad_steps_per_iter` gradient steps on the critics, one in `policy_delay` on the policy too. Consumes the
        key."""

        def step(state, key):
            ks, kn = jax.random.split(key)
            return self.gradient_step(state, replay.sample(ks, self.config.batch_size), kn)

        state, metrics = jax.lax.scan(step, state, jax.random.split(key, self.config.grad_steps_per_iter))
        return state, jax.tree.map(jnp.mean, metrics)

    def _value(self, critic: Any, obs: jax.Array, action: jax.Array) -> jax.Array:
        return self._critic.apply(critic, obs, action)  # pyright: ignore[reportReturnType]

    def values(self, critics: Any, obs: jax.Array, action: jax.Array) -> jax.Array:
        """[2, ...] of both critics."""
        value = lambda critic: self._value(critic, obs, action)
        return jax.vmap(value)(critics)

    def gradient_step(
        self, state: TD3State, steps: Transition, key: jax.Array
    ) -> tuple[TD3State, dict[str, jax.Array]]:
        """One step on the critics and, where its turn is, on the policy. Consumes the key."""
        config = self.config
        noise = jax.random.normal(key, steps.action.shape) * config.target_noise
        noise = jnp.clip(noise, -config.target_noise_clip, config.target_noise_clip)
        next_action = jnp.clip(self.act(state.target_policy, steps.next_obs) + noise, -1, 1)
        next_value = self.values(state.target_critics, steps.next_obs, next_action).min(0)
        target = config.reward_scale * steps.reward + config.discount * (1 - steps.done) * next_value

        def critic_loss(critics):
            return jnp.mean((self.values(critics, steps.obs, steps.action) - target) ** 2)

        loss, grads = jax.value_and_grad(critic_loss)(state.critics)
        changes, critic_opt = self._optimizer.update(grads, state.critic_opt)
        critics = optax.apply_updates(state.critics, changes)
        state = state.replace(critics=critics, critic_opt=critic_opt, updates=state.updates + 1)

        def policy_update(state: TD3State) -> TD3State:
            first = jax.tree.map(lambda x: x[0], state.critics)

            def policy_loss(policy):
                raw = self._raw(policy, steps.obs)
                value = self._value(first, steps.obs, jnp.tanh(raw))
                return config.pre_tanh_l2 * jnp.mean(raw**2) - jnp.mean(value)

            grads = jax.grad(policy_loss)(state.policy)
            changes, policy_opt = self._optimizer.update(grads, state.policy_opt)
            policy = optax.apply_updates(state.policy, changes)
            follow = lambda target, new: optax.incremental_update(new, target, config.tau)
            return state.replace(
                policy=policy,
                policy_opt=policy_opt,
                target_policy=follow(state.target_policy, policy),
                target_critics=follow(state.target_critics, state.critics),
            )

        state = jax.lax.cond(state.updates % config.policy_delay == 0, policy_update, lambda s: s, state)
        return state, {"critic_loss": loss, "value": jnp.mean(target)}
