"""Scene: device, skin, grounding, drive, measurement and prior.

Scenes are read from TOML, where quantities have units ("160 kohm"); inside, every number is in SI units. An empty
scene is the nominal device of the reference paper.
"""

import difflib
import json
import math
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import pydantic
from jax.typing import ArrayLike
from markupsafe import Markup
from pydantic import model_validator

from fitact.charts.circuit_diagram import Lead, lay_out_circuit, lay_out_wiring
from fitact.errors import InputError
from fitact.instrument.pieces import Piece, find_load
from fitact.model.circuit import RC, Channel, Circuit, DirectGround, FinalCircuit, NaturalGround, Probe
from fitact.model.drive import Drive
from fitact.model.force import EPSILON_0, Geometry, plate_capacitance
from fitact.model.skin import Dispersive, Fractional, WithSkin
from fitact.prior.distributions import Distribution, LogNormal
from fitact.prior.prior import Prior
from fitact.prior.product import multiply
from fitact.prior.published import Layer
from fitact.scene import diagrams, sections, toml
from fitact.scene.instrument_section import CalibrationSection, InstrumentSection
from fitact.scene.prior_section import FRICTION_PRIORS, UNKNOWN_CI, PriorSection
from fitact.scene.prior_spec import ORDER_KEYS, PriorSpec
from fitact.scene.section import Section, field_section
from fitact.scene.threshold_table import resolve_table_path
from fitact.scene.uncertain_value import UncertainValue
from fitact.summary import Summary
from fitact.tables import Display

_DIRECT_GROUND_KEYS = ("R_H", "grounding_Rsc", "grounding_Csc")  # keys of only one kind of grounding
_NATURAL_GROUND_KEYS = ("Z", "Z_capacitance")
_GEOMETRY_KEYS = {  # what force and friction rest on beside the circuit: quantity -> section and key
    "skin_thickness": ("skin", "thickness"),
    "skin_permittivity": ("skin", "permittivity"),
    "insulator_thickness": ("device", "insulator_thickness"),
    "insulator_permittivity": ("device", "insulator_permittivity"),
    "contact_area": ("device", "contact_area"),
    "friction_coefficient": ("friction", "coefficient"),
}
_NO_KEYS = ("function-before", "constrained-float", "DummyCircuit", "literal['open']")  # pydantic's words in a place
PLATES = {  # eq. (3): capacitance -> the powers of the quantities that it follows from
    "Ci": {"insulator_permittivity": 1.0, "contact_area": 1.0, "insulator_thickness": -1.0},
    "Csc": {"skin_permittivity": 1.0, "contact_area": 1.0, "skin_thickness": -1.0},
}


class Scene(Section, Display):
    """Device, skin, grounding, drive, measurement and prior of one case; see the sections.

    Attributes:
        description: text for the user, which reports repeat.

    Raises:
        InputError: a key or a value is unknown.
    """

    description: str = ""
    calibration: tuple[CalibrationSection, ...] = ()
    device: sections.Device = sections.Device()
    skin: sections.SkinSection = sections.SkinSection()
    grounding: sections.Grounding = sections.Grounding()
    gap: sections.Gap = sections.Gap()
    drive: sections.DriveSection = sections.DriveSection()
    measurement: sections.Measurement = sections.Measurement()
    instrument: InstrumentSection = InstrumentSection()
    friction: sections.Friction = sections.Friction()
    prior: PriorSection = PriorSection()
    force: sections.ForceSection = sections.ForceSection()
    perception: sections.Perception = sections.Perception()
    population: sections.PopulationSection = sections.PopulationSection()
    tolerance: sections.Tolerance = sections.Tolerance()

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a scene file (TOML), or a shipped scene by its name, such as "paper" (docs/scene.md lists them).

        Raises:
            InputError: naming the file, the line, the section, the key and the remedy.
        """
        text = toml.read_scene_text(path)
        try:
            content = tomllib.loads(text)
            for each in content.get("calibration", ()):  # files lie beside the scene
                if isinstance(each, dict) and isinstance(each.get("record"), str):
                    each["record"] = str(Path(path).parent / each["record"])
            perception = content.get("perception")
            if isinstance(perception, dict) and isinstance(name := perception.get("thresholds"), str):
                perception["thresholds"] = resolve_table_path(name, Path(path).parent)
            return cls.model_validate(content)
        except tomllib.TOMLDecodeError as error:
            raise InputError(f"{path}: not valid TOML: {error}") from error
        except pydantic.ValidationError as error:
            sentence = _sentence(error.errors()[0])
            line = toml.find_line(text, sentence)
            raise InputError(f"{path}{f', line {line}' if line else ''}: {sentence}") from None

    @classmethod
    def from_dict(cls, content: dict[str, Any], source: str = "scene") -> Self:
        """Make a scene from the tables of a scene file; `source` names the file in errors."""
        try:
            return cls.model_validate(content)
        except pydantic.ValidationError as error:
            raise InputError(f"{source}: {_sentence(error.errors()[0])}") from None

    def __str__(self) -> str:
        """Return the scene as TOML: every key with its unit, defaults as comments. It loads to an equal scene."""
        return toml.to_toml(self)

    __repr__ = Display.__repr__

    @property
    def _headline(self) -> str:
        sections = [name for name in type(self).model_fields if name in self.model_fields_set]
        return f"states {', '.join(sections)}" if sections else "the nominal device of the reference paper"

    def _rows(self) -> list[tuple[str, ...]]:
        stated = [line for line in str(self).splitlines() if line and not line.startswith("#")]
        rows = [("key", "value"), *(tuple(line.split(" = ", 1)) for line in stated)]
        # a section without stated keys is the default
        return [row for row, after in zip(rows, [*rows[1:], ("",)], strict=True) if len(row) == 2 or len(after) == 2]

    def _repr_html_(self) -> str:
        return super()._repr_html_() + str(self.draw_circuit())

    def draw_circuit(self, values: Mapping[str, Summary] | None = None, *, is_file: bool = False) -> Markup:
        """Draw the circuit as an SVG element, or as a file; `values`, by name, replace the scene's."""
        grounding = self.grounding.connection
        diagram = lay_out_circuit(self.describe_parts(values or {}), grounding, self.find_current_lead())
        return Markup(diagram.svg(f"The circuit with {grounding} ground", is_file=is_file))

    def draw_wiring(self, *, is_file: bool = False) -> Markup:
        """Draw how the record is measured, as an SVG element, or as a file."""
        grounding, measured = self.grounding.connection, self.measurement
        has_shunt = measured.series_resistor > 0.0
        diagram = lay_out_wiring(grounding, measured.channels, has_shunt, self.find_current_lead())
        return Markup(diagram.svg(f"The wiring with {grounding} ground", is_file=is_file))

    def describe_parts(self, values: Mapping[str, Summary]) -> dict[str, str]:
        """Return each part's value with its unit, by name, of `values` with their standard deviation.

        It is "" where only a prior without a median describes the part.
        """
        parts: dict[str, float | None] = {n: spec.median or spec.nominal for n, spec in self.prior.specs().items()}
        parts |= {name: value for name, value in self.nominal_values().items() if value is not None}
        return diagrams.describe_parts(parts | self.fixed_values(), self.prior.ties(), self.measurement, values)

    def find_current_lead(self) -> Lead | None:
        """Return the lead in which I is recorded, or None without I; where it makes no difference, the usual one."""
        if "I" not in self.measurement.channels:
            return None
        if "current_lead" in self.measurement.model_fields_set or self.states_stray_capacitance():
            return self.measurement.current_lead
        return "drive" if self.grounding.connection == "natural" else "ground"  # the mains earth would bypass the other

    def to_json(self) -> str:
        """Return the stated keys as JSON, in SI units; `from_json` reads it."""
        stated = self.model_dump(mode="json", exclude_unset=True)
        return json.dumps({name: section for name, section in stated.items() if section}, sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Make a scene from the output of `to_json`."""
        return cls.from_dict(json.loads(text))

    def states_waveform(self) -> bool:
        """Return whether the file states the waveform."""
        return "waveform" in self.drive.model_fields_set

    def steady_state(self) -> bool | None:
        """Return `steady_state` as stated in the file; None if it is not stated."""
        return self.drive.steady_state if "steady_state" in self.drive.model_fields_set else None

    def require_available(self, *, fit: bool = False) -> None:
        """Raise InputError if this version cannot model (or, with `fit`, cannot fit) the scene."""
        follows = ("constant", "fractional") if fit else ("constant",)  # skins with computable transients
        if self.skin.level not in follows and not self.drive.steady_state:
            raise InputError(
                f"scene: [skin] level = '{self.skin.level}' with [drive] steady_state = false is not available in this"
                " version, which does not model it; leave it out of the scene to go on without it"
            )

    def nominal_values(self) -> dict[str, float | None]:
        """Return nominal values of all parameters that can have a prior, SI; None if there is no such element."""
        ground, measured = self.grounding, self.measurement
        return {
            "Rsc": self.skin.Rsc,
            "Csc": self.skin.Csc,
            "Ci": self.device.Ci,
            "Ri": self.device.Ri,
            **{name: getattr(ground, name) for name in (*_DIRECT_GROUND_KEYS, *_NATURAL_GROUND_KEYS)},
            "Z": ground.Z or None,  # 0 means that the body is at earth
            "series_resistor": measured.series_resistor or None,
            "alpha": self.skin.alpha if self.skin.level == "fractional" else None,
            "stray_capacitance": float(measured.stray_capacitance or 0.0) or None,
            "Rgap": self.gap.resistance,
            "Cgap": self._gap_capacitance(),
            "sigma": measured.noise_Vsc or None,
            "sigma_I": measured.noise_I or None,
            "sigma_Ft": measured.noise_Ft or None,
        } | self._friction_values()

    def _friction_values(self) -> dict[str, float | None]:
        """Return the nominal values of a measured friction; None for what a scene without the channel Ft has not."""
        stated = self.friction
        values = {
            "mu": stated.coefficient,
            "fN": stated.normal_force or None,
            "force_scale": 1.0,
            "sensor_frequency": stated.sensor_frequency,
            "sensor_damping": stated.sensor_damping,
        }
        return values if "Ft" in self.measurement.channels else dict.fromkeys(values)

    def _gap_capacitance(self) -> float | None:
        """Return the stated capacitance, or that of air with the stated thickness, eq. (3)."""
        thickness = self.gap.thickness
        if self.gap.capacitance is not None or thickness is None:
            return self.gap.capacitance
        return float(plate_capacitance(1.0, self.device.contact_area, thickness))

    def geometry(self) -> Geometry:
        """Return the sizes for the force; the thickness of a gap follows from Cgap unless both are stated."""
        both = self.gap.capacitance is not None and self.gap.thickness is not None
        panel, gap = self.device, self.gap.thickness if both else None
        layers = float(panel.insulator_thickness), float(self.skin.thickness)
        return Geometry(float(panel.contact_area), *layers, gap, self.force.model)

    def geometry_values(self) -> dict[str, float | None]:
        """Return what force and friction rest on beside the circuit, SI; None if the skin has no permittivity."""
        return {name: getattr(getattr(self, section), key) for name, (section, key) in _GEOMETRY_KEYS.items()}

    def geometry_distributions(self) -> dict[str, Distribution]:
        """Return the stated distributions of what force and friction rest on beside the circuit."""
        values = self.geometry_values().items()
        return {name: value.distribution() for name, value in values if isinstance(value, UncertainValue)}

    def uncertain_plates(self) -> tuple[str, ...]:
        """Return the capacitances that follow from stated distributions by eq. (3), unless [prior] overrules that."""
        is_derived = {"Ci": self.device.derives_Ci, "Csc": self.skin.permittivity is not None}
        stated = self.geometry_distributions().keys()
        return tuple(name for name, powers in PLATES.items() if is_derived[name] and stated & powers.keys())

    def plates(self) -> dict[str, tuple[dict[str, float], float]]:
        """Return the capacitances whose prior follows from stated distributions by eq. (3).

        Each has the powers of the quantities with a distribution, and the factor from all others.
        """
        stated, values, found = self.geometry_distributions(), self.geometry_values(), {}
        for name in self.uncertain_plates():
            if not self.states_prior(name):
                powers = {quantity: power for quantity, power in PLATES[name].items() if quantity in stated}
                exact = [
                    float(values[other] or 0.0) ** power for other, power in PLATES[name].items() if other not in powers
                ]
                found[name] = powers, EPSILON_0 * math.prod(exact)
        return found

    def states_prior(self, name: str) -> bool:
        """Return whether [prior] states the density or the value of a parameter, and not only its order."""
        belief = getattr(self.prior, name)
        return name in self.prior.model_fields_set and bool(belief.model_fields_set - ORDER_KEYS)

    def thickness_sd(self) -> dict[str, float]:
        """Return the standard deviations of the logarithms of thicknesses that vary between fingers or panels."""
        keys = {name: f"{name}_relative_sd" for name in ("skin_thickness", "insulator_thickness")}
        sds = {name: math.sqrt(math.log1p(getattr(self.population, key) ** 2)) for name, key in keys.items()}
        if keys["skin_thickness"] not in self.population.model_fields_set and isinstance(
            self.skin.thickness, UncertainValue
        ):
            sds["skin_thickness"] = self.skin.thickness.distribution().log_sd
        return {name: sd for name, sd in sds.items() if sd > 0.0}

    def make_circuit(self, values: Mapping[str, ArrayLike] | None = None) -> Circuit:
        """Make the circuit at the nominal values, or at `values` by name (ohm, F).

        It is `FinalCircuit` unless the scene, or `values`, has further elements.
        """
        self.require_available()
        circuit = self.make_rc_circuit(values)
        if self.skin.level == "constant":
            return circuit
        alpha = dict(values or {}).get("alpha", self.skin.alpha)
        return WithSkin(circuit, Dispersive() if self.skin.level == "dispersive" else Fractional(alpha))

    def make_rc_circuit(self, values: Mapping[str, ArrayLike] | None = None) -> RC:
        """Make the circuit with constant skins."""
        self.require_available(fit=True)
        at: dict[str, Any] = self.nominal_values() | dict(values or {})
        skin, names = (at["Rsc"], at["Csc"], at["Ci"]), ("series_resistor", "Rgap", "Cgap")
        common = {name: at[name] for name in names} | {"probe": self._probe()}
        Ri: Any = at["Ri"]
        if self.grounding.connection == "natural":
            return NaturalGround(*skin, at["Z"], at["Z_capacitance"], **common, Ri=Ri)
        extras = common | {name: at[name] for name in _DIRECT_GROUND_KEYS}
        if all(extra is None for extra in extras.values()):
            return FinalCircuit(*skin, Ri=Ri)
        return DirectGround(*skin, **extras, Ri=Ri)

    def noise_V(self) -> float:
        """Return the rms noise of the recorded V, V; unless stated, the rounding of 12 bits over the drive's swing."""
        stated = self.measurement.noise_V
        return self.drive.swing / 4096 / math.sqrt(12.0) if stated is None else stated

    def states_stray_capacitance(self) -> bool:
        """Return whether [measurement] or [prior] states a stray capacitance, also one of 0."""
        return self.measurement.stray_capacitance is not None or self.prior.stray_capacitance is not None

    def stray_capacitance(self) -> float:
        """Return the capacitance (F) of panel and cable whose current I includes, or 0.

        It is the stated value, or else the median of [prior]. I in the ground lead does not include it.
        """
        if self.measurement.current_lead == "ground":
            return 0.0
        stated, belief = self.measurement.stray_capacitance, self.prior.stray_capacitance
        if stated is None and belief is not None:
            return math.exp(self.make_prior()["stray_capacitance"].log_mean)
        return float(stated or 0.0)

    def find_load(self) -> Piece | None:
        """Return the piece of [instrument] Vsc that loads the skin, or None."""
        return find_load(self.instrument.pieces("Vsc"))

    def _probe(self) -> Probe | None:
        if (load := self.find_load()) is not None:
            return load.nominal_probe()
        resistance, capacitance = self.measurement.probe_resistance, self.measurement.probe_capacitance
        if resistance is None and capacitance is None:
            return None
        return Probe(math.inf if resistance is None else resistance, capacitance or 0.0)

    def gain_u(self, channel: str) -> float:
        """Return the relative standard uncertainty of a channel's gain by the stated pieces; 0 if none is stated."""
        gains = (piece.gain for piece in self.instrument.pieces(channel))
        return math.hypot(*(float(gain.log_sd) for gain in gains if gain is not None))

    def offset_limit(self, channel: str) -> float:
        """Return the largest offset of a channel by the stated pieces, relative to its range."""
        return sum(piece.offset for piece in self.instrument.pieces(channel))

    def skew_limit(self, channel: str, time_step: float) -> float:
        """Return the largest delay (s) of a channel against V by the stated pieces; `time_step` is that of samples."""
        pieces = (*self.instrument.pieces("V"), *self.instrument.pieces(channel))
        return max((piece.skew + piece.skew_intervals * time_step for piece in pieces), default=0.0)

    def states_skew(self, channel: str) -> bool:
        """Return whether pieces of equipment, which have a skew, are stated for V or for a channel."""
        return bool(self.instrument.pieces("V") or self.instrument.pieces(channel))

    def delay_sd(self, channel: str, time_step: float) -> float:
        """Return the prior sd (s) of a channel's delay against a recorded V; `time_step` is that of samples.

        It is one time step if nobody stated with what V was recorded, and no less for I: converters take channels in
        turn, and probes delay them.
        """
        limit = self.skew_limit(channel, time_step)
        if channel == "I":
            return max(time_step, limit)
        return limit / math.sqrt(3.0) if self.states_skew(channel) else time_step

    def without_instrument_errors(self) -> Self:
        """Return the scene with instruments that have no errors, but the load of their input."""
        load = self.find_load()
        exact: dict[str, Any] = {"gain_relative_sd": 0.0, "gain_I_relative_sd": 0.0}
        if load is not None:
            probe = load.nominal_probe()
            exact |= {"probe_resistance": float(probe.R), "probe_capacitance": float(probe.C) or None}
        measurement = self.measurement.model_copy(update=exact)
        changes = {"measurement": measurement, "instrument": InstrumentSection(), "calibration": ()}
        return self.model_copy(update=changes)

    def make_drive(self) -> Drive:
        """Make the drive; refused if the waveform is 'measured', which only a record has."""
        return self.drive.make()

    def with_channels(self, *channels: Channel) -> Self:
        """Return the scene in which these channels are fitted."""
        return self.model_copy(update={"measurement": self.measurement.model_copy(update={"channels": channels})})

    @property
    def states_Ci(self) -> bool:
        """Whether the scene states Ci: by a value, by area, thickness and permittivity, or by a prior of its own."""
        device, spec = self.device.model_fields_set, self.prior.Ci
        own_prior = bool({"median", "low", "nominal", "tied"} & spec.model_fields_set) or isinstance(spec.fixed, float)
        return (
            own_prior or "Ci" in device or {"insulator_thickness", "insulator_permittivity", "contact_area"} <= device
        )

    def make_prior(self) -> Prior:
        """Make the prior of the free parameters, without gains."""
        layer = Layer(self.device.contact_area, self.skin.thickness, self.drive.lowest_frequency)
        default = FRICTION_PRIORS if "Ft" in self.measurement.channels else {}
        nominal, beliefs = self.nominal_values(), default | self.prior.specs()
        if "I" in self.measurement.channels and not self.states_Ci and "Ci" not in self.prior.model_fields_set:
            beliefs["Ci"] = UNKNOWN_CI
        marginals = {name: b.distribution(name, nominal[name], layer) for name, b in beliefs.items() if b.is_free}
        stray = self.measurement.stray_capacitance
        if isinstance(stray, UncertainValue) and "stray_capacitance" not in self._unmeasured_parameters():
            marginals.setdefault("stray_capacitance", stray.distribution())
        correlations, stated = self.prior.correlations(), self.geometry_distributions()
        plates = self.plates()
        for name, (powers, factor) in plates.items():
            marginals[name] = multiply([(stated[quantity], power) for quantity, power in powers.items()], factor)
        if len(plates) == 2 and "contact_area" in stated:
            laws = [marginals[name] for name in plates]
            correlation = stated["contact_area"].log_sd ** 2 / math.prod(law.log_sd for law in laws)
            if correlation > 0.999 or not all(isinstance(law, LogNormal) for law in laws):
                raise InputError(
                    "[device] contact_area sets Ci and Csc together; write each distribution that they follow from as"
                    " {median, relative_sd} or {median, factor}, and one of a thickness or permittivity, too"
                )
            correlations = {("Csc", "Ci"): correlation} | correlations
        return Prior.from_marginals(correlations, self.prior.order_constraints(), **marginals)

    def fixed_values(self) -> dict[str, float]:
        """Return the fixed parameters and their values, SI.

        Raises:
            InputError: a parameter is fixed at a value that the scene does not have.
        """
        nominal, fixed = self.nominal_values(), {}
        for name, belief in self.prior.specs().items():
            if belief.fixed is not None:
                value = nominal[name] if belief.fixed is True else belief.fixed
                if value is None:
                    raise InputError(f"[prior] {name} is fixed, but the scene has no {name}; write fixed = its value")
                fixed[name] = float(value)
        return fixed

    @model_validator(mode="after")
    def _derive_Csc(self) -> Self:
        if self.skin.permittivity is not None:
            Csc = plate_capacitance(self.skin.permittivity, self.device.contact_area, self.skin.thickness)
            skin = self.skin.model_copy()
            object.__setattr__(skin, "Csc", Csc)  # eq. (3); both are frozen from here on
            object.__setattr__(self, "skin", skin)
        return self

    @model_validator(mode="after")
    def _check_prior(self) -> Self:
        absent = dict.fromkeys(_DIRECT_GROUND_KEYS, "[grounding] connection = 'direct'")
        if self.grounding.connection == "direct":
            absent = dict.fromkeys(_NATURAL_GROUND_KEYS, "[grounding] connection = 'natural'")
        if self.skin.level != "fractional":
            absent["alpha"] = "[skin] level = 'fractional'"
        absent |= self._unmeasured_parameters()
        for name in self.prior.specs():
            if name in absent:
                raise InputError(f"[prior] {name} needs {absent[name]}; leave it out of [prior] otherwise")
        self._check_friction()
        stated = self.measurement.probe_resistance is not None or self.measurement.probe_capacitance is not None
        if stated and self.find_load() is not None:
            raise InputError(
                "[measurement] probe_resistance and probe_capacitance state the load that a piece of [instrument] Vsc"
                " has; state it under [instrument.own] only"
            )
        has = {name for name, value in self.nominal_values().items() if value is not None} | set(self.prior.specs())
        if "Ri" in has and self.skin.level != "constant":
            raise InputError(
                f"[device] Ri, a leak, is not modelled with [skin] level = '{self.skin.level}'; use level = 'constant',"
                " or leave Ri out"
            )
        if "Rgap" in has and "Cgap" not in has:
            raise InputError(
                "[gap] resistance needs what lies in parallel with it; give capacitance, or the thickness of air, too"
            )
        if self.force.model == "gap" and "Cgap" not in has:
            raise InputError(
                "[force] model = 'gap' needs a gap; give [gap] thickness or capacitance, or take model = 'paper'"
            )
        self.make_prior()
        self.fixed_values()
        return self

    def _unmeasured_parameters(self) -> dict[str, str]:
        """Return parameters that no recorded channel depends on, with what they need."""
        channels = {"sigma": "Vsc", "sigma_I": "I", "stray_capacitance": "I"}
        channels |= dict.fromkeys(("sigma_Ft", *self._friction_values()), "Ft")
        missing = {name: each for name, each in channels.items() if each not in self.measurement.channels}
        absent = {name: f"'{each}' among [measurement] channels" for name, each in missing.items()}
        if self.measurement.current_lead == "ground":
            absent.setdefault("stray_capacitance", "[measurement] current_lead = 'drive'")
        return absent

    def _check_friction(self) -> None:
        """Raise InputError if the friction is measured and what it needs is not stated."""
        if "Ft" not in self.measurement.channels:
            return
        has_load = self.friction.normal_force > 0.0 and "normal_force" in self.friction.model_fields_set
        if not has_load and self.prior.fN is None:
            raise InputError(
                "[measurement] channel Ft needs the normal force, because friction is mu (force + fN); give [friction]"
                " normal_force, or a prior for it as [prior] fN"
            )
        if isinstance(self.friction.coefficient, UncertainValue):
            raise InputError(
                "[friction] coefficient has a distribution, and the channel Ft measures it; write the distribution as"
                " [prior] mu"
            )


def _sentence(error: Any) -> str:
    """Return a pydantic error as one sentence with place and remedy."""
    where = [str(part) for part in error["loc"] if part not in _NO_KEYS]
    place = f"[{where[0]}] {'.'.join(where[1:])}".strip() if where else "the scene"
    if error["type"] == "extra_forbidden":
        model: type[Section] = Scene
        for name in where[:-1]:
            if name in model.model_fields:  # not a piece of [instrument.own]
                model = field_section(model.model_fields[name]) or PriorSpec  # the distribution of a number
        return f"{place} is not a key of a scene; {_suggest_key(where[-1], list(model.model_fields))}"
    message = str(error["msg"]).removeprefix("Value error, ")
    if error["type"] == "model_type":
        message = "not a table; write its keys in one"
    if error["type"] == "literal_error":
        known = re.findall("'([^']+)'", error["ctx"]["expected"])
        message = f"not a choice; {_suggest_key(str(error['input']), known)}"
    if message.startswith("["):  # the message already names the place
        return message
    value = error["input"]
    shown = f" = {value!r}" if isinstance(value, str | int | float | bool) else ""
    return f"{place}{shown}: {message[0].lower()}{message[1:]}"


def _suggest_key(word: str, known: list[str]) -> str:
    near = difflib.get_close_matches(word, known, n=1)
    return (f"did you mean '{near[0]}'? " if near else "") + f"known: {', '.join(known)}"
