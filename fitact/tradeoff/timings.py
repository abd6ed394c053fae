"""Benchmarks of the response, likelihood and posterior methods for one fit."""

import dataclasses
import functools
import math
import os
import pickle
import statistics
import subprocess
import sys
import time
import timeit
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from fitact.compiled import BatchEvaluator, is_array
from fitact.data.record import Record
from fitact.fitting.fit import fit as fit_record
from fitact.fitting.result import Fit
from fitact.likelihood.likelihood import Likelihood
from fitact.model.circuit import RC
from fitact.model.drive import Drive, Sampled
from fitact.model.harmonic import harmonic_response
from fitact.model.response import highpass, response
from fitact.problem.drive_choice import whole_periods
from fitact.sampling.ensemble import Level, sample
from fitact.sampling.posterior import Posterior
from fitact.scene.scene import Scene


@dataclasses.dataclass(frozen=True)
class BenchmarkResult:
    """Error and cost of one method."""

    name: str  # "least squares", "exact", "harmonic(100)", "compressed(1e-3)", "psis", ...
    error: float  # relative to the reference method; see `fitact.tradeoff.tradeoff.Tradeoff`
    # time of an answer, of one evaluation (of one walker in a batch), or of one effective draw of the mean force
    seconds: float
    gradient_seconds: float | None = None  # time of one gradient, or None
    compile_seconds: float = 0.0  # compilation time; of an answer, what a first process without stored programs adds
    memory: int | None = None  # bytes for an evaluation, or for the draws; None if unknown
    details: dict[str, Any] = dataclasses.field(default_factory=dict)  # additional figures of this method


class _Job(NamedTuple):
    """Functions to time (value and gradient), evaluations per call, compilation time (s) and memory (bytes)."""

    call: Callable[[], Any]
    gradient: Callable[[], Any] | None = None
    evaluations: int = 1
    compile_seconds: float = 0.0
    memory: int | None = None


def _compile_job(
    value: Callable[..., Array], gradient: Callable[..., Array], arguments: tuple[Any, ...], evaluations: int = 1
) -> _Job:
    """Compile a function and its gradient in advance, and measure the compilation time."""
    arguments = jax.tree.map(lambda x: jnp.asarray(np.asarray(x)), arguments)  # in the current precision of JAX
    start = time.perf_counter()
    value_program = jax.jit(value).lower(*arguments).compile()
    seconds = time.perf_counter() - start
    gradient_program = jax.jit(gradient).lower(*arguments).compile()
    used = value_program.memory_analysis()
    return _Job(
        lambda: jax.block_until_ready(value_program(*arguments)),
        lambda: jax.block_until_ready(gradient_program(*arguments)),
        evaluations,
        seconds,
        None if used is None else int(used.temp_size_in_bytes + used.output_size_in_bytes),
    )


def _time_jobs(
    jobs: dict[str, _Job], errors: dict[str, float], details: dict[str, dict[str, Any]] | None = None
) -> list[BenchmarkResult]:
    """Measure the median time of an evaluation and of a gradient for each job, in interleaved rounds."""
    values = median_seconds({name: job.call for name, job in jobs.items()})
    gradients = median_seconds({name: job.gradient for name, job in jobs.items() if job.gradient is not None})
    return [
        BenchmarkResult(
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


def median_seconds(jobs: dict[str, Callable[[], Any]], rounds: int = 9) -> dict[str, float]:
    """Measure the median time (s) of a call of each job, in interleaved rounds of at least 5 ms."""
    counts: dict[str, int] = {}
    seconds: dict[str, list[float]] = {name: [] for name in jobs}
    for name, job in jobs.items():
        job()
        counts[name] = max(1, math.ceil(5e-3 / timeit.timeit(job, number=1)))
    for number in range(rounds):
        for name, job in jobs.items():
            if number < 3 or seconds[name][0] < 0.05:  # three rounds suffice for long calls
                seconds[name].append(timeit.timeit(job, number=counts[name]) / counts[name])
    return {name: statistics.median(measured) for name, measured in seconds.items()}


class _Case(NamedTuple):
    """Circuit and drive of a fit; a measured drive is cut to whole periods."""

    circuit: RC
    drive: Drive
    time: Float[np.ndarray, " times"]
    steady_state: bool
    charges: Float[np.ndarray, " terms"]  # high-pass response at the first time minus the drive, V

    @classmethod
    def from_fit(cls, fit: Fit) -> "_Case":
        record, choice = fit.record, fit.choice
        circuit: Any = fit.likelihood.circuit(jnp.asarray(fit.theta))  # constant skins only
        drive, time, steady_state = choice.drive, record.time - choice.shift, choice.steady_state
        if isinstance(drive, Sampled):
            samples, period = whole_periods(record)
            drive, time = Sampled(record.time[:samples], choice.voltage[:samples], period), record.time[:samples]
            steady_state = period is not None
        first = [highpass(drive, time[:1], tau, steady_state=steady_state) for tau in circuit.terms().tau]
        return cls(circuit, drive, time, steady_state, np.array(first)[:, 0] - np.asarray(drive.value(time[0])))

    def with_sampled_drive(self) -> "_Case":
        """Return the case with a drive interpolated between the samples, starting from the initial charge."""
        return self._replace(drive=Sampled(self.time, self.drive.value(self.time)), steady_state=False)


def benchmark_responses(fit: Fit, harmonics: Sequence[int] = (10, 100, 1000)) -> list[BenchmarkResult]:
    """Benchmark methods for the response Vsc(t) at the optimum, the exact one first, in double precision."""
    case = _Case.from_fit(fit)

    def exact(circuit: RC, drive: Drive, time: Array) -> Array:
        return response(circuit, drive, time, steady_state=case.steady_state)

    def recurrence(circuit: RC, drive: Drive, time: Array) -> Array:
        initial = jnp.stack(list(map(jnp.asarray, circuit.terms().weight))) * case.charges
        return response(circuit, drive, time, steady_state=False, initial=initial)

    jobs = {"exact": _response_job(exact, case), "recurrence": _response_job(recurrence, case.with_sampled_drive())}
    with jax.enable_x64(False):
        jobs["float32"] = _response_job(exact, case)
    for n in harmonics if case.steady_state else ():
        jobs[f"harmonic({n})"] = _response_job(functools.partial(harmonic_response, harmonics=n), case)
    jobs["ODE (scipy)"] = _Job(_make_ode_solver(case.with_sampled_drive()))
    values = {name: np.asarray(job.call(), dtype=float) for name, job in jobs.items()}
    norm = np.linalg.norm(values["exact"])
    errors = {name: float(np.linalg.norm(value - values["exact"]) / norm) for name, value in values.items()}
    return _time_jobs(jobs, errors)


def _response_job(level: Callable[[RC, Drive, Array], Array], case: _Case) -> _Job:
    """Compile a method, and the gradient of its sum of squares with respect to the circuit elements."""

    def squares(circuit: RC, drive: Drive, time: Array) -> Array:
        return jnp.sum(jnp.square(level(circuit, drive, time)))

    return _compile_job(level, jax.grad(squares), (case.circuit, case.drive, case.time))


def _make_ode_solver(case: _Case, rtol: float = 1e-6) -> Callable[[], np.ndarray]:
    """Return a solver (LSODA of SciPy) of x' = (V - x) / tau for each time constant.

    Vsc is direct V + sum weight (V - x).
    """
    terms = case.circuit.terms()
    weight, tau, direct = (np.array(x, dtype=float) for x in (terms.weight, terms.tau, terms.direct or 0.0))
    voltage, step = np.asarray(case.drive.value(case.time)), float(np.median(np.diff(case.time)))

    def slope(t: float, x: np.ndarray) -> np.ndarray:
        return (np.interp(t, case.time, voltage) - x) / tau

    def solve() -> np.ndarray:
        x = scipy.integrate.odeint(slope, -case.charges, case.time, rtol=rtol, hmax=step, tfirst=True)
        return (voltage[:, None] - x) @ weight + direct * voltage

    return solve


def benchmark_likelihoods(full: Fit, compressed: dict[float, Fit]) -> list[BenchmarkResult]:
    """Benchmark methods for the log-posterior around the optimum, the full sum first, in double precision."""
    walkers, batch_rows = 128, 1_000_000  # points; samples in a batch, which bounds the memory
    models, details = {"full": full.likelihood.without_compression()}, {}
    for name, fit in _distinct_compressions(compressed).items():
        models[name] = fit.likelihood.without_samples()
        details[name] = {"numbers": fit.likelihood.rows, "certified_error": fit.compression_error}
    points = np.tile(full.point, (walkers, 1))
    points[1:] += np.random.default_rng(0).standard_normal(points[1:].shape) @ full.point_root.T
    jobs, values = {}, {}
    for name, model in models.items():
        batch = max(1, min(walkers, batch_rows // model.rows))
        jobs[name] = _likelihood_job(model, points[:batch])
        log_probs = BatchEvaluator(Likelihood.log_prob, model, model.rows, walkers)(points)
        values[name] = log_probs - log_probs[0]
    errors = {name: float(np.max(np.abs(value - values["full"]))) for name, value in values.items()}
    return _time_jobs(jobs, errors, details)


def _distinct_compressions(fits: dict[float, Fit]) -> dict[str, Fit]:
    """Return the compressed fits by name; tolerances with the same compression share one name."""
    groups: dict[tuple[Any, ...], list[float]] = {}
    for tolerance, fit in fits.items():
        if fit.compression_error is not None:
            groups.setdefault((fit.likelihood.rows, fit.compression_error), []).append(tolerance)
    return {f"compressed({', '.join(map(format_tolerance, group))})": fits[group[0]] for group in groups.values()}


def format_tolerance(value: float) -> str:
    """Return the tolerance as text such as 1e-3 (not 1e-03)."""
    return f"{value:.0e}".replace("e-0", "e-")


def _likelihood_job(model: Likelihood, points: Float[np.ndarray, "batch coordinates"]) -> _Job:
    dynamic, static = eqx.partition(model, is_array)

    def log_probs(dynamic: Any, points: Array) -> Array:
        return jax.vmap(eqx.combine(dynamic, static).log_prob)(points)

    def gradients(dynamic: Any, points: Array) -> Array:
        return jax.vmap(jax.grad(eqx.combine(dynamic, static).log_prob))(points)

    return _compile_job(log_probs, gradients, (dynamic, points), len(points))


class UncertaintyBenchmark(NamedTuple):
    """Benchmarks of the posterior methods, resolution of their errors, and convergence of the reference."""

    levels: list[BenchmarkResult]
    resolution: float
    converged: bool
    force: dict[str, list[Float[np.ndarray, " draws"]]]  # draws of the mean force (N), by method and run

    @property
    def force_log_sd(self) -> float:
        """Posterior standard deviation of the logarithm of the mean force, by the reference."""
        return float(np.std(np.log(np.concatenate(self.force["emcee, full"]))))


def benchmark_uncertainties(
    full: Fit, compressed: Fit, report: Callable[[str], None], runs: int = 3
) -> UncertaintyBenchmark:
    """Sample by each method in interleaved rounds, and compare the draws with emcee on the full sum.

    Each method has `runs` runs, after one that compiles. An interrupt during sampling is raised again.
    """
    jobs: dict[str, tuple[Fit, Level]] = {"emcee, full": (full, "emcee")}
    jobs |= {level: (compressed, level) for level in ("laplace", "psis", "emcee")}
    posteriors: dict[str, list[Posterior]] = {name: [] for name in jobs}
    for seed in range(runs + 1):
        report(f"posterior methods, round {seed + 1} of {runs + 1}")
        for name, (fit, level) in jobs.items():
            posterior = sample(fit, level=level, seed=seed, progress=False)
            if posterior.convergence.interrupted:
                raise KeyboardInterrupt
            posteriors[name].append(posterior)
    draws = {name: _pool_draws(repeated) for name, repeated in posteriors.items()}
    reference = draws["emcee, full"]
    levels = [_summarize_runs(name, posteriors[name], posterior_discrepancies(draws[name], reference)) for name in jobs]
    fewest = min(sum(min(p.convergence.ess_min, p.log_prob.size) for p in ps) for ps in posteriors.values())
    # 2.11 = sqrt(0.05 0.95) over the normal density there, i.e. the sd of a 5 % quantile times sqrt(draws); the largest
    # of ten differences hardly ever exceeds 2.5 sd
    resolution = 2.5 * 2.11 * math.sqrt(2.0 / fewest)
    converged = all(posterior.convergence.converged for posterior in posteriors["emcee, full"])
    force = {name: [p.force()["force_mean"].ravel() for p in repeated] for name, repeated in posteriors.items()}
    return UncertaintyBenchmark(levels, resolution, converged, force)


def _pool_draws(posteriors: Sequence[Posterior]) -> dict[str, Float[np.ndarray, " draws"]]:
    """Return the logarithms of Rsc (if it is free) and of the mean force, pooled over all runs."""
    names, pooled = posteriors[0].fit.point_names, {}
    if "Rsc" in names:
        pooled["Rsc"] = np.concatenate([p.points[..., names.index("Rsc")].ravel() for p in posteriors])
    return pooled | {"force_mean": np.concatenate([np.log(p.force()["force_mean"]).ravel() for p in posteriors])}


def posterior_discrepancies(draws: dict[str, np.ndarray], reference: dict[str, np.ndarray]) -> dict[str, float]:
    """Return the differences of mean, sd and quantiles by name, in standard deviations of the reference."""
    statistic: dict[str, Callable[[np.ndarray], Any]] = {"mean": np.mean, "sd": np.std}
    statistic |= {f"q{round(100 * q):02}": functools.partial(np.quantile, q=q) for q in (0.05, 0.5, 0.95)}
    return {
        f"{name} {what}": float((compute(values) - compute(reference[name])) / np.std(reference[name]))
        for name, values in draws.items()
        for what, compute in statistic.items()
    }


def _summarize_runs(name: str, posteriors: Sequence[Posterior], discrepancies: dict[str, float]) -> BenchmarkResult:
    first, *warm = (posterior.convergence for posterior in posteriors)
    seconds = statistics.median(c.seconds for c in warm)
    points = max(c.ensembles * c.steps * c.walkers for c in warm) or posteriors[0].log_prob.size
    return BenchmarkResult(
        name,
        max(map(abs, discrepancies.values())),
        statistics.median(c.seconds / c.ess["force_mean"] for c in warm),
        None,
        max(0.0, first.seconds - seconds),
        8 * points * (posteriors[0].points.shape[-1] + 1),
        discrepancies | {"seconds": seconds, "certified": all(c.converged for c in warm)},
    )


# the work of a first answer, as a user's script does it
_FIRST_ANSWER = """
import pickle, sys, fitact
record, scene, level = pickle.load(sys.stdin.buffer)
fit = fitact.fit(record, scene)
result = fitact.sample(fit, level=level, progress=False).summary() if level else fit.derived()
"""


def benchmark_answers(
    record: Record, scene: Scene | None, draws: UncertaintyBenchmark, report: Callable[[str], None]
) -> list[BenchmarkResult]:
    """Measure the wall time from a record to the force, by least squares and by each posterior method.

    `seconds` is for a process that has answered before; `cold_seconds` of the details is for a new process without any
    stored program. The error is the largest difference of median, 5 and 95 % quantile of the mean force, relative to
    the median by emcee on the full sum; of several runs, the root mean square.
    """
    fit_seconds = statistics.median(timeit.repeat(lambda: fit_record(record, scene), number=1, repeat=3))
    fitted = fit_record(record, scene).derived()["force_mean"]
    probabilities = (0.5, 0.05, 0.95)
    reference = np.quantile(np.concatenate(draws.force["emcee, full"]), probabilities)
    stated = [np.array([fitted["q50"], fitted["q05"], fitted["q95"]], dtype=float)]
    sampling_seconds = {level.name: level.details["seconds"] for level in draws.levels}
    results = []
    for level in (None, "laplace", "psis", "emcee"):
        report(f"first answer by {level or 'least squares'} in a new process")
        quantiles = [np.quantile(force, probabilities) for force in draws.force[level]] if level else stated
        errors = [np.max(np.abs(each - reference)) / reference[0] for each in quantiles]
        sampling = 0.0 if level is None else sampling_seconds[level]
        cold = _time_first_answer(record, scene, level)
        results.append(
            BenchmarkResult(
                level or "least squares",
                float(np.sqrt(np.mean(np.square(errors)))),
                fit_seconds + sampling,
                compile_seconds=max(0.0, cold - fit_seconds - sampling),
                details={"cold_seconds": cold},
            )
        )
    return results


def _time_first_answer(record: Record, scene: Scene | None, level: str | None) -> float:
    """Return the time (s) of a new process, imports included, that finds no stored program."""
    start = time.perf_counter()
    subprocess.run(
        [sys.executable, "-c", _FIRST_ANSWER],
        input=pickle.dumps((record, scene, level)),
        env=os.environ | {"FITACT_CACHE": "off"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        check=True,
    )
    return time.perf_counter() - start
