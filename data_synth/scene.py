"""Scene files as in docs/scene.md: the keys that determine a record, with their defaults."""

import math
from collections.abc import Mapping
from typing import Any

from data_synth.errors import RecipeError
from data_synth.keys import Choice, IgnoredKey, ListKey, Quantity, Table, WholeNumber, validate_sections
from data_synth.network import EPS0

Scene = dict[str, dict[str, Any]]

_ANY = -math.inf
_PRIORS = """Rsc Csc Ci R_H grounding_Rsc grounding_Csc Z Z_capacitance series_resistor Ri Rgap Cgap alpha sigma
sigma_I sigma_Ft mu fN force_scale sensor_frequency sensor_damping correlation stray_capacitance"""
KEYS: Table = {
    "device": {
        "Ci": Quantity("F", 1.35e-9),
        "Ri": Quantity("ohm"),
        "insulator_thickness": Quantity("m", 1e-6),
        "insulator_permittivity": Quantity("", 3.9),
        "contact_area": Quantity("m^2", 1e-4),
        **dict.fromkeys(("breakdown_field", "current_limit_rms", "current_limit_peak"), IgnoredKey()),
    },
    "skin": {
        "Rsc": Quantity("ohm", 160e3),
        "Csc": Quantity("F", 22e-9),
        "thickness": Quantity("m", 200e-6),
        "permittivity": IgnoredKey(),
        "level": Choice(("constant", "dispersive", "fractional")),
        "alpha": Quantity("", 0.8),
    },
    "grounding": {
        "connection": Choice(("direct", "natural")),
        "R_H": Quantity("ohm"),
        "grounding_Rsc": Quantity("ohm"),
        "grounding_Csc": Quantity("F"),
        "Z": Quantity("ohm", least=True),
        "Z_capacitance": Quantity("F"),
    },
    "gap": {"resistance": Quantity("ohm"), "capacitance": Quantity("F"), "thickness": Quantity("m")},
    "drive": {
        "waveform": Choice(("square", "sine", "triangle", "trapezoid", "burst", "chirp", "multitone", "measured")),
        "peak_to_peak": Quantity("V", 360.0),
        "frequency": Quantity("Hz", 100.0),
        "rise_time": Quantity("s"),
        "duty": Quantity("", 0.5),
        "offset": Quantity("V", 0.0, _ANY),
        "phase": Quantity("rad", 0.0, _ANY),
        "shape": Choice(("square", "sine", "triangle")),
        "cycles": WholeNumber(5, 1),
        "start_frequency": Quantity("Hz"),
        "end_frequency": Quantity("Hz"),
        "sweep_time": Quantity("s"),
        "spacing": Choice(("linear", "logarithmic")),
        "frequencies": ListKey(Quantity("Hz")),
        "amplitudes": ListKey(Quantity("V")),
        "phases": ListKey(Quantity("rad", None, _ANY)),
        "steady_state": Choice((True, False)),
    },
    "measurement": {
        "channels": ListKey(Choice(("Vsc", "I", "Ft")), ("Vsc",)),
        "series_resistor": Quantity("ohm", 0.0, least=True),
        "probe_resistance": Quantity("ohm"),
        "probe_capacitance": Quantity("F"),
        "stray_capacitance": Quantity("F", least=True),  # from drive to ground, beside the loop
        "current_lead": Choice(("drive", "ground")),
        "sampling_rate": Quantity("Hz", 200e3),
        "duration": Quantity("s", 20e-3),
        "noise_V": Quantity("V", least=True),
        "noise_Vsc": Quantity("V", 0.1, least=True),
        "noise_I": Quantity("A", 20e-9, least=True),
        "noise_Ft": Quantity("N", 2e-3, least=True),
        **dict.fromkeys(("gain_relative_sd", "gain_I_relative_sd", "noise_model", "quiet", "weighting"), IgnoredKey()),
        **dict.fromkeys(("spectrum_relative_sd", "spectrum_floor_sd"), IgnoredKey()),
    },
    "instrument": dict.fromkeys(("V", "Vsc", "I", "Z", "Ft", "own"), IgnoredKey()),
    "friction": {
        "coefficient": Quantity("", 0.5),
        "normal_force": Quantity("N", 0.5, least=True),
        "sensor_frequency": Quantity("Hz"),
        "sensor_damping": Quantity(""),
    },
    "prior": dict.fromkeys(_PRIORS.split(), IgnoredKey()),
    "force": {"model": Choice(("paper", "gap"))},
    "perception": dict.fromkeys(("threshold_force", "friction_change", "thresholds", "source"), IgnoredKey()),
    "population": dict.fromkeys(
        ("contact_area", "skin_thickness_relative_sd", "insulator_thickness_relative_sd"), IgnoredKey()
    ),
    "tolerance": {"force": IgnoredKey()},
}
_NEEDED = {
    "trapezoid": ("rise_time",),
    "chirp": ("start_frequency", "end_frequency", "sweep_time"),
    "multitone": ("frequencies", "amplitudes"),
}


def make_scene(content: Mapping[str, Any], truth: Mapping[str, Any], place: str) -> Scene:
    """Return the scene of a file's tables, with the values of `truth` inserted; `place` names the file.

    Raises:
        RecipeError: an unknown key, an impossible value, or a missing key.
    """
    ignored = ("description", "calibration")  # text for people, and other records
    content = {name: section for name, section in content.items() if name not in ignored}
    merged = {name: {**content.get(name, {}), **truth.get(name, {})} for name in {**content, **truth}}
    scene = validate_sections(merged, KEYS, place)
    device, drive, skin = scene["device"], scene["drive"], scene["skin"]
    given = merged.get("device", {})
    if "Ci" not in given and {"insulator_thickness", "insulator_permittivity"} <= given.keys():  # eq. (3)
        permittivity, thickness = device["insulator_permittivity"], device["insulator_thickness"]
        device["Ci"] = EPS0 * permittivity * device["contact_area"] / thickness
    for key in _NEEDED.get(drive["waveform"], ()):
        if drive[key] is None:
            raise RecipeError(f"{place}: [drive] waveform = '{drive['waveform']}' needs {key}; state it")
    if drive["frequencies"] and any(len(drive[k] or drive["frequencies"]) != len(drive["frequencies"]) for k in _LISTS):
        raise RecipeError(f"{place}: [drive] frequencies, amplitudes and phases differ in length; correct one")
    if not drive["duty"] < 1.0 or not skin["alpha"] <= 1.0:
        raise RecipeError(f"{place}: [drive] duty must be below 1, and [skin] alpha at most 1")
    if scene["grounding"]["connection"] == "natural" and scene["grounding"]["Z"] is None:
        raise RecipeError(f"{place}: [grounding] connection = 'natural' needs Z, such as '14.5 Mohm'")
    if scene["gap"]["resistance"] and not (scene["gap"]["capacitance"] or scene["gap"]["thickness"]):
        raise RecipeError(f"{place}: [gap] resistance needs capacitance or thickness; state one of them")
    return scene


_LISTS = ("amplitudes", "phases")
