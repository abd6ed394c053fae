"""Errors of Vsc and force in a simplified model, for many circuits under one drive.

The time constants come from `fitact.model_selection.partial_fractions`. The rest is NumPy, which needs no compilation:
a vmapped `fitact.response` evaluates 5 times faster, but its compilation for a new drive, regime or length takes 7
times as long as a whole plan. Every response is a sum of exponentials on the linear pieces of its drive. The nodes are
graded towards the corners, where a small resistance has its effect.
"""

import functools
import itertools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple, TypeAlias

import jax
import numpy as np
from jaxtyping import Array, Complex, Float

from fitact.compiled import double_precision, jit, pad_rows
from fitact.model.chirp import Chirp
from fitact.model.circuit import Channel, passes_direct_current
from fitact.model.drive import Burst, Drive, LinearPieces, Multitone, Periodic, PiecewiseLinear, Sampled, Sine
from fitact.model.force import force_constant
from fitact.model.harmonic import mean_voltage
from fitact.model.response import highpass, knot_values, steady_knot_values
from fitact.model.skin import WithSkin
from fitact.model_selection.partial_fractions import ROWS, complete_circuit, partial_fractions
from fitact.scene.scene import Scene

Rows: TypeAlias = Float[np.ndarray, "circuits times"]


class ComparisonGrid(NamedTuple):
    """Time nodes at which models are compared."""

    cycle: Float[np.ndarray, " times"]  # s since the last start of a period
    elapsed: Float[np.ndarray, " times"]  # s since t = 0
    weight: Float[np.ndarray, " times"]  # fraction of the window that each node represents
    n_intervals: int = 1  # intervals without a corner, each with the same number of nodes

    @classmethod
    def from_scene(cls, scene: Scene, measured: Sampled | None = None) -> "ComparisonGrid":
        """Return nodes over a steady-state period, over the duration from rest, or at samples of a measured drive."""
        if measured is not None:
            time, last = (np.asarray(x) for x in (measured.time, measured.time[-1]))
            step = np.diff(time, append=last if measured.period is None else time[0] + measured.period)
            return cls(time, time, step / step.sum())
        drive, duration = scene.make_drive(), scene.measurement.duration
        if isinstance(drive, Chirp):
            # about 16 per cycle of the highest frequency; a power of 2, so that few programs are compiled
            count = int(np.clip(2 ** math.ceil(math.log2(2 * drive.pieces)), 2048, 32768))
            times = duration * (np.arange(count) + 0.5) / count
            return cls(times, times, np.full(times.size, 1.0 / times.size))
        wave: Any = drive.wave if isinstance(drive, Burst) else drive
        period, lead, cuts = 1.0 / wave.frequency, _phase_offset(wave), _corner_times(wave)
        if scene.drive.steady_state:
            stretches = [(0, low, high, 1.0) for low, high in itertools.pairwise(cuts)]
        else:
            end = lead + duration
            cuts = np.union1d(cuts, [lead, end % period])
            cuts = np.append(cuts[:-1][np.diff(cuts) > 1e-9 * period], cuts[-1])  # such close corners are merged
            stretches = [
                (number, low, high, stands)
                for number, stands in _representative_periods(math.ceil(end / period), getattr(drive, "cycles", 0))
                for low, high in itertools.pairwise(cuts)
                if lead <= number * period + 0.5 * (low + high) <= end
            ]
        share, share_weight = _quadrature_nodes()
        first, low, length, stands = (
            np.array(x)[:, None] for x in zip(*((n, a, b - a, w) for n, a, b, w in stretches), strict=True)
        )
        cycle = low + length * share
        weight = stands * length * share_weight
        elapsed = first * period + cycle - lead
        return cls(cycle.ravel(), elapsed.ravel(), (weight / weight.sum()).ravel(), len(stretches))


class CircuitResponses(NamedTuple):
    """Responses of one channel of many circuits to one drive: time constants, and harmonics of a skin."""

    drive: Drive
    steady_state: bool  # or from rest
    segments: LinearPieces | None  # one period of a piecewise linear drive
    weight: Float[np.ndarray, "circuits terms"]  # weights of the high-pass terms
    tau: Float[np.ndarray, "circuits terms"]  # s
    knots: Float[np.ndarray, "circuits terms pieces"]  # steady state of each term at the starts of the pieces, V
    harmonics: Complex[np.ndarray, "circuits harmonics"]  # amplitudes not covered by the terms, V
    mean: Float[np.ndarray, " circuits"]  # of the response in the steady state, which no term has, V

    @classmethod
    def from_scene(
        cls, scene: Scene, drive: Drive, values: Mapping[str, Any], precision: type[np.floating[Any]], channel: Channel
    ) -> "CircuitResponses":
        """Return responses of the scene's circuit at `values` (SI, by name; at most `ROWS`) in this precision."""
        count = max(np.size(value) for value in values.values())

        def pad(values: Any) -> np.ndarray:
            return pad_rows(np.atleast_1d(np.asarray(values, dtype=precision)), ROWS)

        with jax.enable_x64(precision is np.float64):
            circuit = scene.make_circuit(dict(values))
            # the exponent of the skin may differ between circuits
            skin = jax.tree.map(pad, circuit.skin) if isinstance(circuit, WithSkin) else None
            complete = jax.tree.map(pad, complete_circuit(scene.make_rc_circuit(dict(values))))
            weight, tau, harmonics = partial_fractions(complete, skin, drive, precision, channel)
            repeats = scene.drive.steady_state and isinstance(drive, Periodic)
            repeats |= isinstance(drive, Sampled) and drive.period is not None
            mean = np.zeros(len(weight), dtype=precision)
            if repeats and passes_direct_current(complete):
                mean = weight[:, -1] * np.asarray(mean_voltage(drive))
            # in single precision, the tau of an absent element may be 0
            tau = np.maximum(tau, np.finfo(np.float32).tiny)
            wave = drive.wave if isinstance(drive, Burst) else drive
            segments, knots = None, np.zeros((*tau.shape, 0), dtype=precision)
            if isinstance(wave, PiecewiseLinear | Sampled):
                segments = _period_segments(wave)
                settled = not isinstance(drive, Sampled) or drive.period is not None
                rounded = jax.tree.map(precision, segments)
                # column by column, so that one program serves any number of terms
                knots = np.stack([np.asarray(_column_knots(rounded, column, settled)) for column in tau.T], axis=1)
        weight, tau, knots, harmonics, mean = (
            x[:count] for x in (weight.astype(precision), tau.astype(precision), knots, harmonics, mean)
        )
        return cls(drive, scene.drive.steady_state, segments, weight, tau, knots, harmonics, mean)

    @property
    def wave(self) -> Any:
        return self.drive.wave if isinstance(self.drive, Burst) else self.drive

    def evaluate(self, cycle: np.ndarray, elapsed: np.ndarray) -> Rows:
        """Return the response at nodes common to all circuits, or at separate nodes of each circuit."""
        cycle, elapsed = (np.atleast_2d(x).astype(self.tau.dtype) for x in (cycle, elapsed))
        if isinstance(self.drive, Sampled):  # the samples are the nodes
            u = self.knots
        elif isinstance(self.drive, Chirp):
            with jax.enable_x64(self.tau.dtype == np.float64):
                u = np.asarray(_chirp_response(self.drive, elapsed[0], pad_rows(self.tau, ROWS)))[: len(self.tau)]
        elif self.steady_state:
            u = self._steady_state_response(cycle)
        else:
            u = self._transient_response(cycle, elapsed)
        total = np.einsum("rk,rkn->rn", self.weight, u) + self.mean[:, None]
        if not self.harmonics.shape[1]:
            return total
        assert isinstance(self.drive, Periodic)
        order = 2j * np.pi * self.drive.frequency * np.arange(1, self.harmonics.shape[1] + 1)
        return total + 2.0 * np.einsum("rh,rhn->rn", self.harmonics, np.exp(order[:, None] * cycle[:, None, :])).real

    def _transient_response(self, cycle: np.ndarray, elapsed: np.ndarray) -> np.ndarray:
        begin = np.full((1, 1), _phase_offset(self.wave), dtype=cycle.dtype)
        tau, since = self.tau[..., None], elapsed[:, None, :]
        with double_precision():
            initial = float(self.wave.value(0.0))
        difference = initial - self._steady_state_response(begin)
        u = self._steady_state_response(cycle) + difference * np.exp(-since / tau)
        if not isinstance(self.drive, Burst):
            return u
        end = self.drive.cycles / self.wave.frequency
        after = difference * np.expm1(-end / tau) * np.exp(-np.maximum(since - end, 0.0) / tau)
        return np.where(since > end, after, u)

    def _steady_state_response(self, cycle: np.ndarray) -> np.ndarray:
        tau, cycle = self.tau[..., None], cycle[:, None, :]
        if self.segments is None:
            omega, u = 2.0 * np.pi * self.wave.frequency, np.zeros((1, 1, 1), dtype=tau.dtype)
            for order, height, phase in _tones(self.wave):
                x = order * omega * tau
                u = u + height * (x / np.hypot(1.0, x)) * np.sin(order * omega * cycle + (phase + np.arctan2(1.0, x)))
            return u
        piece, since, slope = _locate_segment(self.segments, cycle)
        decay = np.expm1(-since / tau)
        return np.take_along_axis(self.knots, piece, axis=2) * (1.0 + decay) - slope.astype(tau.dtype) * tau * decay


class ReferenceModel:
    """Vsc and force of the full model over a window, as the reference for other models.

    `values` of the circuits as in `CircuitResponses.from_scene`; a `measured` drive replaces the scene's drive.
    """

    def __init__(self, scene: Scene, values: Mapping[str, Any], measured: Sampled | None = None) -> None:
        self.measured, self.grid = measured, ComparisonGrid.from_scene(scene, measured)
        self.full = self._evaluate(scene, values, np.float64)

    def compare(
        self, scene: Scene, values: Mapping[str, Any], precision: type[np.floating[Any]] = np.float64
    ) -> Float[np.ndarray, "4 circuits"]:
        """Return relative errors of another scene's model against the full one, for the first circuits.

        The four errors are those in rms and peak of Vsc, and in mean and peak of the force.
        """
        weight, changed = self.grid.weight, self._evaluate(scene, values, precision)
        (vsc, peak), (acting, acting_peak), factor = changed
        full = jax.tree.map(lambda x: x[: len(vsc)], self.full)
        (full_vsc, full_peak), (full_acting, full_acting_peak), full_factor = full
        ratio = factor / full_factor
        return np.array([
            np.sqrt((vsc - full_vsc) ** 2 @ weight / (full_vsc**2 @ weight)),
            np.abs(peak / full_peak - 1.0),
            np.abs(ratio * (acting**2 @ weight / (full_acting**2 @ weight)) - 1.0),
            np.abs(ratio * (acting_peak / full_acting_peak) ** 2 - 1.0),
        ])  # fmt: skip

    def _evaluate(
        self, scene: Scene, values: Mapping[str, Any], precision: type[np.floating[Any]]
    ) -> tuple[tuple[Rows, np.ndarray], tuple[Rows, np.ndarray], Float[np.ndarray, " circuits"]]:
        """Return Vsc and its peak, the voltage that causes the force and its peak, and force / voltage^2 (N/V^2)."""
        drive = self.measured or scene.make_drive()
        vsc = acting = _voltages(self.grid, CircuitResponses.from_scene(scene, drive, values, precision, "Vsc"))
        if scene.force.model != "paper":
            acting = _voltages(self.grid, CircuitResponses.from_scene(scene, drive, values, precision, "Vgap"))
        with double_precision():  # for any precision of the voltages
            contact = scene.geometry().contact(scene.make_rc_circuit(dict(values)))
            return vsc, acting, np.broadcast_to(np.asarray(force_constant(contact)), len(vsc[0]))


def _voltages(grid: ComparisonGrid, responses: CircuitResponses) -> tuple[Rows, Float[np.ndarray, " circuits"]]:
    """Return voltages at the nodes, and the maximum, which may lie between nodes."""
    voltage = responses.evaluate(grid.cycle, grid.elapsed)
    if isinstance(responses.drive, Chirp):  # its code is compiled for these nodes
        return voltage, _parabola_vertex(np.abs(voltage))
    if isinstance(responses.drive, Sampled):  # unknown between the samples
        return voltage, np.abs(voltage).max(axis=1)
    # the intervals with the highest values are refined
    candidates, points, refinements = 4, 17, 3
    height = np.abs(voltage).reshape(len(voltage), grid.n_intervals, -1)
    highest = np.argsort(-height.max(axis=2), axis=1)[:, :candidates]
    first, last = highest * height.shape[2], (highest + 1) * height.shape[2] - 1
    node = first + np.take_along_axis(height.argmax(axis=2), highest, axis=1)
    low, high = grid.cycle[np.maximum(node - 1, first)], grid.cycle[np.minimum(node + 1, last)]
    offset = (grid.elapsed - grid.cycle)[node][..., None]
    for _ in range(refinements):
        cycle = np.linspace(low, high, points, axis=2)
        flat = (x.reshape(len(voltage), -1) for x in (cycle, cycle + offset))
        refined = np.abs(responses.evaluate(*flat)).reshape(cycle.shape)
        best = refined.argmax(axis=2)[..., None]
        low, high = (np.take_along_axis(cycle, np.clip(best + i, 0, points - 1), 2)[..., 0] for i in (-1, 1))
    return voltage, np.maximum(height.max(axis=(1, 2)), refined.max(axis=(1, 2)))


def _parabola_vertex(height: Rows) -> Float[np.ndarray, " circuits"]:
    """Return the maximum of the parabola through the highest node of each row and its neighbours."""
    at = np.clip(height.argmax(axis=1), 1, height.shape[1] - 2)
    before, top, after = (height[np.arange(len(height)), at + i] for i in (-1, 0, 1))
    bend = before - 2.0 * top + after
    vertex = top - 0.125 * np.square(after - before) / np.where(bend < 0.0, bend, -np.inf)
    return np.maximum(vertex, height.max(axis=1))


@functools.cache
def _quadrature_nodes(decades: int = 8, order: int = 8) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights on (0, 1), graded towards 0, with `order` nodes per decade; the ends have weight 0."""
    x, w = np.polynomial.legendre.leggauss(order)
    ends = np.concatenate([[0.0], np.logspace(-decades, -1.0, decades), [0.25, 0.5, 0.75, 1.0]])
    low, length = ends[:-1, None], np.diff(ends)[:, None]
    share = (low + 0.5 * length * (x + 1.0)).ravel()
    weight = (0.5 * length * w).ravel()
    return np.concatenate([[1e-12], share, [1.0 - 1e-12]]), np.concatenate([[0.0], weight, [0.0]])


def _representative_periods(periods: int, cycles: int, groups: int = 12) -> list[tuple[int, int]]:
    """Return periods from rest, and the number of periods that each represents.

    The first, the last and the end of a burst represent themselves. The others form `groups` in geometric progression,
    so that early periods are resolved.
    """
    edges = np.unique(np.rint(np.geomspace(1, periods + 1, groups + 1)).astype(int) - 1)
    alone = np.array([1, periods - 1, cycles, cycles + 1])
    edges = np.union1d(edges, alone[(alone > 0) & (alone < periods)])
    return [((low + high - 1) // 2, high - low) for low, high in itertools.pairwise(edges.tolist())]


def _phase_offset(wave: Any) -> float:
    """Return the position of t = 0 within a period, s."""
    return float(wave.phase / (2.0 * np.pi) % 1.0 / wave.frequency)


def _corner_times(wave: Periodic) -> np.ndarray:
    if isinstance(wave, Sine | Multitone):
        return np.linspace(0.0, 1.0, 4 * max(order for order, _, _ in _tones(wave)) + 1) / float(wave.frequency)
    assert isinstance(wave, PiecewiseLinear)
    return np.unique(_period_segments(wave).knots)


def _period_segments(wave: PiecewiseLinear | Sampled) -> LinearPieces:
    """Return one period, padded to 4 pieces with pieces of zero length, so that one compiled program serves."""
    with double_precision():
        knots, start, end = (np.asarray(x) for x in wave.pieces())
    missing = np.zeros(max(4 - start.size, 0))
    return LinearPieces(*(np.append(x, missing + y[-1]) for x, y in ((knots, knots), (start, end), (end, end))))


def _locate_segment(segments: LinearPieces, cycle: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the piece of each time, the time since its start, and its slope."""
    knots, length = segments.knots.astype(cycle.dtype), np.diff(segments.knots)
    last = int(np.flatnonzero(length)[-1])
    piece = np.clip(np.searchsorted(knots, cycle, side="right") - 1, 0, last)
    slope = (segments.end - segments.start) / np.where(length > 0.0, length, 1.0)
    return piece, np.maximum(cycle - knots[piece], 0.0), slope[piece]


def _tones(wave: Any) -> list[tuple[int, float, float]]:
    """Return orders, amplitudes (V) and phases (rad, relative to the drive's phase) of the sines in a smooth drive."""
    if isinstance(wave, Sine):
        return [(1, 0.5 * float(wave.peak_to_peak), 0.0)]
    phases = wave.phases or (0.0,) * len(wave.orders)
    tones = zip(wave.orders, wave.amplitudes, phases, strict=True)
    return [(order, float(height), float(phase)) for order, height, phase in tones]


@functools.partial(jit, double=False)
def _column_knots(
    segments: LinearPieces, tau: Float[Array, " circuits"], steady_state: bool
) -> Float[Array, "circuits pieces"]:
    """Return u just after the start of each piece, in the steady state or from rest."""
    begin = functools.partial(knot_values, segments, first=segments.start[0])
    return jax.vmap(functools.partial(steady_knot_values, segments) if steady_state else begin)(tau)


@functools.partial(jit, double=False)
def _chirp_response(
    drive: Drive, time: Array, tau: Float[Array, "circuits terms"]
) -> Float[Array, "circuits terms times"]:
    return jax.vmap(jax.vmap(lambda each: highpass(drive, time, each, steady_state=False)))(tau)
