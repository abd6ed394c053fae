"""Comparison of the residuals with the model-free noise estimate of the record."""

import math
from collections.abc import Mapping, Sequence
from statistics import NormalDist

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool, Float

from fitact.data.noise import rounding_noise_sd, row_medians, white_noise_sds
from fitact.data.record import Record
from fitact.fitting.residual_tests import N_TESTS, PhaseBins, ResidualTestStatistics, p_values, runs_z
from fitact.problem.drive_choice import DriveModel

_FALSE_ALARM = 1e-6  # false-alarm probability of all residual tests of a channel together, for pure noise
_P_VALUES = ("folded_p", "spectrum_p", "line_p")


def channel_statistics(
    residuals: Float[np.ndarray, " used"],
    time: Float[np.ndarray, " used"],
    noise: float,
    n_fitted: float,
    gain: float,
    record: Record,
    channel: str,
    choice: DriveModel,
    b: float,
    rounding_share: float | None,
    *,
    is_curved: bool,
) -> dict[str, float]:
    """Return figures of merit of the weighted residuals of a channel (in its unit) after fitting `n_fitted` parameters.

    `noise` is the model-free noise estimate of the channel. The noise of a measured drive adds to it, multiplied by
    `gain` (unit of the channel per V). At the samples of V, the response follows V but for a low-pass of it with the
    time constant `b` (s), whose interpolation is all that may be wrong, unless `b` is 0. Between the samples, V is
    linear, or a cubic if it `is_curved`. Rounding errors that noise does not make independent have a share of the power
    of the residuals, `rounding_share` if it is known, and structure that they can explain does not count.
    """
    measured, V = choice.name == "measured", choice.voltage
    expected = math.hypot(noise, gain * record.noise("V") if measured else 0.0)
    repeats = record.frequency() if choice.periodic else None
    count, square, bins = residuals.size, residuals @ residuals, PhaseBins.from_times(time, repeats)
    unit, is_flat = math.sqrt(square / count) or 1.0, rounding_share is None  # else in proportion to the frequency
    if rounding_share is None:
        from_V = gain * record.correlated_rounding("V") if measured else 0.0
        rounding_share = min((math.hypot(record.correlated_rounding(channel), from_V) / unit) ** 2, 1.0)
    # single precision suffices for the tests
    structure = ResidualTestStatistics.from_residuals((residuals / unit).astype(np.float32), bins)
    structure = structure.without_share(rounding_share, count, with_means=is_flat)
    figures = residual_statistics(square, count, structure, np.asarray(expected), count - n_fitted, bins)
    if rounding_share > 0.01:  # whose signs are not independent
        figures["runs_z"] = np.zeros(())
    interpolated = float(interpolation_errors(V, white_noise_sds(V), is_curved=is_curved))
    delayed = float(np.median(np.abs(np.diff(V)))) * record.time_step / (8.0 * b) if b else math.inf
    return {name: float(value) for name, value in figures.items()} | {
        "rounding_noise": rounding_noise_sd(record[channel]),
        "rounding_share": rounding_share,
        "interpolation_error": gain * min(interpolated, delayed) if measured else 0.0,
        "samples": count,
    }


def residual_statistics(
    square: Float[np.ndarray, "*records"],
    samples: int,
    test_statistics: ResidualTestStatistics | None,
    expected: Float[np.ndarray, "*records"],
    freedom: ArrayLike,
    phase_bins: PhaseBins | None,
) -> dict[str, Float[np.ndarray, "*records"]]:
    """Return the figures of merit of each record that follow from sums over its residuals.

    `square` is the sum of the squared residuals, `expected` their expected standard deviation and `freedom` the degrees
    of freedom. `test_statistics` is None if the residuals are not tested.
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
    """Return the number of outliers and the time of the first, `first_outlier` (s).

    Normal noise has a residual beyond the threshold in one of a thousand records. Its sd is estimated from the median
    absolute residual, or is the expected `noise` if that is larger.
    """
    core = float(np.median(np.abs(residuals[residuals != 0.0]))) / 0.6744897501960817 if residuals.any() else 0.0
    threshold = -NormalDist().inv_cdf(0.5e-3 / residuals.size)  # exceeded by any residual with probability 1e-3
    mask = np.abs(residuals) > threshold * max(core, noise)
    count = int(np.count_nonzero(mask))
    return {"outliers": count, **({"first_outlier": float(time[np.argmax(mask)])} if count else {})}


def pooled_statistics(figures: Sequence[dict[str, float]]) -> dict[str, float]:
    """Return pooled figures of merit of all channels; figures with a unit are those of the first channel."""
    freedom = np.array([each["degrees_of_freedom"] for each in figures])
    chi2 = np.array([each["chi2_reduced"] for each in figures])
    return figures[0] | {
        "chi2_reduced": float(chi2 @ freedom / freedom.sum()),
        **{name: min(each[name] for each in figures) for name in ("runs_z", *_P_VALUES)},
        "samples": sum(each["samples"] for each in figures),
        "degrees_of_freedom": float(freedom.sum()),
    }


def is_misfit(figures: Mapping[str, ArrayLike], max_excess: float = 0.1) -> Bool[np.ndarray, "*records"]:
    """Return whether the residuals are larger than the noise, or have structure.

    `max_excess` is the largest acceptable relative excess of the residual variance over that of the noise; a larger
    excess must also be significant.
    """
    # sd of log(residual variance / variance of `white_noise_sd`), times sqrt(samples), from simulations
    log_ratio_sd = 2.66
    significance = -NormalDist().inv_cdf(_FALSE_ALARM)
    significant = np.expm1(significance * log_ratio_sd / np.sqrt(np.asarray(figures["degrees_of_freedom"])))
    # rounding correlates the residuals and makes the noise estimate less accurate
    rounded = np.where(np.asarray(figures["rounding_noise"]) > 0.0, 1.0, figures.get("rounding_share", 0.0))
    allowed = np.maximum(np.maximum(rounded, max_excess), significant)
    excess = np.asarray(figures["chi2_reduced"]) > 1.0 + allowed
    return excess | is_structured(figures) | is_undersampled(figures)


def is_structured(figures: Mapping[str, ArrayLike], min_runs_z: float = -6.0) -> Bool[np.ndarray, "*records"]:
    """Return whether any test rejects white noise; False for residuals that were not tested."""
    if "runs_z" not in figures:
        return np.zeros(np.shape(figures["chi2_reduced"]), bool)
    least = np.minimum.reduce([np.asarray(figures[name]) for name in _P_VALUES])
    return (np.asarray(figures["runs_z"]) < min_runs_z) | (least < _FALSE_ALARM / N_TESTS)


def is_undersampled(figures: Mapping[str, ArrayLike]) -> Bool[np.ndarray, "*records"]:
    """Return whether linear interpolation between samples of the drive causes a significant error."""
    # above a fifth of the rms of the residuals, g and b are biased by several sd
    return np.asarray(figures["interpolation_error"]) > 0.2 * np.asarray(figures["rms_residual"])


def interpolation_errors(
    voltage: Float[np.ndarray, "*records samples"], noise: ArrayLike, *, is_curved: bool = False
) -> Float[np.ndarray, "*records"]:
    """Return the error (V) of linear interpolation of smooth drives, from their second differences less their noise.

    If the interpolation `is_curved`, it is that of cubics, from fourth differences.
    """
    order, variance, part = (4, 70.0, 3.0 / 128.0) if is_curved else (2, 6.0, 1.0 / 8.0)
    bend = row_medians(np.abs(np.diff(np.diff(voltage).astype(np.float32), order - 1)))
    noise = 0.6744897501960817 * np.asarray(noise)
    return part * np.sqrt(np.maximum(bend**2 - 1.5 * variance * noise**2, 0.0))
