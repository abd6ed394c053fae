"""Compression of many windows of one record at once, which is the cost of following a finger over time.

All windows have the same length and time step, so that slow shapes and the decays of an unknown charge are common to
all. The responses to the recorded drive are first-order recursive filters, whose state goes on from window to window.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Self

import numpy as np
from jaxtyping import Float

from fitact.data.tones import Tones
from fitact.likelihood.channel import ChannelLikelihood
from fitact.likelihood.charge_rows import LAG, ChargeRows, filter_highpass, step_means, whiten_rows
from fitact.likelihood.compression import (
    BASELINE_NAMES,
    Columns,
    Compression,
    function_sizes,
    place_functions,
    split_functions,
)
from fitact.likelihood.likelihood import CircuitValues
from fitact.likelihood.noise import Whitening
from fitact.likelihood.projection import (
    MAX_DELAY,
    TableNodes,
    assemble_compression,
    drive_steps,
    evaluate_baseline,
    factor_products,
)
from fitact.likelihood.smooth_drive import curve_drive, curve_tones, smooth_drive
from fitact.model.loop_modes import HighpassTerms
from fitact.model.response_table import count_nodes

REACH = 4.0  # factor by which b may change
RANK = 14  # combinations of responses that represent those of the table, to 2e-7
TREND_RANK = 6  # combinations of responses that represent those to a small trend, to 0.3 %


class FilterState(NamedTuple):
    """State of the responses at the end of a window, from which the next one goes on."""

    end: float  # time of the first sample after the window, s
    voltage: float  # last V to which the filters respond
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
    noise_V: float  # sd of the noise of V, V; 0 if the channels respond to V with its noise
    tones: Tones | None  # of V in the window of the fit, if they are few
    short: int  # number of the fastest time constants that are not in the tables
    late: float  # delay of Vsc in time steps

    @classmethod
    def from_channels(
        cls,
        channels: Sequence[ChannelLikelihood],
        circuit: CircuitValues,
        samples: int,
        step: float,
        noise_V: float,
        tones: Tones | None,
        late: float,
    ) -> Self:
        """Make the tables around the time constants of a circuit, a factor `REACH` either way.

        `noise_V` is the sd of the noise of V, to which a channel whose response may be delayed does not respond,
        `tones` are those of V, and `late` is the delay of Vsc in time steps.
        """
        time, short = step * np.arange(samples), channels[0].count_untabulated(circuit.tau)
        is_single = circuit.tau.size - short == 1
        margins = 2 * (math.log(REACH),) if is_single else None
        count = count_nodes(math.log(REACH), 1e-8) if is_single else None
        tables, shared = [], []
        for each in channels:
            terms = each.electrical.select_terms(circuit.terms[each.channel])
            terms = terms.without_fastest(each.count_short(circuit.tau))
            table = TableNodes.from_terms(terms, time, narrow=False, margins=margins, count=count)
            if is_single:
                kept = slice(RANK)
                table = dataclasses.replace(table, combinations=table.combinations[:, kept], series=table.series[kept])
            baseline = dict(zip(BASELINE_NAMES, evaluate_baseline(time, table.middle, table.half), strict=True))
            functions = np.vstack([_decays(table, time), *(baseline[name] for name in _baseline_names(each))])
            tables.append(table)
            shared.append(functions if each.samples.charges is None else step_means(functions))
        noise = noise_V if any(each.shifts_response for each in channels) else 0.0
        return cls(tuple(channels), tuple(tables), time, tuple(shared), noise, tones if noise else None, short, late)

    def compress(
        self,
        V: Samples,
        given: Sequence[Samples | MakeRows],
        weights: Sequence[Samples | None],
        drive: tuple[Samples, Samples],
        responses: Float[np.ndarray, "nodes samples"],
        has_charge: bool,
    ) -> tuple[tuple[Compression, ...], tuple[TrendInputs, ...], Compression | None]:
        """Compress a window with the drive `V`: each channel's samples and weights, or rows of charge.

        `drive` and `responses` are those of `respond`. With `has_charge`, the charge at the first sample is unknown.
        Also returns what a trend within the window needs, and the responses at all samples, unless the first channel
        is compressed in them.
        """
        late, rank = self.time - 0.5 * self.time[-1], len(self.tables[0].series)
        functions = np.empty((rank + TREND_RANK + 2, V.size))
        combined = np.matmul(self.tables[0].combinations.T, responses, out=functions[:rank])
        np.multiply(late, combined[:TREND_RANK], out=functions[rank:-2])
        functions[-2], found, steps = V, [], np.empty((0, V.size))
        if any(each.shifts_response for each in self.channels):
            smooth, missed = drive
            # beside its noise, V has what lines between its samples lack
            steps = drive_steps(smooth, V - smooth + missed, 0, V.size, float(self.time[1]))
        for i, pair in enumerate(zip(given, weights, strict=True)):
            functions[-1] = self.tables[i].expected @ responses
            found.append(self._compress_channel(i, late, functions, steps, *pair, has_charge))
        parts, inputs, (products, *_) = zip(*found, strict=True)
        first, steps = self.channels[0], steps if self.short else steps[:0]
        if products is None and first.samples.charges is None and first.samples.whitening is None:
            return parts, inputs, None
        if products is None:
            decays = _decays(self.tables[0], self.time)[: rank * has_charge]
            products = WindowProducts.from_functions({"signal": combined, "decay": decays, "steps": steps})
        sampled = _find_coordinates(products, function_sizes(rank, decays=True, ages=len(steps)))
        table = assemble_compression(self.tables[0], sampled, V.size)
        return parts, inputs, dataclasses.replace(table, short=self.short)

    def _compress_channel(
        self,
        index: int,
        late: Samples,
        functions: Float[np.ndarray, "functions samples"],
        steps: Float[np.ndarray, "ages samples"],
        given: Samples | MakeRows,
        weight: Samples | None,
        has_charge: bool,
    ) -> "tuple[Compression, TrendInputs, WindowProducts | None]":
        """Compress a channel; the `functions` are the responses, those of trends, V, and what the tables expect.

        Also returns inner products over all samples, if some are excluded and the others are not whitened.
        """
        channel, table, step = self.channels[index], self.tables[index], float(self.time[1])
        rank, charged = len(table.series), has_charge * len(table.series)
        shared, rows, whitening = self.shared[index][rank - charged :], None, None
        if not channel.shifts_response:
            steps = steps[:0]
        else:  # samples at the ends may respond to the V of other windows
            weight = np.ones(late.size) if weight is None else weight.copy()
            weight[:MAX_DELAY] = weight[-MAX_DELAY:] = 0.0
        if callable(given):
            functions = step_means(functions)
            rows = given([functions[:-2], shared])
            rate, slope, observed = rows.rate, rows.bend, rows.observed
            late, count = late - (LAG - 0.5) * step, max(round(float(rows.count)), 1)
        else:
            rate, slope, observed = np.zeros(late.size), np.gradient(functions[-2], step), given
            fitted = channel.samples.whitening
            whitening = fitted and fitted.begin(np.zeros(late.size, bool) if weight is None else weight == 0.0)
            used = weight if whitening is None else whitening.mask
            count = late.size if used is None else int(np.count_nonzero(used))
        rest = observed - functions[-1] - (0.0 if table.expected_rate is None else table.expected_rate * rate)
        own = {"signal": functions[:rank], "decay": shared[:charged], "steps": steps}
        own |= zip(_baseline_names(channel), shared[charged:, None], strict=True)
        own |= {"rate": rate[None], "slope": slope[None], "observed": rest[None]}
        own |= {"late": functions[rank:-2], "late_rate": (late * rate)[None], "voltage": functions[-2:-1]}
        sizes = function_sizes(rank, decays=True, effects=len(channel.effect_sizes), ages=len(steps))
        whole = products = WindowProducts.from_functions(own, rows, whitening)
        if rows is None and whitening is None and weight is not None:
            excluded = weight == 0.0
            ends = WindowProducts.from_functions({name: each[:, excluded] for name, each in own.items()})
            products = products._replace(values=products.values - ends.values)
        found = _find_coordinates(products, sizes | {"late": TREND_RANK, "late_rate": 1, "voltage": 1})
        late_signal = found["late"] @ table.series[:TREND_RANK]
        trend = TrendInputs(late_signal, found["late_rate"][:, 0], found["voltage"][:, 0])
        compression = dataclasses.replace(
            assemble_compression(table, found, count), short=self.short - channel.electrical.lags
        )
        return compression, trend, None if products is whole else whole

    def expect(self, V: Samples, responses: Float[np.ndarray, "nodes samples"]) -> Samples:
        """Return the samples of the first channel with the tables' circuit, without its charge."""
        table = self.tables[0]
        signal = table.expected @ responses
        return signal if table.expected_rate is None else signal + table.expected_rate * np.gradient(V, self.time[1])

    def respond(
        self, V: Float[np.ndarray, " samples"], start: float, before: FilterState | None
    ) -> tuple[tuple[Samples, Samples], Float[np.ndarray, "nodes samples"], FilterState]:
        """Return what the channels respond to in the V of a window from `start` (s) on, and the responses at the nodes.

        The first is the smooth drive, and what lines between its samples lack where Vsc is late. Also return the state
        at the end. u[k] = e^{-x} u[k - 1] + phi(x) (V[k] - V[k - 1]). Without a state `before`, V
        was constant before the window.
        """
        step, (smooth, missed) = float(self.time[1]), self.smooth_drive(V)
        rise = np.diff(smooth, prepend=smooth[0] if before is None else before.voltage)
        nodes = self.tables[0].nodes
        memory = np.zeros((nodes.size, 1)) if before is None else before.memory
        responses, left = np.empty((nodes.size, V.size)), np.empty((nodes.size, 1))
        for i, x in enumerate(step / nodes):
            responses[i], left[i] = filter_highpass(rise, x, memory[i])
        length = step * V.size
        age = length + (0.0 if before is None else before.age)
        return (smooth, missed), responses, FilterState(start + length, float(smooth[-1]), left, age)

    def smooth_drive(self, V: Samples) -> tuple[Samples, Samples]:
        """Return the drive of a window without most of its noise, unless the channels respond to that.

        Also what lines between its samples lack, where Vsc is late.
        """
        tones = self.tones and self.tones.continue_with(V)
        smooth = smooth_drive(V, self.noise_V, tones) if self.noise_V else V
        number = np.arange(float(V.size))
        curved = (
            curve_tones(tones, self.late, HighpassTerms((), (), None, 1.0)) if tones else curve_drive(smooth, self.late)
        )
        return smooth, np.interp(number - self.late, number, curved - smooth)


class WindowProducts(NamedTuple):
    """Inner products of functions over a window."""

    sizes: dict[str, int]  # number of functions, by name
    values: Float[np.ndarray, "functions functions"]

    @classmethod
    def from_functions(
        cls,
        functions: Mapping[str, Float[np.ndarray, "some samples"]],
        charges: ChargeRows | None = None,
        whitening: Whitening | None = None,
    ) -> Self:
        """Multiply functions over the samples, which may have a filter, or rows that are whitened like `charges`."""
        rows = np.concatenate(list(functions.values()))
        if charges is not None:
            rows = whiten_rows(charges.gain, charges.decay, rows) * charges.used
        elif whitening is not None:
            around = np.pad(rows, [(0, 0), (whitening.taps.size - 1, 0)])
            rows = whitening.mask * whitening.filter(around, np.zeros(len(rows)))
        return cls({name: len(each) for name, each in functions.items()}, rows @ rows.T)


def _find_coordinates(products: WindowProducts, sizes: Mapping[str, int]) -> dict[str, Columns]:
    """Return coordinates of the functions of `sizes`, 0 for absent ones, so that windows have equal shapes."""
    places, given, total = place_functions(sizes), place_functions(products.sizes), np.zeros(2 * [sum(sizes.values())])
    pairs = [(place[: given[name].size], given[name][: place.size]) for name, place in places.items() if name in given]
    kept, there = map(np.concatenate, zip(*pairs, strict=True))
    total[np.ix_(kept, kept)] = products.values[np.ix_(there, there)]
    return split_functions(factor_products(total)[0], sizes)


def _decays(table: TableNodes, time: Samples) -> Float[np.ndarray, "rank samples"]:
    return table.combinations.T @ np.exp(-time / table.nodes[:, None])


def _baseline_names(channel: ChannelLikelihood) -> list[str]:
    return [BASELINE_NAMES[column] for column in channel.columns if column < len(BASELINE_NAMES)]
