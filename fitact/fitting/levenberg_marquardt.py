"""Levenberg-Marquardt by optimistix, with checks that a successful result is a minimum."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, PyTree

from fitact.fitting.outcome import RESULT_NAMES, Minimum


def find_minimum(
    residuals: Callable[[Float[Array, " parameters"]], PyTree[Float[Array, "..."]]],
    start: Float[Array, " parameters"],
    max_steps: int,
    damping: ArrayLike,
) -> Minimum:
    """Find a minimum as `fitact.fitting.minimum.minimise` does."""
    start = jnp.asarray(start)

    @jax.jit  # optimistix traces its function six times, and jit only once
    def flat_residuals(theta: Array, _: None) -> Array:
        return ravel_pytree(residuals(theta))[0]

    solver: Any = LevenbergMarquardt(
        descent=_Descent(rows=jax.eval_shape(flat_residuals, start, None).size, damping=damping),
        search=optx.ClassicalTrustRegion(high_cutoff=0.75, low_cutoff=1e-3, high_constant=3.0),
        norm=optx.max_norm,
        verbose=lambda **_: None,
    )
    solution: Any = optx.least_squares(flat_residuals, solver, start, max_steps=max_steps, throw=False)
    end: _LinearProblem = solution.state.descent_state
    return Minimum(
        theta=end.theta,
        cost=0.5 * jnp.sum(jnp.square(end.residuals)),
        jacobian=end.jacobian,
        steps=solution.stats["num_steps"],
        result=solver.final_result(end, start, solution.result),
    )


class _LinearProblem(eqx.Module):
    """Linearised least-squares problem at theta: singular values of the Jacobian with scaled columns."""

    theta: Float[Array, " parameters"]
    residuals: Float[Array, " rows"]
    jacobian: Float[Array, "rows parameters"]
    scale: Float[Array, " parameters"]  # recent maximum of the column norms
    values: Float[Array, " parameters"]
    directions: Float[Array, "parameters parameters"]
    projections: Float[Array, " parameters"]  # residuals projected on the left singular vectors
    offset: Float[Array, ""]  # standard errors to the optimum; Bates and Watts, Technometrics 23 (1981) 179
    rank: Array


class _Descent(optx.AbstractDescent):
    """Damped Gauss-Newton steps."""

    rows: int = eqx.field(static=True)  # number of residuals
    damping: ArrayLike  # of the first step, relative to the largest curvature
    # decay of the scale per step: slow enough to cross a plateau, fast enough for a valley
    scale_decay: float = 0.9
    # relative to the largest singular value of the scaled Jacobian; smaller ones are rounding
    rank_tolerance: float = 1e-13
    rounding: float = 8.0  # rounding error of a parameter, in units of the last place

    def init(self, y: Array, f_info_struct: Any) -> _LinearProblem:
        residuals, jacobian, zero = jnp.zeros(self.rows), jnp.zeros((self.rows, y.size)), jnp.zeros_like(y)
        nowhere = np.asarray(np.inf), np.asarray(0)
        return _LinearProblem(y, residuals, jacobian, zero, zero, jnp.eye(y.size), zero, *nowhere)

    def query(self, y: Array, f_info: Any, state: _LinearProblem) -> _LinearProblem:
        residuals, jacobian = f_info.residual, f_info.jac.as_matrix()
        norms = jnp.linalg.norm(jacobian, axis=0)
        scale = jnp.maximum(self.scale_decay * state.scale, norms)
        q, r = jnp.linalg.qr(jacobian / jnp.where(scale > 0.0, scale, 1.0))
        u, values, directions = jnp.linalg.svd(r)
        projections = u.T @ (q.T @ residuals)
        # unlike the step, the rank test must not depend on the history of the scale
        u, sizes, _ = jnp.linalg.svd(r * scale / jnp.where(norms > 0.0, norms, 1.0))
        kept = sizes > self.rank_tolerance * sizes[0]
        short = jnp.linalg.norm(jnp.where(kept, u.T @ (q.T @ residuals), 0.0))
        rounding = self.rounding * jnp.finfo(y.dtype).eps * jnp.sum(norms * jnp.abs(y))
        spread = jnp.linalg.norm(residuals) / jnp.sqrt(max(residuals.size - y.size, 1))
        offset = jnp.where(short <= rounding, 0.0, short / spread)
        return _LinearProblem(y, residuals, jacobian, scale, values, directions, projections, offset, jnp.sum(kept))

    def step(self, step_size: Array, state: _LinearProblem) -> tuple[Array, Any]:
        damped = state.values * state.projections / (jnp.square(state.values) + self.damping / step_size)
        step = -(damped @ state.directions) / jnp.where(state.scale > 0.0, state.scale, 1.0)
        finite = jnp.all(jnp.isfinite(step))
        return step, optx.RESULTS.where(finite, optx.RESULTS.successful, optx.RESULTS.nonfinite)


class LevenbergMarquardt(optx.AbstractGaussNewton):
    """Levenberg-Marquardt that stops if the offset is small enough, or if steps no longer change the parameters."""

    descent: _Descent
    search: optx.ClassicalTrustRegion
    norm: Callable[..., Array]
    verbose: Callable[..., None]
    rtol: float = 0.0  # only a step without any change meets the Cauchy criterion
    atol: float = 1e-300
    offset_tolerance: float = 1e-4  # accepted distance from the optimum, in standard errors
    # the same where no step, however short, lowers the cost: a corner of it, e.g. a delay at a sample of the drive
    corner_tolerance: float = 1.0
    corner_damping: float = 100.0  # above which a step is short, relative to the largest curvature
    max_rejections: int = 4  # rejected steps in a row near the optimum, where rounding dominates the sum of squares
    min_step: float = 1e-10  # relative to the size of the first step

    def terminate(self, fn: Any, y: Any, args: Any, options: Any, state: Any, tags: Any) -> tuple[Array, Any]:
        local: _LinearProblem = state.descent_state
        # so near to the optimum, rounding dominates the sum of squares
        there = jnp.square(local.offset) <= jnp.finfo(local.theta.dtype).eps * local.residuals.size
        there |= (local.offset < self.offset_tolerance) & (state.num_steps_since_acceptance > self.max_rejections)
        is_short = self.descent.damping > self.corner_damping * state.search_state.step_size
        there |= (local.offset < self.corner_tolerance) & is_short
        return there | state.terminate | (state.search_state.step_size < self.min_step), state.result

    def final_result(self, end: _LinearProblem, start: Array, result: Any) -> Int[Array, ""]:
        """Return the index in `RESULT_NAMES` of the first reason why the result is unreliable, or of success."""
        index = RESULT_NAMES.index
        has_ended = result == optx.RESULTS.successful
        failed = jnp.where(has_ended, index("not_at_optimum"), index("nonfinite"))  # by the linear solver
        for name in ("nonlinear_max_steps_reached", "nonlinear_divergence"):
            failed = jnp.where(result == getattr(optx.RESULTS, name), index(name), failed)
        failed = jnp.where(jnp.all(end.theta == start), index("did_not_move"), failed)
        found = jnp.where(end.rank < end.theta.size, index("rank_deficient"), index("successful"))
        is_optimum = end.offset < jnp.where(has_ended, self.corner_tolerance, self.offset_tolerance)
        finite = jnp.all(jnp.isfinite(end.residuals)) & jnp.all(jnp.isfinite(end.jacobian))
        return jnp.where(finite, jnp.where(is_optimum, found, failed), index("nonfinite"))
