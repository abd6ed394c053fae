"""Least squares from several starting points, which shows whether there are other optima."""

import math
from collections.abc import Mapping

import jax
import numpy as np
from jaxtyping import Array, Float

from fitact.errors import InputError
from fitact.fitting.least_squares import LeastSquaresResult, solve
from fitact.fitting.minimum import Optima, minimise_many
from fitact.likelihood.likelihood import Likelihood
from fitact.problem.build import Problem
from fitact.problem.starting_point import residual_objective


def choose_start(problem: Problem, start: Mapping[str, float] | None) -> Float[np.ndarray, " parameters"]:
    """Return the starting point estimated from the data, or one fitted to the samples from `start` (SI units).

    The response table covers only the neighbourhood of the data's start, so another start is first fitted to the
    samples. Far from the data the circuit gives no signal and that fit fails; if it ends above the data's start, the
    latter is returned.

    Raises:
        InputError: a name is not a free parameter, or a value is not positive and finite.
    """
    theta, names = problem.start.copy(), problem.likelihood.prior.names
    if start is None:
        return theta
    for name, value in start.items():
        if name not in names or not 0.0 < value < math.inf:
            raise InputError(f"start {name} = {value}: give positive values in SI units for any of {', '.join(names)}")
        theta[names.index(name)] = math.log(value)
    noise = np.array([source.noise for source in problem.sources])
    end = solve(problem.likelihood, theta, noise, ((),) * noise.size, (False,) * noise.size).theta
    objective_end, objective_start = residual_objective(problem.likelihood, np.stack([end, problem.start]))
    return end if objective_end < objective_start else problem.start


def find_optima(solution: LeastSquaresResult, count: int, draws_per_start: int = 100) -> Optima:
    """Return the optima reached from the solution and `count` - 1 draws of the prior, at the noise of the solution.

    If the record is compressed, only draws with a time constant within its table are used. These may be few, so
    `draws_per_start` draws are made for each start.
    """
    likelihood = solution.likelihood.without_samples()
    draws = likelihood.sample_prior(solution.theta, draws_per_start * count)
    _, slowest = likelihood.evaluate_g_and_b(draws)
    tables = [channel.compression for channel in likelihood.channels if channel.compression is not None]
    within_tables = np.all([np.ones(len(draws), bool), *(table.covers(slowest) for table in tables)], axis=0)
    starts = np.vstack([solution.theta, draws[within_tables][: count - 1]])
    return minimise_many(jax.tree_util.Partial(_residuals, likelihood, solution.sigma), starts, likelihood.elements)


def _residuals(
    likelihood: Likelihood, sigma: Float[Array, " channels"], theta: Float[Array, " parameters"]
) -> tuple[tuple[Array, ...], Array]:
    return likelihood.residuals(theta, sigma), likelihood.prior_residuals(theta)


def lower_optimum(optima: Optima, solution: LeastSquaresResult, min_separation: float = 0.5) -> dict[str, float] | None:
    """Return the parameters (SI) of a lower optimum at least `min_separation` standard errors away, or None."""
    lowest = optima.minima.theta[0]
    separation = np.linalg.norm(optima.minima.jacobian[0] @ (solution.theta - lowest))
    if not separation > min_separation:
        return None
    return {name: math.exp(lowest[i]) for i, name in enumerate(solution.likelihood.prior.names)}
