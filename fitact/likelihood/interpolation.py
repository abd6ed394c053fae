"""Projection of a record on the signals of its model around an optimum, where a table of responses does not serve.

For whitened Gaussian noise, a delay, a clock error or a skin without time constants changes the signal smoothly, except
at samples that pass a corner of the drive. Near an optimum, the signals therefore lie, to rounding, in the span of
some ten or twenty of them, and the values at as few samples determine the others (empirical interpolation: Barrault,
Maday, Nguyen, Patera, C. R. Math. 339 (2004) 667; reduced-order quadrature: Antil, Field, Herrmann, Nochetto, Tiglio,
J. Sci. Comput. 57 (2013) 604). Twice as many samples are used, and the disagreement of the surplus shows at each
evaluation whether the interpolation holds. Samples that may pass a corner are kept as they are.
"""

import functools
import math
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float

from fitact.compiled import jit
from fitact.likelihood.channel import ChannelLikelihood
from fitact.likelihood.compression import BASELINE_NAMES, Interpolation, split_functions
from fitact.likelihood.observable import ChannelInputs
from fitact.likelihood.projection import (
    Samples,
    WhiteningState,
    baseline_functions,
    chunk_length,
    chunks,
    evaluate_baseline,
    factor_products,
    whitened_products,
)
from fitact.model.chirp import Chirp
from fitact.model.drive import Burst, InterpolatedDrive, PiecewiseLinear
from fitact.progress import track_progress


def interpolate(
    channel: ChannelLikelihood,
    inputs: ChannelInputs,
    precision: float,
    max_functions: int = 40,
    max_kept: int = 2048,
    tried: int = 1024,
) -> Interpolation | None:
    """Project the record of a channel on signals of its model, which `inputs` (stacked, the optimum first) sample.

    An interpolated signal is wrong by at most `precision` (root of the sum of squares over the samples). Its functions
    and points are chosen among `tried` samples. Returns None if more than `max_functions` are needed, or more than
    `max_kept` samples may pass a corner of the drive. Double precision is required.
    """
    samples, taps = (
        _samples(channel),
        None if channel.samples.whitening is None else np.asarray(channel.samples.whitening.taps),
    )
    size, rms = samples.time.size, precision / math.sqrt(samples.time.size)
    timing = np.stack([np.broadcast_to(each, inputs.gain.shape) for each in (inputs.delay, inputs.clock)])
    lowest, highest = timing.min(axis=1), timing.max(axis=1)
    corners = _passes_corner(channel, lowest, highest)[:size]
    kept = np.flatnonzero(
        (np.convolve(corners, np.ones(1 if taps is None else taps.size))[:size] > 0.5) & (samples.mask > 0.0)
    )
    smooth = np.flatnonzero((samples.weight > 0.0) & ~corners)
    if kept.size > max_kept or smooth.size < 2 * max_functions:
        return None
    smooth = np.sort(np.random.default_rng(0).permutation(smooth)[:tried])  # any subset serves
    signals = _evaluate(channel, inputs, smooth)
    chosen = _choose_signals(signals, 0.1 * rms, max_functions)
    if chosen is None:
        return None
    basis, triangle = np.linalg.qr(signals[chosen].T)
    selected, coefficients, surplus = _choose_points(basis)
    without_kept: dict[str, Any] = {
        "mask" if channel.samples.whitening else "weight": np.where(np.isin(np.arange(size), kept), 0.0, samples.mask)
    }
    training = jax.tree.map(lambda leaf: leaf[np.append(chosen, 0)], inputs)
    parts = _accumulate(channel, training, np.linalg.inv(triangle), samples._replace(**without_kept), taps)
    parts = track_progress(parts, "compressing the record", math.ceil(size / chunk_length(size)))
    rows, _ = factor_products(sum(parts, np.zeros(())))
    sizes = {"signal": len(chosen), "baseline": len(BASELINE_NAMES), "slope": 1, "observed": 1}
    functions, baseline, slope, observed = (each.T for each in split_functions(rows, sizes).values())
    needed, filtering = _kept_rows(kept, taps, samples)
    middle, half = 0.5 * (samples.time[0] + samples.time[-1]), 0.5 * (samples.time[-1] - samples.time[0])
    optimum = jax.tree.map(lambda leaf: leaf[0], inputs)
    points = np.append(smooth[selected], needed)
    return Interpolation(
        time=samples.time[points],
        rate=None if channel.samples.rate is None else samples.rate[points],
        to_rows=scipy.linalg.block_diag(functions.T @ coefficients, filtering),
        surplus=np.pad(surplus, ((0, 0), (0, needed.size))) / rms,
        lowest=lowest,
        highest=highest,
        baseline=np.hstack([baseline, evaluate_baseline(samples.time[needed], middle, half) @ filtering.T]),
        slope=np.append(
            slope[0], filtering @ _slope(channel.select(needed, np.ones(needed.size)), optimum)[: needed.size]
        ),
        observed=np.append(observed[0] + functions.T @ (basis.T @ signals[0]), filtering @ samples.observed[needed]),
        samples=np.asarray(float(np.count_nonzero(samples.mask))),
        effects=None if samples.effects is None else samples.effects[:, points],
    )


def _samples(channel: ChannelLikelihood) -> Samples:
    given = channel.samples
    part = slice(given.size)
    time, observed, weight = (np.asarray(x)[part] for x in (given.time, given.observed, given.weights))
    rate = np.zeros(time.size) if given.rate is None else np.asarray(given.rate)[part]
    mask = weight if given.whitening is None else given.whitening.mask[part]
    effects = None if given.effects is None else np.asarray(given.effects)[:, part]
    return Samples(time, observed, weight, rate, mask, effects=effects)


def _passes_corner(channel: ChannelLikelihood, lowest: np.ndarray, highest: np.ndarray) -> Bool[np.ndarray, " samples"]:
    """Return which samples lie on different pieces of the drive for some delays and clock errors in a range."""
    ends = np.stack(np.meshgrid(*np.stack([lowest, highest]).T, indexing="ij")).reshape(2, -1)
    pieces = _pieces(channel, *ends)
    return np.any(pieces != pieces[0], axis=0)


@jit
def _pieces(channel: ChannelLikelihood, delays: Array, clocks: Array) -> Float[Array, "n samples"]:
    """Return numbers of the pieces of the drive on which the samples lie."""
    drive = channel.electrical.drive
    wave = drive.wave if isinstance(drive, Burst) else drive

    def piece(delay: Array, clock: Array) -> Array:
        time = channel.timing.drive_time(channel.samples.time, delay, clock)
        index = jnp.asarray(time >= drive.start_time, dtype=int)
        if isinstance(drive, Burst | Chirp):
            index = index + drive.is_over(time)
        return index if not isinstance(wave, PiecewiseLinear | InterpolatedDrive) else index + 3 * wave.locate(time)[0]

    return jax.vmap(piece)(delays, clocks)


def _evaluate(
    channel: ChannelLikelihood, inputs: ChannelInputs, indices: np.ndarray
) -> Float[np.ndarray, "inputs points"]:
    return _signals(channel.select(indices, np.ones(indices.size)), inputs)[:, : indices.size]


@jit
def _signals(channel: ChannelLikelihood, inputs: ChannelInputs) -> Float[Array, "inputs samples"]:
    return jax.vmap(channel.signal)(inputs)


@jit
def _slope(channel: ChannelLikelihood, inputs: ChannelInputs) -> Float[Array, " samples"]:
    """Return the derivative with respect to a delay, or 0 if it is a parameter."""
    if "delay" in channel.timing.free:
        return jnp.zeros_like(channel.samples.time)
    return channel.observable.delay_derivative(channel.samples, inputs)


def _choose_signals(signals: Float[np.ndarray, "n samples"], rms: float, most: int) -> np.ndarray | None:
    """Return the indices of signals of which all others are combinations, to within `rms`; None if `most` do not do."""
    modes, sizes, _ = np.linalg.svd(signals / math.sqrt(signals.shape[1]), full_matrices=False)
    parts = np.square(modes * sizes)
    errors = np.sqrt(np.max(np.cumsum(parts[:, ::-1], axis=1)[:, ::-1], axis=0))
    count = 8 * math.ceil(np.count_nonzero(errors > rms) / 8)
    return None if count > most else scipy.linalg.qr(signals.T, mode="r", pivoting=True)[1][: max(count, 8)]


def _choose_points(basis: Float[np.ndarray, "samples rank"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points, the map from values there to coefficients of the basis, and rows that are 0 on the basis."""
    rank = basis.shape[1]
    first = scipy.linalg.qr(basis.T, mode="r", pivoting=True)[1][:rank]
    others = np.setdiff1d(np.arange(len(basis)), first)
    second = others[scipy.linalg.qr(basis[others].T, mode="r", pivoting=True)[1][:rank]]
    points = np.append(first, second)
    directions, triangle = np.linalg.qr(basis[points], mode="complete")
    return points, np.linalg.solve(triangle[:rank], directions[:, :rank].T), directions[:, rank:].T


def _accumulate(
    channel: ChannelLikelihood,
    training: ChannelInputs,
    combinations: Float[np.ndarray, "signals functions"],
    samples: Samples,
    taps: np.ndarray | None,
) -> Iterator[np.ndarray]:
    """Yield the inner products of functions, shapes and record over chunks."""
    ends = samples.time[0], samples.time[-1]
    filtering = WhiteningState.start(taps, len(combinations) + len(BASELINE_NAMES) + 2)
    for chunk in chunks(samples, chunk_length(samples.time.size)):
        total, filtering = _chunk_products(channel.keep_ends(), training, combinations, chunk, ends, filtering)
        yield total


@functools.partial(jit, fast=True)
def _chunk_products(
    channel: ChannelLikelihood,
    training: ChannelInputs,
    combinations: Array,
    chunk: Samples,
    ends: tuple[Array, Array],
    filtering: WhiteningState | None,
) -> tuple[Array, WhiteningState | None]:
    rate = None if channel.samples.rate is None else chunk.rate
    channel = channel.replace_samples(time=chunk.time, observed=chunk.observed, rate=rate, effects=chunk.effects)
    signals = jax.vmap(channel.signal)(training)
    baseline = baseline_functions(chunk.time, 0.5 * (ends[0] + ends[1]), 0.5 * (ends[1] - ends[0]))
    slope = _slope(channel, jax.tree.map(lambda leaf: leaf[-1], training))
    rows = [combinations.T @ signals[:-1], baseline, slope[None], (chunk.observed - signals[-1])[None]]
    return whitened_products(jnp.concatenate(rows), chunk, filtering)


def _kept_rows(
    kept: np.ndarray, taps: np.ndarray | None, samples: Samples, multiple: int = 16
) -> tuple[np.ndarray, Float[np.ndarray, "kept needed"]]:
    """Return which samples the kept ones need, and the filter between them, both padded to a `multiple`."""
    ages = np.arange(1 if taps is None else taps.size)
    sources = np.maximum(kept[:, None] - ages, 0)
    needed, columns = np.unique(sources, return_inverse=True)
    shape = [multiple * math.ceil(n / multiple) for n in (kept.size, needed.size)]
    filtering = np.zeros(shape)
    factors = samples.weight[sources] * (1.0 if taps is None else taps)
    filtering[np.arange(kept.size)[:, None], columns.reshape(sources.shape)] = factors
    return np.pad(needed, (0, shape[1] - needed.size), mode="edge") if kept.size else needed, filtering
