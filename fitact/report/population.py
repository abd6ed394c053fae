"""A population as a picture and as a page: differences between fingers, force on the next one, sources of variance."""

import functools
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
from matplotlib.ticker import EngFormatter, PercentFormatter

from fitact.charts import interactive
from fitact.charts.figure import ALERT, DATA, MODEL, PRIOR, log_ticks, write_figure
from fitact.charts.interactive import Axis
from fitact.errors import InputError
from fitact.model.circuit import FINGER_PARAMETERS
from fitact.populations.population import (
    MAX_INTEGRATION_ERROR,
    SHARES_LEGEND,
    VARIANCE_QUANTITIES,
    format_quantiles,
    format_variance_part,
    population_table,
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
_NUMERIC = ("population", "new_finger", "variance_shares", "variance_shares_prior", "fingers", "convergence")
_NEW_LABEL, _PRIOR_LABEL = "new fingers", "prior"
_NOT_DRAWN_MESSAGE = "Not drawn: some draws are not finite."


def write_population(path: str | os.PathLike[str], tree: Any, content: dict[str, Any]) -> None:
    """Draw the content of population.nc and population.json as SVG at `path`."""
    write_figure(path, lambda: _figure(tree, content))


def _figure(tree: Any, content: dict[str, Any]) -> Figure:
    figure = Figure(figsize=(11.0, 8.4), layout="constrained")
    if not _is_drawable(tree):
        figure.text(0.5, 0.5, _NOT_DRAWN_MESSAGE, ha="center")
        return figure
    for axes, draw in zip(figure.subplots(2, 2).flat, (_draw_skin, _draw_force, _draw_time, _draw_shares), strict=True):
        draw(axes, tree, content)
    return figure


def _is_drawable(tree: Any) -> bool:
    """Return whether all draws are finite; an interrupted chain may hold others."""
    drawn = (values.values for name in ("new_fingers", "prior_new_fingers") for values in tree[name].data_vars.values())
    return all(bool(np.all(np.isfinite(values))) for values in drawn)


def _draw_skin(axes: Axes, tree: Any, content: dict[str, Any], max_fingers: int = 4000) -> None:
    """Draw Rsc and Csc of the fingers, with 95 % intervals, and of new fingers."""
    Rsc, Csc = (tree["new_fingers"][name].values.ravel()[:max_fingers] for name in ("Rsc", "Csc"))
    axes.plot(Rsc, Csc, ".", ms=2, color=MODEL, alpha=0.25, rasterized=True, label=_NEW_LABEL)
    low_Rsc, Rsc, high_Rsc, low_Csc, Csc, high_Csc = (
        np.array([finger["parameters"][name][key] for finger in content["fingers"]], dtype=float)
        for name in ("Rsc", "Csc")
        for key in ("q025", "q50", "q975")
    )
    widths_Rsc, widths_Csc = np.stack([Rsc - low_Rsc, high_Rsc - Rsc]), np.stack([Csc - low_Csc, high_Csc - Csc])
    axes.errorbar(Rsc, Csc, widths_Csc, widths_Rsc, fmt="o", ms=4, color=DATA, label="fingers, 95 %")
    axes.set(xscale="log", yscale="log", xlabel="Rsc", ylabel="Csc", title="Fingers")
    log_ticks(axes.xaxis, "Ω")
    log_ticks(axes.yaxis, "F")
    axes.legend(markerscale=2, fontsize=9)


def _draw_force(axes: Axes, tree: Any, content: dict[str, Any], bins: int = 50) -> None:
    """Draw the predictive distribution of the force, and the credible band of its distribution over fingers."""
    logs = np.log(tree["new_fingers"]["force_mean"].values)
    least, largest = np.quantile(logs, [0.002, 0.998]).tolist()
    edges = np.linspace(least, largest, bins + 1)
    middle = np.exp(0.5 * (edges[1:] + edges[:-1]))
    next_one = np.histogram(logs, edges, density=True)[0]
    mean, sd = logs.mean(axis=1)[:, None], logs.std(axis=1, ddof=1)[:, None]
    of_laws = np.exp(-0.5 * np.square((np.log(middle) - mean) / sd)) / (sd * np.sqrt(2.0 * np.pi))
    low, high = np.quantile(of_laws, [0.025, 0.975], axis=0)
    of_people = "between fingers (95 % credible band)"
    axes.fill_between(middle, low, high, color=ALERT, alpha=0.3, lw=0, label=of_people)
    axes.plot(middle, next_one, color=MODEL, drawstyle="steps-mid", label="next finger (predictive)")
    axes.set_xscale("log")
    log_ticks(axes.xaxis, "N", (1.0, 3.0))
    axes.set_ylim(0.0, 1.3 * float(np.max(high)))  # leaves room for the legend
    axes.set_yticks([])
    axes.set(xlabel="mean electrostatic force", title="Force on different fingers")
    axes.legend(fontsize=9)


def _draw_time(axes: Axes, tree: Any, content: dict[str, Any]) -> None:
    """Draw bands of the force in time over new fingers; the right axis is friction, by eq. (2)."""
    drawn = tree["force_in_time"]
    time, force = drawn["time"].values, dict(zip(drawn["quantile"].values.tolist(), drawn["force"].values, strict=True))
    bands = {(0.025, 0.975): 0.15, (0.05, 0.95): 0.3, (0.25, 0.75): 0.55}  # quantiles: opacity of the area between them
    for (low, high), opaque in bands.items():
        label = f"{100.0 * (high - low):g} % of fingers"
        axes.fill_between(time, force[low], force[high], color=MODEL, alpha=opaque, lw=0, label=label)
    axes.plot(time, force[0.5], color=DATA, lw=1.0, label="median")
    coefficient, normal = drawn.attrs["friction_coefficient"], drawn.attrs["normal_force"]
    to_friction, to_force = lambda force: coefficient * (force + normal), lambda total: total / coefficient - normal
    right = axes.secondary_yaxis("right", functions=(to_friction, to_force))
    axes.xaxis.set_major_formatter(EngFormatter("s"))
    axes.yaxis.set_major_formatter(EngFormatter("N"))
    right.yaxis.set_major_formatter(EngFormatter("N"))
    top = 1.3 * float(max(force[high].max() for _, high in bands))  # leaves room for the legend
    axes.set(xlim=(time[0], time[-1]), ylim=(0.0, top), ylabel="electrostatic force", title="The next finger in time")
    axes.set_xlabel("time in the period" if drawn.attrs["periodic"] else "time")
    right.set_ylabel("friction")
    axes.legend(ncols=2, fontsize=9)


def _draw_shares(axes: Axes, tree: Any, content: dict[str, Any]) -> None:
    """Draw the Sobol indices of the mean force, the largest on top, from the posterior and the prior."""
    after, before = (content[key]["force_mean"] for key in ("variance_shares", "variance_shares_prior"))
    order = sorted(after, key=lambda factor: after[factor]["total"])
    height = 0.2
    rows = (
        (after, "first", MODEL, 1.0, "first-order"),
        (after, "total", ALERT, 1.0, "total"),
        (before, "first", MODEL, 0.35, "prior"),
        (before, "total", ALERT, 0.35, None),
    )
    for row, (shares, key, color, opaque, label) in enumerate(rows):
        axes.barh(
            np.arange(len(order)) + (1.5 - row) * height,
            [shares[factor][key] for factor in order],
            height,
            xerr=[shares[factor][f"{key}_error"] for factor in order],
            color=color,
            alpha=opaque,
            error_kw={"ecolor": DATA, "elinewidth": 1.0},
            label=label,
        )
    axes.set_yticks(np.arange(len(order)), [factor.replace("_", " ") for factor in order])
    axes.set_xlim(left=0.0)
    axes.xaxis.set_major_formatter(PercentFormatter(1.0, symbol=" %"))
    axes.set(xlabel="Sobol index of the mean force", title="Sources of variance")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=len(rows) - 1, handlelength=1.2, fontsize=9)


_PANELS = {"skin": _draw_skin, "force": _draw_force, "time": _draw_time, "shares": _draw_shares}


def write_population_page(path: str | os.PathLike[str], tree: Any, content: dict[str, Any]) -> None:
    """Write the page from the content of population.nc and population.json."""
    content = content | {name: _null_to_nan(content[name]) for name in (*_NUMERIC, "integrals_off")}
    write_page(
        path,
        "population.html",
        frame=_frame(content),
        origin=_origin(content),
        content=content,
        **_figures(tree, content),
        law=[row for row in population_table(content) if not row[0].startswith("next finger")],
        fingers=tuple(_finger_rows(content)),
        new=tuple(_new_rows(content)),
        shares={name: tuple(_share_rows(content, name)) for name in VARIANCE_QUANTITIES},
        legend=SHARES_LEGEND,
    )


def read_population(directory: str | os.PathLike[str]) -> tuple[Any, dict[str, Any]]:
    """Read what `write_population_page` needs from a folder of results; raise InputError if it is incomplete."""
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
    """Replace null, which JSON has for non-finite numbers, by NaN."""
    if isinstance(content, dict):
        return {name: _null_to_nan(value) for name, value in content.items()}
    if isinstance(content, list | tuple):
        return [_null_to_nan(value) for value in content]
    infinite = isinstance(content, float) and not math.isfinite(content)
    return math.nan if content is None or infinite else content


def _figures(tree: Any, content: dict[str, Any]) -> dict[str, Any]:
    if not _is_drawable(tree):
        return {"panels": None, "not_drawn": _NOT_DRAWN_MESSAGE}
    panels = {name: image(functools.partial(_draw_panel, draw, tree, content)) for name, draw in _PANELS.items()}
    return {"panels": panels, "skin": _skin_chart(tree, content), "force": _force_chart(tree)}


def _frame(content: dict[str, Any]) -> PageSummary:
    law, new, count = content["population"], content["new_finger"], len(content["fingers"])
    force, friction = new["force_mean"], new["friction_mean"]
    # two defaults give the friction of a scene that states none
    stated_friction = f" Mean friction {_format_range(friction)}." if "friction" in content["scene"] else ""
    off = f"{content['integrals_off']:.2g} standard deviations"
    accuracy = f"the integrals over the fingers shift no mean by more than {off}"
    return PageSummary(
        title=f"Population of {count} fingers",
        subject=f"Differences between fingers, estimated from one record of each of {count} fingers on one panel, and"
        " the force on the next finger.",
        trusted=content["trusted"],
        verdict=f"Reliable: the chain has converged, and {accuracy}"
        if content["trusted"]
        else f"{content['convergence']['sentence']}; {accuracy} (at most {MAX_INTEGRATION_ERROR:g} are accepted).",
        findings={
            "Force on the next finger": f"Mean electrostatic force {_format_range(force)}, with 95 % prediction"
            f" interval.{stated_friction}",
            "Sources of variance": "; ".join(variance_sentences(content)) + f". {SHARES_LEGEND}",
        }
        | ({"Contact area": _sentence(content["contact_area"]["sentence"])} if "contact_area" in content else {}),
        answers=[
            _answer("Rsc, median of fingers", law["Rsc"]["median"]),
            _answer("Csc, median of fingers", law["Csc"]["median"]),
            _answer("Ci of the panel", law["Ci"]),
            _answer("mean force on the next finger", force),
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
    yield ("finger", "Rsc ± 1 sd", "Csc ± 1 sd", "Ci ± 1 sd", "fit")
    for each in content["fingers"]:
        cells = (format_estimate(each["parameters"][name]) for name in FINGER_PARAMETERS)
        yield (each["record"], *cells, each["result"])


def _new_rows(content: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    parts = {"people": "between fingers", "ignorance": "parameters"}
    if "within_finger" in content:
        parts = {"within_finger": "within a finger", "between_fingers": "between fingers", "ignorance": "parameters"}
    yield ("next finger", *_QUANTILES.values(), *parts.values())
    none = 1e-12 * content["new_finger"]["force_mean"]["q50"]  # smaller forces are rounding errors
    for name, s in content["new_finger"].items():
        values = (
            format_engineering(s[key] if s["unit"] != "N" or s["q975"] > none else 0.0, s["unit"], 3)
            for key in _QUANTILES
        )
        yield (_NAMES[name], *values, *(format_variance_part(s["variance"][key]) for key in parts))


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


def _draw_panel(draw: Callable[[Axes, Any, dict[str, Any]], None], tree: Any, content: dict[str, Any]) -> Figure:
    figure = Figure(figsize=(9.0, 4.6), layout="constrained")
    axes = figure.add_subplot()
    draw(axes, tree, content)
    axes.set_title("")
    return figure


def _skin_chart(tree: Any, content: dict[str, Any], max_fingers: int = 1500) -> interactive.Chart:
    Rsc, Csc = (tree["new_fingers"][name].values.ravel()[:max_fingers] for name in ("Rsc", "Csc"))
    x = Axis.from_values("Rsc", "ohm", np.median(Rsc), log=True)
    y = Axis.from_values("Csc", "F", np.median(Csc), log=True)
    at, values = ([finger["parameters"][name]["q50"] for finger in content["fingers"]] for name in ("Rsc", "Csc"))
    names = [finger["record"] for finger in content["fingers"]]
    cloud = interactive.points(x, y, Rsc, Csc, _NEW_LABEL, MODEL, size=3.0, opacity=0.35)
    fingers = interactive.points(x, y, at, values, "fingers", DATA, size=9.0, names=names)
    drawn = interactive.plot(x, (y, [cloud, fingers]), size=420)
    hide = interactive.visibility_button(_NEW_LABEL, [drawn], _NEW_LABEL)
    return interactive.chart(drawn, controls=[interactive.log_axis_button([drawn], "xy"), hide])


def _force_chart(tree: Any) -> interactive.Chart:
    plots, y = [], Axis("density", hides_numbers=True)
    for name, title in {"force_mean": "mean force", "force_peak": "peak force"}.items():
        after, before = (tree[group][name].values for group in ("new_fingers", "prior_new_fingers"))
        x = Axis.from_values(title, "N", np.median(after), log=True)
        known = interactive.density(x, after, "next finger")
        plots.append(interactive.plot(x, (y, [interactive.density(x, before, _PRIOR_LABEL, PRIOR), known]), size=320))
    hide = interactive.visibility_button(_PRIOR_LABEL, plots, _PRIOR_LABEL)
    return interactive.chart(*plots, controls=[interactive.log_axis_button(plots), hide])
