"""Gauss-Newton with a fixed number of iterations; `vmap` gives a batch, unrolling gradients."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from spdm_jax.types import Array

Result = Literal["last", "best"]
"""Which iterate a solve returns: the last one, or the one with the lowest objective."""


@dataclass(frozen=True)
class GaussNewtonConfig:
    """Static settings of a solve.

    Attributes:
      iterations: number of steps at most.
      step_size: part of the Gauss-Newton step that is taken.
      absolute_tolerance: a solve stands still once a step changes the objective by less.
      relative_tolerance: the same, relative to the objective before the step.
      result: iterate to return; "best" counts the start as well and has no useful gradient.
    """

    iterations: int
    step_size: float
    absolute_tolerance: float = 1e-10
    relative_tolerance: float = 1e-8
    result: Result = "last"

    def __post_init__(self):
        if self.iterations < 1:
            raise ValueError(f"iterations is {self.iterations}; a solve takes at least 1 step")
        if not 0 < self.step_size <= 1:
            raise ValueError(f"step_size is {self.step_size}; expected a number in (0, 1]")


class GaussNewtonSolution(struct.PyTreeNode, kw_only=True):
    """Outcome of a solve.

    Attributes:
      values: `[V]` the iterate that the config asks for.
      objective: scalar, half the sum of squared residuals at `values`.
      objectives: `[I + 1]` the same at the start and after each step; constant after convergence.
      converged: bool, whether a tolerance was met.
    """

    values: Array
    objective: Array
    objectives: Array
    converged: Array


class _Search(NamedTuple):
    """Iterate, its objective (of the iterate before, until judged), the best so far."""

    values: jax.Array
    error: jax.Array
    best: jax.Array
    best_error: jax.Array
    converged: jax.Array


def gauss_newton_step(
    residual: Callable[[jax.Array], jax.Array], values: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Returns the full step `[V]` and the objective before it.

    Solves the normal equations by a Cholesky factor after scaling every variable to a column of
    length 1, which keeps float32 solves of badly scaled residuals apart from breakdown.

    Args:
      residual: `[V]` to `[R]` weighted residuals, R >= V.
      values: `[V]` where to linearise.
    """
    at_values, tangent = jax.linearize(residual, values)
    # Rows are variables: the transposed Jacobian.
    jacobian = jax.vmap(tangent)(jnp.eye(values.shape[0], dtype=values.dtype))
    highest = jax.lax.Precision.HIGHEST
    length = jnp.sqrt(jnp.sum(jacobian**2, axis=1))
    scale = 1 / jnp.where(length > 0, length, 1)
    scaled = jacobian * scale[:, None]
    normal = jnp.matmul(scaled, scaled.T, precision=highest)
    # A variable that no residual depends on stays where it is.
    normal = normal + jnp.diag(jnp.where(length > 0, 0, 1).astype(normal.dtype))
    gradient = jnp.matmul(scaled, at_values, precision=highest)
    factor = jax.scipy.linalg.cho_factor(normal, lower=True)
    step = -scale * jax.scipy.linalg.cho_solve(factor, gradient)
    return step, 0.5 * jnp.sum(at_values**2)


def gauss_newton(
    residual: Callable[[jax.Array], jax.Array], start: jax.Array, config: GaussNewtonConfig
) -> GaussNewtonSolution:
    """Minimises half the sum of squared residuals: u <- u - step_size (J^T J)^-1 J^T r.

    No damping and no line search. A converged solve stands still; under `vmap` all iterations are
    computed, so that a batch runs one program of known cost.

    Args:
      residual: `[V]` to `[R]` weighted residuals, R >= V.
      start: `[V]` first iterate.
      config: static settings.

    Source: theseus 0.2.3 `GaussNewton` with dense solvers (objective, tolerances, best iterate).
    """

    def judge(state: _Search, error: jax.Array) -> _Search:
        change = jnp.abs(state.error - error)
        small = change < config.absolute_tolerance
        small = small | (change < config.relative_tolerance * state.error)
        better = error < state.best_error
        return _Search(
            values=state.values,
            error=error,
            best=jnp.where(better, state.values, state.best),
            best_error=jnp.where(better, error, state.best_error),
            converged=small,
        )

    def move(state: _Search) -> tuple[_Search, jax.Array]:
        # The linearisation tells the objective too: what the last step led to is judged here.
        step, error = gauss_newton_step(residual, state.values)
        state = judge(state, error)
        moved = state.values + config.step_size * step
        values = jnp.where(state.converged, state.values, moved)
        return state._replace(values=values), error

    def iterate(state: _Search, _):
        # Alone a converged solve costs nothing more; under vmap both sides are computed.
        return jax.lax.cond(state.converged, lambda s: (s, s.error), move, state)

    unknown = jnp.full((), jnp.inf, start.dtype)
    state = _Search(start, unknown, start, unknown, jnp.asarray(False))
    state, errors = jax.lax.scan(iterate, state, length=config.iterations)
    last = 0.5 * jnp.sum(residual(state.values) ** 2)
    values, error, best, best_error, converged = judge(state, last)
    if config.result == "best":
        values, error = best, best_error
    return GaussNewtonSolution(
        values=values,
        objective=error,
        objectives=jnp.append(errors, last),
        converged=converged,
    )
