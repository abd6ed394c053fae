"""Profile-likelihood intervals.

A pseudo-datum of the quantity shifts the least-squares optimum. At the shifted optimum all other parameters are optimal
for the value of the quantity there, so it is an exact point of the profile. An interval ends where the deviance has
risen by a quantile of chi-square (Wilks, Ann. Math. Statist. 9 (1938) 60).
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

from fitact.compiled import double_precision, jit
from fitact.errors import InputError
from fitact.fitting.derived import DERIVED_NAMES, DerivedQuantities
from fitact.fitting.laplace import Laplace
from fitact.fitting.minimum import minimise
from fitact.likelihood.likelihood import UNCONSTRAINED_SD, Likelihood
from fitact.summary import format_range
from fitact.tables import align_table, join_lines
from fitact.units import format_engineering, quantity_unit

DIVIDER = ("g", "b")
PROFILE_QUANTITIES = (*DIVIDER, "force_mean")


@dataclasses.dataclass(frozen=True)
class Interval:
    """Interval of a quantity in its SI unit; an open end is 0 or infinite (for a delay or clock error, infinite)."""

    low: float
    high: float
    level: float  # confidence level, from chi-square with one degree of freedom
    prior: bool  # whether it includes the prior of the circuit

    @property
    def open(self) -> str:
        """Open ends (open by a factor of a million or more): "", "low", "high" or "both"."""
        low, high = self.low in (0.0, -math.inf), self.high == math.inf
        return "both" if low and high else "low" * low + "high" * high

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of fit.json, in which an open end is None."""
        ends = {name: None if self.open in (name, "both") else getattr(self, name) for name in ("low", "high")}
        return ends | {"open": self.open, "level": self.level, "prior": self.prior}


class ConstrainedFit(eqx.Module):
    """Fit with a constrained quantity: an element of theta, or the logarithm of g, b or the mean force."""

    likelihood: Likelihood  # likelihood with or without the prior of the circuit
    sigma: Float[Array, " channels"]  # noise sd of the channels, fixed
    derive: DerivedQuantities | None  # of the mean force; without it, the quantities are theta and those of `DIVIDER`

    def quantities(self, theta: Float[Array, " parameters"]) -> Float[Array, " quantities"]:
        """Return the values of the quantities at theta."""
        if self.derive is not None:
            return jnp.log(self.derive(theta, self.sigma)[DERIVED_NAMES.index("force_mean")])[None]
        finger = self.likelihood.finger(self.likelihood.circuit(theta))
        return jnp.concatenate([theta, jnp.log(jnp.stack([finger.g, finger.b]))])


@jit
def _fit_constrained(
    model: ConstrainedFit, indices: Array, goal: Array, weight: Array, start: Array
) -> tuple[Array, Array, Array]:
    """Return, for each row, theta, the quantity and the deviance at the optimum with a pseudo-datum `goal`."""

    def fit_row(index: Array, goal: Array, weight: Array, start: Array) -> tuple[Array, Array, Array]:
        def residuals(theta: Array) -> tuple[Any, ...]:
            pull = weight * (model.quantities(theta)[index] - goal)
            return model.likelihood.residuals(theta, model.sigma), model.likelihood.prior_residuals(theta), pull

        minimum = minimise(residuals, start, max_steps=200, elements=model.likelihood.elements)
        value = model.quantities(minimum.theta)[index]
        return minimum.theta, value, 2.0 * minimum.cost - jnp.square(weight * (value - goal))

    # rows are evaluated one after the other, because long records would need much memory in parallel
    return jax.lax.map(lambda row: fit_row(*row), (indices, goal, weight, start))


def profile_intervals(laplace: Laplace, names: Sequence[str], level: float, prior: bool) -> dict[str, Interval]:
    """Return profile-likelihood intervals of the quantities `names`, at the noise of the fit; see `Fit.profile`."""
    if not 0.0 < level < 1.0:
        raise InputError(f"level = {level}: give a probability between 0 and 1, such as 0.95")
    likelihood, timing = laplace.likelihood, laplace.likelihood.timing
    for name in names:
        if name not in (available := (*likelihood.names, *PROFILE_QUANTITIES)):
            raise InputError(f"no interval is available for {name}; choose from {', '.join(available)}")
    intervals = {}
    with double_precision():
        likelihood = dataclasses.replace(likelihood.without_samples(), use_prior=prior and likelihood.use_prior)
        sd = dict(zip(likelihood.names, np.linalg.norm(laplace.covariance_root, axis=1), strict=True))
        sd |= zip(DERIVED_NAMES, laplace.derived_log_sd, strict=True)
        for kind, derive in (((*likelihood.names, *DIVIDER), None), (("force_mean",), laplace.derive)):
            chosen = [name for name in names if name in kind]
            if not chosen:
                continue
            model = ConstrainedFit(likelihood, jnp.asarray(laplace.sigmas), derive)
            indices, errors = [kind.index(name) for name in chosen], np.array([sd[name] for name in chosen])
            sides = interval_bounds(model, laplace.theta, errors, indices, level)
            for name, side in zip(chosen, sides, strict=True):
                low, high = timing[name][0] + side * timing[name][1] if name in timing else np.exp(side)
                intervals[name] = Interval(float(low), float(high), level, likelihood.use_prior)
    return intervals


def compare_with_normal(laplace: Laplace, name: str, z: float) -> tuple[float, float]:
    """Return as how many standard deviations `z` of them count, below and above the optimum.

    These are roots of the deviance of the profile of g or b: `z` if its posterior is normal.
    """
    index = len(laplace.likelihood.names) + DIVIDER.index(name)
    sd = laplace.derived_log_sd[DERIVED_NAMES.index(name)]
    with double_precision():
        model = ConstrainedFit(laplace.likelihood.without_samples(), jnp.asarray(laplace.sigmas), None)
        side, rows = np.array([0.0, -1.0, 1.0]), np.full(3, index)  # the first is the optimum, without a pseudo-datum
        center = float(laplace.log_derived[0][DERIVED_NAMES.index(name)])
        goal, weight, points = center + z * sd * side, 20.0 / sd * np.abs(side), np.tile(laplace.theta, (3, 1))
        _, value, deviance = map(np.asarray, _fit_constrained(model, rows, goal, weight, points))
    distance = np.abs(value[1:] - value[0]) / (z * sd)  # slightly less than 1
    low, high = np.sqrt(np.maximum(deviance[1:] - deviance[0], 0.0)) / distance
    return float(low), float(high)


def interval_bounds(
    model: ConstrainedFit,
    theta: Float[np.ndarray, " parameters"],
    sd: Float[np.ndarray, " indices"],
    indices: Sequence[int],
    level: float,
) -> Float[np.ndarray, "indices 2"]:
    """Return the bounds of the intervals of the quantities `indices`; an open bound is not finite.

    All bounds are searched in parallel, each between the last value that was too near and the last that was too far.
    `sd` holds the expected standard error of each.
    """
    pseudo_datum_sd = 0.05  # relative to these
    root_tolerance, max_rounds = 1e-4, 30  # relative, of the square root of the deviance
    z = NormalDist().inv_cdf(0.5 * (1.0 + level))
    rows, side = np.repeat(np.asarray(indices), 2), np.tile([-1.0, 1.0], len(indices))
    expected = np.minimum(np.repeat(sd, 2), UNCONSTRAINED_SD / z)
    weight = 1.0 / (pseudo_datum_sd * expected)
    points, zeros = np.tile(theta, (rows.size, 1)), np.zeros(rows.size)
    points, optimum, minimum = map(np.asarray, _fit_constrained(model, rows, zeros, 0.0 * weight, points))
    # last goals that were too near and too far, with the root of the deviance; quantities stay slightly short of goals
    inner, outer = np.zeros((2, rows.size)), np.full((2, rows.size), np.inf)
    goal, bound, inside = z * expected, np.full(rows.size, np.nan), np.zeros(rows.size)
    for _ in range(max_rounds):
        new, value, deviance = map(np.asarray, _fit_constrained(model, rows, optimum + side * goal, weight, points))
        distance, root = side * (value - optimum), np.sqrt(np.maximum(deviance - minimum, 0.0))
        short = root < z  # false if it is not finite
        inner, outer = np.where(short, [goal, root], inner), np.where(short, outer, [goal, root])
        inside = np.where(short, distance, inside)
        points = np.where(np.isfinite(new) & short[:, None], new, points)
        done = np.isnan(bound) & (np.abs(root - z) < root_tolerance * z)
        bound = np.where(done, distance, np.where(np.isnan(bound) & short & (goal >= UNCONSTRAINED_SD), np.inf, bound))
        if not np.isnan(bound).any():
            break
        goal = np.where(np.isnan(bound), _next_goal(inner, outer, z), goal)
    bound = np.where(np.isnan(bound), inside, bound)
    return (optimum + side * bound).reshape(-1, 2)


def _next_goal(inner: np.ndarray, outer: np.ndarray, z: float) -> np.ndarray:
    """Return the next goals by linear interpolation, kept away from the ends of the bracket."""
    with np.errstate(divide="ignore", invalid="ignore"):
        line = inner[0] + (outer[0] - inner[0]) * (z - inner[1]) / (outer[1] - inner[1])
        extrapolated = inner[0] * np.clip(z / inner[1], 1.1, 4.0)
    inside = np.clip(line, 0.95 * inner[0] + 0.05 * outer[0], 0.05 * inner[0] + 0.95 * outer[0])
    inside = np.where(np.isfinite(inside), inside, 0.5 * (inner[0] + outer[0]))
    return np.minimum(np.where(np.isinf(outer[0]), extrapolated, inside), UNCONSTRAINED_SD)


def table(with_prior: Mapping[str, Interval], without_prior: Mapping[str, Interval]) -> str:
    """Return a text table of the intervals with and without the prior."""

    def format_interval(name: str, interval: Interval) -> str:
        if not interval.open:
            return format_range(interval.low, interval.high, 0.25 * (interval.high - interval.low), quantity_unit(name))
        ends = [
            "unbounded" if interval.open in (side, "both") else format_engineering(end, quantity_unit(name), 2)
            for side, end in (("low", interval.low), ("high", interval.high))
        ]
        return " to ".join(ends)

    level = next(iter(with_prior.values())).level
    cells = [(f"{100.0 * level:g} % interval", "with prior", "data only")]
    for name, interval in with_prior.items():
        cells.append((name, format_interval(name, interval), format_interval(name, without_prior[name])))
    return join_lines(align_table(cells))
