"""Noise that is not white and Gaussian: Student-t tails, and colour that a filter takes away."""

import math
from typing import Literal, NamedTuple, TypeAlias

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fitact.data.clipping import longest_run
from fitact.data.record import Record, is_uniform
from fitact.errors import InputError

NoiseModel: TypeAlias = Literal["white", "student", "ar1", "spectrum"]

STUDENT_DOF = 4.0  # of Student's t: Lange, Little, Taylor, J. Am. Stat. Assoc. 84 (1989) 881


def student_residual(z: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Return half its square is -log density of Student's t at z, up to a constant; smooth, and near 0 a multiple of z."""
    u = jnp.square(z) / STUDENT_DOF
    small = u < 1e-6  # where log(1 + u) / u is 1 - u / 2 in double precision
    ratio = jnp.where(small, 1.0 - 0.5 * u, jnp.log1p(u) / jnp.where(small, 1.0, u))
    return z * jnp.sqrt((STUDENT_DOF + 1.0) / STUDENT_DOF * ratio)


def student_weight(z: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """What a squared residual counts in reweighted least squares; averages 1."""
    return (STUDENT_DOF + 1.0) / (STUDENT_DOF + jnp.square(z))


def student_curvature(z: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Return second derivative of -log density."""
    return (STUDENT_DOF + 1.0) * (STUDENT_DOF - jnp.square(z)) / jnp.square(STUDENT_DOF + jnp.square(z))


def scale_information(model: NoiseModel) -> float:
    """Return Fisher's information on log `sigma` in one sample."""
    return 2.0 * STUDENT_DOF / (STUDENT_DOF + 3.0) if model == "student" else 2.0


class Whitening(eqx.Module):
    """A filter that leaves white noise as strong as what it was given."""

    taps: Float[Array, " taps"]  # of this sample, the one before it and so on
    mask: Float[Array, " samples"]  # 1 where a sample and all before it that the filter reaches count, else 0

    def __call__(self, values: Float[Array, "*shape samples"]) -> Float[Array, "*shape samples"]:
        """Return the values filtered, and 0 where `mask` is."""
        reach, size = self.taps.size - 1, values.shape[-1]
        padded = jnp.pad(values, [(0, 0)] * (values.ndim - 1) + [(reach, 0)])
        parts = [self.taps[lag] * padded[..., reach - lag : reach - lag + size] for lag in range(reach + 1)]
        return self.mask * sum(parts[1:], parts[0])


def draw_noise(
    rng: np.random.Generator, model: NoiseModel, whitening: Whitening | None, shape: tuple[int, ...], stride: int = 1
) -> Float[np.ndarray, "*draws samples"]:
    """Return noise of a `sigma` of 1, of every `stride`-th sample of a record."""
    if model == "student":
        return rng.standard_t(STUDENT_DOF, shape)
    if whitening is None:
        return rng.standard_normal(shape)
    around = 4 * shape[-1]  # a circle on which it is drawn, of which it must not see the other side
    power = np.abs(np.fft.fft(np.asarray(whitening.taps), around * stride)) ** -2.0
    power = power.reshape(stride, around).mean(axis=0)  # of the samples between those drawn, the spectrum is folded
    lines = np.fft.fft(rng.standard_normal((*shape[:-1], around))) * np.sqrt(power)
    return np.fft.ifft(lines).real[..., : shape[-1]]


class Autoregression(NamedTuple):
    """x_t = sum_k coefficients_k x_(t-k) + innovation."""

    coefficients: Float[np.ndarray, " order"]  # of the sample before, the one before that and so on
    innovation_ratio: float  # standard deviation of the innovation over that of x

    def whitening(self, mask: Bool[np.ndarray, " samples"]) -> Whitening:
        """Return the filter, for a record of which those samples are `mask`."""
        kept = mask.copy()
        for lag in range(1, self.coefficients.size + 1):
            kept[lag:] &= mask[:-lag]
        kept[: self.coefficients.size] = False
        # filled up with zeros, so that most orders share what is compiled for another
        fill = 2 ** math.ceil(math.log2(max(self.coefficients.size, 1))) - self.coefficients.size
        taps = np.concatenate([[1.0], -self.coefficients, np.zeros(fill)]) / self.innovation_ratio
        return Whitening(jnp.asarray(taps), jnp.asarray(kept, dtype=float))


def fit_ar_burg(values: Float[np.ndarray, " n"], max_order: int = 40) -> Autoregression:
    """Return Burg's autoregression, of the order that Akaike's criterion asks for; `values` have a mean of 0.

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
    """Return the autoregression of first order, by the correlation of neighbours that both count."""
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
    """Return a channel's noise where the drive rests, from and to `quiet` (s): its colour and its standard deviation.

    A spectrum can be told from `min_samples` on. The drive has noise of its own, and may move there by
    `max_drive_fraction` of its span.
    """
    inside = (record.time >= quiet[0]) & (record.time <= quiet[1])
    count = int(np.count_nonzero(inside))
    place = f"{record.source}: [measurement] quiet = {quiet[0]:.4g} s to {quiet[1]:.4g} s"
    if count < min_samples:
        raise InputError(f"{place} holds {count} samples of the record; choose a stretch of {min_samples} or more")
    if "V" in record and np.ptp(record["V"][inside]) > max_drive_fraction * np.ptp(record["V"]):
        raise InputError(f"{place}: V_V moves there; choose a stretch in which the drive rests")
    values = record[channel][inside]
    values = values - values.mean()
    if longest_run(values == values[0]) == count:
        raise InputError(f"{place} shows no noise of {channel}; leave noise_model = 'spectrum' out")
    return fit_ar_burg(values), float(np.std(values))


def require_uniform(record: Record, model: NoiseModel) -> None:
    """Refuse colour of noise, which is known from sample to sample, where these are not equally far apart."""
    if not is_uniform(record.time):
        raise InputError(
            f"{record.source}: [measurement] noise_model = '{model}' needs even time steps; resample the record, or"
            " leave noise_model out"
        )
