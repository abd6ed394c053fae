"""Segments of a file: runs, steps, frames or sheets, one of which is read."""

import dataclasses
import itertools
import re
from pathlib import Path
from typing import IO

import numpy as np
from jaxtyping import Float

from fitact.data.record import MINIMUM_SAMPLES
from fitact.errors import SEGMENT_OPTION, InputError
from fitact.readers.capture import Capture
from fitact.readers.spreadsheet import is_spreadsheet, read_sheets

SEGMENT = re.compile(r"Step Information:|Channels[\t,;]|\*\*\*End_of_Header")  # of LTspice, LabVIEW


class SegmentsError(InputError):
    """The rows of another segment follow."""


def select_segment(
    segment: int | None, count: int, source: str, kind: str = "segments (runs, steps, frames or sheets)"
) -> int:
    """Return the index of a segment that is numbered from 1; None stands for the only one."""
    held = f"holds {count} {kind}" if count > 1 else "holds one segment"
    if segment is None and count > 1:
        raise InputError(f"{source}: {held}; choose one, as {SEGMENT_OPTION}")
    if segment is not None and not 1 <= segment <= count:
        raise InputError(f"{source}: {held}, so there is no number {segment}; choose another, as {SEGMENT_OPTION}")
    return (segment or 1) - 1


def choose_segment(capture: Capture, segment: int | None, stated: int = 1) -> Capture:
    """Return one of the segments of a capture, from 1; see `split_time`."""
    parts = split_time(capture.time, stated)
    return take_part(capture, parts[select_segment(segment, len(parts), capture.source)])


def split_time(time: Float[np.ndarray, " samples"], stated: int = 1) -> list[slice]:
    """Return the segments of a file: the runs in which the time starts anew, or `stated` equal parts."""
    starts = np.flatnonzero(time[1:] < time[:-1]) + 1
    edges = np.concatenate([[0], starts, [time.size]])
    is_short = np.min(np.diff(edges)) < MINIMUM_SAMPLES
    # after a few rows out of order, others follow the rows before
    if not starts.size or is_short or not np.all(time[starts + MINIMUM_SAMPLES - 1] <= time[starts - 1]):
        count = stated if 1 < stated <= time.size // MINIMUM_SAMPLES else 1  # a damaged header may state any number
        edges = np.append(np.arange(count) * (time.size // count), time.size)
    return [slice(int(start), int(stop)) for start, stop in itertools.pairwise(edges)]


def take_part(capture: Capture, part: slice) -> Capture:
    if part == slice(0, capture.time.size):
        return capture
    return dataclasses.replace(
        capture,
        time=capture.time[part],
        channels=tuple(dataclasses.replace(each, values=each.values[part]) for each in capture.channels),
        row_label=lambda row: capture.row_label(row + part.start),
    )


def find_parts(path: Path, stream: IO[bytes], segment: int | None, max_bytes: int) -> list[tuple[bytes, int]]:
    """Return the sheets of a file, or the segments of its only sheet or text if one is asked for."""
    if is_spreadsheet(path):
        sheets = read_sheets(path)
        return [(sheet, 0) for sheet in sheets] if len(sheets) > 1 or segment is None else _split_text(sheets[0])
    return [] if segment is None else _split_text(stream.read(max_bytes))


def _split_text(text: bytes) -> list[tuple[bytes, int]]:
    """Return the segments of a text, each below the header of the file, with the number of lines left out between.

    A segment begins where the first line of the file is repeated, or at the headers of LTspice and LabVIEW.
    """
    first = text.removeprefix(b"\xef\xbb\xbf").partition(b"\n")[0].rstrip()
    repeated = re.escape(first) + rb"\s*$" if re.match(rb"\W*[A-Za-z]", first) else rb"(?!)"
    for mark in (repeated, rb"Step Information:", rb"Channels[\t,;]"):
        starts = [match.start() for match in re.finditer(rb"(?m)^(?:\xef\xbb\xbf)?" + mark, text)]
        if len(starts) > 1:
            header, edges = text[: starts[0]], itertools.pairwise([*starts, len(text)])
            lines = header.count(b"\n")
            return [(header + text[start:stop], text.count(b"\n", 0, start) - lines) for start, stop in edges]
    return [(text, 0)]
