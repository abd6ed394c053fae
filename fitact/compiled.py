"""Records filled up to one of a few lengths, since JAX compiles for every length anew.

The last sample is repeated, with a weight of 0: times still never decrease, a drive stays where it ended, and the ends,
the least and the largest of a record remain its own.
"""

from typing import Any

import numpy as np

_AN_OCTAVE = 8  # lengths: an eighth is the most that is added
_LEAST = 64  # samples between lengths: below, some more cost nothing
LONGEST = 1_048_576  # samples, above which a fit takes longer than compiling


def padded_length(samples: int) -> int:
    """The length that a record of so many samples is filled up to."""
    if samples > LONGEST:
        return samples
    step = max((1 << (samples - 1).bit_length()) // (2 * _AN_OCTAVE), _LEAST)
    return -(-samples // step) * step


def padded(values: np.ndarray, samples: int | None = None) -> np.ndarray:
    """One value a sample, the last one repeated; `samples`: how many the record has of which these are the first."""
    return _padded(values, samples or values.shape[-1], mode="edge")


def padded_weight(weight: np.ndarray, samples: int | None = None) -> np.ndarray:
    """The weights of samples, with 0 for what is added."""
    return _padded(weight, samples or weight.size, mode="constant")


def _padded(values: np.ndarray, samples: int, **how: Any) -> np.ndarray:
    missing = padded_length(samples) - values.shape[-1]
    return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, missing)], **how) if missing else values
