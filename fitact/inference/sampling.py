"""Posterior draws with emcee, until converged: independent ensembles, checkpoints, resume."""

import contextlib
import dataclasses
import hashlib
import importlib.metadata
import json
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import emcee
import jax
import numpy as np
from arviz_stats.base import array_stats
from jaxtyping import Float

from fitact.errors import InputError
from fitact.inference import compressed
from fitact.inference.chain import Chain
from fitact.inference.fit import Fit
from fitact.inference.posterior import Convergence, Posterior

_DEGREES = 8.0  # of freedom of the t proposal: tails above any posterior's seen here
_OVERDISPERSION = 1.5  # of the walkers' start, so that ensembles that agree have had to find each other
_LENGTHS = 50.0  # autocorrelation times each ensemble must be long
_RHAT = 1.01
_CHUNK = 100  # steps between checkpoints


def sample(
    fit: Fit,
    *,
    seed: int = 0,
    walkers: int = 64,
    ensembles: int = 4,
    max_steps: int = 20_000,
    chain_file: str | os.PathLike[str] | None = None,
    progress: bool = True,
) -> Posterior:
    """Sample the posterior around `fit` with emcee until it has converged.

    Coordinates are the log-parameters of the fit and log sigma. Seven moves in ten propose from a Student-t
    over the fit's Laplace approximation, three are stretch moves, which keep the mixture safe where the shape
    is not Gaussian. Converged: each ensemble is longer than 50 autocorrelation times, and split-R-hat over the
    ensembles is below 1.01, in every parameter and in g and b.

    Args:
        fit: from `fitact.fit`.
        seed: the same seed gives the same chain, whether or not it was interrupted.
        walkers: per ensemble; even, at least twice the parameters.
        ensembles: independent ones, at least two.
        max_steps: per ensemble, after which the answer is marked as not converged.
        chain_file: where to keep the chain (HDF5, emcee's layout); if it exists, sampling goes on from it.
        progress: report on standard error.

    Ctrl-C ends sampling after the last checkpoint, with what there is, marked as not converged.

    Raises:
        InputError: the chain file belongs to another record, scene or seed; or the prior forbids every start.
    """
    names = fit.point_names
    if walkers % 2 or walkers < 2 * len(names) or ensembles < 2:
        raise InputError(
            f"walkers = {walkers}, ensembles = {ensembles}: at least {2 * len(names)}, even; and at least 2"
        )
    path = None if chain_file is None else Path(chain_file)
    with jax.enable_x64(True):
        run = _Run.start(fit, names, seed, walkers, ensembles, path)
        report = _Reporter(progress)
        convergence = run.judge()
        try:
            while not convergence.converged and run.chain.steps < max_steps:
                run.advance(min(_CHUNK, max_steps - run.chain.steps))
                convergence = run.judge()
                report(convergence)
        except KeyboardInterrupt:
            if run.chain.steps == 0:
                raise
            convergence = dataclasses.replace(run.judge(), converged=False, interrupted=True)
        finally:
            report.close()
        return Posterior.from_chain(fit, run.chain, convergence, seed)


@dataclasses.dataclass
class _Run:
    """The ensembles of one posterior."""

    chain: Chain
    samplers: list[emcee.EnsembleSampler]
    path: Path | None

    @classmethod
    def start(
        cls, fit: Fit, names: tuple[str, ...], seed: int, walkers: int, ensembles: int, path: Path | None
    ) -> "_Run":
        """From the chain file where there is one, else from the Laplace approximation."""
        proposal = _StudentT.around(fit)
        log_prob = compressed.log_prob(fit.likelihood, walkers // 2)  # as many as a stretch move asks for
        moves = [(emcee.moves.MHMove(proposal.move), 0.7), (emcee.moves.StretchMove(), 0.3)]
        samplers = [
            emcee.EnsembleSampler(walkers, len(names), log_prob, moves=moves, vectorize=True) for _ in range(ensembles)
        ]
        fingerprint = _fingerprint(fit, names, seed, walkers, ensembles)
        if path is not None and path.exists():
            return cls(Chain.load(path, fingerprint), samplers, path)
        states = []
        for child in np.random.SeedSequence(seed).spawn(ensembles):
            random = np.random.RandomState(child.generate_state(8))
            points, values = _starts(proposal, log_prob, walkers, random)
            states.append(emcee.State(points, log_prob=values, random_state=random.get_state()))
        return cls(Chain.empty(names, fingerprint, states), samplers, path)

    def advance(self, steps: int) -> None:
        """Take `steps` with every ensemble, then checkpoint; an interrupted call leaves no trace."""
        done = []
        with _interrupts_between_steps() as check:
            for sampler, last in zip(self.samplers, self.chain.states, strict=True):
                sampler.reset()
                for _ in sampler.sample(last, iterations=steps, skip_initial_state_check=True):
                    check()
                state = sampler.get_last_sample()
                done.append((sampler.get_chain(), sampler.get_log_prob(), state, sampler.backend.accepted))
        self.chain = self.chain.extended(done)
        if self.path is not None:
            self.chain.save(self.path)

    def judge(self) -> Convergence:
        """Autocorrelation times, effective size and split-R-hat of the chain so far."""
        points, steps = self.chain.points, self.chain.steps
        ensembles, _, walkers, _ = points.shape
        if steps < _CHUNK:
            return Convergence(steps=steps, walkers=walkers, ensembles=ensembles)
        seen = _with_divider(points, self.chain.names)
        tau = np.array([emcee.autocorr.integrated_time(x[steps // 5 :], tol=0, quiet=True) for x in seen])
        tau_max = float(np.max(np.where(np.isfinite(tau), tau, steps)))
        burn = int(min(np.ceil(5.0 * tau_max), steps // 2))
        kept = seen[:, burn:].reshape(ensembles, -1, seen.shape[-1])
        rhat = [float(array_stats.rhat(kept[..., i], chain_axis=0, draw_axis=1)) for i in range(kept.shape[-1])]
        stuck = int(np.sum(self.chain.accepted == 0))
        return Convergence(
            converged=bool(steps - burn > _LENGTHS * tau_max and max(rhat) < _RHAT and stuck == 0),
            tau_max=tau_max,
            ess_min=ensembles * (steps - burn) * walkers / tau_max,
            rhat_max=max(rhat),
            acceptance=float(np.mean(self.chain.accepted) / steps),
            burn=burn,
            steps=steps,
            walkers=walkers,
            ensembles=ensembles,
            stuck_walkers=stuck,
        )


@contextlib.contextmanager
def _interrupts_between_steps() -> Iterator[Callable[[], None]]:
    """Hold Ctrl-C back until the function it gives is called: emcee prints a traceback for any error inside a step."""
    pending: list[int] = []

    def check() -> None:
        if pending:
            raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield check
        return
    before = signal.signal(signal.SIGINT, lambda number, _: pending.append(number))
    try:
        yield check
    finally:
        signal.signal(signal.SIGINT, before)


@dataclasses.dataclass(frozen=True)
class _StudentT:
    """A multivariate Student-t in the coordinates of the chain."""

    center: Float[np.ndarray, " n"]
    factor: Float[np.ndarray, "n n"]  # its product with its transpose is the scale

    @classmethod
    def around(cls, fit: Fit) -> "_StudentT":
        """The fit's Laplace approximation."""
        return cls(fit.point, fit.point_root)

    def draw(self, random: np.random.RandomState, count: int, widen: float = 1.0) -> Float[np.ndarray, "count n"]:
        normal = random.standard_normal((count, self.center.size)) @ self.factor.T
        return self.center + widen * normal * np.sqrt(_DEGREES / random.chisquare(_DEGREES, (count, 1)))

    def log_density(self, points: Float[np.ndarray, "count n"]) -> Float[np.ndarray, " count"]:
        """Up to a constant."""
        white = np.linalg.solve(self.factor, (points - self.center).T)
        return -0.5 * (_DEGREES + self.center.size) * np.log1p(np.sum(white**2, axis=0) / _DEGREES)

    def move(
        self, points: Float[np.ndarray, "count n"], random: np.random.RandomState
    ) -> tuple[Float[np.ndarray, "count n"], Float[np.ndarray, " count"]]:
        """emcee's proposal function: new points, and log q(old) - log q(new)."""
        proposed = self.draw(random, len(points))
        return proposed, self.log_density(points) - self.log_density(proposed)


def _starts(
    proposal: _StudentT,
    log_prob: Callable[[np.ndarray], np.ndarray],
    walkers: int,
    random: np.random.RandomState,
) -> tuple[np.ndarray, np.ndarray]:
    """Over-dispersed draws that the posterior allows, with their log-probabilities."""
    found: list[np.ndarray] = []
    values: list[np.ndarray] = []
    for _ in range(100):
        points = proposal.draw(random, walkers, _OVERDISPERSION)
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


def _with_divider(points: Float[np.ndarray, "*shape n"], names: tuple[str, ...]) -> Float[np.ndarray, "*shape m"]:
    """The coordinates, and the logarithms of g and b, which the data see best."""
    r, c, i = (points[..., names.index(name)] for name in ("Rsc", "Csc", "Ci"))
    total = np.logaddexp(np.log(2.0) + i, c)
    return np.concatenate([points, (i - total)[..., None], (r + total)[..., None]], axis=-1)


def _fingerprint(fit: Fit, names: tuple[str, ...], seed: int, walkers: int, ensembles: int) -> str:
    """What a chain belongs to; any change of it makes another chain."""
    settings = [
        fit.record.fingerprint,
        fit.scene.to_json(),
        fit.choice.name,
        fit.likelihood.rows,
        names,
        fit.theta.tolist(),
        seed,
        walkers,
        ensembles,
    ]
    return hashlib.sha256(json.dumps([importlib.metadata.version("fitact"), *settings]).encode()).hexdigest()


class _Reporter:
    """Progress on standard error: a bar where it is a terminal, else a line now and then."""

    def __init__(self, on: bool) -> None:
        self._bar = None
        self._on = on
        self._lines = 0
        if on and sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

            columns = (
                TextColumn("sampling"),
                BarColumn(),
                TextColumn("{task.description}"),
                TimeElapsedColumn(),
            )
            self._bar = Progress(*columns, console=Console(stderr=True))
            self._bar.start()
            self._task = self._bar.add_task("starting", total=1.0)

    def __call__(self, c: Convergence) -> None:
        if not self._on:
            return
        share = min((c.steps - c.burn) / (_LENGTHS * c.tau_max), 1.0) if c.tau_max else 0.0
        text = f"{c.steps} steps, tau {c.tau_max:.1f}, R-hat {c.rhat_max:.4f}"
        if self._bar is not None:
            self._bar.update(self._task, completed=share, description=text)
        elif self._lines in (0, 1, 2, 5, 10) or self._lines % 20 == 0 or c.converged:
            print(f"sampling: {text}", file=sys.stderr)
        self._lines += 1

    def close(self) -> None:
        if self._bar is not None:
            self._bar.stop()
