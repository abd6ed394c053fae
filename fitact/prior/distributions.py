"""Priors for one positive parameter x, given as densities of u = log x.

Parameters are fitted and sampled as logarithms, so each density includes the Jacobian of the transformation. Each
distribution also maps u to a standard normal z = Phi^-1(F(u)), which serves for correlations and for drawing.
"""

import abc
import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy
from jax.scipy.special import ndtr, ndtri
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.compiled import array_module, double_precision
from fitact.errors import InputError


class Distribution(eqx.Module):
    """Prior for one positive parameter."""

    @abc.abstractmethod
    def log_moments(self) -> tuple[float, float]:
        """Return mean and standard deviation of log x."""

    @property
    def log_mean(self) -> float:
        """Mean of log x."""
        return type(self).log_moments(self)[0]  # Equinox takes long to bind a method

    @property
    def log_sd(self) -> float:
        """Standard deviation of log x."""
        return type(self).log_moments(self)[1]

    @property
    def support(self) -> tuple[float, float]:
        """Bounds of u = log x; infinite without bounds."""
        return -math.inf, math.inf

    @abc.abstractmethod
    def log_density(self, u: ArrayLike) -> Float[Array, "*shape"]:
        """Return the log-density of u = log x, Jacobian included; -inf outside the support."""

    @abc.abstractmethod
    def to_standard_normal(self, u: ArrayLike) -> Float[Array, "*shape"]:
        """Return the standard normal z = Phi^-1(F(u))."""

    @abc.abstractmethod
    def from_standard_normal(self, z: ArrayLike) -> Float[Array, "*shape"]:
        """Return u = log x, the inverse of `to_standard_normal`."""

    def standardize(self, u: ArrayLike) -> Float[Array, "*shape"]:
        """Return (u - mean) / standard deviation."""
        return (jnp.asarray(u) - self.log_mean) / self.log_sd

    @double_precision()
    def sample(self, rng: np.random.Generator, size: int) -> Float[np.ndarray, " size"]:
        """Return draws of x."""
        return np.exp(np.asarray(self.from_standard_normal(rng.standard_normal(size))))


class LogNormal(Distribution):
    """Log-normal: log x has mean log `median` and standard deviation `spread`, which may be arrays."""

    median: ArrayLike
    spread: ArrayLike

    def __check_init__(self) -> None:
        if not (self.median > 0.0 and self.spread > 0.0):
            raise InputError(
                f"a log-normal prior needs a positive median and a positive spread, not {self.median}, {self.spread}"
            )

    @classmethod
    def within_factor(cls, median: float, factor: float) -> "LogNormal":
        """Return the log-normal with 95 % probability between median / `factor` and median * `factor` (> 1)."""
        if not factor > 1.0:
            raise InputError(f"factor = {factor:g} must be above 1: 95 % of the prior lies within this factor")
        return cls(median, math.log(factor) / float(scipy.special.ndtri(0.975)))

    @classmethod
    def with_relative_sd(cls, median: float, relative_sd: float) -> "LogNormal":
        """Return the log-normal whose standard deviation is `relative_sd` (> 0) times its mean."""
        if not relative_sd > 0.0:
            raise InputError(f"relative_sd = {relative_sd:g} must be above 0")
        return cls(median, math.sqrt(math.log1p(relative_sd**2)))

    def log_moments(self) -> tuple[float, float]:
        return math.log(self.median), float(self.spread)

    def standardize(self, u: ArrayLike) -> Float[Array, "*shape"]:
        """Return (u - log median) / spread, also for arrays."""
        return self.to_standard_normal(u)

    def log_density(self, u: ArrayLike) -> Float[Array, "*shape"]:
        """Return the normal log-density of u."""
        return -0.5 * self.to_standard_normal(u) ** 2 - _log(self.spread * math.sqrt(2.0 * math.pi))

    def to_standard_normal(self, u: ArrayLike) -> Float[Array, "*shape"]:
        """Return (u - log median) / spread."""
        return (array_module(u).asarray(u) - _log(self.median)) / self.spread

    def from_standard_normal(self, z: ArrayLike) -> Float[Array, "*shape"]:
        """Return u = log x, the inverse of `to_standard_normal`."""
        return _log(self.median) + self.spread * z


class Bounded(Distribution):
    """Prior that is zero outside `low` < x < `high`."""

    low: eqx.AbstractVar[float]
    high: eqx.AbstractVar[float]

    @abc.abstractmethod
    def cdf(self, u: ArrayLike) -> Float[Array, "*shape"]:
        """Return the cumulative probability of u = log x, within the bounds."""

    @abc.abstractmethod
    def ppf(self, p: ArrayLike) -> Float[Array, "*shape"]:
        """Return log x, the inverse of `cdf`."""

    @property
    def support(self) -> tuple[float, float]:
        return -math.inf if self.low == 0.0 else math.log(self.low), math.log(self.high)

    def contains(self, u: ArrayLike) -> Array:
        """Return whether u = log x lies within the bounds."""
        u, (low, high) = array_module(u).asarray(u), self.support
        return (u >= low) & (u <= high)

    def to_standard_normal(self, u: ArrayLike) -> Float[Array, "*shape"]:
        """Return the standard normal z = Phi^-1(F(u))."""
        u = jnp.where(self.contains(u), u, self.log_mean)  # any value inside, since the density is zero outside
        p = self.cdf(u)
        return ndtri(jnp.clip(p, 1e-300, 1.0 - jnp.finfo(p.dtype).epsneg))  # finite also if p rounds to 0 or 1

    def from_standard_normal(self, z: ArrayLike) -> Float[Array, "*shape"]:
        """Return u = log x, the inverse of `to_standard_normal`."""
        xp = array_module(z)
        return self.ppf((ndtr if xp is jnp else scipy.special.ndtr)(xp.asarray(z, dtype=float)))


class Uniform(Bounded):
    """Uniform distribution of x between `low` and `high`, both above zero."""

    low: float
    high: float

    def __check_init__(self) -> None:
        _check_limits("uniform", self.low, self.high)

    @classmethod
    def with_tolerance(cls, nominal: float, tolerance: float) -> "Uniform":
        """Return the uniform distribution within ± `tolerance` (relative, 0 to 1) of `nominal`.

        Limits stated without a distribution are taken as rectangular (JCGM 100:2008, 4.3.7).
        """
        if not 0.0 < tolerance < 1.0:
            raise InputError(f"tolerance = {tolerance:g} must lie between 0 and 1, such as 0.1 or '10 %'")
        return cls(nominal * (1.0 - tolerance), nominal * (1.0 + tolerance))

    def log_moments(self) -> tuple[float, float]:
        """Return mean and sd of u; the sd is sqrt(1 - q L^2 / (1 - q)^2) with L = log(high / low), q = low / high."""
        mean = (self.high * math.log(self.high) - self.low * math.log(self.low)) / (self.high - self.low) - 1.0
        q = self.low / self.high
        return mean, math.sqrt(max(1.0 - q * math.log(q) ** 2 / (1.0 - q) ** 2, 0.0))

    def log_density(self, u: ArrayLike) -> Float[Array, "*shape"]:
        """Return log(e^u / (high - low)) within the bounds, -inf outside."""
        return array_module(u).where(self.contains(u), u - math.log(self.high - self.low), -math.inf)

    def cdf(self, u: ArrayLike) -> Float[Array, "*shape"]:
        """Return (x - low) / (high - low)."""
        return self.low * array_module(u).expm1(u - math.log(self.low)) / (self.high - self.low)

    def ppf(self, p: ArrayLike) -> Float[Array, "*shape"]:
        """Return log x, the inverse of `cdf`."""
        return math.log(self.low) + array_module(p).log1p(p * ((self.high - self.low) / self.low))


class LogUniform(Bounded):
    """Log-uniform distribution of x between `low` and `high`: all decades are equally probable."""

    low: float
    high: float

    def __check_init__(self) -> None:
        _check_limits("log-uniform", self.low, self.high)

    @property
    def _length(self) -> float:
        return math.log(self.high / self.low)

    def log_moments(self) -> tuple[float, float]:
        return math.log(self.low) + 0.5 * self._length, self._length / math.sqrt(12.0)

    def log_density(self, u: ArrayLike) -> Float[Array, "*shape"]:
        """Return -log log(high / low) within the bounds, -inf outside."""
        return array_module(u).where(self.contains(u), -math.log(self._length), -math.inf)

    def cdf(self, u: ArrayLike) -> Float[Array, "*shape"]:
        """Return log(x / low) / log(high / low)."""
        return (u - math.log(self.low)) / self._length

    def ppf(self, p: ArrayLike) -> Float[Array, "*shape"]:
        """Return log x, the inverse of `cdf`."""
        return math.log(self.low) + self._length * p


class TruncatedLogNormal(Bounded):
    """Log-normal truncated to `low` < x < `high` (0 and inf: no bound); `median` and `spread` are before truncation.

    Raises:
        InputError: the probability within the bounds is below 0.001.
    """

    median: float
    spread: float
    low: float
    high: float

    def __check_init__(self) -> None:
        if not 0.0 <= self.low < self.high:
            raise InputError(f"bounds of a prior need 0 <= low < high, not low = {self.low:g}, high = {self.high:g}")
        if self._mass < 1e-3:  # see above; the median is far outside the bounds
            raise InputError(
                f"the bounds low = {self.low:g}, high = {self.high:g} contain almost none of a prior with median"
                f" {self.median:g}; bring the median within them"
            )

    @property
    def _parent(self) -> LogNormal:
        return LogNormal(self.median, self.spread)

    @property
    def _limits(self) -> tuple[float, float]:
        """Bounds in standard deviations before truncation."""
        low, high = ((math.log(x) if x > 0.0 else -math.inf) - math.log(self.median) for x in (self.low, self.high))
        return low / self.spread, high / self.spread

    @property
    def _cdf_low(self) -> float:
        return _normal_cdf(self._limits[0])

    @property
    def _mass(self) -> float:
        return _normal_cdf(self._limits[1]) - self._cdf_low

    def log_moments(self) -> tuple[float, float]:
        """Return mean and standard deviation of u by quadrature; the closed form cancels if the bounds are close."""
        low, high = np.clip(self._limits, -10.0, 10.0)  # omits a probability of 1e-23
        nodes, weights = np.polynomial.legendre.leggauss(128)
        z = low + 0.5 * (high - low) * (nodes + 1.0)
        weights = weights * np.exp(-0.5 * (z**2 - np.min(z**2)))
        weights = weights / weights.sum()
        mean = float(weights @ z)
        return math.log(self.median) + self.spread * mean, self.spread * math.sqrt(weights @ (z - mean) ** 2)

    def log_density(self, u: ArrayLike) -> Float[Array, "*shape"]:
        """Return the normal log-density of u, normalised within the bounds."""
        return jnp.where(self.contains(u), self._parent.log_density(u) - math.log(self._mass), -jnp.inf)

    def cdf(self, u: ArrayLike) -> Float[Array, "*shape"]:
        """Return the cumulative probability of u = log x, within the bounds."""
        return (ndtr(self._parent.to_standard_normal(u)) - self._cdf_low) / self._mass

    def ppf(self, p: ArrayLike) -> Float[Array, "*shape"]:
        """Return log x, the inverse of `cdf`."""
        z = ndtri(self._cdf_low + jnp.asarray(p) * self._mass)
        return self._parent.from_standard_normal(jnp.clip(z, *self._limits))


def _log(x: Any) -> Any:
    """Return the logarithm, by NumPy outside compiled functions."""
    return array_module(x).log(x)


def _check_limits(kind: str, low: float, high: float) -> None:
    if not 0.0 < low < high < math.inf:
        raise InputError(f"a {kind} prior needs 0 < low < high, not low = {low:g}, high = {high:g}")


def _normal_cdf(z: float) -> float:
    return 0.5 * math.erfc(-z / math.sqrt(2.0))
