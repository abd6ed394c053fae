"""Posterior draws at a level of uncertainty; by emcee until converged: independent ensembles, checkpoints, resume."""

import contextlib
import dataclasses
import functools
import hashlib
import importlib.metadata
import json
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import emcee
import jax
import numpy as np
from jaxtyping import Float

from fitact.errors import InputError
from fitact.files import clean
from fitact.fitting.fit import Fit
from fitact.likelihood import certificate as compressed
from fitact.sampling import importance
from fitact.sampling.chain import Chain
from fitact.sampling.convergence import Convergence, judge_chain
from fitact.sampling.posterior import Posterior
from fitact.sampling.progress import Reporter
from fitact.sampling.proposal import OVERDISPERSION, SHARES, LogProb, Proposal

Level = Literal["emcee", "psis", "laplace"]

_LOOK = 100  # steps; the chain is judged at multiples of it,
_GROWTH = 1.1  # ever further apart, so that judging never outweighs sampling
_ROUND = (1.0, 4.0)  # seconds that the ensembles take turns for
_CHECKPOINT = 2.0  # seconds between checkpoints, at least,
_SHARE = 20.0  # and so many times what writing one takes
FOLLOWED = 4  # walkers per ensemble whose derived quantities are looked at


def sample(
    fit: Fit,
    *,
    level: Level = "emcee",
    seed: int = 0,
    walkers: int | None = None,
    ensembles: int = 4,
    max_steps: int = 20_000,
    chain_file: str | os.PathLike[str] | None = None,
    progress: bool = True,
) -> Posterior:
    """Draw from the posterior around `fit`, and judge the draws.

    Coordinates are the log-parameters of the fit and log sigma. The levels, fastest first:

    - "laplace": independent draws from the fit's normal approximation. Importance weights say what it is off by;
      refused above a tenth of a standard deviation.
    - "psis": draws from a Student-t over the fit, importance-weighted (Pareto-smoothed), resampled systematically
      to equal weights. Refused where Pareto's k-hat is above 0.7.
    - "emcee": sampled until converged. Seven moves in ten propose from that Student-t, three are stretch moves,
      which keep the mixture safe where the shape is another. Converged: each ensemble is longer than 50
      autocorrelation times, split-R-hat over the ensembles is below 1.01, in every coordinate and in g, b and the
      mean force, and no walker is stuck.

    Along what a bounded prior limits, the density itself is tabulated and takes the Student-t's place.

    Args:
        fit: from `fitact.fit`.
        level: of uncertainty; those below concern "emcee" alone.
        seed: the same seed gives the same draws, whether or not sampling was interrupted.
        walkers: per ensemble; even, at least twice the parameters. None: 128, or 64 where samples are summed.
        ensembles: independent ones, at least two.
        max_steps: per ensemble, after which the answer is marked as not converged.
        chain_file: where to keep the chain (HDF5, emcee's layout); if it exists, sampling goes on from it.
        progress: report on standard error.

    Ctrl-C ends sampling with what there is, marked as not converged.

    Raises:
        InputError: the chain file belongs to another record, scene or seed; the fit was made without its prior, or
            the prior forbids every start.
    """
    if level not in get_args(Level):
        raise InputError(f"level = {level!r}: choose one of {', '.join(get_args(Level))}")
    if not fit.likelihood.believed:
        raise InputError("a fit with prior=False has no posterior to draw from; fit with the prior, then sample")
    size = len(fit.point_names)
    if walkers is None:  # a few numbers cost less than a step of emcee's, whose own time hardly grows with walkers
        walkers = max(128 if fit.likelihood.rows <= compressed.FEW_ROWS else 64, 2 * size)
    if walkers % 2 or walkers < 2 * size or ensembles < 2:
        raise InputError(f"walkers = {walkers}, ensembles = {ensembles}: at least {2 * size}, even; and at least 2")
    began = time.perf_counter()
    with jax.enable_x64(True):
        log_prob = finite(compressed.log_prob(fit.likelihood, walkers))
        if level != "emcee":
            posterior = importance.draw(fit, level, log_prob, seed)
            judged = dataclasses.replace(posterior.convergence, seconds=time.perf_counter() - began)
            return dataclasses.replace(posterior, convergence=judged)
        target = Target(
            fit.point_names,
            log_prob,
            Proposal.around(fit.point, fit.point_root, log_prob),
            functools.partial(importance.followed, fit),
            _fingerprint(fit, seed, walkers, ensembles),
        )
        path = None if chain_file is None else Path(chain_file)
        chain, convergence = run(target, seed, walkers, ensembles, max_steps, path, progress)
        return Posterior.from_chain(fit, chain, convergence, seed)


class Target(NamedTuple):
    """What ensembles sample.

    Attributes:
        names: of the coordinates.
        log_prob: of points, finite or -inf.
        proposal: near to it.
        follow: quantities to be judged beside the coordinates, of points (ensembles, draws, n), with a seed.
        fingerprint: what a chain belongs to; "" where none is kept.
    """

    names: tuple[str, ...]
    log_prob: LogProb
    proposal: Proposal
    follow: Callable[[Float[np.ndarray, "ensembles draws n"], int], dict[str, np.ndarray]]
    fingerprint: str = ""


def run(
    target: Target, seed: int, walkers: int, ensembles: int, max_steps: int, path: Path | None, progress: bool
) -> tuple[Chain, Convergence]:
    """Sample until converged; arguments as in `sample`. Call it in double precision."""
    sampled = _Run.start(target, seed, walkers, ensembles, path)
    convergence = sampled.until_converged(max_steps, Reporter(progress))
    return sampled.chain, convergence


def moves(proposal: Proposal) -> list[tuple[emcee.moves.Move, float]]:
    """What emcee's walkers do, and how often."""
    return list(zip((emcee.moves.MHMove(proposal.move), emcee.moves.StretchMove()), SHARES, strict=True))


def finite(log_prob: LogProb) -> LogProb:
    """What is not finite is impossible: emcee would end at NaN, and a walker stick at +inf."""

    def values(points: np.ndarray) -> np.ndarray:
        found = log_prob(points)
        return np.where(np.isfinite(found), found, -np.inf)

    return values


@dataclasses.dataclass
class _Run:
    """The ensembles of one posterior."""

    target: Target
    chain: Chain
    samplers: list[emcee.EnsembleSampler]
    path: Path | None
    began: float = dataclasses.field(default_factory=time.perf_counter)
    pace: int = 1  # steps that the ensembles take in turn
    saved: float = 0.0  # when
    writing: float = 0.0  # seconds that it took
    derived: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)

    @classmethod
    def start(cls, target: Target, seed: int, walkers: int, ensembles: int, path: Path | None) -> "_Run":
        """From the chain file where there is one, else from a wider proposal."""
        began = time.perf_counter()
        names, log_prob, proposal = target.names, target.log_prob, target.proposal
        samplers = [
            emcee.EnsembleSampler(walkers, len(names), log_prob, moves=moves(proposal), vectorize=True)
            for _ in range(ensembles)
        ]
        if path is not None:
            clean(path)
        if path is not None and path.exists():
            return cls(target, Chain.load(path, target.fingerprint), samplers, path, began)
        states = []
        for child in np.random.SeedSequence(seed).spawn(ensembles):
            random = np.random.RandomState(child.generate_state(8))
            points, values = _starts(proposal.widened(OVERDISPERSION), log_prob, walkers, random)
            states.append(emcee.State(points, log_prob=values, random_state=random.get_state()))
        return cls(target, Chain.empty(names, target.fingerprint, states), samplers, path, began)

    def until_converged(self, max_steps: int, report: Reporter) -> Convergence:
        """Sample, judge and save in turn."""
        convergence = self.judge() if self._is_look() or self.chain.steps >= max_steps else Convergence()
        with _interrupts_between_steps() as check:
            try:
                while not convergence.converged and self.chain.steps < max_steps:
                    goal = min(_next_look(self.chain.steps), max_steps)
                    while self.chain.steps < goal:
                        self.advance(min(self.pace, goal - self.chain.steps), check)
                        report(self.chain.steps, convergence)
                    convergence = self.judge()
                    report(self.chain.steps, convergence)
                    check()
            except KeyboardInterrupt:
                if self.chain.steps == 0:
                    raise
                convergence = dataclasses.replace(self.judge(), converged=False, interrupted=True)
            finally:
                report.close()
                self.save()
        return convergence

    def _is_look(self) -> bool:
        return self.chain.steps == _next_look(self.chain.steps - 1)

    def advance(self, steps: int, check: Callable[[], None]) -> None:
        """Take `steps` with every ensemble, calling `check` after each; where it raises, nothing has changed."""
        began, done = time.perf_counter(), []
        for sampler, last in zip(self.samplers, self.chain.states, strict=True):
            sampler.reset()
            for _ in sampler.sample(last, iterations=steps, skip_initial_state_check=True):
                check()
            state = sampler.get_last_sample()
            done.append((sampler.get_chain(), sampler.get_log_prob(), state, sampler.backend.accepted))
        self.chain.extend(done)
        took = time.perf_counter() - began
        if took < _ROUND[0]:
            self.pace = min(2 * self.pace, _LOOK)
        elif took > _ROUND[1]:
            self.pace = max(self.pace // 2, 1)
        if time.perf_counter() - self.saved > max(_CHECKPOINT, _SHARE * self.writing):
            self.save()

    def save(self) -> None:
        """Checkpoint, where there is a file for it."""
        now = time.perf_counter()
        self.chain.seconds, self.began = self.chain.seconds + now - self.began, now
        if self.path is not None and self.chain.steps:
            self.chain.save(self.path)
            self.saved = time.perf_counter()
            self.writing = self.saved - now

    def judge(self) -> Convergence:
        """How far the chain can be trusted so far."""
        chain = self.chain
        self._follow()
        judged = judge_chain(chain.names, chain.points, chain.accepted, self.derived)
        return dataclasses.replace(judged, seconds=chain.seconds + time.perf_counter() - self.began)

    def _follow(self) -> None:
        """Derived quantities of some walkers, for the steps that lack them."""
        known = next(iter(self.derived.values())).shape[1] if self.derived else 0
        fresh = self.chain.points[:, known:, :FOLLOWED]
        if not fresh.size:
            return
        ensembles, steps, followed, size = fresh.shape
        found = self.target.follow(fresh.reshape(ensembles, -1, size), known)
        for name, values in found.items():
            values = values.reshape(ensembles, steps, followed)
            self.derived[name] = np.concatenate([self.derived[name], values], axis=1) if known else values


def _next_look(steps: int) -> int:
    """When to judge next: depends on the steps alone, so that a resumed chain ends where an undisturbed one does."""
    look = _LOOK
    while look <= steps:
        look = int(np.ceil(_GROWTH * look / _LOOK)) * _LOOK
    return look


@contextlib.contextmanager
def _interrupts_between_steps() -> Iterator[Callable[[], None]]:
    """Hold Ctrl-C back until the function it gives is called, or until it comes a second time.

    Inside a step emcee prints a traceback for any error, and Python drops what is raised in a weak reference's
    callback, of which JAX has many.
    """
    pending: list[int] = []

    def check() -> None:
        if pending:
            pending.clear()
            raise KeyboardInterrupt

    def hold(number: int, _: object) -> None:
        check()
        pending.append(number)

    if threading.current_thread() is not threading.main_thread():
        yield check
        return
    before = signal.signal(signal.SIGINT, hold)
    try:
        yield check
    finally:
        signal.signal(signal.SIGINT, before)
        if pending:
            signal.raise_signal(signal.SIGINT)


def _starts(
    proposal: Proposal, log_prob: LogProb, walkers: int, random: np.random.RandomState
) -> tuple[np.ndarray, np.ndarray]:
    """Draws that the posterior allows, with their log-probabilities."""
    found: list[np.ndarray] = []
    values: list[np.ndarray] = []
    for _ in range(100):
        points = proposal.draw(random, walkers)
        value = log_prob(points)
        possible = np.isfinite(value)
        found.append(points[possible])
        values.append(value[possible])
        if sum(map(len, found)) >= walkers:
            return np.concatenate(found)[:walkers], np.concatenate(values)[:walkers]
    raise InputError(
        "scene: [prior] leaves no room where the record puts the parameters: its bounds exclude the record's"
        " g and b, or nearly so; widen them, or check the record's units"
    )


def _fingerprint(fit: Fit, seed: int, walkers: int, ensembles: int) -> str:
    """What a chain belongs to; any change of it makes another chain."""
    settings = [
        [record.fingerprint for record in fit.records],
        fit.scene.to_json(),
        [trace.choice.name for trace in fit.traces],
        fit.likelihood.rows,
        fit.point_names,
        fit.theta.tolist(),
        seed,
        walkers,
        ensembles,
    ]
    return hashlib.sha256(json.dumps([importlib.metadata.version("fitact"), *settings]).encode()).hexdigest()
