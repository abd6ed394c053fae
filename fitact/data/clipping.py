"""Clipped samples, where an ADC or an amplifier was saturated, so that only a bound on the signal is known."""

import numpy as np
from jaxtyping import Bool, Float


def clipping_mask(values: Float[np.ndarray, " samples"]) -> Bool[np.ndarray, " samples"]:
    """Return a mask of the samples in saturation, or within `margin` samples of saturation.

    A saturation level is an extreme value that occurs `min_run` times in a row, and `min_count_ratio` times as often
    as the adjacent level; at a rounded smooth peak this ratio is at most 2.4. A signal that `has_flat_levels` has no
    saturation level. Another drive with flat tops cannot be distinguished from a clipped one.
    """
    min_run, min_count_ratio, margin = 4, 8.0, 2
    railed = np.zeros(values.size, dtype=bool)
    for upward in (values, -values):
        is_extreme = upward == upward.max()
        count = np.count_nonzero(is_extreme)
        if min_run <= count < values.size and longest_run(is_extreme) >= min_run:
            others = upward[~is_extreme]
            railed |= is_extreme & (count > min_count_ratio * np.count_nonzero(others == others.max()))
    if not railed.any() or has_flat_levels(values):
        return np.zeros(values.size, dtype=bool)
    return np.convolve(railed, np.ones(2 * margin + 1), mode="same") > 0.5


def replace_codes(values: Float[np.ndarray, " samples"], code: float = 9e36, min_count: int = 9) -> None:
    """Replace an oscilloscope's codes for values out of range by the largest value within it, in place.

    As many of them, some in a row, count as clipped then (`clipping_mask`); few remain, and a record refuses them.
    Codes are infinite, or at least `code` in size.
    """
    if values.min(initial=0.0) > -code and values.max(initial=0.0) < code:
        return
    for sign in (1.0, -1.0):
        beyond = sign * values >= code
        within = np.abs(values) < code
        if np.count_nonzero(beyond) >= min_count and longest_run(beyond) >= 4 and within.any():
            values[beyond] = sign * np.max(sign * values[within])


def has_flat_levels(values: Float[np.ndarray, " samples"], max_levels: int = 6, min_fraction: float = 0.95) -> bool:
    """Return whether nearly all samples have one of a few values, as of a square without noise or rounded above it.

    Three plateaus, each on the edge of two levels of an ADC, have six values. A clipped signal has its noise, or its
    way to the rail, in more than the other samples.
    """
    _, counts = np.unique(values, return_counts=True)
    return bool(np.sum(np.sort(counts)[-max_levels:]) >= min_fraction * values.size)


def describe_clipping(channel: str, clipped: Bool[np.ndarray, " samples"]) -> str:
    """Return the sentence on the samples of a channel in a `clipping_mask`, which are excluded."""
    return (
        f"{channel} is clipped: {np.count_nonzero(clipped):,} of {clipped.size:,} samples (at an extreme, or within two"
        " samples of one) are excluded; record with a wider range"
    )


def longest_run(mask: Bool[np.ndarray, " n"]) -> int:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return int(np.max(edges[1::2] - edges[::2], initial=0))
