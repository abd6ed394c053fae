"""Are residuals white noise? By the runs of signs, what repeats with the drive, their colour, and single lines."""

import math
from typing import NamedTuple

import numpy as np
import scipy.fft
import scipy.sparse
import scipy.special
from jaxtyping import Bool, Float, Int

_PHASES = (8, 32, 128, 512)  # parts of a period whose means are compared; few show what is slow, many what is brief
_MIN_SAMPLES = 64  # samples, below which a spectrum says little
N_TESTS = len(_PHASES) + 2  # whose probabilities are looked at


class Fold(NamedTuple):
    """Parts of a period whose means are compared."""

    weight: Float[np.ndarray, " parts"]  # one over the samples in each part; 0 where there are none
    means_dof: int  # degrees of freedom of the means
    scatter_dof: int  # and of what scatters about them


class PhaseBins(NamedTuple):
    """Samples by their place in the drive's period."""

    bin_matrix: scipy.sparse.csr_array  # which are in each of the finest parts, as a matrix of ones
    folds: tuple[Fold, ...]  # from the finest on

    @classmethod
    def from_times(cls, time: Float[np.ndarray, " n"], frequency: float | None) -> "PhaseBins | None":
        """For a drive's frequency (Hz); None where too little repeats."""
        if frequency is None or time.size < _MIN_SAMPLES:
            return None
        place = np.minimum((np.mod(time * frequency, 1.0) * _PHASES[-1]).astype(int), _PHASES[-1] - 1)
        ones = np.ones(time.size, np.float32)
        places = scipy.sparse.csr_array((ones, (place, np.arange(time.size))), (_PHASES[-1], time.size))
        finest = np.bincount(place, minlength=_PHASES[-1])
        counts = [finest.reshape(parts, -1).sum(axis=1) for parts in _PHASES[::-1]]
        sized = [(n, int(np.count_nonzero(n))) for n in counts]
        folds = [Fold(np.where(n > 0, 1.0 / np.maximum(n, 1), 0.0), size, time.size - size) for n, size in sized]
        # with too few samples in each phase their scatter is not known
        return cls(places, tuple(fold for fold in folds if fold.scatter_dof >= time.size // 2))


class ResidualTestStatistics(NamedTuple):
    """What the tests look at, of each record."""

    n_positive: Int[np.ndarray, "*records"]  # residuals above 0
    n_runs: Int[np.ndarray, "*records"]  # stretches of them on one side of it
    fold_fractions: Float[np.ndarray, "*records folds"]  # share of the means over parts of a period in the squares
    distance: Float[np.ndarray, "*records"]  # of the periodogram's sum from white noise's, times the root of the lines
    line_fraction: Float[np.ndarray, "*records"]  # the share of the strongest line

    @classmethod
    def from_residuals(
        cls, residuals: Float[np.ndarray, "*records n"], phase_bins: PhaseBins | None
    ) -> "ResidualTestStatistics":
        """In the precision of the residuals."""
        positive = residuals > 0.0
        turns = count_true(positive[..., 1:] != positive[..., :-1])
        distance, strongest = _periodogram_statistics(residuals)
        folded = _fold_fractions(residuals, phase_bins)
        return cls(count_true(positive), 1 + turns, folded, distance, strongest)


def count_true(mask: Bool[np.ndarray, "*rows n"]) -> Int[np.ndarray, "*rows"]:
    """How many are true in each row, added up in the smallest numbers that hold them, which takes least."""
    return mask.view(np.uint8).sum(axis=-1, dtype=np.min_scalar_type(mask.shape[-1])).astype(int)


def _fold_fractions(
    residuals: Float[np.ndarray, "*records n"], phase_bins: PhaseBins | None
) -> Float[np.ndarray, "*records folds"]:
    records = residuals.shape[:-1]
    if phase_bins is None or not phase_bins.folds:
        return np.empty((*records, 0))
    square = np.vecdot(residuals, residuals)
    sums, found = phase_bins.bin_matrix @ residuals.reshape(-1, residuals.shape[-1]).T, []
    for weight, _, _ in phase_bins.folds:
        sums = sums.reshape(weight.size, len(sums) // weight.size, -1).sum(axis=1)
        found.append((weight @ sums**2).reshape(records) / np.where(square > 0.0, square, 1.0))
    return np.stack(found, axis=-1)


def _periodogram_statistics(
    residuals: Float[np.ndarray, "*records n"], n_bands: int = 250
) -> tuple[np.ndarray, np.ndarray]:
    """The distance of the cumulative periodogram, and the strongest line's share; 0 where there is nothing to share.

    The periodogram is looked at in about `n_bands` places, for colour is broad.
    """
    spectrum = scipy.fft.rfft(residuals)[..., 1 : (residuals.shape[-1] + 1) // 2]
    power = np.square(spectrum.real)
    power += np.square(spectrum.imag)
    whole, lines = power.sum(axis=-1), power.shape[-1]
    if lines == 0:
        return whole, whole
    share = np.where(whole > 0.0, 1.0 / np.where(whole > 0.0, whole, 1.0), 0.0)
    width = max(lines // n_bands, 1)
    count = lines // width
    bands = power[..., : count * width].reshape(*whole.shape, count, width)
    apart = np.cumsum(bands @ np.ones(width, bands.dtype), axis=-1, dtype=float)
    apart *= share[..., None]
    apart -= width * np.arange(1, count + 1) / lines
    distance = np.maximum(apart.max(axis=-1), -apart.min(axis=-1)) * math.sqrt(lines)
    return np.where(whole > 0.0, distance, 0.0), power.max(axis=-1) * share


def p_values(
    statistics: ResidualTestStatistics, samples: int, phase_bins: PhaseBins | None
) -> dict[str, Float[np.ndarray, "*records"]]:
    """Return probabilities that white noise shows more than `statistics`, by test; uncorrected for their number.

    Beside `_folded_p`: Bartlett's test of the cumulative periodogram, by Kolmogorov's law, low where noise is not
    white; and Fisher's, low where one line of the periodogram, as of hum, is too strong for white noise.
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
    """Wald and Wolfowitz's runs test of signs, in standard deviations; far below zero: signs come in stretches."""
    above = statistics.n_positive.astype(float)
    both = 2.0 * above * (samples - above)
    mean = both / samples + 1.0
    variance = both * (both - samples) / (samples**2 * (samples - 1.0))
    return np.where(both > 0.0, (statistics.n_runs - mean) / np.sqrt(np.where(both > 0.0, variance, 1.0)), -np.inf)


def _folded_p(
    fractions: Float[np.ndarray, "*records folds"], phase_bins: PhaseBins | None
) -> Float[np.ndarray, "*records"]:
    """The least of F tests, each of which compares the means in as many parts of the drive's period with their scatter.

    What a wrong circuit leaves repeats with the drive, and adds up over the periods. 1 where nothing is expected to.
    """
    least = np.ones(fractions.shape[:-1])
    for fold, share in zip(phase_bins.folds if phase_bins else (), np.moveaxis(fractions, -1, 0), strict=True):
        # the share of `between` directions in the sum of squares of white noise has a beta distribution
        p = scipy.special.betainc(0.5 * fold.scatter_dof, 0.5 * fold.means_dof, np.maximum(1.0 - share, 0.0))
        least = np.minimum(least, p)
    return least
