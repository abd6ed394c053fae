"""Least-squares fit of one or several channels, and the selection of nuisance parameters by the BIC."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.compiled import jit
from fitact.experiment.fisher import covariance_factor
from fitact.fitting.derived import UnknownCharges
from fitact.fitting.minimum import minimise
from fitact.fitting.outcome import result_name
from fitact.fitting.score_test import explained_squares
from fitact.fitting.timing import clock_r_squared, free_timing
from fitact.likelihood.certificate import can_interpolate, expand_student, interpolate_channel, recompress
from fitact.likelihood.channel import ChannelLikelihood, compiled_fit_nuisances
from fitact.likelihood.compression import HUM_FREQUENCIES, Interpolation
from fitact.likelihood.likelihood import Likelihood
from fitact.likelihood.noise import NoiseModel, fit_ar1, student_curvature, student_weight
from fitact.likelihood.observable import FIRST_CHARGE, TIMING_NUISANCES

# columns of `LINEAR_NUISANCES` that a fit may add as free parameters, by name; it may also add `TIMING_NUISANCES`
NUISANCES = {
    "offset": (0,),
    "drift": (1,),
    **{f"hum_{frequency:.0f}Hz": (2 * i + 2, 2 * i + 3) for i, frequency in enumerate(HUM_FREQUENCIES)},
    "crosstalk": (FIRST_CHARGE + 2, FIRST_CHARGE + 3),
}
MIN_BIC_DECREASE = 10.0  # least decrease of the BIC for which a nuisance is added as a free parameter


@dataclasses.dataclass(frozen=True)
class LeastSquaresResult:
    """End point of a fit. The rows of a channel are its samples, or their coordinates if it is compressed."""

    likelihood: Likelihood  # likelihood with the selected nuisances
    theta: Float[np.ndarray, " parameters"]  # the optimum
    sigma: Float[np.ndarray, " channels"]  # noise sd of each channel, from its residuals
    log_density: float  # of the posterior, up to a constant, before the last change of sigma
    result: str  # name of a member of `RESULTS`
    steps: int  # total number of trial steps
    prior: tuple[Float[np.ndarray, " rows"], Float[np.ndarray, "rows parameters"]]  # its residuals and their Jacobian
    jacobian: tuple[Float[np.ndarray, "rows parameters"], ...]  # Jacobian of the whitened residuals
    nuisances: tuple[Float[np.ndarray, " columns"], ...]  # linear nuisances, in prior standard deviations
    # under Student's t, all of these are reweighted
    residuals: tuple[Float[np.ndarray, " rows"], ...]
    shapes: tuple[Float[np.ndarray, "columns rows"], ...]  # regressors of the linear nuisances
    slope: tuple[Float[np.ndarray, " rows"], ...]  # derivative of the signal with respect to the delay
    signal: tuple[Float[np.ndarray, " rows"], ...]  # without linear nuisances

    def covariance_factor(self) -> Float[np.ndarray, "parameters parameters"]:
        """Return a factor of the covariance of theta in the Laplace approximation."""
        rows = np.concatenate([*self.jacobian, self.likelihood.calibration_jacobian])
        return covariance_factor(rows, self.likelihood.prior_factor)

    def unknown_charges(self) -> UnknownCharges:
        """Return the unknown charges at the first sample of the first channel."""
        first = len(self.jacobian[0]) - len(self.nuisances[0])  # the rows of the nuisances follow those of the data
        return UnknownCharges.from_nuisances(self.likelihood, self.theta, self.nuisances[0], self.jacobian[0][first:])


def least_squares(
    likelihood: Likelihood, start: np.ndarray, noise: np.ndarray, noise_tolerance: float = 0.01, max_rounds: int = 6
) -> LeastSquaresResult:
    """Fit in rounds, first with the given noise, then with that of the residuals, until the noise has converged.

    It has converged when its relative change is below `noise_tolerance`; further rounds do not change the result.
    """
    reduced, steps = likelihood.without_samples(), 0
    theta, sigma = start, noise
    for damping in [1e-2, *[1e-9] * (max_rounds - 1)]:  # later rounds start at the optimum of another noise
        solved = LeastSquaresResult(likelihood, *_solve_round(reduced, theta, sigma, np.asarray(damping)))
        change = np.max(np.abs(solved.sigma / sigma - 1.0))
        theta, sigma, steps = solved.theta, solved.sigma, steps + int(solved.steps)
        if not change > noise_tolerance:
            break
    log_density, result = float(solved.log_density), result_name(solved.result)
    return dataclasses.replace(solved, log_density=log_density, result=result, steps=steps)


@jit
def _solve_round(likelihood: Likelihood, start: Array, sigma: Array, damping: Array) -> tuple[Any, ...]:
    """Return the fields of `LeastSquaresResult` after the likelihood, with the index of the result."""

    def with_prior(theta: Array) -> tuple[Any, Array]:
        return likelihood.residuals(theta, sigma), likelihood.prior_residuals(theta)

    minimum = minimise(with_prior, start, damping=damping, elements=likelihood.elements)
    theta, fraction = minimum.theta, minimum.theta.size / likelihood.count  # parameters per sample
    parts = []
    for (channel, inputs), s in zip(likelihood.channels_and_inputs(theta), sigma, strict=True):
        remainder, shapes = channel.residuals_and_shapes(inputs)
        residuals, beta, _ = channel.fit_rows(remainder, shapes, s)
        factor = jnp.sqrt(student_weight(residuals / s)) if channel.is_student else 1.0
        signal, slope = channel.whitened_observed() - remainder, channel.whitened_delay_derivative(inputs)
        sigma_new = _noise(channel, residuals, fraction) if channel.expansion is None else channel.expansion.sigma
        parts.append((residuals, sigma_new, beta, *(factor * x for x in (residuals, shapes, slope, signal))))
    unweighted, noise, nuisances, *weighted = zip(*parts, strict=True)
    if any(channel.is_student for channel in likelihood.channels):
        jacobians = _information_jacobian(likelihood, theta, sigma, unweighted)
    else:
        sizes = [channel.rows + len(channel.columns) for channel in likelihood.channels]
        jacobians = tuple(jnp.split(minimum.jacobian, np.cumsum(sizes))[:-1])
    counts = jnp.stack([jnp.asarray(channel.count, dtype=float) for channel in likelihood.channels])
    log_density = -minimum.cost - counts @ jnp.log(sigma)
    off_prior = likelihood.prior_residuals(theta)
    prior = off_prior, minimum.jacobian[len(minimum.jacobian) - off_prior.size :]
    end = theta, jnp.stack(noise), log_density, minimum.result, minimum.steps, prior, jacobians, nuisances
    return *end, *weighted


def _information_jacobian(
    likelihood: Likelihood, theta: Array, sigma: Array, residuals: tuple[Array, ...]
) -> tuple[Float[Array, "rows parameters"], ...]:
    """Return the Jacobian J for which J^T J is the curvature of -log-likelihood, also under Student's t."""

    def whitened_residuals(theta: Array) -> list[Array]:
        parts = zip(likelihood.channels_and_inputs(theta), sigma, strict=True)
        fits = ((channel.fit_nuisances(inputs, s), s) for (channel, inputs), s in parts)
        return [jnp.concatenate([residuals / s, beta]) for (residuals, beta, _), s in fits]

    scaled, jacobians = [], jax.jacfwd(whitened_residuals)(theta)
    for channel, jacobian, residual, s in zip(likelihood.channels, jacobians, residuals, sigma, strict=True):
        if channel.is_student:
            z = residual / s
            weight = student_weight(z)
            weight = weight * channel.samples.mean(student_curvature(z)) / channel.samples.mean(weight)
            jacobian = jacobian * jnp.pad(jnp.sqrt(weight), (0, len(channel.columns)), constant_values=1.0)[:, None]
        scaled.append(jacobian)
    return tuple(scaled)


def _noise(channel: ChannelLikelihood, residuals: Array, parameter_fraction: Array) -> Array:
    """Return the noise sd, or Student's scale, but at least the noise floor of the channel."""
    counted = jnp.maximum(channel.count * (1.0 - parameter_fraction), 1)
    sigma = jnp.sqrt(jnp.sum(jnp.square(residuals)) / counted)
    sigma = jnp.maximum(sigma, channel.noise_floor)
    if channel.noise != "student":
        return sigma

    def update_scale(_: int, sigma: Array) -> Array:
        squares = student_weight(residuals / sigma) * jnp.square(residuals)
        return jnp.maximum(jnp.sqrt(jnp.sum(squares) / counted), channel.noise_floor)

    return lax.fori_loop(0, 40, update_scale, sigma)  # each step adds a quarter of a digit


def solve(
    likelihood: Likelihood,
    start: Float[np.ndarray, " parameters"],
    noise: Float[np.ndarray, " channels"],
    optional_nuisances: tuple[tuple[str, ...], ...],
    interpolated: tuple[bool, ...],
) -> LeastSquaresResult:
    """Fit, then add nuisances (`NUISANCES`, `TIMING_NUISANCES`) one by one while the BIC favours one.

    `interpolated` states for each channel whether it may be compressed around its optimum if no table serves.
    """
    students = [i for i, channel in enumerate(likelihood.channels) if channel.noise == "student"]
    if not students:
        return _select_nuisances(likelihood, start, noise, optional_nuisances, interpolated)
    # samples at edges that a delay moves look like outliers, so normal noise proposes delays, and Student's t decides
    timing = tuple(tuple(name for name in each if name in TIMING_NUISANCES) for each in optional_nuisances)
    others = tuple(tuple(name for name in each if name not in TIMING_NUISANCES) for each in optional_nuisances)
    normal = _select_nuisances(_with_noise(likelihood, students, "white"), start, noise, timing, interpolated)
    timed = _with_noise(normal.likelihood, students, "student")
    solved = _select_nuisances(timed, normal.theta, noise, others, interpolated)
    if timed.names == likelihood.names or _least_timing_gain(solved) > MIN_BIC_DECREASE:
        return solved
    return _select_nuisances(likelihood, start, noise, others, interpolated)


def _least_timing_gain(solution: LeastSquaresResult) -> float:
    """Return the decrease of the BIC that the least significant of the free delays and clocks causes."""
    likelihood, count = solution.likelihood, float(solution.likelihood.count)
    root = solution.covariance_factor()
    gains = []
    for name, (origin, unit) in likelihood.timing.items():
        place = likelihood.names.index(name)
        z_squared = (origin / unit + solution.theta[place]) ** 2 / float(root[place] @ root[place])
        gains.append(bic_decrease_from_z(z_squared, count))
    return min(gains, default=math.inf)


def _with_noise(likelihood: Likelihood, channels: list[int], noise: NoiseModel) -> Likelihood:
    """Return the likelihood with another noise model of some channels; an interpolation holds for one model only."""
    for i in channels:
        channel = dataclasses.replace(likelihood.channels[i], noise=noise, expansion=None)
        if isinstance(channel.compression, Interpolation):
            channel = channel.without_compression()
        likelihood = likelihood.replace_channel(i, channel)
    return likelihood


def _select_nuisances(
    likelihood: Likelihood,
    start: Float[np.ndarray, " parameters"],
    noise: Float[np.ndarray, " channels"],
    optional_nuisances: tuple[tuple[str, ...], ...],
    interpolated: tuple[bool, ...],
) -> LeastSquaresResult:
    solved = _solve_coloured_noise(likelihood, start, noise, interpolated)
    if lasting := _find_lasting_charges(solved, optional_nuisances):
        for index in lasting:
            likelihood = _free_columns(likelihood, index, "offset")
        solved = _solve_coloured_noise(likelihood, start, noise, interpolated)
    for _ in range(sum(map(len, optional_nuisances))):
        gains = _bic_decreases(solved, optional_nuisances)
        which, name = max(gains, key=gains.__getitem__, default=(0, ""))
        if not name or not gains[which, name] > MIN_BIC_DECREASE:
            break
        likelihood, theta = _add_nuisance(solved, which, name)
        solved = _solve_coloured_noise(likelihood, theta, solved.sigma, interpolated)
    return solved


def _find_lasting_charges(
    solution: LeastSquaresResult, optional_nuisances: tuple[tuple[str, ...], ...], least: float = 0.5
) -> list[int]:
    """Return the channels whose unknown charge lasts for `least` of the record or longer, so that it may be an offset.

    The BIC cannot tell, since a wrong time constant then takes the place of an offset.
    """
    likelihood, (offset,) = solution.likelihood, NUISANCES["offset"]
    slowest = float(np.max(likelihood.evaluate_circuit(solution.theta).tau))

    def lasts(channel: ChannelLikelihood) -> bool:
        is_alone = channel.linear_sd[FIRST_CHARGE] > 0.0 and channel.linear_sd[offset] == 0.0
        return bool(is_alone and slowest > least * (channel.samples.time[-1] - channel.samples.time[0]))

    pairs = enumerate(zip(likelihood.channels, optional_nuisances, strict=True))
    return [i for i, (channel, names) in pairs if "offset" in names and lasts(channel)]


def _solve_coloured_noise(
    likelihood: Likelihood, start: np.ndarray, noise: np.ndarray, interpolated: tuple[bool, ...]
) -> LeastSquaresResult:
    """Fit; if the noise of a channel is AR(1), fit again with the coefficient estimated from the residuals.

    The coefficient is then fixed. For many samples its error is uncorrelated with those of the parameters (the
    information matrix is block-diagonal), so it does not widen them.
    """
    solved = _solve_student(*_interpolate(likelihood, start, noise, interpolated))
    likelihood = solved.likelihood
    for i, channel in enumerate(likelihood.channels):
        if channel.noise == "ar1":
            white = channel.without_compression().replace_samples(whitening=None)
            residuals, *_ = compiled_fit_nuisances(white, likelihood.channel_inputs(solved.theta, i), solved.sigma[i])
            counted = channel.samples.weights > 0.0
            channel = channel.replace_samples(whitening=fit_ar1(residuals, counted).whitening(counted))
            channel = recompress(channel, likelihood.evaluate_circuit(solved.theta))
            likelihood = likelihood.replace_channel(i, channel)
    if likelihood is solved.likelihood:
        return solved
    return _solve_student(*_interpolate(likelihood, solved.theta, solved.sigma, interpolated))


def _solve_student(
    likelihood: Likelihood, start: np.ndarray, noise: np.ndarray, tolerance: float = 0.03, max_rounds: int = 20
) -> LeastSquaresResult:
    """Fit; expand Student-t noise of compressed channels around the optimum until it moves by less than `tolerance`.

    The tolerance is in standard errors. The first fit is that of normal noise.
    """
    which = [
        i for i, each in enumerate(likelihood.channels) if each.noise == "student" and each.compression is not None
    ]
    if not which:
        return least_squares(likelihood, start, noise)
    solved, steps, moved = least_squares(_with_noise(likelihood, which, "white"), start, noise), 0, math.inf
    for _ in range(max_rounds):
        exact = moved < 1.0  # from further away, Newton's step may lead astray
        theta, sigma, steps = solved.theta, solved.sigma.copy(), steps + solved.steps
        for i in which:
            channel = expand_student(solved.likelihood, i, theta, float(sigma[i]), exact=exact)
            likelihood = likelihood.replace_channel(i, channel)
            assert channel.expansion is not None
            sigma[i] = channel.expansion.sigma
        solved = least_squares(likelihood, theta, sigma, max_rounds=1)
        moved = float(np.linalg.norm(np.concatenate(solved.jacobian) @ (solved.theta - theta)))
        if exact and not tolerance < moved < 1.0:  # a larger step shows that the expansion does not hold
            break
    return dataclasses.replace(solved, steps=steps + solved.steps)


def _interpolate(
    likelihood: Likelihood, start: np.ndarray, noise: np.ndarray, interpolated: tuple[bool, ...], few: int = 4096
) -> tuple[Likelihood, np.ndarray, np.ndarray]:
    """Return the likelihood with interpolations for channels without a table, and the optimum and noise near it.

    The optimum is that of `few` samples of these channels, as if their noise were white.
    """
    pairs = enumerate(zip(likelihood.channels, interpolated, strict=True))
    chosen = [i for i, (channel, may) in pairs if may and can_interpolate(channel)]
    if not chosen:
        return likelihood, start, noise
    thin = likelihood
    for i in chosen:
        thin = thin.replace_channel(i, likelihood.channels[i].thin(few))
    solved = least_squares(thin, start, noise, noise_tolerance=0.1)
    root = solved.covariance_factor()
    for i in chosen:
        size = likelihood.channels[i].samples.size
        reach = 6.0 + 20.0 * math.sqrt(min(few / size, 1.0))
        channel = interpolate_channel(likelihood, i, solved.theta, root, float(solved.sigma[i]), reach)
        likelihood = likelihood.replace_channel(i, channel)
    return likelihood, solved.theta, solved.sigma


def _add_nuisance(solution: LeastSquaresResult, index: int, name: str) -> tuple[Likelihood, np.ndarray]:
    """Return the likelihood with an added nuisance of channel `index`, and the theta from which to continue."""
    likelihood, theta = solution.likelihood, solution.theta
    channel = likelihood.channels[index]
    if name in TIMING_NUISANCES:
        channel = free_timing(
            channel, likelihood.channel_inputs(theta, index), likelihood.evaluate_circuit(theta), name
        )
        new, before = likelihood.replace_channel(index, channel).names, likelihood.names
        theta = np.array([theta[before.index(n)] if n in before else 0.0 for n in new])
        return likelihood.replace_channel(index, channel), theta
    return _free_columns(likelihood, index, name), theta


def _free_columns(likelihood: Likelihood, index: int, name: str) -> Likelihood:
    """Return the likelihood with a free linear nuisance of channel `index`, whose prior is wide."""
    channel = likelihood.channels[index]
    sd = channel.linear_sd.copy()
    sd[list(NUISANCES[name])] = 10.0 * np.ptp(channel.samples.observed)
    return likelihood.replace_channel(index, dataclasses.replace(channel, linear_sd=sd))


def _bic_decreases(
    solution: LeastSquaresResult, optional_nuisances: tuple[tuple[str, ...], ...]
) -> dict[tuple[int, str], float]:
    """Return the decrease of the BIC that adding each nuisance would cause, to first order.

    The rows of the prior follow those of the data, since a parameter stands for a nuisance only as far as its prior
    lets it: a fast time constant of a known circuit acts as a delay.
    """
    likelihood, sigma = solution.likelihood, solution.sigma
    residuals = [x / s for x, s in zip(solution.residuals, sigma, strict=True)]
    if not all(np.isfinite(x).all() for x in (*residuals, *solution.jacobian)):
        return {}
    starts = np.cumsum([0, *(x.size for x in residuals)])
    off_prior, prior_jacobian = solution.prior
    parts = [j[: x.size] for j, x in zip(solution.jacobian, residuals, strict=True)]
    fitted = [np.concatenate([*parts, prior_jacobian]).T]

    def pad_shapes(index: int, shapes: np.ndarray) -> np.ndarray:
        """Return the shapes of one channel, padded with zeros for the others."""
        around = (starts[index], starts[-1] - starts[index + 1] + off_prior.size)
        return np.pad(np.atleast_2d(shapes) / sigma[index], ((0, 0), around))

    candidates, gains = {}, {}
    for i, channel in enumerate(likelihood.channels):
        shapes, free = solution.shapes[i], channel.linear_sd > 0.0
        fitted.append(pad_shapes(i, shapes[channel.column_sd > 0.0]))
        if "clock" in optional_nuisances[i] and "clock" not in channel.timing.free:
            fraction = clock_r_squared(channel, likelihood.channel_inputs(solution.theta, i), sigma[i])
            gains[i, "clock"] = bic_decrease(fraction, float(channel.count), 1)
        for name in optional_nuisances[i]:
            if name == "delay" and name not in channel.timing.free:
                candidates[i, name] = pad_shapes(i, solution.slope[i])
            elif name in NUISANCES and not free[NUISANCES[name][0]]:
                candidates[i, name] = pad_shapes(i, shapes[list(NUISANCES[name])])
    explained = explained_squares(np.concatenate([*residuals, off_prior]), np.concatenate(fitted), candidates)
    for (i, name), square in explained.items():
        fraction = square / float(residuals[i] @ residuals[i])
        gains[i, name] = bic_decrease(fraction, float(likelihood.channels[i].count), len(candidates[i, name]))
    return gains


def bic_decrease(fraction: ArrayLike, count: float, n_columns: int) -> Any:
    """Return the decrease of the BIC if `n_columns` explain a `fraction` of the sum of squares of `count` samples."""
    return -count * np.log1p(-np.minimum(fraction, 1.0 - 1e-12)) - n_columns * math.log(count)


def bic_decrease_from_z(z_squared: ArrayLike, count: float) -> Any:
    """Return `bic_decrease` of a free parameter from the square of its value over its standard error."""
    return bic_decrease(z_squared / (z_squared + count), count, 1)
