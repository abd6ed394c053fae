"""Metropolis-Hastings sampling of many posteriors at once, with independent random numbers.

All posteriors have the same number of coordinates and are nearly normal, so that every move proposes from a Student-t
around its Gaussian approximation. Such proposals do not depend on the walkers, and all are evaluated together. Each
posterior has its own seed, so that its draws do not depend on the other posteriors.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Self

import numpy as np
from jaxtyping import Float, Int

from fitact.sampling.proposal import OVERDISPERSION, draw_student_t, principal_axes, student_log_density

ENSEMBLES = 4
WALKERS = 16  # per ensemble; few suffice, since many posteriors are evaluated together

# log-densities of points (posteriors, any, n), never NaN
LogProbs = Callable[[Float[np.ndarray, "posteriors any n"]], Float[np.ndarray, "posteriors any"]]


class EnsembleDraws(NamedTuple):
    """Points drawn, and the number of accepted moves."""

    points: Float[np.ndarray, "posteriors ensembles steps walkers n"]
    accepted: Int[np.ndarray, "posteriors ensembles walkers"]


class GaussianApproximations(NamedTuple):
    """Gaussian approximations: centers, and factors of the covariances."""

    centers: Float[np.ndarray, "posteriors n"]
    covariance_factors: Float[np.ndarray, "posteriors n n"]

    @classmethod
    def from_covariance_factors(cls, centers: np.ndarray, covariance_factors: np.ndarray) -> Self:
        """Return approximations whose covariance factors have the principal axes as columns, one sd long."""
        return cls(centers, principal_axes(covariance_factors))

    def from_standard_normal(self, z: Float[np.ndarray, "posteriors any n"]) -> Float[np.ndarray, "posteriors any n"]:
        return self.centers[:, None] + z @ np.swapaxes(self.covariance_factors, 1, 2)

    def refine(self, values: Float[np.ndarray, "posteriors n probes"]) -> Self:
        """Correct centers and lengths by parabolas through the log-densities at `PROBES` on each axis, if any."""
        below, middle, above = np.moveaxis(values[..., 1:4], -1, 0)
        with np.errstate(invalid="ignore"):  # a point outside the support
            curvature = 2.0 * middle - below - above
            step = 0.5 * (above - below) / curvature
            is_peak = (curvature > 0.25) & (curvature < 4.0) & (np.abs(step) < 1.0)
        step, length = np.where(is_peak, step, 0.0), np.where(is_peak, curvature, 1.0) ** -0.5
        return type(self)(self.from_standard_normal(step[:, None])[:, 0], self.covariance_factors * length[:, None])


def sample_posteriors(
    log_probs: LogProbs, approximations: GaussianApproximations, steps: int, seeds: Sequence[Sequence[int]]
) -> EnsembleDraws:
    """Sample posteriors that are close to `approximations`; `seeds` are those of the posteriors."""
    count, size = approximations.centers.shape
    shape = (count, ENSEMBLES, steps + 1, WALKERS)
    generators = [np.random.default_rng(entropy) for entropy in seeds]
    z = np.stack([draw_student_t(each, ENSEMBLES * (steps + 1) * WALKERS, size) for each in generators])
    z.reshape(*shape, size)[:, :, 0] *= OVERDISPERSION  # the walkers start there
    points = approximations.from_standard_normal(z)
    log_ratios = (log_probs(points) - student_log_density(z)).reshape(shape)
    log_uniform = np.log(np.stack([each.random(shape[1:]) for each in generators]))
    current, chosen = log_ratios[:, :, 0], np.zeros(shape, dtype=int)  # the step at which each point was proposed
    for step in range(1, steps + 1):
        with np.errstate(invalid="ignore"):  # both points are outside the support
            is_accepted = log_uniform[:, :, step] < log_ratios[:, :, step] - current
        current = np.where(is_accepted, log_ratios[:, :, step], current)
        chosen[:, :, step] = np.where(is_accepted, step, chosen[:, :, step - 1])
    points = np.take_along_axis(points.reshape(*shape, size), chosen[..., None], axis=2)[:, :, 1:]
    return EnsembleDraws(points, np.count_nonzero(np.diff(chosen, axis=2), axis=2))
