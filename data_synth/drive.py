"""Drives: the voltage as a function of time, smooth between corners."""

import math
from collections.abc import Callable, Mapping
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np

from data_synth.errors import RecipeError

_STRAIGHT, _SMOOTH = 1, 8  # degree of the polynomial that represents a drive within a step
_BESIDE = 1e-7  # fraction of a stretch: distance from its ends at which the drive is evaluated
_STEPS = 16  # steps per cycle, so that this degree represents a sine to 1e-14

Values = Callable[[np.ndarray], np.ndarray]


class Drive(NamedTuple):
    """V(t) between corners.

    value: V at times (s); the side taken at a corner is unspecified.
    corners: times (s) of jumps and bends in an interval.
    degree: degree of the polynomial that equals the drive, to rounding, over `longest` (s).
    period: s; None if the drive does not repeat.
    jumps: whether a corner is a jump.
    """

    value: Values
    corners: Callable[[float, float], np.ndarray]
    degree: int
    longest: float
    period: float | None
    jumps: bool


def make_drive(section: Mapping[str, Any]) -> Drive:
    """Return the drive of a scene's section [drive], from rest if `steady_state` is false.

    Raises:
        RecipeError: the waveform is measured, so only a record has it.
    """
    waveform = section["waveform"]
    if waveform == "measured":
        raise RecipeError("[drive] waveform = 'measured' cannot be computed; state a waveform under [truth.drive]")
    if waveform == "chirp":
        return _chirp(section)
    if waveform == "burst":
        wave = _wave(section, section["shape"])
        return _gate_drive(wave, 0.0, section["cycles"] / section["frequency"])
    wave = _multitone(section) if waveform == "multitone" else _wave(section, waveform)
    return wave if section["steady_state"] else _gate_drive(wave, 0.0, math.inf)


def _wave(section: Mapping[str, Any], shape: str) -> Drive:
    frequency, offset, height = section["frequency"], section["offset"], 0.5 * section["peak_to_peak"]
    ahead, duty = section["phase"] / (2.0 * math.pi), section["duty"]
    if shape == "sine":
        xs, ys = [], []
    elif shape == "triangle":
        xs, ys = [0.0, 0.25, 0.75, 1.0], [0.0, 1.0, -1.0, 0.0]
    else:
        rise = (section["rise_time"] or 0.0) * frequency
        xs, ys = [0.0, rise, duty, duty + rise, 1.0], [-1.0, 1.0, 1.0, -1.0, -1.0]

    def value(time: np.ndarray) -> np.ndarray:
        cycle = np.mod(time * frequency + ahead, 1.0)
        if shape == "square":
            return offset + height * np.where(cycle < duty, 1.0, -1.0)
        return offset + height * (np.interp(cycle, xs, ys) if xs else np.sin(2.0 * np.pi * cycle))

    def corners(start: float, end: float) -> np.ndarray:
        cycles = np.arange(math.floor(start * frequency) - 1, math.ceil(end * frequency) + 2)
        return (np.add.outer(cycles, sorted(set(xs[:-1]))).ravel() - ahead) / frequency

    straight = bool(xs)
    longest = 1.0 / frequency if straight else 1.0 / (_STEPS * frequency)
    return Drive(value, corners, _STRAIGHT if straight else _SMOOTH, longest, 1.0 / frequency, shape == "square")


def _multitone(section: Mapping[str, Any]) -> Drive:
    tones, heights = np.array(section["frequencies"]), np.array(section["amplitudes"])
    phases = np.array(section["phases"] or [0.0] * tones.size)
    exact = [Fraction(repr(float(tone))) for tone in tones]
    whole = math.lcm(*(tone.denominator for tone in exact))
    lowest = math.gcd(*(int(tone * whole) for tone in exact)) / whole

    def value(time: np.ndarray) -> np.ndarray:
        total = np.full(np.shape(time), float(section["offset"]))
        for tone, height, phase in zip(tones, heights, phases, strict=True):
            total = total + height * np.sin(2.0 * np.pi * tone * time + phase)
        return total

    return Drive(value, _no_corners, _SMOOTH, 1.0 / (_STEPS * tones.max()), 1.0 / lowest, False)


def _chirp(section: Mapping[str, Any]) -> Drive:
    first, last, duration = section["start_frequency"], section["end_frequency"], section["sweep_time"]

    def value(time: np.ndarray) -> np.ndarray:
        if section["spacing"] == "linear":
            cycles = first * time + 0.5 * (last - first) * time**2 / duration
        else:
            rate = math.log(last / first) / duration
            cycles = first * (np.expm1(rate * time) / rate if rate else time)
        wave = np.sin(2.0 * np.pi * cycles + section["phase"])
        return section["offset"] + 0.5 * section["peak_to_peak"] * wave

    sweep = Drive(value, _no_corners, _SMOOTH, 1.0 / (_STEPS * max(first, last)), None, False)
    return _gate_drive(sweep, 0.0, duration)


def _no_corners(start: float, end: float) -> np.ndarray:
    return np.empty(0)


def _gate_drive(wave: Drive, begin: float, end: float) -> Drive:
    """Return the wave from `begin` to `end` (s), and zero before and after."""

    def value(time: np.ndarray) -> np.ndarray:
        inside = (time >= begin) & (time < end)
        return np.where(inside, wave.value(np.where(inside, time, begin)), 0.0)

    def corners(start: float, stop: float) -> np.ndarray:
        ends = [each for each in (begin, end) if math.isfinite(each)]
        return np.append(wave.corners(start, stop), ends)

    at_ends = [wave.value(np.array(each)) for each in (begin, end) if math.isfinite(each)]
    jumps = wave.jumps or max(abs(float(each)) for each in at_ends) > 1e-9 * float(
        np.ptp(wave.value(_sample_times(wave)))
    )
    return Drive(value, corners, wave.degree, wave.longest, None, jumps)


def _sample_times(wave: Drive) -> np.ndarray:
    """Return times (s) that cover the wave's range."""
    return np.linspace(0.0, wave.period or 64.0 * wave.longest, 64)


def end_values(drive: Drive, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return V at the start and end of each stretch between neighbouring times; no stretch has a corner inside."""
    length = np.diff(corners)
    if drive.degree > _STRAIGHT:
        return drive.value(corners[:-1] + _BESIDE * length), drive.value(corners[1:] - _BESIDE * length)
    early, late = drive.value(corners[:-1] + 0.25 * length), drive.value(corners[1:] - 0.25 * length)
    return 1.5 * early - 0.5 * late, 1.5 * late - 0.5 * early
