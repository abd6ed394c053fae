"""What a file holds, before it is fitted: channels, rate, noise, and what is doubtful about it."""

import dataclasses
import math
import os
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from fitact.data.checks import check_channel, check_divider, check_time
from fitact.data.clipping import clipped
from fitact.data.readers.capture import Capture, is_mapped, to_record
from fitact.data.readers.read import read_capture, with_other_files
from fitact.data.record import (
    CHANNEL_UNITS,
    MINIMUM_SAMPLES,
    OVERFLOW,
    fundamental,
    grid_notes,
    rounding_noise,
    white_noise,
)
from fitact.errors import InputError
from fitact.units import engineering

_ENOUGH = 2_097_152  # samples from which the frequency of a long record is found


@dataclasses.dataclass(frozen=True)
class Channel:
    """One channel in its SI unit ("" where none is stated), the standard deviation of its noise, samples clipped."""

    name: str
    unit: str
    values: Float[np.ndarray, " samples"]
    noise: float
    clipped: int

    def to_dict(self) -> dict[str, Any]:
        """As `fitact inspect --json` lists it."""
        low, high = float(self.values.min()), float(self.values.max())
        return {
            "name": self.name, "unit": self.unit, "min": low, "max": high, "noise": self.noise,
            "clipped": self.clipped > 0, "clipped_samples": self.clipped,
        }  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Inspection:
    """A file's channels, time (s), dominant frequency (Hz, or None), what was assumed, and what is doubtful."""

    source: str
    format: str
    time: Float[np.ndarray, " samples"]
    channels: tuple[Channel, ...]
    frequency: float | None
    notes: tuple[str, ...]
    warnings: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """As `fitact inspect --json` prints it."""
        return {
            "source": self.source,
            "format": self.format,
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
        lines = [
            f"{self.source} ({self.format}): {self.time.size:,} samples, every {engineering(step, 's')}"
            f" ({engineering(1.0 / step, 'Hz')}), from {engineering(self.time[0], 's')} to"
            f" {engineering(self.time[-1], 's')}; "
            + ("no whole wave seen" if self.frequency is None else f"repeats at {engineering(self.frequency, 'Hz')}")
        ]
        width = max(len(channel.name) for channel in self.channels)
        for channel in self.channels:
            low, high, noise = (
                engineering(x, channel.unit) for x in (channel.values.min(), channel.values.max(), channel.noise)
            )
            rail = f", {channel.clipped:,} samples clipped" if channel.clipped else ""
            lines.append(f"  {channel.name:<{width}}  {low} to {high}, noise {noise}{rail}")
        lines += [f"note: {note}" for note in self.notes]
        lines += [f"warning: {warning}" for warning in self.warnings]
        return "\n".join(lines)


def inspect(
    path: str | os.PathLike[str],
    *,
    channels: Mapping[str, str] | None = None,
    scale: Mapping[str, float] | None = None,
) -> Inspection:
    """Look at a file without fitting it: as V, Vsc and I where they are known or named, else as the file has them.

    Raises:
        InputError: the file cannot be read, or what is known as V, Vsc or I could not be fitted.
    """
    capture = with_other_files(read_capture(path), path, channels or {})
    if channels or scale or is_mapped(capture):
        record = to_record(capture, channels or {}, scale or {})
        arrays = {name: (record[name], CHANNEL_UNITS[name]) for name in record.channels}
        return _looked_at(capture, record.time, arrays, record.notes)
    _check_times(capture)
    arrays = {trace.name: (trace.values, trace.unit) for trace in capture.traces}
    names = ", ".join(arrays)
    notes = (
        *capture.notes,
        *grid_notes(capture.time, capture.source),
        f"{capture.source}: before a fit, say which of {names} is which, as --channel V=NAME --channel Vsc=NAME",
    )
    return _looked_at(capture, capture.time, arrays, notes)


def _check_times(capture: Capture) -> None:
    """Refuse times that no record could have; the channels may still be anything."""
    time = capture.time
    if time.size < 2 or not np.all(np.isfinite(time)) or np.any(np.diff(time) <= 0.0):
        raise InputError(
            f"{capture.source}: the times are not increasing, or fewer than two; sort the rows, drop repeated ones, and"
            " check which column is time"
        )


def _looked_at(
    capture: Capture,
    time: Float[np.ndarray, " samples"],
    arrays: Mapping[str, tuple[Float[np.ndarray, " samples"], str]],
    notes: tuple[str, ...],
) -> Inspection:
    frequency = next((f for f in (_frequency(time, values) for values, _ in arrays.values()) if f is not None), None)
    warnings = check_time(time, frequency) if time.size > 3 else []
    for name, (values, unit) in arrays.items():
        warnings += check_channel(name, unit, time, values, frequency)
    warnings += check_divider({name: values for name, (values, _) in arrays.items()})
    seen = tuple(_channel(name, unit, values) for name, (values, unit) in arrays.items())
    return Inspection(capture.source, capture.format, time, seen, frequency, notes, tuple(warnings))


def _channel(name: str, unit: str, values: Float[np.ndarray, " samples"]) -> Channel:
    if values.size < MINIMUM_SAMPLES or not _is_signal(values):
        return Channel(name, unit, values, math.nan, 0)
    railed = clipped(values)
    free = values if railed.all() else values[~railed]
    noise = math.hypot(white_noise(free), rounding_noise(free)) if free.size > 4 and np.ptp(free) else 0.0
    return Channel(name, unit, values, noise, int(np.count_nonzero(railed)))


def _is_signal(values: Float[np.ndarray, " samples"]) -> bool:
    """Whether there is anything to judge: finite numbers that vary."""
    return bool(np.all(np.abs(values) < OVERFLOW) and np.ptp(values) > 0.0)


def _frequency(time: Float[np.ndarray, " samples"], values: Float[np.ndarray, " samples"]) -> float | None:
    """From a part of a long record, or from each n-th sample of it."""
    if time.size < MINIMUM_SAMPLES or not _is_signal(values):
        return None
    whole = fundamental(time[:_ENOUGH], values[:_ENOUGH])
    if whole is None and time.size > _ENOUGH:
        every = -(-time.size // _ENOUGH)
        whole = fundamental(time[::every], values[::every])
    return whole
