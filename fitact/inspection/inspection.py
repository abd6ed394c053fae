"""Inspection of a file before a fit: channels, sampling rate, noise, notes and warnings."""

import dataclasses
import math
import os
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from fitact.data.clipping import clipping_mask, has_flat_levels
from fitact.data.noise import rounding_noise_sd, white_noise_sd
from fitact.data.record import (
    CHANNEL_UNITS,
    LARGEST_VALUES,
    MINIMUM_SAMPLES,
    OVERFLOW,
    STATE_RATE,
    fundamental_frequency,
    grid_notes,
    is_uniform,
)
from fitact.errors import InputError
from fitact.inspection.preview import describe_rows, guess_command
from fitact.readers.capture import Capture, FileChannel, has_standard_names, replace_rounded_times, to_record
from fitact.readers.read import merge_other_files, read_capture
from fitact.tables import join_lines
from fitact.units import format_engineering

Samples = Float[np.ndarray, " samples"]


@dataclasses.dataclass(frozen=True)
class Channel:
    """One channel in its SI unit ("" if none is stated), the sd of its noise, and its number of clipped samples."""

    name: str
    unit: str
    values: Samples
    noise: float
    clipped: int

    def to_dict(self) -> dict[str, Any]:
        return {
            "name": self.name, "unit": self.unit, "min": float(self.values.min()), "max": float(self.values.max()),
            "noise": self.noise, "clipped": self.clipped > 0, "clipped_samples": self.clipped,
        }  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Inspection:
    """Channels of a file, time (s), dominant frequency (Hz, or None), notes and warnings.

    `columns` holds all columns with numbers, by their names in the file.
    """

    source: str
    format: str
    columns: tuple[FileChannel, ...]
    time: Samples
    channels: tuple[Channel, ...]
    frequency: float | None
    notes: tuple[str, ...]
    warnings: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON content of `fitact inspect`."""
        return {
            "source": self.source,
            "format": self.format,
            "columns": [
                {"name": column.name, "unit": column.unit_text, "attenuation": column.attenuation}
                for column in self.columns
            ],
            "channels": [channel.to_dict() for channel in self.channels],
            "samples": self.time.size,
            "time_step": float(np.median(np.diff(self.time))),
            "time_start": float(self.time[0]),
            "time_span": float(self.time[-1] - self.time[0]),
            "frequency": self.frequency,
            "notes": list(self.notes),
            "warnings": list(self.warnings),
        }

    def __str__(self) -> str:
        step = float(np.median(np.diff(self.time)))
        wave = (
            f"repeats at {format_engineering(self.frequency, 'Hz')}" if self.frequency else "no complete period found"
        )
        lines = [
            f"{self.source} ({self.format}): {self.time.size:,} samples, every {format_engineering(step, 's')}"
            f" ({format_engineering(1.0 / step, 'Hz')}), from {format_engineering(self.time[0], 's')} to"
            f" {format_engineering(self.time[-1], 's')}; {wave}"
        ]
        width = max(len(channel.name) for channel in self.channels)
        for channel in self.channels:
            low, high, noise = (
                format_engineering(x, channel.unit) for x in (channel.values.min(), channel.values.max(), channel.noise)
            )
            rail = f", {channel.clipped:,} samples clipped" if channel.clipped else ""
            lines.append(f"  {channel.name:<{width}}  {low} to {high}, noise {noise}{rail}")
        if not {"Vsc", "I"} & {channel.name for channel in self.channels}:
            lines += ["first rows:", *describe_rows(self.columns, self.time)]
        return join_lines(lines, self.warnings, self.notes)


def inspect(
    path: str | os.PathLike[str],
    *,
    channels: Mapping[str, str] | None = None,
    scale: Mapping[str, float] | None = None,
    rate: float | None = None,
    segment: int | None = None,
) -> Inspection:
    """Inspect a file without fitting it; channels are V, Vsc and I if known or named, otherwise those of the file.

    `channels`, `scale`, `rate` and `segment` as in `fitact.read`.

    Raises:
        InputError: the file cannot be read, or its V, Vsc or I could not be fitted.
    """
    capture = read_capture(path, rate=rate, segment=segment)
    capture = replace_rounded_times(merge_other_files(capture, path, channels or {}, rate, segment), rate)
    if channels or scale or has_standard_names(capture):
        record = to_record(capture, channels or {}, scale or {})
        arrays = {name: (record[name], CHANNEL_UNITS[name]) for name in record.channels}
        notes = record.notes
        if not channels and not {"Vsc", "I"} & set(record.channels):
            notes = (*notes, _assignment_note(capture, rate, segment))
        return _inspect_channels(capture, record.time, arrays, notes)
    time = capture.time
    if time.size < 2 or not np.all(np.isfinite(time)) or np.any(np.diff(time) <= 0.0):
        raise InputError(
            f"{capture.source}: the times are not increasing, or fewer than two; if they were rounded when written,"
            f" {STATE_RATE}; otherwise sort the rows, drop repeated ones, and check which column is time"
        )
    arrays = {trace.name: (trace.values, trace.unit) for trace in capture.channels}
    notes = (*capture.notes, *grid_notes(time, capture.source), _assignment_note(capture, rate, segment))
    return _inspect_channels(capture, time, arrays, notes)


def _assignment_note(capture: Capture, rate: float | None, segment: int | None) -> str:
    reason, command = guess_command(capture, rate, segment=segment)
    return f"{capture.source}: the channels are not assigned; guess {reason}" + f": {command}" * bool(command)


def _inspect_channels(
    capture: Capture, time: Samples, arrays: Mapping[str, tuple[Samples, str]], notes: tuple[str, ...]
) -> Inspection:
    frequencies = (_estimate_frequency(time, values) for values, _ in arrays.values())
    frequency = next((f for f in frequencies if f is not None), None)
    warnings = [*capture.warnings, *(check_time(time, frequency) if time.size > 3 else [])]
    for name, (values, unit) in arrays.items():
        warnings += check_channel(name, unit, time, values, frequency)
    warnings += check_divider({name: values for name, (values, _) in arrays.items()})
    inspected = tuple(_inspect_channel(name, unit, values) for name, (values, unit) in arrays.items())
    notes = (*notes, *describe_rounded_time(time))
    return Inspection(
        capture.source, capture.format, capture.channels, time, inspected, frequency, notes, tuple(warnings)
    )


def _inspect_channel(name: str, unit: str, values: Samples) -> Channel:
    if values.size < MINIMUM_SAMPLES or not _is_signal(values):
        return Channel(name, unit, values, math.nan, 0)
    railed = clipping_mask(values)
    free = values if railed.all() else values[~railed]
    noise = math.hypot(white_noise_sd(free), rounding_noise_sd(free)) if free.size > 4 and np.ptp(free) else 0.0
    return Channel(name, unit, values, noise, int(np.count_nonzero(railed)))


def _is_signal(values: Samples) -> bool:
    """Return whether the values are finite and vary."""
    return bool(np.all(np.abs(values) < OVERFLOW) and np.ptp(values) > 0.0)


def _estimate_frequency(time: Samples, values: Samples, max_samples: int = 2_097_152) -> float | None:
    """Estimate the fundamental frequency (Hz) from a part of a long record, or from each n-th sample."""
    if time.size < MINIMUM_SAMPLES or not _is_signal(values):
        return None
    whole = fundamental_frequency(time[:max_samples], values[:max_samples])
    if whole is None and time.size > max_samples:
        every = -(-time.size // max_samples)
        whole = fundamental_frequency(time[::every], values[::every])
    return whole


def check_time(time: Samples, frequency: float | None) -> list[str]:
    """Describe doubts about the times (s), and about the sampling rate for a signal of `frequency` (Hz)."""
    min_samples_per_period = 20  # with fewer, edges and bends are lost
    found = []
    step = (time[-1] - time[0]) / (time.size - 1)
    if not time[0] <= 0.0 <= time[-1]:
        found.append(
            f"the trigger (0 s) lies outside of the record ({format_engineering(time[0], 's')} to"
            f" {format_engineering(time[-1], 's')}); the fit aligns the drive of a scene by its phase, not by the"
            " trigger"
        )
    if frequency is None:
        found.append("no channel contains 1.5 periods of a wave; record two periods or more")
    elif 1.0 / (frequency * step) < min_samples_per_period:
        found.append(
            f"{1.0 / (frequency * step):.3g} samples per period: faster changes are lost or aliased; record faster"
        )
    return found


def describe_rounded_time(time: Samples, tolerance: float = 1e-6) -> list[str]:
    """Describe the deviation of uniform times from an even grid, above what double precision causes."""
    step = (time[-1] - time[0]) / max(time.size - 1, 1)
    off = float(np.max(np.abs(time - np.linspace(time[0], time[-1], time.size)))) / step
    if off <= tolerance or not is_uniform(time):
        return []
    return [f"the times are rounded (by up to {off:.2g} of a sampling interval, as in float32); this does no harm"]


def check_channel(name: str, unit: str, time: Samples, values: Samples, frequency: float | None) -> list[str]:
    """Describe doubts about a channel, in sentences; `unit` is V, A or "" if unknown."""
    bad = np.flatnonzero(~np.isfinite(values) | (np.abs(values) >= OVERFLOW))
    if bad.size:
        return [
            f"{name} is not finite, or an overflow code, at {bad.size:,} samples; a fit excludes many in a row of Vsc"
            " and I as clipped, and refuses others"
        ]
    spread = float(np.ptp(values))
    if spread == 0.0:
        return [f"{name} is constant at {values[0]:.6g}; is it connected?"]
    found = []
    if railed := int(np.count_nonzero(clipping_mask(values))):
        found.append(
            f"{name} is clipped at {railed:,} samples ({values.min():.4g} to {values.max():.4g}): it exceeds the range"
            " of the oscilloscope or of the amplifier"
        )
    if has_flat_levels(values):
        found.append(
            f"{name} has plateaus without noise ({values.min():.4g} to {values.max():.4g}): an ideal wave, one rounded"
            " to steps above its noise, or the end of a range; compare them with the levels that you set"
        )
    elif rounding_noise_sd(values) > 0.0:
        found.append(f"{name} is rounded to steps larger than its noise; record with a smaller range")
    largest = float(np.max(np.abs(values)))
    if largest > LARGEST_VALUES.get(unit, math.inf):
        found.append(
            f"{name} reaches {format_engineering(largest, unit)}, more than a touch display withstands; check the unit"
        )
    return found + [f"{name} {sentence}" for sentence in _check_hum_and_drift(time, values, spread, frequency, unit)]


def check_divider(channels: Mapping[str, Samples], low: float = 2e-2, high: float = 0.5) -> list[str]:
    """Describe doubts about Vsc / V: an unstated probe attenuation below `low`, an impossible circuit above `high`."""
    if not {"V", "Vsc"} <= set(channels) or np.ptp(channels["V"]) == 0.0:
        return []
    ratio = float(np.ptp(channels["Vsc"]) / np.ptp(channels["V"]))
    if low <= ratio < high:
        return []
    doubt = (
        "a 10x probe read as 1x (--scale Vsc=10), or a wet finger" if ratio < low else "swapped columns or a wrong unit"
    )
    return [f"Vsc spans {ratio:.3g} times V, which suggests {doubt}"]


def _check_hum_and_drift(
    time: Samples, values: Samples, value_range: float, frequency: float | None, unit: str
) -> Iterator[str]:
    """Describe hum and drift of a periodic signal, found by a spectral line and by the means of the periods."""
    min_mains_periods = 4  # a shorter record cannot distinguish mains hum from drift
    hum_fraction, drift_fraction = 0.01, 0.02  # of the channel's range, above which each is reported
    min_significance = 6.0  # of a drift, in standard errors
    span = float(time[-1] - time[0])
    if frequency is None or not is_uniform(time) or span * frequency < 3.0:
        return
    for mains in (50.0, 60.0):  # Hz
        harmonic = abs(mains / frequency - round(mains / frequency)) * frequency * span < 2.0
        if span * mains < min_mains_periods or harmonic:
            continue  # the record is too short, or the line is a harmonic of the signal
        line = _spectral_line(time, values, mains)
        beside = max(abs(_spectral_line(time, values, mains + away / span)) for away in (-3.0, 3.0))
        if abs(line) > max(hum_fraction * value_range, 3.0 * beside):
            yield (
                f"contains mains hum ({mains:.0f} Hz, amplitude {abs(line):.3g} {unit}); the fit adds a"
                f" {mains:.0f} Hz term if the BIC favours it"
            )
            values = values - np.real(line * np.exp(2j * np.pi * mains * time))
    step = span / (time.size - 1)
    means, centres = _period_means(values, 1.0 / (frequency * step))
    (slope, _), covariance = np.polyfit(centres * step, means, 1, cov=True)
    is_significant = abs(slope) > min_significance * math.sqrt(covariance[0, 0])
    if abs(slope * span) > drift_fraction * value_range and is_significant:
        yield f"drifts by {slope * span:.3g} {unit} over the record; the fit adds a drift if the BIC favours it"


def _period_means(values: Samples, samples: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean of each whole period, and the centre of the period in samples."""
    edges = np.round(np.arange(int(values.size / samples) + 1) * samples).astype(int)
    sums = np.concatenate([[0.0], np.cumsum(values)])
    return np.diff(sums[edges]) / np.diff(edges), 0.5 * (edges[1:] + edges[:-1])


def _spectral_line(time: Samples, values: Samples, frequency: float) -> complex:
    """Return the complex amplitude of one spectral line, with a Hann window."""
    window = np.hanning(values.size)
    wave = np.exp(-2j * np.pi * frequency * time)
    return complex(2.0 * np.sum(window * wave * (values - values.mean())) / window.sum())
