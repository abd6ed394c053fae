"""The charts of a posterior: each record with its fit, the parameters, and the force."""

import itertools
from typing import Any

import numpy as np

from fitact.charts import interactive
from fitact.charts.figure import ALERT, DATA, MODEL, PRIOR, robust_limits
from fitact.charts.interactive import Axis, Chart, Plot, PlotlyTrace

CHANNELS = {"Vsc": "skin voltage Vsc", "I": "trunk current I"}
_FORCES = {"force_mean": "mean force", "force_rms": "rms force", "force_peak": "peak force"}
_PAIR_NAMES = ("Rsc", "Csc", "Ci")
_DENSITY = Axis("density", hides_numbers=True)  # each is scaled to its own peak


def make_charts(tree: Any, page_columns: int = 10_000) -> dict[str, Chart]:
    """Make the charts of a posterior's DataTree, by name; `page_columns`: of all records of a page."""
    records = [str(name) for name in tree["observed_data"].data_vars]
    columns = min(2000, page_columns // len(records))  # no screen shows more
    charts = {f"trace_{i}": _channel_chart(tree, name, columns) for i, name in enumerate(records)}
    return charts | {"corner": _corner_chart(tree), "force": _force_chart(tree)}


def _channel_chart(tree: Any, name: str, columns: int) -> Chart:
    """A channel over time, where it was fitted; of a long one also its beginning, sample by sample."""
    observed, predicted = tree["observed_data"][name], tree["posterior_predictive"][name]
    (axis,) = observed.dims
    fitted = tree["constant_data"][f"{name}_fit"].values
    kept = np.isfinite(fitted)
    series = np.stack([observed[axis].values, observed.values, fitted])[:, kept]
    ends = np.quantile(predicted.values.reshape(-1, predicted.sizes[axis]), [0.05, 0.95], axis=0)
    expected = np.stack([predicted[axis].values, *ends])[:, np.isfinite(ends[0])]
    quantity, count = (CHANNELS[name.partition("_")[0]], observed.attrs["units"]), 2 * columns
    if np.count_nonzero(kept) <= count:
        return interactive.chart(_time_plot(series, quantity, columns, expected))
    return interactive.chart(
        _time_plot(series, quantity, columns, expected, f"all of it, by the extremes of {columns:,} stretches"),
        _time_plot(series[:, :count], quantity, columns, None, f"its first {count:,} samples"),
    )


def _time_plot(
    series: np.ndarray, quantity: tuple[str, str], columns: int, expected: np.ndarray | None, title: str = ""
) -> Plot:
    """Record and fit, and what is left below.

    Args:
        series: times, the record and its fit, SI.
        quantity: the channel and its unit.
        expected: times, and the ends of what 90 % of records keep to.
    """
    (time, values, fitted), (channel, unit) = series, quantity
    residuals, limits = values - fitted, robust_limits(values)
    x = Axis.from_values("time", "s", time, limits=(time[0], time[-1]))
    y = Axis.from_values(channel, unit, limits, limits=limits)
    rest = Axis.from_values("record − fit", unit, residuals)

    def draw_extremes(y: Axis, values: np.ndarray, name: str, color: str) -> PlotlyTrace:
        at = interactive.extremes(values, columns)
        return interactive.line(x, y, time[at], values[at], name, color, width=1.0)

    edges = ("5 % of predicted records", "95 %", "90 % of predicted records")
    above = [] if expected is None else interactive.band(x, y, expected[0], expected[1], expected[2], edges)
    above += [draw_extremes(y, values, "record", DATA), draw_extremes(y, fitted, "fit", MODEL)]
    below = [draw_extremes(rest, residuals, "record − fit", ALERT) | {"showlegend": False}]
    return interactive.plot(x, (y, above), (rest, below), heights=(2.2, 1.0), title=title, size=480, unified_hover=True)


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
    switch = interactive.log_axis_button(plots, label="logarithmic axes")
    switch["updates"] += interactive.log_axis_button(clouds, "xy")["updates"] if clouds else []
    return interactive.chart(
        *plots, *clouds, controls=[interactive.visibility_button("prior", [*plots, *clouds], "prior"), switch]
    )


def _marginal(x: Axis, posterior: np.ndarray, prior: np.ndarray) -> Plot:
    traces = [interactive.density(x, prior, "prior", PRIOR), interactive.density(x, posterior, "posterior", MODEL)]
    return interactive.plot(x, (_DENSITY, traces), size=230, unified_hover=True)


def _pair_plot(axes: tuple[Axis, Axis], clouds: list[tuple[Any, Any]]) -> Plot:
    x, y = axes
    hover = f"{x.hover('x')}, {y.hover('y')}<extra></extra>"
    traces = []
    for (a, b), name, color in zip(clouds, ("prior", "posterior"), (PRIOR, MODEL), strict=True):
        shown = slice(None, None, max(1, a.size // 300))  # so many are a cloud, and a light page
        cloud = interactive.points(
            x, y, a.values.ravel()[shown], b.values.ravel()[shown], name, color, size=4.0, opacity=0.6
        )
        traces.append(cloud | {"hovertemplate": hover})
    return interactive.plot(x, (y, traces))


def _force_chart(tree: Any) -> Chart:
    posterior = tree["posterior"]
    plots = []
    for name, title in _FORCES.items():
        draws = posterior[name].values
        x, (low, high) = Axis.from_values(title, "N", np.median(draws)), np.quantile(draws, [0.05, 0.95])
        distribution = interactive.plot(
            x, (_DENSITY, [interactive.density(x, draws, title)]), size=230, legend=False, unified_hover=True
        )
        plots.append(interactive.shade_interval(distribution, x, float(low), float(high)))
    return interactive.chart(*plots, controls=[interactive.log_axis_button(plots)])
