"""A population as text: tables and sentences from the content of population.json."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from fitact.populations.finger import SHARED_PARAMETER, SKIN
from fitact.populations.hierarchy import AREA
from fitact.populations.next_finger import NAMES
from fitact.units import choose_prefixed_unit, format_engineering, format_percent

VARIANCE_QUANTITIES = ("force_mean", "force_peak")  # quantities with Sobol indices
UNIT_NAMES = {  # of levels, one and several
    "person": ("person", "people"),
    "finger": ("finger", "fingers"),
    "session": ("session", "sessions"),
    "repetition": ("touch", "touches"),
}
SHARES_LEGEND = "Parameters: Sobol indices, first-order (total)."


def population_table(content: dict[str, Any]) -> tuple[tuple[str, ...], ...]:
    """Return titles, then rows of the population and the next finger from population.json, for people."""
    law, new, levels = content["population"], content["new_finger"], content["levels"]
    next_one = describe_next_touch(levels)
    shown = {f"{name}, median": law[name]["median"] for name in SKIN}
    if len(levels) < 2:
        shown |= {f"{name}, log_sd": law[name]["log_sd"] for name in SKIN}
    shown |= {name: law[name] for name in (SHARED_PARAMETER, "correlation")}
    if AREA in law and len(levels) < 2:
        shown["contact area, log_sd"] = law[AREA]["log_sd"]
    shown |= {
        f"{describe_factor(each)}, slope in {name}": x[each]["slope"]
        for name, x in law["covariates"].items()
        for each in (*SKIN, AREA)
        if each in x
    }
    if len(levels) > 1:
        for level in levels:
            between = f"between {UNIT_NAMES[level['level']][1]}"
            shown |= {f"{between}, {describe_factor(name)}, log_sd": s for name, s in level["log_sd"].items()}
        for level in levels[:-1]:
            same = f"touches of one {UNIT_NAMES[level['level']][0]}"
            found = level["intraclass_correlation"]
            shown |= {f"{same}, {name}, correlation": found[name] for name in (*SKIN, "force_mean")}
    within = content.get("within_finger", {})
    shown |= {f"within a finger, {name}, log_sd": each["log_sd"] for name, each in within.items()}
    shown |= {f"{next_one}, {name}": new[name] for name in NAMES}
    rows = [(name, *format_quantiles(s)) for name, s in shown.items()]
    if "friction" not in content["scene"]:  # two defaults give it, so more digits would mislead
        name, s = f"{next_one}, friction_mean", new["friction_mean"]
        cells = (format_engineering(float(f"{s[key]:.2g}"), s["unit"], 3) for key in ("q50", "q025", "q975"))
        rows = [(name, *cells) if row[0] == name else row for row in rows]
    if AREA not in law:
        rows.insert(len(rows) - len(NAMES), ("contact area", "common", "(assumed)", ""))
    return (describe_units(levels), "median", "2.5 % quantile", "97.5 % quantile"), *rows


def describe_units(levels: Sequence[Mapping[str, Any]]) -> str:
    """Return e.g. "8 fingers", or "18 touches of 6 people", from the entry `levels` of population.json."""
    counts = [f"{level['units']} {UNIT_NAMES[level['level']][1]}" for level in levels]
    return counts[0] if len(counts) == 1 else f"{counts[-1]} of {counts[0]}"


def describe_next_touch(levels: Sequence[Mapping[str, Any]]) -> str:
    """Return e.g. "next finger", or "touch of a new person"."""
    top = UNIT_NAMES[levels[0]["level"]][0]
    return f"next {top}" if len(levels) == 1 else f"touch of a new {top}"


def describe_factor(name: str) -> str:
    """Return the name of a factor or quantity of a finger for people."""
    return "contact area" if name == AREA else name


def study_table(content: dict[str, Any]) -> tuple[tuple[str, ...], ...]:
    """Return titles, then rows of the present and larger studies from population.json; none for a single level."""
    entries, levels = content["next_studies"], content["levels"]
    if not entries:
        return ()
    units, now = UNIT_NAMES[levels[0]["level"]][1], entries[0]
    rows = [
        (
            str(each["units"]),
            str(each["repetitions"]),
            str(each["records"]),
            *(f"{format_percent(each[key])} ({each[key] / now[key]:.2f})" for key in ("median_u", "log_sd_u")),
        )
        for each in entries
    ]
    titles = units, "repetitions", "records", "u of the median force", f"u of the spread between {units}"
    return titles, *rows


def format_quantiles(s: dict[str, Any], keys: Sequence[str] = ("q50", "q025", "q975")) -> list[str]:
    """Format quantiles of a summary to the place of the second digit of its standard deviation, at most 4 digits."""
    median, sd, unit = float(s["q50"]), float(s["sd"]), s["unit"]
    if not 0.0 < sd <= 0.5 * abs(median):
        return [format_engineering(float(f"{s[key]:.2g}"), unit, 3) for key in keys]
    digits = min(4, math.floor(math.log10(abs(median))) - math.floor(math.log10(float(f"{sd:.1e}"))) + 2)
    size, symbol = choose_prefixed_unit(median, unit)
    places = max(0, digits - 1 - math.floor(math.log10(abs(median) / size)))
    return [f"{float(s[key]) / size:.{places}f} {symbol}".rstrip() for key in keys]


def format_variance_part(fraction: float) -> str:
    """Format a part of a variance in whole per cent, and a smaller one with two digits."""
    return format_percent(fraction) if 0.0 < fraction < 0.01 else f"{100.0 * fraction:.0f} %"


def variance_sentences(content: dict[str, Any]) -> tuple[str, ...]:
    """Return sentences on the sources of variance of the next finger's force, from population.json."""
    sentences = []
    for name in VARIANCE_QUANTITIES:
        variance = content["new_finger"][name]["variance"]
        sources = {"within_finger": "from changes within a finger"}
        if "levels" in variance:
            variance = variance | variance["levels"]
            sources |= {
                level: f"from differences between {UNIT_NAMES[level][1]}" for level in reversed(variance["levels"])
            }
        else:
            key = "between_fingers" if "within_finger" in variance else "people"
            sources[key] = f"from differences between {UNIT_NAMES[content['levels'][0]['level']][1]}"
        sources["ignorance"] = "from uncertainty of the population parameters"
        sizes = ", ".join(
            f"{format_variance_part(variance[part])} {text}" for part, text in sources.items() if part in variance
        )
        parts = (
            f"{factor} {round(100.0 * share['first'])} % ({round(100.0 * share['total'])} %)"
            for factor, share in content["variance_shares"][name].items()
        )
        sentences.append(f"Variance of {name}: {sizes}; Sobol indices {', '.join(parts)}")
    return tuple(sentences)
