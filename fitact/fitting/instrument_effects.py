"""Small errors of instruments that are not gains: their functions of time, from the signal at the starting point."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import scipy.signal
from jaxtyping import Float

from fitact.compiled import pad_samples
from fitact.fitting.channel_fit import sample_residuals
from fitact.fitting.drive_choice import DriveModel
from fitact.fitting.problem import Source
from fitact.instrument.effects import PROBE_TIME_CONSTANT, nonlinearity_shapes
from fitact.likelihood.likelihood import Likelihood


def fill_effects(
    likelihood: Likelihood, theta: np.ndarray, noise: Sequence[float], sources: Sequence[Source]
) -> Likelihood:
    """Return the likelihood without compression, and with effects of instruments for the signals at `theta`.

    `noise` is the noise sd of each channel, V or A.
    """
    likelihood = likelihood.without_compression()
    for i, (channel, source, sigma) in enumerate(zip(likelihood.channels, sources, noise, strict=True)):
        if channel.effects is not None:
            inputs = likelihood.make_inputs(likelihood.evaluate_circuit(theta).circuit, theta, channel)
            residuals, *_ = sample_residuals(channel.drop_unused_columns(), inputs, np.asarray(sigma))
            signal = np.asarray(channel.observed) - residuals - np.asarray(inputs.effects) @ channel.effects
            signal, record = signal[: channel.n_samples], source.record
            effects = pad_samples(effect_functions(signal, record.time, source.choice, record.frequency()))
            likelihood = likelihood.replace_channel(i, dataclasses.replace(channel, effects=effects))
    return likelihood


def effects_would_change(
    likelihood: Likelihood, start: np.ndarray, theta: np.ndarray, sigma: Float[np.ndarray, " channels"]
) -> float:
    """Return by how much the effects for the signals at `theta` differ from those at `start`, at most.

    This is a root of the sum of squares in units of the noise: no parameter moves by more standard errors.
    """
    total, ends = 0.0, [likelihood.evaluate_circuit(point) for point in (start, theta)]
    for channel, noise in zip(likelihood.channels, sigma, strict=True):
        if channel.effects is not None and ends[0].terms:  # no time constants, no estimate
            inputs = [likelihood.make_inputs(e.circuit, x, channel) for e, x in zip(ends, (start, theta), strict=True)]
            terms = [end.terms[channel.channel] for end in ends]
            heights = [float(i.gain) * float(np.sum(t.weight)) for i, t in zip(inputs, terms, strict=True)]
            moved = abs(math.log(heights[1] / heights[0])) + abs(math.log(terms[1].tau[0] / terms[0].tau[0]))
            added = channel.weights * (np.asarray(inputs[1].effects) @ channel.effects)
            total = math.hypot(total, moved * float(np.linalg.norm(added[: channel.n_samples])) / float(noise))
    return total


def effect_functions(
    signal: Float[np.ndarray, " samples"],
    time: Float[np.ndarray, " samples"],
    choice: DriveModel,
    frequency: float | None,
) -> Float[np.ndarray, "effects samples"]:
    """Return the error of the signal (V or A) for an error of 1 of each of the `EFFECTS`."""
    settled = choice.steady_state or choice.unknown_charge
    compensation = _highpass(signal, time, frequency if settled else None, settled=settled)
    return np.vstack([compensation, nonlinearity_shapes(signal)])


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
    x = step / PROBE_TIME_CONSTANT
    gain = -np.expm1(-x) / x
    filtered = scipy.signal.lfilter([gain, -gain], [1.0, -np.exp(-x)], np.append(before, uniform) - before[0])
    return np.interp(time, time[0] + step * np.arange(time.size), filtered[before.size :])
