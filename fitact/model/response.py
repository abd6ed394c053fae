"""The skin voltage in time, exactly: every circuit is a few first-order high-pass filters.

One function serves all: the response u(t) of  s tau / (1 + s tau)  to the drive. Along a straight
piece of slope m, u' = m - u / tau, so u decays by e^{-L/tau} and gains m L phi(L/tau) over a length
L; at a jump u jumps along. Written so that nothing cancels or overflows at either end of tau.
"""

import math
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.errors import InputError
from fitact.model.circuit import Circuit, gain_at, highpass_gain
from fitact.model.drive import Drive, Pieces, PiecewiseLinear, Sampled, Sine
from fitact.model.harmonic import fourier, frequency, fundamental, gain, harmonic_response, harmonic_sum
from fitact.model.skin import WithSkin

_SERIES = 0.03  # below, the quotients with expm1 lose digits in their derivatives


def response(
    circuit: Circuit,
    drive: Drive,
    time: ArrayLike,
    *,
    steady_state: bool = True,
    channel: Literal["Vsc", "I"] = "Vsc",
) -> Float[Array, "*shape"]:
    """The skin voltage Vsc (V) or the trunk current I (A) at `time` (s), exact for the drives of `fitact.model.drive`.

    In the steady state, or, with ``steady_state=False``, from rest: no charge anywhere and no drive
    before t = 0 (for a sampled drive, before its first sample). Eqs. (18)-(21) in the time domain.
    Where nothing resistive limits the current it follows dV/dt, and at an ideal jump it is NaN.

    A skin that depends on the frequency has its steady state harmonic by harmonic as far as it changes, and
    above by time constants: exact for `Dispersive`; for `Fractional` within the error it states.

    Raises:
        InputError: the steady state of a sampled drive without a period was asked for, or with a skin that
            depends on the frequency anything but the steady state of a periodic drive.
    """
    if isinstance(circuit, WithSkin):
        return _with_skin(circuit, drive, time, steady_state, channel)
    terms = circuit.terms() if channel == "Vsc" else circuit.current_terms()
    total = jnp.zeros_like(jnp.asarray(time, dtype=float))
    if terms.rate is not None:
        total = terms.rate * drive.slope(time, steady_state=steady_state)
    for weight, tau in zip(terms.weight, terms.tau, strict=True):
        total = total + weight * highpass(drive, time, tau, steady_state=steady_state)
    return total


def _with_skin(
    circuit: WithSkin, drive: Drive, time: ArrayLike, steady_state: bool, channel: Literal["Vsc", "I"]
) -> Float[Array, "*shape"]:
    """The terms that stand for the circuit at high frequency, and the harmonics of what they miss below."""
    if not steady_state:
        raise InputError(
            f"a {type(circuit.skin).__name__.lower()} skin is computed in the steady state only;"
            " ask for steady_state=True, or take the constant skin level"
        )
    omega = fundamental(drive)
    if isinstance(drive, Sine):
        return harmonic_response(circuit, drive, time, 1, channel=channel)
    count = circuit.skin.count(frequency(drive))
    terms = circuit.skin.above(circuit, omega * count, channel)
    time = jnp.asarray(time, dtype=float)

    def add(total: Array, term: tuple[Array, Array]) -> tuple[Array, None]:
        return total + term[0] * highpass(drive, time, term[1]), None

    each = jnp.stack(jnp.broadcast_arrays(*terms.weight)), jnp.stack(jnp.broadcast_arrays(*terms.tau))
    total, _ = lax.scan(add, jnp.zeros_like(time), each)
    if terms.rate is not None:
        total = total + terms.rate * drive.slope(time)
    harmonics = omega * jnp.arange(1, count + 1)
    missed = gain(circuit, harmonics, channel) - gain_at(terms, harmonics)
    return total + harmonic_sum(fourier(drive, count) * missed, drive, time)


def highpass(drive: Drive, time: ArrayLike, tau: ArrayLike, *, steady_state: bool = True) -> Float[Array, "*shape"]:
    """The response of s tau / (1 + s tau) to `drive` at `time`; arguments as in `response`."""
    time = jnp.asarray(time, dtype=float)
    if isinstance(drive, Sine):
        return _sine(drive, time, tau, steady_state)
    if isinstance(drive, Sampled) and (not steady_state or drive.period is None):
        if steady_state:
            raise InputError("a sampled drive has no steady state unless its period is given: Sampled(..., period=T)")
        return _along(drive, time, tau, knot_values(drive.pieces(), tau, drive.samples[0]))
    if not isinstance(drive, PiecewiseLinear | Sampled):
        raise TypeError(f"no exact response to a {type(drive).__name__}")
    pieces = drive.pieces()
    settled = _settled(pieces, tau)
    u = _along(drive, time, tau, knot_values(pieces, tau, settled))
    return u if steady_state else _from_rest(u, pieces.start[0] - settled, time, tau)


def knot_values(pieces: Pieces, tau: ArrayLike, first: ArrayLike) -> Float[Array, " pieces"]:
    """u just after the start of each piece, given u just after the first start."""
    length = jnp.diff(pieces.knots)[:-1]
    decay = jnp.exp(-length / tau)
    gain = (pieces.end - pieces.start)[:-1] * phi(length / tau) + (pieces.start[1:] - pieces.end[:-1])
    first = jnp.asarray(first, dtype=gain.dtype)
    return jnp.concatenate([first[None], recurrence(decay, gain, first)])


def recurrence(decay: Float[Array, " n"], gain: Float[Array, " n"], first: Float[Array, ""]) -> Float[Array, " n"]:
    """u[k] = decay[k] u[k - 1] + gain[k], from u[-1] = first.

    In about sqrt(n) blocks side by side, then from block to block: two short loops over short vectors,
    which run and compile several times faster than an associative scan.
    """
    width = math.isqrt(max(decay.size - 1, 0)) + 1
    missing = -decay.size % width
    decay = jnp.pad(decay, (0, missing), constant_values=1.0).reshape(-1, width)
    gain = jnp.pad(gain, (0, missing)).reshape(-1, width)

    def within(
        carry: tuple[Array, Array], step: tuple[Array, Array]
    ) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        carry = carry[0] * step[0], carry[1] * step[0] + step[1]
        return carry, carry

    def across(u: Array, block: tuple[Array, Array]) -> tuple[Array, Array]:
        return block[0] * u + block[1], u

    alone = jnp.ones_like(decay[:, 0]), jnp.zeros_like(gain[:, 0])
    (whole_decay, whole_gain), (decays, gains) = lax.scan(within, alone, (decay.T, gain.T))
    _, starts = lax.scan(across, first, (whole_decay, whole_gain))
    return (decays * starts + gains).T.reshape(-1)[: decay.size - missing]


def _along(drive: PiecewiseLinear | Sampled, time: Array, tau: ArrayLike, u: Array) -> Array:
    """u(t) from its values at the starts of the pieces."""
    knots, start, end = drive.pieces()
    piece, since = drive.locate(time)
    slope = (end - start) / jnp.diff(knots)
    since = jnp.maximum(since, 0.0)
    return u[piece] * jnp.exp(-since / tau) + slope[piece] * since * phi(since / tau)


def _settled(pieces: Pieces, tau: ArrayLike) -> Array:
    """u just after the start of a period, in the steady state.

    u0 (1 - e^{-T/tau}) is the sum over a period of (increment) x (decay until its end). The
    increments of a period add up to nothing, so decay - 1 may stand for decay: every weight is then
    negative and small with T/tau, and the quotient keeps its digits.
    """
    knots, start, end = pieces
    length = jnp.diff(knots)
    left = (knots[-1] - knots[1:]) / tau  # from the end of each piece to the end of the period
    jump = jnp.append(start[1:], start[0]) - end
    ramp_weight = jnp.expm1(-left) * phi(length / tau) - (length / tau) * psi(length / tau)
    return -jnp.sum(jump * jnp.expm1(-left) + (end - start) * ramp_weight) / jnp.expm1(-(knots[-1] - knots[0]) / tau)


def _sine(drive: Sine, time: Array, tau: ArrayLike, steady_state: bool) -> Array:
    gain = 0.5 * jnp.asarray(drive.peak_to_peak) * highpass_gain(2.0 * np.pi * jnp.asarray(drive.frequency) * tau)
    angle = 2.0 * np.pi * drive.phase(time)[0]
    u = gain.real * jnp.sin(angle) + gain.imag * jnp.cos(angle)
    return u if steady_state else _from_rest(u, drive.offset - gain.imag, time, tau)


def _from_rest(settled: Array, difference: ArrayLike, time: Array, tau: ArrayLike) -> Array:
    """The steady state plus the transient that starts with `difference`; nothing before t = 0."""
    later = jnp.maximum(time, 0.0)
    return jnp.where(time >= 0.0, settled + difference * jnp.exp(-later / tau), 0.0)


def phi(x: ArrayLike) -> Array:
    """(1 - e^{-x}) / x for x >= 0, with its derivative."""
    x = jnp.asarray(x, dtype=float)
    large = jnp.where(x < _SERIES, 1.0, x)
    return jnp.where(x < _SERIES, _exponential_series(x, 1), -jnp.expm1(-large) / large)


def psi(x: ArrayLike) -> Array:
    """(1 - phi(x)) / x = (e^{-x} - 1 + x) / x^2 for x >= 0, with its derivative."""
    x = jnp.asarray(x, dtype=float)
    large = jnp.where(x < _SERIES, 1.0, x)
    return jnp.where(x < _SERIES, 0.5 * _exponential_series(x, 2), (1.0 + jnp.expm1(-large) / large) / large)


def _exponential_series(x: Array, first: int) -> Array:
    """first! sum_n (-x)^n / (n + first)!, to double precision (and its gradient's) below `_SERIES`."""
    x = jnp.where(x < _SERIES, x, 0.0)
    total = jnp.ones_like(x)
    for n in reversed(range(8)):
        total = 1.0 - x * (1.0 / (n + 1 + first)) * total
    return total
