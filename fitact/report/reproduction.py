"""The paper's figures in its own form, and its claims beside what they come to."""

import os
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fitact import paper
from fitact.files import replacing, write_json
from fitact.model.circuit import Circuit, DirectGround, FinalCircuit, NaturalGround
from fitact.model.drive import Drive, Square
from fitact.model.response import response
from fitact.report import plots
from fitact.report.page import render
from fitact.units import engineering

_CI = paper.INSULATORS[paper.TEXT_CI]
_COLORS = ("#D55E00", "#009E73", "#CC79A7", "#8C564B", "#222222")  # in the order of the paper's figures
_MARKERS = ("o", "s", "^", "*", "P")
_TIMES = 2001
_BEFORE_EDGE = 1e-9  # of a period


def write_reproduction(directory: str | os.PathLike[str], claims: tuple[paper.Claim, ...]) -> Path:
    """Write reproduction.json and reproduction.html, with the figures, into `directory`; gives the page.

    Raises:
        InputError: the place cannot be written.
    """
    directory = Path(directory)
    with mpl.rc_context(plots.style()), jax.enable_x64(True):
        figures = [(title, plots.source(plots.svg(draw())), alt) for title, draw, alt in _FIGURES]
    page = render("reproduction.html", claims=claims, figures=figures, value=_value, counts=_counts(claims))
    write_json(directory / "reproduction.json", [claim.to_dict() for claim in claims])
    with replacing(directory / "reproduction.html") as temporary:
        temporary.write_text(page, encoding="utf-8")
    return directory / "reproduction.html"


def _counts(claims: tuple[paper.Claim, ...]) -> dict[str, int]:
    return {verdict: sum(claim.verdict == verdict for claim in claims) for verdict in ("agrees", "differs")}


def _value(value: float | None, unit: str) -> str:
    if value is None:
        return "–"
    return f"{value:.4g}" if unit == "1" else engineering(value, unit)


def _square() -> Square:
    return Square(peak_to_peak=paper.PEAK_TO_PEAK, frequency=paper.FREQUENCY)


def _in_time(circuit: Circuit, drive: Drive) -> tuple[Float[np.ndarray, " times"], Float[np.ndarray, " times"]]:
    """Two periods of the steady state (ms, V), both sides of each jump among them."""
    period = 1.0 / paper.FREQUENCY
    edges = np.arange(4) * 0.5 * period
    inside = np.linspace(0.0, 2.0 * period, _TIMES)[:-1]
    time = np.union1d(inside, np.append(edges, edges[1:] - _BEFORE_EDGE * period))
    return 1e3 * time, np.asarray(response(circuit, drive, jnp.asarray(time)))


def _curves(axes: Axes, circuits: dict[str, Circuit]) -> None:
    for (label, circuit), color, marker in zip(circuits.items(), _COLORS, _MARKERS, strict=False):
        axes.plot(*_in_time(circuit, _square()), color=color, marker=marker, markevery=171, ms=4, lw=1.2, label=label)
    axes.set_xlabel("time / ms")
    axes.set_ylabel("Vsc1 / V")
    axes.legend(fontsize=9)


def _grounding() -> Figure:
    figure = Figure(figsize=(8.0, 3.6), layout="constrained")
    direct = DirectGround(paper.RSC, paper.CSC, _CI, R_H=paper.R_H)
    _curves(figure.subplots(), {"direct": direct, "natural": NaturalGround(paper.RSC, paper.CSC, _CI, paper.Z)})
    return figure


def _grounding_points(name: str, values: tuple[float, ...], unit: str) -> Figure:
    figure = Figure(figsize=(10.0, 3.8), layout="constrained")
    whole, part = figure.subplots(1, 2, width_ratios=[1.6, 1.0])
    fixed: dict[str, Any] = {"grounding_Rsc": paper.RSC, "grounding_Csc": paper.CSC}
    circuits: dict[str, Circuit] = {
        f"{name.removeprefix('grounding_')}1 = {engineering(value, unit, 3)}": DirectGround(
            paper.RSC, paper.CSC, _CI, R_H=paper.R_H, **(fixed | {name: value})
        )
        for value in values
    }
    _curves(whole, circuits)
    _curves(part, circuits)
    part.set_xlim(-0.05, 1.0)
    part.set_ylim(9.0, 17.0)
    part.get_legend().remove()
    part.set_title("the peak", fontsize=10)
    return figure


def _body() -> Figure:
    figure = Figure(figsize=(8.0, 3.6), layout="constrained")
    with_body = DirectGround(paper.RSC, paper.CSC, _CI, R_H=paper.R_H)
    _curves(figure.subplots(), {"without R_H": FinalCircuit(paper.RSC, paper.CSC, _CI), "with R_H": with_body})
    return figure


def _insulator() -> Figure:
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    permittivities, thicknesses = np.linspace(1.0, 10.0, 37), 1e-6 * np.geomspace(0.01, 10.0, 46)
    own = paper.force_over(paper.PERMITTIVITY, paper.INSULATOR)
    for axes, x, forces, at, label in (
        (left, permittivities, [paper.force_over(e, paper.INSULATOR) for e in permittivities], paper.PERMITTIVITY,
         "relative permittivity"),
        (right, 1e6 * thicknesses, [paper.force_over(paper.PERMITTIVITY, t) for t in thicknesses],
         1e6 * paper.INSULATOR, "thickness / µm"),
    ):  # fmt: skip
        top = max(forces)
        axes.plot(x, np.array(forces) / top, color="#0072B2")
        axes.plot([at], [own / top], "o", color=_COLORS[0], label="the paper's panel")
        axes.set_xlabel(label)
        axes.set_ylabel("mean force, normalised")
        axes.legend(fontsize=9)
    return figure


def _frequencies(low: float, high: float) -> Figure:
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    amplitude, phase = figure.subplots(1, 2)
    frequency = np.geomspace(low, high, 400)
    for (name, Ci), color in zip(paper.INSULATORS.items(), ("#0072B2", "#999999", "#555555"), strict=True):
        circuit = FinalCircuit(paper.RSC, paper.CSC, Ci)
        omega = jnp.asarray(2.0 * np.pi * frequency)
        amplitude.plot(frequency, np.asarray(circuit.amplitude(omega)), color=color, label=f"Ci = {name}")
        phase.plot(frequency, np.degrees(np.asarray(circuit.phase(omega))), color=color)
    marks = {amplitude: (40.0, 300.0), phase: (90.0, 270.0)} if high <= 1e3 else {}
    for axes, places in marks.items():
        for place in places:
            axes.axvline(place, color=_COLORS[0], lw=1.0, ls="--")
    for axes, label in ((amplitude, "|H|"), (phase, "phase / degrees")):
        axes.set_xscale("log")
        axes.set_xlabel("frequency / Hz")
        axes.set_ylabel(label)
    amplitude.legend(fontsize=9)
    return figure


def _waveforms() -> Figure:
    figure = Figure(figsize=(10.0, 4.6), layout="constrained")
    rows = figure.subplots(2, 3, sharex=True)
    circuit = FinalCircuit(paper.RSC, paper.CSC, _CI)
    for column, (name, drive) in enumerate(paper.waveforms(30.0).items()):
        time, vsc = _in_time(circuit, drive)
        rows[0, column].plot(time, np.asarray(drive.value(jnp.asarray(1e-3 * time))), color="#333333")
        rows[1, column].plot(time, vsc, color="#0072B2")
        rows[0, column].set_title(name, fontsize=10)
        rows[1, column].set_xlabel("time / ms")
        rows[1, column].set_ylim(-2.8, 2.8)
    rows[0, 0].set_ylabel("V / V")
    rows[1, 0].set_ylabel("Vsc / V")
    return figure


_FIGURES = (
    ("Fig. 4: direct and natural ground", _grounding,
     "Vsc over two periods: large under direct ground, a tenth of it under natural ground."),
    ("Fig. 5: the grounding finger's Rsc", lambda: _grounding_points("grounding_Rsc", paper.GROUNDING_RSC, "ohm"),
     "Five curves that differ in how they decay and hardly at the peak."),
    ("Fig. 6: the grounding finger's Csc", lambda: _grounding_points("grounding_Csc", paper.GROUNDING_CSC, "F"),
     "Five curves whose peaks rise from 13.7 V to 15.9 V with the capacitance."),
    ("Fig. 10: with and without R_H", _body, "Two curves on top of each other."),
    ("Fig. 12: the insulator", _insulator,
     "Mean force against permittivity, bending upwards, and against thickness, falling."),
    ("Fig. 13: frequency characteristics", lambda: _frequencies(0.1, 1e5), "A first-order high-pass."),
    ("Fig. 14: 10 to 1000 Hz, the paper's knees and steady frequencies dashed", lambda: _frequencies(10.0, 1e3),
     "Amplitude and phase of the high-pass for three values of Ci."),
    ("Fig. 15: waveforms of 30 Vpp", _waveforms,
     "Sine, triangle and square above, Vsc below: 1.5, 1.5 and 2.6 V from peak to peak."),
)  # fmt: skip
