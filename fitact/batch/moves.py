"""Ensembles of many posteriors in one run of emcee, with independent moves and random numbers.

All posteriors have the same number of coordinates and are nearly normal. emcee holds all walkers in one array, in the
order (posteriors, ensembles, walkers). Each posterior has its own seed, so that its draws do not depend on the other
posteriors.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple, Self

import emcee
import numpy as np
from jaxtyping import Bool, Float

from fitact.sampling.proposal import OVERDISPERSION, SHARES, draw_student_t, principal_axes, student_log_density

ENSEMBLES = 4
WALKERS = 16  # per ensemble; few suffice, since many posteriors are evaluated together

# log-densities of points (posteriors, any, n), never NaN
LogProbs = Callable[[Float[np.ndarray, "posteriors any n"]], Float[np.ndarray, "posteriors any"]]
Generators = Sequence[np.random.Generator]


class EnsembleDraws(NamedTuple):
    """Points drawn, and whether each move was accepted."""

    points: Float[np.ndarray, "posteriors ensembles steps walkers n"]
    accepted: Float[np.ndarray, "posteriors ensembles walkers"]


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

    def to_standard_normal(
        self, points: Float[np.ndarray, "posteriors any n"]
    ) -> Float[np.ndarray, "posteriors any n"]:
        return (points - self.centers[:, None]) @ np.swapaxes(np.linalg.inv(self.covariance_factors), 1, 2)

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
    log_probs: LogProbs, approximations: GaussianApproximations, steps: int, seeds: Sequence[Sequence[int]], seed: int
) -> EnsembleDraws:
    """Sample posteriors that are close to `approximations`.

    `seeds` are the seeds of the posteriors; `seed` determines their common order of moves.
    """
    count, size = approximations.centers.shape
    shape = (count, ENSEMBLES, WALKERS)
    generators = [np.random.default_rng(entropy) for entropy in seeds]

    def flat_log_probs(points: np.ndarray) -> np.ndarray:
        return log_probs(points.reshape(count, -1, size)).ravel()

    moves = [Independence(shape, generators, approximations), Stretch(shape, generators)]
    sampler = emcee.EnsembleSampler(
        count * ENSEMBLES * WALKERS, size, flat_log_probs, moves=list(zip(moves, SHARES, strict=True)), vectorize=True
    )
    z = np.stack([draw_student_t(generator, ENSEMBLES * WALKERS, size) for generator in generators])
    start = approximations.from_standard_normal(OVERDISPERSION * z).reshape(-1, size)
    random = np.random.RandomState(np.random.SeedSequence(seed).generate_state(8))  # for the order of the moves
    state = emcee.State(start, random_state=random.get_state())
    sampler.run_mcmc(state, steps, skip_initial_state_check=True)
    points = sampler.get_chain().reshape(steps, *shape, size)
    return EnsembleDraws(np.moveaxis(points, 0, 2), sampler.backend.accepted.reshape(shape))


@dataclasses.dataclass(eq=False)
class _MultiPosteriorMove(emcee.moves.Move):
    """A move of the walkers of many posteriors, each with its own random numbers."""

    shape: tuple[int, int, int]
    generators: Generators

    def accept(
        self,
        model: emcee.model.Model,
        state: emcee.State,
        walker_mask: Bool[np.ndarray, "posteriors ensembles walkers"],
        proposed: Float[np.ndarray, "some n"],
        factors: Float[np.ndarray, " some"],
    ) -> tuple[emcee.State, np.ndarray]:
        """Apply the Metropolis-Hastings rule to `proposed` points of the masked walkers, equally many per posterior."""
        subset, accepted = walker_mask.ravel(), np.zeros(walker_mask.size, dtype=bool)
        values = model.log_prob_fn(proposed)  # emcee's `compute_log_prob_fn` loops over walkers
        uniform = np.concatenate([g.random(len(proposed) // len(self.generators)) for g in self.generators])
        with np.errstate(invalid="ignore"):  # both points are outside the support
            accepted[subset] = np.log(uniform) < factors + values - state.log_prob[subset]
        return self.update(state, emcee.State(proposed, log_prob=values), accepted, subset), accepted


@dataclasses.dataclass(eq=False)
class Independence(_MultiPosteriorMove):
    """Independence proposals from a Student-t approximation of each posterior."""

    approximations: GaussianApproximations

    def propose(self, model: emcee.model.Model, state: emcee.State) -> tuple[emcee.State, np.ndarray]:
        count, size = len(self.generators), state.coords.shape[1]
        here = self.approximations.to_standard_normal(state.coords.reshape(count, -1, size))
        there = np.stack([draw_student_t(generator, here.shape[1], size) for generator in self.generators])
        factors = student_log_density(here) - student_log_density(there)
        proposed = self.approximations.from_standard_normal(there).reshape(-1, size)
        return self.accept(model, state, np.ones(self.shape, dtype=bool), proposed, factors.ravel())


class Stretch(_MultiPosteriorMove):
    """Stretch move of Goodman and Weare within each ensemble, for alternate halves of the walkers.

    emcee's own move would pair walkers of different posteriors, and accepts in a loop over walkers.
    """

    def propose(self, model: emcee.model.Model, state: emcee.State) -> tuple[emcee.State, np.ndarray]:
        accepted = np.zeros(len(state.coords), dtype=bool)
        for half in (0, 1):
            walker_mask = np.broadcast_to(np.arange(self.shape[2]) % 2 == half, self.shape)
            points = state.coords.reshape(*self.shape, -1)
            here, others = points[:, :, half::2], points[:, :, 1 - half :: 2]
            partners = np.stack([g.integers(others.shape[2], size=here.shape[1:3]) for g in self.generators])
            uniform = np.stack([g.random(here.shape[1:3]) for g in self.generators])
            z = (uniform + 1.0) ** 2 / 2.0  # a = 2, as in Goodman and Weare
            anchors = np.take_along_axis(others, partners[..., None], axis=2)
            proposed = (anchors + (here - anchors) * z[..., None]).reshape(-1, points.shape[-1])
            factors = (points.shape[-1] - 1.0) * np.log(z).ravel()
            state, accepted_half = self.accept(model, state, walker_mask, proposed, factors)
            accepted |= accepted_half
        return state, accepted
