"""Tests of residuals for white noise: runs of signs, repetition with the drive, colour, and spectral lines.

The statistics are computed with NumPy, or within a program of JAX for many records.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float, Int

from fitact.compiled import array_module

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

    part: Int[np.ndarray, " samples"]  # number of the finest part of the period in which each sample is
    folds: tuple[Fold, ...]  # partitions, from the finest to the coarsest

    @classmethod
    def from_times(cls, time: Float[np.ndarray, " n"], frequency: float | None) -> "PhaseBins | None":
        """Bin samples at `time` (s) by phase of a drive of `frequency` (Hz); return None if there are too few."""
        if frequency is None or time.size < _MIN_SAMPLES:
            return None
        part = np.minimum((np.mod(time * frequency, 1.0) * _PHASES[-1]).astype(int), _PHASES[-1] - 1)
        finest = np.bincount(part, minlength=_PHASES[-1])
        counts = [finest.reshape(parts, -1).sum(axis=1) for parts in _PHASES[::-1]]
        sized = [(n, int(np.count_nonzero(n))) for n in counts]
        folds = [Fold(np.where(n > 0, 1.0 / np.maximum(n, 1), 0.0), size, time.size - size) for n, size in sized]
        # with too few samples in each part, the scatter is poorly known
        return cls(part, tuple(fold for fold in folds if fold.scatter_dof >= time.size // 2))


class ResidualTestStatistics(NamedTuple):
    """Test statistics of each record."""

    n_positive: Int[Array, "*records"]  # number of positive residuals
    n_runs: Int[Array, "*records"]  # number of runs of equal sign
    fold_fractions: Float[Array, "*records folds"]  # fraction of the sum of squares in the means over parts
    distance: Float[Array, "*records"]  # of the cumulative periodogram from a straight line, times sqrt(lines)
    line_fraction: Float[Array, "*records"]  # fraction of the power in the strongest line

    @classmethod
    def from_residuals(
        cls, residuals: Float[Array, "*records n"], phase_bins: PhaseBins | None
    ) -> "ResidualTestStatistics":
        """Compute the statistics, in the precision of the residuals."""
        xp = array_module(residuals)
        positive = residuals > 0.0
        runs = 1 + xp.count_nonzero(positive[..., 1:] != positive[..., :-1], axis=-1)
        folded = _fold_fractions(residuals, phase_bins)
        return cls(xp.count_nonzero(positive, axis=-1), runs, folded, *_periodogram_statistics(residuals))

    def without_share(self, share: float, samples: int, *, with_means: bool) -> "ResidualTestStatistics":
        """Return the statistics without the most that a part of the residuals with this share of the power explains.

        Without `with_means`, the part is so fast that it hardly changes means over parts of a period.
        """
        xp, lines = array_module(self.distance), (samples - 1) // 2
        return self._replace(
            fold_fractions=xp.maximum(self.fold_fractions - share * with_means, 0.0),
            distance=xp.maximum(self.distance - share * math.sqrt(lines), 0.0),
            line_fraction=xp.maximum(self.line_fraction - share, 0.0),
        )


def sum_rows(values: Float[Array, "*rows n"]) -> Float[Array, "*rows"]:
    """Return the sums of rows; XLA vectorises this product with ones, but not a sum."""
    return values @ np.ones(values.shape[-1], values.dtype)


def _fold_fractions(
    residuals: Float[Array, "*records n"], phase_bins: PhaseBins | None
) -> Float[Array, "*records folds"]:
    xp, records = array_module(residuals), residuals.shape[:-1]
    if phase_bins is None or not phase_bins.folds:
        return xp.empty((*records, 0))
    square, fractions = sum_rows(residuals * residuals), []
    sums = _sum_parts(residuals, phase_bins.part, _PHASES[-1])
    for weight, _, _ in phase_bins.folds:
        sums = sums.reshape(*records, weight.size, -1).sum(axis=-1)
        fractions.append((sums * sums) @ weight.astype(sums.dtype) / xp.where(square > 0.0, square, 1.0))
    return xp.stack(fractions, axis=-1)


def _sum_parts(
    values: Float[Array, "*records n"], part: Int[np.ndarray, " n"], count: int
) -> Float[Array, "*records count"]:
    """Return the sum of the values in each of `count` parts."""
    if array_module(values) is jnp:
        return jnp.zeros((*values.shape[:-1], count), values.dtype).at[..., part].add(values)
    rows = values.reshape(-1, values.shape[-1])
    sums = [np.bincount(part, row, count) for row in rows]
    return np.array(sums).reshape(*values.shape[:-1], count)


def _periodogram_statistics(
    residuals: Float[Array, "*records n"], n_bands: int = 250
) -> tuple[Float[Array, "*records"], Float[Array, "*records"]]:
    """Return the distance of the cumulative periodogram and the fraction of the strongest line; 0 without any power.

    The cumulative periodogram is evaluated at about `n_bands` frequencies, which suffices for coloured noise.
    """
    xp = array_module(residuals)
    transform = jnp.fft.rfft if xp is jnp else scipy.fft.rfft  # NumPy's would be in double precision
    spectrum = transform(residuals)[..., 1 : (residuals.shape[-1] + 1) // 2]
    power = xp.square(spectrum.real) + xp.square(spectrum.imag)
    total, lines = sum_rows(power), power.shape[-1]
    if lines == 0:
        return total, total
    inverse_total = xp.where(total > 0.0, 1.0 / xp.where(total > 0.0, total, 1.0), 0.0)
    width = max(lines // n_bands, 1)
    count = lines // width
    bands = sum_rows(power[..., : count * width].reshape(*total.shape, count, width))
    expected = width * np.arange(1, count + 1) / lines
    deviation = xp.cumsum(bands.astype(float), axis=-1) * inverse_total[..., None] - expected
    distance = xp.max(xp.abs(deviation), axis=-1) * math.sqrt(lines)
    return xp.where(total > 0.0, distance, 0.0), xp.max(power, axis=-1) * inverse_total


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
