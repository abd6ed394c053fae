"""Independent draws around the fit: its Laplace approximation, and that corrected by importance weights."""

import numpy as np
from jaxtyping import Float

from fitact.fitting.fit import Fit
from fitact.sampling.convergence import Convergence, judge_weights, smoothed
from fitact.sampling.posterior import Posterior
from fitact.sampling.proposal import LogProb, Proposal

_DRAWS = 10_000  # kept
_OVERSAMPLED = 2  # so many weighted draws for one that is kept, so that duplicates are few
_FOLLOWED = 2000  # whose derived quantities are looked at, which cost more than the draws


def draw(fit: Fit, level: str, log_prob: LogProb, seed: int) -> Posterior:
    """Draws, by level "laplace" or "psis", and what is wrong with them."""
    rng = np.random.default_rng([seed, 4])
    points, log_density = _normal(fit, rng) if level == "laplace" else _student(fit, log_prob, rng)
    values = log_prob(points)
    weighted = smoothed(values - log_density)
    derived = {name: x[0] for name, x in followed(fit, points[None, :_FOLLOWED], seed).items()}
    seen = dict(zip(fit.point_names, points.T, strict=True)) | derived
    convergence = judge_weights(level, weighted, seen, _DRAWS)
    if level == "psis":
        kept = rng.permutation(systematic(weighted.weights, _DRAWS, float(rng.uniform())))
        points, values = points[kept], values[kept]
    return Posterior.from_draws(fit, points, values, convergence, seed)


def followed(fit: Fit, points: Float[np.ndarray, "chains draws n"], seed: int) -> dict[str, np.ndarray]:
    """Divider, time constant and mean force of points, as far as the circuit has them: (chains, draws)."""
    derived = Posterior(fit, points, np.zeros(points.shape[:2]), Convergence(), seed).derived()
    return {name: derived[name] for name in ("g", "b", "force_mean") if name in derived}


def systematic(weights: Float[np.ndarray, " draws"], count: int, start: float) -> np.ndarray:
    """Indices of `count` equally likely draws: of each, `count` times its weight, rounded up or down.

    `start`, uniform in [0, 1), is the one random number (Kitagawa 1996).
    """
    total = np.cumsum(weights)
    return np.searchsorted(total / total[-1], (np.arange(count) + start) / count, side="right")


def _normal(fit: Fit, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    white = rng.standard_normal((_DRAWS, fit.point.size))
    return fit.point + white @ fit.point_root.T, -0.5 * np.sum(white**2, axis=1)


def _student(fit: Fit, log_prob: LogProb, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    proposal = Proposal.around(fit.point, fit.point_root, log_prob)
    points = proposal.draw(rng, _OVERSAMPLED * _DRAWS)
    return points, proposal.log_density(points)
