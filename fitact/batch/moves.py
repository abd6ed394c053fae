"""Ensembles of many posteriors side by side in one run of emcee; moves and random numbers never mix them.

All posteriors have the same number of coordinates and are near normal. emcee knows their walkers flattened, in the
order (posteriors, ensembles, walkers). Each posterior's random numbers come from a seed of its own, so that its draws
do not depend on what stands beside it.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Self

import emcee
import numpy as np
from jaxtyping import Bool, Float

from fitact.sampling.proposal import OVERDISPERSION, SHARES, student, student_log_density

ENSEMBLES = 4
WALKERS = 16  # of each ensemble: posteriors side by side keep emcee busy, few walkers make steps cheap
_STRETCH = 2.0  # Goodman and Weare's a

# of points (posteriors, any, n), not NaN
LogProbs = Callable[[Float[np.ndarray, "posteriors any n"]], Float[np.ndarray, "posteriors any"]]
Generators = Sequence[np.random.Generator]


class Ensembles(NamedTuple):
    """What was drawn: points, and which moves were accepted."""

    points: Float[np.ndarray, "posteriors ensembles steps walkers n"]
    accepted: Float[np.ndarray, "posteriors ensembles walkers"]


class Normals(NamedTuple):
    """Normal approximations: centers, and roots of their covariances."""

    centers: Float[np.ndarray, "posteriors n"]
    roots: Float[np.ndarray, "posteriors n n"]

    @classmethod
    def of(cls, centers: np.ndarray, roots: np.ndarray) -> Self:
        """With roots whose columns are principal axes, a standard deviation long."""
        vectors, lengths, _ = np.linalg.svd(roots)
        return cls(centers, vectors * lengths[:, None])

    def placed(self, white: Float[np.ndarray, "posteriors any n"]) -> Float[np.ndarray, "posteriors any n"]:
        """Points that so many standard deviations along the axes lead to."""
        return self.centers[:, None] + white @ np.swapaxes(self.roots, 1, 2)

    def whitened(self, points: Float[np.ndarray, "posteriors any n"]) -> Float[np.ndarray, "posteriors any n"]:
        """The inverse of `placed`."""
        return (points - self.centers[:, None]) @ np.swapaxes(np.linalg.inv(self.roots), 1, 2)

    def refined(self, values: Float[np.ndarray, "posteriors n probes"]) -> Self:
        """With centers and lengths by parabolas through log-densities at `PROBES` of each axis, if there are any."""
        below, middle, above = np.moveaxis(values[..., 1:4], -1, 0)
        with np.errstate(invalid="ignore"):  # an impossible place
            curved = 2.0 * middle - below - above
            step = 0.5 * (above - below) / curved
            sound = (curved > 0.25) & (curved < 4.0) & (np.abs(step) < 1.0)
        step, length = np.where(sound, step, 0.0), np.where(sound, curved, 1.0) ** -0.5
        return type(self)(self.placed(step[:, None])[:, 0], self.roots * length[:, None])


def run(log_probs: LogProbs, near: Normals, steps: int, seeds: Sequence[Sequence[int]], seed: int) -> Ensembles:
    """Sample posteriors that are close to `near`.

    `seeds`: of each posterior's random numbers; `seed`: of the order of the moves, which they share.
    """
    count, size = near.centers.shape
    shape = (count, ENSEMBLES, WALKERS)
    generators = [np.random.default_rng(each) for each in seeds]

    def flat(points: np.ndarray) -> np.ndarray:
        return log_probs(points.reshape(count, -1, size)).ravel()

    moves = [Independence(shape, generators, near), Stretch(shape, generators)]
    sampler = emcee.EnsembleSampler(
        count * ENSEMBLES * WALKERS, size, flat, moves=list(zip(moves, SHARES, strict=True)), vectorize=True
    )
    white = np.stack([student(generator, ENSEMBLES * WALKERS, size) for generator in generators])
    start = near.placed(OVERDISPERSION * white).reshape(-1, size)
    state = emcee.State(start, random_state=_order(seed))
    sampler.run_mcmc(state, steps, skip_initial_state_check=True)
    points = sampler.get_chain().reshape(steps, *shape, size)
    return Ensembles(np.moveaxis(points, 0, 2), sampler.backend.accepted.reshape(shape))


def _order(seed: int) -> Any:
    """Of the moves."""
    return np.random.RandomState(np.random.SeedSequence(seed).generate_state(8)).get_state()


class _Apart(emcee.moves.Move):
    """A move of the walkers of many posteriors, each with random numbers of its own."""

    def __init__(self, shape: tuple[int, int, int], generators: Generators) -> None:
        self.shape, self.generators = shape, generators

    def accept(
        self,
        model: emcee.model.Model,
        state: emcee.State,
        moved: Bool[np.ndarray, "posteriors ensembles walkers"],
        proposed: Float[np.ndarray, "some n"],
        factors: Float[np.ndarray, " some"],
    ) -> tuple[emcee.State, np.ndarray]:
        """Metropolis and Hastings; of proposals for the walkers that are `moved`, as many of each posterior."""
        subset, accepted = moved.ravel(), np.zeros(moved.size, dtype=bool)
        values = model.log_prob_fn(proposed)  # emcee's own `compute_log_prob_fn` loops over walkers
        chances = np.concatenate([g.random(len(proposed) // len(self.generators)) for g in self.generators])
        with np.errstate(invalid="ignore"):  # from one impossible place to another
            accepted[subset] = np.log(chances) < factors + values - state.log_prob[subset]
        return self.update(state, emcee.State(proposed, log_prob=values), accepted, subset), accepted


class Independence(_Apart):
    """Proposals from each posterior's own Student-t, wherever the walker is."""

    def __init__(self, shape: tuple[int, int, int], generators: Generators, near: Normals) -> None:
        super().__init__(shape, generators)
        self.near = near

    def propose(self, model: emcee.model.Model, state: emcee.State) -> tuple[emcee.State, np.ndarray]:
        count, size = len(self.generators), state.coords.shape[1]
        here = self.near.whitened(state.coords.reshape(count, -1, size))
        there = np.stack([student(generator, here.shape[1], size) for generator in self.generators])
        factors = student_log_density(here) - student_log_density(there)
        proposed = self.near.placed(there).reshape(-1, size)
        return self.accept(model, state, np.ones(self.shape, dtype=bool), proposed, factors.ravel())


class Stretch(_Apart):
    """Goodman and Weare's stretch move within each ensemble, every other walker in turn.

    emcee's own would pair walkers of different posteriors, and accepts in a loop over walkers.
    """

    def propose(self, model: emcee.model.Model, state: emcee.State) -> tuple[emcee.State, np.ndarray]:
        accepted = np.zeros(len(state.coords), dtype=bool)
        for half in (0, 1):
            moved = np.broadcast_to(np.arange(self.shape[2]) % 2 == half, self.shape)
            points = state.coords.reshape(*self.shape, -1)
            here, others = points[:, :, half::2], points[:, :, 1 - half :: 2]
            partners = np.stack([g.integers(others.shape[2], size=here.shape[1:3]) for g in self.generators])
            chances = np.stack([g.random(here.shape[1:3]) for g in self.generators])
            z = ((_STRETCH - 1.0) * chances + 1.0) ** 2 / _STRETCH
            fixed = np.take_along_axis(others, partners[..., None], axis=2)
            proposed = (fixed + (here - fixed) * z[..., None]).reshape(-1, points.shape[-1])
            factors = (points.shape[-1] - 1.0) * np.log(z).ravel()
            state, taken = self.accept(model, state, moved, proposed, factors)
            accepted |= taken
        return state, accepted
