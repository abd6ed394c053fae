"""The header of a text file: where the numbers begin, what the columns are, and what its maker says of them."""

import collections
import dataclasses
import functools
import re
from collections.abc import Sequence

from fitact.data.readers import layouts
from fitact.errors import InputError

_EXAMPLE = "time_s,V_V,Vsc_V,I_A"
_SHORT = 4096  # characters of which a header mostly is a small part: to part lines into cells takes longest
_ENOUGH = 64  # rows that show what the rows are
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")
_QUANTITY = re.compile(r"(?:analog:)?\s*([-+]?[\d.,]+(?:e[-+]?\d+)?)\s*([a-zµμ]*)", re.IGNORECASE)
_MOST_ROWS = 1e12  # that a header can mean
_HERTZ = {"hz": 1.0, "khz": 1e3, "mhz": 1e6, "ghz": 1e9}


@dataclasses.dataclass(frozen=True)
class Line:
    """Its number, from 1, and its cells."""

    number: int
    cells: list[str]


@dataclasses.dataclass(frozen=True)
class Column:
    """One column of numbers; `unit` as written, "" where none is, `attenuation` as the header states it."""

    place: int
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
        others: names of the columns that hold no numbers.
        count: rows that the header announces.
        place: of the names, for messages.
    """

    maker: str
    delimiter: str
    decimal_comma: bool
    first: int
    width: int
    time: Column | None
    index: int | None
    columns: tuple[Column, ...]
    others: tuple[str, ...]
    start: float | None
    step: float | None
    count: int | None
    place: str


def read_header(text: str, source: str, companion: str = "") -> Header:
    """The header of a file that begins with `text`; `companion` is one kept in a file of its own, as `key:value` lines.

    Raises:
        InputError: there are no numbers, no time, or several segments.
    """
    sheet = _Sheet.of(text[:_SHORT].rpartition("\n")[0], companion, source)
    if not sheet.is_plain:
        sheet = _Sheet.of(text, companion, source)
    if not sheet.numeric:
        raise InputError(
            f"{source}: there are no rows of numbers; expected a header such as {_EXAMPLE}, and rows of numbers"
        )
    sheet = dataclasses.replace(sheet, numeric=sheet.numeric | sheet.contracted())
    segments = sheet.values(layouts.SEGMENT_KEYS)[:1]
    if segments and (number(segments[0], sheet.decimal_comma) or 1.0) > 1.0:
        raise InputError(f"{source}: holds {segments[0]} segments; export one of them")
    top = sheet.names or sheet.units or sheet.below[0]
    start, step = sheet.grid()
    columns = sheet.columns()
    time = sheet.time(columns)
    if time is None and step is None:
        found = ", ".join(sheet.names.cells) if sheet.names else "no header"
        raise InputError(
            f"{source}, line {top.number}: no column time_s, nor another of time (found: {found[:200]}); name the"
            f" columns as in {_EXAMPLE}, or export the time as well (Rohde & Schwarz keep that of NAME.Wfm.csv in"
            " NAME.csv beside it)"
        )
    index = next((c.place for c in columns if sheet.is_index(c)), None)
    values = sheet.completed([c for c in columns if c.place not in (index, time.place if time else None)])
    if not values:
        raise InputError(
            f"{source}, line {top.number}: there is no column of numbers besides the time; export channels"
        )
    return Header(
        maker=next((maker for maker, mark in layouts.MAKERS if mark.search(text[:4096])), "text"),
        delimiter=sheet.delimiter,
        decimal_comma=sheet.decimal_comma,
        first=sheet.below[0].number,
        width=sheet.width,
        time=time,
        index=index,
        columns=values,
        others=sheet.others(),
        start=start,
        step=step,
        count=sheet.count(),
        place=f", line {top.number}",
    )


def cells_of(line: str, delimiter: str) -> list[str]:
    """The cells of a line, without quotes and blanks around them."""
    parts = line.split() if delimiter == " " else line.split(delimiter)
    return [cell.strip().strip('"').strip() for cell in parts]


def number(cell: str, decimal_comma: bool) -> float | None:
    """The cell as a number, or None; infinity is how some makers write that a value is out of range."""
    if "_" in cell:  # Python would read 1_000
        return None
    try:
        return float(cell.replace(",", ".") if decimal_comma else cell)
    except ValueError:
        return {"∞": float("inf"), "-∞": -float("inf")}.get(cell)


@dataclasses.dataclass(frozen=True)
class _Sheet:
    """The first lines of a file, parted into those above the numbers and those with them."""

    delimiter: str
    decimal_comma: bool
    comments: list[Line]
    above: list[Line]
    below: list[Line]
    numeric: frozenset[int]  # the columns of numbers
    source: str

    @classmethod
    def of(cls, text: str, companion: str, source: str) -> "_Sheet":
        lines = [(n, line.strip(" \r\f\v")) for n, line in enumerate(text.split("\n"), start=1)]
        delimiter, decimal_comma = _delimiter([line for _, line in lines if line and not line.startswith("#")])
        rows = [Line(n, cells_of(line, delimiter)) for n, line in lines if line.strip(delimiter + " ")]
        data = [row for row in rows if not row.cells[0].startswith("#")]
        places = [
            frozenset(i for i, cell in enumerate(row.cells) if number(cell, decimal_comma) is not None) for row in data
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
        comments += [Line(0, line.split(":")) for line in companion.splitlines()]
        return cls(delimiter, decimal_comma, comments, data[:first], data[first:], numeric, source)

    @property
    def is_plain(self) -> bool:
        """Whether further rows have nothing to tell: enough of them, only numbers, and the decimal mark seen."""
        cells = [cell for row in self.below for cell in row.cells]
        enough = len(self.below) >= max(_ENOUGH, 2 * len(self.above))
        marked = self.delimiter == "," or any("," in cell or "." in cell for cell in cells)
        return enough and marked and all(number(cell, self.decimal_comma) is not None for cell in cells)

    @functools.cached_property
    def width(self) -> int:
        widths = (len(row.cells) for row in self.below if len(row.cells) > max(self.numeric))
        return collections.Counter(widths).most_common(1)[0][0]

    @functools.cached_property
    def stated(self) -> dict[str, list[str]]:
        """Each word of the header, with the cells after it."""
        beside = [Line(row.number, row.cells[: min(self.numeric)]) for row in self.below if min(self.numeric) > 1]
        known: dict[str, list[str]] = {}
        for row in (*self.comments, *self.above, *beside):
            for i, cell in enumerate(row.cells):
                word, _, value = cell.partition("=" if "=" in cell.rstrip("= ") else ":")
                following = [value.strip()] * bool(value.strip()) + [c for c in row.cells[i + 1 :] if c]
                if following and layouts.key(word) and number(cell, self.decimal_comma) is None:
                    known.setdefault(layouts.key(word), following)
        return known

    def values(self, keys: Sequence[str]) -> list[str]:
        """What the header states under the first of the keys that it has."""
        return next((self.stated[key] for key in keys if key in self.stated), [])

    def quantity(self, keys: Sequence[str]) -> float | None:
        """The largest number that it states there, in SI units: they may differ between channels."""
        found = (self._quantity(text) for text in self.values(keys))
        return max((value for value in found if value is not None), default=None)

    def _quantity(self, text: str) -> float | None:
        match = _QUANTITY.fullmatch(text.strip())
        value = number(match[1], self.decimal_comma) if match else None
        if match is None or value is None:
            return None
        unit = layouts.unit(match[2])
        return value * (unit[1] if unit else _HERTZ.get(match[2].lower(), 1.0))

    @functools.cached_property
    def names(self) -> Line | None:
        """The row of names, above that of units where there is one; numpy.savetxt writes it as a comment."""
        rows = [row for row in self.above if len(row.cells) > max(self.numeric) and row is not self.units]
        if rows and self._is_names(rows[-1]):
            return rows[-1]
        if self.comments and self.comments[-1].number and not self.units:
            cells = cells_of(self.delimiter.join(self.comments[-1].cells).lstrip("# "), self.delimiter)
            row = Line(self.comments[-1].number, cells)
            if len(cells) == self.width and self._is_names(row):
                return row
        return None

    def _is_names(self, row: Line) -> bool:
        here = [row.cells[i] for i in sorted(self.numeric)]
        if any(layouts.name_and_unit(cell)[0].lower() in layouts.TIME_NAMES for cell in here if cell):
            return True  # although the others may be numbers, as Keysight's are
        return any(here) and all(number(cell, self.decimal_comma) is None for cell in here)

    @functools.cached_property
    def units(self) -> Line | None:
        """The row of units right above the numbers."""
        row = self.above[-1] if self.above else None
        if row is None or len(row.cells) <= max(self.numeric):
            return None
        here = [row.cells[i] for i in sorted(self.numeric)]
        known = [bool(layouts.unit(cell)) or cell[:1] + cell[-1:] in ("()", "[]") for cell in here]
        rest = [cell.lower() in layouts.NOT_UNITS for cell in here]
        return row if any(known) and all(a or b for a, b in zip(known, rest, strict=True)) else None

    def grid(self) -> tuple[float | None, float | None]:
        """Start and step of the time, s: below the words Start and Increment, or beside words of that meaning."""
        below = {}
        if self.names and self.units:
            pairs = zip(self.names.cells, self.units.cells, strict=False)
            below = {layouts.key(word): number(text, self.decimal_comma) for word, text in pairs}

        def find(keys: Sequence[str]) -> float | None:
            found = [below[key] for key in keys if below.get(key) is not None]
            return found[0] if found else self.quantity(keys)

        step, rate = find(layouts.STEP_KEYS), find(layouts.RATE_KEYS)
        if step is None and rate:
            step = 1.0 / rate
        return find(layouts.START_KEYS), step if step is not None and 0.0 < step < float("inf") else None

    def columns(self) -> list[Column]:
        """Those of numbers, with the names and units above them."""
        made = []
        for place in sorted(self.numeric):
            cell, below = (row.cells[place] if row else "" for row in (self.names, self.units))
            made.append(Column(place, layouts.name_and_unit(cell)[0], self._unit(cell, below)))
        return made

    def completed(self, columns: Sequence[Column]) -> tuple[Column, ...]:
        """Columns of values, with the names and units that the header states elsewhere."""
        names = [column.name for column in columns]
        if "" in names or (len(set(names)) < len(names) and not any(layouts.is_contract(name) for name in names)):
            names = self._names_elsewhere(len(names)) or [f"column {column.place + 1}" for column in columns]
        units = [re.sub(r".*:", "", text) for text in self.values(layouts.UNIT_KEYS)] or [""]
        probes = [self._quantity(text) for text in self.values(layouts.ATTENUATION_KEYS)]
        return tuple(
            Column(
                column.place,
                names[i],
                column.unit or units[min(i, len(units) - 1)],
                probes[i] if i < len(probes) else None,
            )
            for i, column in enumerate(columns)
        )

    def _unit(self, cell: str, below: str) -> str:
        """In the name, or in the row of units."""
        written = layouts.name_and_unit(cell)[1]
        below = "" if below.lower() in layouts.NOT_UNITS else below.strip("()[] ")
        if written and below and layouts.unit(written) != layouts.unit(below):
            raise InputError(
                f"{self.source}, line {self.units.number if self.units else 0}: the unit of {cell} is {below} here;"
                " keep one of the two"
            )
        return written or below

    def contracted(self) -> frozenset[int]:
        """Columns under fitact's own names, which must hold numbers whether they do or not."""
        parts = [layouts.name_and_unit(cell) for cell in (self.names.cells[: self.width] if self.names else [])]
        return frozenset(
            i for i, (name, unit) in enumerate(parts) if layouts.is_contract(name) and (not unit or layouts.unit(unit))
        )

    def others(self) -> tuple[str, ...]:
        """Names of the columns that hold no numbers."""
        named = self.names.cells[: self.width] if self.names else []
        words = [layouts.key(cell.partition("=")[0]) for cell in named]
        return tuple(c for i, c in enumerate(named) if i not in self.numeric and words[i] not in layouts.GRID_KEYS)

    def count(self) -> int | None:
        """The rows that the header announces."""
        count = self.quantity(layouts.COUNT_KEYS)
        return int(count) if count is not None and count < _MOST_ROWS else None

    def _names_elsewhere(self, count: int) -> list[str]:
        """As "Source,CH1" or "Vertical Scale,CH1:0.05 CH2:0.10" state them."""
        named = self.values(layouts.NAME_KEYS)
        if len(named) < count:
            named = re.findall(r"([A-Za-z]+\d+)\s*:", " ".join(self.values(("verticalunits", "verticalscale"))))
        return named[:count] if len(set(named[:count])) == count else []

    def is_index(self, column: Column) -> bool:
        """Whether the column counts samples."""
        below = self.units.cells[column.place] if self.units else ""
        return below.lower() in layouts.INDEX_NAMES or column.name.lower() in layouts.INDEX_NAMES

    def time(self, columns: Sequence[Column]) -> Column | None:
        """By name, by unit, or because it stands first beside a header."""
        able = [c for c in columns if not self.is_index(c)]
        for fits in (
            lambda c: c.name.lower() == "time",
            lambda c: (layouts.unit(c.unit) or ("",))[0] == "s",
            lambda c: c.name.lower() in layouts.TIME_NAMES,
        ):
            found = [c for c in able if fits(c)]
            if found:
                return self._timed(found[0])
        beside = not self.names and not self.units and min(self.numeric) > 1 and self.values(layouts.TIME_UNIT_KEYS)
        return self._timed(able[0]) if beside and len(able) > 1 else None

    def _timed(self, column: Column) -> Column:
        """With the unit that the header states elsewhere."""
        elsewhere = next(iter(self.values(layouts.TIME_UNIT_KEYS)), "")
        return dataclasses.replace(column, unit=column.unit or elsewhere)


def _is_unfilled(row: Line, numbers: frozenset[int]) -> bool:
    """Whether all that the row holds are numbers, in some columns of numbers: a time without values yet."""
    return bool(numbers) and all(i in numbers for i, cell in enumerate(row.cells) if cell)


def _delimiter(lines: Sequence[str]) -> tuple[str, bool]:
    """What parts most lines, from the middle on, into two numbers or more, and whether a comma marks the decimals."""
    lines = lines[len(lines) // 2 :]
    for delimiter in (";", "\t", ",", " "):
        rows = [cells_of(line, delimiter) for line in lines]
        comma = delimiter in ";\t" and any(_DECIMAL_COMMA.fullmatch(cell) for cells in rows for cell in cells)
        if sum(sum(number(cell, comma) is not None for cell in cells) >= 2 for cells in rows) > len(rows) / 2:
            return delimiter, comma
    return ",", False
