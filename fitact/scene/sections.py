"""Sections of a scene file: keys, units, defaults and checks. Inside, every number is in SI units."""

import math
from fractions import Fraction
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from fitact.errors import InputError
from fitact.model.chirp import Chirp
from fitact.model.drive import Burst, Drive, Multitone, Periodic, Sine, Square, Trapezoid, Triangle
from fitact.model.force import plate_capacitance
from fitact.scene.section import (
    Ampere,
    Angle,
    AnyOhm,
    AnySecond,
    AnyVolt,
    Farad,
    Hertz,
    Meter,
    Newton,
    NoiseAmpere,
    NoiseVolt,
    Ohm,
    RelativeSD,
    Second,
    Section,
    Share,
    Threshold,
    Volt,
    VoltPerMeter,
)
from fitact.scene.threshold_table import ThresholdTable
from fitact.scene.uncertain_value import (
    UncertainCoefficient,
    UncertainFarad,
    UncertainMeter,
    UncertainPermittivity,
    UncertainSquareMeter,
)


class Device(Section):
    """Panel: insulator with its leak Ri (None means none), contact area, and limits of field and current."""

    Ci: Farad = 1.35e-9
    Ri: Ohm | None = None
    insulator_thickness: UncertainMeter = 1e-6
    insulator_permittivity: UncertainPermittivity = 3.9
    contact_area: UncertainSquareMeter = 1e-4
    breakdown_field: VoltPerMeter | None = None
    current_limit_rms: Ampere | None = None
    current_limit_peak: Ampere | None = None

    @model_validator(mode="after")
    def _derive_Ci(self) -> Self:
        if self.derives_Ci:
            Ci = plate_capacitance(self.insulator_permittivity, self.contact_area, self.insulator_thickness)
            object.__setattr__(self, "Ci", Ci)  # eq. (3); the model is frozen from here on
        return self

    @property
    def derives_Ci(self) -> bool:
        """Whether Ci follows from permittivity, area and thickness, eq. (3)."""
        stated = self.model_fields_set
        return "Ci" not in stated and {"insulator_thickness", "insulator_permittivity"} <= stated


class SkinSection(Section):
    """Skin layer; `alpha` is the exponent of a fractional skin (see `fitact.Fractional`)."""

    Rsc: Ohm = 160e3
    Csc: Farad = 22e-9
    thickness: UncertainMeter = 200e-6
    permittivity: UncertainPermittivity | None = None
    level: Literal["constant", "dispersive", "fractional"] = "constant"
    alpha: Annotated[float, Field(gt=0, le=1)] = 0.8

    @model_validator(mode="after")
    def _check_keys(self) -> Self:
        if "alpha" in self.model_fields_set and self.level != "fractional":
            raise ValueError(f"alpha belongs to level = 'fractional', not to '{self.level}'")
        if {"Csc", "permittivity"} <= self.model_fields_set:
            raise ValueError("[skin] Csc and permittivity state the same by eq. (3); leave one of them out")
        return self


class Grounding(Section):
    """Connection of the body to the ground of the device."""

    connection: Literal["direct", "natural"] = "direct"
    R_H: Ohm | None = None
    grounding_Rsc: Ohm | None = None
    grounding_Csc: Farad | None = None
    Z: AnyOhm | None = None
    Z_capacitance: Farad | None = None

    @model_validator(mode="after")
    def _check_Z(self) -> Self:
        if self.Z == 0.0 and self.Z_capacitance is not None:
            raise ValueError("Z = 0 shorts Z_capacitance; leave one of them out")
        if self.connection == "natural" and self.Z is None:
            raise ValueError("connection = 'natural' needs Z, the resistance to earth, such as '14.5 Mohm'")
        return self


class Gap(Section):
    """Gap between finger and panel; without any key there is none."""

    resistance: Ohm | None = None
    capacitance: Farad | None = None
    thickness: Meter | None = None


_PERIODIC_WAVEFORMS = ("sine", "triangle", "square", "trapezoid")
_KEY_WAVEFORMS = {  # keys of [drive] that belong to some waveforms only
    "peak_to_peak": (*_PERIODIC_WAVEFORMS, "burst", "chirp", "measured"),
    "frequency": (*_PERIODIC_WAVEFORMS, "burst", "measured"),
    "duty": ("square", "trapezoid", "burst"),
    "phase": (*_PERIODIC_WAVEFORMS, "burst", "chirp"),
    **dict.fromkeys(("shape", "cycles"), ("burst",)),
    **dict.fromkeys(("start_frequency", "end_frequency", "sweep_time", "spacing"), ("chirp",)),
    **dict.fromkeys(("frequencies", "amplitudes", "phases"), ("multitone",)),
}


class DriveSection(Section):
    """Voltage on the electrode."""

    waveform: Literal["sine", "triangle", "square", "trapezoid", "burst", "chirp", "multitone", "measured"] = "square"
    peak_to_peak: Volt = 360.0
    frequency: Hertz = 100.0
    rise_time: Second | None = None
    duty: Share = 0.5
    offset: AnyVolt = 0.0
    phase: Angle = 0.0
    shape: Literal["square", "sine", "triangle"] = "square"
    cycles: Annotated[int, Field(ge=1)] = 5
    start_frequency: Hertz | None = None
    end_frequency: Hertz | None = None
    sweep_time: Second | None = None
    spacing: Literal["linear", "logarithmic"] = "linear"
    frequencies: tuple[Hertz, ...] | None = Field(default=None, min_length=1)
    amplitudes: tuple[Volt, ...] | None = None
    phases: tuple[Angle, ...] | None = None
    steady_state: bool = True

    @model_validator(mode="after")
    def _check_waveform_keys(self) -> Self:
        if (self.waveform == "trapezoid") != (self.rise_time is not None):
            raise ValueError(
                "rise_time belongs to waveform = 'trapezoid', which needs it"
                f" (here: waveform = '{self.waveform}', rise_time {'absent' if self.rise_time is None else 'given'})"
            )
        for key, waveforms in _KEY_WAVEFORMS.items():
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
    def _start_from_rest(self) -> Self:
        if self.waveform in ("burst", "chirp"):
            if "steady_state" in self.model_fields_set and self.steady_state:
                raise ValueError(f"a {self.waveform} has no steady state; leave steady_state out, or make it false")
            object.__setattr__(self, "steady_state", False)  # bypasses the frozen model
        return self

    @model_validator(mode="after")
    def _check_tones(self) -> Self:
        if self.waveform != "multitone":
            return self
        if self.frequencies is None or self.amplitudes is None:
            raise ValueError("waveform = 'multitone' needs frequencies and amplitudes, a list of each")
        for key in ("amplitudes", "phases"):
            values = getattr(self, key)
            if values is not None and len(values) != len(self.frequencies):
                raise ValueError(f"{key} has {len(values)} values for {len(self.frequencies)} frequencies")
        if len(set(self.frequencies)) < len(self.frequencies):
            raise ValueError("frequencies must differ; add the amplitudes of one tone up")
        if max(self.frequencies) / self.lowest_frequency > Multitone.max_order:
            raise ValueError(
                f"frequencies must be multiples, up to {Multitone.max_order}, of one frequency (these: of"
                f" {self.lowest_frequency:.6g} Hz)"
            )
        return self

    @property
    def lowest_frequency(self) -> float:
        """Lowest frequency, Hz; for several tones, the frequency at which they repeat together."""
        if self.frequencies is not None:
            tones = [Fraction(repr(tone)) for tone in self.frequencies]
            whole = math.lcm(*(tone.denominator for tone in tones))
            return math.gcd(*(int(tone * whole) for tone in tones)) / whole
        return min(self.start_frequency or self.frequency, self.end_frequency or self.frequency)

    @property
    def swing(self) -> float:
        """Difference between the largest and the smallest voltage, V."""
        if self.waveform != "multitone":
            return self.peak_to_peak
        samples = 64 * Multitone.max_order  # of a period; 64 of the fastest tone are within 0.1 % of its peak
        return float(np.ptp(self.make().value(np.arange(samples) / samples / self.lowest_frequency)))

    def make(self) -> Drive:
        """Make the drive; refused if the waveform is 'measured', which only a record has."""
        if self.waveform == "chirp":
            sweep = self.start_frequency, self.end_frequency, self.sweep_time
            return Chirp(self.peak_to_peak, *sweep, self.spacing, self.offset, self.phase)
        if self.waveform == "burst":
            return Burst(self._wave(self.shape), self.cycles)
        if self.waveform == "multitone":
            orders = tuple(round(tone / self.lowest_frequency) for tone in self.frequencies or ())
            return Multitone(self.lowest_frequency, orders, self.amplitudes or (), self.phases or (), self.offset)
        return self._wave(self.waveform)

    def _wave(self, shape: str) -> Periodic:
        height, offset, phase = (self.peak_to_peak, self.frequency), self.offset, self.phase
        if shape in ("sine", "triangle"):
            return (Sine if shape == "sine" else Triangle)(*height, offset, phase)
        if shape == "square":
            return Square(*height, self.duty, offset, phase)
        if shape == "trapezoid":
            return Trapezoid(*height, self.rise_time, self.duty, offset, phase)
        raise InputError(
            f"scene: [drive] waveform = '{shape}' gives no drive to compute; name sine, triangle, square, trapezoid,"
            " burst, chirp or multitone, or give the record that has it where the command takes one (--record)"
        )


class Measurement(Section):
    """Recorded channels, their noise and gain errors, the lead of I, series resistor, probe and stray capacitance."""

    channels: tuple[Literal["Vsc", "I", "Ft"], ...] = Field(default=("Vsc",), min_length=1)
    series_resistor: AnyOhm = 0.0
    probe_resistance: Ohm | None = None
    probe_capacitance: Farad | None = None
    stray_capacitance: UncertainFarad | None = None
    current_lead: Literal["drive", "ground"] = "drive"
    sampling_rate: Hertz = 200e3
    duration: Second = 20e-3
    noise_V: NoiseVolt | None = None
    noise_Vsc: NoiseVolt = 0.1
    noise_I: NoiseAmpere = 20e-9
    noise_Ft: Newton = 2e-3
    gain_relative_sd: RelativeSD = 0.0
    gain_I_relative_sd: RelativeSD = 0.0
    weighting: Literal["estimated", "modulus", "unit", "stated"] = "estimated"
    spectrum_relative_sd: RelativeSD = 0.0
    spectrum_floor_sd: AnyOhm = 0.0
    noise_model: Literal["white", "student", "ar1", "spectrum"] = "white"
    quiet: tuple[AnySecond, AnySecond] | None = None

    @model_validator(mode="after")
    def _check_keys(self) -> Self:
        if self.channels == ("Ft",):
            raise ValueError(
                "[measurement] channels = ['Ft']: the friction alone does not determine the circuit; add Vsc or I"
            )
        if (self.noise_model == "spectrum") != (self.quiet is not None):
            raise ValueError(
                '[measurement] noise_model = \'spectrum\' and quiet = ["0 ms", "5 ms"], the stretch in which the drive'
                " rests, go together; give both or neither"
            )
        if (self.weighting == "stated") != (self.spectrum_relative_sd > 0.0 or self.spectrum_floor_sd > 0.0):
            raise ValueError(
                "[measurement] weighting = 'stated' needs spectrum_relative_sd, the standard deviation relative to the"
                " magnitude, or spectrum_floor_sd (ohm), which belong to it; give both or neither"
            )
        if self.quiet is not None and not self.quiet[0] < self.quiet[1]:
            raise ValueError("[measurement] quiet ends before it begins; write the earlier time first")
        return self


class Friction(Section):
    """Friction coefficient and normal force of eq. (2), and the sensor that records the friction (channel Ft)."""

    coefficient: UncertainCoefficient = 0.5
    normal_force: Newton = 0.5
    sensor_frequency: Hertz | None = None
    sensor_damping: Share | None = None

    @model_validator(mode="after")
    def _check_sensor(self) -> Self:
        if self.sensor_damping is not None and self.sensor_frequency is None:
            raise ValueError("[friction] sensor_damping belongs to sensor_frequency; give both, or leave it out")
        return self


class ForceSection(Section):
    """Force law: eq. (22) of the reference paper from Vsc, or an interface gap."""

    model: Literal["paper", "gap"] = "paper"


class Perception(Section):
    """Perception threshold, the same at all frequencies, or a table of thresholds over the frequency."""

    threshold_force: Threshold | None = None
    thresholds: ThresholdTable | None = None
    friction_change: Annotated[float, Field(gt=0)] | None = None
    source: str | None = None

    @model_validator(mode="after")
    def _check_number(self) -> Self:
        names = "threshold_force", "thresholds", "friction_change"
        stated = [name for name in names if getattr(self, name) is not None]
        if len(stated) > 1:
            raise ValueError(f"[perception] states {' and '.join(stated)}, of which one can hold; leave out the others")
        return self

    @property
    def threshold_source(self) -> str | None:
        """Where the threshold comes from, by its table or, if that does not say so, as stated here."""
        return (self.thresholds and self.thresholds.source) or self.source


class PopulationSection(Section):
    """Contact area of the fingers, common or varying, and the variability of thicknesses."""

    contact_area: Literal["common", "varies"] = "common"
    skin_thickness_relative_sd: RelativeSD = 0.0
    insulator_thickness_relative_sd: RelativeSD = 0.0


class Tolerance(Section):
    """Accepted relative error of the force."""

    force: Share = 0.01
