"""A population's page: how people differ, what the next finger feels, and what that depends on."""

import json
import math
import os
import shlex
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fitact.charts import interactive
from fitact.charts.figure import DATA, MODEL, PRIOR
from fitact.charts.interactive import Axis
from fitact.errors import InputError
from fitact.populations.population import (
    MAX_INTEGRATION_ERROR,
    SHARES_LEGEND,
    VARIANCE_QUANTITIES,
    population_table,
    variance_sentences,
)
from fitact.report.frame import Answer, PageSummary, Provenance, image, write_page
from fitact.report.population import (
    FONT_SETTINGS,
    NOT_DRAWN_MESSAGE,
    draw_force,
    draw_shares,
    draw_skin,
    draw_time,
    is_drawable,
)
from fitact.summary import format_sd
from fitact.units import format_engineering, format_percent

_QUANTILES = {
    "q025": "2.5 %",
    "q05": "5 %",
    "q25": "25 %",
    "q50": "50 %",
    "q75": "75 %",
    "q95": "95 %",
    "q975": "97.5 %",
}
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
_FORCES = {"force_mean": "mean force", "force_peak": "peak force"}
_NUMERIC = (
    "population",
    "new_finger",
    "variance_shares",
    "variance_shares_prior",
    "fingers",
    "convergence",
    "integrals_off",
)
_NEW_LABEL, _PRIOR_LABEL, _POSTERIOR_LABEL = "fingers to come", "before the records", "next finger"


def write_population_page(path: str | os.PathLike[str], tree: Any, content: dict[str, Any]) -> None:
    """Write the page from the content of population.nc and population.json.

    Raises:
        InputError: the place cannot be written.
    """
    content = content | {name: _null_to_nan(content[name]) for name in _NUMERIC}
    write_page(
        path,
        "population.html",
        _frame(content),
        _origin(content),
        content=content,
        **(_figures(tree, content) if is_drawable(tree) else {"panels": None, "not_drawn": NOT_DRAWN_MESSAGE}),
        law=[row for row in population_table(content) if not row[0].startswith("next finger")],
        fingers=tuple(_finger_rows(content)),
        new=tuple(_new_rows(content)),
        shares={name: tuple(_share_rows(content, name)) for name in VARIANCE_QUANTITIES},
        legend=SHARES_LEGEND,
        engineering=format_engineering,
    )


def read_population(directory: str | os.PathLike[str]) -> tuple[Any, dict[str, Any]]:
    """What `write_population_page` needs, from a folder that `fitact population` wrote.

    Raises:
        InputError: a file is missing or damaged.
    """
    import xarray as xr

    try:
        content = json.loads((Path(directory) / "population.json").read_text(encoding="utf-8"))
        if not (isinstance(content, dict) and "trusted" in content):
            raise ValueError("population.json is not this version's")
        with xr.open_datatree(Path(directory) / "population.nc", engine="h5netcdf") as tree:
            return tree.load(), content
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise InputError(
            f"{directory}: holds no complete population ({error}); make it with: fitact population RECORD..."
            f" --out {directory}"
        ) from error


def _null_to_nan(content: Any) -> Any:
    """With NaN for whatever is not finite, which JSON has as null."""
    if isinstance(content, dict):
        return {name: _null_to_nan(value) for name, value in content.items()}
    if isinstance(content, list | tuple):
        return [_null_to_nan(value) for value in content]
    infinite = isinstance(content, float) and not math.isfinite(content)
    return math.nan if content is None or infinite else content


def _figures(tree: Any, content: dict[str, Any]) -> dict[str, Any]:
    return {
        "panels": {name: image(_panel(draw, tree, content), **FONT_SETTINGS) for name, draw in _PANELS.items()},
        "skin": _skin_chart(tree, content),
        "force": _force_chart(tree),
    }


def _frame(content: dict[str, Any]) -> PageSummary:
    law, new, count = content["population"], content["new_finger"], len(content["fingers"])
    force, friction = new["force_mean"], new["friction_mean"]
    off = f"{content['integrals_off']:.2g} standard deviations"
    certificate = f"integrals over the fingers shift no mean by more than {off}"
    return PageSummary(
        title=f"How people differ: {count} fingers",
        subject=f"What {count} fingers on one panel, a record of each, tell of people: how skins differ, what force the"
        " next finger feels, and what that depends on.",
        trusted=content["trusted"],
        verdict=f"Trusted: the chain has converged, and {certificate}"
        if content["trusted"]
        else f"{content['convergence']['sentence']}; {certificate} ({MAX_INTEGRATION_ERROR:g} are trusted).",
        findings={
            "What the next finger feels": f"A mean electrostatic force of {_format_range(force)}, and a mean"
            " friction of"
            f" {_format_range(friction)}; 95 % lie between.",
            "What makes it differ": "; ".join(variance_sentences(content)) + f" ({SHARES_LEGEND}).",
        },
        answers=[
            _answer("Rsc, median of people", law["Rsc"]["median"]),
            _answer("Csc, median of people", law["Csc"]["median"]),
            _answer("Ci of the panel", law["Ci"]),
            _answer("next finger's mean force", force),
        ],
        warnings=content["warnings"],
    )


def _format_range(s: dict[str, Any]) -> str:
    median, low, high = (format_engineering(s[key], s["unit"]) for key in ("q50", "q025", "q975"))
    return f"{median} ({low} to {high})"


def _answer(title: str, s: dict[str, Any]) -> Answer:
    median, low, high = (format_engineering(s[key], s["unit"], 3) for key in ("q50", "q025", "q975"))
    return Answer(title, median, f"95 %: {low} to {high}")


def _origin(content: dict[str, Any]) -> Provenance:
    records = {each["record"]: each["sha256"] for each in content["fingers"]}
    command = ["fitact population", *map(shlex.quote, records)]
    command += ["--scene SCENE.toml"] if content["scene"] else []
    command += ["--covariates COVARIATES.csv"] if content["population"]["covariates"] else []
    return Provenance(" ".join([*command, f"--seed {content['seed']}"]), content["scene"], records)


def _finger_rows(content: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    yield ("finger", "Rsc", "± 1 sd", "Csc", "± 1 sd", "Ci", "± 1 sd", "fit")
    for each in content["fingers"]:
        own = [each["parameters"][name] for name in ("Rsc", "Csc", "Ci")]
        cells = (cell for s in own for cell in (format_engineering(s["q50"], s["unit"]), format_sd(s)))
        yield (each["record"], *cells, each["result"])


def _new_rows(content: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    yield ("next finger", *_QUANTILES.values(), "people", "ignorance")
    none = 1e-12 * content["new_finger"]["force_mean"]["q50"]  # rounding
    for name, s in content["new_finger"].items():
        values = (
            format_engineering(s[key] if s["unit"] != "N" or s["q975"] > none else 0.0, s["unit"], 3)
            for key in _QUANTILES
        )
        yield (_NAMES[name], *values, *(f"{100.0 * s['variance'][key]:.0f} %" for key in ("people", "ignorance")))


def _share_rows(content: dict[str, Any], name: str) -> Iterator[tuple[str, ...]]:
    yield ("factor", "goes once it is known", "stays if only it is not", "before: goes", "before: stays")
    before = content["variance_shares_prior"][name]
    for factor, share in content["variance_shares"][name].items():
        cells = (
            f"{format_percent(of[key])} ± {format_percent(of[f'{key}_error'])}"
            for of in (share, before[factor])
            for key in ("first", "total")
        )
        yield (factor.replace("_", " "), *cells)


def _panel(
    draw: Callable[[Axes, Any, dict[str, Any]], None], tree: Any, content: dict[str, Any]
) -> Callable[[], Figure]:
    def draw_panel() -> Figure:
        figure = Figure(figsize=(9.0, 4.6), layout="constrained")
        axes = figure.add_subplot()
        draw(axes, tree, content)
        axes.set_title("")
        return figure

    return draw_panel


_PANELS = {
    "skin": draw_skin,
    "force": draw_force,
    "time": draw_time,
    "shares": draw_shares,
}


def _skin_chart(tree: Any, content: dict[str, Any], max_fingers: int = 1500) -> interactive.Chart:
    """Fingers by name, among those to come."""
    Rsc, Csc = (tree["new_fingers"][name].values.ravel()[:max_fingers] for name in ("Rsc", "Csc"))
    x, y = (
        Axis.from_values("Rsc", "ohm", np.median(Rsc), log=True),
        Axis.from_values("Csc", "F", np.median(Csc), log=True),
    )
    own = [each["parameters"] for each in content["fingers"]]
    names = [each["record"] for each in content["fingers"]]
    at, values = ([finger[name]["q50"] for finger in own] for name in ("Rsc", "Csc"))
    drawn = interactive.plot(
        x,
        (
            y,
            [
                interactive.points(x, y, Rsc, Csc, _NEW_LABEL, MODEL, size=3.0, opacity=0.35),
                interactive.points(x, y, at, values, "fingers", DATA, size=9.0, names=names),
            ],
        ),
        size=420,
    )
    return interactive.chart(
        drawn,
        controls=[
            interactive.log_axis_button([drawn], "xy"),
            interactive.visibility_button(_NEW_LABEL, [drawn], _NEW_LABEL),
        ],
    )


def _force_chart(tree: Any) -> interactive.Chart:
    """Mean and peak force of the next finger, and what was believed before."""
    plots = []
    for name, title in _FORCES.items():
        after, before = (tree[group][name].values for group in ("new_fingers", "prior_new_fingers"))
        x = Axis.from_values(title, "N", np.median(after), log=True)
        plots.append(
            interactive.plot(
                x,
                (
                    Axis("density", hides_numbers=True),
                    [
                        interactive.density(x, before, _PRIOR_LABEL, PRIOR),
                        interactive.density(x, after, _POSTERIOR_LABEL),
                    ],
                ),
                size=320,
            )
        )
    return interactive.chart(
        *plots,
        controls=[interactive.log_axis_button(plots), interactive.visibility_button(_PRIOR_LABEL, plots, _PRIOR_LABEL)],
    )
