"""Chirps: a sine whose frequency sweeps, and its Taylor series on short pieces of time.

The response to a chirp has no elementary closed form, but that to a polynomial has. So time is cut into
equal pieces of at most an eighth of a cycle, on which the series is exact to rounding.
Along a piece, the response of a first-order high-pass, u' = v' - z u, has a polynomial solution: with s from 0 to 1
along it and z its length in time constants, u = p(s) + (u0 - p(0)) e^{-z s}. For z <= 1 the solution with p(0) = 0
is a series that converges as that of e^{-z}; for z > 1 the one of least degree is computed from its highest
coefficient down, and nothing cancels either way.
"""

import math
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.errors import InputError
from fitact.model.drive import Drive, is_reached


class Chirp(Drive):
    """A sine around `offset` whose frequency runs from one value to another from t = 0; zero before and after.

    Its response is exact to 1e-12 of its height and the rounding of the phase (an ulp of the number of cycles),
    while the pieces, counted when it is made, hold no more than an eighth of a cycle. After that, frequencies
    and duration may be traced, mapped over and differentiated.

    Attributes:
        peak_to_peak: V.
        start_frequency, end_frequency: Hz.
        duration: of the sweep, s.
        spacing: the frequency is linear in time, or its logarithm is.
        offset: V.
        phase: at t = 0, rad.

    Raises:
        InputError: frequencies or duration are not positive, or not yet known (traced).
    """

    peak_to_peak: ArrayLike
    start_frequency: ArrayLike
    end_frequency: ArrayLike
    duration: ArrayLike
    spacing: Literal["linear", "logarithmic"] = eqx.field(default="linear", static=True)
    offset: ArrayLike = 0.0
    phase: ArrayLike = 0.0
    pieces: int = eqx.field(init=False, static=True)

    def __post_init__(self) -> None:
        stated = (self.start_frequency, self.end_frequency, self.duration)
        if any(isinstance(value, Tracer) for value in stated):
            raise InputError(
                "Chirp: its frequencies and duration must be known numbers when it is made; make it outside jit, grad"
                " and vmap, and pass it in"
            )
        if not all(np.ndim(value) == 0 and 0.0 < float(value) < math.inf for value in stated):
            raise InputError("Chirp: give positive, finite start_frequency, end_frequency and duration")
        if self.spacing not in ("linear", "logarithmic"):
            raise InputError(f"Chirp: spacing = '{self.spacing}'; give 'linear' or 'logarithmic'")
        first, last, duration = (float(value) for value in stated)
        per_cycle, most = 8, 8_000_000  # pieces of a cycle, or an e-fold of the frequency; pieces that memory holds
        self.pieces = math.ceil(per_cycle * max(max(first, last) * duration, abs(math.log(last / first)), 1.0))
        if self.pieces > most:
            raise InputError(
                f"Chirp: {self.pieces // per_cycle:,} cycles of its highest frequency are more than"
                f" {most // per_cycle:,}; make it shorter, or its frequencies lower"
            )

    def is_over(self, time: ArrayLike) -> Array:
        """Whether the sweep has ended; a time on its end to within rounding counts as the end."""
        return is_reached(jnp.asarray(time, dtype=float), self.duration)

    def frequency(self, time: ArrayLike) -> Float[Array, "*shape"]:
        """Hz, at `time` (s) during the sweep."""
        share = jnp.asarray(time, dtype=float) / self.duration
        if self.spacing == "linear":
            return self.start_frequency + (self.end_frequency - jnp.asarray(self.start_frequency)) * share
        return self.start_frequency * jnp.exp(self._log_ratio() * share)

    def cycles(self, time: ArrayLike) -> Float[Array, "*shape"]:
        """Cycles since t = 0, at `time` (s) during the sweep, and what `phase` adds."""
        time = jnp.asarray(time, dtype=float)
        if self.spacing == "linear":
            mean = 0.5 * (self.start_frequency + self.frequency(time))
        else:
            mean = self.start_frequency * _mean_exponential(self._log_ratio() * time / self.duration)
        return mean * time + self.phase / (2.0 * np.pi)

    def value(self, time: ArrayLike) -> Float[Array, "*shape"]:
        """V at `time`."""
        time = jnp.asarray(time, dtype=float)
        return jnp.where((time >= 0.0) & ~self.is_over(time), self.sweep(time), 0.0)

    def sweep(self, time: ArrayLike) -> Float[Array, "*shape"]:
        """V at `time`, up to the very end of the sweep (s, within it)."""
        return self.offset + 0.5 * jnp.asarray(self.peak_to_peak) * jnp.sin(self._angle(time))

    def slope(self, time: ArrayLike, *, steady_state: bool = True) -> Float[Array, "*shape"]:
        """dV/dt at `time`."""
        time = jnp.asarray(time, dtype=float)
        during = (time >= 0.0) & ~self.is_over(time)
        slope = np.pi * jnp.asarray(self.peak_to_peak) * self.frequency(time) * jnp.cos(self._angle(time))
        near_end = self.is_over(time) & is_reached(jnp.asarray(self.duration, dtype=time.dtype), time)
        jumps = ((time == 0.0) & self._is_nonzero(0.0)) | (near_end & self._is_nonzero(self.duration))
        return jnp.where(jumps, jnp.nan, jnp.where(during, slope, 0.0))

    def taylor_coefficients(self, degree: int = 16) -> Float[Array, "degree pieces"]:
        """Coefficients (V) of s^1, s^2, ... on each piece, s running from 0 to 1 along it.

        (pi / 4)^17 / 17! = 5e-17 of the height is left out, of the frequency (1 / 8)^9 / 9! = 2e-14.
        With v + j w for the wave's complex amplitude, (v + j w)' = j (angular frequency) (v + j w).
        """
        length = jnp.asarray(self.duration, dtype=float) / self.pieces
        start = length * jnp.arange(self.pieces)
        rate = 2.0 * np.pi * length * self.frequency(start)  # rad for each s
        if self.spacing == "linear":
            bend = 2.0 * np.pi * length * (self.end_frequency - jnp.asarray(self.start_frequency)) / self.pieces
            rates = jnp.stack([rate, jnp.broadcast_to(bend, rate.shape)])
        else:
            growth = self._log_ratio() / self.pieces
            rates = jnp.stack([rate * growth**n / math.factorial(n) for n in range(9)])
        half, angle = 0.5 * jnp.asarray(self.peak_to_peak), self._angle(start)
        none = jnp.zeros((rates.shape[0] - 1, self.pieces))
        first = tuple(jnp.concatenate([x[None], none]) for x in (jnp.sin(angle), jnp.cos(angle)))

        def next_order(latest: tuple[Array, Array], order: Array) -> tuple[tuple[Array, Array], Array]:
            """From the coefficients so far, the latest first."""
            v, w = latest
            new_v, new_w = jnp.sum(rates * w, axis=0) / order, -jnp.sum(rates * v, axis=0) / order
            return (jnp.concatenate([new_v[None], v[:-1]]), jnp.concatenate([new_w[None], w[:-1]])), new_v

        return half * lax.scan(next_order, first, jnp.arange(1.0, degree + 1.0))[1]

    def locate(self, time: ArrayLike) -> tuple[Array, Array]:
        """The piece that `time` falls in, and how far along it lies, from 0 to 1."""
        place = jnp.clip(jnp.asarray(time, dtype=float) / self.duration, 0.0, 1.0) * self.pieces
        piece = jnp.clip(lax.stop_gradient(jnp.floor(place)), 0, self.pieces - 1)
        return piece.astype(int), place - piece

    def _log_ratio(self) -> Array:
        return jnp.log(self.end_frequency / jnp.asarray(self.start_frequency, dtype=float))

    def _angle(self, time: ArrayLike) -> Array:
        cycles = self.cycles(time)
        return 2.0 * np.pi * (cycles - lax.stop_gradient(jnp.floor(cycles)))

    def _is_nonzero(self, time: ArrayLike) -> Array:
        """Whether the wave is not zero at `time`, so that starting or ending there is a jump."""
        rounding = 64.0 * jnp.finfo(float).eps * (1.0 + jnp.abs(self.cycles(time)))  # which is no jump
        return jnp.abs(self.sweep(time)) > rounding * jnp.abs(jnp.asarray(self.peak_to_peak))


def _mean_exponential(x: Array) -> Array:
    """(e^x - 1) / x, with its derivative."""
    small = jnp.abs(x) < 0.03
    far, near = jnp.where(small, 1.0, x), jnp.where(small, x, 0.0)
    series = jnp.ones_like(x)
    for n in reversed(range(2, 10)):
        series = 1.0 + near / n * series
    return jnp.where(small, series, jnp.expm1(far) / far)


def particular_solution(
    coefficients: Float[Array, "degree pieces"], z: Float[Array, ""]
) -> tuple[Float[Array, "degree+1 pieces"], Float[Array, " pieces"]]:
    """p(s), lowest coefficient first, and p(1), for v = sum_n coefficients[n - 1] s^n on each piece."""
    order = jnp.arange(1.0, coefficients.shape[0] + 1.0)
    slopes = coefficients * order[:, None]  # of v', from s^0
    zero, near, far = jnp.zeros_like(slopes[0]), jnp.minimum(z, 1.0), jnp.maximum(z, 1.0)

    def ascend(below: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        n, slope = step
        p = (slope - near * below) / n
        return p, p

    def descend(above: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        n, slope = step
        p = (slope - n * above) / far
        return p, p

    up = jnp.concatenate([zero[None], lax.scan(ascend, zero, (order, slopes))[1]])
    down = jnp.concatenate([lax.scan(descend, zero, (order, slopes), reverse=True)[1], zero[None]])
    p = jnp.where(z <= 1.0, up, down)
    return p, jnp.sum(p, axis=0)


def evaluate_polynomials(
    coefficients: Float[Array, "degree+1 pieces"], piece: Array, s: Float[Array, "*shape"]
) -> Float[Array, "*shape"]:
    """The pieces' polynomials, lowest coefficient first, at s; memory for one coefficient of each time only."""

    def horner(total: Array, row: Array) -> tuple[Array, None]:
        return total * s + row[piece], None

    return lax.scan(horner, jnp.zeros_like(s), coefficients, reverse=True)[0]
