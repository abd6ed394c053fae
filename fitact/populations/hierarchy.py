"""Posterior of the population parameters, given the fingers, with all effects of persons and touches integrated out."""

import itertools
from collections.abc import Sequence
from typing import Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax.scipy.special import ndtr, ndtri
from jaxtyping import Array, Float

from fitact.compiled import jit, solve_lower
from fitact.model.circuit import FINGER_PARAMETERS
from fitact.populations.finger import SKIN, Finger
from fitact.populations.nested_effects import IntegratedEffects, NestedEffects
from fitact.populations.population_parameters import PopulationParameters, finger_loadings
from fitact.prior.prior import Prior
from fitact.readers.study import Nesting

AREA = "contact_area"


class Hierarchy(eqx.Module):
    """Log-posterior of the population parameters, in coordinates `names` that are nearly independent and normal.

    The coefficients beta are the medians of log Rsc and log Csc, log Ci of the panel, and slopes in the covariates.
    Their coordinates are in standard errors from the estimate given the spreads. The coordinate of a spread is standard
    normal in the prior.
    """

    prior: Prior  # of the medians of Rsc and Csc, and of Ci
    effects: NestedEffects
    covariates: Float[Array, "touches covariates"]  # standardized
    factors: Float[Array, "touches 3 3"]  # normal likelihoods of the touches, see `Finger`
    targets: Float[Array, "touches 3"]  # at the coefficients `origin`
    origin: Float[Array, " coefficients"]
    area_varies: bool = eqx.field(static=True)  # whether each touch has its own contact area
    levels: tuple[str, ...] = eqx.field(static=True)  # names, from the top
    # scale of the half-normal prior of log-standard deviations; 95 % of it lie below 0.98
    log_sd_scale: float = eqx.field(static=True, default=0.5)
    # prior standard deviation of a change of log Rsc, log Csc or log area per standard deviation of a covariate
    slope_sd: float = eqx.field(static=True, default=0.5)
    # shape of the correlation's density (1 - r^2)^(lkj - 1) (Lewandowski, Kurowicka, Joe 2009)
    lkj: float = eqx.field(static=True, default=2.0)

    @classmethod
    def from_fingers(
        cls,
        fingers: Sequence[Finger],
        nesting: Nesting,
        prior: Prior,
        covariates: Float[np.ndarray, "touches covariates"],
        *,
        area_varies: bool,
    ) -> Self:
        """Make the posterior from fingers, in the order of the units of the lowest level."""
        numbers = [level.unit_numbers for level in nesting.levels]
        parents = []
        for above, below in itertools.pairwise(numbers):
            parent = np.zeros(below.max() + 1, dtype=int)
            parent[below] = above
            parents.append(parent)
        effects = NestedEffects(tuple(parents), tuple(len(level.units) for level in nesting.levels))
        centers = np.array([finger.center[-3:] for finger in fingers])
        factors = np.array([finger.skin_factor for finger in fingers])
        components = 2 + area_varies
        origin = np.append(centers.mean(axis=0), np.zeros(components * covariates.shape[1]))
        targets = np.array([finger.skin_target for finger in fingers])
        targets = targets + np.einsum("tij,tj->ti", factors, centers - origin[:3])
        levels = tuple(level.name for level in nesting.levels)
        return cls(prior, effects, covariates, factors, targets, origin, area_varies, levels)

    @property
    def components(self) -> tuple[str, ...]:
        """Names of what differs between touches."""
        return (*SKIN, AREA) if self.area_varies else SKIN

    @property
    def names(self) -> tuple[str, ...]:
        spreads = (f"spread_{name}_{level}" for level in self.levels for name in self.components)
        correlations = (f"atanh_correlation_{level}" for level in self.levels)
        slopes = (f"shift_{name}_{i + 1}" for i in range(self.covariates.shape[1]) for name in self.components)
        return (*(f"shift_{name}" for name in FINGER_PARAMETERS), *slopes, *spreads, *correlations)

    def _split(self, point: Float[Array, " coordinates"]) -> tuple[Array, Array, Array]:
        """Return the coordinates of the coefficients, of the spreads and of the correlations."""
        first, levels = self.origin.size, len(self.levels)
        shifts, spreads, correlations = jnp.split(point, [first, len(self.names) - levels])
        return shifts, spreads.reshape(levels, -1), correlations

    def _design(self) -> Float[Array, "touches 3 coefficients"]:
        """Return the derivatives of log Rsc, log Csc and log Ci of each touch in the coefficients."""
        loadings = finger_loadings(len(self.components))
        slopes = jnp.einsum("tc,ik->tick", self.covariates, loadings).reshape(len(self.targets), 3, -1)
        return jnp.concatenate([jnp.tile(jnp.eye(3), (len(self.targets), 1, 1)), slopes], axis=2)

    def _integrate(self, law: PopulationParameters) -> IntegratedEffects:
        """Integrate the effects out; coefficients are (1, beta - origin)."""
        rows = jnp.concatenate([self.targets[..., None], -self.factors @ self._design()], axis=2)
        return self.effects.integrate(self.factors @ finger_loadings(len(self.components)), rows, law.effect_roots())

    def _solve(
        self, point: Float[Array, " coordinates"]
    ) -> tuple[PopulationParameters, IntegratedEffects, Float[Array, " coefficients"], Float[Array, ""]]:
        """Return the parameters, the likelihood given these, (1, beta - origin), and the log-volume of beta."""
        shifts, spreads, correlations = self._split(point)
        # quantiles of the half-normal distribution, exact in the upper tail
        log_sd = -self.log_sd_scale * ndtri(0.5 * ndtr(-spreads))
        law = PopulationParameters(jnp.zeros(2), log_sd, jnp.tanh(correlations), jnp.zeros(()), jnp.zeros((0, 2)))
        integrated = self._integrate(law)
        covariance = jnp.asarray(self.prior.covariance)
        prior_precision = jnp.full(self.origin.size, self.slope_sd**-2).at[:3].set(0.0)
        prior_precision = jnp.diag(prior_precision).at[:3, :3].add(jnp.linalg.inv(covariance))
        center = jnp.zeros(self.origin.size).at[:3].set(jnp.asarray(self.prior.log_mean)) - self.origin
        root = jnp.linalg.cholesky(integrated.square[1:, 1:] + prior_precision)
        information = prior_precision @ center - integrated.square[1:, 0]
        mean = solve_lower(root, solve_lower(root, information), transposed=True)
        away = mean + solve_lower(root, shifts, transposed=True)
        beta = self.origin + away
        law = law._replace(
            mean=jnp.append(beta[:2], jnp.zeros(len(self.components) - 2)),
            log_Ci=beta[2],
            slopes=beta[3:].reshape(-1, len(self.components)),
        )
        return law, integrated, jnp.append(1.0, away), -jnp.sum(jnp.log(jnp.diagonal(root)))

    def population_parameters(self, point: Float[Array, " coordinates"]) -> PopulationParameters:
        return self._solve(point)[0]

    def log_prob(self, point: Float[Array, " coordinates"]) -> Float[Array, ""]:
        """Evaluate the log-posterior, up to a constant."""
        law, integrated, coefficients, log_volume = self._solve(point)
        _, spreads, _ = self._split(point)
        log_likelihood = integrated.log_norm - 0.5 * coefficients @ integrated.square @ coefficients
        log_prior = self.prior.log_density(jnp.append(law.mean[:2], law.log_Ci))
        log_prior = log_prior - 0.5 * jnp.sum(jnp.square(law.slopes / self.slope_sd))
        log_prior = log_prior - 0.5 * jnp.sum(jnp.square(spreads))
        return log_likelihood + log_prior + self.lkj * jnp.sum(jnp.log1p(-jnp.square(law.correlation))) + log_volume

    def draw_sums(
        self, point: Float[Array, " coordinates"], *deviates: Float[Array, "units components"]
    ) -> Float[Array, "all_units components"]:
        """Draw the sums of the effects down to each level, the top level's units first, given the records."""
        _, integrated, coefficients, _ = self._solve(point)
        return jnp.concatenate(self.effects.draw(integrated, coefficients, deviates))

    def draw_touches(
        self, point: Float[Array, " coordinates"], *deviates: Float[Array, "units components"]
    ) -> Float[Array, "touches 3"]:
        """Draw log Rsc, log Csc and log Ci of each record's touch."""
        _, integrated, coefficients, _ = self._solve(point)
        sums = self.effects.draw(integrated, coefficients, deviates)[-1]
        shared = self.origin[:3] + self._design() @ coefficients[1:]
        return shared + sums @ finger_loadings(len(self.components)).T

    def sample_prior(self, random: np.random.Generator, count: int) -> PopulationParameters:
        """Draw population parameters from the prior."""
        draws, levels, components = self.prior.sample(random, count), len(self.levels), len(self.components)
        medians = np.log(np.stack([draws[name] for name in SKIN], axis=-1))
        return PopulationParameters(
            np.pad(medians, ((0, 0), (0, components - 2))),
            self.log_sd_scale * np.abs(random.standard_normal((count, levels, components))),
            2.0 * random.beta(self.lkj, self.lkj, (count, levels)) - 1.0,  # has the density (1 - r^2)^(lkj - 1)
            np.log(draws[FINGER_PARAMETERS[2]]),
            self.slope_sd * random.standard_normal((count, self.covariates.shape[1], components)),
        )


def laplace(hierarchy: Hierarchy) -> tuple[Float[np.ndarray, " coordinates"], Float[np.ndarray, "n n"]]:
    """Find the posterior mode, and a root of the covariance there; call it in double precision."""
    size, step = len(hierarchy.names), 1e-4
    point = scipy.optimize.minimize(
        lambda z: _value_and_gradient(hierarchy, z), np.zeros(size), jac=True, method="BFGS"
    ).x
    steps = step * np.eye(size)  # differences take less time than another program to compile
    ends = [[_value_and_gradient(hierarchy, point + sign * each)[1] for sign in (1.0, -1.0)] for each in steps]
    hessian = np.array([(upper - lower) / (2.0 * step) for upper, lower in ends])
    curvature, axes = np.linalg.eigh(0.5 * (hessian + hessian.T))
    # the prior's curvature is about 1, so a lower one is that of the tail of a spread
    return point, axes / np.sqrt(np.maximum(curvature, 0.25))


def _objective(hierarchy: Hierarchy, point: Array) -> Array:
    return -hierarchy.log_prob(point)


@jit
def _value_and_gradient(hierarchy: Hierarchy, point: Array) -> tuple[Array, Array]:
    return jax.value_and_grad(_objective, argnums=1)(hierarchy, point)
