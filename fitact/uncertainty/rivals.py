"""Effects that a model may lack, of the circuit, the skin and the instruments, with their plausible sizes."""

import functools
import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from fitact.instrument.effects import PROBE_TIME_CONSTANT
from fitact.uncertainty.channel_series import ChannelSeries, Rows
from fitact.uncertainty.loop import Addition, ChannelModel

CHANGE = "a change during the record of "  # begins the names of changes of the finger, which a track follows
_AREA = {"Rsc": -1.0, "Csc": 1.0, "Ci": 1.0, "Ri": -1.0}
_CHANGES = {"Rsc": {"Rsc": 1.0}, "Csc": {"Csc": 1.0}, "the contact area": _AREA}

# of the mains and their harmonics, Hz
_HUM = sorted({k * mains for mains in (50.0, 60.0) for k in range(1, 9)})
Amplitudes = Float[np.ndarray, " amplitudes"]
# the change of a channel by amplitudes
Effect = Callable[[ChannelModel, Amplitudes], Rows]


class Rival(NamedTuple):
    """One possible cause of structure in residuals."""

    name: str  # for people, with its article
    size: float  # largest plausible amplitude, in the unit of the effect
    effect: Effect  # signal with this cause
    amplitudes: int = 1  # number of amplitudes
    is_positive: bool = False  # whether a negative amplitude is impossible
    is_certain: bool = False  # whether it always exists to some degree


def known_rivals() -> tuple[Rival, ...]:
    """Return all causes that are considered, each with its largest plausible size and the reason for it."""
    return (
        # channels of a scanning converter are sampled up to 1 / (rate x channels) apart: 20 us at 50 kHz
        Rival("a delay", 20e-6, _delay),
        # an anti-alias filter or amplifier of 8 kHz and more
        Rival("a low-pass filter", 20e-6, _lowpass, is_positive=True),
        # body and leads: 0.5 to 1 kohm; current-limiting resistors up to 100 kohm
        Rival("a series resistor", 100e3, functools.partial(_circuit, "resistor"), is_positive=True),
        # one passive probe of 10 Mohm || 12 pF (Tektronix: 8 to 12 pF)
        Rival("the load of a probe", 1.5, functools.partial(_circuit, "probe"), is_positive=True),
        # a few pF remain of unshielded leads after an open compensation
        Rival("the stray capacitance of leads", 1.0, functools.partial(_circuit, "leads")),
        # a trimmer that is off by a tenth; the time constant of a passive probe is 9 Mohm x 12.2 pF
        Rival("the compensation of a probe", 0.1, _compensation),
        # the corner of an oscilloscope's AC coupling: 5 to 10 Hz; 20 Hz with a 10x probe's divider undone
        Rival("AC coupling", 20.0, _ac_coupling, is_positive=True),
        # palm, forearm or a wet finger: resistances differ by a factor of two
        Rival("unequal skins", 1.0, functools.partial(_circuit, "inequality")),
        # two layers whose time constants differ by a factor of four about their mean
        Rival("a skin of two layers", 0.4, functools.partial(_circuit, "layers"), is_positive=True, is_certain=True),
        # exponents of skin in the literature: 0.75 to 1
        Rival("a constant-phase skin", 0.25, functools.partial(_circuit, "dispersion"), is_positive=True),
        # an interface gap of a few Mohm
        Rival("an interface gap", 5.0, functools.partial(_circuit, "gap"), is_positive=True),
        # the conductance of skin grows by a third at the voltages of electrovibration
        Rival("a non-linear skin", 0.3, _nonlinear_skin),
        # an 8-bit converter: one step is 0.4 % of the range; 2 % for a bad one
        *(Rival("the non-linearity of the ADC", 0.02, functools.partial(_adc, shape), n) for shape, n in _ADC_SHAPES),
        # hum of a tenth of the signal
        *(Rival(f"hum at {f:g} Hz", 0.1, functools.partial(_hum, f), 2) for f in _HUM),
        # a thermal drift of 1 % of the signal
        Rival("a drift", 0.01, _drift),
        # the skin moistens, and the contact grows or shrinks, by a factor of two while a finger slides
        *(Rival(f"{CHANGE}{name}", 0.35, functools.partial(_change, powers)) for name, powers in _CHANGES.items()),
        # instruments warm up by 1 %
        Rival("a change of gain during the record", 0.02, _warm_up),
    )


def _circuit(field: str, model: ChannelModel, a: Amplitudes) -> Rows:
    return model.signal_with(Addition(**{field: float(a[0])}))


def _delay(model: ChannelModel, a: Amplitudes) -> Rows:
    return model.signal_filtered(np.exp(-a[0] * model.series.difference))


def _lowpass(model: ChannelModel, a: Amplitudes) -> Rows:
    return model.signal_filtered(1.0 / (1.0 + a[0] * model.s))


def _compensation(model: ChannelModel, a: Amplitudes) -> Rows:
    x = model.s * PROBE_TIME_CONSTANT
    return model.signal_filtered(1.0 + a[0] * x / (1.0 + x))


def _ac_coupling(model: ChannelModel, a: Amplitudes) -> Rows:
    if model.series.samples.channel == "impedance":
        return model.signal
    s, corner = model.s, 2.0 * math.pi * a[0]
    return model.signal_filtered(np.where(s == 0.0, 0.0, s / np.where(s == 0.0, 1.0, s + corner)))


def _nonlinear_skin(model: ChannelModel, a: Amplitudes) -> Rows:
    """Return the signal if the conductance of each skin grows by `a` at the peak of the voltage, to first order."""
    series, parts, signal = model.series, model.parts, model.signal
    if series.samples.omega is not None:
        return signal
    if series.samples.channel == "I":
        ways = (parts.touching * parts.admittance, parts.grounding * parts.admittance)
        voltages = [series.response(way, series.voltage, series.jump) for way in ways]
    else:
        ways = (
            -parts.touching * (1.0 - parts.admittance * parts.touching),
            parts.touching * parts.grounding * parts.admittance,
        )
        other = series.response(parts.grounding * parts.admittance, series.voltage, series.jump)
        voltages = [signal, other]
    for way, voltage, resistance in zip(ways, voltages, parts.skin_resistances, strict=True):
        peak = float(np.max(np.abs(voltage)))
        if peak > 0.0 and resistance > 0.0:
            current = a[0] / resistance * voltage * (voltage / peak) ** 2
            signal = signal + model.record(way, current)
    return signal


# powers of the signal, and a wave over the range
_ADC_SHAPES: tuple[tuple[Callable[[Rows], Float[np.ndarray, "amplitudes rows"]], int], ...] = (
    (lambda x: x[None] ** 2, 1),
    (lambda x: x[None] ** 3, 1),
    (lambda x: np.stack([np.sin(4.0 * math.pi * x), np.cos(4.0 * math.pi * x)]), 2),
)


def _adc(shape: Callable[[Rows], Float[np.ndarray, "amplitudes rows"]], model: ChannelModel, a: Amplitudes) -> Rows:
    signal = model.signal
    if model.series.samples.omega is not None:  # the harmonics are no part of a spectrum
        return signal
    full_scale = 1.2 * float(np.max(np.abs(signal)))
    return signal + full_scale * (a @ shape(signal / full_scale))


def _hum(frequency: float, model: ChannelModel, a: Amplitudes) -> Rows:
    series, signal = model.series, model.signal
    cycles = frequency * (series.time[-1] - series.time[0] + series.step)  # a whole number in each period
    if frequency * series.step >= 0.5 or (series.kind == "period" and abs(cycles - round(cycles)) > 1e-3):
        return signal
    angle = 2.0 * math.pi * frequency * series.time
    return signal + float(np.max(np.abs(signal))) * (a[0] * np.cos(angle) + a[1] * np.sin(angle))


def _progress(series: ChannelSeries) -> Rows:
    """Return the time from -1 to 1 over the record; 0 if the rows are means over periods."""
    return np.linspace(-1.0, 1.0, series.time.size) * (series.kind != "period")


def _drift(model: ChannelModel, a: Amplitudes) -> Rows:
    return model.signal + a[0] * float(np.max(np.abs(model.signal))) * _progress(model.series)


def _warm_up(model: ChannelModel, a: Amplitudes) -> Rows:
    return model.signal * (1.0 + a[0] * _progress(model.series))


def _change(powers: Mapping[str, float], model: ChannelModel, a: Amplitudes) -> Rows:
    """Return the signal if parameters of the finger, with these `powers`, go from e^-a to e^a over the record."""
    changed = {name: (model.values[name] or 0.0) * math.exp(power * float(a[0])) for name, power in powers.items()}
    return model.signal + (model.signal_with(**changed) - model.signal) * _progress(model.series)
