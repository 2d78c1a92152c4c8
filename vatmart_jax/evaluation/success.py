"""Downstream manipulation: what the priors choose is executed, open loop, on objects they have not seen.

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

from vatmart_jax.envs import Env, EnvState, TrialStart
from vatmart_jax.evaluation.metrics import reliability, wilson_interval
from vatmart_jax.trajectory import WAYPOINTS

Method = Callable[[TrialStart, jax.Array], tuple[EnvState, jax.Array | None]]
"""Final states for views and tasks (contact and rotation may be replaced) and a key, and what it thought of its chances
[B], if it says."""


def random_method(env: Env) -> Method:
    """Random contact on the part, random approach within the cone, residuals uniform in the action range."""
    limits = jnp.array([env.config.max_translation] * 3 + [env.config.max_rotation] * 3)

    @jax.jit
    def run(start: TrialStart, key: jax.Array) -> tuple[EnvState, None]:
        k_start, k_move = jax.random.split(key)
        residuals = jax.random.uniform(k_move, (len(start.view), WAYPOINTS, 6), minval=-1.0) * limits
        return env.execute(env.sample_approach(k_start, start.view, start.goal, 0.0), residuals), None

    return run


def downstream(
    env: Env, method: Method, trials: int, key: jax.Array, progress: Callable[[int], None] = lambda done: None
) -> dict[str, Any]:
    """Success of a method over `trials` random views and tasks; the same ones for every method with the same key.

    `lost_grip` counts trials that do not hold the part in the end; `no_grasp` those of them that never did.
    Of a method that scores its trials also the mean score (`said`) and the reliability curve.

    Consumes the key.
    """
    sample = jax.jit(lambda key: env.sample(key, env.config.num_envs))
    rows: list[dict[str, np.ndarray]] = []
    for batch in range(-(-trials // env.config.num_envs)):
        ks, km = jax.random.split(jax.random.fold_in(key, batch))
        final, score = method(sample(ks), km)
        task = final.start.goal
        within = jnp.abs(final.progress - task[:, None]) <= env.config.tolerance * task[:, None]
        outcome = {
            "success": final.success,
            "success_any_waypoint": final.valid & within.any(1),
            "in_collision": final.in_collision,
            "lost_grip": ~final.in_collision & ~final.grasp_held,
            "no_grasp": ~final.in_collision & ~final.valid & ~final.physics.diverged,
            "diverged": final.physics.diverged,
            "scene": final.physics.scene,
        } | ({} if score is None else {"said": score})
        rows.append(jax.device_get(outcome))
        progress(min(trials, (batch + 1) * env.config.num_envs))
    joined = {name: np.concatenate([row[name] for row in rows])[:trials] for name in rows[0]}
    scenes = joined.pop("scene")
    per_object = {
        str(name): round(float(joined["success"][env.bank.object_id[scenes] == name].mean()), 3)
        for name in np.unique(env.bank.object_id[scenes])
    }
    rates: dict[str, Any] = {name: float(value.mean()) for name, value in joined.items()}
    if "said" in joined:
        rates["reliability"] = reliability(joined["said"], joined["success"]).to_json()
    interval = [float(x) for x in wilson_interval(int(joined["success"].sum()), trials)]
    return {"trials": trials, "ci95": interval, **rates, "per_object": per_object}
