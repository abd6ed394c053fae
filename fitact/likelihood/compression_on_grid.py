"""Projection of a record on the responses of a fixed grid of time constants, for circuits that have such a grid."""

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from fitact.likelihood.compression import Compression
from fitact.model.circuit import HighpassTerms


class GridCompression(Compression):
    """A record in coordinates of the responses of a grid, which are the columns of `signal`.

    The model is linear in the weights of the grid. `slope` is the derivative of the signal with respect to a delay.
    """

    def covers(self, tau: Array, delay: ArrayLike = 0.0) -> Bool[Array, "*shape"]:
        """Return True, since the grid belongs to the circuit."""
        return np.ones(np.shape(tau), dtype=bool)

    def response(self, terms: HighpassTerms, delay: ArrayLike = 0.0) -> Float[Array, " rows"]:
        """Return the response of a circuit, undelayed; compare `fitact.response`."""
        if terms.direct is not None:
            raise TypeError("a compression on a grid holds no V, which a leak of the insulator needs")
        total = self.signal @ jnp.asarray(terms.weight)
        total = jnp.pad(total, (0, self.observed.size - total.size))
        return total if terms.rate is None else total + terms.rate * self.rate
