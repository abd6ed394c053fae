"""Whether a fit is reliable, and the first reason why it is not."""

import math
from collections.abc import Sequence

import numpy as np
import scipy
from jaxtyping import Float

from fitact.fitting.channel_fit import ChannelFit
from fitact.fitting.least_squares import LeastSquaresResult
from fitact.fitting.residual_statistics import is_misfit
from fitact.likelihood.likelihood import Likelihood
from fitact.prior.product import Product


def diagnose_fit(
    solution: LeastSquaresResult,
    covariance_factor: Float[np.ndarray, "parameters parameters"],
    traces: Sequence[ChannelFit],
    has_rival: bool,
) -> str:
    """Return the name of the first of the `RESULTS` that makes the fit unreliable; "successful" if none does."""
    if solution.result != "successful":
        return solution.result
    if is_out_of_bounds(solution.likelihood, solution.theta, solution.sigma, covariance_factor):
        return "on_bound"
    if has_rival:
        return "several_optima"
    return "misfit" if any(is_misfit(channel.figures) for channel in traces) else "successful"


def is_out_of_bounds(
    likelihood: Likelihood,
    theta: Float[np.ndarray, " parameters"],
    sigma: Float[np.ndarray, " channels"],
    covariance_factor: Float[np.ndarray, "parameters parameters"],
    blind: float = 6.0,
    noise: float = 4.0,
) -> bool:
    """Return whether the data put the parameters where a bounded or ordered prior, or an instrument, forbids them.

    Least squares use the mean and covariance of a prior. In the direction that the data determine least the optimum
    may therefore lie outside a bound, by `blind` standard deviations, which the sampler corrects. Limits of instruments
    and geometry, and an exponent of 1, which is a constant skin, may be missed by what noise explains: `noise`
    standard deviations in any direction.
    """
    prior = likelihood.prior
    for each, log in zip(likelihood.sigma_prior, np.log(sigma), strict=True):
        if each is not None and not each.support[0] <= log <= each.support[1]:
            return True
    axes = np.eye(theta.size)
    orders = [[axes[prior.names.index(name)] for name in pair] for pair in prior.order_constraints]
    strict, loose = [(higher - lower, 0.0) for lower, higher in orders], list[tuple[np.ndarray, float]]()
    for axis, name, marginal in zip(axes, prior.names, prior.marginals, strict=False):
        chosen = loose if name == "alpha" or isinstance(marginal, Product) else strict
        low, high = marginal.support
        chosen += [(sign * axis, sign * bound) for sign, bound in ((1.0, low), (-1.0, high)) if math.isfinite(bound)]
    directions, sizes, _ = np.linalg.svd(covariance_factor)
    least_determined = directions[:, :1] * sizes[0]
    cases = (strict, least_determined, blind), (loose, covariance_factor, noise)
    return any(_distance(limits, theta, factor) > allowed for limits, factor, allowed in cases)


def _distance(
    limits: Sequence[tuple[Float[np.ndarray, " parameters"], float]],
    theta: Float[np.ndarray, " parameters"],
    factor: Float[np.ndarray, "parameters directions"],
) -> float:
    """Return the norm of the shortest z with which theta + factor z is within all limits, a @ theta >= c for (a, c).

    That is Gz >= h. The residual of Eu = (0, ..., 0, 1) for u >= 0, with E = (G, h)^T, has the squared norm
    1 / (1 + z^T z) (C. Lawson and R. Hanson, Solving Least Squares Problems, 1974, chapter 23).
    """
    E = np.array([[*(row @ factor), bound - row @ theta] for row, bound in limits]).T
    if not limits or np.all(E[-1] <= 0.0):
        return 0.0
    lengths = np.linalg.norm(E, axis=0)
    _, residual = scipy.optimize.nnls(E[:, lengths > 0.0] / lengths[lengths > 0.0], np.eye(len(E))[-1])
    return math.sqrt(max(residual**-2 - 1.0, 0.0)) if residual > 0.0 else math.inf


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
