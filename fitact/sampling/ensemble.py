"""Sampling of the posterior: independent emcee ensembles with checkpoints, run until they have converged."""

import contextlib
import dataclasses
import functools
import hashlib
import importlib.metadata
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import emcee
import numpy as np
from jaxtyping import Float

from fitact.blas import limit_to_one_thread
from fitact.compiled import double_precision
from fitact.errors import InputError
from fitact.files import remove_temporary
from fitact.fitting.result import Fit
from fitact.likelihood import certificate
from fitact.progress import open_bar
from fitact.sampling import importance
from fitact.sampling.chain import Chain
from fitact.sampling.convergence import Convergence, diagnose_chain
from fitact.sampling.posterior import Posterior
from fitact.sampling.proposal import OVERDISPERSION, Proposal
from fitact.sampling.ridge import LogDensity

Level = Literal["emcee", "psis", "laplace"]

TRACKED_WALKERS = 4  # walkers of each ensemble whose derived quantities are diagnosed


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
    """Draw from the posterior around `fit`, and diagnose the draws.

    The coordinates are the log-parameters of the fit and log sigma. The methods, fastest first:

    - "laplace": independent draws from the Gaussian approximation of the fit. Importance weights estimate its error;
      it is refused above a tenth of a standard deviation.
    - "psis": draws from a Student-t around the fit, with Pareto-smoothed importance weights, resampled systematically
      to equal weights. It is refused where Pareto k-hat is above 0.7.
    - "emcee": MCMC, run until converged. Most moves (85 %) propose from the same Student-t. The others are
      stretch moves, which sample posteriors of any other shape. The chain has converged when each ensemble is longer
      than 50 autocorrelation times and split-R-hat over the ensembles is below 1.01, for every coordinate, g, b and
      the mean force, and no walker is stuck.

    Where the posterior is curved, the Student-t is bent along its ridge. Along directions that a bounded prior limits,
    a tabulated density replaces it.

    Args:
        fit: result of `fitact.fit`.
        level: posterior method; the arguments from `walkers` on apply only to "emcee".
        seed: random seed; equal seeds give equal draws, whether or not sampling was interrupted.
        walkers: walkers per ensemble, an even number of at least twice the parameters. None means 128, or 64 if the
            likelihood is a sum over the samples.
        ensembles: number of independent ensembles, at least 2.
        max_steps: steps per ensemble after which the result is marked as not converged.
        chain_file: HDF5 file for the chain, in emcee's layout. If it exists, sampling resumes from it.
        progress: whether to report progress on standard error.

    Ctrl-C ends sampling; the draws so far are returned and marked as not converged.

    Raises:
        InputError: the chain file belongs to another record, scene or seed; the fit was made without its prior; or
            the prior excludes every starting point.
    """
    if level not in get_args(Level):
        raise InputError(f"level = {level!r}: choose one of {', '.join(get_args(Level))}")
    if not fit.likelihood.use_prior:
        raise InputError("a fit with prior=False has no posterior; fit with the prior before sampling")
    size = len(fit.point_names)
    if walkers is None:  # a compressed likelihood costs less than emcee itself, whose time hardly grows with walkers
        walkers = max(128 if fit.likelihood.rows <= certificate.FEW_ROWS else 64, 2 * size)
    if walkers % 2 or walkers < 2 * size or ensembles < 2:
        raise InputError(
            f"walkers = {walkers}, ensembles = {ensembles}: give an even number of at least {2 * size} walkers, and at"
            " least 2 ensembles"
        )
    start_time = time.perf_counter()
    with double_precision(), limit_to_one_thread():
        log_prob = reject_nonfinite(certificate.batched_log_prob(fit.likelihood, walkers))
        if level != "emcee":
            posterior = importance.draw_around_fit(fit, level, log_prob, seed)
            timed = dataclasses.replace(posterior.convergence, seconds=time.perf_counter() - start_time)
            return dataclasses.replace(posterior, convergence=timed)
        proposal = Proposal.from_fit(fit, log_prob)
        track = functools.partial(importance.tracked_quantities, fit)
        target = Target(fit.point_names, log_prob, proposal, track, _fingerprint(fit, seed, walkers, ensembles))
        path = None if chain_file is None else Path(chain_file)
        chain, convergence = run_ensembles(target, seed, walkers, ensembles, max_steps, path, progress)
        return Posterior.from_chain(fit, chain, convergence, seed)


class Target(NamedTuple):
    """Density that ensembles sample, with a proposal."""

    names: tuple[str, ...]  # names of the coordinates
    log_prob: LogDensity  # log-density of points, finite or -inf
    proposal: Proposal  # approximation of the density
    # function of points (ensembles, draws, n) and a seed: derived quantities to diagnose with the coordinates
    track: Callable[[Float[np.ndarray, "ensembles draws n"], int], dict[str, np.ndarray]]
    fingerprint: str = ""  # hash of the inputs that the chain belongs to; "" if no chain is saved


def run_ensembles(
    target: Target, seed: int, walkers: int, ensembles: int, max_steps: int, path: Path | None, progress: bool
) -> tuple[Chain, Convergence]:
    """Sample until converged, in double precision; the arguments are those of `sample`."""
    run = _Run.start_or_resume(target, seed, walkers, ensembles, path)
    convergence = run.sample_until_converged(max_steps, _Reporter(progress))
    return run.chain, convergence


def make_moves(
    proposal: Proposal, independent: float = 0.85, alternative: float = 0.05
) -> list[tuple[emcee.moves.Move, float]]:
    """Return emcee's moves with their weights: a fraction `independent` draws from the proposal, others stretch.

    A fraction `alternative` draws from each alternative instead, which frees walkers where the proposal is too low.
    """
    others = [(emcee.moves.MHMove(each.move), alternative) for each in proposal.alternatives]
    first = independent - alternative * len(others)
    return [(emcee.moves.MHMove(proposal.move), first), *others, (emcee.moves.StretchMove(), 1.0 - independent)]


def reject_nonfinite(log_prob: LogDensity) -> LogDensity:
    """Replace non-finite values by -inf, because emcee stops at NaN and a walker would be stuck at +inf."""

    def finite_log_prob(points: np.ndarray) -> np.ndarray:
        values = log_prob(points)
        return np.where(np.isfinite(values), values, -np.inf)

    return finite_log_prob


class _Reporter:
    """Progress on standard error: a bar on a terminal, otherwise occasional lines."""

    def __init__(self, show: bool) -> None:
        self._show, self._lines = show, 0
        self._bar = open_bar("sampling", status="starting") if show and sys.stderr.isatty() else None

    def __call__(self, steps: int, convergence: Convergence) -> None:
        if not self._show:
            return
        diagnosis = f", tau {convergence.tau_max:.1f}, R-hat {convergence.rhat_max:.4f}" if convergence.ess else ""
        text = f"{steps} steps{diagnosis}"
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], completed=convergence.progress, description=text)
        elif steps == convergence.steps:
            if self._lines in (0, 1, 2, 5, 10) or self._lines % 20 == 0 or convergence.converged:
                print(f"sampling: {text}", file=sys.stderr)
            self._lines += 1

    def close(self) -> None:
        if self._bar is not None:
            self._bar.stop()


@dataclasses.dataclass
class _Run:
    """Ensembles of one posterior, which take their steps in turn."""

    target: Target
    chain: Chain
    samplers: list[emcee.EnsembleSampler]
    path: Path | None
    start_time: float
    turn_seconds: tuple[float, float] = (1.0, 4.0)  # bounds on the duration of a turn, beyond which its steps change
    checkpoint_seconds: float = 2.0  # shortest time between checkpoints
    checkpoint_ratio: float = 20.0  # shortest time between checkpoints, in units of the time that one takes
    steps_per_turn: int = 1
    save_time: float = 0.0  # when the last checkpoint was written
    save_seconds: float = 0.0  # time that the last checkpoint took
    derived: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)

    @classmethod
    def start_or_resume(cls, target: Target, seed: int, walkers: int, ensembles: int, path: Path | None) -> "_Run":
        """Resume from the chain file if it exists; otherwise start at draws of a widened proposal."""
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

    def sample_until_converged(self, max_steps: int, report: _Reporter) -> Convergence:
        """Sample, diagnose and save in turn."""
        steps = self.chain.steps
        is_due = steps == _next_diagnostic_step(steps - 1) or steps >= max_steps
        convergence = self.diagnose() if is_due else Convergence()
        with _defer_interrupts() as check:
            try:
                while not convergence.converged and self.chain.steps < max_steps:
                    goal = min(_next_diagnostic_step(self.chain.steps), max_steps)
                    while self.chain.steps < goal:
                        self.advance(min(self.steps_per_turn, goal - self.chain.steps), check)
                        report(self.chain.steps, convergence)
                    convergence = self.diagnose()
                    report(self.chain.steps, convergence)
                    check()
            except KeyboardInterrupt:
                if self.chain.steps == 0:
                    raise
                convergence = dataclasses.replace(self.diagnose(), converged=False, interrupted=True)
            finally:
                report.close()
                self.save()
        return convergence

    def advance(self, steps: int, check: Callable[[], None]) -> None:
        """Take `steps` with every ensemble and call `check` after each; if it raises, the chain is unchanged."""
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
            self.steps_per_turn = min(2 * self.steps_per_turn, 100)  # shortest interval between two diagnoses
        elif seconds > self.turn_seconds[1]:
            self.steps_per_turn = max(self.steps_per_turn // 2, 1)
        pause = max(self.checkpoint_seconds, self.checkpoint_ratio * self.save_seconds)
        if time.perf_counter() - self.save_time > pause:
            self.save()

    def save(self) -> None:
        """Write a checkpoint if there is a chain file."""
        now = time.perf_counter()
        self.chain.seconds, self.start_time = self.chain.seconds + now - self.start_time, now
        if self.path is not None and self.chain.steps:
            self.chain.save(self.path)
            self.save_time = time.perf_counter()
            self.save_seconds = self.save_time - now

    def diagnose(self) -> Convergence:
        """Return the diagnostics of the chain so far."""
        chain = self.chain
        self._update_tracked()
        convergence = diagnose_chain(chain.names, chain.points, chain.accepted, self.derived)
        return dataclasses.replace(convergence, seconds=chain.seconds + time.perf_counter() - self.start_time)

    def _update_tracked(self) -> None:
        """Compute the derived quantities of some walkers for the new steps."""
        done = next(iter(self.derived.values())).shape[1] if self.derived else 0
        points = self.chain.points[:, done:, :TRACKED_WALKERS]
        if not points.size:
            return
        ensembles, *_, size = points.shape
        for name, values in self.target.track(points.reshape(ensembles, -1, size), done).items():
            values = values.reshape(points.shape[:-1])
            self.derived[name] = np.concatenate([self.derived[name], values], axis=1) if done else values


def _next_diagnostic_step(steps: int, interval: int = 100, growth: float = 1.1) -> int:
    """Return the step of the next diagnosis, a multiple of `interval`; the distance grows, so that diagnosing is cheap.

    The result depends only on `steps`, so a resumed chain ends at the same step as an uninterrupted one.
    """
    step = interval
    while step <= steps:
        step = int(np.ceil(growth * step / interval)) * interval
    return step


@contextlib.contextmanager
def _defer_interrupts() -> Iterator[Callable[[], None]]:
    """Defer Ctrl-C until the yielded function is called, or until a second Ctrl-C.

    Within a step, emcee prints a traceback for any error, and Python drops exceptions in callbacks of weak references,
    of which JAX has many.
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
    proposal: Proposal, log_prob: LogDensity, walkers: int, random: np.random.RandomState
) -> tuple[np.ndarray, np.ndarray]:
    """Draw starting points at which the posterior is positive; return them with their log-probabilities."""
    points, values = np.empty((0, proposal.center.size)), np.empty(0)
    for _ in range(100):
        drawn = proposal.draw(random, walkers)
        log_probs = log_prob(drawn)
        possible = np.isfinite(log_probs)
        points, values = np.append(points, drawn[possible], axis=0), np.append(values, log_probs[possible])
        if len(points) >= walkers:
            return points[:walkers], values[:walkers]
    raise InputError(
        "scene: the bounds of [prior] or the limits of [instrument] exclude, or nearly exclude, what the record shows;"
        " `fitact fit` says where; widen them, or check the units of the record and the circuit of the scene"
    )


def _fingerprint(fit: Fit, seed: int, walkers: int, ensembles: int) -> str:
    """Return a hash of all inputs that determine a chain, and of its optimum without digits that rounding changes."""
    inputs = [[record.fingerprint for record in fit.records], fit.scene.to_json(), [t.choice.name for t in fit.traces]]
    optimum = [f"{value:.6g}" for value in fit.theta]
    settings = [fit.likelihood.rows, fit.point_names, optimum, seed, walkers, ensembles]
    return hashlib.sha256(json.dumps([importlib.metadata.version("fitact"), *inputs, *settings]).encode()).hexdigest()
