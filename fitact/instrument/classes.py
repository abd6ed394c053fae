"""Classes of instruments with the limits of error that their makers specify."""

import math
from typing import Any

# Limits of error by class, whose source says where they come from; without one, none is specified:
# - gain, relative; compensation, of the high-frequency gain relative to that at low frequency;
# - offset and integral nonlinearity, relative to the range;
# - skew between its channels, s, or skew_intervals, in sampling intervals;
# - value and relative limit of the input resistance (ohm) and capacitance (F).
CLASSES: dict[str, dict[str, Any]] = {
    "scope-8bit": dict(
        source="Tektronix TPS2000B, PicoScope 2205 MSO and Rigol DS2000 manuals; INL of 1 LSB:"
        " Tektronix TDS7104 manual",
        gain=0.03,
        offset=0.1 / 8.0,  # 0.1 of 8 divisions
        nonlinearity=1.0 / 256.0,
        skew=1e-9,
        resistance=(1e6, 0.01),
        capacitance=(20e-12, 0.25),
    ),
    "daq-16bit": dict(
        source="National Instruments sbRIO-961x manual, Advantech PCI-1716 data sheet",
        gain=0.0005,
        offset=0.00035,
        nonlinearity=80e-6,
        skew_intervals=1.0,  # of a converter that scans its channels
    ),
    "probe-10x": dict(
        source="attenuation: 1 % resistors in probe and oscilloscope, at most 1.8 %; load: Tektronix probe manuals",
        gain=0.02,
        compensation=0.02,
        resistance=(10e6, 0.02),
        capacitance=(12e-12, 0.25),
    ),
    "impedance-analyser": dict(
        source="Gamry, application note on accurate EIS: 99 % accuracy within the contour of the Interface 1010",
        gain=0.01,
    ),
    "force-sensor": dict(source="no limits: its certificate states them, under [instrument.own]"),
    "shunt-1%": dict(source="the tolerance of the resistor", gain=0.01),
    "shunt-0.1%": dict(source="the tolerance of the resistor", gain=0.001),
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
    return {name: gain for name in TYPICAL[channel] if (gain := CLASSES[name].get("gain"))}


def typical_gain_u(channel: str) -> float:
    """Return the relative standard uncertainty of the gain of a channel with `TYPICAL` equipment."""
    return math.hypot(*typical_gains(channel).values()) / math.sqrt(3.0)  # of uniform distributions
