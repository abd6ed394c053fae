"""Do the residuals look like the noise that the record itself shows?"""

import math
from collections.abc import Mapping, Sequence
from statistics import NormalDist

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool, Float

from fitact.data.record import Record, rounding_noise, white_noise
from fitact.fitting.drive_choice import DriveChoice
from fitact.fitting.residual_tests import TESTS, Phases, Structure, probabilities, runs_z

_RUNS = 6.0  # standard deviations of the runs test at which residuals count as structured
_COARSE = 0.2  # of the residuals' rms: error of the drive's interpolation from which g and b are off by several sd
_FALSE_ALARM = 1e-6  # of a trace that holds nothing but noise, by all tests of structure together
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
    of_time = Phases.of(time, repeats)
    square = residuals @ residuals
    unit = math.sqrt(square / residuals.size) or 1.0
    structure = Structure.of((residuals / unit).astype(np.float32), of_time)  # tests need no more than that
    found = judged(square, residuals.size, structure, np.asarray(expected), residuals.size - freed, of_time)
    return {name: float(value) for name, value in found.items()} | {
        "rounding_noise": rounding_noise(record[channel]),
        "interpolation_error": gain * interpolation_error(record["V"]) if measured else 0.0,
        "samples": residuals.size,
    }


def judged(
    square: Float[np.ndarray, "*records"],
    samples: int,
    structure: Structure | None,
    expected: Float[np.ndarray, "*records"],
    freedom: float,
    of_time: Phases | None,
) -> dict[str, Float[np.ndarray, "*records"]]:
    """The part of `statistics` that needs no more than what residuals come to, of each record.

    That is the sum of their squares, and their `structure`, if tested; `expected` is their standard deviation.
    """
    tests = {}
    if structure is not None:
        tests = {"runs_z": runs_z(structure, samples), **probabilities(structure, samples, of_time)}
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
    """Whether any test tells the residuals from white noise; what was not tested is not told from it."""
    if "runs_z" not in figures:
        return np.zeros(np.shape(figures["chi2_reduced"]), bool)
    least = np.minimum.reduce([np.asarray(figures[name]) for name in _P_VALUES])
    return (np.asarray(figures["runs_z"]) < -_RUNS) | (least < _FALSE_ALARM / TESTS)


def is_coarse(figures: Mapping[str, ArrayLike]) -> Bool[np.ndarray, "*records"]:
    """Whether the straight lines between the drive's samples err by more than the noise hides."""
    return np.asarray(figures["interpolation_error"]) > _COARSE * np.asarray(figures["rms_residual"])


def interpolation_error(voltage: Float[np.ndarray, " samples"]) -> float:
    """How far a smooth drive lies from the lines between its samples (V): its bend over a step, beyond the noise's."""
    bend = float(np.median(np.abs(np.diff(voltage, 2))))
    noise = 0.6744897501960817 * math.sqrt(6.0) * white_noise(voltage)
    return math.sqrt(max(bend**2 - 1.5 * noise**2, 0.0)) / 8.0
