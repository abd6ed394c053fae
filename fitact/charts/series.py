"""Plots of records and tracks over time and of spectra over frequency, with what was fitted to them."""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from fitact.charts import interactive
from fitact.charts.figure import ALERT, DATA, MODEL, robust_limits
from fitact.charts.interactive import Axis, Chart, Plot, PlotlyTrace
from fitact.summary import describe_quantity
from fitact.units import quantity_unit

_EDGES = ("5 % predictive", "95 % predictive", "90 % predictive interval")


class Series(NamedTuple):
    """A channel over time, with what is drawn beside it, in SI units."""

    title: str
    unit: str
    values: np.ndarray  # data
    fit: np.ndarray | None = None  # NaN where a sample does not count
    interval: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None  # times, and ends of the predictive interval
    clipped: np.ndarray | None = None  # which samples the converter clipped
    has_residuals: bool = True  # whether residuals of the fit are drawn below
    white: np.ndarray | None = None  # residuals that take the place of data minus fit; NaN where none counts


def time_chart(time: np.ndarray, series: Sequence[Series], columns: int = 2000) -> Chart:
    """Draw channels on one time axis; of a long record also the beginning, sample by sample."""
    count = 2 * columns
    if time.size <= count:
        return interactive.chart(time_plot(time, series, columns))
    begin = [
        each._replace(
            values=each.values[:count],
            fit=None if each.fit is None else each.fit[:count],
            white=None if each.white is None else each.white[:count],
            interval=None,
        )
        for each in series
    ]
    return interactive.chart(
        time_plot(time, series, columns, f"whole record: minimum and maximum in {columns:,} intervals"),
        time_plot(time[:count], begin, columns, f"first {count:,} samples"),
    )


def time_plot(
    time: np.ndarray, series: Sequence[Series], columns: int = 2000, title: str = "", row_pixels: int = 100
) -> Plot:
    """Draw channels (time in s) one below the other, each with its fit and, below, the residuals.

    A row without a fit is `row_pixels` high.
    """
    x, rows, heights = Axis.from_values("time", "s", time, limits=(time[0], time[-1])), [], []
    names: set[str] = set()  # each has one entry in the legend

    def draw_extremes(y: Axis, kept: np.ndarray, values: np.ndarray, name: str, color: str) -> PlotlyTrace:
        at = interactive.extremes(values, columns)
        shown = name not in names
        names.add(name)
        line = interactive.line(x, y, time[kept][at], values[at], name, color, width=1.0)
        return line | {"legendgroup": name, "showlegend": shown}

    for each in series:
        kept = np.isfinite(each.values if each.fit is None else each.fit)
        values, limits = each.values[kept], robust_limits(each.values[kept])
        y = Axis.from_values(each.title, each.unit, limits, limits=limits)
        traces: list[PlotlyTrace] = []
        if each.interval is not None:
            shown = {"showlegend": _EDGES[2] not in names}
            traces = [edge | shown for edge in interactive.band(x, y, *each.interval, _EDGES)]
            traces[0] |= {"showlegend": False}
            names.add(_EDGES[2])
        traces.append(draw_extremes(y, kept, values, "data", DATA))
        if each.clipped is not None and np.any(each.clipped):
            railed = np.flatnonzero(each.clipped)[:: max(1, np.count_nonzero(each.clipped) // columns)]
            traces.append(interactive.points(x, y, time[railed], each.values[railed], "clipped", ALERT, size=4.0))
        rows.append((y, traces))
        heights.append(1.0 if each.fit is None else 2.2)
        if each.fit is None:
            continue
        fitted = each.fit[kept]
        traces.append(draw_extremes(y, kept, fitted, "fit" if each.has_residuals else "stated drive", MODEL))
        if each.has_residuals:
            name, shown, rests = "data − fit", kept, values - fitted
            if each.white is not None:
                name, shown = "residuals", np.isfinite(each.white)
                rests = each.white[shown]
            rest = Axis.from_values(name, each.unit, rests)
            below = draw_extremes(rest, shown, rests, name, ALERT) | {"showlegend": False}
            rows.append((rest, [below]))
            heights.append(1.0)
    size = int(row_pixels * sum(heights)) + 80  # legend and labels
    legend = len(names) > 1
    return interactive.plot(x, *rows, heights=heights, title=title, size=size, legend=legend, unified_hover=True)


def spectrum_plot(
    frequency: np.ndarray,
    letter: str,
    unit: str,
    values: np.ndarray,
    fit: np.ndarray | None = None,
    draws: np.ndarray | None = None,
) -> Plot:
    """Draw magnitude and phase of a complex spectrum over frequency (Hz), with its fit and the relative residuals.

    `draws` (any, points) give the 90 % posterior predictive interval.
    """
    x = Axis.from_values("frequency", "Hz", frequency, log=True)
    size, phase = Axis.from_values(letter, unit, np.abs(values), log=True), Axis("phase", "°")
    rows: list[tuple[Axis, list[PlotlyTrace]]] = []
    for y, part in ((size, np.abs), (phase, lambda z: np.angle(z, deg=True))):
        traces: list[PlotlyTrace] = []
        if draws is not None:
            low, high = np.quantile(part(draws), [0.05, 0.95], axis=0)
            traces += interactive.band(x, y, frequency, low, high, _EDGES)
        traces.append(interactive.points(x, y, frequency, part(values), "data", DATA, size=4.0))
        if fit is not None:
            traces.append(interactive.line(x, y, frequency, part(fit), "fit", MODEL))
        rows.append((y, traces))
    for more in rows[1][1]:
        more["showlegend"] = False
    if fit is not None:
        rest = Axis("|data / fit − 1|", "%", 0.01)
        left = interactive.points(x, rest, frequency, np.abs(values / fit - 1.0), "residual", ALERT, size=4.0)
        rows.append((rest, [left | {"showlegend": False}]))
    heights = (1.6, 1.2, 1.0)[: len(rows)]
    return interactive.plot(
        x, *rows, heights=heights, size=int(147 * sum(heights)), legend=fit is not None, unified_hover=True
    )


def track_plot(columns: Mapping[str, np.ndarray], name: str, jumps: Sequence[float]) -> Plot:
    """Draw a quantity over time, with its 95 % band; `columns` are those of track.parquet, `jumps` in s."""
    times, values, spread = columns["time_s"], columns[name], columns[f"{name}_sd"]
    finite = np.isfinite(values)
    x = Axis.from_values("time", "s", times)
    title = name if name in ("g", "b") else describe_quantity(name)  # their names are long
    y = Axis.from_values(title, quantity_unit(name), values[finite])
    traces = []
    for number, part in enumerate(_stretches(finite)):
        time, middle = times[part], values[part]
        low, high = (middle * np.exp(sign * 1.96 * spread[part]) for sign in (-1.0, 1.0))
        edges = interactive.band(x, y, time, low, high, ("2.5 %", "97.5 %", "95 % band"), MODEL)
        curve = interactive.line(x, y, time, middle, "median", MODEL)
        shown = [*edges, curve]
        traces += [each | ({"showlegend": False} if number else {}) for each in shown]
    for jump in jumps:
        ends = np.nanmin(values), np.nanmax(values)
        traces.append(interactive.line(x, y, (jump, jump), ends, "jump", ALERT, dash="dot"))
    return interactive.plot(x, (y, traces), legend=False)


def _stretches(shown: np.ndarray, max_points: int = 4_000) -> Iterator[np.ndarray]:
    """Yield the places of each stretch without a gap, at most `max_points` of all."""
    places = np.flatnonzero(shown)
    stride = -(-places.size // max_points)
    for part in np.split(places, np.flatnonzero(np.diff(places) > 1) + 1):
        if part.size:
            yield part[::stride]
