"""The figures of a posterior, on paper and on screen: each record with its fit, the parameters, and the force."""

import itertools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.axis import Axis as FigureAxis
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, FixedLocator, MaxNLocator, NullFormatter, NullLocator

from fitact.charts.figure import ALERT, DATA, MODEL, PRIOR, robust_limits, svg
from fitact.charts.interactive import (
    Axis,
    Chart,
    Plot,
    PlotlyTrace,
    band,
    chart,
    density,
    extremes,
    line,
    log_axis_button,
    plot,
    points,
    shade_interval,
    visibility_button,
)

CHANNELS = {"Vsc": "skin voltage Vsc", "I": "trunk current I"}
_FORCES = {"force_mean": "mean force", "force_rms": "rms force", "force_peak": "peak force"}
_PAIR_NAMES = ("Rsc", "Csc", "Ci")
_SYMBOLS = {"ohm": "Ω", "1": ""}

Draws = Mapping[str, Float[np.ndarray, " draws"]]


class _FittedChannel(NamedTuple):
    """A channel where it was fitted, and the ends of what 90 % of predicted records keep to, SI."""

    time: np.ndarray
    values: np.ndarray
    fitted: np.ndarray
    channel: str
    unit: str
    predicted_time: np.ndarray
    predicted: np.ndarray


def make_figures(tree: Any) -> dict[str, str]:
    """The pictures of a posterior's DataTree, as SVG by name."""
    posterior, prior = (
        {str(name): values.values.ravel() for name, values in tree[group].data_vars.items()}
        for group in ("posterior", "prior")
    )
    units = {str(name): values.attrs["units"] for name, values in tree["posterior"].data_vars.items()}
    figures = {"corner": _corner_figure(posterior, prior, units), "force": _force_figure(posterior)}
    records = tree["observed_data"].data_vars
    return figures | {f"trace_{i}": _record_figure(_fitted_channel(tree, str(name))) for i, name in enumerate(records)}


def make_charts(tree: Any, page_columns: int = 10_000) -> dict[str, Chart]:
    """The charts by the names of the pictures that they replace; `page_columns`: of all records of a page."""
    charts = {"corner": _corner_chart(tree), "force": _force_chart(tree)}
    records = tree["observed_data"].data_vars
    columns = min(2000, page_columns // len(records))  # no screen shows more
    return charts | {
        f"trace_{i}": _channel_chart(_fitted_channel(tree, str(name)), columns) for i, name in enumerate(records)
    }


def _fitted_channel(tree: Any, name: str) -> _FittedChannel:
    observed, predicted = tree["observed_data"][name], tree["posterior_predictive"][name]
    (axis,) = observed.dims
    fitted = tree["constant_data"][f"{name}_fit"].values
    kept = np.isfinite(fitted)
    channel, unit = CHANNELS[name.partition("_")[0]], observed.attrs["units"]
    ends = np.quantile(predicted.values.reshape(-1, predicted.sizes[axis]), [0.05, 0.95], axis=0)
    return _FittedChannel(
        observed[axis].values[kept], observed.values[kept], fitted[kept], channel, unit, predicted[axis].values, ends
    )


def _record_figure(record: _FittedChannel) -> str:
    """A channel's record, predictive band, residuals in time and their distribution, where it was fitted."""
    time, observed = record.time, record.values
    figure = Figure(figsize=(9.0, 5.6), layout="constrained")
    grid = figure.add_gridspec(2, 2, height_ratios=[2.2, 1.0], width_ratios=[5.0, 1.0])
    above, below = figure.add_subplot(grid[0, :]), figure.add_subplot(grid[1, 0])
    beside = figure.add_subplot(grid[1, 1], sharey=below)
    above.fill_between(
        record.predicted_time, *record.predicted, color=MODEL, alpha=0.45, lw=0, zorder=3,
        label="90 % of predicted records",
    )  # fmt: skip
    above.plot(time, observed, ".", color=DATA, ms=1.5, label="record", rasterized=True)
    above.set_ylabel(record.channel)
    above.set_ylim(*robust_limits(observed))
    above.legend(loc="upper right", framealpha=0.9, markerscale=5)
    residuals = observed - record.fitted
    below.plot(time, residuals, ".", color=ALERT, ms=1.5, rasterized=True)
    below.axhline(0.0, color=DATA, lw=0.8)
    below.set_ylabel("record − fit")
    beside.hist(residuals, bins=60, orientation="horizontal", color=ALERT, alpha=0.7)
    beside.tick_params(labelleft=False, labelbottom=False)
    for axes in (above, below):
        axes.xaxis.set_major_formatter(EngFormatter("s"))
        axes.yaxis.set_major_formatter(EngFormatter(record.unit))
        axes.set_xlim(time[0], time[-1])
    below.set_xlabel("time")
    return svg(figure)


def _corner_figure(posterior: Draws, prior: Draws, units: Mapping[str, str]) -> str:
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
                _draw_scatter(here, prior[x], prior[y], PRIOR, 0.25)
                _draw_scatter(here, posterior[x], posterior[y], MODEL, 0.5)
                _ticks(here.yaxis, limits[y], units[y], column == 0)
            _ticks(here.xaxis, limits[x], units[x], row == len(names) - 1)
            if row == len(names) - 1:
                here.set_xlabel(x)
            if column == 0 and row > 0:
                here.set_ylabel(y)
    handles = [mpl.lines.Line2D([], [], color=c, lw=6, alpha=0.7) for c in (MODEL, PRIOR)]
    figure.legend(handles, ["posterior", "prior"], loc="upper right", fontsize=13)
    return svg(figure)


def _force_figure(force: Draws) -> str:
    """Posterior of mean and peak force."""
    figure = Figure(figsize=(9.0, 3.2), layout="constrained")
    for axes, (name, title) in zip(figure.subplots(1, 3), _FORCES.items(), strict=True):
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


def _draw_scatter(axes: Axes, x: np.ndarray, y: np.ndarray, color: str, alpha: float) -> None:
    step = max(1, len(x) // 1200)  # more only darken the cloud
    axes.plot(x[::step], y[::step], ".", color=color, ms=2.5, alpha=alpha, rasterized=True)


def _limits(posterior: np.ndarray, prior: np.ndarray) -> tuple[float, float]:
    """Wide enough to see the prior's width, but never so wide that the posterior is a line."""
    low, high = np.log(np.quantile(posterior, [0.001, 0.999]))
    wide_low, wide_high = np.log(np.quantile(prior, [0.005, 0.995]))
    width = 4.0 * (high - low)
    low, high = max(wide_low, low - width), min(wide_high, high + width)
    low, high = min(low, np.log(posterior.min())), max(high, np.log(posterior.max()))
    return float(np.exp(low)), float(np.exp(high))


def _ticks(axis: FigureAxis, limits: tuple[float, float], unit: str, show_labels: bool) -> None:
    ends = np.log(limits)
    places = np.exp(ends[0] + np.array([0.2, 0.5, 0.8]) * (ends[1] - ends[0]))
    digits = max(2, 1 + math.ceil(-math.log10(ends[1] - ends[0])))  # that tell them apart
    axis.set_major_locator(FixedLocator([float(f"{place:.{digits}g}") for place in places]))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(EngFormatter(_SYMBOLS.get(unit, unit)) if show_labels else NullFormatter())


def _channel_chart(record: _FittedChannel, columns: int) -> Chart:
    """A channel over time; of a long one also its beginning, sample by sample."""
    expected = np.stack([record.predicted_time, *record.predicted])[:, np.isfinite(record.predicted[0])]
    count = 2 * columns
    if record.time.size <= count:
        return chart(_time_plot(record, columns, expected))
    time, values, fitted = record.time[:count], record.values[:count], record.fitted[:count]
    return chart(
        _time_plot(record, columns, expected, f"all of it, by the extremes of {columns:,} stretches"),
        _time_plot(
            record._replace(time=time, values=values, fitted=fitted), columns, None, f"its first {count:,} samples"
        ),
    )


def _time_plot(record: _FittedChannel, columns: int, expected: np.ndarray | None, title: str = "") -> Plot:
    """Record and fit, and what is left below; `expected`: times, and the ends of what 90 % of records keep to."""
    time, residuals = record.time, record.values - record.fitted
    x, limits = Axis.from_values("time", "s", time, limits=(time[0], time[-1])), robust_limits(record.values)
    y = Axis.from_values(record.channel, record.unit, limits, limits=limits)
    rest = Axis.from_values("record − fit", record.unit, residuals)
    edges = ("5 % of predicted records", "95 %", "90 % of predicted records")
    above = [] if expected is None else band(x, y, expected[0], expected[1], expected[2], edges)
    above += [
        _extremes_line(x, y, time, record.values, "record", DATA, columns),
        _extremes_line(x, y, time, record.fitted, "fit", MODEL, columns),
    ]
    below = [_extremes_line(x, rest, time, residuals, "record − fit", ALERT, columns) | {"showlegend": False}]
    return plot(x, (y, above), (rest, below), heights=(2.2, 1.0), title=title, size=480, unified_hover=True)


def _extremes_line(
    x: Axis, y: Axis, time: np.ndarray, values: np.ndarray, name: str, color: str, columns: int
) -> PlotlyTrace:
    at = extremes(values, columns)
    return line(x, y, time[at], values[at], name, color, width=1.0)


def _corner_chart(tree: Any) -> Chart:
    """Each parameter's distribution, then Rsc, Csc and Ci in pairs."""
    posterior, prior = tree["posterior"], tree["prior"]
    names = [str(name) for name in posterior.data_vars if name in prior.data_vars]
    axes = {
        name: Axis.from_values(name, posterior[name].attrs["units"], np.median(posterior[name]), log=True)
        for name in names
    }
    plots = [_marginal(axes[name], posterior[name].values, prior[name].values) for name in names]
    pairs = list(itertools.combinations([name for name in _PAIR_NAMES if name in names], 2))
    clouds = [_pair_plot((axes[a], axes[b]), [(each[a], each[b]) for each in (prior, posterior)]) for a, b in pairs]
    switch = log_axis_button(plots, label="logarithmic axes")
    switch["updates"] += log_axis_button(clouds, "xy")["updates"] if clouds else []
    return chart(*plots, *clouds, controls=[visibility_button("prior", [*plots, *clouds], "prior"), switch])


def _marginal(x: Axis, posterior: np.ndarray, prior: np.ndarray) -> Plot:
    traces = [density(x, prior, "prior", PRIOR), density(x, posterior, "posterior", MODEL)]
    return plot(x, (_density_axis(), traces), size=230, unified_hover=True)


def _pair_plot(axes: tuple[Axis, Axis], clouds: list[tuple[Any, Any]]) -> Plot:
    x, y = axes
    hover = f"{x.hover('x')}, {y.hover('y')}<extra></extra>"
    traces = []
    for (a, b), name, color in zip(clouds, ("prior", "posterior"), (PRIOR, MODEL), strict=True):
        shown = slice(None, None, max(1, a.size // 300))  # so many are a cloud, and a light page
        cloud = points(x, y, a.values.ravel()[shown], b.values.ravel()[shown], name, color, size=4.0, opacity=0.6)
        traces.append(cloud | {"hovertemplate": hover})
    return plot(x, (y, traces))


def _force_chart(tree: Any) -> Chart:
    posterior = tree["posterior"]
    plots = []
    for name, title in _FORCES.items():
        draws = posterior[name].values
        x, (low, high) = Axis.from_values(title, "N", np.median(draws)), np.quantile(draws, [0.05, 0.95])
        distribution = plot(
            x, (_density_axis(), [density(x, draws, title)]), size=230, legend=False, unified_hover=True
        )
        plots.append(shade_interval(distribution, x, float(low), float(high)))
    return chart(*plots, controls=[log_axis_button(plots)])


def _density_axis() -> Axis:
    """Return an axis without numbers, since each density is scaled to its own peak."""
    return Axis("density", hides_numbers=True)
