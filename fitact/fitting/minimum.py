"""Minima of sums of squares.

The solver itself is in `fitact.fitting.levenberg_marquardt`. It is imported only where a program is traced, because a
program from the disk does without optimistix.
"""

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from fitact.fitting.outcome import Minimum
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
