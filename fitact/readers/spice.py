"""Raw files of LTspice, ngspice and other simulators: transient analyses as records, AC analyses as spectra.

A header of `key: value` lines and the list of variables is followed by the values, as text or as numbers: doubles, or,
as LTspice writes real values beside the time, single precision. LTspice's header is UTF-16, and may state that each
variable is stored by itself (fastaccess). The library that reads these files, spicelib, is under the GPL.
"""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fitact.data.spectrum import ChannelName
from fitact.errors import InputError
from fitact.files import read_head
from fitact.readers.capture import Capture, FileChannel, Pick
from fitact.readers.header import parse_number
from fitact.readers.segments import select_segment, split_time, take_part

_BEGIN = re.compile(rb"Title:[^\n]*\nDate:[^\n]*\n(?:[^\n]*\n)?Plotname:")
_WIDE = b"T\0i\0t\0l\0e\0:\0"  # UTF-16
_UNITS = {"voltage": "V", "current": "A", "device_current": "A", "subckt_current": "A"}


class Plot(NamedTuple):
    """One analysis: names and kinds of its variables, the first of which is the time or frequency, and their values."""

    names: list[str]
    kinds: list[str]
    values: np.ndarray  # points by variables, real or complex
    start: float  # of the time, s

    @property
    def axis(self) -> str:
        return self.names[0].lower()


def is_spice(head: bytes) -> bool:
    return head.startswith(_WIDE) or _BEGIN.match(head) is not None


def is_ac_analysis(path: Path) -> bool:
    """Return whether a file is a raw file of AC analyses and of no transient analysis."""
    head = read_head(path)
    if not is_spice(head):
        return False
    text = head.replace(b"\0", b"") if head.startswith(_WIDE) else path.read_bytes()
    names = {name[:2].upper() for name in re.findall(rb"\nPlotname:\s*([^\n]*)", text)}
    return b"AC" in names and b"TR" not in names


def read_spice(path: Path, source: str, pick: Pick, segment: int | None = None) -> Capture:
    """Return the variables of a transient analysis that `pick` selects; `segment` chooses a step or an analysis.

    Raises:
        InputError: the file is damaged, or holds no transient analysis, or several and no `segment` is given.
    """
    plots = [plot for plot in _read_plots(path) if plot.axis == "time"]
    if not plots:
        raise InputError(f"{source}: holds no transient analysis; run one (.tran), and keep its raw file")
    runs = [(plot, part) for plot in plots for part in split_time(np.abs(plot.values[:, 0].real))]
    plot, part = runs[select_segment(segment, len(runs), source)]
    return take_part(_make_capture(plot, source, pick), part)


def _make_capture(plot: Plot, source: str, pick: Pick) -> Capture:
    names = plot.names[1:]
    wanted = set(pick(names, ""))
    # LTspice marks the points that are to be kept by the sign of their time
    time = np.abs(plot.values[:, 0].real) + plot.start
    units = [_UNITS.get(kind, "") for kind in plot.kinds[1:]]
    channels = tuple(
        FileChannel(name, plot.values[:, i].real.astype(float), units[i - 1], units[i - 1])
        for i, name in enumerate(names, 1)
        if name in wanted
    )
    unread = tuple(name for name in names if name not in wanted)
    return Capture(source, "SPICE raw file", time, channels, unread_columns=unread)


def read_ac_analyses(path: Path) -> list[Plot]:
    return [plot for plot in _read_plots(path) if plot.axis == "frequency"]


def find_ac_analyses(lines: Sequence[str]) -> Iterator[Plot]:
    """Yield the AC analysis of a text by LTspice, or by wrdata of ngspice with wr_vecnames, with steps below it."""
    names = lines[0].split() if lines else []
    pairs = [i for i in range(1, len(names) - 1) if names[i] == names[i + 1] != names[i - 1]]  # real, imaginary part
    if names[:1] == ["Freq."]:
        names, pairs = lines[0].strip().split("\t"), []
    elif names[:1] != ["frequency"] or not pairs:
        return
    rows = []
    for line in lines[1:]:
        if not line.strip() or line == lines[0] or line.startswith("Step Information:"):
            continue
        cells = line.split() if pairs else line.strip().split("\t")
        numbers = [
            parse_number(cell, False) if pairs or not i else _parse_complex(cell) for i, cell in enumerate(cells)
        ]
        if len(numbers) != len(names) or None in numbers:
            return
        values = np.array(numbers, dtype=complex)
        rows.append([values[0], *(values[i] + 1j * values[i + 1] for i in pairs)] if pairs else values)
    names = [names[0], *(names[i] for i in pairs)] if pairs else names
    kinds = ["device_current" if re.match(r"[Ii][a-z]?\(", name) else "voltage" for name in names]
    yield Plot(names, kinds, np.array(rows, dtype=complex).reshape(-1, len(names)), 0.0)


def _parse_complex(cell: str) -> complex | None:
    """Return a number that LTspice writes as (1.0dB,2.0°), or as its real and imaginary part."""
    number = r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)"
    if match := re.fullmatch(rf"\({number}dB,{number}\S*\)", cell):
        decibels, degrees = map(float, match.groups())
        return complex(10.0 ** (decibels / 20.0) * np.exp(1j * np.pi / 180.0 * degrees))
    match = re.fullmatch(f"{number},{number}", cell)
    return complex(*map(float, match.groups())) if match else None


def find_response(plot: Plot, source: str) -> tuple[np.ndarray, ChannelName, str]:
    """Return frequency, real and imaginary part (columns) of an AC analysis, whether it is a gain, and a note.

    The drive is the voltage that is the same at all frequencies, or else a source of 1 V. The response is the voltage
    of a node named vsc or skin, the impedance at the only voltage source, or the only other voltage.

    Raises:
        InputError: none of these is there.
    """
    frequency, columns = plot.values[:, 0].real, dict(zip(plot.names[1:], plot.values[:, 1:].T, strict=True))
    kinds = dict(zip(plot.names, plot.kinds, strict=True))
    voltages = {name: each for name, each in columns.items() if kinds[name] == "voltage"}
    constant = [name for name, each in voltages.items() if np.max(np.abs(each - each[0])) <= 1e-6 * np.abs(each[0])]
    constant = [name for name in constant if voltages[name][0] != 0.0]
    drive, below = (voltages[constant[0]], constant[0]) if len(constant) == 1 else (1.0, "a source of 1 V")
    others = [name for name in voltages if name not in constant]
    sources = [name for name in columns if re.fullmatch(r"i\(v[^)]*\)|v\w*#branch", name, re.IGNORECASE)]
    skin = [name for name in others if re.fullmatch(r"(?:v\()?(?:vsc|skin)\)?", name, re.IGNORECASE)]
    kind: ChannelName = "impedance" if not skin and len(sources) == 1 else "Vsc"
    with np.errstate(all="ignore"):  # what is not finite is refused later
        if kind == "impedance":
            values, note = -drive / columns[sources[0]], f"the impedance is {below} over the current -{sources[0]}"
        elif len(skin or others) == 1:
            name = (skin or others)[0]
            values, note = voltages[name] / drive, f"the gain is {name} over {below}"
        else:
            raise InputError(
                f"{source}: which of the voltages {', '.join(others)[:200] or 'is'} is that of the skin is not guessed;"
                " name its node vsc, or save only the drive, this voltage and the current of the source"
            )
    return np.column_stack([frequency, values.real, values.imag]), kind, note


def _read_plots(path: Path) -> list[Plot]:
    source, content = str(path), path.read_bytes()
    plots: list[Plot] = []
    try:
        while content.strip(b"\r\n\0 ") and (not plots or is_spice(content)):
            plot, content = _read_plot(content)
            plots.append(plot)
    except (ValueError, IndexError, KeyError, TypeError) as error:
        reason = " ".join(str(error).split())[:120]
        raise InputError(f"{source}: cannot be read ({reason}); simulate again, or export text") from error
    return plots


def _read_plot(content: bytes) -> tuple[Plot, bytes]:
    """Return the first plot, and what follows it; raise ValueError for damage."""
    encoding = "utf-16-le" if content.startswith(_WIDE) else "latin-1"
    marks = {kind: content.find(f"\n{kind}:".encode(encoding)) for kind in ("Binary", "Values")}
    kind = min((kind for kind in marks if marks[kind] > 0), key=lambda kind: marks[kind], default="")
    if not kind:
        raise ValueError("no values follow the header")
    header, _, listed = content[: marks[kind]].decode(encoding).partition("\nVariables:")
    keys = {key.strip().lower(): text.strip() for key, _, text in (line.partition(":") for line in header.split("\n"))}
    variables = [line.split() for line in listed.split("\n") if line.strip()]
    count, points = int(keys["no. variables"]), int(keys["no. points"])
    flags = keys.get("flags", "").lower().split()
    if count != len(variables) or not count or points < 1:
        raise ValueError(f"the header states {count} variables and {points} points, and lists {len(variables)} names")
    names, kinds = [line[1] for line in variables], [line[2].lower() for line in variables]
    start = marks[kind] + len(f"\n{kind}:".encode(encoding))
    body = content[content.index("\n".encode(encoding), start) + len("\n".encode(encoding)) :]
    if kind == "Binary":
        values, rest = _parse_binary(body, points, count, "complex" in flags, "fastaccess" in flags)
    else:
        values, rest = _parse_text(body, points, count, encoding)
    return Plot(names, kinds, values, float(keys.get("offset", 0.0))), rest


def _parse_binary(
    body: bytes, points: int, count: int, is_complex: bool, by_variable: bool
) -> tuple[np.ndarray, bytes]:
    """Return the values; their type is that by which the file ends, or another plot begins, behind them."""
    kind = "<c16" if is_complex else "<f8"
    for first, others in ((kind, kind), ("<f8", "<f4"), ("<f8", kind)):
        row = np.dtype([("axis", first), ("others", others, (count - 1,))])
        rest = body[points * row.itemsize :]
        if len(body) >= points * row.itemsize and (not rest.strip(b"\r\n\0 ") or is_spice(rest)):
            break
    else:
        raise ValueError(f"{points} points of {count} variables do not fill {len(body)} bytes, so it is truncated")
    if by_variable:
        axis = np.frombuffer(body, first, points)
        columns = np.frombuffer(body, others, points * (count - 1), axis.nbytes).reshape(count - 1, points).T
    else:
        rows = np.frombuffer(body, row, points)
        axis, columns = rows["axis"], rows["others"]
    return np.column_stack([axis, columns]), rest


def _parse_text(body: bytes, points: int, count: int, encoding: str) -> tuple[np.ndarray, bytes]:
    """Return the values of points that are written as a number of the point and a line for each variable."""
    end = body.find("\nTitle:".encode(encoding))
    text, rest = (body, b"") if end < 0 else (body[:end], body[end + len("\n".encode(encoding)) :])
    cells = text.decode(encoding).split()
    if len(cells) != points * (count + 1):
        raise ValueError(f"{points} points of {count} variables, but {len(cells)} numbers follow")
    table = np.array([complex(*map(float, cell.split(","))) for cell in cells]).reshape(points, count + 1)
    if np.any(table[:, 0] != np.arange(points)):
        raise ValueError("the points are not numbered from 0")
    return table[:, 1:] if np.any(table.imag) else table[:, 1:].real, rest
