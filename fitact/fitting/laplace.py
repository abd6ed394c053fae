"""The normal approximation of a posterior at its optimum: parameters and what follows from them, with errors."""

import dataclasses
import math

import numpy as np
from jaxtyping import Float

from fitact import summary
from fitact.fitting import derived
from fitact.likelihood.likelihood import Likelihood


@dataclasses.dataclass(frozen=True)
class Laplace:
    """An optimum and its covariance.

    Attributes:
        theta: the optimum, in the coordinates `names`.
        covariance_root: its product with its transpose is `covariance`; keeps digits where that cannot.
        likelihood, derive: what was fitted, what follows from it.
    """

    theta: Float[np.ndarray, " parameters"]
    covariance_root: Float[np.ndarray, "parameters parameters"]
    likelihood: Likelihood
    derive: derived.Derived

    @property
    def names(self) -> tuple[str, ...]:
        """Coordinates of theta: logarithms, and delays and clocks in steps."""
        return self.likelihood.names

    @property
    def covariance(self) -> Float[np.ndarray, "parameters parameters"]:
        """Covariance of theta, in the Laplace approximation."""
        return self.covariance_root @ self.covariance_root.T

    @property
    def sd(self) -> Float[np.ndarray, " parameters"]:
        """Standard deviations of theta."""
        return np.linalg.norm(self.covariance_root, axis=1)

    @property
    def _sigmas(self) -> Float[np.ndarray, " traces"]:
        """The traces' noise."""
        return np.zeros(0)

    @property
    def correlation(self) -> Float[np.ndarray, "parameters parameters"]:
        """Correlations of theta."""
        return self.covariance / np.outer(self.sd, self.sd)

    def parameters(self) -> dict[str, summary.Summary]:
        """Summaries of the parameters in the Laplace approximation, with their contraction."""
        values, prior_sd = self.likelihood.natural(self.theta), self.likelihood.prior.log_sd
        timing, believed = self.likelihood.timing, self.likelihood.believed
        out = {}
        for i, name in enumerate(self.names):
            if name in timing:
                out[name] = summary.normal(name, float(values[name]), float(self.sd[i]) * timing[name][1])
            else:
                out[name] = summary.log_normal(name, float(values[name]), float(self.sd[i]))
                if believed or name.startswith("gain"):
                    out[name]["contraction"] = float(1.0 - self.sd[i] / prior_sd[i])
        return out

    def derived(self) -> dict[str, summary.Summary]:
        """Summaries of divider, time constant, force and friction in the Laplace approximation."""
        values, gradient = self.derive.logs(self.theta, self._sigmas)
        sd = np.linalg.norm(gradient @ self.covariance_root, axis=1)
        return {
            name: summary.log_normal(name, math.exp(value), float(s))
            for name, value, s in zip(derived.NAMES, values, sd, strict=True)
        }
