"""Rows of charge at the optimum of a fit: with its circuit, nuisances and delay, and the drive estimated there."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Array, Float

from fitact.compiled import jit, pad_samples
from fitact.data.record import Record
from fitact.data.tones import Tones
from fitact.fitting.channel_fit import sample_residuals
from fitact.fitting.least_squares import LeastSquaresResult
from fitact.fitting.timing import free_timing
from fitact.likelihood.channel import ChannelLikelihood, compiled_fit_nuisances, compiled_signal
from fitact.likelihood.charge_rows import MAX_STEPS, ChargeRows
from fitact.likelihood.compression import HUM_FREQUENCIES
from fitact.likelihood.likelihood import CircuitValues, Likelihood
from fitact.likelihood.observable import ChannelInputs
from fitact.model.circuit import gain_at
from fitact.model.drive import Sampled
from fitact.problem.limited_current import NoisePath, estimate_drive, replace_drive, set_drive
from fitact.problem.recorded_current import Current, RecordedCurrent, set_rows
from fitact.problem.runs import Rows
from fitact.problem.source import Source


def estimate_drives(
    likelihood: Likelihood, theta: Float[np.ndarray, " parameters"], sources: Sequence[Source]
) -> Likelihood:
    """Return the likelihood with estimates at theta of the delays and drives of currents that a resistance limits.

    An estimate of the drive at a wrong delay would be a minimum.
    """
    circuit = likelihood.evaluate_circuit(theta)
    for i, (channel, source) in enumerate(zip(likelihood.channels, sources, strict=True)):
        if channel.samples.has_drive_noise and channel.samples.charges is None:
            inputs = likelihood.make_inputs(circuit.circuit, theta, channel)
            channel = free_timing(channel, inputs, circuit, "delay")
            channel = _update_drive(channel, inputs, np.asarray(source.noise), circuit, source.in_time)
            likelihood = likelihood.replace_channel(i, channel)
    return likelihood


def update_rows(likelihood: Likelihood, solution: LeastSquaresResult, sources: Sequence[Source]) -> Likelihood:
    """Return the likelihood with rows of charge for the drive, noise and delay at a solution."""
    optimum = solution.likelihood.evaluate_circuit(solution.theta)
    for i, (channel, solved) in enumerate(zip(likelihood.channels, solution.likelihood.channels, strict=True)):
        # nuisances that were added stay: without them, the next fit leaves the optimum and returns by hundreds of steps
        channel = dataclasses.replace(channel, linear_sd=solved.linear_sd)
        if channel.samples.has_drive_noise:
            inputs = solution.likelihood.make_inputs(optimum.circuit, solution.theta, solved)
            sigma, record = np.asarray(solution.sigma[i]), sources[i].in_time
            if channel.samples.charges is None:
                delay = inputs.delay + (solved.timing.shift - channel.timing.shift)
                inputs = _correct_delay(channel, dataclasses.replace(inputs, delay=delay), optimum, record)
                channel = _update_drive(channel, inputs, sigma, optimum, record)
            else:
                beta = np.asarray(compiled_fit_nuisances(solved, inputs, sigma)[1])
                sizes = beta * np.asarray(solved.linear_sd)[list(solved.columns)]
                channel = dataclasses.replace(channel, linear_sd=_expect_harmonics(solved, sizes))
                channel = set_rows(channel, *_rows_at(solved, inputs, sizes, record))
        likelihood = likelihood.replace_channel(i, channel)
    return likelihood


def _update_drive(
    channel: ChannelLikelihood, inputs: ChannelInputs, sigma: np.ndarray, circuit: CircuitValues, record: Record
) -> ChannelLikelihood:
    """Return the channel of a limited current with the drive and the noise that its residuals tell."""
    full, current, size = channel.without_compression(), RecordedCurrent.from_record(record), len(record)
    late, stray = dataclasses.replace(inputs, gain=np.ones(())), float(inputs.stray or 0.0)
    shift, step = float(channel.timing.shift), record.time_step
    steps = round(shift / step)
    whole = dataclasses.replace(late, delay=np.asarray(steps * step - shift), stray=None)

    def respond(V: Rows, inputs: ChannelInputs) -> Rows:
        return np.asarray(compiled_signal(replace_drive(full, record, V, np.zeros(size)), inputs))[:size]

    # a delay by whole steps does not smooth the noise of V
    rise = np.diff(current.V - current.smooth, prepend=0.0) / step
    noise = respond(current.V, whole) - respond(current.smooth, whole)
    noise += stray * np.roll(rise, steps)
    path = NoisePath.from_terms(circuit.terms[channel.channel], stray, step)
    known = respond(current.smooth, late)
    if current.tones is not None:
        response, _ = _respond_to_tones(current.tones, channel, inputs, circuit, record)
        noise += _leave_out_decays(response - known, full, current.tones, circuit, record)
    full = set_drive(full, path, record, current.smooth, noise)
    if current.tones is not None:  # whose residuals tell nothing of the drive, and would draw a delay along
        return full
    V = estimate_drive(full, path, sample_residuals(full, inputs, sigma)[1], record)
    return replace_drive(full, record, V, noise + known - respond(V, late))


def _respond_to_tones(
    tones: Tones, channel: ChannelLikelihood, inputs: ChannelInputs, circuit: CircuitValues, record: Record
) -> tuple[Rows, Rows]:
    """Return the steady response of a current to the tones of a drive (A), and its derivative by the delay (A/s)."""
    terms = circuit.terms[channel.channel]
    terms = terms._replace(rate=(terms.rate or 0.0) + float(inputs.stray or 0.0))
    omega, delay = tones.frequencies / record.time_step, float(channel.timing.shift + inputs.delay)
    gain = jit(gain_at)(terms, omega) * np.exp(-1j * omega * delay)
    return tones.scale(gain), tones.scale(-1j * omega * gain)


def _correct_delay(
    channel: ChannelLikelihood, inputs: ChannelInputs, circuit: CircuitValues, record: Record
) -> ChannelInputs:
    """Return inputs with the delay at which a current of tones responds as the channel does with these.

    What lines between the samples lack was added for another delay, and does not follow it, which may be half of all.
    """
    tones, full = RecordedCurrent.from_record(record).tones, channel.without_compression()
    if tones is None:
        return inputs
    modelled = np.asarray(compiled_signal(full, dataclasses.replace(inputs, gain=np.ones(()))))[: len(record)]
    response, slope = _respond_to_tones(tones, channel, inputs, circuit, record)
    slope = slope * (full.samples.weights[: len(record)] > 0.0)
    return dataclasses.replace(inputs, delay=inputs.delay + slope @ (modelled - response) / (slope @ slope))


def _leave_out_decays(
    missing: Rows, channel: ChannelLikelihood, tones: Tones, circuit: CircuitValues, record: Record
) -> Rows:
    """Return what the response to lines between the samples of tones lacks, without the decays of a start from rest.

    They are those of the samples that are used, because the first ones have the jump from rest at any time of their
    step, of 1e5 times the noise.
    """
    since, used = record.time - record.time[0], channel.samples.weights[: len(record)] > 0.0
    taus = np.asarray(circuit.terms[channel.channel].tau, dtype=float)
    decays = np.vstack([np.ones_like(since), np.exp(-since / taus[:, None])])
    functions = np.vstack([decays, tones.basis()[1:]])  # with the tones, which begin like decays
    sizes = np.linalg.lstsq(functions[:, used].T, missing[used])[0]
    return missing - sizes[: len(decays)] @ decays


def _expect_harmonics(channel: ChannelLikelihood, fitted: Float[np.ndarray, " columns"]) -> np.ndarray:
    """Return the prior sds of the linear nuisances, with a third harmonic of the size of each hum that was `fitted`.

    A harmonic beside one of the drive cannot be told from it, but its amplitude is about known.
    """
    linear_sd = np.array(channel.linear_sd, dtype=float)
    sizes = np.zeros(linear_sd.size)
    sizes[list(channel.columns)] = fitted
    names = list(channel.observable.linear_names)
    for mains in HUM_FREQUENCIES[:2]:
        first, third = (
            [names.index(f"hum_{order * mains:.0f}Hz_{part}") for part in ("cos", "sin")] for order in (1, 3)
        )
        expected = math.hypot(*np.minimum(np.abs(sizes[first]), linear_sd[first]))
        linear_sd[third] = np.maximum(linear_sd[third], expected)
    return linear_sd


def _rows_at(
    channel: ChannelLikelihood, inputs: ChannelInputs, sizes: Float[np.ndarray, " columns"], record: Record
) -> tuple[ChargeRows, Rows, float]:
    """Return rows and drive of a channel at its optimum, with nuisances of these `sizes`, and the delay (s)."""
    current, size = RecordedCurrent.from_record(record), len(record)
    full = channel.without_compression()
    skew, inputs = float(inputs.delay) / current.step, dataclasses.replace(inputs, delay=np.zeros(()))
    delay = float(full.timing.shift) / current.step + float(np.clip(skew, -0.5, 0.5))
    delay = float(np.clip(delay, 0.5 - MAX_STEPS, MAX_STEPS - 0.5))

    modelled = Current.from_channel(channel, inputs, delay)

    def respond_with_nuisances(V: Rows) -> tuple[Rows, Rows]:
        rows, nuisances = _modelled_rows(_with_drive(full, current, V, modelled.lag), inputs, sizes)
        return np.asarray(rows)[:size], np.asarray(nuisances)[:size]

    from_V, nuisances = respond_with_nuisances(current.V)

    def respond(V: Rows) -> Rows:
        return from_V if V is current.V else respond_with_nuisances(V)[0]

    return *current.make_rows(modelled, respond, nuisances), delay * current.step


def _with_drive(channel: ChannelLikelihood, current: RecordedCurrent, V: Rows, lag: float) -> ChannelLikelihood:
    """Return the channel of a current that is 0, with another drive and a `lag` (time steps)."""
    charges, drive = channel.samples.charges, channel.electrical.drive
    assert charges is not None
    assert isinstance(drive, Sampled)
    length = np.shape(channel.samples.time)[0]
    rise = np.pad(current.rise(V, lag), (0, length - V.size))
    charges = dataclasses.replace(charges, observed=np.zeros(length), rate=rise)
    return channel.replace_observable(drive=Sampled(drive.time, pad_samples(V))).replace_samples(charges=charges)


@jit
def _modelled_rows(channel: ChannelLikelihood, inputs: ChannelInputs, sizes: Array) -> tuple[Array, Array]:
    """Return the rows of the signal of a channel that observed 0, and those of nuisances of these sizes."""
    rows, shapes = channel.rows_and_shapes(inputs)
    return -rows, sizes @ shapes
