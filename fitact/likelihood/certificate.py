"""Compression of channels: built before the fit, and verified against all samples after it."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from fitact.compiled import BatchEvaluator
from fitact.likelihood.channel import ChannelLikelihood
from fitact.likelihood.compression import BASELINE_NAMES, Compression, compress
from fitact.likelihood.compression_on_grid import GridCompression, compress_on_grid
from fitact.likelihood.likelihood import CircuitValues, Likelihood
from fitact.model.circuit import HighpassTerms
from fitact.model.drive import Sampled
from fitact.model.skin import WithSkin

TOLERANCE = 1e-3  # error of the log-likelihood
_TIMING_REASON = "a delay or a clock error is a free parameter"
_MANY_ROWS = 65_536  # samples, above which a faster program saves more than its compilation takes
FEW_ROWS = 200  # numbers per evaluation, below which the overhead of the call dominates


class CertifiedLikelihood(NamedTuple):
    """Likelihood for sampling, with the verified error of its compressions."""

    likelihood: Likelihood  # with those compressions that passed the check
    # maximum error of the compressed log-likelihood near the optimum; None: a channel is not compressed
    error: float | None
    reasons: tuple[str, ...]  # why each channel is not compressed, as a clause; "" if it is


def compress_channel(
    channel: ChannelLikelihood, start: CircuitValues, tau_identified: bool, tolerance: float
) -> tuple[ChannelLikelihood, str]:
    """Return the channel with a compression and "", or the unchanged channel and the reason.

    `start` is close to the optimum; `tau_identified` states whether the record determines its time constant.
    """
    circuit = start.circuit
    reason = _uncompressed_reason(channel, start, tau_identified, tolerance)
    if reason:
        return channel, reason
    samples = slice(channel.n_samples)
    arrays = channel.drive, np.asarray(channel.time)[samples], np.asarray(channel.observed)[samples]
    how: dict[str, Any] = {
        "steady_state": channel.steady_state,
        "weight": None if channel.equally_weighted else channel.weights[samples],
        "rate": None if channel.rate is None else np.asarray(channel.rate)[samples],
    }
    compression: Compression | GridCompression
    if isinstance(circuit, WithSkin):
        assert circuit.grid is not None  # otherwise there is a reason against compression
        compression = compress_on_grid(*arrays, grid=circuit.grid, **how)
    else:
        compression = compress(*arrays, expected_terms=start.terms[channel.channel], **how)
    return dataclasses.replace(channel, compression=compression), ""


def _uncompressed_reason(
    channel: ChannelLikelihood, start: CircuitValues, tau_identified: bool, tolerance: float, min_samples: int = 512
) -> str:
    if tolerance == 0.0:
        return "the full sum was requested"
    if channel.noise == "student":
        return "the likelihood of Student-t noise does not follow from inner products"
    if channel.whitening is not None:
        return "the noise is coloured"
    if channel.n_samples < min_samples:  # compression would save nothing
        return f"the record is shorter than {min_samples} samples"
    if channel.timing:
        return _TIMING_REASON
    if isinstance(start.circuit, WithSkin):
        return "a dispersive skin has no time constants" if start.circuit.grid is None else ""
    if isinstance(channel.drive, Sampled) and channel.steady_state:
        return "the steady state of a measured drive is not tabulated"
    if not tau_identified:
        return "the record does not determine its time constant"
    if len(start.terms[channel.channel].tau) > 1:
        return "the circuit has several time constants"
    return ""


def certify(
    likelihood: Likelihood,
    reasons: tuple[str, ...],
    theta: np.ndarray,
    covariance_factor: np.ndarray,
    sigma: Float[np.ndarray, " channels"],
    tolerance: float,
    check_points: int = 8,
) -> CertifiedLikelihood:
    """Return the likelihood for sampling around the optimum `theta`, checked against the full sum.

    `covariance_factor` is a factor of the covariance of theta. The compressed log-likelihood of each channel must be
    exact to `tolerance` / (number of channels) at the optimum and `check_points` points around it. At as many points
    of the prior, an additional 1e-6 of the difference to the optimum is allowed.
    """
    free = [tuple(np.flatnonzero(np.asarray(channel.linear_sd)).tolist()) for channel in likelihood.channels]
    pairs = zip(likelihood.channels, free, strict=True)
    likelihood = dataclasses.replace(
        likelihood, channels=tuple(dataclasses.replace(channel, columns=columns) for channel, columns in pairs)
    )
    if all(channel.compression is None for channel in likelihood.channels):
        return CertifiedLikelihood(likelihood, None, tuple(r or _TIMING_REASON for r in reasons))
    light, optimum = likelihood.without_samples(), likelihood.evaluate_circuit(theta)
    log_b = float(np.log(optimum.b))
    reach = float(table_half_width(np.linalg.norm(_log_b_slope(light, theta) @ covariance_factor)))
    precisions = table_precision(sigma, tolerance).tolist()
    inputs = [likelihood.make_inputs(optimum.circuit, theta, channel) for channel in likelihood.channels]
    restricted = tuple(
        _restrict_table(channel, optimum.terms.get(channel.channel), each.gain, log_b, reach, precision)
        for channel, each, precision in zip(likelihood.channels, inputs, precisions, strict=True)
    )
    deviates = np.random.default_rng(0).standard_normal((check_points, theta.size))  # any reproducible points serve
    around = np.vstack([theta, theta + 1.5 * deviates @ covariance_factor.T])
    points = np.vstack([around, _prior_points(light, theta, check_points)])
    narrow = dataclasses.replace(likelihood, channels=restricted).without_samples()
    exact, compressed, tabulated = (
        _evaluate_log_likelihoods(model, points, sigma) for model in (likelihood.without_compression(), narrow, light)
    )
    errors = np.max(np.abs(compressed - exact)[: len(around)], axis=0)
    # far from the optimum, the error may grow with the difference in log-likelihood to the optimum
    excesses = np.nanmax(np.abs(tabulated - exact) - 1e-6 * np.abs(exact[0] - exact), axis=0, initial=-np.inf)
    failures = []
    for i, channel in enumerate(restricted):
        failure = _compression_failure(errors[i], excesses[i], tolerance / len(restricted))
        failures.append(reasons[i] or (_TIMING_REASON if channel.compression is None else failure))
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
        return "the uncertainty of its time constant exceeds the range of the table"
    if not error <= tolerance:
        return f"the error of the compressed log-likelihood is {error:.2g} near the optimum"
    return f"the error of the compressed log-likelihood is {excess:.2g} within the prior" if excess > tolerance else ""


def _prior_points(likelihood: Likelihood, theta: np.ndarray, count: int) -> Float[np.ndarray, "n parameters"]:
    """Return draws from the prior that the tables cover, filled up with the optimum if there are too few."""
    draws = likelihood.sample_prior(theta, 1000)
    _, tau = likelihood.evaluate_g_and_b(draws)
    covered = [channel.compression.covers(tau) for channel in likelihood.channels if channel.compression is not None]
    return np.vstack([draws[np.all(covered, axis=0)], np.tile(theta, (count, 1))])[:count]


def _evaluate_log_likelihoods(
    likelihood: Likelihood, theta: Float[np.ndarray, "n parameters"], sigma: np.ndarray
) -> np.ndarray:
    """Return the log-likelihood of each channel at points with common sigma, (n, channels)."""
    points = np.column_stack([theta, np.tile(np.log(sigma), (len(theta), 1))])
    few, many = likelihood.rows <= FEW_ROWS, likelihood.rows > _MANY_ROWS
    evaluate = batch_log_prob_parts(likelihood, 128 if few else 1, fast=many)
    return evaluate(points, description="checking the compression")[:, :-1]


def batch_log_prob_parts(likelihood: Likelihood, batch: int = 128, *, fast: bool = False) -> BatchEvaluator:
    """Return the evaluation of `Likelihood.log_prob_parts` at many points; `fast` as in `compiled.jit`."""
    return BatchEvaluator(Likelihood.log_prob_parts, likelihood, likelihood.rows, batch, fast=fast)


def batched_log_prob(likelihood: Likelihood, walkers: int) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function for the log-posteriors of points (theta, log sigma); outside the tables it sums all samples.

    It is fastest for all `walkers` of an ensemble at once, or half of them.
    """
    # pad halves where this costs nothing, so that only one size is compiled
    batch = walkers if likelihood.rows <= FEW_ROWS else walkers // 2
    light, full = likelihood.without_samples(), likelihood.without_compression()
    tabulated, summed = batch_log_prob_parts(light, batch, fast=True), batch_log_prob_parts(full, 1, fast=True)
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
    terms: HighpassTerms | None,
    gain: ArrayLike,
    center: float,
    half_width: float,
    error: float,
) -> ChannelLikelihood:
    """Return the channel with its table restricted to the posterior, if the table covers the optimum.

    `terms` and `gain` are those at the optimum. The restricted table covers `center` ± `half_width` in log b, with an
    `error` of the signal (V or A).
    """
    table = channel.compression
    if terms is None or not isinstance(table, Compression) or not table.covers(np.exp(center)):
        return channel
    largest = float(np.sum(np.abs(terms.weight)) * gain)
    has_charge = max(channel.columns, default=0) >= len(BASELINE_NAMES)
    charge = float(np.ptp(channel.observed)) / largest if has_charge else 0.0
    low, high = (float(table.center + side * table.half_width) for side in (-1.0, 1.0))
    low, high = max(center - half_width, low), min(center + half_width, high)
    narrow = table.restrict(0.5 * (low + high), 0.5 * (high - low), error / largest, charge=charge)
    return dataclasses.replace(channel, compression=narrow)


def _log_b_slope(likelihood: Likelihood, theta: np.ndarray, step: float = 1e-4) -> Float[np.ndarray, " parameters"]:
    """Return the gradient of the logarithm of the slowest time constant, from differences over two steps."""
    steps = step * np.eye(theta.size)
    _, b = likelihood.evaluate_g_and_b(np.vstack([theta + steps, theta - steps]))
    later, earlier = np.split(b, 2)
    return np.log(later / earlier) / (2.0 * step)
