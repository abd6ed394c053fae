"""Responses at fixed times for many circuits: Chebyshev series in log tau, so that a circuit costs one matrix product.

The response of a high-pass to any drive is a convolution of dV/dt with e^{-t/tau}. As a function of log tau, such an
exponential is smooth, whatever the age t, and so its Chebyshev series converges exponentially.
"""

import functools
import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.compiled import BatchEvaluator
from fitact.model.circuit import HighpassTerms
from fitact.model.drive import Drive
from fitact.model.response import highpass

NODES = 41  # odd, so that the middle of the table is a node
TABLE_HALF_WIDTH = math.log(9.0)  # half-width in log tau that `NODES` cover to rounding
_MARGIN = 0.05  # least half-width of a `ResponseTable`, in log tau
_FEW_NODES, _NARROW = 11, 0.2  # nodes of a narrow table, and its largest half-width
_MAX_HALF_WIDTH = 4.0 * TABLE_HALF_WIDTH  # beyond it, a table costs more than it saves
_MAX_NUMBERS = 4_000_000  # responses of all nodes at all times, which bounds the memory
_PRECISION = 1e-13  # of a `ResponseTable`, relative to the largest response
_OPEN = 1e6  # a time constant longer than the table's slowest by this factor counts as infinite


class ResponseTable(eqx.Module):
    """Responses to a drive, and decays of an unknown charge, at fixed times."""

    center: Float[Array, ""]  # the table covers log tau in `center` ± `half_width` (tau in s)
    half_width: Float[Array, ""]
    # Chebyshev coefficients in log tau of the response (V); the last column is the response for an infinite tau
    signal: Float[Array, "times terms+1"]
    decay: Float[Array, "times terms"]  # the same for e^{-(t - t0) / tau}

    @classmethod
    def from_drive(
        cls,
        drive: Drive,
        time: Float[np.ndarray, " times"],
        begin: float,
        tau_range: tuple[float, float],
        steady_state: bool,
    ) -> "ResponseTable | None":
        """Tabulate the response to `drive` at `time` (s) for the time constants in `tau_range` (s).

        Decays begin at `begin` (s). Returns None if the range, or the number of times, is too large for a table.
        """
        low, high = np.log(tau_range)
        center, half_width = 0.5 * (low + high), 0.5 * (high - low) + _MARGIN
        if not half_width < _MAX_HALF_WIDTH or (count := _node_count(half_width)) * time.size > _MAX_NUMBERS:
            return None
        x, to_series = chebyshev(count)
        nodes = np.append(np.exp(center + half_width * x), 10.0 * _OPEN * math.exp(high))
        signal = highpass_responses(drive, time, nodes, steady_state)
        signal, settled = signal[:-1].T @ to_series.T, signal[-1:].T
        decay = np.exp(-(time[:, None] - begin) / nodes[:-1]) @ to_series.T
        largest = max(np.max(np.abs(signal)), np.finfo(float).tiny)
        terms = count_terms(np.max(np.abs(signal) / largest, axis=0) + np.max(np.abs(decay), axis=0), _PRECISION)
        return cls(
            np.asarray(center), np.asarray(half_width), np.hstack([signal[:, :terms], settled]), decay[:, :terms]
        )

    def response(self, terms: HighpassTerms) -> Float[Array, " times"]:
        """Return the response of `terms` without the one in dV/dt; compare `superpose_terms`."""
        total = jnp.zeros(self.signal.shape[1])
        for weight, tau in zip(terms.weight, terms.tau, strict=True):
            x = self._position(tau)
            is_open = x > 1.0 + math.log(_OPEN) / self.half_width
            series = chebyshev_polynomials(jnp.where(is_open, 0.0, x), self.decay.shape[1])
            total += weight * jnp.append(jnp.where(is_open, 0.0, series), is_open)
        return self.signal @ total

    def decays(self, tau: Array) -> Float[Array, " times"]:
        """Return e^{-(t - t0) / tau}, where t0 is the beginning."""
        return self.decay @ chebyshev_polynomials(self._position(tau), self.decay.shape[1])

    def _position(self, tau: Array) -> Array:
        return (jnp.log(tau) - self.center) / self.half_width


def _node_count(half_width: float) -> int:
    """Return how many nodes reach rounding: e^{-t/tau} is analytic in log tau within a strip of half-width pi / 2."""
    return _FEW_NODES if half_width <= _NARROW else NODES * math.ceil(half_width / TABLE_HALF_WIDTH)


def highpass_responses(
    drive: Drive, time: Float[np.ndarray, " times"], tau: Float[np.ndarray, " n"], steady_state: bool
) -> Float[np.ndarray, "n times"]:
    """Return the responses of `highpass` to `drive` at `time` (s) for many time constants (s)."""
    batch = math.ceil(tau.size / math.ceil(tau.size / (NODES + 1)))  # equal batches, at most a whole table
    respond = functools.partial(_respond, steady_state=steady_state)
    return BatchEvaluator(respond, (drive, time), time.size, batch, fast=False)(tau)


def _respond(driven: tuple[Drive, Array], tau: Array, *, steady_state: bool) -> Float[Array, " times"]:
    drive, time = driven
    return highpass(drive, time, tau, steady_state=steady_state)


def chebyshev(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return Chebyshev nodes in [-1, 1], and the matrix from values there to series coefficients (terms, nodes)."""
    angle = np.pi * (np.arange(count) + 0.5) / count
    matrix = 2.0 / count * np.cos(np.arange(count)[:, None] * angle)
    matrix[0] *= 0.5
    return np.cos(angle), matrix


def chebyshev_polynomials(x: Array, terms: int) -> Float[Array, " terms"]:
    """Return the first Chebyshev polynomials at x."""

    def step(last: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], Array]:
        return (last[1], 2.0 * x * last[1] - last[0]), last[0]

    # a loop compiles faster, but runs slower for few terms
    return lax.scan(step, (jnp.ones_like(x), x), None, length=terms, unroll=terms <= NODES // 2)[1]


def count_terms(sizes: Float[np.ndarray, "*tables terms"], precision: ArrayLike) -> int:
    """Return how many terms keep series of these sizes within `precision`, rounded up as by `round_up_column_count`."""
    tails = np.cumsum(sizes[..., ::-1], axis=-1)[..., ::-1]  # error after omitting a term and all later ones
    return round_up_column_count(np.max(np.count_nonzero(tails > precision, axis=-1)), sizes.shape[-1])


def round_up_column_count(count: float | np.integer, maximum: int) -> int:
    """Return `count` rounded up to a multiple of 4, at most `maximum`, so that most records share compiled code."""
    return min(4 * max(1, math.ceil(float(count) / 4)), maximum)
