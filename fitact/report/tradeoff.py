"""Picture and page of accuracy against run time, with the Pareto front."""

import functools
import os
from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fitact.charts import interactive
from fitact.charts.figure import ALERT, DATA, MODEL, PRIOR
from fitact.charts.interactive import Axis
from fitact.charts.picture import draw_plot
from fitact.report.frame import Answer, PageSummary, Provenance, image, write_page
from fitact.tradeoff.tradeoff import COLUMNS, KINDS, BenchmarkedMethod, Kind, Tradeoff
from fitact.units import format_engineering

_TITLES: dict[Kind, tuple[str, str, str]] = {
    "answer": ("answer", "the answer", "error of the stated force, relative"),
    "response": ("response", "one evaluation", "error of Vsc, relative rms"),
    "likelihood": ("likelihood", "one evaluation in a batch", "error of the log-likelihood"),
    "uncertainty": ("uncertainty", "one effective draw", "error in posterior standard deviations"),
}


def draw_tradeoff(tradeoff: Tradeoff, kinds: Sequence[Kind] = tuple(_TITLES)) -> Figure:
    """Draw the methods of some kinds."""
    columns, rows = min(len(kinds), 2), -(-len(kinds) // 2)
    figure = Figure(figsize=(max(9.0, 7.0 * columns), 4.8 * rows), layout="constrained")
    for kind, axes in zip(kinds, figure.subplots(rows, columns, squeeze=False).flat, strict=True):
        _draw_panel(axes, kind, tradeoff)
    return figure


def _heights(levels: Sequence[BenchmarkedMethod], zero_ratio: float = 30.0) -> dict[str, float]:
    """Return the positions of errors on the logarithmic axis; 0 is drawn at the smallest other over `zero_ratio`."""
    zero = min((level.error for level in levels if level.error > 0.0), default=1.0) / zero_ratio
    return {level.name: level.error or zero for level in levels}


def _all_seconds(levels: Sequence[BenchmarkedMethod]) -> list[float]:
    """Return all times on the axis: those of the methods, and of answers in a first process."""
    return [level.seconds for level in levels] + [x.details["cold_seconds"] for x in levels if x.kind == "answer"]


def _draw_panel(axes: Axes, kind: Kind, tradeoff: Tradeoff) -> None:
    plot, size = _plot(tradeoff, kind)
    bare = plot["layout"] | {"showlegend": False}  # the names of the methods replace a legend
    draw_plot(plot | {"layout": bare, "title": _TITLES[kind][0]}, axes)
    axes.grid(visible=False)
    levels = sorted(tradeoff.methods(kind), key=lambda level: level.error)
    heights, seconds = _heights(levels).values(), [x / size for x in _all_seconds(levels)]
    zero, margin = min(heights), 1.5 * (max(seconds) / min(seconds)) ** 0.25
    axes.axhline(zero, color=DATA, lw=0.8, ls=":")
    axes.set(xlim=(min(seconds) / margin, max(seconds) * margin), ylim=(zero / 6.0, 10.0 * max(heights)))
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:.0e}" if value > 2.0 * zero else "")
    zero_label: dict[str, Any] = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points"}
    axes.annotate("0", (0.0, zero), (-6, 0), ha="right", va="center", **zero_label)
    # the names stand beside the axes in the order of the errors, so that none covers another
    for row, level in enumerate(levels):
        color = ALERT if level.dominated_by else MODEL
        point, place = (level.seconds / size, level.error or zero), (1.04, (row + 0.5) / len(levels))
        leader: dict[str, Any] = {"arrowstyle": "-", "color": color, "lw": 0.6, "shrinkB": 4.0}
        label: dict[str, Any] = {"color": color, "fontsize": 9, "va": "center", "arrowprops": leader}
        axes.annotate(level.name, point, place, textcoords="axes fraction", **label)


def write_tradeoff_page(path: str | os.PathLike[str], tradeoff: Tradeoff, origin: Provenance) -> None:
    cheapest = {kind: tradeoff.front(kind)[0] for kind in KINDS}
    names = ", ".join(f"{level.name} ({kind})" for kind, level in cheapest.items())
    front = {kind: "; ".join(map(_describe_level, tradeoff.front(kind))) for kind in KINDS}
    frame = PageSummary(
        title="Accuracy and run time",
        subject=f"Measured on {tradeoff.record}; {tradeoff.machine['cpu']}, {tradeoff.machine['cores']} cores.",
        trusted=tradeoff.trusted,
        verdict=f"Fastest methods on the Pareto fronts: {names}"
        if tradeoff.trusted
        else f"{'; '.join(tradeoff.notes)}.",
        findings={
            "How to choose": "Choose the fastest method on the front whose error is acceptable. Every method off the"
            " front is dominated: another method is no less accurate and no slower.",
        }
        | {f"Pareto front of {kind}, fastest first": f"{levels}." for kind, levels in front.items()},
        answers=[
            Answer(
                f"{kind}, fastest", format_engineering(level.seconds, "s", 3), f"{level.name}, error {level.error:.2g}"
            )
            for kind, level in cheapest.items()
        ],
        warnings=tradeoff.notes,
    )
    write_page(
        path,
        "tradeoff.html",
        frame=frame,
        origin=origin,
        kinds=KINDS,
        charts={kind: interactive.chart(_plot(tradeoff, kind)[0]) for kind in KINDS},
        pictures={kind: image(functools.partial(draw_tradeoff, tradeoff, (kind,))) for kind in KINDS},
        tables={
            kind: [(*COLUMNS, "dominated by"), *((*each.cells, each.dominated_by) for each in tradeoff.methods(kind))]
            for kind in KINDS
        },
        resolved=tradeoff.resolution_note,
        machine=tradeoff.machine,
    )


def _describe_level(level: BenchmarkedMethod) -> str:
    return f"{level.name}, {format_engineering(level.seconds, 's', 3)}, error {level.error:.2g}"


def _plot(tradeoff: Tradeoff, kind: Kind) -> tuple[interactive.Plot, float]:
    """Return the plot of one kind, and the unit of its time axis (s)."""
    levels, height = tradeoff.methods(kind), _heights(tradeoff.methods(kind))
    _, cost, error = _TITLES[kind]
    seconds = [level.seconds for level in levels]
    x, y = Axis.from_values(f"time of {cost}", "s", _all_seconds(levels), log=True), Axis(error, log=True)
    middle = (min(seconds) * max(seconds)) ** 0.5
    traces = []
    for name, some, color in (
        ("front", tradeoff.front(kind), MODEL),
        ("dominated", tuple(level for level in levels if level.dominated_by), ALERT),
    ):
        at = [level.seconds for level in some]
        heights = [height[level.name] for level in some]
        trace = interactive.points(x, y, at, heights, name, color, size=9.0, hollow=name == "dominated")
        traces.append(
            trace
            | {
                "mode": "markers+text" if name == "dominated" else "lines+markers+text",
                "line": {"color": color, "width": 1.2},
                "text": [level.name for level in some],
                "textposition": ["top right" if each < middle else "top left" for each in at],
                "customdata": [_describe_level(level) for level in some],
                "hovertemplate": "%{customdata}<extra></extra>",  # an error of 0 is drawn at another height
            }
        )
    if kind == "answer":
        cold = [level.details["cold_seconds"] for level in levels]
        trace = interactive.points(x, y, cold, list(height.values()), "first time", PRIOR, size=9.0, hollow=True)
        text = [
            f"{each.name}, first time, {format_engineering(each.details['cold_seconds'], 's', 3)}" for each in levels
        ]
        traces.append(trace | {"customdata": text, "hovertemplate": "%{customdata}<extra></extra>"})
    if kind == "uncertainty":
        ends, least = (min(seconds), max(seconds)), (tradeoff.resolution, tradeoff.resolution)
        traces.append(interactive.line(x, y, ends, least, "smallest significant error", PRIOR, dash="dash"))
    return interactive.plot(x, (y, traces), size=400), x.size
