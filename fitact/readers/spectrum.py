"""Impedance spectra and frequency responses from the files of analysers, oscilloscopes and programs."""

import dataclasses
import itertools
import os
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from fitact.data.spectrum import MINIMUM_POINTS, ChannelName, Spectrum
from fitact.errors import InputError
from fitact.files import read_head
from fitact.readers.header import parse_number, split_cells
from fitact.readers.segments import select_segment
from fitact.readers.spice import find_ac_analyses, find_response, is_ac_analysis, read_ac_analyses
from fitact.readers.spreadsheet import is_spreadsheet, read_sheets
from fitact.units import PREFIX_FACTORS, format_engineering

_DELIMITERS = ("\t", ";", ",", " ")
_FREQUENCY = re.compile(r"^f(req|(?![a-z]))", re.IGNORECASE)
_REAL = re.compile(r"^-?(re\s*\(?z|z?\s*_?re(al)?\b|zre|z_re|z['’′])(?!['’′])", re.IGNORECASE)
_IMAGINARY = re.compile(r"^-?(im\s*\(?z|z?\s*_?im(ag(inary)?)?\b|zim|z_im|z['’′]{2}|z[\"”″])", re.IGNORECASE)
_RESISTANCE = re.compile(r"^(r|rs|resistance)(?![a-z])", re.IGNORECASE)  # in the words of LCR meters
_REACTANCE = re.compile(r"^-?(x|xs|reactance)(?![a-z])", re.IGNORECASE)
_MAGNITUDE = re.compile(
    r"^(\|z\||z\s*_?mod|abs\s*\(?z|z_abs|z_magnitude|magnitude|(z|impedance)\s*([(/\[]|$))", re.IGNORECASE
)
_GAIN = re.compile(r"^(?P<channel>.*?)\s*(magnitude|gain|amplitude(?=.*db)|\|h\||ratio)", re.IGNORECASE)
_PHASE = re.compile(r"^-?(?P<channel>.*?)\s*(phase|ph[zi]\b|theta|θ|arg\s*\(?z)", re.IGNORECASE)
_DECIBEL = re.compile(r"db", re.IGNORECASE)
_RATIO = re.compile(r"v\s*/\s*v|ratio|\|h\|", re.IGNORECASE)
_OHM = re.compile(r"[(/_\[\s]([kKMGm]?)\s*(?:(?i:ohms?)|Ω|Ω)")
_HERTZ = re.compile(r"[(/_\[\s]([kKM]?)(?i:hz)")
# pairs of an LCR meter, by the names of their columns
_LCR_NAMES = {
    name: re.compile(rf"^({pattern})(?![a-z])", re.IGNORECASE)
    for name, pattern in {
        "Cp": "c_?p", "Cs": "c_?s", "Lp": "l_?p", "Ls": "l_?s", "Rp": "r_?p", "Rs": "r_?s|esr",
        "G": "g_?p?|conductance", "B": "b_?p?|susceptance", "|Y|": r"\|y\||y|admittance",
        "D": "d|df|tan ?(δ|delta)|dissipation( factor)?", "Q": "q|quality( factor)?",
    }.items()
}  # fmt: skip
_LCR_UNIT = re.compile(r"[(/_\[\s]([fpnuµμmkMG]?)(?:[FHS]|Ω|Ω|(?i:ohms?|farad|henry|siemens))\b")
# omega (rad/s) and the two values, of which an angle is in radians times the imaginary unit, to impedance, ohm
_Pair = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
_LCR_PAIRS: dict[tuple[str, str], _Pair] = {
    ("Cp", "D"): lambda w, C, D: 1.0 / (w * C * (D + 1j)),
    ("Cp", "Q"): lambda w, C, Q: 1.0 / (w * C * (1.0 / Q + 1j)),
    ("Cp", "G"): lambda w, C, G: 1.0 / (G + 1j * w * C),
    ("Cp", "Rp"): lambda w, C, R: 1.0 / (1.0 / R + 1j * w * C),
    ("Cs", "D"): lambda w, C, D: (D - 1j) / (w * C),
    ("Cs", "Q"): lambda w, C, Q: (1.0 / Q - 1j) / (w * C),
    ("Cs", "Rs"): lambda w, C, R: R - 1j / (w * C),
    ("Lp", "D"): lambda w, L, D: w * L / (D - 1j),
    ("Lp", "Q"): lambda w, L, Q: w * L / (1.0 / Q - 1j),
    ("Lp", "G"): lambda w, L, G: 1.0 / (G - 1j / (w * L)),
    ("Lp", "Rp"): lambda w, L, R: 1.0 / (1.0 / R - 1j / (w * L)),
    ("Ls", "D"): lambda w, L, D: w * L * (D + 1j),
    ("Ls", "Q"): lambda w, L, Q: w * L * (1.0 / Q + 1j),
    ("Ls", "Rs"): lambda w, L, R: R + 1j * w * L,
    ("G", "B"): lambda w, G, B: 1.0 / (G + 1j * B),
    ("|Y|", "theta"): lambda w, Y, turn: np.exp(-turn) / Y,
}
_LATE_TABLES = re.compile(r"^(EXPLAIN|EC-Lab|<Application>|\"?ZPLOT|\"?Z60W|\0)")  # first lines of long headers

Rows = Float[np.ndarray, "points columns"]


class _Layout(NamedTuple):
    """Meaning of the columns of a table."""

    channel: ChannelName
    places: tuple[int, ...]  # columns that must be numbers
    convert: Callable[[Rows], tuple[np.ndarray, np.ndarray]]  # of these columns to frequency (Hz) and response
    doubt: str = ""  # why the table might be two things
    note: str = ""  # convention by which an impedance follows from the columns


class _Table(NamedTuple):
    """The header of a table, with how the rows below it are written."""

    end: int  # index of the first line below
    delimiter: str  # of the rows
    layout: _Layout


def is_spectrum(path: str | os.PathLike[str], head_size: int = 16_384, size: int = 2**22) -> bool:
    """Return whether a file holds a spectrum, by its layout; the numbers are bytes that are read."""
    try:
        if is_ac_analysis(Path(path)):
            return True
        content = _read_text(path, head_size)
        lines = _split_lines(content)
        lines = lines[:-1] if len(content) == head_size else lines
        if _LATE_TABLES.search(lines[0] if lines else ""):
            lines = _split_lines(_read_text(path, size))
        finders = _find_headers, find_ac_analyses, _find_listings, _find_blocks
        return any(True for find in finders for _ in find(lines))
    except InputError:
        return False


def read_spectrum(path: str | os.PathLike[str], segment: int | None = None, shunt: float | None = None) -> Spectrum:
    """Read one spectrum of a file, the only one or that with the number `segment`, from 1; see `read_spectra`.

    Raises:
        InputError: as `read_spectra`; also if the file holds different spectra and no number is given.
    """
    spectra = read_spectra(path, shunt)
    if segment is None and len({spectrum.fingerprint for spectrum in spectra}) == 1:
        return spectra[0]
    return spectra[select_segment(segment, len(spectra), os.fspath(path), "spectra")]


def read_spectra(path: str | os.PathLike[str], shunt: float | None = None) -> tuple[Spectrum, ...]:
    """Read all spectra of a file, by its layout and not by its suffix.

    The header of a table must name a frequency and an impedance (in parts, or as magnitude and phase), or a gain (dB)
    and a phase: of one channel over another, of Vsc over V. A leading minus in a column's name, as in -Im(Z)/Ohm,
    changes the sign. Three columns without a header are frequency, real and imaginary part. docs/spectra.md lists the
    layouts. With a `shunt` (ohm), a gain is that of the voltage over a resistor between the load and ground, over the
    voltage of both, and the spectrum is the load's impedance.

    Raises:
        InputError: the file cannot be read, or holds no spectrum; the message names the line and a remedy.
    """
    source, is_raw, spectra = os.fspath(path), is_ac_analysis(Path(path)), list[Spectrum]()
    lines = [] if is_raw else _split_lines(_read_text(path, 2**26))  # bytes, more than any spectrum has
    plots = read_ac_analyses(Path(path)) if is_raw else find_ac_analyses(lines)
    for rows, channel, note in (find_response(plot, source) for plot in plots):
        layout = _Layout(channel, (0, 1, 2), lambda x: (x[:, 0], x[:, 1] + 1j * x[:, 2]), note=note)
        spectra += _to_spectra(layout, rows, source, shunt)
    for header in [] if spectra else _find_headers(lines):
        if header.layout.doubt:
            raise InputError(f"{source}, line {header.end}: {header.layout.doubt}")
        spectra += _to_spectra(header.layout, np.array(list(_parse_rows(lines, header, source))), source, shunt)
    for find in (_find_listings, _find_blocks):
        for block in [] if spectra else find(lines):
            spectra += _to_spectra(_parts_layout((0, 1, 2), ("f", "Z'", "Z''")), block, source, shunt)
    if not spectra:
        raise InputError(
            f"{source}: no line names a frequency and an impedance or gain above rows of as many numbers; write a"
            " header such as frequency_Hz,Z_real_ohm,Z_imag_ohm"
        )
    return tuple(spectra)


def _read_text(path: str | os.PathLike[str], size: int) -> bytes:
    return b"\n\n".join(read_sheets(Path(path)))[:size] if is_spreadsheet(Path(path)) else read_head(path, size)


def _split_lines(content: bytes) -> list[str]:
    try:
        return content.decode("utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig").splitlines()
    except UnicodeDecodeError:
        return content.decode("latin-1").splitlines()


def _find_listings(lines: Sequence[str]) -> Iterator[Rows]:
    """Yield frequency, real and imaginary part of spectra that Ecochemie (.dfr) and Ivium (.idf, .ids) list."""
    if lines and re.match(r"VERSION\d", lines[0]):  # nine lines for each point: f, Z', -Z'', and others
        numbers = [parse_number(line, True) for line in lines[3:]]
        count = next((i for i, number in enumerate(numbers) if number is None), len(numbers)) // 9
        yield np.array(numbers[: 9 * count], dtype=float).reshape(-1, 9)[:, :3] * [1.0, 1.0, -1.0]
    for place, line in enumerate(lines):
        if line.strip() == "primary_data":  # the numbers of columns and points, then Z', Z'' and f of each point
            rows = [[parse_number(cell, True) for cell in split_cells(each, " ")] for each in lines[place + 3 :]]
            rows = list(itertools.takewhile(lambda row: len(row) == 3 and None not in row, rows))
            yield np.array(rows, dtype=float).reshape(-1, 3)[:, [2, 0, 1]]


def _find_headers(lines: Sequence[str]) -> Iterator[_Table]:
    """Yield the headers of tables, each with rows of as many numbers below it."""
    for place, line in enumerate(lines):
        text = re.sub(r"^\s*[#%;]*\s*(Definition=)?", "", line)
        if "req" not in text.lower() and not text.lower().startswith("f"):
            continue
        found = [_match_rows(lines, place + 1, names) for names in _split_names(text)]
        header = next((each for each in found if each is not None), None)
        if header is not None:
            yield header


def _split_names(text: str) -> Iterator[list[str]]:
    """Yield the possible lists of names in a header."""
    bare = text.strip()
    if bare[:1] == bare[-1:] == '"' and bare.count('"') == 2:
        bare = bare[1:-1].strip()
    for delimiter in (r"\t", ";", ",", r"\s{2,}", r"\s+"):
        yield [re.sub(r'^"(.*)"$', r"\1", name.strip()).strip() for name in re.split(delimiter, bare)]


def _match_rows(lines: Sequence[str], start: int, names: list[str], max_lines: int = 4) -> _Table | None:
    """Return the header with these names if one of the lines below has as many cells, with numbers where it should."""
    layout = _find_layout(names)
    if layout is None:
        return None
    while names and not names[-1].strip("0123456789"):  # VersaStudio's end in 0
        names = names[:-1]
    for line in lines[start : start + max_lines]:
        for delimiter in _DELIMITERS:
            cells = split_cells(line.strip("\r\n"), delimiter)
            while len(cells) > len(names) and not cells[-1]:
                cells = cells[:-1]
            if len(cells) == len(names) and None not in _parse_cells(cells, layout.places, delimiter):
                return _Table(start, delimiter, layout)
    return None


def _parse_cells(cells: Sequence[str], places: Sequence[int], delimiter: str) -> list[float | None]:
    """Return the numbers in some cells; where a comma does not separate them, it may be decimal."""
    return [parse_number(cells[i], delimiter != ",") if i < len(cells) else None for i in places]


def _parse_rows(lines: Sequence[str], header: _Table, source: str, max_lines: int = 4) -> Iterator[list[float]]:
    """Yield the rows of numbers below a header and lines of units."""
    begun = False
    for line, text in enumerate(lines[header.end :], header.end + 1):
        numbers = _parse_cells(split_cells(text, header.delimiter), header.layout.places, header.delimiter)
        values = [number for number in numbers if number is not None]
        if len(values) == len(numbers):
            begun = True
            yield values
        elif begun and text.strip() and text.lstrip()[0] in "0123456789+-.":
            raise InputError(f"{source}, line {line}: '{text.strip()[:40]}' is not a row of numbers; remove it")
        elif begun or line - header.end > max_lines:
            return  # the table has ended


def _find_blocks(lines: Sequence[str]) -> Iterator[Rows]:
    """Yield blocks of three numbers in each line, without names above, whose first sweeps like a frequency."""
    for delimiter in (each for each in _DELIMITERS if any(each in line for line in lines)):
        block: list[list[float]] = []
        above = 0  # cells of the line above the block
        for line in (*lines, ""):
            cells = split_cells(line, delimiter)
            numbers = [parse_number(cell, delimiter != ",") for cell in cells] if len(cells) == 3 else [None]
            if None not in numbers:
                block.append([number for number in numbers if number is not None])
                continue
            if len(block) >= MINIMUM_POINTS and above != 3 and is_swept(np.array(block)[:, 0]):
                yield np.array(block)
            block, above = [], len(cells)


def is_swept(frequency: np.ndarray, min_ratio: float = 3.0) -> bool:
    """Return whether positive numbers change by steps of very different size, as times do not."""
    steps = np.abs(np.diff(frequency))
    return bool(np.all(frequency > 0.0) and np.max(steps) > min_ratio * np.min(steps))


def _find_layout(names: list[str]) -> _Layout | None:
    """Return the meaning of the columns with these names, or None if they are no spectrum."""
    frequency, size = _find_name(_FREQUENCY, names), _find_name(_MAGNITUDE, names)
    phases = [i for i, name in enumerate(names) if _PHASE.search(name)]
    if frequency is None:
        return None
    # where a chip (AD5933) writes its registers beside them, real and imaginary part are counts of a converter
    is_polar = size is not None and bool(phases) and re.search(r"z|impedance", names[size], re.IGNORECASE)
    for patterns in ((_REAL, _IMAGINARY), (_RESISTANCE, _REACTANCE)):
        real, imaginary = (_find_name(pattern, names) for pattern in patterns)
        bare = real is not None and names[real].lower() in ("real", "re")
        if real is not None and imaginary is not None and not (bare and is_polar):
            return _parts_layout((frequency, real, imaginary), [names[i] for i in (frequency, real, imaginary)])
    if (pair := _pair_layout(names, frequency)) is not None:
        return pair
    if not phases:
        return None
    if size is not None and (is_polar or _OHM.search(names[size])):
        factor, turn, hertz = _find_factor(_OHM, names[size]), _find_turn(names[phases[0]]), _to_hertz(names[frequency])
        places = frequency, size, phases[0]
        return _Layout("impedance", places, lambda x: (hertz(x[:, 0]), factor * x[:, 1] * np.exp(turn * x[:, 2])))
    return _gain_layout(names, frequency, phases)


def _pair_layout(names: Sequence[str], frequency: int) -> _Layout | None:
    """Return the layout of a pair of an LCR meter, such as Cp and D or |Y| and theta, or None."""
    found = {name: place for name, pattern in _LCR_NAMES.items() if (place := _find_name(pattern, names)) is not None}
    hertz = _to_hertz(names[frequency])
    if (phase := _find_name(_PHASE, names)) is not None:
        found["theta"] = phase

    def factor(name: str) -> complex:
        column = names[found[name]]
        return _find_turn(column) if name == "theta" else _find_factor(_LCR_UNIT, column)

    for (first, second), impedance in _LCR_PAIRS.items():
        if first in found and second in found:
            factors = factor(first), factor(second)

            def convert(x: Rows, impedance: _Pair = impedance, factors: tuple[complex, complex] = factors) -> Any:
                f = hertz(x[:, 0])
                return f, impedance(2.0 * np.pi * f, factors[0] * x[:, 1], factors[1] * x[:, 2])

            places = frequency, found[first], found[second]
            return _Layout("impedance", places, convert, note=f"the impedance follows from {first} and {second}")
    return None


def _find_name(pattern: re.Pattern[str], names: Sequence[str]) -> int | None:
    return next((place for place, name in enumerate(names) if pattern.search(name)), None)


def _find_factor(pattern: re.Pattern[str], name: str) -> float:
    prefix = pattern.search(name)
    return PREFIX_FACTORS[prefix[1]] if prefix else 1.0


def _to_hertz(name: str) -> Callable[[np.ndarray], np.ndarray]:
    """Return the conversion of a column of frequencies to Hz; PicoScope's FRA writes their logarithms."""
    if re.search(r"\blog\b", name, re.IGNORECASE):
        return lambda x: 10.0**x
    factor = _find_factor(_HERTZ, name)
    return lambda x: factor * x


def _find_turn(name: str) -> complex:
    """Return the imaginary unit times the unit of a phase in radians, with its sign."""
    return (-1j if name.startswith("-") else 1j) * (1.0 if "rad" in name.lower() else np.pi / 180.0)


def _parts_layout(places: tuple[int, ...], names: Sequence[str]) -> _Layout:
    """Return the layout of real and imaginary part of an impedance."""
    hertz, ohm = _to_hertz(names[0]), _find_factor(_OHM, names[1])
    signs = [-1.0 if name.startswith("-") else 1.0 for name in names[1:]]
    return _Layout(
        "impedance", places, lambda x: (hertz(x[:, 0]), ohm * (signs[0] * x[:, 1] + 1j * signs[1] * x[:, 2]))
    )


def _gain_layout(names: Sequence[str], frequency: int, phases: Sequence[int]) -> _Layout | None:
    """Return the layout of the gain of one channel over another: one gain, or the magnitudes of two channels."""
    sizes = {i: match["channel"].strip().lower() for i, name in enumerate(names) if (match := _GAIN.search(name))}
    known = {i: channel for i, channel in sizes.items() if _DECIBEL.search(names[i]) or _RATIO.search(names[i])}
    if sizes and not known:
        doubt = (
            f"the column '{names[next(iter(sizes))]}' may be an impedance in ohm, or a gain in dB or as a ratio; write"
            " its unit in its name, such as |Z| (ohm), Gain (dB) or Gain (V/V)"
        )
        return _Layout("Vsc", (frequency,), lambda x: (x[:, 0], x[:, 0]), doubt)
    measured = [i for i, channel in known.items() if not channel.startswith("math")] or list(known)
    if not measured:
        return None
    by_channel = {match["channel"].strip().lower(): i for i in phases if (match := _PHASE.search(names[i]))}
    chosen = measured[:2]
    angles = [by_channel.get(known[i], phases[0] if len(chosen) == 1 else None) for i in chosen]
    columns = [frequency, *chosen, *(i for i in angles if i is not None)]
    hertz = _to_hertz(names[frequency])

    def respond(x: Rows, size: int, angle: int | None) -> np.ndarray:
        values = x[:, columns.index(size)]
        values = 10.0 ** (values / 20.0) if _DECIBEL.search(names[size]) else values
        return values if angle is None else values * np.exp(_find_turn(names[angle]) * x[:, columns.index(angle)])

    def convert(x: Rows) -> tuple[np.ndarray, np.ndarray]:
        responses = [respond(x, *pair) for pair in zip(chosen, angles, strict=True)]
        gain = responses[-1] / (responses[0] if len(responses) > 1 else 1.0)
        return hertz(x[:, 0]), np.asarray(gain, dtype=complex)

    return _Layout("Vsc", tuple(columns), convert)


def _to_spectra(layout: _Layout, rows: Rows, source: str, shunt: float | None) -> Iterator[Spectrum]:
    """Yield the sweeps of a table; rows at frequencies of 0 or less, in which nothing was measured, are left out."""
    if not rows.size:
        return
    with np.errstate(all="ignore"):  # what is not finite is refused below
        frequency, values = layout.convert(rows)
    kept = ~(frequency <= 0.0)
    left_out = f"{np.count_nonzero(~kept)} rows without a frequency are left out"
    notes = tuple(filter(None, ("" if kept.all() else left_out, layout.note)))
    for part in _split_sweeps(frequency[kept]):
        swept, response = frequency[kept][part], values[kept][part]
        if layout.channel == "impedance":
            yield Spectrum.from_arrays(swept, response, source, notes)
        else:
            gain = _orient_gain(swept, response, source, notes)
            yield gain if shunt is None else _gain_to_impedance(gain, shunt)


def _split_sweeps(frequency: np.ndarray) -> list[slice]:
    """Return the parts between jumps back against the direction of the sweep, if each has enough points."""
    steps = np.sign(np.diff(frequency))
    direction = np.sign(np.sum(steps)) or 1.0
    ends = [0, *(np.flatnonzero(steps == -direction) + 1).tolist(), frequency.size]
    parts = [slice(*pair) for pair in itertools.pairwise(ends)]
    return parts if all(part.stop - part.start >= MINIMUM_POINTS for part in parts) else [slice(0, frequency.size)]


def _orient_gain(
    frequency: np.ndarray, values: Complex[np.ndarray, " points"], source: str, notes: tuple[str, ...]
) -> Spectrum:
    """Return the gain, inverted if it is above 1."""
    warnings: tuple[str, ...] = ()
    if np.median(np.abs(values)) > 1.0:
        with np.errstate(all="ignore"):  # what is not finite is refused below
            values = 1.0 / values
        warnings = (
            f"{source}: the gain is above 1, which no circuit of resistors and capacitors gives, so the channels are"
            " exchanged; check which of them is V",
        )
    return Spectrum.from_arrays(frequency, values, source, notes, "Vsc", warnings)


def _gain_to_impedance(gain: Spectrum, shunt: float) -> Spectrum:
    note = f"the impedance follows from the gain over a shunt of {format_engineering(shunt, 'ohm')}"
    with np.errstate(all="ignore"):
        load = shunt * (1.0 / gain.values - 1.0)
    return dataclasses.replace(gain, values=load, channel="impedance", notes=(*gain.notes, note))
