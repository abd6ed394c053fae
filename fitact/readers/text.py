"""Text files: a header of the manufacturer, followed by rows of numbers, read in blocks."""

import bisect
import contextlib
import csv
import dataclasses
import gzip
import io
import math
import os
import re
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any, NoReturn, cast

import numpy as np
from jaxtyping import Float

from fitact.errors import RATE_OPTION, SEGMENT_OPTION, InputError
from fitact.files import read_error
from fitact.progress import track_progress
from fitact.readers import layouts
from fitact.readers.capture import Capture, FileChannel, Pick
from fitact.readers.header import MINUS, Column, Header, parse_number, read_header, split_cells
from fitact.readers.segments import SEGMENT, SegmentsError, choose_segment, find_parts, select_segment
from fitact.units import format_engineering

PADDING = b"\x00\x1a"  # that some programs write after the text
_HEAD_BYTES = 32_768  # bytes; enough for any header and some rows
# a time of day, after which date it may stand; the date counts only by its midnights
_CLOCK = re.compile(
    rb"(?:(?:\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4}|\d{1,2}[- ][A-Za-z]{3}[- ]\d{2,4})[ T])?"
    rb"(?<![\d:])(?:(\d{1,2}):)?(\d\d):(\d\d(?:\.\d+|:\d{3}(?:\d{3})?|,\d+(?=[;\t]))?)"
    rb"(?: ?([AaPp])[Mm]|Z|[+-]\d\d:?\d\d)?"
)
_DAY = 86_400.0  # s
_THOUSANDS = re.compile(rb'"([-+]?\d{1,3}(?:,\d{3})+(?:\.\d*)?)"')
MAX_FOOTER_LINES = 20  # more lines of words are no statistics below the data
BLOCK_BYTES = 8_388_608  # parsed in one block


def read_text(
    path: Path,
    source: str,
    pick: Pick,
    rate: float | None = None,
    segment: int | None = None,
    max_bytes: int = 4_294_967_296,
) -> Capture:
    """Return the columns of a text file (plain or gzip) that `pick` selects, in SI units.

    `rate` (Hz) gives the times of a file that states none, `segment` (from 1) chooses one of several. Text of more
    than `max_bytes` is refused; it indicates a damaged gzip file.
    """
    parts: list[tuple[bytes, int]] = []
    try:
        with _open_text(path, max_bytes) as (stream, file):
            parts = find_parts(path, stream, segment, max_bytes)
            place = select_segment(segment, len(parts), source) if len(parts) > 1 else 0
            if parts:
                stream = io.BytesIO(parts[place][0])
            head = stream.read(_HEAD_BYTES)
            stream.seek(0)
            table = _TableParser.from_head(head.rstrip(PADDING), source, pick, read_sidecar(path), rate)
            table.line_shift = parts[place][1] if parts else 0
            if stream is not file or not table.add_file(path):
                blocks = _blocks(iter(lambda: stream.read(BLOCK_BYTES), b""), source, max_bytes)
                for block in track_progress(blocks, f"reading {source}", path.stat().st_size, file.tell):
                    table.add(block)
    except SegmentsError:
        with _open_text(path, max_bytes) as (stream, file):
            select_segment(segment, max(2, len(find_parts(path, stream, 1, max_bytes))), source)
        raise
    except (OSError, EOFError, zlib.error) as error:
        raise read_error(source, error) from error
    capture = table.to_capture()
    return capture if len(parts) > 1 else choose_segment(capture, segment, table.count_segments())


def stream_text(
    chunks: Iterator[bytes], source: str, pick: Pick, sidecar_text: str = "", min_lines: int = 50
) -> Iterator[Capture]:
    """Yield the rows of a text as they arrive, a capture for each chunk; `chunks` are whole or broken lines.

    The header is read from the first `min_lines` lines, or from all if there are fewer.
    """
    table, taken = None, 0
    for block in _join_first(_blocks(chunks, source, math.inf), min_lines):
        table = table or _TableParser.from_head(block[:_HEAD_BYTES], source, pick, sidecar_text)
        table.add(block)
        capture = table.take_capture(taken)
        if capture is not None:
            taken += capture.time.size
            yield capture


def _join_first(blocks: Iterator[bytes], min_lines: int) -> Iterator[bytes]:
    """Yield the blocks, the first of them joined until they have `min_lines` lines."""
    first = next(blocks, b"")
    while first.count(b"\n") < min_lines and (more := next(blocks, b"")):
        first += b"\n" + more
    if first.strip():
        yield first
    yield from blocks


def is_binary(head: bytes) -> bool:
    return not _is_utf16(head) and re.search(rb"[\x00-\x08\x0e-\x1f]", head) is not None


def _is_utf16(head: bytes) -> bool:
    return head[:2] in (b"\xff\xfe", b"\xfe\xff")


@contextlib.contextmanager
def _open_text(path: Path, max_bytes: int) -> Iterator[tuple[IO[bytes], IO[bytes]]]:
    """Open a text file and yield its bytes (UTF-8 or a superset of ASCII, lines ending in a line feed) and the file.

    Of other text, which is converted, at most `max_bytes` are read.
    """
    with path.open("rb") as file:
        packed = file.read(2) == b"\x1f\x8b"
        file.seek(0)
        stream = cast(IO[bytes], gzip.GzipFile(fileobj=file) if packed else file)
        head = stream.read(_HEAD_BYTES)
        stream.seek(0)
        old = b"\r" in head and b"\n" not in head
        if old or _is_utf16(head):
            text = stream.read(max_bytes).decode("utf-16" if _is_utf16(head) else "latin-1", errors="replace")
            stream = io.BytesIO((text.replace("\r", "\n") if old else text).encode())
        yield stream, file


def read_sidecar(path: Path) -> str:
    """Return the header in NAME.csv for the numbers in NAME.Wfm.csv (Rohde & Schwarz), or ""."""
    header = path.with_name(path.name[: -len(".wfm.csv")] + path.name[-4:])
    if not (path.name.lower().endswith(".wfm.csv") and header.is_file()):
        return ""
    with header.open("rb") as file:
        return file.read(_HEAD_BYTES).decode("latin-1")


def _decode(head: bytes, source: str) -> str:
    """Decode UTF-8 or else the Windows encoding, in which some manufacturers write µ."""
    if is_binary(head):
        raise InputError(f"{source}: is neither a text file nor a known binary format; export the record as CSV")
    try:
        return head.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        cut = error.start > len(head) - 4  # the head ends within a character
        return head[: error.start].decode("utf-8-sig") if cut else head.decode("cp1252", errors="replace")


def _write_seconds(clock: re.Match[bytes]) -> bytes:
    """Return a time of day as seconds since midnight."""
    hours, minutes, seconds, half = clock.groups()
    if hours is None:  # as Excel shows times, with minutes, seconds and decimals
        if not re.search(rb"[.,]", seconds):
            return clock[0]
        hours = b"0"
    seconds = re.sub(rb"[,:]", b".", seconds)
    hour = int(hours) if half is None else int(hours) % 12 + 12 * (half in b"Pp")
    return b"%.9f" % (3600.0 * hour + 60.0 * int(minutes) + float(seconds))


def _join_thousands(text: bytes) -> bytes:
    return _THOUSANDS.sub(lambda match: match[1].replace(b",", b""), text)


def _blocks(parts: Iterator[bytes], source: str, max_bytes: float) -> Iterator[bytes]:
    """Yield whole lines, without the last line feed, from parts that may break lines."""
    rest, size = b"", 0
    for part in parts:
        size += len(part)
        if size > max_bytes:
            raise InputError(f"{source}: has more than {max_bytes / 2**30:.0f} GB of uncompressed text; shorten it")
        whole, newline, rest = (rest + part).rpartition(b"\n")
        if newline:
            yield whole
        elif len(rest) > BLOCK_BYTES:
            raise InputError(f"{source}: has a line of {len(rest):,} bytes; export the record as CSV")
    if rest:
        yield rest


class _TableParser:
    def __init__(self, header: Header, columns: Sequence[Column], source: str) -> None:
        self._header, self._columns, self._source = header, columns, source
        known = [header.time.place] if header.time else [header.index] if header.index is not None else []
        self._has_time = bool(known)  # or a count of samples in the first column
        self._column_indices = [*known, *(column.place for column in columns)]
        self._parts: list[np.ndarray] = []  # rows of numbers
        self._lines: list[Sequence[int]] = []  # line numbers of the rows of each part
        self._starts = [0]  # number of rows before each part
        self._blank_rows: list[int] = []  # rows with a time but no values
        self._footer: list[tuple[int, str]] = []  # lines of words below the rows, with their numbers
        self._next_line = 1
        self.line_shift = 0  # lines left out between header and rows
        self._has_thousands = False  # whether quoted numbers have commas between their thousands
        self._clock_start: float | None = None  # first time of day, s
        self._clock_end = 0.0  # last time since the first midnight, s

    @classmethod
    def from_head(
        cls, head: bytes, source: str, pick: Pick, sidecar_text: str, rate: float | None = None
    ) -> "_TableParser":
        """Make the parser of the columns that `pick` selects, by the header in the first `_HEAD_BYTES` of a text."""
        has_thousands = re.search(rb'"[-+]?\d{1,3}(?:,\d{3})+\.\d+"', head) is not None
        head = _join_thousands(head) if has_thousands else head
        is_clock = 2 * len(re.findall(rb"(?m)^.*(?:\d:\d\d:\d\d|\b\d\d:\d\d[.,]\d)", head)) > head.count(b"\n")
        text = _decode(_CLOCK.sub(_write_seconds, head) if is_clock else head, source)
        text = text if len(head) < _HEAD_BYTES else text.rpartition("\n")[0]
        header = read_header(text, source, sidecar_text, rate, is_clock=is_clock)
        wanted = set(pick([column.name for column in header.channels], header.location))
        parser = cls(header, [column for column in header.channels if column.name in wanted], source)
        parser._has_thousands = has_thousands
        return parser

    def add(self, block: bytes) -> None:
        first, skipped = self._next_line, max(0, self._header.data_rows[0].number - self._next_line)
        self._next_line += block.count(b"\n") + 1
        if skipped:
            parts = block.split(b"\n", skipped)
            if len(parts) <= skipped:
                return
            first, block = first + skipped, parts[skipped]
        first += self.line_shift
        block = _join_thousands(block) if self._has_thousands else block
        block = block.replace(b"\r", b"").replace(b'"', b"").rstrip(PADDING)
        block = block if block.isascii() else block.replace(MINUS.encode(), b"-")
        block = _CLOCK.sub(_write_seconds, block) if self._header.is_clock else block
        if self._header.delimiter == " ":
            block = re.sub(rb"(?m)^ +| +$", b"", re.sub(rb"[ \t]+", b" ", block))
        numbers, lines = self._parse_fast(block), None
        if numbers is None:
            numbers, lines = self._parse_line_by_line(block, first)
        if len(numbers):
            self._add_rows(numbers, lines or range(first, first + len(numbers)))

    def _add_rows(self, numbers: np.ndarray, lines: Sequence[int]) -> None:
        self._parts.append(numbers)
        self._lines.append(lines)
        self._starts.append(self._starts[-1] + len(numbers))

    def add_file(self, path: Path, large: int = 1_048_576) -> bool:
        """Add all rows of a plain file above `large` bytes at once; return whether each has a number in every cell.

        Nothing else is done to the text, which costs as much as to parse it. A last column may be empty, as behind a
        delimiter at the end of each line.
        """
        header = self._header
        words, last = set(range(header.width)) - header.numeric, header.width - 1
        is_empty = words <= {last} and not any("".join(row.cells[last:]) for row in header.data_rows if words)
        if path.stat().st_size <= large or header.delimiter == " " or header.is_clock or not is_empty:
            return False
        skipped = header.data_rows[0].number - 1
        numbers = self._parse_large(
            os.fspath(path), skiprows=skipped, decimal="," if header.decimal_comma else ".", quoting=csv.QUOTE_NONE,
            dtype={i: "category" if i in words else float for i in range(header.width)},
        )  # fmt: skip
        if numbers is not None:
            self._add_rows(numbers, range(skipped + 1, skipped + 1 + len(numbers)))
        return numbers is not None

    def _parse_fast(self, block: bytes, large: int = 1_048_576) -> np.ndarray | None:
        """Return the rows, parsed by NumPy or above `large` bytes by pandas, or None if a line has another form."""
        delimiter = self._header.delimiter
        if b"#" in block or not block:
            return None
        codes = np.frombuffer(block, np.uint8)
        starts = np.concatenate([[0], np.flatnonzero(codes == ord("\n")) + 1])
        if starts[-1] == codes.size or np.any(codes[starts] == ord("\n")):
            return None  # an empty line
        counts = np.add.reduceat((codes == ord(delimiter)).astype(np.int32), starts)
        if np.any(counts != self._header.width - 1):
            return None
        if self._header.decimal_comma:
            block = block.replace(b",", b".")
        if len(block) > large:
            places = sorted(set(self._column_indices))
            return self._parse_large(io.BytesIO(block), usecols=places, dtype=float, encoding="latin-1")
        try:
            return np.loadtxt(
                io.BytesIO(block), delimiter=delimiter, ndmin=2, comments=None, usecols=self._column_indices,
                encoding="latin-1",
            )  # fmt: skip
        except ValueError:
            return None

    def _parse_large(self, text: str | io.BytesIO, **options: Any) -> np.ndarray | None:
        """Return the rows, parsed by pandas, which takes half a second to import and a fifth of NumPy's time to run."""
        import pandas

        try:
            frame = pandas.read_csv(
                text, sep=self._header.delimiter, header=None, na_filter=False, skip_blank_lines=False, **options
            )
            return frame[self._column_indices].to_numpy(dtype=float)
        except (ValueError, KeyError):
            return None

    def _parse_line_by_line(self, block: bytes, first: int) -> tuple[np.ndarray, list[int]]:
        """Return the rows, parsed line by line to locate an invalid cell or to skip empty lines."""
        rows: list[list[float]] = []
        lines: list[int] = []
        delimiter = self._header.delimiter
        for line, text in enumerate(block.decode("utf-8", errors="replace").split("\n"), start=first):
            if not text.strip(delimiter + " ") or text.startswith("#"):
                continue
            cells = split_cells(text, delimiter)
            if SEGMENT.match(text) or text.strip() == self._header.first_line:
                raise SegmentsError(
                    f"{self._source}, line {line}: another segment begins ('{text[:60]}'); choose one, as"
                    f" {SEGMENT_OPTION}"
                )
            is_word = bool(cells[0]) and parse_number(cells[0], self._header.decimal_comma) is None
            if self._has_time and is_word and (rows or self._starts[-1]):
                self._footer.append((line, cells[0]))
                continue
            if self._footer:  # rows follow
                self._refuse_words(*self._footer[0])
            if len(cells) != self._header.width:
                raise InputError(
                    f"{self._source}, line {line}: {len(cells)} values, but other rows have {self._header.width};"
                    " correct or remove the row"
                )
            here = [cells[place] for place in self._column_indices]
            if self._has_time and here[0] and here[1:] and not any(here[1:]):
                self._blank_rows.append(self._starts[-1] + len(rows))
                here[1:] = ["nan"] * len(here[1:])
            rows.append(
                [self._parse_cell(cell, line, place) for cell, place in zip(here, self._column_indices, strict=True)]
            )
            lines.append(line)
        return np.array(rows).reshape(len(rows), len(self._column_indices)), lines

    def _refuse_words(self, line: int, words: str) -> NoReturn:
        """Raise InputError for a line of words among rows of numbers."""
        raise InputError(
            f"{self._source}, line {line}, column 1: '{words[:40]}' is not a number; correct or remove the row"
        )

    def _parse_cell(self, cell: str, line: int, place: int) -> float:
        value = parse_number(cell, self._header.decimal_comma)
        if value is None:
            what = f"'{cell[:40]}' is not a number" if cell else "the cell is empty"
            raise InputError(f"{self._source}, line {line}, column {place + 1}: {what}; correct or remove the row")
        return value

    def _line_label(self, row: int) -> str:
        part = bisect.bisect_right(self._starts, row) - 1
        return f"line {self._lines[part][row - self._starts[part]]}"

    def count_segments(self) -> int:
        return self._header.count_segments()

    def to_capture(self) -> Capture:
        """Return the columns that were read."""
        rows, announced = self._starts[-1], self._header.count_rows()
        if announced is not None and rows < announced - 2:  # some manufacturers' counts are off by 2
            raise InputError(
                f"{self._source}: the header states {announced:,} rows, but the file has {rows:,}, so it is"
                " truncated; export it again"
            )
        kept, notes = self._trim_blank_rows(rows)
        if self._footer:
            lines, words = zip(*self._footer, strict=True)
            if len(lines) > MAX_FOOTER_LINES:
                self._refuse_words(lines[0], words[0])
            shown = ", ".join(word[:20] for word in words)
            notes.append(f"{self._source}: {len(lines)} lines of words below the data were left out ({shown})")
        columns = [column[kept] for column in self._take_columns()]  # `row_label` keeps a reference to the parser
        capture = self._make_capture(columns, np.arange(rows, dtype=float)[kept])
        return dataclasses.replace(
            capture,
            row_label=lambda row: self._line_label(row + (kept.start or 0)),
            notes=(*capture.notes, *notes),
        )

    def take_capture(self, before: int) -> Capture | None:
        """Return the rows since the last call, or None without any; `before` is the number of rows before them."""
        rows = self._starts[-1]
        if not rows:
            return None
        capture = self._make_capture(self._take_columns(), before + np.arange(rows, dtype=float))
        self._lines, self._starts, self._blank_rows = [], [0], []
        return capture

    def _take_columns(self) -> list[np.ndarray]:
        whole = self._parts[0] if len(self._parts) == 1 else np.concatenate(self._parts or [np.empty((0, 1))])
        columns = list(np.ascontiguousarray(whole.T))
        self._parts.clear()
        return columns

    def _make_capture(self, columns: Sequence[np.ndarray], index: Float[np.ndarray, " rows"]) -> Capture:
        """Return a capture of columns with times, or, without these, with the `index` of each row."""
        header, chosen = self._header, {column.name for column in self._columns}
        time, values = (columns[0], columns[1:]) if self._has_time else (index, columns)
        time, notes, warnings = self._time_in_seconds(time)
        others = [column.name for column in header.channels if column.name not in chosen]
        return Capture(
            source=self._source,
            format=header.maker,
            time=time,
            channels=tuple(
                FileChannel.from_file(column.name, array, column.unit, column.attenuation, header.location)
                for column, array in zip(self._columns, values, strict=True)
            ),
            notes=tuple(notes),
            warnings=tuple(warnings),
            unread_columns=(*others, *header.non_numeric_columns()),
        )

    def _unwrap_clock(self, time: np.ndarray) -> np.ndarray:
        """Return times of day in s since the first one, beyond midnights; refuse a clock that repeats its times."""
        if self._clock_start is None:
            self._clock_start = self._clock_end = float(time[0])
        with np.errstate(invalid="ignore"):  # times that are not finite are refused with their line
            steps = np.diff(time, prepend=self._clock_end % _DAY)
            steps = np.where(steps < -0.5 * _DAY, steps + _DAY, steps)
            since = self._clock_end - self._clock_start + np.cumsum(steps)
        self._clock_end = self._clock_start + float(since[-1])
        rate, second = self._header.rate, 1.0  # in which clocks are written at least
        if rate is not None and np.max(np.abs(since - np.arange(since.size) / rate)) <= second:
            return np.arange(since.size) / rate
        if rate is None and np.any(steps[1:] == 0.0):
            coarse = format_engineering(float(np.min(steps[steps > 0.0], initial=np.inf)), "s", 2)
            raise InputError(
                f"{self._source}: the times of day have a resolution of {coarse}, in which several rows fall; give the"
                f" sampling rate, as {RATE_OPTION}, or write more digits"
            )
        return since

    def _trim_blank_rows(self, rows: int) -> tuple[slice, list[str]]:
        """Return the rows without empty rows at either end, and a note on these."""
        blank = set(self._blank_rows)
        first = next((row for row in range(rows) if row not in blank), rows)
        last = next((row for row in reversed(range(rows)) if row not in blank), first - 1)
        inside = [row for row in self._blank_rows if first < row < last]
        if inside or first == rows:
            place = self._line_label(inside[0]) if inside else "all rows"
            raise InputError(f"{self._source}, {place}: the cells of the channels are empty; correct or remove the row")
        ignored = rows - (last + 1 - first)
        notes = [f"{self._source}: rows without values at the ends were ignored ({ignored:,})"] if ignored else []
        return slice(first, last + 1), notes

    def _time_in_seconds(self, time: np.ndarray) -> tuple[np.ndarray, list[str], list[str]]:
        """Return the times in seconds, with notes and warnings on what was assumed."""
        header, place = self._header, f"{self._source}{self._header.location}"
        if header.is_clock:
            return self._unwrap_clock(time), [f"{self._source}: times of day are counted from the first"], []
        if header.time:
            stated = header.time.unit or (header.time.name.lower() == "time" and header.maker == "fitact")
            warnings = [] if stated else [f"{self._source}: the file states no unit of time; seconds were assumed"]
            return layouts.convert_time(time, header.time.unit, place, "write a multiple of s"), [], warnings
        start, step = header.time_grid
        assert step is not None  # `read_header` refuses a file with neither
        notes = [] if start is not None else [f"{self._source}: the time was taken to start at 0"]
        return (start or 0.0) + step * time, notes, []
