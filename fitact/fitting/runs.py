"""Runs of equal values of a channel, within which rounding is no noise."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

Rows = Float[np.ndarray, " samples"]
FEW = 4  # equal values in a row that are usual where noise exceeds the rounding
_THRESHOLD_ERROR = 0.05  # of a threshold between two values of a converter, in its steps


def run_lengths(values: Rows) -> Rows:
    """Return for each sample the number of equal values in a row."""
    ends = np.append(np.flatnonzero(np.diff(values)), values.size - 1)
    lengths = np.diff(ends, prepend=-1)
    return np.repeat(lengths, lengths).astype(float)


def least_step(values: Rows, max_part: float = 0.25) -> float:
    """Return the least step between the values of a channel, or 0 if more than `max_part` of its values differ."""
    levels = np.unique(values)
    return float(np.diff(levels).min()) if 1 < levels.size <= max_part * values.size else 0.0


class RoundedSteps(NamedTuple):
    """Steps between samples that have one rounding error together, in groups."""

    group: Int[np.ndarray, " samples"]  # of the step after each sample, from 1 on; 0: none
    variance: Float[np.ndarray, " samples"]  # of the error of the mean over the group
    alike: Float[np.ndarray, " samples"]  # number of groups that have the same error

    @classmethod
    def from_samples(cls, values: Rows, step: float) -> "RoundedSteps":
        """Group the steps of the values of a converter with this `step`.

        Where values pass from one to the next, they are known: around the passage, as many steps on either side as in
        half of the shorter run have the threshold as their mean. The rest of a run has its value, with the error of
        rounding; a run of the opposite value has the opposite error.
        """
        group = np.zeros(values.size, int)
        variance, alike = np.zeros(values.size), np.zeros(values.size)
        ends = np.append(np.flatnonzero(np.diff(values)), values.size - 1)
        lengths = np.diff(ends, prepend=-1)
        ends, lengths = ends[lengths > FEW], lengths[lengths > FEW]
        if not ends.size or step <= 0.0:
            return cls(group, variance, alike)
        starts, levels = ends - lengths + 1, values[ends]
        half = (np.minimum(lengths[:-1], lengths[1:]) - 1) // 2
        passage = starts[1:] - ends[:-1]
        is_passed = (np.abs(np.abs(np.diff(levels)) / step - 1.0) < 0.1) & (passage <= 2 * half)
        half = np.where(is_passed, half, 0)
        first, last = starts + np.append(0, half), ends - np.append(half, 0)
        same = np.unique(np.abs(levels), return_inverse=True, return_counts=True)
        begin = np.append(first, last[:-1][is_passed])
        size = np.append(last, first[1:][is_passed]) - begin
        sd = np.append(np.full(ends.size, 1.0 / math.sqrt(12.0)), np.full(np.sum(is_passed), _THRESHOLD_ERROR))
        count = np.append(same[2][same[1]], np.ones(np.sum(is_passed)))
        order = np.argsort(begin, kind="stable")
        order = order[size[order] > 0]
        size = size[order]
        steps = np.repeat(begin[order] - np.cumsum(size) + size, size) + np.arange(np.sum(size))
        group[steps] = np.repeat(np.arange(1, order.size + 1), size)
        variance[steps] = np.repeat((step * sd[order]) ** 2, size)
        alike[steps] = np.repeat(count[order], size)
        return cls(group, variance, alike)
