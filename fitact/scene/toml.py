"""Scene files as text: where they are, how a scene is written as one, and which line an error is on."""

import difflib
import functools
import importlib.resources
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from fitact.errors import InputError
from fitact.scene.prior_section import QUANTITIES, Belief
from fitact.scene.sections import Section, unit_of
from fitact.units import written

_HEADER = re.compile(r"\s*\[([^\[\]]+)\]\s*(#.*)?$")
_KEY = re.compile(r"\s*([\w.\"'-]+)\s*=")
_INLINE = re.compile(r"[{,]\s*([\w-]+)\s*=")


@functools.cache
def shipped() -> dict[str, str]:
    """The scenes that come with fitact: name -> text."""
    folder = importlib.resources.files("fitact") / "scenes"
    return {file.name.removesuffix(".toml"): file.read_text(encoding="utf-8") for file in folder.iterdir()}


def read(path: str | Path) -> str:
    """The text of a scene file, or of a shipped scene where there is no such file.

    Raises:
        InputError: there is neither, or it cannot be read.
    """
    name = str(path)
    try:
        return Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        if isinstance(error, FileNotFoundError) and name in shipped():
            return shipped()[name]
        reason = (error.strerror or str(error)).lower() if isinstance(error, OSError) else "not UTF-8 text"
        raise InputError(f"{name}: the scene cannot be read ({reason}); give a TOML file{_or_shipped(name)}") from error


def _or_shipped(name: str) -> str:
    if "." in name or "/" in name:
        return ""
    near = difflib.get_close_matches(name, shipped(), n=1)
    return f", or the shipped scene '{near[0]}'" if near else f", or a shipped scene: {', '.join(sorted(shipped()))}"


def to_toml(scene: Section) -> str:
    """Every key with its unit; those that were not given, as comments. Read again it is the same scene."""
    return "\n".join(_lines(scene)) + "\n"


def _lines(scene: Section) -> Iterator[str]:
    for name, section in scene:
        yield f"[{name}]"
        for key, field in type(section).model_fields.items():
            value = getattr(section, key)
            line = f"{key}: absent" if value is None else f"{key} = {value_text(value, unit_of(field))}"
            yield line if key in section.model_fields_set and value is not None else f"# {line}"
        yield ""


def value_text(value: Any, unit: str | None) -> str:
    """A value as TOML; `unit` is that of numbers, None for plain ones."""
    if isinstance(value, Belief):
        given = {key: getattr(value, key) for key in type(value).model_fields if key in value.model_fields_set}
        return _table({key: value_text(x, unit if key in QUANTITIES else None) for key, x in given.items()})
    if isinstance(value, dict):
        return _table({key: value_text(x, unit) for key, x in value.items()})
    if isinstance(value, tuple):
        return f"[{', '.join(value_text(x, unit) for x in value)}]"
    if isinstance(value, float) and unit:
        return f'"{written(value, unit)}"'
    return json.dumps(value, ensure_ascii=False)


def _table(items: dict[str, str]) -> str:
    return f"{{{', '.join(f'{key} = {text}' for key, text in items.items())}}}"


def line_of(text: str, sentence: str) -> int | None:
    """The line of a scene file that a sentence such as "[drive] duty = 2: ..." is about; None if there is none."""
    place = re.match(r"\[(\w+)\](.*)", sentence)
    if place is None:
        return None
    section, lines = place[1], _places(text)
    words = re.findall(r"[\w-]+", place[2])
    for index, word in enumerate(words):
        for path in lines:
            if path[0] == section and path[-1] == word and len(path) > 1:
                whole = (*path, *words[index + 1 : index + 2])
                return lines.get(whole, lines[path])
    return lines.get((section,))


def _places(text: str) -> dict[tuple[str, ...], int]:
    """The first line of every table and key, by its path."""
    found: dict[tuple[str, ...], int] = {}
    table: tuple[str, ...] = ()
    for number, line in enumerate(text.splitlines(), 1):
        header, key = _HEADER.match(line), _KEY.match(line)
        if header:
            table = _parts(header[1])
            found.setdefault(table[:1], number)
            found.setdefault(table, number)
        elif key:
            path = table + _parts(key[1])
            for end in range(1, len(path) + 1):
                found.setdefault(path[:end], number)
            for inner in _INLINE.finditer(line):
                found.setdefault((*path, inner[1]), number)
    return found


def _parts(dotted: str) -> tuple[str, ...]:
    return tuple(part.strip(" \"'") for part in dotted.split("."))
