"""Expected uncertainties of parameters and force from an experiment, before or after it is done.

They come from the Fisher information of the channels and the prior, in the same Laplace approximation as a fit. No
offset or drift is taken to be unknown, and delays and the initial charge are only beside a recorded drive.

A recorded drive has noise, too. A fit that knows the drive from its record alone then has the residuals e = x - h V
with the covariance diag(s^2) + s_V^2 h h^H at each frequency, where h are the channels' gains over V (errors in
variables: Pintelon and Schoukens, System Identification: A Frequency Domain Approach, chapter 9).
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Complex, Float

from fitact.compiled import as_arrays, double_precision, jit
from fitact.experiment.blind_directions import log_values, recorded_gain, with_parameters
from fitact.model.circuit import Channel, Circuit
from fitact.model.drive import Drive, Periodic, Sampled
from fitact.model.force import Geometry, force_constant
from fitact.model.response import drive_voltage, highpass, response_and_rate
from fitact.model.skin import circuit_parameters, has_time_constants, limits_current, with_values

Ties: TypeAlias = tuple[tuple[str, str, float], ...]  # (name, other, ratio): name = ratio * other


@dataclasses.dataclass(frozen=True)
class Experiment:
    """A measurement, made or planned."""

    circuit: Circuit  # at the expected values
    free: tuple[str, ...]  # unknown parameters: fields of the circuit, "gain" (of Vsc), "gain_I", "stray_capacitance"
    prior_factor: Float[np.ndarray, "parameters parameters"]  # root of the prior covariance of the log-parameters
    drive: Drive
    time: Float[np.ndarray, " samples"]  # s, on the drive's time axis
    channels: tuple[Channel, ...]  # recorded in addition to V
    noise: Mapping[str, float]  # sd of each channel, V and A; that of "V" is absent or 0 where the drive is stated
    steady_state: bool = True  # False means from rest
    records: float = 1.0  # number of such records
    geometry: Geometry = Geometry()  # noqa: RUF009  (a frozen Module; areas are factors only)
    own_parameters: tuple[str, ...] = ()  # parameters in `free` that no other experiment shares
    ties: Ties = ()  # between fields of the circuit
    stray_capacitance: float = 0.0  # F, of panel and cable, whose current I includes
    # relative sd of the gain that a channel would have if it was also recorded; a channel without one is exact
    new_gain_sd: Mapping[str, float] = dataclasses.field(default_factory=dict)
    new_stray_sd: float = 0.0  # sd of log(stray_capacitance) that I would add if it was also recorded
    # sd of the unknown delay of each channel against a V with noise, s; a channel without one is not late
    delay_sd: Mapping[str, float] = dataclasses.field(default_factory=dict)
    # steps of V at the first sample that would leave its unknown charge, one for each time constant, V; the charge is
    # known without them, and beside a V without noise
    initial_steps: tuple[float, ...] = ()


def force_gradient(experiment: Experiment) -> Float[np.ndarray, " circuit_parameters"]:
    """Return the gradient of the log mean force of an experiment in its log-parameters."""
    with double_precision():
        sampling, model = _sampling(experiment), _Model.from_experiment(experiment)
        ((voltage, slope),) = _derivatives(model, sampling, slice(-1, None))
        constant = _force_constant_slope(model, as_arrays(experiment.geometry))
    weight = sampling.force_weight * voltage
    return constant + 2.0 * (weight @ slope) / (weight @ voltage)


def jacobian(experiment: Experiment) -> Float[np.ndarray, "rows parameters"]:
    """Return the Jacobian of the signals in units of their noise, in the logarithms of the free parameters."""
    has_noise = experiment.noise.get("V", 0.0) > 0.0
    experiment = _represent_by_uniform_samples(experiment) if has_noise else experiment
    with double_precision():
        sampling, model = _sampling(experiment), _Model.from_experiment(experiment)
        signals = _derivatives(model, sampling, slice(-1))
        if has_noise:
            return _whitened_derivatives(experiment, model, sampling, signals)
    blocks = []
    for channel, (_, slope) in zip(experiment.channels, signals, strict=True):
        weight = sampling.off_edge_weight if _follows_slope(experiment, channel) else sampling.sample_weight
        blocks.append(slope * (weight / experiment.noise[channel])[:, None])
    return np.concatenate(blocks)


def _follows_slope(e: Experiment, channel: Channel) -> bool:
    """Return whether a channel follows dV/dt, so that its samples at edges are not used."""
    return channel == "I" and (not limits_current(e.circuit) or e.stray_capacitance > 0.0)


def _represent_by_uniform_samples(e: Experiment, max_samples: int = 4096) -> Experiment:
    """Return at most `max_samples` samples, evenly over a period or a record, of a drive without its noise.

    They are repeated until the information is that of all samples.
    """
    time, drive = np.asarray(e.time, dtype=float), e.drive
    step, period = float(np.median(np.diff(time))), getattr(drive, "period", None)
    if isinstance(drive, Sampled):
        drive = _remove_noise(drive, float(time[-1]), e.noise["V"])
    if e.steady_state and period is not None:
        length, count = float(period), max(round(float(period) / step), 8)
    else:
        length, count = float(time[-1] - time[0]) + step, time.size
    count = min(count, max_samples)
    grid = time[0] + length / count * np.arange(count)
    if isinstance(drive, Sampled) and period is None and drive.time.size > 2 * max_samples:
        drive = Sampled(grid, np.interp(grid, drive.time, drive.samples))
    return dataclasses.replace(e, drive=drive, time=grid, records=e.records * np.size(e.time) / count)


def _remove_noise(drive: Sampled, end: float, noise: float, min_ratio: float = 10.0) -> Sampled:
    """Return a measured drive with those of its lines whose power is more than `min_ratio` times that of the noise.

    The noise would pass for a known drive otherwise. Samples until the time `end` (s) are used, or those of its period.
    """
    time, samples = np.asarray(drive.time), np.asarray(drive.samples)
    last = min(end, time[-1]) if drive.period is None else time[0] + float(drive.period) - time[1] + time[0]
    # half a step for rounding; samples that fill an array up follow
    count = 1 + int(np.searchsorted(time, last - 0.5 * (time[1] - time[0])))
    time, samples = time[:count], samples[:count]
    step = samples[-1] - samples[-2]
    # of a drive that does not end where it began; one sample before that, it has run through whole periods
    rise = samples[-1] - samples[0] if abs(samples[-1] + step - samples[0]) > abs(step) + 5.0 * noise else 0.0
    trend = np.linspace(0.0, 0.0 if drive.period is not None else rise, count)
    lines = np.fft.rfft(samples - trend)
    lines[np.abs(lines) ** 2 < min_ratio * count * noise**2] = 0.0
    clean = np.fft.irfft(lines, count) + trend
    return dataclasses.replace(drive, time=time, samples=clean)


def _whitened_derivatives(
    e: Experiment, model: "_Model", sampling: "_Sampling", signals: list[tuple[np.ndarray, np.ndarray]]
) -> Float[np.ndarray, "rows parameters"]:
    """Return the derivatives of uniform samples in units of the noise of channels and V, by frequency.

    Unknown delays and charges count as noise. Samples that are not used have an error of their own each, whose
    direction is removed. `signals` holds the values of each channel, and their derivatives.
    """
    count, step = e.time.size, float(e.time[1] - e.time[0])
    omega = 2.0 * np.pi * np.fft.rfftfreq(count, step)
    padded = np.pad(omega, (0, len(sampling.time) - omega.size), mode="edge")  # one length, so one program
    scale = 1.0 / np.array([e.noise[channel] for channel in e.channels])
    gain = scale * np.asarray(_channel_gains(model, padded))[: omega.size]
    covariance = np.eye(scale.size) + e.noise["V"] ** 2 * gain[:, :, None] * gain[:, None, :].conj()
    root = np.linalg.cholesky(covariance)
    multiplicity = np.where((omega == 0.0) | (2 * np.arange(omega.size) == count), 1.0, 2.0)  # of lines in a spectrum

    def whiten(signals: Float[np.ndarray, "samples channels n"]) -> Float[np.ndarray, "rows n"]:
        lines = np.fft.rfft(signals * scale[:, None], axis=0) * np.sqrt(multiplicity / count)[:, None, None]
        white = np.linalg.solve(root, lines).reshape(-1, signals.shape[2])
        return np.concatenate([white.real, white.imag])

    values, slopes = (np.stack([each[:count] for each in pair], axis=1) for pair in zip(*signals, strict=True))
    transient, decays = _unknown_charges(e, model, values)
    delayed = np.eye(scale.size) * [e.delay_sd.get(channel, 0.0) for channel in e.channels]
    delayed = delayed * np.gradient(values, step, axis=0)[:, :, None]
    rows = whiten(np.concatenate([slopes + transient, delayed, decays], axis=2))
    beside_edge = sampling.off_edge_weight[:count] == 0.0
    beside_edge[[0, 1, -2, -1]] |= not e.steady_state  # before and after which the drive is at rest
    unused = [
        (sample, number)
        for number, channel in enumerate(e.channels)
        if _follows_slope(e, channel)
        for sample in np.flatnonzero(beside_edge)
    ]
    if unused:
        impulses = np.zeros((count, scale.size, len(unused)))
        for column, (sample, number) in enumerate(unused):
            impulses[sample, number, column] = 1.0 / scale[number]
        basis = np.linalg.qr(whiten(impulses))[0]
        rows -= basis @ (basis.T @ rows)
    rows, others = np.split(sampling.sample_weight[0] * rows, [len(e.free)], axis=1)
    directions, sizes, _ = np.linalg.svd(others, full_matrices=False)
    return rows - directions * (1.0 - 1.0 / np.hypot(1.0, sizes)) @ (directions.T @ rows)


def _unknown_charges(
    e: Experiment, model: "_Model", values: Float[np.ndarray, "samples channels"]
) -> tuple[Float[np.ndarray, "samples channels parameters"], Float[np.ndarray, "samples channels charges"]]:
    """Return the derivatives of what initial charges add to uniform samples, and the effects of an unknown charge.

    Each channel has a charge of its own for each time constant, whose standard deviation is ten times the range of the
    channel, as in a fit.
    """
    size, n = values.shape
    if not e.initial_steps or not has_time_constants(e.circuit):
        return np.zeros((size, n, len(e.free))), np.zeros((size, n, 0))
    terms, slopes = (each[:n] for each in _term_derivatives(model))
    tau = np.exp(np.array([each.log_tau for each in terms]))
    since = (e.time - e.time[0])[:, None, None] / tau
    decay = np.exp(-since)
    steps = np.pad(e.initial_steps, (0, tau.shape[1]))[: tau.shape[1]]
    changes = since * decay * steps * np.array([each.weight for each in terms])
    transient = np.einsum("snk,nkp->snp", changes, np.array([each.log_tau for each in slopes]))
    unknown = 10.0 * np.ptp(values, axis=0)[:, None, None] * np.eye(n)[:, :, None] * decay[:, :, None, :]
    return transient, unknown.reshape(size, n, -1)


def signal_spans(experiment: Experiment) -> dict[Channel, float]:
    """Return the range of each channel's samples, V and A, without a current's samples at edges."""
    with double_precision():
        sampling, model = _sampling(experiment), _Model.from_experiment(experiment)
        signals = _derivatives(model, sampling, slice(-1))
    kept, channels = sampling.off_edge_weight > 0.0, experiment.channels
    return {channel: float(np.ptp(value[kept])) for channel, (value, _) in zip(channels, signals, strict=True)}


def covariance_factor(
    jacobian: Float[np.ndarray, "samples parameters"], prior_factor: Float[np.ndarray, "parameters parameters"]
) -> Float[np.ndarray, "parameters parameters"]:
    """Return the Cholesky factor of the covariance in the Laplace approximation.

    `jacobian` is the Jacobian of the whitened residuals, `prior_factor` a root of the prior's covariance. Singular
    values are used because their squares span more digits than a double has. The factor is lower triangular with a
    positive diagonal, because rounding decides the sign of singular vectors, and seeded draws would depend on it.
    """
    _, sizes, directions = np.linalg.svd(jacobian @ prior_factor, full_matrices=False)
    _, triangle = np.linalg.qr((prior_factor @ directions.T / np.hypot(1.0, sizes)).T)
    return triangle.T * np.sign(np.diagonal(triangle))


class _Model(eqx.Module):
    """An experiment's circuit as a function of log-parameters, with ties."""

    circuit: Circuit
    theta: Float[Array, " parameters"]  # present values
    stray: Float[Array, ""]  # stray capacitance where it is not free, F
    names: tuple[str, ...] = eqx.field(static=True)  # parameters
    channels: tuple[Channel, ...] = eqx.field(static=True)  # recorded channels, then the voltage that causes the force
    ties: Ties = eqx.field(static=True)

    @classmethod
    def from_experiment(cls, e: Experiment) -> "_Model":
        theta = log_values(e.circuit, e.free, e.channels, e.stray_capacitance)
        circuit = as_arrays(e.circuit)  # plain numbers would become constants of the compiled program
        channels: tuple[Channel, ...] = (*e.channels, "Vsc" if e.geometry.model == "paper" else "Vgap")
        return cls(circuit, theta, np.asarray(e.stray_capacitance, dtype=float), e.free, channels, e.ties)

    def circuit_and_gains(self, theta: Array) -> tuple[Circuit, list[ArrayLike], list[ArrayLike]]:
        """Return the circuit, and the gain and the stray capacitance of each channel, at `theta`."""
        circuit, gains, strays = with_parameters(self.circuit, self.names, self.channels[:-1], theta, self.stray)
        known = circuit_parameters(circuit)
        circuit = with_values(circuit, {name: ratio * known[other] for name, other, ratio in self.ties})
        return circuit, [*gains, 1.0], [*strays, 0.0]


def _derivatives(model: _Model, sampling: "_Sampling", selection: slice) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the signal of each channel in `selection`, and its derivatives in the parameters."""
    if has_time_constants(model.circuit):
        pairs = list(zip(*_term_derivatives(model), strict=True))[selection]
        return [_signal_derivatives(terms, slopes, sampling) for terms, slopes in pairs]
    times = sampling.time, sampling.slope
    return list(zip(*_predicted_signals(model, sampling.drive, *times, sampling.steady_state), strict=True))[selection]


class _LogTauTerms(NamedTuple):
    """High-pass terms of a channel, or their derivatives in the parameters."""

    weight: Array
    log_tau: Array
    rate: Array
    direct: Array


@jit
def _term_derivatives(model: _Model) -> tuple[list[_LogTauTerms], list[_LogTauTerms]]:
    """Return the terms of each channel, and their derivatives in the parameters."""

    def terms(theta: Array) -> list[_LogTauTerms]:
        circuit, gains, strays = model.circuit_and_gains(theta)
        of_channels = []
        for gain, stray, channel in zip(gains, strays, model.channels, strict=True):
            weight, tau, *others = circuit.channel_terms(channel)
            rate, direct = (gain * jnp.asarray(0.0 if each is None else each) for each in others)
            rate = rate + gain * stray
            of_channels.append(_LogTauTerms(gain * jnp.stack(weight), jnp.log(jnp.stack(tau)), rate, direct))
        return of_channels

    return terms(model.theta), jax.jacfwd(terms)(model.theta)


@jit
def _channel_gains(model: _Model, omega: Float[Array, " lines"]) -> Complex[Array, "lines channels"]:
    """Return the recorded channels over V at angular frequencies (rad/s)."""
    circuit, gains, strays = model.circuit_and_gains(model.theta)
    channels = list(zip(model.channels, gains, strays, strict=True))[:-1]
    return jnp.stack([recorded_gain(circuit, *each, omega) for each in channels], axis=1)


@jit
def _force_constant_slope(model: _Model, geometry: Geometry) -> Float[Array, " parameters"]:
    """Return the gradient of log(force / voltage^2) in the parameters."""

    def log_force(theta: Array) -> Array:
        return jnp.log(force_constant(geometry.contact(model.circuit_and_gains(theta)[0])))

    return jax.jacfwd(log_force)(model.theta)


class _Sampling(NamedTuple):
    """Times at which the responses are computed; their number is fixed, so that the function compiles once."""

    drive: Drive
    steady_state: bool
    time: Float[np.ndarray, " times"]  # s
    slope: Float[np.ndarray, " times"]  # dV/dt there, V/s
    voltage: Float[np.ndarray, " times"]  # V there
    sample_weight: Float[np.ndarray, " times"]  # square root of the number of samples that each time represents
    off_edge_weight: Float[np.ndarray, " times"]  # same, but 0 near the drive's edges
    force_weight: Float[np.ndarray, " times"]  # weights of the times in the mean force


def _sampling(e: Experiment, max_samples: int = 4096, period_times: int = 1024, edge_ratio: float = 10.0) -> _Sampling:
    """Choose at most `max_samples` samples that represent a record, and `period_times` times for the mean force.

    A step of V above `edge_ratio` times the mean step is an edge; the largest step of a sine is 1.6 times the mean.
    If V is recorded with a known noise, edges of four steps or more are resolved, and their samples are used.
    """
    padded, time = _pad_drive(e.drive, np.asarray(e.time, dtype=float))
    drive: Any = as_arrays(padded)
    k, used = np.arange(max_samples), min(time.size, max_samples)
    # the golden ratio spreads the chosen samples evenly and out of step with any period
    spread = (time.size * (0.5 * (math.sqrt(5.0) - 1.0) * k % 1.0)).astype(int)
    chosen = np.minimum(k, used - 1) if time.size <= max_samples else spread
    represented = np.where(k < used, math.sqrt(e.records * np.size(e.time) / used), 0.0)
    periodic = e.steady_state and isinstance(drive, Periodic)
    phases = (np.arange(period_times) + 0.5) / period_times
    period = float(drive.period) * phases if periodic else np.full(period_times, time[0])
    times = np.append(time[chosen], period)
    # two samples on either side of an edge carry no information on a current that follows dV/dt; the quarter step keeps
    # rounding from deciding where edges coincide with samples
    around = time[chosen][:, None] + (np.arange(-2, 3) + 0.25) * float(np.median(np.diff(time)))
    has_noise = e.noise.get("V", 0.0) > 0.0
    if isinstance(drive, Sampled) and not has_noise:
        # by NumPy, which is faster; the slope is mostly noise, so a signal that follows it counts as uninformative
        near, voltage = (np.interp(each, drive.time, drive.samples, period=drive.period) for each in (around, times))
        slope = np.zeros_like(times)
    else:
        near, slope, voltage = _evaluate_drive(drive, around, times, e.steady_state)
    step = np.abs(np.diff(near, axis=1))
    largest = 0.25 * np.ptp(near[:used]) if has_noise else edge_ratio * step[:used].mean()
    off_edge = step.max(axis=1) <= largest
    outside = np.zeros(period_times)
    return _Sampling(
        drive,
        e.steady_state,
        times,
        slope,
        voltage,
        sample_weight=np.append(represented, outside),
        off_edge_weight=np.append(off_edge * represented, outside),
        force_weight=np.append(np.zeros(max_samples), 1.0 + outside) if periodic else np.append(k < used, outside),
    )


def _pad_drive(drive: Drive, time: np.ndarray, samples: int = 8192) -> tuple[Drive, np.ndarray]:
    """Pad a measured drive to a fixed number of samples; return it with the times within its record."""
    # the beginning represents a long record, because each sample costs time
    if not isinstance(drive, Sampled) or drive.period is not None:
        return drive, time
    knots, voltage = np.asarray(drive.time)[:samples], np.asarray(drive.samples)[:samples]
    missing = samples - knots.size
    after = knots[-1] + (1.0 + np.arange(missing)) * (knots[-1] - knots[0])
    return Sampled(np.append(knots, after), np.pad(voltage, (0, missing), mode="edge")), time[time <= knots[-1]]


@jit
def _evaluate_drive(drive: Drive, around: Array, time: Array, steady_state: bool) -> tuple[Array, Array, Array]:
    """Return the drive at the times `around`, its slope at `time`, 0 at jumps, and the drive at `time`."""
    voltage = drive_voltage(drive, time, steady_state=steady_state)
    return drive.value(around), jnp.nan_to_num(drive.slope(time, steady_state=steady_state)), voltage


@jit
def _highpass_and_slope(drive: Drive, time: Array, log_tau: Array, steady_state: bool) -> tuple[Array, Array]:
    """Return the response of one term, and its derivative in log tau."""

    def response(log_tau: Array) -> Array:
        return highpass(drive, time, jnp.exp(log_tau), steady_state=steady_state)

    return jax.jvp(response, (log_tau,), (jnp.ones_like(log_tau),))


@jit
def _predicted_signals(
    model: _Model, drive: Drive, time: Array, drive_slope: Array, steady_state: bool
) -> tuple[list[Array], list[Array]]:
    def signals(theta: Array) -> tuple[list[Array], list[Array]]:
        circuit, gains, strays = model.circuit_and_gains(theta)
        of_channels = []
        for gain, stray, channel in zip(gains, strays, model.channels, strict=True):
            value, rate = response_and_rate(circuit, drive, time, steady_state=steady_state, channel=channel)
            rate = (0.0 if rate is None else rate) + stray
            of_channels.append(gain * (value + rate * drive_slope))
        return of_channels, of_channels

    slopes, values = jax.jacfwd(signals, has_aux=True)(model.theta)
    return values, slopes


def _signal_derivatives(
    terms: _LogTauTerms, slopes: _LogTauTerms, sampling: _Sampling
) -> tuple[np.ndarray, np.ndarray]:
    """Return a channel's signal and its derivatives in the log-parameters, from the terms and their derivatives.

    The sum runs term by term, because one compiled function for all takes ten times as long to compile.
    """
    value, slope = (
        np.multiply.outer(sampling.slope, order.rate) + np.multiply.outer(sampling.voltage, order.direct)
        for order in (terms, slopes)
    )
    for weight, log_tau, w, tau in zip(terms.weight, terms.log_tau, slopes.weight, slopes.log_tau, strict=True):
        u, du = _highpass_and_slope(sampling.drive, sampling.time, log_tau, sampling.steady_state)
        value += weight * u
        slope += np.outer(u, w) + np.outer(weight * du, tau)
    return value, slope
