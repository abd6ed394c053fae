"""Drives: the voltage applied to the electrode, as linear pieces or as sines.

A periodic drive starts to rise at t = 0. An edge of finite length begins there, `duty` runs from the start of the
rise to the start of the fall, and sine and triangle cross zero upwards. A `phase` advances the drive. At a jump the
value is the limit from the right. From rest, a drive is zero before t = 0 (or before its first point), and may jump
there.
"""

from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Complex, Float

from fitact.compiled import jit_inline
from fitact.errors import InputError


def _as_float(values: ArrayLike) -> Array:
    return jnp.asarray(values, dtype=float)


def _as_array(values: ArrayLike) -> Any:
    """Return an array as it is, so that a record stays in NumPy outside compiled functions, and else a JAX array."""
    return values if isinstance(values, np.ndarray | Array) else jnp.asarray(values)


def _rounding_error(size: Array, ulps: float = 8.0) -> Array:
    """Return `ulps` units in the last place of numbers of this size; within 8, a time counts as a breakpoint."""
    return lax.stop_gradient(ulps * jnp.finfo(size.dtype).eps * jnp.abs(size))


def is_reached(time: Array, end: ArrayLike) -> Array:
    """Return whether a time is not before `end`, to within 8 ulps."""
    return time * (1.0 + 8.0 * jnp.finfo(time.dtype).eps) >= end


class LinearPieces(NamedTuple):
    """Linear pieces; piece k runs from knot k to knot k + 1, from value `start[k]` to `end[k]`."""

    knots: Float[Array, " pieces+1"]  # s
    start: Float[Array, " pieces"]  # V
    end: Float[Array, " pieces"]  # V

    @jit_inline
    def slopes(self) -> Float[Array, " pieces"]:
        """Return the slopes in V/s, with 0 for a piece of zero length (a jump)."""
        length = jnp.diff(self.knots)
        return jnp.where(length > 0.0, (self.end - self.start) / jnp.where(length > 0.0, length, 1.0), 0.0)


class Drive(eqx.Module):
    """A voltage as a function of time."""

    @property
    def start_time(self) -> ArrayLike:
        """Time at which the drive begins from rest, s."""
        return 0.0

    def value(self, time: ArrayLike) -> Float[Array, "*shape"]:
        """Return the voltage (V) at `time` (s)."""
        raise NotImplementedError

    def slope(self, time: ArrayLike, *, steady_state: bool = True) -> Float[Array, "*shape"]:
        """Return dV/dt (V/s) at `time` (s), the limit from the right; NaN at a jump, also at a start from rest."""
        raise NotImplementedError


class Periodic(Drive):
    """A drive that repeats with `frequency` (Hz), advanced by `phase` (rad)."""

    frequency: eqx.AbstractVar[ArrayLike]
    if TYPE_CHECKING:  # a field here would precede the fields of the subclasses

        @property
        def phase(self) -> ArrayLike: ...
    else:
        phase: eqx.AbstractVar[ArrayLike]

    @property
    def period(self) -> Array:
        """Duration, s."""
        return 1.0 / jnp.asarray(self.frequency, dtype=float)

    @property
    def phase_time(self) -> Array:
        """Phase as a time, s."""
        return self.phase / (2.0 * np.pi) * self.period

    @jit_inline
    def cycle(self, time: ArrayLike) -> tuple[Array, Array]:
        """Return the cycles since the last start of a period, in [0, 1), and their rounding error."""
        elapsed, ahead = _as_float(time) * self.frequency, self.phase / (2.0 * np.pi)
        # rounding would put samples meant for an edge on its wrong side; a phase read from text has 15 digits
        slack = _rounding_error(elapsed) + _rounding_error(_as_float(ahead), ulps=32.0)
        cycles = elapsed + ahead
        return jnp.maximum(cycles - lax.stop_gradient(jnp.floor(cycles + slack)), 0.0), slack


class PiecewiseLinear(Periodic):
    """A periodic drive made of straight pieces."""

    def pieces(self) -> LinearPieces:
        """Return the pieces of one period."""
        raise NotImplementedError

    @jit_inline
    def locate(self, time: ArrayLike) -> tuple[Array, Array]:
        """Return the piece that contains `time`, and the time since the start of that piece (s)."""
        knots = self.pieces().knots
        cycle, slack = self.cycle(time)
        starts = knots[1:-1] / knots[-1]
        # XLA fuses successive comparisons with the operations that follow, but not a sum over an axis
        piece = sum((cycle + slack >= start).astype(int) for start in starts)
        return piece, jnp.maximum(cycle * knots[-1] - knots[piece], 0.0)

    @jit_inline
    def value(self, time: ArrayLike) -> Float[Array, "*shape"]:
        """Return V at `time`."""
        pieces = self.pieces()
        piece, since = self.locate(time)
        return pieces.start[piece] + pieces.slopes()[piece] * since

    def slope(self, time: ArrayLike, *, steady_state: bool = True) -> Float[Array, "*shape"]:
        """Return dV/dt at `time`."""
        pieces = self.pieces()
        piece, since = self.locate(time)
        at_start = since <= self.cycle(time)[1] * self.period
        jumps = at_start & (pieces.start != jnp.roll(pieces.end, 1))[piece]
        slope = jnp.where(jumps, jnp.nan, pieces.slopes()[piece])
        return slope if steady_state else slope_from_rest(self, slope, time, jnp.max(jnp.abs(pieces.start)))


class Square(PiecewiseLinear):
    """Bipolar square wave with ideal edges: `offset` ± `peak_to_peak` / 2 (V), high for `duty` of a period."""

    peak_to_peak: ArrayLike
    frequency: ArrayLike
    duty: ArrayLike = 0.5
    offset: ArrayLike = 0.0
    phase: ArrayLike = 0.0

    def pieces(self) -> LinearPieces:
        """Return the high and the low piece."""
        half = 0.5 * jnp.asarray(self.peak_to_peak, dtype=float)
        values = self.offset + jnp.stack([half, -half])
        one = jnp.ones_like(self.period)
        knots = self.period * jnp.stack([0.0 * one, self.duty * one, one])
        return LinearPieces(knots, values, values)


class Trapezoid(PiecewiseLinear):
    """Square wave whose edges both take `rise_time` (s); the rise begins at t = 0 (with phase 0)."""

    peak_to_peak: ArrayLike
    frequency: ArrayLike
    rise_time: ArrayLike
    duty: ArrayLike = 0.5
    offset: ArrayLike = 0.0
    phase: ArrayLike = 0.0

    def pieces(self) -> LinearPieces:
        """Return the pieces rise, high, fall, low."""
        half = 0.5 * jnp.asarray(self.peak_to_peak, dtype=float)
        rise = jnp.asarray(self.rise_time, dtype=float)
        knots = [0.0 * self.period, rise, self.duty * self.period, self.duty * self.period + rise, self.period]
        start = self.offset + jnp.stack([-half, half, half, -half])
        end = self.offset + jnp.stack([half, half, -half, -half])
        return LinearPieces(jnp.stack(knots), start, end)


class Triangle(PiecewiseLinear):
    """Symmetric triangle wave; crosses its `offset` upwards at t = 0 (with phase 0)."""

    peak_to_peak: ArrayLike
    frequency: ArrayLike
    offset: ArrayLike = 0.0
    phase: ArrayLike = 0.0

    def pieces(self) -> LinearPieces:
        """Return three pieces: to the crest, to the trough, and back to the start."""
        half = 0.5 * jnp.asarray(self.peak_to_peak, dtype=float)
        corner = self.offset + half * jnp.array([0.0, 1.0, -1.0, 0.0])
        return LinearPieces(self.period * jnp.array([0.0, 0.25, 0.75, 1.0]), corner[:-1], corner[1:])


class Sine(Periodic):
    """Sine wave; crosses its `offset` upwards at t = 0 (with phase 0)."""

    peak_to_peak: ArrayLike
    frequency: ArrayLike
    offset: ArrayLike = 0.0
    phase: ArrayLike = 0.0

    @jit_inline
    def value(self, time: ArrayLike) -> Float[Array, "*shape"]:
        """Return V at `time`."""
        cycle, _ = self.cycle(time)
        return self.offset + 0.5 * jnp.asarray(self.peak_to_peak) * jnp.sin(2.0 * np.pi * cycle)

    def slope(self, time: ArrayLike, *, steady_state: bool = True) -> Float[Array, "*shape"]:
        """Return dV/dt at `time`."""
        cycle, _ = self.cycle(time)
        slope = np.pi * jnp.asarray(self.peak_to_peak) * self.frequency * jnp.cos(2.0 * np.pi * cycle)
        return slope if steady_state else slope_from_rest(self, slope, time, jnp.abs(jnp.asarray(self.peak_to_peak)))


class Multitone(Periodic):
    """Sum of sines at integer multiples of one frequency, plus `offset`; each sine crosses zero upwards at t = 0.

    Attributes:
        frequency: repetition frequency, Hz.
        orders: distinct multiples of `frequency`, 1 to 250, one for each tone.
        amplitudes: amplitude of each tone (half its peak-to-peak value), V.
        phases: phase of each tone, rad; () means zero.
        offset: mean, V.
        phase: advance of the sum, in rad of `frequency`.

    Raises:
        InputError: the orders are invalid, or their number differs from the number of amplitudes or phases.
    """

    frequency: ArrayLike
    orders: tuple[int, ...] = eqx.field(static=True)
    amplitudes: tuple[ArrayLike, ...]
    phases: tuple[ArrayLike, ...] = ()
    offset: ArrayLike = 0.0
    phase: ArrayLike = 0.0
    max_order: ClassVar[int] = 250  # the mean of Vsc^4 over 1024 points of a period is exact up to this order

    def __check_init__(self) -> None:
        orders = self.orders
        if not orders or len(set(orders)) < len(orders) or not all(n in range(1, self.max_order + 1) for n in orders):
            raise InputError(f"Multitone: orders = {orders}; give distinct integers from 1 to {self.max_order}")
        if len(self.amplitudes) != len(orders) or len(self.phases) not in (0, len(orders)):
            raise InputError(
                f"Multitone: {len(orders)} tones, {len(self.amplitudes)} amplitudes, {len(self.phases)} phases;"
                " give one amplitude and one phase for each tone"
            )

    def tones(self) -> tuple[Sine, ...]:
        """Return the sines, without the offset."""
        phases = self.phases or (0.0,) * len(self.orders)
        return tuple(
            Sine(2.0 * jnp.asarray(height), n * jnp.asarray(self.frequency), phase=phase + n * jnp.asarray(self.phase))
            for n, height, phase in zip(self.orders, self.amplitudes, phases, strict=True)
        )

    def phasors(self) -> Complex[Array, " tones"]:
        """Return the phasors A (V) with tone = Im(A e^{j order w t}), without `phase`."""
        phases = jnp.stack(list(map(jnp.asarray, self.phases or (0.0,) * len(self.orders))))
        return jnp.stack(list(map(jnp.asarray, self.amplitudes))) * jnp.exp(1j * phases)

    @jit_inline
    def value(self, time: ArrayLike) -> Float[Array, "*shape"]:
        """Return V at `time`."""
        return self.offset + sum((tone.value(time) for tone in self.tones()), jnp.zeros(()))

    def slope(self, time: ArrayLike, *, steady_state: bool = True) -> Float[Array, "*shape"]:
        """Return dV/dt at `time`."""
        slope = sum((tone.slope(time) for tone in self.tones()), jnp.zeros(()))
        height = sum(map(jnp.abs, map(jnp.asarray, self.amplitudes)))
        return slope if steady_state else slope_from_rest(self, slope, time, height)


class InterpolatedDrive(Drive):
    """A drive through points, joined by straight lines; it repeats if it has a period, else it is constant outside.

    Two points at the same time are a jump.
    """

    if TYPE_CHECKING:

        @property
        def period(self) -> ArrayLike | None: ...
    else:
        period: eqx.AbstractVar[ArrayLike | None]

    def points(self) -> tuple[Float[Array, " points"], Float[Array, " points"]]:
        """Return the times (s) and voltages (V) of the points."""
        raise NotImplementedError

    @property
    def start_time(self) -> ArrayLike:
        """Time of the first point, s."""
        return self.points()[0][0]

    def pieces(self) -> LinearPieces:
        """Return the lines between the points, and the line that closes the period or extends the last point."""
        knots, values = map(jnp.asarray, self.points())  # JAX arrays, which a traced index may select from
        if self.period is None:
            return LinearPieces(jnp.append(knots, jnp.inf), values, jnp.append(values[1:], values[-1]))
        close = jnp.maximum(knots[0] + self.period, knots[-1])
        return LinearPieces(jnp.append(knots, close), values, jnp.append(values[1:], values[0]))

    @jit_inline
    def locate(self, time: ArrayLike) -> tuple[Array, Array]:
        """Return the piece that contains `time`, and the time since its start (s; negative before the first)."""
        knots = self.pieces().knots
        time = jnp.asarray(time, dtype=float)
        slack = self._slack(time)
        if self.period is not None:
            time = time - self.period * lax.stop_gradient(jnp.floor((time + slack - knots[0]) / self.period))
        piece = jnp.clip(jnp.searchsorted(knots, time + slack, side="right") - 1, 0, knots.size - 2)
        since = time - knots[piece]
        return piece, jnp.where(since < -slack, since, jnp.maximum(since, 0.0))

    def _slack(self, time: Array) -> Array:
        return _rounding_error(jnp.maximum(jnp.abs(time), jnp.abs(self.start_time)))

    @jit_inline
    def value(self, time: ArrayLike) -> Float[Array, "*shape"]:
        """Return V at `time`, by linear interpolation."""
        pieces = self.pieces()
        piece, since = self.locate(time)
        return pieces.start[piece] + pieces.slopes()[piece] * jnp.maximum(since, 0.0)

    def slope(self, time: ArrayLike, *, steady_state: bool = True) -> Float[Array, "*shape"]:
        """Return dV/dt at `time`, of the line that begins or lies there; 0 outside the points, NaN at a jump."""
        pieces = self.pieces()
        piece, since = self.locate(time)
        slope = jnp.where(since >= 0.0, pieces.slopes()[piece], 0.0)
        jump = jnp.where(jnp.diff(pieces.knots) > 0.0, 0.0, pieces.end - pieces.start)
        at_start = (since >= 0.0) & (since <= self._slack(jnp.asarray(time, dtype=float)))
        slope = jnp.where(at_start & (jnp.roll(jump, 1) != 0.0)[piece], jnp.nan, slope)
        return slope if steady_state else slope_from_rest(self, slope, time, jnp.max(jnp.abs(self.points()[1])))


class Sampled(InterpolatedDrive):
    """Measured drive: linear between samples, constant before the first and after the last.

    Attributes:
        time: strictly increasing times, s.
        samples: voltages, V.
        period: period, s; if given, the samples are one period, the last sample is joined to the first of the
            next period, and a steady state exists.
    """

    time: Float[Array, " samples"] = eqx.field(converter=_as_array)
    samples: Float[Array, " samples"] = eqx.field(converter=_as_array)
    period: ArrayLike | None = None

    def points(self) -> tuple[Float[Array, " samples"], Float[Array, " samples"]]:
        """Return the samples."""
        return self.time, self.samples


class Polyline(InterpolatedDrive):
    """Piecewise linear drive, defined by its corners; two corners at the same time are a jump.

    Attributes:
        time: non-decreasing times of the corners, s.
        voltage: voltages of the corners, V.
        period: period, s; if given, the line repeats and a steady state exists, else it is constant outside.

    Raises:
        InputError: the numbers of times and voltages differ, times decrease, or corners exceed the period.
    """

    time: Float[Array, " corners"] = eqx.field(converter=_as_float)
    voltage: Float[Array, " corners"] = eqx.field(converter=_as_float)
    period: ArrayLike | None = None

    def __check_init__(self) -> None:
        if self.time.ndim != 1 or self.time.shape != self.voltage.shape or self.time.size == 0:
            raise InputError(
                f"Polyline: time has shape {self.time.shape}, voltage {self.voltage.shape};"
                " give one time and one voltage for each corner"
            )
        if isinstance(self.time, Tracer) or isinstance(self.period, Tracer):
            return
        if np.any(np.diff(self.time) < 0.0):
            raise InputError("Polyline: the times decrease; sort the corners (two at the same time are a jump)")
        if self.period is not None and np.ptp(self.time) > self.period * (1.0 + 1e-6):
            raise InputError("Polyline: the corners span more than one period; give the corners of one period only")

    def points(self) -> tuple[Float[Array, " corners"], Float[Array, " corners"]]:
        """Return the corners."""
        return self.time, self.voltage


class Burst(Drive):
    """A periodic `wave` for a whole number of `cycles` from t = 0; zero before and after.

    Raises:
        InputError: `wave` is not periodic, or `cycles` is not an integer of at least 1.
    """

    wave: Periodic
    cycles: int = eqx.field(static=True)

    def __check_init__(self) -> None:
        if not isinstance(self.wave, Periodic):
            raise InputError(f"Burst: a {type(self.wave).__name__} is not periodic; give a sine, triangle, square, ...")
        if isinstance(self.cycles, bool) or not isinstance(self.cycles, int) or self.cycles < 1:
            raise InputError(f"Burst: cycles = {self.cycles!r}; give an integer of at least 1")

    @property
    def duration(self) -> Array:
        """Duration, s."""
        return self.cycles * self.wave.period

    def is_over(self, time: ArrayLike) -> Array:
        """Return whether the burst has ended; a time equal to the end within rounding counts as ended."""
        return is_reached(jnp.asarray(time, dtype=float) * self.wave.frequency, self.cycles)

    @jit_inline
    def value(self, time: ArrayLike) -> Float[Array, "*shape"]:
        """Return V at `time`."""
        time = jnp.asarray(time, dtype=float)
        return jnp.where((time >= 0.0) & ~self.is_over(time), self.wave.value(time), 0.0)

    def slope(self, time: ArrayLike, *, steady_state: bool = True) -> Float[Array, "*shape"]:
        """Return dV/dt at `time`."""
        time = jnp.asarray(time, dtype=float)
        inside = self.wave.slope(time, steady_state=False)
        # the burst ends with a jump if it began with one
        at_end = self.is_over(time) & is_reached(self.duration, time)
        after = jnp.where(at_end & jnp.isnan(self.wave.slope(0.0, steady_state=False)), jnp.nan, 0.0)
        return jnp.where(self.is_over(time), after, inside)


def slope_from_rest(drive: Drive, slope: Array, time: ArrayLike, height: ArrayLike) -> Array:
    """Return the slope from rest: 0 before the drive begins, NaN at its start unless it starts from 0 V."""
    time = jnp.asarray(time, dtype=float)
    slope = jnp.where(time < drive.start_time, 0.0, slope)
    rounding = 64.0 * jnp.finfo(slope.dtype).eps * jnp.asarray(height)  # a difference this small is no jump
    jumps = jnp.abs(drive.value(drive.start_time)) > rounding
    return jnp.where((time == drive.start_time) & jumps, jnp.nan, slope)
