"""The posterior of a population's law, given its fingers."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Array, Float

from fitact.inference.finger import SHARED, SKIN
from fitact.inference.fingers import REACH, Fingers, Law
from fitact.model.prior import Prior

LOG_SD = 0.5  # half-normal scale of log-standard deviations: 95 % of the prior lies below 0.98
LKJ = 2.0  # the correlation's density is (1 - r^2)^(LKJ - 1): Lewandowski, Kurowicka, Joe 2009
NAMES = ("shift_Rsc", "shift_Csc", "log_Ci", "log_sd_Rsc", "log_sd_Csc", "atanh_correlation", "log_sd_area")
_LEAST = 0.05  # in a logarithm: spread that a start has at least
_FLAT = 0.1  # of the start's curvature: least that is believed of the optimum's


class Hierarchy(eqx.Module):
    """The log-posterior of a law, in coordinates `names` that are nearly independent.

    The medians are in standard errors from the fingers' mean, which takes away that they spread with the fingers and
    follow Ci; standard deviations are logarithms, the correlation an inverse hyperbolic tangent.

    Attributes:
        fingers: what the records say.
        prior: of the medians of Rsc and Csc, and of Ci.
    """

    fingers: Fingers
    prior: Prior
    area_varies: bool = eqx.field(static=True)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the coordinates."""
        return NAMES if self.area_varies else NAMES[:-1]

    def law(self, point: Float[Array, " coordinates"]) -> Law:
        """At a point."""
        log_sd, correlation = jnp.exp(point[3:5]), jnp.tanh(point[5])
        standard_error = log_sd / jnp.sqrt(len(self.fingers.center))
        first, second = point[0], correlation * point[0] + jnp.sqrt(1.0 - correlation**2) * point[1]
        median = jnp.mean(self._skin(point[2]), axis=0) + standard_error * jnp.stack([first, second])
        return Law(median, log_sd, correlation, point[2], jnp.exp(point[6]) if self.area_varies else None)

    def _skin(self, log_Ci: Array) -> Float[Array, "fingers 2"]:
        """Log Rsc and log Csc of the fingers, roughly, at the panel's Ci."""
        skin, off = jnp.mean(self.fingers.skin, axis=1), log_Ci - self.fingers.center
        return skin + off * (jnp.array([-1.0, 1.0]) if self.area_varies else self.fingers.slope[:, 0])

    def log_prior(self, point: Float[Array, " coordinates"]) -> Float[Array, ""]:
        """Of the law, up to a constant: that of the medians, half-normal spreads, LKJ's correlation."""
        law, spreads = self.law(point), jnp.concatenate([point[3:5], point[6:]])
        half_normal = jnp.sum(spreads - 0.5 * jnp.square(jnp.exp(spreads) / LOG_SD))
        rest = jnp.log1p(-jnp.square(law.correlation))
        to_median = jnp.sum(point[3:5]) + 0.5 * rest  # the coordinates' determinants
        believed = self.prior.log_density(jnp.append(law.median, law.log_Ci))
        return believed + half_normal + to_median + LKJ * rest

    def prior_laws(self, random: np.random.Generator, count: int) -> Law:
        """Draws of the law before any record is seen, leaves (count, 1)."""
        drawn = self.prior.sample(random, count)
        spreads = LOG_SD * np.abs(random.standard_normal((count, 1, 3)))
        return Law(
            np.log(np.stack([drawn[name] for name in SKIN], axis=-1))[:, None],
            spreads[..., :2],
            2.0 * random.beta(LKJ, LKJ, (count, 1)) - 1.0,  # what makes (1 - r^2)^(LKJ - 1)
            np.log(drawn[SHARED])[:, None],
            spreads[..., 2] if self.area_varies else None,
        )

    def start(self) -> Float[np.ndarray, " coordinates"]:
        """The moments of the fingers, as if each were known."""
        log_Ci = jnp.mean(self.fingers.center)
        spreads = jnp.log(_LEAST + jnp.append(jnp.std(self._skin(log_Ci), axis=0), jnp.std(self.fingers.center)))
        return np.array([0.0, 0.0, log_Ci, *spreads[:2], 0.0, spreads[2]])[: len(self.names)]

    def log_prob(self, point: Float[Array, " coordinates"]) -> Float[Array, ""]:
        """Log-posterior, up to a constant."""
        return self.log_prior(point) + jnp.sum(self.fingers.log_likelihood(self.law(point)))


def laplace(hierarchy: Hierarchy) -> tuple[Float[np.ndarray, " coordinates"], Float[np.ndarray, "n n"]]:
    """The most probable law, and a root of the covariance there; call it in double precision."""
    start = hierarchy.start()
    scale = np.append([1.0, 1.0], np.full(start.size - 2, 1.0 / np.sqrt(len(hierarchy.fingers.center))))
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
