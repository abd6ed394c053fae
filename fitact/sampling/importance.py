"""Independent draws around the fit, from its Laplace approximation or by importance sampling."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from fitact.fitting import derived
from fitact.fitting.result import Fit
from fitact.sampling.convergence import ImportanceWeights, diagnose_weights, pareto_smooth
from fitact.sampling.posterior import Posterior
from fitact.sampling.proposal import Proposal, draw_student_t, student_log_density
from fitact.sampling.ridge import LogDensity


def draw_around_fit(fit: Fit, level: str, log_prob: LogDensity, seed: int) -> Posterior:
    """Draw with method `level`, "laplace" or "psis", and diagnose the draws."""
    draws, oversampling = 10_000, 2  # weighted draws of "psis" for each that it returns, so that few are duplicates
    rng = np.random.default_rng([seed, 4])
    if level == "laplace":
        z = rng.standard_normal((draws, fit.point.size))
        points, log_density = fit.point + z @ fit.point_root.T, -0.5 * np.sum(z**2, axis=1)
    else:
        proposal = Proposal.from_fit(fit, log_prob)
        points = proposal.draw(rng, oversampling * draws)
        log_density = proposal.log_density(points)
    values = log_prob(points)
    weighted = pareto_smooth(values - log_density)
    # derived quantities cost more than the draws, so only some draws are used
    derived = {name: x[0] for name, x in tracked_quantities(fit, points[None, :2000], seed).items()}
    quantities = dict(zip(fit.point_names, points.T, strict=True)) | derived
    convergence = diagnose_weights(level, weighted, quantities, draws)
    if level == "psis":
        indices = rng.permutation(systematic_resample(weighted.weights, draws, float(rng.uniform())))
        points, values = points[indices], values[indices]
    return Posterior.from_draws(fit, points, values, convergence, seed)


class AdaptedDraws(NamedTuple):
    """Weighted draws from a Student-t that was fitted to the density."""

    center: Float[np.ndarray, " n"]
    root: Float[np.ndarray, "n n"]  # of its covariance, but for the tails
    points: Float[np.ndarray, "draws n"]
    weighted: ImportanceWeights


def draw_adaptively(
    log_prob: LogDensity,
    center: Float[np.ndarray, " n"],
    root: Float[np.ndarray, "n n"],
    random: np.random.Generator,
    draws: int,
    *,
    widening: Float[np.ndarray, " n"],
    rounds: int = 8,
    pilot_draws: int = 4096,
) -> AdaptedDraws:
    """Fit a Student-t to a density by its weighted moments, round by round, and draw from it with weights.

    Start with `center` and `root` of an approximation. A pilot with few effective draws is tempered. The last
    distribution is wider by `widening`, more than 1 for coordinates with long tails.
    """
    for last in [*[False] * rounds, True]:
        root = root * widening[:, None] if last else root
        z = draw_student_t(random, draws if last else pilot_draws, center.size)
        points = center + z @ root.T
        log_weights = log_prob(points) - student_log_density(z)
        weighted = pareto_smooth(log_weights)
        if last:
            break
        while 1.0 / np.sum(np.square(weighted.weights)) < 10 * center.size and np.isfinite(weighted.k_hat):
            log_weights = 0.5 * log_weights
            weighted = pareto_smooth(log_weights)
        center = weighted.weights @ points
        away = points - center
        root = np.linalg.cholesky((weighted.weights[:, None] * away).T @ away)
    return AdaptedDraws(center, root, points, weighted)


def tracked_quantities(fit: Fit, points: Float[np.ndarray, "chains draws n"], seed: int) -> dict[str, np.ndarray]:
    """Return g, b and the mean force at `points`, each (chains, draws), as far as the circuit defines them."""
    values = derived.draw_derived(fit.derive, fit.likelihood, points, seed)
    return {name: values[..., derived.DERIVED_NAMES.index(name)] for name in ("g", "b", "force_mean")}


def systematic_resample(weights: Float[np.ndarray, " draws"], count: int, start: float) -> np.ndarray:
    """Return indices of `count` draws of equal weight (systematic resampling, Kitagawa 1996).

    Each draw occurs `count` times its weight, rounded up or down. Uniform `start` in [0, 1) is the only random number.
    """
    total = np.cumsum(weights)
    return np.searchsorted(total / total[-1], (np.arange(count) + start) / count, side="right")
