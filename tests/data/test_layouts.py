"""Files as other people's programs write them: each is read with the written values, or refused for its kind."""

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy.io

import fitact
from fitact.cli import app
from fitact.data.clipping import clipping_mask
from fitact.data.readers.stream import stream_record

STEP, COUNT = 20e-6, 300
TIME = STEP * np.arange(COUNT)
V = 120.0 * np.sin(2.0 * np.pi * 330.0 * TIME) - 3.25
VSC = 11.0 * np.cos(2.0 * np.pi * 330.0 * TIME) + 0.5


def rows(*columns: np.ndarray, form: str = "%.5f", delimiter: str = ",") -> list[str]:
    return [delimiter.join(form % x for x in row) for row in zip(*columns, strict=True)]


def clocks(form: str = "{h:02d}:{m:02d}:{s:09.6f}", begin: float = 86_399.999) -> list[str]:
    """Return times of day that pass midnight."""
    since = (begin + TIME) % 86_400.0
    return [form.format(h=int(t // 3600), m=int(t % 3600 // 60), s=t % 60.0) for t in since]


def with_clock(header: str, clock: list[str], **how: str) -> str:
    lines = zip(clock, rows(V, VSC, **how), strict=True)
    return "\n".join([header, *(f"{time}{how.get('delimiter', ',')}{row}" for time, row in lines), ""])


def half_past(clock: list[str]) -> list[str]:
    return [f"{int(c[:2]) % 12 or 12}{c[2:]} {'AM' if int(c[:2]) < 12 else 'PM'}" for c in clock]


def thousands(x: float) -> str:
    return f'"{x:,.3f}"'


YOKOGAWA = (
    '"Model Name","DL850"\n"TraceName","CH1","CH2"\n"BlockSize",300,300\n"VUnit","V","V"\n"SampleRate",50000,50000\n'
    '"HResolution",2.0E-05,2.0E-05\n"HOffset",0.0,0.0\n"DisplayBlockSize",300,300\n"Date","2025/03/04","2025/03/04"\n'
    '"Time","09:15:59.990","09:15:59.990"\n\n'
)
LVM = (
    "LabVIEW Measurement\nX_Columns\tOne\nChannels\t2\nSamples\t300\t300\nY_Unit_Label\tVolts\tVolts\n"
    "X_Dimension\tTime\tTime\nX0\t0.0\t0.0\nDelta_X\t0.000020\t0.000020\n***End_of_Header***\t\t\t\n"
    "X_Value\tV\tVsc\tComment\n"
)
LAYOUTS: dict[str, tuple[str, dict[str, object]]] = {
    "time stamps": (with_clock(",V_V,Vsc_V", [f"2025-03-04 {c}" for c in clocks()]), {}),
    "ISO time stamps with a zone": (with_clock("when,V_V,Vsc_V", [f"2025-03-04T{c}+01:00" for c in clocks()]), {}),
    "a date and a clock": (with_clock("Date,Time,V (V),Vsc (V)", [f"04/03/2025,{c}" for c in clocks()]), {}),
    "a twelve-hour clock": (with_clock("Time,V_V,Vsc_V", half_past(clocks())), {}),
    "a German clock": (
        with_clock("Zeit;V_V;Vsc_V", clocks(), delimiter=";").replace(".", ","), {},
    ),
    "a date with the name of its month": (with_clock("when,V_V,Vsc_V", [f"04-Mar-2025 {c}" for c in clocks()]), {}),
    "minutes and seconds of Excel and a rate": (
        with_clock("Time,V_V,Vsc_V", [c[3:10] for c in clocks(begin=100.0)]), {"rate": 1.0 / STEP},
    ),
    "minutes and seconds": (with_clock("Time,V_V,Vsc_V", [c[3:] for c in clocks(begin=100.0)]), {}),
    "a coarse clock and a rate": (
        with_clock("Time,V_V,Vsc_V", [c[:8] for c in clocks(begin=100.0)]), {"rate": 1.0 / STEP},
    ),
    "no time and a rate": ("\n".join(["V_V,Vsc_V", *rows(V, VSC)]), {"rate": 1.0 / STEP}),
    "no names and a rate": (
        "\n".join(rows(V, VSC)), {"rate": 1.0 / STEP, "channels": {"V": "1", "Vsc": "2"}},
    ),
    "thousands in quotes": (
        "\n".join(
            ['"Time (us)","V (mV)","Vsc (mV)"']
            + [",".join(map(thousands, row)) for row in zip(1e6 * TIME, 1e3 * V, 1e3 * VSC, strict=True)]
        ),
        {},
    ),
    "typographic minus": (
        "\n".join(["time_s,V_V,Vsc_V", *rows(TIME, V, VSC)]).replace(",-", ",\N{MINUS SIGN}"), {},
    ),
    "statistics below": ("\n".join(["time_s,V_V,Vsc_V", *rows(TIME, V, VSC), "Mean,0.1,0.2", "RMS,1,2", ""]), {}),
    "padding at the end": ("\n".join(["time_s,V_V,Vsc_V", *rows(TIME, V, VSC)]) + "\n\x1a\x00\x00", {}),
    "wrdata of ngspice": (
        "\n".join(rows(TIME, V, TIME, VSC, form=" %.8e", delimiter=" ")), {"channels": {"V": "2", "Vsc": "column 4"}},
    ),
    "LabVIEW with times": (LVM + "\n".join(rows(TIME, V, VSC, delimiter="\t")), {}),
    "LabVIEW without times": (
        LVM.replace("One", "No") + "\n".join("\t" + row for row in rows(V, VSC, delimiter="\t")), {},
    ),
    "LabVIEW with times of each channel": (
        LVM.replace("V\tVsc", "V\tX_Value\tVsc") + "\n".join(rows(TIME, V, TIME, VSC, delimiter="\t")), {},
    ),
    "Origin": (
        "Time\tV\tVsc\nus\tV\tV\nComments\tdrive\tskin\n" + "\n".join(rows(1e6 * TIME, V, VSC, delimiter="\t")), {},
    ),
    "columns that are aligned": (
        "   Time [s]     Drive V [V]    Skin V [V]\n" + "\n".join(rows(TIME, V, VSC, form="%14.6f", delimiter=" ")),
        {"channels": {"V": "Drive V", "Vsc": "Skin V"}},
    ),
    "a clock with colons only": (
        with_clock("Time,V_V,Vsc_V", [clock.replace(".", ":") for clock in clocks()]), {},
    ),
    "Yokogawa": (
        YOKOGAWA + "\n".join("," + row for row in rows(V, VSC)), {"channels": {"V": "CH1", "Vsc": "CH2"}},
    ),
}  # fmt: skip


@pytest.mark.parametrize("layout", LAYOUTS)
def test_values_are_those_that_were_written(layout: str, tmp_path: Path):
    text, how = LAYOUTS[layout]
    path = tmp_path / "record.csv"
    path.write_text(text, encoding="utf-8", newline="\n")
    record = fitact.read(path, **how)
    np.testing.assert_allclose(record.time - record.time[0], TIME, atol=1e-8)
    np.testing.assert_allclose(record["V"], V, atol=6e-5)
    np.testing.assert_allclose(record["Vsc"], VSC, atol=6e-5)
    assert fitact.inspect(path, **how).time.size == COUNT


def test_hantek_writes_one_channel_with_its_clock_in_the_header(tmp_path: Path):
    for name, values in (("a", V), ("b", VSC)):
        head = f"#CHANNEL:CH1\n#CLOCK=20.000uS\n#SIZE={COUNT}\n#UNITS:V\n"
        (tmp_path / f"{name}.csv").write_text(head + "\n".join(rows(values)))
    record = fitact.read(tmp_path / "a.csv", channels={"V": "CH1", "Vsc": "b.csv:CH1"})
    np.testing.assert_allclose(record.time, TIME, atol=1e-12)
    np.testing.assert_allclose(record["V"], V, atol=6e-6)
    np.testing.assert_allclose(record["Vsc"], VSC, atol=6e-6)


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
    with pytest.raises(fitact.InputError, match=r"no V; give the full scale, as --scale Vsc=10 for 10 V"):
        fitact.read(path, channels=assigned, scale={"V": 200.0})


def test_what_was_left_out_is_noted(tmp_path: Path):
    path = tmp_path / "record.csv"
    path.write_text(LAYOUTS["statistics below"][0])
    assert any("2 lines of words below the data were left out (Mean, RMS)" in note for note in fitact.read(path).notes)
    path.write_text(LAYOUTS["time stamps"][0])
    assert any("counted from the first" in note for note in fitact.read(path).notes)


def insert(line: str) -> Callable[[list[str]], list[str]]:
    return lambda lines: [*lines[:100], line, *lines[100:]]


REFUSED = {
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


@pytest.mark.parametrize("kind", REFUSED)
def test_refusals_say_what_was_found_and_what_helps(kind: str, tmp_path: Path):
    lines, words = REFUSED[kind]
    path = tmp_path / "record.csv"
    path.write_text("\n".join(lines))
    with pytest.raises(fitact.InputError) as refused:
        fitact.read(path)
    message = str(refused.value)
    assert re.search(words, message), message
    assert "Rohde" not in message
    assert "NAME.csv" not in message


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


SHARED = Path(__file__).parents[3] / "shared" / "records" / "layouts"


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
    path.write_text(LAYOUTS["LabVIEW with times"][0])
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


def test_only_a_file_of_rohde_and_schwarz_gets_their_advice(tmp_path: Path):
    path = tmp_path / "record.Wfm.csv"
    path.write_text("\n".join(rows(V, VSC)))
    with pytest.raises(fitact.InputError, match=r"put NAME\.csv, which holds the time, beside it"):
        fitact.read(path)


FREQUENCY = np.geomspace(20.0, 1e5, 40)
OMEGA = 2.0 * np.pi * FREQUENCY
Z = 1.0 / (1.0 / 160e3 + 1j * OMEGA * 22e-9) + 800.0 - 1j / (OMEGA * 1.35e-9)
Y = 1.0 / Z
# what an LCR meter shows, by its handbook: series and parallel equivalents of an impedance
SHOWN = {
    "Cp": Y.imag / OMEGA, "Cs": -1.0 / (OMEGA * Z.imag), "Lp": -1.0 / (OMEGA * Y.imag), "Ls": Z.imag / OMEGA,
    "Rp": 1.0 / Y.real, "Rs": Z.real, "G": Y.real, "B": Y.imag, "D": Z.real / abs(Z.imag), "Q": abs(Z.imag) / Z.real,
}  # fmt: skip
PAIRS = [
    *((c, other) for c in ("Cp", "Cs") for other in ("D", "Q")), ("Cp", "G"), ("Cp", "Rp"), ("Cs", "Rs"), ("Ls", "Rs"),
    ("Lp", "Rp"), ("Lp", "G"), ("G", "B"),
]  # fmt: skip


@pytest.mark.parametrize(("first", "second"), PAIRS)
def test_pairs_of_an_LCR_meter_are_impedances(first: str, second: str, tmp_path: Path):
    path = tmp_path / "meter.csv"
    lines = rows(FREQUENCY, SHOWN[first], SHOWN[second], form="%.9e")
    path.write_text("\n".join([f"Frequency,{first},{second}", *lines]))
    spectrum = fitact.read_spectrum(path)
    np.testing.assert_allclose(spectrum.values, Z, rtol=1e-7)
    assert f"the impedance follows from {first} and {second}" in spectrum.notes


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


@pytest.mark.parametrize("form", ["polar", "parts"])
def test_an_AC_analysis_of_LTspice_is_a_gain(form: str, tmp_path: Path):
    gain = 160e3 / (1.0 + 1j * OMEGA * 3.5e-3) / Z
    decibels, degrees = 20.0 * np.log10(np.abs(gain)), np.degrees(np.angle(gain))
    cells = [f"({a:.15e}dB,{b:.15e}\N{DEGREE SIGN})" for a, b in zip(decibels, degrees, strict=True)]
    if form == "parts":
        cells = [f"{x.real:.15e},{x.imag:.15e}" for x in gain]
    lines = ["Freq.\tV(skin)", *(f"{f:.15e}\t{cell}" for f, cell in zip(FREQUENCY, cells, strict=True))]
    path = tmp_path / "ac.txt"
    path.write_text("\n".join(lines), encoding="latin-1")
    spectrum = fitact.read_spectrum(path)
    assert spectrum.channel == "Vsc"
    np.testing.assert_allclose(spectrum.frequency, FREQUENCY, rtol=1e-12)
    np.testing.assert_allclose(spectrum.values, gain, rtol=1e-9)
    assert any("source of 1 V" in note for note in spectrum.notes)


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
