"""The levels themselves, and the stopwatch: responses, likelihoods and uncertainties of one fit."""

import dataclasses
import math
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitact.fitting.drive_choice import whole_periods
from fitact.fitting.fit import Fit
from fitact.likelihood.likelihood import Batched, Likelihood
from fitact.model.circuit import RC
from fitact.model.drive import Drive, Sampled
from fitact.model.harmonic import harmonic_response
from fitact.model.response import highpass, response
from fitact.sampling.ensemble import Level, sample
from fitact.sampling.posterior import Posterior

_HARMONICS = (10, 100, 1000)
_RTOL = 1e-6  # of the ODE solver
_WALKERS = 128
_BATCH_ROWS = 1_000_000  # samples evaluated at a time, which bounds memory
_ROUNDS = 9
_FEW, _LONG = 3, 0.05  # rounds that are enough for calls that take longer than so many seconds
_ROUND = 5e-3  # seconds that a job takes in a round, at least
_RUNS = 3  # of each level of uncertainty, after one that compiles
_QUANTILES = (0.05, 0.5, 0.95)
_SCATTER = 2.11  # sqrt(0.05 0.95) over the normal density there: the sd of a 5 % quantile, times sqrt(draws)
_LARGEST = 2.5  # such sd: what the largest of ten differences is hardly ever above


@dataclasses.dataclass(frozen=True)
class Measured:
    """What was measured of one level; see `fitact.tradeoff.tradeoff.Level`."""

    name: str
    error: float
    seconds: float
    gradient_seconds: float | None = None
    compile_seconds: float = 0.0
    memory: int | None = None
    details: dict[str, Any] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class _Job:
    """Something to time: its call and its gradient's, how many evaluations one is, what compiling and memory took."""

    call: Callable[[], Any]
    gradient: Callable[[], Any] | None = None
    evaluations: int = 1
    compile_seconds: float = 0.0
    memory: int | None = None


def _compiled(
    value: Callable[..., Array], gradient: Callable[..., Array], arguments: tuple[Any, ...], each: int = 1
) -> _Job:
    """A function and its gradient, compiled ahead, so that what that takes is known."""
    arguments = jax.tree.map(lambda x: jnp.asarray(np.asarray(x)), arguments)  # in the precision that is set
    began = time.perf_counter()
    program = jax.jit(value).lower(*arguments).compile()
    took = time.perf_counter() - began
    of_gradient = jax.jit(gradient).lower(*arguments).compile()
    used = program.memory_analysis()
    memory = None if used is None else int(used.temp_size_in_bytes + used.output_size_in_bytes)
    return _Job(
        lambda: jax.block_until_ready(program(*arguments)),
        lambda: jax.block_until_ready(of_gradient(*arguments)),
        each,
        took,
        memory,
    )


def _timed(
    jobs: dict[str, _Job], errors: dict[str, float], details: dict[str, dict[str, Any]] | None = None
) -> list[Measured]:
    """Jobs with the median seconds of an evaluation and of a gradient, all in turn."""
    values = medians({name: job.call for name, job in jobs.items()})
    gradients = medians({name: job.gradient for name, job in jobs.items() if job.gradient is not None})
    return [
        Measured(
            name,
            errors[name],
            values[name] / job.evaluations,
            gradients[name] / job.evaluations if name in gradients else None,
            job.compile_seconds,
            job.memory,
            (details or {}).get(name, {}),
        )
        for name, job in jobs.items()
    ]


def medians(jobs: dict[str, Callable[[], Any]], rounds: int = _ROUNDS) -> dict[str, float]:
    """Median seconds of a call of each job, run in turn; the short ones several times a round."""
    counts: dict[str, int] = {}
    taken: dict[str, list[float]] = {name: [] for name in jobs}
    for name, job in jobs.items():
        job()
        counts[name] = max(1, math.ceil(_ROUND / _seconds(job, 1)))
    for number in range(rounds):
        for name, job in jobs.items():
            if number < _FEW or taken[name][0] < _LONG:
                taken[name].append(_seconds(job, counts[name]))
    return {name: statistics.median(seconds) for name, seconds in taken.items()}


def _seconds(job: Callable[[], Any], count: int) -> float:
    """Of one of so many calls in a row."""
    began = time.perf_counter()
    for _ in range(count):
        job()
    return (time.perf_counter() - began) / count


class _Case(NamedTuple):
    """What is responded to: the fit's drive, or the whole periods that a measured one shows.

    Attributes:
        charges: for each time constant, what its high-pass response at the first time is beyond the drive, V.
    """

    circuit: RC
    drive: Drive
    time: Float[np.ndarray, " times"]
    steady_state: bool
    charges: Float[np.ndarray, " terms"]

    @classmethod
    def of(cls, fit: Fit) -> "_Case":
        record, choice = fit.record, fit.choice
        circuit: Any = fit.likelihood.circuit(jnp.asarray(fit.theta))  # of constant skins
        drive, time, steady_state = choice.drive, record.time - choice.shift, choice.steady_state
        if isinstance(drive, Sampled):
            kept, period = whole_periods(record)
            drive, time = Sampled(record.time[:kept], choice.voltage[:kept], period), record.time[:kept]
            steady_state = period is not None
        first = [highpass(drive, time[:1], tau, steady_state=steady_state) for tau in circuit.terms().tau]
        return cls(circuit, drive, time, steady_state, np.array(first)[:, 0] - np.asarray(drive.value(time[0])))

    def sampled(self) -> "_Case":
        """With straight lines between the drive's values, from the charge that there is at the first time."""
        return self._replace(drive=Sampled(self.time, self.drive.value(self.time)), steady_state=False)


def responses(fit: Fit) -> list[Measured]:
    """Levels of the response Vsc(t) at the fit's optimum; exact first. Call it in double precision."""
    case = _Case.of(fit)

    def exact(circuit: RC, drive: Drive, time: Array) -> Array:
        return response(circuit, drive, time, steady_state=case.steady_state)

    def recurrence(circuit: RC, drive: Drive, time: Array) -> Array:
        initial = jnp.stack(list(map(jnp.asarray, circuit.terms().weight))) * case.charges
        return response(circuit, drive, time, steady_state=False, initial=initial)

    jobs = {"exact": _response_job(exact, case), "recurrence": _response_job(recurrence, case.sampled())}
    with jax.enable_x64(False):
        jobs["float32"] = _response_job(exact, case)
    if case.steady_state:
        for n in _HARMONICS:

            def harmonic(circuit: RC, drive: Drive, time: Array, n: int = n) -> Array:
                return harmonic_response(circuit, drive, time, n)

            jobs[f"harmonic({n})"] = _response_job(harmonic, case)
    jobs["ODE (scipy)"] = _Job(_ode(case.sampled()))
    values = {name: np.asarray(job.call(), dtype=float) for name, job in jobs.items()}
    errors = {name: _rms(value - values["exact"]) / _rms(values["exact"]) for name, value in values.items()}
    return _timed(jobs, errors)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _response_job(level: Callable[[RC, Drive, Array], Array], case: _Case) -> _Job:
    """A level, and the gradient of the sum of its squares in the circuit's elements."""

    def squares(circuit: RC, drive: Drive, time: Array) -> Array:
        return jnp.sum(jnp.square(level(circuit, drive, time)))

    return _compiled(level, jax.grad(squares), (case.circuit, case.drive, case.time))


def _ode(case: _Case) -> Callable[[], np.ndarray]:
    """The low-pass state x' = (V - x) / tau of each time constant by scipy's LSODA; Vsc = sum weight (V - x)."""
    import scipy.integrate

    weight, tau = (np.array(x, dtype=float) for x in case.circuit.terms()[:2])
    voltage, step = np.asarray(case.drive.value(case.time)), float(np.median(np.diff(case.time)))

    def slope(t: float, x: np.ndarray) -> np.ndarray:
        return (np.interp(t, case.time, voltage) - x) / tau

    def solve() -> np.ndarray:
        x = scipy.integrate.odeint(slope, -case.charges, case.time, rtol=_RTOL, hmax=step, tfirst=True)
        return (voltage[:, None] - x) @ weight

    return solve


def likelihoods(full: Fit, compressed: dict[float, Fit]) -> list[Measured]:
    """Levels of the log-posterior around the optimum; the full sum first. Call it in double precision."""
    models, details = {"full": full.likelihood.summed()}, {}
    for name, fit in _distinct(compressed).items():
        models[name] = fit.likelihood.without_samples()
        details[name] = {"numbers": fit.likelihood.rows, "certified_error": fit.compression_error}
    points = np.tile(full.point, (_WALKERS, 1))
    points[1:] += np.random.default_rng(0).standard_normal(points[1:].shape) @ full.point_root.T
    jobs, values = {}, {}
    for name, model in models.items():
        batch = max(1, min(_WALKERS, _BATCH_ROWS // model.rows))
        jobs[name] = _likelihood_job(model, points[:batch])
        found = Batched(Likelihood.log_prob, model, model.rows, _WALKERS)(points)
        values[name] = found - found[0]
    errors = {name: float(np.max(np.abs(value - values["full"]))) for name, value in values.items()}
    return _timed(jobs, errors, details)


def _distinct(fits: dict[float, Fit]) -> dict[str, Fit]:
    """The compressed ones by name; tolerances that came to one and the same compression share a name."""
    groups: dict[tuple[Any, ...], list[float]] = {}
    for tolerance, fit in fits.items():
        if fit.compression_error is not None:
            groups.setdefault((fit.likelihood.rows, fit.compression_error), []).append(tolerance)
    return {f"compressed({', '.join(map(short, group))})": fits[group[0]] for group in groups.values()}


def short(value: float) -> str:
    """1e-3, not 1e-03."""
    return f"{value:.0e}".replace("e-0", "e-")


def _likelihood_job(model: Likelihood, points: Float[np.ndarray, "batch coordinates"]) -> _Job:
    dynamic, static = eqx.partition(model, eqx.is_array)

    def each(dynamic: Any, points: Array) -> Array:
        return jax.vmap(eqx.combine(dynamic, static).log_prob)(points)

    def gradients(dynamic: Any, points: Array) -> Array:
        return jax.vmap(jax.grad(eqx.combine(dynamic, static).log_prob))(points)

    return _compiled(each, gradients, (dynamic, points), len(points))


class Uncertainties(NamedTuple):
    """Levels of uncertainty, emcee on the full sum first; what its draws can tell; whether they converged."""

    levels: list[Measured]
    resolution: float
    converged: bool


def uncertainties(full: Fit, compressed: Fit, say: Callable[[str], None]) -> Uncertainties:
    """Draws by every level, in turn, and what they are off by from those of emcee on the full sum.

    Raises:
        KeyboardInterrupt: also where it came while sampling.
    """
    jobs: dict[str, tuple[Fit, Level]] = {"emcee, full": (full, "emcee")}
    jobs |= {level: (compressed, level) for level in ("laplace", "psis", "emcee")}
    runs: dict[str, list[Posterior]] = {name: [] for name in jobs}
    for seed in range(_RUNS + 1):
        say(f"uncertainties, round {seed + 1} of {_RUNS + 1}")
        for name, (fit, level) in jobs.items():
            posterior = sample(fit, level=level, seed=seed, progress=False)
            if posterior.convergence.interrupted:
                raise KeyboardInterrupt
            runs[name].append(posterior)
    draws = {name: _pooled(posteriors) for name, posteriors in runs.items()}
    reference = draws["emcee, full"]
    found = [_of_runs(name, runs[name], off_by(draws[name], reference)) for name in jobs]
    fewest = min(sum(min(p.convergence.ess_min, p.log_prob.size) for p in ps) for ps in runs.values())
    return Uncertainties(
        found,
        _LARGEST * _SCATTER * math.sqrt(2.0 / fewest),
        all(posterior.convergence.converged for posterior in runs["emcee, full"]),
    )


def _pooled(posteriors: Sequence[Posterior]) -> dict[str, Float[np.ndarray, " draws"]]:
    """Logarithms of Rsc, where it is free, and of the mean force."""
    found: dict[str, list[np.ndarray]] = {}
    for posterior in posteriors:
        names, points = posterior.fit.point_names, posterior.points
        if "Rsc" in names:
            found.setdefault("Rsc", []).append(points[..., names.index("Rsc")])
        found.setdefault("force_mean", []).append(np.log(posterior.force()["force_mean"]))
    return {name: np.concatenate([np.ravel(part) for part in parts]) for name, parts in found.items()}


def off_by(draws: dict[str, np.ndarray], reference: dict[str, np.ndarray]) -> dict[str, float]:
    """Differences of mean, sd and quantiles, in standard deviations of the reference, by name."""
    found = {}
    for name, values in draws.items():
        true = reference[name]
        sd = float(np.std(true))
        found[f"{name} mean"] = float(np.mean(values) - np.mean(true)) / sd
        found[f"{name} sd"] = float(np.std(values)) / sd - 1.0
        for q in _QUANTILES:
            found[f"{name} q{round(100 * q):02}"] = float(np.quantile(values, q) - np.quantile(true, q)) / sd
    return found


def _of_runs(name: str, posteriors: Sequence[Posterior], off: dict[str, float]) -> Measured:
    first, *warm = (posterior.convergence for posterior in posteriors)
    seconds = statistics.median(c.seconds for c in warm)
    held = max(c.ensembles * c.steps * c.walkers for c in warm) or posteriors[0].log_prob.size
    return Measured(
        name,
        max(map(abs, off.values())),
        statistics.median(c.seconds / c.ess["force_mean"] for c in warm),
        None,
        max(0.0, first.seconds - seconds),
        8 * held * (posteriors[0].points.shape[-1] + 1),
        off | {"seconds": seconds, "certified": all(c.converged for c in warm)},
    )
