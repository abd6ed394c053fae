"""Which drive a fit uses: the recorded one or the scene's, its frequency, and where it lies on the record."""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from fitact.compiled import as_arrays, pad_samples, to_device
from fitact.data.record import Record, resample_uniform
from fitact.errors import InputError
from fitact.model.chirp import Chirp
from fitact.model.drive import Burst, Drive, Periodic, Sampled, Sine, Square
from fitact.model.response import highpass
from fitact.scene.scene import Scene
from fitact.scene.sections import DriveSection
from fitact.units import format_percent

_CONTRADICTION = 0.05  # relative difference between the stated and the recorded drive that cannot be an inaccuracy
_EDGE_STEPS = 2.0  # error, over a whole record, of the frequency at which edges repeat
_SMOOTH_WAVEFORMS = ("sine", "triangle", "multitone")


@dataclasses.dataclass(frozen=True)
class DriveModel:
    """The drive of a fit."""

    drive: Drive  # the scene's waveform or the measured one, filled up as the samples of a channel are
    voltage: Float[np.ndarray, " samples"]  # it, at the record's times, V
    steady_state: bool  # or from rest
    unknown_charge: bool  # whether the charge at the first sample must be left free
    shift: float  # the drive starts this much later than the record's t = 0, s
    name: str  # "measured" or the waveform's name
    notes: tuple[str, ...] = ()  # sentences for information
    warnings: tuple[str, ...] = ()  # sentences on what may change the result

    @property
    def periodic(self) -> bool:
        """Whether it is expected to repeat: a burst or a chirp of a scene is not."""
        return isinstance(self.drive, Periodic | Sampled)


def choose_drive(record: Record, scene: Scene | None) -> DriveModel:
    """The recorded V where there is no scene or it says so, otherwise the scene's waveform.

    A scene that does not name a waveform stands for the nominal square; where the recorded V is not
    that square, the record is believed. In double precision.
    """
    with jax.enable_x64(True):
        return _choose_drive(record, scene)


def _choose_drive(record: Record, scene: Scene | None) -> DriveModel:
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
            f"{record.source}: does not start where the scene's sine does, and without V_V the phase of the drive"
            " cannot be told from the circuit's; record V_V, or let t = 0 be its upward zero crossing"
        )
    voltage = _voltage(drive, record.time - shift, scene.drive.steady_state)
    if shift != 0.0:
        notes.append(f"the scene's drive was shifted by {shift:.4g} s to lie on the record")
    if "V" in record:
        error = _mismatch(record, voltage)
        if named:
            _check_amplitude(record, voltage)
        if error > 0.02 and not named:
            note = "the scene names no waveform and V_V is not its nominal square: the recorded V_V drives the fit"
            return _measured_drive(record, scene.steady_state(), (note,))
        if error > 0.02:
            warnings.append(
                f"V_V differs from the scene's {scene.drive.waveform} by {format_percent(error)} rms;"
                " [drive] waveform = 'measured' would use V_V as recorded"
            )
    return DriveModel(
        drive, voltage, scene.drive.steady_state, False, shift, scene.drive.waveform, tuple(notes), tuple(warnings)
    )


def _measured_drive(record: Record, steady_state: bool | None, notes: tuple[str, ...]) -> DriveModel:
    voltage = record["V"]
    warnings: tuple[str, ...] = ()
    if has_unresolved_edge(voltage):
        warnings = (
            "V_V jumps within one sampling interval, so the times of its edges, and with them g, are uncertain by up to"
            " one interval (a free gain accounts for it); record faster, or state the waveform in a scene",
        )
    if not steady_state:
        drive = Sampled(to_device(pad_samples(record.time)), to_device(pad_samples(voltage)))
        return DriveModel(drive, voltage, False, steady_state is None, 0.0, "measured", notes, warnings)
    kept, period = whole_periods(record)
    if period is None:
        raise InputError(
            f"{record.source}: [drive] steady_state = true needs a record of at least 1.5 periods of V_V;"
            " leave steady_state out to have the charge at the first sample fitted"
        )
    time, samples = (pad_samples(x[:kept], len(record)) for x in (record.time, voltage))
    drive = as_arrays(Sampled(time, samples, period))
    return DriveModel(drive, voltage, True, False, 0.0, "measured", notes, warnings)


def whole_periods(record: Record) -> tuple[int, float | None]:
    """How many samples make the largest whole number of periods of V, and how long those are (s), or None."""
    frequency = record.frequency()
    if frequency is None:
        return len(record), None
    span = record.time[-1] - record.time[0] + record.time_step
    length = np.floor(span * frequency + min(1e-3 * span * frequency, 2.0 * record.time_step * frequency)) / frequency
    if length <= 0.0:
        return len(record), None
    kept = int(np.searchsorted(record.time, record.time[0] + length - 0.5 * record.time_step))
    return kept, float(length)


def _check_frequency(record: Record, stated: float) -> None:
    frequency = record.frequency()
    if frequency is not None and abs(frequency / stated - 1.0) > _CONTRADICTION:
        raise InputError(
            f"{record.source}: repeats at {frequency:.5g} Hz, but the scene's [drive] frequency is {stated:.5g} Hz;"
            " mend the scene, or check the unit of time"
        )


def _record_frequency(record: Record, stated: DriveSection) -> float | None:
    """The record's frequency (Hz) where it differs from the stated one by more than it is seen without a model.

    A thousandth biases b by several standard errors: generator and recorder have clocks of their own. What is less
    than this the fit finds, as a channel's clock.
    """
    frequency = record.frequency()
    if frequency is None or not stated.steady_state:  # from rest, the transient shifts where it repeats
        return None
    if stated.waveform not in _SMOOTH_WAVEFORMS:
        frequency = _frequency_from_edges(record, frequency)
    difference = abs(frequency / stated.lowest_frequency - 1.0)
    return frequency if difference > frequency_error(record, stated.waveform) else None


def frequency_error(record: Record, waveform: str) -> float:
    """Relative error of the frequency that a record of a waveform shows by itself; 0 where it shows none."""
    frequency = record.frequency()
    if frequency is None:
        return 0.0
    step = record.time_step / float(record.time[-1] - record.time[0])
    if waveform not in _SMOOTH_WAVEFORMS:  # an edge between two samples may lie anywhere there
        return _EDGE_STEPS * step
    return max(0.5 * step, _correlation_error(record, frequency))


def _correlation_error(record: Record, frequency: float) -> float:
    """Relative error of `Record.frequency`, however fine the samples: what is correlated changes with the lag."""
    periods = frequency * float(record.time[-1] - record.time[0])
    noise = record.noise(record.leading) / float(np.std(record[record.leading]))
    # a smooth signal's, and a thousand times as much where the noise is as large as the signal
    return 4e-4 * (1.0 + 1000.0 * noise**2) / periods**2


def _frequency_from_edges(record: Record, frequency: float) -> float:
    """A better frequency (Hz) of a signal with edges: one part of it, compared with others as long, finds itself."""
    time, count = record.time, record.time.size
    step = float(time[-1] - time[0]) / (count - 1)
    periods = int(2.0 / 3.0 * frequency * step * count)
    lag = periods / (frequency * step)
    reach = math.ceil(3.0 * lag * _correlation_error(record, frequency))  # which is a smooth signal's error
    length = count - round(lag) - 2 * reach
    if periods < 1 or reach <= _EDGE_STEPS or length < 1:
        return frequency
    values = resample_uniform(time, record[record.leading])

    def squared_difference(lag: int) -> float:
        off = values[lag : lag + length] - values[:length]
        return float(off @ off)

    best, stride = round(lag), reach
    while stride > 1:
        reach, stride = stride, max(stride // 10, 1)
        best = min(range(best - reach, best + reach + 1, stride), key=squared_difference)
    return periods / (best * step)


def _check_amplitude(record: Record, voltage: np.ndarray) -> None:
    wave = voltage - voltage.mean()
    ratio = float(wave @ record["V"] / (wave @ wave))
    if abs(ratio - 1.0) > _CONTRADICTION:
        raise InputError(
            f"{record.source}: V_V is {ratio:.3g} times the scene's [drive]; mend peak_to_peak (from trough to crest,"
            " not the peak) or the other keys there, or use the recorded drive: waveform = 'measured'"
        )


def _mismatch(record: Record, voltage: np.ndarray) -> float:
    """Rms difference between recorded and computed V beyond V's noise, over V's rms."""
    difference = record["V"] - voltage
    beyond = max(np.mean(difference**2) - record.noise("V") ** 2, 0.0)
    return float(np.sqrt(beyond / np.mean(voltage**2)))


def has_unresolved_edge(voltage: Float[np.ndarray, " samples"]) -> bool:
    """Whether a drive jumps by most of its height between two samples."""
    return bool(np.max(np.abs(np.diff(voltage))) > 0.6 * np.ptp(voltage))


def has_ideal_edges(drive: Drive) -> bool:
    """Whether it is a square wave, or a burst of one."""
    return isinstance(drive.wave if isinstance(drive, Burst) else drive, Square)


def ideal_edge_mask(drive: Drive, time: np.ndarray, margin: float) -> Bool[np.ndarray, " samples"]:
    """Which times lie within a margin (s) of an ideal edge of a square wave."""
    before, after = (_voltage(drive, t, True) for t in (time - margin, time + margin))
    return np.abs(after - before) > 1e-9 * np.ptp(after)


def _voltage(drive: Drive, time: np.ndarray, steady_state: bool) -> np.ndarray:
    """The drive at `time`; from rest there is none before t = 0."""
    return np.asarray(_value(drive, pad_samples(time), steady_state))[: time.size]


@eqx.filter_jit
def _value(drive: Drive, time: ArrayLike, steady_state: bool) -> Array:
    voltage = drive.value(time)
    return voltage if steady_state else jnp.where(time < 0.0, 0.0, voltage)


@eqx.filter_jit
def _shifted_voltages(drive: Drive, time: Array, shifts: Array, steady_state: bool) -> Float[Array, "shifts times"]:
    return jax.vmap(lambda shift: _value(drive, time - shift, steady_state))(shifts)


def drive_slope(choice: DriveModel, time: np.ndarray) -> Float[np.ndarray, " samples"]:
    """dV/dt of the drive at the record's times, V/s."""
    return np.asarray(_slope(choice.drive, pad_samples(time - choice.shift), choice.steady_state))[: time.size]


def unit_response(choice: DriveModel, time: np.ndarray, tau: float) -> Float[np.ndarray, " samples"]:
    """The drive's response of one time constant (s) at the record's times, V."""
    # tau as an array: for a number jit would compile anew
    voltage = _highpass(
        choice.drive, pad_samples(time - choice.shift), jnp.asarray(tau), steady_state=choice.steady_state
    )
    return np.asarray(voltage)[: time.size]


@eqx.filter_jit
def _slope(drive: Drive, time: ArrayLike, steady_state: bool) -> Array:
    return drive.slope(time, steady_state=steady_state)


_highpass = eqx.filter_jit(highpass)


def _align(
    record: Record, drive: Drive, frequency: float, steady_state: bool, min_samples: int = 20_000, n_parts: int = 8
) -> float:
    """The shift (s) that lays the drive on the record, 0 unless the record is plainly shifted.

    On V where it was recorded, otherwise on Vsc through its best linear combination of the drive and
    the drive's integral. A long record is looked at by its beginning, of `min_samples` or three periods, and the
    shifted drives in `n_parts`, which bounds memory.
    """
    few = slice(0, max(min_samples, math.ceil(3.0 / frequency / record.time_step)))
    if "V" not in record and "Vsc" not in record:
        raise InputError(f"{record.source}: I alone does not show where the drive begins; record V_V as well")
    time, target = record.time[few], record[record.leading][few]
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
    # the middle of what fits equally well: an ideal edge may lie anywhere between two samples
    shift = float(np.mean(fine[fine_errors <= fine_errors.min() * (1.0 + 25.0 / target.size)]))
    return shift - 1.0 / frequency if shift > 0.5 / frequency else shift


def _residual_sums_of_squares(
    waves: Float[np.ndarray, "waves times"], target: Float[np.ndarray, " times"], use_integral: bool
) -> Float[np.ndarray, " waves"]:
    """The least sum of squares that each wave (and its integral) leaves of a target of mean 0; inf if upside down."""
    waves = waves - waves.mean(axis=1, keepdims=True)
    integral = np.cumsum(waves, axis=1)
    columns = np.stack([waves, integral - integral.mean(axis=1, keepdims=True)][: 1 + use_integral], axis=1)
    products = columns @ target
    weights = np.vecdot(np.linalg.pinv(columns @ columns.mT, hermitian=True), products[:, None])
    square = float(target @ target)
    # what is left of records without noise is rounding
    remainders = np.maximum(square - np.vecdot(weights, products), 1e-12 * square)
    return np.where(weights[:, 0] > 0.0, remainders, math.inf)
