"""Proposal density of moves and importance sampling: a Student-t around the fit, with tabulated marginals.

With a bounded prior, the posterior is far from normal in directions that the data do not constrain. Along such a
direction, the density on a line through the optimum is tabulated; the other directions keep the Student-t.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Self

import numpy as np
from jaxtyping import Bool, Float

LogProb = Callable[[np.ndarray], np.ndarray]
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
    """Proposal density in the coordinates of the posterior."""

    center: Float[np.ndarray, " n"]  # center of the Student-t
    axes: Float[np.ndarray, "n n"]  # principal axes as columns, one standard deviation long
    # densities along some axes, by index of the axis, in standard deviations from the center
    tables: dict[int, TabulatedMarginal] = dataclasses.field(default_factory=dict)
    # by tabulated axis, how far the other axes bend with the square of the position along it
    bends: dict[int, Float[np.ndarray, " n"]] = dataclasses.field(default_factory=dict)
    student_share: float = 0.1  # fraction drawn from the Student-t alone, so that the support has no bounds

    @classmethod
    def from_laplace(
        cls,
        point: Float[np.ndarray, " n"],
        covariance_factor: Float[np.ndarray, "n n"],
        log_prob: LogProb,
        order: Sequence[int] = (),
    ) -> Self:
        """Build a proposal from a Laplace approximation; tabulate the axes along which `log_prob` is not normal.

        With an `order` of the coordinates, each axis changes one of them, and those after it as the covariance says.
        If several priors that the data do not narrow have bounds, those coordinates should come first. Otherwise the
        axes are the principal ones.
        """
        axes = triangular_axes(covariance_factor, order) if len(order) else principal_axes(covariance_factor)
        center, tables = np.array(point, dtype=float), {}
        order, center = _enter_support(center, axes, log_prob)
        for i in order:
            table = _tabulate_axis(center, axes[:, i], log_prob)
            if table is not None:
                center = center + table.median * axes[:, i]
                tables[i] = dataclasses.replace(table, low=table.low - table.median)
        bends = {i: _bend(center, axes, i, [k for k in order if k not in tables], log_prob) for i in tables}
        return cls(center, axes, tables, bends)

    def scale_width(self, factor: float) -> Self:
        """Widen the Student-t by `factor`, and the tables as far as their limits allow."""
        tables = {i: table.scale_width(factor) for i, table in self.tables.items()}
        longer = np.array([1.0 if i in tables else factor for i in range(self.center.size)])
        return dataclasses.replace(self, axes=self.axes * longer, tables=tables)

    def draw(self, random: Random, count: int) -> Float[np.ndarray, "count n"]:
        z = draw_student_t(random, count, self.center.size)
        tabulated = random.uniform(size=count) >= self.student_share
        for i, table in self.tables.items():
            z[:, i] = np.where(tabulated, table.draw(random, count), z[:, i])
        return self.center + (z + self._bend(z)) @ self.axes.T

    def _bend(self, z: Float[np.ndarray, "count n"]) -> Float[np.ndarray, "count n"]:
        """Return the bend of the axes without tables, which changes no volume."""
        return sum((np.outer(z[:, i] ** 2, bend) for i, bend in self.bends.items()), np.zeros_like(z))

    def log_density(self, points: Float[np.ndarray, "count n"]) -> Float[np.ndarray, " count"]:
        """Return the logarithm of the density, up to a constant."""
        z = np.linalg.solve(self.axes, (points - self.center).T).T
        z = z - self._bend(z)
        if not self.tables:
            return student_log_density(z)
        others = [i for i in range(self.center.size) if i not in self.tables]
        tabulated = student_log_density(z[:, others])
        for i, table in self.tables.items():
            tabulated = tabulated + table.log_density(z[:, i])
        fraction = self.student_share
        return np.logaddexp(np.log(1.0 - fraction) + tabulated, np.log(fraction) + student_log_density(z))

    def move(
        self, points: Float[np.ndarray, "count n"], random: np.random.RandomState
    ) -> tuple[Float[np.ndarray, "count n"], Float[np.ndarray, " count"]]:
        """Return new points and log q(old) - log q(new), as emcee expects of a proposal function."""
        proposed = self.draw(random, len(points))
        return proposed, self.log_density(points) - self.log_density(proposed)


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
    center: Float[np.ndarray, " n"], axes: Float[np.ndarray, "n n"], log_prob: LogProb, draws: int = 4096
) -> tuple[list[int], Float[np.ndarray, " n"]]:
    """Return the order in which to tabulate the axes, and the center, or where no axis meets the support, a draw in it.

    Where a bound excludes the center, the axis that leads to the highest density comes first. Along another, the
    support may begin only far from the data.
    """
    order = list(range(center.size))
    if np.isfinite(log_prob(center[None])[0]):
        return order, center
    heights = [float(np.max(log_prob(center + _SEARCH[:, None] * axis))) for axis in axes.T]
    if max(heights) > -math.inf:
        order.insert(0, order.pop(int(np.argmax(heights))))
        return order, center
    points = center + draw_student_t(np.random.default_rng(0), draws, center.size) @ axes.T
    values = log_prob(points)
    return order, points[np.argmax(values)] if np.isfinite(values).any() else center


def _bend(
    center: Float[np.ndarray, " n"],
    axes: Float[np.ndarray, "n n"],
    along: int,
    others: list[int],
    log_prob: LogProb,
    position: float = 1.0,
    step: float = 0.5,
) -> Float[np.ndarray, " n"]:
    """Return by how much the most probable values on the axes `others` move with the square of the position on `along`.

    All are in lengths of the axes, along which the density is nearly normal: the gradient is then the distance. The
    positions are in the middle and on both sides; a bound within them leaves 0.
    """
    if not others:
        return np.zeros(len(center))
    ends = np.zeros((3, len(others), 2, len(center)))  # position, other axis, direction
    ends[..., along] = position * np.array([-1.0, 0.0, 1.0])[:, None, None]
    for place, other in enumerate(others):
        ends[:, place, :, other] = step * np.array([-1.0, 1.0])
    values = log_prob(center + ends.reshape(-1, len(center)) @ axes.T).reshape(ends.shape[:-1])
    bend = np.zeros(len(center))
    if np.all(np.isfinite(values)):
        below, middle, above = np.diff(values, axis=2)[..., 0] / (2.0 * step)
        bend[others] = (0.5 * (below + above) - middle) / position**2
    return bend


def _tabulate_axis(
    center: Float[np.ndarray, " n"], axis: Float[np.ndarray, " n"], log_prob: LogProb, log_density_range: float = 25.0
) -> TabulatedMarginal | None:
    """Tabulate the density on a line, in lengths of `axis`; return None if it is normal or zero everywhere.

    The search covers `_SEARCH`. The table ends where the log-density has fallen by `log_density_range` below its
    maximum.
    """

    def line_log_prob(positions: np.ndarray) -> np.ndarray:
        return log_prob(center + positions[:, None] * axis)

    if is_normal(line_log_prob(PROBES)):
        return None
    values, cells = line_log_prob(_SEARCH), _SEARCH.size - 1
    if not np.isfinite(values).any():
        return None
    likely = np.flatnonzero(values > np.max(values) - log_density_range)
    low, high = _SEARCH[max(likely[0] - 1, 0)], _SEARCH[min(likely[-1] + 1, cells)]
    edges = np.linspace(low, high, cells + 1)
    return TabulatedMarginal.from_log_density(low, (high - low) / cells, line_log_prob(edges))
