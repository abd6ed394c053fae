"""Handling of each kind of bad input; test_refusals.py reads the sentences of those that a reader refuses."""

import functools
import gzip
import io
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import fitact
from tests.conftest import square_record

PERIODS, PER_PERIOD = 20, 200
Table = dict[str, np.ndarray]  # columns by name in the header


@functools.cache
def make_table() -> Table:
    """Return 0.2 s of a 360 Vpp square at 100 Hz and its skin voltage, with finite edges and noise."""
    record = square_record(periods=PERIODS, per_period=PER_PERIOD)
    rng = np.random.default_rng(5)
    return {
        "time_s": record.time,
        "V_V": record["V"] + rng.normal(scale=0.3, size=len(record)),
        "Vsc_V": np.array(record["Vsc"]),
    }


def text_of(table: Table, digits: str = "%.9g", delimiter: str = ",") -> str:
    width = max(values.size for values in table.values())
    columns = [[digits % x for x in values] + [""] * (width - values.size) for values in table.values()]
    rows = (delimiter.join(row) for row in zip(*columns, strict=True))
    return "\n".join([delimiter.join(table), *rows]) + "\n"


# ---- functions that damage a file: a text, or bytes, from the valid table


def rename(**names: str) -> Callable[[Table], str]:
    return lambda table: text_of({names.get(name, name): values for name, values in table.items()})


def put(column: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Table], str]:
    return lambda table: text_of({**table, column: change(table[column].copy())})


def at(row: int, value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(values: np.ndarray) -> np.ndarray:
        values[row] = value
        return values

    return change


def rows(pick: Callable[[int], np.ndarray]) -> Callable[[Table], str]:
    return lambda table: text_of({name: values[pick(values.size)] for name, values in table.items()})


def lines(change: Callable[[list[str]], list[str]]) -> Callable[[Table], str]:
    return lambda table: "\n".join(change(text_of(table).splitlines()))


def line(number: int, change: Callable[[str], str]) -> Callable[[Table], str]:
    return lines(lambda all_: [*all_[: number - 1], change(all_[number - 1]), *all_[number:]])


def emptied(row: str) -> str:
    return row.partition(",")[0] + ",,"


def above(header: str) -> Callable[[Table], str]:
    return lambda table: header + text_of(table)


def adding(column: str, wave: Callable[[np.ndarray], np.ndarray]) -> Callable[[Table], str]:
    return lambda table: text_of({**table, column: table[column] + wave(table["time_s"])})


def headed(header: str, scale: float = 1.0) -> Callable[[Table], str]:
    """Return the table with another header and scaled values."""
    return lambda table: "\n".join([header, *text_of({n: scale * v for n, v in table.items()}).splitlines()[1:]])


def float32(table: Table) -> str:
    time = (table["time_s"] + 0.05).astype(np.float32).astype(float)
    return text_of({**table, "time_s": time}, digits="%.12g")


def bare(content: bytes) -> Callable[[Table], bytes]:
    return lambda table: content


def as_npz(table: Table) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, time=table["time_s"], V=table["V_V"], Vsc=table["Vsc_V"][:-7])
    return stream.getvalue()


ALL = {"channels": {"V": "CH1", "Vsc": "CH2"}}
SCENE = {"drive": {"waveform": "square", "peak_to_peak": "360 V", "frequency": "100 Hz"}}

# kind: verdict, function that makes the file, words of the sentence, and options
KINDS: dict[str, tuple] = {
    # the file
    "missing file": ("refused", None, "no such file"),
    "directory": ("refused", None, "is a directory"),
    "empty file": ("refused", bare(b""), "holds no data"),
    "blank lines only": ("refused", bare(b"\n\n \n"), "holds no data"),
    "binary of no known kind": ("refused", bare(bytes(range(256)) * 50), "neither a text file"),
    "broken gzip": ("refused", bare(b"\x1f\x8b broken"), "cannot be read"),
    "cut gzip": ("refused", lambda t: gzip.compress(text_of(t).encode())[:-500], "cannot be read"),
    "damaged spreadsheet": ("refused", bare(b"PK\x03\x04" + b"\0" * 100), "cannot be read"),
    "cut file": ("refused", above("#Samples: 9999\n"), "states 9,999 rows, but the file has 4,000"),
    "several segments": ("refused", above("LECROYx,1,Waveform\nSegments,3,SegmentSize,400\n"), "holds 3 segments"),
    # the header
    "header without rows": ("refused", lines(lambda all_: all_[:1]), "no rows of numbers"),
    "rows without header": ("refused", lines(lambda all_: all_[1:]), "no column time_s"),
    "no time": ("refused", rename(time_s="note"), "no column time_s"),
    "values without their time": ("refused", bare(b"0.5\n" * 50), "no column time_s"),
    "no Vsc": ("refused", lambda t: text_of({n: t[n] for n in ("time_s", "V_V")}), "Vsc_V is missing"),
    "no V and no scene": ("refused", lambda t: text_of({n: t[n] for n in ("time_s", "Vsc_V")}), "V_V is missing"),
    "unknown names": ("refused", rename(V_V="CH1", Vsc_V="CH2"), "is not guessed (found: CH1, CH2)"),
    "unknown name asked for": ("refused", rename(V_V="CH1", Vsc_V="CH3"), "there is no column 'CH2'", ALL),
    "one column asked for twice": (
        "refused", rename(V_V="CH1", Vsc_V="CH2"), "one column is to be two", {"channels": {"V": "CH1", "Vsc": "CH1"}},
    ),
    "factor of zero": ("refused", rename(), "is no factor", {"scale": {"Vsc": 0.0}}),
    "two columns of one name": ("refused", headed("time_s,Vsc_V,Vsc_V"), "two columns are named Vsc"),
    "unknown unit": ("refused", rename(V_V="V_ohm"), "'ohm' is no unit of V"),
    "unknown unit of time": ("refused", rename(time_s="time_h"), "'h' is not a unit of time"),
    "units that disagree": ("refused", line(1, lambda x: f"{x}\nms,V,V"), "the unit of time_s is ms here"),
    "current in volts": ("refused", rename(V_V="I_V"), "give the factor between them"),
    "no unit of time": ("warned", rename(time_s="time"), "seconds were assumed"),
    "no unit of a channel": ("warned", rename(V_V="CH1", Vsc_V="CH2"), "no unit stated, V assumed", ALL),
    "columns of other names": ("warned", lambda t: text_of({**t, "other": t["V_V"]}), "not used: other"),
    # the rows
    "text in a cell": ("refused", line(102, lambda x: x.replace(",", ",abc", 1)), "line 102, column 2: 'abc"),
    "text in all cells of a column": (
        "refused", lambda t: re.sub(r"(?m)^(\d.*),.*$", r"\1,x", text_of(t)), "line 2, column 3: 'x'",
    ),
    "empty cell": ("refused", line(102, lambda x: re.sub(",.*,", ",,", x)), "line 102, column 2: the cell is empty"),
    "short row": ("refused", line(102, lambda x: x.rpartition(",")[0]), "line 102: 2 values"),
    "long row": ("refused", line(102, lambda x: x + ",1"), "line 102: 4 values"),
    "row cut at the end": ("refused", lines(lambda all_: [*all_[:-1], "0.19"]), "line 4001: 1 values"),
    "channels of different lengths": (
        "refused", lambda t: text_of({**t, "Vsc_V": t["Vsc_V"][:-9]}), "line 3993, column 3: the cell is empty",
    ),
    "arrays of different lengths": ("refused", as_npz, "'Vsc' has 3,993 samples and the time 4,000"),
    "rows without values inside": ("refused", line(102, emptied), "line 102: the cells"),
    "rows without values at the ends": ("warned", line(2, emptied), "were ignored (1)"),
    "comments, blank rows, trailing commas": (
        "read", lines(lambda all_: ["# by hand", *(f"{x}," for x in all_), "", ",,,"]), "",
    ),
    "decimal commas": ("read", lambda t: text_of(t, delimiter=";").replace(".", ","), ""),
    "UTF-16": ("read", lambda t: text_of(t).encode("utf-16"), ""),
    # the times
    "repeated time": ("refused", rows(lambda n: np.sort(np.r_[:n, 100])), "line 103: the time 0.005 s repeats"),
    "time that starts anew": ("refused", rows(lambda n: np.r_[: n // 2, : n // 2]), "holds 2 segments"),
    "time that goes back": ("refused", rows(lambda n: np.r_[: n // 2, :9, n // 2 : n]), "goes back"),
    "unsorted rows": ("refused", rows(lambda n: np.r_[1, 0, 2:n]), "line 3: the time 0 s goes back"),
    "time that is not finite": ("refused", put("time_s", at(100, np.nan)), "line 102: time is nan"),
    "time rounded until it repeats": ("refused", put("time_s", lambda x: np.round(x, 4)), "state the sampling rate"),
    "time rounded until its steps differ": ("warned", put("time_s", lambda x: np.round(1.03 * x, 5)), "were rounded"),
    "sampling rate that contradicts the times": ("refused", rename(), "contradicts the times", {"rate": 21e3}),
    "time rounded to float32": ("warned", float32, "the times are rounded"),
    "uneven steps": ("warned", rows(lambda n: np.flatnonzero(np.arange(n) % 7)), "not uniform"),
    "samples lost, with their times": ("warned", rows(lambda n: np.r_[:900, 1000:n]), "not uniform"),
    "trigger outside of the record": ("warned", put("time_s", lambda x: x + 1.0), "the trigger (0 s) lies outside"),
    "fewer than 20 samples": ("refused", rows(lambda n: np.arange(95, 114)), "19 samples are too few"),
    "less than 1.5 periods": ("warned", rows(lambda n: np.arange(230)), "no channel contains 1.5 periods"),
    "few samples a period": ("warned", rows(lambda n: np.arange(0, n, 20)), "10 samples per period"),
    # the values
    "value that is not finite": ("refused", put("Vsc_V", at(100, np.nan)), "line 102: Vsc is nan"),
    "infinite value": ("refused", put("V_V", at(100, -np.inf)), "line 102: V is -inf"),
    "sign of infinity": ("refused", line(102, lambda x: x.rpartition(",")[0] + ",∞"), "line 102: Vsc is inf"),
    "overflow code": ("refused", put("Vsc_V", at(100, 9.9e37)), "code for out of range"),
    "constant channel": ("refused", put("V_V", lambda x: 0.0 * x + 180.0), "V is constant at 180"),
    "channel of zeros": ("refused", put("Vsc_V", lambda x: 0.0 * x), "Vsc is zero throughout"),
    "nothing but noise": (
        "refused", put("Vsc_V", lambda x: np.random.default_rng(1).normal(size=x.size)), "nothing but noise",
    ),
    "clipped Vsc": ("warned", put("Vsc_V", lambda x: np.clip(x, -9.0, 9.0)), "Vsc is clipped at"),
    "saturated amplifier": ("warned", put("V_V", lambda x: np.clip(1.1 * x, -195.0, 197.8)), "V is clipped at"),
    "coarse resolution": ("warned", put("Vsc_V", lambda x: np.round(x / 0.5) * 0.5), "steps larger than its noise"),
    "Vsc of 15,000": ("warned", put("Vsc_V", lambda x: 1e3 * x), "more than a touch display withstands"),
    "current of 5 A": ("warned", headed("time_s,I_A,Vsc_V"), "more than a touch display withstands", {"scene": SCENE}),
    "probe factor missing": ("warned", put("Vsc_V", lambda x: 0.1 * x), "a 10x probe read as 1x"),
    "swapped columns": ("warned", headed("time_s,Vsc_V,V_V"), "swapped columns or a wrong unit"),
    "mains hum": ("warned", adding("Vsc_V", lambda t: 2.0 * np.sin(2.0 * np.pi * 60.0 * t)), "mains hum (60 Hz"),
    "drift": ("warned", adding("Vsc_V", lambda t: 20.0 * t), "drifts by"),
    # against the circuit and the scene
    "Vsc larger than the circuit allows": ("fit refuses", put("Vsc_V", lambda x: 1e3 * x), "1/2 or more"),
    "inverted probe": ("fit refuses", put("Vsc_V", lambda x: -x), "steps against V"),
    "clipped V": ("fit refuses", put("V_V", lambda x: np.clip(x, -180.2, 180.2)), "V_V is clipped at"),
    "peak read as peak-to-peak": ("fit refuses", put("V_V", lambda x: 2.0 * x), "times the scene's", {"scene": SCENE}),
    "time in ms called s": (
        "fit refuses", put("time_s", lambda x: 1e3 * x), "the scene's [drive] frequency", {"scene": SCENE},
    ),
}  # fmt: skip


def make_file(kind: str, folder: Path) -> Path:
    """Write a bad file into a folder, and return its path."""
    if kind == "directory":
        return folder
    path = folder / ("record.npz" if kind == "arrays of different lengths" else "record.csv")
    if kind != "missing file":
        content = KINDS[kind][1](make_table())
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize("kind", [kind for kind, (verdict, *_) in KINDS.items() if verdict != "refused"])
def test_what_bad_input_gets(tmp_path: Path, kind: str):
    """Test what is read nevertheless; test_refusals.py reads the sentences of refusals."""
    verdict, _, words, *asked = KINDS[kind]
    options = dict(asked[0]) if asked else {}
    scene = fitact.Scene(**options.pop("scene")) if "scene" in options else None
    path = make_file(kind, tmp_path)
    record = fitact.read(path, scene, **options)
    if verdict == "fit refuses":
        with pytest.raises(fitact.InputError) as error:
            fitact.fit(record, scene)
        assert words in str(error.value)
        return
    seen = fitact.inspect(path, **options)
    said = (*seen.notes, *seen.warnings)
    assert any(words in sentence for sentence in said) if verdict == "warned" else not said


def test_a_good_record_is_not_doubted(tmp_path: Path):
    path = tmp_path / "record.csv"
    path.write_text(text_of(make_table()))
    seen = fitact.inspect(path)
    assert (seen.notes, seen.warnings) == ((), ())
    assert seen.frequency == pytest.approx(100.0, rel=1e-3)
