"""Samples at a converter's or an amplifier's rail, which say no more than that the signal was beyond it."""

import numpy as np
from jaxtyping import Bool, Float

_LONG = 4  # samples in a row at an extreme, from which it may be a rail
_FLAT = 8.0  # times as many samples there as on the level next to it; a rounded smooth peak has at most 2.4
_BESIDE = 2  # samples to either side of a clipped stretch that are not believed either


def clipped(values: Float[np.ndarray, " samples"]) -> Bool[np.ndarray, " samples"]:
    """Which samples lie at a rail, or within two samples of one that does.

    A rail is an extreme that repeats in a row, much more often than the level next to it. A signal of a few levels
    only, as an ideal square, has none; a drive whose tops are meant to be flat cannot be told from a clipped one.
    """
    railed = np.zeros(values.size, dtype=bool)
    for extreme, beyond in ((values.max(), values < values.max()), (values.min(), values > values.min())):
        at = values == extreme
        if longest_run(at) < _LONG or not beyond.any():
            continue
        next_level = values[beyond].max() if extreme == values.max() else values[beyond].min()
        if np.count_nonzero(at) > _FLAT * np.count_nonzero(values == next_level):
            railed |= at
    if not railed.any():
        return railed
    return np.convolve(railed, np.ones(2 * _BESIDE + 1), mode="same") > 0.5


def longest_run(inside: Bool[np.ndarray, " n"]) -> int:
    """The most true values in a row."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], inside.astype(int), [0]])))
    return int(np.max(edges[1::2] - edges[::2], initial=0))
