"""Policy and critics: the paper's multi-layer perceptrons (appendix A.1)."""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp

# The last layers begin near zero, as in TD3's reference settings: first actions are small, first values unbiased.
_LAST = nn.initializers.uniform(6e-3)


def _last(key, shape, dtype=jnp.float32):
    return _LAST(key, shape, dtype) - 3e-3


class Policy(nn.Module):
    """[..., 33] -> [..., 6], of which actions in [-1, 1] are the tanh: four hidden layers. The paper's variance head is
    unused by TD3."""

    hidden: int = 512
    actions: int = 6

    @nn.compact
    def __call__(self, obs: jax.Array) -> jax.Array:
        x = obs
        for _ in range(4):
            x = nn.relu(nn.Dense(self.hidden)(x))
        return nn.Dense(self.actions, kernel_init=_last)(x)


class Critic(nn.Module):
    """[..., 33] and [..., 6] -> value [...]: three hidden layers."""

    hidden: int = 512

    @nn.compact
    def __call__(self, obs: jax.Array, action: jax.Array) -> jax.Array:
        x = jnp.concatenate([obs, action], -1)
        for _ in range(3):
            x = nn.relu(nn.Dense(self.hidden)(x))
        return nn.Dense(1, kernel_init=_last)(x)[..., 0]
