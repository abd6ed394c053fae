"""Picture and page of accuracy against run time, with the Pareto front."""

import functools
import itertools
import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

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
_ZERO_RATIO = 30.0  # an error of 0 is drawn at the smallest error over this ratio


def draw_tradeoff(tradeoff: Tradeoff, kinds: Sequence[Kind] = tuple(_TITLES)) -> Figure:
    """Draw the methods of some kinds."""
    figure = Figure(figsize=(max(9.0, 4.4 * len(kinds)), 4.8), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    panels = dict(zip(kinds, figure.subplots(1, len(kinds), squeeze=False)[0], strict=True))
    for kind, axes in panels.items():
        _draw_panel(axes, kind, tradeoff)
    canvas.draw()  # fixes the positions of everything
    figure.set_layout_engine("none")  # keeps these positions
    for kind, axes in panels.items():
        _annotate_names(axes, tradeoff.of(kind), _plot(tradeoff, kind)[1], canvas)
    return figure


def _heights(levels: Sequence[BenchmarkedMethod]) -> dict[str, float]:
    """Return the positions of errors on the logarithmic axis; an error of 0 is drawn below all others."""
    zero = min((level.error for level in levels if level.error > 0.0), default=1.0) / _ZERO_RATIO
    return {level.name: level.error or zero for level in levels}


def _all_seconds(levels: Sequence[BenchmarkedMethod]) -> list[float]:
    """Return all times on the axis: those of the methods, and of answers in a first process."""
    return [level.seconds for level in levels] + [x.details["cold_seconds"] for x in levels if x.kind == "answer"]


def _draw_panel(axes: Axes, kind: Kind, tradeoff: Tradeoff) -> None:
    plot, size = _plot(tradeoff, kind)
    bare = plot["layout"] | {"showlegend": False}  # the names of the methods replace a legend
    draw_plot(plot | {"layout": bare, "title": _TITLES[kind][0]}, axes)
    axes.grid(visible=False)
    heights, seconds = _heights(tradeoff.of(kind)).values(), [x / size for x in _all_seconds(tradeoff.of(kind))]
    zero, margin = min(heights), 1.5 * (max(seconds) / min(seconds)) ** 0.25
    axes.axhline(zero, color=DATA, lw=0.8, ls=":")
    axes.set(xlim=(min(seconds) / margin, max(seconds) * margin), ylim=(zero / 6.0, 10.0 * max(heights)))
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:.0e}" if value > 2.0 * zero else "")
    zero_label: dict[str, Any] = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points"}
    axes.annotate("0", (0.0, zero), (-6, 0), ha="right", va="center", **zero_label)


def _front_points(places: dict[str, np.ndarray], levels: tuple[BenchmarkedMethod, ...]) -> list[np.ndarray]:
    front = sorted((x for x in levels if not x.dominated_by), key=lambda x: x.seconds)
    pairs = itertools.pairwise(places[x.name] for x in front)
    return [end + share * (start - end) for start, end in pairs for share in np.linspace(0.0, 1.0, 40)]


def _annotate_names(axes: Axes, levels: tuple[BenchmarkedMethod, ...], size: float, canvas: FigureCanvasAgg) -> None:
    """Write the name of each method next to its point without overlaps; `size` is the unit of x."""
    points = {x.name: (x.seconds / size, y) for x, y in zip(levels, _heights(levels).values(), strict=True)}
    places = {name: axes.transData.transform(point) for name, point in points.items()}
    taken = [
        Bbox.from_extents(x - 8, y - 8, x + 8, y + 8) for x, y in [*places.values(), *_front_points(places, levels)]
    ]
    inside = axes.get_window_extent()
    sides = [(0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, 1), (1, -1), (-1, -1)]  # the preferred side first
    for level in levels:
        color = ALERT if level.dominated_by else MODEL
        for distance, (right, up) in itertools.product((9, 18, 30, 44), sides):
            text = axes.annotate(
                level.name,
                points[level.name],
                xytext=(distance * right, distance * up),
                textcoords="offset points",
                ha={-1: "right", 0: "center", 1: "left"}[right],
                va={-1: "top", 0: "center", 1: "bottom"}[up],
                color=color,
                fontsize=9,
            )
            box = text.get_window_extent(canvas.get_renderer())
            free = not any(box.overlaps(other) for other in taken)
            if free and inside.contains(box.x0, box.y0) and inside.contains(box.x1, box.y1):
                break
            text.remove()
        else:
            axes.add_artist(text)
        taken.append(box)


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
            kind: [(*COLUMNS, "dominated by"), *((*each.cells, each.dominated_by) for each in tradeoff.of(kind))]
            for kind in KINDS
        },
        resolved=tradeoff.resolved,
        machine=tradeoff.machine,
    )


def _describe_level(level: BenchmarkedMethod) -> str:
    return f"{level.name}, {format_engineering(level.seconds, 's', 3)}, error {level.error:.2g}"


def _plot(tradeoff: Tradeoff, kind: Kind) -> tuple[interactive.Plot, float]:
    """Return the plot of one kind, and the unit of its time axis (s)."""
    levels, height = tradeoff.of(kind), _heights(tradeoff.of(kind))
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
