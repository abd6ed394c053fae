"""Records, i.e. measurements in time, with checks of the data."""

import dataclasses
import functools
import hashlib
import math
import weakref
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from fitact import charts
from fitact.compiled import empty_aligned
from fitact.data.clipping import clipping_mask, replace_codes
from fitact.data.noise import estimate_noise, rounding_noise_sd, white_noise_sd
from fitact.data.tones import Tones, find_tones
from fitact.errors import RATE_OPTION, InputError, channel_option
from fitact.tables import Display, to_dataframe
from fitact.units import format_engineering

MINIMUM_SAMPLES = 20
OVERFLOW = 9e36  # oscilloscopes write 9.9E+37 or more for a value out of range
CHANNEL_UNITS = {"V": "V", "Vsc": "V", "I": "A", "Ft": "N"}
LARGEST_VALUES = {"V": 5e3, "A": 0.1}  # on a touch display, by unit
CHANNEL_TITLES = {"V": "drive V", "Vsc": "skin voltage Vsc", "I": "loop current I", "Ft": "friction Ft"}

# times of existing records, so that records on the same grid share one array
_SHARED_TIMES: weakref.WeakValueDictionary[tuple[float, ...], np.ndarray] = weakref.WeakValueDictionary()

# remedy for times with too few digits
STATE_RATE = f"state the sampling rate, as {RATE_OPTION} or [measurement] sampling_rate in a scene"

_RowLabel = Callable[[int], str]


@dataclasses.dataclass(frozen=True, repr=False)
class Record(Display):
    """Time and channels of one measurement, in SI units.

    Attributes:
        time: strictly increasing, s.
        channels: by name: V (drive), Vsc (over the skin), I (loop current).
        source: where it came from, for messages.
        notes: sentences for information.
        warnings: sentences on what may change the result.
    """

    time: Float[np.ndarray, " samples"]
    channels: Mapping[str, Float[np.ndarray, " samples"]]
    source: str = "record"
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    @classmethod
    def from_arrays(
        cls,
        time: Float[np.ndarray, " samples"],
        *,
        V: Float[np.ndarray, " samples"] | None = None,
        Vsc: Float[np.ndarray, " samples"] | None = None,
        I: Float[np.ndarray, " samples"] | None = None,  # noqa: E741  (the field's symbol for current)
        Ft: Float[np.ndarray, " samples"] | None = None,
        source: str = "record",
        notes: tuple[str, ...] = (),
        warnings: tuple[str, ...] = (),
        where: _RowLabel = lambda row: f"sample {row}",
    ) -> "Record":
        """Make a record from arrays of equal length (s, V, V, A, N) after checks; `where` names a row in errors.

        Raises:
            InputError: the samples are too few, not finite or not increasing in time, or a channel has no signal.
        """
        time = _aligned_copy(time)
        given = {"V": V, "Vsc": Vsc, "I": I, "Ft": Ft}
        channels = {name: _aligned_copy(values) for name, values in given.items() if values is not None}
        _check_shapes(time, channels, source)
        for name in ("Vsc", "I"):
            if name in channels:
                replace_codes(channels[name])
        for name, values in {"time": time, **channels}.items():
            _check_values(values, name, source, where)
        _check_increasing(time, source, where)
        for name, values in channels.items():
            _check_signal(values, name, source)
        notes = (*notes, *grid_notes(time, source))
        for array in (time, *channels.values()):
            array.flags.writeable = False
        return cls(_share_times(time), channels, source, notes, warnings)

    def __getitem__(self, channel: str) -> Float[np.ndarray, " samples"]:
        try:
            return self.channels[channel]
        except KeyError:
            have = ", ".join(f"{name}_{CHANNEL_UNITS[name]}" for name in self.channels)
            raise InputError(
                f"{self.source}: the channel {channel}_{CHANNEL_UNITS[channel]} is missing (found: {have});"
                f" record it, name it in the header, or name its column, as {channel_option({channel: 'COLUMN'})}"
            ) from None

    def __contains__(self, channel: object) -> bool:
        return channel in self.channels

    def __len__(self) -> int:
        return self.time.size

    @functools.cached_property
    def time_step(self) -> float:
        """Median time step, s."""
        return float(np.median(np.diff(self.time)))

    @functools.cached_property
    def fingerprint(self) -> str:
        """SHA-256 of the numbers, by which results identify their data."""
        digest = hashlib.sha256(np.ascontiguousarray(self.time).tobytes())
        for name in sorted(self.channels):
            digest.update(name.encode() + np.ascontiguousarray(self.channels[name]).tobytes())
        return digest.hexdigest()

    def noise(self, channel: str) -> float:
        """Return a model-free estimate of the channel's noise sd: white noise and rounding."""
        return math.hypot(*self.noise_parts(channel))

    def noise_parts(self, channel: str) -> tuple[float, float]:
        """Return the sd of white noise, and that of rounding (see `noise`)."""
        if ("noise", channel) not in self._estimates:
            values = self[channel]
            valid = np.ones(values.size, bool) if channel == "V" else ~clipping_mask(values)
            rounding, tones = rounding_noise_sd(values[valid]), self.tones if "V" in self else None
            if tones is None:
                total = white_noise_sd(values[valid])
            else:  # fast ones would be taken for noise
                rest = values - (tones if channel == "V" else tones.fit_phasors(values)).values()
                total = float(np.std(rest)) if channel == "V" else white_noise_sd(rest[valid])
            self._estimates["noise", channel] = math.sqrt(max(total**2 - rounding**2, 0.0)), rounding
        return self._estimates["noise", channel]

    def correlated_rounding(self, channel: str, least_noise: float = 1.2) -> float:
        """Return the sd of rounding, or 0 where white noise of `least_noise` times it makes its errors independent.

        They then depend on the signal by a fourteenth of their sd.
        """
        _, rounding = self.noise_parts(channel)
        is_correlated = rounding > 0.0 and estimate_noise(self[channel]) < math.hypot(1.0, least_noise) * rounding
        return rounding if is_correlated else 0.0

    @functools.cached_property
    def tones(self) -> Tones | None:
        """The few sinusoids of which V consists, or None."""
        if not is_uniform(self.time):
            return None
        frequency = (self.frequency("V") or math.inf) * self.time_step
        return find_tones(self["V"], frequency, rounding_noise_sd(self["V"]))

    @property
    def leading(self) -> str:
        """Name of the channel that best represents the drive: V, or else Vsc."""
        return "V" if "V" in self else "Vsc"

    def frequency(self, channel: str | None = None) -> float | None:
        """Return the fundamental frequency (Hz) of a channel (default V, else Vsc), or None below 1.5 periods."""
        channel = channel or self.leading
        if ("frequency", channel) not in self._estimates:
            self._estimates["frequency", channel] = fundamental_frequency(self.time, self[channel])
        return self._estimates["frequency", channel]

    def plot(self) -> Any:
        """Draw V, Vsc, I and Ft on one time axis, and return the axes, one for each channel."""
        series = [
            charts.Series(title, CHANNEL_UNITS[name], self[name], clipped=clipping_mask(self[name]))
            for name, title in CHANNEL_TITLES.items()
            if name in self
        ]
        return charts.show_plots(charts.time_plot(self.time, series))

    def to_dataframe(self) -> Any:
        """Return a pandas DataFrame with the columns of a record file: time_s, V_V, Vsc_V, I_A, Ft_N."""
        columns = {f"{name}_{CHANNEL_UNITS[name]}": values for name, values in self.channels.items()}
        return to_dataframe({"time_s": self.time} | columns)

    @property
    def _headline(self) -> str:
        span, rate = (
            format_engineering(self.time[-1] - self.time[0], "s"),
            format_engineering(1.0 / self.time_step, "Hz"),
        )
        return f"{self.source}, {', '.join(self.channels)}, {len(self):,} samples, {span} at {rate}"

    def _rows(self) -> list[tuple[str, ...]]:
        rows: list[tuple[str, ...]] = [("channel", "minimum", "maximum", "noise")]
        for name, values in self.channels.items():
            numbers = (float(values.min()), float(values.max()), self.noise(name))
            rows.append((name, *(format_engineering(number, CHANNEL_UNITS[name]) for number in numbers)))
        return rows

    @functools.cached_property
    def _estimates(self) -> dict[tuple[str, str], Any]:
        """Cache of noise estimates and frequencies, since each takes a pass over the record."""
        return {}


def is_uniform(time: Float[np.ndarray, " samples"], tolerance: float = 1e-2, block: int = 65_536) -> bool:
    """Return whether all samples lie on a uniform grid, to `tolerance` steps; checks `block` samples at a time."""
    step = (time[-1] - time[0]) / (time.size - 1)
    for first in range(0, time.size, block):
        part = time[first : first + block]
        grid = time[0] + step * np.arange(first, first + part.size)
        if not np.all(np.abs(part - grid) <= tolerance * step):
            return False
    return True


def grid_notes(time: Float[np.ndarray, " samples"], source: str) -> tuple[str, ...]:
    """Return a note if the time steps are not uniform."""
    if is_uniform(time):
        return ()
    steps, half = np.diff(time), time.size // 2
    mean_step = float(np.mean(time[half:] - time[: time.size - half])) / half
    remedy = f"; if they were rounded when written, {STATE_RATE}" if is_rounded_grid(time, mean_step) else ""
    return (
        f"{source}: the time steps are not uniform ({steps.min():.4g} to {steps.max():.4g} s);"
        f" they are used as they are{remedy}",
    )


def is_rounded_grid(time: Float[np.ndarray, " samples"], step: float) -> bool:
    """Return whether the times are those of a uniform grid of `step` (s), rounded when they were written.

    Rounding changes a time by no more than the difference between the steps that it leaves. The largest and the
    smallest step do not count, because a single one is a lost or a repeated sample. Steps that hardly ever repeat are
    those of a clock with jitter.
    """
    steps = np.diff(time)
    smallest, largest = np.partition(steps, (1, -2))[[1, -2]]
    deviation = time - step * np.arange(time.size)
    is_near = np.ptp(deviation) <= 1.1 * (largest - smallest) + 1e-2 * step
    return bool(is_near and steps.min() >= 0.0 and np.unique(np.round(steps / (1e-4 * step))).size <= time.size / 2)


def fundamental_frequency(time: Float[np.ndarray, " samples"], values: Float[np.ndarray, " samples"]) -> float | None:
    """Return the fundamental frequency (Hz) of a signal from its autocorrelation, or None if it is not periodic."""
    min_correlation = 0.8  # least autocorrelation of a periodic signal
    peak_tolerance = 0.02  # by which the first peak may be lower than a later one
    lag_tolerance = 4  # error, in samples, of twice a period that is estimated from one
    count = time.size
    correlation = _autocorrelation(resample_uniform(time, values))
    below = np.flatnonzero(correlation < 0.5)
    last = (2 * count) // 3  # after a lag of one period, half a period must overlap
    if below.size == 0 or below[0] >= last - 2:
        return None
    window = correlation[below[0] : last]
    best = float(window.max())
    if best < min_correlation:
        return None
    high = window >= best - peak_tolerance
    start, stop = _run_around(high, int(np.argmax(high)))
    top = start + int(np.argmax(window[start:stop]))  # peak of the first period, not of a later one
    lag, periods = below[0] + _peak_position(window, top), 1
    reach = min(lag_tolerance, int(lag) // 4)
    while 2.0 * lag < last - reach:  # twice as many periods halve the error
        near = round(2.0 * lag) - below[0] - reach
        top = near + int(np.argmax(window[near : near + 2 * reach + 1]))
        further = below[0] + _peak_position(window, top)
        if further <= lag:  # a period of two or three samples, whose peaks merge
            return None
        lag, periods = further, 2 * periods
    return periods * (count - 1) / (lag * float(time[-1] - time[0]))


def resample_uniform(time: Float[np.ndarray, " n"], values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return the values interpolated to a uniform grid with the same number of times."""
    return np.interp(np.linspace(time[0], time[-1], time.size), time, values)


def _autocorrelation(x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return the correlation of x[:n - lag] and x[lag:] for each lag; it is 1 at a period, also for few periods."""
    x = x - x.mean()
    count = x.size
    power = np.abs(np.fft.rfft(x, 2 * count))
    power *= power
    correlation = np.fft.irfft(power, 2 * count)[:count].copy()  # the copy frees the other half
    del power
    overlap = np.arange(count, 0, -1)
    head, tail = np.cumsum(x)[::-1], np.cumsum(x[::-1])[::-1]  # sums over x[:n - lag] and x[lag:]
    correlation -= head * tail / overlap
    spread = np.cumsum(x**2)[::-1]
    floor = 1e-12 * spread[0] ** 2  # constant parts have no correlation
    spread = (spread - head**2 / overlap) * (np.cumsum(x[::-1] ** 2)[::-1] - tail**2 / overlap)
    correlation /= np.sqrt(np.maximum(spread, floor))
    correlation[spread <= floor] = 0.0
    return correlation


def _run_around(mask: np.ndarray, index: int) -> tuple[int, int]:
    """Return the start and the end (exclusive) of the run of true values around `index`."""
    outside = np.flatnonzero(~mask)
    place = int(np.searchsorted(outside, index))
    start = int(outside[place - 1]) + 1 if place > 0 else 0
    return start, int(outside[place]) if place < outside.size else mask.size


def _peak_position(curve: Float[np.ndarray, " n"], top: int) -> float:
    """Return the position of the peak near the maximum at `top`, by a parabola through slightly lower points."""
    start, stop = _run_around(curve >= curve[top] - 0.002 - 0.3 * (1.0 - curve[top]), top)
    if stop - start < 5:
        return float(top)
    bend, slope, _ = np.polyfit(np.arange(stop - start), curve[start:stop], 2)
    return float(start + np.clip(-0.5 * slope / bend, 0.0, stop - start) if bend < 0.0 else top)


def _aligned_copy(values: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " samples"]:
    values = np.asarray(values, dtype=float)
    copy = empty_aligned(values.shape)
    copy[...] = values
    return copy


def _share_times(time: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " samples"]:
    """Return the times, or the identical array of an existing record."""
    known = _SHARED_TIMES.setdefault((time.size, time[0], time[-1]), time)
    same = np.array_equal(known.view(np.int64), time.view(np.int64))  # bitwise, as the fingerprint requires
    return known if same else time


def _check_shapes(time: np.ndarray, channels: Mapping[str, np.ndarray], source: str) -> None:
    if not channels:
        raise InputError(f"{source}: no channel was given; give at least Vsc")
    for name, values in {"time": time, **channels}.items():
        if values.ndim != 1 or values.size != time.size:
            raise InputError(f"{source}: {name} has shape {values.shape}, time {time.shape}; give equal lengths")
    if time.size < MINIMUM_SAMPLES:
        raise InputError(
            f"{source}: {time.size} samples are too few to fit; record at least {MINIMUM_SAMPLES},"
            " better a whole period"
        )


def _check_values(values: np.ndarray, name: str, source: str, where: _RowLabel) -> None:
    if values.min() > -OVERFLOW and values.max() < OVERFLOW:
        return
    for is_bad, digits, meaning, remedy in (
        (~np.isfinite(values), "", "", "remove those rows (of Ft, interpolate) or record again"),
        (np.abs(values) >= OVERFLOW, ".4g", ", an oscilloscope's code for out of range", "record again within range"),
    ):
        bad = np.flatnonzero(is_bad)
        if bad.size:
            place, value = f"{source}, {where(int(bad[0]))}", f"{values[bad[0]]:{digits}}"
            raise InputError(f"{place}: {name} is {value}{meaning} ({bad.size} such values); {remedy}")


def _check_increasing(time: np.ndarray, source: str, where: _RowLabel) -> None:
    is_bad = time[1:] <= time[:-1]
    if is_bad.any():
        bad = np.flatnonzero(is_bad)
        row = int(bad[0]) + 1
        kind, remedy = "goes back before", "sort the rows and drop repeated ones, or check which column is time"
        if time[row] == time[row - 1]:
            kind, remedy = "repeats", f"if the times were rounded when written, {STATE_RATE}; otherwise {remedy}"
        raise InputError(
            f"{source}, {where(row)}: the time {time[row]:.9g} s {kind} the time before it ({bad.size} such rows);"
            f" {remedy}"
        )


def _check_signal(values: np.ndarray, name: str, source: str) -> None:
    """Raise InputError if a channel is constant apart from white noise."""
    if values.min() == values.max():
        what = "zero" if values[0] == 0.0 else f"constant at {values[0]:.6g}"
        raise InputError(f"{source}: {name} is {what} throughout; check the probe and the channel")
    # a smooth signal, e.g. a sweep, has no spectral line; and friction may have no electrostatic part
    some = 65_536  # the first samples, which usually suffice
    if name == "Ft" or any(white_noise_sd(part) < 0.3 * np.std(part) for part in (values[:some], values)):
        return
    middle = np.median(values)
    if np.max(np.abs(values - middle)) > 7.0 * np.median(np.abs(values - middle)) / 0.6744897501960817:
        return  # the channel has an edge
    power = np.abs(np.fft.rfft(values - values.mean())[1:]) ** 2
    # Fisher's test: for white noise, the power fraction of the largest of m lines exceeds x with p < m (1 - x)^(m - 1)
    share, lines = power.max() / power.sum(), power.size
    if math.log(lines) + (lines - 1) * math.log1p(-min(share, 1.0 - 1e-16)) > math.log(1e-4):
        raise InputError(
            f"{source}: {name} holds nothing but noise around {values.mean():.4g}; check the probe, the channel"
            " and that the record covers an edge of the drive"
        )
