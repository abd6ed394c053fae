"""Header of a text file: first row of numbers, columns, and metadata of the manufacturer."""

import collections
import dataclasses
import functools
import itertools
import math
import re
from collections.abc import Sequence
from typing import NamedTuple

from fitact.errors import RATE_OPTION, InputError
from fitact.readers import layouts

_EXAMPLE = "time_s,V_V,Vsc_V,I_A"
MINUS = "\N{MINUS SIGN}"  # as typeset, in place of the hyphen
_OUT_OF_RANGE = ("∞", "ol", "ovld", "over", "overflow", "overrange", "1.#inf")
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")
_QUANTITY = re.compile(r"(?:analog:)?\s*([-+]?[\d.,]+(?:e[-+]?\d+)?)\s*([a-zµμ]*)", re.IGNORECASE)


class TextRow(NamedTuple):
    """Number of a row, from 1, and its cells."""

    number: int
    cells: list[str]


class Column(NamedTuple):
    """One column of numbers; `unit` as written or "", and `attenuation` as stated in the header."""

    place: int
    name: str
    unit: str
    attenuation: float | None = None


def read_header(
    text: str, source: str, sidecar_text: str = "", rate: float | None = None, *, is_clock: bool = False
) -> "Header":
    """Return the header of a file that begins with `text`; `sidecar_text` holds `key:value` lines of another file.

    `rate` (Hz) gives the times of a file that states neither times nor a time step. `is_clock`: whether times of day
    were replaced by seconds since midnight.
    """
    head = text[:4096]  # enough for most headers; splitting lines into cells dominates the time
    header = Header.from_text(head.rpartition("\n")[0], sidecar_text, source)
    if not header.is_plain:
        header = Header.from_text(text, sidecar_text, source)
    if not header.numeric:
        first = text.partition("\n")[0].strip()[:60]
        raise InputError(
            f"{source}: there are no rows of numbers (the first line is '{first}'); write them below a header such as"
            f" {_EXAMPLE}"
        )
    maker = next((maker for maker, mark in layouts.MAKERS if mark.search(head)), "text")
    numeric, is_clock = header.numeric | header.standard_columns(), is_clock and header.clock is not None
    header = dataclasses.replace(header, numeric=numeric, maker=maker, rate=rate, is_clock=is_clock)
    if header.time is None and header.time_grid[1] is None:
        count = len(header.numeric)
        found = f"{count} column{'s' * (count > 1)} of numbers" + ("" if header.names else " without names")
        named = f": {', '.join(header.names.cells)[:200]}" if header.names else ""
        beside = " put NAME.csv, which holds the time, beside it," if source.lower().endswith(".wfm.csv") else ""
        raise InputError(
            f"{source}{header.location}: no column time_s, and no other time column ({found}{named});{beside} name the"
            f" columns as in {_EXAMPLE}, or give the sampling rate, as {RATE_OPTION}"
        )
    if not header.channels:
        raise InputError(
            f"{source}{header.location}: the only column of numbers is the time; export V, Vsc or I beside it, as in"
            f" {_EXAMPLE}"
        )
    return header


def split_cells(line: str, delimiter: str) -> list[str]:
    """Return the cells of a line, without surrounding quotes and blanks."""
    parts = line.split() if delimiter == " " else line.split(delimiter)
    return [cell.strip().strip('"').strip() for cell in parts]


def parse_number(cell: str, decimal_comma: bool) -> float | None:
    """Return the cell as a number, or None; some manufacturers write infinity for a value out of range."""
    if "_" in cell:  # Python would read 1_000
        return None
    cell = cell.replace(MINUS, "-")
    try:
        return float(cell.replace(",", ".") if decimal_comma else cell)
    except ValueError:
        size = math.inf if cell.lstrip("+-").lower() in _OUT_OF_RANGE else None
        return -size if size and cell.startswith("-") else size


@dataclasses.dataclass(frozen=True)
class Header:
    """First lines of a file, divided into the lines above the numbers and the rows of numbers."""

    delimiter: str
    decimal_comma: bool
    comments: list[TextRow]
    header_rows: list[TextRow]
    data_rows: list[TextRow]
    numeric: frozenset[int]  # indices of the columns of numbers
    source: str
    first_line: str = ""  # if it has words, of which another copy begins another segment
    maker: str = "text"
    rate: float | None = None  # stated by the user, Hz
    is_clock: bool = False  # whether the time column holds seconds since midnight

    @classmethod
    def from_text(cls, text: str, sidecar_text: str, source: str) -> "Header":
        lines = [(n, line.strip(" \r\f\v")) for n, line in enumerate(text.split("\n"), start=1)]
        delimiter, decimal_comma = _detect_delimiter([line for _, line in lines if line and not line.startswith("#")])
        rows = [TextRow(n, split_cells(line, delimiter)) for n, line in lines if line.strip(delimiter + " ")]
        data = [row for row in rows if not row.cells[0].startswith("#")]
        places = [
            frozenset(i for i, cell in enumerate(row.cells) if parse_number(cell, decimal_comma) is not None)
            for row in data
        ]
        # the most frequent pattern from the middle on, since a header may hold numbers, too
        patterns = collections.Counter(p for p in places[len(places) // 2 :] if p)
        numeric = patterns.most_common(1)[0][0] if patterns else frozenset()
        full = [numeric <= p for p in places]
        if 0 not in numeric and 1 in numeric:  # a word before numbers is a key where most rows have none
            words = [bool(row.cells[0]) for row, is_full in zip(data, full, strict=True) if is_full]
            if 2 * sum(words) < len(words):
                full = [is_full and not row.cells[0] for row, is_full in zip(data, full, strict=True)]
        first = next((i for i, here in enumerate(full) if here and all(full[i : i + 2])), None)
        if first is None:  # no two such rows in succession
            first = full.index(True) if numeric else len(full)
        while first and _is_unfilled(data[first - 1], places[first - 1] & numeric):
            first -= 1
        end = data[first].number if first < len(data) else len(lines)
        comments = [row for row in rows if row.cells[0].startswith("#") and row.number < end]
        comments += [TextRow(0, line.split(":")) for line in sidecar_text.splitlines()]
        if delimiter == " " and first < len(data):  # names of several words stand apart by two blanks
            wide = {n: re.split(r"\s{2,}|\t+", line.strip()) for n, line in lines[: end - 1]}
            width = len(data[first].cells)
            data = [
                TextRow(row.number, wide[row.number]) if len(wide.get(row.number, ())) == width else row for row in data
            ]
        first_line = text.partition("\n")[0].replace('"', "").strip()
        first_line = first_line if re.match(r"\W*[A-Za-z]", first_line) and data[:first] else ""
        return cls(delimiter, decimal_comma, comments, data[:first], data[first:], numeric, source, first_line)

    @property
    def is_plain(self) -> bool:
        """Whether further rows are redundant: enough rows of numbers only, with a known decimal mark."""
        cells = [cell for row in self.data_rows for cell in row.cells]
        enough = len(self.data_rows) >= max(64, 2 * len(self.header_rows))
        marked = self.delimiter == "," or any("," in cell or "." in cell for cell in cells)
        return enough and marked and all(parse_number(cell, self.decimal_comma) is not None for cell in cells)

    @property
    def location(self) -> str:
        """Location of the column names, for messages."""
        return f", line {(self.names or self.units or self.data_rows[0]).number}"

    @functools.cached_property
    def width(self) -> int:
        """Number of cells in a row."""
        widths = (len(row.cells) for row in self.data_rows if len(row.cells) > max(self.numeric))
        return collections.Counter(widths).most_common(1)[0][0]

    @functools.cached_property
    def metadata(self) -> dict[str, list[str]]:
        """Each key of the header with the cells after it."""
        beside = [
            TextRow(row.number, row.cells[: min(self.numeric)]) for row in self.data_rows if min(self.numeric) > 1
        ]
        known: dict[str, list[str]] = {}
        for row in (*self.comments, *self.header_rows, *beside):
            for i, cell in enumerate(row.cells):
                word, _, value = cell.partition("=" if "=" in cell.rstrip("= ") else ":")
                following = [value.strip()] * bool(value.strip()) + [c for c in row.cells[i + 1 :] if c]
                if following and layouts.normalize_key(word) and parse_number(cell, self.decimal_comma) is None:
                    known.setdefault(layouts.normalize_key(word), following)
        return known

    def find_values(self, keys: Sequence[str]) -> list[str]:
        """Return the values of the first of the keys that the header contains."""
        return next((self.metadata[key] for key in keys if key in self.metadata), [])

    def find_quantity(self, keys: Sequence[str]) -> float | None:
        """Return the largest of these values in SI units, since values may differ between channels."""
        quantities = (self._parse_quantity(text) for text in self.find_values(keys))
        return max((value for value in quantities if value is not None), default=None)

    def _parse_quantity(self, text: str) -> float | None:
        match = _QUANTITY.fullmatch(text.strip())
        value = parse_number(match[1], self.decimal_comma) if match else None
        if match is None or value is None:
            return None
        unit = layouts.parse_unit(match[2])
        return value * (unit[1] if unit else {"khz": 1e3, "mhz": 1e6, "ghz": 1e9}.get(match[2].lower(), 1.0))

    @functools.cached_property
    def names(self) -> TextRow | None:
        """Row of names, above the row of units if there is one; numpy.savetxt writes it as a comment."""
        rows = [row for row in self.header_rows if len(row.cells) > max(self.numeric) and row is not self.units]
        if self.units and rows and rows[-1].number > self.units.number and not self._names_time(rows[-1]):
            rows = [row for row in rows if row.number < self.units.number]  # Origin writes comments below the units
        if rows and self._is_names(rows[-1]):
            return rows[-1]
        if self.comments and self.comments[-1].number and not self.units:
            cells = split_cells(self.delimiter.join(self.comments[-1].cells).lstrip("# "), self.delimiter)
            row = TextRow(self.comments[-1].number, cells)
            is_key = len(cells) == 1 and re.search("[:=]", cells[0])
            if len(cells) == self.width and not is_key and self._is_names(row):
                return row
        return None

    def _is_names(self, row: TextRow) -> bool:
        here = [row.cells[i] for i in sorted(self.numeric)]
        if self._names_time(row):
            return True  # although the other cells may be numbers (Keysight)
        if all(re.fullmatch(r"[\d:./ -]+", cell) for cell in here):  # dates or clock times
            return False
        return any(here) and all(parse_number(cell, self.decimal_comma) is None for cell in here)

    def _names_time(self, row: TextRow) -> bool:
        here = [row.cells[i] for i in sorted(self.numeric)]
        return any(layouts.split_name_and_unit(cell)[0].lower() in layouts.TIME_NAMES for cell in here if cell)

    @functools.cached_property
    def units(self) -> TextRow | None:
        """Row of units, the last of the header or the last but one."""
        return next((row for row in self.header_rows[:-3:-1] if self._is_units(row)), None)

    def _is_units(self, row: TextRow) -> bool:
        if len(row.cells) <= max(self.numeric):
            return False
        here = [row.cells[i] for i in sorted(self.numeric)]
        known = [bool(layouts.parse_unit(cell)) or cell[:1] + cell[-1:] in ("()", "[]") for cell in here]
        rest = [cell.lower() in layouts.NOT_UNITS for cell in here]
        return any(known) and all(a or b for a, b in zip(known, rest, strict=True))

    @functools.cached_property
    def time_grid(self) -> tuple[float | None, float | None]:
        """Start and step of the time, s, below the words Start and Increment, or beside equivalent keys."""
        below = {}
        if self.names and self.units:
            pairs = zip(self.names.cells, self.units.cells, strict=False)
            below = {layouts.normalize_key(word): parse_number(text, self.decimal_comma) for word, text in pairs}

        def find(keys: Sequence[str]) -> float | None:
            values = [below[key] for key in keys if below.get(key) is not None]
            return values[0] if values else self.find_quantity(keys)

        step, rate = find(layouts.STEP_KEYS), find(layouts.RATE_KEYS)
        if step is None and (rate or self.rate):
            step = 1.0 / (rate or self.rate or math.nan)
        return find(layouts.START_KEYS), step if step is not None and 0.0 < step < float("inf") else None

    @functools.cached_property
    def _columns(self) -> list[Column]:
        """Columns of numbers, with the unit from their name or from the row of units."""
        made = []
        if self._repeats_time:
            return [Column(0, "time", ""), *(Column(i, f"column {i + 1}", "") for i in range(1, self.width, 2))]
        for place in sorted(self.numeric):
            cell, below = (row.cells[place] if row else "" for row in (self.names, self.units))
            name, unit = layouts.split_name_and_unit(cell)
            below = "" if below.lower() in layouts.NOT_UNITS else below.strip("()[] ")
            if unit and below and layouts.parse_unit(unit) != layouts.parse_unit(below):
                raise InputError(
                    f"{self.source}, line {self.units.number if self.units else 0}: the unit of {cell} is {below} here;"
                    " keep one of the two"
                )
            made.append(Column(place, name, unit or below))
        return made

    @functools.cached_property
    def _repeats_time(self) -> bool:
        """Whether each column without a name follows one with the same times, as ngspice's wrdata writes them."""
        if self.names or self.units or self.width < 4 or self.width % 2 or len(self.numeric) < self.width:
            return False
        rows = [row.cells for row in self.data_rows if len(row.cells) == self.width]
        times = [parse_number(cells[0], self.decimal_comma) or 0.0 for cells in rows]
        same = all(len(set(cells[::2])) == 1 for cells in rows)
        return same and len(times) > 2 and all(a < b for a, b in itertools.pairwise(times))

    @functools.cached_property
    def channels(self) -> list[Column]:
        """Columns of values, with names and units that the header states elsewhere."""
        columns = [c for c in self._columns if c.place not in (self.index, self.time.place if self.time else None)]
        columns = [column for column in columns if not self._is_time_again(column)]
        names = [column.name for column in columns]
        if "" in names or (len(set(names)) < len(names) and not any(layouts.is_standard_name(name) for name in names)):
            names = self._find_names(len(names)) or [f"column {column.place + 1}" for column in columns]
        units = [re.sub(r".*:", "", text) for text in self.find_values(layouts.UNIT_KEYS)] or [""]
        probes = [self._parse_quantity(text) for text in self.find_values(layouts.ATTENUATION_KEYS)]
        return [
            Column(c.place, names[i], c.unit or units[min(i, len(units) - 1)], probes[i] if i < len(probes) else None)
            for i, c in enumerate(columns)
        ]

    def _is_time_again(self, column: Column) -> bool:
        """Return whether a column repeats the times under their name, as LabVIEW does; refuse others there."""
        if self.time is None or not column.name or column.name != self.time.name:
            return False
        places = self.time.place, column.place
        pairs = [[row.cells[i] for i in places] for row in self.data_rows if len(row.cells) > max(places)]
        if any(a != b for a, b in pairs):
            raise InputError(
                f"{self.source}{self.location}: the columns {places[0] + 1} and {places[1] + 1} hold different times;"
                " export channels of one time base"
            )
        return True

    def standard_columns(self) -> frozenset[int]:
        """Return the columns with fitact's own names, which must hold numbers."""
        parts = map(layouts.split_name_and_unit, self.names.cells[: self.width] if self.names else [])
        standard = (layouts.is_standard_name(name) and (not unit or layouts.parse_unit(unit)) for name, unit in parts)
        return frozenset(i for i, is_standard in enumerate(standard) if is_standard)

    def non_numeric_columns(self) -> list[str]:
        """Return the names of the columns without numbers."""
        named = self.names.cells[: self.width] if self.names else []
        words = [layouts.normalize_key(cell.partition("=")[0]) for cell in named]
        return [c for i, c in enumerate(named) if i not in self.numeric and words[i] not in layouts.GRID_KEYS]

    def count_rows(self) -> int | None:
        """Return the number of rows that the header states, or None."""
        count = self.find_quantity(layouts.COUNT_KEYS)
        return int(count) if count is not None and count < 1e12 else None  # a larger number has another meaning

    def count_segments(self) -> int:
        """Return the number of segments that the header states, or 1."""
        counts = [self._parse_quantity(text) for text in self.find_values(layouts.SEGMENT_KEYS)[:1]]
        return int(counts[0]) if counts and counts[0] and 1.0 < counts[0] < 1e6 else 1

    def _find_names(self, count: int) -> list[str]:
        """Return channel names from lines such as "Source,CH1" or "Vertical Scale,CH1:0.05 CH2:0.10"."""
        named = self.find_values(layouts.NAME_KEYS)
        if len(named) < count:
            named = re.findall(r"([A-Za-z]+\d+)\s*:", " ".join(self.find_values(("verticalunits", "verticalscale"))))
        return named[:count] if len(set(named[:count])) == count else []

    @functools.cached_property
    def index(self) -> int | None:
        """Column that counts the samples, or None."""
        return next((c.place for c in self._columns if self._is_index(c)), None)

    def _is_index(self, column: Column) -> bool:
        below = self.units.cells[column.place] if self.units else ""
        return not layouts.INDEX_NAMES.isdisjoint((below.lower(), column.name.lower()))

    def _has_stated_step(self, place: int) -> bool:
        """Return whether a column advances by the time step that the header states."""
        step, cells = self.time_grid[1], [row.cells[place] for row in self.data_rows[:3] if len(row.cells) > place]
        numbers = [parse_number(cell, self.decimal_comma) for cell in cells]
        if step is None or len(numbers) < 2 or numbers[0] is None or numbers[1] is None:
            return False
        return abs(numbers[1] - numbers[0] - step) < 1e-3 * step

    @functools.cached_property
    def clock(self) -> int | None:
        """Column of seconds since midnight with nine decimals, as times of day are written, or None."""
        rows = [row.cells for row in self.data_rows[:8]]
        places = (i for i in sorted(self.numeric) if all(re.fullmatch(r"\d+\.\d{9}", c[i]) for c in rows if len(c) > i))
        return next(places, None)

    @functools.cached_property
    def time(self) -> Column | None:
        """Time column, found by name, by unit, or as the first under a header; None if `time_grid` gives the time."""
        if self.is_clock:
            return Column(self.clock or 0, "time", "s")
        candidates = [c for c in self._columns if not self._is_index(c)]
        times = [c for c in candidates if c.name.lower() == "time"]
        times += [c for c in candidates if (layouts.parse_unit(c.unit) or ("",))[0] == "s"]
        times += [c for c in candidates if c.name.lower() in layouts.TIME_NAMES]
        stated = self.find_values(layouts.TIME_UNIT_KEYS)
        unnamed = not self.names and not self.units and min(self.numeric) > 1 and stated
        if len(candidates) > 1 and (unnamed or self._has_stated_step(candidates[0].place)):
            times += candidates[:1]
        return times[0]._replace(unit=times[0].unit or next(iter(stated), "")) if times else None


def _is_unfilled(row: TextRow, numbers: frozenset[int]) -> bool:
    """Return whether a row holds only numbers, but not in all columns of numbers (a time without values)."""
    return bool(numbers) and all(i in numbers for i, cell in enumerate(row.cells) if cell)


def _detect_delimiter(lines: Sequence[str]) -> tuple[str, bool]:
    """Return the delimiter that fits most lines from the middle on, and whether the decimal mark is a comma."""
    lines = lines[len(lines) // 2 :]
    for delimiter in (";", "\t", ",", " "):
        rows = [split_cells(line, delimiter) for line in lines]
        comma = delimiter in ";\t" and any(_DECIMAL_COMMA.fullmatch(cell) for cells in rows for cell in cells)
        if sum(sum(parse_number(cell, comma) is not None for cell in cells) >= 2 for cells in rows) > len(rows) / 2:
            return delimiter, comma
    return ",", False
