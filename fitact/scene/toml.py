"""Text of scene files: locate and read them, write a scene, and find the line of an error."""

import difflib
import functools
import importlib.resources
import json
import re
from pathlib import Path
from typing import Any

from fitact.errors import InputError
from fitact.scene.prior_spec import QUANTITY_KEYS
from fitact.scene.section import Section, field_unit
from fitact.scene.uncertain_value import UncertainValue
from fitact.units import format_exact

_HEADER = re.compile(r"\s*\[([^\[\]]+)\]\s*(#.*)?$")
_KEY = re.compile(r"\s*([\w.\"'-]+)\s*=")
_INLINE = re.compile(r"[{,]\s*([\w-]+)\s*=")


@functools.cache
def shipped_scenes() -> dict[str, str]:
    """Return the scenes shipped with fitact: name -> text."""
    folder = importlib.resources.files("fitact") / "scenes"
    return {file.name.removesuffix(".toml"): file.read_text(encoding="utf-8") for file in folder.iterdir()}


def read_scene_text(path: str | Path) -> str:
    """Return the text of a scene file, or of a shipped scene if there is no such file."""
    name = str(path)
    try:
        return Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        if isinstance(error, FileNotFoundError) and name in shipped_scenes():
            return shipped_scenes()[name]
        reason = (error.strerror or str(error)).lower() if isinstance(error, OSError) else "not UTF-8 text"
        raise InputError(
            f"{name}: the scene cannot be read ({reason}); give a TOML file{_suggest_shipped(name)}"
        ) from error


def _suggest_shipped(name: str) -> str:
    if "." in name or "/" in name:
        return ""
    if matches := difflib.get_close_matches(name, shipped_scenes(), n=1):
        return f", or the shipped scene '{matches[0]}'"
    return f", or a shipped scene: {', '.join(sorted(shipped_scenes()))}"


def to_toml(scene: Section) -> str:
    """Return the scene as TOML that reads back as the same scene; keys that were not given are comments."""
    lines = []
    for name, section in scene:
        if not isinstance(section, Section):
            line = f"{name} = {value_text(section, None)}"
            lines += [line if name in scene.model_fields_set else f"# {line}", ""]
            continue
        lines.append(f"[{name}]")
        for key, field in type(section).model_fields.items():
            value = getattr(section, key)
            line = f"{key}: absent" if value is None else f"{key} = {value_text(value, field_unit(field))}"
            lines.append(line if key in section.model_fields_set and value is not None else f"# {line}")
        lines.append("")
    return "\n".join(lines) + "\n"


def value_text(value: Any, unit: str | None) -> str:
    """Return a value as TOML; `unit` is the unit of numbers, or None."""
    value = value.spec if isinstance(value, UncertainValue) else value
    if isinstance(value, Section):
        fields, stated = type(value).model_fields, {key: x for key, x in value if key in value.model_fields_set}
        units = {key: unit if key in QUANTITY_KEYS else field_unit(fields[key]) for key in stated}
        return _inline_table({key: value_text(x, units[key]) for key, x in stated.items()})
    if isinstance(value, dict):
        return _inline_table({key: value_text(x, unit) for key, x in value.items()})
    if isinstance(value, tuple):
        return f"[{', '.join(value_text(x, unit) for x in value)}]"
    if isinstance(value, float) and unit:
        return f'"{format_exact(value, unit)}"'
    return json.dumps(value, ensure_ascii=False)


def _inline_table(items: dict[str, str]) -> str:
    keys = {key: key if re.fullmatch(r"[\w-]+", key) else json.dumps(key) for key in items}
    return f"{{{', '.join(f'{keys[key]} = {text}' for key, text in items.items())}}}"


def find_line(text: str, sentence: str) -> int | None:
    """Return the line of a scene file for a message such as "[drive] duty = 2: ...", or None."""
    match = re.match(r"\[(\w+)\](.*)", sentence)
    if match is None:
        return None
    section, lines = match[1], _key_lines(text)
    words = re.findall(r"[\w-]+", match[2])
    for index, word in enumerate(words):
        for path in lines:
            if path[0] == section and path[-1] == word and len(path) > 1:
                whole = (*path, *words[index + 1 : index + 2])
                return lines.get(whole, lines[path])
    return lines.get((section,))


def _key_lines(text: str) -> dict[tuple[str, ...], int]:
    """Return the first line of each table and key, by path."""
    lines: dict[tuple[str, ...], int] = {}
    table: tuple[str, ...] = ()
    for number, line in enumerate(text.splitlines(), 1):
        header, key = _HEADER.match(line), _KEY.match(line)
        if header:
            table = _split_key(header[1])
            lines.setdefault(table[:1], number)
            lines.setdefault(table, number)
        elif key:
            path = table + _split_key(key[1])
            for end in range(1, len(path) + 1):
                lines.setdefault(path[:end], number)
            for inner in _INLINE.finditer(line):
                lines.setdefault((*path, inner[1]), number)
    return lines


def _split_key(dotted: str) -> tuple[str, ...]:
    return tuple(part.strip(" \"'") for part in dotted.split("."))
