"""Files to records: text and binary files of oscilloscopes and DAQ programs, and fitact's own CSV."""

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fitact.data.readers.binary import is_known_binary, read_binary
from fitact.data.readers.capture import Capture, Pick, find_channel, resolve_channels, to_record
from fitact.data.readers.layouts import is_same_grid
from fitact.data.readers.text import is_binary, read_text
from fitact.data.record import CHANNEL_UNITS, Record
from fitact.data.spectrum import is_spectrum
from fitact.errors import InputError
from fitact.files import atomic_write, read_error

if TYPE_CHECKING:
    from fitact.scene.scene import Scene  # which brings JAX along


def read(
    path: str | os.PathLike[str],
    scene: "Scene | None" = None,
    *,
    channels: Mapping[str, str] | None = None,
    scale: Mapping[str, float] | None = None,
) -> Record:
    """Read a record: a CSV file with the columns time_s, V_V, Vsc_V and I_A, or a file of an oscilloscope.

    `channels` says which of a file's own names is which, {"Vsc": "CH2"}; names V, Vsc and I need no word. Where each
    channel has a file of its own, {"Vsc": "CH2", "V": "C1.trc:CH1"} fetches V from beside this one. `scale` multiplies,
    {"Vsc": 10} for a 10x probe that the oscilloscope did not know of. Units in the header are heeded; what had to be
    assumed is in the record's notes. With a `scene`, the channels that it measures must be there; V
    may be absent only where a scene gives the drive. The layouts are listed in docs/input.md.

    Raises:
        InputError: the file cannot be read, or holds what cannot be used; names the line and the remedy.
    """
    source, channels = os.fspath(path), channels or {}
    own = {channel: asked for channel, asked in channels.items() if _locate_file_column(path, asked) is None}
    capture = read_capture(path, lambda names, place: resolve_channels(names, own, source, place).values())
    capture = merge_other_files(capture, path, channels)
    record = to_record(capture, channels, scale or {})
    for channel in scene.measurement.channels if scene else ("Vsc",):
        record[channel]  # refused where missing
    if "V" not in record and (scene is None or scene.drive.waveform == "measured"):
        place = capture.channels[0].location
        raise InputError(
            f"{source}{place}: the column V_V is missing and no scene gives the drive;"
            " record the drive, or name its waveform under [drive] in a scene file"
        )
    return record


def read_capture(path: str | os.PathLike[str], pick: Pick = lambda names, place: names) -> Capture:
    """Return time and channels of a file under its own names, of which `pick` may choose."""
    source, path = os.fspath(path), Path(path)
    if path.is_dir():
        raise InputError(f"{source}: is a directory; give the path of a file")
    try:
        with path.open("rb") as file:
            head = file.read(4096)
    except OSError as error:
        raise read_error(source, error) from error
    if not head.strip():
        raise InputError(f"{source}: the file holds no data; expected a header such as time_s,V_V,Vsc_V,I_A")
    if head[:2] == b"\x1f\x8b":
        return read_text(path, source, pick)
    if is_binary(head) or is_known_binary(head, path.suffix):
        return read_binary(path, source, head, pick)
    if is_spectrum(path):
        raise InputError(f"{source}: is an impedance spectrum, without time; give it to: fitact fit (fit_spectrum)")
    return read_text(path, source, pick)


def merge_other_files(capture: Capture, path: str | os.PathLike[str], channels: Mapping[str, str]) -> Capture:
    """Return the capture, and the columns of other files that `channels` names as FILE:COLUMN."""
    traces = list(capture.channels)
    for asked in channels.values():
        if found := _locate_file_column(path, asked):
            other = _read_column(*found)
            if not is_same_grid(capture.time, other.time):
                raise InputError(
                    f"{capture.source}: {found[0]} has another length or other times, so it is not of one capture with"
                    " this file; export both anew"
                )
            traces.append(dataclasses.replace(other.channels[0], name=asked))
    return dataclasses.replace(capture, channels=tuple(traces))


def _read_column(file: Path, column: str) -> Capture:
    return read_capture(file, lambda names, _: [find_channel(column, names, str(file))])


def _locate_file_column(path: str | os.PathLike[str], requested: str) -> tuple[Path, str] | None:
    """Return the file and the column where a channel is asked for as FILE:COLUMN, the file from here or beside `path`."""
    file, colon, column = requested.rpartition(":")
    found = [place for place in (Path(path).parent / file, Path(file)) if colon and column and place.is_file()]
    return (found[0], column) if found else None


def write_csv(path: str | os.PathLike[str], record: Record) -> None:
    """Write a record as `read` reads it, to 12 digits; times to the last bit, which tells on which side of an edge."""
    header = ["time_s", *(f"{name}_{CHANNEL_UNITS[name]}" for name in record.channels)]
    with atomic_write(path) as temporary:
        table = np.stack([record.time, *record.channels.values()], axis=1)
        digits = ["%.17g", *["%.12g"] * len(record.channels)]
        np.savetxt(temporary, table, fmt=digits, delimiter=",", header=",".join(header), comments="")
