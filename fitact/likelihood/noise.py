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

FREEDOM = 4.0  # of Student's t: Lange, Little, Taylor, J. Am. Stat. Assoc. 84 (1989) 881
_MOST_LAGS = 40
_QUIET = 200  # samples from which a spectrum can be told
_STILL = 0.1  # of the span of the drive: how far it may move where it rests, for its own noise
_AROUND = 4  # lengths of a record: a circle on which noise is drawn, of which it must not see the other side
_SERIES = 1e-6  # u, below which log(1 + u) / u is 1 - u / 2 in double precision


def student_residual(z: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Half its square is -log density of Student's t at z, up to a constant; smooth, and near 0 a multiple of z."""
    u = jnp.square(z) / FREEDOM
    small = u < _SERIES
    ratio = jnp.where(small, 1.0 - 0.5 * u, jnp.log1p(u) / jnp.where(small, 1.0, u))
    return z * jnp.sqrt((FREEDOM + 1.0) / FREEDOM * ratio)


def student_weight(z: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """What a squared residual counts in reweighted least squares; averages 1."""
    return (FREEDOM + 1.0) / (FREEDOM + jnp.square(z))


def student_curvature(z: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Second derivative of -log density."""
    return (FREEDOM + 1.0) * (FREEDOM - jnp.square(z)) / jnp.square(FREEDOM + jnp.square(z))


def scale_information(model: NoiseModel) -> float:
    """Fisher's information on log `sigma` in one sample."""
    return 2.0 * FREEDOM / (FREEDOM + 3.0) if model == "student" else 2.0


class Whitening(eqx.Module):
    """A filter that leaves white noise as strong as what it was given.

    Attributes:
        taps: of this sample, the one before it and so on.
        kept: 1 where a sample and all before it that the filter reaches count, else 0.
    """

    taps: Float[Array, " taps"]
    kept: Float[Array, " samples"]

    def __call__(self, values: Float[Array, "*shape samples"]) -> Float[Array, "*shape samples"]:
        """Filtered, and 0 where not `kept`."""
        reach, size = self.taps.size - 1, values.shape[-1]
        padded = jnp.pad(values, [(0, 0)] * (values.ndim - 1) + [(reach, 0)])
        parts = [self.taps[lag] * padded[..., reach - lag : reach - lag + size] for lag in range(reach + 1)]
        return self.kept * sum(parts[1:], parts[0])


def draw_noise(
    rng: np.random.Generator, model: NoiseModel, whitening: Whitening | None, shape: tuple[int, ...], stride: int = 1
) -> Float[np.ndarray, "*draws samples"]:
    """Noise of a `sigma` of 1, of every `stride`-th sample of a record."""
    if model == "student":
        return rng.standard_t(FREEDOM, shape)
    if whitening is None:
        return rng.standard_normal(shape)
    around = _AROUND * shape[-1]
    power = np.abs(np.fft.fft(np.asarray(whitening.taps), around * stride)) ** -2.0
    power = power.reshape(stride, around).mean(axis=0)  # of the samples between those drawn, the spectrum is folded
    lines = np.fft.fft(rng.standard_normal((*shape[:-1], around))) * np.sqrt(power)
    return np.fft.ifft(lines).real[..., : shape[-1]]


class Autoregression(NamedTuple):
    """x_t = sum_k coefficients_k x_(t-k) + innovation.

    Attributes:
        coefficients: of the sample before, the one before that and so on.
        share: standard deviation of the innovation over that of x.
    """

    coefficients: Float[np.ndarray, " order"]
    share: float

    def whitening(self, counted: Bool[np.ndarray, " samples"]) -> Whitening:
        """The filter, for a record of which those samples are `counted`."""
        kept = counted.copy()
        for lag in range(1, self.coefficients.size + 1):
            kept[lag:] &= counted[:-lag]
        kept[: self.coefficients.size] = False
        # filled up with zeros, so that most orders share what is compiled for another
        fill = 2 ** math.ceil(math.log2(max(self.coefficients.size, 1))) - self.coefficients.size
        taps = np.concatenate([[1.0], -self.coefficients, np.zeros(fill)]) / self.share
        return Whitening(jnp.asarray(taps), jnp.asarray(kept, dtype=float))


def burg(values: Float[np.ndarray, " n"]) -> Autoregression:
    """By Burg's method, of the order that Akaike's criterion asks for; `values` have a mean of 0.

    Kay, Modern Spectral Estimation (1988), sections 7.4 and 7.7.
    """
    ahead, behind = values[1:], values[:-1]
    coefficients, share, count = np.zeros(0), 1.0, values.size
    best, least = Autoregression(coefficients, 1.0), 0.0
    for order in range(1, min(_MOST_LAGS, count // 10) + 1):
        reflection = 2.0 * float(ahead @ behind) / max(float(ahead @ ahead + behind @ behind), 1e-300)
        coefficients = np.append(coefficients - reflection * coefficients[::-1], reflection)
        share *= math.sqrt(1.0 - reflection**2)
        ahead, behind = (ahead - reflection * behind)[1:], (behind - reflection * ahead)[:-1]
        criterion = 2.0 * count * math.log(share) + 2.0 * order
        if criterion < least:
            best, least = Autoregression(coefficients, share), criterion
    return best


def first_order(residuals: Float[np.ndarray, " n"], counted: Bool[np.ndarray, " n"]) -> Autoregression:
    """By the correlation of neighbours that both count."""
    before, after = (residuals[part][counted[:-1] & counted[1:]] for part in (slice(None, -1), slice(1, None)))
    both = max(0.5 * float(before @ before + after @ after), 1e-300)
    coefficient = float(before @ after) / both
    return Autoregression(np.array([coefficient]), math.sqrt(1.0 - min(coefficient**2, 1.0 - 1e-12)))


def quiet_noise(record: Record, channel: str, quiet: tuple[float, float]) -> tuple[Autoregression, float]:
    """A channel's noise where the drive rests, from and to `quiet` (s): its colour and its standard deviation.

    Raises:
        InputError: the stretch is too short, or not quiet.
    """
    inside = (record.time >= quiet[0]) & (record.time <= quiet[1])
    count = int(np.count_nonzero(inside))
    place = f"{record.source}: [measurement] quiet = {quiet[0]:.4g} s to {quiet[1]:.4g} s"
    if count < _QUIET:
        raise InputError(f"{place} holds {count} samples of the record; choose a stretch of {_QUIET} or more")
    if "V" in record and np.ptp(record["V"][inside]) > _STILL * np.ptp(record["V"]):
        raise InputError(f"{place}: V_V moves there; choose a stretch in which the drive rests")
    values = record[channel][inside]
    values = values - values.mean()
    if longest_run(values == values[0]) == count:
        raise InputError(f"{place} shows no noise of {channel}; leave noise_model = 'spectrum' out")
    return burg(values), float(np.std(values))


def require_uniform(record: Record, model: NoiseModel) -> None:
    """Refuse colour of noise, which is known from sample to sample, where these are not equally far apart."""
    if not is_uniform(record.time):
        raise InputError(
            f"{record.source}: [measurement] noise_model = '{model}' needs even time steps; resample the record, or"
            " leave noise_model out"
        )
