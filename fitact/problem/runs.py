"""Runs of equal values of a channel, within which rounding is no noise."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

Rows = Float[np.ndarray, " samples"]
_FEW = 4  # equal values in a row that are usual where noise exceeds the rounding
# sd of errors in steps of a converter: of a threshold that values pass, and of one beside which they alternate; of the
# mean of a run that is passed from one side to the other, of one that is no more than entered or left, and may remain
# near the threshold, and of others
_THRESHOLD_ERRORS, _RUN_ERRORS = (0.05, 0.2), (0.1, 0.5, 0.29)


def run_lengths(values: Rows) -> Rows:
    """Return for each sample the number of equal values in a row."""
    lengths = _Runs.from_values(values).lengths
    return np.repeat(lengths, lengths).astype(float)


def long_run_share(values: Rows) -> float:
    """Return the share of samples in runs longer than noise above the rounding leaves."""
    return float(np.mean(run_lengths(values) > _FEW))


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
        runs = _Runs.from_values(values)
        # a constant signal with this noise (steps) and any rounding error changes to and fro at this rate
        changes = np.diff(runs.levels)
        noise = 0.5 * math.sqrt(math.pi) * np.count_nonzero(changes[1:] * changes[:-1] < 0.0) / values.size
        if step <= 0.0 or np.max(runs.lengths) <= _FEW or noise > 0.25:  # with it, rounding is noise as well
            return result
        passages, is_long = _find_passages(runs, step)
        inner = passages.begin + passages.is_bounded[0], passages.end - passages.is_bounded[1]
        size = inner[1] - inner[0] + 1
        result.values[_ranges(inner[0], size)] = np.repeat(passages.threshold, size)
        groups = np.hstack([passages.groups(noise), _rest_of_runs(runs, passages, is_long)])
        begin, end = groups[:2].astype(int)
        order = np.argsort(begin, kind="stable")
        order = order[(end > begin)[order]]
        size = (end - begin)[order]
        steps = _ranges(begin[order], size)
        result.group[steps] = np.repeat(np.arange(1, order.size + 1), size)
        result.variance[steps] = np.repeat((step * groups[2, order]) ** 2, size)
        result.alike[steps] = np.repeat(groups[3, order], size)
        return result


class _Runs(NamedTuple):
    """Runs of equal values, one after the other."""

    levels: Float[np.ndarray, " runs"]
    starts: Int[np.ndarray, " runs"]  # first and last samples
    ends: Int[np.ndarray, " runs"]

    @classmethod
    def from_values(cls, values: Rows) -> "_Runs":
        ends = np.append(np.flatnonzero(np.diff(values)), values.size - 1)
        return cls(values[ends], np.append(0, ends[:-1] + 1), ends)

    @property
    def lengths(self) -> Int[np.ndarray, " runs"]:
        return self.ends - self.starts + 1


class _Passages(NamedTuple):
    """Changes between two values of a converter, one or more, between long runs or beside one."""

    first: Int[np.ndarray, " n"]  # number of the run before the first change
    last: Int[np.ndarray, " n"]  # and before the last one
    is_bounded: tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]  # whether the run before, and after it, is long
    is_through: Bool[np.ndarray, " n"]  # from a long run to one on the other side
    half: Int[np.ndarray, " n"]  # steps within the runs around it for which the threshold is the mean
    begin: Int[np.ndarray, " n"]  # last sample of the long run before it, or first of its own
    end: Int[np.ndarray, " n"]  # likewise
    threshold: Float[np.ndarray, " n"]

    def groups(self, noise: float) -> Float[np.ndarray, "4 n"]:
        """Return first and last samples, the error of the mean (steps), and how many have it; the noise is in steps."""
        error = np.where(self.is_through, _THRESHOLD_ERRORS[0], max(_THRESHOLD_ERRORS[1], 2.0 * noise))
        alike = np.where(self.is_through, 1.0, _count_equal(np.abs(self.threshold)))
        return np.stack([self.begin - self.half, self.end + self.half, error, alike])


def _find_passages(runs: _Runs, step: float) -> tuple[_Passages, Bool[np.ndarray, " runs"]]:
    """Return the passages, and which runs are long."""
    changes, lengths = np.diff(runs.levels) / step, runs.lengths
    is_unit = np.abs(np.abs(changes) - 1.0) < 0.1
    continues = is_unit[1:] & (np.abs(changes[1:] + changes[:-1]) < 0.1)
    stretch = np.append(0, np.cumsum(~continues))[: changes.size]  # in which values alternate
    is_long = (lengths > _FEW) & (4 * lengths >= _usual_lengths(lengths, stretch))
    first = np.flatnonzero((np.diff(stretch, prepend=-1) != 0) | is_long[:-1])
    last = np.append(first[1:], changes.size) - 1
    is_used = is_unit[first] & ((is_long[first] & is_long[last + 1]) | (last - first > 2))
    first, last = first[is_used], last[is_used]
    before, after = is_long[first], is_long[last + 1]
    is_through = before & after & (changes[first] * changes[last] > 0.0)
    half = np.where(is_through, (np.minimum(lengths[first], lengths[last + 1]) - 1) // 2, 0)
    begin = np.where(before, runs.ends[first], runs.starts[first])
    end = np.where(after, runs.starts[last + 1], runs.ends[last + 1])
    threshold = 0.5 * (runs.levels[first] + runs.levels[first + 1])
    return _Passages(first, last, (before, after), is_through, half, begin, end, threshold), is_long


def _rest_of_runs(runs: _Runs, passages: _Passages, is_long: Bool[np.ndarray, " runs"]) -> Float[np.ndarray, "4 long"]:
    """Return the groups of what passages leave of long runs, as `_Passages.groups`."""
    changes, (before, after) = np.sign(np.diff(runs.levels)), passages.is_bounded
    entered, left, begin, end = np.zeros(is_long.size), np.zeros(is_long.size), runs.starts.copy(), runs.ends.copy()
    left[passages.first[before]] = changes[passages.first[before]]
    entered[passages.last[after] + 1] = changes[passages.last[after]]
    through, half = passages.is_through, passages.half
    end[passages.first[through]] -= half[through]
    begin[passages.last[through] + 1] += half[through]
    error = np.select([entered * left > 0.0, (entered != 0.0) | (left != 0.0)], _RUN_ERRORS[:2], _RUN_ERRORS[2])
    alike = _count_equal(np.abs(runs.levels[is_long]))
    return np.stack([begin[is_long], end[is_long], error[is_long], alike])


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
