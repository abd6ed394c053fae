"""The posterior of a population's law, given its fingers."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Array, Float

from fitact.populations.finger import SHARED, SKIN
from fitact.populations.finger_likelihoods import REACH, Fingers, Law
from fitact.prior.prior import Prior

LOG_SD = 0.5  # half-normal scale of log-standard deviations: 95 % of the prior lies below 0.98
SLOPE = 0.5  # standard deviation of what a covariate's own standard deviation changes log Rsc and log Csc by
LKJ = 2.0  # the correlation's density is (1 - r^2)^(LKJ - 1): Lewandowski, Kurowicka, Joe 2009
NAMES = ("shift_Rsc", "shift_Csc", "log_Ci", "log_sd_Rsc", "log_sd_Csc", "atanh_correlation", "log_sd_area")
_LEAST = 0.05  # in a logarithm: spread that a start has at least
_FLAT = 0.1  # of the start's curvature: least that is believed of the optimum's


class Hierarchy(eqx.Module):
    """The log-posterior of a law, in coordinates `names` that are nearly independent.

    The medians, and what covariates change them by, are in standard errors from the fingers' regression, which takes
    away that they spread with the fingers and follow Ci; standard deviations are logarithms, the correlation an
    inverse hyperbolic tangent.

    Attributes:
        fingers: what the records say.
        prior: of the medians of Rsc and Csc, and of Ci.
        area_varies: whether each finger has an area of its own.
        covariates: of the fingers, standardised.
    """

    fingers: Fingers
    prior: Prior
    area_varies: bool = eqx.field(static=True)
    covariates: Float[Array, "fingers covariates"]

    @property
    def names(self) -> tuple[str, ...]:
        """Of the coordinates."""
        of_law = NAMES if self.area_varies else NAMES[:-1]
        return of_law + tuple(f"shift_{name}_{i + 1}" for i in range(self.covariates.shape[1]) for name in SKIN)

    @property
    def _slopes_from(self) -> int:
        """The first coordinate of a covariate."""
        return len(NAMES) if self.area_varies else len(NAMES) - 1

    @property
    def _design(self) -> Float[Array, "fingers regressors"]:
        return jnp.column_stack([jnp.ones(len(self.covariates)), self.covariates])

    def law(self, point: Float[Array, " coordinates"]) -> Law:
        """At a point."""
        log_sd, correlation = jnp.exp(point[3:5]), jnp.tanh(point[5])
        shifts = jnp.vstack([point[:2], point[self._slopes_from :].reshape(-1, 2)])
        second = correlation * shifts[:, 0] + jnp.sqrt(1.0 - correlation**2) * shifts[:, 1]
        errors = log_sd * jnp.column_stack([shifts[:, 0], second])
        root = jnp.linalg.cholesky(self._design.T @ self._design)
        found = self._regressed(point[2]) + jax.scipy.linalg.solve_triangular(root.T, errors)
        area = jnp.exp(point[6]) if self.area_varies else None
        return Law(found[0], log_sd, correlation, point[2], area, found[1:] if self.covariates.size else None)

    def _regressed(self, log_Ci: Array) -> Float[Array, "regressors 2"]:
        """The fingers' mean log Rsc and log Csc, and their least-squares slopes."""
        design = self._design
        return jnp.linalg.solve(design.T @ design, design.T @ self._skin(log_Ci))

    def _skin(self, log_Ci: Array) -> Float[Array, "fingers 2"]:
        """Log Rsc and log Csc of the fingers, roughly, at the panel's Ci."""
        skin, off = jnp.mean(self.fingers.skin, axis=1), log_Ci - self.fingers.center
        return skin + off * (jnp.array([-1.0, 1.0]) if self.area_varies else self.fingers.slope[:, 0])

    def log_prior(self, point: Float[Array, " coordinates"]) -> Float[Array, ""]:
        """Of the law, up to a constant: that of the medians, half-normal spreads, LKJ's correlation."""
        law, spreads = self.law(point), jnp.concatenate([point[3:5], point[6 : self._slopes_from]])
        half_normal = jnp.sum(spreads - 0.5 * jnp.square(jnp.exp(spreads) / LOG_SD))
        rest = jnp.log1p(-jnp.square(law.correlation))
        regressors = 1 + self.covariates.shape[1]
        to_medians = regressors * (jnp.sum(point[3:5]) + 0.5 * rest)  # the coordinates' determinants
        believed = self.prior.log_density(jnp.append(law.median, law.log_Ci))
        if law.slopes is not None:
            believed = believed - 0.5 * jnp.sum(jnp.square(law.slopes / SLOPE))
        return believed + half_normal + to_medians + LKJ * rest

    def prior_laws(self, random: np.random.Generator, count: int) -> Law:
        """Draws of the law before any record is seen, leaves (count, 1)."""
        drawn, size = self.prior.sample(random, count), self.covariates.shape[1]
        spreads = LOG_SD * np.abs(random.standard_normal((count, 1, 3)))
        return Law(
            np.log(np.stack([drawn[name] for name in SKIN], axis=-1))[:, None],
            spreads[..., :2],
            2.0 * random.beta(LKJ, LKJ, (count, 1)) - 1.0,  # what makes (1 - r^2)^(LKJ - 1)
            np.log(drawn[SHARED])[:, None],
            spreads[..., 2] if self.area_varies else None,
            SLOPE * random.standard_normal((count, 1, size, 2)) if size else None,
        )

    def start(self) -> Float[np.ndarray, " coordinates"]:
        """The moments of the fingers, as if each were known."""
        log_Ci = jnp.mean(self.fingers.center)
        left = self._skin(log_Ci) - self._design @ self._regressed(log_Ci)
        spreads = jnp.log(_LEAST + jnp.append(jnp.std(left, axis=0), jnp.std(self.fingers.center)))
        of_law = np.array([0.0, 0.0, log_Ci, *spreads[:2], 0.0, spreads[2]])[: self._slopes_from]
        return np.append(of_law, np.zeros(2 * self.covariates.shape[1]))

    def log_prob(self, point: Float[Array, " coordinates"]) -> Float[Array, ""]:
        """Log-posterior, up to a constant."""
        of_each = self.law(point).at(self.covariates[:, None])
        return self.log_prior(point) + jnp.sum(self.fingers.log_likelihood(of_each))


def laplace(hierarchy: Hierarchy) -> tuple[Float[np.ndarray, " coordinates"], Float[np.ndarray, "n n"]]:
    """The most probable law, and a root of the covariance there; call it in double precision."""
    start = hierarchy.start()
    scale = np.full(start.size, 1.0 / np.sqrt(len(hierarchy.fingers.center)))
    scale[[name.startswith("shift") for name in hierarchy.names]] = 1.0
    # the records and the prior together leave log Ci a known width; the tables' reach is a multiple of it
    scale[2] = float(jnp.min(hierarchy.fingers.reach)) / REACH
    objective = eqx.Partial(_objective, hierarchy, jnp.asarray(start), jnp.asarray(scale))
    found = scipy.optimize.minimize(
        lambda z: tuple(map(np.asarray, _with_gradient(objective, jnp.asarray(z)))),
        np.zeros(start.size),
        jac=True,
        method="BFGS",
    )
    curvature, axes = np.linalg.eigh(np.asarray(_curvature(objective, jnp.asarray(found.x))))
    return start + scale * found.x, scale[:, None] * axes / np.sqrt(np.maximum(curvature, _FLAT))


def _objective(hierarchy: Hierarchy, start: Array, scale: Array, z: Array) -> Array:
    return -hierarchy.log_prob(start + scale * z)


@eqx.filter_jit
def _with_gradient(objective: eqx.Partial, z: Array) -> tuple[Array, Array]:
    return jax.value_and_grad(objective)(z)


@eqx.filter_jit
def _curvature(objective: eqx.Partial, z: Array) -> Array:
    return jax.hessian(objective)(z)
