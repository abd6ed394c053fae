"""Picture of a file before a fit: channels over time, or spectra over frequency."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from fitact.charts.figure import ALERT, DATA, write_figure
from fitact.charts.interactive import extremes
from fitact.data.clipping import clipping_mask
from fitact.data.inspection import Channel, Inspection
from fitact.data.spectrum import Spectrum
from fitact.errors import InputError


def write_record(path: str | os.PathLike[str], inspection: Inspection) -> None:
    """Draw the channels of a record and write SVG or PNG, by the ending of `path`."""
    _write(path, lambda: _figure(inspection))


def write_spectra(path: str | os.PathLike[str], spectra: Sequence[Spectrum]) -> None:
    """Draw magnitude and phase of spectra and write SVG or PNG, by the ending of `path`."""
    _write(path, lambda: _spectrum_figure(spectra))


def _write(path: str | os.PathLike[str], draw: Callable[[], Figure]) -> None:
    path = Path(path)
    if path.suffix not in (".svg", ".png"):
        raise InputError(f"{path}: the drawing is written as .svg or .png; choose one of these endings")
    write_figure(path, draw, dpi=150)


def _spectrum_figure(spectra: Sequence[Spectrum]) -> Figure:
    figure = Figure(figsize=(9.0, 4.8), layout="constrained")
    size, phase = figure.subplots(2, 1, sharex=True)
    for spectrum in spectra:
        size.loglog(spectrum.frequency, np.abs(spectrum.values), ".-", ms=4.0, lw=0.8)
        phase.plot(spectrum.frequency, np.degrees(np.angle(spectrum.values)), ".-", ms=4.0, lw=0.8)
    is_impedance = spectra[0].channel == "impedance"
    size.set_ylabel("|Z|" if is_impedance else "|Vsc / V|")
    size.yaxis.set_major_formatter(EngFormatter("Ω" if is_impedance else ""))
    phase.set_ylabel("phase / °")
    phase.xaxis.set_major_formatter(EngFormatter("Hz"))
    phase.set_xlabel("frequency")
    figure.suptitle(os.path.basename(spectra[0].source))
    return figure


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
