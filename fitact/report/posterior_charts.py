"""The charts of a posterior's page: each record with its fit, the parameters' distributions, and the force's."""

import itertools
from typing import Any, NamedTuple

import numpy as np

from fitact.charts.figure import ALERT, DATA, MODEL, PRIOR, without_spikes
from fitact.charts.interactive import (
    COLUMNS,
    Axis,
    Chart,
    Plot,
    Trace,
    band,
    chart,
    density,
    extremes,
    line,
    logarithmic,
    plot,
    points,
    shaded,
    toggle,
)

CHANNELS = {"Vsc": "skin voltage Vsc", "I": "trunk current I"}
_FORCES = {"force_mean": "mean force", "force_rms": "rms force", "force_peak": "peak force"}
_PAIRED = ("Rsc", "Csc", "Ci")
_ALL_COLUMNS = 10_000  # of all records of a page
_CLOUD = 300  # draws shown of each pair


def charts(tree: Any) -> dict[str, Chart]:
    """By the names of the pictures that they replace; `tree`: a posterior's DataTree."""
    found = {"corner": _corner(tree), "force": _force(tree)}
    records = tree["observed_data"].data_vars
    for number, name in enumerate(records):
        found[f"trace_{number}"] = _record(tree, str(name), min(COLUMNS, _ALL_COLUMNS // len(records)))
    return found


class _Record(NamedTuple):
    """A channel where it was fitted, SI."""

    time: np.ndarray
    values: np.ndarray
    fitted: np.ndarray
    channel: str
    unit: str


def _record(tree: Any, name: str, columns: int) -> Chart:
    """A channel over time; of a long one also its beginning, sample by sample."""
    observed, predicted = tree["observed_data"][name], tree["posterior_predictive"][name]
    (axis,) = observed.dims
    fitted = tree["constant_data"][f"{name}_fit"].values
    kept = np.isfinite(fitted)
    channel, unit = CHANNELS[name.partition("_")[0]], observed.attrs["units"]
    record = _Record(observed[axis].values[kept], observed.values[kept], fitted[kept], channel, unit)

    ends = np.quantile(predicted.values.reshape(-1, predicted.sizes[axis]), [0.05, 0.95], axis=0)
    expected = np.stack([predicted[axis].values, *ends])[:, np.isfinite(ends[0])]
    if record.time.size <= 2 * columns:
        return chart(_over_time(record, columns, expected))
    start = record._replace(**{each: getattr(record, each)[: 2 * columns] for each in ("time", "values", "fitted")})
    return chart(
        _over_time(record, columns, expected, f"all of it, by the extremes of {columns:,} stretches"),
        _over_time(start, columns, None, f"its first {2 * columns:,} samples"),
    )


def _over_time(record: _Record, columns: int, expected: np.ndarray | None, title: str = "") -> Plot:
    """Record and fit, and what is left below; `expected`: times, and the ends of what 90 % of records keep to."""
    time, residuals = record.time, record.values - record.fitted
    x, limits = Axis.of("time", "s", time, limits=(time[0], time[-1])), without_spikes(record.values)
    y = Axis.of(record.channel, record.unit, limits, limits=limits)
    rest = Axis.of("record − fit", record.unit, residuals)
    edges = ("5 % of predicted records", "95 %", "90 % of predicted records")
    above = [] if expected is None else band(x, y, expected[0], expected[1], expected[2], edges)
    above += [
        _thinned(x, y, time, record.values, "record", DATA, columns),
        _thinned(x, y, time, record.fitted, "fit", MODEL, columns),
    ]
    below = [_thinned(x, rest, time, residuals, "record − fit", ALERT, columns) | {"showlegend": False}]
    return plot(x, (y, above), (rest, below), heights=(2.2, 1.0), title=title, size=480, together=True)


def _thinned(x: Axis, y: Axis, time: np.ndarray, values: np.ndarray, name: str, color: str, columns: int) -> Trace:
    at = extremes(values, columns)
    return line(x, y, time[at], values[at], name, color, width=1.0)


def _corner(tree: Any) -> Chart:
    """Each parameter's distribution, then Rsc, Csc and Ci in pairs."""
    posterior, prior = tree["posterior"], tree["prior"]
    names = [str(name) for name in posterior.data_vars if name in prior.data_vars]
    axes = {name: Axis.of(name, posterior[name].attrs["units"], np.median(posterior[name]), log=True) for name in names}
    plots = [_marginal(axes[name], posterior[name].values, prior[name].values) for name in names]
    pairs = list(itertools.combinations([name for name in _PAIRED if name in names], 2))
    clouds = [_pair((axes[a], axes[b]), [(each[a], each[b]) for each in (prior, posterior)]) for a, b in pairs]
    switch = logarithmic(plots, label="logarithmic axes")
    switch["updates"] += logarithmic(clouds, "xy")["updates"] if clouds else []
    return chart(*plots, *clouds, controls=[toggle("prior", [*plots, *clouds], "prior"), switch])


def _marginal(x: Axis, posterior: np.ndarray, prior: np.ndarray) -> Plot:
    traces = [density(x, prior, "prior", PRIOR), density(x, posterior, "posterior", MODEL)]
    return plot(x, (_heights(), traces), size=230, together=True)


def _pair(axes: tuple[Axis, Axis], clouds: list[tuple[Any, Any]]) -> Plot:
    x, y = axes
    hover = f"{x.hover('x')}, {y.hover('y')}<extra></extra>"
    traces = []
    for (a, b), name, color in zip(clouds, ("prior", "posterior"), (PRIOR, MODEL), strict=True):
        shown = slice(None, None, max(1, a.size // _CLOUD))
        cloud = points(x, y, a.values.ravel()[shown], b.values.ravel()[shown], name, color, size=4.0, opacity=0.6)
        traces.append(cloud | {"hovertemplate": hover})
    return plot(x, (y, traces))


def _force(tree: Any) -> Chart:
    posterior = tree["posterior"]
    plots = []
    for name, title in _FORCES.items():
        draws = posterior[name].values
        x, (low, high) = Axis.of(title, "N", np.median(draws)), np.quantile(draws, [0.05, 0.95])
        distribution = plot(x, (_heights(), [density(x, draws, title)]), size=230, legend=False, together=True)
        plots.append(shaded(distribution, x, float(low), float(high)))
    return chart(*plots, controls=[logarithmic(plots)])


def _heights() -> Axis:
    """Of densities: without numbers, since each is scaled to its own peak."""
    return Axis("density", bare=True)
