"""Oscilloscope files: real captures, and small files in the layouts that manufacturers document."""

import gzip
import importlib
import struct
from pathlib import Path

import numpy as np
import pytest

import fitact
from fitact.data.readers.matlab import read_mat
from fitact.data.readers.read import read_capture

SCOPE = Path(__file__).parents[1] / "data" / "scope"
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


CHS = [("CH1", "V", 1.0), ("CH2", "V", 1.0)]
TWO = [("1", "V", 1.0), ("2", "V", 1.0)]
# layouts that public parsers document: header, row, and the name, unit and factor of each channel
LAYOUTS = {
    "Tektronix": (
        "Model,MSO58\nFirmware Version,2.0.3\n\nWaveform Type,ANALOG,ANALOG\nPoint Format,Y,Y\nHorizontal Units,s,s\n"
        "Sample Interval,1e-06,1e-06\nRecord Length,40,40\nVertical Units,V,A\nProbe Attenuation,10,1\n"
        "Label,SDA,IOUT\n,,\nTIME,CH1,CH2,\n",
        "{t},{a},{b},",
        [("CH1", "V", 1.0), ("CH2", "A", 1.0)],
    ),
    "Keysight": ("x-axis,1,2\nsecond,Volt,Volt\n-2e-3,,\n-1.5e-3,,\n", "{t},{a},{b}", TWO),
    "Rigol": (",CH1,CH2,\nSecond,Volt,Volt,\n", "{t},{a},{b},", CHS),
    "Siglent": (
        "Record Length,40,\nSample Interval,Analog:1e-6\nVertical Units,CH1:V CH2:V,,\n"
        "Vertical Scale,CH1:0.05 CH2:0.1,,\nHorizontal Units,s,,\nModel Number,SDS1202CL+,,\n\nSource,CH1,CH2\n"
        "Second,Volt,Volt\n",
        "{t},{a},{b}", CHS,
    ),
    "LeCroy": (
        "LECROYWaveRunner\x92R,21153,Waveform\nSegments,1,SegmentSize,40\nSegment,TrigTime,TimeSinceSegment1\n"
        "#1,16-Mar-2022 14:45:39,0                 \nTime,Ampl1, Ampl2\n",
        "{t},{a},{b}", [("Ampl1", "", 1.0), ("Ampl2", "", 1.0)],
    ),
    "PicoScope": (
        "Zeit;Kanal A;Kanal B\n(ms);(V);(mV)\n\n", "{ms};{a};{b}", [("Kanal A", "V", 1.0), ("Kanal B", "V", 1e-3)],
    ),
    "Saleae": (
        "Time [s],Channel 0,Channel 1\n", "{t},{a},{b}", [("Channel 0", "", 1.0), ("Channel 1", "", 1.0)],
    ),
    "Rohde & Schwarz": ("in s,C1 in V,C2 in mV\n", "{t},{a},{b}", [("C1", "V", 1.0), ("C2", "V", 1e-3)]),
    "text": (
        '"Time / us","drive (kV)",note,"Vsc / mV"\n', "{us},{a},ok,{b}", [("drive", "V", 1e3), ("Vsc", "V", 1e-3)],
    ),
    "fitact": ("# time_s V_V Vsc_V\n", "{t} {a} {b}", [("V", "V", 1.0), ("Vsc", "V", 1.0)]),  # layout of numpy.savetxt
}  # fmt: skip


@pytest.mark.parametrize("maker", LAYOUTS)
def test_documented_layouts(tmp_path: Path, maker: str):
    header, row, expected = LAYOUTS[maker]
    path = tmp_path / "record.csv"
    lines = [
        row.format(t=f"{i - 5}e-6", ms=f"{(i - 5) * 1e-3:.3f}", us=i - 5, a=i % 7 / 4, b=i % 5 / 8) for i in range(40)
    ]
    text = "\n".join(lines)
    path.write_bytes((header + (text.replace(".", ",") if ";" in row else text)).encode("latin-1"))
    capture = read_capture(path)
    assert capture.format == maker
    np.testing.assert_allclose(capture.time, 1e-6 * (np.arange(40) - 5), atol=1e-15)
    assert [(trace.name, trace.unit) for trace in capture.channels] == [(name, unit) for name, unit, _ in expected]
    waves = np.arange(40) % 7 / 4, np.arange(40) % 5 / 8
    for trace, wave, (_, _, factor) in zip(capture.channels, waves, expected, strict=True):
        np.testing.assert_allclose(trace.values, factor * wave, rtol=1e-15)


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
    monkeypatch.setattr("fitact.data.readers.text.BLOCK_BYTES", 1009)
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


REFUSED = {
    "tek_analog_waveform_first100lines.csv": "states 50,000 rows, but the file has 86",
    "tek_invalid_csv.csv": "no column time_s",
    "tek_invalid_record_length.csv": "no column time_s",
    "rs_rtp_01.Wfm.csv": "no column time_s",
}


@pytest.mark.parametrize("name", REFUSED)
def test_files_that_are_refused(name: str):
    with pytest.raises(fitact.InputError, match=REFUSED[name]):
        read_capture(SCOPE / name)


@pytest.mark.usefixtures("rigolwfm")
def test_a_cut_binary_and_six_samples_are_refused(tmp_path: Path):
    for name in ("agilent_1.bin", "lecroy_3.trc", "rigol_DS2072A-5.wfm", "rigol_MSO5000-A.bin"):
        content = (SCOPE / name).read_bytes()
        (tmp_path / name).write_bytes(content[: int(0.8 * len(content))])
        with pytest.raises(fitact.InputError, match=r"cannot be read .*; export the record again"):
            read_capture(tmp_path / name)
    with pytest.raises(fitact.InputError, match="6 samples are too few"):
        fitact.read(SCOPE / "tek_golden_analog.wfm", channels={"Vsc": "CH 1"})


# ---- arrays with names


TIME = np.arange(100) * 1e-5 - 1e-4
WAVES = {"drive": np.sin(2e3 * np.pi * TIME), "skin": 0.1 * np.cos(2e3 * np.pi * TIME)}


def write_mat(path: Path) -> None:
    import scipy.io

    scipy.io.savemat(path, {"Tstart": TIME[0], "Tinterval": 1e-5, **WAVES})  # layout of PicoScope


def write_mat_73(path: Path) -> None:
    import h5py

    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in {"time": TIME, **WAVES}.items():
            file[name] = values[None, :]
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")


def write_hdf5(path: Path) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        for name, values in {"time": 1e3 * TIME, **WAVES}.items():
            file[f"scope/{name}"] = values
            file[f"scope/{name}"].attrs["units"] = "ms" if name == "time" else "V"


def write_netcdf(path: Path) -> None:
    import xarray

    xarray.Dataset({n: ("time", v, {"units": "V"}) for n, v in WAVES.items()}, {"time": TIME}).to_netcdf(
        path, engine="h5netcdf"
    )


def write_netcdf3(path: Path) -> None:
    import xarray

    xarray.Dataset({n: ("time", v) for n, v in WAVES.items()}, {"time": TIME}).to_netcdf(path, engine="scipy")


def write_npz(path: Path) -> None:
    np.savez(path, t=TIME, **WAVES)


def write_tdms(path: Path) -> None:
    nptdms = pytest.importorskip("nptdms")
    timing = {"wf_increment": 1e-5, "wf_start_offset": TIME[0], "unit_string": "V"}
    with nptdms.TdmsWriter(str(path)) as file:
        file.write_segment([nptdms.ChannelObject("scope", name, values, timing) for name, values in WAVES.items()])


NAMED = {
    "a.mat": write_mat, "b.mat": write_mat_73, "c.h5": write_hdf5, "d.nc": write_netcdf, "e.nc": write_netcdf3,
    "f.npz": write_npz, "g.tdms": write_tdms,
}  # fmt: skip


@pytest.mark.parametrize("name", NAMED)
def test_files_of_named_arrays(tmp_path: Path, name: str):
    NAMED[name](tmp_path / name)
    record = fitact.read(tmp_path / name, channels={"V": "drive", "Vsc": "skin"}, scale={"Vsc": 10.0})
    np.testing.assert_allclose(record.time, TIME, atol=1e-15)
    np.testing.assert_allclose(record["V"], WAVES["drive"], atol=1e-15)
    np.testing.assert_allclose(record["Vsc"], 10.0 * WAVES["skin"], atol=1e-15)


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


def test_named_arrays_that_are_refused(tmp_path: Path):
    import scipy.io

    scipy.io.savemat(tmp_path / "iq.mat", {"sampleInterval": 4e-7, "IQData": np.exp(1j * TIME)})
    with pytest.raises(fitact.InputError, match="complex"):
        read_capture(tmp_path / "iq.mat")
    np.savez(tmp_path / "counts.npz", XInc=1e-6, YInc=0.01, Vsc=np.arange(50))
    with pytest.raises(fitact.InputError, match="ADC counts"):
        read_capture(tmp_path / "counts.npz")
    np.savez(tmp_path / "no_time.npz", Vsc=TIME)
    with pytest.raises(fitact.InputError, match="has no time; store an array 'time'"):
        read_capture(tmp_path / "no_time.npz")
    np.savez(tmp_path / "lengths.npz", time=TIME, V=TIME, Vsc=TIME[:50])
    with pytest.raises(fitact.InputError, match="'Vsc' has 50 samples and the time 100"):
        read_capture(tmp_path / "lengths.npz")


def test_a_missing_extra_is_named(tmp_path: Path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "RigolWFM.wfm", None)
    with pytest.raises(fitact.InputError, match=r"needs RigolWFM, .* pip install 'fitact\[scope\]'"):
        read_capture(SCOPE / "agilent_1.bin")


# ---- assignment of the columns


def test_the_mapping_is_asked_for_and_noted():
    path = SCOPE / "keysight_scope_0.csv"
    with pytest.raises(fitact.InputError, match=r"not guessed \(found: 1, 2\); say it, as --channel V=1 --channel Vsc"):
        fitact.read(path)
    record = fitact.read(path, channels=SKIN, scale={"Vsc": -10.0})
    table = np.loadtxt(path, delimiter=",", skiprows=2)
    np.testing.assert_array_equal(record["V"], table[:, 1])
    np.testing.assert_array_equal(record["Vsc"], -10.0 * table[:, 2])
    assert (
        f"{path}: Vsc read from column '2' (unit Volt), multiplied by -10; the file states no probe attenuation"
        in record.notes
    )


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"channels": {"U": "1"}}, "'U' is no channel of fitact"),
        ({"channels": {"I": "1"}}, r"1 is in V, but I needs A; give the factor between them, as --scale I="),
        ({"channels": SKIN, "scale": {"I": 2.0}}, "I is scaled but not there"),
    ],
)
def test_a_wrong_mapping_is_refused(asked: dict, words: str):
    with pytest.raises(fitact.InputError, match=words):
        fitact.read(SCOPE / "keysight_scope_0.csv", **asked)


def test_channels_from_files_of_their_own(tmp_path: Path):
    """One file per channel, as LeCroy and Tektronix TDS write them; a file of another capture is refused."""
    table = np.loadtxt(SCOPE / "keysight_scope_0.csv", delimiter=",", skiprows=2)
    for name, column in (("C1.csv", 1), ("C2.csv", 2)):
        np.savetxt(tmp_path / name, table[:, [0, column]], "%.9g", ",", header="Time,Ampl", comments="")
    np.savetxt(tmp_path / "C3.csv", table[:-1, :2], "%.9g", ",", header="Time,Ampl", comments="")
    record = fitact.read(tmp_path / "C2.csv", channels={"Vsc": "Ampl", "V": "C1.csv:Ampl"})
    np.testing.assert_array_equal(record["V"], table[:, 1])
    np.testing.assert_array_equal(record["Vsc"], table[:, 2])
    for asked, words in (
        ("C3.csv:Ampl", "does not belong to the same acquisition"),
        ("C1.csv:B", "C1.csv: there is no column 'B'"),
    ):
        with pytest.raises(fitact.InputError, match=words):
            fitact.read(tmp_path / "C2.csv", channels={"Vsc": "Ampl", "V": asked})


def test_a_current_from_the_voltage_over_a_resistor():
    """1 V over 1 kohm is 1 mA."""
    scene = fitact.Scene(measurement={"channels": ["I"]})
    record = fitact.read(SCOPE / "keysight_scope_0.csv", scene, channels={"V": "1", "I": "2"}, scale={"I": 1e-3})
    assert record["I"][0] == pytest.approx(15.345e-3)
