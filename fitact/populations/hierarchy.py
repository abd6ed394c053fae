"""Posterior of the population parameters, given the fingers."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from fitact.compiled import array_module, jit, solve_lower
from fitact.populations.finger import SHARED_PARAMETER, SKIN
from fitact.populations.finger_likelihoods import TABLE_HALF_WIDTH, FingerLikelihoods, PopulationParameters
from fitact.prior.prior import Prior

NAMES = ("shift_Rsc", "shift_Csc", "log_Ci", "log_sd_Rsc", "log_sd_Csc", "atanh_correlation", "log_sd_area")


class Hierarchy(eqx.Module):
    """Log-posterior of the population parameters, in coordinates `names` that are nearly independent.

    Medians and slopes are in standard errors from the fingers' regression, which removes their dependence on the
    spread of the fingers and on Ci. Standard deviations are logarithms, the correlation an inverse hyperbolic tangent.
    """

    fingers: FingerLikelihoods
    prior: Prior  # of the medians of Rsc and Csc, and of Ci
    area_varies: bool = eqx.field(static=True)  # whether each finger has its own contact area
    covariates: Float[Array, "fingers covariates"]  # standardized
    # scale of the half-normal prior of log-standard deviations; 95 % of it lie below 0.98
    log_sd_scale: float = eqx.field(static=True, default=0.5)
    # prior standard deviation of the change of log Rsc and log Csc per standard deviation of a covariate
    slope_sd: float = eqx.field(static=True, default=0.5)
    # shape of the correlation's density (1 - r^2)^(lkj - 1) (Lewandowski, Kurowicka, Joe 2009)
    lkj: float = eqx.field(static=True, default=2.0)

    @property
    def names(self) -> tuple[str, ...]:
        return NAMES[: self._first_slope_index] + tuple(
            f"shift_{name}_{i + 1}" for i in range(self.covariates.shape[1]) for name in SKIN
        )

    @property
    def _first_slope_index(self) -> int:
        return len(NAMES) if self.area_varies else len(NAMES) - 1

    @property
    def _design(self) -> Float[Array, "fingers regressors"]:
        xp = array_module(self.covariates)
        return xp.column_stack([xp.ones(len(self.covariates)), self.covariates])

    def population_parameters(self, point: Float[Array, " coordinates"]) -> PopulationParameters:
        log_sd, correlation = jnp.exp(point[3:5]), jnp.tanh(point[5])
        shifts = jnp.vstack([point[:2], point[self._first_slope_index :].reshape(-1, 2)])
        second = correlation * shifts[:, 0] + jnp.sqrt(1.0 - correlation**2) * shifts[:, 1]
        errors = log_sd * jnp.column_stack([shifts[:, 0], second])
        root = jnp.linalg.cholesky(self._design.T @ self._design)
        coefficients = self._regress_skin(point[2]) + solve_lower(root, errors, transposed=True)
        area = jnp.exp(point[6]) if self.area_varies else None
        slopes = coefficients[1:] if self.covariates.size else None
        return PopulationParameters(coefficients[0], log_sd, correlation, point[2], area, slopes)

    def _regress_skin(self, log_Ci: Array) -> Float[Array, "regressors 2"]:
        """Compute the fingers' mean log Rsc and log Csc, and the least-squares slopes."""
        design = self._design
        return array_module(log_Ci).linalg.solve(design.T @ design, design.T @ self._skin(log_Ci))

    def _skin(self, log_Ci: Array) -> Float[Array, "fingers 2"]:
        """Estimate the fingers' log Rsc and log Csc at the panel's Ci."""
        skin, off = self.fingers.skin.mean(axis=1), log_Ci - self.fingers.center
        return skin + off * (np.array([-1.0, 1.0]) if self.area_varies else self.fingers.slope[:, 0])

    def log_prior(self, point: Float[Array, " coordinates"]) -> Float[Array, ""]:
        """Return the log-prior of the population parameters, up to a constant."""
        law = self.population_parameters(point)
        spreads = jnp.concatenate([point[3:5], point[6 : self._first_slope_index]])
        half_normal = jnp.sum(spreads - 0.5 * jnp.square(jnp.exp(spreads) / self.log_sd_scale))
        rest = jnp.log1p(-jnp.square(law.correlation))
        regressors = 1 + self.covariates.shape[1]
        to_medians = regressors * (jnp.sum(point[3:5]) + 0.5 * rest)  # log-determinant of the change of coordinates
        log_prior = self.prior.log_density(jnp.append(law.median, law.log_Ci))
        if law.slopes is not None:
            log_prior = log_prior - 0.5 * jnp.sum(jnp.square(law.slopes / self.slope_sd))
        return log_prior + half_normal + to_medians + self.lkj * rest

    def sample_prior(self, random: np.random.Generator, count: int) -> PopulationParameters:
        """Draw population parameters from the prior; leaves (count, 1)."""
        draws, size = self.prior.sample(random, count), self.covariates.shape[1]
        spreads = self.log_sd_scale * np.abs(random.standard_normal((count, 1, 3)))
        return PopulationParameters(
            np.log(np.stack([draws[name] for name in SKIN], axis=-1))[:, None],
            spreads[..., :2],
            2.0 * random.beta(self.lkj, self.lkj, (count, 1)) - 1.0,  # has the density (1 - r^2)^(lkj - 1)
            np.log(draws[SHARED_PARAMETER])[:, None],
            spreads[..., 2] if self.area_varies else None,
            self.slope_sd * random.standard_normal((count, 1, size, 2)) if size else None,
        )

    def start(self) -> Float[np.ndarray, " coordinates"]:
        """Return the moments of the fingers, as if each were known exactly."""
        log_Ci = np.mean(self.fingers.center)
        residuals = self._skin(log_Ci) - self._design @ self._regress_skin(log_Ci)
        sds = np.append(np.std(residuals, axis=0), np.std(self.fingers.center))
        spreads = np.log(0.05 + sds)  # the offset keeps each away from 0
        of_law = np.array([0.0, 0.0, log_Ci, *spreads[:2], 0.0, spreads[2]])[: self._first_slope_index]
        return np.append(of_law, np.zeros(2 * self.covariates.shape[1]))

    def log_prob(self, point: Float[Array, " coordinates"]) -> Float[Array, ""]:
        """Evaluate the log-posterior, up to a constant."""
        parameters = self.population_parameters(point).shift_medians(self.covariates[:, None])
        return self.log_prior(point) + jnp.sum(self.fingers.log_likelihood(parameters))


def laplace(hierarchy: Hierarchy) -> tuple[Float[np.ndarray, " coordinates"], Float[np.ndarray, "n n"]]:
    """Find the posterior mode, and a root of the covariance there; call it in double precision."""
    start = hierarchy.start()
    scale = np.full(start.size, 1.0 / np.sqrt(len(hierarchy.fingers.center)))
    scale[[name.startswith("shift") for name in hierarchy.names]] = 1.0
    # the tables' half-width is a known multiple of the standard deviation of log Ci
    scale[2] = float(np.min(hierarchy.fingers.half_width)) / TABLE_HALF_WIDTH
    optimum = scipy.optimize.minimize(
        lambda z: _value_and_gradient(hierarchy, start, scale, z),
        np.zeros(start.size),
        jac=True,
        method="BFGS",
    ).x
    curvature, axes = np.linalg.eigh(_hessian(hierarchy, start, scale, optimum))
    # a curvature below a tenth of the start's is taken as a tenth
    return start + scale * optimum, scale[:, None] * axes / np.sqrt(np.maximum(curvature, 0.1))


def _objective(hierarchy: Hierarchy, start: Array, scale: Array, z: Array) -> Array:
    return -hierarchy.log_prob(start + scale * z)


@jit
def _value_and_gradient(hierarchy: Hierarchy, start: Array, scale: Array, z: Array) -> tuple[Array, Array]:
    return jax.value_and_grad(_objective, argnums=3)(hierarchy, start, scale, z)


@jit
def _hessian(hierarchy: Hierarchy, start: Array, scale: Array, z: Array) -> Array:
    return jax.hessian(_objective, argnums=3)(hierarchy, start, scale, z)
