"""Profile-likelihood intervals: how far a quantity may move before the best of all else fits too badly.

A pseudo-datum of the quantity drags the least squares along. Wherever it comes to rest, all else is at its best
for the value that the quantity has there, so each end is an exact point of the profile, and what is sought is
the value at which the deviance has risen by a quantile of chi-square (Wilks, Ann. Math. Statist. 9 (1938) 60).
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from statistics import NormalDist
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitact.errors import InputError
from fitact.fitting.derived import DERIVED_NAMES, DerivedQuantities
from fitact.fitting.laplace import FitResult
from fitact.fitting.levenberg_marquardt import minimise
from fitact.likelihood.likelihood import UNCONSTRAINED_SD, Likelihood
from fitact.tables import align_rows, join_lines
from fitact.units import format_engineering, quantity_unit

PROFILE_QUANTITIES = ("g", "b", "force_mean")


@dataclasses.dataclass(frozen=True)
class Interval:
    """Where a quantity may lie, in its SI unit; an open side is 0 or infinite (a delay's or a clock's: infinite)."""

    low: float
    high: float
    level: float  # its probability, by the chi-square law of one parameter
    prior: bool  # whether the circuit's prior speaks in it

    @property
    def open(self) -> str:
        """Which sides are open, to a factor of a million at least: "", "low", "high" or "both"."""
        low, high = self.low in (0.0, -math.inf), self.high == math.inf
        return "both" if low and high else "low" * low + "high" * high

    def to_dict(self) -> dict[str, Any]:
        """Return its part of fit.json, where an open end is None."""
        ends = {name: None if self.open in (name, "both") else getattr(self, name) for name in ("low", "high")}
        return ends | {"open": self.open, "level": self.level, "prior": self.prior}


class ConstrainedFit(eqx.Module):
    """A fit whose quantities can be pinned: theta, or the logarithms of `PROFILE_QUANTITIES`."""

    likelihood: Likelihood  # with or without the circuit's prior
    sigma: Float[Array, " channels"]  # the channels' noise, which is held
    derive: DerivedQuantities | None  # None: the quantities are theta itself

    def quantities(self, theta: Float[Array, " parameters"]) -> Float[Array, " quantities"]:
        """Their values at theta."""
        if self.derive is None:
            return theta
        values = self.derive(theta, self.sigma)
        return jnp.log(jnp.stack([values[DERIVED_NAMES.index(name)] for name in PROFILE_QUANTITIES]))


@eqx.filter_jit
def _fit_constrained(
    model: ConstrainedFit, indices: Array, goal: Array, weight: Array, start: Array
) -> tuple[Array, Array, Array]:
    """For each row: theta, the quantity and the deviance where a pseudo-datum `goal` of that weight drags them."""

    def fit_row(index: Array, goal: Array, weight: Array, start: Array) -> tuple[Array, Array, Array]:
        def residuals(theta: Array) -> tuple[Any, ...]:
            pull = weight * (model.quantities(theta)[index] - goal)
            return model.likelihood.residuals(theta, model.sigma), model.likelihood.prior_residuals(theta), pull

        found = minimise(residuals, start, max_steps=200)
        value = model.quantities(found.theta)[index]
        return found.theta, value, 2.0 * found.cost - jnp.square(weight * (value - goal))

    # one after the other: side by side, long records would want much memory
    return jax.lax.map(lambda row: fit_row(*row), (indices, goal, weight, start))


def profile_intervals(fit: FitResult, names: Sequence[str], level: float, prior: bool) -> dict[str, Interval]:
    """Profile-likelihood intervals of the quantities `names` around an optimum, at its noise."""
    if not 0.0 < level < 1.0:
        raise InputError(f"level = {level}: give a probability between 0 and 1, such as 0.95")
    likelihood, timing = fit.likelihood, fit.likelihood.timing
    for name in names:
        if name not in (available := (*likelihood.names, *PROFILE_QUANTITIES)):
            raise InputError(f"there is no interval of {name}; choose from {', '.join(available)}")
    derived_sd = fit.laplace.derived_log_sd[[DERIVED_NAMES.index(name) for name in PROFILE_QUANTITIES]]
    intervals = {}
    with jax.enable_x64(True):
        likelihood = dataclasses.replace(likelihood.without_samples(), use_prior=prior and likelihood.use_prior)
        for kind, sd, derive in ((likelihood.names, fit.sd, None), (PROFILE_QUANTITIES, derived_sd, fit.derive)):
            chosen = [name for name in names if name in kind]
            if not chosen:
                continue
            model = ConstrainedFit(likelihood, jnp.asarray(fit.laplace.sigmas), derive)
            sides = interval_bounds(model, fit.theta, sd, [kind.index(name) for name in chosen], level)
            for name, side in zip(chosen, sides, strict=True):
                low, high = timing[name][0] + side * timing[name][1] if name in timing else np.exp(side)
                intervals[name] = Interval(float(low), float(high), level, likelihood.use_prior)
    return intervals


def interval_bounds(
    model: ConstrainedFit,
    theta: Float[np.ndarray, " parameters"],
    sd: Float[np.ndarray, " quantities"],
    indices: Sequence[int],
    level: float,
    pseudo_datum_sd: float = 0.05,
    root_tolerance: float = 1e-4,
    max_rounds: int = 30,
) -> Float[np.ndarray, "quantities 2"]:
    """The ends of the intervals of the quantities `indices`; not finite where a side is open.

    All sides are sought at once, each between the last value that was too near and the last that was too far. `sd` are
    the errors to expect, of which the pseudo-datum's is `pseudo_datum_sd`; `root_tolerance` is that of the root of the
    deviance, relative.
    """
    z = NormalDist().inv_cdf(0.5 * (1.0 + level))
    lanes, side = np.repeat(np.asarray(indices), 2), np.tile([-1.0, 1.0], len(indices))
    expected = np.minimum(sd[lanes], UNCONSTRAINED_SD / z)
    weight = 1.0 / (pseudo_datum_sd * expected)
    points = np.tile(theta, (lanes.size, 1))
    points, middle, least = map(np.asarray, _fit_constrained(model, lanes, np.zeros(lanes.size), 0.0 * weight, points))
    # the goals last found too near and too far, of which a quantity falls a little short, and the deviance's root there
    near, far = np.zeros((2, lanes.size)), np.full((2, lanes.size), np.inf)
    goal, found, within = z * expected, np.full(lanes.size, np.nan), np.zeros(lanes.size)
    for _ in range(max_rounds):
        there, value, deviance = map(np.asarray, _fit_constrained(model, lanes, middle + side * goal, weight, points))
        out, root = side * (value - middle), np.sqrt(np.maximum(deviance - least, 0.0))
        short = root < z  # false where it is not finite
        near, far = np.where(short, [goal, root], near), np.where(short, far, [goal, root])
        within = np.where(short, out, within)
        points = np.where(np.isfinite(there) & short[:, None], there, points)
        done = np.isnan(found) & (np.abs(root - z) < root_tolerance * z)
        found = np.where(done, out, np.where(np.isnan(found) & short & (goal >= UNCONSTRAINED_SD), np.inf, found))
        if not np.isnan(found).any():
            break
        goal = np.where(np.isnan(found), _next_goal(near, far, z), goal)
    found = np.where(np.isnan(found), within, found)
    return (middle + side * found).reshape(-1, 2)


def _next_goal(inner: np.ndarray, outer: np.ndarray, z: float) -> np.ndarray:
    """Where to look next: by a line through what is known, kept away from the ends of what is left."""
    with np.errstate(divide="ignore", invalid="ignore"):
        line = inner[0] + (outer[0] - inner[0]) * (z - inner[1]) / (outer[1] - inner[1])
        ahead = inner[0] * np.clip(z / inner[1], 1.1, 4.0)
    inside = np.clip(line, 0.95 * inner[0] + 0.05 * outer[0], 0.05 * inner[0] + 0.95 * outer[0])
    inside = np.where(np.isfinite(inside), inside, 0.5 * (inner[0] + outer[0]))
    return np.minimum(np.where(np.isinf(outer[0]), ahead, inside), UNCONSTRAINED_SD)


def table(with_prior: Mapping[str, Interval], without_prior: Mapping[str, Interval]) -> str:
    """Both kinds of intervals, for people."""

    def format_interval(name: str, interval: Interval) -> str:
        ends = [
            "open" if interval.open in (side, "both") else format_engineering(end, quantity_unit(name))
            for side, end in (("low", interval.low), ("high", interval.high))
        ]
        return f"{ends[0]} to {ends[1]}"

    level = next(iter(with_prior.values())).level
    cells = [(f"{100.0 * level:g} % interval", "with the prior", "of the records alone")]
    for name, interval in with_prior.items():
        cells.append((name, format_interval(name, interval), format_interval(name, without_prior[name])))
    return join_lines(align_rows(cells, (14, 28, 28)))
