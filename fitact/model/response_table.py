"""Responses at fixed times for many circuits: Chebyshev series in log tau, so that a circuit costs one matrix product.

The response of a high-pass to any drive is a convolution of dV/dt with e^{-t/tau}. As a function of log tau, such an
exponential is smooth, whatever the age t, and so its Chebyshev series converges exponentially.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.compiled import BatchEvaluator, jit_inline
from fitact.model.circuit import INFINITE_RATIO, HighpassTerms
from fitact.model.drive import Drive
from fitact.model.harmonic import mean_voltage
from fitact.model.response import highpass


def count_nodes(half_width: float, precision: float = 2e-12) -> int:
    """Return how many nodes give e^{-t/tau} at any age t to this precision, for log tau within ± `half_width`.

    It is analytic within a strip of half-width pi / 2, which contains an ellipse around the range: coefficients fall
    by the factor e^asinh(pi / (2 half_width)) from one to the next. The number is odd: the middle is a node.
    """
    terms = math.ceil(-math.log(precision) / math.asinh(0.5 * math.pi / half_width))
    return terms + (terms % 2 == 0)


TABLE_HALF_WIDTH = math.log(9.0)  # half-width of a table, in log tau
NARROW = 0.2  # half-width in log tau of a narrow table
NODES = count_nodes(TABLE_HALF_WIDTH)
_MARGIN = 0.05  # least half-width of a `ResponseTable`, in log tau
_MAX_HALF_WIDTH = 4.0 * TABLE_HALF_WIDTH  # beyond it, a table costs more than it saves
_MAX_NUMBERS = 4_000_000  # responses of all nodes at all times, which bounds the memory
_PRECISION = 1e-13  # of a `ResponseTable`, relative to the largest response
_OPEN = 1e6  # a time constant longer than the table's slowest by this factor counts as infinite


class ResponseTable(eqx.Module):
    """Responses to a drive, and decays of an unknown charge, at fixed times."""

    # the table covers log tau in `center` ± `half_width` (tau in s), for each time constant, or for all if there is one
    center: Float[Array, " tables"]
    half_width: Float[Array, ""]
    # responses (V) are the product with `series`; the last column is the response for an infinite tau
    signal: Float[Array, "times tables*rank+1"]
    decay: Float[Array, "times tables*rank"]  # the same for e^{-(t - t0) / tau}
    series: Float[Array, "rank terms"]  # Chebyshev coefficients in log tau
    mean: ArrayLike  # of the drive, V, which the response for an infinite tau lacks; 0 from rest

    @classmethod
    def from_drive(
        cls,
        drive: Drive,
        time: Float[np.ndarray, " times"],
        begin: float,
        tau_range: Sequence[float] | Float[np.ndarray, "2 taus"],
        steady_state: bool,
    ) -> "ResponseTable | None":
        """Tabulate the response to `drive` at `time` (s) for time constants within the ends of `tau_range` (s).

        The ends are arrays if each time constant of a circuit has its own range. Decays begin at `begin` (s). Returns
        None if the range, or the number of times, is too large for a table.
        """
        low, high = map(np.atleast_1d, np.log(tau_range))
        half_width, whole = (0.5 * float(np.max(x)) + _MARGIN for x in (high - low, np.max(high) - np.min(low)))
        if not whole < _MAX_HALF_WIDTH:
            return None
        if low.size * node_count(half_width) >= node_count(whole):
            low, high, half_width = np.min(low, keepdims=True), np.max(high, keepdims=True), whole
        center, count = 0.5 * (low + high), node_count(half_width)
        if count * low.size * time.size > _MAX_NUMBERS:
            return None
        relative, combinations, series = exponential_basis(half_width, count)
        nodes = np.append(np.outer(np.exp(center), relative), INFINITE_RATIO * np.exp(np.max(high)))
        signal = highpass_responses(drive, time, nodes, steady_state)
        tables = signal[:-1], np.exp(-(time - begin) / nodes[:-1, None])
        rows, decay = (np.hstack([each.T @ combinations for each in np.split(x, low.size)]) for x in tables)
        mean = np.asarray(mean_voltage(drive) if steady_state else 0.0)
        return cls(center, np.asarray(half_width), np.hstack([rows, signal[-1:].T]), decay, series, mean)

    def response(self, terms: HighpassTerms) -> Float[Array, " times"]:
        """Return the response of `terms` without the one in dV/dt; compare `superpose_terms`."""
        total = self.signal @ self._combine(terms.weight, terms.tau)
        return total if terms.direct is None else total + terms.direct * (self.signal[:, -1] + self.mean)

    def decays(self, tau: Sequence[Array], size: Float[Array, " taus"]) -> Float[Array, " times"]:
        """Return the sum of size e^{-(t - t0) / tau}, where t0 is the beginning."""
        return self.decay @ self._combine(size, tau)[:-1]

    def _combine(self, sizes: Any, taus: Any) -> Float[Array, " tables*rank+1"]:
        """Return the coefficients of the columns of `signal` for the sum of these responses."""
        tables, settled = [jnp.zeros(len(self.series))] * self.center.size, jnp.zeros(())
        for index, (size, tau) in enumerate(zip(sizes, taus, strict=True)):
            index = min(index, len(tables) - 1)
            x = (jnp.log(tau) - self.center[index]) / self.half_width
            is_open = x > 1.0 + math.log(_OPEN) / self.half_width
            polynomials = chebyshev_polynomials(jnp.where(is_open, 0.0, x), self.series.shape[1])
            tables[index] = tables[index] + jnp.where(is_open, 0.0, size) * (self.series @ polynomials)
            settled = settled + jnp.where(is_open, size, 0.0)
        return jnp.append(jnp.concatenate(tables), settled)


def node_count(half_width: float) -> int:
    """Return the nodes of a table, one of few numbers, so that few programs are compiled; see `count_nodes`."""
    return count_nodes(NARROW) if half_width <= NARROW else NODES * math.ceil(half_width / TABLE_HALF_WIDTH)


@functools.lru_cache(maxsize=64)
def exponential_basis(
    half_width: float, count: int, tolerance: float = _PRECISION
) -> tuple[Float[np.ndarray, " nodes"], Float[np.ndarray, "nodes rank"], Float[np.ndarray, "rank terms"]]:
    """Return nodes over a half-width in log tau, and what represents e^{-t/tau} at any age t by values at the nodes.

    The nodes are relative to the center. Few combinations of these values are significant (relative to `tolerance`),
    and the product of these with the Chebyshev coefficients is the series in log tau.
    """
    x, to_series = chebyshev(count)
    relative = np.exp(half_width * x)
    combinations, values = significant_combinations(relative, tolerance)
    return relative, combinations, values @ to_series.T


def significant_combinations(
    tau: Float[np.ndarray, " nodes"], tolerance: float, scale: ArrayLike = 1.0
) -> tuple[Float[np.ndarray, "nodes rank"], Float[np.ndarray, "rank nodes"]]:
    """Return combinations of e^{-t/tau} at any age t that give all of them, to a relative `tolerance`; and how.

    The tolerance is relative to the largest of them times its `scale`.
    """
    ages = np.concatenate([[0.0], np.geomspace(1e-3 * tau.min(), 40.0 * tau.max(), 400)])
    scale = np.broadcast_to(scale, tau.shape)
    _, sizes, modes = np.linalg.svd(np.exp(-ages[:, None] / tau) * scale, full_matrices=False)
    rank = round_up_column_count(np.count_nonzero(sizes > tolerance * sizes[0]), tau.size)
    return scale[:, None] * modes[:rank].T / sizes[:rank], sizes[:rank, None] * modes[:rank] / scale


def highpass_responses(
    drive: Drive, time: Float[np.ndarray, " times"], tau: Float[np.ndarray, " n"], steady_state: bool
) -> Float[np.ndarray, "n times"]:
    """Return the responses of `highpass` to `drive` at `time` (s) for many time constants (s)."""
    batch = math.ceil(tau.size / math.ceil(tau.size / (NODES + 1)))  # equal batches, at most a whole table
    return BatchEvaluator(_respond, (drive, time, steady_state), time.size, batch, fast=False)(tau)


def _respond(driven: tuple[Drive, Array, bool], tau: Array) -> Float[Array, " times"]:
    drive, time, steady_state = driven
    return highpass(drive, time, tau, steady_state=steady_state)


def chebyshev(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return Chebyshev nodes in [-1, 1], and the matrix from values there to series coefficients (terms, nodes)."""
    angle = np.pi * (np.arange(count) + 0.5) / count
    matrix = 2.0 / count * np.cos(np.arange(count)[:, None] * angle)
    matrix[0] *= 0.5
    return np.cos(angle), matrix


@functools.partial(jit_inline, static_argnames="terms")
def chebyshev_polynomials(x: Array, terms: int) -> Float[Array, " terms"]:
    """Return the first Chebyshev polynomials at x."""

    def step(last: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], Array]:
        return (last[1], 2.0 * x * last[1] - last[0]), last[0]

    # a loop compiles faster, but runs slower for few terms
    return lax.scan(step, (jnp.ones_like(x), x), None, length=terms, unroll=terms <= NODES // 2)[1]


def count_terms(sizes: Float[np.ndarray, "*tables terms"], precision: ArrayLike) -> int:
    """Return how many terms keep series of these sizes within `precision`, rounded up to a multiple of 8.

    These tables follow the posteriors, of which those of a laboratory differ.
    """
    tails = np.cumsum(sizes[..., ::-1], axis=-1)[..., ::-1]  # error after omitting a term and all later ones
    return round_up_column_count(np.max(np.count_nonzero(tails > precision, axis=-1)), sizes.shape[-1], 8)


def round_up_column_count(count: float | np.integer, maximum: int, multiple: int = 4) -> int:
    """Return `count` rounded up to a multiple, at most `maximum`, so that most records share compiled code."""
    return min(multiple * max(1, math.ceil(float(count) / multiple)), maximum)
