"""Force sensor of a tribometer: a first-order low-pass, or a load cell with a resonance."""

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

STEP_PARTS = 8  # of a time step, over which the force of a stated drive is averaged


class ForceSensor(eqx.Module):
    """Sensor with gain 1 at low frequency, exact for a force that is constant over each time step.

    Attributes:
        frequency: natural frequency, or the corner frequency of a first-order low-pass, Hz.
        damping: damping ratio, between 0 and 1; None means a first-order low-pass.
    """

    frequency: ArrayLike
    damping: ArrayLike | None = None

    def respond(self, force: Float[Array, " samples"], time_step: ArrayLike) -> Float[Array, " samples"]:
        """Return the reading (N) at the end of each time step (s) for the mean force (N) over each step.

        The force counts as periodic. A sensor that was in another state before the first sample adds a combination of
        `ringing`.
        """
        size = force.shape[-1]
        delay = jnp.exp(-2j * math.pi * jnp.arange(size // 2 + 1) / size)  # by one step, at each frequency of the FFT
        return jnp.fft.irfft(jnp.fft.rfft(force) * self._step_gain(delay, time_step), size)

    def _step_gain(self, delay: Array, time_step: ArrayLike) -> Array:
        """Return the gain of the sensor, sampled with a zero-order hold."""
        angle = 2.0 * math.pi * jnp.asarray(self.frequency) * time_step
        if self.damping is None:
            return -jnp.expm1(-angle) / (1.0 - jnp.exp(-angle) * delay)
        fall = jnp.exp(-self.damping * angle)
        turn, root = self._turn(angle), jnp.sqrt(1.0 - jnp.square(self.damping))
        cosine, sine = jnp.cos(turn), self.damping / root * jnp.sin(turn)
        first, second = 1.0 - fall * (cosine + sine), fall * (fall + sine - cosine)
        return (first + second * delay) / (1.0 - 2.0 * fall * cosine * delay + jnp.square(fall * delay))

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


def mean_square_over_step(
    voltage: Callable[[ArrayLike], Float[Array, " samples"]], time_step: ArrayLike, *, follows_samples: bool = False
) -> Float[Array, " samples"]:
    """Return the mean square (V^2) of a voltage over the time step (s) before each sample.

    `voltage` returns the voltage (V) a time (s) before the samples. With `follows_samples`, it is linear between them,
    as for a measured drive; the first sample then counts the last as the one before it.
    """
    if follows_samples:
        end = voltage(0.0)
        begin = jnp.roll(end, 1)
        return (begin * begin + begin * end + end * end) / 3.0
    parts = (jnp.arange(STEP_PARTS) + 0.5) / STEP_PARTS * time_step
    return jnp.mean(jax.lax.map(lambda part: jnp.square(voltage(part)), parts), axis=0)
