"""Steady state as a sum over the harmonics of a periodic drive.

The sum is cheap if few harmonics matter, and the only method for a skin without time constants. The Fourier
coefficients c_k = 1/T int V e^{-jkwt} dt of linear pieces have a closed form. A jump J at t adds
J e^{-jkwt} / (jkwT). A piece adds (its rise) x (the mean of e^{-jkwt} over it) / (jkwT).
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Complex, Float

from fitact.compiled import jit_inline
from fitact.errors import InputError
from fitact.model.circuit import Channel, Circuit, passes_direct_current
from fitact.model.drive import Drive, InterpolatedDrive, Multitone, Periodic, PiecewiseLinear, Sine


def harmonic_response(
    circuit: Circuit, drive: Drive, time: ArrayLike, harmonics: int, *, channel: Channel = "Vsc"
) -> Float[Array, "*shape"]:
    """Return the steady state of Vsc (V) or I (A) at `time` (s), summed over the first `harmonics`, eq. (20).

    `harmonic_error` gives the truncation error. At a jump of the drive the sum converges to the mean of both sides,
    and it overshoots near the jump for any number of harmonics (Gibbs phenomenon).

    Raises:
        InputError: the drive is not periodic.
    """
    omega = angular_frequency(drive) * jnp.arange(1, harmonics + 1)
    amplitude = fourier_coefficients(drive, harmonics) * circuit.channel_gain(channel, omega)
    return mean_response(circuit, drive, channel) + harmonic_sum(amplitude, drive, time)


def harmonic_error(circuit: Circuit, drive: Drive, harmonics: int, *, channel: Channel = "Vsc") -> Float[Array, ""]:
    """Return the rms of the harmonics that `harmonic_response` omits, over the rms of the whole response.

    The powers of the omitted harmonics are summed (Parseval) up to 64 times the number kept (at least 4096). The
    sum beyond is extrapolated as a geometric series from the last two octaves.

    Raises:
        InputError: the drive is not periodic.
    """
    last = max(64 * harmonics, 4096)
    omega = angular_frequency(drive) * jnp.arange(1, last + 1)
    amplitude = fourier_coefficients(drive, last) * circuit.channel_gain(channel, omega)
    power = amplitude.real**2 + amplitude.imag**2
    octave, before = jnp.sum(power[last // 2 :]), jnp.sum(power[last // 4 : last // 2])
    # the response to jumps converges most slowly, and loses half of its power per octave
    ratio = jnp.minimum(octave / jnp.where(before > 0.0, before, 1.0), 0.5)
    left_out = jnp.sum(power[harmonics:]) + octave * ratio / (1.0 - ratio)
    mean_power = 0.5 * jnp.square(mean_response(circuit, drive, channel))
    share = left_out / (mean_power + jnp.sum(power[:harmonics]) + left_out)
    return jnp.where(share > 0.0, jnp.sqrt(jnp.where(share > 0.0, share, 1.0)), 0.0)


@jit_inline
def harmonic_sum(amplitude: Complex[Array, " harmonics"], drive: Drive, time: ArrayLike) -> Float[Array, "*shape"]:
    """Return 2 Re sum_k amplitude[k - 1] e^{jkwt}, one harmonic at a time to save memory."""
    cycles = _cycles(drive, jnp.asarray(time, dtype=float))

    @jax.checkpoint
    def add(total: Array, step: tuple[Array, Array]) -> tuple[Array, None]:
        k, c = step
        angle = 2.0 * np.pi * jnp.mod(k * cycles, 1.0)
        return total + 2.0 * (c.real * jnp.cos(angle) - c.imag * jnp.sin(angle)), None

    order = jnp.arange(1, amplitude.size + 1, dtype=cycles.dtype)
    return lax.scan(add, jnp.zeros_like(cycles), (order, amplitude))[0]


@partial(jit_inline, static_argnames="harmonics")
def fourier_coefficients(drive: Drive, harmonics: int) -> Complex[Array, " harmonics"]:
    """Return c_k (V) for k = 1 to `harmonics`, where the drive is its mean plus 2 Re sum_k c_k e^{jkwt}."""
    order = jnp.arange(1, harmonics + 1, dtype=float)
    if isinstance(drive, Sine):
        return jnp.where(order == 1.0, -0.25j * jnp.asarray(drive.peak_to_peak), 0.0)
    if isinstance(drive, Multitone):
        kept = np.flatnonzero(np.asarray(drive.orders) <= harmonics)
        places = np.asarray(drive.orders)[kept] - 1
        return jnp.zeros(harmonics, dtype=complex).at[places].set(-0.5j * drive.phasors()[kept])
    drive_frequency(drive)  # raises if the drive is not periodic
    assert isinstance(drive, PiecewiseLinear | InterpolatedDrive)
    knots, start, end = drive.pieces()
    period = knots[-1] - knots[0]
    at, middle = (knots[:-1] - knots[0]) / period, (0.5 * (knots[1:] + knots[:-1]) - knots[0]) / period
    jump, rise, length = start - jnp.roll(end, 1), end - start, jnp.diff(knots) / period

    def coefficient(k: Array) -> Array:
        jumps = jnp.sum(jump * _phase_factor(k * at))
        rises = jnp.sum(rise * jnp.sinc(k * length) * _phase_factor(k * middle))
        return (jumps + rises) / (2j * np.pi * k)

    return lax.map(coefficient, order)


def mean_voltage(drive: Drive) -> Array:
    """Return the mean of a periodic drive over its period, V."""
    if isinstance(drive, Sine | Multitone):
        return jnp.asarray(drive.offset, dtype=float)
    drive_frequency(drive)  # raises if the drive is not periodic
    assert isinstance(drive, PiecewiseLinear | InterpolatedDrive)
    knots, start, end = drive.pieces()
    return jnp.sum(0.5 * (start + end) * jnp.diff(knots)) / (knots[-1] - knots[0])


def mean_response(circuit: Circuit, drive: Drive, channel: Channel) -> Array:
    """Return the mean over a period, in the channel's unit; 0 unless the insulator has a leak."""
    if not passes_direct_current(circuit):
        return jnp.zeros(())
    return circuit.channel_gain(channel, 0.0).real * mean_voltage(drive)


def angular_frequency(drive: Drive) -> Array:
    """Return the angular frequency w of the drive's period, rad/s."""
    return 2.0 * np.pi * jnp.asarray(drive_frequency(drive), dtype=float)


def drive_frequency(drive: Drive) -> ArrayLike:
    """Return the repetition frequency of the drive, Hz, or raise InputError if it is not periodic."""
    if isinstance(drive, Periodic):
        return drive.frequency
    if isinstance(drive, InterpolatedDrive) and drive.period is not None:
        return 1.0 / drive.period
    raise InputError(
        f"a {type(drive).__name__} drive is not periodic, so it has no harmonics; give a drive of points a period"
    )


def _cycles(drive: Drive, time: Array) -> Array:
    """Return the cycles since the last start of a period, in [0, 1), so that multiples of them keep their digits."""
    if isinstance(drive, InterpolatedDrive):
        return jnp.mod((time - drive.start_time) / drive.period, 1.0)
    assert isinstance(drive, Periodic)
    return drive.cycle(time)[0]


def _phase_factor(cycles: Array) -> Array:
    angle = 2.0 * np.pi * jnp.mod(cycles, 1.0)
    return lax.complex(jnp.cos(angle), -jnp.sin(angle))
