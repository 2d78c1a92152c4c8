"""What encoders and heads are built of."""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax

Params = dict[str, Any]
"""Flax parameters by name: those of one network, or of all networks by the networks' names."""


def apply(module: nn.Module, params: Params, *inputs: Any, **options: Any) -> jax.Array:
    """The output of a module that has parameters only, and one array to return."""
    output: Any = module.apply({"params": params}, *inputs, **options)
    return output


def init(module: nn.Module, key: jax.Array, *inputs: Any, **options: Any) -> Params:
    """A module's initial parameters; they follow from the key and the names of the modules within. Consumes the key."""
    variables: Any = module.init(key, *inputs, **options)
    return variables["params"]


def flatten_last_two(x: jax.Array) -> jax.Array:
    """[..., a, b] -> [..., a b]."""
    return x.reshape(*x.shape[:-2], x.shape[-2] * x.shape[-1])


class SharedMLP(nn.Module):
    """Dense layers with ReLU, the same for every point [..., d] -> [..., widths[-1]].

    Without normalisation: batch statistics would be mutable state and tie a view's features to its batch, and layer
    normalisation took a quarter more time here and learned no better.
    """

    widths: tuple[int, ...]

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        for width in self.widths:
            x = nn.relu(nn.Dense(width, kernel_init=nn.initializers.he_normal())(x))
        return x
