"""Scene: the device, the skin, how it is grounded and driven, what is measured and what is believed.

Read from TOML, where quantities carry units ("160 kohm"); inside, every number is SI. An empty scene
is the paper's nominal device.
"""

import difflib
import json
import math
import tomllib
from pathlib import Path
from typing import Any, Self

import pydantic

from fitact.errors import InputError
from fitact.model.circuit import Circuit, DirectGround, FinalCircuit, NaturalGround, Probe
from fitact.model.drive import Drive
from fitact.model.prior import LogNormal, Prior
from fitact.model.sections import (
    Device,
    DriveSection,
    ForceSection,
    Friction,
    Grounding,
    Measurement,
    Perception,
    PopulationSection,
    PriorSection,
    Section,
    Skin,
    Tolerance,
)
from fitact.model.skin import Dispersive, Fractional, WithSkin


class Scene(Section):
    """One case: see the sections. Raises `fitact.InputError` for what it does not understand."""

    device: Device = Device()
    skin: Skin = Skin()
    grounding: Grounding = Grounding()
    drive: DriveSection = DriveSection()
    measurement: Measurement = Measurement()
    friction: Friction = Friction()
    prior: PriorSection = PriorSection()
    force: ForceSection = ForceSection()
    perception: Perception = Perception()
    population: PopulationSection = PopulationSection()
    tolerance: Tolerance = Tolerance()

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a scene file (TOML).

        Raises:
            InputError: naming the file, the section, the key and the remedy.
        """
        try:
            content = tomllib.loads(Path(path).read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{path}: the scene cannot be read ({_reason(error)}); give a TOML file") from error
        except tomllib.TOMLDecodeError as error:
            raise InputError(f"{path}: not valid TOML: {error}") from error
        return cls.from_dict(content, source=str(path))

    @classmethod
    def from_dict(cls, content: dict[str, Any], source: str = "scene") -> Self:
        """From the tables of a scene file; `source` names it in errors."""
        try:
            return cls.model_validate(content)
        except pydantic.ValidationError as error:
            raise InputError(f"{source}: {_sentence(error.errors()[0])}") from None

    def to_json(self) -> str:
        """What was given, in SI units; `from_json` reads it back."""
        return json.dumps(self.model_dump(mode="json", exclude_unset=True), sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> Self:
        """The scene that `to_json` wrote."""
        return cls.from_dict(json.loads(text))

    def states_waveform(self) -> bool:
        """Whether the file names the waveform, rather than leaving the default."""
        return "waveform" in self.drive.model_fields_set

    def steady_state(self) -> bool | None:
        """What the file says of the steady state; None where it is silent."""
        return self.drive.steady_state if "steady_state" in self.drive.model_fields_set else None

    def require_available(self, *, fit: bool = False) -> None:
        """Refuse what this version cannot model (or, with `fit`, cannot fit), rather than leave it out in silence."""
        unavailable = {
            f"[skin] level = '{self.skin.level}' with [drive] steady_state = false": (
                self.skin.level != "constant" and not self.drive.steady_state
            ),
            "[force] model = 'gap'": self.force.model == "gap",
            "[population] contact_area = 'varies'": self.population.contact_area == "varies",
        }
        if fit:
            unavailable |= {
                f"[skin] level = '{self.skin.level}'": self.skin.level != "constant",
                "[grounding] connection = 'natural'": self.grounding.connection == "natural",
                "[grounding] R_H": self.grounding.R_H is not None,
                "[grounding] grounding_Rsc": self.grounding.grounding_Rsc is not None,
                "[grounding] grounding_Csc": self.grounding.grounding_Csc is not None,
                "[measurement] channel I": "I" in self.measurement.channels,
                "[measurement] series_resistor": self.measurement.series_resistor > 0.0,
                "[measurement] probe_resistance": self.measurement.probe_resistance is not None,
                "[measurement] probe_capacitance": self.measurement.probe_capacitance is not None,
            }
        for what, asked in unavailable.items():
            if asked:
                can = (
                    "fits the paper's final circuit (direct ground, equal skins) to Vsc" if fit else "does not model it"
                )
                raise InputError(
                    f"scene: {what} is not available in this version, which {can};"
                    " leave it out of the scene to go on without it"
                )

    def make_circuit(self) -> Circuit:
        """The circuit at the scene's nominal values; the paper's final one unless the scene asks for more."""
        circuit = self._circuit_of_constant_skins()
        if self.skin.level == "constant":
            return circuit
        return WithSkin(circuit, Dispersive() if self.skin.level == "dispersive" else Fractional(self.skin.alpha))

    def _circuit_of_constant_skins(self) -> FinalCircuit | DirectGround | NaturalGround:
        self.require_available()
        Rsc, Csc, Ci, ground = self.skin.Rsc, self.skin.Csc, self.device.Ci, self.grounding
        series, probe = self.measurement.series_resistor or None, self._probe()
        if ground.connection == "natural":
            assert ground.Z is not None  # checked when the section was read
            return NaturalGround(Rsc, Csc, Ci, ground.Z, ground.Z_capacitance, series_resistor=series, probe=probe)
        extras = (ground.R_H, ground.grounding_Rsc, ground.grounding_Csc, series, probe)
        if all(extra is None for extra in extras):
            return FinalCircuit(Rsc, Csc, Ci)
        return DirectGround(Rsc, Csc, Ci, *extras)

    def _probe(self) -> Probe | None:
        resistance, capacitance = self.measurement.probe_resistance, self.measurement.probe_capacitance
        if resistance is None and capacitance is None:
            return None
        return Probe(math.inf if resistance is None else resistance, capacitance or 0.0)

    def make_drive(self) -> Drive:
        """The scene's drive.

        Raises:
            InputError: the waveform is 'measured', so only a record has it.
        """
        return self.drive.make()

    def make_prior(self) -> Prior:
        """The prior of the parameters that the scene frees."""
        sd = self.measurement.gain_relative_sd
        return Prior(
            Rsc=self.prior.Rsc.distribution(self.skin.Rsc),
            Csc=self.prior.Csc.distribution(self.skin.Csc),
            Ci=self.prior.Ci.distribution(self.device.Ci),
            gain=LogNormal.with_relative_sd(1.0, sd) if sd > 0.0 else None,
        )


def _reason(error: OSError | UnicodeDecodeError) -> str:
    return (error.strerror or str(error)).lower() if isinstance(error, OSError) else "not UTF-8 text"


def _sentence(error: Any) -> str:
    """A pydantic error as one sentence with the place and the remedy."""
    where = [str(part) for part in error["loc"] if part not in ("function-before", "constrained-float")]
    place = f"[{where[0]}] {'.'.join(where[1:])}".strip() if where else "the scene"
    if error["type"] == "extra_forbidden":
        model: Any = Scene
        for name in where[:-1]:
            field = model.model_fields.get(name) if hasattr(model, "model_fields") else None
            model = field.annotation if field is not None else None
        known = list(model.model_fields) if hasattr(model, "model_fields") else []
        near = difflib.get_close_matches(where[-1], known, n=1)
        hint = f"did you mean '{near[0]}'?" if near else f"known here: {', '.join(known)}"
        return f"{place} is not a key of a scene; {hint}"
    message = str(error["msg"]).removeprefix("Value error, ")
    value = error["input"]
    shown = f" = {value!r}" if isinstance(value, str | int | float | bool) else ""
    return f"{place}{shown}: {message[0].lower()}{message[1:]}"
