"""Records of a finger that changes while it is recorded: contact area, resistance and capacitance vary in time.

The finger is two equal layers Rsc‖Csc in series with Ci. A capacitance that changes carries i = d(C v)/dt, so that with
y = (Csc + 2 Ci) Vsc - Ci V the equation is y' = -Vsc / Rsc, for any Rsc(t), Csc(t), Ci(t).
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from data_synth.drive import Drive
from data_synth.errors import RecipeError
from data_synth.response import polynomials, steps

_SETTLED = 20.0  # time constants before the record, in which the charge of an earlier start decays
_SUBSTEPS = 4  # per step of a curved drive, which is taken as straight within a substep
_LIFTED = 1e-4  # ratio of Ci of a lifted finger to that in contact
_LIFT_TIME = 2e-3  # s, in which a finger leaves the panel or returns to it
_WALK_STEP = 2e-3  # s, of a random walk, or a 3,000th of a shorter record; few steps in a window are no walk


class Course(NamedTuple):
    """Logarithms of Rsc (ohm), Csc (F) and Ci (F) at `time` (s), straight lines between."""

    time: np.ndarray
    logs: np.ndarray  # (3, times)

    def values(self, time: np.ndarray) -> np.ndarray:
        """Return Rsc, Csc and Ci at `time` (s)."""
        return np.exp([np.interp(time, self.time, each) for each in self.logs])

    def rates(self, time: np.ndarray) -> np.ndarray:
        """Return the time derivatives of the logarithms (1/s) at `time` (s), from the right."""
        place = np.clip(np.searchsorted(self.time, time, side="right") - 1, 0, self.time.size - 2)
        inside = (time >= self.time[0]) & (time < self.time[-1])
        return np.where(inside, (np.diff(self.logs) / np.diff(self.time))[:, place], 0.0)


def make_course(
    change: Mapping[str, Any], start: tuple[float, float, float], duration: float, rng: np.random.Generator
) -> Course:
    """Return the course of Rsc, Csc and Ci from their values at the `start`, by the recipe's section [change].

    The factors at `time` are interpolated in the logarithm. An area multiplies Ci and Csc and divides Rsc. `walk_...`
    are standard deviations, per root of a second, of random walks in the logarithms of the area, of the resistance
    times the area, and of Csc over the area. A finger that is lifted keeps its skin and loses Ci.

    Raises:
        RecipeError: lists of unequal length, or times that do not increase.
    """
    times = np.array(change["time"] or (0.0, duration))
    logs: dict[str, np.ndarray] = {}
    for name in ("area", "Rsc", "Csc"):
        factors = np.array(change[name] or (1.0,) * times.size)
        if factors.shape != times.shape:
            raise RecipeError(f"[change] {name} has {factors.size} factors for {times.size} times; state one for each")
        logs[name] = np.log(factors)
    if np.any(np.diff(times) <= 0.0):
        raise RecipeError("[change] time does not increase; sort it")
    lift_times, lift_logs = _lifts(change["lifted"] or ())
    count = max(3_000, math.ceil(duration / _WALK_STEP))
    grid = np.unique(np.concatenate([times, np.linspace(0.0, duration, count + 1), lift_times]))
    found = {name: np.interp(grid, times, each) for name, each in logs.items()}
    steps_between = np.sqrt(np.diff(grid, prepend=grid[0]))
    for name in found:
        found[name] += change[f"walk_{name}"] * np.cumsum(steps_between * rng.standard_normal(grid.size))
    lift = np.interp(grid, lift_times, lift_logs) if lift_times.size else 0.0
    area = found["area"]
    skin = np.log(start[0]) + found["Rsc"] - area, np.log(start[1]) + found["Csc"] + area
    return Course(grid, np.array([*skin, np.log(start[2]) + area + lift]))


def _lifts(ends: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Return times (s), and the logarithm of what is left of Ci, for a finger that is lifted in pairs of times."""
    if len(ends) % 2 or any(b <= a + _LIFT_TIME for a, b in itertools.pairwise(ends)):
        raise RecipeError("[change] lifted is not a list of increasing times, lift-off and touch in turn; correct it")
    low = math.log(_LIFTED)
    levels = [(0.0, low) if n % 2 == 0 else (low, 0.0) for n in range(len(ends))]
    return np.ravel([[end, end + _LIFT_TIME] for end in ends]), np.ravel(levels)


def changing_response(
    course: Course, drive: Drive, time: np.ndarray, stray: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return V, Vsc (V) and I (A) at `time` (s, any order): settled periodic drives, others from rest.

    I includes the current of the capacitance `stray` (F) from drive to ground. At an ideal jump I is NaN.
    """
    first, fine = float(time.min()), 1 if drive.degree == 1 else _SUBSTEPS
    before = np.empty(0)
    if drive.period:
        Rsc, Csc, Ci = course.values(np.array(first))
        lead = drive.period * math.ceil(_SETTLED * Rsc * (Csc + 2.0 * Ci) / drive.period)
        before = first - lead + np.arange(0.0, lead, min(drive.period / 200.0, lead / 20.0))
    grid, place = steps(drive, np.concatenate([before, time]))
    if fine > 1:
        grid = np.append((grid[:-1, None] + np.diff(grid)[:, None] * np.arange(fine) / fine).ravel(), grid[-1])
        place = place * fine
    taylor = polynomials(drive, grid)
    length = np.diff(grid)
    V, V_end = taylor[:, 0], np.sum(taylor / [math.factorial(n) for n in range(drive.degree + 1)], axis=1)
    Rsc, Csc, Ci = course.values(grid[:-1] + 0.5 * length)
    x = length / (Rsc * (Csc + 2.0 * Ci))
    decay, share = np.exp(-x), -np.expm1(-x) / x
    pushed = -Ci * (V * -np.expm1(-x) + (V_end - V) * (1.0 - share))
    Rsc, Csc, Ci = course.values(grid[:-1])
    y = np.append(0.0, _recur(decay, pushed))[:-1]
    total = Csc + 2.0 * Ci
    Vsc = (y + Ci * V) / total
    slope, (_, Csc_rate, Ci_rate) = taylor[:, 1] / length, course.rates(grid[:-1])
    change = (-Vsc / Rsc + Ci * (slope + Ci_rate * V) - (Csc * Csc_rate + 2.0 * Ci * Ci_rate) * Vsc) / total
    current = Vsc / Rsc + Csc * (change + Csc_rate * Vsc) + stray * slope
    if drive.jumps:
        jumped = np.abs(V - np.append(V[:1], V_end[:-1])) > 1e-5 * np.ptp(V)
        current = np.where(jumped, np.nan, current)
    last = place[before.size :]
    return V[last], Vsc[last], current[last]


def _recur(decay: np.ndarray, pushed: np.ndarray) -> np.ndarray:
    """Return y[k] = decay[k] y[k - 1] + pushed[k], from y[-1] = 0, in rows that are joined afterwards."""
    rows = math.isqrt(decay.size) + 1
    width = -(-decay.size // rows)
    missing = rows * width - decay.size
    decay, pushed = np.pad(decay, (0, missing)).reshape(rows, width), np.pad(pushed, (0, missing)).reshape(rows, width)
    y, left = pushed.copy(), decay.copy()
    for column in range(1, width):
        y[:, column] += decay[:, column] * y[:, column - 1]
        left[:, column] *= left[:, column - 1]
    start = 0.0
    for row in range(rows):
        y[row] += left[row] * start
        start = y[row, -1]
    return y.ravel()[: y.size - missing]
