"""Fit records: parameters, their covariance, and whether the answer may be trusted."""

import dataclasses
import math
import os
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fitact import summary
from fitact.data.record import Record
from fitact.errors import InputError
from fitact.experiment.fisher import Experiment, covariance_factor
from fitact.fitting import derived, remarks
from fitact.fitting.channel_fit import ChannelFit, information_criteria
from fitact.fitting.drive_choice import DriveModel
from fitact.fitting.identifiability import assess_identifiability
from fitact.fitting.laplace import FitResult, Laplace
from fitact.fitting.least_squares import LeastSquaresResult, solve
from fitact.fitting.levenberg_marquardt import Optima
from fitact.fitting.multistart import choose_start, find_optima, lower_optimum
from fitact.fitting.problem import Problem, build_problem
from fitact.fitting.profile import PROFILE_QUANTITIES, Interval, profile_intervals
from fitact.fitting.residual_statistics import pooled_statistics
from fitact.fitting.verdict import diagnose_fit, misfit_warnings
from fitact.likelihood import certificate
from fitact.likelihood.noise import scale_information
from fitact.model.skin import constant_skin_circuit
from fitact.scene.scene import Scene
from fitact.tables import join_lines
from fitact.units import format_engineering, quantity_unit

_SKIN = ("Rsc", "Csc", "Ci")
_RESPONSE = {
    "constant": "exact",
    "dispersive": "harmonics and time constants",
    "fractional": "time constants on a grid",
}


@dataclasses.dataclass(frozen=True)
class Fit(FitResult):
    """The best parameters, their Laplace approximation, and a judgement.

    Attributes:
        traces: the channels fitted, by record.
        compression_error: of the compressed log-likelihood near the optimum; None: samples are summed.
        experiment: the measurement that was done, at the optimum.
    """

    traces: tuple[ChannelFit, ...]
    compression_error: float | None
    experiment: Experiment

    @property
    def record(self) -> Record:
        """The record, or the first of several."""
        return self.traces[0].record

    @property
    def records(self) -> tuple[Record, ...]:
        """All of them."""
        return tuple({id(channel.record): channel.record for channel in self.traces}.values())

    @property
    def choice(self) -> DriveModel:
        """The drive of `record`."""
        return self.traces[0].choice

    @property
    def sigma(self) -> float:
        """Standard deviation of the first channel's noise, V or A, from the residuals."""
        return self.traces[0].sigma

    @property
    def residuals(self) -> Float[np.ndarray, " samples"]:
        """Record minus fit of the first channel, V or A."""
        return self.traces[0].residuals

    @property
    def linear(self) -> dict[str, float]:
        """What entered linearly and was freed, V or A, at the optimum."""
        return {name: value for channel in self.traces for name, value in channel.linear.items()}

    @property
    def full_because(self) -> str:
        """Why samples are summed, as a clause; "" where none are."""
        reasons = [f"{c.label}: " * bool(c.label) + c.full_because for c in self.traces if c.full_because]
        return "; ".join(dict.fromkeys(reasons))

    @property
    def point_names(self) -> tuple[str, ...]:
        """Coordinates of the posterior: those of theta, and the logarithm of each channel's sigma."""
        return (*self.names, *self.likelihood.sigma_names)

    @property
    def point(self) -> Float[np.ndarray, " coordinates"]:
        """The optimum in the coordinates of the posterior."""
        return np.append(self.theta, np.log(self.laplace.sigmas))

    @property
    def point_root(self) -> Float[np.ndarray, "coordinates coordinates"]:
        """As `covariance_root`, in the coordinates of the posterior; sigma's by its Fisher information."""
        freedom = np.array([channel.figures["degrees_of_freedom"] for channel in self.traces])
        information = freedom * [scale_information(channel.noise) for channel in self.likelihood.channels]
        size = self.theta.size
        root = np.diag(np.append(np.zeros(size), information**-0.5))
        root[:size, :size] = self.covariance_root
        return root

    def profile(self, name: str, level: float = 0.95, *, prior: bool = True) -> Interval:
        """The profile-likelihood interval of one parameter, or of g, b or force_mean.

        `prior`: whether the circuit's prior speaks in it (that of the posterior), or the records alone. The noise is
        held at its estimate. A side that the records leave open, to a factor of a million, is 0 or infinite.

        Raises:
            InputError: there is no quantity of that name, or the level is not between 0 and 1.
        """
        return profile_intervals(self, (name,), level, prior)[name]

    def intervals(self, level: float = 0.95, *, prior: bool = True) -> dict[str, Interval]:
        """As `profile`, of all parameters, and of g, b and force_mean.

        Raises:
            InputError: the level is not between 0 and 1.
        """
        return profile_intervals(self, (*self.names, *PROFILE_QUANTITIES), level, prior)

    def model(self) -> dict[str, Any]:
        """What was fitted, by name."""
        circuit = type(constant_skin_circuit(self.likelihood.template)).__name__
        return {
            "circuit": {"FinalCircuit": "final", "DirectGround": "direct", "NaturalGround": "natural"}[circuit],
            "skin": self.scene.skin.level,
            "response": _RESPONSE[self.scene.skin.level],
            "drive": self.choice.name,
            "steady_state": self.choice.steady_state,
            "channels": [channel.channel for channel in self.traces],
            "force": self.derive.geometry.model,
            "freed": [*self.linear, *(name for name in self.names if name not in _SKIN)],
            "likelihood": "full" if self.compression_error is None else "compressed",
            "compression_error": self.compression_error,
            "full_because": self.full_because,
        }

    def _likelihood(self) -> str:
        if self.compression_error is None:
            return f"summed over the samples each time, since {self.full_because}"
        return f"compressed to {self.likelihood.rows} numbers, off by {self.compression_error:.1g} at most"

    def judgement(self) -> dict[str, Any]:
        """The result, and the figures of merit of all channels and of each."""
        traces = [
            {"channel": t.channel, "record": os.path.basename(t.record.source), "label": t.label, **t.figures}
            for t in self.traces
        ]
        return super().judgement() | {"traces": traces}

    def _nuisances(self) -> dict[str, float]:
        return dict(zip(self.likelihood.sigma_names, self.laplace.sigmas.tolist(), strict=True)) | self.linear

    def summary(self) -> str:
        """A table for people: values with errors, correlations, the verdict."""
        names, correlation = self.names, self.correlation
        pairs = [f"{names[j]}-{names[i]} {correlation[i, j]:+.3f}" for i in range(len(names)) for j in range(i)]
        nuisances = [f"{name} {format_engineering(v, quantity_unit(name))}" for name, v in self._nuisances().items()]
        rows = [
            *self._align_table(14, 12, 12, 14),
            f"nuisances: {', '.join(nuisances)}",
            f"correlations of the logs: {', '.join(pairs)}",
            f"reduced chi-square {self.figures['chi2_reduced']:.3f}. {self.message}",
            f"log-likelihood: {self._likelihood()}.",
            f"force: {summary.FORCE_DESCRIPTIONS[self.derive.geometry.model]}.",
            str(self.identifiability),
        ]
        return join_lines(rows, self.warnings)

    __str__ = summary


def fit(
    record: Record | Sequence[Record],
    scene: Scene | Sequence[Scene] | None = None,
    *,
    prior: bool = True,
    start: Mapping[str, float] | None = None,
    starts: int = 1,
    tolerance: float = certificate.TOLERANCE,
) -> Fit:
    """Fit one circuit to a record, or to several jointly, by Levenberg-Marquardt in log-parameters with their prior.

    The circuit, the prior and the device are the (first) scene's. Each record has the drive of its scene: the
    recorded V where there is no scene or its waveform is "measured", else the scene's. Each of the scene's
    channels has its own noise; offset, drift, hum of the mains and (Vsc) a delay and a clock are freed where it asks
    for them, a gain only with the scene's prior. The start comes from the records. Runs in double precision whatever
    JAX is set to, and leaves that setting alone.

    Args:
        record: with the scene's channels, and V unless the scene has the drive.
        scene: the device, and what is believed of it; one for all records, or one for each.
        prior: False leaves the circuit's out, for least squares alone; gains, delays and clocks keep theirs.
        start: values (SI) to start from in place of the records' own.
        starts: how many; those after the first are draws of the prior, and tell whether there are other optima.
        tolerance: error of the log-likelihood that compressing the records may cause; 0: sum over the samples
            each time. Where compression does not hold, `Fit.full_because` says why.

    Raises:
        InputError: a record cannot come from this circuit, the scene asks for what is not available, a start is
            none of its parameters, or the tolerance is no number of 0 or more.
    """
    records = (record,) if isinstance(record, Record) else tuple(record)
    scenes = (scene,) * len(records) if scene is None or isinstance(scene, Scene) else tuple(scene)
    return fit_records(records, scenes, prior=prior, start=start, starts=starts, tolerance=tolerance)


def fit_records(
    records: tuple[Record, ...],
    scenes: tuple[Scene | None, ...],
    drives: Sequence[DriveModel | None] = (),
    *,
    prior: bool = True,
    start: Mapping[str, float] | None = None,
    starts: int = 1,
    tolerance: float = certificate.TOLERANCE,
) -> Fit:
    """Fit as `fit`; `drives` are those of the first records where they have been chosen already."""
    if not 0.0 <= tolerance < math.inf:
        raise InputError(f"tolerance = {tolerance}: give an error of the log-likelihood, 0.001 or so, or 0 for none")
    if starts < 1:
        raise InputError(f"starts = {starts}: give 1 or more")
    if not records or len(scenes) != len(records):
        raise InputError(f"{len(records)} records and {len(scenes)} scenes: give one scene for all, or one for each")
    if len({record.fingerprint for record in records}) < len(records):
        raise InputError(
            f"{records[0].source}: one record was given twice, which would count its samples twice; drop one"
        )
    for scene in scenes:
        (scene or Scene()).require_available(fit=True)
    with jax.enable_x64(True):
        try:
            problem = build_problem(records, scenes, prior, drives)
            solved, certified, root = _solve_problem(problem, tolerance, start)
            optima = find_optima(solved, starts) if starts > 1 else None
            lower = None if optima is None else lower_optimum(optima, solved)
            if lower is not None:
                solved, certified, root = _solve_problem(problem, tolerance, lower)
            return _assemble_fit(problem, solved, certified, root, optima, without_scene=scenes[0] is None)
        except np.linalg.LinAlgError as error:
            raise InputError(
                f"{records[0].source}: the channels cannot be computed with ({error}); check for a huge offset or a"
                " wrong unit"
            ) from error


def _solve_problem(
    problem: Problem, tolerance: float, start: Mapping[str, float] | None
) -> tuple[LeastSquaresResult, certificate.CertifiedLikelihood, np.ndarray]:
    """The fit, with compressions where they hold, and its covariance's root; again where they turn out not to."""
    (likelihood, reasons), theta_0 = problem.compress_likelihood(tolerance), choose_start(problem, start)
    noise = np.array([source.noise for source in problem.sources])
    freeable = tuple(source.optional_nuisances for source in problem.sources)
    while True:
        solved = solve(likelihood, theta_0, noise, freeable)
        root = covariance_factor(np.concatenate(solved.jacobian), solved.likelihood.prior_factor)
        theta, sigma = np.asarray(solved.theta), np.asarray(solved.sigma)
        certified = certificate.certify(solved.likelihood, reasons, theta, root, sigma, tolerance)
        pairs = zip(solved.likelihood.channels, certified.reasons, strict=True)
        failed = [bool(reason) and channel.compression is not None for channel, reason in pairs]
        if not any(failed):
            return solved, certified, root
        reasons = certified.reasons
        for i, channel in enumerate(likelihood.channels):
            likelihood = likelihood.replace_channel(i, channel.without_compression() if failed[i] else channel)


def _assemble_fit(
    problem: Problem,
    solution: LeastSquaresResult,
    certified: certificate.CertifiedLikelihood,
    root: Float[np.ndarray, "parameters parameters"],
    optima: Optima | None,
    without_scene: bool,
) -> Fit:
    likelihood, theta, sigma = certified.likelihood, np.asarray(solution.theta), np.asarray(solution.sigma)
    first = problem.sources[0]
    b = float(likelihood.circuit(jnp.asarray(theta)).b)
    derive = derived.derived_from_fit(likelihood, first.record, first.choice, first.scene, b)
    laplace = Laplace(theta, root, sigma, likelihood, derive, derive.log_value_and_grad(theta, sigma))
    traces = tuple(
        ChannelFit.from_optimum(likelihood, i, theta, float(sigma[i]), source, certified.reasons[i])
        for i, source in enumerate(problem.sources)
    )
    figures = pooled_statistics([channel.figures for channel in traces]) | {"steps": int(solution.steps)}
    figures |= information_criteria(theta.size, traces)
    if optima is not None:
        figures |= {"optima": len(optima.start_counts), "starts_failed": optima.n_failed}
    warnings: list[str] = []
    for source, channel in zip(problem.sources, traces, strict=True):
        warnings += source.notes
        warnings += remarks.channel_warnings(source.record, source.choice, channel.channel, channel.figures)
    warnings += misfit_warnings(traces)
    warnings += remarks.parameter_warnings(likelihood, theta, without_scene)
    experiment = problem.experiment(likelihood, theta, sigma)
    gradient = laplace.log_gradient("force_mean")
    return Fit(
        laplace,
        result=diagnose_fit(solution, root, traces, problem.sources, optima),
        figures=figures,
        identifiability=assess_identifiability(likelihood.names, root, likelihood.prior_factor, gradient, experiment),
        scene=first.scene,
        warnings=tuple(dict.fromkeys(warnings)),
        traces=traces,
        compression_error=certified.error,
        experiment=experiment,
    )
