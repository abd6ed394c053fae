"""Compressions of many records on one time grid, each with its own recorded drive.

Responses to the drive of a record are tabulated in a narrow range of time constants, by exact recursion. The decays of
an unknown charge, offset, drift and hum are functions of time alone, which all records share. The inner products of
these functions and the record give a `Compression`. Functions are computed again where they serve again, which takes
less time than to store them.
"""

import functools
import math
from typing import NamedTuple, Self

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from fitact.batch.gauss_newton import decompose_qr, substitute_back
from fitact.compiled import jit, map_blocks
from fitact.data.tones import Tones
from fitact.likelihood.compression import BASELINE_NAMES, split_functions
from fitact.likelihood.projection import MAX_DELAY, evaluate_baseline, root_products, uniform_recurrence
from fitact.likelihood.smooth_drive import lasting_bend, smooth_drive
from fitact.model.response_table import (
    NODES,
    TABLE_HALF_WIDTH,
    ResponseTable,
    chebyshev,
    chebyshev_polynomials,
    count_nodes,
)

HALF_WIDTH = 0.05  # of a record's table, in log tau
AGES = 1  # time steps by which the delay of a record may differ from that of the first
TABLE_NODES = count_nodes(HALF_WIDTH, 2e-9)
RECORD_BLOCK = 4  # records whose functions are computed at once; see `map_blocks`
_BLOCK = 50  # samples whose responses are computed one after the other, in parallel with other blocks


class SharedFunctions(NamedTuple):
    """Functions of time that all records share: offset, drift, hum, and the decays of unknown charges.

    Attributes:
        functions: orthonormal over the fitted samples, which are all but `MAX_DELAY` at both ends; known at all.
        is_fitted: 1 at the samples of the drive to which the fitted ones respond, and 0 at others.
        fitted_functions: the functions at the times of the responses to these, and 0 at others.
        baseline: coordinates of the shapes of `BASELINE_NAMES`.
        decay: Chebyshev coefficients in log tau of the coordinates of e^{-(t - t0) / tau}.
        center: center of the range of log tau, whose half-width is `TABLE_HALF_WIDTH`.
        time_step: s.
        origin: delay of the first record in time steps, rounded.
        curve: part of the second differences of a drive that is added to it (`missing_curve`).
        tones: orthonormal functions of which the first drive consists, if it consists of few tones.
    """

    functions: Float[Array, "shared samples"]
    is_fitted: Float[Array, " samples"]
    fitted_functions: Float[Array, "shared samples"]
    baseline: Float[Array, "shapes shared"]
    decay: Float[Array, "shared terms"]
    center: Float[Array, ""]
    time_step: Float[Array, ""]
    origin: Int[Array, ""]
    curve: Float[Array, ""]
    tones: Float[Array, "tones samples"]

    @classmethod
    def from_times(
        cls, time: Float[np.ndarray, " samples"], tau: float, origin: int, curve: float, tones: Tones | None
    ) -> Self:
        """Return the functions at uniform times (s), for time constants around `tau` (s).

        `origin` and `curve` are as in the attributes, `tones` those of the first drive.
        """
        x, to_series = chebyshev(NODES)
        decays = np.exp(-(time - time[0])[:, None] / (tau * np.exp(TABLE_HALF_WIDTH * x)))
        middle, half = 0.5 * (time[0] + time[-1]), 0.5 * (time[-1] - time[0])
        shapes = np.column_stack([evaluate_baseline(time, middle, half).T, decays])
        _, sizes, modes = np.linalg.svd(shapes[MAX_DELAY:-MAX_DELAY], full_matrices=False)
        # a charge is no larger than the drive, and needs fewer digits
        rank = np.count_nonzero(sizes > 1e-10 * sizes[0])
        baseline, decay = np.split(sizes[:rank, None] * modes[:rank], [len(BASELINE_NAMES)], axis=1)
        functions, step = modes[:rank] / sizes[:rank, None] @ shapes.T, (time[-1] - time[0]) / (time.size - 1)
        is_fitted = np.zeros(time.size)
        is_fitted[MAX_DELAY - origin : time.size - MAX_DELAY - origin] = 1.0
        fitted_functions = is_fitted * np.roll(functions, -origin, axis=1)
        numbers = np.asarray(math.log(tau)), np.asarray(step), np.asarray(origin), np.asarray(curve)
        basis = np.empty((0, time.size)) if tones is None else tones.basis()
        return cls(functions, is_fitted, fitted_functions, baseline.T, decay @ to_series.T, *numbers, basis)

    @property
    def size(self) -> int:
        """Number of functions."""
        return len(self.functions)

    def select_fitted(self, values: Float[Array, " samples"]) -> Float[Array, " used"]:
        """Return values at the times of the drive at the fitted samples, delayed by `origin`."""
        return lax.dynamic_slice(values, (MAX_DELAY - self.origin,), (values.size - 2 * MAX_DELAY,))

    def smooth_drive(self, V: Float[Array, " samples"], noise: Float[Array, ""]) -> Float[Array, " samples"]:
        """Return a drive without most of its white noise, of sd `noise` (V), as a single fit smooths it."""
        smooth = smooth_drive(V, noise)
        if not len(self.tones):
            return smooth
        tones = (self.tones @ V) @ self.tones
        return jnp.where(jnp.std(V - tones) < 1.5 * noise, tones, smooth)

    def decay_polynomials(self, tau: Float[Array, " nodes"]) -> Float[Array, "terms nodes"]:
        """Return the polynomials in log tau whose coefficients are in `decay`."""
        return chebyshev_polynomials((jnp.log(tau) - self.center) / TABLE_HALF_WIDTH, NODES)

    def filter_drive(
        self,
        V: Float[Array, " samples"],
        Vsc: Float[Array, " samples"],
        tau: Float[Array, " nodes"],
        smooth: Float[Array, " samples"],
    ) -> Float[Array, "own samples"]:
        """Return the functions of a record: the responses to `smooth` at the nodes, the `steps`, and last Vsc itself.

        They are those at the times of the drive, i.e. without the delay `origin`. `smooth` is V without its noise.
        """
        samples, noise = V.size, V - smooth
        smooth = smooth + self.curve * lasting_bend(smooth)
        rises = jnp.diff(jnp.pad(smooth, (AGES + 1, AGES), mode="edge")) / self.time_step
        steps = [*(rises[AGES - age : AGES - age + samples] for age in range(-AGES, AGES)), noise]
        return jnp.concatenate([self.respond(smooth, tau), jnp.stack([*steps, jnp.roll(Vsc, -self.origin)])])

    def respond(self, drive: Float[Array, " samples"], tau: Float[Array, " nodes"]) -> Float[Array, "nodes samples"]:
        """Return the responses to a drive at its samples."""
        x = self.time_step / tau
        # the first sample is a jump from 0
        rise = jnp.pad(jnp.diff(drive, prepend=drive[:1]), (0, -drive.size % _BLOCK))
        return uniform_recurrence(rise, drive[0] * jnp.exp(x), x, _BLOCK)[:, : drive.size]


def table_nodes(tau: Float[Array, ""]) -> Float[Array, " nodes"]:
    """Return the time constants of a table around `tau`."""
    return tau * np.exp(HALF_WIDTH * chebyshev(TABLE_NODES)[0])


class Tables(NamedTuple):
    """Compressions of records, in terms of functions of time.

    The functions of a record are those that all share, the responses at the nodes of its table, the steps of its drive,
    and the record itself.

    Attributes:
        g, b: estimates of the parameters, around which each table lies (b in s).
        is_possible: whether they could be estimated.
        smooth: V without its noise, to which the records respond.
        decay: decays of an unknown charge at the nodes, in the shared functions.
        coordinates: orthogonal coordinates of the functions, with the inner products over the fitted samples.
    """

    shared: SharedFunctions
    g: Float[np.ndarray, " records"]
    b: Float[np.ndarray, " records"]
    is_possible: Bool[np.ndarray, " records"]
    smooth: Float[np.ndarray, "records samples"]
    decay: Float[np.ndarray, "records shared nodes"]
    coordinates: Float[np.ndarray, "records rows functions"]

    @classmethod
    def from_records(
        cls,
        shared: SharedFunctions,
        V: Float[np.ndarray, "records samples"],
        Vsc: Float[np.ndarray, "records samples"],
        noise: Float[np.ndarray, " records"],
    ) -> Self:
        """Tabulate the responses of each record; `noise` is the sd of the white noise of V."""
        g, b, is_possible, smooth, decay, across, products = _multiply_functions(shared, V, Vsc, noise)
        scale = np.sqrt(np.einsum("rii->ri", products))
        rest, *_ = root_products(products - np.swapaxes(across, 1, 2) @ across, scale)
        own = np.concatenate([across, rest], axis=1)
        first = np.broadcast_to(np.eye(own.shape[1], shared.size), (len(V), own.shape[1], shared.size))
        return cls(shared, g, b, is_possible, smooth, decay, np.concatenate([first, own], axis=2))

    def fields(self, *, in_functions: bool = False) -> dict[str, np.ndarray]:
        """Return the fields of `Compression` that differ between records, by name.

        If `in_functions`, the coordinates are instead coefficients of the functions, and the record is 0.
        """
        columns = self.coordinates
        if in_functions:
            *_, count = columns.shape
            columns = np.broadcast_to(np.eye(count - 1, count), (len(columns), count - 1, count))
        records, rows, _ = columns.shape
        size, series = self.shared.size, chebyshev(TABLE_NODES)[1].T
        found = split_functions(columns, {"shared": size, "signal": TABLE_NODES, "steps": 2 * AGES + 1, "observed": 1})
        steps = np.swapaxes(found["steps"], 1, 2)
        zeros, missing = np.zeros((records, rows)), ((0, 0), (0, rows - size))
        return {
            "center": np.log(self.b),
            "signal": found["signal"] @ series,
            "decay": np.pad(self.decay @ series, (*missing, (0, 0))),
            "baseline": np.tile(np.pad(self.shared.baseline, missing), (records, 1, 1)),
            "rate": zeros,
            "slope": 0.5 * (steps[:, AGES - 1] + steps[:, AGES]),
            "observed": found["observed"][..., 0],
            "observed_slope": zeros,
            "steps": steps,
        }


def make_response_table(
    center: Float[Array, ""], signal: Float[Array, "rows terms"], decay: Float[Array, "rows terms"]
) -> ResponseTable:
    """Return a record's table, undelayed, from Chebyshev coefficients of values at times or of other coefficients."""
    signal = jnp.pad(signal, ((0, 0), (0, 1)))
    return ResponseTable(center[None], jnp.asarray(HALF_WIDTH), signal, decay, jnp.eye(TABLE_NODES), jnp.zeros(()))


@functools.partial(jit, fast=True)
def _multiply_functions(
    shared: SharedFunctions,
    V: Float[Array, "records samples"],
    Vsc: Float[Array, "records samples"],
    noise: Float[Array, " records"],
) -> tuple[Array, ...]:
    """Return what `Tables` holds of each record, and the inner products of functions with the shared ones and own."""

    def multiply_record(record: tuple[Array, Array, Array]) -> tuple[Array, ...]:
        v, vsc, sd = record
        g, b, is_possible = _estimate_start(shared, v, vsc)
        nodes = table_nodes(b)
        smooth, decay = shared.smooth_drive(v, sd), shared.decay @ shared.decay_polynomials(nodes)
        used = shared.is_fitted * shared.filter_drive(v, vsc, nodes, smooth)
        return g, b, is_possible, smooth, decay, shared.fitted_functions @ used.T, used @ used.T

    return map_blocks(multiply_record, (V, Vsc, noise), RECORD_BLOCK)


def _estimate_start(
    shared: SharedFunctions, V: Float[Array, " samples"], Vsc: Float[Array, " samples"], stride: int = 3
) -> tuple[Float[Array, ""], Float[Array, ""], Bool[Array, ""]]:
    """Estimate g and b (s) from Vsc = g V - (1/b) ∫ Vsc dt + line, with V delayed, and whether it is possible.

    One sample of `stride` suffices; even strides would meet the same phases of most drives again.
    """
    summed = jnp.pad(Vsc, (0, -Vsc.size % _BLOCK))
    integral = uniform_recurrence(summed, jnp.zeros(1), jnp.zeros(1), _BLOCK)[0, : Vsc.size] - 0.5 * Vsc
    delayed = jnp.roll(V, shared.origin)
    # steps of the drive around a sample represent a delay by a fraction of a step
    before, moved, after = (delayed[MAX_DELAY + k : V.size - MAX_DELAY + k : stride] for k in (-1, 0, 1))
    integral, observed = (x[MAX_DELAY : V.size - MAX_DELAY : stride] for x in (integral, Vsc))
    line = jnp.linspace(-1.0, 1.0, moved.size)
    rows = jnp.stack([moved, integral, moved - before, after - moved, jnp.ones_like(line), line, observed])
    products = rows @ rows.T
    scale = jnp.sqrt(jnp.diagonal(products))
    scale = jnp.where(scale == 0.0, 1.0, scale)
    products = products / (scale[:, None] * scale)
    normal = products[:-1, :-1] + np.finfo(float).eps * np.eye(len(rows) - 1)
    solution = substitute_back(*decompose_qr(normal, products[:-1, -1]))[:2] * scale[-1] / scale[:2]
    g, rate = solution[0], -solution[1] / shared.time_step
    log_b = -jnp.log(jnp.maximum(rate, np.finfo(float).tiny))
    is_possible = (g > 0.0) & (g < 0.5) & (log_b > jnp.log(3.0 * shared.time_step))
    is_possible &= jnp.abs(log_b - shared.center) < TABLE_HALF_WIDTH - HALF_WIDTH
    return jnp.where(is_possible, g, 0.1), jnp.exp(jnp.where(is_possible, log_b, shared.center)), is_possible
