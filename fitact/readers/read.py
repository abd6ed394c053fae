"""Records from files: text and binary files of oscilloscopes and DAQ programs, and fitact's own CSV."""

import dataclasses
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fitact.data.record import CHANNEL_UNITS, Record
from fitact.data.spectrum import Spectrum
from fitact.errors import InputError, channel_option
from fitact.files import atomic_write, read_head
from fitact.readers.binary import is_known_binary, read_binary
from fitact.readers.capture import (
    Capture,
    Pick,
    find_channel,
    replace_rounded_times,
    resolve_channels,
    to_record,
)
from fitact.readers.layouts import is_same_grid
from fitact.readers.spectrum import is_spectrum, read_spectrum
from fitact.readers.spice import is_ac_analysis
from fitact.readers.spreadsheet import is_spreadsheet
from fitact.readers.text import PADDING, is_binary, read_text

if TYPE_CHECKING:
    from fitact.scene.scene import Scene  # would import JAX


class SpectrumFileError(InputError):
    """The file holds a spectrum in place of a record."""


def read_any(path: str | os.PathLike[str], scene: "Scene | None" = None, **columns: Any) -> Record | Spectrum:
    """Read a record with the `columns` of `read`, or the spectrum that the file holds.

    Raises:
        InputError: as `read` and `read_spectrum`.
    """
    try:
        return read(path, scene, **columns)
    except SpectrumFileError:
        return read_spectrum(path, columns.get("segment"))


def read(
    path: str | os.PathLike[str],
    scene: "Scene | None" = None,
    *,
    channels: Mapping[str, str] | None = None,
    scale: Mapping[str, float] | None = None,
    rate: float | None = None,
    segment: int | None = None,
) -> Record:
    """Read a record: a CSV file with the columns time_s, V_V, Vsc_V, I_A and Ft_N, or a file of an oscilloscope.

    `channels` assigns the names in the file, e.g. {"Vsc": "CH2"}; the names V, Vsc, I and Ft need none. If each channel
    has its own file, {"Vsc": "CH2", "V": "C1.trc:CH1"} reads V from another file in the same folder. `scale` multiplies
    a channel, e.g. {"Vsc": 10} for a 10x probe that was not set on the oscilloscope. `rate` (Hz), or else a sampling
    rate that the scene states, replaces times that were rounded when they were written. `segment` (from 1) chooses one
    of the runs, steps, frames or sheets of a file that holds several. Units in the header are applied, and assumptions
    are listed in the record's notes. With a `scene`, its measured channels are required, and V may be absent if the
    scene states the drive. docs/input.md lists the layouts.

    Raises:
        InputError: the file cannot be read, or its data are invalid; the message names the line and a remedy.
    """
    source, channels = os.fspath(path), channels or {}
    local_columns = {channel: asked for channel, asked in channels.items() if _locate_file_column(path, asked) is None}
    stated = scene is not None and "sampling_rate" in scene.measurement.model_fields_set
    scene_rate = scene.measurement.sampling_rate if scene is not None and stated else None

    def pick(names: list[str], place: str) -> Iterable[str]:
        return resolve_channels(names, local_columns, source, place).values()

    capture = read_capture(path, pick, rate or scene_rate, segment)
    capture = merge_other_files(capture, path, channels, rate or scene_rate, segment)
    capture = replace_rounded_times(capture, rate, scene_rate)
    record = to_record(capture, channels, scale or {})
    for channel in scene.measurement.channels if scene else ("Vsc",):
        record[channel]  # raises InputError if missing
    if "V" not in record and (scene is None or scene.drive.waveform == "measured"):
        place = capture.channels[0].location
        raise InputError(
            f"{source}{place}: the column V_V is missing and no scene states the drive; record the drive, name its"
            f" column, as {channel_option({'V': 'COLUMN'})}, or name its waveform under [drive] in a scene file"
        )
    return record


def read_capture(
    path: str | os.PathLike[str],
    pick: Pick = lambda names, place: names,
    rate: float | None = None,
    segment: int | None = None,
) -> Capture:
    """Return time and channels of a file, by the names in the file; `pick` may select some of them.

    `rate` (Hz) gives the times of a file that states none, `segment` (from 1) chooses one of several.
    """
    source, path = os.fspath(path), Path(path)
    head = read_head(path)
    if not head.strip():
        raise InputError(f"{source}: the file holds no data; record again, or export it again as CSV")
    if head[:2] == b"\x1f\x8b":
        return read_text(path, source, pick, rate, segment)
    binary = is_binary(head.rstrip(PADDING)) or is_known_binary(head, path.suffix)
    binary = binary and not is_spreadsheet(path)
    if is_ac_analysis(path) if binary else is_spectrum(path):
        raise SpectrumFileError(
            f"{source}: is a spectrum, without time, and this needs a record in time; give a record, or read it with"
            " fitact.read_spectrum, as fitact inspect and fitact fit do"
        )
    if binary:
        return read_binary(path, source, head, pick, rate, segment)
    return read_text(path, source, pick, rate, segment)


def merge_other_files(
    capture: Capture,
    path: str | os.PathLike[str],
    channels: Mapping[str, str],
    rate: float | None = None,
    segment: int | None = None,
) -> Capture:
    """Return the capture with the columns of other files that `channels` names as FILE:COLUMN added."""
    traces = list(capture.channels)
    for requested in channels.values():
        if found := _locate_file_column(path, requested):
            other = _read_column(*found, rate, segment)
            if not is_same_grid(capture.time, other.time):
                raise InputError(
                    f"{capture.source}: {found[0]} has a different length or different times, so it does not belong to"
                    " the same acquisition; export both files again"
                )
            traces.append(dataclasses.replace(other.channels[0], name=requested))
    return dataclasses.replace(capture, channels=tuple(traces))


def _read_column(file: Path, column: str, rate: float | None, segment: int | None) -> Capture:
    return read_capture(file, lambda names, _: [find_channel(column, names, str(file))], rate, segment)


def _locate_file_column(path: str | os.PathLike[str], requested: str) -> tuple[Path, str] | None:
    """Return file and column of a channel given as FILE:COLUMN, relative to the current folder or to `path`."""
    file, colon, column = requested.rpartition(":")
    candidates = [place for place in (Path(path).parent / file, Path(file)) if colon and column and place.is_file()]
    return (candidates[0], column) if candidates else None


def write_csv(path: str | os.PathLike[str], record: Record) -> None:
    """Write a record for `read`, with 12 digits; times are exact, so that samples stay on their side of an edge."""
    header = ["time_s", *(f"{name}_{CHANNEL_UNITS[name]}" for name in record.channels)]
    with atomic_write(path) as temporary:
        table = np.stack([record.time, *record.channels.values()], axis=1)
        digits = ["%.17g", *["%.12g"] * len(record.channels)]
        np.savetxt(temporary, table, fmt=digits, delimiter=",", header=",".join(header), comments="")
