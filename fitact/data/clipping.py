"""Samples at a converter's or an amplifier's rail, which say no more than that the signal was beyond it."""

import numpy as np
from jaxtyping import Bool, Float


def clipping_mask(
    values: Float[np.ndarray, " samples"], *, min_run: int = 4, min_count_ratio: float = 8.0, margin: int = 2
) -> Bool[np.ndarray, " samples"]:
    """Which samples lie at a rail, or within `margin` samples of one that does.

    A rail is an extreme that repeats `min_run` times in a row, and `min_count_ratio` times as often as the level next
    to it; a rounded smooth peak does so 2.4 times at most. A signal of a few levels only, as an ideal square, has none;
    a drive whose tops are meant to be flat cannot be told from a clipped one.
    """
    railed = np.zeros(values.size, dtype=bool)
    for upward in (values, -values):
        is_extreme = upward == upward.max()
        others = upward[~is_extreme]
        if longest_run(is_extreme) >= min_run and others.size:
            railed |= is_extreme & (is_extreme.sum() > min_count_ratio * np.count_nonzero(others == others.max()))
    if not railed.any():
        return railed
    return np.convolve(railed, np.ones(2 * margin + 1), mode="same") > 0.5


def longest_run(mask: Bool[np.ndarray, " n"]) -> int:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return int(np.max(edges[1::2] - edges[::2], initial=0))
