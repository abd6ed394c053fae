"""Coordinates of a circuit in which its posterior is less curved: what records determine, instead of elements.

Vsc depends on the divider g = Ci / (2 Ci + Csc) and the time constant b = Rsc (2 Ci + Csc), eqs. (20)-(21) of the
reference paper; I also on g Csc, which follows dV/dt. The logarithms of Rsc, Csc and Ci are exchanged for log b,
log(2 g / (1 - 2 g)) and log(2 g Csc). The determinant of the Jacobian is -1, so that densities stay as they are.
"""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float


def from_elements(points: Float[np.ndarray, "*n names"], places: Sequence[int]) -> Float[np.ndarray, "*n names"]:
    """Return points with these coordinates at the `places` where they have log Rsc, log Csc and log Ci."""
    rsc, csc, ci = (points[..., place] for place in places)
    twice_ci = ci + math.log(2.0)
    total = np.logaddexp(csc, twice_ci)
    return _replace(points, places, (rsc + total, twice_ci - csc, csc + twice_ci - total))


def to_elements(points: Float[np.ndarray, "*n names"], places: Sequence[int]) -> Float[np.ndarray, "*n names"]:
    """Return the inverse of `from_elements`."""
    log_b, log_odds, series = (points[..., place] for place in places)
    csc, twice_ci = series + np.logaddexp(0.0, -log_odds), series + np.logaddexp(0.0, log_odds)
    return _replace(points, places, (log_b - np.logaddexp(csc, twice_ci), csc, twice_ci - math.log(2.0)))


def differentiate(point: Float[np.ndarray, " names"], places: Sequence[int]) -> Float[np.ndarray, "names names"]:
    """Return the Jacobian of `from_elements` at a point."""
    share = 1.0 / (1.0 + 0.5 * math.exp(point[places[1]] - point[places[2]]))  # of 2 Ci in 2 Ci + Csc
    jacobian = np.eye(point.size)
    jacobian[np.ix_(places, places)] = [[1.0, 1.0 - share, share], [0.0, -1.0, 1.0], [0.0, share, 1.0 - share]]
    return jacobian


def _replace(points: np.ndarray, places: Sequence[int], values: Sequence[np.ndarray]) -> np.ndarray:
    changed = np.array(points)
    changed[..., list(places)] = np.stack(values, axis=-1)
    return changed
