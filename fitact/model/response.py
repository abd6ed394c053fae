"""Exact response in time: every circuit is a sum of a few first-order high-pass filters.

One function serves all circuits: the response u(t) of  s tau / (1 + s tau)  to the drive. On a linear piece of
slope m, u' = m - u / tau. Over a length L, u decays by e^{-L/tau} and gains m L phi(L/tau). At a jump of the drive,
u jumps by the same amount. The formulas neither cancel nor overflow for small or large tau.
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

from fitact.compiled import jit_inline
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
    """Return the exact skin voltage Vsc (V), loop current I (A) or gap voltage Vgap (V) at `time` (s).

    The response is the steady state or, with ``steady_state=False``, starts from rest: no charge and no drive
    before t = 0, or before the first point of a drive given by points. (A `Sampled` drive holds its first value
    before that, since a measured drive existed before the record.) Eqs. (18)-(21) in the time domain. If no
    resistance limits the current, it follows dV/dt, and is NaN at an ideal jump. A non-conducting gap carries none
    of the mean drive in the steady state; from rest it carries its capacitive fraction of it.

    `initial` describes the charge at the start of the drive. It holds one amplitude, in the channel's unit, for each
    time constant in ``circuit.terms().tau``, with which it decays.

    The steady state of a frequency-dependent skin is computed harmonic by harmonic up to the frequency where the skin
    stops changing, and by time constants above. This is exact for `Dispersive`; `Fractional` documents its error.
    A skin represented by a grid of time constants is computed like any other circuit.

    Outside `jax.enable_x64`, times are rounded, which may move an edge by a millionth of its time.

    Raises:
        InputError: the drive has no steady state; `initial` is given for the steady state, or has a wrong number of
            values; a frequency-dependent skin is combined with anything but the steady state of a periodic drive; or
            the circuit has no gap for Vgap.
    """
    total, rate = response_and_rate(circuit, drive, time, steady_state=steady_state, channel=channel)
    if rate is not None:
        total = total + rate * drive.slope(time, steady_state=steady_state)
    if initial is None:
        return total
    if steady_state:
        raise InputError("an initial charge has decayed in the steady state; set steady_state=False to use initial")
    return total + _initial_charge_decay(drive, time, circuit.channel_terms(channel).tau, initial)


def response_and_rate(
    circuit: Circuit, drive: Drive, time: ArrayLike, *, steady_state: bool = True, channel: Channel = "Vsc"
) -> tuple[Float[Array, "*shape"], ArrayLike | None]:
    """Return the `response` without the term in dV/dt, and the coefficient of this term (F), or None."""
    if has_time_constants(circuit):
        terms = circuit.channel_terms(channel)
        return superpose_terms(terms, drive, time, steady_state=steady_state), terms.rate
    assert isinstance(circuit, WithSkin)
    if not steady_state:
        raise InputError(
            f"a {type(circuit.skin).__name__.lower()} skin has a response in the steady state only;"
            " use steady_state=True, or a constant skin"
        )
    harmonics = harmonic_decomposition(circuit, drive, channel)
    missing = harmonic_sum(harmonics.drive * harmonics.missing_gain, drive, time)
    return superpose_terms(harmonics.terms, drive, time) + missing, harmonics.terms.rate


def superpose_terms(
    terms: HighpassTerms, drive: Drive, time: ArrayLike, *, steady_state: bool = True
) -> Float[Array, "*shape"]:
    """Return the response of the `terms`, without the term in dV/dt; other arguments as in `response`."""
    if terms.direct is not None:
        rest = superpose_terms(terms._replace(direct=None), drive, time, steady_state=steady_state)
        return rest + terms.direct * drive_voltage(drive, time, steady_state=steady_state)
    time = jnp.asarray(time, dtype=float)
    if len(terms.tau) <= 8:  # an unrolled sum, which XLA fuses
        total = jnp.zeros_like(time)
        for weight, tau in zip(terms.weight, terms.tau, strict=True):
            total = total + weight * highpass(drive, time, tau, steady_state=steady_state)
        return total

    def add(total: Array, term: tuple[Array, Array]) -> tuple[Array, None]:
        return total + term[0] * highpass(drive, time, term[1], steady_state=steady_state), None

    return lax.scan(add, jnp.zeros_like(time), terms.stack())[0]


def drive_voltage(drive: Drive, time: ArrayLike, *, steady_state: bool = True) -> Float[Array, "*shape"]:
    """Return V(t) as the response takes it: from rest it is 0 before the start, unless the drive was measured."""
    if isinstance(drive, Sampled) and drive.period is None and time is drive.time:
        return jnp.asarray(drive.samples, dtype=float)  # they need no search
    time = jnp.asarray(time, dtype=float)
    if steady_state or isinstance(drive, Sampled):
        return drive.value(time)
    return jnp.where(time >= drive.start_time, drive.value(time), 0.0)


class Harmonics(NamedTuple):
    """Steady state of a circuit without time constants: single harmonics, and terms for higher frequencies."""

    terms: HighpassTerms  # exact, or fitted, above the harmonics
    drive: Complex[Array, " harmonics"]  # V, amplitudes of the harmonics
    gain: Complex[Array, " harmonics"]  # gain of the circuit at each harmonic
    missing_gain: Complex[Array, " harmonics"]  # gain minus the gain of the terms


def harmonic_decomposition(circuit: WithSkin, drive: Drive, channel: Channel) -> Harmonics:
    """Return the harmonics up to which the skin changes, and terms for higher ones."""
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
    """Return the response of s tau / (1 + s tau) to `drive` at `time`; arguments as in `response`."""
    wave = drive.wave if isinstance(drive, Burst) else drive
    at_samples = isinstance(wave, Sampled) and time is wave.time
    time = jnp.asarray(time, dtype=float)
    if not isinstance(wave, Sine | Multitone | PiecewiseLinear | InterpolatedDrive | Chirp):
        raise TypeError(f"no exact response to a {type(wave).__name__}")
    if steady_state:
        _require_steady_state(drive)
    if isinstance(wave, Chirp):
        return _chirp(wave, time, jnp.asarray(tau, dtype=float))
    if isinstance(wave, InterpolatedDrive) and wave.period is None:
        pieces = wave.pieces()
        at_knots = knot_values(pieces, tau, pieces.start[0])
        if at_samples:  # they need no search
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
    # the burst is the wave minus the same wave started at its end; after the end only the transients remain
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
    """Return the contribution at `time` of the charge at the start of the drive."""
    amplitudes = jnp.atleast_1d(jnp.asarray(initial, dtype=float))
    if amplitudes.shape != (len(taus),):
        raise InputError(
            f"initial has shape {amplitudes.shape}, but the circuit has {len(taus)} time constants;"
            " give one value for each time constant"
        )
    since = jnp.asarray(time, dtype=float) - drive.start_time
    decayed = sum(v * jnp.exp(-jnp.maximum(since, 0.0) / tau) for v, tau in zip(amplitudes, taus, strict=True))
    return jnp.asarray(decayed if isinstance(drive, Sampled) else jnp.where(since >= 0.0, decayed, 0.0))


def _steady_response(
    drive: Sine | Multitone | PiecewiseLinear | InterpolatedDrive, tau: ArrayLike
) -> Callable[[Array], Array]:
    """Return a function that evaluates u(t) in the steady state."""
    if isinstance(drive, Sine):
        return partial(_sine, drive, tau)
    if isinstance(drive, Multitone):
        return lambda time: sum((_sine(tone, tau, time) for tone in drive.tones()), jnp.zeros(()))
    u = steady_knot_values(drive.pieces(), tau)
    return lambda time: _propagate(drive, time, tau, u)


@partial(jit_inline, static_argnames="part")
def knot_values(pieces: LinearPieces, tau: ArrayLike, first: ArrayLike, part: int = 32_768) -> Float[Array, " pieces"]:
    """Return u just after the start of each piece, given u just after the first start.

    More pieces than `part` are processed in parts, whose intermediate arrays stay in the processor's cache.
    """

    def propagate_part(before: Array, begin: ArrayLike, count: int) -> tuple[Array, Array]:
        """Return the last u and all u of `count` pieces, given u `before` the first."""
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


@jit_inline
def recurrence(
    decay: Float[Array, " n"], gain: Float[Array, "*shape n"], first: Float[Array, "*shape"]
) -> Float[Array, "*shape n"]:
    """Return u[k] = decay[k] u[k - 1] + gain[k], from u[-1] = first; each row of `gain` has the same `decay`.

    About sqrt(n) blocks are computed in parallel and then joined one after another. These two short loops over
    short vectors run and compile several times faster than an associative scan.
    """
    if gain.ndim > 1:
        return jax.vmap(partial(recurrence, decay))(gain, first)
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


@jit_inline
def _propagate(drive: PiecewiseLinear | InterpolatedDrive, time: Array, tau: ArrayLike, u: Array) -> Array:
    """Return u(t), given its values at the starts of the pieces."""
    piece, since = drive.locate(time)
    since = jnp.maximum(since, 0.0)
    decaying = _select_piece(u, piece) * jnp.exp(-since / tau)
    if isinstance(drive, Square):
        return decaying
    return decaying + _select_piece(drive.pieces().slopes(), piece) * since * phi(since / tau)


def _select_piece(values: Array, piece: Array) -> Array:
    """Return values[piece]; up to 8 are selected by comparisons, which XLA fuses, unlike a gather."""
    if values.size > 8:
        return values[piece]
    selected = values[0]
    for k in range(1, values.size):
        selected = jnp.where(piece >= k, values[k], selected)
    return jnp.broadcast_to(selected, piece.shape)


def steady_knot_values(pieces: LinearPieces, tau: ArrayLike) -> Float[Array, " pieces"]:
    """Return u just after the start of each piece, in the steady state."""
    return knot_values(pieces, tau, _steady_initial_value(pieces, tau))


@jit_inline
def _steady_initial_value(pieces: LinearPieces, tau: ArrayLike) -> Array:
    """Return u just after the start of a period, in the steady state.

    u0 (1 - e^{-T/tau}) is the sum over a period of (increment) x (decay until the end of the period). If T/tau is
    large, u0 is computed from this sum. If T/tau is small, all decays are close to 1. The increments of a period
    add up to zero, so decay - 1 may replace decay, and the quotient keeps its digits. The derivative keeps its
    digits because fractions of the period do not depend on tau, and because 1 - exp replaces expm1 where this is
    exact enough (JAX computes the derivative of expm1 as expm1 + 1).
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


@jit_inline
def _sine(drive: Sine, tau: ArrayLike, time: Array) -> Array:
    x = 2.0 * np.pi * jnp.asarray(drive.frequency) * tau
    height = 0.5 * jnp.asarray(drive.peak_to_peak) * highpass_amplitude(x)
    return height * jnp.sin(2.0 * np.pi * drive.cycle(time)[0] + jnp.arctan2(1.0, x))


@eqx.filter_jit  # outside jit, each call would compile the loops again
def _chirp(drive: Chirp, time: Array, tau: Array) -> Array:
    """Return u(t) from rest, as a polynomial plus a decay on each piece."""
    z = drive.duration / tau / drive.pieces
    series, v = drive.taylor_coefficients(), drive.sweep(drive.duration / drive.pieces * jnp.arange(drive.pieces + 1))
    p, p_end = particular_solution(series, z)
    rounding = jnp.diff(v) - jnp.sum(series, axis=0)  # it would accumulate over many pieces
    decay = jnp.broadcast_to(jnp.exp(-z), p_end.shape)
    u = jnp.append(v[0], recurrence(decay, p_end - jnp.exp(-z) * p[0] + rounding, v[0]))
    piece, s = drive.locate(time)
    during = evaluate_polynomials(p, piece, s) + (u[piece] - p[0][piece]) * jnp.exp(-z * s)
    since = jnp.maximum(time - drive.duration, 0.0)
    after = (u[-1] - v[-1]) * jnp.exp(-since / tau)
    return jnp.where(time >= 0.0, jnp.where(drive.is_over(time), after, during), 0.0)


@jax.custom_jvp
@jit_inline
def phi(x: ArrayLike) -> Array:
    """Return (1 - e^{-x}) / x for x >= 0."""
    x = jnp.asarray(x, dtype=float)
    return jnp.where(x == 0.0, 1.0, -jnp.expm1(-x) / jnp.where(x == 0.0, 1.0, x))


@phi.defjvp
def _phi_jvp(primals: tuple[ArrayLike], tangents: tuple[Array]) -> tuple[Array, Array]:
    (x,), (dx,) = primals, tangents
    return phi(x), phi(x) * log_phi_derivative(x) * dx


def psi(x: ArrayLike) -> Array:
    """Return (1 - phi(x)) / x = (e^{-x} - 1 + x) / x^2 for x >= 0."""
    return phi(x) * (0.5 + half_langevin(x))


@jit_inline
def log_phi_derivative(x: ArrayLike) -> Array:
    """Return the derivative of log phi(x) for x >= 0; it goes from -1/2 towards -1/x."""
    x = jnp.asarray(x, dtype=float)
    large = jnp.where(x < 2.0, 2.0, x)
    return jnp.where(x < 2.0, half_langevin(x) - 0.5, jnp.exp(-large) / (1.0 - jnp.exp(-large)) - 1.0 / large)


@jit_inline
def half_langevin(x: ArrayLike) -> Array:
    """Return 1 / (e^x - 1) - 1/x + 1/2 for x >= 0; it goes from x/12 towards 1/2."""
    x = jnp.asarray(x, dtype=float)
    small, large = jnp.where(x < 2.0, x, 0.0), jnp.where(x < 2.0, 2.0, x)
    direct = jnp.exp(-large) / (1.0 - jnp.exp(-large)) - 1.0 / large + 0.5
    return jnp.where(x < 2.0, 0.25 * small / coth_fraction(0.25 * small * small), direct)


def coth_fraction(z: ArrayLike) -> Array:
    """Return 3 + z / (5 + z / (7 + ...)) for 0 <= z <= 1, so that w coth w = 1 + w^2 / coth_fraction(w^2)."""
    z = jnp.asarray(z, dtype=float)
    total = jnp.full_like(z, 21.0)
    for odd in range(19, 1, -2):
        total = odd + z / total
    return total
