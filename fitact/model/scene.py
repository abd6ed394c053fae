"""Scene: the device, the skin, how it is grounded and driven, what is measured and what is believed.

Read from TOML, where quantities carry units ("160 kohm"); inside, every number is SI. An empty scene
is the paper's nominal device.
"""

import difflib
import json
import math
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, TypeAlias

import pydantic
from pydantic import BeforeValidator, ConfigDict, Field, model_validator

from fitact import units
from fitact.errors import InputError
from fitact.model.chirp import Chirp
from fitact.model.circuit import Circuit, DirectGround, FinalCircuit, NaturalGround, Probe
from fitact.model.drive import Burst, Drive, Periodic, Sine, Square, Trapezoid, Triangle
from fitact.model.force import plate_capacitance
from fitact.model.prior import Distribution, LogNormal, Prior, Uniform
from fitact.model.skin import Dispersive, Fractional, WithSkin


def _quantity(unit: str, **bounds: Any) -> Any:
    """The type of a field in `unit`: SI floats inside, text with units accepted."""
    return Annotated[float, BeforeValidator(lambda value: units.parse(value, unit)), Field(**bounds)]


if TYPE_CHECKING:
    Ohm: TypeAlias = float
    Farad: TypeAlias = float
    Meter: TypeAlias = float
    SquareMeter: TypeAlias = float
    Second: TypeAlias = float
    Hertz: TypeAlias = float
    Ratio: TypeAlias = float
    Volt: TypeAlias = float
    Angle: TypeAlias = float
    AnyVolt: TypeAlias = float
    AnyOhm: TypeAlias = float
    NoiseVolt: TypeAlias = float
    NoiseAmpere: TypeAlias = float
    Newton: TypeAlias = float
    Threshold: TypeAlias = float
else:
    Ohm = _quantity("ohm", gt=0)
    Farad = _quantity("F", gt=0)
    Meter = _quantity("m", gt=0)
    SquareMeter = _quantity("m^2", gt=0)
    Second = _quantity("s", gt=0)
    Hertz = _quantity("Hz", gt=0)
    Ratio = _quantity("", gt=0)
    Volt = _quantity("V", gt=0)
    Angle = _quantity("rad")
    AnyVolt = _quantity("V")
    AnyOhm = _quantity("ohm", ge=0)
    NoiseVolt = _quantity("V", ge=0)
    NoiseAmpere = _quantity("A", ge=0)
    Newton = _quantity("N", ge=0)
    Threshold = _quantity("N", gt=0)


class _Section(pydantic.BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Device(_Section):
    """The panel."""

    Ci: Farad = 1.35e-9
    insulator_thickness: Meter = 1e-6
    insulator_permittivity: Ratio = 3.9
    contact_area: SquareMeter = 1e-4

    @model_validator(mode="after")
    def _capacitance_of_the_layer(self) -> Self:
        given = self.model_fields_set
        if "Ci" not in given and {"insulator_thickness", "insulator_permittivity"} <= given:
            Ci = plate_capacitance(self.insulator_permittivity, self.contact_area, self.insulator_thickness)
            object.__setattr__(self, "Ci", Ci)  # eq. (3); the model is frozen from here on
        return self


class Skin(_Section):
    """One skin layer; `alpha` is the exponent of a fractional one (see `fitact.Fractional`)."""

    Rsc: Ohm = 160e3
    Csc: Farad = 22e-9
    thickness: Meter = 200e-6
    level: Literal["constant", "dispersive", "fractional"] = "constant"
    alpha: Annotated[float, Field(gt=0, le=1)] = 0.8

    @model_validator(mode="after")
    def _alpha_of_a_fractional_skin(self) -> Self:
        if "alpha" in self.model_fields_set and self.level != "fractional":
            raise ValueError(f"alpha belongs to level = 'fractional', not to '{self.level}'")
        return self


class Grounding(_Section):
    """How the body is connected to the device's ground."""

    connection: Literal["direct", "natural"] = "direct"
    R_H: Ohm | None = None
    grounding_Rsc: Ohm | None = None
    grounding_Csc: Farad | None = None
    Z: Ohm | None = None

    @model_validator(mode="after")
    def _Z_of_natural_ground(self) -> Self:
        if self.connection == "natural" and self.Z is None:
            raise ValueError("connection = 'natural' needs Z, the resistance to earth, such as '14.5 Mohm'")
        return self


_WAVES = ("sine", "triangle", "square", "trapezoid")
_WAVEFORMS_OF = {  # the keys of [drive] that only some waveforms have
    "frequency": (*_WAVES, "burst", "measured"),
    "duty": ("square", "trapezoid", "burst"),
    "phase": (*_WAVES, "burst", "chirp"),
    "shape": ("burst",),
    "cycles": ("burst",),
    "start_frequency": ("chirp",),
    "end_frequency": ("chirp",),
    "sweep_time": ("chirp",),
    "spacing": ("chirp",),
}


class DriveSection(_Section):
    """The voltage on the electrode."""

    waveform: Literal["sine", "triangle", "square", "trapezoid", "burst", "chirp", "measured"] = "square"
    peak_to_peak: Volt = 360.0
    frequency: Hertz = 100.0
    rise_time: Second | None = None
    duty: Annotated[float, Field(gt=0, lt=1)] = 0.5
    offset: AnyVolt = 0.0
    phase: Angle = 0.0
    shape: Literal["square", "sine", "triangle"] = "square"
    cycles: Annotated[int, Field(ge=1)] = 5
    start_frequency: Hertz | None = None
    end_frequency: Hertz | None = None
    sweep_time: Second | None = None
    spacing: Literal["linear", "logarithmic"] = "linear"
    steady_state: bool = True

    @model_validator(mode="after")
    def _keys_of_the_waveform(self) -> Self:
        if (self.waveform == "trapezoid") != (self.rise_time is not None):
            raise ValueError(
                "rise_time belongs to waveform = 'trapezoid', which needs it"
                f" (here: waveform = '{self.waveform}', rise_time {'absent' if self.rise_time is None else 'given'})"
            )
        for key, waveforms in _WAVEFORMS_OF.items():
            if key in self.model_fields_set and self.waveform not in waveforms:
                raise ValueError(f"{key} belongs to the waveforms {', '.join(waveforms)}, not to '{self.waveform}'")
        if "duty" in self.model_fields_set and self.waveform == "burst" and self.shape != "square":
            raise ValueError(f"duty belongs to a burst of shape = 'square', not '{self.shape}'")
        if self.waveform == "chirp" and None in (self.start_frequency, self.end_frequency, self.sweep_time):
            raise ValueError("waveform = 'chirp' needs start_frequency, end_frequency and sweep_time")
        if self.rise_time is not None and self.rise_time >= min(self.duty, 1.0 - self.duty) / self.frequency:
            raise ValueError("rise_time must be shorter than the high and the low part of the period")
        return self

    @model_validator(mode="after")
    def _from_rest(self) -> Self:
        if self.waveform in ("burst", "chirp"):
            if "steady_state" in self.model_fields_set and self.steady_state:
                raise ValueError(f"a {self.waveform} has no steady state; leave steady_state out, or make it false")
            object.__setattr__(self, "steady_state", False)  # the model is frozen from here on
        return self

    @property
    def slowest(self) -> float:
        """The lowest frequency in it, Hz."""
        return min(self.start_frequency or self.frequency, self.end_frequency or self.frequency)

    def make(self) -> Drive:
        """The drive.

        Raises:
            InputError: the waveform is 'measured', so only a record has it.
        """
        if self.waveform == "chirp":
            start, end, duration = self.start_frequency, self.end_frequency, self.sweep_time
            assert None not in (start, end, duration)  # checked when the section was read
            return Chirp(self.peak_to_peak, start, end, duration, self.spacing, self.offset, self.phase)
        if self.waveform == "burst":
            return Burst(self._wave(self.shape), self.cycles)
        return self._wave(self.waveform)

    def _wave(self, shape: str) -> Periodic:
        height, offset, phase = (self.peak_to_peak, self.frequency), self.offset, self.phase
        if shape == "sine":
            return Sine(*height, offset, phase)
        if shape == "triangle":
            return Triangle(*height, offset, phase)
        if shape == "square":
            return Square(*height, self.duty, offset, phase)
        if shape == "trapezoid":
            assert self.rise_time is not None  # checked when it was read
            return Trapezoid(*height, self.rise_time, self.duty, offset, phase)
        raise InputError(
            f"scene: [drive] waveform = '{shape}' gives no drive to compute; name sine, triangle, square, trapezoid,"
            " burst or chirp"
        )


class Measurement(_Section):
    """What is recorded, and through what."""

    channels: tuple[Literal["Vsc", "I"], ...] = Field(default=("Vsc",), min_length=1)
    series_resistor: AnyOhm = 0.0
    probe_resistance: Ohm | None = None
    probe_capacitance: Farad | None = None
    sampling_rate: Hertz = 200e3
    duration: Second = 20e-3
    noise_Vsc: NoiseVolt = 0.1
    noise_I: NoiseAmpere = 20e-9
    gain_relative_sd: Annotated[float, Field(ge=0, lt=1)] = 0.0


class Friction(_Section):
    """Eq. (2)."""

    coefficient: Annotated[float, Field(gt=0)] = 0.5
    normal_force: Newton = 0.5


class Belief(_Section):
    """A prior for one parameter: a log-normal (median with factor or relative_sd), or uniform (low, high)."""

    median: float | None = Field(default=None, gt=0)
    factor: float | None = Field(default=None, gt=1, le=1e6)
    relative_sd: float | None = Field(default=None, gt=0, le=10)
    low: float | None = Field(default=None, gt=0)
    high: float | None = Field(default=None, gt=0)

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        given = self.model_fields_set
        kinds = (
            {"low", "high"},
            {"factor"},
            {"relative_sd"},
            {"median", "factor"},
            {"median", "relative_sd"},
        )
        if given not in kinds:
            raise ValueError("write {median, factor}, {median, relative_sd} or {low, high}")
        if self.low is not None and self.high is not None and not self.low < self.high:
            raise ValueError(f"low = {self.low:g} must be below high = {self.high:g}")
        return self

    def distribution(self, median: float) -> Distribution:
        """The distribution; `median` where none is given."""
        if self.low is not None and self.high is not None:
            return Uniform(self.low, self.high)
        median = self.median or median
        if self.factor is not None:
            return LogNormal.within_factor(median, self.factor)
        assert self.relative_sd is not None  # _one_kind leaves nothing else
        return LogNormal.with_relative_sd(median, self.relative_sd)


def _belief(unit: str) -> Any:
    def parse(value: object) -> object:
        if not isinstance(value, dict):
            return value
        return {k: units.parse(v, unit) if k in ("median", "low", "high") else v for k, v in value.items()}

    return Annotated[Belief, BeforeValidator(parse)]


if TYPE_CHECKING:
    BeliefOhm: TypeAlias = Belief
    BeliefFarad: TypeAlias = Belief
else:
    BeliefOhm = _belief("ohm")
    BeliefFarad = _belief("F")


class PriorSection(_Section):
    """Beliefs; where one is silent on the median, the device's or the skin's value is it.

    The skin's defaults reach, within their 95 %, from the paper's values to published whole-skin ones
    (10 kohm and 5 nF dry, 4.3 kohm and 200 nF wet); the insulator's is a data sheet's 5 %.
    """

    Rsc: BeliefOhm = Belief(factor=50.0)
    Csc: BeliefFarad = Belief(factor=20.0)
    Ci: BeliefFarad = Belief(relative_sd=0.05)


class ForceSection(_Section):
    """Which voltage makes the force."""

    model: Literal["paper", "gap"] = "paper"


class Perception(_Section):
    """What counts as felt."""

    threshold_force: Threshold | None = None
    friction_change: Annotated[float, Field(gt=0)] | None = None


class PopulationSection(_Section):
    """What fingers on one panel share."""

    contact_area: Literal["common", "varies"] = "common"


class Tolerance(_Section):
    """The relative error the user accepts."""

    force: Annotated[float, Field(gt=0, lt=1)] = 0.01


class Scene(_Section):
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
            return NaturalGround(Rsc, Csc, Ci, ground.Z, series_resistor=series, probe=probe)
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
