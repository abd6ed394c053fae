"""Transfer functions of the circuit's loop in NumPy, also with what the model of a fit lacks."""

import dataclasses
import functools
import types
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from fitact.instrument.effects import PROBE_TIME_CONSTANT, nonlinearity_shapes
from fitact.likelihood.likelihood import Likelihood
from fitact.model.circuit import FINGER_PARAMETERS, FinalCircuit, NaturalGround
from fitact.model.skin import Fractional, WithSkin, constant_skin_circuit
from fitact.uncertainty.channel_series import ChannelSeries, Rows, Spectrum


class Addition(NamedTuple):
    """Circuit elements that a model lacks, by their amplitude; 0 omits each."""

    probe: float = 0.0  # probes of 10 Mohm || 12 pF across the touching skin
    resistor: float = 0.0  # in series, ohm
    inequality: float = 0.0  # relative excess of the resistance of the grounding skin
    layers: float = 0.0  # relative variance of the time constants of two layers in each skin
    dispersion: float = 0.0  # 1 - exponent of the skins
    gap: float = 0.0  # interface gaps of 1 Mohm || 5 nF
    leads: float = 0.0  # stray capacitances of 10 pF between the terminals of an analyser


NOTHING = Addition()


class LoopImpedances(NamedTuple):
    """Impedances of the loop, ohm."""

    touching: Spectrum  # touching skin with its probe
    grounding: Spectrum  # grounding skin, or the environment
    skin_resistances: tuple[float, float]  # of the touching and the grounding skin
    admittance: Spectrum  # of the whole loop, S
    leads: Spectrum  # admittance between the terminals of an analyser, S

    def gain(self, channel: str) -> Spectrum:
        """Return the ratio of a channel to V, or the impedance (ohm)."""
        if channel == "impedance":
            return 1.0 / (self.admittance + self.leads)
        return self.admittance if channel == "I" else self.touching * self.admittance


class LoopModel(NamedTuple):
    """A circuit as the values of its parameters."""

    kind: type  # class of the circuit with constant skins
    is_probed: bool = True  # whether the circuit's probe, if any, is connected

    @classmethod
    def from_likelihood(cls, likelihood: Likelihood) -> "LoopModel | None":
        """Return the circuit of a likelihood; None for a skin that is known by tabulated values only."""
        template = likelihood.template
        if isinstance(template, WithSkin) and not isinstance(template.skin, Fractional):
            return None
        return cls(type(constant_skin_circuit(template)))

    def impedances(self, values: Mapping[str, Any], s: Spectrum, added: Addition = NOTHING) -> LoopImpedances:
        """Return the impedances for the `Likelihood.parameter_values` at `s` (rad/s, complex), with what is `added`."""
        get = values.get
        R, C, Ci = (float(values[name] or 0.0) for name in FINGER_PARAMETERS)
        alpha = (get("alpha") or 1.0) - added.dispersion
        touching = _skin(R, C, s, alpha, added.layers)
        load = added.probe * (1e-7 + s * 12e-12)
        if self.is_probed and "probe_resistance" in values:
            load = load + 1.0 / values["probe_resistance"] + s * values["probe_capacitance"]
        touching = touching / (1.0 + touching * load)
        grounding, R2 = np.zeros_like(s), 0.0
        series: Any = added.resistor + (get("R_H") or 0.0) + (get("series_resistor") or 0.0)
        if self.kind is not NaturalGround:
            equal = self.kind is FinalCircuit
            R2 = (R if equal else get("grounding_Rsc") or R) * (1.0 + added.inequality)
            grounding = _skin(R2, C if equal else get("grounding_Csc") or C, s, alpha, added.layers)
        elif Z := get("Z"):
            grounding = Z / (1.0 + s * Z * (get("Z_capacitance") or 0.0))
        insulator: Any = s * Ci + (1.0 / Ri if (Ri := get("Ri")) else 0.0)  # its admittance, S
        if Cgap := get("Cgap"):
            Rgap = get("Rgap")
            if not Rgap:  # the insulator, in series with an open gap
                insulator = s * Cgap * insulator / (insulator + s * Cgap) if Ri else s * (Ci * Cgap / (Ci + Cgap))
            series = series + (Rgap / (1.0 + s * Rgap * Cgap) if Rgap else 0.0)
        series = series + added.gap * 1e6 / (1.0 + s * 5e-3)
        admittance = insulator / (1.0 + insulator * (touching + grounding + series))
        return LoopImpedances(touching, grounding, (R, R2), admittance, added.leads * 10e-12 * s)


def _skin(R: float, C: float, s: Spectrum, alpha: float, layers: float) -> Spectrum:
    """Return the impedance of a skin of total resistance R and series capacitance C, ohm.

    `layers` is the relative variance of the time constants of two layers of equal resistance.
    """
    x = (s * (R * C / (1.0 - layers))) ** alpha
    return R * (1.0 + x) / ((1.0 + x) ** 2 - layers * x * x)


class Instrument(NamedTuple):
    """How a channel is recorded."""

    gain: float = 1.0
    delay: float = 0.0  # s
    clock: float = 0.0  # relative deviation of the drive's frequency
    effects: Mapping[str, float] = types.MappingProxyType({})  # size of each error, by name


class ChannelModel:
    """Signal of one channel at one set of parameter values, and with changes of the circuit or the instrument."""

    def __init__(
        self, series: ChannelSeries, loop: LoopModel, values: Mapping[str, Any], instrument: Instrument
    ) -> None:
        """Set the rows, the circuit and its values, and the instrument."""
        self.series, self.values, self.instrument = series, values, instrument
        # an analyser is connected without the probe
        self.loop = loop._replace(is_probed=series.samples.channel != "impedance")
        self.s = series.frequencies

    @functools.cached_property
    def parts(self) -> LoopImpedances:
        """Impedances at the frequencies of the FFT."""
        return self.loop.impedances(self.values, self.s)

    @functools.cached_property
    def signal(self) -> Rows:
        """Signal of the circuit as it is, V or A."""
        effects, x = self.instrument.effects, self.s * PROBE_TIME_CONSTANT
        signal = self._respond(self.parts, 1.0 + effects.get("compensation", 0.0) * x / (1.0 + x))
        own_sizes, drive_sizes = (
            np.array([effects.get(f"{name}_{shape}", 0.0) for shape in ("even", "odd")])
            for name in ("nonlinearity", "nonlinearity_V")
        )
        if own_sizes.any():
            signal = signal + own_sizes @ nonlinearity_shapes(signal)
        if drive_sizes.any():
            signal = signal + self._respond(self.parts, change=drive_sizes @ nonlinearity_shapes(self.series.voltage))
        return signal

    def signal_with(self, added: Addition = NOTHING, /, **changed: float) -> Rows:
        """Return the signal of the circuit with what is `added`, and `changed` values of its parameters, V or A."""
        return self._respond(self.loop.impedances({**self.values, **changed}, self.s, added))

    def signal_filtered(self, gain: Spectrum) -> Rows:
        """Return the signal behind a filter, V or A."""
        return self._respond(self.parts, gain)

    def record(self, gain: Spectrum, rows: Rows, jump: float = 0.0) -> Rows:
        """Return rows after a filter, as the instrument records them."""
        series, (factor, delay, clock, _) = self.series, self.instrument
        gain = factor * gain * (np.exp(-delay * series.difference) if delay else 1.0)
        signal = series.response(gain, rows, jump)
        if not clock:
            return signal
        return signal + clock * series.time * series.response(gain * series.difference, rows, jump)

    def with_charge(self) -> ChannelSeries:
        """Return the rows with the jump of V at the first sample that stands for the unknown charge there.

        The jump divides as any other. The transient of a fit is relative to a V that was 0 before the record.
        """
        series = self.series
        if not series.samples.unknown_charge or series.samples.channel == "I":
            return series
        gain = self.parts.touching * self.parts.admittance
        high = abs(gain[-1])
        decaying = (high - abs(gain[0])) or high  # what remains of a jump, with a leak, decays to the gain at zero
        first = high * float(series.voltage[0]) + series.samples.transient
        if series.repeats:
            before = float(series.response(gain, series.voltage)[0])
            return dataclasses.replace(series, jump=(first - before) / decaying)
        return dataclasses.replace(series, jump=series.samples.transient / decaying)

    def _respond(self, parts: LoopImpedances, filter_gain: Spectrum | float = 1.0, change: Rows | None = None) -> Rows:
        """Return the response to V, or to a `change` of it, behind a filter."""
        series, gain = self.series, parts.gain(self.series.samples.channel)
        if series.samples.channel == "I":
            gain = series.regular_gain(gain)
        drive = (series.voltage, series.jump) if change is None else (change, 0.0)
        return self.record(gain * filter_gain, *drive)
