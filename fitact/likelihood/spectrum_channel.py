"""Likelihood of a spectrum: the response of a circuit at single frequencies, as one channel."""

import dataclasses
from typing import cast

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Complex, Float

from fitact.compiled import pad_weight
from fitact.instrument.effects import PROBE_TIME_CONSTANT
from fitact.likelihood.channel import ChannelInputs, ChannelLikelihood
from fitact.model.circuit import Circuit
from fitact.model.skin import with_probe


class SpectrumChannel(ChannelLikelihood):
    """Impedance V / I (ohm), or gain Vsc / V, at single frequencies; its samples are real and imaginary parts in turn.

    The noise of both parts has the same standard deviation, sigma over the weight: sigma is the noise relative to the
    magnitude where the weight is one over the magnitude. Offset, drift, hum and clock do not exist.
    """

    omega: Float[Array, " points"] = eqx.field(kw_only=True)  # rad/s, one for two (padded) samples

    @property
    def is_impedance(self) -> bool:
        """Whether the response is V / I, and not Vsc / V."""
        return self.letter == "Z"

    def response(self, inputs: ChannelInputs) -> Complex[Array, " points"]:
        """Return the modelled response without effects of instruments; a probe loads the skin only where Vsc is."""
        if self.is_impedance:
            return inputs.gain / cast(Circuit, with_probe(inputs.circuit, None)).admittance(self.omega)
        return inputs.gain * inputs.circuit.transfer_function(self.omega) * jnp.exp(-1j * self.omega * inputs.delay)

    def _response(self, inputs: ChannelInputs, extra_delay: ArrayLike) -> Float[Array, " samples"]:
        return split_complex(self.response(inputs))

    def delay_derivative(self, inputs: ChannelInputs) -> Float[Array, " samples"]:
        """Return 0: a delay is no optional nuisance of a spectrum."""
        return jnp.zeros_like(self.observed)

    def with_compensation(self, inputs: ChannelInputs) -> "SpectrumChannel":
        """Return the channel with the effect of an error of 1 in the high-frequency gain of its instruments."""
        x = 1j * self.omega * PROBE_TIME_CONSTANT
        return dataclasses.replace(self, effects=split_complex(self.response(inputs) * x / (1.0 + x))[None])

    def with_noise_sd(self, sd: Float[np.ndarray, " points"]) -> "SpectrumChannel":
        """Return the channel with weights for noise in proportion to `sd`, in the unit of the response."""
        return dataclasses.replace(self, weight=pad_weight(np.repeat(1.0 / sd, 2)))


def split_complex(values: Complex[Array, " points"]) -> Float[Array, " samples"]:
    """Return real and imaginary parts in turn."""
    return jnp.stack([values.real, values.imag], axis=-1).reshape(-1)


def join_complex(parts: Float[np.ndarray, "*n samples"]) -> Complex[np.ndarray, "*n points"]:
    """Return the complex values whose real and imaginary parts are given in turn."""
    return parts[..., ::2] + 1j * parts[..., 1::2]
