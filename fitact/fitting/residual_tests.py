"""Tests of residuals for white noise: runs of signs, repetition with the drive, colour, and spectral lines."""

import math
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

_PHASES = (8, 32, 128, 512)  # numbers of parts of a period; few reveal slow structure, many brief structure
_MIN_SAMPLES = 64  # least number of samples for the spectral tests
N_TESTS = len(_PHASES) + 2  # number of p-values


class Fold(NamedTuple):
    """Parts of a period whose means are compared by an F test."""

    weight: Float[np.ndarray, " parts"]  # inverse number of samples in each part; 0 if a part is empty
    means_dof: int  # degrees of freedom of the means
    scatter_dof: int  # degrees of freedom of the scatter about the means


class PhaseBins(NamedTuple):
    """Samples binned by phase of the drive."""

    bin_matrix: scipy.sparse.csr_array  # indicator matrix of the samples in each of the finest parts
    folds: tuple[Fold, ...]  # partitions, from the finest to the coarsest

    @classmethod
    def from_times(cls, time: Float[np.ndarray, " n"], frequency: float | None) -> "PhaseBins | None":
        """Bin samples at `time` (s) by phase of a drive of `frequency` (Hz); return None if there are too few."""
        if frequency is None or time.size < _MIN_SAMPLES:
            return None
        part = np.minimum((np.mod(time * frequency, 1.0) * _PHASES[-1]).astype(int), _PHASES[-1] - 1)
        ones = np.ones(time.size, np.float32)
        bin_matrix = scipy.sparse.csr_array((ones, (part, np.arange(time.size))), (_PHASES[-1], time.size))
        finest = np.bincount(part, minlength=_PHASES[-1])
        counts = [finest.reshape(parts, -1).sum(axis=1) for parts in _PHASES[::-1]]
        sized = [(n, int(np.count_nonzero(n))) for n in counts]
        folds = [Fold(np.where(n > 0, 1.0 / np.maximum(n, 1), 0.0), size, time.size - size) for n, size in sized]
        # with too few samples in each part, the scatter is poorly known
        return cls(bin_matrix, tuple(fold for fold in folds if fold.scatter_dof >= time.size // 2))


class ResidualTestStatistics(NamedTuple):
    """Test statistics of each record."""

    n_positive: Int[np.ndarray, "*records"]  # number of positive residuals
    n_runs: Int[np.ndarray, "*records"]  # number of runs of equal sign
    fold_fractions: Float[np.ndarray, "*records folds"]  # fraction of the sum of squares in the means over parts
    distance: Float[np.ndarray, "*records"]  # of the cumulative periodogram from a straight line, times sqrt(lines)
    line_fraction: Float[np.ndarray, "*records"]  # fraction of the power in the strongest line

    @classmethod
    def from_residuals(
        cls, residuals: Float[np.ndarray, "*records n"], phase_bins: PhaseBins | None
    ) -> "ResidualTestStatistics":
        """Compute the statistics, in the precision of the residuals."""
        positive = residuals > 0.0
        turns = count_true(positive[..., 1:] != positive[..., :-1])
        distance, strongest = _periodogram_statistics(residuals)
        folded = _fold_fractions(residuals, phase_bins)
        return cls(count_true(positive), 1 + turns, folded, distance, strongest)


def count_true(mask: Bool[np.ndarray, "*rows n"]) -> Int[np.ndarray, "*rows"]:
    """Return the number of true values in each row, summed in the smallest integer type, which is fastest."""
    return mask.view(np.uint8).sum(axis=-1, dtype=np.min_scalar_type(mask.shape[-1])).astype(int)


def _fold_fractions(
    residuals: Float[np.ndarray, "*records n"], phase_bins: PhaseBins | None
) -> Float[np.ndarray, "*records folds"]:
    records = residuals.shape[:-1]
    if phase_bins is None or not phase_bins.folds:
        return np.empty((*records, 0))
    square = np.vecdot(residuals, residuals)
    sums, fractions = phase_bins.bin_matrix @ residuals.reshape(-1, residuals.shape[-1]).T, []
    for weight, _, _ in phase_bins.folds:
        sums = sums.reshape(weight.size, len(sums) // weight.size, -1).sum(axis=1)
        fractions.append((weight @ sums**2).reshape(records) / np.where(square > 0.0, square, 1.0))
    return np.stack(fractions, axis=-1)


def _periodogram_statistics(
    residuals: Float[np.ndarray, "*records n"], n_bands: int = 250
) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance of the cumulative periodogram and the fraction of the strongest line; 0 without any power.

    The cumulative periodogram is evaluated at about `n_bands` frequencies, which suffices for coloured noise.
    """
    spectrum = scipy.fft.rfft(residuals)[..., 1 : (residuals.shape[-1] + 1) // 2]
    power = np.square(spectrum.real)
    power += np.square(spectrum.imag)
    total, lines = power.sum(axis=-1), power.shape[-1]
    if lines == 0:
        return total, total
    inverse_total = np.where(total > 0.0, 1.0 / np.where(total > 0.0, total, 1.0), 0.0)
    width = max(lines // n_bands, 1)
    count = lines // width
    bands = power[..., : count * width].reshape(*total.shape, count, width)
    deviation = np.cumsum(bands @ np.ones(width, bands.dtype), axis=-1, dtype=float)
    deviation *= inverse_total[..., None]
    deviation -= width * np.arange(1, count + 1) / lines
    distance = np.maximum(deviation.max(axis=-1), -deviation.min(axis=-1)) * math.sqrt(lines)
    return np.where(total > 0.0, distance, 0.0), power.max(axis=-1) * inverse_total


def p_values(
    statistics: ResidualTestStatistics, samples: int, phase_bins: PhaseBins | None
) -> dict[str, Float[np.ndarray, "*records"]]:
    """Return the p-values of the tests, without a correction for their number.

    - folded_p: F tests of means over parts of the drive's period.
    - spectrum_p: Bartlett's test of the cumulative periodogram (Kolmogorov's distribution); low for coloured noise.
    - line_p: Fisher's test of the strongest line of the periodogram; low for a line such as mains hum.
    """
    lines = (samples - 1) // 2
    spectrum_p = line_p = np.ones(statistics.distance.shape)
    if lines >= _MIN_SAMPLES // 2:
        spectrum_p = scipy.special.kolmogorov(statistics.distance)
        log_p = math.log(lines) + (lines - 1) * np.log1p(-np.minimum(statistics.line_fraction, 1.0 - 1e-16))
        line_p = np.exp(np.minimum(log_p, 0.0))
    folded_p = _folded_p(statistics.fold_fractions, phase_bins)
    return {"folded_p": folded_p, "spectrum_p": spectrum_p, "line_p": line_p}


def runs_z(statistics: ResidualTestStatistics, samples: int) -> Float[np.ndarray, "*records"]:
    """Return z of the Wald-Wolfowitz runs test of signs; far below zero if equal signs follow each other."""
    above = statistics.n_positive.astype(float)
    both = 2.0 * above * (samples - above)
    mean = both / samples + 1.0
    variance = both * (both - samples) / (samples**2 * (samples - 1.0))
    return np.where(both > 0.0, (statistics.n_runs - mean) / np.sqrt(np.where(both > 0.0, variance, 1.0)), -np.inf)


def _folded_p(
    fractions: Float[np.ndarray, "*records folds"], phase_bins: PhaseBins | None
) -> Float[np.ndarray, "*records"]:
    """Return the lowest p-value of the F tests, which compare the means over parts of the drive's period.

    Residuals of a wrong circuit repeat with the drive and add up over the periods. The p-value is 1 without a period.
    """
    lowest = np.ones(fractions.shape[:-1])
    for fold, fraction in zip(phase_bins.folds if phase_bins else (), np.moveaxis(fractions, -1, 0), strict=True):
        # for white noise, the fraction of the sum of squares in the means has a beta distribution
        p = scipy.special.betainc(0.5 * fold.scatter_dof, 0.5 * fold.means_dof, np.maximum(1.0 - fraction, 0.0))
        lowest = np.minimum(lowest, p)
    return lowest
