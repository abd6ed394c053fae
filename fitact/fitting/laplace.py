"""The normal approximation of a posterior at its optimum: parameters and what follows from them, with errors."""

import dataclasses
import functools
import math

import numpy as np
from jaxtyping import Float

from fitact import summary
from fitact.fitting import derived
from fitact.fitting.identifiability import Identifiability
from fitact.likelihood.likelihood import Likelihood
from fitact.scene.scene import Scene


@dataclasses.dataclass(frozen=True)
class Laplace:
    """An optimum and its covariance.

    Attributes:
        theta: the optimum, in the coordinates `names`.
        covariance_root: its product with its transpose is `covariance`; keeps digits where that cannot.
        sigma: the channels' noise.
        likelihood, derive: what was fitted, what follows from it.
    """

    theta: Float[np.ndarray, " parameters"]
    covariance_root: Float[np.ndarray, "parameters parameters"]
    sigma: Float[np.ndarray, " channels"]
    likelihood: Likelihood
    derive: derived.DerivedQuantities

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

    @functools.cached_property
    def log_derived(self) -> tuple[Float[np.ndarray, " derived"], Float[np.ndarray, "derived parameters"]]:
        """Logarithms of the derived quantities, and their gradients in theta."""
        return self.derive.log_value_and_grad(self.theta, self.sigma)

    def log_sd(self, name: str) -> float:
        """Standard deviation of the logarithm of a derived quantity."""
        return float(np.linalg.norm(self.log_gradient(name) @ self.covariance_root))

    def log_gradient(self, name: str) -> Float[np.ndarray, " parameters"]:
        """Gradient of the logarithm of a derived quantity in theta."""
        return self.log_derived[1][derived.DERIVED_NAMES.index(name)]

    def summarize_parameters(self) -> dict[str, summary.Summary]:
        """Summaries of the parameters, with their contraction."""
        values, prior_sd = self.likelihood.to_physical(self.theta), self.likelihood.prior.log_sd
        timing, use_prior = self.likelihood.timing, self.likelihood.use_prior
        summaries = {}
        for i, name in enumerate(self.likelihood.names):
            value, sd = float(values[name]), float(self.sd[i])
            if name in timing:
                summaries[name] = summary.summarize_normal(name, value, sd * timing[name][1])
            else:
                summaries[name] = summary.summarize_log_normal(name, value, sd)
                if use_prior or name.startswith("gain"):
                    summaries[name]["contraction"] = float(1.0 - sd / prior_sd[i])
        return summaries

    def summarize_derived(self) -> dict[str, summary.Summary]:
        """Summaries of divider, time constant, force and friction."""
        values, gradients = self.log_derived
        sds = np.linalg.norm(gradients @ self.covariance_root, axis=1)
        return {
            name: summary.summarize_log_normal(name, math.exp(value), float(sd))
            for name, value, sd in zip(derived.DERIVED_NAMES, values, sds, strict=True)
        }


@dataclasses.dataclass(frozen=True)
class FitResult:
    """What every fit comes to.

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
        return self.laplace.summarize_parameters()

    def derived(self) -> dict[str, summary.Summary]:
        """Summaries of divider, time constant, force and friction in the Laplace approximation."""
        return self.laplace.summarize_derived()
