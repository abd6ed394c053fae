"""Samples of a long record in blocks, also of a file that is still being written, or of standard input."""

import os
import sys
import time
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np
from jaxtyping import Float

from fitact.files import read_error, read_head
from fitact.readers.binary import is_known_binary
from fitact.readers.capture import channel_arrays, resolve_channels
from fitact.readers.read import read
from fitact.readers.text import BLOCK_BYTES, is_binary, read_sidecar, stream_text


class Block(NamedTuple):
    """Samples as they were read, in SI units."""

    time: Float[np.ndarray, " samples"]  # s
    channels: Mapping[str, Float[np.ndarray, " samples"]]
    position: float  # bytes or samples read so far
    notes: tuple[str, ...] = ()


def stream_record(
    path: str | os.PathLike[str],
    *,
    channels: Mapping[str, str] | None = None,
    scale: Mapping[str, float] | None = None,
    rate: float | None = None,
    segment: int | None = None,
    follow: float = 0.0,
) -> Iterator[Block]:
    """Yield the samples of a record in blocks; arguments as in `read`.

    `path` may be "-" for standard input. A text file is read in blocks; with `follow`, until it has not grown for that
    many seconds. Other files, and one `segment` of a file, are read at once. `rate` (Hz) replaces the times by a
    uniform grid.

    Raises:
        InputError: as `read`.
    """
    source, channels, scale = os.fspath(path), channels or {}, scale or {}
    if source != "-" and (segment is not None or not _is_plain_text(Path(path))):
        record = read(path, channels=channels, scale=scale, rate=rate, segment=segment)
        size = 262_144  # samples in a block
        for first in range(0, len(record), size):
            part = slice(first, first + size)
            values = {name: each[part] for name, each in record.channels.items()}
            yield Block(record.time[part], values, float(first), record.notes)
        return
    is_standard = source == "-"
    source = "standard input" if is_standard else source

    def pick(names: list[str], place: str) -> Iterable[str]:
        return resolve_channels(names, channels, source, place).values()

    try:
        with sys.stdin.buffer if is_standard else Path(path).open("rb") as file:
            sidecar = "" if is_standard else read_sidecar(Path(path))
            count, begin = 0, None
            for capture in stream_text(_chunks(file, follow), source, pick, sidecar):
                arrays, _, notes = channel_arrays(capture, channels, scale)
                times = capture.time
                begin = float(times[0]) if begin is None else begin
                if rate is not None:
                    times = begin + (count + np.arange(times.size)) / rate
                count += times.size
                position = float(file.tell()) if file.seekable() else float(count)
                yield Block(times, arrays, position, (*capture.notes, *capture.warnings, *notes))
    except OSError as error:
        raise read_error(source, error) from error


def _is_plain_text(path: Path) -> bool:
    """Return whether a file is text that can be read in blocks: not packed, and with lines of ASCII or UTF-8."""
    head = read_head(path)
    packed, wide = head[:2] == b"\x1f\x8b", head[:2] in (b"\xff\xfe", b"\xfe\xff")
    return not (packed or wide or is_binary(head) or is_known_binary(head, path.suffix) or b"\n" not in head)


def _chunks(file: IO[bytes], follow: float, pause: float = 0.1) -> Iterator[bytes]:
    """Yield what can be read; with `follow`, wait that many seconds for more."""
    read_some = getattr(file, "read1", file.read)
    waited = 0.0
    while True:
        chunk = read_some(BLOCK_BYTES)
        if chunk:
            waited = 0.0
            yield chunk
        elif waited >= follow:
            return
        else:
            time.sleep(pause)
            waited += pause
