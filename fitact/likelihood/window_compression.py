"""Compression of many windows of one record at once, which is the cost of following a finger over time.

All windows have the same length and time step, so that slow shapes and the decays of an unknown charge are common to
all. The responses to the recorded drive are first-order recursive filters, whose state goes on from window to window.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
import scipy.signal
from jaxtyping import Float

from fitact.likelihood.channel import ChannelLikelihood
from fitact.likelihood.compression import Compression
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


@dataclasses.dataclass(frozen=True)
class WindowCompressor:
    """Compresses windows of `time.size` samples; `channels` are those of a fit to one of them."""

    channels: tuple[ChannelLikelihood, ...]
    tables: tuple[TableNodes, ...]  # of the channels
    time: Float[np.ndarray, " samples"]  # from the start of a window, s
    shared: Float[np.ndarray, "functions samples"]  # decays in the combinations of the table, and slow shapes

    @classmethod
    def from_channels(
        cls, channels: Sequence[ChannelLikelihood], circuit: CircuitValues, samples: int, step: float
    ) -> Self:
        """Make the tables around the time constants of a circuit, a factor `REACH` either way."""
        time = step * np.arange(samples)
        reach = (math.log(REACH), REACH_NODES) if len(circuit.tau) == 1 else None
        tables = [
            TableNodes.from_terms(circuit.terms[each.channel], time, narrow=False, reach=reach) for each in channels
        ]
        first = tables[0]
        decays = first.combinations.T @ np.exp(-time / first.nodes[:, None])
        baseline = evaluate_baseline(time, first.middle, first.half)
        return cls(tuple(channels), tuple(tables), time, np.concatenate([decays, baseline]))

    def compress(
        self,
        V: Float[np.ndarray, " samples"],
        rests: Sequence[Float[np.ndarray, " samples"]],
        rates: Sequence[Float[np.ndarray, " samples"] | None],
        weights: Sequence[Float[np.ndarray, " samples"] | None],
        responses: Float[np.ndarray, "nodes samples"],
        has_charge: bool,
    ) -> tuple[tuple[Compression, ...], tuple[TrendInputs, ...]]:
        """Compress a window with the drive `V`: each channel's rest, dV/dt where it follows that, and weights.

        `responses` are those of `respond`, and the rests those of `subtract_expected`. With `has_charge`, the charge at
        the first sample is unknown. Also returns what a trend within the window needs.
        """
        table, step = self.tables[0], self.time[1]
        combined = table.combinations.T @ responses
        ages = MAX_DELAY if any(channel.timing for channel in self.channels) else 0
        steps, zero = drive_steps(V, 0, V.size, ages) / step, np.zeros(V.size)
        followed = [zero if rate is None else rate for rate in rates]
        rank = len(combined)
        late = self.time - 0.5 * self.time[-1]
        trends = [*(late * combined[:TREND_RANK]), *(late * each for each in followed)]
        shared = self.shared if has_charge else self.shared[rank:]
        # all channels with the same weights share the products of what they share
        rows = np.concatenate([combined, shared, steps, [zero, np.gradient(V, step)], followed, rests, trends, [V]])
        begin = rank + len(shared)
        last, products, parts, inputs = begin + len(steps), dict[int, np.ndarray](), [], []
        first_trend, count_trends = len(rows) - 1 - len(trends), len(trends) - len(followed)
        baseline = begin - (len(self.shared) - rank)
        decays = range(rank, baseline) if has_charge else [last] * rank  # the row of zeros, if the charge is known
        for i, (channel, weight) in enumerate(zip(self.channels, weights, strict=True)):
            if id(weight) not in products:
                weighted = rows if weight is None else rows * weight
                products[id(weight)] = weighted @ weighted.T
            own = steps[: 2 * MAX_DELAY * bool(channel.timing)]
            places = [
                *range(rank),
                *decays,
                *[last] * len(channel.effect_sizes),
                *range(first_trend, first_trend + count_trends),
                first_trend + count_trends + i,
                len(rows) - 1,
                *range(begin, begin + len(own)),
            ]
            places += [*range(baseline, begin), last + 2 + i, last + 1, last + 2 + len(followed) + i]
            total = products[id(weight)][np.ix_(places, places)]
            count = V.size if weight is None else int(np.count_nonzero(weight))
            effects = len(channel.effect_sizes)
            whole = assemble_compression(self.tables[i], total, True, len(own), effects + count_trends + 2, count)
            assert whole.effects is not None
            *late_parts, late_rate, voltage = whole.effects[effects:]
            late_signal = np.transpose(late_parts) @ self.tables[i].series[:count_trends]
            inputs.append(TrendInputs(late_signal, late_rate, voltage))
            parts.append(dataclasses.replace(whole, effects=whole.effects[:effects] if effects else None))
        return tuple(parts), tuple(inputs)

    def subtract_expected(
        self,
        observed: Sequence[Float[np.ndarray, " samples"]],
        rates: Sequence[Float[np.ndarray, " samples"] | None],
        responses: Float[np.ndarray, "nodes samples"],
    ) -> list[Float[np.ndarray, " samples"]]:
        """Return each channel's samples less the signal of the tables' circuit, without its charge."""
        rests = []
        for x, each, rate in zip(self.tables, observed, rates, strict=True):
            following = 0.0 if x.expected_rate is None or rate is None else x.expected_rate * rate
            rests.append(each - x.expected @ responses - following)
        return rests

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
