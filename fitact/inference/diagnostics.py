"""Do the residuals look like the noise that the record itself shows?"""

import math

import numpy as np
from jaxtyping import Float

from fitact.data.record import Record, rounding_noise, white_noise
from fitact.inference.start import DriveChoice

_RUNS = 6.0  # standard deviations of the runs test at which residuals count as structured
_COARSE = 0.2  # of the residuals' rms: error of the drive's interpolation from which g and b are off by several sd
_EXCESS = 0.1  # excess of the residual variance over the noise's that counts, if it is also significant


def statistics(
    residuals: Float[np.ndarray, " samples"], freed: int, g: float, record: Record, choice: DriveChoice
) -> dict[str, float]:
    """Figures of merit of residuals (V) after `freed` parameters were fitted.

    The noise to expect is judged from the record without a model; a measured drive adds its own noise,
    which reaches Vsc through the divider `g`.
    """
    from_drive = g * record.noise("V") if choice.name == "measured" else 0.0
    expected = math.hypot(record.noise("Vsc"), from_drive)
    freedom = residuals.size - freed
    return {
        "chi2_reduced": float(residuals @ residuals / (freedom * expected**2)),
        "rms_residual": float(np.sqrt(np.mean(residuals**2))),
        "noise_expected": expected,
        "runs_z": runs_z(residuals),
        "rounding_noise": rounding_noise(record["Vsc"]),
        "interpolation_error": g * interpolation_error(record["V"]) if choice.name == "measured" else 0.0,
        "samples": residuals.size,
        "degrees_of_freedom": freedom,
    }


def is_misfit(figures: dict[str, float]) -> bool:
    """Whether the residuals are larger than the noise, or have structure."""
    significant = 6.0 * math.sqrt(2.0 / figures["degrees_of_freedom"])
    # a rounded channel's residuals come in stretches, and its noise is known less well
    rounded = figures["rounding_noise"] > 0.0
    excess = figures["chi2_reduced"] > 1.0 + max(1.0 if rounded else _EXCESS, significant)
    return excess or (figures["runs_z"] < -_RUNS and not rounded) or is_coarse(figures)


def is_coarse(figures: dict[str, float]) -> bool:
    """Whether the straight lines between the drive's samples err by more than the noise hides."""
    return figures["interpolation_error"] > _COARSE * figures["rms_residual"]


def interpolation_error(voltage: Float[np.ndarray, " samples"]) -> float:
    """How far a smooth drive lies from the lines between its samples (V): its bend over a step, beyond the noise's."""
    bend = float(np.median(np.abs(np.diff(voltage, 2))))
    noise = 0.6744897501960817 * math.sqrt(6.0) * white_noise(voltage)
    return math.sqrt(max(bend**2 - 1.5 * noise**2, 0.0)) / 8.0


def runs_z(residuals: Float[np.ndarray, " samples"]) -> float:
    """Wald and Wolfowitz's runs test of signs, in standard deviations; far below zero: signs come in stretches."""
    positive = residuals > np.median(residuals)
    above = int(positive.sum())
    below = positive.size - above
    if above == 0 or below == 0:
        return -math.inf
    runs = 1 + int(np.count_nonzero(positive[1:] != positive[:-1]))
    both = 2.0 * above * below
    mean = both / positive.size + 1.0
    variance = both * (both - positive.size) / (positive.size**2 * (positive.size - 1.0))
    return (runs - mean) / math.sqrt(variance)
