"""Picture of a record: its channels over time."""

import os
from pathlib import Path

from fitact.charts import interactive
from fitact.charts.figure import write_figure
from fitact.charts.picture import draw_chart
from fitact.charts.series import Series, time_plot
from fitact.data.clipping import clipping_mask
from fitact.data.inspection import Inspection
from fitact.errors import InputError


def write_record(path: str | os.PathLike[str], inspection: Inspection) -> None:
    """Draw the channels of a record and write SVG or PNG, by the ending of `path`."""
    path = Path(path)
    if path.suffix not in (".svg", ".png"):
        raise InputError(f"{path}: the drawing is written as .svg or .png; choose one of these endings")
    series = [
        Series(each.name, each.unit, each.values, clipped=clipping_mask(each.values) if each.clipped else None)
        for each in inspection.channels
    ]
    plot = time_plot(inspection.time, series, title=os.path.basename(inspection.source))
    write_figure(path, lambda: draw_chart(interactive.chart(plot)), dpi=150)
