"""Track of a record: reading, windows, and the random walk that joins them."""

import dataclasses
import hashlib
import itertools
import math
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np

from fitact.blas import limit_to_one_thread
from fitact.compiled import double_precision
from fitact.data.record import STATE_RATE, Record, fundamental_frequency
from fitact.data.spectrum import Spectrum
from fitact.errors import InputError
from fitact.files import atomic_write, require_folder
from fitact.problem.source import require_record
from fitact.progress import track_progress
from fitact.readers.spectrum import is_spectrum, read_spectrum
from fitact.readers.stream import Block, stream_record
from fitact.scene.scene import Scene
from fitact.scene.sections import DriveSection
from fitact.tracking.compressed_windows import (
    CompressedWindow,
    CompressedWindows,
    WindowModel,
    find_model,
    require_compressible,
    require_table,
    stack_data,
)
from fitact.tracking.solve_windows import solve_windows
from fitact.tracking.track import Track
from fitact.tracking.windows import Window, split_windows

CHECKPOINT = "windows.npz"
_HEAD_SAMPLES = 65_536  # from which the time step and the period are taken
_MIN_PERIODS, _MIN_SAMPLES = 5, 4_000  # of a default window
UPDATE_INTERVAL = 1.0  # s, between tracks of a record that is being followed


_Item = TypeVar("_Item")


class _Head(NamedTuple):
    """Sampling of a record, from its first samples."""

    step: float  # s
    samples: int  # in a window
    notes: tuple[str, ...]


def track(
    record: Record | str | os.PathLike[str],
    scene: Scene | None = None,
    *,
    window: float | None = None,
    channels: Mapping[str, str] | None = None,
    scale: Mapping[str, float] | None = None,
    rate: float | None = None,
    segment: int | None = None,
    follow: float = 0.0,
    folder: str | os.PathLike[str] | None = None,
    update: Callable[[Track], None] | None = None,
    rates: Sequence[float] | None = None,
) -> Track:
    """Follow a finger along a record of any length: Rsc, Csc, Ci, contact area and force over time.

    The record is cut into windows, each of which is compressed to a few numbers as it is read. One window is fitted;
    its model, with the recorded V as its drive, serves all. Random walks in the logarithms join the windows: in the
    contact area, in the skin's resistance times the area, and in its capacitance over the area. Their rates are
    estimated, with half-normal priors. What else is free (gains of instruments, R_H, ...) is constant. Windows in which
    the finger does not touch the panel are left out, and lost samples are bridged with growing uncertainty.

    Args:
        record: a record, the path of one, or "-" for standard input; V and the channels of the scene are needed.
        scene: device, circuit and prior. A waveform that it states is not used.
        window: length of a window, s; default: five periods of the drive, at least 4,000 samples.
        channels, scale, rate, segment: as in `fitact.read`, for a path.
        follow: seconds to wait for more samples at the end of a text file that is still being written.
        folder: folder in which an interrupted run leaves what it has compressed, and from which it goes on.
        update: called with the track so far, about once a second, while the record is followed.
        rates: standard deviations of the walks' logarithms after 1 s, instead of their estimates; 0 for constants.

    Raises:
        InputError: the record is refused, lacks V, changes its sampling rate, or a window is shorter than 1.5 periods.
    """
    if isinstance(record, Sequence) and not isinstance(record, str):
        raise InputError(f"{len(record)} records: a track follows one record; track each by itself")
    if isinstance(record, (str, os.PathLike)) and os.path.isfile(record) and is_spectrum(record):
        require_record(read_spectrum(record))
    if isinstance(record, (Record, Spectrum)):
        record = require_record(record)
        blocks: Iterator[Block] = iter([Block(record.time, record.channels, float(len(record)))])
        source, total = record.source, float(len(record))
    else:
        blocks = stream_record(record, channels=channels, scale=scale, rate=rate, segment=segment, follow=follow)
        source = os.fspath(record)
        total = float(os.path.getsize(source)) if os.path.isfile(source) and follow <= 0.0 else math.inf
    return track_blocks(blocks, source, total, scene, window=window, folder=folder, update=update, rates=rates)


def track_blocks(
    blocks: Iterator[Block],
    source: str,
    total: float,
    scene: Scene | None = None,
    *,
    window: float | None = None,
    folder: str | os.PathLike[str] | None = None,
    update: Callable[[Track], None] | None = None,
    rates: Sequence[float] | None = None,
) -> Track:
    """Follow a finger along blocks of samples, as `track` does.

    `total` is the last block's position, for progress; infinite if more may follow, so that a block may take long.
    """
    place = require_folder(None if folder is None else Path(folder))
    stated = scene or Scene()
    followed = stated.model_copy(update={"drive": DriveSection(waveform="measured")})
    require_compressible(stated, source)
    first, frequency, blocks = _read_head(blocks, followed, source)
    head = _describe_head(first, frequency, window, source)
    position = [0.0]
    windows = split_windows(_watch(blocks, position), head.step, head.samples, source)
    model, begun = _find_first_model(windows, followed, head.step, source)
    require_table(model, source)
    checkpoint = None if place is None else _Checkpoint(place / CHECKPOINT, model, followed)
    done = checkpoint.load(begun) if checkpoint else []
    compressed: list[CompressedWindow] = []
    everything: Iterable[Window] = itertools.chain(begun, windows)
    waits = math.isinf(total)
    if not waits:
        everything = track_progress(everything, f"tracking {source}", total, lambda: position[0])
    responses, last = model.respond(everything), time.monotonic()
    try:
        # the products are small, and a thread reads and filters meanwhile: BLAS leaves it its core
        with double_precision(), limit_to_one_thread():
            for number, each in enumerate(responses if waits else _read_ahead(responses)):
                compressed.append(done[number] if number < len(done) else model.compress(each))
                if update is not None and time.monotonic() - last > UPDATE_INTERVAL:
                    update(_solve(model, compressed, stated, head.notes, rates))
                    last = time.monotonic()
    except KeyboardInterrupt:
        if checkpoint:
            checkpoint.store(compressed)
        raise
    found = _solve(model, compressed, stated, head.notes, rates)
    if checkpoint:
        checkpoint.path.unlink(missing_ok=True)
    return found


def _solve(
    model: WindowModel,
    compressed: list[CompressedWindow],
    scene: Scene,
    notes: tuple[str, ...],
    rates: Sequence[float] | None,
) -> Track:
    found = solve_windows(model, CompressedWindows.from_windows(compressed), rates=rates)
    if scene.states_waveform() and scene.drive.waveform != "measured":
        notes = (*notes, f"the recorded V is the drive of a track, not the {scene.drive.waveform} of the scene")
    return dataclasses.replace(found, notes=tuple(dict.fromkeys([*found.notes, *notes])))


def _watch(blocks: Iterable[Block], position: list[float]) -> Iterator[Block]:
    for block in blocks:
        position[0] = block.position
        yield block


def _read_ahead(items: Iterator[_Item]) -> Iterator[_Item]:
    """Yield items; the next one is made in a thread while one is used."""
    with ThreadPoolExecutor(1) as reader:
        following = reader.submit(next, items, None)
        while (item := following.result()) is not None:
            following = reader.submit(next, items, None)
            yield item


def _read_head(blocks: Iterator[Block], scene: Scene, source: str) -> tuple[list[Block], float | None, Iterator[Block]]:
    """Return the first blocks, the frequency of V in them, and all; refuse a record that lacks a needed channel."""
    first, count, frequency, needed = list[Block](), 0, None, ("V", *scene.measurement.channels)
    for block in blocks:
        for name in needed:
            if name not in block.channels:
                unit = "A" if name == "I" else "V"
                raise InputError(
                    f"{source}: the channel {name}_{unit} is missing; a track needs the recorded drive and the"
                    f" channels of the scene ({', '.join(scene.measurement.channels)})"
                )
        first.append(block)
        count += block.time.size
        frequency = _find_frequency(first) if count >= _MIN_SAMPLES else None
        if count >= _HEAD_SAMPLES or frequency is not None:
            break
    if count < 20:
        raise InputError(f"{source}: holds {count} samples, too few for a track; record several periods of the drive")

    def select(block: Block) -> Block:
        return block._replace(channels={name: block.channels[name] for name in needed})

    return first, frequency or _find_frequency(first), map(select, itertools.chain(first, blocks))


def _find_frequency(first: list[Block]) -> float | None:
    """Return the frequency of V (Hz), or None if it does not repeat."""
    time = np.concatenate([block.time for block in first])[:_HEAD_SAMPLES]
    voltage = np.concatenate([block.channels["V"] for block in first])[:_HEAD_SAMPLES]
    finite = np.isfinite(voltage)
    if not finite.any() or not np.ptp(voltage[finite]) > 0.0:
        return None
    return fundamental_frequency(time[finite], voltage[finite])


def _describe_head(first: list[Block], frequency: float | None, window: float | None, source: str) -> _Head:
    """Return the time step and the number of samples in a window, from the first samples."""
    times = np.concatenate([block.time for block in first])[:_HEAD_SAMPLES]
    steps = np.diff(times)
    usual = float(np.median(steps))
    if not usual > 0.0:
        raise InputError(f"{source}: the time does not increase; if it was rounded when written, {STATE_RATE}")
    whole = steps[(steps > 0.5 * usual) & (steps < 1.5 * usual)]
    step = float(np.mean(whole))
    notes = tuple(dict.fromkeys(note for block in first for note in block.notes))
    if window is None:
        periods = 0 if frequency is None else math.ceil(_MIN_PERIODS / (frequency * step) - 0.5)
        return _Head(step, max(periods, _MIN_SAMPLES), notes)
    samples = round(window / step) if 0.0 < window < math.inf else 0
    if samples < 20:
        raise InputError(f"window = {window:g} s holds {samples} samples of {step:.3g} s; give at least 20 samples")
    if frequency is not None and samples * step < (1.5 + 1e-3) / frequency:
        raise InputError(
            f"window = {window:g} s is shorter than one and a half periods of V_V ({1.0 / frequency:.4g} s each); give"
            f" two periods or more, better {_MIN_PERIODS}"
        )
    return _Head(step, samples, notes)


def _find_first_model(
    windows: Iterator[Window], scene: Scene, step: float, source: str, rounds: int = 250, tried: int = 8
) -> tuple[WindowModel, list[Window]]:
    """Return the model of the first windows, `tried` at a time, that can be fitted, and all windows read for that."""
    begun: list[Window] = []
    for number in range(rounds):
        part = list(itertools.islice(windows, tried))
        begun += part
        if not part:
            if number == 0:
                raise InputError(f"{source}: is shorter than one window; give a shorter one with --window")
            break
        try:
            return find_model(part, scene, step, source), begun
        except InputError as error:  # perhaps the finger does not touch yet
            refusal = error
    raise refusal


class _Checkpoint:
    """Compressed windows of an interrupted run, with what they depend on."""

    def __init__(self, path: Path, model: WindowModel, scene: Scene) -> None:
        self.path, self._model, self._scene = path, model, scene

    def _key(self) -> str:
        parts = self._scene.to_json(), str(self._model.compressor.time.size), self._model.fit.record.fingerprint
        return hashlib.sha256("\0".join(parts).encode()).hexdigest()

    def store(self, windows: list[CompressedWindow]) -> None:
        if all(each.data is None for each in windows):
            return
        leaves = jax.tree.leaves(stack_data(windows))
        arrays: dict[str, Any] = {f"leaf{i}": leaf for i, leaf in enumerate(leaves)}
        for name in ("start", "lowest", "highest", "clipped"):
            arrays[name] = np.array([getattr(each, name) for each in windows])
        arrays["has_data"] = np.array([each.data is not None for each in windows])
        with atomic_write(self.path) as temporary, temporary.open("wb") as file:
            np.savez(file, key=np.array(self._key()), **arrays)

    def load(self, begun: list[Window]) -> list[CompressedWindow]:
        """Return the windows of an interrupted run with the same scene, window and first samples."""
        if not self.path.is_file():
            return []
        with np.load(self.path, allow_pickle=False) as stored:
            if str(stored["key"]) != self._key():
                return []
            with double_precision():
                whole = next(each for each in begun if each.is_whole)
                given = next(self._model.respond([whole]))
                structure = jax.tree.structure(self._model.compress(given).data)
            leaves = [stored[f"leaf{i}"] for i in range(structure.num_leaves)]
            names = "start", "lowest", "highest", "has_data", "clipped"
            rest = zip(*(stored[name] for name in names), strict=True)
            return [
                CompressedWindow(
                    float(start),
                    jax.tree.unflatten(structure, [leaf[k] for leaf in leaves]) if has_data else None,
                    float(low),
                    float(high),
                    bool(clipped),
                )
                for k, (start, low, high, has_data, clipped) in enumerate(rest)
            ]
