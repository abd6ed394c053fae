"""Ensembles of many posteriors side by side in one run of emcee; moves and random numbers never mix them.

All posteriors have the same number of coordinates and are near normal. emcee knows their walkers flattened, in the
order (posteriors, ensembles, walkers). Each posterior's random numbers come from a seed of its own, so that its draws
do not depend on what stands beside it.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple, Self

import emcee
import numpy as np
from jaxtyping import Bool, Float

from fitact.sampling.proposal import OVERDISPERSION, SHARES, draw_student_t, principal_axes, student_log_density

ENSEMBLES = 4
WALKERS = 16  # of each ensemble: posteriors side by side keep emcee busy, few walkers make steps cheap

# of points (posteriors, any, n), not NaN
LogProbs = Callable[[Float[np.ndarray, "posteriors any n"]], Float[np.ndarray, "posteriors any"]]
Generators = Sequence[np.random.Generator]


class EnsembleDraws(NamedTuple):
    """Points that were drawn, and which moves were accepted."""

    points: Float[np.ndarray, "posteriors ensembles steps walkers n"]
    accepted: Float[np.ndarray, "posteriors ensembles walkers"]


class GaussianApproximations(NamedTuple):
    """Normal approximations: centers, and roots of their covariances."""

    centers: Float[np.ndarray, "posteriors n"]
    covariance_factors: Float[np.ndarray, "posteriors n n"]

    @classmethod
    def from_covariance_factors(cls, centers: np.ndarray, covariance_factors: np.ndarray) -> Self:
        """Take roots whose columns are principal axes, a standard deviation long."""
        return cls(centers, principal_axes(covariance_factors))

    def from_standard_normal(self, z: Float[np.ndarray, "posteriors any n"]) -> Float[np.ndarray, "posteriors any n"]:
        return self.centers[:, None] + z @ np.swapaxes(self.covariance_factors, 1, 2)

    def to_standard_normal(
        self, points: Float[np.ndarray, "posteriors any n"]
    ) -> Float[np.ndarray, "posteriors any n"]:
        return (points - self.centers[:, None]) @ np.swapaxes(np.linalg.inv(self.covariance_factors), 1, 2)

    def refine(self, values: Float[np.ndarray, "posteriors n probes"]) -> Self:
        """Correct centers and lengths by parabolas through log-densities at `PROBES` of each axis, if there are any."""
        below, middle, above = np.moveaxis(values[..., 1:4], -1, 0)
        with np.errstate(invalid="ignore"):  # an impossible place
            curvature = 2.0 * middle - below - above
            step = 0.5 * (above - below) / curvature
            is_peak = (curvature > 0.25) & (curvature < 4.0) & (np.abs(step) < 1.0)
        step, length = np.where(is_peak, step, 0.0), np.where(is_peak, curvature, 1.0) ** -0.5
        return type(self)(self.from_standard_normal(step[:, None])[:, 0], self.covariance_factors * length[:, None])


def sample_posteriors(
    log_probs: LogProbs, approximations: GaussianApproximations, steps: int, seeds: Sequence[Sequence[int]], seed: int
) -> EnsembleDraws:
    """Sample posteriors that are close to `approximations`.

    `seeds`: of each posterior's random numbers; `seed`: of the order of the moves, which they share.
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
    white = np.stack([draw_student_t(generator, ENSEMBLES * WALKERS, size) for generator in generators])
    start = approximations.from_standard_normal(OVERDISPERSION * white).reshape(-1, size)
    random = np.random.RandomState(np.random.SeedSequence(seed).generate_state(8))  # of the moves' order
    state = emcee.State(start, random_state=random.get_state())
    sampler.run_mcmc(state, steps, skip_initial_state_check=True)
    points = sampler.get_chain().reshape(steps, *shape, size)
    return EnsembleDraws(np.moveaxis(points, 0, 2), sampler.backend.accepted.reshape(shape))


@dataclasses.dataclass(eq=False)
class _MultiPosteriorMove(emcee.moves.Move):
    """A move of the walkers of many posteriors, each with random numbers of its own."""

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
        """Accept by Metropolis and Hastings; `proposed` are for the walkers of the mask, as many of each posterior."""
        subset, accepted = walker_mask.ravel(), np.zeros(walker_mask.size, dtype=bool)
        values = model.log_prob_fn(proposed)  # emcee's own `compute_log_prob_fn` loops over walkers
        uniform = np.concatenate([g.random(len(proposed) // len(self.generators)) for g in self.generators])
        with np.errstate(invalid="ignore"):  # from one impossible place to another
            accepted[subset] = np.log(uniform) < factors + values - state.log_prob[subset]
        return self.update(state, emcee.State(proposed, log_prob=values), accepted, subset), accepted


@dataclasses.dataclass(eq=False)
class Independence(_MultiPosteriorMove):
    """Proposals from each posterior's own Student-t, wherever the walker is."""

    approximations: GaussianApproximations

    def propose(self, model: emcee.model.Model, state: emcee.State) -> tuple[emcee.State, np.ndarray]:
        count, size = len(self.generators), state.coords.shape[1]
        here = self.approximations.to_standard_normal(state.coords.reshape(count, -1, size))
        there = np.stack([draw_student_t(generator, here.shape[1], size) for generator in self.generators])
        factors = student_log_density(here) - student_log_density(there)
        proposed = self.approximations.from_standard_normal(there).reshape(-1, size)
        return self.accept(model, state, np.ones(self.shape, dtype=bool), proposed, factors.ravel())


class Stretch(_MultiPosteriorMove):
    """Goodman and Weare's stretch move within each ensemble, every other walker in turn.

    emcee's own would pair walkers of different posteriors, and accepts in a loop over walkers.
    """

    def propose(self, model: emcee.model.Model, state: emcee.State) -> tuple[emcee.State, np.ndarray]:
        accepted = np.zeros(len(state.coords), dtype=bool)
        for half in (0, 1):
            walker_mask = np.broadcast_to(np.arange(self.shape[2]) % 2 == half, self.shape)
            points = state.coords.reshape(*self.shape, -1)
            here, others = points[:, :, half::2], points[:, :, 1 - half :: 2]
            partners = np.stack([g.integers(others.shape[2], size=here.shape[1:3]) for g in self.generators])
            uniform = np.stack([g.random(here.shape[1:3]) for g in self.generators])
            z = (uniform + 1.0) ** 2 / 2.0  # with Goodman and Weare's a = 2
            anchors = np.take_along_axis(others, partners[..., None], axis=2)
            proposed = (anchors + (here - anchors) * z[..., None]).reshape(-1, points.shape[-1])
            factors = (points.shape[-1] - 1.0) * np.log(z).ravel()
            state, accepted_half = self.accept(model, state, walker_mask, proposed, factors)
            accepted |= accepted_half
        return state, accepted
