"""Files that appear whole or not at all."""

import contextlib
import json
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from fitact.errors import InputError


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary name beside `path`, which takes its place when the block ends well, and goes when it does not."""
    path = Path(path)
    temporary = _temporary_path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error}); choose another place") from error
    finally:
        remove_temporary(path)


def remove_temporary(path: str | os.PathLike[str]) -> None:
    """Remove what a killed program left of `atomic_write(path)`."""
    with contextlib.suppress(OSError):
        _temporary_path(Path(path)).unlink()


def _temporary_path(path: Path) -> Path:
    return path.with_name(f".{path.name}.tmp")  # one name, so that what a kill leaves is overwritten


def read_error(source: str, error: Exception) -> InputError:
    """Return the error to raise where a file cannot be read."""
    reason = getattr(error, "strerror", None) or str(error)
    return InputError(f"{source}: cannot be read ({reason.lower()}); check the path and the file")


def to_json(content: Any, indent: int | None = 2) -> str:
    """Return plain JSON, with null for what is not finite; keys in the order given; without `indent` on one line."""
    return json.dumps(_to_plain(content), indent=indent, ensure_ascii=False, allow_nan=False) + "\n"


def _to_plain(content: Any) -> Any:
    if isinstance(content, dict):
        return {str(key): _to_plain(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_to_plain(value) for value in content]
    if isinstance(content, float) and not math.isfinite(content):
        return None
    return content


def write_json(path: str | os.PathLike[str], content: Any) -> None:
    """`content` as JSON at `path`."""
    with atomic_write(path) as temporary:
        temporary.write_text(to_json(content), encoding="utf-8")
