"""Files as other people's programs write them: each is read with the written values, or refused for its kind."""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy.io

import fitact
from fitact.data.clipping import clipping_mask
from fitact.data.readers.read import read_capture
from tests.layouts.__main__ import PAGE, render_table
from tests.layouts.layout import COUNT, REAL, SCOPE, TIME, VSC, Layout, V, rows
from tests.layouts.records import LVM, PLAIN, RECORDS, clocks, with_clock
from tests.layouts.spectra import FREQUENCY, GAIN, SHOWN, SPECTRA, Y, Z, write_gain, write_pair

EXTRAS = {"scope": "RigolWFM.wfm", "tdms": "nptdms"}  # modules that `fitact[...]` installs
MADE = [
    pytest.param(layout, id=f"{layout.program}{layout.ending}")
    for layout in (*RECORDS, *SPECTRA)
    if layout.write is not None
]


@pytest.mark.parametrize("layout", MADE)
def test_values_are_those_that_were_written(layout: Layout, tmp_path: Path, monkeypatch):
    if layout.extra:
        pytest.importorskip(EXTRAS[layout.extra])
    path = layout.write(tmp_path)
    if layout.kind == "spectrum":
        spectrum = fitact.read_spectrum(path)
        assert spectrum.channel == ("impedance" if layout.taken == "impedance" else "Vsc")
        np.testing.assert_allclose(spectrum.frequency, FREQUENCY, rtol=1e-8)
        np.testing.assert_allclose(spectrum.values, Z if layout.taken == "impedance" else GAIN, rtol=1e-7)
        return
    if layout.options:
        with pytest.raises(fitact.InputError):  # it needs them
            fitact.read(path)
    record = fitact.read(path, **layout.options)
    np.testing.assert_allclose(record.time - record.time[0], TIME, atol=1e-8)
    np.testing.assert_allclose(record["V"], V, atol=6e-6 + layout.resolution * np.max(np.abs(V)))
    np.testing.assert_allclose(record["Vsc"], VSC, atol=6e-6 + layout.resolution * np.max(np.abs(VSC)))
    inspection = fitact.inspect(path, **layout.options)
    assert inspection.time.size == COUNT
    # what the table says is taken from the file is taken: nothing of it was assumed
    channels = inspection.columns if layout.kind != "sound" else ()
    assert "units" not in layout.taken or all(channel.unit == "V" for channel in channels)
    assert "attenuation" not in layout.taken or inspection.columns[0].attenuation == 10.0
    if layout.extra:
        monkeypatch.setitem(sys.modules, EXTRAS[layout.extra], None)
        with pytest.raises(fitact.InputError, match=rf"pip install 'fitact\[{layout.extra}\]'"):
            fitact.read(path, **layout.options)


REAL_FILES = [pytest.param(layout, name, id=name) for layout in (*RECORDS, *SPECTRA) for name in layout.real]


@pytest.mark.parametrize(("layout", "name"), REAL_FILES)
def test_real_files_are_read(layout: Layout, name: str, tmp_path: Path):
    """Test that they are read; the values are compared in the tests of each."""
    if layout.extra:
        pytest.importorskip(EXTRAS[layout.extra])
    found = [folder / name for folder in (SCOPE, REAL) if (folder / name).exists()]
    if not found:
        pytest.skip(f"{name} is another's and not shipped")
    if layout.kind == "spectrum":
        assert min(map(len, fitact.read_spectra(found[0]))) > 20
        return
    capture = read_capture(found[0], rate=None if name != "rs_rtp_01.Wfm.csv" else 1e9)
    assert capture.time.size == capture.channels[0].values.size
    assert np.all(np.diff(capture.time) > 0.0)


def test_the_page_holds_the_table():
    assert render_table() in PAGE.read_text("utf-8"), "write it again: python -m tests.layouts"


@pytest.mark.parametrize("kind", [np.int16, np.int32, np.uint8, np.float32])
def test_sound_files_need_their_full_scale(kind: type, tmp_path: Path):
    path, parts = tmp_path / "card.wav", np.column_stack([V / 200.0, VSC / 20.0])
    steps = {np.int16: 2**15, np.int32: 2**31, np.uint8: 2**7, np.float32: 1}[kind]
    written = np.round(steps * parts) + 128 * (kind is np.uint8) if steps > 1 else parts
    scipy.io.wavfile.write(path, 50_000, written.astype(kind))
    assigned = {"V": "1", "Vsc": "channel 2"}
    record = fitact.read(path, channels=assigned, scale={"V": 200.0, "Vsc": 20.0})
    atol = 0.51 / steps if steps > 1 else 1e-6
    np.testing.assert_allclose(record.time, TIME, atol=1e-12)
    np.testing.assert_allclose(record["V"], V, atol=200.0 * atol)
    np.testing.assert_allclose(record["Vsc"], VSC, atol=20.0 * atol)


def test_what_was_left_out_is_noted(tmp_path: Path):
    path = tmp_path / "record.csv"
    path.write_text(PLAIN + "Mean,0.1,0.2\nRMS,1,2\n")
    assert any("2 lines of words below the data were left out (Mean, RMS)" in note for note in fitact.read(path).notes)
    path.write_text(with_clock(",V_V,Vsc_V", clocks()))
    assert any("counted from the first" in note for note in fitact.read(path).notes)
    spectrum = fitact.read_spectrum(write_gain("ltspice.txt", tmp_path))
    assert any("source of 1 V" in note for note in spectrum.notes)


def test_a_damaged_number_of_an_AC_analysis_is_refused(tmp_path: Path):
    path = write_gain("ltspice.txt", tmp_path)
    path.write_text(path.read_text().replace("0.", "0.1.", 1))
    with pytest.raises(fitact.InputError, match="no line names a frequency"):
        fitact.read_spectrum(path)


def insert(line: str) -> Callable[[list[str]], list[str]]:
    return lambda lines: [*lines[:100], line, *lines[100:]]


REFUSED = {  # lines, and words of the sentence; see test_refusals.py
    "no time": (["V_V,Vsc_V", *rows(V, VSC)], r"2 columns of numbers: V_V, Vsc_V.*--rate 100kHz"),
    "no names": (rows(V, VSC), r"2 columns of numbers without names.*--rate 100kHz"),
    "a coarse clock": (
        with_clock("Time,V_V,Vsc_V", [c[:11] for c in clocks()]).splitlines(), r"resolution of 10 ms.*--rate 100kHz",
    ),
    "steps of a simulation": (
        insert("Step Information: Rsc=160K  (Run: 2/2)")(["time\tV_V\tVsc_V", *rows(TIME, V, VSC, delimiter="\t")]),
        r"line 101: holds several runs.*Rsc=160K.*export one",
    ),
    "segments of LabVIEW": (
        [
            *LVM.splitlines(), *rows(TIME, V, VSC, delimiter="\t"), "",
            *LVM.splitlines()[2:], *rows(TIME, V, VSC, delimiter="\t"),
        ],
        r"several runs or segments, the next from 'Channels' on; keep one",
    ),
    "words among rows": (
        insert("pause,,")(["time_s,V_V,Vsc_V", *rows(TIME, V, VSC)]), r"line 101, column 1: 'pause' is not a number",
    ),
    "a page of words below": (
        ["time_s,V_V,Vsc_V", *rows(TIME, V, VSC), *["remark,1,2"] * 30],
        r"line 302, column 1: 'remark' is not a number",
    ),
}  # fmt: skip


def test_the_convention_of_a_pair_is_noted(tmp_path: Path):
    assert "the impedance follows from Cp and D" in fitact.read_spectrum(write_pair("Cp", "D", tmp_path)).notes


def test_units_and_other_words_of_an_LCR_meter(tmp_path: Path):
    path = tmp_path / "meter.csv"
    lines = rows(1e-3 * FREQUENCY, 1e9 * SHOWN["Cs"], 1e-3 * SHOWN["Rs"], form="%.9e")
    path.write_text("\n".join(["Frequency (kHz),Cs (nF),Rs (kOhm)", *lines]))
    np.testing.assert_allclose(fitact.read_spectrum(path).values, Z, rtol=1e-7)
    path.write_text(
        "\n".join(
            [
                "freq/Hz;Cp [pF];Dissipation",
                *rows(FREQUENCY, 1e12 * SHOWN["Cp"], SHOWN["D"], form="%.9e", delimiter=";"),
            ]
        )
    )
    np.testing.assert_allclose(fitact.read_spectrum(path).values, Z, rtol=1e-7)
    degrees = np.degrees(np.angle(Y))
    path.write_text("\n".join(["f (Hz),|Y| (uS),theta (deg)", *rows(FREQUENCY, 1e6 * np.abs(Y), degrees, form="%.9e")]))
    np.testing.assert_allclose(fitact.read_spectrum(path).values, Z, rtol=1e-7)


@pytest.mark.parametrize("code", ["9.9e37", "\N{INFINITY}"])
def test_codes_for_values_out_of_range_are_clipped_samples(code: str, tmp_path: Path):
    """A single code in Vsc, or one in V, is refused."""
    path, beyond = tmp_path / "record.csv", np.abs(VSC) > 10.0
    lines = rows(TIME, V, VSC)
    marked = [
        ",".join([*line.split(",")[:2], code if VSC[i] > 0.0 else f"-{code}"]) if beyond[i] else line
        for i, line in enumerate(lines)
    ]
    path.write_text("\n".join(["time_s,V_V,Vsc_V", *marked]), encoding="utf-8")
    record = fitact.read(path)
    assert np.all(clipping_mask(record["Vsc"])[beyond])
    np.testing.assert_allclose(record["Vsc"][~beyond], VSC[~beyond], atol=6e-6)
    assert np.max(np.abs(record["Vsc"])) < 10.1
    for place, field in ((2, "Vsc"), (1, "V")):
        cells = lines[150].split(",")
        cells[place] = code
        path.write_text("\n".join(["time_s,V_V,Vsc_V", *lines[:150], ",".join(cells), *lines[151:]]), encoding="utf-8")
        with pytest.raises(fitact.InputError, match=rf"line 152: {field} is"):
            fitact.read(path)
