"""Result of a fit: parameters, derived quantities, budgets and verdict, as numbers, tables and figures."""

import dataclasses
import functools
import math
import os
from typing import Any

import numpy as np
from jaxtyping import Float

from fitact import charts, result_text, summary
from fitact.data.kramers_kronig import KramersKronig
from fitact.data.noise import estimate_noise, rounding_noise_sd
from fitact.data.record import Record
from fitact.data.spectrum import Spectrum
from fitact.experiment.fisher import Experiment
from fitact.fitting import derived
from fitact.fitting.channel_fit import ChannelFit
from fitact.fitting.effects import assess_fit, describe_alternatives, describe_structure
from fitact.fitting.error_sources import (
    UnstatedError,
    geometry_component,
    list_unstated_errors,
    structure_components,
)
from fitact.fitting.fit_figures import plot_fit, plot_identifiability
from fitact.fitting.geometry import Contribution
from fitact.fitting.identifiability import Identifiability, assess_identifiability
from fitact.fitting.laplace import Laplace
from fitact.fitting.outcome import RESULTS
from fitact.fitting.profile import PROFILE_QUANTITIES, Interval, profile_intervals
from fitact.likelihood.likelihood import Likelihood
from fitact.likelihood.noise import scale_information
from fitact.model.circuit import FINGER_PARAMETERS
from fitact.model.force import ForceModel
from fitact.model.skin import circuit_parameters, constant_skin_circuit
from fitact.problem.drive_choice import DriveModel
from fitact.problem.source import require_record
from fitact.scene.assumptions import list_assumptions
from fitact.scene.scene import Scene
from fitact.tables import Display, to_dataframe
from fitact.uncertainty.budget import Budget, Component, laplace_components
from fitact.uncertainty.effect_size import NO_EFFECTS, EffectSizes
from fitact.units import quantity_unit

_RESPONSE = {
    "constant": "exact",
    "dispersive": "harmonics and time constants",
    "fractional": "time constants on a grid",
}


@dataclasses.dataclass(frozen=True, repr=False)
class Fit(Display):
    """Fit of one circuit to records: best parameters, their Laplace approximation, and whether it is reliable.

    Attributes:
        laplace: best parameters and derived quantities, with their covariance.
        result: name of a member of `RESULTS`; `message` is its sentence.
        figures: chi2_reduced, steps and other statistics.
        scene: scene of the first record, whose circuit and prior were fitted.
        warnings: sentences on what may change the result.
        notes: sentences for information.
        traces: the fitted channels of each record.
        compression_error: error of the compressed log-likelihood near the optimum; None if all samples are summed.
        experiment: the measurement at the optimum, for designs; None with a spectrum.
        error_sources: sources of error of each coordinate of theta.
        noise_information: root of the Fisher information of each source of noise.
        gain_shifts: change of theta for a relative error of 1 in the gain of V, Vsc or I that nobody stated.
        stray_changes: relative changes of Rsc, Csc and Ci by a usual stray capacitance that nobody stated.
        misfit_effects: effects of what the model lacks, where the verdict needed them.
        kramers_kronig: the worst of the tests of the spectra; None without spectra.
    """

    laplace: Laplace
    result: str
    figures: dict[str, float]
    scene: Scene
    warnings: tuple[str, ...]
    notes: tuple[str, ...]
    traces: tuple[ChannelFit, ...]
    compression_error: float | None
    experiment: Experiment | None
    error_sources: tuple[tuple[Component, ...], ...]
    noise_information: dict[str, Float[np.ndarray, "rows parameters"]]
    gain_shifts: dict[str, Float[np.ndarray, " parameters"]]
    stray_changes: dict[str, float]
    misfit_effects: EffectSizes | None = None
    kramers_kronig: KramersKronig | None = None

    @property
    def trusted(self) -> bool:
        """Whether the fit is reliable."""
        return self.result in summary.TRUSTED_RESULTS

    @property
    def names(self) -> tuple[str, ...]:
        """Coordinates of theta: logarithms of parameters; delays and clocks in time steps."""
        return self.likelihood.names

    @property
    def theta(self) -> Float[np.ndarray, " parameters"]:
        """The optimum, in the coordinates `names`."""
        return self.laplace.theta

    @property
    def covariance(self) -> Float[np.ndarray, "parameters parameters"]:
        """Covariance of theta, in the Laplace approximation."""
        return self.covariance_root @ self.covariance_root.T

    @property
    def covariance_root(self) -> Float[np.ndarray, "parameters parameters"]:
        """Factor of `covariance`, i.e. covariance = factor @ factor.T; more accurate than the covariance."""
        return self.laplace.covariance_root

    @property
    def sd(self) -> Float[np.ndarray, " parameters"]:
        """Standard deviations of theta."""
        return np.linalg.norm(self.covariance_root, axis=1)

    @property
    def correlation(self) -> Float[np.ndarray, "parameters parameters"]:
        """Correlations of theta."""
        return self.covariance / np.outer(self.sd, self.sd)

    @property
    def likelihood(self) -> Likelihood:
        """The likelihood that was fitted."""
        return self.laplace.likelihood

    @property
    def derive(self) -> derived.DerivedQuantities:
        """The derived quantities as functions of theta."""
        return self.laplace.derive

    @functools.cached_property
    def identifiability(self) -> Identifiability:
        """Which parameters the data determine."""
        evidence = (
            self.names,
            self.covariance_root,
            self.likelihood.prior_factor,
            self.laplace.log_gradient("force_mean"),
        )
        free = [name for name in self.names if name in circuit_parameters(self.likelihood.template)]
        channels = tuple(dict.fromkeys(trace.channel for trace in self.traces))
        channels = channels if self.experiment is None else self.experiment.channels
        return assess_identifiability(*evidence, free, channels, self.experiment, self.unchanged_force_u())

    def _summarize(self, name: str, value: float, log_sd: float) -> summary.Summary:
        """Summarize a positive quantity, with the shape of the distributions of its sources of error."""
        result = summary.summarize_log_normal(name, value, log_sd)
        budget = self.budgets.get(name)
        if budget is None:
            return result if name in self.assumed_quantities else result | {"u": log_sd}
        if math.isfinite(log_sd):
            result |= _scale_quantiles(value, budget, only_posterior=True)
        combined = summary.summarize_log_normal(name, value, budget.combined_budget.u)
        if math.isfinite(budget.combined_budget.u):
            combined |= _scale_quantiles(value, budget.combined_budget)
        entry = summary.describe_combined(combined, budget.combined_budget.u, budget.combined_budget.origins())
        return result | {"u": budget.u, "combined": entry}

    def parameters(self) -> dict[str, summary.Summary]:
        """Summarize the parameters in the Laplace approximation.

        `sd` and the quantiles are those of the posterior alone, `u` is the relative standard uncertainty from all
        stated sources, and `combined` has sd and quantiles with usual errors of what nobody stated, too.

        `contraction` is 1 - posterior sd / prior sd of the logarithm; `from_prior` is the fraction of the variance of
        the logarithm that comes from the prior.
        """
        values, timing = self.likelihood.to_physical(self.theta), self.likelihood.timing
        summaries, from_prior = {}, self.laplace.variance_from_prior(np.eye(self.theta.size))
        for i, name in enumerate(self.names):
            value, sd = float(values[name]), float(self.sd[i])
            if name in timing:
                absolute = sd * timing[name][1]
                summaries[name] = summary.summarize_normal(name, value, absolute)
                summaries[name]["u"] = absolute / abs(value) if value else math.inf
            else:
                summaries[name] = self._summarize(name, value, sd)
                if self.likelihood.use_prior or name.startswith("gain"):
                    summaries[name]["contraction"] = float(1.0 - sd / self.likelihood.prior.log_sd[i])
            summaries[name]["from_prior"] = float(from_prior[i])
        return summaries

    def derived(self) -> dict[str, summary.Summary]:
        """Summarize divider, time constant, force and friction in the Laplace approximation.

        The stated distributions of thicknesses, area and friction are included.
        """
        columns = self.laplace.derived_moments()
        return {
            name: self._summarize(name, math.exp(log), float(sd)) | {"from_prior": float(fraction)}
            for name, log, sd, fraction in zip(derived.DERIVED_NAMES, *columns, strict=True)
        }

    def budget_entries(self) -> dict[str, Any]:
        """Return `budget` of fit.json."""
        medians = self.likelihood.to_physical(self.theta)
        medians |= dict(zip(derived.DERIVED_NAMES, np.exp(self.laplace.derived_moments()[0]), strict=True))
        budgets = self.budgets.items()
        return {name: each.to_dict(float(medians[name])) | self.calibration_entry(name) for name, each in budgets}

    def geometry_contributions(self) -> dict[str, tuple[Contribution, ...]]:
        """Return what thicknesses, permittivities, area and friction contribute to each quantity's uncertainty."""
        laplace = self.laplace
        return laplace.geometry.contributions(laplace.likelihood, laplace.theta, laplace.log_derived, self.covariance)

    @functools.cached_property
    def force_basis(self) -> dict[str, Any]:
        """Force law, values that the force rests on, and the mean force by the other law if a gap is stated."""
        law = self.derive.geometry.model
        other_law: ForceModel = "gap" if law == "paper" else "paper"
        assumptions = list_assumptions(
            self.scene, law, prior=self.laplace.prior_sets_Ci, stated_drive=self.uses_stated_drive
        )
        other: dict[str, Any] | None = None
        if getattr(constant_skin_circuit(self.likelihood.template), "Cgap", None) is not None:
            geometry = dataclasses.replace(self.derive.geometry, model=other_law)
            derive = dataclasses.replace(self.derive, geometry=geometry)
            laplace = dataclasses.replace(
                self.laplace,
                derive=derive,
                log_derived=derive.log_value_and_grad(self.theta, self.laplace.charges),
                geometry=dataclasses.replace(self.laplace.geometry, geometry=geometry),
            )
            i = derived.DERIVED_NAMES.index("force_mean")
            logs, sds, _ = laplace.derived_moments()
            force = summary.summarize_log_normal("force_mean", math.exp(logs[i]), float(sds[i]))
            other = {"law": other_law, "force_mean": force}
        return {
            "law": law,
            **dict.fromkeys(("measured", "tested_by_data"), "force_scale" in self.names),
            "other_law": other,
            "assumptions": [
                each.to_dict() for each in assumptions if each.affects != "friction" or each.symbol not in self.names
            ],
        }

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
            unstated = tuple(part for error in self._list_unstated_errors(name) for part in error.components)
            budgets[name] = Budget((*components, *others), unstated)
        return budgets

    @property
    def assumed_quantities(self) -> tuple[str, ...]:
        """Quantities of the friction that rest on defaults, or on a force sensor of which nobody stated the error."""
        friction = [each for each in self.force_basis["assumptions"] if each["affects"] == "friction"]
        is_default = any(each["origin"] == "default" for each in friction)
        is_assumed = is_default and not any(each["has_distribution"] for each in friction)
        if "mu" in self.names:
            return ("mu", "friction_mean") * (is_assumed or not self.scene.instrument.pieces("Ft"))
        return ("friction_mean",) * is_assumed

    @functools.cached_property
    def _gradients(self) -> dict[str, Float[np.ndarray, " parameters"]]:
        """Gradients of the logarithms of the quantities with a budget, in theta."""
        gradients = dict(zip(self.names, np.eye(self.theta.size), strict=True))
        moments = self.laplace.approximate_derived()
        derivatives = zip(derived.DERIVED_NAMES, moments.gradients, strict=True)
        names = (*FINGER_PARAMETERS, "force_scale")
        found = {name: gradients[name] for name in names if name in gradients} | dict(derivatives)
        return {name: gradient for name, gradient in found.items() if name not in self.assumed_quantities}

    def _list_unstated_errors(self, name: str) -> tuple[UnstatedError, ...]:
        """Return the usual errors that nobody stated, of a quantity."""
        section, measurement = self.scene.instrument, self.scene.measurement
        stated = {"Vsc": measurement.gain_relative_sd > 0.0, "I": measurement.gain_I_relative_sd > 0.0}
        gradient, gains = self._gradients[name], {}
        for channel, shift in self.gain_shifts.items():
            if section.pieces(channel) or stated.get(channel) or (channel == "Z" and section.pieces("I")):
                continue
            # the force is computed from V, beside the parameters that follow from it
            direct = 2.0 if channel == "V" and name in derived.DERIVED_NAMES and name.startswith("force") else 0.0
            gains[channel] = float(gradient @ shift) + direct
        changes = dict(zip(self.names, gradient, strict=True))
        stray = sum(math.log1p(size) * changes.get(other, 0.0) for other, size in self.stray_changes.items())
        return list_unstated_errors(gains, stray)

    def calibration_entry(self, name: str) -> dict[str, Any]:
        """Return `stated` and `not_stated` of the budget of a quantity: usual errors that nobody stated."""
        errors = self._list_unstated_errors(name)
        return {"stated": self.scene.instrument.is_stated, "not_stated": [each.to_dict() for each in errors]}

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
            sources.append(f"usual errors of {' and '.join(each['source'] for each in missing)}")
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
        message = RESULTS[self.result]
        if self.result not in ("misfit", "structure"):
            return message
        return describe_structure(self.result, message, self.effects)

    def profile(self, name: str, level: float = 0.95, *, prior: bool = True) -> Interval:
        """Return the profile-likelihood interval of one parameter, or of g, b or force_mean.

        `prior`: whether to include the prior of the circuit. The noise is fixed at its estimate. A bound that the data
        do not determine within a factor of a million is 0 or infinite.

        Raises:
            InputError: there is no quantity of that name, or the level is not between 0 and 1.
        """
        return profile_intervals(self.laplace, (name,), level, prior)[name]

    def intervals(self, level: float = 0.95, *, prior: bool = True) -> dict[str, Interval]:
        """Return the profile-likelihood intervals of all parameters, and of g, b and force_mean; see `profile`.

        Raises:
            InputError: the level is not between 0 and 1.
        """
        return profile_intervals(self.laplace, (*self.names, *PROFILE_QUANTITIES), level, prior)

    def plot(self, record: int = 0) -> Any:
        """Draw V, and each fitted channel with its fit and residuals, on one axis of time or frequency.

        `record` counts the records and spectra. Returns the axes, from top to bottom.
        """
        return plot_fit(self.records[record], self.traces)

    def plot_budget(self) -> Any:
        """Draw the largest components of each quantity's combined uncertainty, and return the axes."""
        return np.array(charts.draw_budgets(self.to_dict(), make=charts.pyplot_figure).axes)

    def plot_identifiability(self, ax: Any = None) -> Any:
        """Draw the 95 % regions of two parameters before and after the data, in the Laplace approximation.

        They are the two that change most in the direction that the data constrain least. Returns the axes.
        """
        return plot_identifiability(self.laplace, self.identifiability.blind_direction, ax)

    def to_dataframe(self) -> Any:
        """Return a pandas DataFrame with a row for each parameter and derived quantity, by name, in SI units.

        Columns are those of `parameters()`: unit, mean, sd, quantiles, u, contraction and from_prior.
        """
        return to_dataframe(self.parameters() | self.derived(), orient="index")

    @property
    def _headline(self) -> str:
        values = self.likelihood.to_physical(self.theta)
        estimates = {name: float(values[name]) for name in FINGER_PARAMETERS if name in self.names}
        first, others = os.path.basename(self.records[0].source), len(self.records) - 1
        source = f"{first} and {others} more" if others else first
        state = self.identifiability.verdict, "reliable" if self.trusted else f"unreliable ({self.result})"
        return ", ".join((source, summary.format_values(estimates), *state))

    def _rows(self) -> list[tuple[str, ...]]:
        content = {"parameters": self.parameters(), "derived": self.derived(), "force_basis": self.force_basis}
        return result_text.estimate_table(content)

    def _sentences(self) -> list[str]:
        law = result_text.force_sentences(self.force_basis)[0]
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
        judgement = {"result": self.result, "message": self.message, "misfit": self.result == "misfit"}
        return judgement | self.figures | {"traces": traces}

    def to_dict(self) -> dict[str, Any]:
        """Return the content of fit.json, which `fitact fit --json` prints."""
        noise = dict(zip(self.likelihood.sigma_names, self.laplace.sigmas.tolist(), strict=True))
        nuisances = {
            name: {"unit": quantity_unit(name), "value": value} for name, value in (noise | self.linear).items()
        }
        return {
            "parameters": self.parameters(),
            "derived": self.derived(),
            "nuisances": nuisances,
            "correlation": {"names": list(self.names), "matrix": self.correlation.tolist()},
            "identifiability": self.identifiability.to_dict(),
            "fit": self.judgement(),
            "model": self.model(),
            "force_basis": self.force_basis,
            "budget": self.budget_entries(),
            "warnings": list(self.warnings),
            "notes": [*self.notes, *self.effect_notes],
            **self.effects.to_dict(),
            **self.validity(),
        }

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

    def summary(self, *, verbose: bool = False) -> str:
        """Return the main results for people, or all of them: estimates, verdict and what to do next."""
        content = self.to_dict()
        if not verbose:
            return result_text.describe_result(content, self.scene.description)
        names, correlation = list(self.identifiability.blind_direction), self.correlation
        places = [self.names.index(name) for name in names]
        pairs = [
            f"{names[j]}-{names[i]} {correlation[places[i], places[j]]:+.3f}"
            for i in range(len(names))
            for j in range(i)
        ]
        details = [
            f"Correlations of the log-parameters: {', '.join(pairs)}.",
            f"Residual variance / model-free noise variance: {self.figures['chi2_reduced']:.3f}. {self.message}",
            f"Log-likelihood: {self._likelihood()}.",
            str(self.identifiability),
        ]
        return result_text.describe_fully(content, details)

    __str__ = summary


def _scale_quantiles(value: float, budget: Budget, *, only_posterior: bool = False) -> dict[str, float]:
    """Return the quantiles of a quantity by name, from its estimate and its budget."""
    factors = budget.quantiles(summary.PROBABILITIES.values(), only_posterior=only_posterior)
    return dict(zip(summary.PROBABILITIES, (value * factors).tolist(), strict=True))
