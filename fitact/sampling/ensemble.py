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
from fitact.files import remove_temporary
from fitact.fitting.fit import Fit
from fitact.likelihood import certificate
from fitact.sampling import importance
from fitact.sampling.chain import Chain
from fitact.sampling.convergence import Convergence, diagnose_chain
from fitact.sampling.posterior import Posterior
from fitact.sampling.progress import Reporter
from fitact.sampling.proposal import OVERDISPERSION, SHARES, LogProb, Proposal

Level = Literal["emcee", "psis", "laplace"]

TRACKED_WALKERS = 4  # walkers per ensemble whose derived quantities are looked at


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
    if not fit.likelihood.use_prior:
        raise InputError("a fit with prior=False has no posterior to draw from; fit with the prior, then sample")
    size = len(fit.point_names)
    if walkers is None:  # a few numbers cost less than a step of emcee's, whose own time hardly grows with walkers
        walkers = max(128 if fit.likelihood.rows <= certificate.FEW_ROWS else 64, 2 * size)
    if walkers % 2 or walkers < 2 * size or ensembles < 2:
        raise InputError(f"walkers = {walkers}, ensembles = {ensembles}: at least {2 * size}, even; and at least 2")
    start_time = time.perf_counter()
    with jax.enable_x64(True):
        log_prob = reject_nonfinite(certificate.batched_log_prob(fit.likelihood, walkers))
        if level != "emcee":
            posterior = importance.draw_around_fit(fit, level, log_prob, seed)
            timed = dataclasses.replace(posterior.convergence, seconds=time.perf_counter() - start_time)
            return dataclasses.replace(posterior, convergence=timed)
        proposal = Proposal.from_laplace(fit.point, fit.point_root, log_prob)
        track = functools.partial(importance.tracked_quantities, fit)
        target = Target(fit.point_names, log_prob, proposal, track, _fingerprint(fit, seed, walkers, ensembles))
        path = None if chain_file is None else Path(chain_file)
        chain, convergence = run_ensembles(target, seed, walkers, ensembles, max_steps, path, progress)
        return Posterior.from_chain(fit, chain, convergence, seed)


class Target(NamedTuple):
    """What ensembles sample."""

    names: tuple[str, ...]  # of the coordinates
    log_prob: LogProb  # of points, finite or -inf
    proposal: Proposal  # near to it
    # quantities to be judged beside the coordinates, of points (ensembles, draws, n), with a seed
    track: Callable[[Float[np.ndarray, "ensembles draws n"], int], dict[str, np.ndarray]]
    fingerprint: str = ""  # what a chain belongs to; "" where none is kept


def run_ensembles(
    target: Target, seed: int, walkers: int, ensembles: int, max_steps: int, path: Path | None, progress: bool
) -> tuple[Chain, Convergence]:
    """Sample until converged; arguments as in `sample`. Call it in double precision."""
    run = _Run.start_or_resume(target, seed, walkers, ensembles, path)
    convergence = run.sample_until_converged(max_steps, Reporter(progress))
    return run.chain, convergence


def make_moves(proposal: Proposal) -> list[tuple[emcee.moves.Move, float]]:
    """What emcee's walkers do, and how often."""
    return list(zip((emcee.moves.MHMove(proposal.move), emcee.moves.StretchMove()), SHARES, strict=True))


def reject_nonfinite(log_prob: LogProb) -> LogProb:
    """Make what is not finite impossible: emcee would end at NaN, and a walker stick at +inf."""

    def finite_log_prob(points: np.ndarray) -> np.ndarray:
        values = log_prob(points)
        return np.where(np.isfinite(values), values, -np.inf)

    return finite_log_prob


@dataclasses.dataclass
class _Run:
    """The ensembles of one posterior, which take their steps in turn."""

    target: Target
    chain: Chain
    samplers: list[emcee.EnsembleSampler]
    path: Path | None
    start_time: float
    turn_seconds: tuple[float, float] = (1.0, 4.0)  # that all turns together take, or else their steps are changed
    checkpoint_seconds: float = 2.0  # between checkpoints, at least,
    checkpoint_ratio: float = 20.0  # and so many times what writing one takes
    steps_per_turn: int = 1
    save_time: float = 0.0  # when the last checkpoint was written
    save_seconds: float = 0.0  # that it took
    derived: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)

    @classmethod
    def start_or_resume(cls, target: Target, seed: int, walkers: int, ensembles: int, path: Path | None) -> "_Run":
        """Go on from the chain file where there is one, else begin at draws of a wider proposal."""
        start_time = time.perf_counter()
        names, log_prob, proposal = target.names, target.log_prob, target.proposal
        samplers = [
            emcee.EnsembleSampler(walkers, len(names), log_prob, moves=make_moves(proposal), vectorize=True)
            for _ in range(ensembles)
        ]
        if path is not None:
            remove_temporary(path)
            if path.exists():
                return cls(target, Chain.load(path, target.fingerprint), samplers, path, start_time)
        states = []
        for child in np.random.SeedSequence(seed).spawn(ensembles):
            random = np.random.RandomState(child.generate_state(8))
            points, values = _draw_starting_points(proposal.scale_width(OVERDISPERSION), log_prob, walkers, random)
            states.append(emcee.State(points, log_prob=values, random_state=random.get_state()))
        return cls(target, Chain.empty(names, target.fingerprint, states), samplers, path, start_time)

    def sample_until_converged(self, max_steps: int, report: Reporter) -> Convergence:
        """Sample, judge and save in turn."""
        steps = self.chain.steps
        is_due = steps == _next_diagnostic_step(steps - 1) or steps >= max_steps
        convergence = self.judge() if is_due else Convergence()
        with _defer_interrupts() as check:
            try:
                while not convergence.converged and self.chain.steps < max_steps:
                    goal = min(_next_diagnostic_step(self.chain.steps), max_steps)
                    while self.chain.steps < goal:
                        self.advance(min(self.steps_per_turn, goal - self.chain.steps), check)
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

    def advance(self, steps: int, check: Callable[[], None]) -> None:
        """Take `steps` with every ensemble, calling `check` after each; where it raises, nothing has changed."""
        start_time, new_steps = time.perf_counter(), []
        for sampler, last in zip(self.samplers, self.chain.states, strict=True):
            sampler.reset()
            for _ in sampler.sample(last, iterations=steps, skip_initial_state_check=True):
                check()
            state = sampler.get_last_sample()
            new_steps.append((sampler.get_chain(), sampler.get_log_prob(), state, sampler.backend.accepted))
        self.chain.extend(new_steps)
        seconds = time.perf_counter() - start_time
        if seconds < self.turn_seconds[0]:
            self.steps_per_turn = min(2 * self.steps_per_turn, 100)  # the least between two looks
        elif seconds > self.turn_seconds[1]:
            self.steps_per_turn = max(self.steps_per_turn // 2, 1)
        pause = max(self.checkpoint_seconds, self.checkpoint_ratio * self.save_seconds)
        if time.perf_counter() - self.save_time > pause:
            self.save()

    def save(self) -> None:
        """Checkpoint, where there is a file for it."""
        now = time.perf_counter()
        self.chain.seconds, self.start_time = self.chain.seconds + now - self.start_time, now
        if self.path is not None and self.chain.steps:
            self.chain.save(self.path)
            self.save_time = time.perf_counter()
            self.save_seconds = self.save_time - now

    def judge(self) -> Convergence:
        """How far the chain can be trusted so far."""
        chain = self.chain
        self._update_tracked()
        convergence = diagnose_chain(chain.names, chain.points, chain.accepted, self.derived)
        return dataclasses.replace(convergence, seconds=chain.seconds + time.perf_counter() - self.start_time)

    def _update_tracked(self) -> None:
        """Derived quantities of some walkers, for the steps that lack them."""
        known = next(iter(self.derived.values())).shape[1] if self.derived else 0
        points = self.chain.points[:, known:, :TRACKED_WALKERS]
        if not points.size:
            return
        ensembles, *_, size = points.shape
        for name, values in self.target.track(points.reshape(ensembles, -1, size), known).items():
            values = values.reshape(points.shape[:-1])
            self.derived[name] = np.concatenate([self.derived[name], values], axis=1) if known else values


def _next_diagnostic_step(steps: int, interval: int = 100, growth: float = 1.1) -> int:
    """Return when to judge next: multiples of `interval`, ever further apart, so that sampling outweighs judging.

    It depends on the steps alone, so that a resumed chain ends where an undisturbed one does.
    """
    look = interval
    while look <= steps:
        look = int(np.ceil(growth * look / interval)) * interval
    return look


@contextlib.contextmanager
def _defer_interrupts() -> Iterator[Callable[[], None]]:
    """Hold Ctrl-C back until the function it gives is called, or until it comes a second time.

    Inside a step emcee prints a traceback for any error, and Python drops what is raised in a weak reference's
    callback, of which JAX has many.
    """
    pending: list[int] = []

    def check() -> None:
        if pending:
            pending.clear()
            raise KeyboardInterrupt

    def defer(number: int, _: object) -> None:
        check()
        pending.append(number)

    if threading.current_thread() is not threading.main_thread():
        yield check
        return
    before = signal.signal(signal.SIGINT, defer)
    try:
        yield check
    finally:
        signal.signal(signal.SIGINT, before)
        if pending:
            signal.raise_signal(signal.SIGINT)


def _draw_starting_points(
    proposal: Proposal, log_prob: LogProb, walkers: int, random: np.random.RandomState
) -> tuple[np.ndarray, np.ndarray]:
    """Draw what the posterior allows, with its log-probability."""
    points, values = np.empty((0, proposal.center.size)), np.empty(0)
    for _ in range(100):
        drawn = proposal.draw(random, walkers)
        log_probs = log_prob(drawn)
        possible = np.isfinite(log_probs)
        points, values = np.append(points, drawn[possible], axis=0), np.append(values, log_probs[possible])
        if len(points) >= walkers:
            return points[:walkers], values[:walkers]
    raise InputError(
        "scene: [prior] leaves no room where the record puts the parameters: its bounds exclude the record's"
        " g and b, or nearly so; widen them, or check the record's units"
    )


def _fingerprint(fit: Fit, seed: int, walkers: int, ensembles: int) -> str:
    """What a chain belongs to; any change of it makes another chain."""
    inputs = [[record.fingerprint for record in fit.records], fit.scene.to_json(), [t.choice.name for t in fit.traces]]
    settings = [fit.likelihood.rows, fit.point_names, fit.theta.tolist(), seed, walkers, ensembles]
    return hashlib.sha256(json.dumps([importlib.metadata.version("fitact"), *inputs, *settings]).encode()).hexdigest()
