"""Friction on the finger as a force sensor records it, from Vsc on a finer grid than the record's."""

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import scipy.signal

from data_synth.errors import RecipeError
from data_synth.network import EPS0
from data_synth.scene import Scene

_FINE = 16  # grid points in each step of the record
_SETTLED = 12.0  # time constants of the sensor before the record, after which e^-12 of its first state is left

Waves = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]  # V, Vsc and I at times


def friction(scene: Scene, waves: Waves, time: np.ndarray, part: Mapping[str, Any]) -> np.ndarray:
    """Return the friction (N) at `time` (s), with cross-talk; `waves` returns V, Vsc and I at any times.

    f = mu (k fe + fN), eq. (2), through a sensor  x'' + 2 z w x' + w^2 x = w^2 f  or  x' + w x = w f.
    """
    stated, step = scene["friction"], float(np.median(np.diff(time)))
    V = waves(time)[0]
    crosstalk = part["crosstalk"] * V
    constant, factor = stated["coefficient"] * stated["normal_force"], stated["coefficient"] * part["force_scale"]
    if stated["sensor_frequency"] is None:
        return constant + factor * _force(scene, *waves(time)[:2]) + crosstalk
    w, z = 2.0 * math.pi * stated["sensor_frequency"], stated["sensor_damping"]
    lead = math.ceil(_SETTLED / (w * (z or 1.0)) / step)
    fine = time[0] + step / _FINE * np.arange(-lead * _FINE, (time.size - 1) * _FINE + 1)
    force = _force(scene, *waves(fine)[:2])
    # the middle of each part of a step, so that a jump at a grid point belongs to one side
    middle = 0.5 * (force[1:] + force[:-1])
    polynomial = [1.0, w] if z is None else [1.0, 2.0 * z * w, w**2]
    (numerator,), denominator, _ = scipy.signal.cont2discrete((polynomial[-1:], polynomial), step / _FINE, "zoh")
    # settled at the first force, it stays there without further change
    read = force[0] + scipy.signal.lfilter(numerator, denominator, np.append(middle, middle[-1]) - force[0])
    return constant + factor * read[lead * _FINE :: _FINE] + crosstalk


def _force(scene: Scene, V: np.ndarray, Vsc: np.ndarray) -> np.ndarray:
    """Return the electrostatic force, N: eq. (22) with eq. (3), or that of an interface gap."""
    device, skin, gap = scene["device"], scene["skin"], scene["gap"]
    if scene["force"]["model"] == "paper":
        thickness = device["insulator_thickness"] + skin["thickness"]
        return Vsc**2 / (2.0 * thickness * (1.0 / device["Ci"] + 1.0 / skin["Csc"]))
    grounding = scene["grounding"]
    others = [grounding[key] for key in ("R_H", "grounding_Rsc", "grounding_Csc")]
    if gap["resistance"] or grounding["connection"] != "direct" or any(others):
        raise RecipeError("[force] model = 'gap' with Ft needs two equal skins and a gap without resistance")
    distance = gap["thickness"]
    capacitance = gap["capacitance"] or EPS0 * device["contact_area"] / distance
    across = (V - 2.0 * Vsc) * device["Ci"] / (device["Ci"] + capacitance)
    return EPS0 * device["contact_area"] * across**2 / (2.0 * distance**2)
