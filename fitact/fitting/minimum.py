"""Minima of sums of squares, from one start or many.

The solver itself is in `fitact.fitting.levenberg_marquardt`. It is imported only where a program is traced, because a
program from the disk does without optimistix.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, PyTree

from fitact.compiled import jit
from fitact.fitting.outcome import RESULT_NAMES, Minimum, result_name
from fitact.model.divider_coordinates import differentiate, from_elements, to_elements


def minimise(
    residuals: Callable[[Float[Array, " parameters"]], PyTree[Float[Array, "..."]]],
    start: Float[Array, " parameters"],
    max_steps: int = 300,
    damping: ArrayLike = 1e-2,
    elements: tuple[int, ...] = (),
) -> Minimum:
    """Find the least-squares optimum nearest to `start`; pure, for use within jit and vmap, in double precision.

    Steps are damped in units of the Jacobian's columns (Marquardt 1963). `damping` is that of the first step, relative
    to the largest curvature. Those of `elements`, the places of log Rsc, log Csc and log Ci, are in the coordinates of
    `divider_coordinates`.
    """
    from fitact.fitting.levenberg_marquardt import find_minimum

    def evaluate(point: Array) -> PyTree[Array]:
        return residuals(to_elements(point, elements))

    end = find_minimum(evaluate, from_elements(jnp.asarray(start), elements), max_steps, damping)
    theta = to_elements(end.theta, elements)
    return dataclasses.replace(end, theta=theta, jacobian=end.jacobian @ differentiate(theta, elements))


class Optima(NamedTuple):
    """Distinct optima from many starting points."""

    minima: Minimum  # stacked, lowest cost first; if no start converged, the lowest end point
    start_counts: Int[np.ndarray, " optima"]  # number of starts that ended in each
    n_failed: int  # number of starts that did not converge
    result: str  # result of the lowest


def minimise_many(
    residuals: Callable[[Float[Array, " parameters"]], PyTree[Float[Array, "..."]]],
    starts: Float[np.ndarray, "starts parameters"],
    elements: tuple[int, ...] = (),
) -> Optima:
    """Minimise from all starts at once; with residuals in units of their sd, the cost is -log(probability)."""
    same_optimum = 0.1  # standard errors, below which end points count as one optimum
    log_density_margin = 3.0  # by which the log-probability of a competing optimum is lower, or less
    ends = _minimise_each(residuals, starts, elements)
    theta, jacobian = ends.theta, ends.jacobian
    cost = np.where(np.isfinite(ends.cost), ends.cost, np.inf)
    order = np.argsort(cost)
    settled = np.isin(ends.result, [RESULT_NAMES.index(name) for name in ("successful", "rank_deficient")])
    firsts: list[int] = []
    counts: list[int] = []
    for i in order[settled[order]]:
        apart = [np.linalg.norm(jacobian[first] @ (theta[i] - theta[first])) for first in firsts]
        if apart and min(apart) < same_optimum:
            counts[int(np.argmin(apart))] += 1
        else:
            firsts.append(i)
            counts.append(1)
    lowest = order[0]
    # an end point below all optima has not converged, so a better optimum exists
    if not firsts or cost[lowest] < cost[firsts[0]] - 0.5 * same_optimum**2:
        firsts, counts = [lowest, *firsts], [0, *counts]
    minima = jax.tree.map(lambda leaf: leaf[np.array(firsts)], ends)
    result = result_name(minima.result[0])
    several = len(firsts) > 1 and cost[firsts[1]] < cost[firsts[0]] + log_density_margin
    if several and result == "successful":
        result = "several_optima"
    return Optima(minima, np.array(counts), int(np.sum(~settled)), result)


@jit
def _minimise_each(residuals: Callable[..., Any], starts: Array, elements: tuple[int, ...]) -> Minimum:
    return jax.vmap(lambda start: minimise(residuals, start, elements=elements))(starts)
