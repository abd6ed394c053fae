"""The likelihood of each of several fingers as a function of what they share, all that is its own integrated out.

Given log Ci, a finger's likelihood is nearly normal in log Rsc, log Csc and its nuisances, also where Vsc alone
leaves the three together open: its mean then slides along that line with log Ci. Draws of a Student-t over that
normal slide with it, so the weight of each draw is a smooth function of log Ci alone, tabulated once. Under any law
the likelihood is that of the normal, in closed form, times what averages of the law's density over the draws, with
their exact weights and with the normal's, say that it is off by.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.special
import scipy.stats
from jaxtyping import Array, Float

from fitact.errors import InputError
from fitact.likelihood.likelihood import Batched, Likelihood
from fitact.populations.finger import SHARED, SKIN, Finger
from fitact.prior.distributions import Distribution
from fitact.sampling.proposal import DEGREES, Proposal

REACH = 8.0  # standard deviations of log Ci that the tables hold
_AREA = 1.0  # of an area's logarithm: the widest that the tables allow for
_BATCH = 128  # points evaluated at a time
_IMPOSSIBLE = -1e6  # log-weight of a draw that some nuisance's prior forbids, or a compression does not reach


class Law(NamedTuple):
    """How fingers of a population are distributed.

    Attributes:
        median: of log Rsc and log Csc, at the panel's Ci: their means.
        log_sd: of Rsc and Csc.
        correlation: of their logarithms.
        log_Ci: of the panel, for the median finger's area.
        area: standard deviation of the logarithm of a finger's area; None: they are the same.
        slopes: by how much a standard deviation of each covariate shifts `median`, which is at their mean.
    """

    median: Float[Array, "2"]
    log_sd: Float[Array, "2"]
    correlation: Float[Array, ""]
    log_Ci: Float[Array, ""]
    area: Float[Array, ""] | None = None
    slopes: Float[Array, "covariates 2"] | None = None

    def at(self, covariates: Float[Array, "*shape covariates"]) -> Self:
        """The law of fingers with those (standardised) covariates, its median of shape (*shape, 2)."""
        return self if self.slopes is None else self._replace(median=self.median + covariates @ self.slopes)

    def log_density(self, skin: Float[Array, "*shape 2"]) -> Float[Array, "*shape"]:
        """Of log Rsc and log Csc, at the median area, up to a constant."""
        first, second = jnp.moveaxis((skin - self.median) / self.log_sd, -1, 0)
        rest = 1.0 - jnp.square(self.correlation)
        squares = jnp.square(first) + jnp.square(second - self.correlation * first) / rest
        return -0.5 * squares - jnp.sum(jnp.log(self.log_sd)) - 0.5 * jnp.log(rest)


class Fingers(eqx.Module):
    """Weighted draws of several fingers, as tables in log Ci.

    Attributes:
        skin: log Rsc and log Csc of each draw at `center`.
        slope: how they move with log Ci.
        center, reach: of the tables in log Ci.
        weight: Chebyshev coefficients of the log-weights.
        precision: of log Ci, by each record alone.
        pull: precision times how far the record wants log Ci from `center`.
        deviate: standard normal numbers that draw the fingers' areas.
        normal: log-weights of the draws under the normal likelihood, at `center`.
        mean, covariance: of log Rsc and log Csc by that.
    """

    skin: Float[Array, "fingers draws 2"]
    slope: Float[Array, "fingers 1 2"]
    center: Float[Array, "fingers 1"]
    reach: Float[Array, "fingers 1"]
    weight: Float[Array, "fingers draws terms"]
    precision: Float[Array, "fingers 1"]
    pull: Float[Array, "fingers 1"]
    deviate: Float[Array, "fingers draws"]
    normal: Float[Array, "fingers draws"]
    mean: Float[Array, "fingers 2"]
    covariance: Float[Array, "fingers 2 2"]

    @classmethod
    def tabulated(
        cls,
        fingers: Sequence[Finger],
        prior: Distribution,
        *,
        area_varies: bool,
        draws: int,
        terms: int,
        seed: Sequence[int],
    ) -> Self:
        """Tables of `terms`, wherever the records and the panel's `prior` allow log Ci to be."""
        tables = []
        center, reach = _weighed(fingers, prior.log_mean, prior.log_sd)
        for each, child in zip(fingers, np.random.SeedSequence(seed).spawn(len(fingers)), strict=True):
            if area_varies:
                center, reach = _weighed([each], prior.log_mean, math.hypot(prior.log_sd, _AREA))
            student = Proposal(np.zeros(each.place.size + area_varies), np.eye(each.place.size + area_varies))
            tables.append(_table(each, center, reach, student, draws, terms, np.random.default_rng(child)))
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *tables)

    def log_likelihood(self, law: Law) -> Float[Array, " fingers"]:
        """Of each finger under a law, up to a constant; -inf beyond the tables.

        That of the normal likelihood is known in closed form; the draws say by what factor the exact one differs, which
        takes most of their noise away where a law is narrower than they are apart.
        """
        log_Ci, value = jnp.broadcast_to(law.log_Ci, self.deviate.shape), jnp.zeros(())
        if law.area is not None:
            # given the law, log Ci of a finger is normal, but for what the tables correct
            precision, middle = self._of_areas(law.log_Ci, law.area)
            log_Ci = self.center + middle + self.deviate / jnp.sqrt(precision)
            value = -0.5 * jnp.square((log_Ci - law.log_Ci) / law.area) - jnp.log(law.area) - 0.5 * jnp.log(precision)
        off = log_Ci - self.center
        own = self.skin + self.slope * off[..., None]
        skin = own + jnp.array([1.0, -1.0]) * (log_Ci - law.log_Ci)[..., None]
        value, at = value + law.log_density(skin), off / self.reach
        exact = value + jnp.where(jnp.abs(at) <= 1.0, _series(self.weight, at), -jnp.inf)
        normal = value + self.normal + self.pull * off - 0.5 * self.precision * jnp.square(off)
        factor = jax.nn.logsumexp(exact, axis=1) - jax.nn.logsumexp(normal, axis=1)
        return self._normal_log_likelihood(law) + factor

    def _of_areas(self, log_Ci: Array, area: Array) -> tuple[Float[Array, "fingers 1"], Float[Array, "fingers 1"]]:
        """Precision of log Ci of each finger, and its mean from `center`, where areas differ by `area`."""
        precision = self.precision + area**-2
        return precision, (self.pull + (log_Ci - self.center) * area**-2) / precision

    def _normal_log_likelihood(self, law: Law) -> Float[Array, " fingers"]:
        """Of the normal likelihood under a law, up to a constant."""
        off = law.log_Ci - self.center
        between = jnp.outer(law.log_sd, law.log_sd) * jnp.where(jnp.eye(2) == 1.0, 1.0, law.correlation)
        covariance, mean = self.covariance + between, self.mean + self.slope[:, 0] * off
        value = self.pull * off - 0.5 * self.precision * jnp.square(off)
        if law.area is not None:
            precision, middle = self._of_areas(law.log_Ci, law.area)
            area = jnp.array([1.0, -1.0])
            along = self.slope[:, 0] + area
            covariance = covariance + along[:, :, None] * along[:, None, :] / precision[..., None]
            mean = self.mean + self.slope[:, 0] * middle + area * (middle - off)
            value = 0.5 * precision * jnp.square(middle) - 0.5 * jnp.square(off / law.area)
            value = value - jnp.log(law.area) - 0.5 * jnp.log(precision)
        left = mean - law.median.reshape(-1, 2)
        (xx, xy), (_, yy) = jnp.moveaxis(covariance, 0, -1)
        determinant = xx * yy - jnp.square(xy)
        squares = yy * left[:, 0] ** 2 - 2.0 * xy * left[:, 0] * left[:, 1] + xx * left[:, 1] ** 2
        return value[:, 0] - 0.5 * (squares / determinant + jnp.log(determinant))


def _spread_out(size: int, draws: int, random: np.random.Generator) -> Float[np.ndarray, "draws size"]:
    """Draws of a `Proposal` of no mean and unit axes by Sobol's scrambled sequence: fewer hold an integral as well."""
    uniform = scipy.stats.qmc.Sobol(size + 1, rng=random).random(draws)
    chi_square = scipy.stats.chi2.ppf(uniform[:, -1:], DEGREES)
    return scipy.special.ndtri(uniform[:, :-1]) * np.sqrt(DEGREES / chi_square)


def _series(weight: Float[Array, "fingers draws terms"], at: Float[Array, "fingers draws"]) -> Array:
    """Chebyshev series, by Clenshaw's recurrence."""
    later, latest = jnp.zeros_like(at), jnp.zeros_like(at)
    for k in range(weight.shape[-1] - 1, 0, -1):
        latest, later = 2.0 * at * latest - later + weight[..., k], latest
    return at * latest - later + weight[..., 0]


def _weighed(fingers: Sequence[Finger], mean: float, sd: float) -> tuple[float, float]:
    """Where log Ci may lie by records and a normal prior, and how far from there."""
    precision = sd**-2 + sum(each.precision for each in fingers)
    pull = sum(each.pull + each.precision * (each.center - mean) for each in fingers)
    return mean + pull / precision, REACH / math.sqrt(precision)


def _table(
    finger: Finger,
    center: float,
    reach: float,
    student: Proposal,
    draws: int,
    terms: int,
    random: np.random.Generator,
) -> Fingers:
    """Of one finger, for log Ci within `reach` of `center`; a deviate beyond its own coordinates draws its area."""
    own = finger.place.size
    deviates = _spread_out(student.center.size, draws, random)
    nodes = np.cos(np.pi * (np.arange(terms) + 0.5) / terms)
    points = np.stack([finger.at(center + reach * x, deviates[:, :own]) for x in nodes])
    log_prob = Batched(Likelihood.log_prob, finger.likelihood, finger.likelihood.rows, _BATCH)
    values = log_prob(points.reshape(-1, points.shape[-1]))
    density = student.log_density(deviates)
    values = values.reshape(terms, draws) - density
    possible = np.isfinite(values).all(axis=0)
    if not possible.any():
        raise InputError(f"{finger.source}: the record leaves Rsc and Csc too open for a population; leave it out")
    values = np.where(possible, values - np.max(values[:, possible]), _IMPOSSIBLE)
    skin = [finger.names.index(name) for name in SKIN]
    at_center = finger.at(center, np.vstack([np.zeros(own), deviates[:, :own]]))[:, skin]
    root = np.insert(finger.root, finger.names.index(SHARED), 0.0, axis=0)[skin]
    off = center - finger.center
    return Fingers(
        skin=jnp.asarray(at_center[1:]),
        slope=jnp.asarray(np.insert(finger.slope, finger.names.index(SHARED), 1.0)[None, skin]),
        center=jnp.array([center]),
        reach=jnp.array([reach]),
        weight=jnp.asarray(np.polynomial.chebyshev.chebfit(nodes, values, terms - 1).T),
        precision=jnp.array([finger.precision]),
        pull=jnp.array([finger.pull - finger.precision * off]),
        deviate=jnp.asarray(deviates[:, -1] if deviates.shape[1] > own else np.zeros(draws)),
        normal=jnp.asarray(-0.5 * np.sum(np.square(deviates[:, :own]), axis=1) - density),
        mean=jnp.asarray(at_center[0]),
        covariance=jnp.asarray(root @ root.T),
    )
