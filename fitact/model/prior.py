"""What is believed of the parameters before the data, as densities of their logarithms.

Everything is fitted and sampled in log-parameters, so each distribution gives the density of
u = log x, with the Jacobian of the change included.
"""

import abc
import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.errors import InputError

_Z95 = 1.959963984540054  # half-width, in standard deviations, of a central 95 % interval


class Distribution(eqx.Module):
    """A prior for one positive parameter."""

    @property
    @abc.abstractmethod
    def log_mean(self) -> float:
        """Mean of log x."""

    @property
    @abc.abstractmethod
    def log_sd(self) -> float:
        """Standard deviation of log x."""

    @abc.abstractmethod
    def log_density(self, u: ArrayLike) -> Float[Array, "*shape"]:
        """Log-density of u = log x, Jacobian included; -inf where x is impossible."""

    @abc.abstractmethod
    def sample(self, rng: np.random.Generator, size: int) -> Float[np.ndarray, " size"]:
        """Draws of x."""


class LogNormal(Distribution):
    """log x is normal with the standard deviation `spread` around log `median`."""

    median: float
    spread: float

    def __check_init__(self) -> None:
        if not (self.median > 0.0 and self.spread > 0.0):
            raise InputError(
                f"a log-normal prior needs a median and a spread above zero, not {self.median}, {self.spread}"
            )

    @classmethod
    def within_factor(cls, median: float, factor: float) -> "LogNormal":
        """95 % of the probability lies within `factor` (> 1) of the median, either way."""
        if not factor > 1.0:
            raise InputError(f"factor = {factor:g} must be above 1: 95 % of the prior lies within that factor")
        return cls(median, math.log(factor) / _Z95)

    @classmethod
    def with_relative_sd(cls, median: float, relative_sd: float) -> "LogNormal":
        """The standard deviation of x is `relative_sd` (> 0) times its mean."""
        if not relative_sd > 0.0:
            raise InputError(f"relative_sd = {relative_sd:g} must be above 0")
        return cls(median, math.sqrt(math.log1p(relative_sd**2)))

    @property
    def log_mean(self) -> float:
        """Mean of log x."""
        return math.log(self.median)

    @property
    def log_sd(self) -> float:
        """Standard deviation of log x."""
        return self.spread

    def log_density(self, u: ArrayLike) -> Float[Array, "*shape"]:
        """Normal in u."""
        z = (jnp.asarray(u) - self.log_mean) / self.spread
        return -0.5 * z**2 - math.log(self.spread * math.sqrt(2.0 * math.pi))

    def sample(self, rng: np.random.Generator, size: int) -> Float[np.ndarray, " size"]:
        """Draws of x."""
        return np.exp(self.log_mean + self.spread * rng.standard_normal(size))


class Uniform(Distribution):
    """x is uniform between `low` and `high`, both above zero."""

    low: float
    high: float

    def __check_init__(self) -> None:
        if not 0.0 < self.low < self.high:
            raise InputError(f"a uniform prior needs 0 < low < high, not low = {self.low:g}, high = {self.high:g}")

    @property
    def log_mean(self) -> float:
        """Mean of log x."""
        return (self.high * math.log(self.high) - self.low * math.log(self.low)) / (self.high - self.low) - 1.0

    @property
    def log_sd(self) -> float:
        """Standard deviation of log x: sqrt(1 - q L^2 / (1 - q)^2) with L = log(high / low), q = low / high."""
        q = self.low / self.high
        return math.sqrt(max(1.0 - q * math.log(q) ** 2 / (1.0 - q) ** 2, 0.0))

    def log_density(self, u: ArrayLike) -> Float[Array, "*shape"]:
        """e^u / (high - low) inside."""
        u = jnp.asarray(u)
        inside = (u >= math.log(self.low)) & (u <= math.log(self.high))
        return jnp.where(inside, u - math.log(self.high - self.low), -jnp.inf)

    def sample(self, rng: np.random.Generator, size: int) -> Float[np.ndarray, " size"]:
        """Draws of x."""
        return rng.uniform(self.low, self.high, size)


class Prior(eqx.Module):
    """Independent priors of the circuit's parameters.

    Attributes:
        Rsc, Csc, Ci: ohm, F, F.
        gain: of the channel Vsc, where the scene frees it.
    """

    Rsc: Distribution
    Csc: Distribution
    Ci: Distribution
    gain: LogNormal | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters it covers, in the order of the chain."""
        return ("Rsc", "Csc", "Ci") if self.gain is None else ("Rsc", "Csc", "Ci", "gain")

    def __getitem__(self, name: str) -> Distribution:
        return getattr(self, name)

    @property
    def log_mean(self) -> Float[np.ndarray, " parameters"]:
        """Means of the log-parameters."""
        return np.array([self[name].log_mean for name in self.names])

    @property
    def log_sd(self) -> Float[np.ndarray, " parameters"]:
        """Standard deviations of the log-parameters."""
        return np.array([self[name].log_sd for name in self.names])

    def log_density(self, u: Float[Array, " parameters"]) -> Float[Array, ""]:
        """Log-density of the log-parameters."""
        return sum((self[name].log_density(u[i]) for i, name in enumerate(self.names)), jnp.zeros(()))

    def sample(self, rng: np.random.Generator, size: int) -> dict[str, Float[np.ndarray, " size"]]:
        """Draws of the parameters."""
        return {name: self[name].sample(rng, size) for name in self.names}
