"""Friction on a finger as a channel, recorded by a force sensor beside the electrical channels."""

import dataclasses
from typing import Self

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.likelihood.compression import BASELINE_NAMES
from fitact.likelihood.observable import ChannelInputs, DriveTiming, ElectricalSignal, Observable
from fitact.likelihood.padded_samples import PaddedSamples
from fitact.model.circuit import Channel
from fitact.model.force import Geometry, electrostatic_force, friction
from fitact.model.force_sensor import ForceSensor, StepForce, square_over_steps

# of the friction, in the place of the decays of charges: state of the sensor at the first sample, and parts of the
# reading in proportion to V and dV/dt
_NUISANCES = ("ringing", "ringing_2", "crosstalk", "crosstalk_2")


class FrictionObservable(Observable):
    """Tangential force  mu (force_scale * electrostatic force + fN), eq. (2), through the dynamics of a sensor."""

    voltage: ElectricalSignal  # that generates the force
    geometry: Geometry
    constants: dict[str, ArrayLike]  # values of `FRICTION_PARAMETERS`; a free one is replaced

    @property
    def channel(self) -> Channel:
        return "Ft"

    @property
    def timing(self) -> DriveTiming:
        return self.voltage.timing

    @property
    def electrical(self) -> ElectricalSignal:
        return self.voltage

    @property
    def linear_names(self) -> tuple[str, ...]:
        return (*BASELINE_NAMES, *_NUISANCES)

    @property
    def follows_samples(self) -> bool:
        return self.voltage.follows_samples

    def keep_ends(self) -> Self:
        return dataclasses.replace(self, voltage=self.voltage.keep_ends())

    def _values(self, inputs: ChannelInputs) -> dict[str, ArrayLike]:
        return self.constants | (inputs.friction or {})

    def _sensor(self, inputs: ChannelInputs) -> ForceSensor | None:
        values = self._values(inputs)
        frequency = values.get("sensor_frequency")
        return None if frequency is None else ForceSensor(frequency, values.get("sensor_damping"))

    def reading(
        self, samples: PaddedSamples, inputs: ChannelInputs, extra_delay: ArrayLike = 0.0
    ) -> Float[Array, " samples"]:
        """Return the reading of the sensor for the square of the voltage that generates the force, V^2."""
        first, alone = samples.first_period(), dataclasses.replace(inputs, gain=1.0)
        sensor, step = self._sensor(inputs), self.timing.step

        def voltage(delay: ArrayLike) -> Array:
            return self.voltage.response(first, alone, extra_delay + delay)

        if sensor is None:
            return samples.repeat(jnp.square(voltage(0.0)))
        squares = square_over_steps(voltage, step, follows_samples=self.follows_samples)
        return sensor.respond(StepForce(*map(samples.repeat, squares)), step)

    def response(
        self, samples: PaddedSamples, inputs: ChannelInputs, extra_delay: ArrayLike = 0.0
    ) -> Float[Array, " samples"]:
        values, contact = self._values(inputs), self.geometry.contact(inputs.circuit)
        force = electrostatic_force(1.0 / inputs.drive_gain, contact) * self.reading(samples, inputs, extra_delay)
        return inputs.gain * friction(values["force_scale"] * force, values["mu"], values["fN"])

    def linear_shapes(self, samples: PaddedSamples, inputs: ChannelInputs) -> Float[Array, "4 samples"]:
        """Return the shapes of ringing (0 without a sensor) and cross-talk, each of height 1."""
        sensor, since = self._sensor(inputs), samples.time - samples.time[0]
        V = self.voltage.drive.value(self.timing.drive_time(samples.time, inputs.delay, inputs.clock))
        ringing = jnp.zeros((0, since.size)) if sensor is None else sensor.ringing(since)
        crosstalk = jnp.stack([V, jnp.gradient(V)])
        crosstalk = crosstalk / jnp.max(jnp.abs(crosstalk), axis=1, keepdims=True)
        return jnp.concatenate([jnp.pad(ringing, ((0, 2 - len(ringing)), (0, 0))), crosstalk])
