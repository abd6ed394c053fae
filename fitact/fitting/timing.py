"""Delay and clock error of a channel: their best value on a grid, and the gain from fitting a clock error."""

import dataclasses
import functools
from collections.abc import Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitact.compiled import jit, pad_rows, pad_samples, pad_weight
from fitact.fitting.score_test import explained_squares, orthonormalise
from fitact.likelihood.certificate import recompress
from fitact.likelihood.channel import ChannelLikelihood
from fitact.likelihood.likelihood import CircuitValues, Likelihood
from fitact.likelihood.noise import student_weight
from fitact.likelihood.observable import TIMING_NUISANCES, ChannelInputs
from fitact.likelihood.smooth_drive import corner_errors, curve_drive, curve_tones
from fitact.model.drive import Sampled
from fitact.model.response import highpass
from fitact.model.skin import constant_skin_circuit, limits_current
from fitact.problem.build import smooth_recorded_drive
from fitact.problem.drive_choice import has_ideal_edges, has_unresolved_edge, ideal_edge_mask
from fitact.problem.source import Source


def free_timing(
    channel: ChannelLikelihood,
    inputs: ChannelInputs,
    circuit: CircuitValues,
    name: str,
    step: float = 1 / 8,
    delay_half_width: float = 5.0,
    clock_half_width: float = 2.0,
    few: int = 4096,
) -> ChannelLikelihood:
    """Return the channel with a free delay or clock error (`name`); `circuit` is that of the `inputs`.

    It keeps its compression if a table can represent the delay. The start is the center of the best points of a grid,
    because an ideal edge has no slope to follow. `step` and the half widths of the grid are in units of the
    coordinates; at most `few` samples decide. With ideal edges, only the samples next to them determine a clock error,
    and a delay with it. These samples bound both by a prior, and are then excluded from the fit.
    """
    edges = _edge_mask(channel) if name == "clock" else np.zeros(channel.samples.time.size, bool)
    names = TIMING_NUISANCES if edges.any() else (name,)
    units = np.array([float(channel.timing_unit(n)) for n in names])
    free = tuple(n for n in TIMING_NUISANCES if n in names or n in channel.timing.free)
    channel = recompress(channel.replace_timing(free=free).exclude_unknown_drive(), circuit)
    half_widths = {"delay": 1.0 if len(names) > 1 else delay_half_width, "clock": clock_half_width}
    axes = [step * np.arange(-int(w / step), int(w / step) + 1) for w in map(half_widths.__getitem__, names)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(names))
    used = channel
    if edges.any():
        used = channel.select(np.flatnonzero(edges), channel.samples.weights[edges])
    elif channel.compression is None:
        used = channel.thin(few)
    squares = _residual_sums_of_squares(used, inputs, names, grid * units)
    # less than the effect of one sample on the wrong side of an edge, whose error is most of the height
    margin = squares.min() * 25.0 / used.samples.size
    if edges.any():
        margin = (0.1 * np.ptp(np.asarray(channel.samples.observed))) ** 2
    good = grid[squares < squares.min() + margin]
    change = {"delay": 0.0, "clock": 0.0} | dict(zip(names, good.mean(axis=0) * units, strict=True))
    timing = channel.timing
    shift, clock = timing.shift + change["delay"], timing.clock + change["clock"]
    channel = channel.replace_timing(shift=shift, clock=clock)
    if (steps := round(float(shift) / float(timing.step))) and channel.electrical.smooth is not None:
        delayed = channel.electrical.delay_noise(steps)
        channel = recompress(dataclasses.replace(channel, observable=delayed), circuit)
    if not edges.any():
        return channel
    timing_sd = np.hypot(good.std(axis=0), step / np.sqrt(12.0))
    return channel.exclude_samples(edges).replace_timing(sd=timing_sd)


def start_delays(
    likelihood: Likelihood, theta: Float[np.ndarray, " parameters"], sources: Sequence[Source]
) -> Likelihood:
    """Return the likelihood in which delays of recorded drives that jump between two samples start from a grid.

    Each sample that such a jump passes is a minimum.
    """
    for i, channel in _delayed_channels(likelihood):
        if has_unresolved_edge(sources[i].in_time):
            at_theta = likelihood.channel_inputs(theta, i), likelihood.evaluate_circuit(theta)
            likelihood = likelihood.replace_channel(i, free_timing(channel, *at_theta, "delay"))
    return likelihood


def shift_whole_steps(
    likelihood: Likelihood, theta: Float[np.ndarray, " parameters"], sd: Float[np.ndarray, " parameters"]
) -> tuple[Likelihood, Float[np.ndarray, " parameters"]]:
    """Shift each Vsc that is clearly late by whole steps, with the noise of its recorded V.

    `sd` is that of theta. The likelihood is the same if there are none.
    """
    theta = theta.copy()
    for i, channel in _delayed_channels(likelihood):
        place, timing = likelihood.names.index(channel.qualified_name("delay")), channel.timing
        before = float(timing.shift / timing.step)
        steps = round(before + float(theta[place])) - round(before)
        if steps == 0 or abs(theta[place]) < max(0.75, 4.0 * sd[place]):
            continue
        late = channel.without_compression().replace_timing(shift=timing.shift + steps * timing.step)
        late = dataclasses.replace(late, observable=late.electrical.delay_noise(steps))
        likelihood, theta[place] = likelihood.replace_channel(i, late), theta[place] - steps
    return likelihood, theta


def curve_drives(
    likelihood: Likelihood,
    theta: Float[np.ndarray, " parameters"],
    sigma: Float[np.ndarray, " channels"],
    sources: Sequence[Source],
    max_change: float = 0.3,
    max_excluded: float = 0.25,
) -> Likelihood:
    """Return the likelihood in which recorded drives, linear between samples, are cubic for a delay by part of a step.

    Between two samples, a line misses a curve by part (1 - part) / 2 of its second differences, which are added.
    Samples that read V at a corner, where it misses by more than half of their noise, are excluded. The likelihood is
    the same if none are, and no Vsc changes by more than `max_change` standard errors.
    """
    for i, (channel, source) in enumerate(zip(likelihood.channels, sources, strict=True)):
        if not channel.may_curve_drive:
            continue
        electrical, record = channel.electrical, source.in_time
        smooth = smooth_recorded_drive(record)
        drive, now = electrical.drive, np.asarray(electrical.smooth)
        assert isinstance(drive, Sampled)
        assert smooth is not None
        late = theta[likelihood.names.index(channel.qualified_name("delay"))]
        step, lag = float(channel.timing.step), 0.0
        late += float(channel.timing.shift) / step
        if record.tones is not None:
            terms = likelihood.evaluate_circuit(theta).terms[channel.channel]
            curved = curve_tones(record.tones, late, terms, step)
        else:
            if limits_current(likelihood.template):  # whose resistance makes Vsc later, too
                lag = min(float(likelihood.evaluate_circuit(theta).tau[-1]) / step, 1.0)
            curved = curve_drive(smooth[: len(record)], late, lag)
            missed = abs(float(electrical.noise_gain)) * corner_errors(smooth[: len(record)], late, lag)
            at_corner = (missed > 0.5 * source.noise) & (channel.samples.weights[: len(record)] > 0.0)
            if 0.0 < np.mean(at_corner) < max_excluded:
                channel = channel.without_compression().exclude_samples(pad_weight(at_corner))
                likelihood = likelihood.replace_channel(i, channel)
        curved = pad_samples(curved)
        changes = np.asarray(electrical.noise_gain) * (curved - now) / sigma[i]
        if np.linalg.norm(changes * np.sqrt(channel.samples.weights)) > max_change:
            drive = dataclasses.replace(drive, samples=curved + (np.asarray(drive.samples) - now))
            channel = channel.without_compression().replace_observable(drive=drive, smooth=curved)
            likelihood = likelihood.replace_channel(i, channel)
    return likelihood


def _delayed_channels(likelihood: Likelihood) -> Iterator[tuple[int, ChannelLikelihood]]:
    """Yield the channels with a free delay against the samples of a recorded drive; rows of charge follow it."""
    for i, channel in enumerate(likelihood.channels):
        if "delay" in channel.timing.free and channel.observable.follows_samples and channel.samples.charges is None:
            yield i, channel


def _edge_mask(channel: ChannelLikelihood, margin: float = 3.0) -> np.ndarray:
    """Return which samples lie within `margin` steps of an ideal edge and thus determine its time."""
    if not has_ideal_edges(channel.electrical.drive):
        return np.zeros(channel.samples.time.size, bool)
    time, step = np.asarray(channel.samples.time) - float(channel.timing.shift), margin * float(channel.timing.step)
    return ideal_edge_mask(channel.electrical.drive, time, step)


def _residual_sums_of_squares(
    channel: ChannelLikelihood,
    inputs: ChannelInputs,
    names: tuple[str, ...],
    candidates: np.ndarray,
    batch: int = 27,
    max_numbers: int = 1 << 20,
) -> Float[np.ndarray, " candidates"]:
    """Return the residual sum of squares at each candidate (SI units), with the best gain and linear nuisances.

    The signals of a `batch` are computed in parallel, but not more than `max_numbers` values at once.
    """
    observed, shapes = _observed_and_shapes(channel, inputs)
    basis = orthonormalise(shapes[np.asarray(channel.column_sd) > 0.0])

    def project_out(values: np.ndarray) -> np.ndarray:
        return values - (values @ basis.T) @ basis

    observed, sums = project_out(observed), []
    size = max(1, min(batch, max_numbers // observed.size))
    for first in range(0, len(candidates), size):
        some = candidates[first : first + size]
        offsets = dict(zip(names, pad_rows(some, size).T, strict=True))
        signals = project_out(np.asarray(_signals(channel.without_samples(), inputs, offsets))[: len(some)])
        gains = signals @ observed / np.maximum(np.vecdot(signals, signals), 1e-300)
        residuals = observed - gains[:, None] * signals
        sums.append(np.vecdot(residuals, residuals))
    return np.concatenate(sums)


@jit
def _observed_and_shapes(channel: ChannelLikelihood, inputs: ChannelInputs) -> tuple[Array, Array]:
    return channel.whitened_observed(), channel.residuals_and_shapes(inputs)[1]


@jit
def _signals(
    channel: ChannelLikelihood, inputs: ChannelInputs, offsets: dict[str, Float[Array, " candidates"]]
) -> Float[Array, "candidates rows"]:
    def shifted_signal(offset: dict[str, Array]) -> Array:
        shifted = {name: getattr(inputs, name) + offset[name] for name in offset}
        return channel.whitened_observed() - channel.residuals_and_shapes(dataclasses.replace(inputs, **shifted))[0]

    return jax.vmap(shifted_signal)(offsets)


def clock_r_squared(channel: ChannelLikelihood, inputs: ChannelInputs, sigma: float) -> float:
    """Return the fraction of the residual sum of squares that a free clock error would explain, to first order.

    It is computed from the samples, because the response table cannot represent the effect of a clock error.
    """
    rows = _clock_regressors(channel.without_compression(), inputs, np.asarray(sigma))
    used, edges = channel.samples.weights > 0.0, _edge_mask(channel)
    r_squared = _r_squared(rows[:, used])
    # a clock error shows at an ideal edge only if the edge has passed a sample; otherwise samples there hide it
    return max(r_squared, _r_squared(rows[:, used & ~edges])) if edges.any() else r_squared


def _r_squared(rows: np.ndarray) -> float:
    clock, residuals, fitted = rows[:1], rows[1], rows[2:]
    candidates = {"clock": clock, "all": residuals[None]}
    explained = explained_squares(residuals, fitted[fitted.any(axis=1)], candidates)
    return float(explained["clock"] / max(explained["all"], 1e-300))


@functools.partial(jit, fast=True)
def _clock_regressors(channel: ChannelLikelihood, inputs: ChannelInputs, sigma: Array) -> Float[Array, "n samples"]:
    """Return the effect of a clock error, the residuals, and the effects of all circuit and linear parameters."""
    time = channel.samples.time - (channel.timing.shift + inputs.delay)
    taus = jnp.stack(constant_skin_circuit(inputs.circuit).channel_terms(channel.channel).tau)

    def response(log_tau: Array) -> Array:
        return highpass(channel.electrical.drive, time, jnp.exp(log_tau), steady_state=channel.electrical.steady_state)

    responses, tau_slopes = jax.vmap(lambda x: jax.jvp(response, (x,), (jnp.ones_like(x),)))(jnp.log(taus))
    signal = channel.signal(inputs)
    rise, span = map(jnp.asarray, (jnp.gradient(signal), jnp.gradient(channel.samples.time)))
    slope = -rise / jnp.where(span > 0.0, span, 1.0)  # over two samples, so that a jump appears on both sides
    shapes = jnp.where(channel.linear_sd[:, None] > 0.0, channel.shapes(inputs), 0.0)
    # a free delay adds only the slope as a regressor
    delay = slope if "delay" in channel.timing.free else jnp.zeros_like(slope)
    rows = jnp.stack([time * slope, channel.samples.observed - signal, *responses, *tau_slopes, *shapes, delay])
    rows = channel.samples.apply_whitening(rows)
    if channel.noise != "student":
        return rows
    return rows * jnp.sqrt(student_weight(channel.fit_nuisances(inputs, sigma)[0] / sigma))
