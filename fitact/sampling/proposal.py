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
DEGREES = 8.0  # of freedom: tails above any posterior's seen here
_SAFE = 0.1  # share drawn from the Student-t even where there are tables, so that no place is out of reach
PROBES = np.array([-2.5, -1.0, 0.0, 1.0, 2.5])  # standard deviations along an axis, at which it is compared
_NORMAL = 0.3  # departure from the normal's log-density there, above which an axis is tabulated
_FAR = 40.0  # standard deviations that are searched either way
_CELLS = 256
_NEGLIGIBLE = 25.0  # below the highest log-density, from where a table holds nothing


@dataclasses.dataclass(frozen=True)
class Table:
    """A density of one coordinate, constant within cells of one width."""

    low: float
    width: float
    mass: Float[np.ndarray, " cells"]

    @classmethod
    def of(cls, low: float, width: float, log_density: Float[np.ndarray, " edges"]) -> Self:
        """Each cell as high as the higher of its ends, so that it never falls short where the density ends within."""
        height = np.exp(np.maximum(log_density[1:], log_density[:-1]) - np.max(log_density))
        return cls(low, width, height / height.sum())

    def widened(self, factor: float) -> Self:
        """With the log-density divided by the square of `factor`, which widens a normal by `factor`."""
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
    """A density in the coordinates of the posterior, to draw from.

    Attributes:
        center: of the Student-t.
        axes: its principal axes as columns, a standard deviation long.
        tables: densities along some axes, in standard deviations from the center.
    """

    center: Float[np.ndarray, " n"]
    axes: Float[np.ndarray, "n n"]
    tables: dict[int, Table] = dataclasses.field(default_factory=dict)

    @classmethod
    def around(cls, point: Float[np.ndarray, " n"], root: Float[np.ndarray, "n n"], log_prob: LogProb) -> Self:
        """A Laplace approximation, with tables along the axes on which `log_prob` is not normal."""
        vectors, lengths, _ = np.linalg.svd(root)
        axes, center, tables = vectors * lengths, np.array(point, dtype=float), {}
        for i, axis in enumerate(axes.T):
            table = _along(center, axis, log_prob)
            if table is not None:
                center = center + table.median * axis
                tables[i] = dataclasses.replace(table, low=table.low - table.median)
        return cls(center, axes, tables)

    def widened(self, factor: float) -> Self:
        """Wider by `factor` where it is normal, as far as its limits allow where it is not."""
        tables = {i: table.widened(factor) for i, table in self.tables.items()}
        longer = np.array([1.0 if i in tables else factor for i in range(self.center.size)])
        return dataclasses.replace(self, axes=self.axes * longer, tables=tables)

    def draw(self, random: Random, count: int) -> Float[np.ndarray, "count n"]:
        """Points."""
        white = student(random, count, self.center.size)
        tabulated = random.uniform(size=count) >= _SAFE
        for i, table in self.tables.items():
            white[:, i] = np.where(tabulated, table.draw(random, count), white[:, i])
        return self.center + white @ self.axes.T

    def log_density(self, points: Float[np.ndarray, "count n"]) -> Float[np.ndarray, " count"]:
        """Up to a constant."""
        white = np.linalg.solve(self.axes, (points - self.center).T).T
        if not self.tables:
            return student_log_density(white)
        others = [i for i in range(self.center.size) if i not in self.tables]
        tabulated = student_log_density(white[:, others])
        for i, table in self.tables.items():
            tabulated = tabulated + table.log_density(white[:, i])
        return np.logaddexp(np.log(1.0 - _SAFE) + tabulated, np.log(_SAFE) + student_log_density(white))

    def move(
        self, points: Float[np.ndarray, "count n"], random: np.random.RandomState
    ) -> tuple[Float[np.ndarray, "count n"], Float[np.ndarray, " count"]]:
        """emcee's proposal function: new points, and log q(old) - log q(new)."""
        proposed = self.draw(random, len(points))
        return proposed, self.log_density(points) - self.log_density(proposed)


def student(random: Random, count: int, size: int) -> Float[np.ndarray, "count size"]:
    """Draws around 0, a standard deviation of the normal that it stands over being 1."""
    return random.standard_normal((count, size)) * np.sqrt(DEGREES / random.chisquare(DEGREES, (count, 1)))


def student_log_density(white: Float[np.ndarray, "*shape size"]) -> Float[np.ndarray, "*shape"]:
    """Of such draws."""
    size = white.shape[-1]
    scale = math.lgamma(0.5 * (DEGREES + size)) - math.lgamma(0.5 * DEGREES) - 0.5 * size * math.log(math.pi * DEGREES)
    return scale - 0.5 * (DEGREES + size) * np.log1p(np.sum(white**2, axis=-1) / DEGREES)


def is_normal(probed: Float[np.ndarray, "*shape probes"]) -> Bool[np.ndarray, "*shape"]:
    """Whether log-densities at `PROBES` along an axis are those of a normal, or nearly so."""
    with np.errstate(invalid="ignore"):  # the center itself may be impossible
        departure = probed - probed[..., 2:3] + 0.5 * PROBES**2
    return np.all(np.abs(departure) < _NORMAL, axis=-1)


def _along(center: Float[np.ndarray, " n"], axis: Float[np.ndarray, " n"], log_prob: LogProb) -> Table | None:
    """The density on a line, in lengths of `axis`; None where it is normal, or nothing is found."""

    def on_line(places: np.ndarray) -> np.ndarray:
        return log_prob(center + places[:, None] * axis)

    probed = on_line(PROBES)
    if is_normal(probed):
        return None
    reach = np.arcsinh(_FAR)
    places = np.sinh(np.linspace(-reach, reach, _CELLS + 1))  # dense where it is likely
    values = on_line(places)
    if not np.isfinite(values).any():
        return None
    held = np.flatnonzero(values > np.max(values) - _NEGLIGIBLE)
    low, high = places[max(held[0] - 1, 0)], places[min(held[-1] + 1, _CELLS)]
    return Table.of(low, (high - low) / _CELLS, on_line(np.linspace(low, high, _CELLS + 1)))
