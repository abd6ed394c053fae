"""Summaries of one quantity: mean, sd and quantiles, from draws or from a Laplace approximation."""

import math

import numpy as np
from jaxtyping import Float

from fitact.units import engineering

UNITS = {
    "Rsc": "ohm", "Csc": "F", "Ci": "F", "gain": "1", "delay": "s", "sigma": "V",
    "offset": "V", "drift": "V", "charge": "V",
    "hum_50Hz_cos": "V", "hum_50Hz_sin": "V", "hum_60Hz_cos": "V", "hum_60Hz_sin": "V",
    "g": "1", "b": "s", "force_mean": "N", "force_peak": "N", "force_rms": "N", "friction_mean": "N",
}  # fmt: skip
# standard normal quantiles of the summary's probabilities
_NORMAL = {
    "q025": -1.959963984540054, "q05": -1.6448536269514722, "q25": -0.6744897501960817, "q50": 0.0,
    "q75": 0.6744897501960817, "q95": 1.6448536269514722, "q975": 1.959963984540054,
}  # fmt: skip

Summary = dict[str, float | str]


def of_draws(name: str, draws: Float[np.ndarray, "*shape"]) -> Summary:
    """Summary of draws of the quantity `name`, in its SI unit."""
    quantiles = np.quantile(draws, [float(f"0.{key[1:]}") for key in _NORMAL])
    summary: Summary = {
        "unit": UNITS[name],
        "mean": float(np.mean(draws)),
        "sd": float(np.std(draws, ddof=1)),
    }
    return summary | {key: float(value) for key, value in zip(_NORMAL, quantiles, strict=True)}


def log_normal(name: str, median: float, log_sd: float) -> Summary:
    """Summary of a quantity whose logarithm is normal."""
    mean = median * math.exp(0.5 * log_sd**2)
    summary: Summary = {"unit": UNITS[name], "mean": mean, "sd": mean * math.sqrt(math.expm1(log_sd**2))}
    return summary | {key: median * math.exp(z * log_sd) for key, z in _NORMAL.items()}


def normal(name: str, mean: float, sd: float) -> Summary:
    """Summary of a normal quantity."""
    summary: Summary = {"unit": UNITS[name], "mean": mean, "sd": sd}
    return summary | {key: mean + z * sd for key, z in _NORMAL.items()}


def width(summary: Summary) -> str:
    """Its standard deviation for people: in per cent of the mean, or as it is where that says little."""
    mean, sd = float(summary["mean"]), float(summary["sd"])
    if sd > 0.5 * abs(mean):
        return engineering(sd, str(summary["unit"]), 2)
    return f"{np.format_float_positional(100.0 * sd / abs(mean), 2, fractional=False, trim='-')} %"
