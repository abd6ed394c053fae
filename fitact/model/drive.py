"""Drives: the voltage applied to the electrode, as exact straight pieces or as a sine.

A periodic drive starts with its rise at t = 0: an edge of finite length begins there, `duty` runs
from the start of the rise to the start of the fall, and sine and triangle cross zero upwards. A
`phase` lets it run ahead of that. At a jump the value is the limit from the right. From rest, a drive
is zero before t = 0 (one given by points: before the first), and may jump there.
"""

from typing import TYPE_CHECKING, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Complex, Float

from fitact.errors import InputError


def _as_float(values: ArrayLike) -> Array:
    return jnp.asarray(values, dtype=float)


def _rounding_error(size: Array, ulps: float = 8.0) -> Array:
    """So many ulps of numbers of that size: within 8, a time counts as lying on a breakpoint."""
    return lax.stop_gradient(ulps * jnp.finfo(size.dtype).eps * jnp.abs(size))


def is_reached(time: Array, end: ArrayLike) -> Array:
    """Whether a time is no earlier than `end`, to within 8 ulps."""
    return time * (1.0 + 8.0 * jnp.finfo(time.dtype).eps) >= end


class LinearPieces(NamedTuple):
    """Straight pieces: piece k runs from knot k to knot k + 1, from value `start[k]` to `end[k]`."""

    knots: Float[Array, " pieces+1"]  # s
    start: Float[Array, " pieces"]  # V
    end: Float[Array, " pieces"]  # V

    def slopes(self) -> Float[Array, " pieces"]:
        """V/s; 0 for a piece of no length, which is a jump."""
        length = jnp.diff(self.knots)
        return jnp.where(length > 0.0, (self.end - self.start) / jnp.where(length > 0.0, length, 1.0), 0.0)


class Drive(eqx.Module):
    """A voltage in time."""

    @property
    def start_time(self) -> ArrayLike:
        """When it begins, from rest (s)."""
        return 0.0

    def value(self, time: ArrayLike) -> Float[Array, "*shape"]:
        """V at `time` (s), in V."""
        raise NotImplementedError

    def slope(self, time: ArrayLike, *, steady_state: bool = True) -> Float[Array, "*shape"]:
        """dV/dt at `time` (s), in V/s, from the right; NaN at a jump, that of a start from rest included."""
        raise NotImplementedError


class Periodic(Drive):
    """A drive that repeats with `frequency` (Hz) and runs ahead by `phase` (rad)."""

    frequency: eqx.AbstractVar[ArrayLike]
    if TYPE_CHECKING:  # a field here would come before the waves' own

        @property
        def phase(self) -> ArrayLike: ...
    else:
        phase: eqx.AbstractVar[ArrayLike]

    @property
    def period(self) -> Array:
        """s."""
        return 1.0 / jnp.asarray(self.frequency, dtype=float)

    @property
    def phase_time(self) -> Array:
        """The phase as a time, s."""
        return self.phase / (2.0 * np.pi) * self.period

    def cycle(self, time: ArrayLike) -> tuple[Array, Array]:
        """Cycles since the last start of a period, in [0, 1), and the rounding error to allow for in it."""
        elapsed, ahead = _as_float(time) * self.frequency, self.phase / (2.0 * np.pi)
        # which would put samples meant for an edge on its wrong side; a phase that was read from text has 15 digits
        slack = _rounding_error(elapsed) + _rounding_error(_as_float(ahead), ulps=32.0)
        cycles = elapsed + ahead
        return jnp.maximum(cycles - lax.stop_gradient(jnp.floor(cycles + slack)), 0.0), slack


class PiecewiseLinear(Periodic):
    """A periodic drive made of straight pieces."""

    def pieces(self) -> LinearPieces:
        """One period of it."""
        raise NotImplementedError

    def locate(self, time: ArrayLike) -> tuple[Array, Array]:
        """The piece that `time` falls in, and the time since that piece began (s)."""
        knots = self.pieces().knots
        cycle, slack = self.cycle(time)
        starts = knots[1:-1] / knots[-1]
        # one comparison after the other fuses with what follows; a sum over an axis does not
        piece = sum((cycle + slack >= start).astype(int) for start in starts)
        return piece, jnp.maximum(cycle * knots[-1] - knots[piece], 0.0)

    def value(self, time: ArrayLike) -> Float[Array, "*shape"]:
        """V at `time`."""
        pieces = self.pieces()
        piece, since = self.locate(time)
        return pieces.start[piece] + pieces.slopes()[piece] * since

    def slope(self, time: ArrayLike, *, steady_state: bool = True) -> Float[Array, "*shape"]:
        """dV/dt at `time`."""
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
        """High, then low."""
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
        """Rise, high, fall, low."""
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
        """Up to the crest, down to the trough, up to the start."""
        half = 0.5 * jnp.asarray(self.peak_to_peak, dtype=float)
        corner = self.offset + half * jnp.array([0.0, 1.0, -1.0, 0.0])
        return LinearPieces(self.period * jnp.array([0.0, 0.25, 0.75, 1.0]), corner[:-1], corner[1:])


class Sine(Periodic):
    """Sine wave; crosses its `offset` upwards at t = 0 (with phase 0)."""

    peak_to_peak: ArrayLike
    frequency: ArrayLike
    offset: ArrayLike = 0.0
    phase: ArrayLike = 0.0

    def value(self, time: ArrayLike) -> Float[Array, "*shape"]:
        """V at `time`."""
        cycle, _ = self.cycle(time)
        return self.offset + 0.5 * jnp.asarray(self.peak_to_peak) * jnp.sin(2.0 * np.pi * cycle)

    def slope(self, time: ArrayLike, *, steady_state: bool = True) -> Float[Array, "*shape"]:
        """dV/dt at `time`."""
        cycle, _ = self.cycle(time)
        slope = np.pi * jnp.asarray(self.peak_to_peak) * self.frequency * jnp.cos(2.0 * np.pi * cycle)
        return slope if steady_state else slope_from_rest(self, slope, time, jnp.abs(jnp.asarray(self.peak_to_peak)))


class Multitone(Periodic):
    """A sum of sines at whole multiples of one frequency, around `offset`; each crosses it upwards at t = 0.

    Attributes:
        frequency: at which the sum repeats, Hz.
        orders: of the tones: the multiples of `frequency` that they have, each once, 1 to 250.
        amplitudes: from the middle to the crest of each tone, V.
        phases: of each tone, rad; () for none.
        offset: V.
        phase: by which the whole runs ahead, in rad of `frequency`.

    Raises:
        InputError: the orders are no such numbers, or there is not one amplitude and phase for each.
    """

    frequency: ArrayLike
    orders: tuple[int, ...] = eqx.field(static=True)
    amplitudes: tuple[ArrayLike, ...]
    phases: tuple[ArrayLike, ...] = ()
    offset: ArrayLike = 0.0
    phase: ArrayLike = 0.0
    max_order: ClassVar[int] = 250  # up to which a mean of Vsc^4 over a period's 1024 points is exact

    def __check_init__(self) -> None:
        orders = self.orders
        if not orders or len(set(orders)) < len(orders) or not all(n in range(1, self.max_order + 1) for n in orders):
            raise InputError(f"Multitone: orders = {orders}; give different whole numbers from 1 to {self.max_order}")
        if len(self.amplitudes) != len(orders) or len(self.phases) not in (0, len(orders)):
            raise InputError(
                f"Multitone: {len(orders)} tones, {len(self.amplitudes)} amplitudes, {len(self.phases)} phases;"
                " give one of each for a tone"
            )

    def tones(self) -> tuple[Sine, ...]:
        """The sines that it is the sum of, but for the offset."""
        phases = self.phases or (0.0,) * len(self.orders)
        return tuple(
            Sine(2.0 * jnp.asarray(height), n * jnp.asarray(self.frequency), phase=phase + n * jnp.asarray(self.phase))
            for n, height, phase in zip(self.orders, self.amplitudes, phases, strict=True)
        )

    def phasors(self) -> Complex[Array, " tones"]:
        """A with tone = Im A e^{j order w t} (V), `phase` left out."""
        phases = jnp.stack(list(map(jnp.asarray, self.phases or (0.0,) * len(self.orders))))
        return jnp.stack(list(map(jnp.asarray, self.amplitudes))) * jnp.exp(1j * phases)

    def value(self, time: ArrayLike) -> Float[Array, "*shape"]:
        """V at `time`."""
        return self.offset + sum((tone.value(time) for tone in self.tones()), jnp.zeros(()))

    def slope(self, time: ArrayLike, *, steady_state: bool = True) -> Float[Array, "*shape"]:
        """dV/dt at `time`."""
        slope = sum((tone.slope(time) for tone in self.tones()), jnp.zeros(()))
        height = sum(map(jnp.abs, map(jnp.asarray, self.amplitudes)))
        return slope if steady_state else slope_from_rest(self, slope, time, height)


class InterpolatedDrive(Drive):
    """A drive through points, joined by straight lines; constant outside, or, with a period, repeated.

    Two points at one time are a jump.
    """

    if TYPE_CHECKING:

        @property
        def period(self) -> ArrayLike | None: ...
    else:
        period: eqx.AbstractVar[ArrayLike | None]

    def points(self) -> tuple[Float[Array, " points"], Float[Array, " points"]]:
        """Their times (s) and voltages (V)."""
        raise NotImplementedError

    @property
    def start_time(self) -> ArrayLike:
        """The first point (s)."""
        return self.points()[0][0]

    def pieces(self) -> LinearPieces:
        """The lines between the points, and the one that closes the period, or the endless one after the last."""
        knots, values = self.points()
        if self.period is None:
            return LinearPieces(jnp.append(knots, jnp.inf), values, jnp.append(values[1:], values[-1]))
        close = jnp.maximum(knots[0] + self.period, knots[-1])
        return LinearPieces(jnp.append(knots, close), values, jnp.append(values[1:], values[0]))

    def locate(self, time: ArrayLike) -> tuple[Array, Array]:
        """The piece that `time` falls in, and the time since that piece began (s; negative before the first)."""
        knots = self.pieces().knots
        time = jnp.asarray(time, dtype=float)
        slack = self._slack(time)
        if self.period is not None:
            time = time - self.period * lax.stop_gradient(jnp.floor((time + slack - knots[0]) / self.period))
        piece = jnp.clip(jnp.searchsorted(knots, time + slack, side="right") - 1, 0, knots.size - 2)
        since = time - knots[piece]
        return piece, jnp.where(since < -slack, since, jnp.maximum(since, 0.0))

    def _slack(self, time: Array) -> Array:
        """The rounding error to allow for in a time (s)."""
        return _rounding_error(jnp.maximum(jnp.abs(time), jnp.abs(self.start_time)))

    def value(self, time: ArrayLike) -> Float[Array, "*shape"]:
        """V at `time`, by linear interpolation."""
        pieces = self.pieces()
        piece, since = self.locate(time)
        return pieces.start[piece] + pieces.slopes()[piece] * jnp.maximum(since, 0.0)

    def slope(self, time: ArrayLike, *, steady_state: bool = True) -> Float[Array, "*shape"]:
        """dV/dt at `time`: that of the line that begins or lies there; 0 outside the points, NaN at a jump."""
        pieces = self.pieces()
        piece, since = self.locate(time)
        slope = jnp.where(since >= 0.0, pieces.slopes()[piece], 0.0)
        jump = jnp.where(jnp.diff(pieces.knots) > 0.0, 0.0, pieces.end - pieces.start)
        at_start = (since >= 0.0) & (since <= self._slack(jnp.asarray(time, dtype=float)))
        slope = jnp.where(at_start & (jnp.roll(jump, 1) != 0.0)[piece], jnp.nan, slope)
        return slope if steady_state else slope_from_rest(self, slope, time, jnp.max(jnp.abs(self.points()[1])))


class Sampled(InterpolatedDrive):
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

    def points(self) -> tuple[Float[Array, " samples"], Float[Array, " samples"]]:
        """The samples."""
        return self.time, self.samples


class Polyline(InterpolatedDrive):
    """Any piecewise linear drive, by its corners; two at one time are a jump.

    Attributes:
        time: of the corners, not decreasing, s.
        voltage: V.
        period: s; where given, the line repeats and a steady state exists, else it is constant outside.

    Raises:
        InputError: the corners do not pair up, go back in time, or reach beyond the period.
    """

    time: Float[Array, " corners"] = eqx.field(converter=_as_float)
    voltage: Float[Array, " corners"] = eqx.field(converter=_as_float)
    period: ArrayLike | None = None

    def __check_init__(self) -> None:
        if self.time.ndim != 1 or self.time.shape != self.voltage.shape or self.time.size == 0:
            raise InputError(
                f"Polyline: time has shape {self.time.shape}, voltage {self.voltage.shape};"
                " give one of each for a corner"
            )
        if isinstance(self.time, Tracer) or isinstance(self.period, Tracer):
            return
        if np.any(np.diff(self.time) < 0.0):
            raise InputError("Polyline: its times go back; sort the corners (two at one time are a jump)")
        if self.period is not None and np.ptp(self.time) > self.period * (1.0 + 1e-6):
            raise InputError("Polyline: its corners reach beyond one period; give those of one period")

    def points(self) -> tuple[Float[Array, " corners"], Float[Array, " corners"]]:
        """The corners."""
        return self.time, self.voltage


class Burst(Drive):
    """A periodic `wave` for a whole number of `cycles` from t = 0; zero before and after.

    Raises:
        InputError: `wave` is not periodic, or `cycles` is not a whole number of at least 1.
    """

    wave: Periodic
    cycles: int = eqx.field(static=True)

    def __check_init__(self) -> None:
        if not isinstance(self.wave, Periodic):
            raise InputError(f"Burst: a {type(self.wave).__name__} has no cycles; give a sine, triangle, square, ...")
        if isinstance(self.cycles, bool) or not isinstance(self.cycles, int) or self.cycles < 1:
            raise InputError(f"Burst: cycles = {self.cycles!r}; give a whole number of at least 1")

    @property
    def duration(self) -> Array:
        """s."""
        return self.cycles * self.wave.period

    def is_over(self, time: ArrayLike) -> Array:
        """Whether the burst has ended; a time on its end to within rounding counts as the end."""
        return is_reached(jnp.asarray(time, dtype=float) * self.wave.frequency, self.cycles)

    def value(self, time: ArrayLike) -> Float[Array, "*shape"]:
        """V at `time`."""
        time = jnp.asarray(time, dtype=float)
        return jnp.where((time >= 0.0) & ~self.is_over(time), self.wave.value(time), 0.0)

    def slope(self, time: ArrayLike, *, steady_state: bool = True) -> Float[Array, "*shape"]:
        """dV/dt at `time`."""
        time = jnp.asarray(time, dtype=float)
        inside = self.wave.slope(time, steady_state=False)
        # it ends as it began: with a jump or without
        at_end = self.is_over(time) & is_reached(self.duration, time)
        after = jnp.where(at_end & jnp.isnan(self.wave.slope(0.0, steady_state=False)), jnp.nan, 0.0)
        return jnp.where(self.is_over(time), after, inside)


def slope_from_rest(drive: Drive, slope: Array, time: ArrayLike, height: ArrayLike) -> Array:
    """A slope from rest: 0 before the drive begins, and NaN there unless it begins at 0."""
    time = jnp.asarray(time, dtype=float)
    slope = jnp.where(time < drive.start_time, 0.0, slope)
    rounding = 64.0 * jnp.finfo(slope.dtype).eps * jnp.asarray(height)  # which is no jump
    jumps = jnp.abs(drive.value(drive.start_time)) > rounding
    return jnp.where((time == drive.start_time) & jumps, jnp.nan, slope)
