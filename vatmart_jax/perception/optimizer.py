"""The optimizers of the perception networks: Adam, as in the paper, or Muon."""

from __future__ import annotations

import math
from collections import defaultdict
from typing import Any

import jax
import jax.numpy as jnp
import optax
from optax.contrib import MuonDimensionNumbers, muon

# optax's own five Newton-Schulz steps, given one by one: as a loop they compile in a fraction of the time.
_NEWTON_SCHULZ = ((3.4445, -4.7750, 2.0315),) * 5
_REST = "rest"


def make_optimizer(*, use_muon: bool, weight_decay: float) -> optax.GradientTransformation:
    """Its updates are to be subtracted, times the learning rate.

    One for all networks of a stage and not optax.partition: gradients are clipped by the norm over all of them.
    """
    clip, decay = optax.clip_by_global_norm(1.0), optax.add_decayed_weights(weight_decay)
    if use_muon:
        return optax.chain(clip, _muon(), decay)
    # As one vector: an update per parameter compiles twice as long.
    return optax.flatten(optax.chain(clip, optax.scale_by_adam(), decay))


def _muon() -> optax.GradientTransformation:
    """Muon for matrices, all of one shape (or its transpose: Newton-Schulz does not tell them apart) as one array;
    Adam for the rest, as one vector. So a program has one update for each shape and not for each parameter."""

    def dimensions(packed: Any) -> Any:
        return {name: None if name == _REST else MuonDimensionNumbers(1, 2) for name in packed}

    # It subtracts by itself, hence -1. Adam's updates have an RMS of 1 at first, of about 0.2 later.
    inner = muon(-1.0, ns_coeffs=_NEWTON_SCHULZ, consistent_rms=0.5, muon_weight_dimension_numbers=dimensions)

    def update(updates: Any, state: optax.OptState, params: Any = None) -> tuple[Any, optax.OptState]:
        packed: Any
        packed, state = inner.update(_pack(updates), state, None if params is None else _pack(params))
        return _unpack(packed, updates), state

    return optax.GradientTransformation(lambda params: inner.init(_pack(params)), update)


def _groups(leaves: list[jax.Array]) -> dict[str, list[int]]:
    """The leaves of each packed array."""
    groups: dict[str, list[int]] = defaultdict(list)
    for i, leaf in enumerate(leaves):
        groups["{}x{}".format(*sorted(leaf.shape)) if leaf.ndim == 2 else _REST].append(i)
    return groups


def _pack(tree: optax.Params) -> dict[str, jax.Array]:
    """[n, a, b] with a <= b of all matrices of a shape, and a vector of everything else."""
    leaves = jax.tree.leaves(tree)
    wide = lambda x: x if x.shape[0] <= x.shape[1] else x.T
    return {
        name: jnp.concatenate([leaves[i].ravel() for i in members])
        if name == _REST
        else jnp.stack([wide(leaves[i]) for i in members])
        for name, members in _groups(leaves).items()
    }


def _unpack(packed: dict[str, jax.Array], like: optax.Params) -> optax.Params:
    leaves, treedef = jax.tree.flatten(like)
    for name, members in _groups(leaves).items():
        if name == _REST:
            sizes = [math.prod(leaves[i].shape) for i in members]
            ends = [sum(sizes[: k + 1]) for k in range(len(sizes))]
            found = [packed[name][end - size : end] for size, end in zip(sizes, ends, strict=True)]
            found = [x.reshape(leaves[i].shape) for i, x in zip(members, found, strict=True)]
        else:
            found = [x if x.shape == leaves[i].shape else x.T for i, x in zip(members, packed[name], strict=True)]
        for i, x in zip(members, found, strict=True):
            leaves[i] = x
    return jax.tree.unflatten(treedef, leaves)
