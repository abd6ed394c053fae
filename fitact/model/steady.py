"""Exact quantities of the steady state over a period: mean squares, peaks, and the body current.

Let u be the response of one high-pass term s tau / (1 + s tau), and S(tau) its mean square. Two terms have

    mean(u_j u_k) = (tau_k S(tau_j) + tau_j S(tau_k)) / (tau_j + tau_k),   mean(u V') = S(tau) / tau,

so S suffices for every circuit. The formulas avoid cancellation in S and its derivative for small and large tau.
"""

import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Complex, Float

from fitact.compiled import jit_inline
from fitact.errors import InputError
from fitact.model.circuit import Channel, Circuit, HighpassTerms, highpass_amplitude
from fitact.model.drive import (
    Drive,
    InterpolatedDrive,
    LinearPieces,
    Multitone,
    Periodic,
    PiecewiseLinear,
    Sine,
    Square,
    Trapezoid,
    Triangle,
)
from fitact.model.harmonic import mean_response
from fitact.model.response import (
    coth_fraction,
    half_langevin,
    harmonic_decomposition,
    log_phi_derivative,
    phi,
    psi,
    steady_knot_values,
)
from fitact.model.skin import WithSkin


class BodyCurrent(NamedTuple):
    """Loop current over a period of the steady state, A."""

    rms: Array
    peak: Array


def mean_square(circuit: Circuit, drive: Drive, channel: Channel = "Vsc") -> Float[Array, ""]:
    """Return the exact mean square of Vsc or Vgap (V^2) or I (A^2) over a period of the steady state.

    It is infinite for a current that follows dV/dt if the drive jumps.

    Raises:
        InputError: the drive is not periodic.
    """
    if isinstance(circuit, WithSkin) and circuit.grid is None:
        terms, tones, gain, missing_gain = harmonic_decomposition(circuit, drive, channel)
        # Parseval: at the single harmonics, the power of the circuit replaces the power of the terms
        instead = _power(tones * gain) - _power(tones * (gain - missing_gain))
        return instead + (_terms_mean_square(terms, drive) if terms.tau else 0.0)
    return _terms_mean_square(circuit.channel_terms(channel), drive)


def _terms_mean_square(terms: HighpassTerms, drive: Drive) -> Float[Array, ""]:
    weight, tau = terms.stack()
    products = weight * jax.vmap(lambda t: highpass_mean_square(drive, t))(tau)
    # for a term with itself this is exactly 1 / 2, with zero derivative
    share = jnp.where(jnp.eye(tau.size, dtype=bool), 0.5, tau[:, None] / (tau[:, None] + tau))
    total = 2.0 * jnp.sum(weight[:, None] * share * products)
    if terms.direct is not None:  # mean(V u) = mean(u^2)
        total = total + 2.0 * terms.direct * jnp.sum(products) + terms.direct**2 * voltage_mean_square(drive)
    if terms.rate is None:
        return jnp.maximum(total, 0.0)  # the terms of Vsc may cancel to within rounding
    total = total + 2.0 * terms.rate * jnp.sum(products / tau)
    return jnp.where(_has_impulses(drive, terms.rate), jnp.inf, total + terms.rate**2 * _slope_mean_square(drive))


def _power(amplitude: Array) -> Array:
    """Return the mean square of 2 Re sum_k amplitude[k - 1] e^{jkwt}."""
    return 2.0 * jnp.sum(amplitude.real**2 + amplitude.imag**2)


def peak(circuit: Circuit, drive: Drive, channel: Channel = "Vsc") -> Float[Array, ""]:
    """Return the exact maximum of |Vsc| or |Vgap| (V) or |I| (A) over a period of the steady state, jumps included.

    With one time constant, the extremes lie at the ends of the linear pieces. With several, extremes in between are
    bracketed and bisected to the last bit; extremes of a multi-tone are found by Newton's method. The maximum is
    infinite for a current that follows dV/dt if the drive jumps.

    Raises:
        InputError: the drive is not periodic.
    """
    if isinstance(drive, Sine):
        omega = 2.0 * np.pi * jnp.asarray(drive.frequency)
        amplitude = circuit.amplitude(omega) if channel == "Vsc" else abs(circuit.channel_gain(channel, omega))
        return abs(0.5 * jnp.asarray(drive.peak_to_peak)) * amplitude + abs(mean_response(circuit, drive, channel))
    if isinstance(drive, Multitone):
        omega = 2.0 * np.pi * jnp.asarray(drive.frequency) * jnp.asarray(drive.orders)
        phasors, mean = drive.phasors() * circuit.channel_gain(channel, omega), mean_response(circuit, drive, channel)
        return _largest_sum(phasors, drive.orders, mean)
    terms = circuit.channel_terms(channel)
    if isinstance(drive, Square | Triangle) and len(terms.tau) == 1 and terms.rate is None and terms.direct is None:
        return abs(terms.weight[0] * jnp.asarray(drive.peak_to_peak)) * _unit_peak(drive, drive.period / terms.tau[0])
    largest = jnp.max(jnp.abs(_extremes(terms, _period_pieces(drive))))
    return largest if terms.rate is None else jnp.where(_has_impulses(drive, terms.rate), jnp.inf, largest)


def _largest_sum(phasors: Complex[Array, " tones"], orders: tuple[int, ...], mean: ArrayLike) -> Float[Array, ""]:
    """Return the maximum of |mean + Im sum_k phasors[k] e^{j orders[k] x}| by Newton's method from many points.

    The position is not differentiated, so only first derivatives are right.
    """
    points_per_cycle, steps = 32, 6  # each step doubles the number of digits
    order = jnp.asarray(orders, dtype=float)
    start = jnp.linspace(0.0, 2.0 * np.pi, points_per_cycle * max(orders), endpoint=False)

    def phasor_sum(x: Array, derivative: int = 0) -> Array:
        return jnp.imag((phasors * (1j * order) ** derivative) @ jnp.exp(1j * order[:, None] * x))

    def newton(_: int, x: Array) -> Array:
        bend = phasor_sum(x, 2)
        step = jnp.where(bend == 0.0, 0.0, -phasor_sum(x, 1) / jnp.where(bend == 0.0, 1.0, bend))
        return x + jnp.clip(step, -start[1], start[1])

    extremes = lax.stop_gradient(lax.fori_loop(0, steps, newton, lax.stop_gradient(start)))
    return jnp.max(jnp.abs(mean + phasor_sum(jnp.concatenate([start, extremes]))))


def body_current(circuit: Circuit, drive: Drive) -> BodyCurrent:
    """Return rms and peak (A) of the body current in the steady state, edges included; relevant to electrical safety.

    Both are infinite at an ideal jump if no resistance limits the current. In this case, give the drive a rise time,
    or the circuit an R_H or a series resistor.

    Raises:
        InputError: the drive is not periodic.
    """
    return BodyCurrent(jnp.sqrt(mean_square(circuit, drive, "I")), peak(circuit, drive, "I"))


def highpass_mean_square(drive: Drive, tau: ArrayLike) -> Array:
    """Return S(tau), the mean square over a period of the response of s tau / (1 + s tau) to `drive`, V^2."""
    if isinstance(drive, Sine):
        omega = 2.0 * np.pi * jnp.asarray(drive.frequency)
        return 0.5 * jnp.square(0.5 * jnp.asarray(drive.peak_to_peak) * highpass_amplitude(omega * tau))
    if isinstance(drive, Multitone):
        return sum((highpass_mean_square(tone, tau) for tone in drive.tones()), jnp.zeros(()))
    if isinstance(drive, Square):
        return jnp.square(jnp.asarray(drive.peak_to_peak)) * _rectangle(drive.duty, drive.period / tau)
    if isinstance(drive, Triangle):
        return _triangle(0.5 * jnp.asarray(drive.peak_to_peak), 0.25 * drive.period / tau)
    general = _straight_pieces(_period_pieces(drive), tau)
    return _trapezoid(drive, tau, general) if isinstance(drive, Trapezoid) else general


def _period_pieces(drive: Drive) -> LinearPieces:
    if isinstance(drive, PiecewiseLinear) or (isinstance(drive, InterpolatedDrive) and drive.period is not None):
        return drive.pieces()
    if isinstance(drive, Periodic):
        raise TypeError(f"no exact response to a {type(drive).__name__}")
    raise InputError(
        f"a {type(drive).__name__} drive without a period has no steady state to average over;"
        " use a periodic drive, or Sampled(..., period=T)"
    )


@jax.custom_jvp
def _rectangle(duty: ArrayLike, x: ArrayLike) -> Array:
    """Return S of a rectangular wave of peak-to-peak 1 that is high for `duty` of its period; x = T / tau."""
    duty = jnp.asarray(duty, dtype=float)
    return duty * phi(duty * x) * ((1.0 - duty) * phi((1.0 - duty) * x) / phi(x))


@_rectangle.defjvp
def _rectangle_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    (d, x), (d_duty, dx) = primals, tangents
    q = 1.0 - jnp.asarray(d, dtype=float)
    value = _rectangle(d, x)
    few, many = jnp.where(x < 2.0, x, 0.0), jnp.where(x < 2.0, 2.0, x)
    # the remainder after -d/2 - q/2 + 1/2 has cancelled
    slow = d * half_langevin(d * few) + q * half_langevin(q * few) - half_langevin(few)
    fast = d * log_phi_derivative(d * many) + q * log_phi_derivative(q * many) - log_phi_derivative(many)
    by_x = jnp.where(x < 2.0, slow, fast)
    by_duty = jnp.exp(-d * x) / (d * phi(d * x)) - jnp.exp(-q * x) / (q * phi(q * x))
    return value, value * by_x * dx + value * by_duty * d_duty


def _triangle(amplitude: Array, y: Array) -> Array:
    """Return (1 - tanh(y) / y) / y^2 times the amplitude squared; y = T / (4 tau)."""
    few, many = jnp.where(y < 1.0, y, 0.0), jnp.where(y < 1.0, 1.0, y)
    slow = 1.0 / (coth_fraction(few * few) + few * few)
    fast = jnp.square(amplitude / many) * (1.0 - jnp.tanh(many) / many)
    return jnp.where(y < 1.0, amplitude * amplitude * slow, fast)


def _unit_peak(drive: Square | Triangle, x: Array) -> Array:
    """Return the maximum of |u| for one time constant and a peak-to-peak value of 1; x = T / tau.

    These closed forms are needed for the derivative. At the crest of a triangle the first-order terms cancel, and the
    heights at the two edges of a square may differ by less than rounding, so the pieces would give neither.
    """
    if isinstance(drive, Triangle):
        y = 0.25 * x
        few, many = jnp.where(y < 1.0, y, 0.0), jnp.where(y < 1.0, 1.0, y)
        fraction = coth_fraction(few * few)
        return 0.5 * jnp.where(y < 1.0, fraction / (fraction + few * few), jnp.tanh(many) / many)
    duty = jnp.asarray(drive.duty, dtype=float)
    longer = jnp.maximum(duty, 1.0 - duty)
    few, many = jnp.where(x < 1.0, x, 0.0), jnp.where(x < 1.0, 1.0, x)
    slow = longer * phi(longer * few) / phi(few)
    return jnp.where(x < 1.0, slow, (1.0 - jnp.exp(-longer * many)) / (1.0 - jnp.exp(-many)))


def _trapezoid(drive: Trapezoid, tau: ArrayLike, general: Array) -> Array:
    """Return S of a trapezoid, or `general` if the rise is longer than tau.

    A trapezoid is a rectangular wave averaged over the rise. With z = rise / tau, this multiplies S by
    (sinh(z/2) / (z/2))^2, except for the products of edges with themselves, which are smaller.
    """
    x, rise = drive.period / tau, jnp.asarray(drive.rise_time) / drive.period
    z = jnp.where(rise * x < 1.0, rise * x, 0.0)
    widened = _even_series(z * z, 2) * _rectangle(drive.duty, x)
    shortfall = rise * _even_series(z * z, 3) / 3.0
    square = jnp.square(jnp.asarray(drive.peak_to_peak))
    return jnp.where(rise * x < 1.0, square * (widened - shortfall), general)


def _even_series(z: Array, first: int) -> Array:
    """Return first! sum_n z^n / (2 n + first)! for 0 <= z <= 1."""
    total = jnp.ones_like(z)
    for n in reversed(range(8)):
        total = 1.0 + z * total / ((2 * n + first + 1) * (2 * n + first + 2))
    return total


@jit_inline
def _straight_pieces(pieces: LinearPieces, tau: ArrayLike) -> Array:
    """Return S of any drive made of linear pieces."""
    length, rise = jnp.diff(pieces.knots), pieces.end - pieces.start
    u, lam = steady_knot_values(pieces, tau), length / tau
    third = phi(lam) * (_half_langevin_ratio(lam) + 0.5 * psi(lam))  # for a rise from u = 0: (psi - phi^2 / 2) / lam
    inside = u * u * phi(2.0 * lam) + u * rise * jnp.square(phi(lam)) + rise * rise * third
    return jnp.sum(length / (pieces.knots[-1] - pieces.knots[0]) * inside)


def _half_langevin_ratio(x: Array) -> Array:
    """Return `half_langevin(x) / x`, finite at 0."""
    few, many = jnp.where(x < 2.0, x, 0.0), jnp.where(x < 2.0, 2.0, x)
    return jnp.where(x < 2.0, 0.25 / coth_fraction(0.25 * few * few), half_langevin(many) / many)


def voltage_mean_square(drive: Drive) -> Array:
    """Return the mean square of V over a period, V^2."""
    if isinstance(drive, Sine):
        return jnp.square(jnp.asarray(drive.offset)) + 0.125 * jnp.square(jnp.asarray(drive.peak_to_peak))
    if isinstance(drive, Multitone):
        return jnp.square(jnp.asarray(drive.offset)) + sum(map(voltage_mean_square, drive.tones()))
    knots, start, end = _period_pieces(drive)
    return jnp.sum(jnp.diff(knots) * (start * start + start * end + end * end)) / (3.0 * (knots[-1] - knots[0]))


def _slope_mean_square(drive: Drive) -> Array:
    """Return the mean square of dV/dt between jumps, V^2/s^2."""
    if isinstance(drive, Sine):
        return 0.5 * jnp.square(np.pi * jnp.asarray(drive.peak_to_peak) * drive.frequency)
    if isinstance(drive, Multitone):
        return sum(map(_slope_mean_square, drive.tones()), jnp.zeros(()))
    pieces = _period_pieces(drive)
    return jnp.sum(jnp.square(pieces.slopes()) * jnp.diff(pieces.knots)) / (pieces.knots[-1] - pieces.knots[0])


def _has_impulses(drive: Drive, rate: ArrayLike) -> Array:
    """Return whether the current follows dV/dt and the drive jumps."""
    if isinstance(drive, Sine | Multitone):
        return jnp.asarray(False)
    knots, start, end = _period_pieces(drive)
    inside = (jnp.diff(knots) == 0.0) & (end != start)
    return jnp.any(rate * (start - jnp.roll(end, 1)) != 0.0) | (jnp.any(inside) & (jnp.asarray(rate) != 0.0))


@jit_inline
def _extremes(terms: HighpassTerms, pieces: LinearPieces) -> Array:
    """Return the response at both ends of every piece and at the extremes in between.

    The positions of the extremes are not differentiated, so only first derivatives are right.
    """
    length, rise, slopes = jnp.diff(pieces.knots), pieces.end - pieces.start, pieces.slopes()
    weights, tau = terms.stack()
    u = jnp.stack([steady_knot_values(pieces, t) for t in terms.tau])

    def piece_response(since: Array) -> Array:
        total = 0.0 if terms.rate is None else terms.rate * slopes
        for weight, t, first in zip(terms.weight, terms.tau, u, strict=True):
            total = total + weight * (first * jnp.exp(-since / t) + slopes * since * phi(since / t))
        return total if terms.direct is None else total + terms.direct * (pieces.start + slopes * since)

    # the derivative is a sum of exponentials; a shift of an extreme changes its value only in second order
    fall, rates = weights[:, None] * (slopes - u / tau[:, None]), 1.0 / tau
    if terms.direct is not None:
        fall, rates = jnp.vstack([fall, terms.direct * slopes]), jnp.append(rates, 0.0)
    inside = _zeros(*lax.stop_gradient((fall, rates, length)))
    start, end = piece_response(jnp.zeros_like(length)), piece_response(length)
    # a constant piece only decays; rounding may make its ends equal, but not their derivatives
    if len(terms.tau) == 1 and terms.direct is None:
        end = jnp.where(rise == 0.0, 0.0, end)
    return jnp.stack([start, end, *map(piece_response, inside)])


def _zeros(factor: Array, rate: Array, length: Array, bisections: int = 160) -> list[Array]:
    """Return the sign changes of sum_k factor[k] e^{-rate[k] s} in 0 < s < length, one fewer than terms (or an end).

    A sum of n exponentials has at most n - 1 zeros: its product with e^{rate[0] s} has a derivative of n - 1
    exponentials, and is monotone between two zeros of this derivative. A bracket that begins at 0 is bisected often
    enough to resolve an extreme that is far closer to 0 than to the end.
    """
    if len(rate) == 1:
        return []
    turns = _zeros(factor[1:] * (rate[0] - rate[1:])[:, None], rate[1:], length)
    slowest = jnp.min(rate)

    def positive(s: Array) -> Array:
        return jnp.sum(factor * jnp.exp(-(rate - slowest)[:, None] * s), axis=0) > 0.0

    def halve(_: int, bracket: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bracket
        middle = 0.5 * (low + high)
        same = positive(middle) == rising
        return jnp.where(same, middle, low), jnp.where(same, high, middle)

    zeros = []
    ends = [jnp.zeros_like(length), *turns, length]
    for low, high in itertools.pairwise(ends):
        rising = positive(low)
        zeros.append(lax.fori_loop(0, bisections, halve, (low, high))[0])
    return zeros
