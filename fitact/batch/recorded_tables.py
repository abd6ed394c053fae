"""Compressions of many records on one time grid, each with its own recorded drive.

Responses to the drive of a record are tabulated in a narrow range of time constants, by exact recursion. The decays of
an unknown charge, offset, drift and hum are functions of time alone, which all records share. The inner products of
these functions and the record give a `Compression`.
"""

import functools
import math
from typing import NamedTuple, Self

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from fitact.compiled import jit
from fitact.likelihood.compression import BASELINE_NAMES, Compression
from fitact.likelihood.projection import evaluate_baseline, uniform_recurrence
from fitact.model.response_table import NODES, TABLE_HALF_WIDTH, ResponseTable, chebyshev

HALF_WIDTH = 0.05  # of a record's table, in log tau
AGES = 1  # time steps by which the delay of a record may differ from that of the first
TABLE_NODES = 5  # of a record's table, with which its responses are exact to 1e-9
_BLOCK = 50  # samples whose responses are computed one after the other, in parallel with other blocks


class SharedFunctions(NamedTuple):
    """Functions of time that all records share: offset, drift, hum, and the decays of unknown charges.

    Attributes:
        functions: orthonormal over the fitted samples, known at all.
        used: the fitted samples.
        baseline: coordinates of the shapes of `BASELINE_NAMES`.
        decay: Chebyshev coefficients in log tau of the coordinates of e^{-(t - t0) / tau}.
        center: center of the range of log tau, whose half-width is `TABLE_HALF_WIDTH`.
        time_step: s.
        origin: delay of the first record in time steps, rounded.
    """

    functions: Float[np.ndarray, "samples shared"]
    used: slice
    baseline: Float[np.ndarray, "shapes shared"]
    decay: Float[np.ndarray, "shared terms"]
    center: float
    time_step: float
    origin: int

    @classmethod
    def from_times(cls, time: Float[np.ndarray, " samples"], margin: int, tau: float, origin: int) -> Self:
        """Return the functions at uniform times (s), for time constants around `tau` (s).

        `margin` samples at both ends are not fitted.
        """
        used = slice(margin, time.size - margin)
        x, to_series = chebyshev(NODES)
        decays = np.exp(-(time - time[0])[:, None] / (tau * np.exp(TABLE_HALF_WIDTH * x)))
        middle, half = 0.5 * (time[0] + time[-1]), 0.5 * (time[-1] - time[0])
        shapes = np.column_stack([evaluate_baseline(time, middle, half).T, decays])
        _, sizes, modes = np.linalg.svd(shapes[used], full_matrices=False)
        # a charge is no larger than the drive, and needs fewer digits
        rank = np.count_nonzero(sizes > 1e-10 * sizes[0])
        baseline, decay = np.split(sizes[:rank, None] * modes[:rank], [len(BASELINE_NAMES)], axis=1)
        functions, step = shapes @ (modes[:rank].T / sizes[:rank]), float((time[-1] - time[0]) / (time.size - 1))
        return cls(functions, used, baseline.T, decay @ to_series.T, math.log(tau), step, origin)

    @property
    def size(self) -> int:
        """Number of functions."""
        return self.functions.shape[1]

    def select_fitted(self, own: Float[np.ndarray, "records own samples"]) -> Float[np.ndarray, "records own used"]:
        """Return functions at the times of the drive at the fitted samples, delayed by `origin`."""
        return own[:, :, self.used.start - self.origin : self.used.stop - self.origin]


class Tables(NamedTuple):
    """Compressions of records, in terms of functions of time.

    The functions of a record are those that all share, the responses at the nodes of its table, and the steps of its
    drive.

    Attributes:
        own: responses, steps, and last the record itself, at the times of the drive, i.e. without the delay `origin`.
        center: center of each table, in log tau.
        decay: decays of an unknown charge at the nodes, in the shared functions.
        coordinates: orthogonal coordinates of the functions, with the inner products over the fitted samples.
        observed: the same for the record.
    """

    shared: SharedFunctions
    own: Float[np.ndarray, "records own samples"]
    center: Float[np.ndarray, " records"]
    decay: Float[np.ndarray, "records shared nodes"]
    coordinates: Float[np.ndarray, "records rows functions"]
    observed: Float[np.ndarray, "records rows"]

    @classmethod
    def from_records(
        cls,
        shared: SharedFunctions,
        V: Float[np.ndarray, "records samples"],
        Vsc: Float[np.ndarray, "records samples"],
        tau: Float[np.ndarray, " records"],
    ) -> Self:
        """Tabulate the responses to V around the time constants `tau` (s)."""
        nodes, size = tau[:, None] * np.exp(HALF_WIDTH * chebyshev(TABLE_NODES)[0]), shared.size
        inside = (np.log(nodes) - shared.center) / TABLE_HALF_WIDTH
        decay = np.swapaxes(np.polynomial.chebyshev.chebvander(inside, NODES - 1) @ shared.decay.T, 1, 2)
        own = _filter_drives(V, np.roll(Vsc, -shared.origin, axis=1), shared.time_step / nodes)
        used = shared.select_fitted(own)
        across = used.reshape(-1, used.shape[-1]) @ shared.functions[shared.used]
        across = np.swapaxes(across.reshape(*own.shape[:2], size), 1, 2)
        products = used @ np.swapaxes(used, 1, 2)
        scale = np.sqrt(np.einsum("rii->ri", products))
        rest = _factor_products(products - np.swapaxes(across, 1, 2) @ across, scale)
        columns = np.concatenate([across, rest], axis=1)
        first = np.broadcast_to(np.eye(columns.shape[1], size), (len(V), columns.shape[1], size))
        coordinates = np.concatenate([first, columns[:, :, :-1]], axis=2)
        return cls(shared, own, np.log(tau), decay, coordinates, columns[:, :, -1])

    def fields(self, *, in_functions: bool = False) -> dict[str, np.ndarray]:
        """Return the fields of `Compression` that differ between records, by name.

        If `in_functions`, the coordinates are instead coefficients of the functions, and the record is 0.
        """
        records, _, functions = self.coordinates.shape
        to_rows = (
            np.broadcast_to(np.eye(functions), (records, functions, functions)) if in_functions else self.coordinates
        )
        rows, size, series = to_rows.shape[1], self.shared.size, chebyshev(TABLE_NODES)[1].T
        zeros, missing = np.zeros((records, rows)), ((0, 0), (0, rows - size))
        steps = np.swapaxes(to_rows[:, :, size + TABLE_NODES :], 1, 2) / self.shared.time_step
        return {
            "center": self.center,
            "signal": to_rows[:, :, size : size + TABLE_NODES] @ series,
            "decay": np.pad(self.decay @ series, (*missing, (0, 0))),
            "baseline": np.tile(np.pad(self.shared.baseline, missing), (records, 1, 1)),
            "rate": zeros,
            "slope": 0.5 * (steps[:, AGES - 1] + steps[:, AGES]),
            "observed": zeros if in_functions else self.observed,
            "observed_slope": zeros,
            "steps": steps,
        }

    def residuals(self, fitted: Float[np.ndarray, "records functions"]) -> Float[np.ndarray, "records used"]:
        """Return the records minus a model with these coefficients, at the fitted samples."""
        size, used = self.shared.size, self.shared.select_fitted(self.own)
        model = (fitted[:, None, size:] @ used[:, :-1])[:, 0]
        model += fitted[:, :size] @ self.shared.functions[self.shared.used].T
        return np.subtract(used[:, -1], model, out=model)


def to_response_table(table: Compression) -> ResponseTable:
    """Return a table of coefficients from a compression in functions; the response is not delayed."""
    signal = jnp.pad(table.signal, ((0, 0), (0, 1)))
    return ResponseTable(table.center[None], table.half_width, signal, table.decay, jnp.eye(TABLE_NODES), 0.0)


def _factor_products(
    products: Float[np.ndarray, "records n n"], scale: Float[np.ndarray, "records n"]
) -> Float[np.ndarray, "records n n"]:
    """Return coordinates (columns) that have these inner products, to rounding relative to the squares of `scale`."""
    scale = np.where(scale > 0.0, scale, 1.0)
    values, vectors = np.linalg.eigh(products / (scale[:, :, None] * scale[:, None, :]))
    return np.sqrt(np.maximum(values, 0.0))[:, :, None] * np.swapaxes(vectors, 1, 2) * scale[:, None, :]


def _filter_drives(
    V: Float[np.ndarray, "records samples"], Vsc: np.ndarray, x: Float[np.ndarray, "records nodes"]
) -> Float[np.ndarray, "records functions samples"]:
    """Return the responses at the nodes, the steps of the drive, and Vsc; `x` is the time step over tau."""
    missing = ((0, 0), (0, -V.shape[1] % _BLOCK))
    return _filter_padded(np.pad(V, missing, mode="edge"), np.pad(Vsc, missing), x)[:, :, : V.shape[1]]


@functools.partial(jit, fast=True)
def _filter_padded(V: Array, Vsc: Array, x: Array) -> Float[Array, "records functions padded"]:
    def filter_drive(record: tuple[Array, Array, Array]) -> Array:
        v, vsc, x = record
        rises = jnp.diff(jnp.pad(v, (AGES + 1, AGES), mode="edge"))
        steps = [rises[AGES - age : AGES - age + v.size] for age in range(-AGES, AGES)]
        # the first sample is a jump from 0
        u = uniform_recurrence(steps[AGES], v[0] * jnp.exp(x), x, _BLOCK)
        return jnp.concatenate([u, jnp.stack(steps), vsc[None]])

    return lax.map(filter_drive, (V, Vsc, x))
