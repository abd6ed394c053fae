"""Drives: the voltage applied to the electrode, as exact straight pieces or as a sine.

A periodic drive starts with its rise at t = 0: an edge of finite length begins there, `duty` runs
from the start of the rise to the start of the fall, and sine and triangle cross zero upwards. At a
jump the value is the limit from the right. From rest, a drive is zero before t = 0.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

_SNAP = 8  # ulps of t f within which a time counts as lying on a breakpoint


class Pieces(NamedTuple):
    """Straight pieces: piece k runs from knot k to knot k + 1, from value `start[k]` to `end[k]`."""

    knots: Float[Array, " pieces+1"]  # s
    start: Float[Array, " pieces"]  # V
    end: Float[Array, " pieces"]  # V


class Drive(eqx.Module):
    """What every drive offers: its value in time."""

    def value(self, time: ArrayLike) -> Float[Array, "*shape"]:
        """V at `time` (s), in V."""
        raise NotImplementedError

    def slope(self, time: ArrayLike, *, steady_state: bool = True) -> Float[Array, "*shape"]:
        """dV/dt at `time` (s), in V/s, from the right; NaN at a jump, that of a start from rest included."""
        raise NotImplementedError


class Periodic(Drive):
    """A drive that repeats with `frequency` (Hz)."""

    frequency: eqx.AbstractVar[ArrayLike]

    @property
    def period(self) -> Array:
        """s."""
        return 1.0 / jnp.asarray(self.frequency, dtype=float)

    def phase(self, time: ArrayLike) -> tuple[Array, Array]:
        """Cycles since the last start of a period, in [0, 1), and the rounding error to allow for in it.

        `time * frequency` is only good to a few ulp, which puts samples meant for an edge on its wrong
        side; such a sample is moved onto the edge.
        """
        cycles = jnp.asarray(time, dtype=float) * self.frequency
        slack = lax.stop_gradient(_SNAP * jnp.finfo(cycles.dtype).eps * jnp.abs(cycles))
        phase = cycles - lax.stop_gradient(jnp.floor(cycles + slack))
        return jnp.maximum(phase, 0.0), slack


class PiecewiseLinear(Periodic):
    """A periodic drive made of straight pieces."""

    def pieces(self) -> Pieces:
        """One period of it."""
        raise NotImplementedError

    def locate(self, time: ArrayLike) -> tuple[Array, Array]:
        """The piece that `time` falls in, and the time since that piece began (s)."""
        knots = self.pieces().knots
        phase, slack = self.phase(time)
        starts = knots[1:-1] / knots[-1]
        piece = jnp.sum(phase[..., None] + slack[..., None] >= starts, axis=-1)
        return piece, jnp.maximum(phase * knots[-1] - knots[piece], 0.0)

    def value(self, time: ArrayLike) -> Float[Array, "*shape"]:
        """V at `time`."""
        knots, start, end = self.pieces()
        piece, since = self.locate(time)
        slope = (end - start) / jnp.diff(knots)
        return start[piece] + slope[piece] * since

    def slope(self, time: ArrayLike, *, steady_state: bool = True) -> Float[Array, "*shape"]:
        """dV/dt at `time`."""
        knots, start, end = self.pieces()
        piece, since = self.locate(time)
        before = jnp.roll(end, 1)
        jumps = (since == 0.0) & (start != before)[piece]
        return _after_rest(
            jnp.where(jumps, jnp.nan, ((end - start) / jnp.diff(knots))[piece]), start[0], time, steady_state
        )


class Square(PiecewiseLinear):
    """Bipolar square wave with ideal edges: `offset` ± `peak_to_peak` / 2 (V), high for `duty` of a period."""

    peak_to_peak: ArrayLike
    frequency: ArrayLike
    duty: ArrayLike = 0.5
    offset: ArrayLike = 0.0

    def pieces(self) -> Pieces:
        """High, then low."""
        half = 0.5 * jnp.asarray(self.peak_to_peak, dtype=float)
        values = self.offset + jnp.stack([half, -half])
        one = jnp.ones_like(self.period)
        knots = self.period * jnp.stack([0.0 * one, self.duty * one, one])
        return Pieces(knots, values, values)


class Trapezoid(PiecewiseLinear):
    """Square wave whose edges both take `rise_time` (s); the rise begins at t = 0."""

    peak_to_peak: ArrayLike
    frequency: ArrayLike
    rise_time: ArrayLike
    duty: ArrayLike = 0.5
    offset: ArrayLike = 0.0

    def pieces(self) -> Pieces:
        """Rise, high, fall, low."""
        half = 0.5 * jnp.asarray(self.peak_to_peak, dtype=float)
        rise = jnp.asarray(self.rise_time, dtype=float)
        knots = [
            0.0 * self.period,
            rise,
            self.duty * self.period,
            self.duty * self.period + rise,
            self.period,
        ]
        start = self.offset + jnp.stack([-half, half, half, -half])
        end = self.offset + jnp.stack([half, half, -half, -half])
        return Pieces(jnp.stack(knots), start, end)


class Triangle(PiecewiseLinear):
    """Symmetric triangle wave; crosses its `offset` upwards at t = 0."""

    peak_to_peak: ArrayLike
    frequency: ArrayLike
    offset: ArrayLike = 0.0

    def pieces(self) -> Pieces:
        """Up to the crest, down to the trough, up to the start."""
        half = 0.5 * jnp.asarray(self.peak_to_peak, dtype=float)
        corner = self.offset + half * jnp.array([0.0, 1.0, -1.0, 0.0])
        return Pieces(self.period * jnp.array([0.0, 0.25, 0.75, 1.0]), corner[:-1], corner[1:])


class Sine(Periodic):
    """Sine wave; crosses its `offset` upwards at t = 0."""

    peak_to_peak: ArrayLike
    frequency: ArrayLike
    offset: ArrayLike = 0.0

    def value(self, time: ArrayLike) -> Float[Array, "*shape"]:
        """V at `time`."""
        phase, _ = self.phase(time)
        return self.offset + 0.5 * jnp.asarray(self.peak_to_peak) * jnp.sin(2.0 * np.pi * phase)

    def slope(self, time: ArrayLike, *, steady_state: bool = True) -> Float[Array, "*shape"]:
        """dV/dt at `time`."""
        phase, _ = self.phase(time)
        steepest = np.pi * jnp.asarray(self.peak_to_peak) * self.frequency
        return _after_rest(steepest * jnp.cos(2.0 * np.pi * phase), self.offset, time, steady_state)


class Sampled(Drive):
    """A measured drive: straight lines between samples, constant before the first and after the last.

    Attributes:
        time: strictly increasing, s.
        samples: V.
        period: s; where given, the samples are one period, which runs on from the last sample to the
            first one of the next period, and a steady state exists.
    """

    time: Float[Array, " samples"] = eqx.field(converter=jnp.asarray)
    samples: Float[Array, " samples"] = eqx.field(converter=jnp.asarray)
    period: ArrayLike | None = None

    def pieces(self) -> Pieces:
        """The lines between the samples, and, for a period, the one that closes it."""
        knots, values = self.time, self.samples
        if self.period is not None:
            knots = jnp.append(knots, knots[0] + self.period)
            values = jnp.append(values, values[0])
        return Pieces(knots, values[:-1], values[1:])

    def locate(self, time: ArrayLike) -> tuple[Array, Array]:
        """The piece that `time` falls in, and the time since that piece began (s)."""
        knots = self.pieces().knots
        time = jnp.asarray(time, dtype=float)
        if self.period is not None:
            time = time - self.period * lax.stop_gradient(jnp.floor((time - knots[0]) / self.period))
        piece = jnp.clip(jnp.searchsorted(knots, time, side="right") - 1, 0, knots.size - 2)
        return piece, time - knots[piece]

    def value(self, time: ArrayLike) -> Float[Array, "*shape"]:
        """V at `time`, by linear interpolation."""
        knots, start, end = self.pieces()
        piece, since = self.locate(time)
        fraction = jnp.clip(since / jnp.diff(knots)[piece], 0.0, 1.0)
        return start[piece] + (end - start)[piece] * fraction

    def slope(self, time: ArrayLike, *, steady_state: bool = True) -> Float[Array, "*shape"]:
        """dV/dt at `time`: that of the line that begins or lies there; 0 outside the samples."""
        knots, start, end = self.pieces()
        piece, since = self.locate(time)
        inside = (since >= 0.0) & (since < jnp.diff(knots)[piece])
        slope = jnp.where(inside, ((end - start) / jnp.diff(knots))[piece], 0.0)
        if steady_state:
            return slope
        return _after_rest(slope, start[0], jnp.asarray(time, dtype=float) - knots[0], steady_state)


def _after_rest(slope: Array, first: ArrayLike, time: ArrayLike, steady_state: bool) -> Array:
    """From rest: nothing before t = 0, and a jump there unless the drive starts at 0."""
    if steady_state:
        return slope
    time = jnp.asarray(time, dtype=float)
    slope = jnp.where(time < 0.0, 0.0, slope)
    return jnp.where((time == 0.0) & (jnp.asarray(first) != 0.0), jnp.nan, slope)
