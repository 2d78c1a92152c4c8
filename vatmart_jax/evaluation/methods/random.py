"""Random actions: the floor of every method."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from vatmart_jax.envs import Env, EnvState, TrialStart
from vatmart_jax.evaluation.methods.base import EvalContext, Method, MethodOutput
from vatmart_jax.trajectory import WAYPOINTS


def make_random_method(context: EvalContext) -> Method:
    """Random contact on the part, random approach within the cone, residuals uniform in the action range."""
    return lambda start, key: MethodOutput(_execute(context.env, start, key), None)


@jax.jit
def _execute(env: Env, start: TrialStart, key: jax.Array) -> EnvState:
    k_start, k_move = jax.random.split(key)
    limits = jnp.array([env.config.max_translation] * 3 + [env.config.max_rotation] * 3)
    residuals = jax.random.uniform(k_move, (len(start.view), WAYPOINTS, 6), minval=-1.0) * limits
    return env.execute(env.sample_approach(k_start, start.view, start.goal, 0.0), residuals)
