"""A method of one's own, in one file: registered, and evaluated beside the others in the same trials."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import pytest
from tiny import TINY

from vatmart_jax.envs import TASKS, TrialStart, make_env
from vatmart_jax.errors import UserError
from vatmart_jax.evaluation.methods.base import METHODS, EvalContext, Method, MethodOutput
from vatmart_jax.trajectory import WAYPOINTS
from vatmart_jax.workflows.evaluate import EvaluationPlan, evaluate_split

pytestmark = pytest.mark.usefixtures("quick_to_compile")


@pytest.fixture
def straight():
    """The method `straight`: a guided start, and equal pushes along the approach that add up to the goal."""

    @METHODS.register("straight")
    def make(context: EvalContext) -> Method:
        env = context.env

        @jax.jit
        def execute(start: TrialStart, key: jax.Array):
            start = env.sample_approach(key, start.view, start.goal, 1.0)
            move = start.rotation[:, :, 2] * (start.goal + env.config.standoff)[:, None] / WAYPOINTS
            residuals = jnp.concatenate([move, jnp.zeros_like(move)], -1)
            return env.execute(start, jnp.repeat(residuals[:, None], WAYPOINTS, 1))

        return lambda start, key: MethodOutput(execute(start, key), jnp.full(start.goal.shape, 0.5))

    yield "straight"
    METHODS.unregister("straight")


def test_a_method_of_ones_own_is_evaluated_beside_the_others(straight, cabinets):
    env = make_env(*cabinets, TASKS["push-drawer"], "c", TINY.env, TINY.physics)
    methods = EvaluationPlan(impl="c", methods=(straight, "random")).methods
    rows = evaluate_split("test_shapes", EvalContext(env=env), methods, trials=32, key=jax.random.key(0))
    own, random = rows
    assert [row["method"] for row in rows] == ["straight", "random"]
    assert own["success"] > random["success"]
    assert own["predicted"] == 0.5 and own["reliability"]["count"] == [32]


def test_without_it_the_known_methods_are_listed():
    with pytest.raises(UserError, match=r"method 'straight' is not known; use one of ours, priors, random, expert"):
        EvaluationPlan(impl="c", methods=("straight",))
