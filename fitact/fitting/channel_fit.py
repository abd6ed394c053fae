"""One channel of one record, fitted: its residuals, nuisances and figures of merit."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitact.data.record import Record
from fitact.fitting.criteria import criteria, gaussian_log_likelihood, student_log_likelihood
from fitact.fitting.drive_choice import DriveModel
from fitact.fitting.problem import Source
from fitact.fitting.residual_statistics import channel_statistics, outliers
from fitact.likelihood.channel import LINEAR_NUISANCES, ChannelInputs, ChannelLikelihood
from fitact.likelihood.likelihood import Likelihood
from fitact.likelihood.noise import student_weight
from fitact.model.circuit import Circuit
from fitact.model.skin import WithSkin


@dataclasses.dataclass(frozen=True)
class ChannelFit:
    """One channel of one record, fitted."""

    label: str  # "" or what tells it from the other channels, as "I_2"
    channel: str  # "Vsc" or "I"
    record: Record
    choice: DriveModel
    sigma: float  # standard deviation of its noise, V or A, from the residuals
    linear: dict[str, float]  # the offset, drift, hum and charge that were freed, V or A, at the optimum
    residuals: Float[np.ndarray, " samples"]  # record minus fit, V or A
    weight: Float[np.ndarray, " samples"] | None  # of the samples; 0 where one was left out. None: all are 1
    log_likelihood: float  # of its samples, all constants included
    figures: dict[str, float]  # chi2_reduced, rms_residual, noise_expected, runs_z and the like
    full_because: str  # why its samples are summed, as a clause; "" where they are not

    @classmethod
    def from_optimum(
        cls, likelihood: Likelihood, index: int, theta: np.ndarray, sigma: float, source: Source, reason: str
    ) -> "ChannelFit":
        """The channel of that index at the optimum `theta` with the noise `sigma`."""
        channel = likelihood.channels[index].without_compression()
        inputs = likelihood.channel_inputs(jnp.asarray(theta), index)
        # the noise as an array: a float would be compiled in, anew for every record
        left, even, beta = (np.asarray(x) for x in _sample_residuals(channel, inputs, jnp.asarray(sigma)))
        own = slice(channel.n_samples)
        left, weight = left[own], None if channel.equally_weighted else channel.weights[own]
        names = [channel.qualified_name(LINEAR_NUISANCES[column]) for column in channel.columns]
        linear = dict(zip(names, (beta * np.asarray(channel.linear_sd)[list(channel.columns)]).tolist(), strict=True))
        counted = (channel.weights if channel.whitening is None else np.asarray(channel.whitening.mask))[own] > 0.0
        kept = even[own][counted]
        used = theta.size * kept.size / float(likelihood.count) + len(linear)
        gain = _gain(inputs.circuit, channel)
        noise = sigma if channel.noise == "ar1" else source.noise  # coloured, only the residuals show it
        time = source.record.time[counted]
        figures = channel_statistics(kept, time, noise, used, gain, source.record, channel.channel, source.choice)
        # below a weight of 0.7 a sample's noise is mostly that of the drive's slope, which is not white
        if weight is not None and np.mean((weight > 0.0) & (weight < 0.7)) > 0.01:
            figures |= {"spectrum_p": 1.0, "line_p": 1.0}
        weighted = left if weight is None else left * weight
        if channel.whitening is not None:  # as a user sees them, before the filter
            figures["rms_residual"] = float(np.sqrt(np.mean(weighted[counted] ** 2)))
        if channel.noise == "spectrum":
            figures["quiet_noise"] = source.noise
        figures |= outliers(weighted, source.record.time, source.noise)
        return cls(
            label=channel.label,
            channel=channel.channel,
            record=source.record,
            choice=source.choice,
            sigma=sigma,
            linear=linear,
            residuals=left,
            weight=weight,
            log_likelihood=_log_likelihood(channel, left, kept, sigma),
            figures=figures,
            full_because=reason,
        )


def _gain(circuit: Circuit, channel: ChannelLikelihood) -> float:
    """What makes the channel's noise of a measured drive's."""
    if isinstance(circuit, WithSkin):  # it falls with the frequency, and noise is mostly fast
        return float(jnp.abs(circuit.channel_gain(channel.channel, 1.0 / channel.time_step)))
    return abs(sum(float(w) for w in circuit.channel_terms(channel.channel).weight))


def _log_likelihood(
    channel: ChannelLikelihood, residuals: np.ndarray, white_residuals: np.ndarray, sigma: float
) -> float:
    """At the noise that makes it largest; under Student's t, at `sigma`."""
    if channel.whitening is None:
        weights = channel.weights[: residuals.size]
        if channel.noise == "student":
            return student_log_likelihood(residuals, weights, sigma)
        return gaussian_log_likelihood(residuals, weights)
    kept = np.asarray(channel.whitening.mask) > 0.0
    innovations = white_residuals / float(channel.whitening.taps[0])
    return gaussian_log_likelihood(innovations, None) + float(np.sum(np.log(channel.weights[kept])))


@eqx.filter_jit
def _sample_residuals(channel: ChannelLikelihood, inputs: ChannelInputs, sigma: Array) -> tuple[Array, Array, Array]:
    """What is left of the samples; that with noise independent and equal; and the linear nuisances in prior sds."""
    _, beta, _ = channel.fit_nuisances(inputs, sigma)
    remainder, shapes = dataclasses.replace(channel, weight=None, whitening=None).residuals_and_shapes(inputs)
    left = remainder - beta @ (channel.linear_sd[np.array(channel.columns, dtype=int), None] * shapes)
    even = channel.apply_whitening(left)
    if channel.noise == "student":
        even = even * jnp.sqrt(student_weight(even / sigma))
    return left, even, beta


def information_criteria(parameters: int, traces: Sequence[ChannelFit]) -> dict[str, float]:
    """Information criteria of a fit with so many `parameters` beside each channel's linear nuisances and noise."""
    counted = parameters + sum(1 + len(channel.linear) for channel in traces)
    samples = sum(int(channel.figures["samples"]) for channel in traces)
    return criteria(sum(channel.log_likelihood for channel in traces), counted, samples)
