"""Fingers that differ, and experiments with levels: persons, their fingers, sessions and repetitions."""

import itertools
import math
from typing import Any, NamedTuple

import numpy as np

from data_synth import imperfections
from data_synth.recipe import LEVELS, Recipe
from data_synth.scene import Scene


class Touch(NamedTuple):
    """One record of a population: the name of its file, its labels by level, and the scene with its true values."""

    name: str
    labels: dict[str, str]
    scene: Scene


def draw_touches(recipe: Recipe) -> list[Touch]:
    """Return the touches of the recipe's population, persons outermost.

    The logarithms of Rsc and Csc at the median area, and of the area, are the medians plus independent normal effects
    of person, finger, session and repetition. An area A makes Rsc / A, A Csc, A Ci and Ri / A. `fingers` are touched
    once each.
    """
    law = recipe.parts["population"]
    counts = [law["fingers"] or law["people"], *(law[level.number] or 1 for level in LEVELS[1:])]
    below = [math.prod(counts[k + 1 :]) for k in range(len(counts))]
    effects = [_draw_effects(recipe, level, math.prod(counts[: level + 1])) for level in range(len(counts))]
    found = []
    for n, place in enumerate(itertools.product(*(range(1, count + 1) for count in counts))):
        logs = sum(effect[n // each] for effect, each in zip(effects, below, strict=True))
        scene = _scale_scene(recipe.scene, *(math.exp(each) for each in logs.tolist()))
        if law["fingers"] is not None:
            found.append(Touch(f"finger{n:02}", {}, scene))
            continue
        units = zip(LEVELS, place, counts, strict=True)
        named = {level.name: f"{level.letter}{unit}" for level, unit, count in units if count > 1 or level is LEVELS[0]}
        labels = {level: part.removeprefix("r") for level, part in named.items()}
        found.append(Touch("_".join(named.values()), labels, scene))
    return found


def _draw_effects(recipe: Recipe, level: int, units: int) -> np.ndarray:
    """Return the effects of a level's units on the logarithms of Rsc, Csc and area, (units, 3)."""
    law, suffix = recipe.parts["population"], LEVELS[level].suffix
    sds = [law[f"log_sd_{name}{suffix}"] or 0.0 for name in ("Rsc", "Csc", "area")]
    if not any(sds):
        return np.zeros((units, 3))
    drawn = np.empty((units, 3))
    for unit in range(units):
        drawn[unit] = imperfections.generator(recipe.seed, unit, LEVELS[level].stream).standard_normal(3)
    if level == 0:
        r = law["correlation"]
        drawn[:, 1] = r * drawn[:, 0] + math.sqrt(1.0 - r**2) * drawn[:, 1]
    return drawn * sds


def _scale_scene(scene: Scene, Rsc: float, Csc: float, area: float) -> Scene:
    """Return the scene with these factors of Rsc and Csc at the median area, and of the area."""
    skin: dict[str, Any] = {**scene["skin"], "Rsc": scene["skin"]["Rsc"] * Rsc / area}
    skin["Csc"] = scene["skin"]["Csc"] * area * Csc
    device = {**scene["device"], "Ci": scene["device"]["Ci"] * area}
    device["contact_area"] *= area
    if device["Ri"]:
        device["Ri"] /= area
    return {**scene, "skin": skin, "device": device}
