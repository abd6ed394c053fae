"""When a record's compression may stand for its samples: built before the fit, certified after it."""

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from fitact.data.compress import Compression, compress
from fitact.inference.likelihood import CHARGE, LINEAR, Batched, Likelihood
from fitact.inference.start import LinearStart
from fitact.model.drive import Sampled

TOLERANCE = 1e-3  # in log-likelihood
_SHORT = 512  # samples, below which nothing is gained
_POINTS = 8  # of each kind at which the full sum is taken
_FAR = 1e-6  # of a point's distance below the optimum, in log-likelihood: error allowed there
_REACH = 20.0  # standard deviations of log b that the table for sampling holds
_LEAST_REACH = 0.05  # in log b


class Certified(NamedTuple):
    """A likelihood to sample from.

    Attributes:
        likelihood: with its compression, or without.
        error: largest error of the compressed log-likelihood near the optimum; None: the samples are summed.
        reason: why they are, as a clause.
    """

    likelihood: Likelihood
    error: float | None
    reason: str


def project(likelihood: Likelihood, start: LinearStart, tolerance: float) -> tuple[Likelihood, str]:
    """The likelihood with the record's compression, or as it is and the reason why."""
    reason = _reason_against(likelihood, start, tolerance)
    if reason:
        return likelihood, reason
    compression = compress(
        likelihood.drive,
        np.asarray(likelihood.time),
        np.asarray(likelihood.observed),
        steady_state=likelihood.steady_state,
        tau=start.b,
        gain=start.g,
    )
    return dataclasses.replace(likelihood, compression=compression), ""


def _reason_against(likelihood: Likelihood, start: LinearStart, tolerance: float) -> str:
    if tolerance == 0.0:
        return "it was asked for"
    if likelihood.time.size < _SHORT:
        return f"the record is shorter than {_SHORT} samples"
    if likelihood.free_delay:
        return "a delay is free"
    if isinstance(likelihood.drive, Sampled) and likelihood.steady_state:
        return "the steady state of a measured drive is not tabulated"
    if not math.isfinite(start.b):
        return "the record does not show its time constant"
    return ""


def certify(
    wide: Likelihood, reason: str, theta: np.ndarray, root: np.ndarray, sigma: float, tolerance: float
) -> Certified:
    """The likelihood for sampling around the optimum `theta`, checked against the full sum.

    `root` is the root of theta's covariance. The compressed log-likelihood must agree to `tolerance` near the
    optimum, and at points of the prior to a part in a million of how far they lie below it.
    """
    columns = tuple(i for i in range(len(LINEAR)) if float(wide.linear_sd[i]) > 0.0)
    full = dataclasses.replace(wide, compression=None, columns=columns)
    if wide.compression is None:
        return Certified(full, None, reason or "a delay is free")
    if not wide.compression.holds(np.exp(_log_b(theta))):
        return Certified(full, None, "the fit left the table's range")
    charge = float(np.ptp(wide.observed)) if CHARGE in columns else 0.0
    precision = 0.1 * tolerance * sigma / float(wide.gain(theta) * wide.circuit(theta).g)
    near = dataclasses.replace(
        wide, columns=columns, compression=_narrowed(wide.compression, theta, root, precision, charge)
    )
    points = np.vstack([_near(theta, root), _believed(wide, theta)])
    exact, compressed, tabulated = (
        _at(model, points, sigma) for model in (full, near, dataclasses.replace(wide, columns=columns))
    )
    error = float(np.max(np.abs(compressed - exact)[: _POINTS + 1]))
    if np.isnan(error):
        return Certified(full, None, "the record leaves its time constant more open than the table is wide")
    if not error <= tolerance:
        return Certified(full, None, f"the compressed log-likelihood was off by {error:.2g} near the optimum")
    excess = float(np.nanmax(np.abs(tabulated - exact) - _FAR * np.abs(exact[0] - exact)))
    if excess > tolerance:
        return Certified(full, None, f"the compressed log-likelihood was off by {excess:.2g} within the prior")
    return Certified(near, error, "")


def _near(theta: np.ndarray, root: np.ndarray) -> Float[np.ndarray, "n parameters"]:
    """The optimum and points around it; any will do."""
    deviates = np.random.default_rng(0).standard_normal((_POINTS, theta.size))
    return np.vstack([theta, theta + 1.5 * deviates @ root.T])


def _believed(wide: Likelihood, theta: np.ndarray) -> Float[np.ndarray, "n parameters"]:
    """Points of the prior that the table reaches, the optimum where there are too few."""
    assert wide.compression is not None
    draws = np.log(np.array(list(wide.prior.sample(np.random.default_rng(0), 1000).values())).T)
    draws = draws[np.asarray(wide.compression.holds(np.exp(_log_b(draws))))]
    return np.vstack([draws, np.tile(theta, (_POINTS, 1))])[:_POINTS]


def _at(likelihood: Likelihood, theta: Float[np.ndarray, "n parameters"], sigma: float) -> np.ndarray:
    """Log-likelihoods at points of one sigma."""
    points = np.column_stack([theta, np.full(len(theta), math.log(sigma))])
    return Batched(Likelihood.log_likelihood, likelihood.without_samples(), likelihood.rows)(points)


def log_prob(likelihood: Likelihood, batch: int) -> Callable[[np.ndarray], np.ndarray]:
    """Log-posteriors of points (theta, log sigma); where the compression does not reach, the samples are summed."""
    tabulated = Batched(Likelihood.log_prob, likelihood.without_samples(), likelihood.rows, batch)
    full = dataclasses.replace(likelihood, compression=None)
    summed = Batched(Likelihood.log_prob, full, full.rows, batch=1)

    def values(points: Float[np.ndarray, "n coordinates"]) -> np.ndarray:
        found = tabulated(points)
        beyond = np.isnan(found)
        if beyond.any():
            found = np.array(found)
            found[beyond] = summed(points[beyond])
        return found

    return values


def _narrowed(wide: Compression, theta: np.ndarray, root: np.ndarray, precision: float, charge: float) -> Compression:
    """The part of the table that the posterior can want; `charge` (V): size of an unknown one, 0 if none."""
    center, parts = float(_log_b(theta)), np.exp(theta[1:3]) * [1.0, 2.0]
    spread = float(np.linalg.norm(root[0] + parts @ root[1:3] / np.sum(parts)))
    reach = max(_REACH * spread, _LEAST_REACH)
    low, high = (float(wide.center + side * wide.reach) for side in (-1.0, 1.0))
    low, high = max(center - reach, low), min(center + reach, high)
    return wide.narrowed(0.5 * (low + high), 0.5 * (high - low), precision, charge=charge)


def _log_b(theta: Float[np.ndarray, "*shape parameters"]) -> Float[np.ndarray, "*shape"]:
    """Logarithm of the time constant, s."""
    return theta[..., 0] + np.logaddexp(np.log(2.0) + theta[..., 2], theta[..., 1])
