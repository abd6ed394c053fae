"""Independent draws around the fit: its Laplace approximation, and that corrected by importance weights."""

import numpy as np
from jaxtyping import Float

from fitact.fitting import derived
from fitact.fitting.fit import Fit
from fitact.sampling.convergence import diagnose_weights, pareto_smooth
from fitact.sampling.posterior import Posterior
from fitact.sampling.proposal import LogProb, Proposal


def draw_around_fit(
    fit: Fit, level: str, log_prob: LogProb, seed: int, *, draws: int = 10_000, oversampling: int = 2
) -> Posterior:
    """Draw by level "laplace" or "psis", and judge the draws.

    There are `oversampling` weighted draws for each of the `draws` that are kept, so that duplicates are few.
    """
    rng = np.random.default_rng([seed, 4])
    if level == "laplace":
        white = rng.standard_normal((draws, fit.point.size))
        points, log_density = fit.point + white @ fit.point_root.T, -0.5 * np.sum(white**2, axis=1)
    else:
        proposal = Proposal.from_laplace(fit.point, fit.point_root, log_prob)
        points = proposal.draw(rng, oversampling * draws)
        log_density = proposal.log_density(points)
    values = log_prob(points)
    weighted = pareto_smooth(values - log_density)
    # some will do for the derived quantities, which cost more than the draws
    derived = {name: x[0] for name, x in tracked_quantities(fit, points[None, :2000], seed).items()}
    quantities = dict(zip(fit.point_names, points.T, strict=True)) | derived
    convergence = diagnose_weights(level, weighted, quantities, draws)
    if level == "psis":
        kept = rng.permutation(systematic_resample(weighted.weights, draws, float(rng.uniform())))
        points, values = points[kept], values[kept]
    return Posterior.from_draws(fit, points, values, convergence, seed)


def tracked_quantities(fit: Fit, points: Float[np.ndarray, "chains draws n"], seed: int) -> dict[str, np.ndarray]:
    """Divider, time constant and mean force of points, as far as the circuit has them: (chains, draws)."""
    values = derived.draw_derived(fit.derive, fit.likelihood, points, seed)
    return {name: values[..., derived.DERIVED_NAMES.index(name)] for name in ("g", "b", "force_mean")}


def systematic_resample(weights: Float[np.ndarray, " draws"], count: int, start: float) -> np.ndarray:
    """Return indices of `count` equally likely draws: of each, `count` times its weight, rounded up or down.

    `start`, uniform in [0, 1), is the one random number (Kitagawa 1996).
    """
    total = np.cumsum(weights)
    return np.searchsorted(total / total[-1], (np.arange(count) + start) / count, side="right")
