"""Damage files at random: each must give a record, spectra or a one-line error, quickly and in little memory.

    python -m tests.fuzz --count 20000 --seed 0

A finding is printed with its number, which suffices to create the file again:
--first NUMBER --count 1 --keep broken.csv
"""

import argparse
import collections
import random
import resource
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import fitact
from fitact.inspection.preview import preview
from fitact.readers.capture import resolve_channels
from fitact.readers.read import read_capture
from fitact.readers.spectrum import is_spectrum
from tests.layouts.layout import REAL, SCOPE
from tests.layouts.records import RECORDS
from tests.layouts.spectra import SPECTRA

SECONDS = 10.0  # time limit for one file, s
MEGABYTES = 1000.0  # limit on the rise of peak memory by one file, MB; a string of damaged length in HDF5 takes 800
TOKENS = (
    b"nan", b"inf", b"-inf", b"1e999", b"-1e-999", b"9.9E+37", b"", b"-", b".", b"e", b"1,5", b"0x1F", b"1_000", b'"',
    b";", b"\t", b"#", b",,,,", b"9" * 400, b"\xe2\x88\x9e", b"\xb5s", b"\xff\xfe", b"\0", b"\r", b"\n\n", b"Start",
    b"Increment", b"Segments", b"Record Length", b"time_s", b"V_V", b"(ms)", b"-1", b"0", b"1e300", b"4294967295", b"=",
)  # fmt: skip


def samples() -> dict[str, bytes]:
    """Return the files to damage: the shipped ones, one in each layout, and others' spectra where they are at hand."""
    paths = [path for path in sorted(SCOPE.iterdir()) if path.suffix != ".md"]
    paths += [path for kind in ("bode", "impedance_py", "pyimpspec") for path in sorted((REAL / kind).glob("*"))]
    found = {path.name: path.read_bytes() for path in paths}
    for number, layout in enumerate((*RECORDS, *SPECTRA)):
        if layout.write is not None:
            with tempfile.TemporaryDirectory() as folder:
                path = layout.write(Path(folder))
                found[f"{number} {path.name}"] = path.read_bytes()
    return found


def broken(files: dict[str, bytes], seed: int, number: int) -> tuple[str, bytes]:
    """Return the name and content of damaged file `number`."""
    rng = random.Random(f"{seed} {number}")
    name = rng.choice(sorted(files))
    content = bytearray(files[name])
    other = files[rng.choice(sorted(files))]
    for _ in range(rng.choice((1, 1, 2, 5, 20))):
        rng.choice((_flip, _flip_early, _cut, _drop, _double, _splice, _token, _token, _swap_lines))(
            rng, content, other
        )
    return name, bytes(content)


def _place(rng: random.Random, content: bytearray) -> tuple[int, int]:
    start = rng.randrange(len(content) + 1)
    return start, min(len(content), start + int(rng.paretovariate(0.7)))


def _flip(rng: random.Random, content: bytearray, other: bytes) -> None:
    if content:
        content[rng.randrange(len(content))] = rng.randrange(256)


def _flip_early(rng: random.Random, content: bytearray, other: bytes) -> None:
    if content:
        content[rng.randrange(min(len(content), 512))] = rng.choice((0, 1, 127, 128, 255, rng.randrange(256)))


def _cut(rng: random.Random, content: bytearray, other: bytes) -> None:
    del content[rng.randrange(len(content) + 1) :]


def _drop(rng: random.Random, content: bytearray, other: bytes) -> None:
    start, stop = _place(rng, content)
    del content[start:stop]


def _double(rng: random.Random, content: bytearray, other: bytes) -> None:
    start, stop = _place(rng, content)
    content[start:start] = content[start:stop]


def _splice(rng: random.Random, content: bytearray, other: bytes) -> None:
    start, stop = _place(rng, content)
    at = rng.randrange(len(other))
    content[start:stop] = other[at : at + stop - start]


def _token(rng: random.Random, content: bytearray, other: bytes) -> None:
    """Return a replacement for a cell, which is in the header half of the time."""
    start = rng.randrange(min(len(content), rng.choice((300, len(content)))) + 1) if content else 0
    stop = start
    while stop < len(content) and content[stop] not in b",;\t\n ":
        stop += 1
    content[start:stop] = rng.choice(TOKENS)


def _swap_lines(rng: random.Random, content: bytearray, other: bytes) -> None:
    lines = bytes(content).split(b"\n")
    i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
    lines[i], lines[j] = lines[j], lines[i]
    content[:] = b"\n".join(lines)


def outcome(path: Path, segment: int | None = None) -> str:
    """Return "spectrum", "record", "capture" or "refused" for a file; any other exception is raised.

    Where a file holds several segments, the first is read.
    """
    try:
        if is_spectrum(path):
            for spectrum in fitact.read_spectra(path):
                assert np.all(np.isfinite(spectrum.values) & np.isfinite(spectrum.frequency))
                assert np.all(np.diff(spectrum.frequency) > 0.0)
            return "spectrum"
        capture = read_capture(path, segment=segment)
        assert len({trace.values.size for trace in capture.channels} | {capture.time.size}) == 1
        fitact.inspect(path, segment=segment)
    except fitact.InputError as error:
        _one_sentence(error, path)
        assert len(preview(path, segment=segment)) < 100_000  # characters
        return outcome(path, 1) if segment is None and "--segment 1" in str(error) else "refused"
    names = [trace.name for trace in capture.channels]
    try:
        asked = {} if any(n.lower() == "vsc" for n in names) else {"Vsc": names[-1]}
        resolve_channels(names, asked, str(path))
        scene = fitact.Scene(drive={"waveform": "square"})
        record = fitact.read(path, scene, channels=asked, segment=segment)
    except fitact.InputError as error:
        _one_sentence(error, path)
        return "capture"
    assert np.all(np.isfinite(record["Vsc"]))
    assert np.all(np.diff(record.time) > 0.0)
    return "record"


def _one_sentence(error: fitact.InputError, path: Path) -> None:
    text = str(error)
    if "\n" in text or str(path) not in text or len(text) > 900:
        raise AssertionError(f"no good sentence: {text[:300]!r}")


def findings(count: int, seed: int, first: int = 0, keep: Path | None = None) -> Iterator[tuple[int, str, str]]:
    """Yield number, name and outcome of each damaged file; the outcome of a finding begins with "FOUND"."""

    def late(*_: object) -> None:
        raise TimeoutError(f"longer than {SECONDS:g} s")

    files = samples()
    before = signal.signal(signal.SIGALRM, late)
    try:
        with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)  # which a user would see above the sentence
            for number in range(first, first + count):
                name, content = broken(files, seed, number)
                path = keep or Path(folder) / name
                path.write_bytes(content)
                signal.setitimer(signal.ITIMER_REAL, SECONDS)
                peak = _peak()
                try:
                    result = outcome(path)
                    if _peak() - peak > MEGABYTES:
                        result = f"FOUND memory: {_peak() - peak:.0f} MB more"
                except BaseException as error:  # any exception that a parser does not handle
                    if isinstance(error, KeyboardInterrupt):
                        raise
                    result = f"FOUND {type(error).__name__}: {error}"
                finally:
                    signal.setitimer(signal.ITIMER_REAL, 0.0)
                yield number, name, result
    finally:
        signal.signal(signal.SIGALRM, before)


def _peak() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=20_000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="write the broken file here instead")
    given = parser.parse_args()
    outcomes: collections.Counter[str] = collections.Counter()
    slowest, before = 0.0, time.perf_counter()
    base = _peak()
    for number, name, result in findings(given.count, given.seed, given.first, given.keep):
        now = time.perf_counter()
        if number > given.first:  # the first file includes the import of the parsers
            slowest = max(slowest, now - before)
        before = now
        outcomes[result.split()[0]] += 1
        if result.startswith("FOUND"):
            print(number, name, result[:300])
    print(f"{dict(outcomes)}; slowest {slowest:.2f} s; memory {base:.0f} to {_peak():.0f} MB")
    return 1 if outcomes["FOUND"] else 0


if __name__ == "__main__":
    sys.exit(main())
