"""Likelihood of the friction on a finger, recorded by a force sensor beside the electrical channels."""

import dataclasses
from typing import Self

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.likelihood.channel import ChannelInputs, ChannelLikelihood
from fitact.likelihood.compression import BASELINE_NAMES
from fitact.model.force import Geometry, electrostatic_force, friction
from fitact.model.force_sensor import ForceSensor, StepForce, square_over_steps

# of a friction channel, in the place of the decays of charges: state of the sensor at the first sample, and parts of
# the reading in proportion to V and dV/dt
_NUISANCES = ("ringing", "ringing_2", "crosstalk", "crosstalk_2")


class FrictionChannel(ChannelLikelihood):
    """Tangential force  mu (force_scale * electrostatic force + fN), eq. (2), through the dynamics of a sensor."""

    geometry: Geometry = eqx.field(kw_only=True)
    constants: dict[str, ArrayLike] = eqx.field(kw_only=True)  # values of `FRICTION_PARAMETERS`; a free one is replaced

    @classmethod
    def from_channel(cls, channel: ChannelLikelihood, geometry: Geometry, constants: dict[str, ArrayLike]) -> Self:
        """Return a channel with these samples and nuisances."""
        fields = {field.name: getattr(channel, field.name) for field in dataclasses.fields(channel)}
        return cls(**fields, geometry=geometry, constants=constants)

    @property
    def linear_names(self) -> tuple[str, ...]:
        return (*BASELINE_NAMES, *_NUISANCES)

    def _values(self, inputs: ChannelInputs) -> dict[str, ArrayLike]:
        return self.constants | (inputs.friction or {})

    def _sensor(self, inputs: ChannelInputs) -> ForceSensor | None:
        values = self._values(inputs)
        frequency = values.get("sensor_frequency")
        return None if frequency is None else ForceSensor(frequency, values.get("sensor_damping"))

    def reading(self, inputs: ChannelInputs, extra_delay: ArrayLike) -> Float[Array, " samples"]:
        """Return the reading of the sensor for the square of the voltage that generates the force, V^2."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(ChannelLikelihood)}
        fields |= {"channel": self.geometry.contact(inputs.circuit).channel, "phases": None}
        fields["time"] = self.time if self.phases is None else self.phases
        acting, alone, sensor = ChannelLikelihood(**fields), dataclasses.replace(inputs, gain=1.0), self._sensor(inputs)

        def voltage(delay: ArrayLike) -> Array:
            return acting.signal(alone, extra_delay + delay)

        def repeat(square: Array) -> Array:
            return square if self.phases is None else square[jnp.arange(self.time.size) % self.period]

        if sensor is None:
            return repeat(jnp.square(voltage(0.0)))
        squares = square_over_steps(voltage, self.time_step, follows_samples=self.follows_samples)
        return sensor.respond(StepForce(*map(repeat, squares)), self.time_step)

    def _response(self, inputs: ChannelInputs, extra_delay: ArrayLike) -> Float[Array, " samples"]:
        values, contact = self._values(inputs), self.geometry.contact(inputs.circuit)
        force = electrostatic_force(1.0 / inputs.drive_gain, contact) * self.reading(inputs, extra_delay)
        return inputs.gain * friction(values["force_scale"] * force, values["mu"], values["fN"])

    def linear_shapes(self, inputs: ChannelInputs) -> Float[Array, "4 samples"]:
        """Return the shapes of ringing (0 without a sensor) and cross-talk, each of height 1."""
        sensor, since = self._sensor(inputs), self.time - self.time[0]
        V = self.drive.value(self.drive_time(inputs.delay, inputs.clock))
        ringing = jnp.zeros((0, since.size)) if sensor is None else sensor.ringing(since)
        crosstalk = jnp.stack([V, jnp.gradient(V)])
        crosstalk = crosstalk / jnp.max(jnp.abs(crosstalk), axis=1, keepdims=True)
        return jnp.concatenate([jnp.pad(ringing, ((0, 2 - len(ringing)), (0, 0))), crosstalk])

    def delay_derivative(self, inputs: ChannelInputs) -> Float[Array, " samples"]:
        """Return 0: a delay is no optional nuisance of the friction."""
        return jnp.zeros_like(self.observed)
