"""Functions of time of the errors of instruments that are not gains."""

import numpy as np
from jaxtyping import Float

# of 9 Mohm and 12.2 pF of a 10x probe. Source: primidi.com, passive probes; Brüel & Kjær 2125A manual, p. 49
PROBE_TIME_CONSTANT = 110e-6  # s


def nonlinearity_shapes(signal: Float[np.ndarray, " samples"], fill: float = 0.8) -> Float[np.ndarray, "2 samples"]:
    """Return the even and the odd error of a signal (V or A) for a non-linearity of 1, relative to the range.

    The range is taken to be `fill`ed by the signal. The shapes are Legendre polynomials, i.e. beside offset and gain.
    """
    low, high = float(signal.min()), float(signal.max())
    size = (high - low) / fill
    x = (2.0 * signal - low - high) / (size or 1.0)
    return size * np.stack([0.5 * (3.0 * x**2 - 1.0), 0.5 * (5.0 * x**3 - 3.0 * x)])
