"""What a scene names that may be left out of its model, what is then left of the scene, and what its model costs."""

import json
from collections.abc import Mapping
from typing import Any

from jax.typing import ArrayLike

from fitact.errors import InputError
from fitact.model.circuit import RC, FinalCircuit
from fitact.model.skin import Fractional, WithSkin
from fitact.scene.scene import Scene

# for each omission, the keys of a scene that change, and to what (None: they go)
_KEYS: dict[str, dict[tuple[str, str], Any]] = {
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
_PARAMETERS = {"resistance": "Rgap", "capacitance": "Cgap"}  # those that are not named as their key
_RESISTANCES = ("R_H", "series resistor")  # what limits the current at an edge

# Nanoseconds a sample, of many circuits side by side in one compiled program: one exponential takes about one.
# Measured by benchmarks/plan.py; docs/plan.md has the table.
_LOCATE = 1.0
_TERM = {"square": 1.0, "trapezoid": 2.0, "triangle": 2.0, "sine": 4.0, "measured": 25.0, "chirp": 15.0}
_TRANSIENT, _BURST = 0.5, 1.0  # more for each term, from rest
_HARMONIC = 10.0
_FRACTIONAL_TERMS = 81
SINGLE_SPEEDUP = 1.6  # of float32, where many circuits are computed side by side


def named(scene: Scene) -> tuple[str, ...]:
    """The names of what the scene's model has and might do without."""
    ground, drive = scene.grounding, scene.drive
    has = dict.fromkeys(scene.prior.beliefs(), 1.0) | {k: v for k, v in scene.nominal().items() if v is not None}
    present = {
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


def parameters(name: str) -> set[str]:
    """The circuit's parameters that go with an omission."""
    keys = {
        key for section, key in _KEYS[name] if section in ("grounding", "gap") or key in ("series_resistor", "alpha")
    }
    return {_PARAMETERS.get(key, key) for key in keys if key != "thickness"}


def required(scene: Scene, name: str) -> str:
    """Why it may not be left out whatever that changes, as a clause; "" if it may."""
    gone, beliefs = parameters(name), scene.prior.beliefs()
    if any(key in gone and belief.free for key, belief in beliefs.items()):
        return "the prior frees it"
    if any(belief.tied in gone and key not in gone for key, belief in beliefs.items()):
        return "another parameter is tied to it"
    if name in _RESISTANCES and "I" in scene.measurement.channels:
        return "the current that is recorded has no value at an edge without it"
    if name == "gap" and scene.force.model == "gap":
        return "the force acts across it"
    if name == "transient" and scene.drive.waveform == "burst":
        return "a burst has no steady state"
    return ""


def driven(scene: Scene) -> Scene:
    """The scene driven by what was recorded.

    Raises:
        InputError: its skin depends on the frequency.
    """
    if scene.skin.level != "constant":
        raise InputError(
            f"scene: [skin] level = '{scene.skin.level}' has no plan with a measured drive;"
            " name the waveform in [drive]"
        )
    content = json.loads(scene.to_json())
    stated = content.pop("drive", {})
    kept = {key: stated[key] for key in ("steady_state",) if key in stated}
    return Scene.from_dict(content | {"drive": {"waveform": "measured"} | kept})


def without(scene: Scene, names: tuple[str, ...], *, prior: bool = True) -> Scene:
    """The scene without these; with ``prior=False`` without its beliefs, too."""
    content = json.loads(scene.to_json())
    for name in names:
        for (section, key), value in _changes(scene, name).items():
            part = content.setdefault(section, {})
            part.pop(key, None)
            if value is not None:
                part[key] = value
    gone = set().union(*(parameters(name) for name in names))
    believed = content.pop("prior", {})
    if prior and believed:
        content["prior"] = {key: belief for key, belief in believed.items() if key not in gone}
    return Scene.from_dict(content)


def _changes(scene: Scene, name: str) -> dict[tuple[str, str], Any]:
    if name == "transient" and scene.drive.waveform == "burst":
        return {("drive", "waveform"): scene.drive.shape, ("drive", "shape"): None, ("drive", "cycles"): None}
    return _KEYS[name]


def cost(scene: Scene, values: Mapping[str, ArrayLike] | None = None) -> float:
    """What a sample of Vsc costs, in exponentials, where many circuits are computed side by side.

    Each time is looked up in the drive once; each time constant and each harmonic adds its share. The shares were
    measured once, so that a plan does not depend on what else a machine does; `benchmarks/plan.py` repeats it.
    `values` are of parameters that the scene has by its prior alone.
    """
    circuit, stated = scene.make_circuit(values), scene.drive
    terms, harmonics, tones = time_constants(scene.make_rc_circuit(values)), 0, len(stated.frequencies or (1,))
    if isinstance(circuit, WithSkin):
        if stated.waveform in ("sine", "multitone"):
            terms, harmonics = 0, tones
        else:
            harmonics = circuit.skin.count(stated.frequency)
            terms = _FRACTIONAL_TERMS if isinstance(circuit.skin, Fractional) else terms
    if stated.waveform == "multitone":
        of_term = tones * _TERM["sine"]
    else:
        of_term = _TERM[stated.shape if stated.waveform == "burst" else stated.waveform]
    if not stated.steady_state and stated.waveform not in ("chirp", "measured"):
        of_term += _BURST if stated.waveform == "burst" else _TRANSIENT
    return _LOCATE + terms * of_term + _HARMONIC * harmonics


def time_constants(circuit: RC) -> int:
    """How many a circuit has: one for each capacitor, but for Ci where nothing resistive is in series with it."""
    if isinstance(circuit, FinalCircuit):
        return 1
    return len(circuit.elements()) + (circuit.resistance() is not None)
