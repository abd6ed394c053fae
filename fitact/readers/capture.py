"""Contents of a file before channels are assigned: time, and channels with the names in the file."""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping

import numpy as np
from jaxtyping import Float

from fitact.data.record import CHANNEL_UNITS, Record, is_rounded_grid
from fitact.errors import RATE_OPTION, InputError, channel_option, scale_option
from fitact.readers.layouts import normalize_channel, parse_unit
from fitact.units import format_engineering

FULL_SCALE = "full scale"  # unit of a file whose values are parts of the range of its converter
Pick = Callable[[list[str], str], Iterable[str]]  # of the names found, and their place, those that are wanted


@dataclasses.dataclass(frozen=True)
class FileChannel:
    """One channel of a file."""

    name: str
    values: Float[np.ndarray, " samples"]  # in `unit`
    unit: str = ""  # SI unit (V, A; "" if the file states none)
    unit_text: str = ""  # unit as written in the file
    attenuation: float | None = None  # probe attenuation that the file states, already applied
    location: str = ""  # location of the name, for messages

    @classmethod
    def from_file(
        cls,
        name: str,
        values: Float[np.ndarray, " samples"],
        unit_text: str,
        attenuation: float | None = None,
        location: str = "",
    ) -> "FileChannel":
        """Convert values in the file's unit."""
        unit, factor = parse_unit(unit_text) or ("", 1.0)
        return cls(name, values * factor if factor != 1.0 else values, unit, unit_text, attenuation, location)


@dataclasses.dataclass(frozen=True)
class Capture:
    """Time and channels of one file."""

    source: str
    format: str  # name of the file format, e.g. "Keysight CSV"
    time: Float[np.ndarray, " samples"]  # s
    channels: tuple[FileChannel, ...]
    row_label: Callable[[int], str] = lambda row: f"sample {row}"  # name of a sample index in messages, e.g. "line 12"
    notes: tuple[str, ...] = ()  # sentences for information
    warnings: tuple[str, ...] = ()  # sentences on what was assumed and may change the result
    unread_columns: tuple[str, ...] = ()  # columns that were not requested, or without numbers


def resolve_channels(names: list[str], channels: Mapping[str, str], source: str, location: str = "") -> dict[str, str]:
    """Return the column name of each of V, Vsc, I and Ft that the user assigned or that has its standard name."""
    known: dict[str, str] = {}
    for channel in CHANNEL_UNITS:
        own = [name for name in names if name.lower() == channel.lower()]
        if own and channel not in channels:
            if len(own) > 1:
                raise InputError(f"{source}{location}: two columns are named {channel}; keep or rename one")
            known[channel] = own[0]
    for channel, asked in channels.items():
        if channel not in CHANNEL_UNITS:
            raise InputError(
                f"{source}: '{channel}' is no channel of fitact ({', '.join(CHANNEL_UNITS)}); name one of these, as"
                f" {channel_option({'Vsc': asked})}"
            )
        known[channel] = find_channel(asked, names, source)
    if len(set(known.values())) < len(known):
        pairs = ", ".join(f"{channel}={name}" for channel, name in known.items())
        raise InputError(
            f"{source}: one column is to be two channels ({pairs}); name another for one of them with --channel"
        )
    if not known:
        example = dict(zip(("V", "Vsc") if len(names) > 1 else ("Vsc",), names[-2:], strict=True))
        raise InputError(
            f"{source}{location}: no column is named time_s, V_V, Vsc_V or I_A, and which is which is not guessed"
            f" (found: {_join_names(names)}); name them, as {channel_option(example)}"
        )
    return known


def find_channel(requested: str, names: list[str], source: str) -> str:
    """Return the name in the file of a requested channel, e.g. "CH2" for "Channel 2"."""
    exact = [name for name in names if name.strip().lower() == requested.strip().lower()]
    alike = exact or [name for name in names if normalize_channel(name) == normalize_channel(requested)]
    if len(alike) != 1:
        what = f"there are {len(alike)} columns" if alike else "there is no column"
        raise InputError(
            f"{source}: {what} '{requested}' (found: {_join_names(names)}); name another with --channel, or rename it"
            " in the file"
        )
    return alike[0]


def has_standard_names(capture: Capture) -> bool:
    known = [name.lower() for name in CHANNEL_UNITS]
    return any(trace.name.lower() in known for trace in capture.channels)


def channel_arrays(
    capture: Capture, channels: Mapping[str, str], scale: Mapping[str, float]
) -> tuple[dict[str, Float[np.ndarray, " samples"]], dict[str, str], list[str]]:
    """Return V, Vsc, I and Ft in SI units, the names of their columns, and notes on how they were converted."""
    for channel, factor in scale.items():
        if channel not in CHANNEL_UNITS:
            raise InputError(
                f"{capture.source}: '{channel}' is no channel of fitact ({', '.join(CHANNEL_UNITS)}); scale one of"
                f" these, as {scale_option('Vsc')}"
            )
        if not math.isfinite(factor) or factor == 0.0:
            raise InputError(
                f"{capture.source}: the scale {factor} of {channel} is no factor; give a number, as"
                f" {scale_option(channel)}"
            )
    names = [trace.name for trace in capture.channels]
    known = resolve_channels(names, channels, capture.source, capture.channels[0].location if capture.channels else "")
    if unused := sorted(set(scale) - set(known)):
        raise InputError(
            f"{capture.source}: {unused[0]} is scaled but not there (found: {_join_names(names)}); name its column, as"
            f" {channel_option({unused[0]: 'COLUMN'})}"
        )
    arrays, notes = {}, list[str]()
    for channel, name in known.items():
        trace = capture.channels[names.index(name)]
        _check_unit(trace, channel, channel in scale, capture.source)
        arrays[channel] = trace.values * scale[channel] if channel in scale else trace.values
        if channels or scale:
            notes.append(f"{capture.source}: {_describe_conversion(trace, channel, scale.get(channel, 1.0))}")
    return arrays, known, notes


def replace_rounded_times(capture: Capture, rate: float | None, scene_rate: float | None = None) -> Capture:
    """Return the capture with uniform times if they were rounded and a sampling rate (Hz) is stated.

    `rate` must agree with the times. `scene_rate` also serves simulations and designs; where it contradicts times that
    increase, these are used, with a warning.
    """
    exact = 1e-6  # deviation in steps up to which times stay as they are
    if rate is not None and not 0.0 < rate < math.inf:
        raise InputError(
            f"{capture.source}: rate = {rate:g} Hz is no sampling rate; give a positive one, as {RATE_OPTION}"
        )
    time, stated = capture.time, scene_rate if rate is None else rate
    if stated is None or time.size < 4 or not np.all(np.isfinite(time)):
        return capture
    grid = time[0] + np.arange(time.size) / stated
    deviation = float(np.max(np.abs(time - grid)))
    if deviation * stated <= exact:
        return capture
    shown, off = format_engineering(stated, "Hz"), format_engineering(deviation, "s", 3)
    if is_rounded_grid(time, 1.0 / stated):
        note = f"{capture.source}: uniform times by the stated sampling rate {shown} replace the file's (off by {off})"
        return dataclasses.replace(capture, time=grid, notes=(*capture.notes, note))
    key = "[measurement] sampling_rate" if rate is None else "rate"
    span = f"{time.size:,} samples in {format_engineering(float(time[-1] - time[0]), 's')}"
    sentence = f"{capture.source}: {key} = {shown} contradicts the times in the file ({span}) by up to {off}"
    if rate is None and np.all(np.diff(time) > 0.0):
        warning = f"{sentence}, more than rounding can explain; the times in the file are used"
        return dataclasses.replace(capture, warnings=(*capture.warnings, warning))
    raise InputError(
        f"{sentence}, more than rounding can explain; state the rate of this file, as {RATE_OPTION}, or correct its"
        " times"
    )


def to_record(capture: Capture, channels: Mapping[str, str], scale: Mapping[str, float]) -> Record:
    """Convert the contents of a file to a record, with the assigned channels and scale factors."""
    arrays, known, conversions = channel_arrays(capture, channels, scale)
    names, notes = [trace.name for trace in capture.channels], [*capture.notes, *conversions]
    if channels or scale:
        first = format_engineering(float(capture.time[0]), "s") if capture.time.size else "nowhere"
        notes.append(f"{capture.source}: time axis taken from the file (format: {capture.format}), starting at {first}")
    unread = [*(name for name in names if name not in known.values()), *capture.unread_columns]
    if unread:
        notes.append(f"{capture.source}: not used: {', '.join(unread)}")
    return Record.from_arrays(
        capture.time,
        **arrays,
        source=capture.source,
        notes=tuple(notes),
        warnings=capture.warnings,
        where=capture.row_label,
    )


def _check_unit(file_channel: FileChannel, channel: str, scaled: bool, source: str) -> None:
    """Raise InputError if a channel has another unit than its own, and no factor between them is given."""
    wanted, stated, place = CHANNEL_UNITS[channel], file_channel.unit_text, f"{source}{file_channel.location}"
    if scaled or not stated or file_channel.unit == wanted:
        return
    if stated == FULL_SCALE:
        raise InputError(
            f"{place}: {file_channel.name} holds parts of the full scale and no {wanted}; give the full scale, for 10"
            f" {wanted} as {scale_option(channel)}"
        )
    if not file_channel.unit:
        raise InputError(
            f"{place}: '{stated}' is no unit of {channel}; correct it to a multiple of {wanted}, or give the factor to"
            f" {wanted}, as {scale_option(channel, 0.001)}"
        )
    raise InputError(
        f"{place}: {file_channel.name} is in {file_channel.unit}, but {channel} needs {wanted}; give the factor between"
        f" them, in {wanted}/{file_channel.unit}, as {scale_option(channel, 0.001)}"
    )


def _describe_conversion(file_channel: FileChannel, channel: str, factor: float) -> str:
    stated = file_channel.unit_text
    unit = f"unit {stated}" if stated else f"no unit stated, {CHANNEL_UNITS[channel]} assumed"
    probe = file_channel.attenuation
    attenuation = "states no probe attenuation" if probe is None else f"states a probe attenuation of {probe:g}"
    scaled = "" if factor == 1.0 else f", multiplied by {factor:g}"
    return f"{channel} read from column '{file_channel.name}' ({unit}){scaled}; the file {attenuation}"


def _join_names(names: list[str]) -> str:
    return (", ".join(names) or "nothing")[:200]
