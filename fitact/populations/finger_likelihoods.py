"""Likelihoods of several fingers under population parameters, with each finger's own parameters integrated out.

Given log Ci, the likelihood of a finger is nearly normal in log Rsc, log Csc and its nuisances. The mean moves with
log Ci along a line, also where Vsc alone does not determine the three. Draws of a Student-t distribution over that
normal move with it, so the weight of each draw is a smooth function of log Ci, tabulated once. The likelihood is the
normal's, in closed form, times a correction: the ratio of two averages of the population density over the draws, with
their exact weights and with the normal's weights.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from fitact.compiled import BatchEvaluator
from fitact.errors import InputError
from fitact.likelihood.likelihood import Likelihood
from fitact.populations.finger import SHARED_PARAMETER, SKIN, Finger
from fitact.prior.distributions import Distribution
from fitact.sampling.proposal import DEGREES_OF_FREEDOM, student_log_density

TABLE_HALF_WIDTH = 8.0  # half-width of the tables, in standard deviations of log Ci


class PopulationParameters(NamedTuple):
    """Parameters of the distribution of fingers."""

    median: Float[Array, "2"]  # means of log Rsc and log Csc, at the panel's Ci
    log_sd: Float[Array, "2"]  # standard deviations of log Rsc and log Csc
    correlation: Float[Array, ""]  # of log Rsc and log Csc
    log_Ci: Float[Array, ""]  # log Ci of the panel, for the median contact area
    area: Float[Array, ""] | None = None  # standard deviation of log contact area; None means that all are equal
    # shift of `median` per standard deviation of each covariate; `median` is at their mean
    slopes: Float[Array, "covariates 2"] | None = None

    def shift_medians(self, covariates: Float[Array, "*shape covariates"]) -> Self:
        """Return the parameters for fingers with these (standardized) covariates, with medians of shape (*shape, 2)."""
        return self if self.slopes is None else self._replace(median=self.median + covariates @ self.slopes)

    def log_density(self, skin: Float[Array, "*shape 2"]) -> Float[Array, "*shape"]:
        """Evaluate the density of log Rsc and log Csc, at the median area, up to a constant."""
        first, second = jnp.moveaxis((skin - self.median) / self.log_sd, -1, 0)
        rest = 1.0 - jnp.square(self.correlation)
        squares = jnp.square(first) + jnp.square(second - self.correlation * first) / rest
        return -0.5 * squares - jnp.sum(jnp.log(self.log_sd)) - 0.5 * jnp.log(rest)


class FingerLikelihoods(eqx.Module):
    """Weighted draws of several fingers, as tables in log Ci."""

    skin: Float[Array, "fingers draws 2"]  # log Rsc and log Csc of each draw at `center`
    slope: Float[Array, "fingers 1 2"]  # their derivatives with respect to log Ci
    center: Float[Array, "fingers 1"]  # of the tables in log Ci
    half_width: Float[Array, "fingers 1"]
    weight: Float[Array, "fingers draws terms"]  # Chebyshev coefficients of the log-weights
    precision: Float[Array, "fingers 1"]  # information of each record alone on log Ci, as in `Finger`
    weighted_offset: Float[Array, "fingers 1"]
    area_deviates: Float[Array, "fingers draws"]  # standard normal numbers for the fingers' areas
    normal_log_weight: Float[Array, "fingers draws"]  # log-weights under the normal likelihood, at `center`
    mean: Float[Array, "fingers 2"]  # moments of log Rsc and log Csc under the normal likelihood
    covariance: Float[Array, "fingers 2 2"]

    @classmethod
    def from_fingers(
        cls,
        fingers: Sequence[Finger],
        prior: Distribution,
        *,
        area_varies: bool,
        draws: int,
        terms: int,
        seed: Sequence[int],
    ) -> Self:
        """Tabulate `terms` Chebyshev terms over the log Ci that the records and the panel's `prior` allow."""
        max_log_sd_area = 1.0  # largest standard deviation of an area's logarithm that the tables cover
        tables = []
        center, half_width = _log_Ci_interval(fingers, prior.log_mean, prior.log_sd)
        for finger, child in zip(fingers, np.random.SeedSequence(seed).spawn(len(fingers)), strict=True):
            if area_varies:
                log_sd = math.hypot(prior.log_sd, max_log_sd_area)
                center, half_width = _log_Ci_interval([finger], prior.log_mean, log_sd)
            size = finger.conditional_mean.size + area_varies
            deviates = _sobol_student_t(size, draws, np.random.default_rng(child))
            tables.append(_tabulate_finger(finger, center, half_width, deviates, terms))
        return jax.tree.map(lambda *leaves: np.stack(leaves), *tables)

    def log_likelihood(self, parameters: PopulationParameters) -> Float[Array, " fingers"]:
        """Evaluate the log-likelihood of each finger, up to a constant; -inf beyond the tables.

        The normal likelihood is known in closed form, and the draws give the factor to the exact one. This removes most
        of their noise where the population is narrower than the distance between draws.
        """
        log_Ci, value = jnp.broadcast_to(parameters.log_Ci, self.area_deviates.shape), jnp.zeros(())
        if parameters.area is not None:
            # a finger's log Ci is normal given the population parameters; the tables correct the difference
            precision, middle = self._log_Ci_moments(parameters.log_Ci, parameters.area)
            log_Ci = self.center + middle + self.area_deviates / jnp.sqrt(precision)
            value = (
                -0.5 * jnp.square((log_Ci - parameters.log_Ci) / parameters.area)
                - jnp.log(parameters.area)
                - 0.5 * jnp.log(precision)
            )
        off = log_Ci - self.center
        skin = self.skin + self.slope * off[..., None]
        skin = skin + jnp.array([1.0, -1.0]) * (log_Ci - parameters.log_Ci)[..., None]
        value, x = value + parameters.log_density(skin), off / self.half_width
        exact = value + jnp.where(jnp.abs(x) <= 1.0, _chebyshev_series(self.weight, x), -jnp.inf)
        normal = value + self.normal_log_weight + self.weighted_offset * off - 0.5 * self.precision * jnp.square(off)
        factor = jax.nn.logsumexp(exact, axis=1) - jax.nn.logsumexp(normal, axis=1)
        return self._normal_log_likelihood(parameters) + factor

    def _log_Ci_moments(
        self, log_Ci: Array, area: Array
    ) -> tuple[Float[Array, "fingers 1"], Float[Array, "fingers 1"]]:
        """Compute each finger's precision of log Ci, and its mean relative to `center`, if areas differ by `area`."""
        precision = self.precision + area**-2
        return precision, (self.weighted_offset + (log_Ci - self.center) * area**-2) / precision

    def _normal_log_likelihood(self, parameters: PopulationParameters) -> Float[Array, " fingers"]:
        off = parameters.log_Ci - self.center
        correlations = jnp.where(jnp.eye(2) == 1.0, 1.0, parameters.correlation)
        between = jnp.outer(parameters.log_sd, parameters.log_sd) * correlations
        covariance, mean = self.covariance + between, self.mean + self.slope[:, 0] * off
        value = self.weighted_offset * off - 0.5 * self.precision * jnp.square(off)
        if parameters.area is not None:
            precision, middle = self._log_Ci_moments(parameters.log_Ci, parameters.area)
            area = jnp.array([1.0, -1.0])
            along = self.slope[:, 0] + area
            covariance = covariance + along[:, :, None] * along[:, None, :] / precision[..., None]
            mean = self.mean + self.slope[:, 0] * middle + area * (middle - off)
            value = 0.5 * precision * jnp.square(middle) - 0.5 * jnp.square(off / parameters.area)
            value = value - jnp.log(parameters.area) - 0.5 * jnp.log(precision)
        first, second = (mean - parameters.median.reshape(-1, 2)).T
        (xx, xy), (_, yy) = jnp.moveaxis(covariance, 0, -1)
        determinant = xx * yy - jnp.square(xy)
        squares = yy * first**2 - 2.0 * xy * first * second + xx * second**2
        return value[:, 0] - 0.5 * (squares / determinant + jnp.log(determinant))


def _sobol_student_t(size: int, draws: int, random: np.random.Generator) -> Float[np.ndarray, "draws size"]:
    """Draw standard Student-t numbers by a scrambled Sobol sequence, which needs fewer draws for an integral."""
    uniform = scipy.stats.qmc.Sobol(size + 1, rng=random).random(draws)
    chi_square = scipy.stats.chi2.ppf(uniform[:, -1:], DEGREES_OF_FREEDOM)
    return scipy.special.ndtri(uniform[:, :-1]) * np.sqrt(DEGREES_OF_FREEDOM / chi_square)


def _chebyshev_series(weight: Float[Array, "fingers draws terms"], x: Float[Array, "fingers draws"]) -> Array:
    """Sum Chebyshev series by Clenshaw's recurrence."""
    later, latest = jnp.zeros_like(x), jnp.zeros_like(x)
    for k in range(weight.shape[-1] - 1, 0, -1):
        latest, later = 2.0 * x * latest - later + weight[..., k], latest
    return x * latest - later + weight[..., 0]


def _log_Ci_interval(fingers: Sequence[Finger], mean: float, sd: float) -> tuple[float, float]:
    """Find the center and half-width of the interval of log Ci that records and a normal prior allow."""
    precision = sd**-2 + sum(finger.precision for finger in fingers)
    offset = sum(finger.weighted_offset + finger.precision * (finger.center - mean) for finger in fingers)
    return mean + offset / precision, TABLE_HALF_WIDTH / math.sqrt(precision)


def _tabulate_finger(
    finger: Finger, center: float, half_width: float, deviates: Float[np.ndarray, "draws size"], terms: int
) -> FingerLikelihoods:
    """Tabulate a finger for log Ci within `half_width` of `center`; an additional deviate draws its area."""
    own, draws = finger.conditional_mean.size, len(deviates)
    z, shared = deviates[:, :own], finger.names.index(SHARED_PARAMETER)
    nodes = np.cos(np.pi * (np.arange(terms) + 0.5) / terms)
    log_density = student_log_density(deviates)
    normal = -0.5 * np.sum(np.square(z), axis=1) - log_density
    if finger.likelihood is None:
        away = center + half_width * nodes[:, None] - finger.center
        values = normal + finger.weighted_offset * away - 0.5 * finger.precision * np.square(away)
    else:
        points = np.stack([finger.from_standard_normal(center + half_width * x, z) for x in nodes])
        log_prob = BatchEvaluator(Likelihood.log_prob, finger.likelihood, finger.likelihood.rows, batch=128)
        values = log_prob(points.reshape(-1, points.shape[-1])).reshape(terms, draws) - log_density
    possible = np.isfinite(values).all(axis=0)
    if not possible.any():
        raise InputError(
            f"{finger.source}: the record does not constrain Rsc and Csc enough for a population; leave it out"
        )
    # a nuisance's prior excludes the other draws, or the compression does not cover them
    values = np.where(possible, values - np.max(values[:, possible]), -1e6)
    skin = [finger.names.index(name) for name in SKIN]
    at_center = finger.from_standard_normal(center, np.vstack([np.zeros(own), z]))[:, skin]
    factor = np.insert(finger.covariance_factor, shared, 0.0, axis=0)[skin]
    off = center - finger.center
    return FingerLikelihoods(
        skin=at_center[1:],
        slope=np.insert(finger.slope, shared, 1.0)[None, skin],
        center=np.array([center]),
        half_width=np.array([half_width]),
        weight=np.polynomial.chebyshev.chebfit(nodes, values, terms - 1).T,
        precision=np.array([finger.precision]),
        weighted_offset=np.array([finger.weighted_offset - finger.precision * off]),
        area_deviates=deviates[:, -1] if deviates.shape[1] > own else np.zeros(draws),
        normal_log_weight=normal,
        mean=at_center[0],
        covariance=factor @ factor.T,
    )
