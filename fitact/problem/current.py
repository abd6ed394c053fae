"""Estimates of the circuit from the loop current before any fit, by a scan of its time constant."""

import functools
import math
from collections.abc import Callable, Sequence

import numpy as np
import scipy
from jaxtyping import Bool

from fitact.data.record import Record
from fitact.likelihood.charge_rows import LAG, MAX_STEPS, RowCovariance, filter_highpass, step_means, whiten_rows
from fitact.problem.drive_choice import DriveModel, drive_slope, unit_response
from fitact.problem.jumps import block_medians
from fitact.problem.recorded_current import Current, RecordedCurrent, solve_linear, thin_rows
from fitact.problem.runs import Rows, run_lengths
from fitact.problem.starting_point import CurrentEstimate, skin_from_estimates

Belief = tuple[np.ndarray, np.ndarray]  # prior means and sds of log Rsc, log Csc and log Ci


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
    edges = bend > threshold * np.maximum(block_medians(bend, block), 1e-9 * float(np.ptp(voltage)))
    return np.convolve(edges, np.ones(2 * margin + 1), mode="same") > 0.5


def estimate_from_current(
    record: Record, choice: DriveModel, used: Bool[np.ndarray, " samples"], slope: Rows, belief: Belief
) -> CurrentEstimate:
    """Estimate the coefficients of I for a stated drive with dV/dt `slope`, on a grid of time constants."""
    span = float(record.time[-1] - record.time[0])

    def fit_at_tau(tau: float) -> tuple[float, float, float]:
        columns = [unit_response(choice, record.time, tau), slope, np.ones_like(slope)]
        residual, amplitudes = solve_linear(np.stack(columns) * used, record["I"] * used)
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


def estimate_recorded(
    current: RecordedCurrent, stray: float, hum: Sequence[float], belief: Belief, resistance: float = 0.0
) -> tuple[CurrentEstimate, Rows]:
    """Estimate the coefficients of I for a recorded V by a scan of b, and return the rows of nuisances.

    Given b, I is linear in the other coefficients, so that the scan finds the global optimum. A `resistance` (ohm) in
    the loop makes I late. `hum` has frequencies (Hz) at which I may have a part of its own.
    """
    charge, V = scipy.signal.detrend(np.cumsum(current.I) * current.step), scipy.signal.detrend(current.V)
    C = abs(float(charge @ V)) / float(V @ V)  # between those of low and of high frequencies
    for _ in range(3):
        before = C
        estimate, nuisances = _scan_recorded(current, C, stray, hum, belief, resistance * C)
        C = abs(estimate.capacitance + stray)
        if abs(C - before) < 0.1 * before:
            break
    if _lacks_capacitance(estimate, belief):  # from where no fit returns
        usual = math.exp(belief[0][2]) - estimate.weight * estimate.b
        estimate = estimate._replace(capacitance=usual)
    return estimate, nuisances


def _lacks_capacitance(estimate: CurrentEstimate, belief: Belief, least: float = 0.3, sds: float = 2.0) -> bool:
    """Return whether Ci is below `least` of its prior median, and by `sds`: noise of V draws it to 0."""
    mean, sd = (each[2] for each in belief)
    return estimate.Ci < min(least, math.exp(-sds * sd)) * math.exp(mean)


def _scan_recorded(
    current: RecordedCurrent,
    C: float,
    stray: float,
    hum: Sequence[float],
    belief: Belief,
    lag: float,
    most: int = 4096,
) -> tuple[CurrentEstimate, Rows]:
    """Return the estimate and the nuisances where noise of V acts through the capacitance `C` (F).

    I is late by the time constant `lag` (s), and its changes are then uncertain by a time step. Charges of several
    steps add up, so that at most `most` rows serve.
    """
    rise = current.rise(current.V)
    several = math.ceil((current.I.size - 3 * LAG) / most)
    first, count = 2 * LAG, (current.I.size - 2 * LAG) // several
    step = current.step * several
    delay = max(current.start_delay - lag / current.step, float(-MAX_STEPS))
    lost = thin_rows(current.excluded_rows(delay) * 1.0, several) > 0.0
    (means, uncertain), rounded = current.step_means(Current(C, 0.0, delay)), current.rounded
    common = np.roll(rounded.variance * rounded.alike * run_lengths(rounded.group), LAG)
    own = current.noise_I**2 / several + thin_rows(uncertain * current.jumps.alike + common, several) / several
    own += 1e-24 * float(np.ptp(current.I)) ** 2
    V, noise_V, is_exact = _pass_low(current, lag)
    V = V[first - LAG :: several][: count + 1]
    V = np.pad(V, (0, count + 1 - V.size), mode="edge")
    time = step * np.arange(count)
    observed = thin_rows(means - stray * rise, several)
    own += (not is_exact) * np.square(np.gradient(observed) / several)
    fixed = np.stack([np.diff(V) / step, np.ones(count), *_waves(hum, time), observed])

    @functools.lru_cache
    def whiten_fixed(twentieths: int) -> tuple[Rows, Rows, np.ndarray, float]:
        """Return gain, decay and whitened rows where the logarithm of the capacitance has these twentieths.

        Also the sum of squares of the noise in dV/dt, which would lower the coefficient of a weak drive.
        """
        capacitance = math.exp(0.05 * twentieths)
        driven = (capacitance / step) ** 2 * noise_V
        gain, decay = RowCovariance(own + 2.0 * driven, np.full(count, -driven), lost).recursion(1.0)
        taken = float(np.sum((1.0 - own / (own + 2.0 * driven))[~lost])) / capacitance**2
        return gain, decay, whiten_rows(gain, decay, fixed), taken

    def fit(tau: float) -> tuple[float, np.ndarray]:
        u = filter_highpass(np.diff(V, prepend=V[0]), step / tau)[0]
        mean = tau * (np.diff(V) - np.diff(u)) / step  # over a step, exactly
        rows, capacitance = np.stack([mean, np.exp(-time / tau)]), C
        for _ in range(2):  # a low-pass is no better for passing less noise of V
            gain, decay, (*others, data), taken = whiten_fixed(round(20.0 * math.log(max(capacitance, 1e-15))))
            columns = np.stack([*whiten_rows(gain, decay, rows), *others])
            square, amplitudes = solve_linear(columns, data, (2, taken))
            lacks = _lacks_capacitance(CurrentEstimate(amplitudes[0], tau, amplitudes[2]), belief)
            capacitance = math.exp(belief[0][2]) if lacks else abs(amplitudes[2] + stray)
        return square, amplitudes

    def fit_at_tau(tau: float) -> tuple[float, float, float]:
        square, amplitudes = fit(tau)
        return square, float(amplitudes[0]), float(amplitudes[2])

    shortest = max(2.0 * step, 3.0 * lag, 1e-4)
    taus = np.geomspace(shortest, max(10.0 * step * count, 4.0 * shortest), 48)
    estimate = _scan(fit_at_tau, taus, 1.0, belief)
    amplitudes = fit(estimate.b)[1]
    time = current.step * (np.arange(current.I.size) - first)
    decays = np.exp(-np.maximum(time, -step) / estimate.b)
    return estimate, amplitudes[1] * decays + amplitudes[3:] @ np.stack([np.ones_like(time), *_waves(hum, time)])


def _pass_low(current: RecordedCurrent, lag: float) -> tuple[Rows, float, bool]:
    """Return V behind a low-pass with the time constant `lag` (s), the variance of its noise, and whether it is exact.

    Tones are known between the samples, and without noise.
    """
    if current.tones is not None:
        return current.tones.scale(1.0 / (1.0 + 1j * current.tones.frequencies * lag / current.step)), 0.0, True
    decay = math.exp(-current.step / lag) if lag > 0.0 else 0.0
    V, _ = scipy.signal.lfilter([1.0 - decay], [1.0, -decay], current.V, zi=decay * current.V[:1])
    return V, float(np.mean(current.variance_V)) * (1.0 - decay) / (1.0 + decay), lag == 0.0


def _waves(frequencies: Sequence[float], time: Rows) -> list[Rows]:
    return [wave(2.0 * np.pi * frequency * time) for frequency in frequencies for wave in (np.cos, np.sin)]


def hum_likeness(current: RecordedCurrent, frequency: float, most: int = 4096) -> float:
    """Return the fraction of a hum's power that a change of the circuit may explain; 1 below a period.

    It is the largest of circuits with a time constant of a fingertip.
    """
    several = math.ceil(current.I.size / most)
    step, V = current.step * several, current.V[: current.I.size // several * several].reshape(-1, several).mean(axis=1)
    if frequency * step * V.size < 1.0 or frequency * step > 0.5:
        return 1.0
    time, largest = step * np.arange(V.size), 0.0
    for b in (1e-3, 4e-3, 16e-3):
        u, later = (filter_highpass(np.diff(V, prepend=V[0]), step / tau)[0] for tau in (b, 1.01 * b))
        rows = np.stack([np.ones_like(V), np.exp(-time / b), np.gradient(V), u, later - u])
        basis, _ = np.linalg.qr(rows.T / np.linalg.norm(rows, axis=1))
        parts = basis.T @ np.stack(_waves([frequency], time), axis=1)
        largest = max(largest, float(np.sum(parts**2) / V.size))
    return largest


def respond_to(current: RecordedCurrent, estimate: CurrentEstimate, stray: float) -> Callable[[Rows], Rows]:
    """Return the function from a drive to the rows of the estimated current."""

    def respond(V: Rows) -> Rows:
        filtered = step_means(filter_highpass(np.diff(V, prepend=V[0]), current.step / estimate.b)[0])
        return (estimate.capacitance + stray) * current.rise(V) + estimate.weight * filtered

    return respond
