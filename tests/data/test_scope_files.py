"""Oscilloscope files: real captures, and small files in the layouts that manufacturers document."""

import gzip
import importlib
import struct
from pathlib import Path

import numpy as np
import pytest

import fitact
from fitact.readers.matlab import read_mat
from fitact.readers.read import read_capture
from tests.layouts.layout import SCOPE, STEP, TIME, VSC, V

SKIN = {"V": "CH1", "Vsc": "CH2"}

# file: manufacturer, names, samples, first time, step, first and last value of the last channel (from a text editor)
SHOWN = {
    "tek_TDS2000_F0000CH1.CSV": ("Tektronix TDS", ["CH1"], 400, -0.01, 5e-5, 15.345, -4.3853),
    "keysight_scope_0.csv": ("Keysight", ["1", "2"], 400, -0.01, 5e-5, 15.345, -4.385),
    "siglent_SDS1104XE.csv": ("Siglent", ["CH1"], 400, -0.01, 5e-5, 15.345, -4.38531),
    "picoscope_en_us_units.csv": ("PicoScope", ["Channel A", "Channel B"], 400, -0.01, 5e-5, 15.345, -4.385),
    "digilent_waveforms.csv": (
        "Digilent WaveForms", ["Channel 1", "Channel 2"], 400, -0.01, 5e-5, 15.345, -4.3853056358332,
    ),
    "rigol_DS1052E.csv.gz": ("Rigol", ["CH 1", "CH 2"], 8192, 0.0, 2e-9, 9.92, 4.96),
    "rigol_DS1102E-D.csv": ("Rigol", ["CH1", "CH2"], 600, -6e-4, 2e-6, 5.4, 5.4),
    "rigol_DS2072A-5.csv": ("Rigol", ["CH1", "CH2"], 1400, -2.52e-6, 1e-8, 0.0, 0.28),
}  # fmt: skip


@pytest.mark.parametrize("name", SHOWN)
def test_csv_of_each_maker(name: str):
    maker, names, samples, start, step, first, last = SHOWN[name]
    capture = read_capture(SCOPE / name)
    assert (capture.format, [trace.name for trace in capture.channels], capture.time.size) == (maker, names, samples)
    np.testing.assert_allclose(capture.time, start + step * np.arange(samples), atol=1e-4 * step)
    values = capture.channels[-1].values
    assert (values[0], values[-1]) == (first, last)
    assert {trace.unit for trace in capture.channels} == {"V"}


def test_what_the_header_says_of_probes():
    attenuation = [t.attenuation for t in read_capture(SCOPE / "rigol_DS1052E.csv.gz").channels]
    assert attenuation == [10.0, 1.0]
    assert read_capture(SCOPE / "tek_TDS2000_F0000CH1.CSV").channels[0].attenuation == 100.0


@pytest.mark.parametrize(
    ("header", "row", "start", "step"),
    [
        ("X,CH1,Start,Increment,\nSequence,Volt,-2e-3,1e-3,\n", "{i},{a},", -2e-3, 1e-3),
        ("CH1(V),t0 = -25s, tInc = 2e-06s,\n", "{a},,,", -25.0, 2e-6),
        ("#t0 = -25s\n#tInc = 2e-06s\nCH1(V)\n", "{a}\n", -25.0, 2e-6),
    ],
)
def test_time_from_start_and_increment(tmp_path: Path, header: str, row: str, start: float, step: float):
    """Row numbers of the first file start at 22, as in files of Rigol."""
    path = tmp_path / "record.csv"
    path.write_text(header + "\n".join(row.format(i=i, a=i % 7) for i in range(22, 62)))
    capture = read_capture(path)
    first = start + (22 * step if "Sequence" in header else 0.0)
    np.testing.assert_allclose(capture.time, first + step * np.arange(40), rtol=1e-12)
    assert [trace.name for trace in capture.channels] == ["CH1"]


def test_the_header_that_rohde_und_schwarz_keep_beside(tmp_path: Path):
    path = tmp_path / "rec.Wfm.csv"
    path.write_bytes((SCOPE / "rs_rtp_01.Wfm.csv").read_bytes())
    with pytest.raises(fitact.InputError, match=r"no column time_s.*NAME\.csv"):
        read_capture(path)
    (tmp_path / "rec.csv").write_text(
        "Resolution:1e-11:\nRecordLength:80:\nXStart:-1e-8:\nHardwareXStart:-1.12e-8:\nSignalHardwareRecordLength:100:\n"
        "SignalResolution:2e-11:\nVerticalScale:0.02:\nSource:Ch1:\n"
    )
    capture = read_capture(path)
    np.testing.assert_allclose(capture.time, -1.12e-8 + 2e-11 * np.arange(100), rtol=1e-12)
    np.testing.assert_array_equal(capture.channels[0].values, np.loadtxt(path))


@pytest.mark.parametrize("end", ["\r", "\r\n"])
def test_utf_16_and_other_line_ends(tmp_path: Path, end: str):
    path = tmp_path / "record.csv"
    text = (SCOPE / "picoscope_en_us_units.csv").read_text("utf-8")
    path.write_bytes(text.replace("\n", end).encode("utf-16"))
    np.testing.assert_array_equal(read_capture(path).time, read_capture(SCOPE / "picoscope_en_us_units.csv").time)


def test_many_blocks_and_gzip(tmp_path: Path, monkeypatch, finger_path: Path):
    """Chunks that end in the middle of a line do not change the result."""
    plain = fitact.read(finger_path)
    path = tmp_path / "record.csv.gz"
    path.write_bytes(gzip.compress(finger_path.read_bytes()))
    monkeypatch.setattr("fitact.readers.text.BLOCK_BYTES", 1009)
    assert fitact.read(path).fingerprint == plain.fingerprint
    lines = finger_path.read_text().splitlines()
    lines[3000] = lines[3000].replace(",", ",x", 1)
    (tmp_path / "bad.csv").write_text("\n".join(lines))
    with pytest.raises(fitact.InputError, match="line 3001, column 2: 'x"):
        fitact.read(tmp_path / "bad.csv")


# ---- binary


@pytest.fixture
def rigolwfm():
    pytest.importorskip("RigolWFM")


def floats(path: Path, start: int, count: int) -> np.ndarray:
    return np.frombuffer(path.read_bytes(), "<f4", count, start).astype(float)


@pytest.mark.usefixtures("rigolwfm")
def test_keysight_and_rigol_binary_against_their_floats():
    """Manuals: a file header of 12 bytes; then, for each channel, headers of 140 + 12 bytes and float32 samples."""
    capture = read_capture(SCOPE / "agilent_1.bin")
    np.testing.assert_array_equal(capture.channels[0].values, floats(SCOPE / "agilent_1.bin", 164, 2000))
    assert capture.time[1] - capture.time[0] == pytest.approx(5e-7)
    capture = read_capture(SCOPE / "rigol_MSO5000-A.bin")
    assert len(capture.channels) == 4
    for i, trace in enumerate(capture.channels):
        np.testing.assert_array_equal(trace.values, floats(SCOPE / "rigol_MSO5000-A.bin", 164 + i * 4152, 1000))


@pytest.mark.usefixtures("rigolwfm")
def test_tektronix_binary_against_its_counts():
    """Layout WFM#003: the volts of a count at byte 168, and counts of 16 bits from the byte that is stated at 16."""
    content = (SCOPE / "tek_golden_analog.wfm").read_bytes()
    (step,), (begin,) = struct.unpack_from("<d", content, 168), struct.unpack_from("<i", content, 16)
    capture = read_capture(SCOPE / "tek_golden_analog.wfm")
    np.testing.assert_allclose(capture.channels[0].values, step * np.frombuffer(content, "<i2", 6, begin), rtol=1e-6)
    np.testing.assert_array_equal(capture.time, np.arange(-3.0, 3.0))


@pytest.mark.usefixtures("rigolwfm")
def test_lecroy_binary_against_its_descriptor():
    """LeCroy's template: lengths of the blocks at 36, gain at 156, offset at 160, interval at 176, start at 180.

    It counts 20 segments of a sequence at 144, milliseconds apart by the list of their triggers.
    """
    content = (SCOPE / "lecroy_3.trc").read_bytes()
    at = content.index(b"WAVEDESC")
    gain, offset = struct.unpack("<2f", content[at + 156 : at + 164])
    step, start = struct.unpack("<fd", content[at + 176 : at + 188])
    counts = np.frombuffer(content, "<i2", 10040, at + sum(struct.unpack("<6i", content[at + 36 : at + 60])))
    with pytest.raises(fitact.InputError, match=r"holds 20 segments .* choose one, as --segment 1"):
        fitact.inspect(SCOPE / "lecroy_3.trc")
    for number in (1, 2, 20):
        capture = read_capture(SCOPE / "lecroy_3.trc", segment=number)
        truth = gain * counts[502 * (number - 1) : 502 * number] - offset
        np.testing.assert_allclose(capture.channels[0].values, truth, atol=1e-9)
        np.testing.assert_allclose(capture.time, start + step * np.arange(502), atol=1e-15)
    with pytest.raises(fitact.InputError, match=r"there is no number 21"):
        read_capture(SCOPE / "lecroy_3.trc", segment=21)


@pytest.mark.usefixtures("rigolwfm")
def test_segmented_memory_of_keysight(tmp_path: Path):
    """Manual: each segment of a channel has headers of 140 + 12 bytes, with the number of the segment at 136."""
    content, path = (SCOPE / "agilent_1.bin").read_bytes(), tmp_path / "segments.bin"
    samples = floats(SCOPE / "agilent_1.bin", 164, 2000)
    waves = [np.roll(samples, 7 * i).astype("<f4") for i in range(6)]
    parts = [
        content[12:124] + str(i % 2 + 1).encode() + content[125:148] + struct.pack("<I", i // 2 + 1) + content[152:164]
        + wave.tobytes()
        for i, wave in enumerate(waves)
    ]  # fmt: skip
    body = b"".join(parts)
    path.write_bytes(content[:4] + struct.pack("<II", 12 + len(body), 6) + body)
    with pytest.raises(fitact.InputError, match=r"holds 3 segments .* choose one, as --segment 1"):
        read_capture(path)
    for number in (1, 2, 3):
        capture = read_capture(path, segment=number)
        assert [(each.name, each.unit) for each in capture.channels] == [("CH 1", "V"), ("CH 2", "V")]
        for i, channel in enumerate(capture.channels):
            np.testing.assert_array_equal(channel.values, waves[2 * number - 2 + i])
        np.testing.assert_allclose(capture.time, read_capture(SCOPE / "agilent_1.bin").time, atol=1e-12)


@pytest.mark.usefixtures("rigolwfm")
def test_frames_of_tektronix_binary(monkeypatch):
    """RigolWFM reads one frame of a FastFrame capture at a time, and counts them."""
    wfm = importlib.import_module("RigolWFM.wfm")
    asked: list[int] = []
    plain = wfm.Wfm.from_file

    def from_file(path: str, frame: int = 0):
        asked.append(frame)
        found = plain(path)
        found.frame_count = 3
        return found

    monkeypatch.setattr(wfm.Wfm, "from_file", from_file)
    with pytest.raises(fitact.InputError, match=r"holds 3 segments .* choose one, as --segment 1"):
        read_capture(SCOPE / "tek_golden_analog.wfm")
    assert read_capture(SCOPE / "tek_golden_analog.wfm", segment=2).time.size
    assert asked == [0, 0, 1]


@pytest.mark.usefixtures("rigolwfm")
def test_rigol_binary_against_the_csv_of_the_same_capture():
    """The DS1052E's CSV begins at 0, four samples later; the DS2072A's has a tenth of the times, 25 ns later."""
    text, binary = (read_capture(SCOPE / f"rigol_DS1052E.{end}") for end in ("csv.gz", "wfm"))
    for shown, kept in zip(text.channels, binary.channels, strict=True):
        np.testing.assert_allclose(shown.values[4:], kept.values[:-4], atol=1e-12)
    assert text.time[1] - text.time[0] == pytest.approx(binary.time[1] - binary.time[0])
    text, binary = (read_capture(SCOPE / f"rigol_DS2072A-5.{end}") for end in ("csv", "wfm"))
    np.testing.assert_allclose(binary.time[::10], text.time, atol=1e-12)
    for shown, kept, step in zip(text.channels, binary.channels, (2e-3, 4e-2), strict=True):
        off = np.abs(shown.values[3:] - kept.values[5:-25:10]) / step
        assert np.mean(off < 1.01) > 0.8
        assert off.max() < 2.51


# ---- arrays with names


@pytest.mark.parametrize("compressed", [False, True])
def test_matlab_against_what_scipy_wrote(tmp_path: Path, compressed: bool):
    import scipy.io

    rng = np.random.default_rng(0)  # any seed
    written = {
        "a": rng.normal(size=(5, 3)), "b": rng.integers(-9, 9, (1, 40)).astype("i2"),
        "c": np.float32(rng.normal(size=(7, 1))), "d": np.array([[1 + 2j, 3.0]]), "a_long_name": np.ones((1, 1)),
    }  # fmt: skip
    more = {"unit": "mV", "cell": np.array([1, "x"], dtype=object), "struct": {"x": 1.0}, "none": np.zeros((0, 0))}
    scipy.io.savemat(tmp_path / "a.mat", written | more, do_compression=compressed)
    found = dict(read_mat((tmp_path / "a.mat").read_bytes(), 10**6))
    assert found.pop("unit") == "mV"
    found.pop("none", None)
    assert set(found) == set(written)
    for name, values in written.items():
        np.testing.assert_array_equal(found[name], values)


def test_arrays_are_named_as_columns_are(tmp_path: Path):
    np.savez(tmp_path / "named.npz", time_ms=1e3 * TIME, V_V=TIME, Vsc_mV=1e3 * TIME)
    capture = read_capture(tmp_path / "named.npz")
    np.testing.assert_allclose(capture.time, TIME, rtol=1e-15)
    assert {trace.name: trace.unit for trace in capture.channels} == {"V": "V", "Vsc": "V"}
    np.testing.assert_allclose(capture.channels[1].values, TIME, rtol=1e-15)


def test_a_rate_gives_the_times_of_arrays_without(tmp_path: Path):
    np.savez(tmp_path / "record.npz", V=V, Vsc=VSC)
    record = fitact.read(tmp_path / "record.npz", rate=1.0 / STEP)
    np.testing.assert_allclose(record.time, TIME, atol=1e-15)
    assert any("start at 0" in note for note in record.notes)


# ---- assignment of the columns


def test_the_mapping_is_asked_for_and_noted():
    path = SCOPE / "keysight_scope_0.csv"
    with pytest.raises(
        fitact.InputError, match=r"not guessed \(found: 1, 2\); name them, as --channel V=1 --channel Vsc"
    ):
        fitact.read(path)
    record = fitact.read(path, channels=SKIN, scale={"Vsc": -10.0})
    table = np.loadtxt(path, delimiter=",", skiprows=2)
    np.testing.assert_array_equal(record["V"], table[:, 1])
    np.testing.assert_array_equal(record["Vsc"], -10.0 * table[:, 2])
    assert (
        f"{path}: Vsc read from column '2' (unit Volt), multiplied by -10; the file states no probe attenuation"
        in record.notes
    )


def test_channels_from_files_of_their_own(tmp_path: Path):
    """One file per channel, as LeCroy and Tektronix TDS write them."""
    table = np.loadtxt(SCOPE / "keysight_scope_0.csv", delimiter=",", skiprows=2)
    for name, column in (("C1.csv", 1), ("C2.csv", 2)):
        np.savetxt(tmp_path / name, table[:, [0, column]], "%.9g", ",", header="Time,Ampl", comments="")
    record = fitact.read(tmp_path / "C2.csv", channels={"Vsc": "Ampl", "V": "C1.csv:Ampl"})
    np.testing.assert_array_equal(record["V"], table[:, 1])
    np.testing.assert_array_equal(record["Vsc"], table[:, 2])


def test_a_current_from_the_voltage_over_a_resistor():
    """1 V over 1 kohm is 1 mA."""
    scene = fitact.Scene(measurement={"channels": ["I"]})
    record = fitact.read(SCOPE / "keysight_scope_0.csv", scene, channels={"V": "1", "I": "2"}, scale={"I": 1e-3})
    assert record["I"][0] == pytest.approx(15.345e-3)


def test_a_factor_replaces_an_unknown_unit(tmp_path: Path):
    path = tmp_path / "record.csv"
    np.savetxt(path, np.column_stack([TIME, V, VSC]), "%.17g", ",", header="time_s,V_V,I_div", comments="")
    record = fitact.read(path, fitact.Scene(measurement={"channels": ["I"]}), scale={"I": 1e-3})
    np.testing.assert_array_equal(record["I"], 1e-3 * VSC)
    assert any("(unit div), multiplied by 0.001" in note for note in record.notes)
