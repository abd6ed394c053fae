"""Small errors of instruments that are not gains: their functions of time, from the signal at the starting point."""

import dataclasses
import math
from collections.abc import Sequence
from typing import cast

import numpy as np
from jaxtyping import Array, Float

from fitact.compiled import jit, pad_samples
from fitact.fitting.channel_fit import sample_residuals
from fitact.instrument.effects import PROBE_TIME_CONSTANT, nonlinearity_shapes, nonlinearity_slopes
from fitact.likelihood.channel import ChannelLikelihood
from fitact.likelihood.charge_rows import filter_highpass
from fitact.likelihood.likelihood import Likelihood
from fitact.likelihood.observable import ChannelInputs
from fitact.likelihood.spectrum_observable import SpectrumObservable
from fitact.model.drive import Sampled
from fitact.problem.instrument_errors import EFFECTS, V_NONLINEARITY
from fitact.problem.source import Source


def fill_effects(
    likelihood: Likelihood, theta: np.ndarray, noise: Sequence[float], sources: Sequence[Source]
) -> Likelihood:
    """Return the likelihood with effects of instruments for the signals at `theta`, and without their compression.

    `noise` is the noise sd of each channel, V or A.
    """
    for i, (channel, source, sigma) in enumerate(zip(likelihood.channels, sources, noise, strict=True)):
        if channel.samples.effects is not None:
            channel = channel.without_compression()
            inputs = likelihood.make_inputs(likelihood.evaluate_circuit(theta).circuit, theta, channel)
            if isinstance(channel.observable, SpectrumObservable):
                effects = channel.observable.compensation_effect(inputs)
            else:
                samples = channel.samples
                residuals, *_ = sample_residuals(channel, inputs, np.asarray(sigma))
                signal = np.asarray(samples.observed) - residuals - np.asarray(inputs.effects) @ samples.effects
                effects = _effect_functions(channel, inputs, signal[: samples.size], source)
            likelihood = likelihood.replace_channel(i, channel.replace_samples(effects=effects))
    return likelihood


def effects_would_change(
    likelihood: Likelihood, start: np.ndarray, theta: np.ndarray, sigma: Float[np.ndarray, " channels"]
) -> float:
    """Return by how much the effects for the signals at `theta` differ from those at `start`, at most.

    This is a root of the sum of squares in units of the noise: no parameter moves by more standard errors.
    """
    total, ends = 0.0, [likelihood.evaluate_circuit(point) for point in (start, theta)]
    for channel, noise in zip(likelihood.channels, sigma, strict=True):
        # no estimate without time constants
        if channel.samples.effects is not None and channel.channel in ends[0].terms:
            inputs = [likelihood.make_inputs(e.circuit, x, channel) for e, x in zip(ends, (start, theta), strict=True)]
            terms = [end.terms[channel.channel] for end in ends]
            # weights of both signs may cancel in a sum
            sizes = [float(np.sum(np.abs(t.weight))) + abs(float(t.direct or 0.0)) for t in terms]
            heights = [float(i.gain) * size for i, size in zip(inputs, sizes, strict=True)]
            moved = abs(math.log(heights[1] / heights[0])) + abs(math.log(terms[1].tau[0] / terms[0].tau[0]))
            added = channel.samples.weights * (np.asarray(inputs[1].effects) @ channel.samples.effects)
            total = math.hypot(total, moved * float(np.linalg.norm(added[: channel.samples.size])) / float(noise))
    return total


def _effect_functions(
    channel: ChannelLikelihood, inputs: ChannelInputs, signal: Float[np.ndarray, " samples"], source: Source
) -> Float[np.ndarray, "effects samples"]:
    """Return the error of the signal (V or A) for an error of 1 of each effect of the channel, padded."""
    names, choice, record = [name for name, _ in channel.effect_sizes], source.choice, source.in_time
    functions = dict(zip(EFFECTS[1:3], pad_samples(nonlinearity_shapes(signal)), strict=True))
    if "compensation" in names:
        settled = choice.steady_state or choice.unknown_charge
        frequency = record.frequency() if settled else None
        functions["compensation"] = pad_samples(_highpass(signal, record.time, frequency, settled=settled))
    if not set(V_NONLINEARITY).isdisjoint(names):
        shapes = nonlinearity_shapes(np.asarray(cast(Sampled, channel.electrical.drive).samples))
        rates = pad_samples(nonlinearity_slopes(record["V"])) if channel.samples.rate is not None else shapes
        functions |= zip(V_NONLINEARITY, _respond(channel, inputs, shapes, rates), strict=True)
    return np.stack([functions[name] for name in names])


@jit
def _respond(
    channel: ChannelLikelihood,
    inputs: ChannelInputs,
    voltages: Float[Array, "n times"],
    rates: Float[Array, "n samples"],
) -> list[Float[Array, " samples"]]:
    """Return the signal for each of these drives (V), whose dV/dt is `rates` times that of the channel's drive."""
    signals = []
    for voltage, rate in zip(voltages, rates, strict=True):
        drive = dataclasses.replace(channel.electrical.drive, samples=voltage)  # type: ignore[call-arg]
        follows = channel.samples.rate is not None
        changed = channel.replace_observable(drive=drive).replace_samples(
            rate=rate * channel.samples.rate if follows else None
        )
        signals.append(changed.signal(dataclasses.replace(inputs, effects=None)))
    return signals


def _highpass(
    signal: Float[np.ndarray, " samples"],
    time: Float[np.ndarray, " samples"],
    frequency: float | None,
    *,
    settled: bool,
) -> Float[np.ndarray, " samples"]:
    """Return a first-order high-pass of `PROBE_TIME_CONSTANT` of a signal that is linear between the samples.

    Before the first sample, the signal is periodic, or constant if `settled`, else 0.
    """
    step = (time[-1] - time[0]) / (time.size - 1)
    uniform = np.interp(time[0] + step * np.arange(time.size), time, signal)
    period = 0 if frequency is None else round(1.0 / (frequency * step))
    before = uniform[:period] if 0 < period <= time.size else np.full(1, uniform[0] if settled else 0.0)
    filtered, _ = filter_highpass(np.diff(np.append(before, uniform), prepend=before[0]), step / PROBE_TIME_CONSTANT)
    return np.interp(time, time[0] + step * np.arange(time.size), filtered[before.size :])
