"""Folder of one result: JSON, figure and page."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from fitact.charts import draw_design, draw_drive_design, draw_plan
from fitact.charts.figure import write_figure
from fitact.data.record import Record
from fitact.design.drive_design import DriveDesign
from fitact.design.measurement import MeasurementDesign
from fitact.files import write_json
from fitact.model_selection.plan import Plan
from fitact.populations.finger import Finger
from fitact.report.design import write_design_page
from fitact.report.drive_design import write_drive_design_page
from fitact.report.frame import Provenance
from fitact.report.plan import write_plan_page
from fitact.report.tradeoff import draw_tradeoff, write_tradeoff_page
from fitact.scene.scene import Scene
from fitact.tradeoff.tradeoff import Tradeoff

# by class: file name, function that draws the figure, function that writes the page
_WRITERS: dict[type, tuple[str, Callable[..., Figure], Callable[..., None]]] = {
    DriveDesign: (
        "drive",
        lambda design: draw_drive_design(design.to_dict(), design.scene_waveform),
        write_drive_design_page,
    ),
    MeasurementDesign: ("design", lambda design: draw_design(design.to_dict()), write_design_page),
    Plan: ("plan", lambda plan: draw_plan(plan.to_dict()), write_plan_page),
    Tradeoff: ("tradeoff", draw_tradeoff, write_tradeoff_page),
}


def write_folder(
    folder: Path, result: Any, command: str, scene: Scene | None, records: Sequence[Record | Finger] = ()
) -> None:
    """Write a design, a plan or a trade-off into a folder, with its command, scene and records."""
    name, draw, write_page = _WRITERS[type(result)]
    write_json(folder / f"{name}.json", result.to_dict())
    write_figure(folder / f"{name}.svg", lambda: draw(result))
    write_page(folder / "report.html", result, Provenance.from_inputs(command, scene, records))
