"""Small errors of instruments that are not gains: their functions of time, from the signal at the starting point."""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.signal
from jaxtyping import Float

from fitact.compiled import pad_samples
from fitact.fitting.channel_fit import sample_residuals
from fitact.fitting.drive_choice import DriveModel
from fitact.fitting.problem import Source
from fitact.instrument.effects import PROBE_TIME_CONSTANT, nonlinearity_shapes
from fitact.likelihood.likelihood import Likelihood


class FilledEffects(NamedTuple):
    """Likelihood whose effects of instruments are in proportion to its signals, without compression."""

    likelihood: Likelihood
    change: float  # of the fitted signals by the new effects, root of the sum of squares in units of the noise


def fill_effects(
    likelihood: Likelihood, theta: np.ndarray, sigma: Sequence[float], sources: Sequence[Source]
) -> FilledEffects:
    """Compute the effects of instruments anew, for the signals at `theta` with the noise `sigma` (V or A)."""
    likelihood, change = likelihood.without_compression(), 0.0
    for i, (channel, source, noise) in enumerate(zip(likelihood.channels, sources, sigma, strict=True)):
        if channel.effects is not None:
            inputs = likelihood.make_inputs(likelihood.evaluate_circuit(theta).circuit, theta, channel)
            residuals, *_ = sample_residuals(channel, inputs, np.asarray(noise))
            signal = np.asarray(channel.observed) - residuals - np.asarray(inputs.effects) @ channel.effects
            signal, record = signal[: channel.n_samples], source.record
            effects = pad_samples(effect_functions(signal, record.time, source.choice, record.frequency()))
            moved = channel.weights * (np.asarray(inputs.effects) @ (effects - channel.effects))
            change = math.hypot(change, float(np.linalg.norm(moved[: channel.n_samples])) / noise)
            likelihood = likelihood.replace_channel(i, dataclasses.replace(channel, effects=effects))
    return FilledEffects(likelihood, change)


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
