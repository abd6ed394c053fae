"""A recorded drive without most of its noise, by which delays of a part of a time step are computed.

A response between two samples of a noisy V has less noise than at a sample, by up to a half of its variance, so that a
free delay is drawn there; and the slope of V, by which a delay is found, is partly noise. So a delay shifts the smooth
drive only, and the noise of V stays where it was recorded.
"""

from typing import Any

import numpy as np
from jax.typing import ArrayLike

from fitact.compiled import array_module

# fit of a parabola to nine samples, at the middle one (Savitzky and Golay, Anal. Chem. 36 (1964) 1627)
_WEIGHTS = np.array([-21.0, 14.0, 39.0, 54.0, 59.0, 54.0, 39.0, 14.0, -21.0]) / 231.0


def smooth_drive(V: Any, noise: ArrayLike, max_deviation: float = 4.0) -> Any:
    """Return V (..., samples) without most of its white noise, of sd `noise` (V).

    A sample that a parabola over nine samples misses by more than `max_deviation` sd, as at an edge, stays as it is.
    """
    xp, reach = array_module(V), len(_WEIGHTS) // 2
    padded = xp.pad(V, [(0, 0)] * (V.ndim - 1) + [(reach, reach)], mode="edge")
    count = V.shape[-1]
    smooth = sum(weight * padded[..., i : i + count] for i, weight in enumerate(_WEIGHTS))
    return xp.where(abs(V - smooth) < max_deviation * noise, smooth, V)
