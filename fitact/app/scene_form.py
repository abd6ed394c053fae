"""Scene as the texts of a form, and back: a field holds a TOML value, and text needs no quotes."""

import json
import re
import tomllib
from collections.abc import Iterable, Mapping
from typing import Any

Fields = Iterable[Mapping[str, Any]]  # of `fitact.scene.fields.describe_fields`


def field_name(field: Mapping[str, Any]) -> str:
    """Return the name of a field in the form, e.g. "scene.drive.waveform"."""
    return f"scene.{field['section']}.{field['key']}"


def read_values(text: str) -> dict[str, str]:
    """Return the stated values of a scene as `fitact scene` prints it, by the name of the field."""
    values, section = {}, ""
    for line in text.splitlines():
        if header := re.fullmatch(r"\[(\w+)\]", line):
            section = header[1]
        elif stated := re.fullmatch(r"(\w+) = (.*)", line):
            values[f"scene.{section}.{stated[1]}"] = display_value(stated[2])
    return values


def write_scene(values: Mapping[str, str], fields: Fields) -> str:
    """Return the text of a scene file with the values of a form; "" if nothing is stated."""
    sections: dict[str, list[str]] = {}
    for field in fields:
        if value := values.get(field_name(field), "").strip():
            sections.setdefault(field["section"], []).append(f"{field['key']} = {_toml_value(value)}")
    parts = [[f"[{name}]"] * bool(name) + lines for name, lines in sections.items()]
    return "\n\n".join("\n".join(lines) for lines in parts) + "\n" * bool(parts)


def display_value(value: str) -> str:
    """Return a TOML value without quotes where these are not needed in a form."""
    plain = json.loads(value) if value.startswith('"') else value
    return plain if _toml_value(plain) == value else value


def _toml_value(text: str) -> str:
    """Return the text if it is one TOML value, otherwise the text as a TOML string."""
    text = "".join(character if character.isprintable() else " " for character in text)
    try:
        if set(tomllib.loads(f"x = {text}")) == {"x"}:
            return text
    except tomllib.TOMLDecodeError:
        pass
    return json.dumps(text, ensure_ascii=False)


def locate_error(sentence: str, fields: Fields) -> str:
    """Return the name of the field that a refusal of a scene is about, or "scene"."""
    if place := re.search(r"\[(\w+)\](.*)", sentence):
        names = {field["key"]: field_name(field) for field in fields if field["section"] == place[1]}
        for word in re.findall(r"\w+", place[2]):
            if word in names:
                return names[word]
    return "scene"
