"""The fit of one or several channels, and which nuisances they ask for."""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.fitting.levenberg_marquardt import minimise
from fitact.fitting.timing import clock_r_squared, free_timing, orthonormal_basis
from fitact.likelihood.channel import TIMING_NUISANCES, ChannelLikelihood
from fitact.likelihood.likelihood import Likelihood
from fitact.likelihood.noise import fit_ar1, student_curvature, student_weight

# by name, the columns of `LINEAR_NUISANCES` that a fit may free; beside these there are `TIMING_NUISANCES`
NUISANCES = {"offset": (0,), "drift": (1,), "hum_50Hz": (2, 3), "hum_60Hz": (4, 5)}
MIN_BIC_DECREASE = 10.0  # a nuisance is freed when it lowers the Bayesian information criterion by this much


class LeastSquaresResult(eqx.Module):
    """Where a fit ended; by channel: rows are its samples, or their coordinates."""

    likelihood: Likelihood  # what was fitted
    theta: Float[Array, " parameters"]  # the optimum
    sigma: Float[Array, " channels"]  # each channel's noise, by what is left of it
    result: Any  # a member of `RESULTS`
    steps: Array  # trial steps taken, in all
    jacobian: tuple[Float[Array, "rows parameters"], ...]  # of the whitened residuals in theta
    # under Student's t these, and the Jacobian, are reweighted
    residuals: tuple[Float[Array, " rows"], ...]
    shapes: tuple[Float[Array, "columns rows"], ...]  # those of the linear nuisances
    slope: tuple[Float[Array, " rows"], ...]  # what a further delay would change


def least_squares(
    likelihood: Likelihood, start: Array, noise: Array, noise_tolerance: float = 0.01, max_rounds: int = 6
) -> LeastSquaresResult:
    """Fit in rounds: with the noise as given, then with that of the residuals, until it has settled.

    It has where it changes by less than `noise_tolerance` of itself: no further round changes what follows.
    """
    needed, steps = likelihood.without_samples(), jnp.zeros((), dtype=int)
    theta, sigma = start, noise
    for _ in range(max_rounds):
        solved = _solve_round(needed, theta, sigma)
        change = float(jnp.max(jnp.abs(solved.sigma / sigma - 1.0)))
        theta, sigma, steps = solved.theta, solved.sigma, steps + solved.steps
        if not change > noise_tolerance:
            break
    return dataclasses.replace(solved, likelihood=likelihood, steps=steps)


@eqx.filter_jit
def _solve_round(likelihood: Likelihood, start: Array, sigma: Array) -> LeastSquaresResult:
    found = minimise(lambda theta: (likelihood.residuals(theta, sigma), likelihood.prior_residuals(theta)), start)
    theta, used = found.theta, found.theta.size / likelihood.count  # of a channel's samples, by the parameters
    parts = []
    for (channel, inputs), s in zip(likelihood.channels_and_inputs(theta), sigma, strict=True):
        left = channel.fit_nuisances(inputs, s)[0]
        root = jnp.sqrt(student_weight(left / s)) if channel.noise == "student" else 1.0
        shapes, slope = channel.residuals_and_shapes(inputs)[1], channel.whitened_delay_derivative(inputs)
        parts.append((left, _noise(channel, left, used), root * left, root * shapes, root * slope))
    remainders, noise, *weighted = zip(*parts, strict=True)
    if any(channel.noise == "student" for channel in likelihood.channels):
        jacobians = _information_jacobian(likelihood, theta, sigma, remainders)
    else:
        sizes = [channel.rows + len(channel.columns) for channel in likelihood.channels]
        jacobians = tuple(jnp.split(found.jacobian, np.cumsum(sizes))[:-1])
    return LeastSquaresResult(likelihood, theta, jnp.stack(noise), found.result, found.steps, jacobians, *weighted)


def _information_jacobian(
    likelihood: Likelihood, theta: Array, sigma: Array, residuals: tuple[Array, ...]
) -> tuple[Float[Array, "rows parameters"], ...]:
    """The Jacobian whose square is the curvature of -log-likelihood: that of Student's residuals is steeper."""

    def whitened_residuals(theta: Array) -> list[Array]:
        parts = zip(likelihood.channels_and_inputs(theta), sigma, strict=True)
        found = ((channel.fit_nuisances(inputs, s), s) for (channel, inputs), s in parts)
        return [jnp.concatenate([left / s, beta]) for (left, beta, _), s in found]

    scaled, jacobians = [], jax.jacfwd(whitened_residuals)(theta)
    for channel, jacobian, left, s in zip(likelihood.channels, jacobians, residuals, sigma, strict=True):
        if channel.noise == "student":
            z = left / s
            weight = student_weight(z)
            weight = weight * channel.mean(student_curvature(z)) / channel.mean(weight)
            jacobian = jacobian * jnp.pad(jnp.sqrt(weight), (0, len(channel.columns)), constant_values=1.0)[:, None]
        scaled.append(jacobian)
    return tuple(scaled)


def _noise(channel: ChannelLikelihood, residuals: Array, parameter_fraction: Array) -> Array:
    """Its standard deviation, or Student's scale, not below the least that is believed."""
    counted = jnp.maximum(channel.count * (1.0 - parameter_fraction), 1)
    sigma = jnp.sqrt(jnp.sum(jnp.square(residuals)) / counted)
    sigma = jnp.maximum(sigma, channel.noise_floor)
    if channel.noise != "student":
        return sigma

    def update_scale(_: int, sigma: Array) -> Array:
        squares = student_weight(residuals / sigma) * jnp.square(residuals)
        return jnp.maximum(jnp.sqrt(jnp.sum(squares) / counted), channel.noise_floor)

    return lax.fori_loop(0, 40, update_scale, sigma)  # each step gains a quarter of a digit


def solve(
    likelihood: Likelihood,
    start: Float[np.ndarray, " parameters"],
    noise: Float[np.ndarray, " channels"],
    optional_nuisances: tuple[tuple[str, ...], ...],
) -> LeastSquaresResult:
    """Fit, then free nuisances (`NUISANCES`, `TIMING_NUISANCES`) one at a time while one is asked for."""
    solved = _solve_coloured_noise(likelihood, jnp.asarray(start), jnp.asarray(noise, dtype=float))
    for _ in range(sum(map(len, optional_nuisances))):
        gains = _bic_decreases(solved, optional_nuisances)
        which, name = max(gains, key=gains.__getitem__, default=(0, ""))
        if not name or not gains[which, name] > MIN_BIC_DECREASE:
            break
        likelihood, theta = _add_nuisance(solved, which, name)
        solved = _solve_coloured_noise(likelihood, theta, solved.sigma)
    return solved


def _solve_coloured_noise(likelihood: Likelihood, start: Array, noise: Array) -> LeastSquaresResult:
    """Fit; where a channel's noise is AR(1), again with the coefficient that the residuals show.

    It is then held: its error and the parameters' are uncorrelated in the limit of many samples (the information
    is block-diagonal), so that not knowing it exactly widens no parameter.
    """
    solved = least_squares(likelihood, start, noise)
    for i, channel in enumerate(likelihood.channels):
        if channel.noise == "ar1":
            white = dataclasses.replace(channel, whitening=None)
            left, *_ = _fit_nuisances(white, likelihood.channel_inputs(solved.theta, i), solved.sigma[i])
            counted = channel.weights > 0.0
            whitening = fit_ar1(np.asarray(left), counted).whitening(counted)
            likelihood = likelihood.replace_channel(i, dataclasses.replace(channel, whitening=whitening))
    if likelihood is solved.likelihood:
        return solved
    return least_squares(likelihood, solved.theta, solved.sigma)


_fit_nuisances = eqx.filter_jit(ChannelLikelihood.fit_nuisances)


def _add_nuisance(solution: LeastSquaresResult, index: int, name: str) -> tuple[Likelihood, Array]:
    """The likelihood with a nuisance of the channel `index` freed, and where to go on from."""
    likelihood, theta = solution.likelihood, solution.theta
    channel = likelihood.channels[index]
    if name in TIMING_NUISANCES:
        channel = free_timing(channel, likelihood.channel_inputs(theta, index), name)
        new, before = likelihood.replace_channel(index, channel).names, likelihood.names
        theta = jnp.array([theta[before.index(n)] if n in before else 0.0 for n in new])
    else:
        sd = channel.linear_sd.at[np.array(NUISANCES[name])].set(10.0 * jnp.ptp(channel.observed))
        channel = dataclasses.replace(channel, linear_sd=sd)
    return likelihood.replace_channel(index, channel), theta


def _bic_decreases(
    solution: LeastSquaresResult, optional_nuisances: tuple[tuple[str, ...], ...]
) -> dict[tuple[int, str], float]:
    """Return what freeing each nuisance would take off the Bayesian information criterion, to first order."""
    likelihood, sigma = solution.likelihood, np.asarray(solution.sigma)
    remainders = [np.asarray(x) / s for x, s in zip(solution.residuals, sigma, strict=True)]
    starts = np.cumsum([0, *(x.size for x in remainders)])
    columns = [np.concatenate([np.asarray(j)[: x.size] for j, x in zip(solution.jacobian, remainders, strict=True)])]

    def pad_columns(index: int, shapes: np.ndarray) -> np.ndarray:
        """Columns of one channel, which are nothing in the others."""
        around = (starts[index], starts[-1] - starts[index + 1])
        return np.pad(np.atleast_2d(shapes) / sigma[index], ((0, 0), around)).T

    candidates, gains = {}, {}
    for i, channel in enumerate(likelihood.channels):
        shapes, free = np.asarray(solution.shapes[i]), np.asarray(channel.linear_sd) > 0.0
        columns.append(pad_columns(i, shapes[free[list(channel.columns)]]))
        if "clock" in optional_nuisances[i] and "clock" not in channel.timing:
            share = clock_r_squared(channel, likelihood.channel_inputs(solution.theta, i), sigma[i])
            gains[i, "clock"] = bic_decrease(share, float(channel.count), 1)
        for name in optional_nuisances[i]:
            if name == "delay" and name not in channel.timing:
                candidates[i, name] = pad_columns(i, np.asarray(solution.slope[i]))
            elif name in NUISANCES and not free[NUISANCES[name][0]]:
                candidates[i, name] = pad_columns(i, shapes[list(NUISANCES[name])])
    basis = orthonormal_basis(np.concatenate(columns, axis=1))
    remainder = np.concatenate(remainders)
    for (i, name), added in candidates.items():
        left = added - basis @ (basis.T @ added)
        modes, sizes, _ = np.linalg.svd(left, full_matrices=False)
        modes = modes[:, sizes > 1e-9 * max(float(np.linalg.norm(added)), 1e-300)]
        share = float(np.sum((modes.T @ remainder) ** 2)) / float(remainders[i] @ remainders[i])
        gains[i, name] = bic_decrease(share, float(likelihood.channels[i].count), added.shape[1])
    return gains


def bic_decrease(fraction: ArrayLike, count: float, n_columns: int) -> Any:
    """Return the fall of the Bayesian information criterion with a share of `count` samples' sum of squares."""
    return -count * np.log1p(-np.minimum(fraction, 1.0 - 1e-12)) - n_columns * math.log(count)
