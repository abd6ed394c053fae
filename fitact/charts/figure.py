"""The report's figures, as SVG text that stands alone."""

import base64
import io
import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, LogLocator, MaxNLocator, NullFormatter

from fitact.files import replacing

DATA, MODEL, PRIOR, ALERT = (
    "#333333",
    "#0072B2",
    "#999999",
    "#D55E00",
)  # told apart by the colour-blind, too
_STYLE = {
    "font.size": 11.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "svg.fonttype": "path",
    "svg.hashsalt": "fitact",
    "savefig.bbox": "tight",
    "path.simplify_threshold": 0.5,
}
_SYMBOLS = {"ohm": "Ω", "1": ""}
_CORNER_POINTS = 1200

Draws = Mapping[str, Float[np.ndarray, " draws"]]


def style() -> Any:
    """Settings that all figures share; use with `matplotlib.rc_context`."""
    return dict(_STYLE)


def record_figure(
    time: Float[np.ndarray, " samples"],
    observed: Float[np.ndarray, " samples"],
    fitted: Float[np.ndarray, " samples"],
    predicted_time: Float[np.ndarray, " predicted"],
    predicted: Float[np.ndarray, "draws predicted"],
    channel: str,
    unit: str,
) -> str:
    """A channel's record, predictive band, residuals in time and their distribution, where it was fitted."""
    time, observed, fitted = (x[np.isfinite(fitted)] for x in (time, observed, fitted))
    figure = Figure(figsize=(9.0, 5.6), layout="constrained")
    grid = figure.add_gridspec(2, 2, height_ratios=[2.2, 1.0], width_ratios=[5.0, 1.0])
    above, below = figure.add_subplot(grid[0, :]), figure.add_subplot(grid[1, 0])
    beside = figure.add_subplot(grid[1, 1], sharey=below)
    low, high = np.quantile(predicted, [0.05, 0.95], axis=0)
    above.fill_between(
        predicted_time, low, high, color=MODEL, alpha=0.45, lw=0, zorder=3, label="90 % of predicted records"
    )
    above.plot(time, observed, ".", color=DATA, ms=1.5, label="record", rasterized=True)
    above.set_ylabel(channel)
    above.set_ylim(*without_spikes(observed))
    above.legend(loc="upper right", framealpha=0.9, markerscale=5)
    residuals = observed - fitted
    below.plot(time, residuals, ".", color=ALERT, ms=1.5, rasterized=True)
    below.axhline(0.0, color=DATA, lw=0.8)
    below.set_ylabel("record − fit")
    beside.hist(residuals, bins=60, orientation="horizontal", color=ALERT, alpha=0.7)
    beside.tick_params(labelleft=False, labelbottom=False)
    for axes in (above, below):
        axes.xaxis.set_major_formatter(EngFormatter("s"))
        axes.yaxis.set_major_formatter(EngFormatter(unit))
        axes.set_xlim(time[0], time[-1])
    below.set_xlabel("time")
    return svg(figure)


def without_spikes(values: np.ndarray) -> tuple[float, float]:
    """Limits that show a channel, but not the few samples of a current at edges that would flatten all others."""
    low, high = np.quantile(values, [0.02, 0.98])
    whole = float(values.min()), float(values.max())
    if whole[1] - whole[0] > 20.0 * (high - low):
        whole = float(low), float(high)
    margin = 0.06 * (whole[1] - whole[0])
    return whole[0] - margin, whole[1] + margin


def corner_figure(posterior: Draws, prior: Draws, units: Mapping[str, str]) -> str:
    """Each pair of parameters, the prior beside the posterior, on logarithmic axes."""
    names = [name for name in posterior if name in prior]
    figure = Figure(figsize=(8.6, 8.0), layout="constrained")
    axes = figure.subplots(len(names), len(names), squeeze=False)
    limits = {name: _limits(posterior[name], prior[name]) for name in names}
    for row, y in enumerate(names):
        for column, x in enumerate(names):
            here: Axes = axes[row, column]
            if column > row:
                here.set_visible(False)
                continue
            here.set_xscale("log")
            here.set_xlim(*limits[x])
            if row == column:
                _histograms(here, posterior[x], prior[x], limits[x])
            else:
                here.set_yscale("log")
                here.set_ylim(*limits[y])
                _cloud(here, prior[x], prior[y], PRIOR, 0.25)
                _cloud(here, posterior[x], posterior[y], MODEL, 0.5)
                _ticks(here.yaxis, limits[y], units[y], column == 0)
            _ticks(here.xaxis, limits[x], units[x], row == len(names) - 1)
            if row == len(names) - 1:
                here.set_xlabel(x)
            if column == 0 and row > 0:
                here.set_ylabel(y)
    handles = [mpl.lines.Line2D([], [], color=c, lw=6, alpha=0.7) for c in (MODEL, PRIOR)]
    figure.legend(handles, ["posterior", "prior"], loc="upper right", fontsize=13)
    return svg(figure)


def force_figure(force: Draws) -> str:
    """Posterior of mean and peak force."""
    figure = Figure(figsize=(9.0, 3.2), layout="constrained")
    titles = {"force_mean": "mean force", "force_rms": "rms force", "force_peak": "peak force"}
    for axes, (name, title) in zip(figure.subplots(1, 3), titles.items(), strict=True):
        low, median, high = np.quantile(force[name], [0.05, 0.5, 0.95])
        axes.hist(force[name], bins=60, color=MODEL, alpha=0.75, density=True)
        axes.axvline(median, color=DATA)
        axes.axvspan(low, high, color=MODEL, alpha=0.12)
        axes.xaxis.set_major_formatter(EngFormatter("N"))
        axes.xaxis.set_major_locator(MaxNLocator(4))
        axes.set_yticks([])
        axes.set_xlabel(title)
    return svg(figure)


def _histograms(axes: Axes, posterior: np.ndarray, prior: np.ndarray, limits: tuple[float, float]) -> None:
    edges = np.geomspace(*limits, 80)
    for draws, color in ((prior, PRIOR), (posterior, MODEL)):
        # per unit of the logarithm, as the axis shows it
        counts, _ = np.histogram(draws, edges)
        axes.stairs(counts / len(draws), edges, fill=True, color=color, alpha=0.6)
    axes.set_yticks([])


def _cloud(axes: Axes, x: np.ndarray, y: np.ndarray, color: str, alpha: float) -> None:
    step = max(1, len(x) // _CORNER_POINTS)
    axes.plot(x[::step], y[::step], ".", color=color, ms=2.5, alpha=alpha, rasterized=True)


def _limits(posterior: np.ndarray, prior: np.ndarray) -> tuple[float, float]:
    """Wide enough to see the prior's width, but never so wide that the posterior is a line."""
    low, high = np.log(np.quantile(posterior, [0.001, 0.999]))
    wide_low, wide_high = np.log(np.quantile(prior, [0.005, 0.995]))
    width = 4.0 * (high - low)
    low, high = max(wide_low, low - width), min(wide_high, high + width)
    low, high = min(low, np.log(posterior.min())), max(high, np.log(posterior.max()))
    return float(np.exp(low)), float(np.exp(high))


def _ticks(axis: mpl.axis.Axis, limits: tuple[float, float], unit: str, labelled: bool) -> None:
    ends = np.log(limits)
    places = np.exp(ends[0] + np.array([0.2, 0.5, 0.8]) * (ends[1] - ends[0]))
    digits = max(2, 1 + math.ceil(-math.log10(ends[1] - ends[0])))  # that tell them apart
    axis.set_major_locator(mpl.ticker.FixedLocator([float(f"{place:.{digits}g}") for place in places]))
    axis.set_minor_locator(mpl.ticker.NullLocator())
    axis.set_major_formatter(EngFormatter(_SYMBOLS.get(unit, unit)) if labelled else mpl.ticker.NullFormatter())


def log_ticks(axis: Axis, unit: str, subs: tuple[float, ...] = (1.0, 2.0, 5.0)) -> None:
    """Ticks of a logarithmic axis at so many of each power of ten, with prefixes of the unit."""
    axis.set_major_locator(LogLocator(subs=subs))
    axis.set_major_formatter(EngFormatter(unit))
    axis.set_minor_formatter(NullFormatter())


def write_svg(path: str | os.PathLike[str], draw: Callable[[], Figure], **settings: Any) -> None:
    """Write a figure as SVG at `path`, drawn in the shared style and `settings` beside it.

    Raises:
        InputError: the place cannot be written.
    """
    with mpl.rc_context(style() | settings), replacing(path) as temporary:
        draw().savefig(temporary, format="svg", metadata={"Date": None})


def save(figure: Figure, path: Path, suffix: str) -> None:
    """Write a figure at `path`, as the ending of what it becomes says: ".svg" or ".png"."""
    metadata = {"Date": None} if suffix == ".svg" else {}
    figure.savefig(path, format=suffix[1:], dpi=150, metadata=metadata)


def svg(figure: Figure) -> str:
    """A figure as an element of a page."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", dpi=150, metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def source(svg: str) -> str:
    """A figure as the source of an image: it cannot clash with another's ids, and has its alt text."""
    return "data:image/svg+xml;base64," + base64.b64encode(svg.encode()).decode()
