"""Compression of channels: built before the fit, and verified against all samples after it."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from fitact.compiled import BatchEvaluator, jit, pad_samples
from fitact.likelihood.channel import ChannelLikelihood, compiled_fit_nuisances, compiled_signal
from fitact.likelihood.compression import BASELINE_NAMES, Compression, GridCompression
from fitact.likelihood.friction_observable import FrictionObservable
from fitact.likelihood.interpolation import interpolate
from fitact.likelihood.likelihood import CircuitValues, Likelihood
from fitact.likelihood.noise import StudentExpansion, fit_student_scale, student_curvature, student_weight
from fitact.likelihood.observable import ChannelInputs
from fitact.likelihood.projection import (
    MANY_SAMPLES,
    compress,
    is_exactly_uniform,
    samples_per_period,
    table_multiple,
)
from fitact.likelihood.spectrum_observable import SpectrumObservable
from fitact.model.circuit import HighpassTerms
from fitact.model.divider_coordinates import differentiate, from_elements, to_elements
from fitact.model.drive import Sampled
from fitact.model.response_table import TABLE_HALF_WIDTH
from fitact.model.skin import WithSkin

TOLERANCE = 1e-3  # error of the log-likelihood
OUTSIDE = "its parameters, or their uncertainty, lie outside the range of the compression"
_TIMING_REASON = "a delay or a clock error is a free parameter"
FEW_ROWS = 200  # numbers per evaluation, below which the overhead of the call dominates


class CertifiedLikelihood(NamedTuple):
    """Likelihood for sampling, with the verified error of its compressions."""

    likelihood: Likelihood  # with those compressions that passed the check
    # maximum error of the compressed log-likelihood near the optimum; None: a channel is not compressed
    error: float | None
    reasons: tuple[str, ...]  # why each channel is not compressed, as a clause; "" if it is


def compress_channel(
    channel: ChannelLikelihood,
    start: CircuitValues,
    tolerance: float,
    student: np.ndarray | None = None,
    *,
    is_wide: bool = False,
) -> tuple[ChannelLikelihood, str]:
    """Return the channel with a compression and "", or the uncompressed channel and the reason.

    The compression holds around the circuit `start`, for the channel's present noise and timing. For Student-t noise,
    it needs an expansion (`expand_student`); `student` and `is_wide` are as in `compress`.
    """
    circuit, channel = start.circuit, channel.without_compression()
    reason = reason_against_table(channel, start, tolerance)
    if reason:
        return channel, reason
    samples, electrical = channel.samples, channel.electrical
    part = slice(samples.size)
    drive, time, observed = electrical.drive, np.asarray(samples.time)[part], np.asarray(samples.observed)[part]
    how: dict[str, Any] = {
        "student": student,
        "steady_state": electrical.steady_state,
        "weight": None if samples.equally_weighted else samples.weights[part],
        "whitening": samples.whitening and samples.whitening.restrict(part),
        "charges": samples.charges and samples.charges.restrict(part),
        "rate": None if samples.rate is None else np.asarray(samples.rate)[part],
        "effects": None if samples.effects is None else np.asarray(samples.effects)[:, part],
        "is_wide": is_wide,
    }
    terms = electrical.select_terms(start.terms[channel.channel])
    if isinstance(circuit, WithSkin):
        channel = fold(channel)
        inputs = ChannelInputs(circuit, np.asarray(1.0), np.asarray(0.0), np.asarray(0.0))
        signal = compiled_signal(channel, inputs)[part]
        slope = -np.gradient(signal, time)
        compression = compress(drive, time, observed, expected_terms=terms, slope=slope, **how)
        fields = {field.name: getattr(compression, field.name) for field in dataclasses.fields(compression)}
        compression = GridCompression(**fields)
        return dataclasses.replace(channel, compression=compression), ""
    smooth = None if electrical.smooth is None else np.asarray(electrical.smooth)[part]
    if smooth is not None:
        how["slope"] = np.gradient(smooth, time)
    if isinstance(drive, Sampled) and channel.shifts_response:
        V = np.asarray(drive.samples)[part]
        smooth = V if smooth is None else smooth
        drive, how["noise"] = Sampled(time, smooth), V - smooth
    short = channel.count_short(start.tau)
    compression = compress(drive, time, observed, expected_terms=terms.without_fastest(short), **how)
    return dataclasses.replace(channel, compression=dataclasses.replace(compression, short=short)), ""


def fold(channel: ChannelLikelihood) -> ChannelLikelihood:
    """Return the channel with its `phases` if drive and samples repeat, where a response is costly."""
    samples, electrical = channel.samples, channel.electrical
    time = np.asarray(samples.time)[: samples.size]
    period = samples_per_period(electrical.drive, time) if electrical.steady_state and samples.rate is None else None
    if period is None:
        return channel
    return channel.replace_samples(phases=pad_samples(time[:period]), period=np.asarray(period))


def recompress(channel: ChannelLikelihood, circuit: CircuitValues) -> ChannelLikelihood:
    """Return a channel whose noise or timing has changed with a new compression, if it had one and a table serves."""
    if channel.compression is None:
        return channel
    return compress_channel(channel, circuit, TOLERANCE, is_wide=_is_wide(channel))[0]


def _is_wide(channel: ChannelLikelihood) -> bool:
    """Return whether the table of a channel is as wide as possible, or it has none."""
    table = channel.compression
    if not isinstance(table, Compression) or isinstance(table, GridCompression):
        return True
    return float(np.max(table.half_width)) > 4.5 * TABLE_HALF_WIDTH  # wider than those of several time constants


def reason_against_compression(channel: ChannelLikelihood, tolerance: float, min_samples: int = 512) -> str:
    """Return why a channel may not be compressed at all, or ""."""
    if isinstance(channel.observable, SpectrumObservable):
        return "a spectrum has few points"
    if isinstance(channel.observable, FrictionObservable):
        return "the sensor of the friction has a memory"
    if tolerance == 0.0:
        return "the full sum was requested"
    if channel.samples.size < min_samples:  # compression would save nothing
        return f"the record is shorter than {min_samples} samples"
    return ""


def reason_against_table(
    channel: ChannelLikelihood, start: CircuitValues, tolerance: float, max_multiple: int = 4
) -> str:
    """Return why there is no table of responses for a channel, or ""."""
    if reason := reason_against_compression(channel, tolerance):
        return reason
    if isinstance(start.circuit, WithSkin):
        if channel.shifts_response:
            return _TIMING_REASON
        # inner products would lose digits of large weights
        if channel.channel == "I" and not channel.observable.follows_samples:
            return "the current of a fractional skin is not tabulated"
        return "a dispersive skin has no time constants" if start.circuit.grid is None else ""
    if channel.shifts_response and not _can_delay(channel):
        return _TIMING_REASON
    tau = start.tau[: start.tau.size - channel.count_untabulated(start.tau)]
    if not tau.size:
        return "the time constants of the circuit are far below the time step"
    if table_multiple(tau) > max_multiple:
        return "the time constants of the circuit are too far apart"
    return ""


def expand_student(
    likelihood: Likelihood, index: int, theta: np.ndarray, sigma: float, *, exact: bool
) -> ChannelLikelihood:
    """Return a channel of Student-t noise that has a table of responses, expanded around theta.

    Unless `exact`, the weights of the squares are positive, with which each step of the fit is a descent.
    """
    channel, inputs, circuit = (
        likelihood.channels[index],
        likelihood.channel_inputs(theta, index),
        likelihood.evaluate_circuit(theta),
    )
    _, beta, _ = compiled_fit_nuisances(channel, inputs, np.asarray(sigma))
    size, full = channel.samples.size, channel.without_compression()
    residuals = (np.asarray(channel.samples.observed) - _model(full, inputs, beta))[:size]
    counted = channel.samples.weights[:size] > 0.0
    free = theta.size / likelihood.count
    sigma = max(fit_student_scale(residuals[counted], counted.sum() * (1.0 - free)), float(channel.noise_floor))
    z = residuals / sigma
    weight, curvature = student_weight(z), student_curvature(z)
    slopes = sigma * weight * z, -sigma * (weight + curvature) * z
    student = np.stack([curvature if exact else weight, *slopes])
    changed, _ = compress_channel(full, circuit, TOLERANCE, student)
    table = changed.compression
    assert isinstance(table, Compression)
    expansion = StudentExpansion.from_residuals(z[counted], sigma)
    _, derivative = np.polynomial.chebyshev.chebval(
        0.0,
        np.stack([expansion.curvature, np.append(np.polynomial.chebyshev.chebder(expansion.curvature), 0.0)], axis=1),
    )
    first = np.array(table.observed)
    # the rest of the record, so that the sum of squares is that of the reweighted residuals
    first[-1] = math.sqrt(max(sigma**2 * np.sum(weight[counted] * np.square(z[counted])) - first @ first, 0.0))
    slope = np.asarray(table.observed_slope) - first * derivative / float(expansion.half_width)
    squares = np.array([first @ first, 2.0 * first @ slope, slope @ slope])
    expansion = dataclasses.replace(expansion, squares=squares)
    changed = dataclasses.replace(changed, compression=dataclasses.replace(table, observed=np.zeros_like(first)))
    observed = first - _model(changed, inputs, beta, coordinates=True)
    table = dataclasses.replace(table, observed=observed, observed_slope=slope)
    return dataclasses.replace(changed, compression=table, expansion=expansion, noise="student")


@jit
def _model(channel: ChannelLikelihood, inputs: ChannelInputs, beta: Array, coordinates: bool = False) -> Array:
    """Return signal and linear nuisances, over samples or (negative) in coordinates of a record that is 0."""
    sizes = beta * channel.column_sd
    if not coordinates:
        return channel.signal(inputs) + sizes @ channel.shapes(inputs)[np.array(channel.columns, dtype=int)]
    remainder, shapes = channel.residuals_and_shapes(inputs)
    return remainder - sizes @ shapes


def interpolate_channel(
    likelihood: Likelihood,
    index: int,
    theta: np.ndarray,
    covariance_factor: np.ndarray,
    sigma: float,
    reach: float,
    training: int = 63,
) -> ChannelLikelihood:
    """Return a channel with an interpolation around theta, or without a compression if that is not possible.

    It extends `reach` standard deviations in all directions that the record determines, less in others, and represents
    the signals of `training` points there.
    """
    channel = likelihood.channels[index]
    directions, sd, _ = np.linalg.svd(covariance_factor)
    widths = np.minimum(reach * sd, 6.0 * sd + 1.0)
    deviates = np.random.default_rng(0).standard_normal((training, theta.size))  # any reproducible points serve
    deviates *= np.random.default_rng(1).uniform(0.2, 1.0, (training, 1)) / np.linalg.norm(deviates, axis=1)[:, None]
    points = theta + np.vstack([np.zeros(theta.size), deviates * widths @ directions.T])
    light = dataclasses.replace(likelihood, channels=tuple(each.keep_ends() for each in likelihood.channels))
    inputs = _inputs(light, points)[index]
    compression = interpolate(channel, inputs, 0.3 * TOLERANCE * sigma)
    return dataclasses.replace(channel, compression=compression)


@jit
def _inputs(likelihood: Likelihood, points: Array) -> tuple[ChannelInputs, ...]:
    return jax.vmap(lambda theta: tuple(inputs for _, inputs in likelihood.channels_and_inputs(theta)))(points)


def can_interpolate(channel: ChannelLikelihood) -> bool:
    """Return whether a channel without a table may be interpolated, i.e. few samples of a signal cost less than all."""
    if isinstance(channel.observable, FrictionObservable):  # a sample depends on those before it
        return False
    return channel.compression is None and channel.noise != "student" and not channel.observable.follows_samples


def _can_delay(channel: ChannelLikelihood) -> bool:
    """Return whether a compression represents a delay: of a measured drive on a uniform grid."""
    if not channel.observable.follows_samples or channel.timing.free != ("delay",):
        return False
    return is_exactly_uniform(np.asarray(channel.samples.time)[: channel.samples.size])


def certify(
    likelihood: Likelihood,
    reasons: tuple[str, ...],
    theta: np.ndarray,
    covariance_factor: np.ndarray,
    sigma: Float[np.ndarray, " channels"],
    tolerance: float,
    check_points: int = 8,
    expanded_factor: float = 10.0,
) -> CertifiedLikelihood:
    """Return the likelihood for sampling around the optimum `theta`, checked against the full sum.

    `covariance_factor` is a factor of the covariance of theta. The compressed log-likelihood of each channel must be
    exact to `tolerance` / (number of channels) and 1e-6 of the difference to the optimum, at the optimum, at
    `check_points` points around it in `divider_coordinates`, and at almost as many points of the prior. An expansion of
    Student-t noise may have an error `expanded_factor` times as large: an error of 0.01 moves quantiles by less than
    0.01 sd. Rows of charge, whose signal is up to a million times the noise of V, may have one a hundred times as
    large, and a hundredth of the difference.
    """
    channels = tuple(channel.drop_unused_columns() for channel in likelihood.channels)
    likelihood = dataclasses.replace(likelihood, channels=channels)
    if all(channel.compression is None for channel in likelihood.channels):
        return CertifiedLikelihood(likelihood, None, tuple(r or _TIMING_REASON for r in reasons))
    light, optimum = likelihood.without_samples(), likelihood.evaluate_circuit(theta)
    log_tau_sd = np.linalg.norm(_log_tau_slopes(light, theta) @ covariance_factor, axis=1)
    reach, least_reach = table_half_width(log_tau_sd), table_half_width(log_tau_sd, 6.0, 0.015)
    precisions = table_precision(sigma, tolerance).tolist()
    inputs = [likelihood.make_inputs(optimum.circuit, theta, channel) for channel in likelihood.channels]
    delay_sd = dict(zip(likelihood.names, np.linalg.norm(covariance_factor, axis=1), strict=True))
    restricted = tuple(
        _restrict_table(
            channel,
            each,
            optimum.terms.get(channel.channel),
            reach,
            delay_sd.get(channel.qualified_name("delay"), 0.0),
            precision,
        )
        for channel, each, precision in zip(likelihood.channels, inputs, precisions, strict=True)
    )
    deviates = np.random.default_rng(0).standard_normal((check_points, theta.size))  # any reproducible points serve
    if likelihood.count > MANY_SAMPLES:
        check_points = math.ceil(check_points / 3)
    places = likelihood.elements
    middle, factor = from_elements(theta, places), differentiate(theta, places) @ covariance_factor
    around = np.vstack([theta, to_elements(middle + 1.5 * deviates[:check_points] @ factor.T, places)])
    is_local = any(channel.expansion is not None for channel in likelihood.channels)
    points = around
    if not is_local:  # fills a batch
        points = np.vstack([around, draw_within_tables(light, theta, check_points - 1)])
    narrow = dataclasses.replace(likelihood, channels=restricted).without_samples()
    exact, compressed, tabulated = _evaluate_log_likelihoods(
        (likelihood.without_compression(), narrow, light), points, sigma
    )
    # a constant error of an expansion, in the integral over nuisances, does not change the posterior
    is_expanded = np.array([channel.expansion is not None for channel in likelihood.channels])
    differences = compressed - exact
    differences -= np.where(is_expanded, differences[0], 0.0)
    # where the density is far from normal, some of the points around the optimum are far from it in log-likelihood
    has_rows = np.array([channel.samples.has_drive_noise for channel in likelihood.channels])
    relative = np.where(has_rows, 1e-2, 1e-6)
    errors = np.max((np.abs(differences) - relative * np.abs(exact - exact[0]))[: len(around)], axis=0)
    ends = [optimum.tau * np.exp(side * least_reach) for side in (-1.0, 1.0)]
    for i, channel in enumerate(likelihood.channels):
        if not (is_expanded[i] or _is_wide(channel) or all(covers(channel, tau) for tau in ends)):
            errors[i] = np.nan  # a wider table serves more draws
    # far from the optimum, the error may grow with the difference in log-likelihood to the optimum
    excesses = np.nanmax(np.abs(tabulated - exact) - relative * np.abs(exact[0] - exact), axis=0, initial=-np.inf)
    excesses = np.where(is_expanded, errors, excesses)
    failures = []
    for i, channel in enumerate(restricted):
        if isinstance(channel.observable, SpectrumObservable):  # exact
            failures.append("")
            continue
        allowed = tolerance / len(restricted) * (expanded_factor if is_expanded[i] else 1.0)
        allowed *= 100.0 if has_rows[i] else 1.0
        failure = _compression_failure(errors[i], excesses[i], allowed)
        failures.append((reasons[i] or _TIMING_REASON) if channel.compression is None else failure)
        likelihood = likelihood.replace_channel(i, channel.without_compression() if failures[i] else channel)
    return CertifiedLikelihood(likelihood, None if any(failures) else float(np.sum(errors)), tuple(failures))


def table_half_width(
    log_b_sd: ArrayLike, standard_deviations: float = 20.0, least: float = 0.05
) -> Float[np.ndarray, "*shape"]:
    """Return the half-width in log b of a table for sampling."""
    return np.maximum(standard_deviations * np.asarray(log_b_sd), least)


def table_precision(noise: ArrayLike, tolerance: float = TOLERANCE) -> Float[np.ndarray, "*shape"]:
    """Return the error that a table for sampling may have (root of the sum of squares), in the unit of `noise`."""
    return 0.1 * tolerance * np.asarray(noise)


def _compression_failure(error: float, excess: float, tolerance: float) -> str:
    """Return why a compression fails, from its errors near the optimum and within the prior; "" if it passes."""
    if np.isnan(error):
        return OUTSIDE
    if not error <= tolerance:
        return f"the error of the compressed log-likelihood is {error:.2g} near the optimum"
    return f"the error of the compressed log-likelihood is {excess:.2g} within the prior" if excess > tolerance else ""


def draw_within_tables(
    likelihood: Likelihood, theta: np.ndarray, count: int, draws: int = 256
) -> Float[np.ndarray, "n parameters"]:
    """Return draws from the prior that the tables cover, `count` if so many of the `draws` are."""
    tabulated, found = [each for each in likelihood.channels if each.compression is not None], list[np.ndarray]()
    for draw in likelihood.sample_prior(theta, draws):
        tau = np.asarray(likelihood.evaluate_circuit(draw).tau)
        if all(covers(each, tau) for each in tabulated):
            found.append(draw)
        if len(found) == count:
            break
    return np.reshape(found, (-1, theta.size))


def covers(channel: ChannelLikelihood, tau: Float[np.ndarray, " taus"]) -> bool:
    """Return whether the table of a channel covers the time constants (s) of a circuit."""
    assert channel.compression is not None
    return bool(np.all(channel.compression.covers(tau[: tau.size - channel.electrical.lags])))


def _evaluate_log_likelihoods(
    models: tuple[Likelihood, ...], theta: Float[np.ndarray, "n parameters"], sigma: np.ndarray
) -> Float[np.ndarray, "models n channels"]:
    """Return the log-likelihood of each channel in several models at points with common sigma, by one program."""
    points = np.column_stack([theta, np.tile(np.log(sigma), (len(theta), 1))])
    rows = max(model.rows for model in models)
    evaluate = BatchEvaluator(_log_likelihoods, models, rows, 16, max_numbers=65_536, fast=rows > MANY_SAMPLES)
    return evaluate(points, description="checking the compression").swapaxes(0, 1)


def _log_likelihoods(models: tuple[Likelihood, ...], point: Array) -> Float[Array, "models channels"]:
    return jnp.stack([model.log_likelihoods(point) for model in models])


def batched_log_prob(likelihood: Likelihood, walkers: int) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function for the log-posteriors of points (theta, log sigma); outside the tables it sums all samples.

    It is fastest for all `walkers` of an ensemble at once, or half of them.
    """
    # pad halves where this costs nothing, so that only one size is compiled
    batch = walkers if likelihood.rows <= FEW_ROWS else walkers // 2
    light, full = likelihood.without_samples(), likelihood.without_compression()
    tabulated, summed = (
        # of a sum over samples so few at once that intermediate arrays stay in the processor's cache
        BatchEvaluator(Likelihood.log_prob_parts, model, model.rows, size, max_numbers=65_536)
        for model, size in ((light, batch), (full, 1))
    )
    # bound once, because Equinox takes longer to bind a method than the evaluation takes
    combine_tabulated, combine_summed = light.combine_log_prob, full.combine_log_prob

    def values(points: Float[np.ndarray, "n coordinates"]) -> np.ndarray:
        log_prob = combine_tabulated(points, tabulated(points))
        beyond = np.isnan(log_prob)
        if beyond.any():
            log_prob[beyond] = combine_summed(points[beyond], summed(points[beyond]))
        return log_prob

    return values


def _restrict_table(
    channel: ChannelLikelihood,
    inputs: ChannelInputs,
    terms: HighpassTerms | None,
    reach: Float[np.ndarray, " taus"],
    delay_sd: float,
    error: float,
) -> ChannelLikelihood:
    """Return the channel with its table restricted to the posterior, if the table covers the optimum.

    `inputs` and `terms` are those at the optimum. The restricted table covers each log tau within its `reach`, as far
    as the table does, with an `error` of the signal (V or A). `delay_sd` is in time steps.
    """
    table = channel.compression
    delay = float(channel.timing.shift) + float(inputs.delay)
    if terms is None or not isinstance(table, Compression) or isinstance(table, GridCompression):
        return channel
    terms = channel.electrical.select_terms(terms)
    if not np.all(table.covers(np.asarray(terms.tau, dtype=float), delay)):
        return channel
    tabulated = slice(len(terms.tau) - table.short)
    largest = float(np.sum(np.abs(terms.weight)) * inputs.gain)
    has_charge = max(channel.columns, default=0) >= len(BASELINE_NAMES)
    charge = float(np.ptp(channel.samples.observed)) / largest if has_charge else 0.0
    ends = (np.log(terms.tau[tabulated]) + side * reach[tabulated] for side in (-1.0, 1.0))
    low, high = (np.clip(end, table.center - table.half_width, table.center + table.half_width) for end in ends)
    # time constants that may become equal exchange their places, and need one range
    group = np.cumsum(np.append(0, high[1:] < low[:-1]))
    low = np.array([low[group == g].min() for g in group])
    high = np.array([high[group == g].max() for g in group])
    # dV/dt is a mean over half a time step on both sides
    since = (float(table_half_width(delay_sd)) + 0.5 * (inputs.stray is not None)) * float(channel.timing.step)
    narrow = table.restrict(
        0.5 * (low + high), 0.5 * (high - low), error / largest, charge=charge, delay=(delay - since, delay + since)
    )
    return dataclasses.replace(channel, compression=narrow)


def _log_tau_slopes(
    likelihood: Likelihood, theta: np.ndarray, step: float = 1e-4
) -> Float[np.ndarray, "taus parameters"]:
    """Return the gradients of the logarithms of the time constants, from differences."""
    steps = step * np.eye(theta.size)
    later, earlier = (
        np.log([likelihood.evaluate_circuit(theta + sign * change).tau for change in steps]) for sign in (1.0, -1.0)
    )
    return (later - earlier).T / (2.0 * step)
