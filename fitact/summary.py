"""Summaries of quantities: mean, sd, quantiles and combined uncertainty, and how people read these numbers."""

import importlib.metadata
import json
import math
import os
import platform
import re
import statistics
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from fitact.files import complete_folder
from fitact.units import (
    DERIVED,
    GEOMETRY,
    NUISANCES,
    PARAMETERS,
    choose_prefixed_unit,
    format_engineering,
    quantity_unit,
)

_PACKAGES = ("fitact", "jax", "equinox", "optimistix", "emcee", "numpy", "xarray")
_SECTIONS = {"parameters", "derived", "identifiability", "convergence", "fit", "model", "warnings", "record"}
PROBABILITIES = {f"q{digits}": float(f"0.{digits}") for digits in ("025", "05", "25", "50", "75", "95", "975")}
_NORMAL = {key: statistics.NormalDist().inv_cdf(p) for key, p in PROBABILITIES.items()}  # standard normal quantiles

Summary = dict[str, Any]
TRUSTED_RESULTS = ("successful", "structure")  # results of reliable fits
_CHANNELS = {"": "Vsc", "I": "I", "Z": "the impedance", "H": "Vsc/V", "Ft": "the friction"}  # by the end of a name


def describe_quantity(name: str) -> str:
    """Return the name of a quantity for people; a nuisance may end in the label of its channel, as "sigma_I_2"."""
    labels = PARAMETERS | NUISANCES | GEOMETRY | DERIVED
    bare = name if name in labels else re.sub(r"_\d+$", "", name)
    number = name[len(bare) + 1 :]
    stem, _, letter = (bare, "", "") if bare in labels else bare.rpartition("_")
    label = labels[stem][1].format(describe_channel(letter))
    return label + (f", record {number}" if number else "")


def describe_channel(letter: str) -> str:
    """Return the name of a channel by the end of the names of its nuisances: "" means Vsc."""
    return _CHANNELS[letter]


def summarize_draws(name: str, draws: Float[np.ndarray, "*shape"]) -> Summary:
    """Summarize draws of the quantity `name`, in its SI unit."""
    quantiles = np.quantile(draws, list(PROBABILITIES.values())).tolist()
    summary: Summary = {"unit": quantity_unit(name), "mean": float(np.mean(draws)), "sd": float(np.std(draws, ddof=1))}
    return summary | dict(zip(PROBABILITIES, quantiles, strict=True))


def summarize_log_normal(name: str, median: float, log_sd: float) -> Summary:
    """Summarize a quantity whose logarithm is normal; infinite where a number of that size overflows."""
    with np.errstate(over="ignore"):
        mean = median * np.exp(0.5 * log_sd**2)
        quantiles = median * np.exp(log_sd * np.array(list(_NORMAL.values())))
        sd = mean * np.sqrt(np.expm1(log_sd**2))
    summary: Summary = {"unit": quantity_unit(name), "mean": float(mean), "sd": float(sd)}
    return summary | dict(zip(_NORMAL, quantiles.tolist(), strict=True))


def summarize_normal(name: str, mean: float, sd: float) -> Summary:
    """Summarize a normal quantity."""
    summary: Summary = {"unit": quantity_unit(name), "mean": mean, "sd": sd}
    return summary | {key: mean + z * sd for key, z in _NORMAL.items()}


def format_sd(summary: Summary) -> str:
    """Return the standard deviation for people: in per cent of the mean, or in the unit where that exceeds 50 %."""
    mean, sd = float(summary["mean"]), float(summary["sd"])
    if not sd <= 10.0 * abs(mean) or math.isinf(sd):  # a factor of nine in the logarithm
        return "undetermined"
    if sd > 0.5 * abs(mean):
        return format_engineering(sd, str(summary["unit"]), 2)
    return f"{np.format_float_positional(100.0 * sd / abs(mean), 2, fractional=False, trim='-')} %"


def describe_combined(combined: Summary, u: float, sources: Mapping[str, float]) -> dict[str, Any]:
    """Return the entry `combined` of a summary: the uncertainty that one would sign.

    `combined` summarizes the quantity with all sources of error, also with usual ones of what nobody stated; `u` is its
    relative standard uncertainty, and `sources` are the fractions of the variance by what they come from.
    """
    return {"u": u, "sd": combined["sd"], **{key: combined[key] for key in PROBABILITIES}, "sources": dict(sources)}


def combine(summary: Summary) -> Summary:
    """Return the summary with the sd and the quantiles of its combined uncertainty, if it has one."""
    return summary | summary.get("combined", {})


# sources in `combined` that nobody stated, beside defaults
UNSTATED_GAINS, UNSTATED_STRAY = "unstated gains", "unstated stray C"


def is_default(source: str) -> bool:
    """Return whether a source in `combined` is a value that nobody stated."""
    return source.startswith(("default", "spread of", UNSTATED_GAINS, UNSTATED_STRAY))


def rounding_unit(summary: Summary) -> float:
    """Return the sd to whose second digit the estimate is rounded; to its first one where defaults decide."""
    sd, sources = float(summary["sd"]), summary.get("sources", {})
    assumed = sum(fraction for source, fraction in sources.items() if is_default(source))
    return 10.0 * sd if assumed > 0.5 and f"{sd:.1e}"[0] != "1" else sd


def format_estimate(summary: Summary) -> str:
    """Return the median with its combined standard deviation, both to the same place: "160.1 ± 8.1 kΩ"."""
    s = combine(summary)
    median, sd = float(s["q50"]), float(s["sd"])
    size, symbol = choose_prefixed_unit(median, str(s["unit"]))
    if not 0.0 < sd <= abs(median):
        spread = "" if sd == 0.0 else f" (sd {format_sd(s)})"
        return format_engineering(median, str(s["unit"]), 2 if spread else 4) + spread
    value, spread = round_to_sd((median / size, sd / size), rounding_unit(s) / size)
    return f"{value} ± {spread} {symbol}".rstrip()


def format_values(values: Mapping[str, float]) -> str:
    """Return several values in a line, to three digits: "Rsc 160 kΩ, Ci 1.35 nF"."""
    return ", ".join(f"{name} {format_engineering(x, quantity_unit(name), 3)}" for name, x in values.items())


def format_estimates(summaries: Mapping[str, Summary]) -> str:
    """Return several estimates in a line: "Rsc 160.1 ± 8.1 kΩ, Ci 1.35 ± 0.068 nF"."""
    return ", ".join(f"{name} {format_estimate(each)}" for name, each in summaries.items())


def format_interval(summary: Summary, low: str = "q05", high: str = "q95") -> str:
    """Return two quantiles of the combined uncertainty, to the place of `format_estimate`: "147.3 to 173.4 kΩ"."""
    s = combine(summary)
    ends, unit, sd = (float(s[low]), float(s[high])), str(s["unit"]), float(s["sd"])
    if not 0.0 < sd <= abs(float(s["q50"])):
        return " to ".join(format_engineering(end, unit, 2) for end in ends)
    return format_range(*ends, rounding_unit(s), unit)


def format_range(low: float, high: float, sd: float, unit: str) -> str:
    """Return two values of a quantity to the place of the second digit of its standard deviation `sd`."""
    size, symbol = choose_prefixed_unit(0.5 * (low + high), unit)
    return f"{' to '.join(round_to_sd((low / size, high / size), sd / size))} {symbol}".rstrip()


def round_to_sd(values: Iterable[float], sd: float) -> list[str]:
    """Return numbers rounded to the place of the second significant digit of `sd`."""
    places = 1 - int(f"{sd:.1e}".partition("e")[2])
    return [f"{round(value, places):.{max(places, 0)}f}" for value in values]


def load(directory: str | os.PathLike[str]) -> dict[str, Any]:
    """Read summary.json from a folder that `fitact sample` or `fitact run` wrote."""
    with complete_folder(directory, "results") as folder:
        content = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
        if not (isinstance(content, dict) and set(content) >= _SECTIONS):
            raise ValueError("summary.json is not fitact's")
    return content


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that results depend on."""
    return {"python": platform.python_version()} | {name: importlib.metadata.version(name) for name in _PACKAGES}


def is_trusted(content: dict[str, Any]) -> bool:
    """Return whether the answer that fit.json or summary.json holds is reliable; a fit has no draws to converge."""
    converged = content["convergence"]["converged"] if "convergence" in content else True
    return bool(converged) and content["fit"]["result"] in TRUSTED_RESULTS
