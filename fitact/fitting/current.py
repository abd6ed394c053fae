"""Loop current I: rows of charge where V was recorded, the noise of V in them, and estimates before any fit.

The noise of a recorded V is part of the likelihood of I (errors in variables). At given parameters, the residuals tell
how much of V is noise; the estimate of the drive that remains, with its covariance left in that of the rows, gives
estimates without bias, unlike the recorded V (`fitact.likelihood.charge_rows`).
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np
import scipy.fft
import scipy.signal
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from fitact.compiled import jit, pad_samples
from fitact.data.clipping import clipping_mask
from fitact.data.record import Record, rounding_noise_sd, white_noise_sd
from fitact.errors import InputError
from fitact.fitting.drive_choice import DriveModel, drive_slope, unit_response
from fitact.fitting.least_squares import LeastSquaresResult
from fitact.fitting.source import Source
from fitact.fitting.starting_point import CurrentEstimate, skin_from_estimates
from fitact.likelihood.channel import ChannelInputs, ChannelLikelihood
from fitact.likelihood.charge_rows import (
    LAG,
    MAX_STEPS,
    ChargeRows,
    RowCovariance,
    step_means,
    whiten_rows,
)
from fitact.likelihood.likelihood import Likelihood
from fitact.model.circuit import HighpassTerms, gain_at
from fitact.model.drive import Sampled

Rows = Float[np.ndarray, " samples"]
Belief = tuple[np.ndarray, np.ndarray]  # prior means and sds of log Rsc, log Csc and log Ci
# rms error of the mean over a step, up to six steps from a jump, relative to its height; beside the step of the jump,
# where the error is 0.06 to 0.1 at all jumps alike and would bias a delay, three times as large
_JUMP_ERRORS = np.array([3e-4, 1e-3, 3e-3, 0.01, 0.03, 0.3, 0.29, 0.3, 0.03, 0.01, 3e-3, 1e-3, 3e-4])
FEW = 4  # equal values in a row that are usual where noise exceeds the rounding
_ROW_NOISE = 0.6285  # variance of a row over that of a sample of white noise; with those of neighbours, the sum is 1


class Current(NamedTuple):
    """A modelled current: what its noise of V and its delay depend on."""

    capacitance: float  # that follows dV/dt, with the stray one, F
    conductance: float  # of what does not follow it, S
    delay: float  # against V, in time steps
    follows: bool = True  # whether it follows dV/dt, which no resistance limits

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
    uncertain: Rows  # variance of the mean current over the step after a sample, because of kinks, A^2
    shared: float  # number of kinks that have the same error
    rounded: Rows  # variance of the rounding error that the steps of a run of equal values of I have in common, A^2
    alike: Rows  # number of runs that have the same rounding error
    excluded: Bool[np.ndarray, " samples"]  # samples of I that are clipped

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
        noise_V = math.sqrt(max(estimate_noise(V) ** 2 - rounding_noise_sd(V) ** 2, 0.0)), rounding_noise_sd(V)
        noise_I = max(estimate_noise(current), _least_step(current) / math.sqrt(12.0))
        return cls.from_samples(V, current, record.time_step, noise_V, noise_I)

    @classmethod
    def from_samples(
        cls, V: Rows, current: Rows, step: float, noise_V: tuple[float, float], noise: float, is_whole: bool = True
    ) -> "RecordedCurrent":
        """Estimate which samples are less certain than the noise of V and I (A) makes them.

        `is_whole`: whether they are a whole record, and not a window of one, whose delay others determine.
        """
        rounding, alike = _least_step(current) / math.sqrt(12.0), _count_runs(current)
        uncertain, shared = _kink_variance(current, noise, is_whole)
        # the flat top of a pulse that is coarsely rounded looks clipped, but lies within the range of the converter
        codes = np.log2(np.maximum(np.abs([current.min(), current.max()]) / (math.sqrt(12.0) * rounding or 1.0), 1.0))
        is_coarse = rounding > white_noise_sd(current) and np.max(np.abs(codes - np.round(codes))) > 0.02
        excluded = np.zeros(V.size, bool) if is_coarse else clipping_mask(current)
        rounded = np.where(alike > 0.0, rounding**2, 0.0)
        variance_V = drive_variance(V, *noise_V)
        return cls(V, current, step, variance_V, noise_V, noise, uncertain, shared, rounded, alike, excluded)

    def continue_with(self, V: Rows, current: Rows) -> "RecordedCurrent":
        """Return other samples of V and I, with the same noise."""
        return self.from_samples(V, current, self.step, self.noise_V, self.noise_I, is_whole=False)

    @property
    def is_coarse(self) -> bool:
        """Whether I has long runs of equal values, whose rounding is no noise."""
        return float(np.mean(run_lengths(self.I) > FEW)) > 0.1

    @property
    def is_within_steps(self) -> bool:
        """Whether I spends half of the time within a step of its converter, and so tells little."""
        half = np.quantile(np.abs(self.I - np.median(self.I)), 0.5)
        return self.is_coarse and bool(half <= 1.01 * _least_step(self.I))

    @property
    def _floor(self) -> float:
        """Noise of I, at least of rounding errors, A."""
        return max(self.noise_I, 1e-12 * float(np.ptp(self.I)))

    def covariance(self, modelled: Current, is_shared: bool = True) -> RowCovariance:
        """Return the covariance of the rows.

        Errors that several kinks or runs have in common, which a tridiagonal matrix cannot express, have their sum if
        `is_shared`; else they are independent.
        """
        variance, neighbours, excluded = self._variance(modelled, is_shared)
        common = np.roll(self.rounded * (self.alike if is_shared else 1.0), LAG - round(modelled.delay))
        return RowCovariance(variance, 0.5 * (1.0 - _ROW_NOISE) * self._floor**2 + neighbours, excluded, common)

    def _variance(self, modelled: Current, is_shared: bool = True) -> tuple[Rows, Rows, Bool[np.ndarray, " samples"]]:
        """Return the variance of the rows, their covariance by the sample of V they share, and which are excluded."""
        early, late = modelled.sample_gains(self.step)
        driven = np.roll(self.variance_V, LAG)
        level = _ROW_NOISE * self._floor**2 + early**2 * driven + late**2 * np.roll(driven, -1)
        shift, excluded = LAG - round(modelled.delay), self.excluded.copy()
        if excluded.any():
            excluded = np.roll(np.convolve(excluded, np.ones(2 * LAG), "same") > 0.5, shift)
        excluded[: 2 * LAG] = True
        uncertain = np.roll(self.uncertain, shift) * (self.shared if is_shared else 1.0)
        return level + uncertain, early * late * driven, excluded

    def flatten(self, white: Rows, modelled: Current) -> Rows:
        """Return whitened rows without the spectrum that a tridiagonal covariance leaves in the noise of I."""
        cycles = np.linspace(0.0, 0.5, 257)
        power = np.interp(np.fft.rfftfreq(white.size), cycles, self._noise_power(cycles, modelled))
        lines = scipy.fft.rfft(white) / np.sqrt(np.maximum(power / np.mean(power), 0.05))
        return scipy.fft.irfft(lines, white.size)

    def _noise_power(self, cycles: Rows, modelled: Current) -> Rows:
        """Return the power of the noise of rows over the assumed one, at frequencies in cycles per step."""
        impulse, turns = np.zeros(64), 2.0 * math.pi * cycles
        impulse[32 - LAG] = 1.0
        taps = np.flatnonzero(own := step_means(impulse, modelled.delay))
        driven = (modelled.capacitance / self.step) ** 2 * float(np.median(self.variance_V))
        floor, others = self._floor**2, 2.0 * driven * (1.0 - np.cos(turns))
        assumed = floor * (_ROW_NOISE + (1.0 - _ROW_NOISE) * np.cos(turns)) + others
        return (floor * np.abs(np.exp(-1j * np.outer(turns, taps)) @ own[taps]) ** 2 + others) / assumed

    def rise(self, V: Rows) -> Rows:
        """Return the rise of a drive over each step, V/s, stored as rows are."""
        return np.concatenate([np.zeros(LAG), np.diff(V)[: 1 - LAG] / self.step])

    def make_rows(
        self, modelled: Current, respond: Callable[[Rows], Rows], nuisances: ArrayLike = 0.0
    ) -> tuple[ChargeRows, Rows]:
        """Return the rows of charge and the estimate of V, given the modelled rows of a drive and of nuisances."""
        covariance = self.covariance(modelled)
        means, from_V = step_means(self.I, modelled.delay), respond(self.V)
        independent = self.covariance(modelled, is_shared=False)
        scaled = np.append(independent.solve(means - from_V - nuisances)[LAG:], np.zeros(LAG))
        # covariance of the noise of V with that of the rows
        early, late = modelled.sample_gains(self.step)
        V = self.V + self.variance_V * (early * scaled + late * np.append(0.0, scaled[:-1]))
        signal = respond(V)
        power = np.mean(self._noise_power(np.linspace(0.0, 0.5, 129), modelled))
        gain, decay = covariance.recursion(self._floor / math.sqrt(float(power)))
        slope = np.where(gain > 0.0, -np.gradient(signal) / self.step, 0.0)
        return ChargeRows(means + signal - from_V, self.rise(V), slope, gain, decay, covariance.used * 1.0), V

    def fit_rows(
        self, modelled: Current, blocks: int, functions: Sequence[Float[np.ndarray, "functions samples"]]
    ) -> ChargeRows:
        """Return the rows of charge, if the signal is any combination of dV/dt, which may drift, and rows of functions.

        The residuals, which tell the noise of the drive, thus need no circuit. The combination is that of charges over
        `blocks` of steps, in which noise of V hardly matters.
        """
        rise, several = self.rise(self.V), max(1, (self.V.size - 2 * LAG) // blocks)
        (variance, _, excluded), follows = self._variance(modelled), modelled.follows
        weight = 1.0 / np.sqrt(_thin(np.where(excluded, np.inf, variance), several))
        changing = np.linspace(-1.0, 1.0, rise.size) * rise
        parts = [np.stack([rise, changing])[: 2 * follows], *functions]
        columns = np.concatenate([_thin(part, several) for part in parts]) * weight
        noise = 2.0 * float(np.mean(self.variance_V)) * float(np.sum(weight**2)) / (several * self.step) ** 2
        observed = _thin(step_means(self.I, modelled.delay), several) * weight
        sizes = _solve(columns, observed, (0, noise * follows))[1]
        capacitance, begin = float(sizes[0]) * follows, 2 * follows
        rest = sizes[1] * changing if follows else np.zeros(rise.size)
        for part in functions:
            rest += sizes[begin : (begin := begin + len(part))] @ part
        noisy = modelled._replace(capacitance=abs(capacitance)) if follows else modelled
        return self.make_rows(noisy, lambda V: capacitance * self.rise(V) + rest)[0]


def _thin(rows: np.ndarray, several: int) -> np.ndarray:
    """Return means over `several` rows each, without the first ones, which are not valid."""
    count = (rows.shape[-1] - 2 * LAG) // several
    return rows[..., 2 * LAG : 2 * LAG + several * count].reshape(*rows.shape[:-1], count, several).mean(axis=-1)


def estimate_noise(values: Rows, block: int = 16, max_ratio: float = 0.7) -> float:
    """Return the sd of white noise and rounding: that of sixth differences, or of the highest frequencies if far lower.

    Fast smooth signals hardly change the second, which is less accurate. The median over blocks is robust to edges, and
    the mean square within a block counts rounding, with which a median of differences takes few values.
    """
    squares = np.diff(values, 6) ** 2 / 924.0
    means = squares[: squares.size // block * block].reshape(-1, block).mean(axis=1)
    # median over mean of the mean squares of white noise in blocks of 16, from simulations
    differences = math.sqrt(float(np.median(means)) / 0.8677) if means.size else white_noise_sd(values)
    lines = scipy.fft.rfft((values - values.mean()) * np.hanning(values.size))[int(0.4 * values.size) :]
    fastest = math.sqrt(float(np.median(np.abs(lines) ** 2)) / math.log(2.0) / (0.375 * values.size))
    return max(fastest if fastest < max_ratio * differences else differences, rounding_noise_sd(values))


def _kink_variance(
    current: Rows, noise: float, is_whole: bool, threshold: float = 4.0, smooth: float = 8.0, block: int = 64
) -> tuple[Rows, float]:
    """Return the variance of the mean current over the step after each sample, if the current jumps within the step.

    Also how many jumps have the same error.

    A jump somewhere within a step changes the mean by its height times a uniform number in +-1/2, and the polynomials
    of `step_means` around it by the `_JUMP_ERRORS`. Sixth differences are ten times a jump; they count above
    `threshold` times the effect of noise, and `smooth` times what is usual in a `block` of samples.
    """
    jump = np.pad(np.abs(np.diff(current, 6)) / 10.0, 3)
    padded = np.pad(jump, (0, -jump.size % block), mode="edge").reshape(-1, block)
    usual = np.repeat(np.median(padded, axis=1), block)[: jump.size]
    least = np.maximum(threshold * math.sqrt(924.0) / 10.0 * noise, smooth * usual)
    around = np.max([np.roll(jump, k) for k in (-2, -1, 1, 2)], axis=0)
    jump = np.where((jump > np.maximum(least, 1e-9 * np.ptp(current))) & (jump >= around), jump, 0.0)
    height = np.maximum(jump, np.append(jump[1:], 0.0))
    shared = _shared_jumps(np.flatnonzero(height)) if is_whole else 1.0
    return np.convolve(np.square(height), np.square(_JUMP_ERRORS), "same"), shared


def _shared_jumps(places: Int[np.ndarray, " n"], most: float = 4.0) -> float:
    """Return how many jumps lie at the same part of a step and so have the same error, `most` at most.

    These are half of all if the drive repeats after a whole number of steps, to one over the record. With more of them,
    the delay of a long record would be known to a part of a step only, which is too cautious for its other parameters.
    """
    first = places[np.diff(places, prepend=-9) > 3]
    for jumps in (2, 4):  # in a period, of a triangle and a trapezoid
        periods = (first.size - 1) // jumps
        if periods > 0:
            period = (first[periods * jumps] - first[0]) / periods
            if abs(period - round(period)) * periods <= 1.0:
                return min(max(0.5 * first.size, 1.0), most)
    return 1.0


def drive_variance(V: Rows, white: float, rounding: float) -> Rows:
    """Return the variance of each sample of V.

    Within a run of equal values, rounding is no noise, but an offset, unless noise of a seventh of a step changes it.
    """
    alike = (np.diff(V) == 0.0) & (white < 0.5 * rounding)
    within = np.append(False, alike) & np.append(alike, False)
    return white**2 + np.where(within, 0.0, rounding**2)


def _least_step(current: Rows, max_part: float = 0.25) -> float:
    """Return the least step between the values of a channel, or 0 if more than `max_part` of its values differ."""
    levels = np.unique(current)
    return float(np.diff(levels).min()) if 1 < levels.size <= max_part * current.size else 0.0


def run_lengths(values: Rows) -> Rows:
    """Return for each sample the number of equal values in a row."""
    ends = np.append(np.flatnonzero(np.diff(values)), values.size - 1)
    lengths = np.diff(ends, prepend=-1)
    return np.repeat(lengths, lengths).astype(float)


def _count_runs(values: Rows) -> Rows:
    """Return for each sample in a run of equal values, and not its last one, how many runs have such a value.

    It is 0 for other samples. The opposite value counts, whose rounding error is the opposite one.
    """
    lengths = run_lengths(values)
    within = (lengths > FEW) & np.append(np.diff(values) == 0.0, False)
    begins = within & ~np.append(False, within[:-1])
    sizes, counts = np.unique(np.abs(values[begins]), return_counts=True)
    result = np.zeros(values.size)
    if sizes.size:
        result[within] = counts[np.searchsorted(sizes, np.abs(values[within]))]
    return result


def describe_terms(terms: HighpassTerms, stray: ArrayLike | None, delay: float, step: float) -> Current:
    """Return what the noise of the drive in a current depends on; `delay` is in time steps of `step` s.

    If a resistance limits the current, its capacitance is that whose rows have the same variance.
    """
    stray = 0.0 if stray is None else float(stray)
    if terms.rate is not None:
        return Current(float(terms.rate) + stray, float(np.sum(terms.weight)), delay)
    omega = math.pi / step * (np.arange(64) + 0.5) / 64.0
    gain = np.asarray(gain_at(terms, omega)) + 1j * omega * stray
    mean_square = float(np.mean(np.abs(gain * np.sinc(0.5 * omega * step / math.pi)) ** 2))
    return Current(math.sqrt(0.5 * mean_square) * step, 0.0, delay, follows=False)


# ---- estimates before a fit ----------------------------------------------------------------------------------------


def select_samples(record: Record, choice: DriveModel) -> tuple[Bool[np.ndarray, " samples"], Rows]:
    """Return the samples of I that a stated drive predicts, and its dV/dt (V/s), which is 0 at others."""
    slope = drive_slope(choice, record.time)
    used = ~edge_mask(choice.voltage) & np.isfinite(slope)  # a record may begin at a jump
    return used, np.where(used, slope, 0.0)


def edge_mask(voltage: Rows, margin: int = 2, threshold: float = 8.0, block: int = 64) -> Bool[np.ndarray, " samples"]:
    """Return which samples lie within `margin` steps of a sudden change of a stated drive's slope.

    A change is sudden if it exceeds `threshold` times the median over a `block` of samples.
    """
    bend = np.abs(np.diff(voltage, 2, prepend=voltage[0], append=voltage[-1]))
    blocks = np.pad(bend, (0, -bend.size % block), mode="edge").reshape(-1, block)
    median = np.repeat(np.median(blocks, axis=1), block)[: bend.size]
    edges = bend > threshold * np.maximum(median, 1e-9 * float(np.ptp(voltage)))
    return np.convolve(edges, np.ones(2 * margin + 1), mode="same") > 0.5


def estimate_from_current(
    record: Record, choice: DriveModel, used: Bool[np.ndarray, " samples"], slope: Rows, belief: Belief
) -> CurrentEstimate:
    """Estimate the coefficients of I for a stated drive with dV/dt `slope`, on a grid of time constants."""
    span = float(record.time[-1] - record.time[0])

    def fit_at_tau(tau: float) -> tuple[float, float, float]:
        columns = [unit_response(choice, record.time, tau), slope, np.ones_like(slope)]
        residual, amplitudes = _solve(np.stack(columns) * used, record["I"] * used)
        return residual, *amplitudes[:2]

    return _scan(fit_at_tau, np.geomspace(2.0 * record.time_step, 10.0 * span, 60), record.noise("I"), belief)


def _scan(
    fit_at_tau: Callable[[float], tuple[float, float, float]], taus: np.ndarray, noise: float, belief: Belief
) -> CurrentEstimate:
    """Return the most probable coefficients for any of the time constants, refined between its neighbours.

    `noise` is the standard deviation of the residuals.
    """
    mean, sd = belief
    for _ in range(2):
        costs, estimates = [], []
        for tau in taus:
            square, weight, capacitance = fit_at_tau(float(tau))
            estimates.append(CurrentEstimate(weight, float(tau), capacitance))
            skin = skin_from_estimates(None, estimates[-1])  # None if a coefficient is negative
            surprise = math.inf if skin is None else float(np.sum(np.square((np.log(skin) - mean) / sd)))
            costs.append((surprise == math.inf, square / noise**2 + (0.0 if skin is None else surprise)))
        best = min(range(taus.size), key=costs.__getitem__)
        if not 0 < best < taus.size - 1:
            break
        taus = np.geomspace(taus[best - 1], taus[best + 1], 17)
    return estimates[best]


def _solve(columns: np.ndarray, observed: np.ndarray, noisy: tuple[int, float] = (0, 0.0)) -> tuple[float, np.ndarray]:
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


def _first_order(V: Rows, step: float, tau: float) -> Rows:
    """Return the response of s tau / (1 + s tau) to V, linear between samples, from 0."""
    x = step / tau
    decay = np.full(V.size, math.exp(-x))
    return whiten_rows(np.full(V.size, -math.expm1(-x) / x), decay, np.diff(V, prepend=V[0]))


def estimate_recorded(
    current: RecordedCurrent, stray: float, hum: Sequence[float], belief: Belief, most: int = 4096
) -> tuple[CurrentEstimate, Rows]:
    """Estimate the coefficients of I for a recorded V by a scan of b, and return the rows of nuisances.

    Given b, I is linear in the other coefficients, so that the scan finds the global optimum. Charges of several steps
    add up, so that at most `most` rows serve. `hum` has frequencies (Hz) at which I may have a part of its own.
    """
    charge, V = scipy.signal.detrend(np.cumsum(current.I) * current.step), scipy.signal.detrend(current.V)
    C = abs(float(charge @ V)) / float(V @ V)  # between those of low and of high frequencies
    for _ in range(3):
        before = C
        estimate, nuisances = _scan_recorded(current, C, stray, hum, belief, most)
        C = abs(estimate.capacitance + stray)
        if abs(C - before) < 0.1 * before:
            break
    # noise of V draws a capacitance that the record does not determine to 0, from where no fit returns
    Ci, usual = estimate.capacitance + estimate.weight * estimate.b, math.exp(belief[0][2])
    if Ci < 0.3 * usual:
        estimate = estimate._replace(capacitance=estimate.capacitance + usual - Ci)
    return estimate, nuisances


def _scan_recorded(
    current: RecordedCurrent, C: float, stray: float, hum: Sequence[float], belief: Belief, most: int
) -> tuple[CurrentEstimate, Rows]:
    """Return the estimate and the nuisances where noise of V acts through the capacitance `C` (F)."""
    rise = current.rise(current.V)
    several = math.ceil((current.I.size - 3 * LAG) / most)
    first, count = 2 * LAG, (current.I.size - 2 * LAG) // several
    step = current.step * several
    covariance = current.covariance(Current(C, 0.0, 0.0))
    lost = _thin((covariance.recursion(1.0)[0] == 0.0) * 1.0, several) > 0.0
    uncertain = current.uncertain * current.shared + current.rounded * current.alike * run_lengths(current.I)
    own = current.noise_I**2 / several + _thin(np.roll(uncertain, LAG), several) / several
    own += 1e-24 * float(np.ptp(current.I)) ** 2
    noise_V = float(np.mean(current.variance_V))

    def recursion(capacitance: float) -> tuple[Rows, Rows]:
        driven = (capacitance / step) ** 2 * noise_V
        return RowCovariance(own + 2.0 * driven, np.full(count, -driven), lost).recursion(1.0)

    V = current.V[first - LAG :: several][: count + 1]
    V = np.pad(V, (0, count + 1 - V.size), mode="edge")
    time = step * np.arange(count)
    waves = [wave(2.0 * np.pi * f * time) for f in hum for wave in (np.cos, np.sin)]
    observed = _thin(step_means(current.I) - stray * rise, several)
    fixed = np.stack([np.diff(V) / step, np.ones(count), *waves])

    def fit(tau: float) -> tuple[float, np.ndarray]:
        u = _first_order(V, step, tau)
        mean = tau * (np.diff(V) - np.diff(u)) / step  # over a step, exactly
        rows = np.concatenate([[mean, np.exp(-time / tau)], fixed, observed[None]])
        capacitance = C
        for _ in range(2):  # a low-pass is no better for passing less noise of V
            gain, decay = recursion(capacitance)
            *columns, data = whiten_rows(gain, decay, rows)
            # the noise of V in dV/dt, which would lower the coefficient of a weak drive
            part = 1.0 - own / (own + 2.0 * (capacitance / step) ** 2 * noise_V)
            taken = float(np.sum(part[~lost])) / max(capacitance, 1e-15) ** 2
            square, amplitudes = _solve(np.stack(columns), data, (2, taken))
            # noise of V draws to 0 what the record does not determine
            has_drive = amplitudes[0] * tau + amplitudes[2] > 0.3 * usual
            capacitance = abs(amplitudes[2] + stray) if has_drive else usual
        return square, amplitudes

    def fit_at_tau(tau: float) -> tuple[float, float, float]:
        square, amplitudes = fit(tau)
        return square, float(amplitudes[0]), float(amplitudes[2])

    usual = math.exp(belief[0][2])
    taus = np.geomspace(max(2.0 * step, 1e-4), max(10.0 * step * count, 4e-4), 48)
    estimate = _scan(fit_at_tau, taus, 1.0, belief)
    amplitudes = fit(estimate.b)[1]
    time = current.step * (np.arange(current.I.size) - first)
    waves = [wave(2.0 * np.pi * f * time) for f in hum for wave in (np.cos, np.sin)]
    decays = np.exp(-np.maximum(time, -step) / estimate.b)
    return estimate, amplitudes[1] * decays + amplitudes[3:] @ np.stack([np.ones_like(time), *waves])


def hum_likeness(current: RecordedCurrent, frequency: float, most: int = 4096) -> float:
    """Return the fraction of a hum's power that a change of the circuit may explain; 1 below a period.

    It is the largest of circuits with a time constant of a fingertip.
    """
    several = math.ceil(current.I.size / most)
    step, V = current.step * several, current.V[: current.I.size // several * several].reshape(-1, several).mean(axis=1)
    if frequency * step * V.size < 1.0 or frequency * step > 0.5:
        return 1.0
    turns, largest = 2.0 * math.pi * frequency * step * np.arange(V.size), 0.0
    for b in (1e-3, 4e-3, 16e-3):
        u, later = (_first_order(V, step, tau) for tau in (b, 1.01 * b))
        decay = np.exp(-step * np.arange(V.size) / b)
        rows = np.stack([np.ones_like(V), decay, np.gradient(V), u, later - u])
        basis, _ = np.linalg.qr(rows.T / np.linalg.norm(rows, axis=1))
        parts = basis.T @ np.stack([np.cos(turns), np.sin(turns)], axis=1)
        largest = max(largest, float(np.sum(parts**2) / V.size))
    return largest


def respond_to(current: RecordedCurrent, estimate: CurrentEstimate, stray: float) -> Callable[[Rows], Rows]:
    """Return the function from a drive to the rows of the estimated current."""

    def respond(V: Rows) -> Rows:
        filtered = step_means(_first_order(V, current.step, estimate.b))
        return (estimate.capacitance + stray) * current.rise(V) + estimate.weight * filtered

    return respond


# ---- after a fit ---------------------------------------------------------------------------------------------------


def update_rows(likelihood: Likelihood, solution: LeastSquaresResult, sources: Sequence[Source]) -> Likelihood:
    """Return the likelihood with rows of charge for the drive, noise and delay at a solution."""
    optimum = solution.likelihood.evaluate_circuit(solution.theta)
    for i, (channel, solved) in enumerate(zip(likelihood.channels, solution.likelihood.channels, strict=True)):
        # nuisances that were added stay: without them, the next fit leaves the optimum and returns by hundreds of steps
        channel = dataclasses.replace(channel, linear_sd=solved.linear_sd)
        if channel.charges is not None:
            inputs = solution.likelihood.make_inputs(optimum.circuit, solution.theta, solved)
            beta = np.asarray(_fit_nuisances(solved, inputs, np.asarray(solution.sigma[i]))[1])
            sizes = beta * np.asarray(solved.linear_sd)[list(solved.columns)]
            channel = dataclasses.replace(channel, linear_sd=_expect_harmonics(solved, sizes))
            channel = set_rows(channel, *_rows_at(solved, inputs, sizes, sources[i].in_time))
        likelihood = likelihood.replace_channel(i, channel)
    return likelihood


def _expect_harmonics(channel: ChannelLikelihood, fitted: Float[np.ndarray, " columns"]) -> np.ndarray:
    """Return the prior sds of the linear nuisances, with a third harmonic of the size of each hum that was `fitted`.

    A harmonic beside one of the drive cannot be told from it, but its amplitude is about known.
    """
    linear_sd = np.array(channel.linear_sd, dtype=float)
    sizes = np.zeros(linear_sd.size)
    sizes[list(channel.columns)] = fitted
    names = list(channel.linear_names)
    for mains in (50, 60):
        first, third = (
            [names.index(f"hum_{frequency}Hz_{part}") for part in ("cos", "sin")] for frequency in (mains, 3 * mains)
        )
        linear_sd[third] = np.maximum(linear_sd[third], math.hypot(*sizes[first]))
    return linear_sd


def row_figures(
    white: Rows, channel: ChannelLikelihood, inputs: ChannelInputs, record: Record
) -> tuple[Rows, dict[str, float]]:
    """Return whitened rows without the spectrum of their own (`RecordedCurrent.flatten`), and figures of merit.

    Signs of rounded noise are not independent, and the covariance knows the rounding.
    """
    terms, current = inputs.circuit.channel_terms(channel.channel), RecordedCurrent.from_record(record)
    delay = float(channel.shift) / current.step
    figures = {
        "runs_z": 0.0,
        "rounding_noise": 0.0,
        "within_steps": float(current.is_within_steps),
        "rounding_V": current.noise_V[1] if current.noise_V[0] < current.noise_V[1] else 0.0,
    }
    return current.flatten(white, describe_terms(terms, inputs.stray, delay, current.step)), figures


def _rows_at(
    channel: ChannelLikelihood, inputs: ChannelInputs, sizes: Float[np.ndarray, " columns"], record: Record
) -> tuple[ChargeRows, Rows, float]:
    """Return rows and drive of a channel at its optimum, with nuisances of these `sizes`, and the delay (s)."""
    current, size = RecordedCurrent.from_record(record), len(record)
    full = channel.without_compression()
    skew, inputs = float(inputs.delay) / current.step, dataclasses.replace(inputs, delay=np.zeros(()))
    delay = float(full.shift) / current.step + float(np.clip(skew, -0.5, 0.5))
    delay = float(np.clip(delay, 0.5 - MAX_STEPS, MAX_STEPS - 0.5))

    @functools.lru_cache(maxsize=1)
    def respond_to_V() -> tuple[np.ndarray, np.ndarray]:
        return _modelled_rows(_with_drive(full, current, current.V), inputs, sizes)

    def respond(V: Rows) -> Rows:
        pair = respond_to_V() if V is current.V else _modelled_rows(_with_drive(full, current, V), inputs, sizes)
        return np.asarray(pair[0])[:size]

    terms = inputs.circuit.channel_terms(channel.channel)
    modelled = describe_terms(terms, inputs.stray, delay, current.step)
    return *current.make_rows(modelled, respond, np.asarray(respond_to_V()[1])[:size]), delay * current.step


def set_rows(channel: ChannelLikelihood, rows: ChargeRows, V: Rows, delay: float) -> ChannelLikelihood:
    """Return the channel with rows of charge, an estimate of the drive, and the delay (s) at which they are taken."""
    length = np.shape(channel.time)[0]
    padded = jax.tree.map(lambda x: np.pad(x, (0, length - x.size)), rows)
    assert isinstance(channel.drive, Sampled)
    drive = Sampled(channel.drive.time, pad_samples(V))
    channel = channel.without_compression()
    return dataclasses.replace(channel, drive=drive, charges=padded, shift=np.asarray(delay, dtype=float))


def _with_drive(channel: ChannelLikelihood, current: RecordedCurrent, V: Rows) -> ChannelLikelihood:
    """Return the channel of a current that is 0, with another drive."""
    assert channel.charges is not None
    assert isinstance(channel.drive, Sampled)
    length = np.shape(channel.time)[0]
    rise = np.pad(current.rise(V), (0, length - V.size))
    charges = dataclasses.replace(channel.charges, observed=np.zeros(length), rate=rise)
    return dataclasses.replace(channel, drive=Sampled(channel.drive.time, pad_samples(V)), charges=charges)


@jit
def _modelled_rows(channel: ChannelLikelihood, inputs: ChannelInputs, sizes: Array) -> tuple[Array, Array]:
    """Return the rows of the signal of a channel that observed 0, and those of nuisances of these sizes."""
    rows, shapes = channel.rows_and_shapes(inputs)
    return -rows, sizes @ shapes


_fit_nuisances = jit(ChannelLikelihood.fit_nuisances)
