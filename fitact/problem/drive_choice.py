"""Choice of the drive of a fit (recorded V or the scene's waveform), its frequency and its time shift."""

import dataclasses
import functools
import math

import jax
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from fitact.compiled import as_arrays, jit, pad_samples
from fitact.data.record import Record, resample_uniform
from fitact.errors import InputError
from fitact.likelihood.projection import evaluate_voltage
from fitact.model.chirp import Chirp
from fitact.model.drive import Burst, Drive, Periodic, Sampled, Sine, Square
from fitact.model.response import drive_voltage, highpass
from fitact.scene.scene import Scene
from fitact.scene.sections import DriveSection
from fitact.units import format_percent

_CONTRADICTION = 0.05  # relative difference between stated and recorded drive above which a record is refused
_EDGE_STEPS = 2.0  # error of a frequency from edges, in time steps over the whole record
_SMOOTH_WAVEFORMS = ("sine", "triangle", "multitone")


@dataclasses.dataclass(frozen=True)
class DriveModel:
    """Drive of a fit."""

    drive: Drive  # the scene's waveform or the measured drive, padded like the samples of a channel
    voltage: Float[np.ndarray, " samples"]  # drive at the times of the record, V
    steady_state: bool  # whether the drive has repeated for long; otherwise it starts from rest
    unknown_charge: bool  # whether the charge at the first sample is a free parameter
    shift: float  # time by which the drive starts after t = 0 of the record, s
    name: str  # "measured" or the waveform's name
    notes: tuple[str, ...] = ()  # sentences for information
    warnings: tuple[str, ...] = ()  # sentences on what may change the result

    @property
    def periodic(self) -> bool:
        """Whether the drive is expected to repeat; a burst or a chirp of a scene is not."""
        return isinstance(self.drive, Periodic | Sampled)


def choose_drive(record: Record, scene: Scene | None) -> DriveModel:
    """Return the drive of a fit: the recorded V without a scene or if the scene says so, else the scene's waveform.

    A scene that names no waveform has the nominal square; if the recorded V differs from it, the recorded V is used.
    """
    if scene is None or scene.drive.waveform == "measured":
        return _measured_drive(record, scene.steady_state() if scene else None, ())
    drive, slowest = scene.make_drive(), scene.drive.lowest_frequency
    notes: list[str] = []
    warnings: list[str] = []
    named = scene.states_waveform()
    if named and not isinstance(drive, Chirp):
        _check_frequency(record, slowest)
    if named and isinstance(drive, Periodic) and (frequency := _record_frequency(record, scene.drive)) is not None:
        stated, slowest = slowest, frequency
        drive = dataclasses.replace(drive, frequency=slowest)
        warnings.append(
            f"the record repeats at {slowest:.6g} Hz, not at the scene's {stated:.6g} Hz, and its own frequency is used"
        )
    drive = as_arrays(drive)
    shift = _align(record, drive, slowest, scene.drive.steady_state)
    if shift != 0.0 and "V" not in record and isinstance(drive, Sine):
        raise InputError(
            f"{record.source}: the sine does not start at phase zero as in the scene; without V_V, the phase of the"
            " drive cannot be separated from that of the circuit; record V_V, or set t = 0 at its upward zero crossing"
        )
    voltage = evaluate_voltage(drive, record.time - shift, scene.drive.steady_state)
    if shift != 0.0:
        notes.append(f"the scene's drive was shifted by {shift:.4g} s to match the record")
    if "V" in record:
        error = _mismatch(record, voltage)
        if named:
            _check_amplitude(record, voltage)
        if error > 0.02 and not named:
            note = "the scene names no waveform and V_V is not the nominal square wave; the fit uses the recorded V_V"
            return _measured_drive(record, scene.steady_state(), (note,))
        if error > 0.02:
            warnings.append(
                f"V_V differs from the scene's {scene.drive.waveform} by {format_percent(error)} rms;"
                " set [drive] waveform = 'measured' to use V_V as recorded"
            )
    return DriveModel(
        drive, voltage, scene.drive.steady_state, False, shift, scene.drive.waveform, tuple(notes), tuple(warnings)
    )


def _measured_drive(record: Record, steady_state: bool | None, notes: tuple[str, ...]) -> DriveModel:
    voltage = record["V"]
    warnings: tuple[str, ...] = ()
    if has_unresolved_edge(record):
        warnings = (
            "V_V jumps within one sampling interval, so the times of its edges, and with them g, are uncertain by up to"
            " one interval (a free gain accounts for it); record faster, or state the waveform in a scene",
        )
    if not steady_state:
        drive = Sampled(pad_samples(record.time), pad_samples(voltage))
        return DriveModel(drive, voltage, False, steady_state is None, 0.0, "measured", notes, warnings)
    n_samples, period = whole_periods(record)
    if period is None:
        raise InputError(
            f"{record.source}: [drive] steady_state = true needs a record of at least 1.5 periods of V_V;"
            " omit steady_state to fit the charge at the first sample instead"
        )
    time, samples = (pad_samples(x[:n_samples], len(record)) for x in (record.time, voltage))
    drive = as_arrays(Sampled(time, samples, period))
    return DriveModel(drive, voltage, True, False, 0.0, "measured", notes, warnings)


def whole_periods(record: Record) -> tuple[int, float | None]:
    """Return the number of samples in the largest whole number of periods of V, and their duration (s) or None."""
    frequency = record.frequency()
    if frequency is None:
        return len(record), None
    span = record.time[-1] - record.time[0] + record.time_step
    length = np.floor(span * frequency + min(1e-3 * span * frequency, 2.0 * record.time_step * frequency)) / frequency
    if length <= 0.0:
        return len(record), None
    n_samples = int(np.searchsorted(record.time, record.time[0] + length - 0.5 * record.time_step))
    return n_samples, float(length)


def _check_frequency(record: Record, stated: float) -> None:
    frequency = record.frequency()
    if frequency is not None and abs(frequency / stated - 1.0) > _CONTRADICTION:
        raise InputError(
            f"{record.source}: repeats at {frequency:.5g} Hz, but the scene's [drive] frequency is {stated:.5g} Hz;"
            " correct the scene, or check the unit of time"
        )


def _record_frequency(record: Record, stated: DriveSection) -> float | None:
    """Return the record's frequency (Hz) if it differs from the stated one by more than its error, otherwise None.

    Generator and recorder have separate clocks; a difference of 0.1 % biases b by several standard errors. Smaller
    differences are fitted as the clock error of a channel.
    """
    frequency = record.frequency()
    if frequency is None or not stated.steady_state:  # from rest, the transient biases the frequency
        return None
    if stated.waveform not in _SMOOTH_WAVEFORMS:
        frequency = _frequency_from_edges(record, frequency)
    difference = abs(frequency / stated.lowest_frequency - 1.0)
    return frequency if difference > frequency_error(record, stated.waveform) else None


def frequency_error(record: Record, waveform: str) -> float:
    """Return the relative error of the frequency estimated from a record of `waveform`; 0 if there is no estimate."""
    frequency = record.frequency()
    if frequency is None:
        return 0.0
    step = record.time_step / float(record.time[-1] - record.time[0])
    if waveform not in _SMOOTH_WAVEFORMS:  # an edge may lie anywhere between two samples
        return _EDGE_STEPS * step
    return max(0.5 * step, _correlation_error(record, frequency))


def _correlation_error(record: Record, frequency: float) -> float:
    """Return the relative error of `Record.frequency` for fine sampling, where it comes from the finite record."""
    periods = frequency * float(record.time[-1] - record.time[0])
    noise = record.noise(record.leading) / float(np.std(record[record.leading]))
    # error of a smooth signal, which is a thousand times as large if the noise equals the signal
    return 4e-4 * (1.0 + 1000.0 * noise**2) / periods**2


def _frequency_from_edges(record: Record, frequency: float) -> float:
    """Refine the frequency (Hz) of a signal with edges by comparing a part of it with later parts of equal length."""
    time, count = record.time, record.time.size
    step = float(time[-1] - time[0]) / (count - 1)
    periods = int(2.0 / 3.0 * frequency * step * count)
    lag = periods / (frequency * step)
    half_width = math.ceil(3.0 * lag * _correlation_error(record, frequency))  # the error of a smooth signal
    length = count - round(lag) - 2 * half_width
    if periods < 1 or half_width <= _EDGE_STEPS or length < 1:
        return frequency
    values = resample_uniform(time, record[record.leading])

    def squared_difference(lag: int) -> float:
        difference = values[lag : lag + length] - values[:length]
        return float(difference @ difference)

    best, stride = round(lag), half_width
    while stride > 1:
        half_width, stride = stride, max(stride // 10, 1)
        best = min(range(best - half_width, best + half_width + 1, stride), key=squared_difference)
    return periods / (best * step)


def _check_amplitude(record: Record, voltage: np.ndarray) -> None:
    wave = voltage - voltage.mean()
    ratio = float(wave @ record["V"] / (wave @ wave))
    if abs(ratio - 1.0) > _CONTRADICTION:
        raise InputError(
            f"{record.source}: V_V is {ratio:.3g} times the scene's [drive]; correct peak_to_peak (from minimum to"
            " maximum) or the other keys there, or use the recorded drive with waveform = 'measured'"
        )


def _mismatch(record: Record, voltage: np.ndarray) -> float:
    """Return the rms difference between recorded and computed V, less the noise of V, relative to the rms of V."""
    difference = record["V"] - voltage
    excess = max(np.mean(difference**2) - record.noise("V") ** 2, 0.0)
    return float(np.sqrt(excess / np.mean(voltage**2)))


def has_unresolved_edge(record: Record) -> bool:
    """Return whether V jumps by most of its height between two samples, and is no fast tone."""
    largest, height = np.max(np.abs(np.diff(record["V"]))), np.ptp(record["V"])
    return bool(has_unresolved_edges(largest, height)) and record.tones is None


def has_unresolved_edges(largest_step: ArrayLike, height: ArrayLike) -> Bool[np.ndarray, "*records"]:
    """Return `has_unresolved_edge` for drives with these largest steps between samples and these heights."""
    return np.asarray(largest_step) > 0.6 * np.asarray(height)


def has_ideal_edges(drive: Drive) -> bool:
    """Return whether the drive is an ideal square wave, or a burst of one."""
    return isinstance(drive.wave if isinstance(drive, Burst) else drive, Square)


def ideal_edge_mask(drive: Drive, time: np.ndarray, margin: float) -> Bool[np.ndarray, " samples"]:
    """Return which times lie within `margin` (s) of an ideal edge of a square wave."""
    before, after = (evaluate_voltage(drive, t, True) for t in (time - margin, time + margin))
    return np.abs(after - before) > 1e-9 * np.ptp(after)


@functools.partial(jit, fast=True)
def _shifted_voltages(drive: Drive, time: Array, shifts: Array, steady_state: bool) -> Float[Array, "shifts times"]:
    return jax.vmap(lambda shift: drive_voltage(drive, time - shift, steady_state=steady_state))(shifts)


def drive_slope(choice: DriveModel, time: np.ndarray) -> Float[np.ndarray, " samples"]:
    """Return dV/dt of the drive at the times of the record, V/s."""
    return np.asarray(_slope(choice.drive, pad_samples(time - choice.shift), choice.steady_state))[: time.size]


def unit_response(choice: DriveModel, time: np.ndarray, tau: float) -> Float[np.ndarray, " samples"]:
    """Return the drive filtered by a high-pass of time constant `tau` (s), at the times of the record, V."""
    # tau is passed as an array, because jit would compile again for every new number
    voltage = _highpass(
        choice.drive, pad_samples(time - choice.shift), np.asarray(tau), steady_state=choice.steady_state
    )
    return voltage[: time.size]


@jit
def _slope(drive: Drive, time: ArrayLike, steady_state: bool) -> Array:
    return drive.slope(time, steady_state=steady_state)


_highpass = jit(highpass)


def _align(record: Record, drive: Drive, frequency: float, steady_state: bool) -> float:
    """Return the time shift (s) of the drive that matches the record, 0 unless the record is clearly shifted.

    The drive is compared with V if it was recorded, otherwise its best linear combination with its integral is
    compared with Vsc.
    """
    min_samples = 20_000  # used of a long record, or three periods
    n_parts = 8  # in which the shifted drives are processed, to limit memory
    beginning = slice(0, max(min_samples, math.ceil(3.0 / frequency / record.time_step)))
    if "V" not in record and "Vsc" not in record:
        raise InputError(f"{record.source}: I alone does not determine the start of the drive; record V_V as well")
    time, target = record.time[beginning], record[record.leading][beginning]
    target = target - target.mean()

    def sums_of_squares(shifts: np.ndarray) -> np.ndarray:
        waves = np.asarray(_shifted_voltages(drive, pad_samples(time), shifts, steady_state))[:, : time.size]
        parts = np.array_split(waves, n_parts)
        return np.concatenate([_residual_sums_of_squares(part, target, "V" not in record) for part in parts])

    shifts = np.arange(0.0, 1.0, 1.0 / 128.0) / frequency
    errors = sums_of_squares(shifts)
    best = int(np.argmin(errors))
    fine = shifts[best] + np.linspace(-1.0, 1.0, 129) / (128.0 * frequency)
    fine_errors = sums_of_squares(fine)
    if errors[0] <= 2.0 * fine_errors.min():
        return 0.0
    # the mean of all shifts that fit equally well, because an ideal edge may lie anywhere between two samples
    shift = float(np.mean(fine[fine_errors <= fine_errors.min() * (1.0 + 25.0 / target.size)]))
    return shift - 1.0 / frequency if shift > 0.5 / frequency else shift


def _residual_sums_of_squares(
    waves: Float[np.ndarray, "waves times"], target: Float[np.ndarray, " times"], use_integral: bool
) -> Float[np.ndarray, " waves"]:
    """Return the residual sum of squares of `target` (mean 0) fitted by each wave; inf if the amplitude is negative.

    With `use_integral`, the integral of the wave is a second regressor.
    """
    waves = waves - waves.mean(axis=1, keepdims=True)
    integral = np.cumsum(waves, axis=1)
    columns = np.stack([waves, integral - integral.mean(axis=1, keepdims=True)][: 1 + use_integral], axis=1)
    products = columns @ target
    weights = np.vecdot(np.linalg.pinv(columns @ columns.mT, hermitian=True), products[:, None])
    square = float(target @ target)
    # records without noise leave only rounding errors
    sums_of_squares = np.maximum(square - np.vecdot(weights, products), 1e-12 * square)
    return np.where(weights[:, 0] > 0.0, sums_of_squares, math.inf)
