"""Plots of values over time with their bands."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from fitact.charts import interactive
from fitact.charts.figure import ALERT, MODEL
from fitact.charts.interactive import Axis, Plot
from fitact.summary import describe_quantity
from fitact.units import quantity_unit

_MAX_POINTS = 4_000  # of a curve


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


def _stretches(shown: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the places of each stretch without a gap, at most `_MAX_POINTS` of all."""
    places = np.flatnonzero(shown)
    stride = -(-places.size // _MAX_POINTS)
    for part in np.split(places, np.flatnonzero(np.diff(places) > 1) + 1):
        if part.size:
            yield part[::stride]
