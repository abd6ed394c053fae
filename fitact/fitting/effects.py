"""Small errors of instruments that are not gains: their functions of time, from the signal at the starting point."""

import dataclasses

import numpy as np
import scipy.signal
from jaxtyping import Float

from fitact.compiled import pad_samples
from fitact.fitting.channel_fit import sample_residuals
from fitact.fitting.drive_choice import DriveModel
from fitact.fitting.problem import Problem
from fitact.likelihood.likelihood import Likelihood

# of 9 Mohm and 12.2 pF of a 10x probe. Source: primidi.com, passive probes; Brüel & Kjær 2125A manual, p. 49
PROBE_TIME_CONSTANT = 110e-6  # s


def fill_effects(problem: Problem, theta: np.ndarray) -> Problem:
    """Return the problem with the effects of instruments in proportion to the signals at `theta`.

    The effects are small, so that errors of these signals do not matter.
    """
    likelihood = problem.likelihood
    for i, (channel, source) in enumerate(zip(likelihood.channels, problem.sources, strict=True)):
        if channel.effects is not None:
            signal = _fitted_signal(likelihood, i, theta, source.noise)
            effects = effect_functions(signal, source.record.time, source.choice, source.record.frequency())
            changed = dataclasses.replace(channel, effects=pad_samples(effects))
            likelihood = likelihood.replace_channel(i, changed)
    return problem._replace(likelihood=likelihood)


def _fitted_signal(
    likelihood: Likelihood, index: int, theta: np.ndarray, noise: float
) -> Float[np.ndarray, " samples"]:
    channel = likelihood.channels[index]
    inputs = likelihood.make_inputs(likelihood.evaluate_circuit(theta).circuit, theta, channel)
    residuals, *_ = sample_residuals(channel, inputs, np.asarray(noise))
    return (np.asarray(channel.observed) - residuals)[: channel.n_samples]


def effect_functions(
    signal: Float[np.ndarray, " samples"],
    time: Float[np.ndarray, " samples"],
    choice: DriveModel,
    frequency: float | None,
    fill: float = 0.8,
) -> Float[np.ndarray, "effects samples"]:
    """Return the functions of `EFFECTS`: the error of the signal (V or A) for an error of 1.

    The range, to which a non-linearity is relative, is taken to be `fill`ed by the signal.
    """
    settled = choice.steady_state or choice.unknown_charge
    compensation = _highpass(signal, time, frequency if settled else None, settled=settled)
    low, high = float(signal.min()), float(signal.max())
    size = (high - low) / fill
    x = (2.0 * signal - low - high) / size
    # Legendre polynomials, i.e. beside offset and gain
    even, odd = size * (0.5 * (3.0 * x**2 - 1.0)), size * (0.5 * (5.0 * x**3 - 3.0 * x))
    return np.stack([compensation, even, odd])  # in the order of `EFFECTS`


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
