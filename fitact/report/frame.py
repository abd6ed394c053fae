"""Frame of all result pages: subject, verdict, answers, and how to repeat the result."""

import base64
import json
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Self

import jinja2
import matplotlib as mpl
from markupsafe import Markup
from matplotlib.figure import Figure

from fitact.charts.figure import STYLE, svg
from fitact.charts.picture import draw_chart
from fitact.data.record import Record
from fitact.files import atomic_write
from fitact.populations.finger import Finger
from fitact.scene.scene import Scene
from fitact.summary import versions
from fitact.units import format_engineering


class Provenance(NamedTuple):
    """Origin of a result."""

    command: str  # command line that repeats it
    scene: Mapping[str, Any]  # stated keys of the scene, SI; {} if none
    records: Mapping[str, str]  # SHA-256 of the data of each record, by name

    @classmethod
    def from_inputs(cls, command: str, scene: Scene | None, records: Sequence[Record | Finger] = ()) -> Self:
        """Make the provenance from the inputs of a command."""
        stated = {} if scene is None else scene.model_dump(mode="json", exclude_unset=True)
        return cls(command, stated, {os.path.basename(each.source): each.fingerprint for each in records})

    @property
    def scene_text(self) -> str:
        """Scene as text; "" if it states nothing."""
        return json.dumps(self.scene, indent=2, ensure_ascii=False) if self.scene else ""


class Answer(NamedTuple):
    """Tile with a title, a value and a note on its uncertainty."""

    title: str
    value: str
    note: str


class PageSummary(NamedTuple):
    """Top of every page."""

    title: str
    subject: str
    trusted: bool  # whether the result is reliable
    verdict: str  # one sentence; for an unreliable result, the reason
    findings: Mapping[str, str]  # sentences, by the question that they answer
    answers: Sequence[Answer]  # the main numbers
    warnings: Sequence[str]  # sentences on what may change the result
    has_reservation: bool = False  # whether a reliable result is limited, as the verdict states


def write_page(path: str | os.PathLike[str], template: str, **content: Any) -> None:
    """Render a template with `content`: mostly `frame` (a `PageSummary`), `origin` (a `Provenance`) and more.

    Raises:
        jinja2.UndefinedError: the template needs a value that is missing.
    """
    loader = jinja2.PackageLoader("fitact.report")
    environment = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined)
    environment.globals["engineering"] = format_engineering
    environment.filters["picture"] = lambda chart: image(lambda: draw_chart(chart))
    # trusted scripts of this package
    environment.globals["verbatim"] = lambda name: Markup(loader.get_source(environment, name)[0])
    page = environment.get_template(template).render(content, versions=versions())
    with atomic_write(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def image(draw: Callable[[], Figure]) -> str:
    """Draw a figure in the shared style, as the source of an image, so that its ids cannot clash with others."""
    with mpl.rc_context(STYLE):
        return "data:image/svg+xml;base64," + base64.b64encode(svg(draw()).encode()).decode()
