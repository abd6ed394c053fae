"""Rows of a current that follows dV/dt: its mean over each step between samples, whitened for the noise of V and I.

Over a step of length h, the current of a capacitance C is C (V[k + 1] - V[k]) / h, whatever V does in between, so that
no derivative of a sampled V is needed. Noise of V adds C (n[k + 1] - n[k]) / h: its spectrum grows with the frequency,
and neighbouring rows share a sample of V. The covariance of the rows is therefore tridiagonal, also where single rows
are less certain or excluded, and its Cholesky factor whitens them by a recursion over the samples.
Where a converter returns the same value for several samples, these share one rounding error. Their rows are one, the
mean current over the whole run, which is whitened at its last step.
Errors in variables: Levin, IEEE Trans. Autom. Control 9 (1964) 229; Pintelon and Schoukens, System Identification
(2012), chapter 9.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from fitact.model.response import recurrence

# mean of a smooth function over the middle step of six samples, by the polynomial through them
_MEAN_OF_STEP = np.array([11.0, -93.0, 802.0, 802.0, -93.0, 11.0]) / 1440.0
ROW_NOISE = 0.6285  # variance of a row over that of a sample of white noise; with those of neighbours, the sum is 1
_BEFORE = 2  # of these samples, those before the first of the step
MAX_STEPS = 3  # largest delay of the current against V, in time steps
# the row of a step from sample k to k + 1 is stored at k + LAG, when all samples that it needs are there
LAG = 6 + MAX_STEPS
_INTERPOLATED = np.arange(-2, 4)  # samples between which a delayed one is interpolated, those around it being 0 and 1


def step_means(values: Float[np.ndarray, "*n samples"], delay: float = 0.0) -> Float[np.ndarray, "*n samples"]:
    """Return the means of samples over each step, stored `LAG` later; those of the first `LAG` + 5 are not valid.

    The step is taken `delay` time steps later, at most `MAX_STEPS` in either direction.
    """
    taps, shift = mean_filter(delay)
    result = np.zeros_like(values)
    result[..., shift:] = scipy.signal.lfilter(taps, [1.0], values[..., : values.shape[-1] - shift])
    return result


def mean_filter(delay: float) -> tuple[Float[np.ndarray, " taps"], int]:
    """Return the filter of `step_means`, and by how many samples its result is later."""
    whole = int(np.floor(delay))
    part = delay - whole
    others = _INTERPOLATED[:, None] != _INTERPOLATED
    factors = np.where(others, part - _INTERPOLATED, 1.0) / np.where(
        others, np.subtract.outer(_INTERPOLATED, _INTERPOLATED), 1.0
    )
    taps = np.convolve(np.prod(factors, axis=1), _MEAN_OF_STEP)
    used = np.flatnonzero(taps)[[0, -1]]
    return taps[used[1] : used[0] - 1 if used[0] else None : -1], LAG + 2 + _BEFORE - whole - int(used[1])


def estimate_current_noise(
    gain: np.ndarray, decay: np.ndarray, white: Float[np.ndarray, " samples"], taps: np.ndarray, shift: int = 0
) -> Float[np.ndarray, " samples"]:
    """Return the noise of each sample of I that is most probable for whitened residuals of rows, A.

    The rest of the residuals is noise of V. For normal noise it is the covariance of the sample with the rows, times
    the inverse of their covariance, times the residuals. `taps` and `shift` (`mean_filter`) make the rows of samples.
    """
    bands = np.stack([np.ones_like(decay), -np.append(decay[1:], 0.0)])
    summed, _ = scipy.linalg.lapack.dtbtrs(bands, white[:, None], uplo="L", trans="T", diag="U")
    noise = np.zeros(white.size)
    noise[: white.size - shift] = scipy.signal.lfilter(taps, [1.0], (gain * summed[:, 0])[shift:][::-1])[::-1]
    return noise


class ChargeRows(eqx.Module):
    """A current in rows of one step each, and the recursion that whitens rows.

    Whitened rows have the standard deviation of the noise of I. The arrays are padded with 0.
    """

    observed: Float[Array, " samples"]  # mean current over each step, on the clock of V, A
    rate: Float[Array, " samples"]  # rise of V over each step, divided by its length, V/s
    bend: Float[Array, " samples"]  # derivative of `rate` in time, V/s^2
    # whitened row k = gain[k] (row k) + decay[k] (whitened row k - 1)
    gain: Float[Array, " samples"]
    decay: Float[Array, " samples"]
    # weight of whitened rows: 0 for those that do not count, as all but the last of a run, else 1, or less where the
    # residuals of many rows are alike
    used: Float[Array, " samples"]

    @property
    def count(self) -> ArrayLike:
        """Number of rows that count, by the square of their weights."""
        return self.used @ self.used

    @property
    def reach(self) -> int:
        """Number of samples before its own that a row needs."""
        return LAG + _BEFORE

    def means(self, values: Float[Array, "*shape reach+samples"]) -> Float[Array, "*shape samples"]:
        """Return the rows of functions of time, given from `reach` samples before the first row on."""
        size = values.shape[-1] - self.reach
        parts = [tap * values[..., j : j + size] for j, tap in enumerate(_MEAN_OF_STEP)]
        return sum(parts[1:], parts[0])

    def whiten(self, rows: Float[Array, "*shape samples"]) -> Float[Array, "*shape samples"]:
        """Return whitened rows, 0 where they do not count."""
        return self.continue_whitening(rows, jnp.zeros(rows.shape[:-1])) * self.used

    def continue_whitening(
        self, rows: Float[Array, "*shape samples"], before: Float[Array, "*shape"]
    ) -> Float[Array, "*shape samples"]:
        """Return whitened rows, where the whitened ones `before` the first are given."""
        return recurrence(self.decay, self.gain * rows, before)

    def sample_rate(self) -> Float[Array, " samples"]:
        """Return dV/dt at the samples, over two steps, V/s."""
        return 0.5 * (jnp.roll(self.rate, -LAG) + jnp.roll(self.rate, 1 - LAG))

    def restrict(self, samples: slice) -> "ChargeRows":
        """Return some of the rows."""
        return jax.tree.map(lambda leaf: leaf[samples], self)


class RowCovariance:
    """Covariance of the rows, those of a run taken together: tridiagonal, and excluded rows are not correlated."""

    def __init__(
        self,
        variance: Float[np.ndarray, " rows"],
        neighbours: Float[np.ndarray, " rows"],
        excluded: Bool[np.ndarray, " rows"],
        group: Int[np.ndarray, " rows"] | None = None,
        common: ArrayLike = 0.0,
    ) -> None:
        """Factorise; `neighbours` are the covariances of each row with the one before.

        Rows of the same `group`, if that is not 0, are one, whose error has the variance `common` besides.
        """
        group = np.zeros(variance.size, int) if group is None else np.where(excluded, 0, group)
        self._begins = np.flatnonzero((group == 0) | (np.diff(group, prepend=0) != 0))
        self._lengths = np.diff(self._begins, append=variance.size)
        self.used = np.zeros(variance.size, bool)
        self.used[np.append(self._begins[1:], variance.size) - 1] = True
        self.used &= ~excluded
        self._lost = lost = excluded[self._begins]
        apart = lost | np.append(True, lost[:-1])
        first = neighbours[self._begins]
        whole = np.add.reduceat(variance + 2.0 * neighbours, self._begins) - 2.0 * first
        diagonal = whole / self._lengths**2 + np.broadcast_to(common, variance.shape)[self._begins]
        beside = first / (self._lengths * np.append(1, self._lengths[:-1]))
        self._factor = scipy.linalg.cholesky_banded(
            np.stack([np.where(apart, 0.0, beside), np.where(lost, 1.0, diagonal)])
        )

    def recursion(self, unit: float) -> tuple[Float[np.ndarray, " rows"], Float[np.ndarray, " rows"]]:
        """Return gain and decay of `ChargeRows`, with which whitened rows have the standard deviation `unit`."""
        above, diagonal = self._factor
        decay = np.ones(self.used.size)  # within a run, rows add up
        decay[self._begins] = np.where(self._lost, 0.0, -above / diagonal)
        return np.repeat(np.where(self._lost, 0.0, unit / diagonal / self._lengths), self._lengths), decay

    def solve(self, rows: Float[np.ndarray, " rows"]) -> Float[np.ndarray, " rows"]:
        """Return the inverse of the covariance times rows, for the rows of runs an equal part each."""
        means = np.where(self._lost, 0.0, np.add.reduceat(rows, self._begins) / self._lengths)
        scaled = scipy.linalg.cho_solve_banded((self._factor, False), means) * ~self._lost
        return np.repeat(scaled / self._lengths, self._lengths)


def whiten_rows(
    gain: np.ndarray, decay: np.ndarray, rows: Float[np.ndarray, "*n rows"]
) -> Float[np.ndarray, "*n rows"]:
    """Return whitened rows as `ChargeRows.whiten`, without JAX."""
    bands = np.stack([np.ones_like(decay), -np.append(decay[1:], 0.0)])
    scaled = np.reshape(gain * rows, (-1, decay.size))
    whitened, _ = scipy.linalg.lapack.dtbtrs(bands, scaled.T, uplo="L", diag="U", overwrite_b=True)
    return whitened.T.reshape(np.shape(rows))


def filter_highpass(
    rise: Float[np.ndarray, " n"], x: float, memory: Float[np.ndarray, "1"] | None = None
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "1"]]:
    """Return u[k] = e^{-x} u[k - 1] + phi(x) rise[k] without JAX, and the `memory` with which it goes on; from 0."""
    before = np.zeros(1) if memory is None else memory
    return scipy.signal.lfilter([-np.expm1(-x) / x], [1.0, -np.exp(-x)], rise, zi=before)
