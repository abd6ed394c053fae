"""Records of one drive on one time grid, in coordinates that they share.

As a `fitact.likelihood.compression.Compression` of each, but the basis is worked out once, so that a record costs one
product with a matrix of some twenty columns.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitact.compiled import padded
from fitact.likelihood.compression import NODES, RANK, REACH, Compression, chebyshev, in_fours, slow_shapes
from fitact.model.drive import Drive
from fitact.model.response import highpass


class Narrow(NamedTuple):
    """Records on tables of their own, of few coordinates: signal and record of a `Compression` around each center.

    Attributes:
        center, reach: of each, in log s.
    """

    center: Float[np.ndarray, " records"]
    reach: Float[np.ndarray, " records"]
    signal: Float[np.ndarray, "records terms terms"]
    observed: Float[np.ndarray, "records terms+1"]


class SharedBasis(NamedTuple):
    """Orthonormal functions over the samples, whose first span the responses of time constants around a middle one.

    Attributes:
        center: of the table, log s.
        functions: over the samples; the last is how a faster clock changes the record, to first order.
        signal: Chebyshev coefficients in log tau of the response to the drive (V), in the first coordinates.
        slow, slope, clock: the shapes of a `Compression` in these coordinates, and that of the clock.
    """

    center: float
    functions: Float[np.ndarray, "samples coordinates"]
    signal: Float[np.ndarray, "rank terms"]
    slow: Float[np.ndarray, "shapes coordinates"]
    slope: Float[np.ndarray, " coordinates"]
    clock: Float[np.ndarray, " coordinates"]

    @classmethod
    def around(cls, drive: Drive, time: Float[np.ndarray, " samples"], steady_state: bool, tau: float) -> "SharedBasis":
        """For time constants within a factor 9 of `tau` (s). Call it in double precision."""
        x, to_series = chebyshev(NODES)
        nodes = jnp.asarray(tau * np.exp(REACH * x))
        u, slow, slope = _over_samples(drive, time, nodes, steady_state)
        clock = (time - 0.5 * (time[0] + time[-1])) * slope
        _, sizes, spanning = np.linalg.svd(u, full_matrices=False)
        rank = in_fours(np.count_nonzero(sizes > RANK * sizes[0]), len(spanning))
        functions, rows = np.linalg.qr(np.concatenate([spanning[:rank], slow, slope[None], clock[None]]).T)
        series = functions[:, :rank].T @ u.T @ to_series.T
        places = np.cumsum([rank, len(slow), 1])
        slow, slope, clock = np.split(rows[:, rank:].T, places[1:] - rank)
        return cls(float(np.log(tau)), functions, series, slow, slope[0], clock[0])

    def compression(self, samples: int) -> Compression:
        """What all records have in common; `observed` is to be replaced by a row of `project`."""
        size = self.functions.shape[1] + 1

        def lengthened(rows: np.ndarray) -> Array:
            return jnp.asarray(np.pad(rows, [(0, 0)] * (rows.ndim - 1) + [(0, 1)]))

        return Compression(
            center=jnp.asarray(self.center),
            reach=jnp.asarray(REACH),
            signal=jnp.asarray(self.signal),
            decay=jnp.zeros((size, NODES)),
            slow=lengthened(self.slow),
            rate=jnp.zeros(size),
            slope=lengthened(self.slope),
            observed=jnp.zeros(size),
            samples=jnp.asarray(float(samples)),
        )

    def project(self, observed: Float[np.ndarray, "records samples"]) -> Float[np.ndarray, "records coordinates+1"]:
        """Coordinates of records; the last is the length of what lies outside of the basis."""
        inside = observed @ self.functions
        square = np.vecdot(observed, observed) - np.vecdot(inside, inside)
        return np.column_stack([inside, np.sqrt(np.maximum(square, 0.0))])

    def response(self, signal: Float[np.ndarray, "records rank"]) -> Float[np.ndarray, "records samples"]:
        """In time, from its coordinates."""
        return signal @ self.functions[:, : signal.shape[1]].T

    def narrowed(
        self,
        coordinates: Float[np.ndarray, "records coordinates+1"],
        center: Float[np.ndarray, " records"],
        reach: Float[np.ndarray, " records"],
        precision: Float[np.ndarray, " records"],
    ) -> Narrow:
        """Tables for log tau within `reach` of each record's `center`, which cost less to evaluate.

        What is left out changes the response to the drive by no more than `precision` (V, root of the sum of squares).
        """
        x, to_series = chebyshev(NODES)
        inside = (center[:, None] + reach[:, None] * x - self.center) / REACH
        at = np.polynomial.chebyshev.chebvander(inside, NODES - 1)
        series = self.signal @ np.swapaxes(at, 1, 2) @ to_series.T
        left = np.cumsum(np.linalg.norm(series, axis=1)[:, ::-1], axis=1)[:, ::-1]
        terms = in_fours(np.max(np.count_nonzero(left > precision[:, None], axis=1)), NODES)
        others = ((0, 0), (0, coordinates.shape[1] - len(self.signal)), (0, 0))
        columns = np.concatenate([np.pad(series[..., :terms], others), coordinates[..., None]], axis=2)
        _, rows = np.linalg.qr(columns)
        return Narrow(center, reach, rows[:, :terms, :terms], rows[:, :, terms])


def _over_samples(drive: Drive, time: np.ndarray, nodes: Array, steady_state: bool) -> list[np.ndarray]:
    """Responses of the nodes, the slow shapes, and dV/dt over two samples."""
    step = jnp.asarray((time[-1] - time[0]) / (time.size - 1))
    return [np.asarray(x)[..., : time.size] for x in _at_times(drive, padded(time), step, nodes, steady_state)]


@eqx.filter_jit
def _at_times(drive: Drive, time: Array, step: Array, nodes: Array, steady_state: bool) -> tuple[Array, Array, Array]:
    u = jax.vmap(lambda tau: highpass(drive, time, tau, steady_state=steady_state))(nodes)

    def voltage(time: Array) -> Array:
        return jnp.where(steady_state | (time >= 0.0), drive.value(time), 0.0)

    slope = (voltage(time + step) - voltage(time - step)) / (2.0 * step)
    slow = slow_shapes(time, 0.5 * (time[0] + time[-1]), 0.5 * (time[-1] - time[0]))
    return u, slow, slope
