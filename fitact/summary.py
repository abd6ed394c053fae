"""Summaries of one quantity: mean, sd and quantiles, from draws or from a Laplace approximation; and of them all."""

import importlib.metadata
import json
import math
import os
import platform
import statistics
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from fitact.errors import InputError
from fitact.tables import align_rows, join_lines
from fitact.units import format_engineering, quantity_unit

_PACKAGES = ("fitact", "jax", "equinox", "optimistix", "emcee", "numpy", "xarray")
_SECTIONS = {"parameters", "derived", "identifiability", "convergence", "fit", "model", "warnings", "record"}
PROBABILITIES = {f"q{digits}": float(f"0.{digits}") for digits in ("025", "05", "25", "50", "75", "95", "975")}
_NORMAL = {key: statistics.NormalDist().inv_cdf(p) for key, p in PROBABILITIES.items()}  # standard normal quantiles

Summary = dict[str, float | str]
FORCE_DESCRIPTIONS = {  # what makes the force, by the name of its model
    "paper": "by Vsc, eq. (22)",
    "gap": "by the voltage across the gap, eps0 A Vgap^2 / (2 d^2)",
}


def summarize_draws(name: str, draws: Float[np.ndarray, "*shape"]) -> Summary:
    """Summary of draws of the quantity `name`, in its SI unit."""
    quantiles = np.quantile(draws, list(PROBABILITIES.values())).tolist()
    summary: Summary = {"unit": quantity_unit(name), "mean": float(np.mean(draws)), "sd": float(np.std(draws, ddof=1))}
    return summary | dict(zip(PROBABILITIES, quantiles, strict=True))


def summarize_log_normal(name: str, median: float, log_sd: float) -> Summary:
    """Summary of a quantity whose logarithm is normal; infinite where a number of that size overflows."""
    with np.errstate(over="ignore"):
        mean = median * np.exp(0.5 * log_sd**2)
        quantiles = median * np.exp(log_sd * np.array(list(_NORMAL.values())))
        sd = mean * np.sqrt(np.expm1(log_sd**2))
    summary: Summary = {"unit": quantity_unit(name), "mean": float(mean), "sd": float(sd)}
    return summary | dict(zip(_NORMAL, quantiles.tolist(), strict=True))


def summarize_normal(name: str, mean: float, sd: float) -> Summary:
    """Summary of a normal quantity."""
    summary: Summary = {"unit": quantity_unit(name), "mean": mean, "sd": sd}
    return summary | {key: mean + z * sd for key, z in _NORMAL.items()}


def format_sd(summary: Summary) -> str:
    """Its standard deviation for people: in per cent of the mean, or as it is where that says little."""
    mean, sd = float(summary["mean"]), float(summary["sd"])
    if not sd <= 1e6 * abs(mean) or math.isinf(sd):  # it says nothing
        return "open"
    if sd > 0.5 * abs(mean):
        return format_engineering(sd, str(summary["unit"]), 2)
    return f"{np.format_float_positional(100.0 * sd / abs(mean), 2, fractional=False, trim='-')} %"


def load(directory: str | os.PathLike[str]) -> dict[str, Any]:
    """The content of summary.json, in a folder that `fitact sample` or `fitact run` wrote."""
    try:
        content = json.loads((Path(directory) / "summary.json").read_text(encoding="utf-8"))
        if not (isinstance(content, dict) and set(content) >= _SECTIONS):
            raise ValueError("summary.json is not fitact's")
        return content
    except (OSError, ValueError) as error:
        raise InputError(
            f"{directory}: holds no complete results ({error}); make them with: fitact sample RECORD --out {directory}"
        ) from error


def table(content: dict[str, Any]) -> str:
    """The content of summary.json, for people."""
    cells = [("", "median", "5 %", "95 %")]
    for name, s in (content["parameters"] | content["derived"]).items():
        cells.append((name, *(format_engineering(float(s[q]), str(s["unit"])) for q in ("q50", "q05", "q95"))))
    rows = align_rows(cells, (14, 12, 14, 12))
    rows += [f"force: {FORCE_DESCRIPTIONS[content['model'].get('force', 'paper')]}."]
    rows += [content[section]["sentence"] for section in ("convergence", "identifiability")]
    return join_lines(rows, content["warnings"])


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that results depend on."""
    return {"python": platform.python_version()} | {name: importlib.metadata.version(name) for name in _PACKAGES}


def is_trusted(content: dict[str, Any]) -> bool:
    """Whether nothing stands against the answer that summary.json holds."""
    return bool(content["convergence"]["converged"]) and content["fit"]["result"] == "successful"
