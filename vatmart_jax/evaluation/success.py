"""Success downstream: what a method chooses is executed, open loop, on objects that it has not seen.

Strict: success is the part's value at the END of the trajectory within tolerance; a start in collision or a lost grip
is a failure; nothing leaves the denominator. The released code's looser definition (it stops at the first waypoint
within tolerance) is reported beside it as `success_any_waypoint`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vatmart_jax.envs import Env, TrialStart
from vatmart_jax.evaluation.methods.base import Method, MethodOutput
from vatmart_jax.evaluation.metrics import reliability, wilson_interval

ALIASES = {"grasp_lost": "lost_grip", "grasp_failed": "no_grasp", "predicted": "said"}
"""JSON keys -> the names that version 0.1 gave them, which stay."""


def evaluate_success(
    env: Env, method: Method, trials: int, key: jax.Array, on_progress: Callable[[int], None] = lambda done: None
) -> dict[str, Any]:
    """Success of a method over `trials` random views and goals; the same ones for every method with the same key.

    `grasp_lost` counts trials that do not hold the part in the end; `grasp_failed` those of them that never did.
    Of a method that predicts its success also the mean prediction (`predicted`) and the reliability curve.

    Consumes the key.
    """
    rows: list[dict[str, np.ndarray]] = []
    for batch in range(-(-trials // env.config.num_envs)):
        k_sample, k_method = jax.random.split(jax.random.fold_in(key, batch))
        rows.append(jax.device_get(_outcome(env, method(_sample(env, k_sample), k_method))))
        on_progress(min(trials, (batch + 1) * env.config.num_envs))
    joined = {name: np.concatenate([row[name] for row in rows])[:trials] for name in rows[0]}
    objects = env.bank.object_id[joined.pop("scene")]
    per_object = {str(name): round(float(joined["success"][objects == name].mean()), 3) for name in np.unique(objects)}
    rates: dict[str, Any] = {name: float(value.mean()) for name, value in joined.items()}
    rates |= {old: rates[new] for new, old in ALIASES.items() if new in rates}
    if "predicted" in joined:
        rates["reliability"] = reliability(joined["predicted"], joined["success"]).to_json()
    interval = list(wilson_interval(int(joined["success"].sum()), trials))
    return {"trials": trials, "ci95": interval, **rates, "per_object": per_object}


@jax.jit
def _sample(env: Env, key: jax.Array) -> TrialStart:
    return env.sample(key, env.config.num_envs)


def _outcome(env: Env, output: MethodOutput) -> dict[str, jax.Array]:
    """[B] of each rate, and the Scene."""
    final, goal = output.final, output.final.start.goal
    within = jnp.abs(final.progress - goal[:, None]) <= env.config.tolerance * goal[:, None]
    outcome = {
        "success": final.success,
        "success_any_waypoint": final.valid & within.any(1),
        "in_collision": final.in_collision,
        "grasp_lost": ~final.in_collision & ~final.grasp_held,
        "grasp_failed": ~final.in_collision & ~final.valid & ~final.physics.diverged,
        "diverged": final.physics.diverged,
        "scene": final.physics.scene,
    }
    return outcome if output.predicted is None else outcome | {"predicted": output.predicted}
