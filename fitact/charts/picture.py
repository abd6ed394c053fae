"""Static pictures of the charts of `interactive`, drawn by matplotlib."""

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from matplotlib.ticker import EngFormatter, NullLocator

from fitact.charts.figure import MODEL, log_ticks, pyplot_figure
from fitact.charts.interactive import Chart, Plot, PlotlyTrace

_DASHES = {"solid": "-", "dash": "--", "dot": ":"}


def draw_chart(chart: Chart) -> Figure:
    """Draw all plots of a chart, with fixed margins, since to compute them takes most of the time of a drawing."""
    figure = Figure(figsize=(9.0, sum(_line_heights(chart["plots"]))))
    draw_plots(figure, chart["plots"])
    return figure


def show_plots(*plots: Plot, ax: Axes | None = None, caption: str = "") -> Any:
    """Draw plots on a new figure of pyplot, or a plot of one row on `ax`; return the axes, an array of several.

    The `caption` is written below a new figure.
    """
    if ax is None:
        figure = pyplot_figure(figsize=(9.0, sum(_line_heights(plots))), layout="constrained")
        draw_plots(figure, plots)
        if caption:
            figure.supxlabel(caption, fontsize=9.0)
        return figure.axes[0] if len(figure.axes) == 1 else np.array(figure.axes)
    draw_plot(plots[0], ax)
    return ax


def _line_heights(plots: Sequence[Plot]) -> list[float]:
    sizes = [0.01 * plot["layout"]["height"] for plot in plots]
    return [max(sizes[first : first + 3]) for first in range(0, len(sizes), 3)]


def draw_plots(
    figure: FigureBase, plots: Sequence[Plot], margins: tuple[float, float, float, float] = (0.8, 0.15, 0.6, 0.4)
) -> None:
    """Draw plots side by side, three in a line.

    `margins`: left, right, below and above the axes (inches), where no layout engine finds them.
    """
    heights = _line_heights(plots)
    parts = figure.subfigures(len(heights), min(len(plots), 3), squeeze=False, height_ratios=heights).flat
    for part, plot in zip(parts, plots, strict=False):
        domains = [np.ptp(axis["domain"]) for name, axis in plot["layout"].items() if name.startswith("yaxis")]
        rows = part.subplots(len(domains), 1, sharex=True, squeeze=False, height_ratios=domains)[:, 0]
        draw_plot(plot, *rows)
        if part.get_layout_engine() is None:
            left, right, bottom, top = margins
            width, height = part.bbox.width / part.dpi, part.bbox.height / part.dpi
            ends = {"left": left / width, "right": 1.0 - right / width}
            part.subplots_adjust(**ends, bottom=bottom / height, top=1.0 - top / height, hspace=0.15)


def draw_plot(plot: Plot, *rows: Axes) -> None:
    """Draw a plot on the axes of its rows."""
    layout = plot["layout"]
    for number, axes in enumerate(rows, start=1):
        suffix = "" if number == 1 else str(number)
        below = np.zeros(())
        for trace in plot["data"]:
            if trace["yaxis"] == f"y{suffix}":
                below = _draw_trace(axes, trace, below)
        for shape in layout.get("shapes", ()):
            if shape["x0"] == shape["x1"]:
                axes.axvline(shape["x0"], color=shape["line"]["color"], lw=1.0, ls="--")
            else:
                axes.axvspan(shape["x0"], shape["x1"], color=MODEL, alpha=0.12, lw=0.0)
        _format_axis(axes, "y", layout[f"yaxis{suffix}"])
    _format_axis(rows[-1], "x", layout["xaxis"])
    if layout["showlegend"]:
        above: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "frameon": False}
        entries = {
            label: handle for axes in rows for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
        }
        named = list(entries.values()), list(entries)
        columns = len(entries) if len(entries) <= 3 else 2
        rows[0].legend(*named, **above, title=plot["title"], ncols=columns, fontsize=9.0, columnspacing=1.0)
    else:
        rows[0].set_title(plot["title"], fontsize=10.0)


def _draw_trace(axes: Axes, trace: PlotlyTrace, below: np.ndarray, points_per_pixel: float = 0.75) -> np.ndarray:
    """Draw a trace, if requested filled down to the previous trace `below`, and return its values."""
    x, y = (np.frombuffer(base64.b64decode(trace[k]["bdata"]), f"<{trace[k]['dtype']}") for k in ("x", "y"))
    line, marker = trace.get("line", {}), trace.get("marker", {})
    color, is_step = (line or marker)["color"], line.get("shape") == "hv"
    label = trace["name"] if trace.get("showlegend", True) else None
    if trace.get("fill"):
        base = below if trace["fill"] == "tonexty" else 0.0
        step: dict[str, Any] = {"step": "post"} if is_step else {}
        axes.fill_between(x, base, y, color=color, alpha=0.35, lw=0.0, label=label, **step)
    axes.plot(
        x,
        y,
        color=color,
        lw=points_per_pixel * line.get("width", 0.0) * ("lines" in trace["mode"]),
        ls=_DASHES[line.get("dash", "solid")],
        drawstyle="steps-post" if is_step else "default",
        marker="o" if marker else "",
        ms=points_per_pixel * marker.get("size", 0.0),
        mfc="none" if marker.get("symbol") == "circle-open" else color,
        alpha=marker.get("opacity"),
        rasterized=x.size > 500,
        label=None if trace.get("fill") else label,
    )
    return y


def _format_axis(axes: Axes, letter: str, layout: dict[str, Any]) -> None:
    reach = axes.dataLim.intervalx if letter == "x" else axes.dataLim.intervaly
    is_log = layout["type"] == "log" and bool(np.all(np.isfinite(reach)))  # an empty plot has no logarithmic limits
    axes.set(**{f"{letter}scale": "log" if is_log else "linear", f"{letter}label": layout["title"]["text"]})
    if "range" in layout:
        axes.set(**{f"{letter}lim": np.power(10.0, layout["range"]) if is_log else layout["range"]})
    axis = axes.xaxis if letter == "x" else axes.yaxis
    if not layout.get("showticklabels", True):
        axes.set(**{f"{letter}ticks": []})
        axes.set_ylim(bottom=0.0)
        return
    if is_log:
        low, high = axis.get_view_interval()
        log_ticks(axis, "", (1.0, 2.0, 5.0) if high < 100.0 * low else (1.0,))
        axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(_format_tick)


def _format_tick(value: float, _: Any) -> str:
    return f"{value:g}" if value == 0.0 or 1e-3 <= abs(value) < 1e4 else EngFormatter(sep="")(value)
