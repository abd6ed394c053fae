"""Jumps of a current at the corners of a drive, and its mean over steps beside them.

Between jumps a current is smooth, so that a step beside one has the mean of a polynomial through samples on its own
side, as in essentially non-oscillatory schemes (Harten et al., J. Comput. Phys. 71 (1987) 231). V tells which step
holds the corner: that in which its slope changes most. Only this one has an unknown mean.
"""

import math
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

from fitact.likelihood.charge_rows import LAG, MAX_STEPS, ROW_NOISE, step_means
from fitact.problem.runs import Rows

_REACH = 6 + MAX_STEPS  # steps beside a jump whose polynomial of `step_means` may pass it


class Jumps(NamedTuple):
    """Jumps of a current, in order."""

    last: Int[np.ndarray, " jumps"]  # the last sample of I before each
    middle: Float[np.ndarray, " jumps"]  # its place between samples of I, to half a step
    corner: Int[np.ndarray, " jumps"]  # the step of V, by its first sample, that holds the corner
    is_seen: Bool[np.ndarray, " jumps"]  # else the steps beside it may hold it as well
    height: Float[np.ndarray, " jumps"]  # A
    early: Float[np.ndarray, " jumps"]  # part of it in the mean over the step before, of a corner that is not sharp
    alike: float  # how many have the same error

    @classmethod
    def from_samples(cls, V: Rows, current: Rows, noise: tuple[float, float], is_whole: bool = True) -> "Jumps":
        """Find the jumps in samples with `noise` (V, A).

        `is_whole`: whether they are a whole record, and not a window of one, whose delay others determine.
        """
        change = np.diff(current)
        last = _find_jumps(current, noise[1])
        last = last[(last > MAX_STEPS + 1) & (last < current.size - MAX_STEPS - 3)]
        around = change[last[:, None] + np.arange(-1, 2)]
        around = np.where(around * around[:, 1:2] > 0.0, around, 0.0)
        height = around.sum(axis=1)
        middle = last + 0.5 + (around[:, 2] - around[:, 0]) / height
        # the step in which the slope of V changes most, if noise of V shows it
        rises = np.diff(V)
        candidates = last[:, None] + np.arange(-MAX_STEPS - 1, MAX_STEPS + 2)
        bends = (rises[candidates + 1] - rises[candidates - 1]) * np.sign(change[last])[:, None]
        best = np.argmax(bends, axis=1)
        bend = bends[np.arange(last.size), best]
        is_seen = bend > 8.0 * math.sqrt(2.0) * noise[0]
        corner = np.maximum.accumulate(np.where(is_seen, last - MAX_STEPS - 1 + best, last))
        squares = np.square(rises[corner - 1] - rises[corner - 2]) - 6.0 * noise[0] ** 2
        early = np.sqrt(np.maximum(squares, 0.0)) / np.where(is_seen, bend, math.inf)
        is_alone = np.diff(corner, prepend=-9) > 2  # else the step before holds another corner, or lies beside it
        early = np.where(is_alone, early, np.median(early[is_alone]) if np.any(is_alone) else 0.0)
        within = (rises[corner + 1] - rises[corner]) / np.where(is_seen, bend * np.sign(change[last]), math.inf)
        alike = _count_alike(within) if is_whole else 1.0
        return cls(last, middle, corner, is_seen, np.abs(height), early, alike)

    def step_means(self, current: Rows, delay: float, noise: float) -> tuple[Rows, Rows]:
        """Return the rows of the mean current over each step, and their variance beyond that of white noise, A^2.

        The current is `delay` steps late, and has the `noise` (A).
        """
        means, variance = step_means(current, delay), np.zeros(current.size)
        if not self.last.size:
            return means, variance
        steps = (self.corner[:, None] + np.arange(-_REACH, _REACH + 1)).ravel()
        steps = np.setdiff1d(steps[(steps > 0) & (steps < current.size - LAG)], self.corner)
        side = np.searchsorted(self.corner, steps)  # jumps before the step
        first, final = np.append(0, self.last + 1)[side], np.append(self.last, current.size - 1)[side]
        lone = np.max(self.height) / math.sqrt(12.0)
        means[steps + LAG], error, weight = _fit_parabolas(current, steps + delay, first, final, lone)
        variance[steps + LAG] = error**2 + noise**2 * np.maximum(weight - ROW_NOISE, 0.0)
        after = self.corner + delay + 1.0 - self.middle  # part of the step after the jump
        early, own, late = (self._rows(k, current.size) for k in (-1, 0, 1))
        means[own] = (1.0 - after) * means[early] + after * means[late]
        variance[early] += (self.early * self.height) ** 2
        unknown = self.height**2 / 12.0
        variance[own] = unknown
        for beside in (early, late):
            variance[beside[~self.is_seen]] = unknown[~self.is_seen]
        return means, variance

    def kink_variance(self, size: int) -> Rows:
        """Return the variance of the means of a modelled current that has kinks where this one has jumps, A^2.

        Its slope changes by these heights per step, and the delay decides which step holds the kink: it is off by such
        parts of it at most, all alike.
        """
        variance = np.zeros(size)
        for k, part in ((-2, 0.05), (-1, 0.25), (1, 0.25), (2, 0.05)):
            variance[self._rows(k, size)] += (part * self.height) ** 2
        return variance * self.last.size

    def _rows(self, beside: int, size: int) -> Int[np.ndarray, " jumps"]:
        """Return the rows of the steps `beside` those of corners."""
        return np.minimum(self.corner + beside + LAG, size - 1)

    def differentiate(self, rows: Rows) -> Rows:
        """Return derivatives of rows per step: differences on their own side of each jump, and across its own row."""
        change, known = np.diff(rows, prepend=0.0, append=0.0), np.ones(rows.size + 1)
        own = self._rows(0, rows.size)
        known[own], known[own + 1] = 0.0, 0.0
        known[[2 * LAG, -1]] = 0.0  # first and last rows
        across, change = change[own] + change[own + 1], change * known
        result = (change[:-1] + change[1:]) / np.maximum(known[:-1] + known[1:], 1.0)
        result[own] = across
        return result


def _fit_parabolas(
    current: Rows,
    begin: Float[np.ndarray, " n"],
    first: Int[np.ndarray, " n"],
    final: Int[np.ndarray, " n"],
    lone: float,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the means of steps that `begin` between samples, by those from the `first` to the `final` one.

    Also their errors, as much as the last power that is used, and `lone` with a single sample; and the sums of squares
    of the weights of the samples.
    """
    count = np.minimum(3, final - first + 1)
    start = np.clip(np.round(begin - 0.5 * (count - 2.0)).astype(int), first, final - count + 1)
    offset, value = begin - start, current[start]
    rise = np.where(count > 1, current[np.minimum(start + 1, final)] - value, 0.0)
    bend = np.where(count > 2, current[np.minimum(start + 2, final)] - value - 2.0 * rise, 0.0)
    ramp, curved = np.where(count > 1, offset + 0.5, 0.0), np.where(count > 2, 0.5 * (offset**2 - 1.0 / 6.0), 0.0)
    linear, square = np.maximum(np.abs(ramp), 1.0 / 6.0) * np.abs(rise), np.maximum(np.abs(curved), 1.0 / 12.0)
    error = np.select([count > 2, count > 1], [square * np.abs(bend), linear], lone)
    weight = np.square(1.0 - ramp + curved) + np.square(ramp - 2.0 * curved) + np.square(curved)
    return value + ramp * rise + curved * bend, error, weight


def block_medians(values: Rows, block: int) -> Rows:
    """Return for each value the median of its block."""
    padded = np.pad(values, (0, -values.size % block), mode="edge").reshape(-1, block)
    return np.repeat(np.median(padded, axis=1), block)[: values.size]


def _find_jumps(
    current: Rows, noise: float, threshold: float = 4.0, smooth: float = 8.0, block: int = 64, part: float = 0.2
) -> Int[np.ndarray, " jumps"]:
    """Return the last sample before each jump.

    Sixth differences are ten times a jump; they count above `threshold` times the effect of noise, and `smooth` times
    what is usual in a `block` of samples. Near them, each largest rise and fall above a `part` of the others is a jump.
    """
    jump = np.pad(np.abs(np.diff(current, 6)) / 10.0, 3)
    least = np.maximum(threshold * math.sqrt(924.0) / 10.0 * noise, smooth * block_medians(jump, block))
    sudden = jump > np.maximum(least, 1e-9 * np.ptp(current))
    sudden = np.convolve(sudden, np.ones(7), "same")[1:] > 0.5
    change = np.diff(current)
    size, before, after = np.abs(change), np.roll(change, 1), np.roll(change, -1)
    largest = (np.sign(change) * before <= size) & (np.sign(change) * after < size)
    return np.flatnonzero(sudden & largest & (size > part * scipy.ndimage.maximum_filter1d(size, 13)))


def _count_alike(within: Float[np.ndarray, " n"], width: float = 0.1) -> float:
    """Return how many jumps lie `within` their steps at the same part and so have the same error.

    It is the mean number that lies in a `width` around each, beyond those of any positions.
    """
    if not within.size:
        return 1.0
    places = np.sort(np.mod(within, 1.0))
    around = np.concatenate([places - 1.0, places, places + 1.0])
    near = np.searchsorted(around, places + 0.5 * width, "right") - np.searchsorted(around, places - 0.5 * width)
    return max(float(np.mean(near)) - width * (within.size - 1), 1.0)
