"""The normal approximation of a posterior at its optimum: parameters and what follows from them, with errors."""

import abc
import dataclasses
import math
from typing import Any

import numpy as np
from jaxtyping import Float

from fitact import summary
from fitact.fitting import derived
from fitact.fitting.identifiability import Identifiability
from fitact.fitting.levenberg_marquardt import result_message
from fitact.likelihood.likelihood import Likelihood
from fitact.scene.scene import Scene
from fitact.tables import align_rows
from fitact.units import format_engineering, quantity_unit

SUCCESS_MESSAGE = "The fit is at its optimum and leaves only noise."


@dataclasses.dataclass(frozen=True)
class Laplace:
    """An optimum and its covariance.

    Attributes:
        theta: the optimum, in the likelihood's coordinates.
        covariance_root: its product with its transpose is `covariance`; keeps digits where that cannot.
        sigmas: standard deviation of each channel's noise.
        likelihood, derive: what was fitted, and what follows from theta.
        log_derived: logarithms of the derived quantities at the optimum, and their gradients in theta.
    """

    theta: Float[np.ndarray, " parameters"]
    covariance_root: Float[np.ndarray, "parameters parameters"]
    sigmas: Float[np.ndarray, " channels"]
    likelihood: Likelihood
    derive: derived.DerivedQuantities
    log_derived: tuple[Float[np.ndarray, " derived"], Float[np.ndarray, "derived parameters"]]

    @property
    def covariance(self) -> Float[np.ndarray, "parameters parameters"]:
        """Covariance of theta."""
        return self.covariance_root @ self.covariance_root.T

    @property
    def sd(self) -> Float[np.ndarray, " parameters"]:
        """Standard deviations of theta."""
        return np.linalg.norm(self.covariance_root, axis=1)

    @property
    def correlation(self) -> Float[np.ndarray, "parameters parameters"]:
        """Correlations of theta."""
        return self.covariance / np.outer(self.sd, self.sd)

    @property
    def derived_log_sd(self) -> Float[np.ndarray, " derived"]:
        """Standard deviations of the logarithms of the derived quantities."""
        return np.linalg.norm(self.log_derived[1] @ self.covariance_root, axis=1)

    def log_gradient(self, name: str) -> Float[np.ndarray, " parameters"]:
        """Gradient of the logarithm of a derived quantity in theta."""
        return self.log_derived[1][derived.DERIVED_NAMES.index(name)]


@dataclasses.dataclass(frozen=True)
class FitResult(abc.ABC):
    """What every fit comes to: a Laplace approximation, and a judgement of it.

    Attributes:
        laplace: the best parameters with their errors, and what follows from them.
        result: name of a member of `RESULTS`; `message` is its sentence.
        figures: chi2_reduced, steps and the like.
        identifiability: what was measured can and cannot tell.
        scene: whose circuit and prior were fitted; the first record's.
        warnings: sentences.
    """

    laplace: Laplace
    result: str
    figures: dict[str, float]
    identifiability: Identifiability
    scene: Scene
    warnings: tuple[str, ...]

    @property
    def trusted(self) -> bool:
        """Whether nothing stands against the answer."""
        return self.result == "successful"

    @property
    def names(self) -> tuple[str, ...]:
        """Coordinates of theta: logarithms, and delays and clocks in steps."""
        return self.likelihood.names

    @property
    def theta(self) -> Float[np.ndarray, " parameters"]:
        """The optimum, in the coordinates `names`."""
        return self.laplace.theta

    @property
    def covariance(self) -> Float[np.ndarray, "parameters parameters"]:
        """Covariance of theta, in the Laplace approximation."""
        return self.laplace.covariance

    @property
    def covariance_root(self) -> Float[np.ndarray, "parameters parameters"]:
        """Its product with its transpose is `covariance`; keeps digits where that cannot."""
        return self.laplace.covariance_root

    @property
    def sd(self) -> Float[np.ndarray, " parameters"]:
        """Standard deviations of theta."""
        return self.laplace.sd

    @property
    def correlation(self) -> Float[np.ndarray, "parameters parameters"]:
        """Correlations of theta."""
        return self.laplace.correlation

    @property
    def likelihood(self) -> Likelihood:
        """What was fitted."""
        return self.laplace.likelihood

    @property
    def derive(self) -> derived.DerivedQuantities:
        """What follows from theta."""
        return self.laplace.derive

    def parameters(self) -> dict[str, summary.Summary]:
        """Summaries of the parameters in the Laplace approximation, with their contraction."""
        values, timing = self.likelihood.to_physical(self.theta), self.likelihood.timing
        summaries = {}
        for i, name in enumerate(self.names):
            value, sd = float(values[name]), float(self.sd[i])
            if name in timing:
                summaries[name] = summary.summarize_normal(name, value, sd * timing[name][1])
            else:
                summaries[name] = summary.summarize_log_normal(name, value, sd)
                if self.likelihood.use_prior or name.startswith("gain"):
                    summaries[name]["contraction"] = float(1.0 - sd / self.likelihood.prior.log_sd[i])
        return summaries

    def derived(self) -> dict[str, summary.Summary]:
        """Summaries of divider, time constant, force and friction in the Laplace approximation."""
        values = zip(derived.DERIVED_NAMES, self.laplace.log_derived[0], self.laplace.derived_log_sd, strict=True)
        return {name: summary.summarize_log_normal(name, math.exp(log), float(sd)) for name, log, sd in values}

    @property
    def message(self) -> str:
        """The result as a sentence."""
        return SUCCESS_MESSAGE if self.trusted else result_message(self.result)

    def judgement(self) -> dict[str, Any]:
        """The result, and the figures of merit."""
        return {"result": self.result, "message": self.message, "misfit": self.result == "misfit"} | self.figures

    @abc.abstractmethod
    def model(self) -> dict[str, Any]:
        """What was fitted, by name."""

    @abc.abstractmethod
    def _nuisances(self) -> dict[str, float]:
        """Noise, and what entered linearly, at the optimum."""

    def to_dict(self) -> dict[str, Any]:
        """What `fitact fit --json` prints and fit.json holds."""
        nuisances = {name: {"unit": quantity_unit(name), "value": value} for name, value in self._nuisances().items()}
        return {
            "parameters": self.parameters(),
            "derived": self.derived(),
            "nuisances": nuisances,
            "correlation": {"names": list(self.names), "matrix": self.correlation.tolist()},
            "identifiability": self.identifiability.to_dict(),
            "fit": self.judgement(),
            "model": self.model(),
            "warnings": list(self.warnings),
        }

    def _align_table(self, *widths: int) -> list[str]:
        """The first columns, as many as `widths`, of a table of parameters and derived quantities."""
        cells = [("", "median", "± 1 sd", "contraction")]
        for name, s in (self.parameters() | self.derived()).items():
            median = format_engineering(float(s["q50"]), str(s["unit"]))
            contraction = f"{s['contraction']:.3f}" if "contraction" in s else ""
            cells.append((name, median, summary.format_sd(s), contraction))
        return align_rows([row[: len(widths)] for row in cells], widths)
