"""Simplifications of a scene: elements that may be neglected, the reduced scene, and the cost of a model."""

import dataclasses
import json
from collections.abc import Mapping
from typing import Any

from jax.typing import ArrayLike

from fitact.errors import InputError
from fitact.model.circuit import RC, FinalCircuit
from fitact.model.skin import Fractional, WithSkin
from fitact.scene.scene import Scene

# keys of a scene that each omission changes, and their new values (None removes a key)
_KEYS: dict[str, dict[tuple[str, str], Any]] = {
    "leak": {("device", "Ri"): None},
    "R_H": {("grounding", "R_H"): None},
    "grounding skin": {("grounding", "grounding_Rsc"): None, ("grounding", "grounding_Csc"): None},
    "Z": {("grounding", "Z"): 0.0, ("grounding", "Z_capacitance"): None},
    "Z capacitance": {("grounding", "Z_capacitance"): None},
    "series resistor": {("measurement", "series_resistor"): None},
    "gap": {**{("gap", key): None for key in ("resistance", "capacitance", "thickness")}, ("force", "model"): None},
    "probe": {("measurement", "probe_resistance"): None, ("measurement", "probe_capacitance"): None},
    "edges": {("drive", "waveform"): "square", ("drive", "rise_time"): None},
    "dispersion": {("skin", "level"): None, ("skin", "alpha"): None},
    "transient": {("drive", "steady_state"): True},
}
_PARAMETERS = {"resistance": "Rgap", "capacitance": "Cgap"}  # parameters whose name differs from their key
_RESISTANCES = ("R_H", "series resistor")  # resistances that limit the current at an edge
FLOAT32_SPEEDUP = 1.6  # measured by benchmarks/plan.py for many circuits in one program


@dataclasses.dataclass(frozen=True)
class _Costs:
    """Cost in nanoseconds per sample for many circuits in one compiled program; one exponential takes about 1 ns.

    The values were measured once by benchmarks/plan.py, so that a plan does not depend on the load of a machine.
    """

    lookup: float = 1.0  # locating a time in the drive
    square: float = 1.0  # this and the following per time constant, by drive
    trapezoid: float = 2.0
    triangle: float = 2.0
    sine: float = 4.0  # per tone
    measured: float = 25.0
    chirp: float = 15.0
    transient: float = 0.5  # additional cost per time constant, from rest
    burst: float = 1.0  # additional cost per time constant, for a burst
    harmonic: float = 10.0
    fractional_terms: int = 81  # number of time constants of a fractional skin


def applicable_omissions(scene: Scene) -> tuple[str, ...]:
    """Return the names of elements in the scene's model that might be neglected."""
    ground, drive = scene.grounding, scene.drive
    has = dict.fromkeys(scene.prior.specs(), 1.0) | {k: v for k, v in scene.nominal_values().items() if v is not None}
    present = {
        "leak": "Ri" in has,
        "R_H": "R_H" in has,
        "grounding skin": "grounding_Rsc" in has or "grounding_Csc" in has,
        "Z": ground.connection == "natural" and "Z" in has,
        "Z capacitance": "Z_capacitance" in has,
        "series resistor": "series_resistor" in has,
        "gap": "Cgap" in has,
        "probe": scene.measurement.probe_resistance is not None or scene.measurement.probe_capacitance is not None,
        "edges": drive.waveform == "trapezoid",
        "dispersion": scene.skin.level != "constant",
        "transient": not drive.steady_state and drive.waveform not in ("chirp", "measured"),
    }
    return tuple(name for name, there in present.items() if there)


def omitted_parameters(name: str) -> set[str]:
    """Return the circuit parameters that an omission removes."""
    others = "series_resistor", "alpha", "Ri"
    keys = {key for section, key in _KEYS[name] if section in ("grounding", "gap") or key in others}
    return {_PARAMETERS.get(key, key) for key in keys if key != "thickness"}


def reason_to_keep(scene: Scene, name: str) -> str:
    """Return why an element must be kept regardless of its effect, as a clause; "" if it may be neglected."""
    gone, beliefs = omitted_parameters(name), scene.prior.specs()
    if any(key in gone and belief.is_free for key, belief in beliefs.items()):
        return "it is a free parameter of [prior]"
    if any(belief.tied in gone and key not in gone for key, belief in beliefs.items()):
        return "another parameter is tied to it"
    if name in _RESISTANCES and "I" in scene.measurement.channels:
        return "without it, the recorded current is undefined at an edge"
    if name == "gap" and scene.force.model == "gap":
        return "the force acts across it"
    if name == "transient" and scene.drive.waveform == "burst":
        return "a burst has no steady state"
    return ""


def with_measured_drive(scene: Scene) -> Scene:
    """Return the scene with the measured drive."""
    if scene.skin.level != "constant":
        raise InputError(
            f"scene: [skin] level = '{scene.skin.level}' has no plan with a measured drive;"
            " name the waveform in [drive]"
        )
    content = json.loads(scene.to_json())
    kept = {key: value for key, value in content.pop("drive", {}).items() if key == "steady_state"}
    return Scene.from_dict(content | {"drive": {"waveform": "measured"} | kept})


def reduce_scene(scene: Scene, names: tuple[str, ...], *, prior: bool = True) -> Scene:
    """Return the scene without these elements and, with ``prior=False``, without its prior."""
    content = json.loads(scene.to_json())
    for name in names:
        changes = _KEYS[name]
        if name == "transient" and scene.drive.waveform == "burst":
            changes = {("drive", "waveform"): scene.drive.shape, ("drive", "shape"): None, ("drive", "cycles"): None}
        for (section, key), value in changes.items():
            part = content.setdefault(section, {})
            part.pop(key, None)
            if value is not None:
                part[key] = value
    beliefs = drop_parameters(content.pop("prior", {}), names)
    return Scene.from_dict(content | {"prior": beliefs} if prior and beliefs else content)


def drop_parameters(values: Mapping[str, Any], names: tuple[str, ...]) -> dict[str, Any]:
    """Return the values without the parameters that these omissions remove."""
    omitted = set().union(*(omitted_parameters(name) for name in names))
    return {name: value for name, value in values.items() if name not in omitted}


def evaluation_cost(scene: Scene, values: Mapping[str, ArrayLike] | None = None) -> float:
    """Return the cost of a sample of Vsc, in exponentials, for many circuits in one program.

    `values` holds the parameters that only the scene's prior states.
    """
    circuit, drive, costs = scene.make_circuit(values), scene.drive, _Costs()
    terms, harmonics, tones = count_time_constants(scene.make_rc_circuit(values)), 0, len(drive.frequencies or (1,))
    if isinstance(circuit, WithSkin):
        if drive.waveform in ("sine", "multitone"):
            terms, harmonics = 0, tones
        else:
            harmonics = circuit.skin.harmonic_count(drive.frequency)
            if isinstance(circuit.skin, Fractional):
                terms = costs.fractional_terms
    if drive.waveform == "multitone":
        each_term = tones * costs.sine
    else:
        each_term = getattr(costs, drive.shape if drive.waveform == "burst" else drive.waveform)
    if not drive.steady_state and drive.waveform not in ("chirp", "measured"):
        each_term += costs.burst if drive.waveform == "burst" else costs.transient
    return costs.lookup + terms * each_term + costs.harmonic * harmonics


def count_time_constants(circuit: RC) -> int:
    """Return the number of capacitors, without Ci if no resistance is in series with it."""
    if isinstance(circuit, FinalCircuit):
        return 1
    return len(circuit.elements()) + (circuit.resistance() is not None)
