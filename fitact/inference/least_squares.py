"""Levenberg-Marquardt by optimistix, and which nuisances a record asks for."""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from fitact.inference.likelihood import Likelihood

_PRECISION = 1e-9  # of Vsc's span: least noise assumed
NUISANCES = {  # by name, the columns of `LINEAR` that the record may ask for; beside these, a delay
    "offset": (0,),
    "drift": (1,),
    "hum_50Hz": (2, 3),
    "hum_60Hz": (4, 5),
}
_EVIDENCE = 10.0  # a nuisance is freed when it lowers the Bayesian information criterion by this much


class RESULTS(optx.RESULTS):
    """Why a fit ended: optimistix's results, and what else makes an answer untrustworthy."""

    did_not_move = (
        "The fit never left its start although the record asks for another answer; check the units of the record."
    )
    not_at_optimum = "The fit stopped before its optimum; check the units of the record, or give a nearer prior."
    misfit = (
        "The model does not describe the record: its residuals are larger than the noise or have structure;"
        " look at them in the report, and use the drive as measured or a scene that has what is missing."
    )


_NAMES = (
    "successful", "did_not_move", "not_at_optimum", "misfit",
    "nonfinite", "nonlinear_max_steps_reached", "nonlinear_divergence",
)  # fmt: skip


def result_name(result: Any) -> str:
    """The name of a member of `RESULTS`; a linear solver's failure counts as "nonfinite"."""
    return next((name for name in _NAMES if bool(result == getattr(RESULTS, name))), "nonfinite")


def result_message(name: str) -> str:
    """The sentence of a member of `RESULTS`, by its name."""
    return str(RESULTS[getattr(RESULTS, name)])  # type: ignore[misc]  # equinox's enumerations look up by item


class Solved(eqx.Module):
    """Where Levenberg-Marquardt ended; `start` is where the last fit began. Rows: samples, or their coordinates."""

    likelihood: Likelihood
    start: Float[Array, " parameters"]
    theta: Float[Array, " parameters"]
    sigma: Float[Array, ""]
    result: Any
    steps: Array
    remainder: Float[Array, " rows"]  # of the record, V
    jacobian: Float[Array, "rows parameters"]
    shapes: Float[Array, "columns rows"]  # of the linear nuisances
    slope: Float[Array, " rows"]  # of the signal in a further delay
    gradient: Float[Array, " parameters"]  # of minus the log-posterior


def _least_squares(likelihood: Likelihood, start: Array, noise: float | Array) -> Solved:
    """Two rounds: with the noise as given, then with that of the residuals."""
    needed = likelihood.without_samples()
    first = _round(needed, start, jnp.asarray(noise, dtype=float))
    second = _round(needed, first.theta, first.sigma)
    return dataclasses.replace(second, likelihood=likelihood, start=start, steps=first.steps + second.steps)


@eqx.filter_jit
def _round(likelihood: Likelihood, start: Array, sigma: Array) -> Solved:
    def residuals(theta: Array, _: None) -> tuple[Array, Array]:
        return likelihood.residuals(theta, sigma), likelihood.prior_residuals(theta)

    solver: Any = optx.LevenbergMarquardt(rtol=1e-9, atol=1e-9)
    solution: Any = optx.least_squares(residuals, solver, start, max_steps=256, throw=False)
    theta = solution.value
    (of_data, of_prior), (jacobian, prior_jacobian) = (
        residuals(theta, None),
        jax.jacfwd(residuals)(theta, None),
    )
    remainder, _, _ = likelihood.linear(theta, sigma)
    return Solved(
        likelihood=likelihood,
        start=start,
        theta=theta,
        # not below what double precision leaves of a record without noise
        sigma=jnp.maximum(
            jnp.sqrt(jnp.sum(jnp.square(remainder)) / jnp.maximum(likelihood.count - start.size, 1)),
            _PRECISION * jnp.ptp(likelihood.observed),
        ),
        result=RESULTS.promote(solution.result),
        steps=solution.stats["num_steps"],
        remainder=remainder,
        jacobian=jacobian,
        shapes=likelihood.before_linear(theta)[1],
        slope=likelihood.slope(theta),
        gradient=jacobian.T @ of_data + prior_jacobian.T @ of_prior,
    )


def solve(
    likelihood: Likelihood, start: Float[np.ndarray, " parameters"], noise: float, freeable: tuple[str, ...]
) -> Solved:
    """Fit; then free nuisances (of `NUISANCES`), one at a time, as long as the record asks for one.

    With a delay, the samples are summed: the response table holds none.
    """
    solved = _least_squares(likelihood, jnp.asarray(start), noise)
    for _ in freeable:
        gains = _evidence(solved, freeable)
        name = max(gains, key=gains.__getitem__, default="")
        if not name or not gains[name] > _EVIDENCE:
            break
        theta = solved.theta
        if name == "delay":
            likelihood = dataclasses.replace(likelihood, compression=None)
            shift = likelihood.shift + _nearest_delay(likelihood, theta)
            likelihood = dataclasses.replace(likelihood, free_delay=True, shift=shift)
            theta = jnp.append(theta, 0.0)
        else:
            sd = likelihood.linear_sd.at[np.array(NUISANCES[name])].set(10.0 * jnp.ptp(likelihood.observed))
            likelihood = dataclasses.replace(likelihood, linear_sd=sd)
        solved = _least_squares(likelihood, theta, solved.sigma)
    return solved


def _nearest_delay(likelihood: Likelihood, theta: Array) -> Array:
    """The middle of the best of a grid of delays within five steps (s): across an ideal edge there is no slope
    to follow, and between two samples nothing that a gain could not do as well.
    """
    delays = np.arange(-40, 41) / 8.0
    later = jnp.asarray(delays) * likelihood.time_step
    shapes = np.asarray(likelihood.shapes(theta))[np.asarray(likelihood.linear_sd) > 0.0]
    left = []
    for shift in later:
        design = np.vstack([_signal(likelihood, theta, shift), shapes]).T
        remainder = likelihood.observed - design @ np.linalg.lstsq(design, likelihood.observed, rcond=None)[0]
        left.append(float(remainder @ remainder))
    good = np.asarray(left) < min(left) * (1.0 + 25.0 / likelihood.observed.size)
    return jnp.asarray(np.mean(delays[good])) * likelihood.time_step


@eqx.filter_jit
def _signal(likelihood: Likelihood, theta: Array, later: Array) -> Array:
    return likelihood.signal(theta, later)


def _evidence(solved: Solved, freeable: tuple[str, ...]) -> dict[str, float]:
    """By how much freeing each nuisance would lower the Bayesian information criterion, to first order."""
    likelihood, shapes, remainder = solved.likelihood, np.asarray(solved.shapes), np.asarray(solved.remainder)
    count, free = float(likelihood.count), np.asarray(likelihood.linear_sd) > 0.0
    candidates = {
        name: shapes[list(places)] for name, places in NUISANCES.items() if name in freeable and not free[places[0]]
    }
    if "delay" in freeable and not likelihood.free_delay:
        candidates["delay"] = np.asarray(solved.slope)[None]
    known = np.concatenate([np.asarray(solved.jacobian)[: remainder.size], shapes[free].T], axis=1)
    basis, values, _ = np.linalg.svd(known / np.maximum(np.linalg.norm(known, axis=0), 1e-300), full_matrices=False)
    basis = basis[:, values > 1e-9 * values[0]]
    gains = {}
    for name, columns in candidates.items():
        left = columns.T - basis @ (basis.T @ columns.T)
        modes, sizes, _ = np.linalg.svd(left, full_matrices=False)
        modes = modes[:, sizes > 1e-9 * max(float(np.linalg.norm(columns)), 1e-300)]
        drop = float(np.sum((modes.T @ remainder) ** 2))
        share = min(drop / float(remainder @ remainder), 1.0 - 1e-12)
        gains[name] = -count * math.log1p(-share) - len(columns) * math.log(count)
    return gains
