"""Records with one drive and one time grid, in common coordinates.

The coordinates serve like those of a `fitact.likelihood.compression.Compression` of each record. The basis is computed
only once, so that a record costs one product with a matrix of some twenty columns.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitact.compiled import jit, pad_samples
from fitact.likelihood.compression import Compression
from fitact.likelihood.projection import RANK_TOLERANCE, baseline_functions
from fitact.model.drive import Drive
from fitact.model.response import highpass
from fitact.model.response_table import NODES, TABLE_HALF_WIDTH, chebyshev, round_up_column_count


class SharedBasis(NamedTuple):
    """Orthonormal functions over the samples, the first of which span the responses around a central time constant.

    Attributes:
        center: center of the table, in log tau (tau in s).
        functions: values at the samples; the last is the first-order effect of a clock error on the record.
        signal: Chebyshev coefficients in log tau of the response to the drive (V), in the first coordinates.
        baseline, slope, clock: shapes of a `Compression`, and of a clock error, in these coordinates.
    """

    center: float
    functions: Float[np.ndarray, "samples coordinates"]
    signal: Float[np.ndarray, "rank terms"]
    baseline: Float[np.ndarray, "shapes coordinates"]
    slope: Float[np.ndarray, " coordinates"]
    clock: Float[np.ndarray, " coordinates"]

    @classmethod
    def from_drive(
        cls, drive: Drive, time: Float[np.ndarray, " samples"], steady_state: bool, tau: float
    ) -> "SharedBasis":
        """Return a basis for time constants within a factor 9 of `tau` (s). Double precision is required."""
        x, to_series = chebyshev(NODES)
        nodes, step = tau * np.exp(TABLE_HALF_WIDTH * x), np.asarray((time[-1] - time[0]) / (time.size - 1))
        padded = _evaluate_basis_functions(drive, pad_samples(time), step, nodes, steady_state)
        u, baseline, slope = (values[..., : time.size] for values in padded)
        clock = (time - 0.5 * (time[0] + time[-1])) * slope
        _, sizes, spanning = np.linalg.svd(u, full_matrices=False)
        rank = round_up_column_count(np.count_nonzero(sizes > RANK_TOLERANCE * sizes[0]), len(spanning))
        functions, rows = np.linalg.qr(np.concatenate([spanning[:rank], baseline, slope[None], clock[None]]).T)
        series = functions[:, :rank].T @ u.T @ to_series.T
        baseline, (slope, clock) = np.split(rows[:, rank:].T, [len(baseline)])
        return cls(float(np.log(tau)), functions, series, baseline, slope, clock)

    def compression(self, samples: int) -> Compression:
        """Return the compression common to all records; `observed` must be replaced by a row of `project`."""
        size = self.functions.shape[1] + 1

        def append_zero(rows: np.ndarray) -> Array:
            return jnp.asarray(np.pad(rows, [(0, 0)] * (rows.ndim - 1) + [(0, 1)]))

        return Compression(
            center=jnp.asarray(self.center),
            half_width=jnp.asarray(TABLE_HALF_WIDTH),
            signal=jnp.asarray(self.signal),
            decay=jnp.zeros((size, NODES)),
            baseline=append_zero(self.baseline),
            rate=jnp.zeros(size),
            slope=append_zero(self.slope),
            observed=jnp.zeros(size),
            observed_slope=jnp.zeros(size),
            samples=jnp.asarray(float(samples)),
            steps=jnp.zeros((0, size)),
            origin=jnp.zeros(()),
            time_step=jnp.zeros(()),
        )

    def project(self, observed: Float[np.ndarray, "records samples"]) -> Float[np.ndarray, "records coordinates+1"]:
        """Return coordinates of records; the last is the length of the component outside the basis."""
        inside = observed @ self.functions
        square = np.vecdot(observed, observed) - np.vecdot(inside, inside)
        return np.column_stack([inside, np.sqrt(np.maximum(square, 0.0))])


@jit
def _evaluate_basis_functions(
    drive: Drive, time: Array, step: Array, nodes: Array, steady_state: bool
) -> tuple[Array, Array, Array]:
    """Evaluate the responses of the nodes, the baseline functions, and dV/dt over two samples."""
    u = jax.vmap(lambda tau: highpass(drive, time, tau, steady_state=steady_state))(nodes)

    def voltage(time: Array) -> Array:
        return jnp.where(steady_state | (time >= 0.0), drive.value(time), 0.0)

    slope = (voltage(time + step) - voltage(time - step)) / (2.0 * step)
    baseline = baseline_functions(time, 0.5 * (time[0] + time[-1]), 0.5 * (time[-1] - time[0]))
    return u, baseline, slope
