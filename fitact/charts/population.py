"""Pictures and charts of a population: its fingers, the force on the next finger, and the sources of variance."""

from collections.abc import Callable, Iterator
from typing import Any, TypeAlias

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, FuncFormatter, LogLocator, NullFormatter, PercentFormatter

from fitact.charts import interactive
from fitact.charts.figure import ALERT, DATA, GREEN, MODEL, ORANGE, PRIOR, SKY, FigureMaker, log_ticks
from fitact.charts.interactive import Axis
from fitact.units import format_percent

Panel: TypeAlias = Callable[[Axes, Any, dict[str, Any]], None]

_NEW_LABEL, _PRIOR_LABEL = "new fingers", "prior"
NOT_DRAWN_MESSAGE = "Not drawn: some draws are not finite."


def draw_population(tree: Any, content: dict[str, Any], make: FigureMaker = Figure) -> Figure:
    """Draw the content of population.nc and population.json."""
    panels = choose_panels(content)
    rows = len(panels) // 2
    figure = make(figsize=(11.0, 4.2 * rows), layout="constrained")
    if not is_drawable(tree):
        figure.text(0.5, 0.5, NOT_DRAWN_MESSAGE, ha="center")
        return figure
    for axes, draw in zip(figure.subplots(rows, 2).flat, panels.values(), strict=True):
        draw(axes, tree, content)
    return figure


def choose_panels(content: dict[str, Any]) -> dict[str, Panel]:
    """Return the panels by name; those that compare levels only where there are several."""
    levels = {"touches": _draw_touches, "levels": _draw_levels} if len(content["levels"]) > 1 else {}
    return {"skin": _draw_skin, "force": _draw_force} | levels | {"time": _draw_time, "shares": _draw_shares}


def is_drawable(tree: Any) -> bool:
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
    groups = list(_group_by_top_level(content))
    for number, (name, members, color) in enumerate(groups):
        bars = widths_Csc[:, members], widths_Rsc[:, members]
        label = (
            name if len(groups) <= 10 else "records, 95 %" if number == 0 else None
        )  # the legend has no room for more
        axes.errorbar(Rsc[members], Csc[members], *bars, fmt="o", ms=4, color=color, label=label)
    axes.set(xscale="log", yscale="log", xlabel="Rsc", ylabel="Csc", title="Fingers")
    low, high = axes.get_xlim()
    log_ticks(axes.xaxis, "Ω", (1.0,) if high > 100.0 * low else (1.0, 2.0, 5.0))
    log_ticks(axes.yaxis, "F")
    axes.legend(markerscale=2, fontsize=9, ncols=2)


def _group_by_top_level(content: dict[str, Any]) -> Iterator[tuple[str, list[int], Any]]:
    """Yield the name of each person (or finger) with several records, its records and its colour; or all records."""
    top = content["levels"][0]["level"]
    if len(content["levels"]) < 2:
        yield "fingers, 95 %", list(range(len(content["fingers"]))), DATA
        return
    names = [finger["units"][top] for finger in content["fingers"]]
    unique = list(dict.fromkeys(names))
    colors = mpl.colormaps["viridis"](np.linspace(0.0, 0.9, len(unique)))
    for unit, color in zip(unique, colors, strict=True):
        yield unit, [i for i, name in enumerate(names) if name == unit], color


def _draw_touches(axes: Axes, tree: Any, content: dict[str, Any]) -> None:
    """Draw Rsc and Csc of each record, with 95 % intervals, over their population medians, grouped by person."""
    position, ticks = 0.0, []
    for name, members, color in _group_by_top_level(content):
        places = position + np.arange(len(members))
        for part, (key, marker, fill) in enumerate((("Rsc", "o", color), ("Csc", "s", "white"))):
            middle = content["population"][key]["median"]["q50"]
            found = [content["fingers"][i]["parameters"][key] for i in members]
            low, values, high = (np.array([each[q] for each in found]) / middle for q in ("q025", "q50", "q975"))
            axes.errorbar(
                places + 0.3 * part, values, [values - low, high - values], fmt=marker, ms=5, color=color, mfc=fill,
                label=key if position == 0.0 else None,
            )  # fmt: skip
        ticks.append((float(np.mean(places)) + 0.15, name))
        position = places[-1] + 2.0
    axes.axhline(1.0, color=PRIOR, lw=1.0)
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 1.5, 2.0, 3.0, 5.0, 7.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_xticks(*zip(*ticks, strict=True), fontsize=9, rotation=90.0 if len(ticks) > 10 else 0.0)
    axes.grid(axis="x", visible=False)
    axes.set(ylabel="over the population's median", title="Touches")
    axes.legend(fontsize=9)


def _draw_levels(axes: Axes, tree: Any, content: dict[str, Any]) -> None:
    """Draw the fractions of the variance of each logarithm that come from the levels."""
    levels = content["levels"]
    names = list(levels[0]["log_sd"])[::-1]
    variances = np.array([[level["log_sd"][name]["q50"] ** 2 for name in names] for level in levels])
    fractions, start = variances / variances.sum(axis=0), np.zeros(len(names))
    for level, fraction, color in zip(levels, fractions, (MODEL, GREEN, ORANGE, SKY), strict=False):
        axes.barh(names, fraction, left=start, color=color, label=f"{level['level']} ({level['units']})")
        for place, (name, x, width) in enumerate(zip(names, start, fraction, strict=True)):
            if width > 0.12:
                sd = format_percent(level["log_sd"][name]["q50"])
                axes.text(x + 0.5 * width, place, sd, ha="center", va="center", color="white", fontsize=9)
        start = start + fraction
    axes.set_yticks(range(len(names)), [name.replace("_", " ") for name in names])
    axes.xaxis.set_major_formatter(PercentFormatter(1.0, symbol=" %"))
    axes.set(xlim=(0.0, 1.0), xlabel="fraction of the variance; in the bars: standard deviation", title="Levels")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=len(levels), handlelength=1.2, fontsize=9)


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


def draw_panel(draw: Panel, tree: Any, content: dict[str, Any]) -> Figure:
    """Draw one of `choose_panels` as a figure of its own."""
    figure = Figure(figsize=(9.0, 4.6), layout="constrained")
    axes = figure.add_subplot()
    draw(axes, tree, content)
    axes.set_title("")
    return figure


def skin_chart(tree: Any, content: dict[str, Any], max_fingers: int = 1500) -> interactive.Chart:
    """Draw Rsc and Csc of each finger by name, among new fingers."""
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


def force_chart(tree: Any) -> interactive.Chart:
    """Draw the distributions of the force on the next finger, from the records and from the prior."""
    plots, y = [], Axis("density", hides_numbers=True)
    for name, title in {"force_mean": "mean force", "force_peak": "peak force"}.items():
        after, before = (tree[group][name].values for group in ("new_fingers", "prior_new_fingers"))
        x = Axis.from_values(title, "N", np.median(after), log=True)
        known = interactive.density(x, after, "next finger")
        plots.append(interactive.plot(x, (y, [interactive.density(x, before, _PRIOR_LABEL, PRIOR), known]), size=320))
    hide = interactive.visibility_button(_PRIOR_LABEL, plots, _PRIOR_LABEL)
    return interactive.chart(*plots, controls=[interactive.log_axis_button(plots), hide])
