"""Binary files of oscilloscopes (read by RigolWFM), LabVIEW (TDMS), MATLAB, HDF5, NetCDF and NumPy.

Optional parsers are imported where they are used. Any error of a parser becomes one sentence.
"""

import contextlib
import dataclasses
import io
import logging
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import lazy_loader
import numpy as np

from fitact.errors import RATE_OPTION, InputError
from fitact.files import read_head
from fitact.readers import layouts
from fitact.readers.capture import FULL_SCALE, Capture, FileChannel, Pick
from fitact.readers.extras import import_extra
from fitact.readers.matlab import read_mat
from fitact.readers.segments import choose_segment, select_segment
from fitact.readers.spice import is_spice, read_spice

h5py, scipy = lazy_loader.load("h5py"), lazy_loader.load("scipy")

_SCOPE = re.compile(
    rb"\A(?:AG(?:01|03|10)|RG0\d|\xa5\xa5|\xa1\xa5\0\0|\x01\xff\xff\xff|[\x0f\xf0]{2}.:WFM#|.{0,3}LLWFM|<\?xml)"
    rb"|WAVEDESC|:CURVE? #|NR_PT:",
    re.DOTALL,
)
_SCOPE_SUFFIXES = (".wfm", ".bin", ".trc", ".isf")


@dataclasses.dataclass
class _Contents:
    """Contents of a file: named arrays, their units, and scalar numbers and strings."""

    format: str
    arrays: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    units: dict[str, str] = dataclasses.field(default_factory=dict)
    metadata: dict[str, Any] = dataclasses.field(default_factory=dict)  # by layouts.normalize_key(name)

    def add(self, name: str, value: Any, unit: Any = "") -> None:
        """Add a value; values that are neither one-dimensional arrays, numbers nor strings are ignored."""
        array = np.squeeze(np.asarray(value))
        if array.ndim == 0 and array.dtype.kind in "iufSU":
            self.metadata[layouts.normalize_key(name.rpartition("/")[2])] = array.item()
        elif array.ndim == 1 and array.dtype.kind in "iufc":
            self.arrays[name] = array
            self.units[name] = _to_text(unit)


def is_known_binary(head: bytes, suffix: str) -> bool:
    """Return whether `read_binary` should read a file with this beginning, even if it resembles text."""
    return _find_reader(head, "" if suffix.lower() in (".csv", ".txt") else suffix) is not None


def read_binary(
    path: Path, source: str, head: bytes, pick: Pick, rate: float | None = None, segment: int | None = None
) -> Capture:
    """Return the channels of a binary file that `pick` selects, in SI units.

    `rate` (Hz) gives the times of arrays that state none, `segment` (from 1) chooses one of several.
    """
    reader = _find_reader(head, path.suffix)
    if reader is None:
        raise InputError(f"{source}: is neither a text file nor a known binary format; export the record as CSV")
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # from parsers that continue after a problem
            if reader in (_read_scope, read_spice):
                return reader(path, source, pick, segment)
            return choose_segment(_make_capture(reader(path, source), source, pick, rate), segment)
    except InputError:
        raise
    except Exception as error:  # a dozen parsers with exceptions of their own
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise InputError(f"{source}: cannot be read ({reason}); export the record again, or as CSV") from error


def _find_reader(head: bytes, suffix: str) -> Callable[..., Any] | None:
    """Return `_read_scope`, `read_spice`, or the function of path and source that reads the contents, or None."""
    readers = {
        b"\x89HDF\r\n\x1a\n": _read_hdf5, b"CDF": _read_netcdf3, b"TDSm": _read_tdms, b"PK\x03\x04": _read_npz,
        b"MATLAB 7.3": _read_hdf5, b"MATLAB": _read_mat, b"RIFF": _read_wav,
    }  # fmt: skip
    if is_spice(head):
        return read_spice
    scope = _read_scope if _SCOPE.search(head) or suffix.lower() in _SCOPE_SUFFIXES else None
    return next((reader for start, reader in readers.items() if head.startswith(start)), scope)


def _read_scope(path: Path, source: str, pick: Pick, segment: int | None) -> Capture:
    reader = import_extra("RigolWFM.wfm", "scope", source).Wfm
    if read_head(path, 2) == b"AG" and (capture := _read_keysight_segment(path, source, pick, segment)):
        return capture
    wfm = reader.from_file(str(path))
    if getattr(wfm, "frame_count", 1) > 1:  # FastFrame of Tektronix
        wfm = reader.from_file(str(path), frame=select_segment(segment, wfm.frame_count, source))
        segment = None
    if not wfm.channels:
        raise InputError(f"{source}: holds no analogue channel; export one")
    names = [str(channel.name) for channel in wfm.channels]
    wanted = set(pick(names, ""))
    units = {"v": "V", "a": "A"}
    channels, times = [], []
    for name, channel in zip(names, wfm.channels, strict=True):
        if name in wanted:
            unit = channel.unit.name
            attenuation = float(channel.probe_value) if channel.probe_value != 1.0 else None  # 1 may also mean unknown
            values = np.asarray(channel.volts, dtype=float)
            channels.append(FileChannel(name, values, units.get(unit, ""), units.get(unit, unit), attenuation))
            times.append(np.asarray(channel.times, dtype=float))
    _check_one_grid(times, [channel.name for channel in channels], source)
    maker, unread = str(wfm.header_name) or "oscilloscope", tuple(name for name in names if name not in wanted)
    capture = Capture(source, maker, times[0], tuple(channels), unread_columns=unread)
    parts = choose_segment(capture, segment, _count_sequence(path))
    return dataclasses.replace(parts, time=times[0][: parts.time.size])  # since the trigger of the segment


def _read_keysight_segment(path: Path, source: str, pick: Pick, segment: int | None) -> Capture | None:
    """Return one segment of Keysight's segmented memory, which RigolWFM parses but does not convert, or None."""
    contents = import_extra("RigolWFM.agilent_agxx_bin", "scope", source).AgilentAgxxBin.from_file(str(path))
    floats = [each for each in contents.waveforms if each.buffers and each.buffers[0].data_header.buffer_type == 1]
    numbers = sorted({each.wfm_header.segment_index for each in floats})
    if numbers in ([], [0]):
        return None
    number = numbers[select_segment(segment, len(numbers), source)]
    here = [each for each in floats if each.wfm_header.segment_index == number]
    chosen = {f"CH {each.wfm_header.waveform_label.strip()}": each for each in here}
    wanted = [name for name in chosen if name in set(pick(list(chosen), ""))]
    units, header = {1: "V", 4: "A"}, chosen[wanted[0]].wfm_header
    values = {name: np.frombuffer(chosen[name].buffers[0].data_raw, "<f4").astype(float) for name in wanted}
    channels = [FileChannel(name, values[name], units.get(int(chosen[name].wfm_header.y_units), "")) for name in wanted]
    time = header.x_origin + header.x_increment * np.arange(header.n_pts)
    for name in wanted:
        if values[name].size != time.size:
            raise InputError(f"{source}: {name} has {values[name].size:,} of {time.size:,} samples; export it again")
    return Capture(source, "Keysight", time, tuple(channels), unread_columns=tuple(set(chosen) - set(wanted)))


def _count_sequence(path: Path, place: int = 144) -> int:
    """Return the number of segments in LeCroy's sequence mode, `place` bytes into its WAVEDESC, or 1."""
    _, mark, block = read_head(path).partition(b"WAVEDESC")
    start = place - len(mark)
    order: Literal["little", "big"] = "little" if block[34 - len(mark) : 35 - len(mark)] == b"\1" else "big"
    return int.from_bytes(block[start : start + 4], order) if mark and block[8:].startswith(b"LECROY_2") else 1


def _read_wav(path: Path, source: str) -> _Contents:
    """Read a sound file, whose values are parts of the full scale."""
    rate, data = scipy.io.wavfile.read(path)
    middle, size = (128.0, 128.0) if data.dtype == np.uint8 else (0.0, 1.0)
    if data.dtype.kind == "i":
        size = float(np.iinfo(data.dtype).max) + 1.0
    contents = _Contents("sound file", metadata={"fs": rate, "start": 0.0})
    for i, values in enumerate(data.reshape(len(data), -1).T):
        contents.add(f"channel {i + 1}", (values - middle) / size, FULL_SCALE)
    return contents


def _read_tdms(path: Path, source: str) -> _Contents:
    nptdms = import_extra("nptdms", "tdms", source)
    with _capture_log("nptdms") as said, nptdms.TdmsFile.open(path) as file:
        pairs = [(group, channel) for group in file.groups() for channel in group.channels()]
        channels = {channel.name: channel for _, channel in pairs}
        if len(channels) < len(pairs):  # the same name in several groups
            channels = {f"{group.name}/{channel.name}": channel for group, channel in pairs}
        _check_size(sum(8 * len(channel) for channel in channels.values()), path, source)
        contents = _Contents("TDMS")
        times = []
        for name, channel in channels.items():
            contents.add(name, channel[:], channel.properties.get("unit_string", ""))
            if name in contents.arrays and "wf_increment" in channel.properties:
                times.append(channel.time_track())
        if said:  # nptdms reads a truncated file without an error
            raise InputError(f"{source}: is truncated or damaged ({said[0][:120]}); export the record again")
        if len(times) == len(contents.arrays) and times:
            _check_one_grid(times, list(contents.arrays), source)
            contents.add("time", times[0], "s")
    return contents


def _read_mat(path: Path, source: str) -> _Contents:
    contents = _Contents("MATLAB")
    for name, value in read_mat(path.read_bytes(), _size_limit(path)):
        contents.add(name, value)
    return contents


def _read_npz(path: Path, source: str) -> _Contents:
    contents = _Contents("NumPy")
    with np.load(path, allow_pickle=False) as file:
        if isinstance(file, np.ndarray) or not all(name.endswith(".npy") for name in file.zip.namelist()):
            raise InputError(f"{source}: is a zip archive, but not from NumPy; save the record as CSV")
        _check_size(sum(part.file_size for part in file.zip.infolist()), path, source)
        for name in file.files:
            contents.add(name, file[name])
    return contents


def _read_netcdf3(path: Path, source: str) -> _Contents:
    contents = _Contents("NetCDF")
    with scipy.io.netcdf_file(path, mmap=False) as file:
        for name, variable in file.variables.items():
            _check_size(8 * int(np.prod(variable.shape)), path, source)
            contents.add(name, variable[...].copy(), getattr(variable, "units", ""))
    return contents


def _read_hdf5(path: Path, source: str) -> _Contents:
    contents = _Contents("HDF5")
    with h5py.File(path, "r") as file:

        def visit(name: str, item: Any) -> None:
            for key in item.attrs:
                kept = item.attrs.get_id(key)
                _check_size(kept.dtype.itemsize * int(np.prod(kept.shape)), path, source)
                contents.add(key, item.attrs[key])
            if isinstance(item, h5py.Dataset) and item.dtype.kind in "iufc":
                _check_size(item.size * 8, path, source)
                contents.add(name, item[...], item.attrs.get("units", item.attrs.get("unit", "")))

        visit("", file)
        file.visititems(visit)
    return contents


def _make_capture(contents: _Contents, source: str, pick: Pick, rate: float | None) -> Capture:
    """Make a capture: find the time, or start and step of the time, among the named arrays, and the channels."""
    arrays = contents.arrays
    if any(array.dtype.kind == "c" for array in arrays.values()):
        raise InputError(f"{source}: holds complex numbers (IQ data); export voltages against time")
    last = {name: layouts.split_name_and_unit(name.rpartition("/")[2]) for name in arrays}
    times = ("time", *sorted(layouts.TIME_NAMES))
    timed = [name for wanted in times for name in arrays if last[name][0].lower() == wanted]
    others = [name for name in arrays if not timed or name != timed[0]]
    short = [last[name][0] for name in others]
    names = others if len(set(short)) < len(short) else short
    if not names:
        raise InputError(f"{source}: has no one-dimensional array except the time; store V, Vsc or I in it")
    wanted = set(pick(names, ""))
    chosen = [(name, other) for name, other in zip(names, others, strict=True) if name in wanted]
    if "yinc" in contents.metadata and any(arrays[other].dtype.kind in "iu" for _, other in chosen):
        raise InputError(f"{source}: holds ADC counts with a manufacturer's scale (YInc); export volts, or CSV")
    if timed:
        unit = last[timed[0]][1] or contents.units[timed[0]]
        time = layouts.convert_time(arrays[timed[0]].astype(float), unit, source, "store seconds")
        notes: list[str] = []
        assumed = [] if unit else [f"{source}: the file states no unit of time; seconds were assumed"]
    else:
        assumed = []
        time, notes = _time_grid(contents, arrays[chosen[0][1]].size, source, rate)
    for name, other in chosen:
        if arrays[other].size != time.size:
            raise InputError(
                f"{source}: '{name}' has {arrays[other].size:,} samples and the time {time.size:,}; store channels of"
                " equal length, or select channels with --channel"
            )
    stated = next((_to_text(contents.metadata[key]) for key in layouts.UNIT_KEYS if key in contents.metadata), "")
    channels = tuple(
        FileChannel.from_file(name, arrays[other].astype(float), last[other][1] or contents.units[other] or stated)
        for name, other in chosen
    )
    unread = tuple(name for name in names if name not in wanted)
    return Capture(
        source, contents.format, time, channels, notes=tuple(notes), warnings=tuple(assumed), unread_columns=unread
    )


def _time_grid(contents: _Contents, count: int, source: str, stated_rate: float | None) -> tuple[np.ndarray, list[str]]:
    def find(keys: Sequence[str]) -> float | None:
        return next((float(x) for x in map(contents.metadata.get, keys) if isinstance(x, int | float)), None)

    step, rate, start = (find(keys) for keys in (layouts.STEP_KEYS, layouts.RATE_KEYS, layouts.START_KEYS))
    zero = find(("zeroindex",))  # Tektronix
    rate = rate or stated_rate
    step = 1.0 / rate if step is None and rate else step
    if step is None or not 0.0 < step < float("inf"):
        raise InputError(
            f"{source}: has no time; give the sampling rate, as {RATE_OPTION}, or store an array 'time' (s) or the step"
            " 'dt' with the channels"
        )
    notes = [] if start is not None or zero is not None else [f"{source}: the time was assumed to start at 0"]
    return step * (np.arange(count) - (zero or 0.0)) + (start or 0.0), notes


@contextlib.contextmanager
def _capture_log(library: str) -> Iterator[list[str]]:
    said: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: said.append(record.getMessage())  # type: ignore[method-assign]
    logs = [logging.getLogger(name) for name in logging.root.manager.loggerDict if name.startswith(library)]
    before = [(log, log.propagate, log.handlers) for log in logs]
    for log in logs:
        log.propagate, log.handlers = False, [handler]
    try:
        yield said
    finally:
        for log, propagate, handlers in before:
            log.propagate, log.handlers = propagate, handlers


def _check_one_grid(times: Sequence[np.ndarray], names: Sequence[str], source: str) -> None:
    for time, name in zip(times, names, strict=True):
        if not layouts.is_same_grid(time, times[0]):
            raise InputError(
                f"{source}: '{name}' has a different length or different times than '{names[0]}'; export channels of"
                " one time base"
            )


def _size_limit(path: Path) -> int:
    """Return the maximum uncompressed size of the file, in bytes; deflate compresses by at most a factor 1032."""
    return 1_000_000 + 1032 * path.stat().st_size


def _check_size(size: int, path: Path, source: str) -> None:
    if size > _size_limit(path):
        raise InputError(f"{source}: the header states {size:,} bytes, more than the file can hold; export it again")


def _to_text(value: Any) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)
