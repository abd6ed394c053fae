"""Each refusal of a reader: a file that reaches it, and its sentence, which says what was found and what helps."""

import ast
import contextlib
import dataclasses
import functools
import gzip
import re
import struct
import sys
import types
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io

import fitact
from fitact.data import record, spectrum
from fitact.inspection import inspection
from fitact.readers import (
    binary,
    capture,
    extras,
    header,
    layouts,
    matlab,
    read,
    segments,
    spice,
    spreadsheet,
    stream,
    text,
)
from fitact.readers import spectrum as spectrum_files
from tests.data.test_bad_input import KINDS, make_file
from tests.data.test_layouts import REFUSED as REFUSED_LAYOUTS
from tests.data.test_scope_files import SKIN
from tests.data.test_spectrum import BROKEN
from tests.data.test_spectrum import broken as write_broken
from tests.layouts.files import raw, write_xlsx
from tests.layouts.layout import SCOPE, TIME, VSC, V, rows
from tests.layouts.records import ARRAYS, PLAIN, spice_file, write_mat, write_tdms, write_wav
from tests.layouts.spectra import FILES, FREQUENCY, GAIN, Z
from tests.layouts.spectra import write as write_spectrum

READERS = (
    binary, capture, extras, header, layouts, matlab, read, segments, spice, spreadsheet, stream, text, spectrum_files,
    record, spectrum, inspection,
)  # fmt: skip
OPTIONS = {"--rate": "rate=", "--channel": "channels=", "--scale": "scale=", "--segment": "segment="}
REMEDIES = re.compile(
    r"--[a-z]|\b(add|average|begin|check|choose|correct|drop|export|give|interpolate|keep|measure|name|pip|put|record"
    r"|remove|rename|save|scale|shorten|sort|state|store|write)\b"
)
MAKERS = [
    *(maker for maker, _ in layouts.MAKERS if maker not in ("fitact", "text")),
    "Tektronix", "Scopy", "Yokogawa", "Hantek", "LabVIEW", "LTspice", "ngspice", "MATLAB", "Gamry", "NAME.csv",
]  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Refusal:
    """A file that is refused.

    Attributes:
        write: writes it into a folder, and returns its path.
        words: regular expression of a part of the sentence.
        options: arguments of `call` besides the path.
        call: function that reads the file.
        maker: name that the sentence may state, because the file is by this maker.
        patched: module and attribute, or dictionary and key, and value, for conditions that a file cannot cause.
    """

    write: Callable[[Path], Path]
    words: str
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    call: Callable[..., Any] = fitact.read
    maker: str = ""
    patched: tuple[Any, str, Any] | None = None


def put(content: str | bytes, name: str = "record.csv") -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        path = folder / name
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    return write


def scope(name: str, size: float = 1.0) -> Callable[[Path], Path]:
    """Return the writer of the first part of a shipped file."""
    content = (SCOPE / name).read_bytes()
    return put(content[: int(size * len(content))], name)


def npz(**arrays: Any) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        np.savez(folder / "record.npz", **arrays)
        return folder / "record.npz"

    return write


def cut(write: Callable[[Path], Path], size: float) -> Callable[[Path], Path]:
    """Return the writer of the first part of a file."""

    def write_part(folder: Path) -> Path:
        path = write(folder)
        path.write_bytes(path.read_bytes()[: int(size * path.stat().st_size)])
        return path

    return write_part


def write_iq(folder: Path) -> Path:
    scipy.io.savemat(folder / "iq.mat", {"sampleInterval": 4e-7, "IQData": np.exp(1j * TIME)})
    return folder / "iq.mat"


def write_zip(folder: Path) -> Path:
    with zipfile.ZipFile(folder / "a.zip", "w") as file:
        file.writestr("record.csv", "0,1,2\n")
    return folder / "a.zip"


def write_damaged_sheet(folder: Path) -> Path:
    with zipfile.ZipFile(folder / "a.xlsx", "w") as file:
        file.writestr("xl/workbook.xml", "0,1,2\n")
    return folder / "a.xlsx"


def write_short_segment(folder: Path) -> Path:
    """Write a segment of Keysight's memory whose headers, of 140 and 12 bytes, state more samples than there are."""
    real, count = (SCOPE / "agilent_1.bin").read_bytes(), 1000
    body = real[12:148] + struct.pack("<I", 1) + real[152:160] + struct.pack("<i", 4 * count) + real[164:][: 4 * count]
    (folder / "a.bin").write_bytes(real[:4] + struct.pack("<2I", 12 + len(body), 1) + body)
    return folder / "a.bin"


def analysis(name: str, axis: str) -> Callable[[Path], Path]:
    """Return the writer of a raw file with another analysis of two voltages."""
    waves = {node: ("voltage", size * GAIN) for node, size in (("V(a)", 1.0), ("V(b)", 2.0))}
    content = raw([(FREQUENCY, waves)], "double", "complex", name=name)
    return put(content.replace(b"\tfrequency\tfrequency", f"\t{axis}\t{axis}".encode()), "a.raw")


def write_huge_hdf5(folder: Path) -> Path:
    import h5py

    with h5py.File(folder / "a.h5", "w") as file:
        file.create_dataset("Vsc", (10**10,), "f8", chunks=(1000,))
    return folder / "a.h5"


def write_two_rates(folder: Path) -> Path:
    nptdms = pytest.importorskip("nptdms")
    with nptdms.TdmsWriter(str(folder / "a.tdms")) as file:
        for step, (name, values) in zip((1e-5, 2e-5), ARRAYS.items(), strict=True):
            file.write_segment(
                [nptdms.ChannelObject("scope", name, values, {"wf_increment": step, "wf_start_offset": 0.0})]
            )
    return folder / "a.tdms"


def write_two_files(folder: Path) -> Path:
    for name, count in (("C1.csv", 300), ("C2.csv", 299)):
        put("\n".join(["Time,Ampl", *rows(TIME[:count], V[:count])]), name)(folder)
    return folder / "C1.csv"


def sweep(scale: complex = 1.0) -> Callable[[Path], Path]:
    return lambda folder: write_spectrum(folder / "z.csv", *FILES["plain.csv"], scale * Z)


def write_two_sweeps(folder: Path) -> Path:
    first, second = (sweep(scale)(folder).read_text().splitlines() for scale in (1.0, 0.5))
    return put("\n".join([*first, *second[1:]]), "z.csv")(folder)


def from_arrays(path: Path, **channels: np.ndarray) -> fitact.Record:
    return fitact.Record.from_arrays(TIME, source=str(path), **channels)


def spectrum_from_arrays(path: Path, frequency: np.ndarray, values: np.ndarray) -> fitact.Spectrum:
    return fitact.Spectrum.from_arrays(frequency, values, str(path))


def select_band(path: Path) -> fitact.Spectrum:
    return fitact.read_spectrum(path).select_band(10.0, 15.0)


def raise_an_error(*_: object) -> Any:
    raise OSError("the disk is gone")


NO_CHANNELS = types.SimpleNamespace(Wfm=types.SimpleNamespace(from_file=lambda _: types.SimpleNamespace(channels=[])))
KEYSIGHT = scope("keysight_scope_0.csv")
REFUSALS: dict[str, Refusal] = {
    **{
        name: Refusal(functools.partial(make_file, name), re.escape(words), dict(*options))
        for name, (verdict, _, words, *options) in KINDS.items()
        if verdict == "refused"
    },
    **{name: Refusal(put("\n".join(lines)), words) for name, (lines, words) in REFUSED_LAYOUTS.items()},
    **{
        f"spectrum, {name}": Refusal(
            lambda folder, lines=lines: write_broken(folder, *lines), words, call=fitact.read_spectrum
        )
        for name, (lines, words) in BROKEN.items()
    },
    # text
    "header of another file": Refusal(
        put("\n".join(rows(V, VSC)), "record.Wfm.csv"), r"put NAME\.csv, which holds the time", maker="NAME.csv"
    ),
    "header of another file, real": Refusal(scope("rs_rtp_01.Wfm.csv"), r"put NAME\.csv", maker="NAME.csv"),
    "cut file, real": Refusal(
        scope("tek_analog_waveform_first100lines.csv"), "states 50,000 rows, but the file has 86",
        {"channels": {"Vsc": "REF7"}},
    ),
    "invalid file, real": Refusal(scope("tek_invalid_csv.csv"), "no column time_s"),
    "invalid length, real": Refusal(scope("tek_invalid_record_length.csv"), "no column time_s"),
    "time alone": Refusal(put("\n".join(["time_s", *rows(TIME)])), "the only column of numbers is the time"),
    "packed binary": Refusal(put(gzip.compress(bytes(range(256)) * 50)), "neither a text file"),
    "endless line": Refusal(put(PLAIN + "1" * 9_000_000), "has a line of 9,000,000 bytes"),
    "text without end": Refusal(
        put(PLAIN), "of uncompressed text",
        call=lambda path: text.read_text(path, str(path), lambda names, _: names, max_bytes=99),
    ),
    "disk that is gone": Refusal(
        put(PLAIN), "cannot be read", call=lambda path: list(stream.stream_record(path)),
        patched=(stream, "_chunks", raise_an_error),
    ),
    # the assignment of columns
    "unknown channel": Refusal(KEYSIGHT, "'U' is no channel of fitact", {"channels": {"U": "1"}}),
    "current from volts": Refusal(
        KEYSIGHT, r"1 is in V, but I needs A; .* --scale I=0.001", {"channels": {"I": "1", "Vsc": "2"}}
    ),
    "factor without a channel": Refusal(KEYSIGHT, "I is scaled but not there", {"channels": SKIN, "scale": {"I": 2.0}}),
    "factor of an unknown channel": Refusal(KEYSIGHT, "'U' is no ch", {"channels": SKIN, "scale": {"U": 2.0}}),
    "unknown name in another file": Refusal(
        write_two_files, "there is no column 'B'", {"channels": {"Vsc": "Ampl", "V": "C1.csv:B"}}
    ),
    "files of two acquisitions": Refusal(
        write_two_files, "same acquisition", {"channels": {"Vsc": "Ampl", "V": "C2.csv:Ampl"}}
    ),
    "negative rate": Refusal(put(PLAIN), "is no sampling rate", {"rate": -1.0}),
    "rate that is no number": Refusal(put(PLAIN), "is no sampling rate", {"rate": np.nan}),
    "rounded times without names": Refusal(
        put("\n".join(["time_s,a,b", *rows(TIME, V, VSC, form="%.3f")])), "times are not increasing",
        call=fitact.inspect,
    ),
    "sound without its full scale": Refusal(
        write_wav, r"give the full scale, for 10 V as --scale V=10",
        {"channels": {"V": "1", "Vsc": "2"}},
    ),
    # binary files and arrays
    "cut Keysight": Refusal(scope("agilent_1.bin", 0.8), r"cannot be read .*; export the record again"),
    "cut LeCroy": Refusal(scope("lecroy_3.trc", 0.8), r"cannot be read .*; export the record again"),
    "cut Rigol": Refusal(scope("rigol_DS2072A-5.wfm", 0.8), r"cannot be read .*; export the record again"),
    "cut Rigol MSO": Refusal(scope("rigol_MSO5000-A.bin", 0.8), r"cannot be read .*; export the record again"),
    "six samples": Refusal(
        scope("tek_golden_analog.wfm"), "6 samples are too few", {"channels": {"Vsc": "CH 1"}}
    ),
    "missing extra": Refusal(
        scope("agilent_1.bin"), r"needs RigolWFM, .* pip install 'fitact\[scope\]'",
        patched=(sys.modules, "RigolWFM.wfm", None),
    ),
    "no channel": Refusal(
        scope("agilent_1.bin"), "no analogue channel", patched=(sys.modules, "RigolWFM.wfm", NO_CHANNELS)
    ),
    "cut TDMS": Refusal(cut(write_tdms, 0.7), "truncated or damaged"),
    "two sampling rates": Refusal(
        write_two_rates, "different times than 'drive'", {"channels": {"V": "drive", "Vsc": "skin"}}
    ),
    "cut MATLAB": Refusal(cut(write_mat, 0.7), "cannot be read"),
    "another zip": Refusal(write_zip, "is a zip archive"),
    "complex numbers": Refusal(write_iq, "complex"),
    "short segment": Refusal(write_short_segment, "has 1,000 of 2,000 samples", {"channels": {"Vsc": "CH 1"}}),
    "second of one segment": Refusal(put(PLAIN), "holds one segment", {"segment": 2}),
    "operating points": Refusal(analysis("Operating Point", "x"), "no transient analysis"),
    "two voltages": Refusal(
        analysis("AC Analysis", "frequency"), r"which of the voltages V\(a\), V\(b\)", call=fitact.read_spectrum
    ),
    "cut raw file": Refusal(cut(spice_file("mixed"), 0.7), "so it is truncated"),
    "empty sheet": Refusal(lambda folder: write_xlsx(folder / "a.xlsx", [["V"], ["Vsc"]]), "no sheet has rows"),
    "damaged sheet": Refusal(write_damaged_sheet, "cannot be read .*; save the sheet again"),
    "counts": Refusal(npz(XInc=1e-6, YInc=0.01, Vsc=np.arange(50)), "ADC counts"),
    "arrays without time": Refusal(npz(Vsc=TIME), "has no time"),
    "arrays without channels": Refusal(npz(time=TIME), "no one-dimensional array except the time"),
    "huge array": Refusal(write_huge_hdf5, "more than the file can hold"),
    # arrays of a program, in place of a file
    "no channel given": Refusal(put(PLAIN), "no channel was given", call=from_arrays),
    "shapes": Refusal(put(PLAIN), "has shape", {"Vsc": TIME[1:]}, from_arrays),
    # spectra
    "spectrum in place of a record": Refusal(sweep(), "is a spectrum, without time"),
    "record in place of a spectrum": Refusal(put(PLAIN), "no line names a frequency", call=fitact.read_spectrum),
    "two spectra": Refusal(
        write_two_sweeps, r"holds 2 spectra; choose one, as --segment 1", call=fitact.read_spectrum
    ),
    "third of two spectra": Refusal(
        write_two_sweeps, "there is no number 3", {"segment": 3}, fitact.read_spectrum
    ),
    "narrow band": Refusal(sweep(), "2 of 41 points", call=select_band),
    "shapes of a spectrum": Refusal(
        sweep(), "has shape", {"frequency": FREQUENCY, "values": FREQUENCY[1:]}, spectrum_from_arrays
    ),
    "frequency of zero": Refusal(
        sweep(), "holds the frequency 0 Hz", {"frequency": np.arange(9.0), "values": np.ones(9)}, spectrum_from_arrays
    ),
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Sentence:
    """Answer to a file: the sentence, the path, and the file and line that raised it."""

    text: str
    path: str
    site: tuple[str, int]

    @property
    def body(self) -> str:
        return self.text.replace(self.path, "FILE")

    @property
    def remedy(self) -> str:
        return self.body.partition("; ")[2]


@pytest.fixture(scope="module")
def sentences(tmp_path_factory) -> dict[str, Sentence]:
    """Feed every reader what it refuses."""
    said = {}
    for name, refusal in REFUSALS.items():
        path = refusal.write(tmp_path_factory.mktemp("refused"))
        with contextlib.ExitStack() as stack:
            if refusal.patched:
                patch = stack.enter_context(pytest.MonkeyPatch.context())
                set_value = patch.setitem if isinstance(refusal.patched[0], dict) else patch.setattr
                set_value(*refusal.patched)
            caught = stack.enter_context(pytest.raises(fitact.InputError))
            refusal.call(path, **refusal.options)
        frames = [(str(frame.path), frame.lineno + 1) for frame in caught.traceback]
        site = next(frame for frame in reversed(frames) if frame[0] in {module.__file__ for module in READERS})
        said[name] = Sentence(str(caught.value), str(path), site)
    return said


def raises() -> list[tuple[str, int, int]]:
    """Return file, first and last line of each statement of the readers that raises InputError."""
    found = []
    for module in READERS:
        for node in ast.walk(ast.parse(Path(str(module.__file__)).read_text("utf-8"))):
            called = node.exc.func if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) else None
            if isinstance(called, ast.Name) and called.id in ("InputError", "SpectrumFileError", "read_error"):
                found.append((str(module.__file__), node.lineno, node.end_lineno or node.lineno))
    return found


def test_every_refusal_of_a_reader_has_a_file(sentences):
    reached = [sentence.site for sentence in sentences.values()]
    missing = [
        f"{file}:{first}"
        for file, first, last in raises()
        if not any(site == file and first <= line <= last for site, line in reached)
    ]
    assert missing == []
    assert len(raises()) >= 60


@pytest.mark.parametrize("name", REFUSALS)
def test_a_refusal_says_what_was_found_and_what_helps(name: str, sentences):
    refusal, sentence = REFUSALS[name], sentences[name]
    assert re.search(refusal.words, sentence.text), sentence.text
    assert sentence.path in sentence.text
    assert "\n" not in sentence.text
    assert not re.search(r"\. [A-Z]", sentence.body), "two sentences"
    assert len(sentence.body) < 400
    assert REMEDIES.search(sentence.remedy), sentence.body
    for option, argument in OPTIONS.items():
        assert f"{option} " not in sentence.body or argument in sentence.body or "with " + option in sentence.body, (
            f"{sentence.body} has no word on Python"
        )
    makers = [maker for maker in MAKERS if re.search(rf"\b{re.escape(maker)}\b", sentence.body)]
    assert set(makers) <= {refusal.maker}, sentence.body
