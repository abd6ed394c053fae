"""Charts of a posterior: each record with its fit, the parameters, and the force."""

import itertools
from typing import Any

import numpy as np

from fitact.charts import interactive
from fitact.charts.figure import ALERT, DATA, MODEL, PRIOR, robust_limits
from fitact.charts.interactive import Axis, Chart, Plot, PlotlyTrace
from fitact.model.circuit import FINGER_PARAMETERS

CHANNELS = {"Vsc": "skin voltage Vsc", "I": "loop current I", "Ft": "friction Ft", "impedance": "impedance"}
_FORCES = {"force_mean": "mean force", "force_rms": "rms force", "force_peak": "peak force"}
_DENSITY = Axis("density", hides_numbers=True)  # each density is scaled to its own maximum


def make_charts(tree: Any, page_columns: int = 10_000) -> dict[str, Chart]:
    """Make the charts of the DataTree of a posterior, by name; `page_columns`: columns for all records of a page."""
    names = [str(name) for name in tree["observed_data"].data_vars if not str(name).endswith("_imag")]
    columns = min(2000, page_columns // len(names))  # screens have no more columns
    charts = {
        f"trace_{i}": _spectrum_chart(tree, name) if name.endswith("_real") else _channel_chart(tree, name, columns)
        for i, name in enumerate(names)
    }
    return charts | {"corner": _corner_chart(tree), "force": _force_chart(tree)}


def _channel_chart(tree: Any, name: str, columns: int) -> Chart:
    """Draw a fitted channel over time; for a long record also its beginning, sample by sample."""
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
        _time_plot(series, quantity, columns, expected, f"whole record: minimum and maximum in {columns:,} intervals"),
        _time_plot(series[:, :count], quantity, columns, None, f"first {count:,} samples"),
    )


def _spectrum_chart(tree: Any, name: str) -> Chart:
    """Draw magnitude and phase of a spectrum over frequency, and the relative residuals."""

    def join(group: str, end: str = "") -> np.ndarray:
        real, imag = (tree[group][f"{name.removesuffix('real')}{part}{end}"].values for part in ("real", "imag"))
        return real + 1j * imag

    observed = tree["observed_data"][name]
    (axis,) = observed.dims
    frequency, values, fitted = observed[axis].values, join("observed_data"), join("constant_data", "_fit")
    drawn = join("posterior_predictive").reshape(-1, frequency.size)
    letter, unit = ("|Z|", "Ω") if name.startswith("Z") else ("|Vsc / V|", "")
    x = Axis.from_values("frequency", "Hz", frequency, log=True)
    size = Axis.from_values(letter, unit, np.abs(values), log=True)
    phase, rest = Axis("phase", "°"), Axis("|data / fit − 1|", "%", 0.01)
    edges = ("5 % predictive", "95 % predictive", "90 % predictive interval")
    rows = []
    for y, part in ((size, np.abs), (phase, lambda z: np.angle(z, deg=True))):
        low, high = np.quantile(part(drawn), [0.05, 0.95], axis=0)
        band = interactive.band(x, y, frequency, low, high, edges)
        marks = interactive.points(x, y, frequency, part(values), "data", DATA, size=4.0)
        rows.append((y, [*band, marks, interactive.line(x, y, frequency, part(fitted), "fit", MODEL)]))
    for more in rows[1][1]:
        more["showlegend"] = False
    left = interactive.points(x, rest, frequency, np.abs(values / fitted - 1.0), "residual", ALERT, size=4.0)
    below = (rest, [left | {"showlegend": False}])
    return interactive.chart(interactive.plot(x, *rows, below, heights=(1.6, 1.2, 1.0), size=560, unified_hover=True))


def _time_plot(
    series: np.ndarray, quantity: tuple[str, str], columns: int, expected: np.ndarray | None, title: str = ""
) -> Plot:
    """Draw a `series` (times, data and fit) of a `quantity` (channel and unit), with the residuals below.

    `expected` holds times, and both ends of the 90 % posterior predictive interval.
    """
    (time, values, fitted), (channel, unit) = series, quantity
    residuals, limits = values - fitted, robust_limits(values)
    x = Axis.from_values("time", "s", time, limits=(time[0], time[-1]))
    y = Axis.from_values(channel, unit, limits, limits=limits)
    rest = Axis.from_values("data − fit", unit, residuals)

    def draw_extremes(y: Axis, values: np.ndarray, name: str, color: str) -> PlotlyTrace:
        at = interactive.extremes(values, columns)
        return interactive.line(x, y, time[at], values[at], name, color, width=1.0)

    edges = ("5 % predictive", "95 % predictive", "90 % predictive interval")
    above = [] if expected is None else interactive.band(x, y, expected[0], expected[1], expected[2], edges)
    above += [draw_extremes(y, values, "data", DATA), draw_extremes(y, fitted, "fit", MODEL)]
    below = [draw_extremes(rest, residuals, "data − fit", ALERT) | {"showlegend": False}]
    return interactive.plot(x, (y, above), (rest, below), heights=(2.2, 1.0), title=title, size=480, unified_hover=True)


def _corner_chart(tree: Any) -> Chart:
    """Draw the distribution of each parameter, then Rsc, Csc and Ci in pairs."""
    posterior, prior = ({str(name): x.values.ravel() for name, x in tree[g].items()} for g in ("posterior", "prior"))
    axes = {
        name: Axis.from_values(name, tree["posterior"][name].attrs["units"], np.median(draws), log=True)
        for name, draws in posterior.items()
        if name in prior
    }
    both = (prior, "prior", PRIOR), (posterior, "posterior", MODEL)
    plots = []
    for name, x in axes.items():
        traces = [interactive.density(x, draws[name], label, color) for draws, label, color in both]
        plots.append(interactive.plot(x, (_DENSITY, traces), size=230, unified_hover=True))
    clouds = []
    for a, b in itertools.combinations([name for name in FINGER_PARAMETERS if name in axes], 2):
        traces = []
        for draws, label, color in both:
            shown = slice(None, None, max(1, draws[a].size // 300))  # 300 points show the shape and keep the page small
            at = draws[a][shown], draws[b][shown]
            cloud = interactive.points(axes[a], axes[b], *at, label, color, size=4.0, opacity=0.6)
            traces.append(cloud | {"hovertemplate": f"{axes[a].hover('x')}, {axes[b].hover('y')}<extra></extra>"})
        clouds.append(interactive.plot(axes[a], (axes[b], traces)))
    switch = interactive.log_axis_button(plots, label="logarithmic axes")
    switch["updates"] += interactive.log_axis_button(clouds, "xy")["updates"] if clouds else []
    hide = interactive.visibility_button("prior", [*plots, *clouds], "prior")
    return interactive.chart(*plots, *clouds, controls=[hide, switch])


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
