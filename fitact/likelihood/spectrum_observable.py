"""Spectrum as a channel: the response of a circuit at single frequencies."""

from typing import cast

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Complex, Float

from fitact.instrument.effects import PROBE_TIME_CONSTANT
from fitact.likelihood.observable import ChannelInputs, DriveTiming, Observable
from fitact.likelihood.padded_samples import PaddedSamples
from fitact.model.circuit import Channel, Circuit
from fitact.model.skin import with_probe


class SpectrumObservable(Observable):
    """Impedance V / I (ohm), or gain Vsc / V, at single frequencies; its samples are real and imaginary parts in turn.

    The noise of both parts has the same standard deviation, sigma over the weight: sigma is the noise relative to the
    magnitude where the weight is one over the magnitude. Offset, drift, hum and clock do not exist.
    """

    omega: Float[Array, " points"]  # rad/s, one for two (padded) samples
    timing: DriveTiming
    channel: Channel = eqx.field(static=True)  # "impedance" or "gain"

    @property
    def is_impedance(self) -> bool:
        """Whether the response is V / I, and not Vsc / V."""
        return self.channel == "impedance"

    def respond(self, inputs: ChannelInputs) -> Complex[Array, " points"]:
        """Return the modelled response without effects of instruments; a probe loads the skin only where Vsc is."""
        if self.is_impedance:
            return inputs.gain / cast(Circuit, with_probe(inputs.circuit, None)).admittance(self.omega)
        return inputs.gain * inputs.circuit.transfer_function(self.omega) * jnp.exp(-1j * self.omega * inputs.delay)

    def response(
        self, samples: PaddedSamples, inputs: ChannelInputs, extra_delay: ArrayLike = 0.0
    ) -> Float[Array, " samples"]:
        return split_complex(self.respond(inputs))

    def compensation_effect(self, inputs: ChannelInputs) -> Float[Array, "1 samples"]:
        """Return the effect of an error of 1 in the high-frequency gain of the instruments."""
        x = 1j * self.omega * PROBE_TIME_CONSTANT
        return split_complex(self.respond(inputs) * x / (1.0 + x))[None]


def split_complex(values: Complex[Array, " points"]) -> Float[Array, " samples"]:
    """Return real and imaginary parts in turn."""
    return jnp.stack([values.real, values.imag], axis=-1).reshape(-1)


def join_complex(parts: Float[np.ndarray, "*n samples"]) -> Complex[np.ndarray, "*n points"]:
    """Return the complex values whose real and imaginary parts are given in turn."""
    return parts[..., ::2] + 1j * parts[..., 1::2]
