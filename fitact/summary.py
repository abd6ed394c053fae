"""Summaries of quantities: mean, sd and quantiles, from draws or from a Laplace approximation, and as text."""

import importlib.metadata
import json
import math
import os
import platform
import re
import shlex
import statistics
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from fitact.errors import InputError
from fitact.tables import align_table, join_lines
from fitact.units import (
    DERIVED,
    GEOMETRY,
    NUISANCES,
    PARAMETERS,
    choose_prefixed_unit,
    format_engineering,
    format_percent,
    quantity_unit,
)

_PACKAGES = ("fitact", "jax", "equinox", "optimistix", "emcee", "numpy", "xarray")
_SECTIONS = {"parameters", "derived", "identifiability", "convergence", "fit", "model", "warnings", "record"}
PROBABILITIES = {f"q{digits}": float(f"0.{digits}") for digits in ("025", "05", "25", "50", "75", "95", "975")}
_NORMAL = {key: statistics.NormalDist().inv_cdf(p) for key, p in PROBABILITIES.items()}  # standard normal quantiles

Summary = dict[str, float | str]
TRUSTED_RESULTS = ("successful", "structure")  # results of reliable fits
FORCE_LAWS = {  # by [force] model
    "paper": "from Vsc with eq. (22) of the reference paper",
    "gap": "from the voltage across the interface gap, eps0 A Vgap^2 / (2 d^2)",
}
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


def format_estimate(summary: Summary) -> str:
    """Return the median with its standard deviation to two digits, both to the same place: "160.1 ± 8.1 kΩ"."""
    median, sd = float(summary["q50"]), float(summary["sd"])
    size, symbol = choose_prefixed_unit(median, str(summary["unit"]))
    if not 0.0 < sd <= abs(median):
        spread = "" if sd == 0.0 else f" (sd {format_sd(summary)})"
        return f"{median / size:.{2 if spread else 4}g} {symbol}".rstrip() + spread
    value, spread = round_to_sd((median / size, sd / size), sd / size)
    return f"{value} ± {spread} {symbol}".rstrip()


def format_estimates(summaries: Mapping[str, Summary]) -> str:
    """Return several estimates in a line: "Rsc 160.1 ± 8.1 kΩ, Ci 1.35 ± 0.068 nF"."""
    return ", ".join(f"{name} {format_estimate(each)}" for name, each in summaries.items())


def format_interval(summary: Summary, low: str = "q05", high: str = "q95") -> str:
    """Return two quantiles, to the place of the standard deviation's second digit: "147.3 to 173.4 kΩ"."""
    ends, unit, sd = (float(summary[low]), float(summary[high])), str(summary["unit"]), float(summary["sd"])
    if not 0.0 < sd <= abs(float(summary["q50"])):
        return " to ".join(format_engineering(end, unit, 2) for end in ends)
    return format_range(*ends, sd, unit)


def format_range(low: float, high: float, sd: float, unit: str) -> str:
    """Return two values of a quantity to the place of the second digit of its standard deviation `sd`."""
    size, symbol = choose_prefixed_unit(0.5 * (low + high), unit)
    return f"{' to '.join(round_to_sd((low / size, high / size), sd / size))} {symbol}".rstrip()


def round_to_sd(values: Iterable[float], sd: float) -> list[str]:
    """Return numbers rounded to the place of the second significant digit of `sd`."""
    places = 1 - int(f"{sd:.1e}".partition("e")[2])
    return [f"{round(value, places):.{max(places, 0)}f}" for value in values]


def quantity_table(content: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return rows of all quantities for people, the first of them titles; a row of one cell is a heading.

    `content` is that of fit.json or summary.json. Cells: name, estimate with standard deviation, 90 % interval, the
    combined relative standard uncertainty, the fraction of the variance of the logarithm that comes from the prior,
    description.
    """
    summaries = content["parameters"] | content["derived"]
    headings = "circuit", "geometry and friction", "computed, not measured", "measurement"
    groups: dict[str, list[tuple[str, ...]]] = {heading: [] for heading in headings}
    for name, s in summaries.items():
        group = "computed, not measured" if name in DERIVED else "measurement"
        group = "geometry and friction" if name in GEOMETRY else group
        if name in PARAMETERS or name in ("g", "b"):
            group = "circuit"
        groups[group].append(_quantity_row(name, s, content["force_basis"]))
    for name, s in content.get("nuisances", {}).items():
        value = format_engineering(s["value"], s["unit"], 3)
        groups["measurement"].append((name, value, "", "", "", describe_quantity(name)))
    rows: list[tuple[str, ...]] = [("", "estimate ± 1 sd", "90 % interval", "combined u", "from the prior")]
    for heading, group_rows in groups.items():
        rows += [(heading,), *group_rows] if group_rows else []
    return rows


def _quantity_row(name: str, summary: Summary, basis: dict[str, Any]) -> tuple[str, ...]:
    remark = "" if name in ("Rsc", "Csc", "Ci") else describe_quantity(name)
    friction = [a for a in basis["assumptions"] if a["affects"] == "friction"]
    defaults = [a for a in friction if a["origin"] == "default"]
    if name == "friction_mean" and defaults and not any(a.get("has_distribution") for a in friction):
        value = format_engineering(float(f"{summary['q50']:.2g}"), str(summary["unit"]))
        assumed = ", ".join(f"{a['symbol']} = {a['text']}" for a in defaults)
        return name, f"about {value}", "", "", "", f"{remark}; default {assumed}"
    fraction = format_percent(round(float(summary["from_prior"]), 3)) if "from_prior" in summary else ""
    combined = format_percent(u) if math.isfinite(u := float(summary.get("u", math.inf))) else ""
    return name, format_estimate(summary), format_interval(summary), combined, fraction, remark


def force_sentences(basis: dict[str, Any]) -> list[str]:
    """Return what a force rests on, in sentences; `basis` is `force_basis` of fit.json or summary.json."""
    law = f"Force: computed {FORCE_LAWS[basis['law']]}"
    if basis["tested_by_data"]:
        sentences = [f"{law}, which the measured friction tests."]
    else:
        sentences = [f"{law}; it was not measured, and these data do not test that law."]
    if basis["assumptions"]:
        values = ", ".join(f"{a['symbol']} = {a['text']} ({a['origin']})" for a in basis["assumptions"])
        included = [a["symbol"] for a in basis["assumptions"] if a.get("has_distribution")]
        exception = "the prior's" + (f" and the stated distributions ({', '.join(included)})" if included else "")
        sentences.append(
            f"Force and friction rest on {values}; default means that nobody stated it. The errors above include no"
            f" uncertainty of these values except {exception}."
        )
    if other := basis["other_law"]:
        force = format_estimate(other["force_mean"])
        sentences.append(f"Mean force by the other law ({FORCE_LAWS[other['law']]}): {force}, for the same data.")
    return sentences


def _compare_with_friction(content: dict[str, Any]) -> list[str]:
    """Return what a measured friction says about the computed force, in a sentence."""
    scale = content["parameters"].get("force_scale")
    if scale is None:
        return []
    ratio, u = float(scale["q50"]), float(scale.get("u", math.inf))
    if not u < 1.0:
        return ["The measured friction does not determine how far the computed force is right (force_scale)."]
    sentence = f"The force in the measured friction is {format_estimate(scale)} times the computed one (force_scale"
    sentence += f", combined u {format_percent(u)} of its logarithm): "
    if abs(math.log(ratio)) <= 2.0 * u:
        sentence += "they agree."
    else:
        sentence += "they differ, so the law, the contact area, a thickness or the normal force is wrong."
    sentence += " This rests on mu, which follows from the mean friction and the normal force."
    if content["identifiability"]["verdict"] != "identified":
        sentence += " The electrical channels do not determine the contact area, whose error force_scale contains."
    return [sentence]


def result_sentences(content: dict[str, Any]) -> list[str]:
    """Return what the force rests on, and how far it is felt if the scene has a table of thresholds."""
    felt = content.get("sensation")
    friction = _compare_with_friction(content)
    return [*force_sentences(content["force_basis"]), *friction, *([felt["sentence"]] if felt else [])]


def budget_sentence(content: dict[str, Any]) -> str:
    """Return what the stated uncertainties include; `content` is that of fit.json or summary.json."""
    entries = content.get("budget") or {}
    if not entries:
        return ""
    head = "Uncertainties: noise, priors and the stated instruments; u combines all sources (fitact budget)."
    if not any(entry["stated"] for entry in entries.values()):
        head = "Uncertainties: noise and prior only; no instrument stated."
    missing = entries["g"]["not_stated"]
    if not missing:
        return head
    added = [
        f"{format_percent(u)} to {name}"
        for name, entry in entries.items()
        if name in ("g", "Rsc", "Csc", "Ci", "force_mean")
        and (u := math.hypot(*(each["u"] for each in entry["not_stated"]))) > 1e-4
    ]
    equipment = ", ".join(f"{each['source']} ({each['typical']})" for each in missing)
    return f"{head} Not stated: {equipment}; usual ones would add {', '.join(added)}. State yours under [instrument]."


def budget_table(name: str, entry: dict[str, Any], min_share: float = 0.001) -> list[tuple[str, ...]]:
    """Return rows of the uncertainty budget of a quantity, titles first, largest component first.

    `entry` is that of the quantity in `budget` of fit.json or summary.json. Sources below `min_share` of the variance
    are one row.
    """
    rows: list[tuple[str, ...]] = [(name, "type", "u(x)", "sensitivity", "component", "share")]
    small = [each for each in entry["components"] if each["share"] < min_share]
    for each in entry["components"]:
        if each["share"] >= min_share:
            sensitivity = "" if each["type"] == "A" else f"{each['sensitivity']:+.2g}"
            cells = (each["type"], format_percent(each["input_u"]), sensitivity, format_percent(each["u"]))
            rows.append((each["source"], *cells, format_percent(each["share"]), each["reduce_by"]))
    if small:
        u, share = math.hypot(*(each["u"] for each in small)), sum(each["share"] for each in small)
        rows.append((f"{len(small)} smaller sources", "", "", "", format_percent(u), format_percent(share), ""))
    for each in entry["not_stated"]:
        added = f"usual equipment ({each['typical']}) would add {format_percent(each['u'])}"
        rows.append((f"{each['source']}: not stated", "", "", "", "none", "", added))
    low, high = entry["interval95"]
    interval = format_range(low, high, 0.25 * (high - low), quantity_unit(name))
    rows.append(("combined", "", "", "", format_percent(entry["u"]), "", f"95 % interval {interval}"))
    return rows


def blind_table(content: dict[str, Any], names: Sequence[str] = ("g", "b", "force_mean"), count: int = 8) -> list[Any]:
    """Return rows of the causes that may shift the quantities `names` most without a trace in the residuals.

    Titles come first. A cause of a plausible size is meant.
    """
    titles = ("what the residuals would not show", "visible", *names)
    causes = [each for each in content.get("blind_table", []) if all(name in each["shift"] for name in names)]
    causes.sort(key=lambda each: -max(each["shift"][name] for name in names))
    shown = [
        (each["name"], format_percent(each["visible"]), *(format_percent(each["shift"][name]) for name in names))
        for each in causes[:count]
    ]
    return [titles, *shown] if shown else []


def budget_text(content: dict[str, Any], names: Sequence[str] = ()) -> str:
    """Return the uncertainty budgets of the quantities `names`, or of all, for people."""
    entries = content["budget"]
    tables = [budget_table(name, entries[name]) for name in names or entries]
    tables += [rows] if (rows := blind_table(content)) else []
    return "\n\n".join([budget_sentence(content), *("\n".join(align_table(table)) for table in tables)])


def load(directory: str | os.PathLike[str]) -> dict[str, Any]:
    """Read summary.json from a folder that `fitact sample` or `fitact run` wrote."""
    try:
        content = json.loads((Path(directory) / "summary.json").read_text(encoding="utf-8"))
        if not (isinstance(content, dict) and set(content) >= _SECTIONS):
            raise ValueError("summary.json is not fitact's")
        return content
    except (OSError, ValueError) as error:
        raise InputError(
            f"{directory}: holds no complete results ({error}); make them with: fitact sample RECORD --out {directory}"
        ) from error


def format_table(content: dict[str, Any]) -> list[str]:
    """Return the lines of `quantity_table`, and what the force rests on."""
    sentences = filter(None, (budget_sentence(content), *result_sentences(content)))
    return [*align_table(quantity_table(content)), *sentences]


def result_names(content: dict[str, Any]) -> list[str]:
    """Return the names of results that need advice (see `fitact.what_now`); `content` is fit.json or summary.json."""
    names = [] if content["fit"]["result"] == "successful" else [content["fit"]["result"]]
    convergence = content.get("convergence", {"converged": True})
    if not convergence["converged"]:
        names += [{"psis": "k-hat", "laplace": "laplace"}.get(convergence["level"], "not converged")]
    verdict = content["identifiability"]["verdict"]
    return names + ([] if verdict == "identified" else [verdict])


def advice_line(content: dict[str, Any]) -> list[str]:
    """Return the line that names the advice for a result; none for an identified, reliable one."""
    commands = [f"fitact explain {shlex.quote(name)}" for name in result_names(content)]
    return [f"What to do now: {', '.join(commands)}"] if commands else []


def table(content: dict[str, Any]) -> str:
    """Return the content of summary.json for people."""
    rows = format_table(content)
    rows += [content[section]["sentence"] for section in ("convergence", "identifiability")]
    rows += advice_line(content)
    return join_lines(rows, content["warnings"], content["notes"])


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that results depend on."""
    return {"python": platform.python_version()} | {name: importlib.metadata.version(name) for name in _PACKAGES}


def is_trusted(content: dict[str, Any]) -> bool:
    """Return whether the answer that summary.json holds is reliable."""
    return bool(content["convergence"]["converged"]) and content["fit"]["result"] in TRUSTED_RESULTS
