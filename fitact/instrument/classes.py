"""Classes of instruments with the limits of error that their makers specify."""

import dataclasses
import math


@dataclasses.dataclass(frozen=True)
class InstrumentClass:
    """Limits of error of a class of instruments; None means that the class has no such error, or none is specified."""

    source: str  # where the figures come from
    gain: float | None = None  # relative
    offset: float | None = None  # relative to the range
    nonlinearity: float | None = None  # integral non-linearity, relative to the range
    skew: float | None = None  # between its channels, s
    skew_intervals: float | None = None  # the same in sampling intervals
    compensation: float | None = None  # error of the high-frequency gain relative to that at low frequency
    # value and relative limits of the input resistance (ohm) and capacitance (F)
    resistance: tuple[float, float] | None = None
    capacitance: tuple[float, float] | None = None


CLASSES = {
    "scope-8bit": InstrumentClass(
        "Tektronix TPS2000B, PicoScope 2205 MSO and Rigol DS2000 manuals; INL of 1 LSB: Tektronix TDS7104 manual",
        gain=0.03,
        offset=0.1 / 8.0,  # 0.1 of 8 divisions
        nonlinearity=1.0 / 256.0,
        skew=1e-9,
        resistance=(1e6, 0.01),
        capacitance=(20e-12, 0.25),
    ),
    "daq-16bit": InstrumentClass(
        "National Instruments sbRIO-961x manual, Advantech PCI-1716 data sheet",
        gain=0.0005,
        offset=0.00035,
        nonlinearity=80e-6,
        skew_intervals=1.0,  # of a converter that scans its channels
    ),
    "probe-10x": InstrumentClass(
        "attenuation: 1 % resistors in probe and oscilloscope, at most 1.8 %; load: Tektronix probe manuals",
        gain=0.02,
        compensation=0.02,
        resistance=(10e6, 0.02),
        capacitance=(12e-12, 0.25),
    ),
    "impedance-analyser": InstrumentClass(
        "Gamry, application note on accurate EIS: 99 % accuracy within the contour of the Interface 1010", gain=0.01
    ),
    "force-sensor": InstrumentClass("no limits: its certificate states them, under [instrument.own]"),
    "shunt-1%": InstrumentClass("the tolerance of the resistor", gain=0.01),
    "shunt-0.1%": InstrumentClass("the tolerance of the resistor", gain=0.001),
}

# equipment of a channel for which nobody states any, as an example of what it adds
TYPICAL = {
    "V": ("scope-8bit", "probe-10x"),
    "Vsc": ("scope-8bit", "probe-10x"),
    "I": ("scope-8bit", "shunt-1%"),
    "Z": ("impedance-analyser",),
    "Ft": ("force-sensor",),
}


# largest stray capacitance of panel and cable that is usual, F
USUAL_STRAY = 100e-12


def typical_gains(channel: str) -> dict[str, float]:
    """Return the limits of the relative gain error of a channel's `TYPICAL` equipment, by class."""
    return {name: gain for name in TYPICAL[channel] if (gain := CLASSES[name].gain)}


def typical_gain_u(channel: str) -> float:
    """Return the relative standard uncertainty of the gain of a channel with `TYPICAL` equipment."""
    return math.hypot(*typical_gains(channel).values()) / math.sqrt(3.0)  # of uniform distributions
