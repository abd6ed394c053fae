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
    """One channel of one record, fitted.

    Attributes:
        label: "" or what tells it from the other traces, as "I_2".
        channel: "Vsc" or "I".
        record, choice: where it comes from, and its drive.
        sigma: standard deviation of its noise, V or A, from the residuals.
        linear: the offset, drift, hum and charge that were freed, V or A, at the optimum.
        residuals: record minus fit, V or A.
        weight: of the samples; 0 where one was left out. None: all are 1.
        log_likelihood: of its samples, all constants included.
        figures: chi2_reduced, rms_residual, noise_expected, runs_z and the like.
        full_because: why its samples are summed, as a clause; "" where they are not.
    """

    label: str
    channel: str
    record: Record
    choice: DriveModel
    sigma: float
    linear: dict[str, float]
    residuals: Float[np.ndarray, " samples"]
    weight: Float[np.ndarray, " samples"] | None
    log_likelihood: float
    figures: dict[str, float]
    full_because: str

    @classmethod
    def from_optimum(
        cls, likelihood: Likelihood, index: int, theta: np.ndarray, sigma: float, source: Source, reason: str
    ) -> "ChannelFit":
        """The trace of that index at the optimum `theta` with the noise `sigma`."""
        trace, seen = (
            likelihood.channels[index].without_compression(),
            likelihood.channel_inputs(jnp.asarray(theta), index),
        )
        # the noise as an array: a float would be compiled in, anew for every record
        left, even, beta = (np.asarray(x) for x in _sample_residuals(trace, seen, jnp.asarray(sigma)))
        own = slice(trace.n_samples)
        left, weight = left[own], None if trace.equally_weighted else trace.weights[own]
        linear = {
            trace.qualified_name(LINEAR_NUISANCES[column]): float(value * trace.linear_sd[column])
            for column, value in zip(trace.columns, beta, strict=True)
        }
        counted = (trace.weights if trace.whitening is None else np.asarray(trace.whitening.mask))[own] > 0.0
        kept = even[own][counted]
        used = theta.size * kept.size / float(likelihood.count) + len(linear)
        gain = _gain(seen.circuit, trace)
        noise = sigma if trace.noise == "ar1" else source.noise  # coloured, only the residuals show it
        time = source.record.time[counted]
        figures = channel_statistics(kept, time, noise, used, gain, source.record, trace.channel, source.choice)
        # below a weight of 0.7 a sample's noise is mostly that of the drive's slope, which is not white
        if weight is not None and np.mean((weight > 0.0) & (weight < 0.7)) > 0.01:
            figures |= {"spectrum_p": 1.0, "line_p": 1.0}
        weighted = left if weight is None else left * weight
        if trace.whitening is not None:  # as a user sees them, before the filter
            figures["rms_residual"] = float(np.sqrt(np.mean(weighted[counted] ** 2)))
        if trace.noise == "spectrum":
            figures["quiet_noise"] = source.noise
        figures |= outliers(weighted, source.record.time, source.noise)
        return cls(
            label=trace.label,
            channel=trace.channel,
            record=source.record,
            choice=source.choice,
            sigma=sigma,
            linear=linear,
            residuals=left,
            weight=weight,
            log_likelihood=_log_likelihood(trace, left, kept, sigma),
            figures=figures,
            full_because=reason,
        )


def _gain(circuit: Circuit, trace: ChannelLikelihood) -> float:
    """What makes the channel's noise of a measured drive's."""
    if isinstance(circuit, WithSkin):  # it falls with the frequency, and noise is mostly fast
        return float(jnp.abs(circuit.channel_gain(trace.channel, 1.0 / trace.time_step)))
    return abs(sum(float(w) for w in circuit.channel_terms(trace.channel).weight))


def _log_likelihood(
    trace: ChannelLikelihood, residuals: np.ndarray, white_residuals: np.ndarray, sigma: float
) -> float:
    """At the noise that makes it largest; under Student's t, at `sigma`."""
    if trace.whitening is None:
        weights = trace.weights[: residuals.size]
        if trace.noise == "student":
            return student_log_likelihood(residuals, weights, sigma)
        return gaussian_log_likelihood(residuals, weights)
    kept = np.asarray(trace.whitening.mask) > 0.0
    innovations = white_residuals / float(trace.whitening.taps[0])
    return gaussian_log_likelihood(innovations, None) + float(np.sum(np.log(trace.weights[kept])))


@eqx.filter_jit
def _sample_residuals(trace: ChannelLikelihood, inputs: ChannelInputs, sigma: Array) -> tuple[Array, Array, Array]:
    """What is left of the samples; that with noise independent and equal; and the linear nuisances in prior sds."""
    _, beta, _ = trace.fit_nuisances(inputs, sigma)
    remainder, shapes = dataclasses.replace(trace, weight=None, whitening=None).residuals_and_shapes(inputs)
    left = remainder - beta @ (trace.linear_sd[np.array(trace.columns, dtype=int), None] * shapes)
    even = trace.apply_whitening(left)
    if trace.noise == "student":
        even = even * jnp.sqrt(student_weight(even / sigma))
    return left, even, beta


def information_criteria(parameters: int, traces: Sequence[ChannelFit]) -> dict[str, float]:
    """Information criteria of a fit with so many `parameters` beside each trace's linear nuisances and noise."""
    counted = parameters + sum(1 + len(trace.linear) for trace in traces)
    samples = sum(int(trace.figures["samples"]) for trace in traces)
    return criteria(sum(trace.log_likelihood for trace in traces), counted, samples)
