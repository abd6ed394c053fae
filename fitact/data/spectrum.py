"""Impedance spectra (frequency and complex impedance) from text files of impedance analysers."""

import dataclasses
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from fitact.data.readers.header import parse_number, split_cells
from fitact.errors import InputError
from fitact.files import read_error
from fitact.units import PREFIX_FACTORS, format_engineering

MINIMUM_POINTS = 5
_FREQUENCY = re.compile(r"^f(req|(?![a-z]))", re.IGNORECASE)
_REAL = re.compile(r"^-?(re\s*\(?z|z?\s*_?re(al)?\b|zre|z_re|z')(?!')", re.IGNORECASE)
_IMAGINARY = re.compile(r"""^-?(im\s*\(?z|z?\s*_?im(ag)?\b|zim|z_im|z''|z")""", re.IGNORECASE)
_MAGNITUDE = re.compile(r"^(\|z\||z\s*_?mod|abs\s*\(?z|z_abs|z_magnitude|magnitude)", re.IGNORECASE)
_PHASE = re.compile(r"^(-?phase|z\s*_?ph(z|ase)?\b|theta|arg\s*\(?z)", re.IGNORECASE)
_OHM = re.compile(r"[(/_\[\s]([kKMGm]?)\s*(?:(?i:ohms?)|Ω|Ω)")
_HERTZ = re.compile(r"[(/_\[\s]([kKM]?)(?i:hz)")


@dataclasses.dataclass(frozen=True)
class Spectrum:
    """Impedance V / I of finger and panel, between the drive electrode and ground.

    Attributes:
        frequency: increasing frequencies, Hz.
        impedance: complex impedance, ohm; a capacitance has a negative imaginary part.
        source: origin of the data, for messages.
        notes: assumptions, as sentences.
    """

    frequency: Float[np.ndarray, " points"]
    impedance: Complex[np.ndarray, " points"]
    source: str = "spectrum"
    notes: tuple[str, ...] = ()

    @classmethod
    def from_arrays(
        cls,
        frequency: Float[np.ndarray, " points"],
        impedance: Complex[np.ndarray, " points"],
        source: str = "spectrum",
        notes: tuple[str, ...] = (),
    ) -> "Spectrum":
        """Make a spectrum from arrays of equal length (Hz, ohm; any order) after checks.

        Raises:
            InputError: the points are too few or not finite, a frequency is not positive or occurs twice, or the
                impedance is zero or inductive.
        """
        f, z = np.array(frequency, dtype=float), np.array(impedance, dtype=complex)
        if f.ndim != 1 or f.shape != z.shape:
            raise InputError(f"{source}: frequency has shape {f.shape}, impedance {z.shape}; give equal shapes")
        if f.size < MINIMUM_POINTS:
            raise InputError(f"{source}: {f.size} points are too few to fit; measure {MINIMUM_POINTS} or more")
        if not (np.isfinite(f).all() and np.isfinite(z).all()):
            raise InputError(f"{source}: holds values that are not finite; remove those points")
        order = np.argsort(f)
        f, z = f[order], z[order]
        if f[0] <= 0.0:
            raise InputError(f"{source}: holds the frequency {f[0]:g} Hz; remove points at 0 Hz and below")
        if np.any(np.diff(f) == 0.0):
            raise InputError(
                f"{source}: {f[:-1][np.diff(f) == 0.0][0]:g} Hz occurs twice; keep one sweep, or average the sweeps"
            )
        if np.any(np.abs(z) == 0.0):
            raise InputError(f"{source}: the impedance is 0 at {f[np.abs(z) == 0.0][0]:g} Hz; remove that point")
        if np.mean(z.imag > 0.0) > 0.5:
            raise InputError(
                f"{source}: the imaginary part is positive (inductive), but a finger's is negative; begin the name of a"
                " column of -Im Z with a minus, e.g. -Z_imag_ohm"
            )
        for array in (f, z):
            array.flags.writeable = False
        return cls(f, z, source, notes)

    def __len__(self) -> int:
        return self.frequency.size

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON output of `fitact inspect`, in Hz and ohm."""
        size = np.abs(self.impedance)
        return {
            "source": self.source,
            "format": "impedance spectrum",
            "channels": [{"name": "impedance", "unit": "ohm", "min": float(size.min()), "max": float(size.max())}],
            "points": len(self),
            "frequency_min": float(self.frequency[0]),
            "frequency_max": float(self.frequency[-1]),
            "notes": list(self.notes),
        }

    def __str__(self) -> str:
        low, high = (format_engineering(float(f), "Hz") for f in self.frequency[[0, -1]])
        small, large = (format_engineering(float(z), "ohm") for z in np.sort(np.abs(self.impedance))[[0, -1]])
        return f"{self.source} (impedance spectrum): {len(self)} points, {low} to {high}, |Z| {small} to {large}"


class _Columns(NamedTuple):
    """Indices of the columns; `second` holds the imaginary part or the phase."""

    frequency: int
    first: int
    second: int
    hertz: float
    ohm: float
    sign: float  # sign of `second`
    radian: float  # size of the unit of the phase, rad; 0 means that the columns hold real and imaginary part


def is_spectrum(path: str | os.PathLike[str]) -> bool:
    """Return whether a file's header names a frequency and an impedance."""
    try:
        return next(_find_headers(_read_lines(path, 16_384)), None) is not None  # more bytes than any header has
    except OSError:
        return False


def read_spectrum(path: str | os.PathLike[str]) -> Spectrum:
    """Read an impedance spectrum: a CSV file with frequency_Hz, Z_real_ohm and Z_imag_ohm, or an analyser's text.

    The header of the table must name a frequency and an impedance, in parts or as magnitude and phase. Examples are
    files of Gamry (.DTA), BioLogic (.mpt), Autolab, ZPlot (.z), VersaStudio (.par) and CH Instruments. A leading
    minus in a column's name, as in -Im(Z)/Ohm, changes the sign. Three columns without a header are read as
    frequency, real and imaginary part.

    Raises:
        InputError: the file cannot be read, or holds no spectrum; the message names the line and a remedy.
    """
    source = os.fspath(path)
    try:
        lines = _read_lines(path, 2**26)  # bytes, more than any spectrum has
    except OSError as error:
        raise read_error(source, error) from error
    place, delimiter, columns = next(_find_headers(lines), None) or _headerless_columns(lines, source)
    rows = np.array(list(_parse_rows(lines, place, delimiter, columns, source))).reshape(-1, 3)
    first, second = columns.ohm * rows[:, 1], columns.sign * rows[:, 2]
    z = first * np.exp(1j * columns.radian * second) if columns.radian else first + 1j * columns.ohm * second
    return Spectrum.from_arrays(columns.hertz * rows[:, 0], z, source)


def _read_lines(path: str | os.PathLike[str], size: int) -> list[str]:
    with Path(path).open("rb") as file:
        content = file.read(size)
    try:
        return content.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        return content.decode("latin-1").splitlines()


def _find_headers(lines: list[str]) -> Iterator[tuple[int, str, _Columns]]:
    """Yield each header line as (index of the next line, delimiter, columns)."""
    for place, line in enumerate(lines):
        if "req" not in line.lower() and not line.lower().startswith("f"):
            continue
        for delimiter in ("\t", ";", ",", " "):
            columns = _find_columns(_split_names(line, delimiter))
            if columns is not None:
                yield place + 1, delimiter, columns
                break


def _split_names(line: str, delimiter: str) -> list[str]:
    names = re.split(r"\s{2,}", line.strip()) if delimiter == " " else line.split(delimiter)
    return [name.strip().strip('"#').strip() for name in names]


def _find_columns(names: list[str]) -> _Columns | None:
    def find_first(pattern: re.Pattern[str]) -> int | None:
        return next((place for place, name in enumerate(names) if pattern.search(name)), None)

    def find_factor(pattern: re.Pattern[str], name: str) -> float:
        prefix = pattern.search(name)
        return PREFIX_FACTORS[prefix[1]] if prefix else 1.0

    frequency, first, second, radian = find_first(_FREQUENCY), find_first(_REAL), find_first(_IMAGINARY), 0.0
    if first is None or second is None:
        first, second = find_first(_MAGNITUDE), find_first(_PHASE)
        radian = 1.0 if second is not None and "rad" in names[second].lower() else np.pi / 180.0
    if frequency is None or first is None or second is None:
        return None
    hertz, ohm = find_factor(_HERTZ, names[frequency]), find_factor(_OHM, names[first])
    return _Columns(frequency, first, second, hertz, ohm, -1.0 if names[second].startswith("-") else 1.0, radian)


def _headerless_columns(lines: list[str], source: str) -> tuple[int, str, _Columns]:
    first = next((line for line in lines if line.strip() and not line.startswith("#")), "")
    for delimiter in ("\t", ";", ",", " "):
        cells = split_cells(first, delimiter)
        if len(cells) == 3 and all(parse_number(cell, delimiter != ",") is not None for cell in cells):
            return 0, delimiter, _Columns(0, 1, 2, 1.0, 1.0, 1.0, 0.0)
    raise InputError(
        f"{source}: no line names a frequency and an impedance; write a header such as"
        " frequency_Hz,Z_real_ohm,Z_imag_ohm"
    )


def _parse_rows(
    lines: list[str], place: int, delimiter: str, columns: _Columns, source: str, max_unit_lines: int = 2
) -> Iterator[tuple[float, ...]]:
    """Yield the rows of numbers below the header and the lines of units."""
    begun, comma = False, delimiter in ("\t", ";")
    for line, text in enumerate(lines[place:], place + 1):
        # names separated by blanks may precede numbers with another delimiter
        cells = re.split(r"[\s,;]+", text.strip()) if delimiter == " " else split_cells(text, delimiter)
        places = columns.frequency, columns.first, columns.second
        numbers = [parse_number(cells[i], comma) if i < len(cells) else None for i in places]
        if None not in numbers:
            begun = True
            yield tuple(number or 0.0 for number in numbers)
        elif begun and (not text.strip() or text.lstrip()[0] not in "0123456789+-."):
            return  # the table has ended
        elif begun or line - place > max_unit_lines + 1:
            raise InputError(f"{source}, line {line}: '{text.strip()[:40]}' is not a row of numbers; remove it")
