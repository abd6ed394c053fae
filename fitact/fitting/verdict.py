"""Whether a fit is reliable, and the first reason why it is not."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from fitact.compiled import BatchEvaluator
from fitact.fitting.channel_fit import ChannelFit
from fitact.fitting.least_squares import LeastSquaresResult
from fitact.fitting.minimum import Optima
from fitact.fitting.residual_statistics import is_misfit
from fitact.likelihood.likelihood import Likelihood
from fitact.prior.distributions import Bounded
from fitact.prior.product import Product


def diagnose_fit(
    solution: LeastSquaresResult,
    covariance_factor: Float[np.ndarray, "parameters parameters"],
    traces: Sequence[ChannelFit],
    optima: Optima | None,
) -> str:
    """Return the name of the first of the `RESULTS` that makes the fit unreliable; "successful" if none does."""
    if solution.result != "successful":
        return solution.result
    if is_out_of_bounds(solution.likelihood, solution.theta, solution.sigma, covariance_factor):
        return "on_bound"
    if optima is not None and optima.result == "several_optima":
        return "several_optima"
    return "misfit" if any(is_misfit(channel.figures) for channel in traces) else "successful"


def is_out_of_bounds(
    likelihood: Likelihood,
    theta: Float[np.ndarray, " parameters"],
    sigma: Float[np.ndarray, " channels"],
    covariance_factor: Float[np.ndarray, "parameters parameters"],
    half_width: float = 6.0,
) -> bool:
    """Return whether the data put the parameters where a bounded or ordered prior forbids them.

    Least squares use the mean and covariance of a prior. In the direction that the data determine least the optimum
    may therefore lie outside a bound, which the sampler corrects. The test passes if any point in that direction,
    within `half_width` standard deviations, is allowed. An exponent of 1 is a constant skin: where noise alone
    explains an exponent above 1, the line goes through 1.
    """
    prior = likelihood.prior
    is_bounded = any(isinstance(each, Bounded) for each in (*prior.marginals, *likelihood.sigma_prior))
    if not is_bounded and not prior.order_constraints:
        return False
    axes, sizes, _ = np.linalg.svd(covariance_factor)
    along = np.linspace(-half_width, half_width, 241)[:, None] * (axes[:, 0] * sizes[0])
    points = np.hstack([_clip_exponent(likelihood, theta, covariance_factor) + along, np.tile(np.log(sigma), (241, 1))])
    for i, marginal in enumerate(prior.marginals):
        if isinstance(marginal, Product):  # limits of an instrument, which bound no parameter of the circuit
            points[:, i] = np.clip(points[:, i], marginal.edges[0], marginal.edges[-1])
    evaluate = BatchEvaluator(Likelihood.log_prior, likelihood.without_samples(), points.shape[1], 256, fast=False)
    return not np.any(np.isfinite(evaluate(points)))


def _clip_exponent(likelihood: Likelihood, theta: np.ndarray, covariance_factor: np.ndarray) -> np.ndarray:
    """Return theta, or the most probable point with the fractional exponent at its bound if noise explains that."""
    if "alpha" not in likelihood.prior.names:
        return theta
    place, high = likelihood.prior.names.index("alpha"), getattr(likelihood.prior["alpha"], "high", 1.0)
    excess, spread = theta[place] - math.log(high), np.linalg.norm(covariance_factor[place])
    if not 0.0 < excess < 4.0 * spread:  # further than noise explains
        return theta
    moved = theta - covariance_factor @ covariance_factor[place] * (excess / spread**2)
    moved[place] = math.log(high) * (1.0 + 1e-12) - 1e-12  # rounding must not put it outside
    return moved


def misfit_warnings(traces: Sequence[ChannelFit]) -> list[str]:
    """Return a warning for each of several channels with a poor fit."""
    remedies = {
        "Ft": "mu, force_scale and what is said of the force law do not hold; check the sign and zero of the force"
        " sensor, its frequency and damping, mu and the normal force"
    }
    return [
        f"{channel.record.source}: the common model fits {channel.channel} poorly (residual variance"
        f" {channel.figures['chi2_reduced']:.3g} times the noise variance);"
        f" {remedies.get(channel.channel, 'fit it alone to check that it belongs to this finger')}"
        for channel in traces
        if len(traces) > 1 and is_misfit(channel.figures)
    ]
