"""The harmonic level: the steady state as a sum over the harmonics of a periodic drive.

Cheap where few harmonics matter, and the only level for a skin without time constants. The Fourier
coefficients come in closed form from the drive's straight pieces: with c_k = 1/T int V e^{-jkwt} dt,
a jump J at t adds J e^{-jkwt} / (jkwT), and a straight piece its rise times the mean of e^{-jkwt} over it.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Complex, Float

from fitact.errors import InputError
from fitact.model.circuit import Channel, Circuit
from fitact.model.drive import Drive, InterpolatedDrive, Multitone, Periodic, PiecewiseLinear, Sine


def harmonic_response(
    circuit: Circuit, drive: Drive, time: ArrayLike, harmonics: int, *, channel: Channel = "Vsc"
) -> Float[Array, "*shape"]:
    """The steady state of Vsc (V) or I (A) at `time` (s) from the first `harmonics` of a periodic drive, eq. (20).

    `harmonic_error` says what is left out. At a jump of the drive the sum tends to the mean of both sides
    and overshoots beside it (Gibbs), however many harmonics are taken.

    Raises:
        InputError: the drive has no period.
    """
    omega = angular_frequency(drive) * jnp.arange(1, harmonics + 1)
    return harmonic_sum(fourier_coefficients(drive, harmonics) * circuit.channel_gain(channel, omega), drive, time)


def harmonic_error(circuit: Circuit, drive: Drive, harmonics: int, *, channel: Channel = "Vsc") -> Float[Array, ""]:
    """The rms of all that `harmonic_response` leaves out, over that of the whole response.

    By Parseval: the harmonics left out are summed up to 64 times those kept (4096 at least), and what lies
    beyond is taken as a geometric series of octaves from the last two.

    Raises:
        InputError: the drive has no period.
    """
    last = max(64 * harmonics, 4096)
    omega = angular_frequency(drive) * jnp.arange(1, last + 1)
    amplitude = fourier_coefficients(drive, last) * circuit.channel_gain(channel, omega)
    power = amplitude.real**2 + amplitude.imag**2
    octave, before = jnp.sum(power[last // 2 :]), jnp.sum(power[last // 4 : last // 2])
    # a bounded response to jumps, the slowest there is, loses half of its power from octave to octave
    ratio = jnp.minimum(octave / jnp.where(before > 0.0, before, 1.0), 0.5)
    left_out = jnp.sum(power[harmonics:]) + octave * ratio / (1.0 - ratio)
    share = left_out / (jnp.sum(power[:harmonics]) + left_out)
    return jnp.where(share > 0.0, jnp.sqrt(jnp.where(share > 0.0, share, 1.0)), 0.0)


def harmonic_sum(amplitude: Complex[Array, " harmonics"], drive: Drive, time: ArrayLike) -> Float[Array, "*shape"]:
    """2 Re sum_k amplitude[k - 1] e^{jkwt}, one harmonic at a time: the memory does not grow with them."""
    cycles = _cycles(drive, jnp.asarray(time, dtype=float))

    @jax.checkpoint
    def add(total: Array, step: tuple[Array, Array]) -> tuple[Array, None]:
        k, c = step
        angle = 2.0 * np.pi * jnp.mod(k * cycles, 1.0)
        return total + 2.0 * (c.real * jnp.cos(angle) - c.imag * jnp.sin(angle)), None

    order = jnp.arange(1, amplitude.size + 1, dtype=cycles.dtype)
    return lax.scan(add, jnp.zeros_like(cycles), (order, amplitude))[0]


def fourier_coefficients(drive: Drive, harmonics: int) -> Complex[Array, " harmonics"]:
    """c_k (V) for k = 1 to `harmonics`: the drive is its mean plus 2 Re sum_k c_k e^{jkwt}."""
    order = jnp.arange(1, harmonics + 1, dtype=float)
    if isinstance(drive, Sine):
        return jnp.where(order == 1.0, -0.25j * jnp.asarray(drive.peak_to_peak), 0.0)
    if isinstance(drive, Multitone):
        kept = np.flatnonzero(np.asarray(drive.orders) <= harmonics)
        places = np.asarray(drive.orders)[kept] - 1
        return jnp.zeros(harmonics, dtype=complex).at[places].set(-0.5j * drive.phasors()[kept])
    drive_frequency(drive)  # raises where there is none
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


def angular_frequency(drive: Drive) -> Array:
    """The angular frequency w of the drive's period, rad/s."""
    return 2.0 * np.pi * jnp.asarray(drive_frequency(drive), dtype=float)


def drive_frequency(drive: Drive) -> ArrayLike:
    """How often the drive repeats, Hz; raises where it does not."""
    if isinstance(drive, Periodic):
        return drive.frequency
    if isinstance(drive, InterpolatedDrive) and drive.period is not None:
        return 1.0 / drive.period
    raise InputError(
        f"a {type(drive).__name__} drive does not repeat, so it has no harmonics; give one of points its period"
    )


def _cycles(drive: Drive, time: Array) -> Array:
    """Cycles since the last start of a period, in [0, 1): their product with k keeps its digits."""
    if isinstance(drive, InterpolatedDrive):
        return jnp.mod((time - drive.start_time) / drive.period, 1.0)
    assert isinstance(drive, Periodic)
    return drive.cycle(time)[0]


def _phase_factor(cycles: Array) -> Array:
    angle = 2.0 * np.pi * jnp.mod(cycles, 1.0)
    return lax.complex(jnp.cos(angle), -jnp.sin(angle))
