"""Force sensor of a tribometer: a first-order low-pass, or a load cell with a resonance."""

import math
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

STEP_PARTS = 8  # of a time step, over which the force of a stated drive is averaged


class StepForce(NamedTuple):
    """Force over each time step: its mean, and by how much it rises; it counts as a straight line between."""

    mean: Float[Array, " samples"]
    rise: Float[Array, " samples"]


class ForceSensor(eqx.Module):
    """Sensor with gain 1 at low frequency, exact for a force that is a straight line over each time step.

    Attributes:
        frequency: natural frequency, or the corner frequency of a first-order low-pass, Hz.
        damping: damping ratio, between 0 and 1; None means a first-order low-pass.
    """

    frequency: ArrayLike
    damping: ArrayLike | None = None

    def respond(self, force: StepForce, time_step: ArrayLike) -> Float[Array, " samples"]:
        """Return the reading (N) at the end of each time step (s) for the `force` over each step.

        The force counts as periodic. A sensor that was in another state before the first sample adds a combination of
        `ringing`. A damping of 1 or more gives NaN.
        """
        size = force.mean.shape[-1]
        q = jnp.exp(-2j * math.pi * jnp.arange(size // 2 + 1) / size)  # delay by one step, at each frequency of the FFT
        level, ramp = self._step_gains(q, time_step)
        lines = (level * jnp.fft.rfft(force.mean)) + (ramp - 0.5 * level) * jnp.fft.rfft(force.rise)
        return jnp.fft.irfft(lines, size)

    def _step_gains(self, q: Array, time_step: ArrayLike) -> tuple[Array, Array]:
        """Return the gains for a force of 1 over a step, and for one that rises from 0 to 1 over a step.

        They follow from the z-transforms of the sensor's responses to a step and to a ramp, whose decaying parts are
        (1 + step q) / decay and (lag + ramp q) / decay.
        """
        angle = 2.0 * math.pi * jnp.asarray(self.frequency) * time_step
        if self.damping is None:
            lag, step, ramp, decay = 1.0 / angle, 0.0, 0.0, 1.0 - jnp.exp(-angle) * q
        else:
            fall, root, turn = (
                jnp.exp(-self.damping * angle),
                jnp.sqrt(1.0 - jnp.square(self.damping)),
                self._turn(angle),
            )
            cosine, sine = fall * jnp.cos(turn), fall * jnp.sin(turn) / root
            lag = 2.0 * self.damping / angle
            step = self.damping * sine - cosine
            ramp = (2.0 * jnp.square(self.damping) - 1.0) / angle * sine - lag * cosine
            decay = 1.0 - 2.0 * cosine * q + jnp.square(fall * q)
        level = (1.0 - (1.0 - q) * (1.0 + step * q) / decay) / q
        return level, ((1.0 - q) * (lag + ramp * q) / q + 1.0 + step * q) / decay - lag / q

    def _turn(self, angle: Array) -> Array:
        """Return the angle by which the free oscillation turns; NaN for a damping of 1 or more."""
        assert self.damping is not None
        return angle * jnp.sqrt(1.0 - jnp.square(self.damping))

    def ringing(self, since: Float[Array, " samples"]) -> Float[Array, "shapes samples"]:
        """Return how a state of the sensor decays after the times `since` (s): one shape, or two of a resonance."""
        angle = 2.0 * math.pi * jnp.asarray(self.frequency) * since
        if self.damping is None:
            return jnp.exp(-angle)[None]
        turn = self._turn(angle)
        return jnp.exp(-self.damping * angle) * jnp.stack([jnp.cos(turn), jnp.sin(turn)])


def square_over_steps(
    voltage: Callable[[ArrayLike], Float[Array, " samples"]], time_step: ArrayLike, *, follows_samples: bool = False
) -> StepForce:
    """Return the square (V^2) of a voltage over the time step (s) before each sample.

    `voltage` returns the voltage (V) a time (s) before the samples. With `follows_samples`, it is linear between them,
    as for a measured drive; the first sample then counts the last as the one before it.
    """
    if follows_samples:
        end = voltage(0.0)
        begin = jnp.roll(end, 1)
        return StepForce((begin * begin + begin * end + end * end) / 3.0, end * end - begin * begin)
    place = (jnp.arange(STEP_PARTS) + 0.5) / STEP_PARTS - 0.5  # of the parts' middles, from the middle of a step
    squares = jax.lax.map(lambda part: jnp.square(voltage((0.5 - part) * time_step)), place)
    return StepForce(jnp.mean(squares, axis=0), place @ squares / jnp.sum(jnp.square(place)))
