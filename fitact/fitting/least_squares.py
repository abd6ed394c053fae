"""The fit of one or several traces, and which nuisances they ask for."""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.fitting.levenberg_marquardt import minimise
from fitact.fitting.timing import clock_drop, opened
from fitact.likelihood.channel import TIMING, Seen, Trace
from fitact.likelihood.likelihood import Likelihood
from fitact.likelihood.noise import first_order, student_curvature, student_weight

_SETTLED = 0.01  # relative change of the noise, below which no further round changes what follows
_ROUNDS = 6
_SCALE_STEPS = 40  # of Student's scale, each of which gains a quarter of a digit
NUISANCES = {  # by name, the columns of `LINEAR` that a trace may ask for; beside these, its `TIMING`
    "offset": (0,),
    "drift": (1,),
    "hum_50Hz": (2, 3),
    "hum_60Hz": (4, 5),
}
EVIDENCE = 10.0  # a nuisance is freed when it lowers the Bayesian information criterion by this much


class Solved(eqx.Module):
    """Where a fit ended; by trace: rows are its samples, or their coordinates.

    Attributes:
        likelihood: what was fitted.
        theta, sigma: the optimum, and each trace's noise by what is left of it.
        result: a member of `RESULTS`.
        steps: trial steps taken, in all.
        jacobian: of the whitened residuals in theta.
        remainder, shapes, slope: of each trace: what is left of it, the shapes of its linear nuisances, and what a
            further delay would change. Under Student's t these, and the Jacobian, are reweighted.
    """

    likelihood: Likelihood
    theta: Float[Array, " parameters"]
    sigma: Float[Array, " traces"]
    result: Any
    steps: Array
    jacobian: tuple[Float[Array, "rows parameters"], ...]
    remainder: tuple[Float[Array, " rows"], ...]
    shapes: tuple[Float[Array, "columns rows"], ...]
    slope: tuple[Float[Array, " rows"], ...]


def least_squares(likelihood: Likelihood, start: Array, noise: Array) -> Solved:
    """In rounds: with the noise as given, then with that of the residuals, until it has settled."""
    needed, steps = likelihood.without_samples(), jnp.zeros((), dtype=int)
    theta, sigma = start, noise
    for _ in range(_ROUNDS):
        solved = _round(needed, theta, sigma)
        change = float(jnp.max(jnp.abs(solved.sigma / sigma - 1.0)))
        theta, sigma, steps = solved.theta, solved.sigma, steps + solved.steps
        if not change > _SETTLED:
            break
    return dataclasses.replace(solved, likelihood=likelihood, steps=steps)


@eqx.filter_jit
def _round(likelihood: Likelihood, start: Array, sigma: Array) -> Solved:
    found = minimise(lambda theta: (likelihood.residuals(theta, sigma), likelihood.prior_residuals(theta)), start)
    theta, parts = found.theta, list(likelihood.each(found.theta))
    sizes = [trace.rows + len(trace.columns) for trace, _ in parts]
    of_traces = jnp.split(found.jacobian, np.cumsum(sizes))[:-1]
    remainder = tuple(trace.linear(seen, s)[0] for (trace, seen), s in zip(parts, sigma, strict=True))
    root = [_root_weight(trace, left / s) for (trace, _), left, s in zip(parts, remainder, sigma, strict=True)]
    if any(trace.noise == "student" for trace, _ in parts):
        of_traces = _informing(likelihood, theta, sigma, remainder)
    used = theta.size / likelihood.count  # of a trace's samples, by the parameters
    return Solved(
        likelihood=likelihood,
        theta=theta,
        sigma=jnp.stack([_noise(trace, left, used) for trace, left in zip(likelihood.traces, remainder, strict=True)]),
        result=found.result,
        steps=found.steps,
        jacobian=tuple(of_traces),
        remainder=tuple(w * left for w, left in zip(root, remainder, strict=True)),
        shapes=tuple(w * trace.before_linear(seen)[1] for w, (trace, seen) in zip(root, parts, strict=True)),
        slope=tuple(w * trace.slope(seen) for w, (trace, seen) in zip(root, parts, strict=True)),
    )


def _root_weight(trace: Trace, z: Array) -> ArrayLike:
    """Of the samples, in reweighted least squares."""
    return jnp.sqrt(student_weight(z)) if trace.noise == "student" else 1.0


def _informing(
    likelihood: Likelihood, theta: Array, sigma: Array, remainder: tuple[Array, ...]
) -> list[Float[Array, "rows parameters"]]:
    """The Jacobian whose square is the curvature of -log-likelihood: that of Student's residuals is steeper."""

    def whitened(theta: Array) -> list[Array]:
        parts = zip(likelihood.each(theta), sigma, strict=True)
        found = ((trace.linear(seen, s), s) for (trace, seen), s in parts)
        return [jnp.concatenate([left / s, beta]) for (left, beta, _), s in found]

    scaled = []
    for trace, jacobian, left, s in zip(likelihood.traces, jax.jacfwd(whitened)(theta), remainder, sigma, strict=True):
        if trace.noise == "student":
            z = left / s
            weight = student_weight(z)
            weight = weight * trace.mean(student_curvature(z)) / trace.mean(weight)
            jacobian = jacobian * jnp.pad(jnp.sqrt(weight), (0, len(trace.columns)), constant_values=1.0)[:, None]
        scaled.append(jacobian)
    return scaled


def _noise(trace: Trace, remainder: Array, used: Array) -> Array:
    """Its standard deviation, or Student's scale, not below the least that is believed."""
    counted = jnp.maximum(trace.count * (1.0 - used), 1)
    sigma = jnp.sqrt(jnp.sum(jnp.square(remainder)) / counted)
    sigma = jnp.maximum(sigma, trace.least_noise)
    if trace.noise != "student":
        return sigma

    def reweighted(_: int, sigma: Array) -> Array:
        squares = student_weight(remainder / sigma) * jnp.square(remainder)
        return jnp.maximum(jnp.sqrt(jnp.sum(squares) / counted), trace.least_noise)

    return lax.fori_loop(0, _SCALE_STEPS, reweighted, sigma)


def solve(
    likelihood: Likelihood,
    start: Float[np.ndarray, " parameters"],
    noise: Float[np.ndarray, " traces"],
    freeable: tuple[tuple[str, ...], ...],
) -> Solved:
    """Fit; then free nuisances (of each trace, `NUISANCES` and `TIMING`), one at a time, while one is asked for."""
    solved = _coloured(likelihood, jnp.asarray(start), jnp.asarray(noise, dtype=float))
    for _ in range(sum(map(len, freeable))):
        gains = _evidence(solved, freeable)
        which, name = max(gains, key=gains.__getitem__, default=(0, ""))
        if not name or not gains[which, name] > EVIDENCE:
            break
        likelihood, theta = _freed(solved, which, name)
        solved = _coloured(likelihood, theta, solved.sigma)
    return solved


def _coloured(likelihood: Likelihood, start: Array, noise: Array) -> Solved:
    """Fit; where a trace's noise is AR(1), again with the coefficient that the residuals show.

    It is then held: its error and the parameters' are uncorrelated in the limit of many samples (the information
    is block-diagonal), so that not knowing it exactly widens no parameter.
    """
    solved = least_squares(likelihood, start, noise)
    for i, trace in enumerate(likelihood.traces):
        if trace.noise == "ar1":
            white = dataclasses.replace(trace, whitening=None)
            left = np.asarray(_remainder(white, likelihood.seen(solved.theta, i), solved.sigma[i]))
            counted = trace.weights > 0.0
            whitening = first_order(left, counted).whitening(counted)
            likelihood = likelihood.with_trace(i, dataclasses.replace(trace, whitening=whitening))
    if likelihood is solved.likelihood:
        return solved
    return least_squares(likelihood, solved.theta, solved.sigma)


@eqx.filter_jit
def _remainder(trace: Trace, seen: Seen, sigma: Array) -> Array:
    return trace.linear(seen, sigma)[0]


def _freed(solved: Solved, which: int, name: str) -> tuple[Likelihood, Array]:
    """The likelihood with a nuisance of the trace `which` freed, and where to go on from."""
    likelihood, theta = solved.likelihood, solved.theta
    trace = likelihood.traces[which]
    if name in TIMING:
        trace = opened(trace, likelihood.seen(theta, which), name)
        new, before = likelihood.with_trace(which, trace).names, likelihood.names
        theta = jnp.array([theta[before.index(n)] if n in before else 0.0 for n in new])
    else:
        sd = trace.linear_sd.at[np.array(NUISANCES[name])].set(10.0 * jnp.ptp(trace.observed))
        trace = dataclasses.replace(trace, linear_sd=sd)
    return likelihood.with_trace(which, trace), theta


def _evidence(solved: Solved, freeable: tuple[tuple[str, ...], ...]) -> dict[tuple[int, str], float]:
    """By how much freeing each nuisance would lower the Bayesian information criterion, to first order."""
    likelihood, sigma = solved.likelihood, np.asarray(solved.sigma)
    remainders = [np.asarray(x) / s for x, s in zip(solved.remainder, sigma, strict=True)]
    starts = np.cumsum([0, *(x.size for x in remainders)])
    columns = [np.concatenate([np.asarray(j)[: x.size] for j, x in zip(solved.jacobian, remainders, strict=True)])]

    def alone(which: int, shapes: np.ndarray) -> np.ndarray:
        """Columns of one trace, which are nothing in the others."""
        around = (starts[which], starts[-1] - starts[which + 1])
        return np.pad(np.atleast_2d(shapes) / sigma[which], ((0, 0), around)).T

    candidates = {}
    for i, trace in enumerate(likelihood.traces):
        shapes, free = np.asarray(solved.shapes[i]), np.asarray(trace.linear_sd) > 0.0
        columns.append(alone(i, shapes[free[list(trace.columns)]]))
        for name in freeable[i]:
            if name == "delay" and name not in trace.timing:
                candidates[i, name] = alone(i, np.asarray(solved.slope[i]))
            elif name in NUISANCES and not free[NUISANCES[name][0]]:
                candidates[i, name] = alone(i, shapes[list(NUISANCES[name])])
    known = np.concatenate(columns, axis=1)
    basis, values, _ = np.linalg.svd(known / np.maximum(np.linalg.norm(known, axis=0), 1e-300), full_matrices=False)
    basis = basis[:, values > 1e-9 * values[0]]
    remainder = np.concatenate(remainders)
    gains = {
        (i, "clock"): bic_gain(clock_drop(trace, likelihood.seen(solved.theta, i), sigma[i]), float(trace.count), 1)
        for i, trace in enumerate(likelihood.traces)
        if "clock" in freeable[i] and "clock" not in trace.timing
    }
    for (i, name), added in candidates.items():
        left = added - basis @ (basis.T @ added)
        modes, sizes, _ = np.linalg.svd(left, full_matrices=False)
        modes = modes[:, sizes > 1e-9 * max(float(np.linalg.norm(added)), 1e-300)]
        share = float(np.sum((modes.T @ remainder) ** 2)) / float(remainders[i] @ remainders[i])
        gains[i, name] = bic_gain(share, float(likelihood.traces[i].count), added.shape[1])
    return gains


def bic_gain(share: ArrayLike, count: float, added: int) -> Any:
    """By how much the Bayesian information criterion falls with a share of `count` samples' sum of squares."""
    return -count * np.log1p(-np.minimum(share, 1.0 - 1e-12)) - added * math.log(count)
