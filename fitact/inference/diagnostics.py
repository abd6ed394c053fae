"""Do the residuals look like the noise that the record itself shows?"""

import math
from collections.abc import Mapping, Sequence
from statistics import NormalDist

import numpy as np
import scipy.fft
import scipy.sparse
import scipy.special
from jax.typing import ArrayLike
from jaxtyping import Bool, Float

from fitact.data.record import Record, medians, rounding_noise, white_noise
from fitact.inference.start import DriveChoice

_RUNS = 6.0  # standard deviations of the runs test at which residuals count as structured
_COARSE = 0.2  # of the residuals' rms: error of the drive's interpolation from which g and b are off by several sd
_PHASES = (8, 32, 128, 512)  # parts of a period whose means are compared; few show what is slow, many what is brief
_FALSE_ALARM = 1e-6  # of a trace that holds nothing but noise, by all tests of structure together
_TESTS = len(_PHASES) + 2
_BANDS = 500  # about as many places are looked at in the cumulative periodogram, for colour is broad
_LEAST_TESTED = 64  # samples, below which a spectrum says little
_P_VALUES = ("folded_p", "spectrum_p", "line_p")
_EXCESS = 0.1  # excess of the residual variance over the noise's that counts, if it is also significant
_RATIO = 2.66  # sd of the log of residual variance over `white_noise`'s, times the root of the samples, by simulation
_SURE = -NormalDist().inv_cdf(_FALSE_ALARM)  # standard deviations


def statistics(
    residuals: Float[np.ndarray, " kept"],
    time: Float[np.ndarray, " kept"],
    noise: float,
    freed: float,
    gain: float,
    record: Record,
    channel: str,
    choice: DriveChoice,
) -> dict[str, float]:
    """Figures of merit of a channel's residuals (weighted, in its unit) after `freed` parameters were fitted.

    `noise` is what to expect of the channel, judged without the model; a measured drive adds its own, which
    reaches the channel through `gain` (its unit per V).
    """
    measured = choice.name == "measured"
    expected = math.hypot(noise, gain * record.noise("V") if measured else 0.0)
    repeats = record.frequency() if choice.periodic else None
    found = tests(residuals, np.asarray(expected), residuals.size - freed, phases(time, repeats))
    return {name: float(value) for name, value in found.items()} | {
        "rounding_noise": rounding_noise(record[channel]),
        "interpolation_error": gain * interpolation_error(record["V"]) if measured else 0.0,
        "samples": residuals.size,
    }


def tests(
    residuals: Float[np.ndarray, "*records kept"],
    expected: Float[np.ndarray, "*records"],
    freedom: float,
    of_time: scipy.sparse.csr_array | None,
) -> dict[str, Float[np.ndarray, "*records"]]:
    """The part of `statistics` that needs no more than residuals, of each record.

    `expected` is their standard deviation, `of_time` the samples' `phases`.
    """
    square = np.einsum("...i,...i->...", residuals, residuals)
    shares = periodogram(residuals)
    return {
        "chi2_reduced": square / (freedom * expected**2),
        "rms_residual": np.sqrt(square / residuals.shape[-1]),
        "noise_expected": expected,
        "runs_z": runs_z(residuals),
        "folded_p": folded_p(residuals, of_time),
        "spectrum_p": spectrum_p(shares),
        "line_p": line_p(shares),
        "degrees_of_freedom": np.full(square.shape, freedom),
    }


def outliers(residuals: Float[np.ndarray, " n"], time: Float[np.ndarray, " n"], noise: float) -> dict[str, float]:
    """How many residuals lie further out than normal noise puts one in a thousand such records, and where the first.

    The noise is that of the middle half of them, or the one to expect where that is larger; `first_outlier` is in s.
    """
    core = float(np.median(np.abs(residuals[residuals != 0.0]))) / 0.6744897501960817 if residuals.any() else 0.0
    beyond = np.abs(residuals) > far(residuals.size) * max(core, noise)
    count = int(np.count_nonzero(beyond))
    return {"outliers": count, **({"first_outlier": float(time[np.argmax(beyond)])} if count else {})}


def far(count: int) -> float:
    """Standard deviations beyond which one of that many normal numbers lies with a probability of 1e-3."""
    return -NormalDist().inv_cdf(0.5e-3 / count)


def together(figures: Sequence[dict[str, float]]) -> dict[str, float]:
    """Figures of merit of all traces; those with a unit are the first's."""
    freedom = np.array([each["degrees_of_freedom"] for each in figures])
    chi2 = np.array([each["chi2_reduced"] for each in figures])
    return figures[0] | {
        "chi2_reduced": float(chi2 @ freedom / freedom.sum()),
        **{name: min(each[name] for each in figures) for name in ("runs_z", *_P_VALUES)},
        "samples": sum(each["samples"] for each in figures),
        "degrees_of_freedom": float(freedom.sum()),
    }


def is_misfit(figures: Mapping[str, ArrayLike]) -> Bool[np.ndarray, "*records"]:
    """Whether the residuals are larger than the noise, or have structure."""
    significant = np.expm1(_SURE * _RATIO / np.sqrt(np.asarray(figures["degrees_of_freedom"])))
    # a rounded channel's residuals come in stretches that repeat, and its noise is known less well
    rounded = np.asarray(figures["rounding_noise"]) > 0.0
    excess = np.asarray(figures["chi2_reduced"]) > 1.0 + np.maximum(np.where(rounded, 1.0, _EXCESS), significant)
    return excess | (is_structured(figures) & ~rounded) | is_coarse(figures)


def is_structured(figures: Mapping[str, ArrayLike]) -> Bool[np.ndarray, "*records"]:
    """Whether any test tells the residuals from white noise."""
    least = np.minimum.reduce([np.asarray(figures[name]) for name in _P_VALUES])
    return (np.asarray(figures["runs_z"]) < -_RUNS) | (least < _FALSE_ALARM / _TESTS)


def is_coarse(figures: Mapping[str, ArrayLike]) -> Bool[np.ndarray, "*records"]:
    """Whether the straight lines between the drive's samples err by more than the noise hides."""
    return np.asarray(figures["interpolation_error"]) > _COARSE * np.asarray(figures["rms_residual"])


def interpolation_error(voltage: Float[np.ndarray, " samples"]) -> float:
    """How far a smooth drive lies from the lines between its samples (V): its bend over a step, beyond the noise's."""
    bend = float(np.median(np.abs(np.diff(voltage, 2))))
    noise = 0.6744897501960817 * math.sqrt(6.0) * white_noise(voltage)
    return math.sqrt(max(bend**2 - 1.5 * noise**2, 0.0)) / 8.0


def runs_z(residuals: Float[np.ndarray, "*records samples"]) -> Float[np.ndarray, "*records"]:
    """Wald and Wolfowitz's runs test of signs, in standard deviations; far below zero: signs come in stretches."""
    positive = residuals > medians(residuals.copy())[..., None]
    size = positive.shape[-1]
    above = np.count_nonzero(positive, axis=-1).astype(float)
    runs = 1.0 + np.count_nonzero(positive[..., 1:] != positive[..., :-1], axis=-1)
    both = 2.0 * above * (size - above)
    mean = both / size + 1.0
    variance = both * (both - size) / (size**2 * (size - 1.0))
    return np.where(both > 0.0, (runs - mean) / np.sqrt(np.where(both > 0.0, variance, 1.0)), -np.inf)


def phases(time: Float[np.ndarray, " n"], frequency: float | None) -> scipy.sparse.csr_array | None:
    """Which samples are in each of the many parts of the drive's period (Hz); None where too little repeats."""
    if frequency is None or time.size < _LEAST_TESTED:
        return None
    place = np.minimum((np.mod(time * frequency, 1.0) * _PHASES[-1]).astype(int), _PHASES[-1] - 1)
    return scipy.sparse.csr_array((np.ones(time.size), (place, np.arange(time.size))), (_PHASES[-1], time.size))


def folded_p(
    residuals: Float[np.ndarray, "*records n"], of_time: scipy.sparse.csr_array | None
) -> Float[np.ndarray, "*records"]:
    """Probability that white noise repeats with the drive as much as this: the least of F tests, uncorrected.

    Each compares the means of the residuals in as many of the `phases` of the period with their scatter. What a wrong
    circuit leaves repeats with the drive, and adds up over the periods. 1 where nothing is expected to repeat.
    """
    size, of = residuals.shape[-1], residuals.shape[:-1]
    if of_time is None:
        return np.ones(of)
    count = of_time.sum(axis=1)
    total = np.ascontiguousarray((of_time @ residuals.reshape(-1, size).T).T)
    square = np.einsum("...i,...i->...", residuals, residuals)
    found = [np.ones(of)]
    for parts in _PHASES:
        n = count.reshape(parts, -1).sum(axis=-1)
        between, within = np.count_nonzero(n), size - np.count_nonzero(n)
        if within < size // 2:  # too few samples in each phase to know their scatter
            break
        sums = total.reshape(*of, parts, _PHASES[-1] // parts).sum(axis=-1)
        share = sums**2 @ (1.0 / np.maximum(n, 1)) / np.where(square > 0.0, square, 1.0)
        # the share of `between` directions in the sum of squares of white noise has a beta distribution
        found.append(scipy.special.betainc(0.5 * within, 0.5 * between, np.maximum(1.0 - share, 0.0)))
    return np.minimum.reduce(found)


def spectrum_p(share: Float[np.ndarray, "*records lines"]) -> Float[np.ndarray, "*records"]:
    """Bartlett's test of the cumulative `periodogram`, by Kolmogorov's law: low where noise is not white."""
    lines = share.shape[-1]
    if lines < _LEAST_TESTED // 2:
        return np.ones(share.shape[:-1])
    width = max(lines // _BANDS, 1)
    count = lines // width
    bands = share[..., : count * width].reshape(*share.shape[:-1], count, width) @ np.ones(width, share.dtype)
    above = np.cumsum(bands, axis=-1, dtype=float)
    above -= width * np.arange(1, count + 1) / lines
    distance = np.maximum(above.max(axis=-1), -above.min(axis=-1)) * math.sqrt(lines)
    k = np.arange(1, 31)
    series = 2.0 * np.sum((-1.0) ** (k - 1) * np.exp(-2.0 * (k * distance[..., None]) ** 2), axis=-1)
    # 1 where the series converges slowly
    return np.where(distance < 0.2, 1.0, np.clip(series, 0.0, 1.0))


def line_p(share: Float[np.ndarray, "*records lines"]) -> Float[np.ndarray, "*records"]:
    """Fisher's test: low where one line of the `periodogram`, as of hum, is too strong for white noise."""
    lines = share.shape[-1]
    if lines < _LEAST_TESTED // 2:
        return np.ones(share.shape[:-1])
    log_p = math.log(lines) + (lines - 1) * np.log1p(-np.minimum(np.max(share, axis=-1), 1.0 - 1e-16))
    return np.exp(np.minimum(log_p, 0.0))


def periodogram(residuals: Float[np.ndarray, "*records n"]) -> Float[np.ndarray, "*records lines"]:
    """Shares of the lines between 0 and half the sampling rate; even ones where there is nothing to share.

    In single precision, which is plenty for tests, and takes half the time.
    """
    height = np.max(np.abs(residuals), axis=-1, keepdims=True)
    unit = np.multiply(residuals, 1.0 / np.where(height > 0.0, height, 1.0), dtype=np.float32, casting="same_kind")
    lines = scipy.fft.rfft(unit)[..., 1 : (residuals.shape[-1] + 1) // 2]
    power = lines.real**2 + lines.imag**2
    whole = power.sum(axis=-1, keepdims=True)
    power /= np.where(whole > 0.0, whole, 1.0)
    power[whole[..., 0] == 0.0] = 1.0 / max(power.shape[-1], 1)
    return power
