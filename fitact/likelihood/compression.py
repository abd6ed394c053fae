"""Projection of a record on a table of responses, after which the cost of a likelihood is independent of its length.

For white Gaussian noise, the likelihood depends on the record only through its inner products with the functions of
the model: the responses u(t; tau) to the drive, the decays of an unknown charge, and a few slow shapes. Over a range
of time constants, all u(.; tau) lie, to rounding, in the span of some twenty functions for any drive, since they are
convolutions of dV/dt with e^{-t/tau}, and these exponentials do. One pass accumulates the inner products of these
functions, the shapes and the record. A factor of this matrix gives coordinates in which the difference between record
and model has the same length as over all samples. As functions of log tau, the coordinates are Chebyshev series.
"""

import functools
import math
from collections.abc import Iterator
from fractions import Fraction
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.compiled import array_module, jit, pad_samples, pad_weight
from fitact.data.record import is_uniform
from fitact.model.chirp import Chirp
from fitact.model.circuit import HighpassTerms
from fitact.model.drive import Drive, Periodic, Sampled
from fitact.model.response import highpass, phi, recurrence
from fitact.model.response_table import (
    NODES,
    TABLE_HALF_WIDTH,
    chebyshev,
    chebyshev_polynomials,
    count_terms,
)
from fitact.progress import track_progress

BASELINE_NAMES = ("offset", "drift", "hum_50Hz_cos", "hum_50Hz_sin", "hum_60Hz_cos", "hum_60Hz_sin")

# indices of the last functions of the inner products
_RATE, _SLOPE, _OBSERVED = -3, -2, -1
_BASELINE = slice(_RATE - len(BASELINE_NAMES), _RATE)

RANK_TOLERANCE = 1e-13  # relative size of the singular values that are omitted


class Compression(eqx.Module):
    """A record in coordinates of its response table.

    A vector of `rows` coordinates represents one value per sample, with the same inner products as over all samples.
    """

    center: Float[Array, ""]  # the table covers log tau in `center` ± `half_width` (tau in s)
    half_width: Float[Array, ""]
    # Chebyshev coefficients in log tau of the response to the drive (V); rows beyond the rank are 0
    signal: Float[Array, "rank terms"]
    decay: Float[Array, "rows terms"]  # the same for the decay of an unknown charge from 1 V
    baseline: Float[Array, "shapes rows"]  # the shapes of `BASELINE_NAMES`, of height 1
    rate: Float[Array, " rows"]  # dV/dt, V/s, if the channel follows it, else 0
    slope: Float[Array, " rows"]  # dV/dt, V/s, over two samples, so that a jump appears on both sides
    observed: Float[Array, " rows"]  # the record, V or A
    samples: Float[Array, ""]  # number of samples

    def covers(self, tau: Array) -> Array:
        """Return whether the table covers the time constant (s)."""
        return abs(array_module(tau).log(tau) - self.center) <= self.half_width

    def response(self, terms: HighpassTerms) -> Float[Array, " rows"]:
        """Return the response of a circuit; compare `fitact.response`."""
        total = sum(
            weight * (self.signal @ self._series(tau)) for weight, tau in zip(terms.weight, terms.tau, strict=True)
        )
        total = jnp.pad(total, (0, self.observed.size - self.signal.shape[0]))
        return total if terms.rate is None else total + terms.rate * self.rate

    def delay_derivative(self, terms: HighpassTerms) -> Float[Array, " rows"]:
        """Return the derivative of the response with respect to a delay (per s): u / tau - V' for each term."""
        falling = HighpassTerms(tuple(w / t for w, t in zip(terms.weight, terms.tau, strict=True)), terms.tau)
        return self.response(falling) - sum(terms.weight) * self.slope

    def decays(self, tau: Array) -> Float[Array, " rows"]:
        """Return e^{-(t - t0) / tau}, where t0 is the first sample."""
        return self.decay @ self._series(tau)

    def _series(self, tau: Array) -> Float[Array, " terms"]:
        return chebyshev_polynomials((jnp.log(tau) - self.center) / self.half_width, self.signal.shape[1])

    def restrict(self, center: float, half_width: float, precision: float, charge: float) -> "Compression":
        """Return the compression for log tau in `center` ± `half_width` only, with fewer terms and rows.

        Omitted terms change no response, and no decay of a `charge` (V), by more than `precision` (V, root of the
        sum of squares). If `charge` is 0, the decay is omitted.
        """
        x, to_series = chebyshev(NODES)
        # nodes of the narrow table in the wide one, with NumPy because JAX would compile its loop for every record
        inside = (center + half_width * x - float(self.center)) / float(self.half_width)
        polynomials = np.polynomial.chebyshev.chebvander(inside, self.signal.shape[1] - 1).T
        signal = np.asarray(self.signal @ polynomials) @ to_series.T
        decay = np.asarray(self.decay @ polynomials) @ to_series.T
        terms = count_terms(np.linalg.norm(signal, axis=0) + charge * np.linalg.norm(decay, axis=0), precision)
        signal = np.pad(signal[:, :terms], ((0, self.observed.size - signal.shape[0]), (0, 0)))
        others = [decay[:, :terms]] if charge > 0.0 else []
        columns = [signal, *others, self.baseline.T, *(x[:, None] for x in (self.rate, self.slope, self.observed))]
        _, rows = np.linalg.qr(np.hstack(columns))
        decay = rows[:, terms : 2 * terms] if charge > 0.0 else np.zeros((len(rows), terms))
        table = center, half_width, rows[:terms, :terms], decay
        return Compression(*map(np.asarray, (*table, *_baseline_and_record(rows), self.samples)))


def _baseline_and_record(rows: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the last columns, in the order of the fields of `Compression`."""
    return rows[:, _BASELINE].T, rows[:, _RATE], rows[:, _SLOPE], rows[:, _OBSERVED]


def compress(
    drive: Drive,
    time: Float[np.ndarray, " samples"],
    observed: Float[np.ndarray, " samples"],
    *,
    steady_state: bool,
    expected_terms: HighpassTerms,
    weight: Float[np.ndarray, " samples"] | None = None,
    rate: Float[np.ndarray, " samples"] | None = None,
) -> Compression:
    """Project a record on responses to `drive`, for time constants within a factor 9 of the one in `expected_terms`.

    This is one pass over the arrays in chunks, which may be `numpy.memmap`. If a steady drive repeats on the sampling
    grid of the record, its periods are first folded exactly. Double precision is required.

    A `Sampled` drive has the times of the record, and may be padded. `expected_terms` is one term whose response is
    close to the record; it is subtracted before and added after, so that the noise keeps its digits. `weight`
    multiplies the residuals of the samples (0 excludes a sample, None means 1). `rate` is dV/dt (V/s) for a channel
    that follows it.
    """
    table = _TableNodes.from_terms(expected_terms, time)
    squares = np.broadcast_to(1.0 if weight is None else np.square(weight), time.size)
    samples = _Samples(time, observed, squares, np.broadcast_to(0.0 if rate is None else rate, time.size))
    if isinstance(drive, Sampled):
        parts = _accumulate_measured(table, drive, samples)
    else:
        period = _samples_per_period(drive, time) if steady_state else None
        if period is None:
            parts = _accumulate_directly(table, drive, samples, steady_state)
        else:
            parts = _accumulate_folded(table, drive, samples, period)
    parts = track_progress(parts, "compressing the record", math.ceil(time.size / _chunk_length(time.size)))
    return _assemble(table, sum(parts, np.zeros(())), isinstance(drive, Sampled), int(np.count_nonzero(squares)))


class _TableNodes(eqx.Module):
    """Response table during the pass: its nodes, and the few significant combinations of their responses."""

    center: Array
    nodes: Float[Array, " nodes"]  # s
    combinations: Float[Array, "nodes rank"]
    series: np.ndarray  # coefficients (rank, terms) of any response in these combinations
    expected_terms: HighpassTerms
    middle: Array  # of the record, s
    half: Array  # half the length of the record, s
    step: Array  # mean time step, s

    @classmethod
    def from_terms(cls, expected_terms: HighpassTerms, time: np.ndarray) -> "_TableNodes":
        (tau,) = map(float, expected_terms.tau)
        relative, mix, series = _exponentials()
        return cls(
            center=np.asarray(math.log(tau)),
            nodes=tau * relative,
            combinations=mix,
            series=series,
            expected_terms=jax.tree.map(np.asarray, expected_terms),
            middle=np.asarray(0.5 * (time[0] + time[-1])),
            half=np.asarray(0.5 * (time[-1] - time[0])),
            step=np.asarray((time[-1] - time[0]) / (time.size - 1)),
        )


@functools.cache
def _exponentials() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the nodes of a table relative to its centre, their significant combinations, and the series in these."""
    x, to_series = chebyshev(NODES)
    relative = np.exp(TABLE_HALF_WIDTH * x)
    ages = np.concatenate([[0.0], np.geomspace(1e-3 * relative.min(), 40.0 * relative.max(), 400)])
    _, sizes, modes = np.linalg.svd(np.exp(-ages[:, None] / relative), full_matrices=False)
    rank = int(np.count_nonzero(sizes > RANK_TOLERANCE * sizes[0]))
    return relative, modes[:rank].T / sizes[:rank], (sizes[:rank, None] * modes[:rank]) @ to_series.T


def baseline_functions(time: Float[Array, " n"], middle: Array, half: Array) -> Float[Array, "6 n"]:
    """Return the shapes of `BASELINE_NAMES` in time: 1, a line from -1 to 1 over the record, and hum."""
    since = time - middle
    turns = 2.0 * np.pi * since
    waves = [wave(frequency * turns) for frequency in (50.0, 60.0) for wave in (jnp.cos, jnp.sin)]
    return jnp.stack([jnp.ones_like(since), since / half, *waves])


def evaluate_baseline(time: np.ndarray, middle: ArrayLike, half: ArrayLike) -> Float[np.ndarray, "6 n"]:
    """Return `baseline_functions` at any number of times without compilation."""
    return _baseline_functions(pad_samples(time), np.asarray(middle), np.asarray(half))[:, : time.size]


_baseline_functions = jit(baseline_functions)


class _Samples(NamedTuple):
    """Arrays over all samples (possibly on disk) or over a chunk of them."""

    time: np.ndarray
    observed: np.ndarray
    weight: np.ndarray  # weight of the squares
    rate: np.ndarray  # dV/dt


def _chunks(samples: _Samples, length: int) -> Iterator[_Samples]:
    """Yield chunks of `length` samples; the last is padded with weight 0."""
    for first in range(0, samples.time.size, length):
        time, *others = (np.asarray(x[first : first + length]) for x in samples)
        missing = (0, length - time.size)
        yield _Samples(np.pad(time, missing, mode="edge"), *(np.pad(x, missing) for x in others))


def _chunk_length(samples: int, longest: int = 8_192) -> int:
    """Return the number of samples in a chunk, which bounds the memory."""
    return min(longest, 1 << (samples - 1).bit_length())


def _accumulate_directly(
    table: _TableNodes, drive: Drive, samples: _Samples, steady_state: bool
) -> Iterator[np.ndarray]:
    size = samples.time.size
    length = _chunk_length(size, 65_536) if isinstance(drive, Chirp) else _chunk_length(size)  # of few chirps
    for chunk in _chunks(samples, length):
        yield _chunk_products(table, drive, chunk, None, steady_state)


@jit
def _chunk_products(
    table: _TableNodes, drive: Drive, chunk: _Samples, baseline: Array | None, steady_state: bool
) -> Array:
    """Return the inner products of a chunk, for a drive whose response can be computed at any time."""
    time = chunk.time

    def respond(tau: Array) -> Array:
        return highpass(drive, time, tau, steady_state=steady_state)

    # the many pieces of a chirp are computed anew for each node, one node at a time to save memory
    u = lax.map(respond, table.nodes) if isinstance(drive, Chirp) else jax.vmap(respond)(table.nodes)

    def voltage(time: Array) -> Array:
        return jnp.where(steady_state | (time >= 0.0), drive.value(time), 0.0)

    slope = (voltage(time + table.step) - voltage(time - table.step)) / (2.0 * table.step)
    baseline = baseline_functions(time, table.middle, table.half) if baseline is None else baseline
    return _inner_products(table, [u], baseline, slope, chunk)


def _inner_products(
    table: _TableNodes, responses: list[Array], baseline: Array, slope: Array, chunk: _Samples
) -> Array:
    """Return the inner products of the responses (and charge decays) at the nodes, the shapes and the record."""
    rest = chunk.observed - table.expected_terms.weight[0] * responses[0][NODES // 2]
    if table.expected_terms.rate is not None:
        rest = rest - table.expected_terms.rate * chunk.rate
    parts = [table.combinations.T @ response for response in responses]
    rows = jnp.concatenate([*parts, baseline, chunk.rate[None], slope[None], rest[None]])
    return (rows * chunk.weight) @ rows.T


def _accumulate_folded(table: _TableNodes, drive: Drive, samples: _Samples, period: int) -> Iterator[np.ndarray]:
    """Yield the inner products from folded periods; the response is computed for one period only."""
    periods = max(1, _chunk_length(samples.time.size) // period)
    reference = np.asarray(samples.observed[:period])
    count = np.zeros(period)
    sums = np.zeros((len(BASELINE_NAMES) + 1, period))
    squares = np.zeros((len(BASELINE_NAMES) + 1, len(BASELINE_NAMES) + 1))
    for t, y, weight, _ in _chunks(samples, periods * period):
        difference = (y.reshape(periods, period) - reference).reshape(-1)
        z = np.concatenate([evaluate_baseline(t, table.middle, table.half), difference[None]])
        count += weight.reshape(periods, period).sum(axis=0)
        weighted = z * weight
        sums += weighted.reshape(len(z), periods, period).sum(axis=1)
        squares += weighted @ z.T
    means = sums / np.where(count > 0.0, count, 1.0)
    time, rate = (np.asarray(x[:period]) for x in (samples.time, samples.rate))
    time, mean, rate, baseline = map(pad_samples, (time, means[-1] + reference, rate, means[:-1]))
    folded = _Samples(time, mean, pad_weight(count), rate)
    total = np.array(_chunk_products(table, drive, folded, baseline, True))
    # scatter of the samples of one phase about their mean
    kept = np.r_[_BASELINE, _OBSERVED]
    total[np.ix_(kept, kept)] += squares - means @ sums.T
    yield total


def _samples_per_period(
    drive: Drive, time: np.ndarray, max_samples: int = 65_536, tolerance: float = 1e-9
) -> int | None:
    """Return after how many samples drive and grid coincide (to `tolerance` steps), or None if folding is useless."""
    if not isinstance(drive, Periodic) or not _is_exactly_uniform(time):
        return None
    advance = (time[-1] - time[0]) / (time.size - 1) * float(drive.frequency)  # cycles per sample
    cycles = Fraction(advance).limit_denominator(max(1, min(time.size // 2, max_samples)))
    rounding = 4.0 * np.finfo(float).eps * time.size
    error = abs(advance - cycles) * time.size / advance  # at the end of the record, in samples
    return cycles.denominator if cycles > 0 and error < tolerance + rounding else None


def _is_exactly_uniform(time: np.ndarray, tolerance: float = 1e-9) -> bool:
    """Return whether the samples lie on a uniform grid, to `tolerance` of a step plus rounding."""
    step = (time[-1] - time[0]) / (time.size - 1)
    rounding = 4.0 * np.finfo(float).eps * max(abs(time[0]), abs(time[-1]))
    return is_uniform(time, tolerance + rounding / step)


def _accumulate_measured(table: _TableNodes, drive: Sampled, samples: _Samples) -> Iterator[np.ndarray]:
    """Yield the inner products of each chunk for a measured drive."""
    time = samples.time
    length, step, first = _chunk_length(time.size), float(table.step), float(drive.samples[0])
    x = step / table.nodes if _is_exactly_uniform(time) and step < np.min(table.nodes) else None
    last = np.zeros(NODES), np.asarray(time[0]), np.zeros(())  # the first sample is a jump from 0
    if x is not None:
        last = first * np.exp(x), np.asarray(time[0] - step), np.asarray(first)
    voltages = _chunks(samples._replace(observed=np.asarray(drive.samples)[: time.size]), length)
    for chunk, driven in zip(_chunks(samples, length), voltages, strict=True):
        total, last = _advance_chunk(table, chunk, driven.observed, last, time[0], x)
        yield total


@jit
def _advance_chunk(
    table: _TableNodes,
    chunk: _Samples,
    voltage: Array,
    last: tuple[Array, Array, Array],
    first: Array,
    x: Array | None,
) -> tuple[Array, tuple[Array, Array, Array]]:
    """Return inner products of a chunk, and u, time and drive at its end; `x`: uniform step over the nodes."""
    time, (u, since, before) = chunk.time, last
    step, rise = jnp.diff(time, prepend=since), jnp.diff(voltage, prepend=before)
    if x is None:
        ages = step / table.nodes[:, None]
        u = jax.vmap(recurrence)(jnp.exp(-ages), rise * phi(ages), u)
    else:
        u = _uniform_recurrence(rise, u, x)
    decays = jnp.exp((first - time) / table.nodes[:, None])
    times, voltages = jnp.append(since, time), jnp.append(before, voltage)
    span = jnp.append(times[2:] - times[:-2], step[-1])
    slope = jnp.append(voltages[2:] - voltages[:-2], 0.0) / jnp.where(span > 0.0, span, 1.0)
    baseline = baseline_functions(time, table.middle, table.half)
    return _inner_products(table, [u, decays], baseline, slope, chunk), (u[:, -1], time[-1], voltage[-1])


def _uniform_recurrence(
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


def _assemble(table: _TableNodes, total: np.ndarray, decays: bool, samples: int) -> Compression:
    """Return coordinates that have the accumulated inner products."""
    size, rank = len(total), table.series.shape[0]
    scale = np.sqrt(np.diagonal(total))
    scale[scale == 0.0] = 1.0
    values, vectors = np.linalg.eigh(total / np.outer(scale, scale))
    _, rows = np.linalg.qr(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T * scale)
    signal = rows[:, :rank] @ table.series
    decay = rows[:, rank : 2 * rank] @ table.series if decays else np.zeros((size, NODES))
    middle = signal @ np.cos(0.5 * np.pi * np.arange(NODES))  # Chebyshev polynomials at 0
    baseline, rate, slope, remainder = _baseline_and_record(rows)
    following = 0.0 if table.expected_terms.rate is None else float(table.expected_terms.rate) * rate
    observed = remainder + float(table.expected_terms.weight[0]) * middle + following
    arrays = table.center, TABLE_HALF_WIDTH, signal[:rank], decay, baseline, rate, slope, observed, float(samples)
    return Compression(*map(np.asarray, arrays))
