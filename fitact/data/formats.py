"""Files to records: text and binary files of oscilloscopes and DAQ programs, and fitact's own CSV."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fitact.data.binary import is_known_binary, read_binary
from fitact.data.capture import Capture, Pick, resolve, to_record
from fitact.data.record import CHANNEL_UNITS, Record
from fitact.data.text import is_binary, read_text
from fitact.errors import InputError
from fitact.files import replacing

if TYPE_CHECKING:
    from fitact.model.scene import Scene  # which brings JAX along


def read(
    path: str | os.PathLike[str],
    scene: "Scene | None" = None,
    *,
    channels: Mapping[str, str] | None = None,
    scale: Mapping[str, float] | None = None,
) -> Record:
    """Read a record: a CSV file with the columns time_s, V_V, Vsc_V and I_A, or a file of an oscilloscope.

    `channels` says which of a file's own names is which, {"Vsc": "CH2"}; names V, Vsc and I need no word. `scale`
    multiplies, {"Vsc": 10} for a 10x probe that the oscilloscope did not know of. Units in the header are heeded;
    what had to be assumed is in the record's notes. With a `scene`, the channels that it measures must be there; V
    may be absent only where a scene gives the drive. The layouts are listed in docs/input.md.

    Raises:
        InputError: the file cannot be read, or holds what cannot be used; names the line and the remedy.
    """
    source, channels = os.fspath(path), channels or {}
    capture = read_capture(path, lambda names, place: resolve(names, channels, source, place).values())
    record = to_record(capture, channels, scale or {})
    for channel in scene.measurement.channels if scene else ("Vsc",):
        record[channel]  # refused where missing
    if "V" not in record and (scene is None or scene.drive.waveform == "measured"):
        place = capture.traces[0].place
        raise InputError(
            f"{source}{place}: the column V_V is missing and no scene gives the drive;"
            " record the drive, or name its waveform under [drive] in a scene file"
        )
    return record


def read_capture(path: str | os.PathLike[str], pick: Pick = lambda names, place: names) -> Capture:
    """Time and channels of a file under its own names, of which `pick` may choose.

    Raises:
        InputError: the file cannot be read, or is of no known layout.
    """
    source, path = os.fspath(path), Path(path)
    if path.is_dir():
        raise InputError(f"{source}: is a directory; give the path of a file")
    try:
        with path.open("rb") as file:
            head = file.read(4096)
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(f"{source}: cannot be read ({reason.lower()}); check the path and the file") from error
    if not head.strip():
        raise InputError(f"{source}: the file holds no data; expected a header such as time_s,V_V,Vsc_V,I_A")
    if head[:2] == b"\x1f\x8b" or not (is_binary(head) or is_known_binary(head, path.suffix)):
        return read_text(path, source, pick)
    return read_binary(path, source, head, pick)


def write_csv(path: str | os.PathLike[str], record: Record) -> None:
    """Write a record as `read` reads it, to 12 digits; times to the last bit, which tells on which side of an edge.

    Raises:
        InputError: the place cannot be written.
    """
    header = ["time_s", *(f"{name}_{CHANNEL_UNITS[name]}" for name in record.channels)]
    with replacing(path) as temporary:
        table = np.stack([record.time, *record.channels.values()], axis=1)
        digits = ["%.17g", *["%.12g"] * len(record.channels)]
        np.savetxt(temporary, table, fmt=digits, delimiter=",", header=",".join(header), comments="")
