"""Files of records and their true values, written under a temporary name first."""

import gzip
import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from data_synth.errors import RecipeError
from data_synth.recipe import UNITS

Columns = Mapping[str, np.ndarray]
_UNITS = {"time": "s", **UNITS}


def write_record(path: Path, time: np.ndarray, channels: Columns) -> None:
    """Write time (s) and channels (V, V, A, N); the suffix selects .csv, .csv.gz, .npz, .mat or .h5.

    Raises:
        RecipeError: another suffix.
    """
    write = _FORMATS.get(file_format(path))
    if write is None:
        raise RecipeError(f"{path}: no format has this suffix; use one of {', '.join(_FORMATS)}")
    _write_atomically(path, lambda file: write(file, {"time": time, **channels}))


def file_format(path: Path) -> str:
    """Return the suffix csv.gz, csv, npz, mat or h5, or \"\" for another one."""
    return next((end for end in _FORMATS if path.name.endswith(f".{end}")), "")


def write_json(path: Path, content: Any) -> None:
    """Write indented JSON."""
    text = json.dumps(content, indent=1, ensure_ascii=False) + "\n"
    _write_atomically(path, lambda file: file.write(text.encode()))


def write_table(path: Path, rows: Sequence[Mapping[str, str]]) -> None:
    """Write rows of text without commas as CSV, below a line with the names of the columns, which all rows share."""
    text = "".join(",".join(each) + "\n" for each in (rows[0], *(row.values() for row in rows)))
    _write_atomically(path, lambda file: file.write(text.encode()))


def _csv(columns: Columns) -> bytes:
    """Return CSV with all digits of the times and nine digits of the values."""
    rows = [",".join(f"{name}_{_UNITS[name]}" for name in columns)]
    for time, *values in zip(*(each.tolist() for each in columns.values()), strict=True):
        rows.append(",".join([repr(time), *(f"{value:.9g}" for value in values)]))
    return ("\n".join(rows) + "\n").encode()


def _npz(file: IO[bytes], columns: Columns) -> None:
    arrays: dict[str, Any] = dict(columns)
    np.savez_compressed(file, **arrays)


def _mat(file: IO[bytes], columns: Columns) -> None:
    import scipy.io

    scipy.io.savemat(file, dict(columns), oned_as="column")


def _h5(file: IO[bytes], columns: Columns) -> None:
    import h5py

    with h5py.File(file, "w") as content:
        for name, values in columns.items():
            content[name] = values
            content[name].attrs["units"] = _UNITS[name]


_FORMATS: dict[str, Callable[[IO[bytes], Columns], Any]] = {
    "csv.gz": lambda file, columns: file.write(gzip.compress(_csv(columns), mtime=0)),
    "csv": lambda file, columns: file.write(_csv(columns)),
    "npz": _npz,
    "mat": _mat,
    "h5": _h5,
}
FORMATS = tuple(_FORMATS)


def _write_atomically(path: Path, write: Callable[[IO[bytes]], Any]) -> None:
    """Write a file completely or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        with beside.open("w+b") as file:
            write(file)
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)
