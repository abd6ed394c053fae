"""The paper's figures in its own form, and its claims beside what they come to."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fitact import paper
from fitact.charts.interactive import Chart
from fitact.files import write_json
from fitact.model.circuit import Circuit
from fitact.report import reproduction_charts, reproduction_curves
from fitact.report.frame import image
from fitact.report.html import write_html
from fitact.report.reproduction_curves import COLORS, KNEES, OTHERS, OURS
from fitact.units import engineering

_MARKERS = ("o", "s", "^", "*", "P")


class _Shown(NamedTuple):
    title: str
    draw: Callable[[], Figure]
    chart: Callable[[], Chart]
    alt: str


def write_reproduction(directory: str | os.PathLike[str], claims: tuple[paper.Claim, ...]) -> Path:
    """Write reproduction.json and reproduction.html, with the figures, into `directory`; gives the page.

    Raises:
        InputError: the place cannot be written.
    """
    directory = Path(directory)
    page = directory / "reproduction.html"
    with jax.enable_x64(True):
        figures = [(each.title, each.chart(), image(each.draw), each.alt) for each in _FIGURES]
    write_json(directory / "reproduction.json", [claim.to_dict() for claim in claims])
    write_html(page, "reproduction.html", claims=claims, figures=figures, value=_value, counts=_counts(claims))
    return page


def _counts(claims: tuple[paper.Claim, ...]) -> dict[str, int]:
    return {verdict: sum(claim.verdict == verdict for claim in claims) for verdict in ("agrees", "differs")}


def _value(value: float | None, unit: str) -> str:
    if value is None:
        return "–"
    return f"{value:.4g}" if unit == "1" else engineering(value, unit)


def _curves(axes: Axes, circuits: dict[str, Circuit]) -> None:
    for (label, circuit), color, marker in zip(circuits.items(), COLORS, _MARKERS, strict=False):
        time, vsc = reproduction_curves.in_time(circuit)
        axes.plot(1e3 * time, vsc, color=color, marker=marker, markevery=171, ms=4, lw=1.2, label=label)
    axes.set_xlabel("time / ms")
    axes.set_ylabel("Vsc1 / V")
    axes.legend(fontsize=9)


def _in_time(circuits: dict[str, Circuit]) -> Figure:
    figure = Figure(figsize=(8.0, 3.6), layout="constrained")
    _curves(figure.subplots(), circuits)
    return figure


def _with_peak(circuits: dict[str, Circuit]) -> Figure:
    figure = Figure(figsize=(10.0, 3.8), layout="constrained")
    whole, part = figure.subplots(1, 2, width_ratios=[1.6, 1.0])
    _curves(whole, circuits)
    _curves(part, circuits)
    part.set_xlim(-0.05, 1.0)
    part.set_ylim(9.0, 17.0)
    part.get_legend().remove()
    part.set_title("the peak", fontsize=10)
    return figure


def _insulator() -> Figure:
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    for axes, each in zip(figure.subplots(1, 2), reproduction_curves.insulator(), strict=True):
        size, label = (1e-6, f"{each.title} / µm") if each.unit == "m" else (1.0, each.title)
        axes.plot(each.force.at / size, each.force.values, color=OURS)
        axes.plot([each.own[0] / size], [each.own[1]], "o", color=COLORS[0], label="the paper's panel")
        axes.set_xlabel(label)
        axes.set_ylabel("mean force, normalised")
        axes.legend(fontsize=9)
    return figure


def _frequencies(low: float, high: float) -> Figure:
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    panels = dict(zip(KNEES, figure.subplots(1, 2), strict=True))
    for (name, curves), color in zip(reproduction_curves.frequencies(low, high).items(), (OURS, *OTHERS), strict=True):
        for axes, curve in zip(panels.values(), curves, strict=True):
            axes.plot(curve.at, curve.values, color=color, label=name)
    for (label, axes), places in zip(panels.items(), KNEES.values(), strict=True):
        for place in places if high <= 1e3 else ():
            axes.axvline(place, color=COLORS[0], lw=1.0, ls="--")
        axes.set_xscale("log")
        axes.set_xlabel("frequency / Hz")
        axes.set_ylabel(f"{label} / degrees" if label == "phase" else label)
    panels["|H|"].legend(fontsize=9)
    return figure


def _waveforms() -> Figure:
    figure = Figure(figsize=(10.0, 4.6), layout="constrained")
    rows = figure.subplots(2, 3, sharex=True)
    for column, (name, (drive, vsc)) in enumerate(reproduction_curves.waveforms().items()):
        rows[0, column].plot(1e3 * drive.at, drive.values, color="#333333")
        rows[1, column].plot(1e3 * vsc.at, vsc.values, color=OURS)
        rows[0, column].set_title(name, fontsize=10)
        rows[1, column].set_xlabel("time / ms")
        rows[1, column].set_ylim(-2.8, 2.8)
    rows[0, 0].set_ylabel("V / V")
    rows[1, 0].set_ylabel("Vsc / V")
    return figure


def _of(
    title: str, draw: Callable[[dict[str, Circuit]], Figure], circuits: Callable[[], dict[str, Circuit]], alt: str
) -> _Shown:
    """Of Vsc of some circuits."""
    return _Shown(title, lambda: draw(circuits()), lambda: reproduction_charts.in_time(circuits()), alt)


def _between(title: str, low: float, high: float, alt: str) -> _Shown:
    """Of frequencies."""
    return _Shown(title, lambda: _frequencies(low, high), lambda: reproduction_charts.frequencies(low, high), alt)


_FIGURES = (
    _of("Fig. 4: direct and natural ground", _in_time, reproduction_curves.grounding,
        "Vsc over two periods: large under direct ground, a tenth of it under natural ground."),
    _of("Fig. 5: the grounding finger's Rsc", _with_peak,
        lambda: reproduction_curves.grounding_points("grounding_Rsc", paper.GROUNDING_RSC, "ohm"),
        "Five curves that differ in how they decay and hardly at the peak."),
    _of("Fig. 6: the grounding finger's Csc", _with_peak,
        lambda: reproduction_curves.grounding_points("grounding_Csc", paper.GROUNDING_CSC, "F"),
        "Five curves whose peaks rise from 13.7 V to 15.9 V with the capacitance."),
    _of("Fig. 10: with and without R_H", _in_time, reproduction_curves.body, "Two curves on top of each other."),
    _Shown("Fig. 12: the insulator", _insulator, reproduction_charts.insulator,
           "Mean force against permittivity, bending upwards, and against thickness, falling."),
    _between("Fig. 13: frequency characteristics", 0.1, 1e5, "A first-order high-pass."),
    _between("Fig. 14: 10 to 1000 Hz, the paper's knees and steady frequencies dashed", 10.0, 1e3,
             "Amplitude and phase of the high-pass for three values of Ci."),
    _Shown("Fig. 15: waveforms of 30 Vpp", _waveforms, reproduction_charts.waveforms,
           "Sine, triangle and square above, Vsc below: 1.5, 1.5 and 2.6 V from peak to peak."),
)  # fmt: skip
