"""The contact solver on problems of random contacts: the gradient says whether it has arrived."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vatmart_jax.physics.mjx_solver import Problem, solve

BATCH, ROWS, DOFS = 64, 30, 9


def problems(seed: int) -> tuple[Problem, jax.Array]:
    """Some with most rows active, some with none, as stiff as contacts are."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(BATCH, DOFS, DOFS))
    inertia = root @ root.swapaxes(1, 2) + 0.1 * np.eye(DOFS)
    jacobian = rng.normal(size=(BATCH, ROWS, DOFS)) * (rng.random((BATCH, ROWS, 1)) < rng.random((BATCH, 1, 1)))
    stiffness = rng.uniform(1, 1e3, (BATCH, ROWS))
    arrays = inertia, rng.normal(size=(BATCH, DOFS)), jacobian, stiffness, rng.normal(size=(BATCH, ROWS))
    return Problem(*(jnp.asarray(x, jnp.float32) for x in arrays)), jnp.asarray(
        rng.normal(size=(BATCH, DOFS)), jnp.float32
    )


def gradient(problem: Problem, qacc: np.ndarray) -> np.ndarray:
    """[B, n] of the cost, in float64: zero at the solution."""
    inertia, smooth, jacobian, stiffness, reference = (np.asarray(x, float) for x in problem)
    residual = np.einsum("brn,bn->br", jacobian, qacc) - reference
    pressed = np.einsum("brn,br->bn", jacobian, stiffness * np.minimum(residual, 0))
    return np.einsum("bij,bj->bi", inertia, qacc - smooth) + pressed


@pytest.fixture(scope="module")
def solved():
    return jax.jit(lambda problem, warm: solve(problem, warm, iterations=12, ls_iterations=6))


@pytest.mark.parametrize("seed", range(3))
def test_nothing_is_left_to_gain(solved, seed):
    problem, warm = problems(seed)
    qacc, force = map(np.asarray, solved(problem, warm))
    at_start = np.abs(gradient(problem, np.asarray(problem.smooth, float))).max(1)
    left = np.abs(gradient(problem, qacc.astype(float))).max(1)
    assert (left < 1e-4 * (1 + at_start)).all()
    balance = np.einsum("bij,bj->bi", np.asarray(problem.inertia), qacc - np.asarray(problem.smooth))
    assert (np.abs(force - balance).max(1) < 1e-4 * (1 + at_start)).all()


def test_a_simulation_does_not_depend_on_the_others(solved):
    problem, warm = problems(7)
    together = np.asarray(solved(problem, warm)[0])
    order = np.random.default_rng(0).permutation(BATCH)
    shuffled = jax.tree.map(lambda x: x[order], (problem, warm))
    np.testing.assert_allclose(np.asarray(solved(*shuffled)[0]), together[order], atol=1e-5)
