"""Layouts of records in time."""

import functools
import gzip
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
import xarray

from tests.layouts.files import Cell, raw, write_ods, write_xlsx
from tests.layouts.layout import COUNT, SCOPE, STEP, TIME, VSC, Layout, V, rows, text

CHS = {"channels": {"V": "CH1", "Vsc": "CH2"}}
NAMED = {"channels": {"V": "drive", "Vsc": "skin"}}
RATE = {"rate": 1.0 / STEP}
ARRAYS = {"drive": V, "skin": VSC}
NAMES = "time_s,V_V,Vsc_V"
LSB = 1.0 / 32_000.0  # of counts of 16 bits, relative to the largest value


def table(header: str, *columns: np.ndarray, end: str = "", **how: Any) -> str:
    """Return a header above rows of numbers, which end in `end`."""
    return "\n".join([header, *(row + end for row in rows(*(columns or (TIME, V, VSC)), **how)), ""])


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
TEKTRONIX = (
    "Model,MSO58\nFirmware Version,2.0.3\n\nWaveform Type,ANALOG,ANALOG\nPoint Format,Y,Y\nHorizontal Units,s,s\n"
    "Sample Interval,2e-05,2e-05\nRecord Length,300,300\nVertical Units,V,mV\nProbe Attenuation,10,1\n"
    "Label,SDA,IOUT\n,,\nTIME,CH1,CH2,"
)
TDS = ("Record Length,300", "Sample Interval,2e-05", "Vertical Units,V", "Probe Atten,10")
SIGLENT = (
    "Record Length,300,\nSample Interval,Analog:2e-5\nVertical Units,CH1:V CH2:V,,\n"
    "Vertical Scale,CH1:0.05 CH2:0.1,,\nHorizontal Units,s,,\nModel Number,SDS1202CL+,,\n\nSource,CH1,CH2\n"
    "Second,Volt,Volt"
)
LECROY = (
    "LECROYWaveRunner\x92R,21153,Waveform\nSegments,1,SegmentSize,300\nSegment,TrigTime,TimeSinceSegment1\n"
    "#1,16-Mar-2022 14:45:39,0                 \nTime,Ampl1, Ampl2"
)
SCOPY = (
    ";Scopy version,6fa2c03\n;Device,M2K\n;Nr of samples,300\n;Sample rate,5e+04\n;Tool,Oscilloscope\n"
    "Sample,Time(S),CH1(V),CH2(V)"
)
RESOLUTION = (
    "Resolution:1e-5:\nRecordLength:240:\nXStart:0:\nHardwareXStart:0:\nSignalHardwareRecordLength:300:\n"
    "SignalResolution:2e-5:\nVerticalScale:0.02:\nMultiChannelSource:Ch1:Ch2:\n"
)
GW_INSTEK = "Memory Length,300,\nSource,CH1,\nVertical Units,V,\nSampling Period,2.0e-05,\nTime, ,\nWaveform Data,"
HANTEK = "#CHANNEL:CH1\n#CLOCK=20.000uS\n#SIZE=300\n#UNITS:V"


def tds(values: np.ndarray) -> str:
    """Return the text of one channel, with the header beside the first rows."""
    cells = [*TDS, "Source,CH1"] + [","] * (COUNT - 5)
    return "\n".join(f"{cell},{row}" for cell, row in zip(cells, rows(TIME, values, delimiter=","), strict=True))


def pair(content: Callable[[np.ndarray], str]) -> Callable[[Path], Path]:
    """Return the writer of two files of one channel each."""

    def write(folder: Path) -> Path:
        text(content(VSC), name="b.csv")(folder)
        return text(content(V), name="a.csv")(folder)

    return write


APART = {"channels": {"V": "CH1", "Vsc": "b.csv:CH1"}}


def write_beside(folder: Path) -> Path:
    text(RESOLUTION, name="record.csv")(folder)
    return text("\n".join(rows(V, VSC)), name="record.Wfm.csv")(folder)


def packed(content: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        (folder / "record.csv.gz").write_bytes(gzip.compress(content.encode()))
        return folder / "record.csv.gz"

    return write


def write_isf(folder: Path) -> Path:
    """Write files of one channel: a header of words, then counts of 16 bits."""
    for name, values in (("a.isf", V), ("b.isf", VSC)):
        step = LSB * float(np.max(np.abs(values)))
        head = (
            f":WFMPRE:BYT_NR 2;BIT_NR 16;ENCDG BIN;BN_FMT RI;BYT_OR MSB;NR_PT {COUNT};WFID Ch1;PT_FMT Y;XINCR {STEP};"
            f"PT_OFF 0;XZERO 0.0;YMULT {step:.9e};YZERO 0.0;YOFF 0.0;:CURVE #3{2 * COUNT}"
        )
        (folder / name).write_bytes(head.encode() + np.round(values / step).astype(">i2").tobytes())
    return folder / "a.isf"


def write_lecroy(folder: Path) -> Path:
    """Write files of one channel: the descriptor of a real file with other counts, then counts of 16 bits."""
    real = (SCOPE / "lecroy_3.trc").read_bytes()
    begin = real.index(b"WAVEDESC")
    for name, values in (("a.trc", V), ("b.trc", VSC)):
        step, descriptor = LSB * float(np.max(np.abs(values))), bytearray(real[begin : begin + 346])
        struct.pack_into("<8i", descriptor, 36, 346, 0, 0, 0, 0, 0, 2 * COUNT, 0)  # lengths of blocks
        struct.pack_into("<8i", descriptor, 116, COUNT, COUNT, 0, COUNT - 1, 0, 1, 0, 1)
        struct.pack_into("<2f", descriptor, 156, step, 0.0)
        struct.pack_into("<fd", descriptor, 176, STEP, 0.0)
        counts = np.round(values / step).astype("<i2").tobytes()
        (folder / name).write_bytes(b"#9%09d" % (346 + len(counts)) + descriptor + counts)
    return folder / "a.trc"


def write_agilent(magic: bytes, folder: Path) -> Path:
    """Write a file header of 12 bytes; then, for each channel, headers of 140 + 12 bytes and float32 samples."""
    body = b""
    for number, values in enumerate((V, VSC), 1):
        head = struct.pack("<5if", 140, 1, 1, COUNT, 1, STEP * COUNT) + struct.pack("<3d2i", 0.0, STEP, 0.0, 2, 1)
        words = struct.pack("<16s16s24s16s", b"", b"", b"MSO", f"{number}".encode())
        body += (head + words).ljust(140, b"\0") + struct.pack("<i2hi", 12, 1, 4, 4 * COUNT)
        body += values.astype("<f4").tobytes()
    (folder / "record.bin").write_bytes(magic + struct.pack("<2i", 12 + len(body), 2) + body)
    return folder / "record.bin"


def write_mat(folder: Path) -> Path:
    scipy.io.savemat(folder / "a.mat", {"Tstart": 0.0, "Tinterval": STEP, **ARRAYS})  # layout of PicoScope
    return folder / "a.mat"


def write_mat_73(folder: Path) -> Path:
    with h5py.File(folder / "b.mat", "w", userblock_size=512) as file:
        for name, values in {"time": TIME, **ARRAYS}.items():
            file[name] = values[None, :]
    with (folder / "b.mat").open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    return folder / "b.mat"


def write_hdf5(folder: Path) -> Path:
    with h5py.File(folder / "c.h5", "w") as file:
        for name, values in {"time": 1e3 * TIME, **ARRAYS}.items():
            file[f"scope/{name}"] = values
            file[f"scope/{name}"].attrs["units"] = "ms" if name == "time" else "V"
    return folder / "c.h5"


def write_netcdf(folder: Path) -> Path:
    variables = {name: ("time", values, {"units": "V"}) for name, values in ARRAYS.items()}
    xarray.Dataset(variables, {"time": TIME}).to_netcdf(folder / "d.nc", engine="h5netcdf")
    return folder / "d.nc"


def write_netcdf3(folder: Path) -> Path:
    variables = {name: ("time", values, {"units": "V"}) for name, values in ARRAYS.items()}
    xarray.Dataset(variables, {"time": TIME}).to_netcdf(folder / "e.nc", engine="scipy")
    return folder / "e.nc"


def write_npz(folder: Path) -> Path:
    np.savez(folder / "f.npz", t=TIME, **ARRAYS)
    return folder / "f.npz"


def write_tdms(folder: Path) -> Path:
    nptdms = pytest.importorskip("nptdms")
    timing = {"wf_increment": STEP, "wf_start_offset": 0.0, "unit_string": "V"}
    with nptdms.TdmsWriter(str(folder / "g.tdms")) as file:
        file.write_segment([nptdms.ChannelObject("scope", name, values, timing) for name, values in ARRAYS.items()])
    return folder / "g.tdms"


def write_wav(folder: Path) -> Path:
    parts = np.column_stack([V / 200.0, VSC / 20.0])
    scipy.io.wavfile.write(folder / "card.wav", round(1.0 / STEP), np.round(2**31 * parts).astype(np.int32))
    return folder / "card.wav"


LVM_HEAD, SEGMENT = "LabVIEW Measurement\nX_Columns\tOne\n***End_of_Header***\n\n", LVM.split("\n", 2)[2]
RUNS = ["\n".join(rows(TIME, n * V, n * VSC, delimiter="\t")) for n in (2, 1, 3)]
SECOND = {"segment": 2}
NODES = {"channels": {"V": "V(drive)", "Vsc": "V(skin)"}}


def spice_file(form: str) -> Callable[[Path], Path]:
    """Return the writer of a raw file of a transient analysis."""
    waves = {"V(drive)": ("voltage", V), "V(skin)": ("voltage", VSC)}

    def write(folder: Path) -> Path:
        (folder / "a.raw").write_bytes(raw([(TIME, waves)], form, "real forward"))
        return folder / "a.raw"

    return write


def _sheet() -> list[list[Cell]]:
    return [NAMES.split(","), *(list(map(float, row)) for row in zip(TIME, V, VSC, strict=True))]


def write_sheet(folder: Path) -> Path:
    return write_xlsx(folder / "a.xlsx", _sheet())


def write_open_sheet(folder: Path) -> Path:
    return write_ods(folder / "a.ods", _sheet())


UNITS, TIMES, GRID, CLOCK = "time, units", "time", "time step, units", "time of day"
ATTENUATION, VARIANT = "time, units, attenuation", "as without"
SCOPE_FILES = {"kind": "binary", "extra": "scope"}
PLAIN = table(NAMES)
RECORDS: tuple[Layout, ...] = (
    Layout("fitact", ".csv", UNITS, text(PLAIN)),
    Layout("numpy.savetxt", ".txt", UNITS, text(table("# time_s V_V Vsc_V", delimiter=" "))),
    Layout("LabVIEW", ".lvm", UNITS, text(LVM + "\n".join(rows(TIME, V, VSC, delimiter="\t")))),
    Layout(
        "LabVIEW", ".lvm", UNITS,
        text(LVM.replace("V\tVsc", "V\tX_Value\tVsc") + "\n".join(rows(TIME, V, TIME, VSC, delimiter="\t"))),
    ),
    Layout(
        "Origin", ".dat", UNITS,
        text("Time\tV\tVsc\nus\tV\tV\nComments\tdrive\tskin\n" + "\n".join(rows(1e6 * TIME, V, VSC, delimiter="\t"))),
    ),
    Layout(
        "LabVIEW without times", ".lvm", GRID,
        text(LVM.replace("One", "No") + "\n".join("\t" + row for row in rows(V, VSC, delimiter="\t"))),
    ),
    Layout("time stamps", ".csv", CLOCK, text(with_clock(",V_V,Vsc_V", [f"2025-03-04 {c}" for c in clocks()]))),
    Layout(
        "time stamps", ".csv", CLOCK,
        text(with_clock("when,V_V,Vsc_V", [f"2025-03-04T{c}+01:00" for c in clocks()])),
    ),
    Layout(
        "clocks", ".csv", CLOCK,
        text(with_clock("Date,Time,V (V),Vsc (V)", [f"04/03/2025,{c}" for c in clocks()])),
    ),
    Layout("clocks", ".csv", CLOCK, text(with_clock("when,V_V,Vsc_V", [f"04-Mar-2025 {c}" for c in clocks()]))),
    Layout(
        "clocks", ".csv", CLOCK,
        text(with_clock("Time,V_V,Vsc_V", [c[3:] for c in clocks(begin=9.0)])),
    ),
    Layout(
        "clocks", ".csv", CLOCK, text(with_clock("Time,V_V,Vsc_V", [c.replace(".", ":") for c in clocks()])),
    ),
    Layout("clocks", ".csv", CLOCK, text(with_clock("Time,V_V,Vsc_V", half_past(clocks())))),
    Layout(
        "clocks", ".csv", CLOCK,
        text(with_clock("Zeit;V_V;Vsc_V", clocks(), delimiter=";").replace(".", ",")),
    ),
    Layout(
        "coarse clocks", ".csv", "-", text(with_clock("Time,V_V,Vsc_V", [c[:8] for c in clocks(begin=1.0)])),
        RATE,
    ),
    Layout(
        "coarse clocks", ".csv", "-", text(with_clock("Time,V_V,Vsc_V", [c[3:10] for c in clocks(begin=9.0)])), RATE,
    ),
    Layout("columns without time", ".csv", "-", text(table("V_V,Vsc_V", V, VSC)), RATE),
    Layout(
        "columns without names", ".csv", "-", text("\n".join(rows(V, VSC))),
        {**RATE, "channels": {"V": "1", "Vsc": "2"}},
    ),
    Layout("gzip", ".csv.gz", VARIANT, packed(PLAIN)),
    Layout("UTF-16", ".csv", VARIANT, text(PLAIN.replace("\n", "\r"), "utf-16")),
    Layout("decimal commas", ".csv", VARIANT, text(table(NAMES.replace(",", ";"), delimiter=";").replace(".", ","))),
    Layout(
        "thousands separated", ".csv", VARIANT,
        text(
            "\n".join(
                ['"Time (us)","V (mV)","Vsc (mV)"']
                + [",".join(map(thousands, row)) for row in zip(1e6 * TIME, 1e3 * V, 1e3 * VSC, strict=True)]
            )
        ),
    ),
    Layout("typographic minus", ".csv", VARIANT, text(PLAIN.replace(",-", ",\N{MINUS SIGN}"))),
    Layout("statistics below", ".csv", VARIANT, text(PLAIN + "Mean,0.1,0.2\nRMS,1,2\n")),
    Layout("zeros at the end", ".csv", VARIANT, text(PLAIN + "\x1a\x00\x00")),
    Layout("Tektronix DPO, MSO", ".csv", ATTENUATION, text(table(TEKTRONIX, TIME, V, 1e3 * VSC, end=",")), CHS),
    Layout("Tektronix TDS", ".csv", ATTENUATION, pair(tds), APART),
    Layout(
        "any table", ".csv", UNITS,
        text(table('"Time / us","drive (kV)","skin / mV"', 1e6 * TIME, 1e-3 * V, 1e3 * VSC, form="%.8f")), NAMED,
    ),
    Layout("Keysight", ".csv", UNITS, text(table("x-axis,1,2\nsecond,Volt,Volt\n-4e-5,,\n-2e-5,,")), CHS),
    Layout("Siglent", ".csv", UNITS, text(table(SIGLENT)), CHS),
    Layout(
        "PicoScope", ".csv", UNITS,
        text(table("Zeit;Kanal A;Kanal B\n(ms);(V);(mV)\n", 1e3 * TIME, V, 1e3 * VSC, delimiter=";").replace(".", ",")),
        {"channels": {"V": "A", "Vsc": "Kanal B"}},
    ),
    Layout(
        "Digilent WaveForms", ".csv", UNITS,
        text(table("#Digilent WaveForms Oscilloscope Acquisition\n\nTime (s),Channel 1 (V),Channel 2 (V)")), CHS,
    ),
    Layout(
        "Rohde & Schwarz RTB", ".csv", UNITS, text(table("in s,C1 in V,C2 in mV", TIME, V, 1e3 * VSC)),
        {"channels": {"V": "C1", "Vsc": "C2"}},
    ),
    Layout(
        "Rigol", ".csv", UNITS, text(table(",CH1,CH2,\nSecond,Volt,Volt,", end=",")), CHS,
        real=("rigol_DS1052E.csv.gz", "rigol_DS1102E-D.csv", "rigol_DS2072A-5.csv"),
    ),
    Layout(
        "Scopy", ".csv", UNITS, text(table(SCOPY, np.arange(COUNT), TIME, V, VSC)), CHS,
        real=("scopes/Lab1_Square_7kHz.csv",),
    ),
    Layout(
        "GW Instek", ".csv", UNITS, pair(lambda values: table(GW_INSTEK, TIME, values, end=",")), APART
    ),
    Layout("LeCroy", ".csv", TIMES, text(table(LECROY), "latin-1"), {"channels": {"V": "Ampl1", "Vsc": "Ampl2"}}),
    Layout("Saleae", ".csv", TIMES, text(table("Time [s],Channel 0,Channel 1")), {"channels": {"V": "0", "Vsc": "1"}}),
    Layout(
        "ngspice's wrdata", ".txt", TIMES, text("\n".join(rows(TIME, V, TIME, VSC, form=" %.8e", delimiter=" "))),
        {"channels": {"V": "2", "Vsc": "column 4"}},
    ),
    Layout(
        "LTspice's export", ".txt", TIMES, text(table("time\tV(drive)\tV(skin)", form="%.15e", delimiter="\t")),
        {"channels": {"V": "V(drive)", "Vsc": "V(skin)"}},
    ),
    Layout("Yokogawa", ".csv", GRID, text(YOKOGAWA + "\n".join("," + row for row in rows(V, VSC))), CHS),
    Layout("Hantek", ".csv", GRID, pair(lambda values: table(HANTEK, values)), APART),
    Layout(
        "Rohde & Schwarz RTO, RTP", ".Wfm.csv", "time step from NAME.csv", write_beside,
        {"channels": {"V": "Ch1", "Vsc": "Ch2"}}, real=("rs_rtp_01.Wfm.csv",),
    ),
    Layout(
        "Keysight", ".bin", UNITS, functools.partial(write_agilent, b"AG10"), CHS, **SCOPE_FILES,
        real=("agilent_1.bin",),
    ),
    Layout(
        "Rigol", ".bin", UNITS, functools.partial(write_agilent, b"RG01"), CHS, **SCOPE_FILES,
        real=("rigol_MSO5000-A.bin",),
    ),
    Layout("Rigol", ".wfm", UNITS, None, CHS, **SCOPE_FILES, real=("rigol_DS1052E.wfm", "rigol_DS2072A-5.wfm")),
    Layout("Tektronix", ".wfm", UNITS, None, CHS, **SCOPE_FILES, real=("tek_golden_analog.wfm",)),
    Layout(
        "LeCroy", ".trc", UNITS, write_lecroy, {"channels": {"V": "CH2", "Vsc": "b.trc:CH2"}}, **SCOPE_FILES,
        real=("lecroy_3.trc",), resolution=LSB,
    ),
    Layout(
        "Tektronix", ".isf", UNITS, write_isf, {"channels": {"V": "Ch1", "Vsc": "b.isf:Ch1"}}, **SCOPE_FILES,
        resolution=LSB,
    ),
    Layout("LabVIEW", ".tdms", UNITS, write_tdms, NAMED, "binary", "tdms"),
    Layout("MATLAB", ".mat", "time or step", write_mat, NAMED, "array"),
    Layout("MATLAB", ".mat", "time or step", write_mat_73, NAMED, "array"),
    Layout("LabVIEW segments", ".lvm", UNITS, text(LVM_HEAD + "\n\n".join(SEGMENT + each for each in RUNS)), SECOND),
    Layout("time that starts anew", ".csv", UNITS, text("\n".join([NAMES.replace(",", "\t"), *RUNS])), SECOND),
    Layout(
        "LTspice's steps", ".txt", TIMES,
        text("time\tV(a)\tV(b)\n" + "\n".join(f"Step Information: R={n}K\n{run}" for n, run in enumerate(RUNS))),
        {**SECOND, "channels": {"V": "V(a)", "Vsc": "V(b)"}},
    ),
    Layout("LTspice", ".raw", UNITS, spice_file("mixed"), NODES, "binary"),
    Layout("ngspice", ".raw", UNITS, spice_file("text"), NODES, "binary"),
    Layout("Excel", ".xlsx, .xls", UNITS, write_sheet, kind="sheet", extra="excel"),
    Layout("OpenDocument", ".ods", UNITS, write_open_sheet, kind="sheet", extra="excel"),
    Layout("HDF5", ".h5", UNITS, write_hdf5, NAMED, "array"),
    Layout("NetCDF", ".nc", UNITS, write_netcdf, NAMED, "array"),
    Layout("NetCDF", ".nc", UNITS, write_netcdf3, NAMED, "array"),
    Layout("NumPy", ".npz", "time or step", write_npz, NAMED, "array"),
    Layout(
        "sound cards", ".wav", "sampling rate", write_wav,
        {"channels": {"V": "1", "Vsc": "2"}, "scale": {"V": 200.0, "Vsc": 20.0}}, "sound",
    ),
)  # fmt: skip
