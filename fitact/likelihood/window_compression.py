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
from fitact.likelihood.projection import (
    MAX_DELAY,
    TableNodes,
    assemble_compression,
    drive_steps,
    evaluate_baseline,
)

REACH = 4.0  # factor by which b may change
REACH_NODES = 29  # of the table, whose series then ends at 1e-12
RANK = 16  # combinations of responses that represent those of the table, to 1e-8
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
MakeRows = Callable[[Float[np.ndarray, "functions samples"]], ChargeRows]


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
            decays = table.combinations.T @ np.exp(-time / table.nodes[:, None])
            baseline = evaluate_baseline(time, table.middle, table.half)[_baseline_columns(each)]
            functions = np.concatenate([decays, baseline])
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
        what a trend within the window needs, and the samples of the responses if the first channel has rows instead.
        """
        step, late = float(self.time[1]), self.time - 0.5 * self.time[-1]
        combined = self.tables[0].combinations.T @ responses
        functions = np.concatenate([combined, late * combined[:TREND_RANK], V[None]])
        found = [
            self._compress_channel(i, V, late, functions, self.tables[i].expected @ responses, *pair, has_charge)
            for i, pair in enumerate(zip(given, weights, strict=True))
        ]
        parts, inputs = zip(*found, strict=True)
        if self.channels[0].charges is None:
            return parts, inputs, None
        rank, nodes = len(combined), self.tables[0].nodes
        decays = self.tables[0].combinations.T @ np.exp(-self.time / nodes[:, None]) if has_charge else combined[:0]
        rows = np.concatenate([combined, decays])
        total = np.zeros(2 * [2 * rank + len(BASELINE_NAMES) + 3])
        total[: len(rows), : len(rows)] = rows @ rows.T
        return parts, inputs, assemble_compression(self.tables[0], total, True, 0, 0, V.size)

    def _compress_channel(
        self,
        index: int,
        V: Samples,
        late: Samples,
        functions: Float[np.ndarray, "functions samples"],
        expected: Samples,
        given: Samples | MakeRows,
        weight: Samples | None,
        has_charge: bool,
    ) -> tuple[Compression, TrendInputs]:
        """Compress a channel, in which the `functions` are the responses, those of trends, and V."""
        channel, table, step = self.channels[index], self.tables[index], float(self.time[1])
        rank, effects = len(table.series), len(channel.effect_sizes)
        shared = self.shared[index][0 if has_charge else rank :]
        steps = np.empty((0, V.size))
        if callable(given):
            *means, expected = step_means(np.concatenate([functions, expected[None]]))
            functions = np.stack(means)
            rows = given(np.concatenate([functions[:-1], shared]))
            rate, slope, observed = rows.rate, rows.slope, rows.observed
            late, count = late - (LAG - 0.5) * step, int(np.count_nonzero(rows.gain))
        else:
            rate, slope, observed = np.zeros(V.size), np.gradient(V, step), given
            count = V.size if weight is None else int(np.count_nonzero(weight))
            if channel.timing:
                steps = drive_steps(V, 0, V.size, MAX_DELAY) / step
        rest = observed - expected - (0.0 if table.expected_rate is None else table.expected_rate * rate)
        decays, baseline = shared[: rank * has_charge], shared[rank * has_charge :]
        late_rate = [late * rate, functions[-1]]
        own = [functions[:rank], decays, functions[rank:-1], late_rate, steps, baseline, [rate, slope, rest]]
        products = np.concatenate(own)
        if callable(given):
            products = whiten_rows(rows.gain, rows.decay, products)
        elif weight is not None:
            products = products * weight
        # functions that are absent are 0
        first = 2 * rank + effects
        begin = first + TREND_RANK + 2 + len(steps)
        places = [*range(rank + rank * has_charge), *range(first, begin)]
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


def _baseline_columns(channel: ChannelLikelihood) -> list[int]:
    return [column for column in channel.columns if column < len(BASELINE_NAMES)]
