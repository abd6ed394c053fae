"""A population as a picture: its fingers with its law, the force of the next one, and what that depends on."""

import os
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, PercentFormatter

from fitact.charts.figure import ALERT, DATA, MODEL, log_ticks, write_figure

NOT_DRAWN_MESSAGE = "Not drawn: some draws are not finite."
FONT_SETTINGS = {"legend.fontsize": 9.0}


def write_population(path: str | os.PathLike[str], tree: Any, content: dict[str, Any]) -> None:
    """Draw the fingers, those to come, their force, and what makes it differ, as SVG at `path`.

    From the content of population.nc and population.json.

    Raises:
        InputError: the place cannot be written.
    """
    write_figure(path, lambda: _figure(tree, content), **FONT_SETTINGS)


def _figure(tree: Any, content: dict[str, Any]) -> Figure:
    figure = Figure(figsize=(11.0, 8.4), layout="constrained")
    if not is_drawable(tree):
        figure.text(0.5, 0.5, NOT_DRAWN_MESSAGE, ha="center")
        return figure
    for axes, draw in zip(figure.subplots(2, 2).flat, (draw_skin, draw_force, draw_time, draw_shares), strict=True):
        draw(axes, tree, content)
    return figure


def is_drawable(tree: Any) -> bool:
    """Whether every draw has a place on a logarithmic axis; a chain that was cut short may hold others."""
    drawn = (values.values for name in ("new_fingers", "prior_new_fingers") for values in tree[name].data_vars.values())
    return all(bool(np.all(np.isfinite(values))) for values in drawn)


def draw_skin(axes: Axes, tree: Any, content: dict[str, Any], max_fingers: int = 4000) -> None:
    """Rsc and Csc of the fingers, with 95 % intervals, and of fingers to come."""
    Rsc, Csc = (tree["new_fingers"][name].values.ravel()[:max_fingers] for name in ("Rsc", "Csc"))
    axes.plot(Rsc, Csc, ".", ms=2, color=MODEL, alpha=0.25, rasterized=True, label="fingers to come")
    for number, finger in enumerate(content["fingers"]):
        (x, y), (dx, dy) = (
            [np.array([finger["parameters"][name][key] for key in keys], dtype=float) for name in ("Rsc", "Csc")]
            for keys in (["q50"], ["q025", "q975"])
        )
        label = "fingers, 95 %" if number == 0 else None
        errors = {"xerr": np.abs(dx - x)[:, None], "yerr": np.abs(dy - y)[:, None]}
        axes.errorbar(x, y, **errors, fmt="o", ms=4, color=DATA, label=label)
    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis, unit in ((axes.xaxis, "Ω"), (axes.yaxis, "F")):
        log_ticks(axis, unit)
    axes.set_xlabel("Rsc")
    axes.set_ylabel("Csc")
    axes.set_title("Fingers")
    axes.legend(markerscale=2)


def draw_force(axes: Axes, tree: Any, content: dict[str, Any], bins: int = 50) -> None:
    """What the next finger may feel; and for each law that may be the true one, what its fingers feel."""
    logs = np.log(tree["new_fingers"]["force_mean"].values)
    least, largest = np.quantile(logs, [0.002, 0.998]).tolist()
    edges = np.linspace(least, largest, bins + 1)
    middle = np.exp(0.5 * (edges[1:] + edges[:-1]))
    next_one = np.histogram(logs, edges, density=True)[0]
    mean, sd = logs.mean(axis=1)[:, None], logs.std(axis=1, ddof=1)[:, None]
    of_laws = np.exp(-0.5 * np.square((np.log(middle) - mean) / sd)) / (sd * np.sqrt(2.0 * np.pi))
    low, high = np.quantile(of_laws, [0.025, 0.975], axis=0)
    axes.fill_between(
        middle, low, high, color=ALERT, alpha=0.3, lw=0, label="people, by 95 % of the laws that may be true"
    )
    axes.plot(middle, next_one, color=MODEL, drawstyle="steps-mid", label="next finger: people and ignorance")
    axes.set_xscale("log")
    log_ticks(axes.xaxis, "N", (1.0, 3.0))
    axes.set_ylim(0.0, 1.3 * float(np.max(high)))  # room for the legend
    axes.set_yticks([])
    axes.set_xlabel("mean electrostatic force")
    axes.set_title("Force across people")
    axes.legend()


def draw_time(axes: Axes, tree: Any, content: dict[str, Any]) -> None:
    """Bands of force in time over fingers to come; friction, by eq. (2), on the other side."""
    drawn = tree["force_in_time"]
    time, force = drawn["time"].values, dict(zip(drawn["quantile"].values.tolist(), drawn["force"].values, strict=True))
    bands = {(0.025, 0.975): 0.15, (0.05, 0.95): 0.3, (0.25, 0.75): 0.55}  # quantiles: how opaque between
    for (low, high), opaque in bands.items():
        label = f"{100.0 * (high - low):g} % of fingers"
        axes.fill_between(time, force[low], force[high], color=MODEL, alpha=opaque, lw=0, label=label)
    axes.plot(time, force[0.5], color=DATA, lw=1.0, label="median")
    coefficient, normal = drawn.attrs["friction_coefficient"], drawn.attrs["normal_force"]

    def friction_from_force(force: Any) -> Any:
        return coefficient * (np.asarray(force) + normal)

    def force_from_friction(total_friction: Any) -> Any:
        return np.asarray(total_friction) / coefficient - normal

    right = axes.secondary_yaxis("right", functions=(friction_from_force, force_from_friction))
    axes.xaxis.set_major_formatter(EngFormatter("s"))
    axes.yaxis.set_major_formatter(EngFormatter("N"))
    right.yaxis.set_major_formatter(EngFormatter("N"))
    axes.set_xlim(time[0], time[-1])
    axes.set_ylim(0.0, 1.3 * float(max(force[high].max() for _, high in bands)))  # room for the legend
    axes.set_xlabel("time in the period" if drawn.attrs["periodic"] else "time")
    axes.set_ylabel("electrostatic force")
    right.set_ylabel("friction")
    axes.set_title("The next finger in time")
    axes.legend(ncols=2)


def draw_shares(axes: Axes, tree: Any, content: dict[str, Any]) -> None:
    """Each factor's share of the variance of the mean force, the largest on top; before the records, too."""
    after, before = (content[key]["force_mean"] for key in ("variance_shares", "variance_shares_prior"))
    order = sorted(after, key=lambda factor: after[factor]["total"])
    height = 0.2
    rows = (
        (after, "first", MODEL, 1.0, "goes once it is known"),
        (after, "total", ALERT, 1.0, "stays if only it is not"),
        (before, "first", MODEL, 0.35, "before the records"),
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
    axes.set_xlabel("share of the variance of the mean force")
    axes.set_title("What makes it differ")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=len(rows) - 1, handlelength=1.2)
