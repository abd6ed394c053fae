"""Atomic writing of files, JSON, Parquet, NetCDF, and errors of reading."""

import contextlib
import json
import math
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from fitact.errors import InputError

# commands that make the contents of folders
_REMEDIES = {
    "results": "make them with: fitact sample RECORD",
    "population": "make it with: fitact population RECORD...",
}


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path that replaces `path` after the block, or is deleted after an exception."""
    path = Path(path)
    temporary = _temporary_path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error}); choose another path") from error
    finally:
        remove_temporary(path)


def require_folder(folder: Path | None) -> Path | None:
    """Return the folder, in which files can be written: before work whose results would be lost.

    Raises:
        InputError: it, or what is to contain it, is no folder or not writable.
    """
    if folder is not None:
        place = next(each for each in (folder.absolute(), *folder.absolute().parents) if each.exists())
        if not place.is_dir() or not os.access(place, os.W_OK):
            reason = "permission denied" if place.is_dir() else f"{place} is no folder"
            raise InputError(f"{folder}: cannot be written ({reason}); choose another path")
    return folder


def remove_temporary(path: str | os.PathLike[str]) -> None:
    """Remove the temporary file of an `atomic_write(path)` that was killed."""
    with contextlib.suppress(OSError):
        _temporary_path(Path(path)).unlink()


def _temporary_path(path: Path) -> Path:
    return path.with_name(f".{path.name}.tmp")  # a fixed name, so that the file of a killed run is overwritten


def read_error(source: str, error: Exception) -> InputError:
    """Return the error for a file that cannot be read."""
    reason = getattr(error, "strerror", None) or str(error)
    return InputError(f"{source}: cannot be read ({reason.lower()}); check the path and the file")


def write_parquet(path: str | os.PathLike[str], columns: Mapping[str, Any]) -> None:
    """Write columns of equal length as Parquet; needs `pip install 'fitact[campaign]'`.

    Raises:
        InputError: the path cannot be written, or pyarrow is not installed.
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise InputError(f"{path}: Parquet needs pyarrow; pip install 'fitact[campaign]', or write CSV") from error
    with atomic_write(path) as temporary:
        pq.write_table(pa.table(columns), temporary)


@contextlib.contextmanager
def complete_folder(path: str | os.PathLike[str], content: str) -> Iterator[Path]:
    """Yield a folder from which the block reads its `content`, "results" or "population".

    Raises:
        InputError: the block raised an error of reading.
    """
    try:
        yield Path(path)
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise InputError(f"{path}: holds no complete {content} ({error}); {_REMEDIES[content]} --out {path}") from error


def read_datatree(path: str | os.PathLike[str]) -> Any:
    """Return the `xarray.DataTree` of a NetCDF file; raise what xarray does."""
    import xarray as xr  # slow to import, and few commands read NetCDF

    with xr.open_datatree(path, engine="h5netcdf") as tree:
        return tree.load()


def read_head(path: str | os.PathLike[str], size: int = 4096) -> bytes:
    """Return the first bytes of a file.

    Raises:
        InputError: the path is a directory, or cannot be read.
    """
    if Path(path).is_dir():
        raise InputError(f"{path}: is a directory; give the path of a file")
    try:
        with Path(path).open("rb") as file:
            return file.read(size)
    except OSError as error:
        raise read_error(os.fspath(path), error) from error


def to_json(content: Any, indent: int | None = 2) -> str:
    """Return standard JSON, with null for values that are not finite; without `indent`, on one line."""
    return json.dumps(map_leaves(_to_null, content), indent=indent, ensure_ascii=False, allow_nan=False) + "\n"


def map_leaves(function: Callable[[Any], Any], content: Any) -> Any:
    """Return dicts, with names as keys, and lists as JSON has them, with `function` of what they hold."""
    if isinstance(content, dict):
        return {str(key): map_leaves(function, value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [map_leaves(function, value) for value in content]
    return function(content)


def _to_null(leaf: Any) -> Any:
    return None if isinstance(leaf, float) and not math.isfinite(leaf) else leaf


def write_json(path: str | os.PathLike[str], content: Any) -> None:
    """Write `content` as JSON to `path`."""
    with atomic_write(path) as temporary:
        temporary.write_text(to_json(content), encoding="utf-8")
