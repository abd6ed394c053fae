"""Sheets of Excel and OpenDocument files, which hold what a text file would."""

import datetime
from pathlib import Path

import numpy as np
import pytest

import fitact
from fitact.cli import internal
from tests.layouts.files import Cell, write_ods, write_xlsx

pytest.importorskip("python_calamine", reason="python-calamine is not installed: make env, or fitact[excel]")
STEP, COUNT = 20e-6, 200
TIME = STEP * np.arange(COUNT)


def noisy(number: int = 0) -> np.ndarray:
    """Return V and Vsc with noise, skew and the rounding of an instrument."""
    rng = np.random.default_rng(number)
    waves = [120.0 * np.sin(2e3 * np.pi * TIME), 9.0 * np.cos(2e3 * np.pi * (TIME - 3e-6))]
    return np.round((np.stack(waves) + rng.normal(scale=0.05, size=(2, COUNT))) / 0.01) * 0.01


def table(scale: float = 1.0, number: int = 0) -> list[list[Cell]]:
    return [list(map(float, row)) for row in zip(scale * TIME, *noisy(number), strict=True)]


def check(record: fitact.Record, number: int = 0) -> None:
    np.testing.assert_allclose(record.time - record.time[0], TIME, atol=1e-12)
    for name, truth in zip(("V", "Vsc"), noisy(number), strict=True):
        np.testing.assert_allclose(record[name], truth, rtol=1e-12)


NAMES: list[Cell] = ["time_s", "V_V", "Vsc_V"]
ABOVE: list[list[Cell]] = [["Instrument", "DL850"], ["Sample rate", 50e3], [], []]
SHEETS: dict[str, tuple[list[list[Cell]], dict]] = {
    "names": ([NAMES, *table()], {}),
    "header lines": (
        [*ABOVE, ["Time (ms)", "CH1 (V)", "CH2 (V)"], *table(1e3)], {"channels": {"V": "1", "Vsc": "CH2"}},
    ),
    "units below": ([["Time", "V", "Vsc"], ["(us)", "(V)", "(V)"], *table(1e6)], {}),
    "empty rows and columns around": (
        [[], [], [None, None, *NAMES, "remark"], *([None, None, *row, "ok"] for row in table()), [], []], {},
    ),
    "no time": ([["V_V", "Vsc_V"], *(row[1:] for row in table())], {"rate": 50e3}),
    "mean below": ([NAMES, *table(), ["Mean", 1.0, 2.0]], {}),
}  # fmt: skip


@pytest.mark.parametrize("kind", SHEETS)
def test_a_sheet_is_read_like_a_text(kind: str, tmp_path: Path):
    rows, how = SHEETS[kind]
    check(fitact.read(write_xlsx(tmp_path / "record.xlsx", rows), **how))
    check(fitact.read(write_xlsx(tmp_path / "record.xlsx", [["of", "the bench"]], rows), **how))


def test_dates_and_times_are_clocks(tmp_path: Path):
    begin = datetime.datetime(2025, 3, 4, 23, 59, 59, 900_000)
    dates: list[Cell] = [begin + datetime.timedelta(milliseconds=5 * i) for i in range(COUNT)]
    path = write_xlsx(
        tmp_path / "record.xlsx", [["when", *NAMES[1:]], *([d, *r[1:]] for d, r in zip(dates, table(), strict=True))]
    )
    record = fitact.read(path)
    np.testing.assert_allclose(record.time, 5e-3 * np.arange(COUNT), atol=2e-6)  # s, the resolution of a date
    assert any("counted from the first" in note for note in record.notes)


def test_other_kinds_of_sheets_and_a_missing_library(tmp_path: Path, monkeypatch):
    check(fitact.read(write_ods(tmp_path / "record.ods", [NAMES, *table()])))
    path = write_xlsx(tmp_path / "record.xlsx", [NAMES, *table(number=2)])
    monkeypatch.setitem(__import__("sys").modules, "python_calamine", None)
    with pytest.raises(fitact.InputError, match=r"needs python_calamine, .*pip install 'fitact\[excel\]'"):
        fitact.read(path)


def test_sheets_are_segments(tmp_path: Path):
    path = write_xlsx(tmp_path / "record.xlsx", *([NAMES, *table(number=n)] for n in (1, 2)))
    with pytest.raises(fitact.InputError, match=r"holds 2 segments .* choose one, as --segment 1"):
        fitact.read(path)
    for number in (1, 2):
        check(fitact.read(path, segment=number), number)
    with pytest.raises(fitact.InputError, match=r"there is no number 3"):
        fitact.read(path, segment=3)
    path = write_xlsx(tmp_path / "runs.xlsx", [NAMES, *table(number=1), *table(number=2)])
    check(fitact.read(path, segment=2), 2)


def test_a_spectrum_in_a_sheet(tmp_path: Path):
    frequency = np.geomspace(10.0, 1e5, 30)
    z = 160e3 / (1.0 + 2j * np.pi * frequency * 3.5e-3) - 1j / (2.0 * np.pi * frequency * 1.35e-9)
    rows = [list(map(float, row)) for row in zip(frequency, z.real, z.imag, strict=True)]
    path = write_xlsx(tmp_path / "z.xlsx", [["made", "by us"], ["Frequency (Hz)", "Z' (ohm)", "Z'' (ohm)"], *rows])
    assert internal.is_spectrum(path)
    np.testing.assert_allclose(fitact.read_spectrum(path).values, z, rtol=1e-12)


def test_sheets_that_are_refused(tmp_path: Path):
    path = tmp_path / "record.xlsx"
    rows = [NAMES, *table()]
    rows[99] = [*rows[99][:2], "oops"]
    write_xlsx(path, rows)
    with pytest.raises(fitact.InputError, match="line 100, column 3: 'oops' is not a number"):
        fitact.read(path)
    write_xlsx(path, [["a", "b"], ["c", "d"]])
    with pytest.raises(fitact.InputError, match="no sheet has rows of numbers"):
        fitact.read(path)
    content = write_xlsx(path, [NAMES, *table()]).read_bytes()
    path.write_bytes(content[:300] + b"\0" * 50 + content[350:])
    with pytest.raises(fitact.InputError, match="cannot be read"):
        fitact.read(path)
