"""The header of a text file: where the numbers begin, what the columns are, and what its maker says of them."""

import collections
import dataclasses
import functools
import re
from collections.abc import Sequence

from fitact.data.readers import layouts
from fitact.errors import InputError

_EXAMPLE = "time_s,V_V,Vsc_V,I_A"
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")
_QUANTITY = re.compile(r"(?:analog:)?\s*([-+]?[\d.,]+(?:e[-+]?\d+)?)\s*([a-zµμ]*)", re.IGNORECASE)


@dataclasses.dataclass(frozen=True)
class TextRow:
    """Its number, from 1, and its cells."""

    number: int
    cells: list[str]


@dataclasses.dataclass(frozen=True)
class Column:
    """One column of numbers; `unit` as written, "" where none is, `attenuation` as the header states it."""

    index: int
    name: str
    unit: str
    attenuation: float | None = None


@dataclasses.dataclass(frozen=True)
class Header:
    """What stands above the rows of numbers, or beside them.

    Attributes:
        first: number of the first line of numbers, from 1.
        width: cells of a row.
        time: column of the time; None where `start` and `step` (s) make it.
        index: column that counts samples; None where there is none.
        non_numeric_columns: names of the columns that hold no numbers.
        count: rows that the header announces.
        location: of the names, for messages.
    """

    maker: str
    delimiter: str
    decimal_comma: bool
    first: int
    width: int
    time: Column | None
    index: int | None
    columns: tuple[Column, ...]
    non_numeric_columns: tuple[str, ...]
    start: float | None
    step: float | None
    count: int | None
    location: str


def read_header(text: str, source: str, sidecar_text: str = "") -> Header:
    """The header of a file that begins with `text`; `sidecar_text`: one in a file of its own, as `key:value` lines.

    Raises:
        InputError: there are no numbers, no time, or several segments.
    """
    head = text[:4096]  # of which a header mostly is a small part: to part lines into cells takes longest
    sheet = _HeaderParser.from_text(head.rpartition("\n")[0], sidecar_text, source)
    if not sheet.is_plain:
        sheet = _HeaderParser.from_text(text, sidecar_text, source)
    if not sheet.numeric:
        raise InputError(
            f"{source}: there are no rows of numbers; expected a header such as {_EXAMPLE}, and rows of numbers"
        )
    sheet = dataclasses.replace(sheet, numeric=sheet.numeric | sheet.standard_columns())
    segments = sheet.find_values(layouts.SEGMENT_KEYS)[:1]
    if segments and (parse_number(segments[0], sheet.decimal_comma) or 1.0) > 1.0:
        raise InputError(f"{source}: holds {segments[0]} segments; export one of them")
    top = sheet.names or sheet.units or sheet.data_rows[0]
    start, step = sheet.time_grid()
    columns = sheet.columns()
    time = sheet.find_time_column(columns)
    if time is None and step is None:
        found = ", ".join(sheet.names.cells) if sheet.names else "no header"
        raise InputError(
            f"{source}, line {top.number}: no column time_s, nor another of time (found: {found[:200]}); name the"
            f" columns as in {_EXAMPLE}, or export the time as well (Rohde & Schwarz keep that of NAME.Wfm.csv in"
            " NAME.csv beside it)"
        )
    index = next((c.index for c in columns if sheet.is_index(c)), None)
    values = sheet.complete_columns([c for c in columns if c.index not in (index, time.index if time else None)])
    if not values:
        raise InputError(
            f"{source}, line {top.number}: there is no column of numbers besides the time; export channels"
        )
    return Header(
        maker=next((maker for maker, mark in layouts.MAKERS if mark.search(head)), "text"),
        delimiter=sheet.delimiter,
        decimal_comma=sheet.decimal_comma,
        first=sheet.data_rows[0].number,
        width=sheet.width,
        time=time,
        index=index,
        columns=values,
        non_numeric_columns=sheet.non_numeric_columns(),
        start=start,
        step=step,
        count=sheet.count(),
        location=f", line {top.number}",
    )


def split_cells(line: str, delimiter: str) -> list[str]:
    """The cells of a line, without quotes and blanks around them."""
    parts = line.split() if delimiter == " " else line.split(delimiter)
    return [cell.strip().strip('"').strip() for cell in parts]


def parse_number(cell: str, decimal_comma: bool) -> float | None:
    """The cell as a number, or None; infinity is how some makers write that a value is out of range."""
    if "_" in cell:  # Python would read 1_000
        return None
    try:
        return float(cell.replace(",", ".") if decimal_comma else cell)
    except ValueError:
        return {"∞": float("inf"), "-∞": -float("inf")}.get(cell)


@dataclasses.dataclass(frozen=True)
class _HeaderParser:
    """The first lines of a file, parted into those above the numbers and those with them."""

    delimiter: str
    decimal_comma: bool
    comments: list[TextRow]
    header_rows: list[TextRow]
    data_rows: list[TextRow]
    numeric: frozenset[int]  # the columns of numbers
    source: str

    @classmethod
    def from_text(cls, text: str, sidecar_text: str, source: str) -> "_HeaderParser":
        lines = [(n, line.strip(" \r\f\v")) for n, line in enumerate(text.split("\n"), start=1)]
        delimiter, decimal_comma = _detect_delimiter([line for _, line in lines if line and not line.startswith("#")])
        rows = [TextRow(n, split_cells(line, delimiter)) for n, line in lines if line.strip(delimiter + " ")]
        data = [row for row in rows if not row.cells[0].startswith("#")]
        places = [
            frozenset(i for i, cell in enumerate(row.cells) if parse_number(cell, decimal_comma) is not None)
            for row in data
        ]
        # the pattern that most lines show, from the middle on: above, a header may state numbers
        patterns = collections.Counter(p for p in places[len(places) // 2 :] if p)
        numeric = patterns.most_common(1)[0][0] if patterns else frozenset()
        full = [numeric <= p for p in places]
        first = next((i for i, here in enumerate(full) if here and all(full[i : i + 2])), None)
        if first is None:  # not two in a row
            first = full.index(True) if numeric else len(full)
        while first and _is_unfilled(data[first - 1], places[first - 1] & numeric):
            first -= 1
        end = data[first].number if first < len(data) else len(lines)
        comments = [row for row in rows if row.cells[0].startswith("#") and row.number < end]
        comments += [TextRow(0, line.split(":")) for line in sidecar_text.splitlines()]
        return cls(delimiter, decimal_comma, comments, data[:first], data[first:], numeric, source)

    @property
    def is_plain(self) -> bool:
        """Whether further rows have nothing to tell: enough of them, only numbers, and the decimal mark seen."""
        cells = [cell for row in self.data_rows for cell in row.cells]
        enough = len(self.data_rows) >= max(64, 2 * len(self.header_rows))
        marked = self.delimiter == "," or any("," in cell or "." in cell for cell in cells)
        return enough and marked and all(parse_number(cell, self.decimal_comma) is not None for cell in cells)

    @functools.cached_property
    def width(self) -> int:
        widths = (len(row.cells) for row in self.data_rows if len(row.cells) > max(self.numeric))
        return collections.Counter(widths).most_common(1)[0][0]

    @functools.cached_property
    def metadata(self) -> dict[str, list[str]]:
        """Each word of the header, with the cells after it."""
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
        """What the header states under the first of the keys that it has."""
        return next((self.metadata[key] for key in keys if key in self.metadata), [])

    def find_quantity(self, keys: Sequence[str]) -> float | None:
        """The largest number that it states there, in SI units: they may differ between channels."""
        found = (self._parse_quantity(text) for text in self.find_values(keys))
        return max((value for value in found if value is not None), default=None)

    def _parse_quantity(self, text: str) -> float | None:
        match = _QUANTITY.fullmatch(text.strip())
        value = parse_number(match[1], self.decimal_comma) if match else None
        if match is None or value is None:
            return None
        unit = layouts.parse_unit(match[2])
        return value * (unit[1] if unit else {"khz": 1e3, "mhz": 1e6, "ghz": 1e9}.get(match[2].lower(), 1.0))

    @functools.cached_property
    def names(self) -> TextRow | None:
        """The row of names, above that of units where there is one; numpy.savetxt writes it as a comment."""
        rows = [row for row in self.header_rows if len(row.cells) > max(self.numeric) and row is not self.units]
        if rows and self._is_names(rows[-1]):
            return rows[-1]
        if self.comments and self.comments[-1].number and not self.units:
            cells = split_cells(self.delimiter.join(self.comments[-1].cells).lstrip("# "), self.delimiter)
            row = TextRow(self.comments[-1].number, cells)
            if len(cells) == self.width and self._is_names(row):
                return row
        return None

    def _is_names(self, row: TextRow) -> bool:
        here = [row.cells[i] for i in sorted(self.numeric)]
        if any(layouts.split_name_and_unit(cell)[0].lower() in layouts.TIME_NAMES for cell in here if cell):
            return True  # although the others may be numbers, as Keysight's are
        return any(here) and all(parse_number(cell, self.decimal_comma) is None for cell in here)

    @functools.cached_property
    def units(self) -> TextRow | None:
        row = self.header_rows[-1] if self.header_rows else None
        if row is None or len(row.cells) <= max(self.numeric):
            return None
        here = [row.cells[i] for i in sorted(self.numeric)]
        known = [bool(layouts.parse_unit(cell)) or cell[:1] + cell[-1:] in ("()", "[]") for cell in here]
        rest = [cell.lower() in layouts.NOT_UNITS for cell in here]
        return row if any(known) and all(a or b for a, b in zip(known, rest, strict=True)) else None

    def time_grid(self) -> tuple[float | None, float | None]:
        """Start and step of the time, s: below the words Start and Increment, or beside words of that meaning."""
        below = {}
        if self.names and self.units:
            pairs = zip(self.names.cells, self.units.cells, strict=False)
            below = {layouts.normalize_key(word): parse_number(text, self.decimal_comma) for word, text in pairs}

        def find(keys: Sequence[str]) -> float | None:
            values = [below[key] for key in keys if below.get(key) is not None]
            return values[0] if values else self.find_quantity(keys)

        step, rate = find(layouts.STEP_KEYS), find(layouts.RATE_KEYS)
        if step is None and rate:
            step = 1.0 / rate
        return find(layouts.START_KEYS), step if step is not None and 0.0 < step < float("inf") else None

    def columns(self) -> list[Column]:
        made = []
        for place in sorted(self.numeric):
            cell, below = (row.cells[place] if row else "" for row in (self.names, self.units))
            made.append(Column(place, layouts.split_name_and_unit(cell)[0], self._column_unit(cell, below)))
        return made

    def complete_columns(self, columns: Sequence[Column]) -> tuple[Column, ...]:
        """Columns of values, with the names and units that the header states elsewhere."""
        names = [column.name for column in columns]
        if "" in names or (len(set(names)) < len(names) and not any(layouts.is_standard_name(name) for name in names)):
            names = self._find_names(len(names)) or [f"column {column.index + 1}" for column in columns]
        units = [re.sub(r".*:", "", text) for text in self.find_values(layouts.UNIT_KEYS)] or [""]
        probes = [self._parse_quantity(text) for text in self.find_values(layouts.ATTENUATION_KEYS)]
        return tuple(
            Column(
                column.index,
                names[i],
                column.unit or units[min(i, len(units) - 1)],
                probes[i] if i < len(probes) else None,
            )
            for i, column in enumerate(columns)
        )

    def _column_unit(self, cell: str, unit_cell: str) -> str:
        """In the name, or in the row of units."""
        written = layouts.split_name_and_unit(cell)[1]
        unit_cell = "" if unit_cell.lower() in layouts.NOT_UNITS else unit_cell.strip("()[] ")
        if written and unit_cell and layouts.parse_unit(written) != layouts.parse_unit(unit_cell):
            raise InputError(
                f"{self.source}, line {self.units.number if self.units else 0}: the unit of {cell} is {unit_cell} here;"
                " keep one of the two"
            )
        return written or unit_cell

    def standard_columns(self) -> frozenset[int]:
        """Columns under fitact's own names, which must hold numbers whether they do or not."""
        parts = [layouts.split_name_and_unit(cell) for cell in (self.names.cells[: self.width] if self.names else [])]
        return frozenset(
            i
            for i, (name, unit) in enumerate(parts)
            if layouts.is_standard_name(name) and (not unit or layouts.parse_unit(unit))
        )

    def non_numeric_columns(self) -> tuple[str, ...]:
        named = self.names.cells[: self.width] if self.names else []
        words = [layouts.normalize_key(cell.partition("=")[0]) for cell in named]
        return tuple(c for i, c in enumerate(named) if i not in self.numeric and words[i] not in layouts.GRID_KEYS)

    def count(self) -> int | None:
        count = self.find_quantity(layouts.COUNT_KEYS)
        return int(count) if count is not None and count < 1e12 else None  # beyond, it means something else

    def _find_names(self, count: int) -> list[str]:
        """As "Source,CH1" or "Vertical Scale,CH1:0.05 CH2:0.10" state them."""
        named = self.find_values(layouts.NAME_KEYS)
        if len(named) < count:
            named = re.findall(r"([A-Za-z]+\d+)\s*:", " ".join(self.find_values(("verticalunits", "verticalscale"))))
        return named[:count] if len(set(named[:count])) == count else []

    def is_index(self, column: Column) -> bool:
        below = self.units.cells[column.index] if self.units else ""
        return below.lower() in layouts.INDEX_NAMES or column.name.lower() in layouts.INDEX_NAMES

    def find_time_column(self, columns: Sequence[Column]) -> Column | None:
        """By name, by unit, or because it stands first beside a header."""
        candidates = [c for c in columns if not self.is_index(c)]
        times = [c for c in candidates if c.name.lower() == "time"]
        times += [c for c in candidates if (layouts.parse_unit(c.unit) or ("",))[0] == "s"]
        times += [c for c in candidates if c.name.lower() in layouts.TIME_NAMES]
        stated = self.find_values(layouts.TIME_UNIT_KEYS)
        if not self.names and not self.units and min(self.numeric) > 1 and stated and len(candidates) > 1:
            times += candidates[:1]
        return dataclasses.replace(times[0], unit=times[0].unit or next(iter(stated), "")) if times else None


def _is_unfilled(row: TextRow, numbers: frozenset[int]) -> bool:
    """Whether all that the row holds are numbers, in some columns of numbers: a time without values yet."""
    return bool(numbers) and all(i in numbers for i, cell in enumerate(row.cells) if cell)


def _detect_delimiter(lines: Sequence[str]) -> tuple[str, bool]:
    """What parts most lines, from the middle on, into two numbers or more, and whether a comma marks the decimals."""
    lines = lines[len(lines) // 2 :]
    for delimiter in (";", "\t", ",", " "):
        rows = [split_cells(line, delimiter) for line in lines]
        comma = delimiter in ";\t" and any(_DECIMAL_COMMA.fullmatch(cell) for cells in rows for cell in cells)
        if sum(sum(parse_number(cell, comma) is not None for cell in cells) >= 2 for cells in rows) > len(rows) / 2:
            return delimiter, comma
    return ",", False
