"""Recipes: which scene is recorded, what is true of it that the scene does not say, and what the instruments add."""

import itertools
import math
from pathlib import Path
from typing import Any, NamedTuple

from data_synth.errors import RecipeError
from data_synth.keys import Choice, Key, ListKey, Quantity, Table, WholeNumber, read_toml, validate_sections
from data_synth.scene import KEYS as SCENE
from data_synth.scene import Scene, make_scene

UNITS = {"V": "V", "Vsc": "V", "I": "A"}
AS_IT_IS = "as the scene says"  # what skin a recipe has that names no other
_SUFFIX = ".recipe"


def _channel_quantities(low: float = 0.0, default: float | None = None) -> dict[str, Key]:
    """A quantity of each channel, `low` or more."""
    return {name: Quantity(unit, default, low, least=True) for name, unit in UNITS.items()}


KEYS: Table = {
    # what the scene's skin is not
    "skin": {
        "model": Choice((AS_IT_IS, "two layers", "nonlinear", "electroporated")),
        "Rsc_2": Quantity("ohm"),
        "Csc_2": Quantity("F"),
        "half_voltage": Quantity("V"),
        "threshold": Quantity("V"),
        "width": Quantity("V"),
        "time_constant": Quantity("s"),
        "factor": Quantity("", low=1.0),
    },
    "population": {
        "fingers": WholeNumber(None, 1),
        "log_sd_Rsc": Quantity("", 0.0, least=True),
        "log_sd_Csc": Quantity("", 0.0, least=True),
        "correlation": Quantity("", 0.0, low=-1.0),
        "log_sd_area": Quantity("", 0.0, least=True),
    },
    # in the order in which they act
    "clock": {"jitter": Quantity("s", 0.0, least=True), "trigger_error": Quantity("s", 0.0, -math.inf)},
    "gain": dict.fromkeys(UNITS, Quantity("", 1.0, -math.inf)),
    "offset": _channel_quantities(-math.inf),
    "drift": _channel_quantities(-math.inf),
    "hum": {
        **_channel_quantities(),
        "frequency": Quantity("Hz", 50.0),
        "harmonics": ListKey(Quantity("", least=True), (1.0,)),
    },
    "pink": {**_channel_quantities(), "exponent": Quantity("", 1.0), "corner": Quantity("Hz")},
    "white": _channel_quantities(),
    "clip": {name: Quantity(unit) for name, unit in UNITS.items()},
    "converter": {"bits": WholeNumber(12, 2), **{name: Quantity(unit) for name, unit in UNITS.items()}},
    "missing": {"share": Quantity("", 0.0, least=True)},
}
_MODELS = {
    "two layers": ("Rsc_2", "Csc_2"),
    "nonlinear": ("half_voltage",),
    "electroporated": ("threshold", "width", "time_constant", "factor"),
}
_TOP = ("scene", "truth", "seed", "route")
_RECIPE: Table = {"recipe": {"seed": WholeNumber(0), "route": Choice(("scipy", "ngspice"))}}


class Recipe(NamedTuple):
    """What a record is made from; all numbers SI.

    scene: with what is true in place of what the file says.
    parts: every section of `KEYS`; given: those that the file has.
    """

    name: str
    scene_file: str
    scene: Scene
    parts: dict[str, dict[str, Any]]
    given: tuple[str, ...]
    seed: int
    route: str


def load(path: Path) -> Recipe:
    """A recipe, or a scene to be recorded as it is.

    Raises:
        RecipeError: naming file, section, key and remedy.
    """
    content, scene_path = read_toml(path), path
    if "scene" in content:
        scene_path = path.parent / str(content["scene"])
        tables = read_toml(scene_path)
    else:
        tables, content = content, {}
    truth = content.get("truth", {})
    if not isinstance(truth, dict):
        raise RecipeError(f"{path}: truth is not a table; write [truth.skin] and the like")
    validate_sections(truth, SCENE, f"{path}, truth")
    scene = make_scene(tables, truth, str(scene_path))
    rest = {name: part for name, part in content.items() if name not in _TOP}
    parts = validate_sections(rest, KEYS, str(path))
    top = validate_sections({"recipe": {k: content[k] for k in _RECIPE["recipe"] if k in content}}, _RECIPE, str(path))[
        "recipe"
    ]
    _check(parts, scene, str(path))
    name = path.name.removesuffix(".toml").removesuffix(_SUFFIX)
    return Recipe(name, scene_path.name, scene, parts, tuple(rest), top["seed"], top["route"])


def _check(parts: dict[str, dict[str, Any]], scene: Scene, place: str) -> None:
    skin = parts["skin"]
    needed = _MODELS.get(skin["model"], ())
    for key in itertools.chain(*_MODELS.values()):
        if (key in needed) != (skin[key] is not None):
            what = "needs" if key in needed else "does not have"
            raise RecipeError(f"{place}: [skin] model = '{skin['model']}' {what} {key}; mend one of them")
    if needed and scene["skin"]["level"] != "constant":
        raise RecipeError(f"{place}: [skin] model = '{skin['model']}' needs a scene whose skin has level = 'constant'")
    if not -1.0 < parts["population"]["correlation"] < 1.0:
        raise RecipeError(f"{place}: [population] correlation must lie between -1 and 1")
    if parts["missing"]["share"] > 0.9:
        raise RecipeError(f"{place}: [missing] share = {parts['missing']['share']} leaves too little; give 0.9 or less")
