"""One finger of a population: the likelihood that is kept of its record after the fit."""

import dataclasses
import math
import os
from typing import Self

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from fitact import summary
from fitact.compiled import jit
from fitact.fitting.result import Fit
from fitact.likelihood.likelihood import Likelihood
from fitact.prior.distributions import LogNormal
from fitact.prior.prior import Prior
from fitact.tracking.tracked_finger import TrackedFinger

SKIN = ("Rsc", "Csc")
SHARED_PARAMETER = "Ci"


@dataclasses.dataclass(frozen=True)
class Finger:
    """Fitted record with its likelihood around the optimum, normal in the finger's own coordinates given log Ci."""

    source: str  # names of the records
    fingerprint: str  # hash of its numbers
    result: str  # of the separate fit, as the next two, see `Fit`
    message: str
    parameters: dict[str, summary.Summary]
    # with priors of the nuisances only; without samples if it is compressed; None means that it is normal
    likelihood: Likelihood | None
    names: tuple[str, ...]  # coordinates of a point; all but Ci are the finger's own
    center: float  # log Ci of the optimum
    conditional_mean: Float[np.ndarray, " own"]  # mean of its own coordinates there, given log Ci
    slope: Float[np.ndarray, " own"]  # derivative of the mean with respect to log Ci
    covariance_factor: Float[np.ndarray, "own own"]  # root of their covariance
    precision: float  # inverse variance of log Ci from the record alone
    weighted_offset: float  # `precision` times (log Ci that the record alone gives, minus `center`)

    @classmethod
    def from_fit(cls, fit: Fit) -> Self:
        """Reduce a fit to its whitened residuals and their Jacobian, and the noise to its Fisher information."""
        likelihood = _flatten_skin_prior(fit.likelihood).without_samples()
        size, shared = fit.theta.size, fit.names.index(SHARED_PARAMETER)
        theta, log_sigma = np.split(fit.point, [size])
        residuals, jacobian = _linearize(likelihood, theta, np.exp(log_sigma))
        own = [i for i in range(size) if i != shared]
        # in R of (own, Ci, residuals), the column of Ci below the own columns holds the record's information on Ci
        R = np.asarray(np.linalg.qr(np.column_stack([jacobian[:, [*own, shared]], residuals]), mode="r"))
        n, noise = len(own), np.diag(fit.point_root)[size:]
        root = np.linalg.inv(R[:n, :n])
        return cls(
            source=", ".join(os.path.basename(each.source) for each in fit.records),
            fingerprint="-".join(each.fingerprint for each in fit.records),
            result=fit.result,
            message=fit.message,
            parameters=fit.parameters(),
            likelihood=likelihood,
            names=fit.point_names,
            center=float(theta[shared]),
            conditional_mean=np.append(theta[own] - root @ R[:n, n + 1], log_sigma),
            slope=np.append(-root @ R[:n, n], np.zeros(noise.size)),
            covariance_factor=scipy.linalg.block_diag(root, np.diag(noise)),
            precision=float(R[n, n] ** 2),
            weighted_offset=float(-R[n, n] * R[n, n + 1]),
        )

    @classmethod
    def from_track(cls, tracked: TrackedFinger, prior: Prior) -> Self:
        """Make the finger from its time averages; `prior` (of Rsc, Csc, Ci) serves for `parameters` only."""
        R, target = tracked.average.factor, tracked.average.target
        precision = np.linalg.inv(prior.covariance)
        covariance = np.linalg.inv(R.T @ R + precision)
        log_mean = covariance @ (R.T @ target + precision @ np.asarray(prior.log_mean))
        log_sd = np.sqrt(np.diag(covariance))
        root, center = np.linalg.inv(R[:2, :2]), float(log_mean[2])
        return cls(
            source=os.path.basename(tracked.source),
            fingerprint=tracked.fingerprint,
            result="misfit" if tracked.message else "successful",
            message=tracked.message,
            parameters={
                name: summary.summarize_log_normal(name, float(np.exp(mean)), float(sd))
                for name, mean, sd in zip(prior.names, log_mean, log_sd, strict=True)
            },
            likelihood=None,
            names=prior.names,
            center=center,
            conditional_mean=root @ (target[:2] - R[:2, 2] * center),
            slope=-root @ R[:2, 2],
            covariance_factor=root,
            precision=float(R[2, 2] ** 2),
            weighted_offset=float(R[2, 2] * (target[2] - R[2, 2] * center)),
        )

    def blur(self, within: Float[np.ndarray, "3 3"]) -> Self:
        """Return the finger's time average, of which the record of one moment deviates by the covariance `within`.

        `within` is that of log Rsc, log Csc and log Ci. The likelihood is taken as normal.
        """
        own = [name for name in self.names if name != SHARED_PARAMETER]
        skin = [own.index(name) for name in SKIN]
        flat = 1e-6  # information of log Ci that stands for none
        variance = 1.0 / (self.precision + flat)
        slope = np.append(self.slope[skin], 1.0)
        whole = variance * np.outer(slope, slope) + within
        whole[:2, :2] += (self.covariance_factor @ self.covariance_factor.T)[np.ix_(skin, skin)]
        mean = np.append(self.conditional_mean[skin], self.center) + slope * variance * self.weighted_offset
        precision = 1.0 / whole[2, 2]
        along = whole[:2, 2] * precision
        return dataclasses.replace(
            self,
            likelihood=None,
            names=(*SKIN, SHARED_PARAMETER),
            conditional_mean=mean[:2] + along * (self.center - mean[2]),
            slope=along,
            covariance_factor=np.linalg.cholesky(whole[:2, :2] - np.outer(along, whole[:2, 2])),
            precision=max(precision - flat, 0.0),
            weighted_offset=precision * (mean[2] - self.center),
        )

    def from_standard_normal(
        self, log_Ci: float, z: Float[np.ndarray, "draws own"]
    ) -> Float[np.ndarray, "draws coordinates"]:
        own = self.conditional_mean + self.slope * (log_Ci - self.center) + z @ self.covariance_factor.T
        return np.insert(own, self.names.index(SHARED_PARAMETER), log_Ci, axis=1)


def _flatten_skin_prior(likelihood: Likelihood, log_sd: float = 1e3) -> Likelihood:
    """Replace the priors of Rsc, Csc and Ci by uninformative ones."""
    prior = likelihood.prior
    flat = {name: LogNormal(math.exp(prior[name].log_mean), log_sd) for name in (*SKIN, SHARED_PARAMETER)}
    marginals = dict(zip(prior.names, prior.marginals, strict=True)) | flat
    return dataclasses.replace(likelihood, prior=Prior.of(**marginals))


@jit
def _linearize(likelihood: Likelihood, theta: Array, sigma: Array) -> tuple[Array, Array]:
    def residuals(theta: Array) -> Array:
        return jnp.concatenate([*likelihood.residuals(theta, sigma), likelihood.prior_residuals(theta)])

    return residuals(theta), jax.jacfwd(residuals)(theta)
