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
from fitact.fitting.derived import NAMES, Derived
from fitact.fitting.levenberg_marquardt import minimise
from fitact.likelihood.likelihood import OPEN, Likelihood
from fitact.units import engineering, unit_of

DERIVED = ("g", "b", "force_mean")
_TIGHT = 0.05  # of the expected error: that of the pseudo-datum
_CLOSE = 1e-4  # relative, of the root of the deviance
_WIDER, _ROUNDS, _STEPS = 4.0, 30, 200


@dataclasses.dataclass(frozen=True)
class Interval:
    """Where a quantity may lie, in its SI unit; an open side is 0 or infinite (a delay's or a clock's: infinite).

    Attributes:
        low, high: its ends.
        level: its probability, by the chi-square law of one parameter.
        prior: whether the circuit's prior speaks in it.
    """

    low: float
    high: float
    level: float
    prior: bool

    @property
    def open(self) -> str:
        """Which sides are open, to a factor of a million at least: "", "low", "high" or "both"."""
        low, high = self.low in (0.0, -math.inf), self.high == math.inf
        return "both" if low and high else "low" * low + "high" * high

    def to_dict(self) -> dict[str, Any]:
        """As in fit.json: an open end is None."""
        ends = {name: None if self.open in (name, "both") else getattr(self, name) for name in ("low", "high")}
        return ends | {"open": self.open, "level": self.level, "prior": self.prior}


class Pinned(eqx.Module):
    """A fit whose quantities can be pinned: theta, or the logarithms of `DERIVED`.

    Attributes:
        likelihood: with or without the circuit's prior.
        sigma: the traces' noise, which is held.
        derive: None: the quantities are theta itself.
    """

    likelihood: Likelihood
    sigma: Float[Array, " traces"]
    derive: Derived | None

    def quantities(self, theta: Float[Array, " parameters"]) -> Float[Array, " quantities"]:
        """Their values at theta."""
        if self.derive is None:
            return theta
        values = self.derive(theta, self.sigma)
        return jnp.log(jnp.stack([values[NAMES.index(name)] for name in DERIVED]))


@eqx.filter_jit
def _pinned(model: Pinned, which: Array, goal: Array, weight: Array, start: Array) -> tuple[Array, Array, Array]:
    """For each row: theta, the quantity and the deviance where a pseudo-datum `goal` of that weight drags them."""

    def one(which: Array, goal: Array, weight: Array, start: Array) -> tuple[Array, Array, Array]:
        def residuals(theta: Array) -> tuple[Any, ...]:
            pull = weight * (model.quantities(theta)[which] - goal)
            return model.likelihood.residuals(theta, model.sigma), model.likelihood.prior_residuals(theta), pull

        found = minimise(residuals, start, max_steps=_STEPS)
        value = model.quantities(found.theta)[which]
        return found.theta, value, 2.0 * found.cost - jnp.square(weight * (value - goal))

    # one after the other: side by side, long records would want much memory
    return jax.lax.map(lambda row: one(*row), (which, goal, weight, start))


def intervals(
    likelihood: Likelihood,
    derive: Derived,
    theta: Float[np.ndarray, " parameters"],
    sigma: Float[np.ndarray, " traces"],
    sd: Mapping[str, float],
    names: Sequence[str],
    level: float,
    prior: bool,
) -> dict[str, Interval]:
    """Intervals of the quantities `names`, around the optimum `theta` at the noise `sigma`.

    `sd` are the errors to expect of theta and the logarithms of `DERIVED`, by name.

    Raises:
        InputError: there is no quantity of that name, or the level is not between 0 and 1.
    """
    if not 0.0 < level < 1.0:
        raise InputError(f"level = {level}: give a probability between 0 and 1, such as 0.95")
    for name in names:
        if name not in sd:
            raise InputError(f"there is no interval of {name}; choose from {', '.join(sd)}")
    timing = likelihood.timing
    found = {}
    with jax.enable_x64(True):
        likelihood = dataclasses.replace(likelihood.without_samples(), believed=prior and likelihood.believed)
        for known, of in ((likelihood.names, None), (DERIVED, derive)):
            chosen = [name for name in names if name in known]
            if not chosen:
                continue
            model, places = Pinned(likelihood, jnp.asarray(sigma), of), [known.index(name) for name in chosen]
            sides = ends(model, theta, np.array([sd[name] for name in known]), places, level)
            for name, side in zip(chosen, sides, strict=True):
                low, high = timing[name][0] + side * timing[name][1] if name in timing else np.exp(side)
                found[name] = Interval(float(low), float(high), level, likelihood.believed)
    return found


def ends(
    model: Pinned,
    theta: Float[np.ndarray, " parameters"],
    sd: Float[np.ndarray, " quantities"],
    which: Sequence[int],
    level: float,
) -> Float[np.ndarray, "quantities 2"]:
    """The ends of the intervals of the quantities `which`; not finite where a side is open.

    From the optimum `theta`; `sd` are the errors to expect of them. All sides are sought at once, each between
    the last value that was too near and the last that was too far.
    """
    z = NormalDist().inv_cdf(0.5 * (1.0 + level))
    lanes, side = np.repeat(np.asarray(which), 2), np.tile([-1.0, 1.0], len(which))
    expected = np.minimum(sd[lanes], OPEN / z)
    weight = 1.0 / (_TIGHT * expected)
    points = np.tile(theta, (lanes.size, 1))
    points, middle, least = map(np.asarray, _pinned(model, lanes, np.zeros(lanes.size), 0.0 * weight, points))
    # the goals last found too near and too far, of which a quantity falls a little short, and the deviance's root there
    near, far = np.zeros((2, lanes.size)), np.full((2, lanes.size), np.inf)
    goal, found, within = z * expected, np.full(lanes.size, np.nan), np.zeros(lanes.size)
    for _ in range(_ROUNDS):
        there, value, deviance = map(np.asarray, _pinned(model, lanes, middle + side * goal, weight, points))
        out, root = side * (value - middle), np.sqrt(np.maximum(deviance - least, 0.0))
        short = root < z  # false where it is not finite
        near, far = np.where(short, [goal, root], near), np.where(short, far, [goal, root])
        within = np.where(short, out, within)
        points = np.where(np.isfinite(there) & short[:, None], there, points)
        done = np.isnan(found) & (np.abs(root - z) < _CLOSE * z)
        found = np.where(done, out, np.where(np.isnan(found) & short & (goal >= OPEN), np.inf, found))
        if not np.isnan(found).any():
            break
        goal = np.where(np.isnan(found), _next(near, far, z), goal)
    found = np.where(np.isnan(found), within, found)
    return (middle + side * found).reshape(-1, 2)


def _next(near: np.ndarray, far: np.ndarray, z: float) -> np.ndarray:
    """Where to look next: by a line through what is known, kept away from the ends of what is left."""
    with np.errstate(divide="ignore", invalid="ignore"):
        line = near[0] + (far[0] - near[0]) * (z - near[1]) / (far[1] - near[1])
        ahead = near[0] * np.clip(z / near[1], 1.1, _WIDER)
    inside = np.clip(line, 0.95 * near[0] + 0.05 * far[0], 0.05 * near[0] + 0.95 * far[0])
    inside = np.where(np.isfinite(inside), inside, 0.5 * (near[0] + far[0]))
    return np.minimum(np.where(np.isinf(far[0]), ahead, inside), OPEN)


def table(with_prior: Mapping[str, Interval], without: Mapping[str, Interval]) -> str:
    """Both kinds of intervals, for people."""

    def shown(name: str, interval: Interval) -> str:
        ends = [
            "open" if interval.open in (side, "both") else engineering(end, unit_of(name))
            for side, end in (("low", interval.low), ("high", interval.high))
        ]
        return f"{ends[0]} to {ends[1]}"

    level = f"{100.0 * next(iter(with_prior.values())).level:g} %"
    rows = [f"{level + ' interval':14}{'with the prior':>28}{'of the records alone':>28}"]
    rows += [f"{name:14}{shown(name, of):>28}{shown(name, without[name]):>28}" for name, of in with_prior.items()]
    return "\n".join(rows)
