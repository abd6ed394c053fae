"""Records from recipes, by scipy or ngspice, with their true values."""

import functools
import platform
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from data_synth import imperfections
from data_synth.bench import IDEAL, Bench
from data_synth.changing import Course, changing_response, make_course
from data_synth.drive import Drive, make_drive
from data_synth.errors import RecipeError
from data_synth.friction import friction
from data_synth.keys import default_value
from data_synth.network import Network, network, state_space
from data_synth.population import Touch, draw_touches
from data_synth.recipe import AS_IT_IS, CIRCUIT_CHANNELS, KEYS, UNITS, Recipe
from data_synth.scene import KEYS as SCENE
from data_synth.scene import Scene

Signals = tuple[np.ndarray, np.ndarray, np.ndarray]  # V, Vsc and I at times

_MOST_SAMPLES = 10_000_000
_VALUES = {  # name -> section of the scene, key, unit
    "Rsc": ("skin", "Rsc", "ohm"),
    "Csc": ("skin", "Csc", "F"),
    "Ci": ("device", "Ci", "F"),
    "Ri": ("device", "Ri", "ohm"),
    "alpha": ("skin", "alpha", "1"),
    "R_H": ("grounding", "R_H", "ohm"),
    "grounding_Rsc": ("grounding", "grounding_Rsc", "ohm"),
    "grounding_Csc": ("grounding", "grounding_Csc", "F"),
    "Z": ("grounding", "Z", "ohm"),
    "Z_capacitance": ("grounding", "Z_capacitance", "F"),
    "series_resistor": ("measurement", "series_resistor", "ohm"),
    "probe_resistance": ("measurement", "probe_resistance", "ohm"),
    "probe_capacitance": ("measurement", "probe_capacitance", "F"),
    "stray_capacitance": ("measurement", "stray_capacitance", "F"),
    "mu": ("friction", "coefficient", "1"),
    "fN": ("friction", "normal_force", "N"),
    "sensor_frequency": ("friction", "sensor_frequency", "Hz"),
    "sensor_damping": ("friction", "sensor_damping", "1"),
    "Rgap": ("gap", "resistance", "ohm"),
    "Cgap": ("gap", "capacitance", "F"),
}


class Synthetic(NamedTuple):
    """Record (s, V, V, A, N) with its true values, and the labels of its person, finger, session and repetition."""

    time: np.ndarray
    channels: dict[str, np.ndarray]
    truth: dict[str, Any]
    labels: dict[str, str]


def make(recipe: Recipe) -> dict[str, Synthetic]:
    """Return the recipe's records by name: one, or one for each touch of its population.

    Raises:
        RecipeError: the route does not support the scene.
    """
    if "population" not in recipe.given:
        return {recipe.name: _record(recipe, Touch(recipe.name, {}, recipe.scene), 0)}
    return {touch.name: _record(recipe, touch, n) for n, touch in enumerate(draw_touches(recipe))}


def _record(recipe: Recipe, touch: Touch, finger: int) -> Synthetic:
    """Return the record of a touch; the number `finger` selects its random numbers."""
    scene = touch.scene
    measured, parts = scene["measurement"], _resolve_noise(recipe)
    count = round(measured["duration"] * measured["sampling_rate"])
    if not 2 <= count <= _MOST_SAMPLES:
        raise RecipeError(f"{recipe.name}: duration times sampling_rate is {count:,} samples; give 2 to 10,000,000")
    time = np.arange(count) / measured["sampling_rate"]
    taken = imperfections.sampling_times(time, parts["clock"], recipe.seed, finger)
    area = scene["device"]["contact_area"] / recipe.scene["device"]["contact_area"]
    course = None
    if "change" in recipe.given:
        values = scene["skin"]["Rsc"], scene["skin"]["Csc"], scene["device"]["Ci"]
        rng = imperfections.generator(recipe.seed, finger, "change")
        course = make_course(parts["change"], values, measured["duration"], rng)
    skin = _scale_second_layer(parts["skin"], area)

    amplified = Bench(parts["amplifier"]["bandwidth"])
    whole = amplified._replace(bandwidth=parts["bandwidth"], behind=parts["shunt"]["V"] == "behind")

    def waves(times: np.ndarray, bench: Bench = amplified) -> Signals:
        return simulate_response(scene, times, skin, recipe.route, course, bench)

    delay = parts["delay"]
    recorded = functools.cache(lambda late: dict(zip(CIRCUIT_CHANNELS, waves(taken - late, whole), strict=True)))
    wanted = [name for name in UNITS if name == "V" or name in measured["channels"]]
    found = {name: recorded(delay[name])[name] for name in wanted if name in CIRCUIT_CHANNELS}
    if "Ft" in wanted:
        found["Ft"] = friction(scene, waves, taken - delay["Ft"], parts["friction"])
    if "I" in wanted and not np.all(np.isfinite(found["I"])):
        raise RecipeError(
            f"{recipe.name}: the current has an impulse at each ideal jump of the drive; give the drive a rise time,"
            " state an [amplifier], or give a circuit without stray capacitance R_H or a series_resistor"
        )
    channels = {n: imperfections.add_imperfections(found[n], n, time, parts, recipe.seed, finger) for n in wanted}
    there = imperfections.sample_mask(count, parts["missing"]["share"], recipe.seed, finger)
    channels = {name: values[there] for name, values in channels.items()}
    truth = touch.labels | _truth(recipe, scene, parts) | _describe_course(course, time[-1])
    return Synthetic(time[there], channels, truth, touch.labels)


def _describe_course(course: Course | None, end: float) -> dict[str, Any]:
    """Return `course` of the truth: the values of a changing finger at 301 times, s, ohm and F."""
    if course is None:
        return {}
    time = np.linspace(0.0, end, 301)
    values = dict(zip(("Rsc", "Csc", "Ci"), course.values(time).tolist(), strict=True))
    return {"course": {"time_s": time.tolist(), **values}}


def _scale_second_layer(skin: Mapping[str, Any], area: float) -> Mapping[str, Any]:
    """Scale the second layer, if there is one, to `area` times the median area."""
    return {**skin, "Rsc_2": skin["Rsc_2"] / area, "Csc_2": skin["Csc_2"] * area} if skin["Rsc_2"] else skin


def _resolve_noise(recipe: Recipe) -> dict[str, dict[str, Any]]:
    """Return the recipe's sections, with the scene's white noise if the recipe states none."""
    measured, white = recipe.scene["measurement"], recipe.parts["white"]
    stated = {name: measured[f"noise_{name}"] or 0.0 for name in UNITS}
    return {**recipe.parts, "white": {n: stated[n] if white[n] is None else white[n] for n in UNITS}}


def simulate_response(
    scene: Scene,
    time: np.ndarray,
    skin: Mapping[str, Any] | None = None,
    route: str = "scipy",
    course: Course | None = None,
    bench: Bench = IDEAL,
) -> Signals:
    """Return V, Vsc (V) and I (A) at `time` (s) without imperfections; `skin` is the recipe's section [skin].

    A `course` gives the values of a changing finger, which supports no bandwidths in `bench`.

    Raises:
        RecipeError: the route does not support this skin or bench, or ngspice is not installed.
    """
    skin = skin or {"model": AS_IT_IS}
    second = (skin["Rsc_2"], skin["Csc_2"]) if skin["model"] == "two layers" else None
    circuit, drive = network(scene, second, bench.behind), make_drive(scene["drive"])
    law = skin if skin["model"] in ("nonlinear", "electroporated") else None
    level, measured = scene["skin"]["level"], scene["measurement"]
    stray = (measured["stray_capacitance"] or 0.0) if measured["current_lead"] == "drive" else 0.0
    if route == "ngspice":
        from data_synth.spice import spice_response

        if level != "constant":
            raise RecipeError(f"[skin] level = '{level}' is not available with ngspice; use route = 'scipy'")
        if bench.filters:
            raise RecipeError("[amplifier] and [bandwidth] are not available with ngspice; use route = 'scipy'")
        if course is not None and stray:
            raise RecipeError("[change] with stray capacitance is not available with ngspice; use route = 'scipy'")
        return spice_response(circuit, law, drive, time, course)
    if course is not None:
        return changing_response(course, drive, time, stray)
    return _scipy_response(circuit, law, scene["skin"], drive, time, bench)


def _scipy_response(
    circuit: Network,
    law: Mapping[str, Any] | None,
    skin: Mapping[str, Any],
    drive: Drive,
    time: np.ndarray,
    bench: Bench,
) -> Signals:
    # imported here, because each loads another part of scipy
    if law is not None:
        from data_synth.nonlinear import nonlinear_response

        return nonlinear_response(circuit, law, drive, time, bench)
    if skin["level"] != "constant":
        from data_synth.harmonics import harmonic_response

        return harmonic_response(circuit, skin, drive, time, bench=bench)
    from data_synth.response import response

    return response(bench.extend(state_space(circuit)), drive, time)


def _truth(recipe: Recipe, scene: Scene, parts: dict[str, dict[str, Any]]) -> dict[str, Any]:
    values = {name: (scene[section][key], unit) for name, (section, key, unit) in _VALUES.items()}
    if scene["skin"]["level"] != "fractional":
        del values["alpha"]
    if "Ft" not in scene["measurement"]["channels"]:
        values = {name: value for name, value in values.items() if _VALUES[name][0] != "friction"}
    else:
        values["force_scale"] = parts["friction"]["force_scale"], "1"
    recorded = ("V", *scene["measurement"]["channels"])
    values |= {f"noise_{name}": (parts["white"][name], UNITS[name]) for name in recorded}
    stated = {key: value for key, value in scene["drive"].items() if value != default_value(SCENE["drive"][key])}
    added = {name: parts[name] for name in KEYS if name in recipe.given}
    return {
        "scene": recipe.scene_file,
        "truth": {name: {"value": value, "unit": unit} for name, (value, unit) in values.items() if value},
        "drive": {"waveform": scene["drive"]["waveform"]} | stated,
        "recipe": {name: {k: v for k, v in part.items() if v is not None} for name, part in added.items()},
        "origin": {"route": recipe.route, "seed": recipe.seed, "versions": _versions(recipe.route)},
    }


def list_truth(name: str, made: Synthetic) -> dict[str, Any]:
    """Return a record's entry in truth.json: its name, its labels, and its true values in SI units."""
    values = {key: each["value"] for key, each in made.truth["truth"].items()}
    return {"name": name, **made.labels, **values}


def _versions(route: str) -> dict[str, str]:
    import scipy

    found = {"python": platform.python_version(), "numpy": np.__version__, "scipy": scipy.__version__}
    if route == "ngspice":
        from data_synth import spice

        found["ngspice"] = spice.ngspice_version()
    return found
