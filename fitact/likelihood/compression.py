"""A record's projection on the response table: after one pass, a likelihood costs the same for any length.

Under white Gaussian noise a likelihood needs from the record only its inner products with what the model
can put together: the responses u(t; tau) to the drive of one time constant, the decays of an unknown
charge, and a few slow shapes. Over a range of time constants all u(.; tau) lie, to rounding, in the span of
some twenty functions, whatever the drive: they are convolutions of dV/dt with e^{-t/tau}, and those
exponentials do. The pass adds up the inner products of these functions, the shapes and the record. Their
root then holds coordinates in which the difference between record and model has the length it has over
all samples, and as functions of log tau the coordinates are Chebyshev series.
"""

import functools
import math
from collections.abc import Iterator
from fractions import Fraction
from typing import NamedTuple, SupportsFloat

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.compiled import padded, padded_weight
from fitact.data.record import is_uniform
from fitact.model.chirp import Chirp
from fitact.model.circuit import Terms
from fitact.model.drive import Drive, Periodic, Sampled
from fitact.model.response import highpass, phi, recurrence
from fitact.progress import watched

SLOW = ("offset", "drift", "hum_50Hz_cos", "hum_50Hz_sin", "hum_60Hz_cos", "hum_60Hz_sin")

# the last of the functions whose inner products are added up
_SLOW = slice(-3 - len(SLOW), -3)
_RATE, _SLOPE, _OBSERVED = -3, -2, -1

NODES = 41  # odd, so that the middle of the table is a node
REACH = math.log(9.0)  # half width of the table in log tau
RANK = 1e-13  # singular values of what spans the responses, relative, that are left out
_EXACT = 1e-9  # of a step: how evenly samples must lie to be folded
_BLOCK = 64  # samples in a block of the recurrence
_LONGEST = 65_536  # samples until a drive repeats on the sampling grid, for folding
_CHUNK = 8_192  # samples at a time, which bounds memory


class Compression(eqx.Module):
    """A record in the coordinates of its response table.

    A vector of `rows` coordinates stands for one value a sample; lengths and angles are those over all samples.

    Attributes:
        center, reach: the table holds log tau within `reach` of `center` (tau in s).
        signal: Chebyshev coefficients in log tau of the response to the drive (V), rows below its rank being 0.
        decay: those of the decay of an unknown charge from 1 V.
        slow: the shapes of `SLOW`, of height 1.
        rate: dV/dt, V/s, where the channel follows it, else 0.
        slope: dV/dt, V/s, over two samples, so that a jump shows on both sides of it.
        observed: the record, V or A.
        samples: how many there are.
    """

    center: Float[Array, ""]
    reach: Float[Array, ""]
    signal: Float[Array, "rank terms"]
    decay: Float[Array, "rows terms"]
    slow: Float[Array, "shapes rows"]
    rate: Float[Array, " rows"]
    slope: Float[Array, " rows"]
    observed: Float[Array, " rows"]
    samples: Float[Array, ""]

    def holds(self, tau: Array) -> Array:
        """Whether the table reaches the time constant (s)."""
        return jnp.abs(jnp.log(tau) - self.center) <= self.reach

    def response(self, terms: Terms) -> Float[Array, " rows"]:
        """The response of a circuit, as `fitact.response` gives it in time."""
        total = sum(
            weight * (self.signal @ self._series(tau)) for weight, tau in zip(terms.weight, terms.tau, strict=True)
        )
        total = jnp.pad(total, (0, self.observed.size - self.signal.shape[0]))
        return total if terms.rate is None else total + terms.rate * self.rate

    def change_by_delay(self, terms: Terms) -> Float[Array, " rows"]:
        """How a delay changes it, per s: u' = V' - u / tau."""
        falling = Terms(tuple(w / t for w, t in zip(terms.weight, terms.tau, strict=True)), terms.tau)
        return self.response(falling) - sum(terms.weight) * self.slope

    def decays(self, tau: Array) -> Float[Array, " rows"]:
        """e^{-(t - t0) / tau} from the first sample on."""
        return self.decay @ self._series(tau)

    def _series(self, tau: Array) -> Float[Array, " terms"]:
        """Chebyshev polynomials at log tau."""
        x = (jnp.log(tau) - self.center) / self.reach
        terms = self.signal.shape[1]

        def step(last: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], Array]:
            return (last[1], 2.0 * x * last[1] - last[0]), last[0]

        # a loop compiles sooner, but runs slower where the terms are few
        return lax.scan(step, (jnp.ones_like(x), x), None, length=terms, unroll=terms <= NODES // 2)[1]

    def narrowed(self, center: float, reach: float, precision: float, charge: float) -> "Compression":
        """The same for log tau within `reach` of `center` only, with fewer terms and rows.

        Left-out terms change no response to the drive, and no decay of a `charge` (V), by more than `precision`
        (V, root of the sum of squares); with no charge its decay is left out altogether.
        """
        x, to_series = chebyshev(NODES)
        # nodes of the narrow table, in the wide one; by NumPy, since JAX would compile its loop for every record
        inside = (center + reach * x - float(self.center)) / float(self.reach)
        at = np.polynomial.chebyshev.chebvander(inside, self.signal.shape[1] - 1)
        signal = np.asarray(self.signal @ at.T) @ to_series.T
        decay = np.asarray(self.decay @ at.T) @ to_series.T
        sizes = np.linalg.norm(signal, axis=0) + charge * np.linalg.norm(decay, axis=0)
        left = np.cumsum(sizes[::-1])[::-1]  # what leaving out this term and all later ones would cost
        terms = in_fours(np.count_nonzero(left > precision), left.size)
        signal = np.pad(signal[:, :terms], ((0, self.observed.size - signal.shape[0]), (0, 0)))
        others = [decay[:, :terms]] if charge > 0.0 else []
        columns = [signal, *others, self.slow.T, *(x[:, None] for x in (self.rate, self.slope, self.observed))]
        _, rows = np.linalg.qr(np.hstack(columns))
        return Compression(
            center=jnp.asarray(center),
            reach=jnp.asarray(reach),
            signal=jnp.asarray(rows[:terms, :terms]),
            decay=jnp.asarray(rows[:, terms : 2 * terms] if charge > 0.0 else np.zeros((len(rows), terms))),
            slow=jnp.asarray(rows[:, _SLOW].T),
            rate=jnp.asarray(rows[:, _RATE]),
            slope=jnp.asarray(rows[:, _SLOPE]),
            observed=jnp.asarray(rows[:, _OBSERVED]),
            samples=self.samples,
        )


def compress(
    drive: Drive,
    time: Float[np.ndarray, " samples"],
    observed: Float[np.ndarray, " samples"],
    *,
    steady_state: bool,
    near: Terms,
    weight: Float[np.ndarray, " samples"] | None = None,
    rate: Float[np.ndarray, " samples"] | None = None,
) -> Compression:
    """Project a record on the responses to `drive` of time constants within a factor 9 of that of `near`.

    One pass over the arrays, a chunk at a time (so they may be `numpy.memmap`); where a steady drive repeats on
    the record's own sampling grid, its periods are folded first, exactly. Call it in double precision.

    Args:
        drive: as in `fitact.response`; a `Sampled` one has the record's own times, and may be filled up.
        time: s.
        observed: Vsc or I, V or A.
        steady_state: as in `fitact.response`.
        near: one term whose response is near the record; it is taken off before and added after, so that the
            record's noise keeps its digits.
        weight: of the samples: what multiplies their differences from a model; 0 leaves one out. None: 1.
        rate: dV/dt, V/s, for a channel that follows it.
    """
    table = _Table.around(near, time)
    samples = _Samples(time, observed, weight, rate)
    if isinstance(drive, Sampled):
        parts = _along_samples(table, drive, samples)
    else:
        period = _samples_a_period(drive, time) if steady_state else None
        if period is None:
            parts = _plainly(table, drive, samples, steady_state)
        else:
            parts = _folded(table, drive, samples, period)
    count = time.size if weight is None else int(np.count_nonzero(weight))
    parts = watched(parts, "compressing the record", math.ceil(time.size / _chunk_length(time.size)))
    return _assemble(table, sum(parts, np.zeros(())), isinstance(drive, Sampled), count)


class _Table(eqx.Module):
    """What the pass needs of the table: its nodes, and the few combinations of them that matter."""

    center: Array
    nodes: Float[Array, " nodes"]  # s
    mix: Float[Array, "nodes rank"]
    series: np.ndarray  # coefficients (rank, terms) that give back any response from those combinations
    near: Terms
    middle: Array  # of the record, s
    half: Array  # its length, s
    step: Array  # between samples, on average, s

    @classmethod
    def around(cls, near: Terms, time: np.ndarray) -> "_Table":
        (tau,) = map(float, near.tau)
        relative, mix, series = _exponentials()
        return cls(
            center=jnp.asarray(math.log(tau)),
            nodes=jnp.asarray(tau * relative),
            mix=jnp.asarray(mix),
            series=series,
            near=jax.tree.map(jnp.asarray, near),
            middle=jnp.asarray(0.5 * (time[0] + time[-1])),
            half=jnp.asarray(0.5 * (time[-1] - time[0])),
            step=jnp.asarray((time[-1] - time[0]) / (time.size - 1)),
        )


@functools.cache
def _exponentials() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes of any table over its middle, their combinations that matter, and the series that give back a response."""
    x, to_series = chebyshev(NODES)
    relative = np.exp(REACH * x)
    ages = np.concatenate([[0.0], np.geomspace(1e-3 * relative.min(), 40.0 * relative.max(), 400)])
    _, sizes, modes = np.linalg.svd(np.exp(-ages[:, None] / relative), full_matrices=False)
    rank = int(np.count_nonzero(sizes > RANK * sizes[0]))
    return relative, modes[:rank].T / sizes[:rank], (sizes[:rank, None] * modes[:rank]) @ to_series.T


def slow_shapes(time: Float[Array, " n"], middle: Array, half: Array) -> Float[Array, "6 n"]:
    """The shapes of `SLOW` in time: 1, a line from -1 to 1 over the record, and hum."""
    since = time - middle
    turns = 2.0 * np.pi * since
    waves = [wave(frequency * turns) for frequency in (50.0, 60.0) for wave in (jnp.cos, jnp.sin)]
    return jnp.stack([jnp.ones_like(since), since / half, *waves])


def slow_at(time: np.ndarray, middle: ArrayLike, half: ArrayLike) -> Float[np.ndarray, "6 n"]:
    """The same at however many times, for which nothing is compiled anew."""
    return np.asarray(_slow_shapes(padded(time), middle, half))[:, : time.size]


_slow_shapes = jax.jit(slow_shapes)


class _Samples(NamedTuple):
    """Arrays over the samples, which may be on disk."""

    time: np.ndarray
    observed: np.ndarray
    weight: np.ndarray | None
    rate: np.ndarray | None


def _chunks(samples: _Samples, length: int) -> Iterator[tuple[np.ndarray, ...]]:
    """Times, record, squared weights and dV/dt of `length` samples at a time; the last are filled up with weight 0."""
    time, observed, weight, rate = samples
    for first in range(0, time.size, length):
        part = slice(first, first + length)
        t = np.asarray(time[part])
        missing = (0, length - t.size)
        w = np.ones(t.size) if weight is None else np.asarray(weight[part]) ** 2
        slope = np.zeros(t.size) if rate is None else np.asarray(rate[part])
        yield np.pad(t, missing, mode="edge"), *(np.pad(x, missing) for x in (np.asarray(observed[part]), w, slope))


def _chunk_length(samples: int, longest: int = _CHUNK) -> int:
    return min(longest, 1 << (samples - 1).bit_length())


def _plainly(table: _Table, drive: Drive, samples: _Samples, steady_state: bool) -> Iterator[np.ndarray]:
    length = _chunk_length(samples.time.size, _LONGEST if isinstance(drive, Chirp) else _CHUNK)
    for t, y, weight, rate in _chunks(samples, length):
        yield np.asarray(_at_times(table, drive, t, y, weight, rate, None, steady_state))


@eqx.filter_jit
def _at_times(
    table: _Table,
    drive: Drive,
    time: Array,
    observed: Array,
    weight: Array,
    rate: Array,
    slow: Array | None,
    steady_state: bool,
) -> Array:
    """Inner products where the response to the drive can be computed at any time."""

    def one(tau: Array) -> Array:
        return highpass(drive, time, tau, steady_state=steady_state)

    # a chirp's many pieces are worked out for each: one after the other, not all side by side
    u = lax.map(one, table.nodes) if isinstance(drive, Chirp) else jax.vmap(one)(table.nodes)

    def voltage(time: Array) -> Array:
        return jnp.where(steady_state | (time >= 0.0), drive.value(time), 0.0)

    slope = (voltage(time + table.step) - voltage(time - table.step)) / (2.0 * table.step)
    slow = slow_shapes(time, table.middle, table.half) if slow is None else slow
    return _inner(table, u, None, slow, slope, observed, weight, rate)


def _inner(
    table: _Table,
    u: Array,
    decays: Array | None,
    slow: Array,
    slope: Array,
    observed: Array,
    weight: Array,
    rate: Array,
) -> Array:
    parts = [table.mix.T @ u] + ([] if decays is None else [table.mix.T @ decays])
    rest = observed - table.near.weight[0] * u[NODES // 2]
    if table.near.rate is not None:
        rest = rest - table.near.rate * rate
    rows = jnp.concatenate([*parts, slow, rate[None], slope[None], rest[None]])
    return (rows * weight) @ rows.T


def _folded(table: _Table, drive: Drive, samples: _Samples, period: int) -> Iterator[np.ndarray]:
    """With the periods laid over each other: the response is computed for one, the rest are sums."""
    periods = max(1, _chunk_length(samples.time.size) // period)
    reference = np.asarray(samples.observed[:period])
    count = np.zeros(period)
    sums = np.zeros((len(SLOW) + 1, period))
    squares = np.zeros((len(SLOW) + 1, len(SLOW) + 1))
    for t, y, weight, _ in _chunks(samples, periods * period):
        difference = (y.reshape(periods, period) - reference).reshape(-1)
        z = np.concatenate([slow_at(t, table.middle, table.half), difference[None]])
        count += weight.reshape(periods, period).sum(axis=0)
        weighted = z * weight
        sums += weighted.reshape(len(z), periods, period).sum(axis=1)
        squares += weighted @ z.T
    means = sums / np.where(count > 0.0, count, 1.0)
    rate = np.zeros(period) if samples.rate is None else np.asarray(samples.rate[:period])
    time, mean, rate, slow = map(padded, (np.asarray(samples.time[:period]), means[-1] + reference, rate, means[:-1]))
    total = np.array(_at_times(table, drive, time, mean, padded_weight(count), rate, slow, True))
    # what the samples of one phase scatter about their mean
    kept = np.r_[_SLOW, _OBSERVED]
    total[np.ix_(kept, kept)] += squares - means @ sums.T
    yield total


def _samples_a_period(drive: Drive, time: np.ndarray) -> int | None:
    """After how many samples drive and sampling grid meet again, if the record is long enough to gain by it."""
    if not isinstance(drive, Periodic) or not _is_even(time):
        return None
    advance = (time[-1] - time[0]) / (time.size - 1) * float(drive.frequency)  # cycles a sample
    cycles = Fraction(advance).limit_denominator(max(1, min(time.size // 2, _LONGEST)))
    rounding = 4.0 * np.finfo(float).eps * time.size
    error = abs(advance - cycles) * time.size / advance  # by the end of the record, in samples
    return cycles.denominator if cycles > 0 and error < _EXACT + rounding else None


def _is_even(time: np.ndarray) -> bool:
    """Whether the samples lie on a grid but for rounding."""
    step = (time[-1] - time[0]) / (time.size - 1)
    rounding = 4.0 * np.finfo(float).eps * max(abs(time[0]), abs(time[-1]))
    return is_uniform(time, _EXACT + rounding / step)


def _along_samples(table: _Table, drive: Sampled, samples: _Samples) -> Iterator[np.ndarray]:
    """Along a measured drive, from sample to sample."""
    time = samples.time
    length, step, first = _chunk_length(time.size), float(table.step), float(drive.samples[0])
    x = step / table.nodes if _is_even(time) and step < float(jnp.min(table.nodes)) else None
    last = jnp.zeros(NODES), jnp.asarray(time[0]), jnp.zeros(())  # the first sample is a jump from 0
    if x is not None:
        last = first * jnp.exp(x), jnp.asarray(time[0] - step), jnp.asarray(first)
    voltages = _chunks(_Samples(time, np.asarray(drive.samples)[: time.size], None, None), length)
    for (t, y, weight, rate), (_, v, _, _) in zip(_chunks(samples, length), voltages, strict=True):
        total, last = _from_sample_to_sample(table, t, v, y, weight, rate, last, time[0], x)
        yield np.asarray(total)


@eqx.filter_jit
def _from_sample_to_sample(
    table: _Table,
    time: Array,
    voltage: Array,
    observed: Array,
    weight: Array,
    rate: Array,
    last: tuple[Array, Array, Array],
    first: Array,
    x: Array | None,
) -> tuple[Array, tuple[Array, Array, Array]]:
    """Inner products along a chunk, and the response, time and drive at its end; `x`: even steps over the nodes."""
    u, since, before = last
    step, rise = jnp.diff(time, prepend=since), jnp.diff(voltage, prepend=before)
    if x is None:
        ages = step / table.nodes[:, None]
        u = jax.vmap(recurrence)(jnp.exp(-ages), rise * phi(ages), u)
    else:
        u = _evenly(rise, u, x)
    decays = jnp.exp((first - time) / table.nodes[:, None])
    times, voltages = jnp.append(since, time), jnp.append(before, voltage)
    span = jnp.append(times[2:] - times[:-2], step[-1])
    slope = jnp.append(voltages[2:] - voltages[:-2], 0.0) / jnp.where(span > 0.0, span, 1.0)
    slow = slow_shapes(time, table.middle, table.half)
    return _inner(table, u, decays, slow, slope, observed, weight, rate), (u[:, -1], time[-1], voltage[-1])


def _evenly(rise: Float[Array, " n"], u: Float[Array, " nodes"], x: Float[Array, " nodes"]) -> Float[Array, "nodes n"]:
    """u[k] = e^{-x} u[k - 1] + phi(x) rise[k]: `recurrence` for one step size, in blocks."""
    width = math.gcd(rise.size, _BLOCK)
    decay, gain = jnp.exp(-x)[:, None], phi(x)[:, None]
    blocks = rise.reshape(-1, width)

    def within(u: Array, rise: Array) -> tuple[Array, Array]:
        u = decay * u + rise
        return u, u

    def across(u: Array, end: Array) -> tuple[Array, Array]:
        return jnp.exp(-width * x) * u + end, u

    _, alone = lax.scan(within, jnp.zeros((x.size, len(blocks))), blocks.T)
    _, starts = lax.scan(across, u / gain[:, 0], alone[-1].T)
    left = jnp.exp(-x[:, None] * jnp.arange(1, width + 1))
    return gain * (alone.transpose(1, 2, 0) + starts.T[:, :, None] * left[:, None]).reshape(x.size, -1)


def _assemble(table: _Table, total: np.ndarray, decays: bool, samples: int) -> Compression:
    """Coordinates in which inner products are those that were added up."""
    size, rank = len(total), table.series.shape[0]
    scale = np.sqrt(np.diagonal(total))
    scale[scale == 0.0] = 1.0
    values, vectors = np.linalg.eigh(total / np.outer(scale, scale))
    _, rows = np.linalg.qr(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T * scale)
    signal = rows[:, :rank] @ table.series
    middle = signal @ np.cos(0.5 * np.pi * np.arange(NODES))  # Chebyshev polynomials at 0
    following = 0.0 if table.near.rate is None else float(table.near.rate) * rows[:, _RATE]
    return Compression(
        center=table.center,
        reach=jnp.asarray(REACH),
        signal=jnp.asarray(signal[:rank]),
        decay=jnp.asarray(rows[:, rank : 2 * rank] @ table.series if decays else np.zeros((size, NODES))),
        slow=jnp.asarray(rows[:, _SLOW].T),
        rate=jnp.asarray(rows[:, _RATE]),
        slope=jnp.asarray(rows[:, _SLOPE]),
        observed=jnp.asarray(rows[:, _OBSERVED] + float(table.near.weight[0]) * middle + following),
        samples=jnp.asarray(float(samples)),
    )


def in_fours(count: SupportsFloat, most: int) -> int:
    """Columns to keep where `count` of `most` matter; in fours, so that most records share what is compiled."""
    return min(4 * max(1, math.ceil(float(count) / 4)), most)


def chebyshev(count: int) -> tuple[np.ndarray, np.ndarray]:
    """The nodes in [-1, 1], and the matrix from values there to a series' coefficients (terms, nodes)."""
    angle = np.pi * (np.arange(count) + 0.5) / count
    matrix = 2.0 / count * np.cos(np.arange(count)[:, None] * angle)
    matrix[0] *= 0.5
    return np.cos(angle), matrix
