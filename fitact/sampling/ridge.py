"""Ridge of a density: its center along one coordinate, and normal approximations across it."""

import dataclasses
import functools
import math
from collections.abc import Callable

import numpy as np
import scipy
from jaxtyping import Float

LogDensity = Callable[[np.ndarray], np.ndarray]


@dataclasses.dataclass(frozen=True)
class Ridge:
    """Normal approximations of the density at positions along one coordinate, in those coordinates that it bends.

    Between the positions, the centers follow a cubic spline and the factors change linearly; they do not change beyond
    the first and the last.
    """

    along: int
    bent: list[int]
    first: float  # position
    spacing: float  # of the positions
    centers: Float[np.ndarray, "positions bent"]
    factors: Float[np.ndarray, "positions bent bent"]  # upper triangular, of the inverse covariances

    def bend(self, z: Float[np.ndarray, "count n"]) -> tuple[np.ndarray, Float[np.ndarray, " count"]]:
        """Return coordinates for those that are standard normal across the ridge, and log of the change of volume."""
        (center, factor), bent = self._interpolate(z[:, self.along]), np.array(z)
        bent[:, self.bent] = center + np.linalg.solve(factor, z[:, self.bent, None])[..., 0]
        return bent, -_log_determinant(factor)

    def straighten(self, z: Float[np.ndarray, "count n"]) -> tuple[np.ndarray, Float[np.ndarray, " count"]]:
        """Return the inverse of `bend`, and the same logarithm."""
        (center, factor), straight = self._interpolate(z[:, self.along]), np.array(z)
        straight[:, self.bent] = (factor @ (z[:, self.bent] - center)[..., None])[..., 0]
        return straight, -_log_determinant(factor)

    def is_straight(self, tolerance: float = 0.25) -> bool:
        """Return whether the approximations are nearly equal."""
        scatter = np.ptp(self.centers, axis=0), np.abs(self.factors - np.eye(len(self.bent)))
        return all(np.max(each) < tolerance for each in scatter)

    def scale(self, lengths: Float[np.ndarray, " n"]) -> "Ridge":
        """Return the ridge in coordinates whose units are longer by factors."""
        others, along = lengths[self.bent], lengths[self.along]
        factors = self.factors * others / others[:, None]
        return Ridge(self.along, self.bent, self.first / along, self.spacing / along, self.centers / others, factors)

    def _interpolate(self, positions: Float[np.ndarray, " count"]) -> tuple[np.ndarray, np.ndarray]:
        place = np.clip((positions - self.first) / self.spacing, 0.0, len(self.centers) - 1.0)
        before = np.minimum(place.astype(int), len(self.centers) - 2)
        share = (place - before)[:, None, None]
        return self._curve(place), (1.0 - share) * self.factors[before] + share * self.factors[before + 1]

    @functools.cached_property
    def _curve(self) -> scipy.interpolate.CubicSpline:
        return scipy.interpolate.CubicSpline(np.arange(len(self.centers)), self.centers)


def follow_ridge(
    log_density: LogDensity,
    start: Float[np.ndarray, " n"],
    along: int,
    bent: list[int],
    spacings: tuple[float, ...] = (0.25, 0.06),
) -> Ridge | None:
    """Follow the ridge near `start` along a coordinate, both ways until the density is low; None if there is none.

    If it turns too fast for the first of the `spacings`, it is followed in steps of the next.
    """
    longest, ridge = 0.0, None
    for spacing in spacings:
        (later, reaches_end), (earlier, reaches_begin) = (
            _walk(log_density, start, along, bent, step) for step in (spacing, -spacing)
        )
        found = [*reversed(earlier[1:]), *later]
        if len(found) > 1 and spacing * len(found) > longest:
            longest = spacing * len(found)
            centers, factors = (np.array(values) for values in zip(*found, strict=True))
            ridge = Ridge(along, bent, start[along] - spacing * len(earlier[1:]), spacing, centers, factors)
        if reaches_end and reaches_begin:
            break
    return ridge


def _walk(
    log_density: LogDensity,
    start: Float[np.ndarray, " n"],
    along: int,
    bent: list[int],
    step: float,
    farthest: float = 40.0,
    log_density_range: float = 15.0,
) -> tuple[list[tuple[np.ndarray, np.ndarray]], bool]:
    """Return centers and factors at positions from `start` on, and whether the density has become low at the last.

    From one position to the next, Newton's method starts where the last three lead.
    """
    last, factor, highest = [start] * 3, np.eye(len(bent)), -math.inf
    found = list[tuple[np.ndarray, np.ndarray]]()
    for number in range(round(farthest / abs(step)) + 1):
        ahead = 3.0 * last[-1] - 3.0 * last[-2] + last[-3]
        ahead[along] = start[along] + number * step
        here, factor, height = _climb(log_density, ahead, bent, factor)
        last.append(here)
        highest = max(highest, height)
        if not height > highest - log_density_range:
            return found, math.isfinite(height)
        found.append((here[bent], factor))
    return found, True


def _climb(
    log_density: LogDensity, z: Float[np.ndarray, " n"], bent: list[int], factor: Float[np.ndarray, "bent bent"]
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the ridge's point near z, a factor there, and the density, which is NaN if there is no ridge."""
    unit = np.eye(z.size)[bent]
    for _ in range(6):
        root = np.linalg.inv(factor)
        height, gradient, hessian = differentiate(log_density, z, root.T @ unit)
        if not np.min(np.linalg.eigvalsh(hessian)) > 0.05:
            break
        change = np.linalg.solve(hessian, gradient)
        if gradient @ change < 0.1:  # twice the increase that is left
            return z, np.linalg.cholesky(factor.T @ hessian @ factor).T, height
        z = z + root @ change / max(1.0, math.sqrt(gradient @ change) / 10.0) @ unit
    return z, factor, math.nan


def _log_determinant(factor: Float[np.ndarray, "count m m"]) -> Float[np.ndarray, " count"]:
    return np.sum(np.log(np.diagonal(factor, axis1=1, axis2=2)), axis=1)


def differentiate(
    log_density: LogDensity, z: Float[np.ndarray, " n"], directions: Float[np.ndarray, "m n"], step: float = 0.5
) -> tuple[float, Float[np.ndarray, " m"], Float[np.ndarray, "m m"]]:
    """Return a log-density, its gradient and minus its Hessian along some directions, from differences.

    What lies outside the support leaves a gradient of 0 and the Hessian of a standard normal.
    """
    m, unit = len(directions), step * directions
    pairs = np.triu_indices(m, 1)
    both = unit[pairs[0]] + unit[pairs[1]]
    values = log_density(z + np.concatenate([np.zeros((1, z.size)), unit, -unit, both, -both]))
    middle, after, before, up, down = np.split(values, np.cumsum([1, m, m, len(both)]))
    with np.errstate(invalid="ignore"):
        gradient, hessian = (after - before) / (2.0 * step), np.diag((2.0 * middle - after - before) / step**2)
        second = (after + before)[pairs[0]] + (after + before)[pairs[1]] - up - down - 2.0 * middle
    hessian[pairs] = hessian[pairs[::-1]] = second / (2.0 * step**2)
    known = np.isfinite(gradient) & np.isfinite(np.diagonal(hessian))
    hessian = np.where(np.isfinite(hessian) & known & known[:, None], hessian, np.eye(m))
    return float(middle[0]), np.where(known, gradient, 0.0), hessian
