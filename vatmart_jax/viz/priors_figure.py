"""Figures of what priors predict in the views of an environment."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from vatmart_jax.envs import Env
from vatmart_jax.priors import Priors
from vatmart_jax.viz import plots

_NUM_FIGURES = 6


def draw_priors(priors: Priors, env: Env, key: jax.Array, out: Path) -> None:
    """Heat map and proposals for a few views of different objects: priors_0.png and so on in `out`.

    Consumes the key."""
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    order = rng.permutation(len(env.views))
    scenes = env.views.scene[order]
    first_of_object = np.sort(np.unique(env.bank.object_id[scenes], return_index=True)[1])
    chosen = order[first_of_object][:_NUM_FIGURES]
    goals = env.sample_goal(key, jnp.asarray(chosen, jnp.int32))
    for number, (view, goal) in enumerate(zip(chosen.tolist(), np.asarray(goals).tolist(), strict=True)):
        points, mask = env.views.points[view].astype(np.float32), env.views.part_mask[view]
        if not mask.any():
            continue
        predicted = priors.predict(points, goal, mask, key=jax.random.fold_in(key, number))
        scene = env.views.scene[view]
        what = f"{env.bank.category[scene]} {env.bank.object_id[scene]}"
        plots.priors_figure(
            out / f"priors_{number}.png",
            points=points,
            part_mask=mask,
            actionability=predicted.actionability,
            contact=predicted.contact,
            trajectories=predicted.trajectories[:3],
            scores=predicted.scores[:3],
            camera=env.views.camera(view),
            title=f"{env.task.name} by {env.task.format_goal(goal)}: {what}",
            standoff=env.config.standoff,
        )
