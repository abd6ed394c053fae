"""Files as other people's programs write them: each is read with the written values, or refused for its kind."""

import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy.io

import fitact
from fitact.cli import app
from fitact.data.clipping import clipping_mask
from fitact.readers.read import read_capture
from fitact.readers.stream import stream_record
from tests.layouts.__main__ import PAGE, render_table
from tests.layouts.layout import COUNT, REAL, SCOPE, STEP, TIME, VSC, Layout, V, rows
from tests.layouts.records import LVM, PLAIN, RECORDS, clocks, with_clock
from tests.layouts.spectra import FREQUENCY, GAIN, OMEGA, SHOWN, SPECTRA, Y, Z, write_gain, write_pair

SHARED = REAL.parent / "records" / "layouts"

EXTRAS = {"scope": "RigolWFM.wfm", "tdms": "nptdms", "excel": "python_calamine"}  # modules that `fitact[...]` installs
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
        path.touch()  # so that it is read again
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
    capture = read_capture(found[0], rate=None if name != "rs_rtp_01.Wfm.csv" else 1e9, segment=1)
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
    "other times beside the first": (
        [*LVM.replace("V\tVsc", "V\tX_Value\tVsc").splitlines(), *rows(TIME, V, 2.0 * TIME, VSC, delimiter="\t")],
        r"the columns 1 and 3 hold different times; export channels of one time base",
    ),
    "words among rows": (
        insert("pause,,")(["time_s,V_V,Vsc_V", *rows(TIME, V, VSC)]), r"line 101, column 1: 'pause' is not a number",
    ),
    "a page of words below": (
        ["time_s,V_V,Vsc_V", *rows(TIME, V, VSC), *["remark,1,2"] * 30],
        r"line 302, column 1: 'remark' is not a number",
    ),
}  # fmt: skip


def noisy(number: int) -> np.ndarray:
    """Return V and Vsc of a segment, other in each, with noise and as an 8-bit converter rounds them."""
    rng = np.random.default_rng(number)
    waves = np.stack([V, VSC]) * (1.0 + 0.1 * number) + rng.normal(scale=0.1, size=(2, COUNT))
    return np.round(waves / 0.05) * 0.05


def tabbed(number: int, time: np.ndarray = TIME, **how: str) -> str:
    return "\n".join(rows(time, *noisy(number), delimiter="\t", **how))


LVM_HEAD, LVM_SEGMENT = "LabVIEW Measurement\nX_Columns\tOne\n***End_of_Header***\n\n", LVM.split("\n", 2)[2]
NUMBERS = (1, 2, 3)
SEGMENTED: dict[str, tuple[str, dict[str, object]]] = {
    "steps of LTspice": (
        "time\tV(drive)\tV(skin)\n"
        + "\n".join(f"Step Information: R={n}K  (Run: {n}/3)\n{tabbed(n, form='%.9e')}" for n in NUMBERS),
        {"channels": {"V": "V(drive)", "Vsc": "V(skin)"}},
    ),
    "LabVIEW": (LVM_HEAD + "\n\n".join(LVM_SEGMENT + tabbed(n) for n in NUMBERS), {}),
    "LabVIEW, whose time goes on": (
        LVM_HEAD + "\n\n".join(LVM_SEGMENT + tabbed(n, TIME + (n - 1) * COUNT * STEP) for n in NUMBERS), {},
    ),
    "LabVIEW without times": (
        LVM_HEAD + "\n\n".join(
            LVM_SEGMENT + "\n".join("\t" + row for row in rows(*noisy(n), delimiter="\t")) for n in NUMBERS
        ),
        {},
    ),
    "sequence of LeCroy": (
        f"LECROYWS3024,42561,Waveform\nSegments,3,SegmentSize,{COUNT}\nSegment,TrigTime,TimeSinceSegment1\n"
        + "".join(f"#{n},25-Nov-2026 10:14:15,{n}\n" for n in NUMBERS) + "Time,V,Vsc\n"
        + "\n".join(line for n in NUMBERS for line in rows(TIME, *noisy(n))),
        {},
    ),
    "files after one another": (
        "\n".join(line for n in NUMBERS for line in ["time_s,V_V,Vsc_V", *rows(TIME, *noisy(n)), ""]), {},
    ),
    "time that starts anew": (
        "\n".join(["time_s,V_V,Vsc_V", *(line for n in NUMBERS for line in rows(TIME, *noisy(n)))]), {},
    ),
}  # fmt: skip


@pytest.mark.parametrize("layout", SEGMENTED)
def test_one_of_several_segments_is_chosen(layout: str, tmp_path: Path):
    text, how = SEGMENTED[layout]
    path = tmp_path / "record.csv"
    path.write_text(text, encoding="utf-8", newline="\n")
    for read in (fitact.read, fitact.inspect):
        with pytest.raises(fitact.InputError, match=r"holds 3 segments .* choose one, as --segment 1"):
            read(path, **how)
        with pytest.raises(fitact.InputError, match=r"holds 3 segments .* there is no number 4"):
            read(path, segment=4, **how)
    for number in NUMBERS:
        record = fitact.read(path, segment=number, **how)
        np.testing.assert_allclose(record.time - record.time[0], TIME, atol=1e-9)
        for name, truth in zip(("V", "Vsc"), noisy(number), strict=True):
            np.testing.assert_allclose(record[name], truth, atol=6e-6)
        assert fitact.inspect(path, segment=number, **how).time.size == COUNT


@pytest.mark.skipif(not SHARED.exists(), reason="the shared files after other programs' layouts are not shipped")
def test_segments_of_shared_files_hold_one_signal():
    """All of them hold parts of a multisine, which wrdata.txt has with nine digits."""
    _, V, _, Vsc = np.loadtxt(SHARED / "wrdata.txt").T
    nodes = {"V": "V(drive)", "Vsc": "V(skin)"}
    for name, segment, how, start, atol in (
        ("ltspice.raw", None, nodes, 0, 1e-5), ("ltspice_steps.txt", 1, nodes, 0, 6e-5),
        ("ltspice_steps.txt", 2, nodes, 0, 6e-5), ("lvm_segs.lvm", 1, {}, 0, 1e-6), ("lvm_segs.lvm", 2, {}, 800, 1e-6),
    ):  # fmt: skip
        record = fitact.read(SHARED / name, channels=how, segment=segment)
        for channel, truth in (("V", V), ("Vsc", Vsc)):
            shared = min(len(record), truth.size - start)
            np.testing.assert_allclose(record[channel][:shared], truth[start : start + shared], atol=atol)


def test_the_command_line_and_streams_choose_a_segment(tmp_path: Path, capsys):
    path, truth = tmp_path / "record.csv", noisy(2)
    path.write_text(SEGMENTED["LabVIEW"][0])
    with pytest.raises(SystemExit):
        app(["inspect", str(path), "--segment", "2", "--json"])
    shown = json.loads(capsys.readouterr().out)
    assert [channel["max"] for channel in shown["channels"]] == pytest.approx(truth.max(axis=1).tolist())
    blocks = list(stream_record(path, segment=2))
    np.testing.assert_allclose(np.concatenate([block.channels["Vsc"] for block in blocks]), truth[1], atol=6e-6)
    for asked, words in (("0", "write a number from 1"), ("x", "write a number from 1"), ("4", "no number 4")):
        with pytest.raises(fitact.InputError, match=words):
            app(["inspect", str(path), "--segment", asked])
    with pytest.raises(fitact.InputError, match=r"line 314: another segment begins .* choose one, as --segment 1"):
        list(stream_record(path))


def test_a_file_with_one_segment_has_no_second(tmp_path: Path):
    path = tmp_path / "record.csv"
    path.write_text(LVM + "\n".join(rows(TIME, V, VSC, delimiter="\t")))
    assert len(fitact.read(path, segment=1)) == COUNT
    with pytest.raises(fitact.InputError, match="holds one segment, so there is no number 2"):
        fitact.read(path, segment=2)


def test_refusals_within_a_segment_name_its_line_in_the_file(tmp_path: Path):
    path = tmp_path / "record.csv"
    lines = SEGMENTED["LabVIEW"][0].splitlines()
    place = lines.index(tabbed(2).splitlines()[99])
    lines[place] = "0.1\toops\t1"
    path.write_text("\n".join(lines))
    with pytest.raises(fitact.InputError, match=f"line {place + 1}, column 2: 'oops' is not a number"):
        fitact.read(path, segment=2)
    assert len(fitact.read(path, segment=3)) == COUNT


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


def test_an_AC_analysis_of_several_voltages_and_steps(tmp_path: Path):
    path, rng = tmp_path / "ac.txt", np.random.default_rng(0)
    gain = (160e3 / (1.0 + 1j * OMEGA * 3.5e-3) / Z) * (1.0 + 1e-3 * rng.standard_normal(OMEGA.size))
    current = 2.0 / Z

    def cells(*columns: np.ndarray) -> list[str]:
        return ["\t".join(f"{x.real:.15e},{x.imag:.15e}" for x in row) for row in zip(*columns, strict=True)]

    def write(names: str, *steps: list[str]) -> None:
        lines = ["Freq.\t" + names]
        for number, step in enumerate(steps, 1):
            lines += [f"Step Information: R={number}K  (Run: {number}/{len(steps)})"] * (len(steps) > 1)
            lines += [f"{f:.15e}\t{cell}" for f, cell in zip(FREQUENCY, step, strict=True)]
        path.write_text("\n".join(lines))

    two = np.full(OMEGA.size, 2.0 + 0.0j)
    write("V(in)\tV(skin)\tV(other)", cells(two, 2.0 * gain, gain))
    np.testing.assert_allclose(fitact.read_spectrum(path).values, gain, rtol=1e-12)
    write("V(in)\tV(a)\tV(b)\tI(V1)", cells(two, gain, gain, -current))
    np.testing.assert_allclose(fitact.read_spectrum(path).values, Z, rtol=1e-12)
    write("V(skin)", cells(gain), cells(0.5 * gain))
    np.testing.assert_allclose(fitact.read_spectrum(path, 2).values, 0.5 * gain, rtol=1e-12)
    table = np.column_stack([FREQUENCY, two.real, two.imag, FREQUENCY, 2.0 * gain.real, 2.0 * gain.imag])
    for chosen, names in (
        ([0, 1, 2, 3, 4, 5], "frequency v(in) v(in) frequency v(out) v(out)"),
        ([0, 1, 2, 4, 5], "frequency v(in) v(in) v(out) v(out)"),
    ):
        lines = rows(*table[:, chosen].T, form="%.14e", delimiter="  ")
        path.write_text("\n".join([names, *lines, names, *lines]))
        found = fitact.read_spectra(path)
        assert len(found) == 2
        np.testing.assert_allclose(found[1].values, gain, rtol=1e-12)
    write("V(in)\tV(a)\tV(b)", cells(two, gain, gain))
    with pytest.raises(fitact.InputError, match=r"which of the voltages V\(a\), V\(b\) is that of the skin"):
        fitact.read_spectra(path)


@pytest.mark.parametrize("code", ["9.9e37", "\N{INFINITY}", "OL", "Overflow", "1.#INF"])
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
