"""What moves and importance weights draw from: a Student-t over the fit, and tables where that is not the shape.

A bounded prior leaves the posterior anything but normal along what the data cannot see. There the density
on a line through the optimum is tabulated, and drawn from; across it the Student-t remains.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Self

import numpy as np
from jaxtyping import Bool, Float

LogProb = Callable[[np.ndarray], np.ndarray]
Random = np.random.RandomState | np.random.Generator

SHARES = (0.7, 0.3)  # of moves that draw from here, and of stretch moves
OVERDISPERSION = 1.5  # of the walkers' start, so that ensembles that agree have had to find each other
DEGREES_OF_FREEDOM = 8.0  # of the Student-t: tails above any posterior's met so far
PROBES = np.array([-2.5, -1.0, 0.0, 1.0, 2.5])  # standard deviations along an axis, at which it is compared


@dataclasses.dataclass(frozen=True)
class TabulatedMarginal:
    """A density of one coordinate, constant within cells of one width."""

    low: float
    width: float
    mass: Float[np.ndarray, " cells"]

    @classmethod
    def from_log_density(cls, low: float, width: float, log_density: Float[np.ndarray, " edges"]) -> Self:
        """Make each cell as high as the higher of its ends, so it never falls short where the density ends within."""
        height = np.exp(np.maximum(log_density[1:], log_density[:-1]) - np.max(log_density))
        return cls(low, width, height / height.sum())

    def scale_width(self, factor: float) -> Self:
        """Divide the log-density by the square of `factor`, which widens a normal by `factor`."""
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
    """A density in the coordinates of the posterior, to draw from."""

    center: Float[np.ndarray, " n"]  # of the Student-t
    axes: Float[np.ndarray, "n n"]  # its principal axes as columns, a standard deviation long
    # densities along some axes, in standard deviations from the center
    tables: dict[int, TabulatedMarginal] = dataclasses.field(default_factory=dict)
    student_share: float = 0.1  # drawn from the Student-t even where there are tables, so that no place is out of reach

    @classmethod
    def from_laplace(
        cls, point: Float[np.ndarray, " n"], covariance_factor: Float[np.ndarray, "n n"], log_prob: LogProb
    ) -> Self:
        """Take a Laplace approximation, with tables along the axes on which `log_prob` is not normal."""
        axes, center, tables = principal_axes(covariance_factor), np.array(point, dtype=float), {}
        for i, axis in enumerate(axes.T):
            table = _tabulate_axis(center, axis, log_prob)
            if table is not None:
                center = center + table.median * axis
                tables[i] = dataclasses.replace(table, low=table.low - table.median)
        return cls(center, axes, tables)

    def scale_width(self, factor: float) -> Self:
        """Widen by `factor` where it is normal, as far as its limits allow where it is not."""
        tables = {i: table.scale_width(factor) for i, table in self.tables.items()}
        longer = np.array([1.0 if i in tables else factor for i in range(self.center.size)])
        return dataclasses.replace(self, axes=self.axes * longer, tables=tables)

    def draw(self, random: Random, count: int) -> Float[np.ndarray, "count n"]:
        white = draw_student_t(random, count, self.center.size)
        tabulated = random.uniform(size=count) >= self.student_share
        for i, table in self.tables.items():
            white[:, i] = np.where(tabulated, table.draw(random, count), white[:, i])
        return self.center + white @ self.axes.T

    def log_density(self, points: Float[np.ndarray, "count n"]) -> Float[np.ndarray, " count"]:
        """Return the logarithm of the density, up to a constant."""
        white = np.linalg.solve(self.axes, (points - self.center).T).T
        if not self.tables:
            return student_log_density(white)
        others = [i for i in range(self.center.size) if i not in self.tables]
        tabulated = student_log_density(white[:, others])
        for i, table in self.tables.items():
            tabulated = tabulated + table.log_density(white[:, i])
        share = self.student_share
        return np.logaddexp(np.log(1.0 - share) + tabulated, np.log(share) + student_log_density(white))

    def move(
        self, points: Float[np.ndarray, "count n"], random: np.random.RandomState
    ) -> tuple[Float[np.ndarray, "count n"], Float[np.ndarray, " count"]]:
        """Propose as emcee asks it: new points, and log q(old) - log q(new)."""
        proposed = self.draw(random, len(points))
        return proposed, self.log_density(points) - self.log_density(proposed)


def principal_axes(covariance_factors: Float[np.ndarray, "*any n n"]) -> Float[np.ndarray, "*any n n"]:
    """Return the axes of roots of covariances as columns, a standard deviation long.

    Rounding decides which way an axis points; it is turned so that the same draws follow from the same random numbers
    on every machine. (The first component that is not small is positive: the largest may be one of several alike.)
    """
    vectors, lengths, _ = np.linalg.svd(covariance_factors)
    sizes = np.abs(vectors)
    first = np.argmax(sizes > 0.5 * sizes.max(axis=-2, keepdims=True), axis=-2, keepdims=True)
    return vectors * np.sign(np.take_along_axis(vectors, first, axis=-2)) * lengths[..., None, :]


def draw_student_t(random: Random, count: int, size: int) -> Float[np.ndarray, "count size"]:
    """Draw around 0, a standard deviation of the normal that it stands over being 1."""
    white = random.standard_normal((count, size))
    return white * np.sqrt(DEGREES_OF_FREEDOM / random.chisquare(DEGREES_OF_FREEDOM, (count, 1)))


def student_log_density(z: Float[np.ndarray, "*shape size"]) -> Float[np.ndarray, "*shape"]:
    dof, size = DEGREES_OF_FREEDOM, z.shape[-1]
    log_norm = math.lgamma(0.5 * (dof + size)) - math.lgamma(0.5 * dof) - 0.5 * size * math.log(math.pi * dof)
    return log_norm - 0.5 * (dof + size) * np.log1p(np.sum(z**2, axis=-1) / dof)


def is_normal(log_densities: Float[np.ndarray, "*shape probes"], tolerance: float = 0.3) -> Bool[np.ndarray, "*shape"]:
    """Whether log-densities at `PROBES` along an axis are, within `tolerance`, those of a normal."""
    with np.errstate(invalid="ignore"):  # the center itself may be impossible
        departure = log_densities - log_densities[..., 2:3] + 0.5 * PROBES**2
    return np.all(np.abs(departure) < tolerance, axis=-1)


def _tabulate_axis(
    center: Float[np.ndarray, " n"],
    axis: Float[np.ndarray, " n"],
    log_prob: LogProb,
    search_range: float = 40.0,
    cells: int = 256,
    log_density_range: float = 25.0,
) -> TabulatedMarginal | None:
    """Tabulate the density on a line, in lengths of `axis`; None where it is normal, or nothing is found.

    `search_range` lengths are searched either way; from `log_density_range` below the highest log-density on the table
    holds nothing.
    """

    def line_log_prob(places: np.ndarray) -> np.ndarray:
        return log_prob(center + places[:, None] * axis)

    if is_normal(line_log_prob(PROBES)):
        return None
    reach = np.arcsinh(search_range)
    places = np.sinh(np.linspace(-reach, reach, cells + 1))  # dense where it is likely
    values = line_log_prob(places)
    if not np.isfinite(values).any():
        return None
    likely = np.flatnonzero(values > np.max(values) - log_density_range)
    low, high = places[max(likely[0] - 1, 0)], places[min(likely[-1] + 1, cells)]
    edges = np.linspace(low, high, cells + 1)
    return TabulatedMarginal.from_log_density(low, (high - low) / cells, line_log_prob(edges))
