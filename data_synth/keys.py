"""Tables of the keys in a file, with units and defaults, and their validation."""

import difflib
import functools
import math
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from data_synth.errors import RecipeError


class Quantity(NamedTuple):
    """Number in an SI unit ("" for a ratio), above `low`, or at least `low` with `least`."""

    unit: str
    default: float | None = None
    low: float = 0.0
    least: bool = False


class Choice(NamedTuple):
    """One of several values; the first is the default."""

    options: tuple[Any, ...]


class ListKey(NamedTuple):
    """List of quantities or choices."""

    of: Quantity | Choice
    default: tuple[Any, ...] | None = None


class WholeNumber(NamedTuple):
    """Whole number."""

    default: int | None
    least: int = 0


class IgnoredKey(NamedTuple):
    """Known key without effect on a record."""


Key = Quantity | Choice | ListKey | WholeNumber | IgnoredKey
Table = Mapping[str, Mapping[str, Key]]


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file.

    Raises:
        RecipeError: the file cannot be read.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise RecipeError(f"{path}: cannot be read as TOML ({reason}); check the path and the file") from error


def validate_sections(content: Mapping[str, Any], table: Table, place: str) -> dict[str, dict[str, Any]]:
    """Return sections with every key of `table`, in SI units; `place` names the file.

    Raises:
        RecipeError: an unknown section or key, or an invalid value.
    """
    for section, given in content.items():
        if section not in table:
            raise RecipeError(f"{place}: [{section}] is not a section; {_suggest_name(section, list(table))}")
        if not isinstance(given, dict):
            raise RecipeError(f"{place}: [{section}] is not a table; write its keys under [{section}]")
        for key in given:
            if key not in table[section]:
                raise RecipeError(
                    f"{place}: [{section}] {key} is not a key; {_suggest_name(key, list(table[section]))}"
                )
    return {
        section: {
            name: validate_value(content[section][name], key, f"{place}: [{section}] {name}")
            if name in content.get(section, {})
            else default_value(key)
            for name, key in keys.items()
        }
        for section, keys in table.items()
    }


def default_value(key: Key) -> Any:
    """Return the default of a key."""
    if isinstance(key, Choice):
        return key.options[0]
    return None if isinstance(key, IgnoredKey) else key.default


def validate_value(given: Any, key: Key, place: str) -> Any:
    """Return one value in SI units after checking it."""
    if isinstance(key, IgnoredKey):
        return given
    if isinstance(key, ListKey):
        if not isinstance(given, list) or not given:
            raise RecipeError(f"{place} = {given!r} is not a list; write one in brackets")
        return tuple(validate_value(each, key.of, place) for each in given)
    if isinstance(key, Choice):
        if given not in key.options:
            raise RecipeError(f"{place} = {given!r} is not a choice; write one of {', '.join(map(repr, key.options))}")
        return given
    if isinstance(key, WholeNumber):
        if isinstance(given, bool) or not isinstance(given, int) or given < key.least:
            raise RecipeError(f"{place} = {given!r}; write a whole number of at least {key.least}")
        return given
    found = parse_quantity(given, key.unit, place)
    if found < key.low or (found == key.low and not key.least):
        raise RecipeError(f"{place} = {given!r} must be {'at least' if key.least else 'above'} {key.low:g}")
    return found


@functools.cache
def _registry() -> Any:
    import pint  # imported only if there is text to parse, because it is slow

    registry = pint.UnitRegistry()
    registry.define("@alias ohm = Ohm = OHM = ohms")
    return registry


def parse_quantity(given: Any, unit: str, place: str) -> float:
    """Convert text such as "160 kohm", or a bare number in SI, to a float in the SI unit `unit`.

    Raises:
        RecipeError: no number, another dimension, or not finite.
    """
    try:
        if isinstance(given, bool):
            raise ValueError
        found = float(_registry().Quantity(given).to(unit).magnitude) if isinstance(given, str) else float(given)
    except Exception as error:  # pint raises a dozen kinds of errors, including tokenize errors
        raise RecipeError(f"{place} = {given!r} is not a number with the unit {unit or '1'}; write one") from error
    if not math.isfinite(found):
        raise RecipeError(f"{place} = {given!r} is not finite; write a number")
    return float(f"{found:.15g}")


def _suggest_name(word: str, known: list[str]) -> str:
    near = difflib.get_close_matches(word, known, n=1)
    return (f"did you mean '{near[0]}'? " if near else "") + f"known: {', '.join(known)}"
