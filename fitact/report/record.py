"""A record as a picture: its channels over time."""

import os
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from fitact.charts.figure import save, style
from fitact.data.clipping import clipped
from fitact.data.inspection import Channel, Inspection
from fitact.errors import InputError
from fitact.files import replacing

_COLOR, _RAIL = "#333333", "#D55E00"
_COLUMNS = 2000  # beyond twice as many samples, the extremes of so many stretches are drawn


def write_record(path: str | os.PathLike[str], inspection: Inspection) -> None:
    """Draw a record's channels at `path`: SVG or PNG by its ending.

    Raises:
        InputError: another ending, or a place that cannot be written.
    """
    path = Path(path)
    if path.suffix not in (".svg", ".png"):
        raise InputError(f"{path}: the drawing is written as .svg or .png; choose one of these endings")
    with mpl.rc_context(style()), replacing(path) as temporary:
        save(_figure(inspection), temporary, path.suffix)


def _figure(inspection: Inspection) -> Figure:
    count = len(inspection.channels)
    figure = Figure(figsize=(9.0, 1.0 + 1.9 * count), layout="constrained")
    rows = figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0]
    for axes, channel in zip(rows, inspection.channels, strict=True):
        _draw(axes, inspection.time, channel)
        axes.set_ylabel(channel.name)
        axes.yaxis.set_major_formatter(EngFormatter(channel.unit))
    rows[-1].xaxis.set_major_formatter(EngFormatter("s"))
    rows[-1].set_xlabel("time")
    figure.suptitle(os.path.basename(inspection.source))
    return figure


def _draw(axes: Axes, time: np.ndarray, channel: Channel) -> None:
    values = channel.values
    if values.size > 2 * _COLUMNS:
        starts = np.linspace(0, values.size, _COLUMNS, endpoint=False).astype(int)
        low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
        axes.fill_between(time[starts], low, high, color=_COLOR, lw=0.6)
    else:
        axes.plot(time, values, ".-", color=_COLOR, ms=2.0, lw=0.6)
    if channel.clipped:
        railed = np.flatnonzero(clipped(values))[:: max(1, channel.clipped // _COLUMNS)]
        axes.plot(time[railed], values[railed], ".", color=_RAIL, ms=3.0, label="clipped")
        axes.legend(loc="upper right")
