"""Newton's method for MuJoCo's contact problem, for a batch of simulations.

The problem is that of `mjx.solve` with a pyramidal cone, where every row of constraints pushes and none pulls. Two
things differ. The batch is the last axis, along which CPUs vectorise, where MJX under vmap has it first and loops over
three or nine numbers. And a simulation is done once a step has changed no active row, for then it has arrived; the few
that are not done after ALL_ITERATIONS go on by themselves, where MJX keeps all waiting for the slowest.

Source: Todorov 2014; `mujoco.mjx._src.solver`.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

ALL_ITERATIONS = 2
"""of every simulation; three in four need no more"""
REST = 4
"""those that need more go on together, up to one in so many of the batch at a time"""


class Problem(NamedTuple):
    """n degrees of freedom, R rows of constraints; any axis may follow, the batch."""

    inertia: jax.Array  # [n, n]
    smooth: jax.Array  # [n] accelerations without constraints
    jacobian: jax.Array  # [R, n]
    stiffness: jax.Array  # [R] efc_D
    reference: jax.Array  # [R] efc_aref

    def residual(self, qacc: jax.Array) -> jax.Array:
        """[R], negative where a row is active."""
        return _times(self.jacobian, qacc) - self.reference

    def cost(self, qacc: jax.Array, residual: jax.Array) -> jax.Array:
        off = qacc - self.smooth
        return 0.5 * (
            (off * _times(self.inertia, off)).sum(0) + (self.stiffness * jnp.minimum(residual, 0) ** 2).sum(0)
        )


class _Iterate(NamedTuple):
    qacc: jax.Array  # [n, B]
    residual: jax.Array  # [R, B]
    going: jax.Array  # [B] bool


def solve(
    problem: Problem, warmstart: jax.Array, *, iterations: int, ls_iterations: int
) -> tuple[jax.Array, jax.Array]:
    """Accelerations [B, n], and forces of the constraints in joint space [B, n].

    problem: leaves [B, ...]; warmstart: [B, n] accelerations to begin at, where they are better than the smooth ones.
    """
    problem, warm = jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), (problem, warmstart))
    r_warm, r_smooth = problem.residual(warm), problem.residual(problem.smooth)
    better = problem.cost(warm, r_warm) < problem.cost(problem.smooth, r_smooth)
    at = _Iterate(
        qacc=jnp.where(better, warm, problem.smooth),
        residual=jnp.where(better, r_warm, r_smooth),
        going=jnp.ones_like(better),
    )
    at = _iterate(problem, at, min(ALL_ITERATIONS, iterations), ls_iterations)
    if iterations > ALL_ITERATIONS:
        at = _finish(problem, at, iterations - ALL_ITERATIONS, ls_iterations)
    force = -_times_transposed(problem.jacobian, problem.stiffness * jnp.minimum(at.residual, 0))
    return at.qacc.T, force.T


def _finish(problem: Problem, at: _Iterate, iterations: int, ls_iterations: int) -> _Iterate:
    """So many iterations more for those that are going, one in REST of the batch at a time."""
    count = -(-len(at.going) // REST)

    def some(at: _Iterate) -> _Iterate:
        chosen = jnp.argsort(~at.going)[:count]
        rest, begun = jax.tree.map(lambda x: x[..., chosen], (problem, at))
        found = _iterate(rest, begun, iterations, ls_iterations)
        found = found._replace(going=jnp.zeros_like(found.going))
        return jax.tree.map(lambda x, y: x.at[..., chosen].set(y), at, found)

    return jax.lax.while_loop(lambda at: at.going.any(), some, at)


def _iterate(problem: Problem, at: _Iterate, iterations: int, ls_iterations: int) -> _Iterate:
    """So many iterations, or fewer where nothing is going any more."""

    def step(carry: tuple[jax.Array, _Iterate]) -> tuple[jax.Array, _Iterate]:
        i, at = carry
        return i + 1, _newton_step(problem, at, ls_iterations)

    def unfinished(carry: tuple[jax.Array, _Iterate]) -> jax.Array:
        return (carry[0] < iterations) & carry[1].going.any()

    return jax.lax.while_loop(unfinished, step, (jnp.int32(0), at))[1]


def _newton_step(problem: Problem, at: _Iterate, ls_iterations: int) -> _Iterate:
    inertia, smooth, jacobian, stiffness, _ = problem
    n = len(smooth)
    active = stiffness * (at.residual < 0)
    off = _times(inertia, at.qacc - smooth)
    gradient = off + _times_transposed(jacobian, active * at.residual)
    # The lower triangle, an expression per entry: XLA makes one loop over the rows of each, along the batch.
    columns = [jacobian[:, i] for i in range(n)]
    hessian = [[inertia[i, j] + (active * columns[i] * columns[j]).sum(0) for j in range(i + 1)] for i in range(n)]
    search = -_cholesky_solve(hessian, gradient)
    along = _times(jacobian, search)
    constant, linear = (search * off).sum(0), (search * _times(inertia, search)).sum(0)

    def slope(alpha: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Of the cost along the search direction, and the slope's own slope."""
        x = at.residual + alpha * along
        pressed = stiffness * along * (x < 0)
        return constant + alpha * linear + (pressed * x).sum(0), linear + (pressed * along).sum(0)

    alpha = jnp.where(at.going, _root(slope, jnp.ones_like(constant), ls_iterations), 0.0)
    residual = at.residual + alpha * along
    changed = ((residual < 0) != (at.residual < 0)).any(0)
    return _Iterate(at.qacc + alpha * search, residual, at.going & changed)


def _root(slope, begin: jax.Array, iterations: int) -> jax.Array:
    """[B] where an increasing, piecewise linear function is nearest to zero: Newton's method in a bracket."""

    def narrow(_, carry):
        alpha, value, rate, low, high, best, least = carry
        low, high = jnp.where(value < 0, alpha, low), jnp.where(value < 0, high, alpha)
        newton = alpha - value / rate
        middle = jnp.where(jnp.isfinite(high), 0.5 * (low + high), 2 * alpha)
        alpha = jnp.where((newton > low) & (newton < high), newton, middle)
        value, rate = slope(alpha)
        closer = jnp.abs(value) < least
        best, least = jnp.where(closer, alpha, best), jnp.where(closer, jnp.abs(value), least)
        return alpha, value, rate, low, high, best, least

    value, rate = slope(begin)
    carry = (begin, value, rate, jnp.zeros_like(begin), jnp.full_like(begin, jnp.inf), begin, jnp.abs(value))
    return jax.lax.fori_loop(0, iterations, narrow, carry)[5]


def _times(matrix: jax.Array, x: jax.Array) -> jax.Array:
    """[m, n, B] times [n, B] -> [m, B]; a sum over the middle axis would not be vectorised."""
    return sum((matrix[:, i] * x[i] for i in range(1, len(x))), matrix[:, 0] * x[0])


def _times_transposed(matrix: jax.Array, x: jax.Array) -> jax.Array:
    """The transpose of [m, n, B] times [m, B] -> [n, B]."""
    return jnp.stack([(matrix[:, i] * x).sum(0) for i in range(matrix.shape[1])])


def _cholesky_solve(lower: list[list[jax.Array]], b: jax.Array) -> jax.Array:
    """x of A x = b, given the lower triangle of A as n rows of entries [B], and b [n, B]. LAPACK, which
    jax.scipy calls once for every matrix, is slower for matrices this small."""
    n = len(lower)
    factor: list[list[jax.Array]] = [[] for _ in range(n)]
    inverse: list[jax.Array] = []  # of the diagonal
    for i in range(n):
        for j in range(i):
            entry = lower[i][j] - sum(factor[i][k] * factor[j][k] for k in range(j))
            factor[i].append(entry * inverse[j])
        pivot = lower[i][i] - sum(factor[i][k] ** 2 for k in range(i))
        inverse.append(jax.lax.rsqrt(pivot))
    y: list[jax.Array] = []
    for i in range(n):
        y.append((b[i] - sum(factor[i][k] * y[k] for k in range(i))) * inverse[i])
    x: list[jax.Array] = []
    for i in reversed(range(n)):
        x.insert(0, (y[i] - sum(factor[k][i] * x[k - i - 1] for k in range(i + 1, n))) * inverse[i])
    return jnp.stack(x)
