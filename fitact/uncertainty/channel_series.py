"""Channels of records as uniform series of bounded length, whose modelled signals are computed by FFT."""

import dataclasses
import functools
import math
import types
from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Complex, Float

from fitact.data.record import is_uniform
from fitact.likelihood.compression import HUM_FREQUENCIES
from fitact.likelihood.observable import CHARGES

Rows = Float[np.ndarray, " rows"]
Spectrum = Complex[np.ndarray, " lines"]


class Timing(NamedTuple):
    """A free delay or clock of a channel."""

    place: int  # coordinate of theta
    unit: float  # of this coordinate: s for a delay, relative for a clock
    total: float  # its value, beyond what the drive was shifted by before the fit
    is_expected: bool = False  # whether it is within three prior sd, and there before the data ask for it


class ChannelSamples(NamedTuple):
    """Residuals of one channel of one record, with what is known of its noise and its nuisances."""

    channel: str  # "Vsc", "I" or "impedance"
    time: Rows  # s
    voltage: Rows  # drive at these times, V
    residuals: Rows  # data minus fit, V or A
    weight: Rows  # relative inverse noise sd; 0 excludes a sample
    sigma: float  # noise sd in the fit, V or A
    noise: float  # noise sd by the model-free estimate, V or A
    taps: Float[np.ndarray, " taps"]  # whitening filter of the noise
    frequency: float | None  # at which the record repeats, Hz
    steady_state: bool  # whether the drive has repeated for long
    unknown_charge: bool  # whether the charge at the first sample is a free parameter
    transient: float  # sum of the decays of the unknown charges at the first sample, V or A
    taus: Float[np.ndarray, " taus"]  # time constants of the circuit, s
    nuisances: dict[str, float]  # free linear nuisances at the optimum, V or A
    timing: dict[str, "Timing"]  # free delay and clock
    # coordinates of theta whose sum, each times its power, is the logarithm of the gain
    gains: tuple[tuple[int, float], ...] = ()
    # the same for 1 + each effect of the instruments, by its name
    effects: Mapping[str, tuple[tuple[int, float], ...]] = types.MappingProxyType({})
    omega: Rows | None = None  # of a spectrum, rad/s; its rows are all real parts, then all imaginary parts


@dataclasses.dataclass(frozen=True)
class ChannelSeries:
    """One channel in uniform rows: its samples, means over its periods, or means of blocks.

    Signals and residuals are in V or A until `whiten` divides them by the noise.
    """

    samples: ChannelSamples
    time: Rows  # s
    voltage: Rows  # V
    residuals: Rows  # V or A
    weight: Rows  # inverse noise sd of each row, relative to the noise of the channel
    is_circular: bool  # whether the rows are whole periods of a steady state
    kind: Literal["samples", "blocks", "period"]  # whether rows are samples, or means of blocks or over periods
    jump: float = 0.0  # of V at the first sample, which stands for the unknown charge, V

    @property
    def is_early(self) -> Bool[np.ndarray, " rows"]:
        """Mask of the first half of the record."""
        return np.arange(self.time.size) < self.time.size // 2

    @property
    def step(self) -> float:
        """Time between rows, s."""
        return float(self.time[-1] - self.time[0]) / (self.time.size - 1)

    def whiten(self, rows: Float[np.ndarray, "*n rows"]) -> Float[np.ndarray, "*n rows"]:
        """Return rows in units of independent noise of sd 1."""
        taps, weighted = self.samples.taps, rows * (self.weight / self.samples.sigma)
        # means of many samples hold only slow changes, which the filter multiplies by the sum of its taps
        if self.kind != "samples" or taps.size == 1:
            return weighted * taps.sum()
        return np.apply_along_axis(lambda row: np.convolve(row, taps)[: row.size], -1, weighted)

    @functools.cached_property
    def frequencies(self) -> Spectrum:
        """Complex frequencies of the FFT, rad/s."""
        return 2j * math.pi * np.fft.rfftfreq(self._length, self.step)

    @functools.cached_property
    def difference(self) -> Spectrum:
        """Gain of the difference over two rows divided by their distance, 1/s: a derivative that does not ring."""
        return 1j * np.sin(self.frequencies.imag * self.step) / self.step

    def regular_gain(self, gain: Spectrum) -> Spectrum:
        """Return a gain whose part in dV/dt, which is that of the highest frequency, is taken by differences."""
        s = self.frequencies
        return gain + gain[-1].imag / s[-1].imag * (self.difference - s)

    @property
    def repeats(self) -> bool:
        """Whether V is taken to have repeated before a record that begins with an unknown charge."""
        frequency, span = self.samples.frequency, float(self.time[-1] - self.time[0])
        return self.samples.unknown_charge and frequency is not None and span * frequency >= 1.5

    def response(self, gain: Spectrum, rows: Rows, jump: float = 0.0) -> Rows:
        """Return an input after a filter; before the record it repeats, or is 0, less `jump`."""
        is_drive = rows is self.voltage and jump == self.jump
        spectrum = self._drive_spectrum if is_drive else self._spectrum(rows, jump)
        return scipy.fft.irfft(spectrum * gain, self._length)[self._length - rows.size :]

    @functools.cached_property
    def _drive_spectrum(self) -> Spectrum:
        return self._spectrum(self.voltage, self.jump)

    def _spectrum(self, rows: Rows, jump: float) -> Spectrum:
        """Return the FFT of an input and of what precedes it."""
        count = self._length - rows.size
        before = np.zeros(count)
        if count and self.repeats:
            assert self.samples.frequency is not None
            phase = np.mod(-self.step * np.arange(count, 0.0, -1.0), 1.0 / self.samples.frequency)
            before = np.interp(phase, self.time - self.time[0], rows)
        return scipy.fft.rfft(np.concatenate([before - jump, rows]))

    def shapes(self) -> dict[str, Rows]:
        """Return the shapes of the free linear nuisances, each of height 1; none that means over periods hide."""
        middle, half = 0.5 * (self.time[0] + self.time[-1]), 0.5 * (self.time[-1] - self.time[0])
        since, all_shapes = self.time - middle, {}
        all_shapes["offset"] = np.ones_like(since)
        if self.kind != "period":
            all_shapes["drift"] = since / half
            for frequency in HUM_FREQUENCIES:
                turns, name = 2.0 * math.pi * frequency * since, f"hum_{frequency:.0f}Hz"
                all_shapes |= {f"{name}_cos": np.cos(turns), f"{name}_sin": np.sin(turns)}
            for name, tau in zip(CHARGES, self.samples.taus, strict=False):
                all_shapes[name] = np.exp(-(self.time - self.time[0]) / tau)
        return {name: shape for name, shape in all_shapes.items() if name in self.samples.nuisances}

    @functools.cached_property
    def _length(self) -> int:
        """Number of rows of an FFT, of which those before the record let decays end."""
        n = self.time.size
        if self.is_circular:
            return n
        before = min(10.0 * float(np.max(self.samples.taus)) / self.step, 4.0 * n)
        return int(scipy.fft.next_fast_len(n + math.ceil(before), real=True))


class SpectrumSeries(ChannelSeries):
    """A spectrum: its rows are the real parts of the response to a drive of 1 V, then the imaginary parts."""

    @property
    def is_early(self) -> Bool[np.ndarray, " rows"]:
        """Mask of the lower half of the frequencies."""
        points = self.time.size // 2
        return np.tile(np.arange(points) < points // 2, 2)

    @property
    def frequencies(self) -> Spectrum:
        """Complex frequencies of the points, rad/s."""
        assert self.samples.omega is not None
        return 1j * self.samples.omega

    @property
    def difference(self) -> Spectrum:
        """Gain of the derivative, 1/s."""
        return self.frequencies

    def response(self, gain: Spectrum, rows: Rows, jump: float = 0.0) -> Rows:
        """Return the gain, whatever the input."""
        return np.concatenate([gain.real, gain.imag])

    def shapes(self) -> dict[str, Rows]:
        """Return no shapes: a spectrum has no linear nuisances."""
        return {}


def channel_series(samples: ChannelSamples, max_rows: int) -> tuple[ChannelSeries, ...]:
    """Return the channel as its samples, or as means over periods (if it repeats) and means of blocks."""
    if samples.omega is not None:
        columns = samples.time, samples.voltage, samples.residuals, samples.weight
        return (SpectrumSeries(samples, *columns, is_circular=True, kind="period"),)
    samples = _uniform(samples)
    n, step = samples.time.size, float(samples.time[-1] - samples.time[0]) / (samples.time.size - 1)
    steady, frequency = samples.steady_state, samples.frequency
    if frequency is not None and steady:
        whole = math.floor(n * step * frequency + 1e-3) / (frequency * step)
        n = min(n, round(whole)) or n
        steady = whole >= 1.0
    samples = _select(samples, slice(0, n))
    if n <= max_rows:
        columns = samples.time, samples.voltage, samples.residuals, samples.weight
        return (ChannelSeries(samples, *columns, steady and frequency is not None, "samples"),)
    blocks = _block_means(samples, math.ceil(n / max_rows), steady and frequency is not None)
    settled = _select(samples, slice(0 if steady else math.ceil(8.0 * float(np.max(samples.taus)) / step), n))
    if frequency is None or settled.time.size * step * frequency < 2.0:
        return (blocks,)
    return _period_means(settled, frequency, step, max_rows), blocks


def _select(samples: ChannelSamples, part: slice) -> ChannelSamples:
    fields = ("time", "voltage", "residuals", "weight")
    return samples._replace(**{name: getattr(samples, name)[part] for name in fields})


def _uniform(samples: ChannelSamples) -> ChannelSamples:
    """Return the samples interpolated to uniform times."""
    time = samples.time
    if is_uniform(time):
        return samples
    grid = np.linspace(time[0], time[-1], time.size)
    fields = ("voltage", "residuals", "weight")
    return samples._replace(time=grid, **{name: np.interp(grid, time, getattr(samples, name)) for name in fields})


def _block_means(samples: ChannelSamples, size: int, is_circular: bool) -> ChannelSeries:
    count = samples.time.size // size
    time, voltage, residuals, weight = (
        x[: count * size].reshape(count, size)
        for x in (samples.time, samples.voltage, samples.residuals, samples.weight)
    )
    total = np.sum(weight**2, axis=1)
    mean = np.sum(weight**2 * residuals, axis=1) / np.where(total > 0.0, total, 1.0)
    whole = is_circular and samples.time.size == count * size
    return ChannelSeries(samples, time.mean(axis=1), voltage.mean(axis=1), mean, np.sqrt(total), whole, "blocks")


def _period_means(samples: ChannelSamples, frequency: float, step: float, max_rows: int) -> ChannelSeries:
    rows = min(max_rows, math.floor(1.0 / (frequency * step)))
    place = np.minimum((np.mod(samples.time * frequency, 1.0) * rows).astype(int), rows - 1)
    count, total = np.bincount(place, minlength=rows), np.bincount(place, samples.weight**2, rows)
    phase, filled = (np.arange(rows) + 0.5) / rows, count > 0
    means = np.bincount(place, samples.voltage, rows)[filled] / count[filled]
    voltage = np.interp(phase, phase[filled], means, period=1.0)
    residuals = np.bincount(place, samples.weight**2 * samples.residuals, rows) / np.where(total > 0.0, total, 1.0)
    return ChannelSeries(samples, phase / frequency, voltage, residuals, np.sqrt(total), True, "period")
