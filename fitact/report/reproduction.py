"""Figures of the reference paper, recomputed, and its claims compared with the computed values."""

import dataclasses
import functools
import os
from collections.abc import Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from fitact import paper
from fitact.charts.figure import DATA, MODEL, PRIOR
from fitact.charts.interactive import Axis, Chart, chart, line, log_axis_button, mark_position, plot, points
from fitact.compiled import double_precision
from fitact.files import write_json
from fitact.model.circuit import Circuit
from fitact.model.drive import Drive, Square
from fitact.model.response import response
from fitact.report.frame import write_page
from fitact.units import format_engineering

_COLORS = ("#D55E00", "#009E73", "#CC79A7", "#8C564B", "#222222")  # in the order of the figures in the reference paper
_CI_COLORS = (MODEL, PRIOR, "#555555")
_TIME = Axis.from_values("time", "s", 2.0 / paper.VALUES.frequency)
_FINAL = paper.VALUES.final_circuit()
_DIRECT = paper.VALUES.direct_ground()


def write_reproduction(directory: str | os.PathLike[str], claims: tuple[paper.Claim, ...]) -> Path:
    """Write reproduction.json and reproduction.html, with the figures, into `directory`, and return the page."""
    directory = Path(directory)
    page = directory / "reproduction.html"
    with double_precision():
        figures = [(title, make_chart(), alt) for title, make_chart, alt in _FIGURES]
    counts = {verdict: sum(claim.verdict == verdict for claim in claims) for verdict in ("agrees", "differs")}
    write_json(directory / "reproduction.json", [claim.to_dict() for claim in claims])
    write_page(page, "reproduction.html", claims=claims, figures=figures, value=_format_value, counts=counts)
    return page


def _format_value(value: float | None, unit: str) -> str:
    if value is None:
        return "–"
    return f"{value:.4g}" if unit == "1" else format_engineering(value, unit)


def _two_periods() -> np.ndarray:
    """Return times (s) over two periods, including both sides of each jump of a square."""
    period = 1.0 / paper.VALUES.frequency
    edges = np.arange(4) * 0.5 * period
    inside = np.linspace(0.0, 2.0 * period, 2001)[:-1]
    return np.union1d(inside, np.append(edges, edges[1:] - 1e-9 * period))  # just before each jump


def _compute_vsc(circuit: Circuit, drive: Drive) -> np.ndarray:
    return np.asarray(response(circuit, drive, jnp.asarray(_two_periods())))


def _vsc_chart(circuits: dict[str, Circuit], shows_peak: bool = False) -> Chart:
    y, drive = Axis("Vsc1", "V"), Square(peak_to_peak=paper.VALUES.peak_to_peak, frequency=paper.VALUES.frequency)
    traces = [
        line(_TIME, y, _two_periods(), _compute_vsc(circuit, drive), name, color)
        for (name, circuit), color in zip(circuits.items(), _COLORS, strict=False)
    ]
    plots = [plot(_TIME, (y, traces), unified_hover=True)]
    if shows_peak:
        near = dataclasses.replace(_TIME, limits=(-0.05e-3, 1e-3)), dataclasses.replace(y, limits=(9.0, 17.0))
        plots.append(plot(near[0], (near[1], traces), title="the peak", legend=False, unified_hover=True))
    return chart(*plots)


def _grounding_chart(name: str, values: Sequence[float], unit: str) -> Chart:
    equal = {"grounding_Rsc": paper.VALUES.Rsc, "grounding_Csc": paper.VALUES.Csc}
    symbol = f"{name.removeprefix('grounding_')}1"
    circuits: dict[str, Circuit] = {
        f"{symbol} = {format_engineering(value, unit, 3)}": paper.VALUES.direct_ground(**equal | {name: value})
        for value in values
    }
    return _vsc_chart(circuits, shows_peak=True)


def _insulator_chart() -> Chart:
    """Return a chart of the mean force, scaled to a maximum of 1, over each property of the insulator."""
    permittivities, thicknesses = np.linspace(1.0, 10.0, 37), 1e-6 * np.geomspace(0.01, 10.0, 46)
    permittivity, thickness = paper.VALUES.insulator_permittivity, paper.VALUES.insulator_thickness
    nominal, y, plots = paper.force_over(permittivity, thickness), Axis("mean force, normalised"), []
    for title, unit, here, values, forces in (
        ("relative permittivity", "1", permittivity, permittivities,
         [paper.force_over(e, thickness) for e in permittivities]),
        ("thickness", "m", thickness, thicknesses, [paper.force_over(permittivity, t) for t in thicknesses]),
    ):  # fmt: skip
        x = Axis.from_values(title, unit, here)
        curve = line(x, y, values, np.array(forces) / max(forces), "mean force", MODEL)
        panel = points(x, y, [here], [nominal / max(forces)], "the paper's panel", _COLORS[0], size=9.0)
        plots.append(plot(x, (y, [curve, panel]), unified_hover=True))
    return chart(*plots, controls=[log_axis_button(plots), log_axis_button(plots, "y", "logarithmic force")])


def _frequencies_chart(low: float, high: float, marks_corners: bool) -> Chart:
    """Return a chart of amplitude and phase between two frequencies (Hz) for each Ci."""
    frequency = np.geomspace(low, high, 400)
    omega, x = jnp.asarray(2.0 * np.pi * frequency), Axis("frequency", "Hz", log=True, has_tick_prefixes=True)
    circuits = {f"Ci = {name}": paper.VALUES.final_circuit(Ci) for name, Ci in paper.INSULATORS.items()}
    plots = []
    for y, corners, evaluate in (
        (Axis("|H|"), (40.0, 300.0), lambda circuit: circuit.amplitude(omega)),
        (Axis("phase", "degrees"), (90.0, 270.0), lambda circuit: np.degrees(circuit.phase(omega))),
    ):  # Hz; corner and steady frequencies stated in the paper
        traces = [
            line(x, y, frequency, evaluate(circuit), name, color)
            for (name, circuit), color in zip(circuits.items(), _CI_COLORS, strict=True)
        ]
        drawn = plot(x, (y, traces), unified_hover=True)
        for corner in corners if marks_corners else ():
            drawn = mark_position(drawn, x, corner, _COLORS[0])
        plots.append(drawn)
    switch = log_axis_button(plots, label="logarithmic frequency")
    return chart(*plots, controls=[switch, log_axis_button(plots[:1], "y", "logarithmic |H|")])


def _waveforms_chart() -> Chart:
    above, below, time = Axis("V", "V"), Axis("Vsc", "V", limits=(-2.8, 2.8)), _two_periods()
    plots = []
    for name, drive in paper.waveforms(30.0).items():
        voltage = line(_TIME, above, time, drive.value(jnp.asarray(time)), "V", DATA)
        vsc = line(_TIME, below, time, _compute_vsc(_FINAL, drive), "Vsc", MODEL)
        rows = (above, [voltage]), (below, [vsc])
        plots.append(plot(_TIME, *rows, heights=(1.0, 1.0), title=name, size=420, legend=False, unified_hover=True))
    return chart(*plots)


_NATURAL = paper.VALUES.natural_ground()
_FIGURES = (
    ("Fig. 4: direct and natural ground", lambda: _vsc_chart({"direct": _DIRECT, "natural": _NATURAL}),
     "Vsc over two periods: large for direct ground, a tenth as large for natural ground."),
    ("Fig. 5: the grounding finger's Rsc", lambda: _grounding_chart("grounding_Rsc", paper.VALUES.grounding_Rsc, "ohm"),
     "Five curves with different decays and almost equal peaks."),
    ("Fig. 6: the grounding finger's Csc", lambda: _grounding_chart("grounding_Csc", paper.VALUES.grounding_Csc, "F"),
     "Five curves whose peaks rise from 13.7 V to 15.9 V with the capacitance."),
    ("Fig. 10: with and without R_H", lambda: _vsc_chart({"without R_H": _FINAL, "with R_H": _DIRECT}),
     "Two curves that coincide."),
    ("Fig. 12: the insulator", _insulator_chart,
     "Mean force against permittivity, bending upwards, and against thickness, falling."),
    ("Fig. 13: frequency characteristics", functools.partial(_frequencies_chart, 0.1, 1e5, False),
     "A first-order high-pass."),
    ("Fig. 14: 10 to 1000 Hz, with the paper's corner and steady frequencies dashed",
     functools.partial(_frequencies_chart, 10.0, 1e3, True),
     "Amplitude and phase of the high-pass for three values of Ci."),
    ("Fig. 15: waveforms of 30 Vpp", _waveforms_chart,
     "Sine, triangle and square above, Vsc below: 1.5, 1.5 and 2.6 V from peak to peak."),
)  # fmt: skip
