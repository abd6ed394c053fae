"""Compression of many windows of one record at once, which is the cost of following a finger over time.

All windows have the same length and time step, so that slow shapes and the decays of an unknown charge are common to
all. The responses to the recorded drive are first-order recursive filters, whose state goes on from window to window.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, Self

import numpy as np
import scipy.signal
from jaxtyping import Float

from fitact.likelihood.channel import ChannelLikelihood
from fitact.likelihood.charge_rows import LAG, ChargeRows, step_means, whiten_rows
from fitact.likelihood.compression import BASELINE_NAMES, Compression
from fitact.likelihood.likelihood import CircuitValues
from fitact.likelihood.noise import Whitening
from fitact.likelihood.projection import (
    MAX_DELAY,
    TableNodes,
    assemble_compression,
    drive_steps,
    evaluate_baseline,
)

REACH = 4.0  # factor by which b may change
REACH_NODES = 21  # of the table, whose series then ends at 1e-8
RANK = 14  # combinations of responses that represent those of the table, to 2e-7
TREND_RANK = 6  # combinations of responses that represent those to a small trend, to 0.3 %


class FilterState(NamedTuple):
    """State of the responses at the end of a window, from which the next one goes on."""

    end: float  # time of the first sample after the window, s
    voltage: float  # last V
    memory: Float[np.ndarray, "nodes 1"]  # of the filters
    age: float  # time since the drive was first known, s


class TrendInputs(NamedTuple):
    """Inputs of what a trend within a window adds to a channel, in its coordinates; times are from its middle, s."""

    signal: Float[np.ndarray, "rows terms"]  # time times the response to the drive, as `Compression.signal`
    rate: Float[np.ndarray, " rows"]  # time times dV/dt
    voltage: Float[np.ndarray, " rows"]  # V itself


Samples = Float[np.ndarray, " samples"]
# makes the rows of charge of a current from those of the functions that it consists of, beside dV/dt
MakeRows = Callable[[Sequence[Float[np.ndarray, "functions samples"]]], ChargeRows]


@dataclasses.dataclass(frozen=True)
class WindowCompressor:
    """Compresses windows of `time.size` samples; `channels` are those of a fit to one of them."""

    channels: tuple[ChannelLikelihood, ...]
    tables: tuple[TableNodes, ...]  # of the channels
    time: Float[np.ndarray, " samples"]  # from the start of a window, s
    # decays in the combinations of the table, and the baseline that each channel has; rows of a current
    shared: tuple[Float[np.ndarray, "functions samples"], ...]

    @classmethod
    def from_channels(
        cls, channels: Sequence[ChannelLikelihood], circuit: CircuitValues, samples: int, step: float
    ) -> Self:
        """Make the tables around the time constants of a circuit, a factor `REACH` either way."""
        time = step * np.arange(samples)
        reach = (math.log(REACH), REACH_NODES) if len(circuit.tau) == 1 else None
        tables, shared = [], []
        for each in channels:
            table = TableNodes.from_terms(circuit.terms[each.channel], time, narrow=False, reach=reach)
            if reach is not None:
                kept = slice(RANK)
                table = dataclasses.replace(table, combinations=table.combinations[:, kept], series=table.series[kept])
            baseline = evaluate_baseline(time, table.middle, table.half)[_baseline_columns(each)]
            functions = np.concatenate([_decays(table, time), baseline])
            tables.append(table)
            shared.append(functions if each.charges is None else step_means(functions))
        return cls(tuple(channels), tuple(tables), time, tuple(shared))

    def compress(
        self,
        V: Samples,
        given: Sequence[Samples | MakeRows],
        weights: Sequence[Samples | None],
        responses: Float[np.ndarray, "nodes samples"],
        has_charge: bool,
    ) -> tuple[tuple[Compression, ...], tuple[TrendInputs, ...], Compression | None]:
        """Compress a window with the drive `V`: each channel's samples and weights, or rows of charge.

        `responses` are those of `respond`. With `has_charge`, the charge at the first sample is unknown. Also returns
        what a trend within the window needs, and the samples of the responses if the first channel is whitened.
        """
        late, rank = self.time - 0.5 * self.time[-1], len(self.tables[0].series)
        functions = np.empty((rank + TREND_RANK + 2, V.size))
        combined = np.matmul(self.tables[0].combinations.T, responses, out=functions[:rank])
        np.multiply(late, combined[:TREND_RANK], out=functions[rank:-2])
        functions[-2], found = V, []
        for i, pair in enumerate(zip(given, weights, strict=True)):
            functions[-1] = self.tables[i].expected @ responses
            found.append(self._compress_channel(i, late, functions, *pair, has_charge))
        parts, inputs = zip(*found, strict=True)
        if self.channels[0].charges is None and self.channels[0].whitening is None:
            return parts, inputs, None
        decays = _decays(self.tables[0], self.time)[: rank * has_charge]
        rows = np.concatenate([combined, decays])
        total = np.zeros(2 * [2 * rank + len(BASELINE_NAMES) + 3])
        total[: len(rows), : len(rows)] = rows @ rows.T
        return parts, inputs, assemble_compression(self.tables[0], total, True, 0, 0, V.size)

    def _compress_channel(
        self,
        index: int,
        late: Samples,
        functions: Float[np.ndarray, "functions samples"],
        given: Samples | MakeRows,
        weight: Samples | None,
        has_charge: bool,
    ) -> tuple[Compression, TrendInputs]:
        """Compress a channel; the `functions` are the responses, those of trends, V, and what the tables expect."""
        channel, table, step = self.channels[index], self.tables[index], float(self.time[1])
        rank, effects, charged = len(table.series), len(channel.effect_sizes), has_charge * len(table.series)
        shared, steps = self.shared[index][rank - charged :], np.empty((0, late.size))
        rows = None
        if callable(given):
            functions = step_means(functions)
            rows = given([functions[:-2], shared])
            rate, slope, observed = rows.rate, rows.bend, rows.observed
            late, count = late - (LAG - 0.5) * step, max(round(float(rows.count)), 1)
        else:
            rate, slope, observed = np.zeros(late.size), np.gradient(functions[-2], step), given
            whitening = None if channel.whitening is None else _make_filter(channel.whitening, weight, late.size)
            used = weight if whitening is None else whitening.mask
            count = late.size if used is None else int(np.count_nonzero(used))
            if channel.timing:
                steps = drive_steps(functions[-2], 0, late.size, MAX_DELAY) / step
        rest = observed - functions[-1] - (0.0 if table.expected_rate is None else table.expected_rate * rate)
        own = functions[:rank], shared[:charged], functions[rank:-2], [late * rate, functions[-2]], steps
        products = np.concatenate([*own, shared[charged:], [rate, slope, rest]])
        if rows is not None:
            products = whiten_rows(rows.gain, rows.decay, products) * rows.used
        elif whitening is not None:
            products = whitening.filter(np.pad(products, [(0, 0), (whitening.taps.size - 1, 0)]))
        elif weight is not None:
            products = products * weight
        # functions that are absent are 0
        first = 2 * rank + effects
        begin = first + TREND_RANK + 2 + len(steps)
        places = [*range(rank + charged), *range(first, begin)]
        places += [begin + column for column in _baseline_columns(channel)]
        end = begin + len(BASELINE_NAMES)
        places += range(end, end + 3)
        total = np.zeros((end + 3, end + 3))
        total[np.ix_(places, places)] = products @ products.T
        whole = assemble_compression(table, total, True, len(steps), effects + TREND_RANK + 2, count)
        assert whole.effects is not None
        *late_parts, late_rate, voltage = whole.effects[effects:]
        late_signal = np.transpose(late_parts) @ table.series[:TREND_RANK]
        whole = dataclasses.replace(whole, effects=whole.effects[:effects] if effects else None)
        return whole, TrendInputs(late_signal, late_rate, voltage)

    def expect(self, V: Samples, responses: Float[np.ndarray, "nodes samples"]) -> Samples:
        """Return the samples of the first channel with the tables' circuit, without its charge."""
        table = self.tables[0]
        signal = table.expected @ responses
        return signal if table.expected_rate is None else signal + table.expected_rate * np.gradient(V, self.time[1])

    def respond(
        self, V: Float[np.ndarray, " samples"], start: float, before: FilterState | None
    ) -> tuple[Float[np.ndarray, "nodes samples"], FilterState]:
        """Return the responses at the nodes to the V of a window from `start` (s) on, and their state at its end.

        u[k] = e^{-x} u[k - 1] + phi(x) (V[k] - V[k - 1]). Without a state `before`, V was constant before the window.
        """
        step = float(self.time[1])
        rise = np.diff(V, prepend=V[0] if before is None else before.voltage)
        nodes = self.tables[0].nodes
        memory = np.zeros((nodes.size, 1)) if before is None else before.memory
        responses, left = np.empty((nodes.size, V.size)), np.empty((nodes.size, 1))
        for i, x in enumerate(step / nodes):
            responses[i], left[i] = scipy.signal.lfilter([-np.expm1(-x) / x], [1.0, -np.exp(-x)], rise, zi=memory[i])
        length = step * V.size
        age = length + (0.0 if before is None else before.age)
        return responses, FilterState(start + length, float(V[-1]), left, age)


def _make_filter(fitted: Whitening, weight: Samples | None, samples: int) -> Whitening:
    """Return the filter of the fitted window for another one, which begins without the samples before it."""
    taps = np.asarray(fitted.taps)
    whitening = Whitening(taps, np.where(np.arange(samples) < taps.size - 1, 0.0, 1.0))
    return whitening if weight is None else whitening.exclude(weight == 0.0)


def _decays(table: TableNodes, time: Samples) -> Float[np.ndarray, "rank samples"]:
    return table.combinations.T @ np.exp(-time / table.nodes[:, None])


def _baseline_columns(channel: ChannelLikelihood) -> list[int]:
    return [column for column in channel.columns if column < len(BASELINE_NAMES)]
