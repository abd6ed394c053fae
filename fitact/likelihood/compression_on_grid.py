"""Projection of a record on the responses of a fixed grid of time constants, for circuits represented by such a grid.

The model is linear in the weights of the grid, whose responses to the drive are computed once. The QR decomposition
of these responses, the slow shapes and the record gives the factor R. Its columns are coordinates in which the
difference between record and model has the same length as over all samples.
"""

from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fitact.compiled import pad_samples
from fitact.likelihood.compression import BASELINE_NAMES, evaluate_baseline
from fitact.model.circuit import HighpassTerms
from fitact.model.drive import Drive, Sampled
from fitact.model.response_table import highpass_responses
from fitact.model.skin import TimeConstantGrid


class GridCompression(eqx.Module):
    """A record in coordinates of the responses of a grid; compare `fitact.likelihood.compression.Compression`."""

    signal: Float[Array, "terms rows"]  # response (V) of each time constant to the drive
    delay_slopes: Float[Array, "terms rows"]  # derivative of `signal` with respect to a delay, V/s, over two samples
    baseline: Float[Array, "shapes rows"]
    rate: Float[Array, " rows"]
    observed: Float[Array, " rows"]
    samples: Float[Array, ""]

    def covers(self, tau: Array) -> Bool[Array, "*shape"]:
        """Return True, since the grid belongs to the circuit."""
        return np.ones(np.shape(tau), dtype=bool)

    def response(self, terms: HighpassTerms) -> Float[Array, " rows"]:
        """Return the response of a circuit; compare `fitact.response`."""
        total = jnp.asarray(terms.weight) @ self.signal
        return total if terms.rate is None else total + terms.rate * self.rate

    def delay_derivative(self, terms: HighpassTerms) -> Float[Array, " rows"]:
        """Return the derivative of the response with respect to a delay (per s)."""
        return jnp.asarray(terms.weight) @ self.delay_slopes

    def decays(self, tau: Array) -> Float[Array, " rows"]:
        """Return zeros, since an unknown charge of such a circuit does not decay exponentially."""
        return jnp.zeros_like(self.observed)


def compress_on_grid(
    drive: Drive,
    time: Float[np.ndarray, " samples"],
    observed: Float[np.ndarray, " samples"],
    *,
    steady_state: bool,
    grid: TimeConstantGrid,
    weight: Float[np.ndarray, " samples"] | None = None,
    rate: Float[np.ndarray, " samples"] | None = None,
) -> GridCompression:
    """Project a record on the responses of the grid to `drive`; other arguments as in `compression.compress`.

    Each chunk is combined with the previous factor R by a QR decomposition, so that no digits are lost.
    """
    step = (time[-1] - time[0]) / (time.size - 1)
    around = np.array([0.0, -step, step])
    scale = max(
        float(np.max(np.abs(observed))), 1e-300
    )  # scales the record's column like the others, to limit rounding
    weight, rate = (
        np.broadcast_to(value if given is None else given, time.shape) for given, value in ((weight, 1.0), (rate, 0.0))
    )
    size = grid.tau.size
    triangle: Any = np.zeros((0, 2 * size + len(BASELINE_NAMES) + 2))
    middle, half = 0.5 * (time[0] + time[-1]), 0.5 * (time[-1] - time[0])
    for part, u in _responses(drive, np.asarray(grid.tau), time, around, steady_state):
        baseline = evaluate_baseline(time[part], middle, half)
        rows = [u[0], baseline, rate[part][None], observed[part][None] / scale, (u[1] - u[2]) / (2.0 * step)]
        columns = (np.concatenate(rows) * weight[part]).T
        triangle = np.linalg.qr(np.vstack([triangle, columns]), mode="r")
    parts = [x.T for x in np.split(triangle, np.cumsum([size, len(BASELINE_NAMES), 1, 1]), axis=1)]
    return GridCompression(
        signal=parts[0],
        delay_slopes=parts[4],
        baseline=parts[1],
        rate=parts[2][0],
        observed=parts[3][0] * scale,
        samples=np.asarray(float(np.count_nonzero(weight))),
    )


def _responses(
    drive: Drive, tau: np.ndarray, time: np.ndarray, offsets: np.ndarray, steady_state: bool, chunk: int = 8_192
) -> Iterator[tuple[slice, Float[np.ndarray, "around terms samples"]]]:
    """Yield the responses at the sample times and at `offsets` from them, in chunks to bound the memory."""
    length = time.size if isinstance(drive, Sampled) else chunk  # a long drive is traversed only once
    for first in range(0, time.size, length):
        part = slice(first, first + length)
        times = pad_samples(time[part], min(length, time.size))
        u = np.stack([highpass_responses(drive, times + x, tau, steady_state) for x in offsets])
        yield part, u[..., : time[part].size]
