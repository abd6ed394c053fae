"""The frame that pages of results share: what it is about, the verdict, the answers, and how to repeat it."""

import base64
import dataclasses
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


@dataclasses.dataclass(frozen=True)
class Provenance:
    """How a result came about.

    Attributes:
        command: that gives it.
        scene: what the scene states, SI; {}: nothing.
        records: SHA-256 of the numbers of each, by name.
    """

    command: str
    scene: Mapping[str, Any]
    records: Mapping[str, str]

    @classmethod
    def from_inputs(cls, command: str, scene: Scene | None, records: Sequence[Record | Finger] = ()) -> Self:
        """From what the command was given."""
        stated = {} if scene is None else scene.model_dump(mode="json", exclude_unset=True)
        return cls(command, stated, {os.path.basename(each.source): each.fingerprint for each in records})

    @property
    def scene_text(self) -> str:
        """The scene for people; "": it states nothing."""
        return json.dumps(self.scene, indent=2, ensure_ascii=False) if self.scene else ""


class Answer(NamedTuple):
    """A tile: a number that people came for, what it is, and how sure it is."""

    title: str
    value: str
    note: str


@dataclasses.dataclass(frozen=True)
class PageSummary:
    """The top of every page.

    Attributes:
        subject: what the page is about.
        trusted: whether nothing stands against the answer.
        verdict: one sentence; of an untrusted answer, what stands against it.
        findings: sentences, by what they answer.
        answers: the few numbers.
        has_reservation: whether a trusted answer is not the one that was hoped for, as the verdict says.
    """

    title: str
    subject: str
    trusted: bool
    verdict: str
    findings: Mapping[str, str]
    answers: Sequence[Answer]
    warnings: Sequence[str]
    has_reservation: bool = False


def write_page(path: str | os.PathLike[str], template: str, **content: Any) -> None:
    """Write what a template makes of `content`: mostly `frame` (a `PageSummary`), `origin` (a `Provenance`) and more.

    Raises:
        InputError: the place cannot be written.
        jinja2.UndefinedError: the template wants more than there is.
    """
    loader = jinja2.PackageLoader("fitact.report")
    environment = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined)
    environment.globals["engineering"] = format_engineering
    environment.filters["picture"] = lambda chart: image(lambda: draw_chart(chart))
    environment.globals["verbatim"] = lambda name: Markup(loader.get_source(environment, name)[0])  # scripts of ours
    page = environment.get_template(template).render(content, versions=versions())
    with atomic_write(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def image(draw: Callable[[], Figure]) -> str:
    """Draw a figure in the shared style, as the source of an image: it cannot clash with another's ids."""
    with mpl.rc_context(STYLE):
        return "data:image/svg+xml;base64," + base64.b64encode(svg(draw()).encode()).decode()
