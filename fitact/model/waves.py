"""Vsc of many circuits under one drive, for comparing models with each other.

All circuits share one compiled program: what a circuit lacks is filled in with a value too small to matter. The rest
is NumPy, where nothing is compiled: every response is a sum of exponentials along the straight pieces of its drive, and
a window is a set of nodes, graded towards the corners, where a small resistance makes its difference.
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Complex, Float

from fitact.model.chirp import Chirp
from fitact.model.circuit import RC, DirectGround, Element, FinalCircuit, NaturalGround, Probe
from fitact.model.drive import Burst, Drive, Periodic, Pieces, PiecewiseLinear, Sine
from fitact.model.harmonic import fourier
from fitact.model.multitone import Multitone
from fitact.model.response import highpass, steady_knots
from fitact.model.scene import Scene
from fitact.model.skin import Fractional, Skin, WithSkin, spread

ROWS = 128  # circuits side by side; fewer are filled up, so that each program is compiled once
_ABSENT = 1e-6  # ohm: with any capacitance here over long before the first node
_PIECES = 4  # of a period; fewer are filled up with ones of no length
_DECADES, _ORDER = 8, 8  # of a piece, and the order of the rule in each
_PERIODS = 12  # from rest: periods that stand for all, in geometric progression
_CHIRP_TIMES = 2048
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
    def of(cls, scene: Scene) -> "Window":
        """One period of the steady state; else the scene's duration from rest."""
        drive, duration = scene.make_drive(), scene.measurement.duration
        if isinstance(drive, Chirp):
            times = duration * (np.arange(_CHIRP_TIMES) + 0.5) / _CHIRP_TIMES
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
    """

    drive: Drive
    steady_state: bool
    pieces: Pieces | None
    weight: Float[np.ndarray, "circuits terms"]
    tau: Float[np.ndarray, "circuits terms"]
    knots: Float[np.ndarray, "circuits terms pieces"]
    harmonics: Complex[np.ndarray, "circuits harmonics"]

    @classmethod
    def of(cls, scene: Scene, values: Mapping[str, Any], precision: type[np.floating[Any]] = np.float64) -> "Waves":
        """Those of the scene's circuit at `values` (SI, by name; arrays of at most `ROWS`), in that precision."""
        drive, count = scene.make_drive(), max(np.size(value) for value in values.values())
        with jax.enable_x64(precision is np.float64):
            circuit = scene.make_circuit(dict(values))
            skin = None
            if isinstance(circuit, WithSkin):  # its exponent may differ from circuit to circuit
                skin = jax.tree.map(lambda x: _filled_up(x, precision)[:, None], circuit.skin)
            complete = _complete(scene.make_rc_circuit(dict(values)))
            filled = jax.tree.map(lambda x: _filled_up(x, precision), complete)
            weight, tau, harmonics = _terms(filled, skin, drive, precision)
            tau = np.maximum(tau, np.finfo(np.float32).tiny)  # single precision may lose that of an absent part
            wave = drive.wave if isinstance(drive, Burst) else drive
            pieces = _pieces(wave) if isinstance(wave, PiecewiseLinear) else None
            knots = np.zeros((*tau.shape, 0), dtype=precision)
            if pieces is not None:
                knots = np.asarray(_knots(jax.tree.map(precision, pieces), tau))
        rows = (x[:count] for x in (weight.astype(precision), tau.astype(precision), knots, harmonics))
        return cls(drive, scene.drive.steady_state, pieces, *rows)

    def at(self, cycle: np.ndarray, elapsed: np.ndarray) -> Rows:
        """Vsc at nodes common to all circuits, or at each circuit's own."""
        cycle, elapsed = (np.atleast_2d(x).astype(self.tau.dtype) for x in (cycle, elapsed))
        if isinstance(self.drive, Chirp):
            with jax.enable_x64(self.tau.dtype == np.float64):
                u = np.asarray(_chirped(self.drive, elapsed[0], _filled_up(self.tau, self.tau.dtype)))[: len(self.tau)]
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
            for order, height, phase in _tones(wave):
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
    """The full model's waves over a window, to compare others with."""

    def __init__(self, window: Window, full: Waves) -> None:
        self.window = window
        self.vsc = full.at(window.cycle, window.elapsed)
        self.peak = _peak(window, full, self.vsc)

    def compare(self, waves: Waves) -> Comparison:
        """How far `waves`, of as many of the circuits from the first on, lie from the full model's."""
        vsc, weight = waves.at(self.window.cycle, self.window.elapsed), self.window.weight
        full = self.vsc[: len(vsc)]
        mean_square = full**2 @ weight
        peak = _peak(self.window, waves, vsc) / self.peak[: len(vsc)]
        return Comparison(
            np.sqrt((vsc - full) ** 2 @ weight / mean_square),
            np.abs(peak - 1.0),
            np.abs(vsc**2 @ weight / mean_square - 1.0),
            np.abs(peak**2 - 1.0),
        )


def _peak(window: Window, waves: Waves, vsc: Rows) -> Float[np.ndarray, " circuits"]:
    """The largest |Vsc|, between the nodes too: the highest stretches are looked at more closely."""
    if isinstance(waves.drive, Chirp):  # smooth, and compiled for its nodes
        return np.abs(vsc).max(axis=1)
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


def _tones(wave: Any) -> list[tuple[int, float, float]]:
    """Of a smooth drive: order, amplitude (V), and phase beside the whole's (rad)."""
    if isinstance(wave, Sine):
        return [(1, 0.5 * float(wave.peak_to_peak), 0.0)]
    phases = wave.phases or (0.0,) * len(wave.orders)
    return [
        (n, float(height), float(phase)) for n, height, phase in zip(wave.orders, wave.amplitudes, phases, strict=True)
    ]


def _corners(wave: Periodic) -> np.ndarray:
    if isinstance(wave, Sine | Multitone):
        return np.linspace(0.0, 1.0, 4 * max(order for order, _, _ in _tones(wave)) + 1) / float(wave.frequency)
    assert isinstance(wave, PiecewiseLinear)
    return np.unique(_pieces(wave).knots)


def _pieces(wave: PiecewiseLinear) -> Pieces:
    """One period, filled up with pieces of no length."""
    with jax.enable_x64(True):
        knots, start, end = (np.asarray(x) for x in wave.pieces())
    missing = _PIECES - start.size
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


def _complete(circuit: RC) -> DirectGround | NaturalGround:
    """The circuit with every part that its kind may have, an absent one too small to matter."""
    if isinstance(circuit, FinalCircuit):
        circuit = DirectGround(circuit.Rsc, circuit.Csc, circuit.Ci)
    skin, probe = (circuit.Rsc, circuit.Csc, circuit.Ci), circuit.probe or Probe(math.inf, 0.0)
    if isinstance(circuit, DirectGround):
        R = circuit.Rsc if circuit.grounding_Rsc is None else circuit.grounding_Rsc
        C = circuit.Csc if circuit.grounding_Csc is None else circuit.grounding_Csc
        return DirectGround(*skin, _sum(circuit.R_H, circuit.series_resistor), R, C, None, probe)
    if circuit.Z_capacitance is None:
        return NaturalGround(*skin, _ABSENT, 0.0, _sum(circuit.Z, circuit.series_resistor), probe)
    return NaturalGround(*skin, circuit.Z, circuit.Z_capacitance, _sum(circuit.series_resistor), probe)


def _sum(*resistances: Any) -> Any:
    return sum((resistance for resistance in resistances if resistance is not None), start=_ABSENT)


def _filled_up(values: Any, precision: Any) -> np.ndarray:
    """As many rows as programs are compiled for, the first standing in for those that are missing."""
    values = np.atleast_1d(np.asarray(values, dtype=precision))
    return np.concatenate([values, np.broadcast_to(values[:1], (ROWS - len(values), *values.shape[1:]))])


def _terms(
    circuit: DirectGround | NaturalGround, skin: Skin | None, drive: Drive, precision: type[np.floating[Any]]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weights, time constants, and amplitudes of the harmonics that they miss."""
    if skin is None:
        weight, tau = _constant_terms(circuit)
        return weight, tau, np.zeros((ROWS, 0), dtype=complex)
    assert isinstance(drive, Periodic)
    frequency = float(drive.frequency)
    smooth = isinstance(drive, Sine | Multitone)
    count = max(order for order, _, _ in _tones(drive)) if smooth else max(1, skin.count(frequency))
    omega = 2.0 * np.pi * frequency * np.arange(1, count + 1)
    gain, amplitude = _gain(circuit, skin, omega), np.asarray(_fourier(jax.tree.map(np.asarray, drive), count))
    if smooth:
        return np.zeros((ROWS, 0)), np.zeros((ROWS, 0)), amplitude * gain
    if isinstance(skin, Fractional):
        tau, x, fitted = spread(True, precision is np.float64)
        above = _gain(circuit, skin, omega[-1] * x)
        weight = np.concatenate([above.real, above.imag], axis=1) @ fitted.T
        tau = np.broadcast_to(tau / omega[-1], weight.shape)
    else:  # above 1000 Hz it is constant
        weight, tau = _constant_terms(WithSkin(circuit, skin).at(1000.0))
    x = 1j * omega * tau[..., None]
    return weight, tau, amplitude * (gain - np.einsum("rk,rkh->rh", weight, x / (1.0 + x)))


def _gain(circuit: DirectGround | NaturalGround, skin: Skin, omega: np.ndarray) -> np.ndarray:
    """Vsc / V of circuits whose skins follow a level."""
    s = 1j * omega

    def admittance(element: Element) -> np.ndarray:
        R, C = (np.atleast_2d(np.asarray(x).T).T for x in element)
        return 1.0 / R + s * C

    def of_skin(R: ArrayLike, C: ArrayLike) -> np.ndarray:
        return admittance(_skin_at(skin, Element(*(jnp.asarray(x)[:, None] for x in (R, C))), omega / (2.0 * np.pi)))

    assert circuit.probe is not None
    touching = 1.0 / (of_skin(circuit.Rsc, circuit.Csc) + admittance(Element(circuit.probe.R, circuit.probe.C)))
    if isinstance(circuit, NaturalGround):
        other = 1.0 / admittance(Element(circuit.Z, circuit.Z_capacitance))
    else:
        other = 1.0 / of_skin(circuit.grounding_Rsc, circuit.grounding_Csc)
    rest = np.asarray(circuit.resistance())[:, None] + 1.0 / (s * np.asarray(circuit.Ci)[:, None])
    return touching / (touching + other + rest)


@eqx.filter_jit
def _fourier(drive: Drive, harmonics: int) -> Complex[Array, " harmonics"]:
    return fourier(drive, harmonics)


@eqx.filter_jit
def _skin_at(skin: Skin, element: Element, frequency: Array) -> Element:
    return skin.at(element, frequency)


def _constant_terms(circuit: Any) -> tuple[np.ndarray, np.ndarray]:
    """Of constant skins. Z stands in the loop where a grounding skin does, so one program serves both."""
    if isinstance(circuit, NaturalGround):
        loop = circuit.series_resistor, circuit.Z, circuit.Z_capacitance
        circuit = DirectGround(circuit.Rsc, circuit.Csc, circuit.Ci, *loop, None, circuit.probe)
    weight, tau = _constant(circuit)
    return np.asarray(weight), np.asarray(tau)


@jax.jit
def _constant(circuit: DirectGround) -> tuple[Array, Array]:
    terms = jax.vmap(lambda one: one.terms())(circuit)
    return jnp.stack(terms.weight, axis=1), jnp.stack(terms.tau, axis=1)


@jax.jit
def _knots(pieces: Pieces, tau: Float[Array, "circuits terms"]) -> Float[Array, "circuits terms pieces"]:
    return jax.vmap(jax.vmap(functools.partial(steady_knots, pieces)))(tau)


@eqx.filter_jit
def _chirped(drive: Drive, time: Array, tau: Float[Array, "circuits terms"]) -> Float[Array, "circuits terms times"]:
    return jax.vmap(jax.vmap(lambda each: highpass(drive, time, each, steady_state=False)))(tau)
