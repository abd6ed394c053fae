"""Projection of a record on a table of responses, after which the cost of a likelihood is independent of its length.

For white Gaussian noise, the likelihood depends on the record only through its inner products with the functions of
the model: the responses u(t; tau) to the drive, the decays of an unknown charge, and a few slow shapes. Over a range
of time constants, all u(.; tau) lie, to rounding, in the span of some twenty functions for any drive, since they are
convolutions of dV/dt with e^{-t/tau}, and these exponentials do. One pass accumulates the inner products of these
functions, the shapes and the record. A factor of this matrix gives the coordinates of a `Compression`.
Coloured noise is whitened by a linear filter, which is applied to all functions and the record during the pass.
"""

import math
from collections.abc import Iterator, Mapping
from fractions import Fraction
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.compiled import jit, pad_samples, pad_weight
from fitact.data.record import is_uniform
from fitact.likelihood.charge_rows import ChargeRows
from fitact.likelihood.compression import (
    BASELINE_NAMES,
    HUM_FREQUENCIES,
    Columns,
    Compression,
    function_sizes,
    place_functions,
    split_functions,
)
from fitact.likelihood.noise import Whitening
from fitact.model.chirp import Chirp
from fitact.model.circuit import HighpassTerms
from fitact.model.drive import Drive, Periodic, Sampled
from fitact.model.response import drive_voltage, highpass, phi, recurrence
from fitact.model.response_table import (
    NARROW,
    TABLE_HALF_WIDTH,
    chebyshev,
    exponential_basis,
    node_count,
    significant_combinations,
)
from fitact.progress import track_progress

RANK_TOLERANCE = 1e-13  # relative size of the singular values that are omitted
MANY_SAMPLES = 65_536  # samples above which a faster program saves more than its compilation takes
MAX_DELAY = 6  # time steps by which the response to a measured drive may be shifted


def compress(
    drive: Drive,
    time: Float[np.ndarray, " samples"],
    observed: Float[np.ndarray, " samples"],
    *,
    steady_state: bool,
    expected_terms: HighpassTerms,
    weight: Float[np.ndarray, " samples"] | None = None,
    whitening: Whitening | None = None,
    charges: ChargeRows | None = None,
    rate: Float[np.ndarray, " samples"] | None = None,
    slope: Float[np.ndarray, " samples"] | None = None,
    student: Float[np.ndarray, "3 samples"] | None = None,
    effects: Float[np.ndarray, "effects samples"] | None = None,
    noise: Float[np.ndarray, " samples"] | None = None,
    is_wide: bool = False,
    wide_margins: tuple[float, float] = (4.0, 8.0),
) -> Compression:
    """Project a record on responses to `drive`, for time constants within a factor 9 of the one in `expected_terms`.

    This is one pass over the arrays in chunks, which may be `numpy.memmap`. If a steady drive repeats on the sampling
    grid of the record and the noise is white, its periods are first folded exactly. Double precision is required.

    A `Sampled` drive has the times of the record, and may be padded. The response of `expected_terms` is close to the
    record; it is subtracted before and added after, so that the noise keeps its digits. The table covers more than a
    factor 9 if several terms need it (see `table_multiple`), or if `is_wide`: then by the powers `wide_margins` of 9
    below and above, since a record may tell of a long time constant no more than that it is long. `weight` multiplies
    the residuals of the samples (0 excludes a sample, None means 1). `rate` is dV/dt (V/s) for a channel that follows
    it. `slope` replaces dV/dt in the field of that name. `student` holds weights of the squares, and two functions to
    be projected instead of the record; `observed` and its slope are then without the model at which they were computed.
    `charges` are rows that take the place of `observed`, `rate` and `slope`, and of the filter. `effects` are further
    functions of the model.

    With `noise`, the response to a measured drive on a uniform grid can be shifted by up to `MAX_DELAY` steps; V is
    then taken as constant before the first and after the last sample. The noise is what was recorded of V beside the
    drive (V), see `smooth_drive`.

    Terms of a grid of time constants have arrays of weights and time constants; the table then holds the responses of
    the grid instead of series.
    """
    margins = None
    if student is None and isinstance(expected_terms.tau, tuple):
        tau = np.array(expected_terms.tau)
        if is_wide:
            below, above = wide_margins
            margins = below * TABLE_HALF_WIDTH, above * TABLE_HALF_WIDTH
        elif charges is not None and time.size <= MANY_SAMPLES:
            # I with a noisy V may leave b uncertain by more than a usual table covers
            margins = 2 * ((1 + table_multiple(tau)) * TABLE_HALF_WIDTH - 0.5 * float(np.ptp(np.log(tau))),)
    table = TableNodes.from_terms(expected_terms, time, narrow=student is not None, margins=margins)
    if table.expected_direct is not None:  # V is one more function, the last of the effects
        voltage = evaluate_voltage(drive, time, steady_state)[None]
        effects = voltage if effects is None else np.concatenate([effects, voltage])
    one = np.ones(time.size) if weight is None else np.asarray(weight)
    mask = one if whitening is None else np.asarray(whitening.mask)[: time.size]
    recursion = None if whitening is None or whitening.gain is None else (whitening.gain, whitening.decay)
    if charges is not None:
        observed, rate, slope, mask = charges.observed, charges.rate, charges.bend, charges.used
    samples = Samples(
        time,
        observed,
        one,
        np.broadcast_to(0.0 if rate is None else rate, time.size),
        mask,
        slope,
        student,
        effects,
        charges,
        recursion,
    )
    taps = None if whitening is None else np.asarray(whitening.taps)
    measured = isinstance(drive, Sampled) and not steady_state
    sizes = function_sizes(
        len(table.series),
        decays=measured and not table.is_grid,
        effects=samples.n_effects,
        ages=0 if noise is None else 2 * MAX_DELAY + 1,
    )
    filtering = WhiteningState.start(taps, sum(sizes.values()), charges)
    if isinstance(drive, Sampled) and measured:
        parts = _accumulate_measured(table, drive, samples, filtering, noise)
    else:
        is_simple = steady_state and taps is None and student is None
        period = samples_per_period(drive, time) if is_simple else None
        rounding = 1e-9 * np.max(np.abs(samples.rate))
        if period and not np.allclose(samples.rate[period:], samples.rate[:-period], rtol=0.0, atol=rounding):
            period = None
        if period is None:
            parts = _accumulate_directly(table, drive, samples, steady_state, filtering)
        else:
            parts = _accumulate_folded(table, drive, samples, period, sizes)
    parts = track_progress(parts, "compressing the record", math.ceil(time.size / chunk_length(time.size)))
    rows, projected = factor_products(sum(parts, np.zeros(())))
    functions, count = split_functions(rows, sizes), int(np.count_nonzero(mask))
    return assemble_compression(table, functions, count, projected.T if projected.size else None)


def table_multiple(tau: Float[np.ndarray, " terms"]) -> int:
    """Return the half-width of a table for these time constants (s), in units of `TABLE_HALF_WIDTH`."""
    return max(1, math.ceil((0.5 * float(np.ptp(np.log(tau))) + math.log(3.0)) / TABLE_HALF_WIDTH))


class TableNodes(eqx.Module):
    """Response table during the pass: its nodes, and the few significant combinations of their responses."""

    center: Array
    nodes: Float[Array, " nodes"]  # s
    combinations: Float[Array, "nodes rank"]
    series: np.ndarray  # coefficients (rank, terms) of any response in these combinations
    half_width: Array
    expected_series: Float[Array, " terms"]  # the expected response is the product of the series with this
    expected: Float[Array, " nodes"]  # the same for the responses of the nodes
    expected_rate: ArrayLike | None  # F
    expected_direct: ArrayLike | None  # None means that V is not among the functions
    middle: Array  # of the record, s
    half: Array  # half the length of the record, s
    step: Array  # mean time step, s
    is_grid: bool = eqx.field(static=True)

    @classmethod
    def from_terms(
        cls,
        expected_terms: HighpassTerms,
        time: np.ndarray,
        *,
        narrow: bool,
        margins: tuple[float, float] | None = None,
        count: int | None = None,
    ) -> "TableNodes":
        """Make the table of these terms at `time`.

        `margins` are what it covers in log tau beyond the terms, below and above, and `count` is the number of nodes.
        """
        tau, weight = (np.asarray(x, dtype=float) for x in (expected_terms.tau, expected_terms.weight))
        log_tau = np.log(tau)
        center = 0.5 * (np.min(log_tau) + np.max(log_tau))
        if isinstance(expected_terms.tau, tuple):
            # a wide table has functions of few samples, which Student's t may weight negatively
            half_width = 0.5 * np.ptp(log_tau) + NARROW if narrow else table_multiple(tau) * TABLE_HALF_WIDTH
            if margins is not None:
                half_width, center = 0.5 * (np.ptp(log_tau) + sum(margins)), center + 0.5 * (margins[1] - margins[0])
            count = count or node_count(half_width)
            relative, mix, series = exponential_basis(half_width, count)
            nodes, (_, to_series) = np.exp(center) * relative, chebyshev(count)
            expected = weight @ np.polynomial.chebyshev.chebvander((log_tau - center) / half_width, count - 1)
        else:
            nodes, half_width, to_series, expected = tau, 0.5 * np.ptp(log_tau), np.eye(tau.size), weight
            # weights in I grow with 1 / tau, so that the responses must be exact relative to their weights
            scale = np.maximum(np.abs(weight), 1e-4 * np.max(np.abs(weight)))
            mix, series = significant_combinations(tau, RANK_TOLERANCE, scale)
        return cls(
            center=np.asarray(center),
            nodes=nodes,
            combinations=mix,
            series=series,
            half_width=np.asarray(half_width),
            expected_series=expected,
            expected=expected @ to_series,
            expected_rate=None if expected_terms.rate is None else np.asarray(expected_terms.rate),
            expected_direct=None if expected_terms.direct is None else np.asarray(expected_terms.direct),
            middle=np.asarray(0.5 * (time[0] + time[-1])),
            half=np.asarray(0.5 * (time[-1] - time[0])),
            step=np.asarray((time[-1] - time[0]) / (time.size - 1)),
            is_grid=not isinstance(expected_terms.tau, tuple),
        )


def baseline_functions(time: Float[Array, " n"], middle: Array, half: Array) -> Float[Array, "shapes n"]:
    """Return the shapes of `BASELINE_NAMES` in time: 1, a line from -1 to 1 over the record, and hum."""
    since = time - middle
    turns = 2.0 * np.pi * since
    waves = [wave(frequency * turns) for frequency in HUM_FREQUENCIES for wave in (jnp.cos, jnp.sin)]
    return jnp.stack([jnp.ones_like(since), since / half, *waves])


def evaluate_baseline(time: np.ndarray, middle: ArrayLike, half: ArrayLike) -> Float[np.ndarray, "shapes n"]:
    """Return `baseline_functions` at any number of times without compilation."""
    return _baseline_functions(pad_samples(time), np.asarray(middle), np.asarray(half))[:, : time.size]


_baseline_functions = jit(baseline_functions)


def evaluate_voltage(
    drive: Drive, time: Float[np.ndarray, " samples"], steady_state: bool
) -> Float[np.ndarray, " samples"]:
    """Return `drive_voltage` at any number of times without compilation; a `Sampled` drive has these times."""
    if isinstance(drive, Sampled) and not steady_state:
        return np.asarray(drive.samples)[: time.size]
    return _voltage(drive, pad_samples(time), steady_state)[: time.size]


@jit
def _voltage(drive: Drive, time: Array, steady_state: bool) -> Float[Array, " n"]:
    return jnp.asarray(drive_voltage(drive, time, steady_state=steady_state))


class Samples(NamedTuple):
    """Arrays over all samples (possibly on disk) or over a chunk of them."""

    time: np.ndarray
    observed: np.ndarray
    weight: np.ndarray
    rate: np.ndarray  # dV/dt
    mask: np.ndarray  # of the whitening filter
    slope: np.ndarray | None = None  # dV/dt over two samples, or what replaces it; None: computed from the drive
    student: np.ndarray | None = None  # as in `compress`
    effects: np.ndarray | None = None  # likewise
    charges: ChargeRows | None = None  # of a current; `observed`, `rate` and `slope` are then rows
    recursion: Any = None  # gain and decay of the whitening filter

    @property
    def n_effects(self) -> int:
        return 0 if self.effects is None else len(self.effects)


def chunks(samples: Samples, length: int) -> Iterator[Samples]:
    """Yield chunks of `length` samples; the last is padded with weight 0."""

    def part(values: np.ndarray | None, first: int) -> Any:
        if values is None:
            return None
        inside = np.asarray(values[..., first : first + length])
        return np.pad(inside, [(0, 0)] * (inside.ndim - 1) + [(0, length - inside.shape[-1])])

    for first in range(0, samples.time.size, length):
        time = np.asarray(samples.time[first : first + length])
        others = (jax.tree.map(lambda values, first=first: part(values, first), values) for values in samples[1:])
        yield Samples(np.pad(time, (0, length - time.size), mode="edge"), *others)


def chunk_length(samples: int, longest: int = 8_192) -> int:
    """Return the number of samples in a chunk, which bounds the memory."""
    return min(longest, 1 << (samples - 1).bit_length())


def _accumulate_directly(
    table: TableNodes, drive: Drive, samples: Samples, steady_state: bool, filtering: "WhiteningState | None"
) -> Iterator[np.ndarray]:
    size = samples.time.size
    length = chunk_length(size, 65_536) if isinstance(drive, Chirp) else chunk_length(size)  # of few chirps
    multiply = jit(_chunk_products, fast=size > MANY_SAMPLES)
    for chunk in chunks(samples, length):
        total, filtering = multiply(table, drive, chunk, None, steady_state, filtering)
        yield total


class WhiteningState(NamedTuple):
    """Whitening filter during the pass."""

    taps: np.ndarray | None  # None for the rows of charges
    last: Float[np.ndarray, "functions reach"]  # values before the chunk
    whitened: Float[np.ndarray, " functions"] | None = None  # last whitened value of each function

    @classmethod
    def start(
        cls, taps: np.ndarray | None, functions: int, charges: ChargeRows | None = None
    ) -> "WhiteningState | None":
        if charges is not None:  # rate, slope and record are rows; the expected signal is a function of time, too
            return cls(None, np.zeros((functions - 2, charges.reach)), np.zeros(functions))
        return None if taps is None else cls(taps, np.zeros((functions, taps.size - 1)), np.zeros(functions))


def _chunk_products(
    table: TableNodes,
    drive: Drive,
    chunk: Samples,
    baseline: Array | None,
    steady_state: bool,
    filtering: WhiteningState | None,
) -> tuple[Array, WhiteningState | None]:
    """Return the inner products of a chunk, for a drive whose response can be computed at any time."""
    u, shapes, slope = evaluate_functions(table, drive, chunk.time, steady_state)
    return _inner_products(table, [u], shapes if baseline is None else baseline, slope, chunk, filtering)


def evaluate_functions(
    table: TableNodes, drive: Drive, time: Float[Array, " n"], steady_state: bool
) -> tuple[Float[Array, "nodes n"], Float[Array, "shapes n"], Float[Array, " n"]]:
    """Return the responses of the nodes to a drive, the baseline functions, and dV/dt over two samples, at any time."""

    def respond(tau: Array) -> Array:
        return highpass(drive, time, tau, steady_state=steady_state)

    # the many pieces of a chirp are computed anew for each node, one node at a time to save memory
    u = lax.map(respond, table.nodes) if isinstance(drive, Chirp) else jax.vmap(respond)(table.nodes)
    before, after = (drive_voltage(drive, time + step, steady_state=steady_state) for step in (-table.step, table.step))
    return u, baseline_functions(time, table.middle, table.half), (after - before) / (2.0 * table.step)


def _inner_products(
    table: TableNodes,
    responses: list[Array],
    others: Float[Array, "functions n"],
    slope: Array,
    chunk: Samples,
    filtering: WhiteningState | None,
) -> tuple[Array, WhiteningState | None]:
    """Return the inner products of the responses (and charge decays) at the nodes, other functions and the record."""
    expected = table.expected @ responses[0]
    if table.expected_direct is not None and chunk.effects is not None:
        expected = expected + table.expected_direct * chunk.effects[-1]
    following = 0.0 if table.expected_rate is None else table.expected_rate * chunk.rate
    parts = [table.combinations.T @ response for response in responses]
    slope = slope if chunk.slope is None else chunk.slope
    before = [] if chunk.effects is None else [chunk.effects]
    functions = jnp.concatenate([*parts, *before, others])
    if chunk.charges is not None:
        return _charge_products(chunk.charges, functions, expected, following, filtering)
    rest = chunk.observed - expected - following
    return whitened_products(jnp.concatenate([functions, chunk.rate[None], slope[None], rest[None]]), chunk, filtering)


def _charge_products(
    charges: ChargeRows, functions: Float[Array, "functions n"], expected: Array, following: ArrayLike, filtering: Any
) -> tuple[Array, WhiteningState]:
    """Return the inner products of whitened rows: of functions of time, then rate, slope and what is not expected."""
    around = jnp.concatenate([filtering.last, jnp.concatenate([functions, expected[None]])], axis=1)
    *means, expected = charges.means(around)
    last = charges.rate, charges.bend, charges.observed - expected - following
    rows = charges.continue_whitening(jnp.stack([*means, *last]), filtering.whitened)
    used = rows * charges.used
    return used @ used.T, WhiteningState(None, around[:, functions.shape[1] :], rows[:, -1])


def whitened_products(
    rows: Float[Array, "functions n"], chunk: Samples, filtering: WhiteningState | None
) -> tuple[Float[Array, "functions functions"], WhiteningState | None]:
    """Return the inner products of functions over the samples of a chunk, whitened if there is a filter.

    For Student-t noise they are weighted, and two columns follow: the products with the functions to be projected.
    """
    rows = rows * chunk.weight
    if chunk.student is not None:
        return jnp.hstack([(rows * chunk.student[0]) @ rows.T, rows @ chunk.student[1:].T]), filtering
    if filtering is not None:
        around = jnp.concatenate([filtering.last, rows], axis=1)
        whitened = Whitening(filtering.taps, chunk.mask, *(chunk.recursion or ())).filter(around, filtering.whitened)
        rows = chunk.mask * whitened
        filtering = WhiteningState(filtering.taps, around[:, rows.shape[1] :], whitened[:, -1])
    return rows @ rows.T, filtering


def _accumulate_folded(
    table: TableNodes, drive: Drive, samples: Samples, period: int, sizes: Mapping[str, int]
) -> Iterator[np.ndarray]:
    """Yield the inner products from folded periods; the response is computed for one period only."""
    periods = max(1, chunk_length(samples.time.size) // period)
    reference = np.asarray(samples.observed[:period])
    count = np.zeros(period)
    sums = np.zeros((len(BASELINE_NAMES) + 1, period))
    squares = np.zeros((len(BASELINE_NAMES) + 1, len(BASELINE_NAMES) + 1))
    for t, y, weight, *_ in chunks(samples, periods * period):
        weight = np.square(weight)
        difference = (y.reshape(periods, period) - reference).reshape(-1)
        z = np.concatenate([evaluate_baseline(t, table.middle, table.half), difference[None]])
        count += weight.reshape(periods, period).sum(axis=0)
        weighted = z * weight
        sums += weighted.reshape(len(z), periods, period).sum(axis=1)
        squares += weighted @ z.T
    means = sums / np.where(count > 0.0, count, 1.0)
    time, rate = (np.asarray(x[:period]) for x in (samples.time, samples.rate))
    time, mean, rate, baseline = map(pad_samples, (time, means[-1] + reference, rate, means[:-1]))
    weight, slope = pad_weight(np.sqrt(count)), None if samples.slope is None else pad_samples(samples.slope[:period])
    effects = None if samples.effects is None else pad_samples(samples.effects[:, :period])
    folded = Samples(time, mean, weight, rate, weight, slope, None, effects)
    total = np.array(jit(_chunk_products)(table, drive, folded, baseline, True, None)[0])
    # scatter of the samples of one phase about their mean
    places = place_functions(sizes)
    kept = np.concatenate([places[name] for name in (*BASELINE_NAMES, "observed")])
    total[np.ix_(kept, kept)] += squares - means @ sums.T
    yield total


def samples_per_period(
    drive: Drive, time: np.ndarray, max_samples: int = 65_536, tolerance: float = 1e-9
) -> int | None:
    """Return after how many samples drive and grid coincide (to `tolerance` steps), or None if folding is useless."""
    if not isinstance(drive, Periodic) or not is_exactly_uniform(time):
        return None
    advance = (time[-1] - time[0]) / (time.size - 1) * float(drive.frequency)  # cycles per sample
    cycles = Fraction(advance).limit_denominator(max(1, min(time.size // 2, max_samples)))
    rounding = 4.0 * np.finfo(float).eps * time.size
    error = abs(advance - cycles) * time.size / advance  # at the end of the record, in samples
    return cycles.denominator if cycles > 0 and error < tolerance + rounding else None


def is_exactly_uniform(time: np.ndarray, tolerance: float = 1e-9) -> bool:
    """Return whether the samples lie on a uniform grid, to `tolerance` of a step plus rounding."""
    step = (time[-1] - time[0]) / (time.size - 1)
    rounding = 4.0 * np.finfo(float).eps * max(abs(time[0]), abs(time[-1]))
    return is_uniform(time, tolerance + rounding / step)


def _accumulate_measured(
    table: TableNodes,
    drive: Sampled,
    samples: Samples,
    filtering: WhiteningState | None,
    noise: Float[np.ndarray, " samples"] | None,
) -> Iterator[np.ndarray]:
    """Yield the inner products of each chunk for a measured drive; `noise` is as in `compress`."""
    time, voltage = samples.time, np.asarray(drive.samples)[: samples.time.size]
    length, step, first = chunk_length(time.size), float(table.step), float(voltage[0])
    x = step / table.nodes if is_exactly_uniform(time) and step < 300.0 * np.min(table.nodes) else None  # no overflow
    last = np.zeros(table.nodes.size), np.asarray(time[0]), np.zeros(())  # the first sample is a jump from 0
    if x is not None:
        last = first * np.exp(x), np.asarray(time[0] - step), np.asarray(first)
    voltages = chunks(samples._replace(observed=voltage, effects=None, charges=None, recursion=None), length)
    advance = jit(_advance_chunk, fast=time.size > MANY_SAMPLES)
    for number, (chunk, driven) in enumerate(zip(chunks(samples, length), voltages, strict=True)):
        steps = np.empty((0, length))
        if noise is not None:
            steps = drive_steps(voltage, noise, number * length, length, step)
        total, last, filtering = advance(table, chunk, driven.observed, steps, last, time[0], x, filtering)
        yield total


def drive_steps(
    voltage: np.ndarray, noise: np.ndarray, first: int, length: int, step: float
) -> Float[np.ndarray, "ages+1 samples"]:
    """Return `Compression.steps` at `length` samples, for `MAX_DELAY` ages before and after each, and 0 for padding."""
    indices = np.clip(np.arange(first - MAX_DELAY, first + length + MAX_DELAY + 1), 0, voltage.size - 1)
    slopes, noise = np.diff(voltage[indices]) / step, noise[first : first + length]
    ages = [slopes[i : i + length] for i in reversed(range(2 * MAX_DELAY))]
    return np.array([*ages, np.pad(noise, (0, length - noise.size))])


def _advance_chunk(
    table: TableNodes,
    chunk: Samples,
    voltage: Array,
    steps: Float[Array, "ages n"],
    last: tuple[Array, Array, Array],
    first: Array,
    x: Array | None,
    filtering: WhiteningState | None,
) -> tuple[Array, tuple[Array, Array, Array], WhiteningState | None]:
    """Return inner products of a chunk, and u, time and drive at its end; `x`: uniform step over the nodes."""
    time, (u, since, before) = chunk.time, last
    step, rise = jnp.diff(time, prepend=since), jnp.diff(voltage, prepend=before)
    if x is None:
        ages = step / table.nodes[:, None]
        u = jax.vmap(recurrence)(jnp.exp(-ages), rise * phi(ages), u)
    else:
        u = uniform_recurrence(rise, u, x)
    decays = [] if table.is_grid else [jnp.exp((first - time) / table.nodes[:, None])]
    times, voltages = jnp.append(since, time), jnp.append(before, voltage)
    span = jnp.append(times[2:] - times[:-2], step[-1])
    slope = jnp.append(voltages[2:] - voltages[:-2], 0.0) / jnp.where(span > 0.0, span, 1.0)
    others = jnp.concatenate([steps, baseline_functions(time, table.middle, table.half)])
    total, filtering = _inner_products(table, [u, *decays], others, slope, chunk, filtering)
    return total, (u[:, -1], time[-1], voltage[-1]), filtering


def uniform_recurrence(
    rise: Float[Array, " n"], u: Float[Array, " nodes"], x: Float[Array, " nodes"], block: int = 64
) -> Float[Array, "nodes n"]:
    """Return u[k] = e^{-x} u[k - 1] + phi(x) rise[k], i.e. `recurrence` for a uniform step, in blocks."""
    width = math.gcd(rise.size, block)
    decay, gain = jnp.exp(-x)[:, None], phi(x)[:, None]
    blocks = rise.reshape(-1, width)

    def advance_sample(u: Array, rise: Array) -> tuple[Array, Array]:
        u = decay * u + rise
        return u, u

    def advance_block(u: Array, end: Array) -> tuple[Array, Array]:
        return jnp.exp(-width * x) * u + end, u

    _, alone = lax.scan(advance_sample, jnp.zeros((x.size, len(blocks))), blocks.T)
    _, starts = lax.scan(advance_block, u / gain[:, 0], alone[-1].T)
    decays = jnp.exp(-x[:, None] * jnp.arange(1, width + 1))
    return gain * (alone.transpose(1, 2, 0) + starts.T[:, :, None] * decays[:, None]).reshape(x.size, -1)


def assemble_compression(
    table: TableNodes, functions: Mapping[str, Columns], samples: int, projected: np.ndarray | None = None
) -> Compression:
    """Return a record from coordinates of its functions, and those of functions `projected` in its place."""
    rate, slope, remainder = (functions[name][:, 0] for name in ("rate", "slope", "observed"))
    signal, effects, series = functions["signal"] @ table.series, functions["effects"].T, table.series
    decay = functions["decay"] @ (series if functions["decay"].size else series[:0])
    following = 0.0 if table.expected_rate is None else table.expected_rate * rate
    if table.expected_direct is not None:
        following = following + table.expected_direct * effects[-1]
    observed, observed_slope = remainder + signal @ table.expected_series + following, np.zeros(rate.size)
    if projected is not None:
        observed, observed_slope = projected
    compression = Compression(
        center=table.center,
        half_width=table.half_width,
        signal=signal[: len(series)],
        decay=decay,
        baseline=np.stack([functions[name][:, 0] for name in BASELINE_NAMES]),
        rate=rate,
        slope=slope,
        observed=observed,
        observed_slope=observed_slope,
        samples=np.asarray(float(samples)),
        steps=functions["steps"].T,
        origin=np.zeros(()),
        time_step=table.step,
    )
    return compression.with_functions(effects, table.expected_direct is not None)


def factor_products(
    total: Float[np.ndarray, "functions functions+projected"],
) -> tuple[Float[np.ndarray, "rows functions"], Float[np.ndarray, "rows projected"]]:
    """Return coordinates (columns) of functions that have these inner products, and of others in their span.

    With others, the last function (the record) is left out. The one before (the slope) comes last, since few samples
    determine it, whose weights may be negative. A coordinate that is 0 for all is added for the rest of the record.
    """
    total, products = np.split(total, [len(total)], axis=1)
    if not products.size:
        return _factor(total, products)
    first = slice(-2)
    rows, projected = _factor(total[first, first], np.hstack([products[first], total[first, -2:-1]]))
    projected, slope = projected[:, :-1], projected[:, -1]
    beyond = math.sqrt(max(total[-2, -2] - slope @ slope, 0.0))
    last = (products[-2] - slope @ projected) / (beyond or np.inf)
    columns = np.column_stack([rows, slope, np.zeros(len(rows))])
    return np.vstack([columns, [*np.zeros(len(rows)), beyond, 0.0], np.zeros(len(total))]), np.vstack(
        [projected, last, np.zeros(2)]
    )


def _factor(total: np.ndarray, products: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    scale = np.sqrt(np.abs(np.diagonal(total)))
    roots, values, vectors = root_products(total, scale)
    scale = np.where(scale > 0.0, scale, 1.0)
    rotation, rows = np.linalg.qr(roots)
    kept = values > 1e-11 * values[-1]  # what the others may not be projected on lies within rounding
    inverse = np.where(kept, 1.0 / np.sqrt(np.where(kept, values, 1.0)), 0.0)
    return rows, rotation.T @ (inverse[:, None] * (vectors.T @ (products / scale[:, None])))


def root_products(
    products: Float[np.ndarray, "*any n n"], scale: Float[np.ndarray, "*any n"]
) -> tuple[Float[np.ndarray, "*any n n"], Float[np.ndarray, "*any n"], Float[np.ndarray, "*any n n"]]:
    """Return columns that have these inner products, to rounding relative to the squares of `scale`.

    Also return the eigenvalues and eigenvectors of the scaled products.
    """
    scale = np.where(scale > 0.0, scale, 1.0)
    values, vectors = np.linalg.eigh(products / (scale[..., :, None] * scale[..., None, :]))
    roots = np.sqrt(np.maximum(values, 0.0))[..., None] * np.swapaxes(vectors, -1, -2)
    return roots * scale[..., None, :], values, vectors
