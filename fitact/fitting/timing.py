"""When a trace's drive began and how fast it runs: the best of a grid, and what a clock of its own would change."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitact.compiled import padded, padded_weight
from fitact.fitting.drive_choice import has_ideal_edges, jumps_within
from fitact.likelihood.channel import TIMING, Seen, Trace
from fitact.likelihood.noise import student_weight
from fitact.model.response import highpass
from fitact.model.skin import constant

_STEP = 1 / 8  # of the grids, in units of the coordinates
_REACH = {"delay": 5.0, "clock": 2.0}
_WRONG_SIDE = 0.1  # of a trace's height: less than what a sample beyond an edge is off by
_AT_ONCE = 27  # places whose signals are computed side by side,
_NUMBERS = 1 << 20  # where these are no more than so many numbers
_DEPENDENT = 1e-9  # of the largest singular value
_BESIDE = 3  # steps from an ideal edge, within which its time shows


def opened(trace: Trace, seen: Seen, name: str) -> Trace:
    """The trace with its delay or clock free, over its samples, since the response table holds none.

    From the middle of the best of a grid: across an ideal edge there is no slope to follow, and between two samples
    nothing that a gain could not do as well. Ideal edges tell a clock, and a delay with it, from the samples beside
    them only; what these leave open is the prior then, and they are left out.
    """
    edges = _beside_edges(trace) if name == "clock" else np.zeros(trace.time.size, bool)
    names = TIMING if edges.any() else (name,)
    units = np.array([float(trace.timing_unit(n)) for n in names])
    timing = tuple(n for n in TIMING if n in names or n in trace.timing)
    trace = dataclasses.replace(trace.summed(), timing=timing)
    reach = [1.0 if len(names) > 1 and n == "delay" else _REACH[n] for n in names]
    axes = [_STEP * np.arange(-int(r / _STEP), int(r / _STEP) + 1) for r in reach]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(names))
    if edges.any():
        left = _left(_part(trace, edges), seen, names, grid * units)
        # more than the least by less than a sample on the wrong side of an edge
        good = grid[left < left.min() + (_WRONG_SIDE * np.ptp(np.asarray(trace.observed))) ** 2]
    else:
        left = _left(trace, seen, names, grid * units)
        good = grid[left < left.min() * (1.0 + 25.0 / trace.own)]
    moved = dict(zip(names, good.mean(axis=0) * units, strict=True))
    trace = dataclasses.replace(
        trace, shift=trace.shift + moved.get("delay", 0.0), clock=trace.clock + moved.get("clock", 0.0)
    )
    if not edges.any():
        return trace
    left_open = np.hypot(good.std(axis=0), _STEP / np.sqrt(12.0))
    weight = jnp.asarray(np.where(edges, 0.0, trace.weights))
    return dataclasses.replace(trace, weight=weight, timing_sd=jnp.asarray(left_open))


def _beside_edges(trace: Trace) -> np.ndarray:
    """Which samples lie beside an ideal edge."""
    if not has_ideal_edges(trace.drive):
        return np.zeros(trace.time.size, bool)
    time, step = np.asarray(trace.time) - float(trace.shift), _BESIDE * float(trace.time_step)
    return jumps_within(trace.drive, time, step)


def _part(trace: Trace, chosen: np.ndarray) -> Trace:
    """With some of its samples only."""
    places, arrays = np.flatnonzero(chosen), (trace.time, trace.observed)
    time, observed = (jnp.asarray(padded(np.asarray(x)[places])) for x in arrays)
    weight = jnp.asarray(padded_weight(trace.weights[places]))
    return dataclasses.replace(trace, time=time, observed=observed, weight=weight)


def _left(trace: Trace, seen: Seen, names: tuple[str, ...], places: np.ndarray) -> Float[np.ndarray, " places"]:
    """What each of the places, in SI units, leaves of the trace with the best gain and linear nuisances."""
    weights, shapes = trace.weights, np.asarray(_shapes(trace, seen))[np.asarray(trace.linear_sd) > 0.0]
    basis = _spanned(shapes * weights)

    def beyond(values: np.ndarray) -> np.ndarray:
        weighted = values * weights
        return weighted - (weighted @ basis) @ basis.T

    observed, left = beyond(np.asarray(trace.observed)), []
    size = max(1, min(_AT_ONCE, _NUMBERS // weights.size))
    for first in range(0, len(places), size):
        some = places[first : first + size]
        filled = np.pad(some, ((0, size - len(some)), (0, 0)), mode="edge")
        signals = beyond(np.asarray(_signals(trace, seen, dict(zip(names, filled.T, strict=True)))))[: len(some)]
        gains = signals @ observed / np.maximum(np.vecdot(signals, signals), 1e-300)
        remainders = observed - gains[:, None] * signals
        left.append(np.vecdot(remainders, remainders))
    return np.concatenate(left)


@eqx.filter_jit
def _signals(trace: Trace, seen: Seen, moves: dict[str, Float[Array, " places"]]) -> Float[Array, "places samples"]:
    def at(moved: dict[str, Array]) -> Array:
        return trace.signal(dataclasses.replace(seen, **{name: getattr(seen, name) + moved[name] for name in moved}))

    return jax.vmap(at)(moves)


def _spanned(rows: Float[np.ndarray, "n samples"]) -> Float[np.ndarray, "samples rank"]:
    """Orthonormal functions over the samples that span the rows."""
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    q, r = np.linalg.qr((rows / np.where(lengths > 0.0, lengths, 1.0)).T)
    modes, sizes, _ = np.linalg.svd(r)
    return q @ modes[:, sizes > _DEPENDENT * np.max(sizes, initial=0.0)]


@eqx.filter_jit
def _shapes(trace: Trace, seen: Seen) -> Array:
    return trace.shapes(seen)


def clock_drop(trace: Trace, seen: Seen, sigma: float) -> float:
    """By what share a free clock would lower the sum of the squared residuals, to first order.

    Its shape is no combination of responses, so the response table does not hold it: from the samples.
    """
    rows = np.asarray(_around(trace.summed(), seen, jnp.asarray(sigma)))
    kept, edges = trace.weights > 0.0, _beside_edges(trace)
    drop = _drop(rows[:, kept])
    # an ideal edge shows a clock where it has passed a sample, and hides it where it has not
    return max(drop, _drop(rows[:, kept & ~edges])) if edges.any() else drop


def _drop(rows: np.ndarray) -> float:
    basis = _spanned(rows[2:])
    clock, remainder = (x - basis @ (basis.T @ x) for x in rows[:2])
    return float((clock @ remainder) ** 2 / max((clock @ clock) * (remainder @ remainder), 1e-300))


@eqx.filter_jit
def _around(trace: Trace, seen: Seen, sigma: Array) -> Float[Array, "n samples"]:
    """What a clock changes, what is left of the trace, and all that the circuit and the linear nuisances can change."""
    time = trace.time - (trace.shift + seen.delay)
    taus = jnp.stack(constant(seen.circuit).terms_of(trace.channel).tau)

    def response(log_tau: Array) -> Array:
        return highpass(trace.drive, time, jnp.exp(log_tau), steady_state=trace.steady_state)

    along, bent = jax.vmap(lambda x: jax.jvp(response, (x,), (jnp.ones_like(x),)))(jnp.log(taus))
    slope = trace.change_by_delay(seen)
    shapes = jnp.where(trace.linear_sd[:, None] > 0.0, trace.shapes(seen), 0.0)
    # a free delay changes the slope alone
    delay = slope if "delay" in trace.timing else jnp.zeros_like(slope)
    rows = jnp.stack([time * slope, trace.observed - trace.signal(seen), *along, *bent, *shapes, delay])
    rows = trace.weighted(rows)
    if trace.noise != "student":
        return rows
    return rows * jnp.sqrt(student_weight(trace.linear(seen, sigma)[0] / sigma))
