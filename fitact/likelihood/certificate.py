"""When traces' compressions may stand for their samples: built before the fit, certified after it."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from fitact.likelihood.channel import Seen, Trace
from fitact.likelihood.compression import SLOW, Compression, compress
from fitact.likelihood.compression_on_grid import compress_on_grid
from fitact.likelihood.likelihood import Batched, Likelihood
from fitact.model.circuit import Circuit
from fitact.model.drive import Sampled
from fitact.model.skin import WithSkin
from fitact.progress import watched

TOLERANCE = 1e-3  # in log-likelihood
_OFF_TIME = "a delay or a clock is free"
_SHORT = 512  # samples, below which nothing is gained
_POINTS = 8  # of each kind at which the full sum is taken
_FAR = 1e-6  # of a point's distance below the optimum, in log-likelihood: error allowed there
_REACH = 20.0  # standard deviations of log b that the table for sampling holds
_LEAST_REACH = 0.05  # in log b
FEW_ROWS = 200  # numbers that an evaluation runs over, up to which the call costs more than they do


class Certified(NamedTuple):
    """A likelihood to sample from.

    Attributes:
        likelihood: with the compressions that hold.
        error: largest error of the compressed log-likelihood near the optimum; None: some samples are summed.
        reasons: why those of each trace are, as a clause; "" where they are not.
    """

    likelihood: Likelihood
    error: float | None
    reasons: tuple[str, ...]


def project(trace: Trace, circuit: Circuit, shown: bool, tolerance: float) -> tuple[Trace, str]:
    """The trace with its record's compression, or as it is and the reason why.

    `circuit` nearly made it, and `shown` says whether the record shows it.
    """
    reason = _reason_against(trace, circuit, shown, tolerance)
    if reason:
        return trace, reason
    own = slice(trace.own)
    arrays = np.asarray(trace.time)[own], np.asarray(trace.observed)[own]
    how: dict[str, Any] = {
        "steady_state": trace.steady_state,
        "weight": None if trace.equally_weighted else trace.weights[own],
        "rate": None if trace.rate is None else np.asarray(trace.rate)[own],
    }
    if isinstance(circuit, WithSkin):
        assert circuit.grid is not None  # there would be a reason against it
        return dataclasses.replace(
            trace, compression=compress_on_grid(trace.drive, *arrays, grid=circuit.grid, **how)
        ), ""
    near = circuit.terms_of(trace.channel)
    return dataclasses.replace(trace, compression=compress(trace.drive, *arrays, near=near, **how)), ""


def _reason_against(trace: Trace, circuit: Circuit, shown: bool, tolerance: float) -> str:
    if tolerance == 0.0:
        return "it was asked for"
    if trace.noise == "student":
        return "noise with outliers is more than lengths and angles"
    if trace.whitening is not None:
        return "the noise is coloured"
    if trace.own < _SHORT:
        return f"the record is shorter than {_SHORT} samples"
    if trace.timing:
        return _OFF_TIME
    if isinstance(circuit, WithSkin):
        return "a dispersive skin has no time constants" if circuit.grid is None else ""
    if isinstance(trace.drive, Sampled) and trace.steady_state:
        return "the steady state of a measured drive is not tabulated"
    if not shown:
        return "the record does not show its time constant"
    if len(circuit.terms_of(trace.channel).tau) > 1:
        return "the circuit has several time constants"
    return ""


def certify(
    wide: Likelihood,
    reasons: tuple[str, ...],
    theta: np.ndarray,
    root: np.ndarray,
    sigma: Float[np.ndarray, " traces"],
    tolerance: float,
) -> Certified:
    """The likelihood for sampling around the optimum `theta`, checked against the full sum.

    `root` is the root of theta's covariance. Each trace's compressed log-likelihood must agree to `tolerance` over
    their number near the optimum, and at points of the prior to a part in a million of how far they lie below it.
    """
    asked = tuple(tuple(np.flatnonzero(np.asarray(trace.linear_sd)).tolist()) for trace in wide.traces)
    wide = dataclasses.replace(
        wide, traces=tuple(dataclasses.replace(t, columns=c) for t, c in zip(wide.traces, asked, strict=True))
    )
    if all(trace.compression is None for trace in wide.traces):
        return Certified(wide, None, tuple(r or _OFF_TIME for r in reasons))
    light, optimum = wide.without_samples(), jnp.asarray(theta)
    log_b, slope = _log_b_and_slope(light, optimum)
    reach = float(reach_of(np.linalg.norm(np.asarray(slope) @ root)))
    near = tuple(
        _narrowed(trace, seen, float(log_b), reach, float(precision_of(noise, tolerance)))
        for (trace, seen), noise in zip(wide.each(optimum), sigma, strict=True)
    )
    points = np.vstack([_near(theta, root), _believed(light, theta)])
    narrow = dataclasses.replace(wide, traces=near).without_samples()
    exact, compressed, tabulated = (_at(model, points, sigma) for model in (wide.summed(), narrow, light))
    found = [
        reason or (_OFF_TIME if trace.compression is None else _against(*parts, tolerance / len(near)))
        for reason, trace, parts in zip(
            reasons, near, zip(exact.T, compressed.T, tabulated.T, strict=True), strict=True
        )
    ]
    error = None if any(found) else float(np.sum(np.max(np.abs(compressed - exact)[: _POINTS + 1], axis=0)))
    kept = tuple(trace.summed() if reason else trace for trace, reason in zip(near, found, strict=True))
    return Certified(dataclasses.replace(wide, traces=kept), error, tuple(found))


def reach_of(log_b_sd: ArrayLike) -> Float[np.ndarray, "*shape"]:
    """What a table for sampling holds on either side of the optimum, in log b."""
    return np.maximum(_REACH * np.asarray(log_b_sd), _LEAST_REACH)


def precision_of(noise: ArrayLike, tolerance: float = TOLERANCE) -> Float[np.ndarray, "*shape"]:
    """What a table for sampling may be off by, V or A (root of the sum of squares), under a noise, V or A."""
    return 0.1 * tolerance * np.asarray(noise)


def _against(exact: np.ndarray, compressed: np.ndarray, tabulated: np.ndarray, tolerance: float) -> str:
    """What speaks against the compression of a trace, by its log-likelihoods at points near and far; "" if nothing."""
    error = float(np.max(np.abs(compressed - exact)[: _POINTS + 1]))
    if np.isnan(error):
        return "the record leaves its time constant more open than the table is wide"
    if not error <= tolerance:
        return f"the compressed log-likelihood was off by {error:.2g} near the optimum"
    excess = float(np.nanmax(np.abs(tabulated - exact) - _FAR * np.abs(exact[0] - exact)))
    return f"the compressed log-likelihood was off by {excess:.2g} within the prior" if excess > tolerance else ""


def _near(theta: np.ndarray, root: np.ndarray) -> Float[np.ndarray, "n parameters"]:
    """The optimum and points around it; any will do."""
    deviates = np.random.default_rng(0).standard_normal((_POINTS, theta.size))
    return np.vstack([theta, theta + 1.5 * deviates @ root.T])


def _believed(likelihood: Likelihood, theta: np.ndarray) -> Float[np.ndarray, "n parameters"]:
    """Points of the prior that the tables reach, the optimum where there are too few."""
    draws = likelihood.draws(theta, 1000)
    slowest = _each_log_b(likelihood, jnp.asarray(draws))
    held = [trace.compression.holds(jnp.exp(slowest)) for trace in likelihood.traces if trace.compression is not None]
    draws = draws[np.all(held, axis=0)]
    return np.vstack([draws, np.tile(theta, (_POINTS, 1))])[:_POINTS]


def _at(likelihood: Likelihood, theta: Float[np.ndarray, "n parameters"], sigma: np.ndarray) -> np.ndarray:
    """Log-likelihoods of each trace at points of one sigma, (n, traces)."""
    points = np.column_stack([theta, np.tile(np.log(sigma), (len(theta), 1))])
    evaluate = Batched(Likelihood.log_likelihoods, likelihood, likelihood.rows)
    batches = [points[i : i + evaluate.batch] for i in range(0, len(points), evaluate.batch)]
    return np.concatenate([evaluate(batch) for batch in watched(batches, "checking the compression", len(batches))])


def log_prob(likelihood: Likelihood, walkers: int) -> Callable[[np.ndarray], np.ndarray]:
    """Log-posteriors of points (theta, log sigma); where the compression does not reach, the samples are summed.

    Fastest for all `walkers` of an ensemble at once, or half of them.
    """
    # halves are filled up where they cost no more, so that one size is compiled
    batch = walkers if likelihood.rows <= FEW_ROWS else walkers // 2
    tabulated = Batched(Likelihood.log_prob, likelihood.without_samples(), likelihood.rows, batch)
    full = likelihood.summed()
    summed = Batched(Likelihood.log_prob, full, full.rows, batch=1)

    def values(points: Float[np.ndarray, "n coordinates"]) -> np.ndarray:
        found = tabulated(points)
        beyond = np.isnan(found)
        if beyond.any():
            found = np.array(found)
            found[beyond] = summed(points[beyond])
        return found

    return values


def _narrowed(trace: Trace, seen: Seen, center: float, reach: float, error: float) -> Trace:
    """With the part of the table that the posterior can want, where there is a table that holds the optimum.

    That is `reach` around `center`, in log b, to an `error` of the signal (V or A).
    """
    table = trace.compression
    if not isinstance(table, Compression) or not table.holds(np.exp(center)):
        return trace
    largest = float(jnp.sum(jnp.abs(jnp.stack(seen.circuit.terms_of(trace.channel).weight))) * seen.gain)
    charge = float(np.ptp(trace.observed)) / largest if max(trace.columns, default=0) >= len(SLOW) else 0.0
    low, high = (float(table.center + side * table.reach) for side in (-1.0, 1.0))
    low, high = max(center - reach, low), min(center + reach, high)
    narrow = table.narrowed(0.5 * (low + high), 0.5 * (high - low), error / largest, charge=charge)
    return dataclasses.replace(trace, compression=narrow)


@eqx.filter_jit
def _log_b_and_slope(likelihood: Likelihood, theta: Array) -> tuple[Array, Array]:
    return jax.value_and_grad(_log_b, argnums=1)(likelihood, theta)


@eqx.filter_jit
def _each_log_b(likelihood: Likelihood, theta: Float[Array, "n parameters"]) -> Float[Array, " n"]:
    return jax.vmap(lambda each: _log_b(likelihood, each))(theta)


def _log_b(likelihood: Likelihood, theta: Array) -> Array:
    """Logarithm of the slowest time constant, s."""
    return jnp.log(likelihood.circuit(theta).b)
