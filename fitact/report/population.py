"""A population as a picture and as a page: differences between fingers, force on the next one, sources of variance."""

import functools
import json
import math
import os
import shlex
from collections.abc import Iterator
from typing import Any

from fitact.charts.figure import write_figure
from fitact.charts.population import (
    NOT_DRAWN_MESSAGE,
    choose_panels,
    draw_panel,
    draw_population,
    force_chart,
    is_drawable,
    skin_chart,
)
from fitact.files import complete_folder, map_leaves, read_datatree
from fitact.model.circuit import FINGER_PARAMETERS
from fitact.populations.exact_likelihood import MAX_INTEGRATION_ERROR
from fitact.populations.population_text import (
    SHARES_LEGEND,
    UNIT_NAMES,
    VARIANCE_QUANTITIES,
    describe_next_touch,
    describe_units,
    format_quantiles,
    format_variance_part,
    population_table,
    study_table,
    variance_sentences,
)
from fitact.report.frame import Answer, PageSummary, Provenance, image, write_page
from fitact.summary import PROBABILITIES, format_estimate
from fitact.units import format_engineering, format_percent

_QUANTILES = {key: f"{100.0 * probability:g} %" for key, probability in PROBABILITIES.items()}
_NAMES = {
    "Rsc": "Rsc",
    "Csc": "Csc",
    "g": "divider g",
    "b": "time constant b",
    "force_mean": "force, mean",
    "force_peak": "force, peak",
    "force_rms": "force, rms",
    "friction_mean": "friction, mean",
    "force_at_f": "force at the drive's f",
    "force_at_2f": "force at 2 f",
    "friction_at_f": "friction at f",
    "friction_at_2f": "friction at 2 f",
}
_NUMERIC = (
    "population",
    "levels",
    "forecasts",
    "next_studies",
    "new_finger",
    "variance_shares",
    "variance_shares_prior",
    "fingers",
    "convergence",
)


def write_population(path: str | os.PathLike[str], tree: Any, content: dict[str, Any]) -> None:
    """Draw the content of population.nc and population.json as SVG at `path`."""
    write_figure(path, lambda: draw_population(tree, content))


def write_population_page(path: str | os.PathLike[str], tree: Any, content: dict[str, Any]) -> None:
    """Write the page from the content of population.nc and population.json."""
    content = content | {name: map_leaves(_null_to_nan, content[name]) for name in (*_NUMERIC, "integrals_off")}
    next_touch = describe_next_touch(content["levels"])
    write_page(
        path,
        "population.html",
        frame=_frame(content),
        origin=_origin(content),
        content=content,
        **_figures(tree, content),
        law=[row for row in population_table(content) if not row[0].startswith(next_touch)],
        units=describe_units(content["levels"]),
        next_touch=next_touch,
        top=UNIT_NAMES[content["levels"][0]["level"]],
        forecasts=tuple(_forecast_rows(content)),
        studies=study_table(content),
        fingers=tuple(_finger_rows(content)),
        new=tuple(_new_rows(content)),
        shares={name: tuple(_share_rows(content, name)) for name in VARIANCE_QUANTITIES},
        legend=SHARES_LEGEND,
    )


def read_population(directory: str | os.PathLike[str]) -> tuple[Any, dict[str, Any]]:
    """Read what `write_population_page` needs from a folder of results; raise InputError if it is incomplete."""
    with complete_folder(directory, "population") as folder:
        content = json.loads((folder / "population.json").read_text(encoding="utf-8"))
        if not (isinstance(content, dict) and {"trusted", "levels"} <= set(content)):
            raise ValueError("population.json is not this version's")
        return read_datatree(folder / "population.nc"), content


def _null_to_nan(leaf: Any) -> Any:
    """Replace null, which JSON has for non-finite numbers, by NaN."""
    return math.nan if leaf is None or (isinstance(leaf, float) and not math.isfinite(leaf)) else leaf


def _figures(tree: Any, content: dict[str, Any]) -> dict[str, Any]:
    if not is_drawable(tree):
        return {"panels": None, "not_drawn": NOT_DRAWN_MESSAGE}
    chosen = choose_panels(content)
    panels = {name: image(functools.partial(draw_panel, draw, tree, content)) for name, draw in chosen.items()}
    return {"panels": panels, "skin": skin_chart(tree, content), "force": force_chart(tree)}


def _frame(content: dict[str, Any]) -> PageSummary:
    law, new, levels = content["population"], content["new_finger"], content["levels"]
    units, next_touch = describe_units(levels), describe_next_touch(levels)
    _, several = UNIT_NAMES[levels[0]["level"]]
    force, friction = new["force_mean"], new["friction_mean"]
    # two defaults give the friction of a scene that states none
    stated_friction = f" Mean friction {_format_range(friction)}." if "friction" in content["scene"] else ""
    off = f"{content['integrals_off']:.2g} standard deviations"
    accuracy = f"the error of the records' likelihoods shifts no mean by more than {off}"
    return PageSummary(
        title=f"Population: {units}",
        subject=f"Differences between {several}, estimated from records of {units} on one panel, and the force on the"
        f" {next_touch}.",
        trusted=content["trusted"],
        verdict=f"Reliable: the posterior is sampled well enough, and {accuracy}"
        if content["trusted"]
        else f"{content['convergence']['sentence']}; {accuracy} (at most {MAX_INTEGRATION_ERROR:g} are accepted).",
        findings={
            f"Force on the {next_touch}": f"Mean electrostatic force {_format_range(force)}, with 95 % prediction"
            f" interval.{stated_friction}",
            "Sources of variance": "; ".join(variance_sentences(content)) + f". {SHARES_LEGEND}",
        }
        | ({"Contact area": _sentence(content["contact_area"]["sentence"])} if "contact_area" in content else {}),
        answers=[
            _answer(f"Rsc, median of {several}", law["Rsc"]["median"]),
            _answer(f"Csc, median of {several}", law["Csc"]["median"]),
            _answer("Ci of the panel", law["Ci"]),
            _answer(f"mean force on the {next_touch}", force),
        ],
        warnings=content["warnings"],
    )


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}"


def _format_range(s: dict[str, Any]) -> str:
    median, low, high = format_quantiles(s)
    return f"{median} ({low} to {high})"


def _answer(title: str, s: dict[str, Any]) -> Answer:
    median, low, high = format_quantiles(s)
    return Answer(title, median, f"95 %: {low} to {high}")


def _origin(content: dict[str, Any]) -> Provenance:
    records = {each["record"]: each["sha256"] for each in content["fingers"]}
    command = ["fitact population", *map(shlex.quote, records)]
    command += ["--scene SCENE.toml"] if content["scene"] else []
    command += ["--covariates COVARIATES.csv"] if content["population"]["covariates"] else []
    return Provenance(" ".join([*command, f"--seed {content['seed']}"]), content["scene"], records)


def _finger_rows(content: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    yield ("record", "Rsc ± 1 sd", "Csc ± 1 sd", "Ci ± 1 sd", "fit")
    for each in content["fingers"]:
        cells = (format_estimate(each["parameters"][name]) for name in FINGER_PARAMETERS)
        yield (each["record"], *cells, each["result"])


def _forecast_rows(content: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    """Yield titles, then rows of a typical new person, and of the next touch of each known one; none for a level."""
    levels = content["levels"]
    if not content["forecasts"]:
        return
    quantities = ("Rsc", "Csc", "force_mean", "force_peak")
    yield ("forecast, 95 %", *(_NAMES[name] for name in quantities))
    for name, values in content["forecasts"].items():
        new = name == levels[0]["level"]
        title = f"a new {UNIT_NAMES[name][0]}, typical" if new else f"{name}, next touch"
        yield (title, *(_format_range(values[quantity]) for quantity in quantities))


def _new_rows(content: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    levels = content["levels"]
    parts = {"people": f"between {UNIT_NAMES[levels[0]['level']][1]}", "ignorance": "parameters"}
    if "within_finger" in content:
        parts = {"within_finger": "within a finger", "between_fingers": "between fingers", "ignorance": "parameters"}
    if len(levels) > 1:
        lowest = {"within_finger": "within a finger"} if "within_finger" in content else {}
        between = {level["level"]: f"between {UNIT_NAMES[level['level']][1]}" for level in reversed(levels)}
        parts = lowest | between | {"ignorance": "parameters"}
    yield (describe_next_touch(levels), *_QUANTILES.values(), *parts.values())
    none = 1e-12 * content["new_finger"]["force_mean"]["q50"]  # smaller forces are rounding errors
    for name, s in content["new_finger"].items():
        values = (
            format_engineering(s[key] if s["unit"] != "N" or s["q975"] > none else 0.0, s["unit"], 3)
            for key in _QUANTILES
        )
        variance = s["variance"] | s["variance"].get("levels", {})
        yield (_NAMES[name], *values, *(format_variance_part(variance[key]) for key in parts))


def _share_rows(content: dict[str, Any], name: str) -> Iterator[tuple[str, ...]]:
    yield ("parameter", "first-order", "total", "first-order (prior)", "total (prior)")
    before = content["variance_shares_prior"][name]
    for factor, share in content["variance_shares"][name].items():
        cells = (
            _format_index(of[key], of[f"{key}_error"]) for of in (share, before[factor]) for key in ("first", "total")
        )
        yield (factor.replace("_", " "), *cells)


def _format_index(value: float, error: float) -> str:
    """Format a Sobol index with its error to two digits, both to the same place, in per cent."""
    if not 0.0 < error < math.inf:
        return format_percent(value)
    places = max(0, 1 - math.floor(math.log10(float(f"{100.0 * error:.1e}"))))
    return f"{round(100.0 * value, places) + 0.0:.{places}f} % ± {100.0 * error:.{places}f} %"
