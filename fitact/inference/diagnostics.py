"""Do the residuals look like the noise that the record itself shows?"""

import math

import numpy as np
from jaxtyping import Float

from fitact.data.record import Record, rounding_noise
from fitact.inference.start import DriveChoice

_RUNS = 6.0  # standard deviations of the runs test at which residuals count as structured
_EXCESS = 0.1  # excess of the residual variance over the noise's that counts, if it is also significant


def statistics(
    residuals: Float[np.ndarray, " samples"], freed: int, g: float, record: Record, choice: DriveChoice
) -> dict[str, float]:
    """Figures of merit of residuals (V) after `freed` parameters were fitted.

    The noise to expect is judged from the record without a model; a measured drive adds its own noise,
    which reaches Vsc through the divider `g`.
    """
    from_drive = g * record.noise("V") if choice.name == "measured" else 0.0
    expected = math.hypot(max(record.noise("Vsc"), rounding_noise(record["Vsc"])), from_drive)
    freedom = residuals.size - freed
    return {
        "chi2_reduced": float(residuals @ residuals / (freedom * expected**2)),
        "rms_residual": float(np.sqrt(np.mean(residuals**2))),
        "noise_expected": expected,
        "runs_z": runs_z(residuals),
        "samples": residuals.size,
        "degrees_of_freedom": freedom,
    }


def is_misfit(figures: dict[str, float]) -> bool:
    """Whether the residuals are larger than the noise, or have structure."""
    significant = 6.0 * math.sqrt(2.0 / figures["degrees_of_freedom"])
    return figures["chi2_reduced"] > 1.0 + max(_EXCESS, significant) or figures["runs_z"] < -_RUNS


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
