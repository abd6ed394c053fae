"""Levenberg-Marquardt by optimistix, which never calls an answer successful that is none."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PyTree

_RANK = 1e-13  # of the largest singular value of the scaled Jacobian: what is smaller is rounding
_ENOUGH = 1e-4  # standard errors from the optimum: what passes for it
_STUCK = 1e-10  # of the first step's size: nothing moves any more
_REJECTED = 4  # times in a row, near the optimum: the sum of squares changes by its rounding only
_MEMORY = 0.9  # of the scale, from step to step: long enough to cross a plateau, short enough for a valley
_SAME = 0.1  # standard errors between ends of one optimum
_LIKE = 3.0  # in log-probability: an optimum lower by this still has a twentieth of the other's density
_DAMPING = 1e-2  # at the first step, of the largest curvature
_ROUNDING = 8.0  # units in the last place by which a parameter's rounding may move the residuals


class RESULTS(optx.RESULTS):
    """Why a fit ended: optimistix's results, and what else makes an answer untrustworthy."""

    did_not_move = (
        "The fit never left its start although the record asks for another answer; check the units of the record."
    )
    not_at_optimum = "The fit stopped before its optimum; check the units of the record, or give a nearer prior."
    rank_deficient = (
        "The record does not determine all parameters, and the answer is one of many;"
        " give a prior, or measure another channel."
    )
    on_bound = "The fit ended at a bound of its parameters; check the units of the record, or widen the bound."
    several_optima = (
        "The fit has several optima of like height; give a nearer prior, or sample the posterior from all of them."
    )
    misfit = (
        "The model does not describe the record: its residuals are larger than the noise or have structure;"
        " look at them in the report, and use the drive as measured or a scene that has what is missing."
    )


_NAMES = (
    "successful", "did_not_move", "not_at_optimum", "rank_deficient", "on_bound", "several_optima", "misfit",
    "nonfinite", "nonlinear_max_steps_reached", "nonlinear_divergence",
)  # fmt: skip


def result_name(result: Any) -> str:
    """The name of a member of `RESULTS`; a linear solver's failure counts as "nonfinite"."""
    return next((name for name in _NAMES if bool(result == getattr(RESULTS, name))), "nonfinite")


def result_message(name: str) -> str:
    """The sentence of a member of `RESULTS`, by its name."""
    return str(RESULTS[getattr(RESULTS, name)])  # type: ignore[misc]  # equinox's enumerations look up by item


class Minimum(eqx.Module):
    """Where Levenberg-Marquardt ended.

    Attributes:
        theta: the parameters.
        cost: half the sum of squared residuals.
        gradient: of the cost.
        jacobian: of the residuals, stacked in the order of their pytree.
        steps: trial steps taken.
        result: a member of `RESULTS`.
    """

    theta: Float[Array, " parameters"]
    cost: Float[Array, ""]
    gradient: Float[Array, " parameters"]
    jacobian: Float[Array, "rows parameters"]
    steps: Array
    result: Any


def minimise(
    residuals: Callable[[Float[Array, " parameters"]], PyTree[Float[Array, "..."]]],
    start: Float[Array, " parameters"],
    lower: Float[Array, " parameters"] | None = None,
    upper: Float[Array, " parameters"] | None = None,
    max_steps: int = 1000,
) -> Minimum:
    """The least squares nearest `start`, within bounds; pure, for use within jit and vmap, in double precision.

    Steps are damped in units of the Jacobian's columns (Marquardt 1963), clipped to the bounds, and leave out
    the parameters that a bound holds.
    """
    start = jnp.asarray(start)
    lower = jnp.full_like(start, -jnp.inf) if lower is None else jnp.asarray(lower)
    upper = jnp.full_like(start, jnp.inf) if upper is None else jnp.asarray(upper)
    start = jnp.clip(start, lower, upper)

    def stacked(theta: Array, _: None) -> Array:
        return ravel_pytree(residuals(theta))[0]

    rows = jax.eval_shape(stacked, start, None).size
    solver: Any = _LevenbergMarquardt(_Descent(lower, upper, rows))
    solution: Any = optx.least_squares(stacked, solver, start, max_steps=max_steps, throw=False)
    end: _Local = solution.state.descent_state
    return Minimum(
        theta=end.theta,
        cost=0.5 * jnp.sum(jnp.square(end.residuals)),
        gradient=end.jacobian.T @ end.residuals,
        jacobian=end.jacobian,
        steps=solution.stats["num_steps"],
        result=_judged(end, start, RESULTS.promote(solution.result)),
    )


@dataclasses.dataclass(frozen=True)
class Optima:
    """The distinct optima that many starts led to.

    Attributes:
        minima: one for each, stacked, lowest first; where no start led to one, the lowest end.
        reached: by how many starts.
        failed: how many starts led to none.
        result: of the lowest.
    """

    minima: Minimum
    reached: Int[np.ndarray, " optima"]
    failed: int
    result: Any


def minimise_many(
    residuals: Callable[[Float[Array, " parameters"]], PyTree[Float[Array, "..."]]],
    starts: Float[Array, "starts parameters"],
    lower: Float[Array, " parameters"] | None = None,
    upper: Float[Array, " parameters"] | None = None,
) -> Optima:
    """All starts at once; residuals in units of their standard deviation, so that the cost is -log-probability.

    Ends are one optimum where the residuals cannot tell them apart, as along a ridge.
    """
    ends = _minimise_each(residuals, jnp.asarray(starts), lower, upper)
    theta, jacobian = np.asarray(ends.theta), np.asarray(ends.jacobian)
    cost = np.where(np.isfinite(ends.cost), ends.cost, np.inf)
    order = np.argsort(cost)
    found = np.zeros(len(cost), bool)
    for settled in (RESULTS.successful, RESULTS.rank_deficient, RESULTS.on_bound):
        found |= np.asarray(ends.result == settled)
    firsts: list[int] = []
    reached: list[int] = []
    for i in order[found[order]]:
        apart = [np.linalg.norm(jacobian[first] @ (theta[i] - theta[first])) for first in firsts]
        if apart and min(apart) < _SAME:
            reached[int(np.argmin(apart))] += 1
        else:
            firsts.append(i)
            reached.append(1)
    lowest = order[0]
    # an end below all optima is none, so there is a better one still
    if not firsts or cost[lowest] < cost[firsts[0]] - 0.5 * _SAME**2:
        firsts, reached = [lowest, *firsts], [0, *reached]
    minima = jax.tree.map(lambda leaf: leaf[np.array(firsts)], ends)
    result = jax.tree.map(lambda leaf: leaf[firsts[0]], ends.result)
    several = len(firsts) > 1 and cost[firsts[1]] < cost[firsts[0]] + _LIKE
    if several and bool(result == RESULTS.successful):
        result = RESULTS.several_optima
    return Optima(minima, np.array(reached), int(np.sum(~found)), result)


@eqx.filter_jit
def _minimise_each(residuals: Callable[..., Any], starts: Array, lower: Array | None, upper: Array | None) -> Minimum:
    return jax.vmap(lambda start: minimise(residuals, start, lower, upper))(starts)


class _Local(eqx.Module):
    """The linear least-squares problem at theta, from the singular values of its Jacobian in scaled columns."""

    theta: Float[Array, " parameters"]
    residuals: Float[Array, " rows"]
    jacobian: Float[Array, "rows parameters"]
    scale: Float[Array, " parameters"]  # largest column norms of late
    free: Bool[Array, " parameters"]  # of bounds
    values: Float[Array, " parameters"]
    directions: Float[Array, "parameters parameters"]
    along: Float[Array, " parameters"]  # the residuals, along the left singular vectors
    offset: Float[Array, ""]  # standard errors to the optimum; Bates and Watts, Technometrics 23 (1981) 179
    rank: Array


def _local(theta: Array, residuals: Array, jacobian: Array, scale: Array, free: Array) -> _Local:
    held = jnp.where(free, jacobian, 0.0)
    norms = jnp.linalg.norm(held, axis=0)
    scale = jnp.maximum(_MEMORY * scale, norms)
    q, r = jnp.linalg.qr(held / jnp.where(scale > 0.0, scale, 1.0))
    u, values, directions = jnp.linalg.svd(r)
    along = u.T @ (q.T @ residuals)
    # the test must not depend on the history of the scale
    u, own, _ = jnp.linalg.svd(r * scale / jnp.where(norms > 0.0, norms, 1.0))
    kept = own > _RANK * own[0]
    short = jnp.linalg.norm(jnp.where(kept, u.T @ (q.T @ residuals), 0.0))
    rounding = _ROUNDING * jnp.finfo(theta.dtype).eps * jnp.sum(norms * jnp.abs(theta))
    left = jnp.linalg.norm(residuals) / jnp.sqrt(max(residuals.size - theta.size, 1))
    offset = jnp.where(short <= rounding, 0.0, short / left)
    return _Local(theta, residuals, jacobian, scale, free, values, directions, along, offset, jnp.sum(kept))


class _Descent(optx.AbstractDescent):
    """Damped Gauss-Newton steps within bounds."""

    lower: Float[Array, " parameters"]
    upper: Float[Array, " parameters"]
    rows: int = eqx.field(static=True)

    def init(self, y: Array, f_info_struct: Any) -> _Local:
        size, zero = y.size, jnp.zeros_like(y)
        return _Local(
            y,
            jnp.zeros(self.rows),
            jnp.zeros((self.rows, size)),
            zero,
            jnp.ones(size, bool),
            zero,
            jnp.eye(size),
            zero,
            jnp.array(jnp.inf),
            jnp.array(0),
        )

    def query(self, y: Array, f_info: Any, state: _Local) -> _Local:
        jacobian = f_info.jac.as_matrix()
        gradient = jacobian.T @ f_info.residual
        near = 4.0 * jnp.finfo(y.dtype).eps * jnp.abs(y)
        held = ((y - self.lower <= near) & (gradient > 0.0)) | ((self.upper - y <= near) & (gradient < 0.0))
        return _local(y, f_info.residual, jacobian, state.scale, ~held)

    def step(self, step_size: Array, state: _Local) -> tuple[Array, Any]:
        along = state.values * state.along / (jnp.square(state.values) + _DAMPING / step_size)
        step = -(along @ state.directions) / jnp.where(state.scale > 0.0, state.scale, 1.0)
        step = jnp.clip(state.theta + step, self.lower, self.upper) - state.theta
        finite = jnp.all(jnp.isfinite(step))
        return step, optx.RESULTS.where(finite, optx.RESULTS.successful, optx.RESULTS.nonfinite)


class _Search(optx.ClassicalTrustRegion):
    """Accepts no step uphill: where a bound clips a step, the linear problem may predict one."""

    def predict_reduction(self, y_diff: Array, f_info: Any) -> Array:
        return jnp.minimum(super().predict_reduction(y_diff, f_info), 0.0)


class _LevenbergMarquardt(optx.AbstractGaussNewton):
    """Ends where the offset is small enough, or where steps change nothing any more."""

    rtol: float
    atol: float
    norm: Callable[..., Array]
    descent: _Descent
    search: _Search
    verbose: Callable[..., None]

    def __init__(self, descent: _Descent) -> None:
        self.rtol, self.atol, self.norm = 0.0, 1e-300, optx.max_norm  # a step that changes nothing is the last
        self.descent = descent
        self.search = _Search(high_cutoff=0.75, low_cutoff=1e-3, high_constant=3.0)
        self.verbose = lambda **_: None

    def terminate(self, fn: Any, y: Any, args: Any, options: Any, state: Any, tags: Any) -> tuple[Array, Any]:
        local: _Local = state.descent_state
        # nearer to the optimum, too, the sum of squares changes by its rounding only
        there = jnp.square(local.offset) <= jnp.finfo(local.theta.dtype).eps * local.residuals.size
        there |= (local.offset < _ENOUGH) & (state.num_steps_since_acceptance > _REJECTED)
        return there | state.terminate | (state.search_state.step_size < _STUCK), state.result


def _judged(end: _Local, start: Array, result: Any) -> Any:
    """The first of the things that stand against the answer."""
    size = jnp.sum(end.free)
    failed = RESULTS.where(result == RESULTS.successful, RESULTS.not_at_optimum, result)
    failed = RESULTS.where(jnp.all(end.theta == start), RESULTS.did_not_move, failed)
    name = RESULTS.where(jnp.all(end.free), RESULTS.successful, RESULTS.on_bound)
    name = RESULTS.where(end.rank < size, RESULTS.rank_deficient, name)
    name = RESULTS.where(end.offset < _ENOUGH, name, failed)
    finite = jnp.all(jnp.isfinite(end.residuals)) & jnp.all(jnp.isfinite(end.jacobian))
    return RESULTS.where(finite, name, RESULTS.nonfinite)
