"""Gaussian (Laplace) approximation of a posterior at its optimum, for parameters and derived quantities."""

import dataclasses

import numpy as np
from jaxtyping import Float

from fitact.fitting import derived
from fitact.fitting.geometry import DerivedMoments, UncertainGeometry
from fitact.fitting.identifiability import MIN_PRIOR_FRACTION, prior_variance_fraction
from fitact.likelihood.likelihood import Likelihood


@dataclasses.dataclass(frozen=True)
class Laplace:
    """An optimum and its covariance."""

    theta: Float[np.ndarray, " parameters"]  # the optimum, in the likelihood's coordinates
    # covariance = root @ root.T; the root is the more accurate of the two
    covariance_root: Float[np.ndarray, "parameters parameters"]
    sigmas: Float[np.ndarray, " channels"]  # standard deviation of each channel's noise
    likelihood: Likelihood  # the model that was fitted
    derive: derived.DerivedQuantities  # the derived quantities as functions of theta
    charges: derived.UnknownCharges  # those of `derive`, at the optimum
    # logarithms of the derived quantities at the optimum, and their gradients in theta
    log_derived: tuple[Float[np.ndarray, " derived"], Float[np.ndarray, "derived parameters"]]
    geometry: UncertainGeometry  # what force and friction rest on beside the circuit

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

    def approximate_derived(self) -> DerivedMoments:
        """Return the logarithms of the derived quantities, their gradients, and what the geometry adds to them."""
        return self.geometry.approximate(self.likelihood, self.theta, self.log_derived)

    def derived_moments(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return mean and sd of the logarithms of `DERIVED_NAMES`, and the fraction of the variance from the prior."""
        logs, gradients, extra = self.approximate_derived()
        known = np.sum((gradients @ self.covariance_root) ** 2, axis=1)
        from_prior = self.variance_from_prior(gradients) * known + extra
        whole = known + extra
        return logs, np.sqrt(whole), from_prior / np.where(whole > 0.0, whole, 1.0)
