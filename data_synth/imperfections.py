"""Imperfections of a channel due to instruments and surroundings, in the order in which they act.

Each kind, channel and record has its own random numbers, so adding one imperfection does not change the others.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from data_synth.recipe import UNITS

# append only: the index seeds the random numbers
_STREAMS = ("population", "clock", "hum", "pink", "white", "missing", "change", "finger", "session", "repetition")
_CHANNELS = tuple(UNITS)
_HEADROOM = 1.3  # end of a converter's automatic range over the largest value


def generator(seed: int, finger: int, kind: str, channel: str = "V") -> np.random.Generator:
    """Return the random generator of one kind of imperfection."""
    return np.random.default_rng([seed, finger, _STREAMS.index(kind), _CHANNELS.index(channel)])


def sampling_times(time: np.ndarray, clock: Mapping[str, Any], seed: int, finger: int) -> np.ndarray:
    """Return the true times (s) of samples recorded as taken at `time`, with normal jitter and a late trigger."""
    jitter = clock["jitter"] * generator(seed, finger, "clock").standard_normal(time.size) if clock["jitter"] else 0.0
    return time + clock["trigger_error"] + jitter


def add_imperfections(
    values: np.ndarray, channel: str, time: np.ndarray, parts: Mapping[str, Mapping[str, Any]], seed: int, finger: int
) -> np.ndarray:
    """Return a channel as it is recorded."""
    share = (time - time[0]) / (time[-1] - time[0])
    values = values * parts["gain"][channel] + (parts["offset"][channel] or 0.0)
    values = values + (parts["drift"][channel] or 0.0) * share
    if parts["hum"][channel]:
        phases = generator(seed, finger, "hum").uniform(0.0, 2.0 * np.pi, len(parts["hum"]["harmonics"]))
        values = values + parts["hum"][channel] * hum(time, parts["hum"], phases)
    if parts["pink"][channel]:
        rng, pink = generator(seed, finger, "pink", channel), parts["pink"]
        step = float(np.median(np.diff(time)))
        values = values + pink[channel] * power_law_noise(time.size, step, pink["exponent"], pink["corner"], rng)
    if parts["white"][channel]:
        values = values + parts["white"][channel] * generator(seed, finger, "white", channel).standard_normal(time.size)
    if parts["clip"][channel]:
        values = np.clip(values, -parts["clip"][channel], parts["clip"][channel])
    converter = parts["converter"]
    span = converter[channel] or (2.0 * _HEADROOM * float(np.max(np.abs(values))) if converter["auto"] else None)
    if span:
        values = quantize(values, span, converter[f"bits_{channel}"] or converter["bits"])
    return values


def hum(time: np.ndarray, section: Mapping[str, Any], phases: np.ndarray) -> np.ndarray:
    """Return mains hum with harmonics of the stated relative amplitudes; all channels of a record share the phases."""
    orders = np.arange(1, len(phases) + 1)
    angle = 2.0 * np.pi * section["frequency"] * np.outer(time, orders) + phases
    return np.sin(angle) @ np.array(section["harmonics"])


def power_law_noise(
    size: int, step: float, exponent: float, corner: float | None, rng: np.random.Generator
) -> np.ndarray:
    """Return normal noise of expected variance 1 with power ~ frequency^-exponent above `corner` (Hz), flat below.

    The default corner is the lowest frequency in a record of `size` samples of `step` s. The noise is made on a circle
    of twice the record, so that its end does not depend on its start; its mean over the circle is zero.
    """
    frequency = np.fft.rfftfreq(2 * size, step)[1:]
    power = np.maximum(frequency, corner or 1.0 / (size * step)) ** -exponent
    twice = np.append(np.full(frequency.size - 1, 2.0), 1.0)  # a spectrum has two sides, its highest frequency one
    waves = rng.standard_normal(frequency.size) + 1j * rng.standard_normal(frequency.size)
    waves[-1] = math.sqrt(2.0) * waves[-1].real
    heights = np.sqrt(0.5 * power / np.sum(twice * power)) * waves
    return np.fft.irfft(np.append(0.0, heights), 2 * size)[:size] * 2 * size


def quantize(values: np.ndarray, span: float, bits: int) -> np.ndarray:
    """Round to the nearest of 2^bits levels over `span` around 0, the lowest at -span / 2, and saturate beyond."""
    step, half = span / 2**bits, 2 ** (bits - 1)
    return np.clip(np.round(values / step), -half, half - 1) * step


def sample_mask(size: int, share: float, seed: int, finger: int) -> np.ndarray:
    """Return a mask of the samples kept; each is lost, with its time, with probability `share`."""
    return generator(seed, finger, "missing").uniform(size=size) >= share
