"""How fast the perception networks are here: training steps, grouping and encoding of a view."""

from __future__ import annotations

import os
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vatmart_jax.bench.common import SceneSubset, device, peak_memory, timed
from vatmart_jax.errors import require_one_of
from vatmart_jax.perception import trainer as perception
from vatmart_jax.perception.config import TaskSpec
from vatmart_jax.perception.grouped_views import group_views
from vatmart_jax.perception.interaction_buffer import Interactions
from vatmart_jax.perception.networks import Networks
from vatmart_jax.pipeline.presets import PRESETS
from vatmart_jax.trajectory import TRAJECTORY

group_view = jax.jit(lambda points, queries, config: config.build().prepare(points, queries), static_argnums=2)


def bench_perception(subset: SceneSubset, *, preset: str, seed: int, seconds: float) -> dict[str, Any]:
    """Training steps per second of each stage, and how long one view of 10,000 points takes to group and to encode."""
    require_one_of("preset", preset, PRESETS)
    config = replace(PRESETS[preset].perception, log_every=5)
    networks, encoder = Networks(config.networks), config.networks.encoder
    rng = np.random.default_rng(seed)
    _, views = subset.banks(seed)
    views = views.select(rng.permutation(len(views))[: 2 * config.views_per_batch])
    views = replace(views, points=_with_points(rng, views.points, max(10_000, encoder.n_points)))
    upright = jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0]), (len(views), 3))
    grouped_views = replace(group_views(views, encoder), joints=(upright, jnp.zeros((len(views), 3))))
    rows = 4 * config.views_per_batch * config.samples_per_view
    spec = TaskSpec(goal_range=(0.1, 0.7), tolerance=0.15, relabel_range=0.45, slides=False)
    samples = Interactions(
        view=jnp.asarray(rng.integers(0, len(views), rows), jnp.int32),
        contact=jnp.asarray(rng.integers(0, views.contacts.shape[1], rows), jnp.int32),
        goal=jnp.asarray(rng.uniform(*spec.goal_range, rows), jnp.float32),
        trajectory=jnp.asarray(rng.normal(size=(rows, TRAJECTORY)), jnp.float32),
        displacement=jnp.asarray(rng.uniform(*spec.goal_range, rows), jnp.float32),
        valid=jnp.ones(rows, bool),
        from_proposal=jnp.zeros(rows, bool),
    )
    state = perception.init_state(jax.random.key(seed), config)
    steps = partial(perception.train, state, grouped_views, samples, config, spec, steps=config.log_every)
    trained = [stage for stage in perception.STAGES.names() if stage != "flow" or config.networks.flow_hidden]
    stages = {stage: timed(lambda _, stage=stage: steps(stage=stage), seconds) for stage in trained}

    points, queries = (jnp.asarray(x[0], jnp.float32) for x in (views.points[:, :10_000], views.contacts))
    point_groups = timed(lambda _: group_view(points, queries, encoder), seconds)
    encode = jax.jit(networks.features)
    encoding = timed(lambda _: encode(state.params, points, point_groups.result), seconds)
    return {
        "preset": preset,
        "training_points": encoder.n_points,
        "views_per_step": config.views_per_batch,
        "samples_per_step": config.views_per_batch * config.samples_per_view,
        "parameters": sum(x.size for x in jax.tree.leaves(state.params)),
        "steps_per_second": {name: round(config.log_every / t.seconds, 3) for name, t in stages.items()},
        "encode_points": len(points),
        "group_seconds": round(point_groups.seconds, 4),
        "encode_seconds": round(encoding.seconds, 4),
        "compile_seconds": {name: round(t.compile_seconds, 1) for name, t in stages.items()},
        "peak_memory_mb": round(peak_memory() / 2**20),
        "seed": seed,
        "device": device(),
        "load": round(os.getloadavg()[0], 1),
    }


def _with_points(rng: np.random.Generator, points: np.ndarray, n: int) -> np.ndarray:
    """Clouds [V, N, 3] with at least n points; what is missing is drawn near the points there are."""
    missing = max(0, n - points.shape[1])
    near = points[:, rng.integers(0, points.shape[1], missing)]
    return np.concatenate([points, (near + rng.normal(scale=2e-3, size=near.shape)).astype(points.dtype)], 1)
