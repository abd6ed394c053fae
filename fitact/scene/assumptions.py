"""Values that a result rests on although no electrical record determines them, each stated or a default."""

import math
from typing import Any, NamedTuple

from fitact.scene.scene import Scene
from fitact.scene.uncertain_value import UncertainValue
from fitact.units import format_engineering, format_percent


class Assumption(NamedTuple):
    """One value that a computed force or friction rests on."""

    symbol: str
    key: str  # where the scene file states it
    value: float | str
    unit: str
    text: str  # the value with its unit, for people
    stated: bool
    affects: str  # "prior", "drive", "force" or "friction"
    has_distribution: bool = False  # stated; the errors of force and friction include it then

    def to_dict(self) -> dict[str, Any]:
        """Return an entry of `force_basis.assumptions` in fit.json and summary.json."""
        fields = {name: value for name, value in self._asdict().items() if name != "stated"}
        return fields | {"origin": "scene" if self.stated else "default"}


def list_assumptions(scene: Scene, law: str, *, prior: bool, stated_drive: bool) -> tuple[Assumption, ...]:
    """List the values of a scene that its force (by `law`, eq. (22) or a gap's) and friction (eq. (2)) rest on.

    `prior`: whether the prior of Ci was used; `stated_drive`: whether the scene's drive was, and not a recorded one.
    """
    wave = (
        ("waveform", "drive", "waveform", ""),
        ("Vpp", "drive", "peak_to_peak", "V"),
        ("f", "drive", "frequency", "Hz"),
    )
    layers = ("Ti", "device", "insulator_thickness", "m"), ("Tsc", "skin", "thickness", "m")
    gap = ("d", "gap", "thickness", "m"), ("Cgap", "gap", "capacitance", "F"), ("A", "device", "contact_area", "m^2")
    friction = ("mu", "friction", "coefficient", ""), ("fN", "friction", "normal_force", "N")
    groups = {"drive": wave if stated_drive else (), "force": gap if law == "gap" else layers, "friction": friction}
    assumptions = [
        Assumption(
            symbol,
            f"[{section}] {key}",
            value if isinstance(value, str) else float(value),
            unit,
            value if isinstance(value, str) else _describe_value(value, unit),
            key in getattr(scene, section).model_fields_set,
            affects,
            isinstance(value, UncertainValue),
        )
        for affects, entries in groups.items()
        for symbol, section, key, unit in entries
        if (value := getattr(getattr(scene, section), key)) is not None
    ]
    return (*(_prior_assumptions(scene) if prior else ()), *assumptions)


def _describe_value(value: float, unit: str) -> str:
    spread = f" ± {format_percent(value.distribution().log_sd)}" if isinstance(value, UncertainValue) else ""
    return format_engineering(value, unit) + spread


def _prior_assumptions(scene: Scene) -> tuple[Assumption, ...]:
    spec = scene.prior.specs()["Ci"]
    if not spec.is_free:
        return ()
    marginal, key = scene.make_prior()["Ci"], "[prior] Ci"
    median, log_sd = math.exp(marginal.log_mean), float(marginal.log_sd)
    own_spread = "Ci" in scene.plates() or (
        "Ci" in scene.prior.model_fields_set
        and bool({"factor", "relative_sd", "low", "tolerance"} & scene.prior.Ci.model_fields_set)
    )
    return (
        Assumption("Ci", key, median, "F", format_engineering(median, "F"), scene.states_Ci, "prior"),
        Assumption("relative sd of Ci", key, log_sd, "", format_percent(log_sd), own_spread, "prior"),
    )
