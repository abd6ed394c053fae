"""Do the residuals look like the noise that the record itself shows?"""

import math
from collections.abc import Mapping, Sequence
from statistics import NormalDist

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool, Float

from fitact.data.record import Record, rounding_noise_sd, white_noise_sd
from fitact.fitting.drive_choice import DriveModel
from fitact.fitting.residual_tests import N_TESTS, PhaseBins, ResidualTestStatistics, p_values, runs_z

_FALSE_ALARM = 1e-6  # of a channel that holds nothing but noise, by all tests of structure together
_P_VALUES = ("folded_p", "spectrum_p", "line_p")


def channel_statistics(
    residuals: Float[np.ndarray, " kept"],
    time: Float[np.ndarray, " kept"],
    noise: float,
    n_fitted: float,
    gain: float,
    record: Record,
    channel: str,
    choice: DriveModel,
) -> dict[str, float]:
    """Figures of merit of a channel's residuals (weighted, in its unit) after `n_fitted` parameters were fitted.

    `noise` is what to expect of the channel, judged without the model; a measured drive adds its own, which
    reaches the channel through `gain` (its unit per V).
    """
    measured = choice.name == "measured"
    expected = math.hypot(noise, gain * record.noise("V") if measured else 0.0)
    repeats = record.frequency() if choice.periodic else None
    count, square, bins = residuals.size, residuals @ residuals, PhaseBins.from_times(time, repeats)
    unit = math.sqrt(square / count) or 1.0
    structure = ResidualTestStatistics.from_residuals((residuals / unit).astype(np.float32), bins)  # which is enough
    found = residual_statistics(square, count, structure, np.asarray(expected), count - n_fitted, bins)
    return {name: float(value) for name, value in found.items()} | {
        "rounding_noise": rounding_noise_sd(record[channel]),
        "interpolation_error": gain * interpolation_error(record["V"]) if measured else 0.0,
        "samples": count,
    }


def residual_statistics(
    square: Float[np.ndarray, "*records"],
    samples: int,
    test_statistics: ResidualTestStatistics | None,
    expected: Float[np.ndarray, "*records"],
    freedom: float,
    phase_bins: PhaseBins | None,
) -> dict[str, Float[np.ndarray, "*records"]]:
    """The part of `statistics` that needs no more than what residuals come to, of each record.

    That is the sum of their squares, and their `test_statistics`, if tested; `expected` is their standard deviation.
    """
    tests = {}
    if test_statistics is not None:
        tests = {"runs_z": runs_z(test_statistics, samples)} | p_values(test_statistics, samples, phase_bins)
    return {
        "chi2_reduced": square / (freedom * expected**2),
        "rms_residual": np.sqrt(square / samples),
        "noise_expected": expected,
        **tests,
        "degrees_of_freedom": np.full(square.shape, freedom),
    }


def outliers(residuals: Float[np.ndarray, " n"], time: Float[np.ndarray, " n"], noise: float) -> dict[str, float]:
    """How many residuals lie further out than normal noise puts one in a thousand such records, and where the first.

    The noise is that of the middle half of them, or the one to expect where that is larger; `first_outlier` is in s.
    """
    core = float(np.median(np.abs(residuals[residuals != 0.0]))) / 0.6744897501960817 if residuals.any() else 0.0
    threshold = -NormalDist().inv_cdf(0.5e-3 / residuals.size)  # beyond which any lies with a probability of 1e-3
    beyond = np.abs(residuals) > threshold * max(core, noise)
    count = int(np.count_nonzero(beyond))
    return {"outliers": count, **({"first_outlier": float(time[np.argmax(beyond)])} if count else {})}


def pooled_statistics(figures: Sequence[dict[str, float]]) -> dict[str, float]:
    """Figures of merit of all channels; those with a unit are the first's."""
    freedom = np.array([each["degrees_of_freedom"] for each in figures])
    chi2 = np.array([each["chi2_reduced"] for each in figures])
    return figures[0] | {
        "chi2_reduced": float(chi2 @ freedom / freedom.sum()),
        **{name: min(each[name] for each in figures) for name in ("runs_z", *_P_VALUES)},
        "samples": sum(each["samples"] for each in figures),
        "degrees_of_freedom": float(freedom.sum()),
    }


def is_misfit(figures: Mapping[str, ArrayLike], max_excess: float = 0.1) -> Bool[np.ndarray, "*records"]:
    """Whether the residuals are larger than the noise, or have structure.

    `max_excess`: of the residual variance over the noise's; more counts if it is also significant.
    """
    # sd of the log of residual variance over `white_noise_sd`'s, times the root of the samples, by simulation
    log_ratio_sd = 2.66
    significance = -NormalDist().inv_cdf(_FALSE_ALARM)
    significant = np.expm1(significance * log_ratio_sd / np.sqrt(np.asarray(figures["degrees_of_freedom"])))
    # a rounded channel's residuals come in stretches that repeat, and its noise is known less well
    rounded = np.asarray(figures["rounding_noise"]) > 0.0
    excess = np.asarray(figures["chi2_reduced"]) > 1.0 + np.maximum(np.where(rounded, 1.0, max_excess), significant)
    return excess | (is_structured(figures) & ~rounded) | is_undersampled(figures)


def is_structured(figures: Mapping[str, ArrayLike], min_runs_z: float = -6.0) -> Bool[np.ndarray, "*records"]:
    """Whether any test tells the residuals from white noise; what was not tested is not told from it."""
    if "runs_z" not in figures:
        return np.zeros(np.shape(figures["chi2_reduced"]), bool)
    least = np.minimum.reduce([np.asarray(figures[name]) for name in _P_VALUES])
    return (np.asarray(figures["runs_z"]) < min_runs_z) | (least < _FALSE_ALARM / N_TESTS)


def is_undersampled(figures: Mapping[str, ArrayLike]) -> Bool[np.ndarray, "*records"]:
    """Whether the straight lines between the drive's samples err by more than the noise hides."""
    # from a fifth of the residuals' rms g and b are off by several sd
    return np.asarray(figures["interpolation_error"]) > 0.2 * np.asarray(figures["rms_residual"])


def interpolation_error(voltage: Float[np.ndarray, " samples"]) -> float:
    """How far a smooth drive lies from the lines between its samples (V): its bend over a step, beyond the noise's."""
    bend = float(np.median(np.abs(np.diff(voltage, 2))))
    noise = 0.6744897501960817 * math.sqrt(6.0) * white_noise_sd(voltage)
    return math.sqrt(max(bend**2 - 1.5 * noise**2, 0.0)) / 8.0
