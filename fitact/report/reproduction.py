"""The paper's figures in its own form, and its claims beside what they come to."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fitact import paper
from fitact.charts.figure import DATA, MODEL, PRIOR
from fitact.charts.interactive import Axis, Chart, Plot, chart, line, log_axis_button, mark_position, plot, points
from fitact.files import write_json
from fitact.model.circuit import Circuit
from fitact.report import reproduction_curves
from fitact.report.frame import image, write_html
from fitact.report.reproduction_curves import CORNER_FREQUENCIES, Insulator, PaperCurve
from fitact.units import format_engineering

_COLORS = ("#D55E00", "#009E73", "#CC79A7", "#8C564B", "#222222")  # in the order of the paper's figures
_CI_COLORS = (MODEL, PRIOR, "#555555")
_MARKERS = ("o", "s", "^", "*", "P")
_TIME = Axis.from_values("time", "s", 2.0 / paper.FREQUENCY)


class _FigureSpec(NamedTuple):
    """A figure of the paper: what makes its curves, and what draws these on paper and on screen."""

    title: str
    curves: Callable[[], Any]
    draw: Callable[[Any], Figure]
    chart: Callable[[Any], Chart]
    alt: str

    def drawings(self) -> tuple[str, Chart, str, str]:
        """Return the title, the chart, the picture and its description."""
        curves = self.curves()
        return self.title, self.chart(curves), image(lambda: self.draw(curves)), self.alt


def write_reproduction(directory: str | os.PathLike[str], claims: tuple[paper.Claim, ...]) -> Path:
    """Write reproduction.json and reproduction.html, with the figures, into `directory`; gives the page.

    Raises:
        InputError: the place cannot be written.
    """
    directory = Path(directory)
    page = directory / "reproduction.html"
    with jax.enable_x64(True):
        figures = [spec.drawings() for spec in _FIGURES]
    write_json(directory / "reproduction.json", [claim.to_dict() for claim in claims])
    write_html(page, "reproduction.html", claims=claims, figures=figures, value=_value, counts=_counts(claims))
    return page


def _counts(claims: tuple[paper.Claim, ...]) -> dict[str, int]:
    return {verdict: sum(claim.verdict == verdict for claim in claims) for verdict in ("agrees", "differs")}


def _value(value: float | None, unit: str) -> str:
    if value is None:
        return "–"
    return f"{value:.4g}" if unit == "1" else format_engineering(value, unit)


def _draw_curves(axes: Axes, curves: dict[str, PaperCurve]) -> None:
    for (label, (time, vsc)), color, marker in zip(curves.items(), _COLORS, _MARKERS, strict=False):
        axes.plot(1e3 * time, vsc, color=color, marker=marker, markevery=171, ms=4, lw=1.2, label=label)
    axes.set_xlabel("time / ms")
    axes.set_ylabel("Vsc1 / V")
    axes.legend(fontsize=9)


def _time_figure(curves: dict[str, PaperCurve]) -> Figure:
    figure = Figure(figsize=(8.0, 3.6), layout="constrained")
    _draw_curves(figure.subplots(), curves)
    return figure


def _peak_figure(curves: dict[str, PaperCurve]) -> Figure:
    figure = Figure(figsize=(10.0, 3.8), layout="constrained")
    whole, part = figure.subplots(1, 2, width_ratios=[1.6, 1.0])
    _draw_curves(whole, curves)
    _draw_curves(part, curves)
    part.set_xlim(-0.05, 1.0)
    part.set_ylim(9.0, 17.0)
    part.get_legend().remove()
    part.set_title("the peak", fontsize=10)
    return figure


def _insulator_figure(properties: tuple[Insulator, Insulator]) -> Figure:
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    for axes, each in zip(figure.subplots(1, 2), properties, strict=True):
        size, label = (1e-6, f"{each.title} / µm") if each.unit == "m" else (1.0, each.title)
        axes.plot(each.force.x / size, each.force.values, color=MODEL)
        axes.plot([each.panel_point[0] / size], [each.panel_point[1]], "o", color=_COLORS[0], label="the paper's panel")
        axes.set_xlabel(label)
        axes.set_ylabel("mean force, normalised")
        axes.legend(fontsize=9)
    return figure


def _frequencies_figure(curves: dict[str, tuple[PaperCurve, PaperCurve]], marks_corners: bool) -> Figure:
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    panels = dict(zip(CORNER_FREQUENCIES, figure.subplots(1, 2), strict=True))
    for (name, both), color in zip(curves.items(), _CI_COLORS, strict=True):
        for axes, curve in zip(panels.values(), both, strict=True):
            axes.plot(curve.x, curve.values, color=color, label=name)
    for (label, axes), places in zip(panels.items(), CORNER_FREQUENCIES.values(), strict=True):
        for place in places if marks_corners else ():
            axes.axvline(place, color=_COLORS[0], lw=1.0, ls="--")
        axes.set_xscale("log")
        axes.set_xlabel("frequency / Hz")
        axes.set_ylabel(f"{label} / degrees" if label == "phase" else label)
    panels["|H|"].legend(fontsize=9)
    return figure


def _waveforms_figure(waveforms: dict[str, tuple[PaperCurve, PaperCurve]]) -> Figure:
    figure = Figure(figsize=(10.0, 4.6), layout="constrained")
    rows = figure.subplots(2, 3, sharex=True)
    for column, (name, (drive, vsc)) in enumerate(waveforms.items()):
        rows[0, column].plot(1e3 * drive.x, drive.values, color=DATA)
        rows[1, column].plot(1e3 * vsc.x, vsc.values, color=MODEL)
        rows[0, column].set_title(name, fontsize=10)
        rows[1, column].set_xlabel("time / ms")
        rows[1, column].set_ylim(-2.8, 2.8)
    rows[0, 0].set_ylabel("V / V")
    rows[1, 0].set_ylabel("Vsc / V")
    return figure


def _vsc_chart(curves: dict[str, PaperCurve]) -> Chart:
    y = Axis("Vsc1", "V")
    traces = [
        line(_TIME, y, *curve, name, color) for (name, curve), color in zip(curves.items(), _COLORS, strict=False)
    ]
    return chart(plot(_TIME, (y, traces), unified_hover=True))


def _insulator_chart(properties: tuple[Insulator, Insulator]) -> Chart:
    plots = []
    for each in properties:
        x, y = Axis.from_values(each.title, each.unit, each.panel_point[0]), Axis("mean force, normalised")
        own = points(x, y, [each.panel_point[0]], [each.panel_point[1]], "the paper's panel", _COLORS[0], size=9.0)
        plots.append(plot(x, (y, [line(x, y, *each.force, "mean force", MODEL), own]), unified_hover=True))
    return chart(*plots, controls=[log_axis_button(plots), log_axis_button(plots, "y", "logarithmic force")])


def _frequencies_chart(curves: dict[str, tuple[PaperCurve, PaperCurve]], marks_corners: bool) -> Chart:
    x = Axis("frequency", "Hz", log=True, has_tick_prefixes=True)
    amplitude, phase = Axis("|H|"), Axis("phase", "degrees")
    plots: list[Plot] = []
    for i, (y, knees) in enumerate(zip((amplitude, phase), CORNER_FREQUENCIES.values(), strict=True)):
        traces = [
            line(x, y, *both[i], name, color) for (name, both), color in zip(curves.items(), _CI_COLORS, strict=True)
        ]
        drawn = plot(x, (y, traces), unified_hover=True)
        for knee in knees if marks_corners else ():
            drawn = mark_position(drawn, x, knee, _COLORS[0])
        plots.append(drawn)
    controls = [
        log_axis_button(plots, label="logarithmic frequency"),
        log_axis_button(plots[:1], "y", "logarithmic |H|"),
    ]
    return chart(*plots, controls=controls)


def _waveforms_chart(waveforms: dict[str, tuple[PaperCurve, PaperCurve]]) -> Chart:
    above, below = Axis("V", "V"), Axis("Vsc", "V", limits=(-2.8, 2.8))
    return chart(
        *(
            plot(
                _TIME,
                (above, [line(_TIME, above, *drive, "V", DATA)]),
                (below, [line(_TIME, below, *vsc, "Vsc", MODEL)]),
                heights=(1.0, 1.0), title=name, size=420, legend=False, unified_hover=True,
            )
            for name, (drive, vsc) in waveforms.items()
        )
    )  # fmt: skip


def _circuits_spec(
    title: str, draw: Callable[[dict[str, PaperCurve]], Figure], circuits: Callable[[], dict[str, Circuit]], alt: str
) -> _FigureSpec:
    return _FigureSpec(title, lambda: reproduction_curves.vsc_curves(circuits()), draw, _vsc_chart, alt)


def _frequencies_spec(title: str, low: float, high: float, marks_corners: bool, alt: str) -> _FigureSpec:
    return _FigureSpec(
        title,
        lambda: reproduction_curves.frequencies(low, high),
        lambda curves: _frequencies_figure(curves, marks_corners),
        lambda curves: _frequencies_chart(curves, marks_corners),
        alt,
    )


_FIGURES = (
    _circuits_spec("Fig. 4: direct and natural ground", _time_figure, reproduction_curves.grounding,
        "Vsc over two periods: large under direct ground, a tenth of it under natural ground."),
    _circuits_spec("Fig. 5: the grounding finger's Rsc", _peak_figure,
        lambda: reproduction_curves.grounding_points("grounding_Rsc", paper.GROUNDING_RSC, "ohm"),
        "Five curves that differ in how they decay and hardly at the peak."),
    _circuits_spec("Fig. 6: the grounding finger's Csc", _peak_figure,
        lambda: reproduction_curves.grounding_points("grounding_Csc", paper.GROUNDING_CSC, "F"),
        "Five curves whose peaks rise from 13.7 V to 15.9 V with the capacitance."),
    _circuits_spec("Fig. 10: with and without R_H", _time_figure, reproduction_curves.body,
        "Two curves on top of each other."),
    _FigureSpec("Fig. 12: the insulator", reproduction_curves.insulator, _insulator_figure, _insulator_chart,
           "Mean force against permittivity, bending upwards, and against thickness, falling."),
    _frequencies_spec("Fig. 13: frequency characteristics", 0.1, 1e5, False, "A first-order high-pass."),
    _frequencies_spec("Fig. 14: 10 to 1000 Hz, the paper's knees and steady frequencies dashed", 10.0, 1e3, True,
             "Amplitude and phase of the high-pass for three values of Ci."),
    _FigureSpec("Fig. 15: waveforms of 30 Vpp", reproduction_curves.waveforms, _waveforms_figure, _waveforms_chart,
           "Sine, triangle and square above, Vsc below: 1.5, 1.5 and 2.6 V from peak to peak."),
)  # fmt: skip
