"""The curves of the paper's figures, as numbers in SI units."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fitact import paper
from fitact.model.circuit import Circuit, DirectGround, FinalCircuit, NaturalGround
from fitact.model.drive import Drive, Square
from fitact.model.response import response
from fitact.units import format_engineering

CORNER_FREQUENCIES = {
    "|H|": (40.0, 300.0),
    "phase": (90.0, 270.0),
}  # Hz: the paper's, and where it calls the curve steady

Numbers = Float[np.ndarray, " points"]


class PaperCurve(NamedTuple):
    """Values over what they depend on."""

    x: Numbers
    values: Numbers


class Insulator(NamedTuple):
    """Mean force over one property of the insulator, its greatest at 1, and that of the paper's panel."""

    title: str
    unit: str
    force: PaperCurve
    panel_point: tuple[float, float]


def grounding() -> dict[str, Circuit]:
    """Fig. 4."""
    direct = DirectGround(paper.RSC, paper.CSC, paper.CI, R_H=paper.R_H)
    return {"direct": direct, "natural": NaturalGround(paper.RSC, paper.CSC, paper.CI, paper.Z)}


def grounding_points(name: str, values: Sequence[float], unit: str) -> dict[str, Circuit]:
    """Figs. 5 and 6."""
    fixed: dict[str, Any] = {"grounding_Rsc": paper.RSC, "grounding_Csc": paper.CSC}
    return {
        f"{name.removeprefix('grounding_')}1 = {format_engineering(value, unit, 3)}": DirectGround(
            paper.RSC, paper.CSC, paper.CI, R_H=paper.R_H, **(fixed | {name: value})
        )
        for value in values
    }


def body() -> dict[str, Circuit]:
    """Fig. 10."""
    with_body = DirectGround(paper.RSC, paper.CSC, paper.CI, R_H=paper.R_H)
    return {"without R_H": FinalCircuit(paper.RSC, paper.CSC, paper.CI), "with R_H": with_body}


def vsc_curve(circuit: Circuit, drive: Drive | None = None) -> PaperCurve:
    """Vsc over two periods of the steady state of `drive` (the paper's square), both sides of each jump among them."""
    time = _two_periods()
    drive = drive or Square(peak_to_peak=paper.PEAK_TO_PEAK, frequency=paper.FREQUENCY)
    return PaperCurve(time, np.asarray(response(circuit, drive, jnp.asarray(time))))


def vsc_curves(circuits: Mapping[str, Circuit]) -> dict[str, PaperCurve]:
    """Figs. 4, 5, 6 and 10: Vsc of some circuits."""
    return {name: vsc_curve(circuit) for name, circuit in circuits.items()}


def waveforms() -> dict[str, tuple[PaperCurve, PaperCurve]]:
    """Fig. 15: V and Vsc of each drive."""
    time, circuit = _two_periods(), FinalCircuit(paper.RSC, paper.CSC, paper.CI)
    return {
        name: (PaperCurve(time, np.asarray(drive.value(jnp.asarray(time)))), vsc_curve(circuit, drive))
        for name, drive in paper.waveforms(30.0).items()
    }


def insulator() -> tuple[Insulator, Insulator]:
    """Fig. 12."""
    permittivities, thicknesses = np.linspace(1.0, 10.0, 37), 1e-6 * np.geomspace(0.01, 10.0, 46)
    own = paper.force_over(paper.PERMITTIVITY, paper.INSULATOR)
    over = np.array([paper.force_over(e, paper.INSULATOR) for e in permittivities])
    under = np.array([paper.force_over(paper.PERMITTIVITY, t) for t in thicknesses])
    return (
        Insulator(
            "relative permittivity", "1", PaperCurve(permittivities, over / over.max()),
            (paper.PERMITTIVITY, own / over.max()),
        ),
        Insulator("thickness", "m", PaperCurve(thicknesses, under / under.max()), (paper.INSULATOR, own / under.max())),
    )  # fmt: skip


def frequencies(low: float, high: float) -> dict[str, tuple[PaperCurve, PaperCurve]]:
    """Figs. 13 and 14: amplitude and phase (degrees) between two frequencies (Hz), by Ci."""
    frequency = np.geomspace(low, high, 400)
    omega = jnp.asarray(2.0 * np.pi * frequency)
    curves = {}
    for name, Ci in paper.INSULATORS.items():
        circuit = FinalCircuit(paper.RSC, paper.CSC, Ci)
        amplitude, phase = np.asarray(circuit.amplitude(omega)), np.degrees(np.asarray(circuit.phase(omega)))
        curves[f"Ci = {name}"] = PaperCurve(frequency, amplitude), PaperCurve(frequency, phase)
    return curves


def _two_periods() -> Numbers:
    period = 1.0 / paper.FREQUENCY
    edges = np.arange(4) * 0.5 * period
    inside = np.linspace(0.0, 2.0 * period, 2001)[:-1]
    return np.union1d(inside, np.append(edges, edges[1:] - 1e-9 * period))  # just before each jump
