"""Picture of a file before a fit: channels over time, or spectra over frequency."""

import os
from collections.abc import Sequence

from fitact.charts import interactive
from fitact.charts.figure import write_figure
from fitact.charts.interactive import Plot
from fitact.charts.picture import draw_chart
from fitact.charts.series import Series, spectrum_plot, time_plot
from fitact.data.clipping import clipping_mask
from fitact.data.spectrum import Spectrum
from fitact.inspection.inspection import Inspection


def write_record(path: str | os.PathLike[str], inspection: Inspection) -> None:
    """Draw the channels of a record and write SVG or PNG, by the ending of `path`."""
    series = [
        Series(each.name, each.unit, each.values, clipped=clipping_mask(each.values) if each.clipped else None)
        for each in inspection.channels
    ]
    _write(path, time_plot(inspection.time, series, title=os.path.basename(inspection.source)))


def write_spectra(path: str | os.PathLike[str], spectra: Sequence[Spectrum]) -> None:
    """Draw magnitude and phase of spectra and write SVG or PNG, by the ending of `path`."""
    _write(path, *(spectrum_plot(each.frequency, *each.symbol, each.values) for each in spectra))


def _write(path: str | os.PathLike[str], *plots: Plot) -> None:
    write_figure(path, lambda: draw_chart(interactive.chart(*plots)))
