"""What a file holds before anything is said about it: time and channels under their maker's names."""

import dataclasses
import math
import shlex
from collections.abc import Callable, Iterable, Mapping

import numpy as np
from jaxtyping import Float

from fitact.data.readers.layouts import same_channel
from fitact.data.record import CHANNEL_UNITS, Record
from fitact.errors import InputError
from fitact.units import engineering

Pick = Callable[[list[str], str], Iterable[str]]  # of the names found, and their place, those that are wanted


@dataclasses.dataclass(frozen=True)
class Trace:
    """One channel as the file has it, in the SI unit `unit` (V, A; "" where the file states none).

    `written` is the unit in the file's words, `attenuation` the probe's as the file states it, already applied.
    """

    name: str
    values: Float[np.ndarray, " samples"]
    unit: str = ""
    written: str = ""
    attenuation: float | None = None
    place: str = ""  # of its name, for messages


@dataclasses.dataclass(frozen=True)
class Capture:
    """Time (s) and traces of one file.

    Attributes:
        format: who wrote it, as "Keysight CSV".
        where: what a sample's number is called in messages, as "line 12".
        notes: what was assumed in reading, in sentences.
        others: columns that hold no numbers.
    """

    source: str
    format: str
    time: Float[np.ndarray, " samples"]
    traces: tuple[Trace, ...]
    where: Callable[[int], str] = lambda row: f"sample {row}"
    notes: tuple[str, ...] = ()
    others: tuple[str, ...] = ()


def resolve(names: list[str], channels: Mapping[str, str], source: str, place: str = "") -> dict[str, str]:
    """For each of V, Vsc and I that is known, the name it has in the file: stated, or by the name itself.

    Raises:
        InputError: none is known, a name stated is not there, or one name is stated twice.
    """
    known: dict[str, str] = {}
    for channel in CHANNEL_UNITS:
        own = [name for name in names if name.lower() == channel.lower()]
        if channel not in channels and len(own) > 1:
            raise InputError(f"{source}{place}: two columns are named {channel}; keep one")
        if own and channel not in channels:
            known[channel] = own[0]
    for channel, asked in channels.items():
        if channel not in CHANNEL_UNITS:
            raise InputError(f"{source}: '{channel}' is no channel of fitact; map to {', '.join(CHANNEL_UNITS)}")
        known[channel] = named(asked, names, source)
    if len(set(known.values())) < len(known):
        raise InputError(f"{source}: one column is to be two channels ({_pairs(known)}); name another for one of them")
    if not known:
        raise InputError(
            f"{source}{place}: no column is named time_s, V_V, Vsc_V or I_A, and which is which is not guessed"
            f" (found: {_listed(names)}); say it, as {_options(names)}"
            " (in Python: channels={'Vsc': ...})"
        )
    return known


def _options(names: list[str]) -> str:
    """What to type, by way of example."""
    given = zip(("V", "Vsc"), names[-2:] if len(names) > 1 else ["NAME", *names], strict=False)
    return " ".join(f"--channel {shlex.quote(f'{channel}={name}')}" for channel, name in given)


def named(asked: str, names: list[str], source: str) -> str:
    """The name in the file of the channel that is asked for, as "CH2" for "Channel 2".

    Raises:
        InputError: there is none, or several.
    """
    exact = [name for name in names if name.strip().lower() == asked.strip().lower()]
    alike = exact or [name for name in names if same_channel(asked, name)]
    if len(alike) != 1:
        what = f"there are {len(alike)} columns" if alike else "there is no column"
        raise InputError(f"{source}: {what} '{asked}'; the file has {_listed(names)}")
    return alike[0]


def is_mapped(capture: Capture) -> bool:
    """Whether the file's own names say which channel is which."""
    known = [name.lower() for name in CHANNEL_UNITS]
    return any(trace.name.lower() in known for trace in capture.traces)


def to_record(capture: Capture, channels: Mapping[str, str], scale: Mapping[str, float]) -> Record:
    """The record that the stated channels and factors make of a capture.

    Raises:
        InputError: a channel is missing, its unit is of another kind, or the numbers are no measurement.
    """
    for channel, factor in scale.items():
        if channel not in CHANNEL_UNITS:
            raise InputError(f"{capture.source}: '{channel}' is no channel of fitact; scale {', '.join(CHANNEL_UNITS)}")
        if not math.isfinite(factor) or factor == 0.0:
            raise InputError(
                f"{capture.source}: the scale {factor} of {channel} is no factor; give a number such as 10"
            )
    names = [trace.name for trace in capture.traces]
    known = resolve(names, channels, capture.source, capture.traces[0].place if capture.traces else "")
    unused = sorted(set(scale) - set(known))
    if unused:
        raise InputError(f"{capture.source}: {unused[0]} is scaled but not there; name its column with --channel")
    arrays, notes = {}, list(capture.notes)
    for channel, name in known.items():
        trace = capture.traces[names.index(name)]
        _check_unit(trace, channel, channel in scale, capture.source)
        arrays[channel] = trace.values * scale.get(channel, 1.0)
        if channels or scale:
            notes.append(f"{capture.source}: {_assumed(trace, channel, scale.get(channel, 1.0))}")
    if channels or scale:
        first = engineering(float(capture.time[0]), "s") if capture.time.size else "nowhere"
        notes.append(f"{capture.source}: the time is the file's own ({capture.format}), from {first}")
    unread = [*(name for name in names if name not in known.values()), *capture.others]
    if unread:
        notes.append(f"{capture.source}: not used: {', '.join(unread)}")
    return Record.from_arrays(capture.time, **arrays, source=capture.source, notes=tuple(notes), where=capture.where)


def _check_unit(trace: Trace, channel: str, scaled: bool, source: str) -> None:
    wanted = CHANNEL_UNITS[channel]
    if trace.written and not trace.unit:
        raise InputError(
            f"{source}{trace.place}: '{trace.written}' is no unit of {channel}; write a multiple of {wanted}"
        )
    if trace.unit and trace.unit != wanted and not scaled:
        raise InputError(
            f"{source}{trace.place}: {trace.name} is in {trace.unit} and {channel} in {wanted}; give the factor between"
            f" them, as --scale {channel}=0.001 for {wanted} per {trace.unit}"
        )


def _assumed(trace: Trace, channel: str, factor: float) -> str:
    """What stands behind the numbers of a channel, in a sentence."""
    unit = f"in {trace.written}" if trace.written else f"no unit stated, {CHANNEL_UNITS[channel]} assumed"
    probe = "no attenuation stated" if trace.attenuation is None else f"attenuation {trace.attenuation:g} as stated"
    return f"{channel} is '{trace.name}' ({unit}; {probe}) times {factor:g}"


def _pairs(known: Mapping[str, str]) -> str:
    return ", ".join(f"{channel}={name}" for channel, name in known.items())


def _listed(names: list[str]) -> str:
    return (", ".join(names) or "nothing")[:200]
