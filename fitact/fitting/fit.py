"""Fit records: parameters, their covariance, and whether the fit is reliable."""

import dataclasses
import functools
import math
import os
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from fitact import charts, summary
from fitact.data.kramers_kronig import KramersKronig, check_kramers_kronig
from fitact.data.record import Record, rounding_noise_sd
from fitact.data.spectrum import Spectrum
from fitact.errors import InputError
from fitact.experiment.fisher import Experiment
from fitact.fitting import derived, remarks
from fitact.fitting.calibrate import calibrate
from fitact.fitting.channel_fit import ChannelFit, information_criteria
from fitact.fitting.effects import assess_fit, describe_alternatives, describe_structure, is_tolerable
from fitact.fitting.error_sources import (
    gain_shifts,
    geometry_component,
    list_error_sources,
    noise_information,
    structure_components,
)
from fitact.fitting.fit_figures import plot_fit, plot_identifiability
from fitact.fitting.geometry import UncertainGeometry
from fitact.fitting.identifiability import assess_identifiability, assess_parameters
from fitact.fitting.laplace import FitResult, Laplace
from fitact.fitting.least_squares import LeastSquaresResult
from fitact.fitting.minimum import Optima
from fitact.fitting.multistart import find_optima, lower_optimum
from fitact.fitting.profile import PROFILE_QUANTITIES, Interval, profile_intervals
from fitact.fitting.residual_statistics import is_misfit, is_undersampled, pooled_statistics
from fitact.fitting.solution import solve_problem
from fitact.fitting.verdict import diagnose_fit, misfit_warnings
from fitact.instrument.classes import TYPICAL, typical_gain_u
from fitact.likelihood import certificate
from fitact.likelihood.likelihood import CircuitValues
from fitact.likelihood.noise import scale_information
from fitact.model.circuit import FINGER_PARAMETERS
from fitact.model.skin import circuit_parameters, constant_skin_circuit
from fitact.problem.build import Problem, build_problem
from fitact.problem.drive_choice import DriveModel
from fitact.problem.recorded_current import estimate_noise
from fitact.problem.source import require_record
from fitact.scene.scene import Scene
from fitact.tables import join_lines, to_dataframe
from fitact.uncertainty.budget import Budget, ErrorSource, laplace_components
from fitact.uncertainty.effect_size import NO_EFFECTS, EffectSizes

_RESPONSE = {
    "constant": "exact",
    "dispersive": "harmonics and time constants",
    "fractional": "time constants on a grid",
}


@dataclasses.dataclass(frozen=True, repr=False)
class Fit(FitResult):
    """Fit of one circuit to records: best parameters, their Laplace approximation, and whether it is reliable.

    Attributes:
        traces: the fitted channels of each record.
        compression_error: error of the compressed log-likelihood near the optimum; None if all samples are summed.
        experiment: the measurement at the optimum, for designs; None with a spectrum.
        error_sources: sources of error of each coordinate of theta.
        noise_information: root of the Fisher information of each source of noise.
        gain_shifts: change of theta for a relative error of 1 in the gain of V, Vsc or I that nobody stated.
        misfit_effects: effects of what the model lacks, where the verdict needed them.
        kramers_kronig: the worst of the tests of the spectra; None without spectra.
    """

    traces: tuple[ChannelFit, ...]
    compression_error: float | None
    experiment: Experiment | None
    error_sources: tuple[tuple[ErrorSource, ...], ...]
    noise_information: dict[str, Float[np.ndarray, "rows parameters"]]
    gain_shifts: dict[str, Float[np.ndarray, " parameters"]]
    misfit_effects: EffectSizes | None = None
    kramers_kronig: KramersKronig | None = None

    @functools.cached_property
    def budgets(self) -> dict[str, Budget]:
        """Uncertainty budgets of the free parameters of the skin and insulator, and of the derived quantities."""
        roots, geometry = (self.covariance_root, self.likelihood.prior_factor), self.geometry_contributions()
        budgets = {}
        for name, gradient in self._gradients.items():
            components = laplace_components(gradient, *roots, self.error_sources, self.noise_information)
            # the scale of a force has the uncertainty of the force that it scales
            in_geometry = geometry["force_mean" if name == "force_scale" else name]
            others = (*map(geometry_component, in_geometry), *structure_components(self.effects, name))
            budgets[name] = Budget((*components, *others))
        return budgets

    @functools.cached_property
    def _gradients(self) -> dict[str, Float[np.ndarray, " parameters"]]:
        """Gradients of the logarithms of the quantities with a budget, in theta."""
        gradients = dict(zip(self.names, np.eye(self.theta.size), strict=True))
        moments = self.geometry.approximate(self.likelihood, self.theta, self.laplace.log_derived)
        derivatives = zip(derived.DERIVED_NAMES, moments.gradients, strict=True)
        names = (*FINGER_PARAMETERS, "force_scale")
        return {name: gradients[name] for name in names if name in gradients} | dict(derivatives)

    def calibration_entry(self, name: str) -> dict[str, Any]:
        """Return `stated` and `not_stated` of the budget of a quantity: gain errors that nobody stated."""
        section, measurement = self.scene.instrument, self.scene.measurement
        stated = {"Vsc": measurement.gain_relative_sd > 0.0, "I": measurement.gain_I_relative_sd > 0.0}
        gradient, entries = self._gradients[name], []
        for channel, shift in self.gain_shifts.items():
            if section.pieces(channel) or stated.get(channel) or (channel == "Z" and section.pieces("I")):
                continue
            # the force is computed from V, beside the parameters that follow from it
            direct = 2.0 if channel == "V" and name in derived.DERIVED_NAMES and name.startswith("force") else 0.0
            u = typical_gain_u(channel)
            typical = " and ".join(TYPICAL[channel])
            entries.append({"source": f"{channel} gain", "typical": typical, "input_u": u})
            entries[-1]["u"] = abs(float(gradient @ shift) + direct) * u
        return {"stated": section.is_stated, "not_stated": entries}

    def unchanged_force_u(self) -> tuple[float, float, str]:
        """Return u of the log mean force from what no suggested measurement changes, now and after it, and the sources.

        The uncertainty of the fit already contains stated gains.
        """
        name, V = "force_mean", self.scene.gain_u("V")
        geometry = math.hypot(*(each.relative_sd * each.sensitivity for each in self.geometry_contributions()[name]))
        missing = self.calibration_entry(name)["not_stated"]
        unstated = math.hypot(*(each["u"] for each in missing))
        sources = ["thickness, area and friction"] if geometry else []
        if missing:
            sources.append(f"usual gain errors of {' and '.join(each['source'][:-5] for each in missing)}")
        if V:
            sources.append("the gain of V")
        return math.hypot(geometry, unstated), math.hypot(geometry, unstated, V), " and ".join(sources)

    @property
    def record(self) -> Record:
        """The record, or the first of several; InputError if there are only spectra."""
        return require_record(self.traces[0].record)

    @property
    def records(self) -> tuple[Record | Spectrum, ...]:
        """All records and spectra."""
        return tuple({id(channel.record): channel.record for channel in self.traces}.values())

    @property
    def choice(self) -> DriveModel:
        """Drive of `record`."""
        return self.traces[0].choice

    @property
    def uses_stated_drive(self) -> bool:
        """Whether the scene's drive was used, and not the recorded V."""
        return self.choice.name != "measured"

    @property
    def sigma(self) -> float:
        """Standard deviation of the first channel's noise, V or A, from the residuals."""
        return self.traces[0].sigma

    @property
    def residuals(self) -> Float[np.ndarray, " samples"]:
        """Residuals (data - fit) of the first channel, V or A."""
        return self.traces[0].residuals

    @property
    def linear(self) -> dict[str, float]:
        """Linear nuisances that were fitted, V or A, at the optimum."""
        return {name: value for channel in self.traces for name, value in channel.linear.items()}

    @property
    def full_because(self) -> str:
        """Reason why all samples are summed, as a clause; "" if the likelihood is compressed."""
        reasons = [f"{c.label}: " * bool(c.label) + c.full_because for c in self.traces if c.full_because]
        return "; ".join(dict.fromkeys(reasons))

    @property
    def point_names(self) -> tuple[str, ...]:
        """Coordinates of the posterior: theta, then the logarithm of each channel's sigma."""
        return (*self.names, *self.likelihood.sigma_names)

    @property
    def point(self) -> Float[np.ndarray, " coordinates"]:
        """The optimum in the coordinates of the posterior."""
        return np.append(self.theta, np.log(self.laplace.sigmas))

    @property
    def point_root(self) -> Float[np.ndarray, "coordinates coordinates"]:
        """Factor of the covariance in the coordinates of the posterior; for sigma from its Fisher information."""
        freedom = np.array([channel.figures["degrees_of_freedom"] for channel in self.traces])
        information = freedom * [scale_information(channel.noise) for channel in self.likelihood.channels]
        size = self.theta.size
        root = np.diag(np.append(np.zeros(size), information**-0.5))
        root[:size, :size] = self.covariance_root
        return root

    @property
    def sampling_order(self) -> list[int]:
        """Coordinates of the posterior, those that the data narrow least first; empty without stated instruments."""
        if not self.scene.instrument.is_stated:
            return []
        ratio = self.sd / np.linalg.norm(self.likelihood.prior_factor, axis=1)
        return [*np.argsort(-ratio, kind="stable").tolist(), *range(self.theta.size, self.point.size)]

    @functools.cached_property
    def effects(self) -> EffectSizes:
        """How far the results may move because of what the model lacks; empty if that cannot be computed."""
        if self.misfit_effects is not None:
            return self.misfit_effects
        usable = self.result in ("successful", "misfit", "structure")
        return (assess_fit(self.laplace, self.traces, has_structure=False) if usable else None) or NO_EFFECTS

    @property
    def effect_notes(self) -> tuple[str, ...]:
        """Sentences on nuisances that may really be something else."""
        return describe_alternatives(self.effects, self.laplace)

    @property
    def message(self) -> str:
        """Sentence for the result, and what the residuals look like."""
        if self.result not in ("misfit", "structure"):
            return super().message
        return describe_structure(self.result, super().message, self.effects)

    def profile(self, name: str, level: float = 0.95, *, prior: bool = True) -> Interval:
        """Return the profile-likelihood interval of one parameter, or of g, b or force_mean.

        `prior`: whether to include the prior of the circuit. The noise is fixed at its estimate. A bound that the data
        do not determine within a factor of a million is 0 or infinite.

        Raises:
            InputError: there is no quantity of that name, or the level is not between 0 and 1.
        """
        return profile_intervals(self, (name,), level, prior)[name]

    def intervals(self, level: float = 0.95, *, prior: bool = True) -> dict[str, Interval]:
        """Return the profile-likelihood intervals of all parameters, and of g, b and force_mean; see `profile`.

        Raises:
            InputError: the level is not between 0 and 1.
        """
        return profile_intervals(self, (*self.names, *PROFILE_QUANTITIES), level, prior)

    def plot(self, record: int = 0) -> Any:
        """Draw V, and each fitted channel with its fit and residuals, on one axis of time or frequency.

        `record` counts the records and spectra. Returns the axes, from top to bottom.
        """
        return plot_fit(self, record)

    def plot_budget(self) -> Any:
        """Draw the largest components of each quantity's combined uncertainty, and return the axes."""
        return np.array(charts.draw_budgets(self.budget_entries(), make=charts.pyplot_figure).axes)

    def plot_identifiability(self, ax: Any = None) -> Any:
        """Draw the 95 % regions of two parameters before and after the data, in the Laplace approximation.

        They are the two that change most in the direction that the data constrain least. Returns the axes.
        """
        return plot_identifiability(self, ax)

    def to_dataframe(self) -> Any:
        """Return a pandas DataFrame with a row for each parameter and derived quantity, by name, in SI units.

        Columns are those of `parameters()`: unit, mean, sd, quantiles, u, contraction and from_prior.
        """
        return to_dataframe(self.parameters() | self.derived(), orient="index")

    @property
    def _headline(self) -> str:
        values, sd = self.likelihood.to_physical(self.theta), dict(zip(self.names, self.sd, strict=True))
        estimates = {
            name: summary.summarize_log_normal(name, float(values[name]), float(sd[name]))
            for name in FINGER_PARAMETERS
            if name in sd
        }
        first, others = os.path.basename(self.records[0].source), len(self.records) - 1
        source = f"{first} and {others} more" if others else first
        state = self.identifiability.verdict, "reliable" if self.trusted else f"unreliable ({self.result})"
        return ", ".join((source, summary.format_estimates(estimates), *state))

    def _rows(self) -> list[tuple[str, ...]]:
        content = {"parameters": self.parameters(), "derived": self.derived(), "force_basis": self.force_basis}
        return summary.quantity_table(content)

    def _sentences(self) -> list[str]:
        law = summary.force_sentences(self.force_basis)[0]
        share = 100.0 * self.identifiability.force_from_prior
        return [self.message, f"The prior contributes {share:.3g} % of the variance of the force.", law]

    def model(self) -> dict[str, Any]:
        """Return the fitted model by name."""
        circuit = type(constant_skin_circuit(self.likelihood.template)).__name__
        has_spectrum = any(isinstance(record, Spectrum) for record in self.records)
        return {
            "circuit": {"FinalCircuit": "final", "DirectGround": "direct", "NaturalGround": "natural"}[circuit],
            "skin": self.scene.skin.level,
            "response": _RESPONSE[self.scene.skin.level],
            "drive": self.choice.name,
            "steady_state": self.choice.steady_state,
            "channels": [channel.channel for channel in self.traces],
            "force": self.derive.geometry.model,
            "freed": [*self.linear, *(name for name in self.names if name not in FINGER_PARAMETERS)],
            "likelihood": "full" if self.compression_error is None else "compressed",
            "compression_error": self.compression_error,
            "full_because": self.full_because,
            **({"weighting": self.scene.measurement.weighting} if has_spectrum else {}),
        }

    def _likelihood(self) -> str:
        if self.compression_error is None:
            return f"summed over all samples in each evaluation, because {self.full_because}"
        return (
            f"computed from {self.likelihood.rows} projection coefficients of the data; error at most"
            f" {self.compression_error:.1g}"
        )

    def judgement(self) -> dict[str, Any]:
        """Return the result, and the figures of merit of all channels together and of each."""
        traces = [
            {"channel": t.channel, "record": os.path.basename(t.record.source), "label": t.label, **t.figures}
            for t in self.traces
        ]
        return super().judgement() | {"traces": traces}

    def to_dict(self) -> dict[str, Any]:
        """Return the content of fit.json, which `fitact fit --json` prints."""
        content = super().to_dict() | self.effects.to_dict() | self.validity()
        return content | {"notes": [*self.notes, *self.effect_notes]}

    def validity(self) -> dict[str, Any]:
        """Return `kramers_kronig` of fit.json, for spectra only, and `noise`, for records."""
        validity: dict[str, Any] = {"noise": self.noise()}
        return validity | ({} if self.kramers_kronig is None else {"kramers_kronig": self.kramers_kronig.to_dict()})

    def noise(self) -> dict[str, dict[str, Any]]:
        """Return the noise of each recorded channel, V among them: `sd`, `rounding` (rms, SI units) and `source`."""
        found = {}
        for trace in self.traces:
            if isinstance(trace.record, Record):
                number = trace.label.rpartition("_")[2]
                suffix = f"_{number}" if number.isdigit() else ""
                known = {trace.channel: trace.sigma}
                if "V" in trace.record:
                    known = {"V": estimate_noise(trace.record["V"])} | known
                for name, sd in known.items():
                    rounding = rounding_noise_sd(trace.record[name])
                    found[name + suffix] = {"sd": sd, "rounding": rounding, "source": "estimated"}
        return found

    def _nuisances(self) -> dict[str, float]:
        return dict(zip(self.likelihood.sigma_names, self.laplace.sigmas.tolist(), strict=True)) | self.linear

    def summary(self) -> str:
        """Return a table for people: estimates with errors, what the force rests on, and the verdict."""
        names, correlation = list(self.identifiability.blind_direction), self.correlation
        places = [self.names.index(name) for name in names]
        pairs = [
            f"{names[j]}-{names[i]} {correlation[places[i], places[j]]:+.3f}"
            for i in range(len(names))
            for j in range(i)
        ]
        chi_square, content = self.figures["chi2_reduced"], self.to_dict()
        rows = [
            *summary.format_table(content),
            f"Correlations of the log-parameters: {', '.join(pairs)}.",
            f"Residual variance / model-free noise variance: {chi_square:.3f}. {self.message}",
            f"Log-likelihood: {self._likelihood()}.",
            str(self.identifiability),
            *summary.advice_line(content),
        ]
        return join_lines(rows, self.warnings, content["notes"])

    __str__ = summary


def fit(
    record: Record | Spectrum | Sequence[Record | Spectrum],
    scene: Scene | Sequence[Scene] | None = None,
    *,
    prior: bool = True,
    start: Mapping[str, float] | None = None,
    starts: int = 1,
    tolerance: float = certificate.TOLERANCE,
) -> Fit:
    """Fit one circuit to records and spectra, jointly, by Levenberg-Marquardt in log-parameters with their prior.

    The scene of the first record (or spectrum, without records) gives the circuit, the prior and the device. The drive
    is the recorded V if there is no scene or its waveform is "measured", otherwise the waveform of the record's scene.
    Each channel has its own noise; that of a recorded V is part of the likelihood of I, whose delay is then free.
    Offset, drift, mains hum and (for Vsc) delay and clock error are added as free parameters if the BIC favours them;
    a gain is free with a prior in the scene, or where V is coarsely rounded. The start is estimated from the records.
    Computes in double precision and leaves the setting of JAX unchanged.

    Args:
        record: record or spectrum, or several. A record has the channels of the scene; V too, unless the scene states
            the drive. The force is that of the first record's drive, or of the scene's if there are only spectra.
        scene: device, circuit and prior; one for all records, or one for each.
        prior: whether to use the prior of the circuit; gains, delays and clocks always keep theirs.
        start: parameter values (SI) to start from instead of the estimate from the data.
        starts: number of starting points; the first is estimated from the data, the others are drawn from the prior
            and reveal further optima.
        tolerance: largest error of the log-likelihood from compression; 0 sums over all samples in each evaluation.
            `Fit.full_because` gives the reason where compression is not accurate enough.

    Raises:
        InputError: a record is impossible for this circuit, the scene needs a model that is not available, `start`
            names an unknown parameter, or the tolerance is negative or not a number.
    """
    records = (record,) if isinstance(record, Record | Spectrum) else tuple(record)
    scenes = (scene,) * len(records) if scene is None or isinstance(scene, Scene) else tuple(scene)
    return fit_records(records, scenes, prior=prior, start=start, starts=starts, tolerance=tolerance)


def fit_records(
    records: tuple[Record | Spectrum, ...],
    scenes: tuple[Scene | None, ...],
    drives: Sequence[DriveModel | None] = (),
    *,
    prior: bool = True,
    start: Mapping[str, float] | None = None,
    starts: int = 1,
    tolerance: float = certificate.TOLERANCE,
) -> Fit:
    """Fit records as `fit` does; `drives` are the drives of the first records if they were chosen already."""
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
    pairs = sorted(zip(records, scenes, strict=True), key=lambda pair: isinstance(pair[0], Spectrum))  # records first
    records, scenes = (tuple(each) for each in zip(*pairs, strict=True))
    with jax.enable_x64(True):
        try:
            problem = build_problem(records, scenes, prior, drives)
            calibrated = calibrate(scenes[0], problem.likelihood.prior.names, fit_records)
            if calibrated.calibration is not None:
                likelihood = dataclasses.replace(problem.likelihood, calibration=calibrated.calibration)
                problem = problem._replace(likelihood=likelihood)
            solved, certified, root = solve_problem(problem, tolerance, start)
            optima = find_optima(solved, starts) if starts > 1 else None
            lower = None if optima is None else lower_optimum(optima, solved)
            if lower is not None:
                solved, certified, root = solve_problem(problem, tolerance, lower)
            fitted = _assemble_fit(problem, solved, certified, root, optima, without_scene=scenes[0] is None)
            return dataclasses.replace(
                fitted,
                warnings=(*calibrated.warnings, *fitted.warnings),
                notes=(*calibrated.notes, *fitted.notes),
            )
        except InputError:
            raise
        except Exception as error:  # whatever it is, other records are to go on
            raise InputError(
                f"{records[0].source}: the channels cannot be computed with ({type(error).__name__}: {error}); check"
                " for a huge offset, a wrong unit, or a channel without a signal"
            ) from error


def _assemble_fit(
    problem: Problem,
    solution: LeastSquaresResult,
    certified: certificate.CertifiedLikelihood,
    root: Float[np.ndarray, "parameters parameters"],
    optima: Optima | None,
    without_scene: bool,
) -> Fit:
    likelihood, theta, sigma = certified.likelihood, solution.theta, solution.sigma
    first = problem.sources[0]
    optimum = likelihood.evaluate_circuit(theta)
    if isinstance(first.record, Spectrum):
        derive = derived.derived_from_scene(likelihood, first.scene)
    else:
        derive = derived.derived_from_fit(likelihood, first.record, first.choice, first.scene, float(optimum.b))
    laplace = Laplace(theta, root, sigma, likelihood, derive, derive.log_value_and_grad(theta, sigma))
    traces = tuple(
        ChannelFit.from_optimum(likelihood, i, theta, float(sigma[i]), optimum, source, certified.reasons[i])
        for i, source in enumerate(problem.sources)
    )
    figures = pooled_statistics([channel.figures for channel in traces]) | {"steps": solution.steps}
    figures |= information_criteria(theta.size, traces)
    if optima is not None:
        figures |= {"optima": len(optima.start_counts), "starts_failed": optima.n_failed}
    said = _collect_remarks(problem, laplace, traces, optimum, without_scene)
    tests = [check_kramers_kronig(each.record) for each in traces if isinstance(each.record, Spectrum)]
    experiment = problem.experiment(likelihood, optimum.circuit, theta, sigma)
    evidence = likelihood.names, root, likelihood.prior_factor, laplace.log_gradient("force_mean")
    if experiment is None:
        free = [name for name in likelihood.names if name in circuit_parameters(likelihood.template)]
        channels = tuple(dict.fromkeys(channel.channel for channel in traces))
        identifiability = assess_parameters(*evidence, free, channels)
    else:
        identifiability = assess_identifiability(*evidence, experiment)
    result, effects = diagnose_fit(solution, root, traces, optima), None
    poor = [trace for trace in traces if is_misfit(trace.figures)]
    if result == "misfit" and any(trace.channel != "Ft" for trace in poor):
        effects = assess_fit(laplace, traces, has_structure=True)
        # what a poor fit of the friction, or of a current with a recorded drive, may move is not assessed
        assessed = {each.label for each in likelihood.channels if each.charges is None and each.channel != "Ft"}
        may_move = any(is_undersampled(trace.figures) or trace.label not in assessed for trace in poor)
        if effects is not None and not may_move and is_tolerable(effects, laplace, first.scene.tolerance.force):
            result = "structure"
    whole = Fit(
        laplace,
        result=result,
        figures=figures,
        identifiability=identifiability,
        scene=first.scene,
        warnings=tuple(dict.fromkeys([*said.warnings, *(test.doubt for test in tests if test.doubt)])),
        notes=tuple(dict.fromkeys(said.notes)),
        traces=traces,
        compression_error=certified.error,
        experiment=experiment,
        error_sources=list_error_sources(likelihood, problem.coordinates, first.scene),
        noise_information=noise_information(likelihood, solution),
        gain_shifts=gain_shifts(likelihood, solution, root),
        misfit_effects=effects,
        kramers_kronig=max(tests, key=lambda test: (not test.passed, test.worst_residual), default=None),
    )
    now, after, sources = whole.unchanged_force_u()
    judgement = dataclasses.replace(whole.identifiability, unchanged_u=(now, after), unchanged_sources=sources)
    return dataclasses.replace(whole, identifiability=judgement)


def _collect_remarks(
    problem: Problem,
    laplace: Laplace,
    traces: tuple[ChannelFit, ...],
    optimum: CircuitValues,
    without_scene: bool,
) -> remarks.Remarks:
    """Return what is to be said of the records, the parameters and the scene."""
    likelihood, theta, first = laplace.likelihood, laplace.theta, problem.sources[0]
    warnings: list[str] = []
    notes = [source.scene.description for source in problem.sources if source.scene.description]
    for source in problem.sources:
        fitted = {channel.channel for channel in traces if channel.record is source.record}
        if isinstance(source.record, Record):
            notes += remarks.unfitted_channel_notes(source.record, fitted)
    for source, channel in zip(problem.sources, traces, strict=True):
        warnings += source.warnings
        notes += source.notes
        if isinstance(source.record, Record):
            warnings += remarks.channel_warnings(source.record, source.choice, channel.channel, channel.figures)
    warnings += misfit_warnings(traces)
    warnings += remarks.parameter_warnings(likelihood, theta)
    stated = [each.name for each in problem.coordinates if each.is_stated]
    spread = np.linalg.norm(laplace.covariance_root, axis=1)
    warnings += remarks.prior_warnings(likelihood, theta, spread, stated)
    force_peak = math.exp(laplace.log_derived[0][derived.DERIVED_NAMES.index("force_peak")])
    warnings += remarks.plausibility_warnings(first.record, first.scene, first.choice, optimum, force_peak)
    notes += remarks.stray_notes(problem.sources, traces, optimum)
    assumed = remarks.describe_assumed_Ci(None if without_scene else first.scene, likelihood, laplace.prior_sets_Ci)
    notes += assumed.notes
    notes += UncertainGeometry.from_scene(first.scene, laplace.derive.geometry).notes(first.scene, likelihood, theta)
    return remarks.Remarks(tuple(notes), (*warnings, *assumed.warnings))
