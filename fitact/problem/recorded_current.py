"""V and I of a record: their noise before any fit, and the rows of charge of a current with a recorded V.

The noise of a recorded V is part of the likelihood of I (errors in variables). At given parameters, the residuals tell
how much of V is noise; the estimate of the drive that remains, with its covariance left in that of the rows, gives
estimates without bias, unlike the recorded V (`fitact.likelihood.charge_rows`).
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, Self

import jax
import numpy as np
import scipy
from jax.typing import ArrayLike
from jaxtyping import Bool, Float

from fitact.compiled import pad_samples
from fitact.data.clipping import clipping_mask
from fitact.data.noise import estimate_noise, rounding_noise_sd, white_noise_sd
from fitact.data.record import Record
from fitact.data.tones import Tones
from fitact.errors import InputError
from fitact.likelihood.channel import ChannelLikelihood
from fitact.likelihood.charge_rows import (
    LAG,
    MAX_STEPS,
    ROW_NOISE,
    ChargeRows,
    RowCovariance,
    mean_filter,
    step_means,
    whiten_rows,
)
from fitact.likelihood.observable import ChannelInputs
from fitact.likelihood.smooth_drive import lasting_bend, second_differences, smooth_drive
from fitact.model.circuit import gain_at
from fitact.model.drive import Sampled
from fitact.problem.jumps import Jumps
from fitact.problem.runs import RoundedSteps, Rows, least_step, long_run_share


class Current(NamedTuple):
    """A modelled current: what its noise of V and its delay depend on."""

    capacitance: float  # that follows dV/dt, with the stray one, F
    conductance: float  # of what does not follow it, S
    delay: float  # against V, in time steps
    lag: float = 0.0  # time constant of a resistance that makes it later, a part of the delay, in time steps

    @classmethod
    def from_channel(cls, channel: ChannelLikelihood, inputs: ChannelInputs, delay: float | None = None) -> Self:
        """Return what a channel models, with its delay or another one (time steps).

        If a resistance limits the current, its capacitance is that whose rows have the same variance.
        """
        terms, step = inputs.circuit.channel_terms(channel.channel), float(channel.timing.step)
        lag = float(terms.tau[-1]) / step if channel.electrical.lags else 0.0
        terms = channel.electrical.select_terms(terms)
        stray = 0.0 if inputs.stray is None else float(inputs.stray)
        delay = float(channel.timing.shift) / step if delay is None else delay
        if terms.rate is not None:
            return cls(float(terms.rate) + stray, float(np.sum(terms.weight)), delay, lag)
        omega = math.pi / step * (np.arange(64) + 0.5) / 64.0
        gain = np.asarray(gain_at(terms, omega)) + 1j * omega * stray
        mean_square = float(np.mean(np.abs(gain * np.sinc(0.5 * omega * step / math.pi)) ** 2))
        return cls(math.sqrt(0.5 * mean_square) * step, 0.0, delay)

    def sample_gains(self, step: float) -> tuple[float, float]:
        """Return the gains (S) of the noise of V, at the first and last sample of a step (s), in the mean current."""
        return 0.5 * self.conductance - self.capacitance / step, 0.5 * self.conductance + self.capacitance / step


@dataclasses.dataclass(frozen=True)
class RecordedCurrent:
    """V and I of a record, and what is known of their noise before a fit."""

    V: Rows
    I: Rows  # noqa: E741
    step: float  # s
    variance_V: Rows  # of the noise and the rounding of each sample of V, V^2
    noise_V: tuple[float, float]  # white noise and rounding, V
    noise_I: float  # A
    step_I: float  # of the converter, or 0 if it does not show, A
    jumps: Jumps  # of I
    rounded: RoundedSteps  # of I
    excluded: Bool[np.ndarray, " samples"]  # samples of I that are clipped
    tones: Tones | None  # of V

    @classmethod
    def from_record(cls, record: Record) -> "RecordedCurrent":
        """Estimate the noise of a record's V and I, once."""
        if len(record) < 6 * LAG:
            raise InputError(
                f"{record.source}: {len(record)} samples are too few to fit I with a recorded V; record at least"
                f" {6 * LAG}, better two periods"
            )
        if (key := ("noise", "rows of I")) not in record._estimates:
            record._estimates[key] = cls._estimate(record)
        return record._estimates[key]

    @classmethod
    def _estimate(cls, record: Record) -> "RecordedCurrent":
        V, current = record["V"], record["I"]
        rounding = rounding_noise_sd(V)
        # within runs of a coarse V, of ten bits or fewer, less noise than this is not known
        least = 0.1 * rounding if rounding > 5e-4 * float(np.ptp(V)) else 0.0
        noise = estimate_noise(V) if record.tones is None else record.noise("V")
        noise_V = math.sqrt(max(noise**2 - rounding**2, least**2)), rounding
        step_I = least_step(current)
        noise_I = max(estimate_noise(current), step_I / math.sqrt(12.0))
        return cls.from_samples(V, current, record.time_step, noise_V, noise_I, step_I, record.tones)

    @classmethod
    def from_samples(
        cls,
        V: Rows,
        current: Rows,
        step: float,
        noise_V: tuple[float, float],
        noise: float,
        step_I: float,
        tones: Tones | None,
        is_whole: bool = True,
    ) -> "RecordedCurrent":
        """Estimate which samples are less certain than the noise (V, A) and the step of the converter of I make them.

        `is_whole`: whether they are a whole record, and not a window of one, whose delay others determine.
        """
        rounded = RoundedSteps.from_samples(current, step_I)
        may_jump = current if tones is None else np.zeros(V.size)  # fast tones would be taken for jumps
        jumps = Jumps.from_samples(V, may_jump, (math.hypot(*noise_V), noise), is_whole)
        # the flat top of a pulse that is coarsely rounded looks clipped, but lies within the range of the converter
        codes = np.log2(np.maximum(np.abs([current.min(), current.max()]) / (step_I or 1.0), 1.0))
        is_rounded = (
            step_I > math.sqrt(12.0) * white_noise_sd(current) and np.max(np.abs(codes - np.round(codes))) > 0.02
        )
        excluded = np.zeros(V.size, bool) if is_rounded else clipping_mask(current)
        variance_V = drive_variance(V, *noise_V)
        return cls(V, rounded.values, step, variance_V, noise_V, noise, step_I, jumps, rounded, excluded, tones)

    def continue_with(self, V: Rows, current: Rows) -> "RecordedCurrent":
        """Return other samples of V and I, with the same noise."""
        noise = self.noise_V, self.noise_I, least_step(current)
        tones = self.tones and self.tones.continue_with(V)
        return self.from_samples(V, current, self.step, *noise, tones, is_whole=False)

    @functools.cached_property
    def smooth(self) -> Rows:
        """V without its noise, before any fit."""
        return smooth_drive(self.V, math.hypot(*self.noise_V), self.tones)

    @functools.cached_property
    def bend(self) -> Rows:
        """Second differences of the smooth V, V."""
        return second_differences(self.smooth)

    @functools.cached_property
    def lasting_bend(self) -> Rows:
        """Second differences without those of single corners, V."""
        return lasting_bend(self.smooth)

    @functools.cached_property
    def start_delay(self) -> float:
        """Delay of I in time steps, from which a fit starts: that of fast tones, whose I follows dV/dt; else 0."""
        if self.tones is None or self._tones_I is None:
            return 0.0
        fast = self.tones.frequencies >= 0.5 * np.max(self.tones.frequencies)
        if self.tones.carrier is None and np.count_nonzero(fast) < 3:
            return 0.0
        turns, currents = self.tones.frequencies[fast], self._tones_I.phasors[fast]
        size, late = np.abs(currents), np.angle(currents / (1j * self.tones.phasors[fast]))
        grid = np.linspace(-MAX_STEPS, MAX_STEPS, 241)
        delay = grid[np.argmax(size @ np.cos(late[:, None] + np.outer(turns, grid)))]
        phase = np.angle(np.exp(1j * (late + turns * delay)))
        # the skin makes I earlier by a phase that falls with the frequency, of which a carrier has one
        columns = np.stack([-turns, 1.0 / turns][: 1 if self.tones.carrier else 2]).T
        delay += np.linalg.lstsq(columns * size[:, None], phase * size)[0][0]
        return float(np.clip(delay, -MAX_STEPS, MAX_STEPS))

    @property
    def is_coarse(self) -> bool:
        """Whether I has long runs of equal values, whose rounding is no noise."""
        return long_run_share(self.I) > 0.1

    @property
    def is_within_steps(self) -> bool:
        """Whether I spends half of the time within a step of its converter, and so tells little."""
        half = np.quantile(np.abs(self.I - np.median(self.I)), 0.5)
        return self.is_coarse and bool(half <= 1.01 * self.step_I)

    @property
    def _floor(self) -> float:
        """Noise of I, at least of rounding errors, A."""
        return max(self.noise_I, 1e-12 * float(np.ptp(self.I)))

    def covariance(self, modelled: Current, uncertain: Rows, is_shared: bool = True) -> RowCovariance:
        """Return the covariance of the rows, which have the variance `uncertain` beside that of noise (A^2).

        Errors that several jumps or runs have in common, which a tridiagonal matrix cannot express, have their sum if
        `is_shared`; else they are independent.
        """
        variance, neighbours = self._variance(modelled, uncertain * (self.jumps.alike if is_shared else 1.0))
        common = self.rounded.variance * (self.rounded.alike if is_shared else 1.0)
        groups = (np.roll(x, LAG - round(modelled.delay)) for x in (self.rounded.group, common))
        return RowCovariance(variance, neighbours, self.excluded_rows(modelled.delay), *groups)

    def excluded_rows(self, delay: float) -> Bool[np.ndarray, " samples"]:
        """Return which rows are not valid or need a clipped sample, where I is `delay` time steps late."""
        excluded = self.excluded.copy()
        if excluded.any():
            excluded = np.roll(np.convolve(excluded, np.ones(2 * LAG), "same") > 0.5, LAG - round(delay))
        excluded[: 2 * LAG] = True
        return excluded

    def _variance(self, modelled: Current, uncertain: Rows) -> tuple[Rows, Rows]:
        """Return the variance of the rows, and their covariance with the rows before."""
        early, late = modelled.sample_gains(self.step)
        driven = np.roll(self.variance_V, LAG)
        variance = ROW_NOISE * self._floor**2 + early**2 * driven + late**2 * np.roll(driven, -1) + uncertain
        return variance, 0.5 * (1.0 - ROW_NOISE) * self._floor**2 + early * late * driven

    def flatten(self, white: Rows, modelled: Current) -> Rows:
        """Return whitened rows without the spectrum that a tridiagonal covariance leaves in the noise of I."""
        cycles = np.linspace(0.0, 0.5, 257)
        power = np.interp(np.fft.rfftfreq(white.size), cycles, self._noise_power(cycles, modelled))
        lines = scipy.fft.rfft(white) / np.sqrt(np.maximum(power / np.mean(power), 0.05))
        return scipy.fft.irfft(lines, white.size)

    def _noise_power(self, cycles: Rows, modelled: Current) -> Rows:
        """Return the power of the noise of rows over the assumed one, by frequency in cycles per step."""
        from_I, from_V = self._noise_powers(cycles, modelled, float(np.median(self.variance_V)))
        assumed = self._floor**2 * (ROW_NOISE + (1.0 - ROW_NOISE) * np.cos(2.0 * math.pi * cycles)) + from_V
        return (from_I + from_V) / assumed

    def _noise_powers(self, cycles: Rows, modelled: Current, variance_V: float) -> tuple[Rows, Rows]:
        """Return the power of rows (A^2) from noise of I, and of V with a variance, by frequency in cycles per step."""
        impulse, turns = np.zeros(64), 2.0 * math.pi * cycles
        impulse[32 - LAG] = 1.0
        taps = np.flatnonzero(own := step_means(impulse, modelled.delay))
        early, late = modelled.sample_gains(self.step)
        gain_V = early**2 + late**2 + 2.0 * early * late * np.cos(turns)
        from_I = self._floor**2 * np.abs(np.exp(-1j * np.outer(turns, taps)) @ own[taps]) ** 2
        return from_I, variance_V * gain_V

    def rounding_share(self, modelled: Current, rounding: float) -> float:
        """Return the share of a `rounding` of V (V) in the power of rows, at the frequency where it is largest."""
        if rounding == 0.0:
            return 0.0
        variance = max(float(np.median(self.variance_V)), rounding**2)
        from_I, from_V = self._noise_powers(np.linspace(0.0, 0.5, 129), modelled, variance)
        return float(np.max(from_V / (from_I + from_V))) * rounding**2 / variance

    def step_means(self, modelled: Current) -> tuple[Rows, Rows]:
        """Return the rows of the mean current over each step, and their variance beyond that of noise, A^2."""
        means, variance = self.jumps.step_means(self.I, modelled.delay, self.noise_I)
        means += self._missing_tones(modelled.delay)
        kink = modelled.conductance * self.step / max(modelled.capacitance, 1e-15)  # of what does not follow dV/dt
        return means, variance + self.jumps.kink_variance(self.I.size) * kink**2

    def _missing_tones(self, delay: float) -> ArrayLike:
        """Return what `step_means` takes from the tones of I: 3e-4 of one with ten samples in a period, A."""
        if self._tones_I is None:
            return 0.0
        taps, shift = mean_filter(delay)
        turns = self._tones_I.frequencies
        made = np.exp(-1j * np.outer(turns, shift + np.arange(taps.size))) @ taps
        mean = np.exp(1j * turns * (delay + 0.5 - LAG)) * np.sinc(turns / (2.0 * math.pi))
        return self._tones_I.scale(mean - made)

    @functools.cached_property
    def _tones_I(self) -> Tones | None:
        """Tones of I at the frequencies of those of V."""
        return self.tones and self.tones.fit_phasors(self.I)

    def rise(self, V: Rows, lag: float = 0.0) -> Rows:
        """Return the rise of a drive over each step, V/s, stored as rows are.

        With a `lag` (time steps) it is that of the drive behind a low-pass of this time constant, which weakens what is
        fast besides making it later: 1 / (1 + s) = e^{-s} (1 + s^2 / 2 + ...).
        """
        if lag and self.tones is not None:
            turns = 1j * lag * self.tones.frequencies
            V = V + self.tones.scale(np.exp(turns) / (1.0 + turns) - 1.0)
        elif lag:
            bend = self.lasting_bend  # from which its own bend leads to the second derivative
            V = V + 0.5 * lag**2 * (bend - lasting_bend(bend) / 12.0)
        return np.concatenate([np.zeros(LAG), np.diff(V)[: 1 - LAG] / self.step])

    def make_rows(
        self, modelled: Current, respond: Callable[[Rows], Rows], nuisances: ArrayLike = 0.0
    ) -> tuple[ChargeRows, Rows]:
        """Return the rows of charge and the estimate of V, given the modelled rows of a drive and of nuisances."""
        means, uncertain = self.step_means(modelled)
        covariance, from_V = self.covariance(modelled, uncertain), respond(self.V)
        is_shared = self.jumps.alike > 1.0 or bool(np.any(self.rounded.alike > 1.0))
        independent = self.covariance(modelled, uncertain, is_shared=False) if is_shared else covariance
        residuals = means - from_V - nuisances
        V = smooth = self._estimate_drive(independent, residuals, modelled)
        if self.rounded.group.any():  # noise of V within a group does not change its mean, but derivatives
            alone = RowCovariance(*self._variance(modelled, uncertain), self.excluded_rows(modelled.delay))
            smooth = self._estimate_drive(alone, residuals, modelled)
        bend = self.jumps.differentiate(self.rise(smooth)) / self.step
        observed = means + respond(V) - from_V
        power = np.mean(self._noise_power(np.linspace(0.0, 0.5, 129), modelled))
        gain, decay = covariance.recursion(self._floor / math.sqrt(float(power)))
        return ChargeRows(observed, self.rise(V, modelled.lag), bend, gain, decay, covariance.used * 1.0), V

    def _estimate_drive(self, covariance: RowCovariance, residuals: Rows, modelled: Current) -> Rows:
        """Return V without the noise that the residuals of the rows tell."""
        scaled = np.append(covariance.solve(residuals)[LAG:], np.zeros(LAG))
        # covariance of the noise of V with that of the rows
        early, late = modelled.sample_gains(self.step)
        return self.V + self.variance_V * (early * scaled + late * np.append(0.0, scaled[:-1]))

    def fit_rows(
        self,
        modelled: Current,
        blocks: int,
        functions: Sequence[Float[np.ndarray, "functions samples"]],
        slow: int = 16,
    ) -> ChargeRows:
        """Return the rows of charge, if the signal is any combination of dV/dt, which may drift, and rows of functions.

        The residuals, which tell the noise of the drive, thus need no circuit. The combination is that of charges over
        `blocks` of steps, of which those that hold a jump hardly count.
        """
        rise, several = self.rise(self.V), max(1, (self.V.size - 2 * LAG) // blocks)
        means, uncertain = self.step_means(modelled)
        variance = self._variance(modelled, uncertain * self.jumps.alike)[0]
        variance = np.where(self.excluded_rows(modelled.delay), np.inf, variance)
        weight = 1.0 / np.sqrt(thin_rows(variance, several))
        changing = np.linspace(-1.0, 1.0, rise.size) * rise
        columns = np.concatenate([thin_rows(part, several) for part in (np.stack([rise, changing]), *functions)])
        columns *= weight
        noise = 2.0 * float(np.mean(self.variance_V)) * float(np.sum(weight**2)) / (several * self.step) ** 2
        sizes = solve_linear(columns, thin_rows(means, several) * weight, (0, noise))[1]
        capacitance, rest, begin = float(sizes[0]), sizes[1] * changing, 2
        for part in functions:
            rest += sizes[begin : (begin := begin + len(part))] @ part
        modelled = modelled._replace(capacitance=abs(capacitance))
        rows, _ = self.make_rows(modelled, lambda V: capacitance * self.rise(V) + rest)
        # what changes within the window is slow, and hidden by the noise of V at high frequencies
        white = whiten_rows(rows.gain, rows.decay, means - capacitance * rise - rest) * rows.used
        power = np.abs(scipy.fft.rfft(white * np.hanning(white.size))) ** 2
        alike = max(1.0, float(np.median(power[: power.size // slow]) / np.median(power)))
        return dataclasses.replace(rows, used=rows.used / math.sqrt(alike))


def thin_rows(rows: np.ndarray, several: int) -> np.ndarray:
    """Return means over `several` rows each, without the first ones, which are not valid."""
    count = (rows.shape[-1] - 2 * LAG) // several
    return rows[..., 2 * LAG : 2 * LAG + several * count].reshape(*rows.shape[:-1], count, several).mean(axis=-1)


def drive_variance(V: Rows, white: float, rounding: float, settling: int = 32) -> Rows:
    """Return the variance of each sample of V.

    Within a run of equal values, rounding is no noise, but an offset, unless noise of a seventh of a step changes it.
    Within `settling` samples of its ends, the offset changes: on a ramp, and where V settles within its last step.
    """
    alike = np.pad(np.diff(V) == 0.0, (1, 0)) & (white < 0.5 * rounding)
    within = scipy.ndimage.minimum_filter1d(alike, 2 * settling + 1, mode="nearest")
    return white**2 + np.where(within, 0.0, rounding**2)


def row_figures(
    white: Rows, channel: ChannelLikelihood, inputs: ChannelInputs, record: Record
) -> tuple[Rows, dict[str, float], float]:
    """Return whitened rows without the spectrum of their own (`RecordedCurrent.flatten`), and figures of merit.

    The covariance knows the rounding of I. Returns also the share of the rounding of V in the power of these rows, at
    the frequency where it is largest.
    """
    current, modelled = RecordedCurrent.from_record(record), Current.from_channel(channel, inputs)
    figures = {
        "rounding_noise": 0.0,
        "within_steps": float(current.is_within_steps),
        "rounding_V": current.noise_V[1] if current.noise_V[0] < current.noise_V[1] else 0.0,
    }
    share = current.rounding_share(modelled, record.correlated_rounding("V"))
    return current.flatten(white, modelled), figures, share


def solve_linear(
    columns: np.ndarray, observed: np.ndarray, noisy: tuple[int, float] = (0, 0.0)
) -> tuple[float, np.ndarray]:
    """Return the residual sum of squares and the coefficients of a linear fit.

    `noisy` is the index of a column, and the sum of squares of its noise, which is taken off, but for a tenth.
    """
    place, square = noisy
    sizes = np.linalg.norm(columns, axis=1)
    sizes = np.where(sizes > 0.0, sizes, 1.0)
    scaled = columns / sizes[:, None]
    gram = scaled @ scaled.T
    gram[place, place] -= min(square / sizes[place] ** 2, 0.9)
    amplitudes = np.linalg.lstsq(gram, scaled @ observed, rcond=1e-13)[0] / sizes
    residuals = observed - amplitudes @ columns
    return float(residuals @ residuals), amplitudes


def set_rows(channel: ChannelLikelihood, rows: ChargeRows, V: Rows, delay: float) -> ChannelLikelihood:
    """Return the channel with rows of charge, an estimate of the drive, and the delay (s) at which they are taken."""
    length = np.shape(channel.samples.time)[0]
    padded = jax.tree.map(lambda x: np.pad(x, (0, length - x.size)), rows)
    assert isinstance(channel.electrical.drive, Sampled)
    drive = Sampled(channel.electrical.drive.time, pad_samples(V))
    timing = dataclasses.replace(channel.timing, shift=np.asarray(delay, dtype=float))
    channel = channel.without_compression().replace_samples(charges=padded)
    return channel.replace_observable(drive=drive, timing=timing)
