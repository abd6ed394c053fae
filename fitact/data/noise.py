"""Noise and rounding of a channel, estimated from its samples without a model."""

import math

import numpy as np
import scipy
from jaxtyping import Float


def estimate_noise(
    values: Float[np.ndarray, " samples"], block: int = 16, max_ratio: float = 0.7, min_lines: int = 50
) -> float:
    """Return the sd of white noise and rounding: that of sixth differences, or of the highest frequencies if far lower.

    Fast smooth signals hardly change the second, which is less accurate, and needs `min_lines` of a spectrum. Blocks
    with edges, above 2.5 times the median, are left out, and the mean square within a block counts rounding, with which
    a median of differences takes few values.
    """
    squares = np.diff(values, 6) ** 2 / 924.0
    means = squares[: squares.size // block * block].reshape(-1, block).mean(axis=1)
    # mean square of white noise in blocks of 16 up to 2.5 times their median, over that of all, from simulations
    kept = means[means <= 2.5 * np.median(means)] if means.size else means
    differences = math.sqrt(float(np.mean(kept)) / 0.9099) if kept.size else white_noise_sd(values)
    lines = scipy.fft.rfft((values - values.mean()) * np.hanning(values.size))[int(0.4 * values.size) :]
    fastest = math.sqrt(float(np.median(np.abs(lines) ** 2)) / math.log(2.0) / (0.375 * values.size))
    is_fast = fastest < max_ratio * differences and lines.size >= min_lines
    return max(fastest if is_fast else differences, rounding_noise_sd(values))


def white_noise_sd(values: Float[np.ndarray, " samples"]) -> float:
    """Return the sd of white noise on a smooth signal, from the median of third differences (robust to edges)."""
    return float(white_noise_sds(values))


def white_noise_sds(values: Float[np.ndarray, "*records samples"]) -> Float[np.ndarray, "*records"]:
    """Return `white_noise_sd` of each record; the differences are in single precision, which halves the time.

    That of records with equal neighbours is from medians of grouped data, since differences of rounded samples take few
    values.
    """
    third = np.diff(np.diff(values).astype(np.float32), 2)
    np.abs(third, out=third)
    medians, rounded = row_medians(third).astype(float), np.any(values[..., 1:] == values[..., :-1], axis=-1)
    if np.any(rounded) and third.size:
        medians = np.where(rounded, _grouped_medians(third), medians)
    return medians / 0.6744897501960817 / math.sqrt(20.0)


def row_medians(values: Float[np.ndarray, "*rows n"]) -> Float[np.ndarray, "*rows"]:
    """Return the median of each row, and reorder each row in place; eight times as fast as `numpy.median`."""
    half = values.shape[-1] // 2
    if not values.shape[-1]:
        return np.full(values.shape[:-1], np.nan)
    values.partition(half, axis=-1)
    upper = values[..., half]
    return upper if values.shape[-1] % 2 else 0.5 * (upper + np.max(values[..., :half], axis=-1))


def _grouped_medians(values: Float[np.ndarray, "*rows n"]) -> Float[np.ndarray, "*rows"]:
    """Return the medians of rows of positive values that `row_medians` has reordered, of which many are about equal.

    Those equal to the median count as evenly distributed halfway to the next values (compare
    `statistics.median_grouped`).
    """
    size, middle = values.shape[-1], values[..., values.shape[-1] // 2, None]
    below, above = values < 0.999 * middle, values > 1.001 * middle
    n_below, n_above = np.count_nonzero(below, axis=-1), np.count_nonzero(above, axis=-1)
    median, first = middle[..., 0].astype(float), np.max(values, axis=-1, where=below, initial=0.0)
    last = np.where(n_above > 0, np.min(values, axis=-1, where=above, initial=np.inf), median)
    within = (0.5 * size - n_below) / (size - n_below - n_above)
    return np.where(median > 0.0, 0.5 * (first + median + within * (last - first)), 0.0)


def rounding_noise_sd(values: Float[np.ndarray, " samples"]) -> float:
    """Return the sd due to the resolution (LSB) of the samples, or 0 if white noise exceeds it."""
    min_levels = 12  # fewer indicate an ideal wave, not an ADC
    some = 65_536  # the first samples, which usually suffice
    noise, step = white_noise_sd(values), math.inf
    for part in (values[:some], values)[values.size <= some :]:
        levels = np.unique(part)
        step = float(np.diff(levels).min(initial=math.inf))
        if step <= noise:
            return 0.0
    return step / math.sqrt(12.0) if levels.size >= min_levels and not _is_ramp_on_levels(values, step) else 0.0


def _is_ramp_on_levels(values: Float[np.ndarray, " samples"], step: float) -> bool:
    """Return whether an ideal wave has few levels because its ramps rise by the same step from sample to sample.

    A converter repeats a level, or skips one, on almost any ramp.
    """
    changes = np.abs(np.diff(values))
    rises = changes > 0.5 * step
    alike = np.abs(changes[rises] - step) < 1e-3 * step
    neighbours = rises & (np.append(rises[1:], False) | np.append(False, rises[:-1]))
    return bool(np.mean(alike) > 0.9 and np.count_nonzero(neighbours) > 0.9 * np.count_nonzero(rises))
