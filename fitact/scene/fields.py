"""Keys of a scene file for a form: unit, default, choices, and the meaning from the page docs/scene.md."""

import importlib.resources
import itertools
import re
from typing import Any, Literal, get_args, get_origin

from fitact.scene.scene import Scene
from fitact.scene.section import Section, field_unit
from fitact.scene.toml import value_text

_MEANINGS = {  # of the keys before the first section, which the page describes in its text
    ("", "description"): "text for people; results repeat it as a note",
    ("", "calibration"): "records of dummy circuits, with absolute paths: `[{record = ..., circuit = ...}]`",
}


def describe_fields() -> list[dict[str, Any]]:
    """Return `section` ("" before the first), `about`, `key`, `unit`, `default`, `choices` and `meaning` of every key.

    `about` says what the section holds. Default and choices are TOML; the default is "" for a key that is absent.
    """
    meanings = _MEANINGS | _read_meanings()
    scene, fields = Scene(), []
    for name, value in scene:
        section = value if isinstance(value, Section) else None
        for key, field in type(section or scene).model_fields.items():
            if section is None and key != name:
                continue
            default, unit = getattr(section or scene, key), field_unit(field)
            fields.append(
                {
                    "section": name if section else "",
                    "about": (section.__doc__ or "").partition("\n")[0] if section else "",
                    "key": key,
                    "unit": unit or "",
                    "default": "" if default is None else value_text(default, unit),
                    "choices": _choices(field.annotation),
                    "meaning": meanings[name if section else "", key],
                }
            )
    return fields


def _choices(annotation: Any) -> list[str]:
    """Return the possible values of a key with few of them, as TOML; [] for any other key."""
    if annotation is bool:
        return ["true", "false"]
    if get_origin(annotation) is Literal:
        return [value_text(value, None) for value in get_args(annotation)]
    if get_origin(annotation) is tuple and get_origin(get_args(annotation)[0]) is Literal:
        names = get_args(get_args(annotation)[0])
        subsets = (subset for size in range(1, len(names) + 1) for subset in itertools.combinations(names, size))
        return [value_text(subset, None) for subset in subsets]
    return []


def _read_meanings() -> dict[tuple[str, str], str]:
    """Return the meaning of each section and key, with links as text."""
    page = (importlib.resources.files("fitact.scene") / "scene.md").read_text(encoding="utf-8")
    found, section = {}, ""
    for line in re.sub(r"\[([^\]]+)\]\([^)]*\)", r"\1", page).splitlines():
        if header := re.fullmatch(r"## \[(\w+)\]", line):
            section = header[1]
        elif line.startswith("| `") and section:
            key, _, _, meaning = (cell.strip() for cell in line.strip("|").split(" | ", 3))
            found[section, key.strip("`")] = meaning
    return found
