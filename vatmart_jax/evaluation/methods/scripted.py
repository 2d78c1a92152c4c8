"""The scripted policy, which knows the joint: the upper bound of every method."""

from __future__ import annotations

from vatmart_jax.envs.scripted_policy import run_scripted_policy
from vatmart_jax.evaluation.methods.base import EvalContext, Method, MethodOutput


def make_scripted_method(context: EvalContext) -> Method:
    """Closed loop, with the object's true joint."""
    env = context.env
    return lambda start, key: MethodOutput(run_scripted_policy(env, start, key), None)
