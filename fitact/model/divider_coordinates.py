"""Coordinates of a circuit in which its likelihood is less curved: what records determine, instead of elements.

Vsc depends on the divider g = Ci / (2 Ci + Csc) and the time constant b = Rsc (2 Ci + Csc), eqs. (20)-(21) of the
reference paper; I also on g Csc, which follows dV/dt. The logarithms of Rsc, Csc and Ci are exchanged for log b,
log(2 g / (1 - 2 g)) and log(2 g Csc). The determinant of the Jacobian is -1, so that densities stay as they are. Steps
of least squares go several times as far in these coordinates, where a record leaves a curved valley.
"""

import math
from collections.abc import Sequence

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.compiled import array_module


def from_elements(points: Float[Array, "*n names"], places: Sequence[int]) -> Float[Array, "*n names"]:
    """Return points with these coordinates at the `places` where they have log Rsc, log Csc and log Ci, if any."""
    if not places:
        return points
    rsc, csc, ci = (points[..., place] for place in places)
    twice_ci = ci + math.log(2.0)
    total = array_module(points).logaddexp(csc, twice_ci)
    return _replace(points, places, (rsc + total, twice_ci - csc, csc + twice_ci - total))


def to_elements(points: Float[Array, "*n names"], places: Sequence[int]) -> Float[Array, "*n names"]:
    """Return the inverse of `from_elements`."""
    if not places:
        return points
    xp, (log_b, log_odds, series) = array_module(points), (points[..., place] for place in places)
    csc, twice_ci = series + xp.logaddexp(0.0, -log_odds), series + xp.logaddexp(0.0, log_odds)
    return _replace(points, places, (log_b - xp.logaddexp(csc, twice_ci), csc, twice_ci - math.log(2.0)))


def differentiate(point: Float[Array, " names"], places: Sequence[int]) -> Float[Array, "names names"]:
    """Return the Jacobian of `from_elements` at a point."""
    if not places:
        return np.eye(point.size)
    xp, (_, csc, ci) = array_module(point), (point[place] for place in places)
    share = 1.0 / (1.0 + 0.5 * xp.exp(csc - ci))  # of 2 Ci in 2 Ci + Csc
    zero, one = xp.zeros_like(share), xp.ones_like(share)
    rows = [[one, 1.0 - share, share], [zero, -one, one], [zero, share, 1.0 - share]]
    chosen = np.eye(point.size)[list(places)]
    return np.eye(point.size) + chosen.T @ (xp.stack([xp.stack(row) for row in rows]) - np.eye(3)) @ chosen


def _replace(points: Array, places: Sequence[int], values: Sequence[ArrayLike]) -> Array:
    new = dict(zip(places, values, strict=True))
    return array_module(points).stack([new.get(i, points[..., i]) for i in range(points.shape[-1])], axis=-1)
