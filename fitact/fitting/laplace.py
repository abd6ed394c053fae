"""Gaussian (Laplace) approximation of a posterior at its optimum, for parameters and derived quantities."""

import abc
import dataclasses
import functools
import math
from typing import Any

import numpy as np
from jaxtyping import Float

from fitact import summary
from fitact.fitting import derived
from fitact.fitting.geometry import Contribution, UncertainGeometry
from fitact.fitting.identifiability import MIN_PRIOR_FRACTION, Identifiability, prior_variance_fraction
from fitact.fitting.minimum import result_message
from fitact.likelihood.likelihood import Likelihood
from fitact.model.force import ForceModel
from fitact.model.skin import constant_skin_circuit
from fitact.scene.assumptions import list_assumptions
from fitact.scene.scene import Scene
from fitact.tables import Display
from fitact.uncertainty.budget import Budget
from fitact.units import quantity_unit

SUCCESS_MESSAGE = "The fit converged, and the residuals are consistent with the noise."


@dataclasses.dataclass(frozen=True)
class Laplace:
    """An optimum and its covariance."""

    theta: Float[np.ndarray, " parameters"]  # the optimum, in the likelihood's coordinates
    # covariance = root @ root.T; the root is the more accurate of the two
    covariance_root: Float[np.ndarray, "parameters parameters"]
    sigmas: Float[np.ndarray, " channels"]  # standard deviation of each channel's noise
    likelihood: Likelihood  # the model that was fitted
    derive: derived.DerivedQuantities  # the derived quantities as functions of theta
    # logarithms of the derived quantities at the optimum, and their gradients in theta
    log_derived: tuple[Float[np.ndarray, " derived"], Float[np.ndarray, "derived parameters"]]

    @property
    def derived_log_sd(self) -> Float[np.ndarray, " derived"]:
        """Standard deviations of the logarithms of the derived quantities."""
        return np.linalg.norm(self.log_derived[1] @ self.covariance_root, axis=1)

    def variance_from_prior(self, gradients: Float[np.ndarray, "quantities parameters"]) -> np.ndarray:
        """Return the fraction of each quantity's variance that comes from the prior, by its gradient in theta."""
        return prior_variance_fraction(self.covariance_root, self.likelihood.prior_factor, gradients)

    @property
    def prior_sets_Ci(self) -> bool:
        """Whether the prior of Ci was used, and contributes at least `MIN_PRIOR_FRACTION` of what is known of Ci."""
        if not self.likelihood.use_prior or "Ci" not in self.likelihood.names:
            return False
        place = self.likelihood.names.index("Ci")
        ratio = float(np.linalg.norm(self.covariance_root[place])) / float(self.likelihood.prior["Ci"].log_sd)
        return ratio**2 >= MIN_PRIOR_FRACTION

    def log_gradient(self, name: str) -> Float[np.ndarray, " parameters"]:
        """Gradient of the logarithm of a derived quantity in theta."""
        return self.log_derived[1][derived.DERIVED_NAMES.index(name)]


@dataclasses.dataclass(frozen=True, repr=False)
class FitResult(Display, abc.ABC):
    """Result of a fit: a Laplace approximation, and whether it is reliable."""

    laplace: Laplace  # best parameters and derived quantities, with their covariance
    result: str  # name of a member of `RESULTS`; `message` is its sentence
    figures: dict[str, float]  # chi2_reduced, steps and other statistics
    identifiability: Identifiability  # which parameters the data determine
    scene: Scene  # scene of the first record, whose circuit and prior were fitted
    warnings: tuple[str, ...]  # sentences on what may change the result
    notes: tuple[str, ...]  # sentences for information

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
    def budgets(self) -> dict[str, Budget]:
        """Uncertainty budgets of the circuit's parameters and of the derived quantities; none for a spectrum."""
        return {}

    def _summarize(self, name: str, value: float, log_sd: float) -> summary.Summary:
        """Summarize a positive quantity, with the shape of the distributions of its sources of error."""
        result = summary.summarize_log_normal(name, value, log_sd)
        budget = self.budgets.get(name)
        if budget is not None and math.isfinite(log_sd):
            probabilities = summary.PROBABILITIES
            factors = budget.quantiles(probabilities.values(), only_posterior=True)
            result |= dict(zip(probabilities, (value * factors).tolist(), strict=True))
        return result | {"u": log_sd if budget is None else budget.u}

    def parameters(self) -> dict[str, summary.Summary]:
        """Summarize the parameters in the Laplace approximation.

        `u` is the combined relative standard uncertainty; `sd` is that of the posterior alone.

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
        columns = self.derived_moments()
        return {
            name: self._summarize(name, math.exp(log), float(sd)) | {"from_prior": float(fraction)}
            for name, log, sd, fraction in zip(derived.DERIVED_NAMES, *columns, strict=True)
        }

    def budget_entries(self) -> dict[str, Any]:
        """Return `budget` of fit.json."""
        medians = self.likelihood.to_physical(self.theta)
        medians |= dict(zip(derived.DERIVED_NAMES, np.exp(self.derived_moments()[0]), strict=True))
        budgets = self.budgets.items()
        return {name: each.to_dict(float(medians[name])) | self.calibration_entry(name) for name, each in budgets}

    def calibration_entry(self, name: str) -> dict[str, Any]:
        """Return `stated` and `not_stated` of the budget of a quantity: gain errors that nobody stated."""
        return {"stated": self.scene.instrument.is_stated, "not_stated": []}

    def derived_moments(self, laplace: Laplace | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return mean and sd of the logarithms of `DERIVED_NAMES`, and the fraction of the variance from the prior.

        `laplace` is that of another force law.
        """
        laplace = laplace or self.laplace
        geometry = UncertainGeometry.from_scene(self.scene, laplace.derive.geometry)
        logs, gradients, extra = geometry.approximate(self.likelihood, self.theta, laplace.log_derived)
        known = np.sum((gradients @ self.covariance_root) ** 2, axis=1)
        from_prior = laplace.variance_from_prior(gradients) * known + extra
        whole = known + extra
        return logs, np.sqrt(whole), from_prior / np.where(whole > 0.0, whole, 1.0)

    @functools.cached_property
    def geometry(self) -> UncertainGeometry:
        """Distributions of what force and friction rest on beside the circuit."""
        return UncertainGeometry.from_scene(self.scene, self.derive.geometry)

    def geometry_contributions(self) -> dict[str, tuple[Contribution, ...]]:
        """Return what thicknesses, permittivities, area and friction contribute to each quantity's uncertainty."""
        return self.geometry.contributions(self.likelihood, self.theta, self.laplace.log_derived, self.covariance)

    @property
    @abc.abstractmethod
    def uses_stated_drive(self) -> bool:
        """Whether the scene's drive was used, and not a recorded one."""

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
                self.laplace, derive=derive, log_derived=derive.log_value_and_grad(self.theta, self.laplace.sigmas)
            )
            i = derived.DERIVED_NAMES.index("force_mean")
            logs, sds, _ = self.derived_moments(laplace)
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

    @property
    def message(self) -> str:
        """Sentence for the result."""
        return SUCCESS_MESSAGE if self.result == "successful" else result_message(self.result)

    def judgement(self) -> dict[str, Any]:
        """Return the result and the figures of merit."""
        return {"result": self.result, "message": self.message, "misfit": self.result == "misfit"} | self.figures

    @abc.abstractmethod
    def model(self) -> dict[str, Any]:
        """Return the fitted model by name."""

    @abc.abstractmethod
    def _nuisances(self) -> dict[str, float]:
        """Return the noise and the linear nuisances at the optimum."""

    def to_dict(self) -> dict[str, Any]:
        """Return the content of fit.json, which `fitact fit --json` prints."""
        nuisances = {name: {"unit": quantity_unit(name), "value": value} for name, value in self._nuisances().items()}
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
            "notes": list(self.notes),
        }
