"""Picture of a record: its channels over time."""

import os
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from fitact.charts.figure import ALERT, DATA, write_figure
from fitact.charts.interactive import extremes
from fitact.data.clipping import clipping_mask
from fitact.data.inspection import Channel, Inspection
from fitact.errors import InputError


def write_record(path: str | os.PathLike[str], inspection: Inspection) -> None:
    """Draw the channels of a record and write SVG or PNG, by the ending of `path`."""
    path = Path(path)
    if path.suffix not in (".svg", ".png"):
        raise InputError(f"{path}: the drawing is written as .svg or .png; choose one of these endings")
    write_figure(path, lambda: _figure(inspection), dpi=150)


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


def _draw(axes: Axes, time: np.ndarray, channel: Channel, columns: int = 2000) -> None:
    """Draw each sample, or the extremes in `columns` intervals if there are more than twice as many samples."""
    values = channel.values
    at = extremes(values, columns)
    axes.plot(time[at], values[at], ".-" if at.size == values.size else "-", color=DATA, ms=2.0, lw=0.6)
    if channel.clipped:
        railed = np.flatnonzero(clipping_mask(values))[:: max(1, channel.clipped // columns)]
        axes.plot(time[railed], values[railed], ".", color=ALERT, ms=3.0, label="clipped")
        axes.legend(loc="upper right")
