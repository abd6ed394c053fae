"""One finger of a population: what is kept of its record once it is fitted."""

import dataclasses
import math
import os
from typing import Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitact import summary
from fitact.fitting.fit import Fit
from fitact.likelihood.likelihood import Likelihood
from fitact.prior.distributions import LogNormal
from fitact.prior.prior import Prior

SKIN = ("Rsc", "Csc")
SHARED = "Ci"
_FLAT = 1e3  # standard deviation, in a logarithm, of a prior that says nothing


@dataclasses.dataclass(frozen=True)
class Finger:
    """A fitted record, and its likelihood around the optimum: normal in the finger's own coordinates given log Ci.

    Attributes:
        source: the record's file.
        fingerprint: of the record.
        result, message: of the fit, as in `Fit`.
        parameters: of the fit by itself.
        likelihood: with priors of the nuisances alone; without samples where a compression stands for them.
        names: the coordinates of a point; its own are all but Ci.
        center: log Ci of the optimum.
        place: its own coordinates there.
        slope: how these move with log Ci.
        root: of their covariance, given log Ci.
        precision: of log Ci, from the record alone.
        pull: precision times how far the record wants log Ci from `center`.
    """

    source: str
    fingerprint: str
    result: str
    message: str
    parameters: dict[str, summary.Summary]
    likelihood: Likelihood
    names: tuple[str, ...]
    center: float
    place: Float[np.ndarray, " own"]
    slope: Float[np.ndarray, " own"]
    root: Float[np.ndarray, "own own"]
    precision: float
    pull: float

    @classmethod
    def of(cls, fit: Fit) -> Self:
        """From the whitened residuals at the fit and their Jacobian; a noise's by its Fisher information."""
        likelihood = _without_skin_prior(fit.likelihood).without_samples()
        names, size = fit.point_names, fit.theta.size
        shared = fit.names.index(SHARED)
        theta, log_sigma = np.split(fit.point, [size])
        residuals, jacobian = _linearised(likelihood, theta, np.exp(log_sigma))
        own = [i for i in range(size) if i != shared]
        # R of (own, Ci, residuals): what Ci's column holds below the own ones' is what the record alone says of it
        R = np.asarray(np.linalg.qr(np.column_stack([jacobian[:, [*own, shared]], residuals]), mode="r"))
        n = len(own)
        root = np.linalg.inv(R[:n, :n])
        noise = np.diag(fit.point_root)[size:]
        whole = np.diag(np.append(np.zeros(n), noise))
        whole[:n, :n] = root
        return cls(
            source=os.path.basename(fit.record.source),
            fingerprint=fit.record.fingerprint,
            result=fit.result,
            message=fit.message,
            parameters=fit.parameters(),
            likelihood=likelihood,
            names=names,
            center=float(theta[shared]),
            place=np.append(theta[own] - root @ R[:n, n + 1], log_sigma),
            slope=np.append(-root @ R[:n, n], np.zeros(noise.size)),
            root=whole,
            precision=float(R[n, n] ** 2),
            pull=float(-R[n, n] * R[n, n + 1]),
        )

    def at(self, log_Ci: float, white: Float[np.ndarray, "draws own"]) -> Float[np.ndarray, "draws coordinates"]:
        """Points that standard normal numbers are at that log Ci."""
        own = self.place + self.slope * (log_Ci - self.center) + white @ self.root.T
        return np.insert(own, self.names.index(SHARED), log_Ci, axis=1)


def _without_skin_prior(likelihood: Likelihood) -> Likelihood:
    flat = {name: LogNormal(math.exp(likelihood.prior[name].log_mean), _FLAT) for name in (*SKIN, SHARED)}
    marginals = dict(zip(likelihood.prior.names, likelihood.prior.marginals, strict=True)) | flat
    return dataclasses.replace(likelihood, prior=Prior.of(**marginals))


@eqx.filter_jit
def _linearised_in(likelihood: Likelihood, theta: Array, sigma: Array) -> tuple[Array, Array]:
    def residuals(theta: Array) -> Array:
        return jnp.concatenate([*likelihood.residuals(theta, sigma), likelihood.prior_residuals(theta)])

    return residuals(theta), jax.jacfwd(residuals)(theta)


def _linearised(likelihood: Likelihood, theta: np.ndarray, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    residuals, jacobian = _linearised_in(likelihood, jnp.asarray(theta), jnp.asarray(sigma))
    return np.asarray(residuals), np.asarray(jacobian)
