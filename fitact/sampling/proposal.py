"""Proposal density of moves and importance sampling: a Student-t around the fit, with ridges and tabulated marginals.

The posterior may be curved: where it is far from normal along a direction, its ridge is followed, with a normal
approximation across it at each position. If the density along the ridge is not normal either, as with a bounded prior
in directions that the data do not constrain, it is tabulated; the other directions keep the Student-t.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Self

import numpy as np
import scipy
from jaxtyping import Bool, Float

from fitact.fitting.result import Fit
from fitact.model import divider_coordinates
from fitact.sampling.ridge import LogDensity, Ridge, differentiate, follow_ridge

Random = np.random.RandomState | np.random.Generator

OVERDISPERSION = 1.5  # factor on the width of the starting points: ensembles must agree in spite of it
DEGREES_OF_FREEDOM = 8.0  # Student-t with heavier tails than any posterior met so far
PROBES = np.array([-2.5, -1.0, 0.0, 1.0, 2.5])  # points along an axis, in sd, at which normality is tested
# points along an axis, in sd, among which the support is searched: 40 on both sides, dense where the density is high
_SEARCH = np.sinh(np.linspace(-np.arcsinh(40.0), np.arcsinh(40.0), 257))


@dataclasses.dataclass(frozen=True)
class TabulatedMarginal:
    """Density of one coordinate, constant within cells of equal width."""

    low: float
    width: float
    mass: Float[np.ndarray, " cells"]

    @classmethod
    def from_log_density(cls, low: float, width: float, log_density: Float[np.ndarray, " edges"]) -> Self:
        """Give each cell the higher density of its two edges, so that a cell in which the support ends is covered."""
        height = np.exp(np.maximum(log_density[1:], log_density[:-1]) - np.max(log_density))
        return cls(low, width, height / height.sum())

    def scale_width(self, factor: float) -> Self:
        """Divide the log-density by the square of `factor`; this widens a normal density by `factor`."""
        mass = self.mass ** (factor**-2)
        return dataclasses.replace(self, mass=mass / mass.sum())

    @property
    def median(self) -> float:
        return self.low + self.width * float(np.searchsorted(np.cumsum(self.mass), 0.5) + 0.5)

    def draw(self, random: Random, count: int) -> Float[np.ndarray, " count"]:
        total = np.cumsum(self.mass)
        cell = np.searchsorted(total, random.uniform(size=count) * total[-1], side="right")
        return self.low + self.width * (cell + random.uniform(size=count))

    def log_density(self, values: Float[np.ndarray, " count"]) -> Float[np.ndarray, " count"]:
        cell = np.floor((values - self.low) / self.width)
        inside = (cell >= 0) & (cell < self.mass.size)
        mass = np.where(inside, self.mass[np.where(inside, cell, 0).astype(int)], 0.0)
        with np.errstate(divide="ignore"):
            return np.log(mass) - np.log(self.width)


@dataclasses.dataclass(frozen=True)
class Proposal:
    """Proposal density in the coordinates of the posterior.

    A point is `center` and a sum of `axes`, whose factors the `ridges` bend, the last one first. With `elements`, which
    are the places of log Rsc, log Csc and log Ci in a point, these are in the coordinates of `divider_coordinates`.
    """

    center: Float[np.ndarray, " n"]
    axes: Float[np.ndarray, "n n"]  # principal axes as columns, one standard deviation long
    ridges: tuple[Ridge, ...] = ()
    origin: Float[np.ndarray, " n"] | float = 0.0  # center of the Student-t, in coordinates without bends
    # densities of some coordinates, relative to the origin
    tables: dict[int, TabulatedMarginal] = dataclasses.field(default_factory=dict)
    student_share: float = 0.1  # fraction drawn from the Student-t alone, so that the support has no bounds
    elements: Sequence[int] = ()
    alternatives: Sequence[Self] = ()  # proposals that may reach where this one does not

    @classmethod
    def from_fit(cls, fit: Fit, log_prob: LogDensity, count: int = 1000) -> Self:
        """Build a proposal around a fit, in that of three sets of coordinates which serves best.

        If the posterior is not normal, it may be curved in several ways. It is then described along the time constant
        first, along principal axes in the same coordinates, or in the elements. The variance of importance weights
        decides, from `count` draws of each. The others are its `alternatives`.
        """
        usual = cls.from_laplace(fit.point, fit.point_root, log_prob, fit.sampling_order)
        elements = fit.likelihood.elements
        if usual.is_normal or fit.sampling_order or not elements:
            return usual
        point = divider_coordinates.from_elements(fit.point, elements)
        root = divider_coordinates.differentiate(fit.point, elements) @ fit.point_root

        def log_density(points: np.ndarray) -> np.ndarray:
            return log_prob(divider_coordinates.to_elements(points, elements))

        found = [
            dataclasses.replace(cls._from_axes(point, axes, range(point.size), log_density), elements=elements)
            for axes in (leading_axes(root, elements[0]), principal_axes(root))
        ]
        found.append(usual)
        random = np.random.default_rng(0)  # any reproducible draws serve
        points = np.concatenate([each.draw(random, count) for each in found])
        log_ratios = log_prob(points) - np.stack([each.log_density(points) for each in found])
        # weights of the draws of all, in whose sum over a proposal what it misses counts most
        log_weights = -scipy.special.logsumexp(-log_ratios, axis=0)
        best = found.pop(int(np.argmin(scipy.special.logsumexp(log_ratios + log_weights, axis=1))))
        return dataclasses.replace(best, alternatives=found)

    @property
    def is_normal(self) -> bool:
        """Whether the density is nearly normal along all axes."""
        return not (self.ridges or self.tables)

    @classmethod
    def from_laplace(
        cls,
        point: Float[np.ndarray, " n"],
        covariance_factor: Float[np.ndarray, "n n"],
        log_prob: LogDensity,
        order: Sequence[int] = (),
    ) -> Self:
        """Build a proposal from a Laplace approximation; follow ridges where `log_prob` is not normal along an axis.

        With an `order` of the coordinates, each axis changes one of them, and those after it as the covariance says.
        If several priors that the data do not narrow have bounds, those coordinates should come first. Otherwise the
        axes are the principal ones.
        """
        axes = triangular_axes(covariance_factor, order) if len(order) else principal_axes(covariance_factor)
        return cls._from_axes(np.array(point, dtype=float), axes, order or range(len(axes)), log_prob)

    @classmethod
    def _from_axes(
        cls, point: Float[np.ndarray, " n"], axes: Float[np.ndarray, "n n"], order: Sequence[int], log_prob: LogDensity
    ) -> Self:
        """Build a proposal with these axes, which are followed in this order."""
        order, center = _enter_support(point, axes, list(order), log_prob)
        found = cls(center, axes, origin=np.zeros(center.size))
        for i in order:
            if is_normal(found._log_density_along(i, log_prob, PROBES)):
                continue
            done = [i, *(ridge.along for ridge in found.ridges), *found.tables]
            found = found._follow_ridge(i, [k for k in order if k not in done], log_prob)
            table = _tabulate(functools.partial(found._log_density_along, i, log_prob))
            if table is not None:
                origin = found.origin + table.median * np.eye(center.size)[i]
                tables = found.tables | {i: dataclasses.replace(table, low=table.low - table.median)}
                found = dataclasses.replace(found, origin=origin, tables=tables)
        return found

    def scale_width(self, factor: float) -> Self:
        """Widen the Student-t by `factor`, and the tables as far as their limits allow."""
        tables = {i: table.scale_width(factor) for i, table in self.tables.items()}
        longer = np.array([1.0 if i in tables else factor for i in range(self.center.size)])
        ridges = tuple(ridge.scale(longer) for ridge in self.ridges)
        return dataclasses.replace(
            self, axes=self.axes * longer, origin=self.origin / longer, tables=tables, ridges=ridges
        )

    def draw(self, random: Random, count: int) -> Float[np.ndarray, "count n"]:
        z = draw_student_t(random, count, self.center.size)
        tabulated = random.uniform(size=count) >= self.student_share
        for i, table in self.tables.items():
            z[:, i] = np.where(tabulated, table.draw(random, count), z[:, i])
        points = self._bend(self.origin + z)[0]
        return divider_coordinates.to_elements(points, self.elements)

    def _bend(self, z: Float[np.ndarray, "count n"]) -> tuple[np.ndarray, Float[np.ndarray, " count"]]:
        """Return the points of coordinates without bends, and the logarithm of the change of volume."""
        log_volume = np.zeros(len(z))
        for ridge in reversed(self.ridges):
            z, change = ridge.bend(z)
            log_volume += change
        return self.center + z @ self.axes.T, log_volume

    def log_density(self, points: Float[np.ndarray, "count n"]) -> Float[np.ndarray, " count"]:
        """Return the logarithm of the density, up to a constant."""
        points = divider_coordinates.from_elements(points, self.elements)
        z = np.linalg.solve(self.axes, (points - self.center).T).T
        log_volume = np.zeros(len(z))
        for ridge in self.ridges:
            z, change = ridge.straighten(z)
            log_volume += change
        z = z - self.origin
        if not self.tables:
            return student_log_density(z) - log_volume
        others = [i for i in range(self.center.size) if i not in self.tables]
        tabulated = student_log_density(z[:, others])
        for i, table in self.tables.items():
            tabulated = tabulated + table.log_density(z[:, i])
        fraction = self.student_share
        mixture = np.logaddexp(np.log(1.0 - fraction) + tabulated, np.log(fraction) + student_log_density(z))
        return mixture - log_volume

    def move(
        self, points: Float[np.ndarray, "count n"], random: np.random.RandomState
    ) -> tuple[Float[np.ndarray, "count n"], Float[np.ndarray, " count"]]:
        """Return new points and log q(old) - log q(new), as emcee expects of a proposal function."""
        proposed = self.draw(random, len(points))
        return proposed, self.log_density(points) - self.log_density(proposed)

    def _log_target(self, z: Float[np.ndarray, "count n"], log_prob: LogDensity) -> Float[np.ndarray, " count"]:
        """Return the log-density of coordinates without bends."""
        points, log_volume = self._bend(z)
        return log_prob(points) + log_volume

    def _log_density_along(
        self, axis: int, log_prob: LogDensity, positions: Float[np.ndarray, " count"]
    ) -> Float[np.ndarray, " count"]:
        """Return it at positions along one of these coordinates from the origin."""
        return self._log_target(self.origin + positions[:, None] * np.eye(self.center.size)[axis], log_prob)

    def _follow_ridge(self, along: int, others: list[int], log_prob: LogDensity) -> Self:
        """Return the proposal with the ridge along a coordinate, from the origin both ways until the density is low.

        It bends those of the `others` across which the density is nearly normal.
        """
        log_target = functools.partial(self._log_target, log_prob=log_prob)
        start, unit = np.array(self.origin, dtype=float), np.eye(self.center.size)
        for _ in range(5):
            _, gradient, hessian = differentiate(log_target, start, unit[others])
            curvature = np.diagonal(hessian)
            usual = (curvature > 0.25) & (curvature < 4.0)
            start[others] += np.clip(np.where(usual, gradient / np.where(usual, curvature, 1.0), 0.0), -2.0, 2.0)
        bent = [other for other, use in zip(others, usual, strict=True) if use]
        ridge = follow_ridge(log_target, start, along, bent) if bent else None
        if ridge is None:
            return self
        if ridge.is_straight():
            return dataclasses.replace(self, origin=start)
        origin = np.array(self.origin)
        origin[bent] = 0.0
        return dataclasses.replace(self, ridges=(*self.ridges, ridge), origin=origin)


def principal_axes(covariance_factors: Float[np.ndarray, "*any n n"]) -> Float[np.ndarray, "*any n n"]:
    """Return the principal axes of covariances as columns, one standard deviation long, from their factors.

    Rounding decides the sign of an axis. The sign is fixed, so that equal random numbers give equal draws on every
    machine. (The first component that is not small is made positive, because the largest may not be unique.)
    """
    vectors, lengths, _ = np.linalg.svd(covariance_factors)
    sizes = np.abs(vectors)
    first = np.argmax(sizes > 0.5 * sizes.max(axis=-2, keepdims=True), axis=-2, keepdims=True)
    return vectors * np.sign(np.take_along_axis(vectors, first, axis=-2)) * lengths[..., None, :]


def triangular_axes(covariance_factor: Float[np.ndarray, "n n"], order: Sequence[int]) -> Float[np.ndarray, "n n"]:
    """Return a factor of the covariance as columns; the k-th changes none of the first k coordinates in `order`."""
    _, triangle = np.linalg.qr(covariance_factor[list(order)].T)
    axes = np.empty_like(triangle)
    axes[list(order)] = triangle.T * np.sign(np.diagonal(triangle))
    return axes


def leading_axes(covariance_factor: Float[np.ndarray, "n n"], first: int) -> Float[np.ndarray, "n n"]:
    """Return the axis along which a coordinate changes, and the principal ones of what is left, as columns."""
    others = np.delete(np.arange(len(covariance_factor)), first)
    axes = triangular_axes(covariance_factor, [first, *others])[:, [first, *others]]
    axes[others, 1:] = principal_axes(axes[others, 1:])
    return axes


def draw_student_t(random: Random, count: int, size: int) -> Float[np.ndarray, "count size"]:
    """Draw from a Student-t around 0 with unit scale matrix."""
    z = random.standard_normal((count, size))
    return z * np.sqrt(DEGREES_OF_FREEDOM / random.chisquare(DEGREES_OF_FREEDOM, (count, 1)))


def student_log_density(z: Float[np.ndarray, "*shape size"]) -> Float[np.ndarray, "*shape"]:
    dof, size = DEGREES_OF_FREEDOM, z.shape[-1]
    log_norm = math.lgamma(0.5 * (dof + size)) - math.lgamma(0.5 * dof) - 0.5 * size * math.log(math.pi * dof)
    return log_norm - 0.5 * (dof + size) * np.log1p(np.sum(z**2, axis=-1) / dof)


def is_normal(log_densities: Float[np.ndarray, "*shape probes"], tolerance: float = 0.3) -> Bool[np.ndarray, "*shape"]:
    """Return whether the log-densities at `PROBES` along an axis are normal within `tolerance`."""
    with np.errstate(invalid="ignore"):  # the density at the center may be zero
        departure = log_densities - log_densities[..., 2:3] + 0.5 * PROBES**2
    return np.all(np.abs(departure) < tolerance, axis=-1)


def _enter_support(
    center: Float[np.ndarray, " n"],
    axes: Float[np.ndarray, "n n"],
    order: list[int],
    log_prob: LogDensity,
    draws: int = 4096,
) -> tuple[list[int], Float[np.ndarray, " n"]]:
    """Return the order in which to tabulate the axes, and the center, or where no axis meets the support, a draw in it.

    Where a bound excludes the center, the axis that leads to the highest density comes first. Along another, the
    support may begin only far from the data.
    """
    if np.isfinite(log_prob(center[None])[0]):
        return order, center
    heights = [float(np.max(log_prob(center + _SEARCH[:, None] * axis))) for axis in axes.T]
    if max(heights) > -math.inf:
        order.insert(0, order.pop(order.index(int(np.argmax(heights)))))
        return order, center
    points = center + draw_student_t(np.random.default_rng(0), draws, center.size) @ axes.T
    values = log_prob(points)
    return order, points[np.argmax(values)] if np.isfinite(values).any() else center


def _tabulate(
    log_density: Callable[[np.ndarray], np.ndarray], log_density_range: float = 25.0
) -> TabulatedMarginal | None:
    """Tabulate a log-density of positions; return None if it is normal or zero everywhere.

    The search covers `_SEARCH`. The table ends where the log-density has fallen by `log_density_range` below its
    maximum.
    """
    if is_normal(log_density(PROBES)):
        return None
    values, cells = log_density(_SEARCH), _SEARCH.size - 1
    if not np.isfinite(values).any():
        return None
    likely = np.flatnonzero(values > np.max(values) - log_density_range)
    low, high = _SEARCH[max(likely[0] - 1, 0)], _SEARCH[min(likely[-1] + 1, cells)]
    edges = np.linspace(low, high, cells + 1)
    return TabulatedMarginal.from_log_density(low, (high - low) / cells, log_density(edges))
