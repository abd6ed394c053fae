"""Recipes: the scene to record, true values that differ from it, and imperfections of the instruments."""

import itertools
import math
from pathlib import Path
from typing import Any, NamedTuple

from data_synth.errors import RecipeError
from data_synth.keys import Choice, Key, ListKey, Quantity, Table, WholeNumber, read_toml, validate_sections
from data_synth.scene import KEYS as SCENE
from data_synth.scene import Scene, make_scene

UNITS = {"V": "V", "Vsc": "V", "I": "A", "Ft": "N"}
CIRCUIT_CHANNELS = ("V", "Vsc", "I")
AS_IT_IS = "as the scene says"  # skin model of a recipe that states none
_SUFFIX = ".recipe"


class Level(NamedTuple):
    """Level of a population: its keys in a recipe, the letter of its units in names, and its random numbers.

    number: the key with the number of units. suffix: of the keys log_sd_Rsc, log_sd_Csc and log_sd_area.
    """

    name: str
    number: str
    suffix: str
    letter: str
    stream: str


LEVELS = (
    Level("person", "people", "", "P", "population"),
    Level("finger", "fingers_per_person", "_finger", "F", "finger"),
    Level("session", "sessions", "_session", "S", "session"),
    Level("repetition", "repetitions", "_repetition", "r", "repetition"),
)
_SDS = ("log_sd_Rsc", "log_sd_Csc", "log_sd_area")


def _channel_quantities(low: float = 0.0, default: float | None = None) -> dict[str, Key]:
    """Return a quantity per channel, at least `low`."""
    return {name: Quantity(unit, default, low, least=True) for name, unit in UNITS.items()}


KEYS: Table = {
    # skins that a scene cannot state
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
        # instead of `fingers`: people, with levels below them; absent: 1, and no variation
        **{level.number: WholeNumber(None, 1) for level in LEVELS},
        **{f"{sd}{level.suffix}": Quantity("", least=True) for level in LEVELS[1:] for sd in _SDS},
    },
    # factors of the contact area, of Rsc and of Csc at `time`; random walks in their logarithms, per root of a second
    "change": {
        "time": ListKey(Quantity("s", least=True)),
        **dict.fromkeys(("area", "Rsc", "Csc"), ListKey(Quantity(""))),
        **dict.fromkeys(("walk_area", "walk_Rsc", "walk_Csc"), Quantity("", 0.0, least=True)),
        "lifted": ListKey(Quantity("s")),
    },
    # electrostatic force over the computed one, and cross-talk of the drive in the friction, N/V
    "friction": {"force_scale": Quantity("", 1.0), "crosstalk": Quantity("N/V", 0.0, -math.inf)},
    # in the order in which they act
    "amplifier": {"bandwidth": Quantity("Hz")},
    "stray": {"capacitance": Quantity("F")},
    "shunt": {"V": Choice(("before", "behind"))},
    "bandwidth": dict.fromkeys(CIRCUIT_CHANNELS, Quantity("Hz")),
    "clock": {"jitter": Quantity("s", 0.0, least=True), "trigger_error": Quantity("s", 0.0, -math.inf)},
    "delay": dict.fromkeys(UNITS, Quantity("s", 0.0, -math.inf)),
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
    "converter": {
        "bits": WholeNumber(12, 2),
        **{f"bits_{name}": WholeNumber(None, 2) for name in UNITS},
        "auto": Choice((False, True)),
        **{name: Quantity(unit) for name, unit in UNITS.items()},
    },
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
    """Specification of a record; all numbers SI.

    scene: the scene with the true values inserted.
    parts: every section of `KEYS`; given: the sections in the file.
    """

    name: str
    scene_file: str
    scene: Scene
    parts: dict[str, dict[str, Any]]
    given: tuple[str, ...]
    seed: int
    route: str


def load(path: Path) -> Recipe:
    """Load a recipe, or a plain scene.

    Raises:
        RecipeError: invalid input; the message names file, section, key and remedy.
    """
    content, scene_path = read_toml(path), path
    if "scene" in content:
        scene_path = path.parent / str(content["scene"])
        tables = read_toml(scene_path)
    else:
        tables, content = content, {}
    truth = content.get("truth", {})
    if not isinstance(truth, dict):
        raise RecipeError(f"{path}: truth is not a table; write [truth.skin] or another section")
    validate_sections(truth, SCENE, f"{path}, truth")
    scene = make_scene(tables, truth, str(scene_path))
    rest = {name: part for name, part in content.items() if name not in _TOP}
    parts = validate_sections(rest, KEYS, str(path))
    top = validate_sections({"recipe": {k: content[k] for k in _RECIPE["recipe"] if k in content}}, _RECIPE, str(path))[
        "recipe"
    ]
    _check(parts, scene, tuple(rest), str(path))
    if parts["stray"]["capacitance"]:
        scene["measurement"]["stray_capacitance"] = parts["stray"]["capacitance"]
    name = path.name.removesuffix(".toml").removesuffix(_SUFFIX)
    return Recipe(name, scene_path.name, scene, parts, tuple(rest), top["seed"], top["route"])


def _check(parts: dict[str, dict[str, Any]], scene: Scene, given: tuple[str, ...], place: str) -> None:
    skin = parts["skin"]
    needed = _MODELS.get(skin["model"], ())
    for key in itertools.chain(*_MODELS.values()):
        if (key in needed) != (skin[key] is not None):
            what = "needs" if key in needed else "does not have"
            raise RecipeError(f"{place}: [skin] model = '{skin['model']}' {what} {key}; correct one of them")
    if needed and scene["skin"]["level"] != "constant":
        raise RecipeError(f"{place}: [skin] model = '{skin['model']}' needs a scene with [skin] level = 'constant'")
    added = (
        *(scene["grounding"][key] for key in ("R_H", "grounding_Rsc", "grounding_Csc")),
        *scene["gap"].values(),
        scene["device"]["Ri"],
    )
    loads = (scene["measurement"][key] for key in ("series_resistor", "probe_resistance", "probe_capacitance"))
    others = scene["skin"]["level"] != "constant" or scene["grounding"]["connection"] != "direct" or needed
    if "change" in given and (others or any(added) or any(loads)):
        raise RecipeError(f"{place}: [change] needs two equal skins in series with Ci; leave out all other elements")
    if "change" in given and {"amplifier", "bandwidth"} & set(given):
        raise RecipeError(f"{place}: [change] excludes [amplifier] and [bandwidth]; leave them out")
    measured = scene["measurement"]
    if parts["stray"]["capacitance"] and measured["stray_capacitance"] is not None:
        raise RecipeError(f"{place}: [stray] repeats the scene's stray_capacitance; put it under [truth.measurement]")
    if parts["stray"]["capacitance"] and measured["current_lead"] == "ground":
        raise RecipeError(f"{place}: [stray] has no effect on I in the ground lead; leave it out")
    if parts["shunt"]["V"] == "behind" and not measured["series_resistor"]:
        raise RecipeError(f"{place}: [shunt] V = 'behind' needs a [measurement] series_resistor in the scene; state it")
    if "population" in given:
        _check_population(parts["population"], place)
    if parts["missing"]["share"] > 0.9:
        raise RecipeError(f"{place}: [missing] share = {parts['missing']['share']} loses too much; state 0.9 or less")


def _check_population(law: dict[str, Any], place: str) -> None:
    if not -1.0 < law["correlation"] < 1.0:
        raise RecipeError(f"{place}: [population] correlation must lie between -1 and 1")
    if law["fingers"] is None and law["people"] is None:
        raise RecipeError(f"{place}: [population] has neither people nor fingers; state how many there are")
    if law["fingers"] is not None and law["people"] is not None:
        raise RecipeError(f"{place}: [population] has people and fingers; write fingers_per_person beside people")
    below = (key for level in LEVELS[1:] for key in (level.number, *(f"{sd}{level.suffix}" for sd in _SDS)))
    for key in below:
        if law["people"] is None and law[key] is not None:
            raise RecipeError(f"{place}: [population] {key} needs people; write people in place of fingers")
