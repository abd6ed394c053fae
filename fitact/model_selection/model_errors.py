"""Vsc of many circuits under one drive, and what makes the force, for comparing models with each other.

The time constants come from `fitact.model_selection.partial_fractions`. The rest is NumPy, where nothing is
compiled: every response is a sum of exponentials along the straight pieces of its drive, and a window is a set of
nodes, graded towards the corners, where a small resistance makes its difference.
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Complex, Float

from fitact.model.chirp import Chirp
from fitact.model.circuit import Channel
from fitact.model.drive import Burst, Drive, Periodic, Pieces, PiecewiseLinear, Sampled, Sine
from fitact.model.force import force_constant
from fitact.model.multitone import Multitone
from fitact.model.response import highpass, knot_values, steady_knots
from fitact.model.skin import WithSkin
from fitact.model_selection.partial_fractions import complete, filled_up, terms, tones
from fitact.scene.scene import Scene

_PIECES = 4  # of a period; fewer are filled up with ones of no length
_DECADES, _ORDER = 8, 8  # of a piece, and the order of the rule in each
_PERIODS = 12  # from rest: periods that stand for all, in geometric progression
_CHIRP_TIMES = 2048, 32768  # at least and at most, and between them 16 a cycle of the highest frequency
_SNAP = 1e-9  # of a period: corners so close are one
_HIGHEST = 4  # stretches among which the peak is looked for
_REFINED, _REFINEMENTS = 17, 3  # times between the neighbours of a peak, and how often

Rows: TypeAlias = Float[np.ndarray, "circuits times"]


class Window(NamedTuple):
    """Nodes over the time in which models are compared."""

    cycle: Float[np.ndarray, " times"]  # s since the drive's last start of a period
    elapsed: Float[np.ndarray, " times"]  # s since t = 0
    weight: Float[np.ndarray, " times"]  # the share of the window that each stands for
    stretches: int = 1  # without a corner, each of as many times as another

    @classmethod
    def of(cls, scene: Scene, measured: Sampled | None = None) -> "Window":
        """One period of the steady state; else the scene's duration from rest; of a measured drive, its samples."""
        if measured is not None:
            time, last = (np.asarray(x) for x in (measured.time, measured.time[-1]))
            step = np.diff(time, append=last if measured.period is None else time[0] + measured.period)
            return cls(time, time, step / step.sum())
        drive, duration = scene.make_drive(), scene.measurement.duration
        if isinstance(drive, Chirp):
            least, most = _CHIRP_TIMES
            count = int(np.clip(2 ** math.ceil(math.log2(2 * drive.pieces)), least, most))
            times = duration * (np.arange(count) + 0.5) / count
            return cls(times, times, np.full(times.size, 1.0 / times.size))
        wave: Any = drive.wave if isinstance(drive, Burst) else drive
        period, lead = 1.0 / wave.frequency, _lead(wave)
        cuts = _corners(wave)
        if scene.drive.steady_state:
            stretches = [(0, low, high, 1.0) for low, high in itertools.pairwise(cuts)]
        else:
            end = lead + duration
            cuts = np.union1d(cuts, [lead, end % period])
            cuts = np.append(cuts[:-1][np.diff(cuts) > _SNAP * period], cuts[-1])
            stretches = [
                (number, low, high, stands)
                for number, stands in _representatives(math.ceil(end / period), getattr(drive, "cycles", 0))
                for low, high in itertools.pairwise(cuts)
                if lead <= number * period + 0.5 * (low + high) <= end
            ]
        share, share_weight = _nodes()
        first, low, length, stands = (
            np.array(x)[:, None] for x in zip(*((n, a, b - a, w) for n, a, b, w in stretches), strict=True)
        )
        cycle = low + length * share
        weight = stands * length * share_weight
        elapsed = first * period + cycle - lead
        return cls(cycle.ravel(), elapsed.ravel(), (weight / weight.sum()).ravel(), len(stretches))


@dataclasses.dataclass(frozen=True)
class Waves:
    """Vsc of circuits under one drive: weighted responses of time constants, and harmonics where a skin has more.

    Attributes:
        drive, steady_state: what drives them all, and whether for ever or from rest.
        pieces: one period of the drive, where it is straight.
        weight, tau: of the high-pass terms; s.
        knots: each term's steady state at the starts of the drive's pieces, V.
        harmonics: amplitude that the terms miss, V.
        factor: the force over the square of the voltage that makes it, N/V^2.
        acting: those voltages; None: these themselves.
    """

    drive: Drive
    steady_state: bool
    pieces: Pieces | None
    weight: Float[np.ndarray, "circuits terms"]
    tau: Float[np.ndarray, "circuits terms"]
    knots: Float[np.ndarray, "circuits terms pieces"]
    harmonics: Complex[np.ndarray, "circuits harmonics"]
    factor: Float[np.ndarray, " circuits"]
    acting: "Waves | None" = None

    @classmethod
    def of(
        cls,
        scene: Scene,
        values: Mapping[str, Any],
        precision: type[np.floating[Any]] = np.float64,
        measured: Sampled | None = None,
    ) -> "Waves":
        """Those of the scene's circuit at `values` (SI, by name; arrays of at most `ROWS`), in that precision.

        `measured` is what drives them in place of the scene's drive.
        """
        drive = measured or scene.make_drive()
        found = cls._of(scene, drive, values, precision, "Vsc")
        if scene.force.model == "paper":
            return found
        return dataclasses.replace(found, acting=cls._of(scene, drive, values, precision, "Vgap"))

    @classmethod
    def _of(
        cls,
        scene: Scene,
        drive: Drive,
        values: Mapping[str, Any],
        precision: type[np.floating[Any]],
        channel: Channel,
    ) -> "Waves":
        count = max(np.size(value) for value in values.values())
        with jax.enable_x64(precision is np.float64):
            circuit = scene.make_circuit(dict(values))
            skin = None
            if isinstance(circuit, WithSkin):  # its exponent may differ from circuit to circuit
                skin = jax.tree.map(lambda x: filled_up(x, precision)[:, None], circuit.skin)
            whole = complete(scene.make_rc_circuit(dict(values)))
            filled = jax.tree.map(lambda x: filled_up(x, precision), whole)
            weight, tau, harmonics = terms(filled, skin, drive, precision, channel)
            tau = np.maximum(tau, np.finfo(np.float32).tiny)  # single precision may lose that of an absent part
            wave = drive.wave if isinstance(drive, Burst) else drive
            pieces = _pieces(wave) if isinstance(wave, PiecewiseLinear | Sampled) else None
            knots = np.zeros((*tau.shape, 0), dtype=precision)
            if pieces is not None:
                settled = not isinstance(drive, Sampled) or drive.period is not None
                knots = _knots(jax.tree.map(precision, pieces), tau, settled)
        weight, tau, knots, harmonics = (
            x[:count] for x in (weight.astype(precision), tau.astype(precision), knots, harmonics)
        )
        return cls(
            drive, scene.drive.steady_state, pieces, weight, tau, knots, harmonics, _factor(scene, values, count)
        )

    def at(self, cycle: np.ndarray, elapsed: np.ndarray) -> Rows:
        """Vsc at nodes common to all circuits, or at each circuit's own."""
        cycle, elapsed = (np.atleast_2d(x).astype(self.tau.dtype) for x in (cycle, elapsed))
        if isinstance(self.drive, Sampled):  # whose samples are the nodes
            u = self.knots
        elif isinstance(self.drive, Chirp):
            with jax.enable_x64(self.tau.dtype == np.float64):
                u = np.asarray(_chirped(self.drive, elapsed[0], filled_up(self.tau, self.tau.dtype)))[: len(self.tau)]
        elif self.steady_state:
            u = self._settled(cycle)
        else:
            u = self._from_rest(cycle, elapsed)
        vsc = np.einsum("rk,rkn->rn", self.weight, u)
        if not self.harmonics.shape[1]:
            return vsc
        assert isinstance(self.drive, Periodic)
        order = 2j * np.pi * self.drive.frequency * np.arange(1, self.harmonics.shape[1] + 1)
        return vsc + 2.0 * np.einsum("rh,rhn->rn", self.harmonics, np.exp(order[:, None] * cycle[:, None, :])).real

    def _from_rest(self, cycle: np.ndarray, elapsed: np.ndarray) -> np.ndarray:
        wave: Any = self.drive.wave if isinstance(self.drive, Burst) else self.drive
        begin = np.full((1, 1), _lead(wave), dtype=cycle.dtype)
        tau, since = self.tau[..., None], elapsed[:, None, :]
        difference = self._start(wave) - self._settled(begin)
        u = self._settled(cycle) + difference * np.exp(-since / tau)
        if not isinstance(self.drive, Burst):
            return u
        end = self.drive.cycles / wave.frequency
        after = difference * np.expm1(-end / tau) * np.exp(-np.maximum(since - end, 0.0) / tau)
        return np.where(since > end, after, u)

    def _start(self, wave: Any) -> float:
        """V at t = 0, from the right."""
        if self.pieces is None:
            with jax.enable_x64(True):
                return float(wave.value(0.0))
        piece, since, slope = _along(self.pieces, np.array(_lead(wave)))
        return float(self.pieces.start[piece] + slope * since)

    def _settled(self, cycle: np.ndarray) -> np.ndarray:
        """Each term's response in the steady state."""
        wave: Any = self.drive.wave if isinstance(self.drive, Burst) else self.drive
        tau, cycle = self.tau[..., None], cycle[:, None, :]
        if self.pieces is None:
            omega, u = 2.0 * np.pi * wave.frequency, np.zeros((1, 1, 1), dtype=tau.dtype)
            for order, height, phase in tones(wave):
                x = order * omega * tau
                u = u + height * (x / np.hypot(1.0, x)) * np.sin(order * omega * cycle + (phase + np.arctan2(1.0, x)))
            return u
        piece, since, slope = _along(self.pieces, cycle)
        left = np.expm1(-since / tau)
        return np.take_along_axis(self.knots, piece, axis=2) * (1.0 + left) - slope.astype(tau.dtype) * tau * left


class Comparison(NamedTuple):
    """What a changed model makes of Vsc and force, relative to the full one; one value for each circuit."""

    Vsc_rms: Float[np.ndarray, " circuits"]
    Vsc_peak: Float[np.ndarray, " circuits"]
    force_mean: Float[np.ndarray, " circuits"]
    force_peak: Float[np.ndarray, " circuits"]


class Reference:
    """The full model's waves over a window, to compare others with.

    `values` of its circuits as in `Waves.of`; `measured`: what drives all of them in place of the scene's drive.
    """

    def __init__(self, scene: Scene, values: Mapping[str, Any], measured: Sampled | None = None) -> None:
        self.measured, self.window = measured, Window.of(scene, measured)
        full = Waves.of(scene, values, measured=measured)
        self.vsc = _Heights.of(self.window, full)
        self.factor = full.factor
        self.acting = self.vsc if full.acting is None else _Heights.of(self.window, full.acting)

    def compare(
        self, scene: Scene, values: Mapping[str, Any], precision: type[np.floating[Any]] = np.float64
    ) -> Comparison:
        """How far those of another scene, of as many of the circuits from the first on, lie from the full model's."""
        waves = Waves.of(scene, values, precision, self.measured)
        weight, count = self.window.weight, len(waves.tau)
        vsc, factor = _Heights.of(self.window, waves), waves.factor / self.factor[:count]
        acting = vsc if waves.acting is None else _Heights.of(self.window, waves.acting)
        full, acting_full = (_Heights(at[:count], peak[:count]) for at, peak in (self.vsc, self.acting))
        return Comparison(
            np.sqrt((vsc.at - full.at) ** 2 @ weight / (full.at**2 @ weight)),
            np.abs(vsc.peak / full.peak - 1.0),
            np.abs(factor * (acting.at**2 @ weight / (acting_full.at**2 @ weight)) - 1.0),
            np.abs(factor * (acting.peak / acting_full.peak) ** 2 - 1.0),
        )


class _Heights(NamedTuple):
    """Voltages at a window's nodes, and the largest."""

    at: Rows
    peak: Float[np.ndarray, " circuits"]

    @classmethod
    def of(cls, window: Window, waves: Waves) -> "_Heights":
        at = waves.at(window.cycle, window.elapsed)
        return cls(at, _peak(window, waves, at))


def _peak(window: Window, waves: Waves, vsc: Rows) -> Float[np.ndarray, " circuits"]:
    """The largest |Vsc|, between the nodes too: the highest stretches are looked at more closely."""
    if isinstance(waves.drive, Chirp | Sampled):  # compiled for its nodes, or not known between them
        return _parabola(np.abs(vsc)) if isinstance(waves.drive, Chirp) else np.abs(vsc).max(axis=1)
    height = np.abs(vsc).reshape(len(vsc), window.stretches, -1)
    node = height.argmax(axis=2)
    highest = np.argsort(-height.max(axis=2), axis=1)[:, :_HIGHEST]
    first, last = highest * height.shape[2], (highest + 1) * height.shape[2] - 1
    at = first + np.take_along_axis(node, highest, axis=1)
    low, high = window.cycle[np.maximum(at - 1, first)], window.cycle[np.minimum(at + 1, last)]
    offset = (window.elapsed - window.cycle)[at][..., None]
    for _ in range(_REFINEMENTS):
        cycle = np.linspace(low, high, _REFINED, axis=2)
        refined = np.abs(waves.at(*(x.reshape(len(vsc), -1) for x in (cycle, cycle + offset)))).reshape(cycle.shape)
        best = refined.argmax(axis=2)[..., None]
        low, high = (np.take_along_axis(cycle, np.clip(best + i, 0, _REFINED - 1), 2)[..., 0] for i in (-1, 1))
    return np.maximum(height.max(axis=(1, 2)), refined.max(axis=(1, 2)))


def _parabola(height: Rows) -> Float[np.ndarray, " circuits"]:
    """The top of the parabola through the highest node of each row and its neighbours."""
    at = np.clip(height.argmax(axis=1), 1, height.shape[1] - 2)
    before, top, after = (height[np.arange(len(height)), at + i] for i in (-1, 0, 1))
    bend = before - 2.0 * top + after
    vertex = top - 0.125 * np.square(after - before) / np.where(bend < 0.0, bend, -np.inf)
    return np.maximum(vertex, height.max(axis=1))


@functools.cache
def _nodes() -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights on (0, 1), graded towards 0; both ends are nodes of no weight."""
    x, w = np.polynomial.legendre.leggauss(_ORDER)
    ends = np.concatenate([[0.0], np.logspace(-_DECADES, -1.0, _DECADES), [0.25, 0.5, 0.75, 1.0]])
    low, length = ends[:-1, None], np.diff(ends)[:, None]
    share = (low + 0.5 * length * (x + 1.0)).ravel()
    weight = (0.5 * length * w).ravel()
    tiny = 1e-12
    return np.concatenate([[tiny], share, [1.0 - tiny]]), np.concatenate([[0.0], weight, [0.0]])


def _representatives(periods: int, cycles: int) -> list[tuple[int, int]]:
    """Periods from rest, and how many each stands for: every early one, the first, the last and a burst's end alone."""
    edges = np.unique(np.rint(np.geomspace(1, periods + 1, _PERIODS + 1)).astype(int) - 1)
    own = np.array([1, periods - 1, cycles, cycles + 1])
    edges = np.union1d(edges, own[(own > 0) & (own < periods)])
    return [
        ((low + high - 1) // 2, high - low) for low, high in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)
    ]


def _lead(wave: Any) -> float:
    """How far into a period t = 0 lies, s."""
    return float(wave.phase / (2.0 * np.pi) % 1.0 / wave.frequency)


def _corners(wave: Periodic) -> np.ndarray:
    if isinstance(wave, Sine | Multitone):
        return np.linspace(0.0, 1.0, 4 * max(order for order, _, _ in tones(wave)) + 1) / float(wave.frequency)
    assert isinstance(wave, PiecewiseLinear)
    return np.unique(_pieces(wave).knots)


def _pieces(wave: PiecewiseLinear | Sampled) -> Pieces:
    """One period, filled up with pieces of no length."""
    with jax.enable_x64(True):
        knots, start, end = (np.asarray(x) for x in wave.pieces())
    missing = max(_PIECES - start.size, 0)
    filled = [
        np.append(x, np.full(missing, last)) for x, last in ((knots, knots[-1]), (start, end[-1]), (end, end[-1]))
    ]
    return Pieces(*filled)


def _along(pieces: Pieces, cycle: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The piece that each time lies in, the time since it began, and its slope."""
    knots, length = pieces.knots.astype(cycle.dtype), np.diff(pieces.knots)
    last = int(np.flatnonzero(length)[-1])
    piece = np.clip(np.searchsorted(knots, cycle, side="right") - 1, 0, last)
    slope = (pieces.end - pieces.start) / np.where(length > 0.0, length, 1.0)
    return piece, np.maximum(cycle - knots[piece], 0.0), slope[piece]


def _factor(scene: Scene, values: Mapping[str, Any], count: int) -> Float[np.ndarray, " circuits"]:
    """Force over the square of the voltage that makes it, in double precision whatever the waves'."""
    with jax.enable_x64(True):
        contact = scene.geometry().contact(scene.make_rc_circuit(dict(values)))
        return np.broadcast_to(np.asarray(force_constant(contact)), count)


def _knots(
    pieces: Pieces, tau: Float[np.ndarray, "circuits terms"], settled: bool
) -> Float[np.ndarray, "circuits terms pieces"]:
    """In columns, so that one program serves any number of terms."""
    return np.stack([np.asarray(_column_knots(pieces, column, settled)) for column in tau.T], axis=1)


@functools.partial(jax.jit, static_argnums=2)
def _column_knots(pieces: Pieces, tau: Float[Array, " circuits"], settled: bool) -> Float[Array, "circuits pieces"]:
    """u just after the start of each piece, in the steady state or without charge before the first."""
    begin = functools.partial(knot_values, pieces, first=pieces.start[0])
    return jax.vmap(functools.partial(steady_knots, pieces) if settled else begin)(tau)


@eqx.filter_jit
def _chirped(drive: Drive, time: Array, tau: Float[Array, "circuits terms"]) -> Float[Array, "circuits terms times"]:
    return jax.vmap(jax.vmap(lambda each: highpass(drive, time, each, steady_state=False)))(tau)
