"""One record of a population: the likelihood that is kept of it after the fit."""

import dataclasses
import math
import os
from typing import Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitact import summary
from fitact.compiled import jit
from fitact.fitting.result import Fit
from fitact.likelihood.likelihood import Likelihood
from fitact.model.circuit import FINGER_PARAMETERS
from fitact.prior.distributions import LogNormal
from fitact.prior.prior import Prior
from fitact.tracking.tracked_finger import TrackedFinger

SKIN = ("Rsc", "Csc")
SHARED_PARAMETER = "Ci"


@dataclasses.dataclass(frozen=True)
class Finger:
    """Fitted record with its likelihood around the optimum, as a normal one.

    The normal likelihood is exp(-|factor (x - center) - target|^2 / 2), with x the nuisances that belong to the record
    alone, then log Rsc, log Csc and log Ci.
    """

    source: str  # names of the records
    fingerprint: str  # hash of its numbers
    result: str  # of the separate fit, as the next two, see `Fit`
    message: str
    parameters: dict[str, summary.Summary]
    # with priors of the nuisances only; without samples if it is compressed; None means that it is normal
    likelihood: Likelihood | None
    names: tuple[str, ...]  # coordinates of a point of `likelihood`
    center: Float[np.ndarray, " x"]
    factor: Float[np.ndarray, "x x"]  # upper triangular
    target: Float[np.ndarray, " x"]
    log_sigma: Float[np.ndarray, " sigmas"] = dataclasses.field(default_factory=lambda: np.zeros(0))
    log_sigma_sd: Float[np.ndarray, " sigmas"] = dataclasses.field(default_factory=lambda: np.zeros(0))

    @classmethod
    def from_fit(cls, fit: Fit) -> Self:
        """Reduce a fit to its whitened residuals and their Jacobian, and the noise to its Fisher information."""
        likelihood = _flatten_skin_prior(fit.likelihood).without_samples()
        size = fit.theta.size
        theta, log_sigma = np.split(fit.point, [size])
        residuals, jacobian = _linearize(likelihood, theta, np.exp(log_sigma))
        order = [*_nuisance_places(fit.names), *map(fit.names.index, FINGER_PARAMETERS)]
        R = np.asarray(np.linalg.qr(np.column_stack([jacobian[:, order], residuals]), mode="r"))
        return cls(
            source=", ".join(os.path.basename(each.source) for each in fit.records),
            fingerprint="-".join(each.fingerprint for each in fit.records),
            result=fit.result,
            message=fit.message,
            parameters=fit.parameters(),
            likelihood=likelihood,
            names=fit.names,
            center=theta[order],
            factor=R[:size, :size],
            target=-R[:size, size],
            log_sigma=log_sigma,
            log_sigma_sd=np.diag(fit.point_root)[size:],
        )

    @classmethod
    def from_track(cls, tracked: TrackedFinger, prior: Prior) -> Self:
        """Make the finger from its time averages; `prior` (of Rsc, Csc, Ci) serves for `parameters` only."""
        R, target = tracked.average.factor, tracked.average.target
        precision = np.linalg.inv(prior.covariance)
        covariance = np.linalg.inv(R.T @ R + precision)
        log_mean = covariance @ (R.T @ target + precision @ np.asarray(prior.log_mean))
        log_sd = np.sqrt(np.diag(covariance))
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
            center=log_mean,
            factor=R,
            target=target - R @ log_mean,
        )

    def blur(self, within: Float[np.ndarray, "3 3"]) -> Self:
        """Return the finger's time average, of which the record of one moment deviates by the covariance `within`.

        `within` is that of log Rsc, log Csc and log Ci. The likelihood is taken as normal.
        """
        flat = 1e-6  # information that stands for none
        left, sizes, right = np.linalg.svd(self.skin_factor)
        variances = 1.0 / (np.square(sizes) + flat)
        mean = right.T @ (variances * sizes * (left.T @ self.skin_target))
        root = np.linalg.inv(np.linalg.cholesky((right.T * variances) @ right + within))
        rotation, factor = np.linalg.qr(root)
        return dataclasses.replace(
            self,
            likelihood=None,
            names=FINGER_PARAMETERS,
            center=self.center[-3:],
            factor=factor,
            target=rotation.T @ root @ mean,
            log_sigma=np.zeros(0),
            log_sigma_sd=np.zeros(0),
        )

    @property
    def skin_factor(self) -> Float[np.ndarray, "3 3"]:
        """`factor` of log Rsc, log Csc and log Ci, after all nuisances."""
        return self.factor[-3:, -3:]

    @property
    def skin_target(self) -> Float[np.ndarray, " 3"]:
        return self.target[-3:]

    @property
    def log_Ci_precision(self) -> float:
        """Inverse variance of log Ci from the record alone."""
        return float(self.factor[-1, -1] ** 2)

    @property
    def log_Ci(self) -> float:
        """Log Ci from the record alone."""
        return float(self.center[-1] + self.target[-1] / self.factor[-1, -1])

    def place_nuisances(
        self, logs: Float[np.ndarray, "draws 3"], z: Float[np.ndarray, "draws nuisances"]
    ) -> tuple[Float[np.ndarray, "draws coordinates"], Float[np.ndarray, " draws"]]:
        """Return points of `likelihood`, with nuisances that standard normal `z` draw given log Rsc, Csc and Ci.

        Also returns the logarithm of the normal likelihood of `logs` times the density of the nuisances.
        """
        own = self.target.size - 3
        away = logs - self.center[-3:]
        nuisances = np.linalg.solve(
            self.factor[:own, :own], (self.target[:own] - away @ self.factor[:own, own:].T + z[:, :own]).T
        ).T
        points = np.empty((len(logs), len(self.names) + self.log_sigma.size))
        points[:, _nuisance_places(self.names)] = self.center[:own] + nuisances
        points[:, list(map(self.names.index, FINGER_PARAMETERS))] = logs
        points[:, len(self.names) :] = self.log_sigma + self.log_sigma_sd * z[:, own:]
        misfit = np.sum(np.square(away @ self.skin_factor.T - self.skin_target), axis=1)
        return points, -0.5 * (misfit + np.sum(np.square(z), axis=1))


def _nuisance_places(names: tuple[str, ...]) -> list[int]:
    return [i for i, name in enumerate(names) if name not in FINGER_PARAMETERS]


def _flatten_skin_prior(likelihood: Likelihood, log_sd: float = 1e3) -> Likelihood:
    """Replace the priors of Rsc, Csc and Ci by uninformative ones."""
    prior = likelihood.prior
    flat = {name: LogNormal(math.exp(prior[name].log_mean), log_sd) for name in FINGER_PARAMETERS}
    marginals = dict(zip(prior.names, prior.marginals, strict=True)) | flat
    return dataclasses.replace(likelihood, prior=Prior.from_marginals(**marginals))


@jit
def _linearize(likelihood: Likelihood, theta: Array, sigma: Array) -> tuple[Array, Array]:
    def residuals(theta: Array) -> Array:
        return jnp.concatenate([*likelihood.residuals(theta, sigma), likelihood.prior_residuals(theta)])

    return residuals(theta), jax.jacfwd(residuals)(theta)
