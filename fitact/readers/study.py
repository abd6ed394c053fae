"""Table of an experiment: person, finger, session and repetition of each record, and covariates."""

import csv
import dataclasses
import io
import os
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import Int

from fitact.errors import InputError
from fitact.files import read_error, read_head
from fitact.readers.header import parse_number
from fitact.tables import Display, join_lines

LEVELS = ("person", "finger", "session", "repetition")  # a unit of each is one within its unit of the level before
_REPETITION = LEVELS[-1]
_FINGER = LEVELS[1]
_RECORD = "record"  # column with the files
_PLURALS = {
    "record": "records",
    "person": "people",
    "finger": "fingers",
    "session": "sessions",
    "repetition": "repetitions",
}
_DELIMITERS = ",;\t"
_FIELD = re.compile(r"\{([^{}]*)\}")


class Level(NamedTuple):
    """Grouping of records into units.

    Attributes:
        name: one of `LEVELS`.
        units: name of each unit: its labels from the top, joined by ", ".
        unit_numbers: index into `units` for each record.
    """

    name: str
    units: tuple[str, ...]
    unit_numbers: Int[np.ndarray, " records"]


class Nesting(NamedTuple):
    """Levels that the records separate, from the top; in the last, each record is a unit.

    `omitted` states in sentences which levels are left out, and why.
    """

    levels: tuple[Level, ...]
    omitted: tuple[str, ...]


@dataclasses.dataclass(frozen=True, repr=False)
class Study(Display):
    """Records of an experiment, with labels and covariates.

    Attributes:
        records: files, or folders that `fitact track` left.
        labels: label of each record, under each of person, finger, session and repetition that is given.
        covariates: number of each record, by name.
        codes: the two words that stand for 0 and 1, of a covariate in words.
        source: path of the table, or the pattern.
    """

    records: tuple[Path, ...]
    labels: Mapping[str, tuple[str, ...]]
    covariates: Mapping[str, tuple[float, ...]]
    codes: Mapping[str, tuple[str, str]]
    source: str

    @classmethod
    def from_table(cls, path: str | os.PathLike[str]) -> Self:
        """Read a CSV (delimiter comma, semicolon or tab) with a column `record`.

        Paths are relative to the folder of the table. The columns person, finger, session and repetition are labels;
        each other column is a covariate, in numbers or in two words.

        Raises:
            InputError: the table cannot be read, a file is missing or named twice, a cell is empty, a covariate has
                neither numbers nor two words, or two rows have the same labels with the same repetition.
        """
        table, folder = _Rows.from_csv(path), Path(path).parent
        records, lines = [], dict[str, str]()
        for place, text in zip(table.places, table.columns[_RECORD], strict=True):
            if not text:
                raise InputError(f"{place}: record is empty; write the path of a file")
            record = folder / text
            if (first := lines.setdefault(os.path.abspath(record), place)) != place:
                raise InputError(f"{place}: {text} has a row already ({first}); keep one")
            if not record.exists():
                raise InputError(f"{place}: {record} does not exist; write its path relative to the table's folder")
            records.append(record)
        return cls._from_columns(table, records)

    @classmethod
    def from_pattern(cls, pattern: str, records: Sequence[str | os.PathLike[str]]) -> Self:
        """Take labels and covariates from the names of files, e.g. "P{person}_r{repetition}.csv".

        A pattern with folders, e.g. "{person}/{side}_{repetition}.csv", is compared with as many parts of the path.

        Raises:
            InputError: there is no record, or one does not match or is given twice; otherwise as `from_table`.
        """
        names, expression, depth = _compile_pattern(pattern)
        paths = [Path(record) for record in records]
        if not paths:
            raise InputError(f"pattern {pattern}: no records are given; give files whose names match")
        twice = [path for path, count in Counter(map(os.path.abspath, paths)).items() if count > 1]
        if twice:
            raise InputError(f"{twice[0]}: is given twice; give each record once")
        rows = []
        for path in paths:
            found = expression.fullmatch("/".join(Path(os.path.abspath(path)).parts[-depth:]))
            if found is None:
                raise InputError(
                    f"{path}: does not match the pattern {pattern}; rename it, or list the records in a table"
                )
            rows.append(found.groups())
        columns = {name: [row[i] for row in rows] for i, name in enumerate(names)}
        return cls._from_columns(_Rows(columns, [str(path) for path in paths], pattern), paths)

    @classmethod
    def _from_columns(cls, table: "_Rows", records: Sequence[Path]) -> Self:
        labels = {name: tuple(table.columns[name]) for name in LEVELS if name in table.columns}
        nest_levels(labels, len(records), table.places)  # raises InputError
        covariates, codes = {}, {}
        for name in table.columns:
            if name not in (_RECORD, *LEVELS):
                covariates[name], words = table.parse_covariate(name)
                if words is not None:
                    codes[name] = words
        return cls(tuple(records), labels, covariates, codes, table.source)

    @property
    def columns(self) -> dict[str, tuple[str, ...] | tuple[float, ...]]:
        """Labels and covariates of the records by name; words in place of their codes."""
        words = {
            name: tuple(words[int(value)] for value in self.covariates[name]) for name, words in self.codes.items()
        }
        return {**self.labels, **self.covariates, **words}

    def nest(self) -> Nesting:
        """Return the levels that the labels separate, see `nest_levels`."""
        names = [record.name for record in self.records]
        if len(set(names)) < len(names):
            names = [str(record) for record in self.records]
        return nest_levels(self.labels, len(self.records), names)

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON content of `fitact inspect` on a table."""
        nesting = self.nest()
        return {
            "source": self.source,
            "records": len(self.records),
            "levels": [{"name": level.name, "units": len(level.units)} for level in nesting.levels],
            "omitted": list(nesting.omitted),
            "covariates": [
                {
                    "name": name, "level": covariate_level(values, nesting), "min": min(values), "max": max(values),
                    "codes": list(self.codes.get(name, ())),
                }
                for name, values in self.covariates.items()
            ],
        }  # fmt: skip

    def __str__(self) -> str:
        nesting = self.nest()
        return join_lines([f"{self.source}: {self._headline}", *self._sentences()], notes=nesting.omitted)

    @property
    def _headline(self) -> str:
        top, *lower = levels = self.nest().levels
        parts = [_count(len(self.records), _RECORD)]
        if top.name != _REPETITION:
            parts[0] += f" of {_count(len(top.units), top.name)}"
        for above, level in zip(levels, lower, strict=False):
            pairs = set(zip(above.unit_numbers.tolist(), level.unit_numbers.tolist(), strict=True))
            sizes = Counter(number for number, _ in pairs).values()
            few = f"{min(sizes)} to " if min(sizes) < max(sizes) else ""
            parts.append(f"{few}{_count(max(sizes), level.name)} each")
        return ", ".join(parts)

    def _sentences(self) -> Iterable[str]:
        nesting = self.nest()
        yield f"levels: {', '.join(f'{level.name} ({len(level.units)})' for level in nesting.levels)}"
        for name, values in self.covariates.items():
            yield f"{name}: {self._describe_covariate(name, values, nesting)}"

    def _describe_covariate(self, name: str, values: Sequence[float], nesting: Nesting) -> str:
        if min(values) == max(values):
            return f"{values[0]:g} for all records"
        names = [level.name for level in nesting.levels]
        place = names.index(covariate_level(values, nesting))
        top = _RECORD if names[0] == _REPETITION else names[0]
        where = f"varies within a {names[place - 1]}" if place else f"one for each {top}"
        if name in self.codes:
            zero, one = self.codes[name]
            return f"{zero} = 0, {one} = 1, {where}"
        return f"{len(set(values))} values from {min(values):g} to {max(values):g}, {where}"


def nest_levels(labels: Mapping[str, Sequence[str]], count: int, names: Sequence[str] | None = None) -> Nesting:
    """Return the levels that the labels of `count` records separate.

    Labels need only differ within the unit above: finger "index" of person P1 is not that of P2. A level stays if it
    splits the units of the level above. Records that the labels do not separate are repetitions, in their order.
    Without labels, each record is a finger.

    Args:
        labels: a label for each record under some of `LEVELS`.
        count: number of records.
        names: name of each record, for messages, and for the units without labels.

    Raises:
        InputError: a name is not one of `LEVELS`, a label is missing or empty, or records with a label of repetition
            have all labels in common.
    """
    places = names or [f"record {number + 1}" for number in range(count)]
    _check_labels(labels, count, places)
    given = [name for name in LEVELS if name in labels]
    if not given:
        units = names or [str(number + 1) for number in range(count)]
        return Nesting((Level(_FINGER, tuple(units), np.arange(count)),), ())
    keys: list[tuple[str, ...]] = [()] * count
    levels: list[Level] = []
    omitted = []
    for name in LEVELS:
        if name in given:
            keys = [(*key, str(label)) for key, label in zip(keys, labels[name], strict=True)]
        elif name == _REPETITION:
            keys = _number_repetitions(keys)
        else:
            continue
        level = _group_records(name, keys)
        if len(level.units) > (len(levels[-1].units) if levels else 1):
            levels.append(level)
        else:
            omitted.append(_explain_omission(name, levels))
    _require_separate(keys, given, places)
    if not levels:  # one record
        return Nesting((_group_records(given[0], [key[:1] for key in keys]),), ())
    return Nesting(tuple(levels), tuple(omitted))


def covariate_level(values: Sequence[float], nesting: Nesting) -> str:
    """Return the name of the highest level in whose units the covariate, a number for each record, is constant."""
    for level in nesting.levels:
        if len(set(zip(level.unit_numbers.tolist(), values, strict=True))) == len(level.units):
            return level.name
    raise AssertionError("in the last level, each record is a unit")


def is_study(path: str | os.PathLike[str]) -> bool:
    """Return whether a file is a table for `Study.from_table`, by its header."""
    try:
        lines = read_head(path).decode("utf-8-sig", "replace").splitlines()
        return _RECORD in _split_header(lines)[0]
    except (InputError, csv.Error):
        return False


class _Rows(NamedTuple):
    """Columns of text; `places` names each row in messages."""

    columns: Mapping[str, Sequence[str]]
    places: Sequence[str]
    source: str
    decimal_comma: bool = False

    @classmethod
    def from_csv(cls, path: str | os.PathLike[str]) -> Self:
        source = os.fspath(path)
        try:
            text = Path(path).read_text(encoding="utf-8-sig")
            names, delimiter = _split_header(text.splitlines())
            reader = csv.reader(io.StringIO(text), delimiter=delimiter)
            rows = [(reader.line_num, [cell.strip() for cell in cells]) for cells in reader]
        except (OSError, csv.Error) as error:
            raise read_error(source, error) from error
        except UnicodeDecodeError as error:
            raise InputError(f"{source}: is no text in UTF-8; save the table as CSV in UTF-8") from error
        rows = [(line, cells) for line, cells in rows if any(cells)][1:]
        if _RECORD not in names:
            raise InputError(f"{source}: the column record is missing; write its name above the paths of the records")
        if not rows:
            raise InputError(f"{source}: holds no records; write a row for each")
        _require_different(names, source)
        for line, cells in rows:
            if len(cells) != len(names):
                raise InputError(
                    f"{source}, line {line}: has {len(cells)} cells, and the header {len(names)};"
                    " write one for each column"
                )
            if unnamed := [cell for cell, name in zip(cells, names, strict=True) if cell and not name]:
                raise InputError(f"{source}, line {line}: {unnamed[0]} is in a column without a name; name the column")
        columns = {name: [cells[i] for _, cells in rows] for i, name in enumerate(names) if name}
        return cls(columns, [f"{source}, line {line}" for line, _ in rows], source, delimiter != ",")

    def parse_covariate(self, name: str) -> tuple[tuple[float, ...], tuple[str, str] | None]:
        """Return a number for each row, and the words for 0 and 1 if the column has words."""
        texts = self.columns[name]
        numbers = [parse_number(text, self.decimal_comma) for text in texts]
        words = sorted({text for text, number in zip(texts, numbers, strict=True) if number is None})
        if len(words) == 2 and "" not in words and set(numbers) == {None}:
            return tuple(float(words.index(text)) for text in texts), (words[0], words[1])
        for place, text, number in zip(self.places, texts, numbers, strict=True):
            if not text:
                raise InputError(f"{place}: {name} is empty; write its value, or leave the record out")
            if number is None and set(numbers) != {None}:
                raise InputError(f"{place}: {name} is {text}, not a number as in other rows; write a number")
            if number is not None and not np.isfinite(number):
                raise InputError(f"{place}: {name} is {text}; write a finite number, or leave the record out")
        if words:
            some = ", ".join(words[:3]) + ", ..." * (len(words) > 3)
            raise InputError(
                f"{self.source}: {name} has neither numbers nor two words ({some}); write one of these, or remove it"
            )
        return tuple(number for number in numbers if number is not None), None


def _split_header(lines: Sequence[str]) -> tuple[list[str], str]:
    """Return the names in the first line that is not blank, known ones in lower case, and the delimiter."""
    header = next((line for line in lines if line.strip()), "")
    delimiter = max(_DELIMITERS, key=header.count)
    names = [name.strip() for name in next(csv.reader([header], delimiter=delimiter), [])]
    return [_unify_name(name) for name in names], delimiter


def _unify_name(name: str) -> str:
    return name.lower() if name.lower() in (_RECORD, *LEVELS) else name


def _require_different(names: Sequence[str], source: str) -> None:
    for name, times in Counter(filter(None, names)).items():
        if times > 1:
            raise InputError(f"{source}: {name} occurs twice; give each name once")


def _compile_pattern(pattern: str) -> tuple[list[str], re.Pattern[str], int]:
    """Return the names in braces, the expression, and the number of path parts to compare."""
    path = pattern.strip("/")
    literals_and_names = _FIELD.split(path)
    names = [_unify_name(name.strip()) for name in literals_and_names[1::2]]
    literals = literals_and_names[::2]
    if not names or "" in names or _RECORD in names or any(set(text) & set("{}") for text in literals):
        raise InputError(f"pattern {pattern}: write names in braces, e.g. P{{person}}_r{{repetition}}.csv")
    if "" in literals[1:-1]:
        raise InputError(f"pattern {pattern}: where one name ends is unclear; write text between two names")
    _require_different(names, f"pattern {pattern}")
    expression = "([^/]+?)".join(map(re.escape, literals))
    return names, re.compile(expression), path.count("/") + 1


def _check_labels(labels: Mapping[str, Sequence[str]], count: int, places: Sequence[str]) -> None:
    for name, column in labels.items():
        if name not in LEVELS:
            raise InputError(f"labels: {name} is no level; use {', '.join(LEVELS)}")
        if len(column) != count:
            raise InputError(f"labels of {name}: {len(column)} for {count} records; give one for each")
        for place, label in zip(places, column, strict=True):
            if not str(label).strip():
                raise InputError(f"{place}: {name} is empty; write a label")


def _require_separate(keys: Sequence[tuple[str, ...]], given: Sequence[str], places: Sequence[str]) -> None:
    """Raise InputError if two records have the same labels, including the repetition."""
    first: dict[tuple[str, ...], int] = {}
    for number, key in enumerate(keys):
        if first.setdefault(key, number) != number:
            same = " and ".join(f"{name} {label}" for name, label in zip(given, key, strict=True))
            raise InputError(f"{places[number]}: has the same {same} as {places[first[key]]}; number the repetitions")


def _number_repetitions(keys: Sequence[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Add the number of each record among those of its unit, from 1."""
    counts: Counter[tuple[str, ...]] = Counter()
    numbered = []
    for key in keys:
        counts[key] += 1
        numbered.append((*key, str(counts[key])))
    return numbered


def _group_records(name: str, keys: Sequence[tuple[str, ...]]) -> Level:
    numbers = {key: number for number, key in enumerate(dict.fromkeys(keys))}
    return Level(name, tuple(", ".join(key) for key in numbers), np.array([numbers[key] for key in keys], dtype=int))


def _explain_omission(name: str, levels: Sequence[Level]) -> str:
    if not levels:
        return f"all records are of one {name}, so differences between {_PLURALS[name]} are not estimated"
    above = levels[-1].name
    one, several = (_RECORD, "touches") if name == _REPETITION else (name, _PLURALS[name])
    return f"each {above} has one {one}, so differences between {_PLURALS[above]} contain those between {several}"


def _count(number: int, name: str) -> str:
    return f"{number} {name if number == 1 else _PLURALS[name]}"
