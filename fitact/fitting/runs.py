"""Runs of equal values of a channel, within which rounding is no noise."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

Rows = Float[np.ndarray, " samples"]
FEW = 4  # equal values in a row that are usual where noise exceeds the rounding
# sd of errors in steps of a converter: of a threshold that values pass, and of one beside which they alternate; of the
# mean of a run that is passed from one side to the other, of one that is no more than entered or left, and may remain
# near the threshold, and of others
_THRESHOLD_ERRORS, _RUN_ERRORS = (0.05, 0.2), (0.1, 0.5, 0.29)
_DITHER = 0.25  # noise, in steps, with which rounding is noise as well


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

    values: Float[np.ndarray, " samples"]  # of the converter, but thresholds where noise makes them alternate
    group: Int[np.ndarray, " samples"]  # of the step after each sample, from 1 on; 0: none
    variance: Float[np.ndarray, " samples"]  # of the error of the mean over the group
    alike: Float[np.ndarray, " samples"]  # number of groups that have the same error

    @classmethod
    def from_samples(cls, values: Rows, step: float) -> "RoundedSteps":
        """Group the steps of the values of a converter with this `step`.

        Where values pass from one to the next, or noise lower than a step makes them alternate, they are at the
        threshold: there, and around a passage for half of the shorter run on either side, it is their mean. The rest of
        a run has its value, with the error of rounding; a run of the opposite value has the opposite error.
        """
        result = cls(values.copy(), np.zeros(values.size, int), np.zeros(values.size), np.zeros(values.size))
        ends = np.append(np.flatnonzero(np.diff(values)), values.size - 1)
        lengths = np.diff(ends, prepend=-1)
        if step <= 0.0 or np.max(lengths) <= FEW:
            return result
        changes, starts = np.diff(values[ends]) / step, ends - lengths + 1
        is_unit = np.abs(np.abs(changes) - 1.0) < 0.1
        # of a constant signal with this noise and any rounding error, values change at this rate
        noise = 0.5 * math.sqrt(math.pi) * changes.size / values.size
        if noise > _DITHER:
            return result
        stretch = np.append(0, np.cumsum(~(is_unit[1:] & (np.abs(changes[1:] + changes[:-1]) < 0.1))))[: changes.size]
        is_long = (lengths > FEW) & (4 * lengths >= _usual_lengths(lengths, stretch))
        # passages: changes of a stretch between long runs, or beside one
        first = np.flatnonzero((np.diff(stretch, prepend=-1) != 0) | is_long[: changes.size])
        last = np.append(first[1:], changes.size) - 1
        before, after = is_long[first], is_long[last + 1]
        is_used = is_unit[first] & ((before & after) | (last - first > 2))
        first, last, before, after = (x[is_used] for x in (first, last, before, after))
        both = before & after & (changes[first] * changes[last] > 0.0)
        half = np.where(both, (np.minimum(lengths[first], lengths[last + 1]) - 1) // 2, 0)
        begin, end = np.where(before, ends[first], starts[first]), np.where(after, starts[last + 1], ends[last + 1])
        threshold = 0.5 * (values[ends[first]] + values[ends[first] + 1])
        inner = _ranges(begin + before, end - begin + 1 - before - after)
        result.values[inner] = np.repeat(threshold, end - begin + 1 - before - after)
        error = np.where(both, _THRESHOLD_ERRORS[0], max(_THRESHOLD_ERRORS[1], 2.0 * noise))
        passages = begin - half, end + half, error, np.where(both, 1.0, _count_equal(np.abs(threshold)))
        # the rest of long runs
        entered, left = np.zeros(lengths.size), np.zeros(lengths.size)
        rest, until = starts.copy(), ends.copy()
        left[first[before]], entered[last[after] + 1] = changes[first[before]], changes[last[after]]
        until[first[both]] -= half[both]
        rest[last[both] + 1] += half[both]
        error = np.select([entered * left > 0.0, (entered != 0.0) | (left != 0.0)], _RUN_ERRORS[:2], _RUN_ERRORS[2])
        runs = (x[is_long] for x in (rest, until, error))
        begin, end, error, alike = (
            np.append(x, y) for x, y in zip(passages, (*runs, _count_equal(np.abs(values[ends[is_long]]))), strict=True)
        )
        order = np.argsort(begin, kind="stable")
        order = order[(end > begin)[order]]
        size = (end - begin)[order]
        steps = _ranges(begin[order], size)
        result.group[steps] = np.repeat(np.arange(1, order.size + 1), size)
        result.variance[steps] = np.repeat((step * error[order]) ** 2, size)
        result.alike[steps] = np.repeat(alike[order], size)
        return result


def _ranges(begin: Int[np.ndarray, " n"], size: Int[np.ndarray, " n"]) -> Int[np.ndarray, " all"]:
    """Return begin, begin + 1, ... of each range of a size, one after the other."""
    return np.repeat(begin - np.cumsum(size) + size, size) + np.arange(np.sum(size))


def _count_equal(values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return how many values equal each, to rounding errors."""
    scale = np.max(values, initial=0.0) or 1.0
    _, places, counts = np.unique(np.round(values / scale, 9), return_inverse=True, return_counts=True)
    return counts[places].astype(float)


def _usual_lengths(lengths: Int[np.ndarray, " runs"], stretch: Int[np.ndarray, " changes"]) -> np.ndarray:
    """Return for each run the largest length of those of its value with which it alternates; noise makes short ones."""
    places = np.arange(stretch.size)
    before, after = 2 * stretch + places % 2, 2 * stretch + (places + 1) % 2  # of the values on either side of a change
    largest = np.zeros(2 * stretch.size + 2, int)
    np.maximum.at(largest, before, lengths[:-1])
    np.maximum.at(largest, after, lengths[1:])
    far = np.full(1, np.iinfo(int).max)
    return np.minimum(np.append(largest[before], far), np.append(far, largest[after]))
