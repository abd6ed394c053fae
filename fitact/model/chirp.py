"""Chirps, i.e. sines whose frequency sweeps, and their Taylor series on short pieces of time.

The response to a chirp has no elementary closed form, but the response to a polynomial has one. The sweep is
therefore divided into equal pieces of at most an eighth of a cycle, on which the series is exact to rounding.
On a piece, the response of a first-order high-pass satisfies u' = v' - z u, where s runs from 0 to 1 and z is the
length of the piece in time constants. Its solution is u = p(s) + (u0 - p(0)) e^{-z s} with a polynomial p.
For z <= 1 the solution with p(0) = 0 is a series that converges like the series of e^{-z}. For z > 1 the solution
of lowest degree is computed from its highest coefficient down. Neither form suffers from cancellation.
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
    """Sine plus `offset` whose frequency sweeps from one value to another from t = 0; zero before and after.

    The error of its response is 1e-12 of the amplitude, plus the rounding of the phase (an ulp of the number of
    cycles), as long as no piece exceeds an eighth of a cycle. The pieces are counted at construction; afterwards
    frequencies and duration may be traced, mapped over and differentiated.

    Attributes:
        peak_to_peak: peak-to-peak voltage, V.
        start_frequency, end_frequency: frequencies at start and end, Hz.
        duration: duration of the sweep, s.
        spacing: sweep of the frequency, linear in time or logarithmic.
        offset: mean, V.
        phase: phase at t = 0, rad.

    Raises:
        InputError: frequencies or duration are not positive, or are traced at construction.
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
                "Chirp: frequencies and duration must be concrete numbers; construct the Chirp outside jit, grad"
                " and vmap, and pass it in"
            )
        if not all(np.ndim(value) == 0 and 0.0 < float(value) < math.inf for value in stated):
            raise InputError("Chirp: give positive, finite start_frequency, end_frequency and duration")
        if self.spacing not in ("linear", "logarithmic"):
            raise InputError(f"Chirp: spacing = '{self.spacing}'; give 'linear' or 'logarithmic'")
        first, last, duration = (float(value) for value in stated)
        per_cycle, most = 8, 8_000_000  # pieces in a cycle or an e-fold of the frequency; pieces that fit into memory
        self.pieces = math.ceil(per_cycle * max(max(first, last) * duration, abs(math.log(last / first)), 1.0))
        if self.pieces > most:
            raise InputError(
                f"Chirp: {self.pieces // per_cycle:,} cycles of its highest frequency are more than"
                f" {most // per_cycle:,}; reduce its duration or frequencies"
            )

    def is_over(self, time: ArrayLike) -> Array:
        """Return whether the sweep has ended; a time equal to the end within rounding counts as ended."""
        return is_reached(jnp.asarray(time, dtype=float), self.duration)

    def frequency(self, time: ArrayLike) -> Float[Array, "*shape"]:
        """Return the frequency (Hz) at `time` (s) during the sweep."""
        share = jnp.asarray(time, dtype=float) / self.duration
        if self.spacing == "linear":
            return self.start_frequency + (self.end_frequency - jnp.asarray(self.start_frequency)) * share
        return self.start_frequency * jnp.exp(self._log_ratio() * share)

    def cycles(self, time: ArrayLike) -> Float[Array, "*shape"]:
        """Return the cycles since t = 0 at `time` (s) during the sweep, including `phase`."""
        time = jnp.asarray(time, dtype=float)
        if self.spacing == "linear":
            mean = 0.5 * (self.start_frequency + self.frequency(time))
        else:
            mean = self.start_frequency * _mean_exponential(self._log_ratio() * time / self.duration)
        return mean * time + self.phase / (2.0 * np.pi)

    def value(self, time: ArrayLike) -> Float[Array, "*shape"]:
        """Return V at `time`."""
        time = jnp.asarray(time, dtype=float)
        return jnp.where((time >= 0.0) & ~self.is_over(time), self.sweep(time), 0.0)

    def sweep(self, time: ArrayLike) -> Float[Array, "*shape"]:
        """Return V at `time` (s) within the sweep, its end included."""
        return self.offset + 0.5 * jnp.asarray(self.peak_to_peak) * jnp.sin(self._angle(time))

    def slope(self, time: ArrayLike, *, steady_state: bool = True) -> Float[Array, "*shape"]:
        """Return dV/dt at `time`."""
        time = jnp.asarray(time, dtype=float)
        during = (time >= 0.0) & ~self.is_over(time)
        slope = np.pi * jnp.asarray(self.peak_to_peak) * self.frequency(time) * jnp.cos(self._angle(time))
        near_end = self.is_over(time) & is_reached(jnp.asarray(self.duration, dtype=time.dtype), time)
        jumps = ((time == 0.0) & self._is_nonzero(0.0)) | (near_end & self._is_nonzero(self.duration))
        return jnp.where(jumps, jnp.nan, jnp.where(during, slope, 0.0))

    def taylor_coefficients(self, degree: int = 16) -> Float[Array, "degree pieces"]:
        """Return the coefficients (V) of s^1, s^2, ... on each piece, with s from 0 to 1.

        The truncation error is (pi / 4)^17 / 17! = 5e-17 of the amplitude, and (1 / 8)^9 / 9! = 2e-14 of the frequency.
        The complex amplitude v + j w of the wave satisfies (v + j w)' = j (angular frequency) (v + j w).
        """
        length = jnp.asarray(self.duration, dtype=float) / self.pieces
        start = length * jnp.arange(self.pieces)
        rate = 2.0 * np.pi * length * self.frequency(start)  # rad per unit of s
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
            """Return the next coefficient, given the previous ones, latest first."""
            v, w = latest
            new_v, new_w = jnp.sum(rates * w, axis=0) / order, -jnp.sum(rates * v, axis=0) / order
            return (jnp.concatenate([new_v[None], v[:-1]]), jnp.concatenate([new_w[None], w[:-1]])), new_v

        return half * lax.scan(next_order, first, jnp.arange(1.0, degree + 1.0))[1]

    def locate(self, time: ArrayLike) -> tuple[Array, Array]:
        """Return the piece that contains `time`, and the position within it, from 0 to 1."""
        position = jnp.clip(jnp.asarray(time, dtype=float) / self.duration, 0.0, 1.0) * self.pieces
        piece = jnp.clip(lax.stop_gradient(jnp.floor(position)), 0, self.pieces - 1)
        return piece.astype(int), position - piece

    def _log_ratio(self) -> Array:
        return jnp.log(self.end_frequency / jnp.asarray(self.start_frequency, dtype=float))

    def _angle(self, time: ArrayLike) -> Array:
        cycles = self.cycles(time)
        return 2.0 * np.pi * (cycles - lax.stop_gradient(jnp.floor(cycles)))

    def _is_nonzero(self, time: ArrayLike) -> Array:
        """Return whether the wave is nonzero at `time`, so that a start or end there is a jump."""
        # a difference this small is no jump
        rounding = 64.0 * jnp.finfo(float).eps * (1.0 + jnp.abs(self.cycles(time)))
        return jnp.abs(self.sweep(time)) > rounding * jnp.abs(jnp.asarray(self.peak_to_peak))


def _mean_exponential(x: Array) -> Array:
    """Return (e^x - 1) / x, differentiable at 0."""
    small = jnp.abs(x) < 0.03
    far, near = jnp.where(small, 1.0, x), jnp.where(small, x, 0.0)
    series = jnp.ones_like(x)
    for n in reversed(range(2, 10)):
        series = 1.0 + near / n * series
    return jnp.where(small, series, jnp.expm1(far) / far)


def particular_solution(
    coefficients: Float[Array, "degree pieces"], z: Float[Array, ""]
) -> tuple[Float[Array, "degree+1 pieces"], Float[Array, " pieces"]]:
    """Return p(s), lowest coefficient first, and p(1), for v = sum_n coefficients[n - 1] s^n on each piece."""
    order = jnp.arange(1.0, coefficients.shape[0] + 1.0)
    slopes = coefficients * order[:, None]  # coefficients of v', from s^0
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
    """Return the polynomials of the pieces at s, lowest coefficient first, with little memory."""

    def horner(total: Array, row: Array) -> tuple[Array, None]:
        return total * s + row[piece], None

    return lax.scan(horner, jnp.zeros_like(s), coefficients, reverse=True)[0]
