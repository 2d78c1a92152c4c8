"""Muon by shapes of matrices against optax's, parameter by parameter."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import optax
from optax.contrib import muon

from vatmart_jax.perception.optimizer import make_optimizer


def test_muon_is_that_of_optax():
    shapes = {"a": (5, 3), "b": (3, 5), "c": (5,), "d": (7, 7), "e": (), "f": (3, 5)}
    keys = jax.random.split(jax.random.key(0), len(shapes))
    params = {name: jax.random.normal(key, shapes[name]) for name, key in zip(shapes, keys, strict=True)}
    ours = make_optimizer(use_muon=True, weight_decay=1e-4)
    theirs = optax.chain(
        optax.clip_by_global_norm(1.0), muon(-1.0, consistent_rms=0.5), optax.add_decayed_weights(1e-4)
    )
    states = [optimizer.init(params) for optimizer in (ours, theirs)]
    for step in range(4):
        gradients = jax.tree.map(lambda x, step=step: jnp.sin(x * (step + 1)), params)
        updates, states = zip(
            *(o.update(gradients, s, params) for o, s in zip((ours, theirs), states, strict=True)), strict=True
        )
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=2e-6), *updates)
