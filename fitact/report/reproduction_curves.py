"""The curves of the paper's figures, as numbers in SI units."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fitact import paper
from fitact.model.circuit import Circuit, DirectGround, FinalCircuit, NaturalGround
from fitact.model.drive import Drive, Square
from fitact.model.response import response
from fitact.units import engineering

COLORS = ("#D55E00", "#009E73", "#CC79A7", "#8C564B", "#222222")  # in the order of the paper's figures
OURS, OTHERS = "#0072B2", ("#999999", "#555555")
KNEES = {"|H|": (40.0, 300.0), "phase": (90.0, 270.0)}  # Hz: the paper's, and where it calls the curve steady
_TIMES = 2001
_BEFORE_EDGE = 1e-9  # of a period

Numbers = Float[np.ndarray, " points"]


class Curve(NamedTuple):
    """Values over what they depend on."""

    at: Numbers
    values: Numbers


class Insulator(NamedTuple):
    """Mean force over one property of the insulator, its greatest at 1; `own`: the paper's panel."""

    title: str
    unit: str
    force: Curve
    own: tuple[float, float]


def grounding() -> dict[str, Circuit]:
    """Fig. 4."""
    direct = DirectGround(paper.RSC, paper.CSC, paper.CI, R_H=paper.R_H)
    return {"direct": direct, "natural": NaturalGround(paper.RSC, paper.CSC, paper.CI, paper.Z)}


def grounding_points(name: str, values: Sequence[float], unit: str) -> dict[str, Circuit]:
    """Figs. 5 and 6."""
    fixed: dict[str, Any] = {"grounding_Rsc": paper.RSC, "grounding_Csc": paper.CSC}
    return {
        f"{name.removeprefix('grounding_')}1 = {engineering(value, unit, 3)}": DirectGround(
            paper.RSC, paper.CSC, paper.CI, R_H=paper.R_H, **(fixed | {name: value})
        )
        for value in values
    }


def body() -> dict[str, Circuit]:
    """Fig. 10."""
    with_body = DirectGround(paper.RSC, paper.CSC, paper.CI, R_H=paper.R_H)
    return {"without R_H": FinalCircuit(paper.RSC, paper.CSC, paper.CI), "with R_H": with_body}


def in_time(circuit: Circuit, drive: Drive | None = None) -> Curve:
    """Vsc over two periods of the steady state of `drive` (the paper's square), both sides of each jump among them."""
    time = _two_periods()
    drive = drive or Square(peak_to_peak=paper.PEAK_TO_PEAK, frequency=paper.FREQUENCY)
    return Curve(time, np.asarray(response(circuit, drive, jnp.asarray(time))))


def waveforms() -> dict[str, tuple[Curve, Curve]]:
    """Fig. 15: V and Vsc of each drive."""
    time, circuit = _two_periods(), FinalCircuit(paper.RSC, paper.CSC, paper.CI)
    return {
        name: (Curve(time, np.asarray(drive.value(jnp.asarray(time)))), in_time(circuit, drive))
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
            "relative permittivity", "1", Curve(permittivities, over / over.max()),
            (paper.PERMITTIVITY, own / over.max()),
        ),
        Insulator("thickness", "m", Curve(thicknesses, under / under.max()), (paper.INSULATOR, own / under.max())),
    )  # fmt: skip


def frequencies(low: float, high: float) -> dict[str, tuple[Curve, Curve]]:
    """Figs. 13 and 14: amplitude and phase (degrees) between two frequencies (Hz), by Ci."""
    frequency = np.geomspace(low, high, 400)
    omega = jnp.asarray(2.0 * np.pi * frequency)
    found = {}
    for name, Ci in paper.INSULATORS.items():
        circuit = FinalCircuit(paper.RSC, paper.CSC, Ci)
        phase = np.degrees(np.asarray(circuit.phase(omega)))
        found[f"Ci = {name}"] = Curve(frequency, np.asarray(circuit.amplitude(omega))), Curve(frequency, phase)
    return found


def _two_periods() -> Numbers:
    period = 1.0 / paper.FREQUENCY
    edges = np.arange(4) * 0.5 * period
    inside = np.linspace(0.0, 2.0 * period, _TIMES)[:-1]
    return np.union1d(inside, np.append(edges, edges[1:] - _BEFORE_EDGE * period))
