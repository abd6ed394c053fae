"""Functions of time of the errors of instruments that are not gains."""

import numpy as np
from jaxtyping import Float

# of 9 Mohm and 12.2 pF of a 10x probe. Source: primidi.com, passive probes; Brüel & Kjær 2125A manual, p. 49
PROBE_TIME_CONSTANT = 110e-6  # s
INPUT_RANGE = 1.25  # assumed range of an input, relative to its signal


def nonlinearity_shapes(signal: Float[np.ndarray, " samples"]) -> Float[np.ndarray, "2 samples"]:
    """Return the even and the odd error of a signal (V or A) for a non-linearity of 1, relative to the range.

    The shapes are Legendre polynomials, i.e. beside offset and gain.
    """
    size, x = _range_and_place(signal)
    return size * np.stack([0.5 * (3.0 * x**2 - 1.0), 0.5 * (5.0 * x**3 - 3.0 * x)])


def nonlinearity_slopes(signal: Float[np.ndarray, " samples"]) -> Float[np.ndarray, "2 samples"]:
    """Return the derivatives of `nonlinearity_shapes` in the signal."""
    _, x = _range_and_place(signal)
    return 2.0 * np.stack([3.0 * x, 0.5 * (15.0 * x**2 - 3.0)])


def _range_and_place(signal: Float[np.ndarray, " samples"]) -> tuple[float, Float[np.ndarray, " samples"]]:
    """Return the range of an input (V or A), and the place of the signal in it from -1 to 1."""
    low, high = float(signal.min()), float(signal.max())
    size = INPUT_RANGE * (high - low)
    return size, (2.0 * signal - low - high) / (size or 1.0)
