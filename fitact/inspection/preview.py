"""First rows of a file whose columns are not assigned, and a guess at the command that reads it."""

import collections
import contextlib
import itertools
import os
import re
import shlex
from collections.abc import Collection, Sequence

import numpy as np
from jaxtyping import Float

from fitact.data.record import CHANNEL_UNITS, MINIMUM_SAMPLES, OVERFLOW
from fitact.errors import InputError
from fitact.files import read_head
from fitact.readers.capture import FULL_SCALE, Capture, FileChannel
from fitact.readers.read import read_capture
from fitact.readers.spectrum import is_swept
from fitact.readers.text import is_binary
from fitact.tables import align_table


def preview(path: str | os.PathLike[str], rate: float | None = None, segment: int | None = None) -> str:
    """Return columns, first rows and a guess for a file that is refused; `rate` (Hz) and `segment` are the user's.

    Of several segments, the first is shown. A text without enough rows of numbers is shown as it is. Of other files
    that cannot be read nothing is shown.
    """
    # any rate shows the columns of a file without times
    for given, chosen in itertools.product((None, rate or 1.0), dict.fromkeys((segment, segment or 1))):
        with contextlib.suppress(InputError):
            capture = read_capture(path, rate=given, segment=chosen)
            if capture.time.size < MINIMUM_SAMPLES:
                break
            is_timed = given is None
            count = len(capture.channels)
            place = capture.source if chosen == segment else f"segment {chosen} of {capture.source}"
            title = f"{place} ({capture.format}) holds {capture.time.size:,} rows in {count} columns of values:"
            table = describe_rows(capture.channels, capture.time if is_timed else None)
            reason, command = guess_command(capture, None if is_timed else rate, is_timed, chosen)
            return "\n".join([title, *table, f"guess {reason}" + f":\n  {command}" * bool(command)])
    with contextlib.suppress(InputError):
        head = read_head(path)
        lines = [] if is_binary(head) else head.decode("utf-8", errors="replace").splitlines()
        shown = [f"  {line[:100]}" for line in lines[:6]]
        return "\n".join([f"{os.fspath(path)} begins with:", *shown] if shown else [])
    return ""


def describe_rows(
    columns: Sequence[FileChannel],
    time: Float[np.ndarray, " samples"] | None = None,
    max_rows: int = 5,
    max_columns: int = 10,
) -> list[str]:
    """Return a table of the first rows and columns, in SI units, beside their times or numbers."""
    shown = [("row", 1 + np.arange(columns[0].values.size))] if time is None else [("time (s)", time)]
    shown += [
        (column.name + f" ({column.unit})" * bool(column.unit), column.values) for column in columns[:max_columns]
    ]
    rows = [[f"{values[i]:.6g}" for _, values in shown] for i in range(min(max_rows, shown[0][1].size))]
    return [f"  {line}" for line in align_table([[name for name, _ in shown], *rows])]


def guess_command(
    capture: Capture, rate: float | None = None, is_timed: bool = True, segment: int | None = None
) -> tuple[str, str]:
    """Return a guess at the channels of a file, by their units and sizes, and the command that reads it so, or "".

    `rate` (Hz) is what the user stated. A file that is not timed needs a rate. `segment` is the one that was read.
    """
    columns = capture.channels
    if capture.time.size < MINIMUM_SAMPLES:
        return f"none: {capture.time.size} samples are too few to fit", ""
    if not is_timed and _is_frequency(columns[0]):
        return f"by '{columns[0].name}': a spectrum; name its columns as in frequency_Hz,Z_real_ohm,Z_imag_ohm", ""
    known = {
        channel: column for channel in CHANNEL_UNITS for column in columns if column.name.lower() == channel.lower()
    }
    assigned, remarks, options = _guess_channels(columns, known), list[str](), list[str]()
    channels = known | assigned
    scaled = {
        channel: column.unit_text == FULL_SCALE
        for channel, column in channels.items()
        if column.unit_text and column.unit != CHANNEL_UNITS[channel]
    }
    if not assigned and not scaled and (segment is None or not {"Vsc", "I"} & known.keys()):
        return "by units and sizes: no other column is a voltage or a current that varies; export Vsc or I", ""
    if rate is not None:
        options += ["--rate", f"{rate:.9g}Hz"]
    elif not is_timed or np.any(np.diff(capture.time) <= 0.0):
        name, guessed = _find_clock(capture, is_timed)
        remarks.append(f"with {name} in s" if name else "with your sampling rate in place of this one")
        options += ["--rate", guessed]
    if segment is not None:
        options += ["--segment", str(segment)]
    for channel, column in assigned.items():
        options += ["--channel", f"{channel}={column.name}"]
    for channel, is_full_scale in scaled.items():
        options += ["--scale", f"{channel}={'10' if is_full_scale else '0.001'}"]
    if scaled:
        remarks.append("with your factors or full scales in place of these")
    if "V" not in channels:
        remarks.append("a fit needs a scene that states the drive")
    elif "Vsc" not in channels:
        remarks.append("a fit needs a scene with [measurement] channels = ['I']")
    reason = "by units and sizes, which may mislead" + f" ({'; '.join(remarks)})" * bool(remarks)
    command = "fit" if {"V", "Vsc"} <= channels.keys() else "inspect"
    return reason, shlex.join(["fitact", command, capture.source, *options])


def _guess_channels(columns: Sequence[FileChannel], known: Collection[str]) -> dict[str, FileChannel]:
    """Return the largest voltage as V, the next one as Vsc, and the largest current and force, if not yet `known`.

    A single voltage is Vsc, unless there is a current. Columns that rise evenly are times or counts, and names that end
    in another unit, as in "T (°C)", come last.
    """
    counts = collections.Counter(column.name for column in columns)
    ranked: dict[str, list[tuple[bool, float, FileChannel]]] = collections.defaultdict(list)
    for column in columns:
        values = column.values[np.abs(column.values) < OVERFLOW]
        size = float(np.ptp(values)) if values.size else 0.0
        is_usable = (column.unit or column.unit_text in ("", FULL_SCALE)) and counts[column.name] == 1
        if size > 0.0 and is_usable and column.name not in known and not _is_ramp(column.values):
            is_other = re.search(r"[)\]%]$|°", column.name) is not None
            ranked[column.unit or "V"].append((is_other, -size, column))
    has_drive = len(ranked["V"]) > 1 or bool(ranked["A"])
    wanted = [channel for channel in CHANNEL_UNITS if channel not in known and (channel != "V" or has_drive)]
    assigned: dict[str, FileChannel] = {}
    for unit, pairs in ranked.items():
        names = [channel for channel in wanted if CHANNEL_UNITS[channel] == unit]
        largest = sorted(pairs, key=lambda pair: pair[:2])
        assigned |= {name: column for name, (*_, column) in zip(names, largest, strict=False)}
    return {channel: assigned[channel] for channel in wanted if channel in assigned}


def _is_ramp(values: Float[np.ndarray, " samples"], tolerance: float = 1e-2) -> bool:
    """Return whether values rise evenly, to `tolerance` of their range."""
    if values.size < 3 or not np.all(np.isfinite(values)) or values[-1] <= values[0]:
        return False
    line = np.linspace(values[0], values[-1], values.size)
    return bool(np.max(np.abs(values - line)) <= tolerance * (values[-1] - values[0]))


def _find_clock(capture: Capture, is_timed: bool) -> tuple[str, str]:
    """Return the name and the rate of the first column that rises evenly and is no count of the rows.

    Without one, the name is empty, and the rate that of the file's rounded times, or an example.
    """
    for column in () if is_timed else capture.channels:
        if _is_ramp(column.values) and not np.isclose(step := _mean_step(column.values), 1.0):
            return column.name, f"{1.0 / step:.6g}Hz"
    step = _mean_step(capture.time) if is_timed and np.all(np.isfinite(capture.time)) else 0.0
    return "", f"{1.0 / step:.6g}Hz" if step > 0.0 else "100kHz"


def _mean_step(values: Float[np.ndarray, " samples"]) -> float:
    """Return the slope of the line through the values, which rounding hardly changes."""
    return float(np.polyfit(np.arange(values.size), values, 1)[0])


def _is_frequency(column: FileChannel) -> bool:
    """Return whether a column is named a frequency, or is positive and sweeps like one."""
    named = column.name.lower().startswith("freq") or "hz" in (column.name + column.unit_text).lower()
    rising = column.values.size > 2 and len(set(np.sign(np.diff(column.values)))) == 1
    return named or bool(rising and is_swept(column.values))
