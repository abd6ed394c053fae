"""Distribution of a product of independent positive factors, such as the gains of a probe and an oscilloscope."""

import math
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
import scipy
from jax.scipy.special import ndtr, ndtri
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.compiled import array_module
from fitact.prior.distributions import Bounded, Distribution, LogNormal

Factor = tuple[Distribution, float]  # a distribution of x and a power p: the factor is x^p


class Product(Distribution):
    """Distribution of a product, tabulated in u = log x, with constant density within cells of equal width.

    All fields are arrays of a fixed size, so that one compiled program serves all tables.
    """

    edges: Float[Array, " cells+1"]  # of the cells, in u; the density is zero outside
    cumulative: Float[Array, " cells+1"]  # probability below each edge
    mean: ArrayLike  # of u
    sd: ArrayLike  # of u

    def log_moments(self) -> tuple[float, float]:
        return self.mean, self.sd

    @property
    def support(self) -> tuple[float, float]:
        return float(self.edges[0]), float(self.edges[-1])

    def log_density(self, u: ArrayLike) -> Float[Array, "*shape"]:
        """Return the log-density of u = log x, interpolated between the centers of the cells."""
        width = self.edges[1] - self.edges[0]
        density = jnp.diff(self.cumulative) / width
        inside = (u >= self.edges[0]) & (u <= self.edges[-1])
        return jnp.where(inside, jnp.log(jnp.interp(u, self.edges[:-1] + 0.5 * width, density)), -jnp.inf)

    def to_standard_normal(self, u: ArrayLike) -> Float[Array, "*shape"]:
        """Return the standard normal z = Phi^-1(F(u))."""
        p = jnp.interp(u, self.edges, self.cumulative)
        return ndtri(jnp.clip(p, 1e-300, 1.0 - jnp.finfo(p.dtype).epsneg))

    def from_standard_normal(self, z: ArrayLike) -> Float[Array, "*shape"]:
        """Return u = log x, the inverse of `to_standard_normal`."""
        xp = array_module(z)
        below = ndtr(z) if xp is jnp else scipy.special.ndtr(z)
        return xp.interp(below, self.cumulative, self.edges)


def multiply(factors: Sequence[Factor], scale: float = 1.0, cells: int = 2048, tails: float = 8.0) -> Distribution:
    """Return the distribution of `scale` times the product of x^p for independent x; log-normal if all factors are.

    `cells` is the size of the table, `tails` (in sd) its reach along factors without bounds.
    """
    moments = [(x.log_mean, x.log_sd) for x, _ in factors]
    mean = math.log(scale) + sum(power * center for (_, power), (center, _) in zip(factors, moments, strict=True))
    sd = math.hypot(*(power * spread for (_, power), (_, spread) in zip(factors, moments, strict=True)))
    if all(isinstance(x, LogNormal) for x, _ in factors):
        return LogNormal(math.exp(mean), sd)
    spans = [
        _span(x, power, center, tails * spread) for (x, power), (center, spread) in zip(factors, moments, strict=True)
    ]
    low, high = (math.log(scale) + sum(span[side] for span in spans) for side in (0, 1))
    width = (high - low) / cells
    counts = [max(round((end - start) / width), 1) for start, end in spans]
    size = sum(counts) - len(counts) + 1
    length = scipy.fft.next_fast_len(size, real=True)
    spectrum: Any = 1.0
    for (x, power), ends, count in zip(factors, spans, counts, strict=True):
        spectrum = spectrum * scipy.fft.rfft(_masses(x, power, np.linspace(*ends, count + 1)), length)
    mass = np.maximum(scipy.fft.irfft(spectrum, length)[:size], 0.0)  # rounding may make it negative
    edges, cumulative = np.linspace(low, high, mass.size + 1), np.append(0.0, np.cumsum(mass))
    table = np.linspace(low, high, cells + 1)
    return Product(table, np.interp(table, edges, cumulative / cumulative[-1]), np.asarray(mean), np.asarray(sd))


def _span(x: Distribution, power: float, center: float, reach: float) -> tuple[float, float]:
    """Return the ends of the support of log(x^power), at most `reach` from the `center` of log x."""
    low, high = (x.low, x.high) if isinstance(x, Bounded) else (0.0, math.inf)
    ends = (max(math.log(low) if low > 0.0 else -math.inf, center - reach), min(math.log(high), center + reach))
    start, end = sorted(power * end for end in ends)
    return start, end


def _masses(x: Distribution, power: float, edges: Float[np.ndarray, " cells+1"]) -> Float[np.ndarray, " cells"]:
    """Return the probabilities of log(x^power) between the edges, by NumPy, since JAX would compile each operation."""
    inner = edges[1:-1] / power  # at the ends, rounding may lie outside the support
    if isinstance(x, Bounded):
        below = type(x).cdf(x, inner)  # Equinox takes long to bind a method
    else:
        below = scipy.special.ndtr((inner - x.log_mean) / x.log_sd)
    below = np.asarray(below) if power > 0.0 else 1.0 - np.asarray(below)
    return np.diff(below, prepend=0.0, append=1.0)
