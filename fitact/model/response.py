"""The skin voltage in time, exactly: every circuit is a few first-order high-pass filters.

One function serves all: the response u(t) of  s tau / (1 + s tau)  to the drive. Along a straight
piece of slope m, u' = m - u / tau, so u decays by e^{-L/tau} and gains m L phi(L/tau) over a length
L; at a jump u jumps along. Written so that nothing cancels or overflows at either end of tau.
"""

import math
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.errors import InputError
from fitact.model.circuit import Circuit, highpass_gain
from fitact.model.drive import Drive, Pieces, PiecewiseLinear, Sampled, Sine

_FEW = 8  # pieces told apart by comparison rather than looked up


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

    Raises:
        InputError: the steady state of a sampled drive without a period was asked for.
    """
    terms = circuit.terms() if channel == "Vsc" else circuit.current_terms()
    total = jnp.zeros_like(jnp.asarray(time, dtype=float))
    if terms.rate is not None:
        total = terms.rate * drive.slope(time, steady_state=steady_state)
    for weight, tau in zip(terms.weight, terms.tau, strict=True):
        total = total + weight * highpass(drive, time, tau, steady_state=steady_state)
    return total


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
    return jnp.concatenate([first[None], _recurrence(decay, gain, first)])


def _recurrence(decay: Float[Array, " n"], gain: Float[Array, " n"], first: Float[Array, ""]) -> Float[Array, " n"]:
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
    level, steepness = _of_piece(u, piece), _of_piece(slope, piece)
    return level * jnp.exp(-since / tau) + steepness * since * phi(since / tau)


def _of_piece(values: Array, piece: Array) -> Array:
    """values[piece]; of a few values by comparison, which XLA fuses with the rest and a gather it does not."""
    if values.size > _FEW:
        return values[piece]
    found = values[0]
    for k in range(1, values.size):
        found = jnp.where(piece >= k, values[k], found)
    return jnp.broadcast_to(found, piece.shape)


def steady_knots(pieces: Pieces, tau: ArrayLike) -> Float[Array, " pieces"]:
    """u just after the start of each piece, in the steady state."""
    return knot_values(pieces, tau, _settled(pieces, tau))


def _settled(pieces: Pieces, tau: ArrayLike) -> Array:
    """u just after the start of a period, in the steady state.

    u0 (1 - e^{-T/tau}) is the sum over a period of (increment) x (decay until its end). Where T/tau is
    large that is how it is computed. Where it is small all decays are close to 1: the increments of a
    period add up to nothing, so decay - 1 may stand for decay, and the quotient keeps its digits.
    Fractions of the period, which do not depend on tau, keep those of its derivative; so does 1 - exp where
    that is no loss, since the derivative of expm1 is computed as expm1 + 1.
    """
    knots, start, end = pieces
    period = knots[-1] - knots[0]
    left, share = (knots[-1] - knots[1:]) / period, jnp.diff(knots) / period
    jump, rise = jnp.append(start[1:], start[0]) - end, end - start
    x = period / tau
    few, many = jnp.where(x < 1.0, x, 1.0), jnp.where(x < 1.0, 1.0, x)

    lam = share * few
    ratio = left * phi(left * few) / phi(few)  # (1 - e^{-left x}) / (1 - e^{-x})
    slow = -jnp.sum(jump * ratio + rise * (ratio * phi(lam) + share * psi(lam) / phi(few)))
    fast = jnp.sum((jump + rise * phi(share * many)) * jnp.exp(-left * many)) / (1.0 - jnp.exp(-many))
    return jnp.where(x < 1.0, slow, fast)


def _sine(drive: Sine, time: Array, tau: ArrayLike, steady_state: bool) -> Array:
    gain = 0.5 * jnp.asarray(drive.peak_to_peak) * highpass_gain(2.0 * np.pi * jnp.asarray(drive.frequency) * tau)
    angle = 2.0 * np.pi * drive.phase(time)[0]
    u = gain.real * jnp.sin(angle) + gain.imag * jnp.cos(angle)
    return u if steady_state else _from_rest(u, drive.offset - gain.imag, time, tau)


def _from_rest(settled: Array, difference: ArrayLike, time: Array, tau: ArrayLike) -> Array:
    """The steady state plus the transient that starts with `difference`; nothing before t = 0."""
    later = jnp.maximum(time, 0.0)
    return jnp.where(time >= 0.0, settled + difference * jnp.exp(-later / tau), 0.0)


@jax.custom_jvp
def phi(x: ArrayLike) -> Array:
    """(1 - e^{-x}) / x for x >= 0."""
    x = jnp.asarray(x, dtype=float)
    return jnp.where(x == 0.0, 1.0, -jnp.expm1(-x) / jnp.where(x == 0.0, 1.0, x))


@phi.defjvp
def _phi_jvp(primals: tuple[ArrayLike], tangents: tuple[Array]) -> tuple[Array, Array]:
    (x,), (dx,) = primals, tangents
    return phi(x), phi(x) * log_slope(x) * dx


def psi(x: ArrayLike) -> Array:
    """(1 - phi(x)) / x = (e^{-x} - 1 + x) / x^2 for x >= 0."""
    return phi(x) * (0.5 + bend(x))


def log_slope(x: ArrayLike) -> Array:
    """The derivative of log phi(x), for x >= 0: from -1/2 towards -1/x."""
    x = jnp.asarray(x, dtype=float)
    large = jnp.where(x < 2.0, 2.0, x)
    return jnp.where(x < 2.0, bend(x) - 0.5, jnp.exp(-large) / (1.0 - jnp.exp(-large)) - 1.0 / large)


def bend(x: ArrayLike) -> Array:
    """1 / (e^x - 1) - 1/x + 1/2 for x >= 0: from x/12 towards 1/2."""
    x = jnp.asarray(x, dtype=float)
    small, large = jnp.where(x < 2.0, x, 0.0), jnp.where(x < 2.0, 2.0, x)
    direct = jnp.exp(-large) / (1.0 - jnp.exp(-large)) - 1.0 / large + 0.5
    return jnp.where(x < 2.0, 0.25 * small / coth_fraction(0.25 * small * small), direct)


def coth_fraction(z: ArrayLike) -> Array:
    """3 + z / (5 + z / (7 + ...)) to double precision for 0 <= z <= 1; w coth w = 1 + w^2 / coth_fraction(w^2)."""
    z = jnp.asarray(z, dtype=float)
    total = jnp.full_like(z, 21.0)
    for odd in range(19, 1, -2):
        total = odd + z / total
    return total
