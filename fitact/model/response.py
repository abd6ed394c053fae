"""The skin voltage in time, exactly: every circuit is a few first-order high-pass filters.

One function serves all: the response u(t) of  s tau / (1 + s tau)  to the drive. Along a straight
piece of slope m, u' = m - u / tau, so u decays by e^{-L/tau} and gains m L phi(L/tau) over a length
L; at a jump u jumps along. Written so that nothing cancels or overflows at either end of tau.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Complex, Float

from fitact.errors import InputError
from fitact.model.chirp import Chirp, evaluate_polynomials, particular_solution
from fitact.model.circuit import Channel, Circuit, HighpassTerms, gain_at, highpass_amplitude
from fitact.model.drive import (
    Burst,
    Drive,
    InterpolatedDrive,
    LinearPieces,
    Multitone,
    PiecewiseLinear,
    Sampled,
    Sine,
    Square,
)
from fitact.model.harmonic import angular_frequency, drive_frequency, fourier_coefficients, harmonic_sum
from fitact.model.skin import WithSkin, has_time_constants


def response(
    circuit: Circuit,
    drive: Drive,
    time: ArrayLike,
    *,
    steady_state: bool = True,
    channel: Channel = "Vsc",
    initial: ArrayLike | Sequence[ArrayLike] | None = None,
) -> Float[Array, "*shape"]:
    """The skin voltage Vsc (V), the trunk current I (A) or the gap's voltage Vgap (V) at `time` (s), exact.

    In the steady state, or, with ``steady_state=False``, from rest: no charge anywhere and no drive
    before t = 0, or before the first point of a drive given by points (where that of a `Sampled` one is
    held, since a measured drive was there before). Eqs. (18)-(21) in the time domain. Where nothing
    resistive limits the current it follows dV/dt, and at an ideal jump it is NaN. A gap that does not
    conduct has, in the steady state, none of the drive's mean across it, and from rest its share of it.

    `initial` stands for a charge that was there when the drive began: one amplitude for each time constant
    of the circuit, in the order of ``circuit.terms().tau`` and the channel's unit, that decays with it.

    A skin that depends on the frequency has its steady state harmonic by harmonic as far as it changes, and
    above by time constants: exact for `Dispersive`; for `Fractional` within the error it states. One that is
    followed by a grid of time constants is computed like any other circuit.

    Raises:
        InputError: the steady state was asked for of a drive that has none, or together with `initial`, or
            `initial` has not one value for each time constant; or, with a skin that depends on the frequency,
            anything but the steady state of a periodic drive; or Vgap of a circuit without a gap.
    """
    total, rate = response_and_rate(circuit, drive, time, steady_state=steady_state, channel=channel)
    if rate is not None:
        total = total + rate * drive.slope(time, steady_state=steady_state)
    if initial is None:
        return total
    if steady_state:
        raise InputError("an initial charge has decayed in the steady state: give steady_state=False with initial")
    return total + _initial_charge_decay(drive, time, circuit.channel_terms(channel).tau, initial)


def response_and_rate(
    circuit: Circuit, drive: Drive, time: ArrayLike, *, steady_state: bool = True, channel: Channel = "Vsc"
) -> tuple[Float[Array, "*shape"], ArrayLike | None]:
    """The `response` without the part that follows dV/dt, and how much does (F); None: nothing."""
    if has_time_constants(circuit):
        terms = circuit.channel_terms(channel)
        return superpose_terms(terms, drive, time, steady_state=steady_state), terms.rate
    assert isinstance(circuit, WithSkin)
    if not steady_state:
        raise InputError(
            f"a {type(circuit.skin).__name__.lower()} skin is computed in the steady state only;"
            " ask for steady_state=True, or take the constant skin level"
        )
    harmonics = harmonic_decomposition(circuit, drive, channel)
    missing = harmonic_sum(harmonics.drive * harmonics.missing_gain, drive, time)
    return superpose_terms(harmonics.terms, drive, time) + missing, harmonics.terms.rate


def superpose_terms(
    terms: HighpassTerms, drive: Drive, time: ArrayLike, *, steady_state: bool = True
) -> Float[Array, "*shape"]:
    """The response of a circuit's `terms`, but for the one that follows dV/dt; arguments as in `response`."""
    time = jnp.asarray(time, dtype=float)
    if len(terms.tau) <= 8:  # written out one by one, which XLA fuses
        total = jnp.zeros_like(time)
        for weight, tau in zip(terms.weight, terms.tau, strict=True):
            total = total + weight * highpass(drive, time, tau, steady_state=steady_state)
        return total

    def add(total: Array, term: tuple[Array, Array]) -> tuple[Array, None]:
        return total + term[0] * highpass(drive, time, term[1], steady_state=steady_state), None

    return lax.scan(add, jnp.zeros_like(time), terms.stack())[0]


class Harmonics(NamedTuple):
    """A circuit without time constants in the steady state: terms that stand for high frequencies, and the others."""

    terms: HighpassTerms  # what they are exact or fitted for lies above the harmonics
    drive: Complex[Array, " harmonics"]  # V, the harmonics' amplitudes
    gain: Complex[Array, " harmonics"]  # the circuit's at each
    missing_gain: Complex[Array, " harmonics"]  # of that, what the terms do not have


def harmonic_decomposition(circuit: WithSkin, drive: Drive, channel: Channel) -> Harmonics:
    """The harmonics in which the skin changes, and terms for those above."""
    omega, terms = angular_frequency(drive), HighpassTerms((), ())
    if isinstance(drive, Sine | Multitone):
        count = max(drive.orders) if isinstance(drive, Multitone) else 1
    else:
        count = circuit.skin.harmonic_count(drive_frequency(drive))
        terms = circuit.skin.high_frequency_terms(circuit, omega * count, channel)
    harmonics = omega * jnp.arange(1, count + 1)
    gain = circuit.channel_gain(channel, harmonics)
    return Harmonics(terms, fourier_coefficients(drive, count), gain, gain - gain_at(terms, harmonics))


def highpass(drive: Drive, time: ArrayLike, tau: ArrayLike, *, steady_state: bool = True) -> Float[Array, "*shape"]:
    """The response of s tau / (1 + s tau) to `drive` at `time`; arguments as in `response`."""
    time = jnp.asarray(time, dtype=float)
    wave = drive.wave if isinstance(drive, Burst) else drive
    if not isinstance(wave, Sine | Multitone | PiecewiseLinear | InterpolatedDrive | Chirp):
        raise TypeError(f"no exact response to a {type(wave).__name__}")
    if steady_state:
        _require_steady_state(drive)
    if isinstance(wave, Chirp):
        return _chirp(wave, time, jnp.asarray(tau, dtype=float))
    if isinstance(wave, InterpolatedDrive) and wave.period is None:
        pieces = wave.pieces()
        at_knots = knot_values(pieces, tau, pieces.start[0])
        if isinstance(wave, Sampled) and time is wave.time:  # its own samples need no search
            return at_knots
        u = _propagate(wave, time, tau, at_knots)
        return u if isinstance(wave, Sampled) else jnp.where(time >= wave.start_time, u, 0.0)
    settled = _steady_response(wave, tau)
    if steady_state:
        return settled(time)
    begin = jnp.asarray(wave.start_time, dtype=float)
    difference = wave.value(begin) - settled(begin)
    since_begin = time - begin
    transient = difference * jnp.exp(-jnp.maximum(since_begin, 0.0) / tau)
    u = jnp.where(since_begin >= 0.0, settled(time) + transient, 0.0)
    if not isinstance(drive, Burst):
        return u
    since = jnp.maximum(time - drive.duration, 0.0)
    # the wave minus the same begun again at the end: of the two only the transients do not cancel
    after = difference * jnp.expm1(-drive.duration / tau) * jnp.exp(-since / tau)
    return jnp.where(drive.is_over(time), after, u)


def _require_steady_state(drive: Drive) -> None:
    name = type(drive).__name__
    if isinstance(drive, Burst | Chirp):
        raise InputError(f"a {name} has no steady state: give steady_state=False")
    if isinstance(drive, InterpolatedDrive) and drive.period is None:
        raise InputError(
            f"a {name} has no steady state unless its period is given: {name}(..., period=T), or steady_state=False"
        )


def _initial_charge_decay(
    drive: Drive, time: ArrayLike, taus: Sequence[ArrayLike], initial: ArrayLike | Sequence[ArrayLike]
) -> Array:
    """The rest at `time` of a charge that was there when the drive began."""
    amplitudes = jnp.atleast_1d(jnp.asarray(initial, dtype=float))
    if amplitudes.shape != (len(taus),):
        raise InputError(
            f"initial has shape {amplitudes.shape}, but the circuit has {len(taus)} time constants;"
            " give one value for each"
        )
    since = jnp.asarray(time, dtype=float) - drive.start_time
    decayed = sum(v * jnp.exp(-jnp.maximum(since, 0.0) / tau) for v, tau in zip(amplitudes, taus, strict=True))
    return jnp.asarray(decayed if isinstance(drive, Sampled) else jnp.where(since >= 0.0, decayed, 0.0))


def _steady_response(
    drive: Sine | Multitone | PiecewiseLinear | InterpolatedDrive, tau: ArrayLike
) -> Callable[[Array], Array]:
    """u(t) in the steady state."""
    if isinstance(drive, Sine):
        return partial(_sine, drive, tau)
    if isinstance(drive, Multitone):
        return lambda time: sum((_sine(tone, tau, time) for tone in drive.tones()), jnp.zeros(()))
    u = steady_knot_values(drive.pieces(), tau)
    return lambda time: _propagate(drive, time, tau, u)


def knot_values(pieces: LinearPieces, tau: ArrayLike, first: ArrayLike, part: int = 262_144) -> Float[Array, " pieces"]:
    """u just after the start of each piece, given u just after the first start.

    More pieces than `part` are followed a part at a time: what they take in between would be several times the record.
    """

    def propagate_part(before: Array, begin: ArrayLike, count: int) -> tuple[Array, Array]:
        """Over so many pieces, the first of which begins with u `before`; the last one's u, and all."""
        knots, start = (lax.dynamic_slice_in_dim(x, begin, count + 1) for x in (pieces.knots, pieces.start))
        end = lax.dynamic_slice_in_dim(pieces.end, begin, count)
        x = jnp.diff(knots) / tau
        gain = (end - start[:-1]) * phi(x) + (start[1:] - end)
        u = recurrence(jnp.exp(-x), gain, before.astype(gain.dtype))
        return u[-1], u

    steps, first = pieces.start.size - 1, jnp.asarray(first)
    if steps <= part:
        return jnp.append(first, propagate_part(first, 0, steps)[1]) if steps else first[None]
    many, rest = divmod(steps - 2, part)
    begun, u = propagate_part(first, 0, 1)
    last, parts = lax.scan(lambda before, k: propagate_part(before, 1 + k * part, part), begun, jnp.arange(many))
    rest_of_it = propagate_part(last, 1 + many * part, rest + 1)[1]
    return jnp.concatenate([first[None].astype(u.dtype), u, parts.ravel(), rest_of_it])


@jax.jit
def recurrence(decay: Float[Array, " n"], gain: Float[Array, " n"], first: Float[Array, ""]) -> Float[Array, " n"]:
    """u[k] = decay[k] u[k - 1] + gain[k], from u[-1] = first.

    In about sqrt(n) blocks side by side, then from block to block: two short loops over short vectors,
    which run and compile several times faster than an associative scan.
    """
    width = math.isqrt(max(decay.size - 1, 0)) + 1
    missing = -decay.size % width
    decay = jnp.pad(decay, (0, missing), constant_values=1.0).reshape(-1, width)
    gain = jnp.pad(gain, (0, missing)).reshape(-1, width)

    def accumulate(carry: tuple[Array, Array], step: tuple[Array, Array]) -> tuple[tuple[Array, Array], Any]:
        carry = carry[0] * step[0], carry[1] * step[0] + step[1]
        return carry, carry

    def carry_block(u: Array, block: tuple[Array, Array]) -> tuple[Array, Array]:
        return block[0] * u + block[1], u

    alone = jnp.ones_like(decay[:, 0]), jnp.zeros_like(gain[:, 0])
    (whole_decay, whole_gain), (decays, gains) = lax.scan(accumulate, alone, (decay.T, gain.T))
    _, starts = lax.scan(carry_block, first, (whole_decay, whole_gain))
    return (decays * starts + gains).T.reshape(-1)[: decay.size - missing]


def _propagate(drive: PiecewiseLinear | InterpolatedDrive, time: Array, tau: ArrayLike, u: Array) -> Array:
    """u(t) from its values at the starts of the pieces."""
    piece, since = drive.locate(time)
    since = jnp.maximum(since, 0.0)
    decaying = _select_piece(u, piece) * jnp.exp(-since / tau)
    if isinstance(drive, Square):
        return decaying
    return decaying + _select_piece(drive.pieces().slopes(), piece) * since * phi(since / tau)


def _select_piece(values: Array, piece: Array) -> Array:
    """values[piece]; of up to 8 by comparison, which XLA fuses with the rest and a gather it does not."""
    if values.size > 8:
        return values[piece]
    selected = values[0]
    for k in range(1, values.size):
        selected = jnp.where(piece >= k, values[k], selected)
    return jnp.broadcast_to(selected, piece.shape)


def steady_knot_values(pieces: LinearPieces, tau: ArrayLike) -> Float[Array, " pieces"]:
    """u just after the start of each piece, in the steady state."""
    return knot_values(pieces, tau, _steady_initial_value(pieces, tau))


def _steady_initial_value(pieces: LinearPieces, tau: ArrayLike) -> Array:
    """u just after the start of a period, in the steady state.

    u0 (1 - e^{-T/tau}) is the sum over a period of (increment) x (decay until its end). Where T/tau is
    large that is how it is computed. Where it is small all decays are close to 1: the increments of a
    period add up to nothing, so decay - 1 may stand for decay, and the quotient keeps its digits.
    Fractions of the period, which do not depend on tau, keep those of its derivative; so does 1 - exp where
    that is no loss, since the derivative of expm1 is computed as expm1 + 1.
    """
    knots, start, end = pieces
    period = knots[-1] - knots[0]
    until_end, share = (knots[-1] - knots[1:]) / period, jnp.diff(knots) / period
    jump, rise = jnp.append(start[1:], start[0]) - end, end - start
    x = period / tau
    few, many = jnp.where(x < 1.0, x, 1.0), jnp.where(x < 1.0, 1.0, x)

    lam = share * few
    ratio = until_end * phi(until_end * few) / phi(few)  # (1 - e^{-until_end x}) / (1 - e^{-x})
    slow = -jnp.sum(jump * ratio + rise * (ratio * phi(lam) + share * psi(lam) / phi(few)))
    fast = jnp.sum((jump + rise * phi(share * many)) * jnp.exp(-until_end * many)) / (1.0 - jnp.exp(-many))
    return jnp.where(x < 1.0, slow, fast)


def _sine(drive: Sine, tau: ArrayLike, time: Array) -> Array:
    x = 2.0 * np.pi * jnp.asarray(drive.frequency) * tau
    height = 0.5 * jnp.asarray(drive.peak_to_peak) * highpass_amplitude(x)
    return height * jnp.sin(2.0 * np.pi * drive.cycle(time)[0] + jnp.arctan2(1.0, x))


@eqx.filter_jit  # loops are compiled anew at every call outside jit
def _chirp(drive: Chirp, time: Array, tau: Array) -> Array:
    """From rest: u at the pieces' starts, then along each as its polynomial and what decays."""
    z = drive.duration / tau / drive.pieces
    series, v = drive.taylor_coefficients(), drive.sweep(drive.duration / drive.pieces * jnp.arange(drive.pieces + 1))
    p, p_end = particular_solution(series, z)
    rounding = jnp.diff(v) - jnp.sum(series, axis=0)  # what would add up over many pieces
    decay = jnp.broadcast_to(jnp.exp(-z), p_end.shape)
    u = jnp.append(v[0], recurrence(decay, p_end - jnp.exp(-z) * p[0] + rounding, v[0]))
    piece, s = drive.locate(time)
    during = evaluate_polynomials(p, piece, s) + (u[piece] - p[0][piece]) * jnp.exp(-z * s)
    since = jnp.maximum(time - drive.duration, 0.0)
    after = (u[-1] - v[-1]) * jnp.exp(-since / tau)
    return jnp.where(time >= 0.0, jnp.where(drive.is_over(time), after, during), 0.0)


@jax.custom_jvp
def phi(x: ArrayLike) -> Array:
    """(1 - e^{-x}) / x for x >= 0."""
    x = jnp.asarray(x, dtype=float)
    return jnp.where(x == 0.0, 1.0, -jnp.expm1(-x) / jnp.where(x == 0.0, 1.0, x))


@phi.defjvp
def _phi_jvp(primals: tuple[ArrayLike], tangents: tuple[Array]) -> tuple[Array, Array]:
    (x,), (dx,) = primals, tangents
    return phi(x), phi(x) * log_phi_derivative(x) * dx


def psi(x: ArrayLike) -> Array:
    """(1 - phi(x)) / x = (e^{-x} - 1 + x) / x^2 for x >= 0."""
    return phi(x) * (0.5 + half_langevin(x))


def log_phi_derivative(x: ArrayLike) -> Array:
    """The derivative of log phi(x), for x >= 0: from -1/2 towards -1/x."""
    x = jnp.asarray(x, dtype=float)
    large = jnp.where(x < 2.0, 2.0, x)
    return jnp.where(x < 2.0, half_langevin(x) - 0.5, jnp.exp(-large) / (1.0 - jnp.exp(-large)) - 1.0 / large)


def half_langevin(x: ArrayLike) -> Array:
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
