"""Files to records. This version reads the project's own CSV: `time_s, V_V, Vsc_V, I_A` in any order."""

import gzip
import io
import os
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fitact import units
from fitact.data.record import CHANNEL_UNITS, Record
from fitact.errors import InputError
from fitact.files import replacing
from fitact.model.scene import Scene

_UNITS = {"time": "s", **CHANNEL_UNITS}
_HEADER = "time_s,V_V,Vsc_V,I_A"


class _Column(NamedTuple):
    place: int
    name: str  # a key of _UNITS
    unit: str | None  # as written, or None


def read(path: str | os.PathLike[str], scene: Scene | None = None) -> Record:
    """Read a CSV file (plain or gzip) with the columns time_s, V_V, Vsc_V and I_A, in any order.

    V_V or I_A may be absent. Another unit may stand in the name (`time_ms`, `V_kV`) or in a row of
    units under the header. Lines that are empty or start with # are passed over, and so are columns of
    other names, which the record's notes then list. With a `scene`, the channels that it measures must
    be there; V_V may be absent only where a scene gives the drive.

    Raises:
        InputError: the file cannot be read, or holds what cannot be used; names the line and the remedy.
    """
    name = os.fspath(path)
    lines = _lines(Path(path), name)
    if not lines:
        raise InputError(f"{name}: the file holds no data; expected a header such as {_HEADER} and rows of numbers")
    header, *rows = lines
    columns, ignored = _columns(header[1], name, header[0])
    if rows and _is_units_row(rows[0][1], columns):
        columns = _with_units(columns, rows.pop(0), name)
    if not rows:
        raise InputError(f"{name}: there are no rows of numbers under the header")
    table = _numbers(rows, [c.place for c in columns], len(_cells(header[1])), name)
    arrays = {c.name: table[:, i] * _scale(c, name, header[0]) for i, c in enumerate(columns)}
    notes = (f"{name}: not used: {', '.join(ignored)}",) if ignored else ()
    time = arrays.pop("time")
    record = Record.from_arrays(time, **arrays, source=name, notes=notes, where=lambda row: f"line {rows[row][0]}")
    for channel in scene.measurement.channels if scene else ("Vsc",):
        record[channel]  # refused where missing
    if "V" not in record and (scene is None or scene.drive.waveform == "measured"):
        raise InputError(
            f"{name}, line {header[0]}: the column V_V is missing and no scene gives the drive;"
            " record the drive, or name its waveform under [drive] in a scene file"
        )
    return record


def _lines(path: Path, name: str) -> list[tuple[int, str]]:
    """Numbered lines that hold something."""
    if path.is_dir():
        raise InputError(f"{name}: is a directory; give the path of a CSV file")
    try:
        content = path.read_bytes()
        if content[:2] == b"\x1f\x8b":
            content = gzip.decompress(content)
        text = content.decode("utf-8-sig")
    except (OSError, EOFError, zlib.error) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{name}: cannot be read ({reason.lower()}); check the path and the file") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{name}: is not a text file (byte {error.start}); export the record as CSV") from error
    numbered = ((number, line.strip()) for number, line in enumerate(text.splitlines(), start=1))
    return [(number, line) for number, line in numbered if line and not line.startswith("#")]


def _cells(line: str) -> list[str]:
    return [cell.strip().strip('"').strip() for cell in line.split(",")]


def _columns(header: str, name: str, line: int) -> tuple[list[_Column], list[str]]:
    """The columns that are known by name, and the names of the others."""
    known: list[_Column] = []
    ignored: list[str] = []
    for index, cell in enumerate(_cells(header)):
        symbol, _, unit = cell.partition("_")
        match = {key.lower(): key for key in _UNITS}.get(symbol.lower())
        if match is None:
            ignored.append(cell or f"column {index + 1} (unnamed)")
        elif any(column.name == match for column in known):
            raise InputError(f"{name}, line {line}: two columns are named {match}; keep one")
        else:
            known.append(_Column(index, match, unit or None))
    names = {column.name for column in known}
    if "time" not in names or not names - {"time"}:
        found = ", ".join(_cells(header))
        raise InputError(
            f"{name}, line {line}: no column {'time_s' if 'time' not in names else 'Vsc_V'} (found: {found[:200]});"
            f" name the columns as in {_HEADER}"
        )
    return known, ignored


def _is_units_row(line: str, columns: list[_Column]) -> bool:
    """Whether no known column holds a number: the row under the header that oscilloscopes fill with units."""
    cells = _cells(line)
    return all(column.place < len(cells) and not _is_number(cells[column.place]) for column in columns)


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _with_units(columns: list[_Column], row: tuple[int, str], name: str) -> list[_Column]:
    cells = [cell.strip("()[]") for cell in _cells(row[1])]
    combined = []
    for column in columns:
        below = cells[column.place] if column.place < len(cells) else ""
        if below and column.unit and _scale(column._replace(unit=below), name, row[0]) != _scale(column, name, row[0]):
            raise InputError(
                f"{name}, line {row[0]}: the unit of {column.name} is {below} here and {column.unit} in the"
                " header; keep one"
            )
        combined.append(column._replace(unit=column.unit or below or None))
    return combined


def _scale(column: _Column, name: str, line: int) -> float:
    """Factor from the column's unit to SI; a column without one is in SI."""
    if column.unit is None:
        return 1.0
    try:
        return units.scale(column.unit, _UNITS[column.name])
    except InputError:
        raise InputError(
            f"{name}, line {line}: '{column.unit}' is no unit of {column.name};"
            f" write a multiple of {_UNITS[column.name]}"
        ) from None


def _numbers(rows: Sequence[tuple[int, str]], places: list[int], width: int, name: str) -> np.ndarray:
    """The columns at `places`, of rows of `width` cells."""
    if all(line.count(",") == width - 1 for _, line in rows):
        text = io.StringIO("\n".join(line for _, line in rows))
        try:
            return np.loadtxt(text, delimiter=",", ndmin=2, comments=None, usecols=places)
        except ValueError:
            pass
    return _numbers_one_by_one(rows, places, width, name)


def _numbers_one_by_one(rows: Sequence[tuple[int, str]], places: list[int], width: int, name: str) -> np.ndarray:
    """The careful way, taken when the fast one failed: finds the offending cell, or copes with quotes."""
    table = np.empty((len(rows), len(places)))
    for row, (number, line) in enumerate(rows):
        cells = _cells(line)
        if len(cells) != width:
            raise InputError(
                f"{name}, line {number}: {len(cells)} values where the header has {width}; mend or remove the row"
            )
        for column, place in enumerate(places):
            cell = cells[place]
            if not _is_number(cell):
                what = f"'{cell[:40]}' is not a number" if cell else "the cell is empty"
                raise InputError(f"{name}, line {number}, column {place + 1}: {what}; mend or remove the row")
            table[row, column] = float(cell)
    return table


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
