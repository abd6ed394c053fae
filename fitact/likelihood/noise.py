"""Noise models other than white Gaussian noise: Student-t noise, and coloured noise with a whitening filter."""

import dataclasses
import math
from typing import Any, Literal, NamedTuple, TypeAlias

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from fitact.data.clipping import longest_run
from fitact.data.record import STATE_RATE, Record, is_uniform
from fitact.errors import InputError
from fitact.model.response import recurrence
from fitact.model.response_table import chebyshev, chebyshev_polynomials

NoiseModel: TypeAlias = Literal["white", "student", "ar1", "spectrum"]

STUDENT_DOF = 4.0  # degrees of freedom; Lange, Little, Taylor, J. Am. Stat. Assoc. 84 (1989) 881


def student_residual(z: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Return r(z), smooth at 0, such that r^2 / 2 is the negative log-density of Student's t up to a constant."""
    u = jnp.square(z) / STUDENT_DOF
    small = u < 1e-6  # here log(1 + u) / u equals 1 - u / 2 in double precision
    ratio = jnp.where(small, 1.0 - 0.5 * u, jnp.log1p(u) / jnp.where(small, 1.0, u))
    return z * jnp.sqrt((STUDENT_DOF + 1.0) / STUDENT_DOF * ratio)


def student_weight(z: Any) -> Any:
    """Return the weight of a squared residual in reweighted least squares; its mean is 1."""
    return (STUDENT_DOF + 1.0) / (STUDENT_DOF + z * z)


def student_curvature(z: Any) -> Any:
    """Return the second derivative of the negative log-density."""
    return (STUDENT_DOF + 1.0) * (STUDENT_DOF - z * z) / (STUDENT_DOF + z * z) ** 2


def scale_information(model: NoiseModel) -> float:
    """Return the Fisher information of one sample on log sigma."""
    return 2.0 * STUDENT_DOF / (STUDENT_DOF + 3.0) if model == "student" else 2.0


class StudentExpansion(eqx.Module):
    """Likelihood under Student-t noise near an optimum: that of weighted samples under normal noise, and its scale.

    The log-likelihood is expanded to second order in the signal. How its value and its curvature depend on the scale
    sigma are series in log sigma.
    """

    sigma: Float[Array, ""]  # scale at the optimum, V or A
    half_width: Float[Array, ""]  # range of the series, in log sigma
    misfit: Float[Array, " terms"]  # sum over the samples of -log(density) - log sigma
    curvature: Float[Array, " terms"]  # relative to that at the optimum
    # |o|^2, 2 o.d and |d|^2 of the remainder o at the optimum and its slope d in log sigma, in coordinates
    squares: Float[Array, "3"]

    @classmethod
    def from_residuals(cls, z: Float[np.ndarray, " samples"], sigma: float, terms: int = 9) -> "StudentExpansion":
        """Expand around the residuals over `sigma` of the valid samples; `squares` are 0."""
        x, to_series = chebyshev(terms)
        half_width = min(1.0, 12.0 / math.sqrt(scale_information("student") * z.size))
        scaled = [np.square(z * math.exp(-half_width * each)) for each in x]
        misfit = [0.5 * (STUDENT_DOF + 1.0) * np.sum(np.log1p(each / STUDENT_DOF)) for each in scaled]
        factors = np.exp(-2.0 * half_width * x) / np.mean(student_curvature(z))
        curvature = [np.mean(student_curvature(np.sqrt(each))) for each in scaled] * factors
        arrays = sigma, half_width, to_series @ misfit, to_series @ curvature, np.zeros(3)
        return cls(*map(np.asarray, arrays))

    def normal_sigma(self, sigma: ArrayLike) -> tuple[Array, Array]:
        """Return the sd of normal noise that gives the curvature, and log sigma relative to that at the optimum."""
        log = jnp.log(sigma / self.sigma)
        precision = jnp.maximum(self.curvature @ self._polynomials(log), 1e-3)
        return self.sigma / jnp.sqrt(precision), log

    def add_misfit(self, remainder: Float[Array, " rows"], sigma: ArrayLike, largest: float = 50.0) -> Array:
        """Return -log-likelihood up to a constant; NaN beyond the series, or if it exceeds the optimum by `largest`."""
        normal, log = self.normal_sigma(sigma)
        squares = self.squares @ jnp.stack([jnp.ones_like(log), log, log * log])
        excess = 0.5 * (remainder @ remainder - squares) / jnp.square(normal)
        holds = (jnp.abs(log) <= self.half_width) & (excess <= largest)
        return jnp.where(holds, self.misfit @ self._polynomials(log) + excess, jnp.nan)

    def _polynomials(self, log: Array) -> Float[Array, " terms"]:
        return chebyshev_polynomials(log / self.half_width, self.misfit.size)


def fit_student_scale(residuals: Float[np.ndarray, " samples"], counted: float) -> float:
    """Return the scale of Student's t with which residuals agree, if they count as `counted` samples."""
    size = max(math.sqrt(float(np.mean(np.square(residuals)))), 1e-300)

    def excess(log: float) -> float:
        z = residuals * math.exp(-log) / size
        return float(np.sum(np.asarray(student_weight(z)) * z * z)) / counted - 1.0

    low = -1.0
    while excess(low) < 0.0 and low > -60.0:
        low *= 2.0
    return size * math.exp(scipy.optimize.brentq(excess, low, 1.0, xtol=1e-6))


class Whitening(eqx.Module):
    """A whitening filter that preserves the standard deviation of the noise, and may go on as a recursion.

    With the recursion, whitened value k is gain[k] times the filtered one + decay[k] times the whitened one before it.
    """

    taps: Float[Array, " taps"]  # for the sample itself, the one before it, and so on
    mask: Float[Array, " samples"]  # 1 if a sample and all earlier samples within the filter are valid, else 0
    gain: Float[Array, " samples"] | None = None
    decay: Float[Array, " samples"] | None = None

    def begin(self, excluded: Bool[np.ndarray, " samples"]) -> "Whitening":
        """Return the filter without a recursion for other samples, some of which are excluded."""
        taps = np.asarray(self.taps)
        whitening = Whitening(taps, np.where(np.arange(excluded.size) < taps.size - 1, 0.0, 1.0))
        return whitening.exclude(excluded) if excluded.any() else whitening

    def __call__(self, values: Float[Array, "*shape samples"]) -> Float[Array, "*shape samples"]:
        """Return the filtered values, with 0 where `mask` is 0."""
        around = jnp.pad(values, [(0, 0)] * (values.ndim - 1) + [(self.taps.size - 1, 0)])
        return self.mask * self.filter(around, jnp.zeros(values.shape[:-1]))

    @property
    def scale(self) -> np.ndarray:
        """Factor of each sample in its own whitened value."""
        return np.abs(float(self.taps[0])) * np.asarray(1.0 if self.gain is None else self.gain)

    def exclude(self, excluded: Bool[np.ndarray, " samples"]) -> "Whitening":
        """Return the filter without the samples that it computes from an excluded one."""
        mask, taps = np.asarray(self.mask), np.trim_zeros(np.asarray(self.taps), "b")
        mask = np.where(np.convolve(excluded, np.ones(taps.size))[: mask.size] > 0.5, 0.0, mask)
        return dataclasses.replace(self, mask=mask)

    def restrict(self, samples: slice) -> "Whitening":
        """Return the filter for some of the samples."""
        recursion = () if self.gain is None or self.decay is None else (self.gain[samples], self.decay[samples])
        return Whitening(self.taps, self.mask[samples], *recursion)

    def filter(
        self, values: Float[Array, "*shape reach+samples"], before: Float[Array, "*shape"]
    ) -> Float[Array, "*shape samples"]:
        """Return filtered values, without the mask, from those that include the filter's reach before the samples.

        `before` are the whitened values before the first, which a recursion needs.
        """
        reach, size = self.taps.size - 1, self.mask.size
        parts = [self.taps[lag] * values[..., reach - lag : reach - lag + size] for lag in range(reach + 1)]
        filtered = sum(parts[1:], parts[0])
        if self.gain is None or self.decay is None:
            return filtered
        return recurrence(self.decay, self.gain * filtered, before)


def draw_noise(
    rng: np.random.Generator, model: NoiseModel, whitening: Whitening | None, shape: tuple[int, ...], stride: int = 1
) -> Float[np.ndarray, "*draws samples"]:
    """Return noise with sigma = 1, at every `stride`-th sample of a record."""
    if model == "student":
        return rng.standard_t(STUDENT_DOF, shape)
    if whitening is None:
        return rng.standard_normal(shape)
    around = 4 * shape[-1]  # noise is drawn on a circle that is longer than its correlations
    power = np.abs(np.fft.fft(np.asarray(whitening.taps), around * stride)) ** -2.0
    power = power.reshape(stride, around).mean(axis=0)  # subsampling folds the spectrum
    lines = np.fft.fft(rng.standard_normal((*shape[:-1], around))) * np.sqrt(power)
    return np.fft.ifft(lines).real[..., : shape[-1]]


class Autoregression(NamedTuple):
    """x_t = sum_k coefficients_k x_(t-k) + innovation."""

    coefficients: Float[np.ndarray, " order"]  # for the previous sample, the one before it, and so on
    innovation_ratio: float  # sd of the innovation over the sd of x

    def whitening(self, mask: Bool[np.ndarray, " samples"]) -> Whitening:
        """Return the whitening filter for a record whose valid samples are `mask`."""
        kept = mask.copy()
        for lag in range(1, self.coefficients.size + 1):
            kept[lag:] &= mask[:-lag]
        kept[: self.coefficients.size] = False
        # padded with zeros, so that most orders share compiled code
        fill = 2 ** math.ceil(math.log2(max(self.coefficients.size, 1))) - self.coefficients.size
        taps = np.concatenate([[1.0], -self.coefficients, np.zeros(fill)]) / self.innovation_ratio
        return Whitening(taps, np.asarray(kept, dtype=float))


def fit_ar_burg(values: Float[np.ndarray, " n"], max_order: int = 40) -> Autoregression:
    """Fit an autoregression by Burg's method, with its order selected by AIC; `values` have zero mean.

    Kay, Modern Spectral Estimation (1988), sections 7.4 and 7.7.
    """
    ahead, behind = values[1:], values[:-1]
    coefficients, share, count = np.zeros(0), 1.0, values.size
    best, least = Autoregression(coefficients, 1.0), 0.0
    for order in range(1, min(max_order, count // 10) + 1):
        reflection = 2.0 * float(ahead @ behind) / max(float(ahead @ ahead + behind @ behind), 1e-300)
        coefficients = np.append(coefficients - reflection * coefficients[::-1], reflection)
        share *= math.sqrt(1.0 - reflection**2)
        ahead, behind = (ahead - reflection * behind)[1:], (behind - reflection * ahead)[:-1]
        criterion = 2.0 * count * math.log(share) + 2.0 * order
        if criterion < least:
            best, least = Autoregression(coefficients, share), criterion
    return best


def fit_ar1(residuals: Float[np.ndarray, " n"], mask: Bool[np.ndarray, " n"]) -> Autoregression:
    """Fit a first-order autoregression by the correlation of neighbouring valid samples."""
    before, after = (residuals[part][mask[:-1] & mask[1:]] for part in (slice(None, -1), slice(1, None)))
    both = max(0.5 * float(before @ before + after @ after), 1e-300)
    coefficient = float(before @ after) / both
    return Autoregression(np.array([coefficient]), math.sqrt(1.0 - min(coefficient**2, 1.0 - 1e-12)))


def estimate_quiet_noise(
    record: Record,
    channel: str,
    quiet: tuple[float, float],
    min_samples: int = 200,
    max_drive_fraction: float = 0.1,
) -> tuple[Autoregression, float]:
    """Return autoregression and standard deviation of a channel's noise in the interval `quiet` (s) without drive.

    The interval must hold `min_samples`. The noise of V may reach `max_drive_fraction` of its span there.
    """
    inside = (record.time >= quiet[0]) & (record.time <= quiet[1])
    count = int(np.count_nonzero(inside))
    place = f"{record.source}: [measurement] quiet = {quiet[0]:.4g} s to {quiet[1]:.4g} s"
    if count < min_samples:
        raise InputError(f"{place} holds {count} samples of the record; choose an interval with at least {min_samples}")
    if "V" in record and np.ptp(record["V"][inside]) > max_drive_fraction * np.ptp(record["V"]):
        raise InputError(f"{place}: V_V varies there; choose an interval in which the drive is constant")
    values = record[channel][inside]
    values = values - values.mean()
    if longest_run(values == values[0]) == count:
        raise InputError(f"{place}: {channel} has no noise; remove noise_model = 'spectrum'")
    return fit_ar_burg(values), float(np.std(values))


def require_uniform(record: Record, model: NoiseModel) -> None:
    """Raise InputError for a model of coloured noise if the time steps are not uniform."""
    if not is_uniform(record.time):
        raise InputError(
            f"{record.source}: [measurement] noise_model = '{model}' needs uniform time steps; if the times were"
            f" rounded when written, {STATE_RATE}; otherwise resample the record, or remove noise_model"
        )
