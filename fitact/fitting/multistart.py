"""Where least squares start from beside the data's own start, and whether they have other optima than the one found."""

import math
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitact.errors import InputError
from fitact.fitting.least_squares import LeastSquaresResult, solve
from fitact.fitting.levenberg_marquardt import Optima, minimise_many
from fitact.fitting.problem import Problem
from fitact.fitting.starting_point import residual_objective
from fitact.likelihood.likelihood import Likelihood


def choose_start(problem: Problem, start: Mapping[str, float] | None) -> Float[np.ndarray, " parameters"]:
    """The data's start, or what summing the samples makes of another (SI), since a table holds little but the data's.

    From far off it may make nothing of it, where the circuit gives no signal: an end that leaves more than the
    data's own start is no optimum, and that start is taken.
    """
    theta, names = problem.start.copy(), problem.likelihood.prior.names
    if start is None:
        return theta
    for name, value in start.items():
        if name not in names or not 0.0 < value < math.inf:
            raise InputError(f"start {name} = {value}: give values above zero, in SI units, of {', '.join(names)}")
        theta[names.index(name)] = math.log(value)
    noise = np.array([source.noise for source in problem.sources])
    end = np.asarray(solve(problem.likelihood, theta, noise, ((),) * noise.size).theta)
    left_of_end, left_of_start = residual_objective(problem.likelihood, np.stack([end, problem.start]))
    return end if left_of_end < left_of_start else problem.start


def find_optima(solution: LeastSquaresResult, count: int, draws_per_start: int = 100) -> Optima:
    """The optima that the one found and `count` - 1 draws of the prior lead to, at the noise found.

    Where the record is compressed, it shows its time constant, and only draws within the table's reach are taken, which
    may be few of the `draws_per_start`.
    """
    likelihood = solution.likelihood.without_samples()
    draws = likelihood.sample_prior(np.asarray(solution.theta), draws_per_start * count)
    slowest = jax.vmap(lambda theta: likelihood.circuit(theta).b)(jnp.asarray(draws))
    tables = [channel.compression for channel in likelihood.channels if channel.compression is not None]
    within_tables = np.all([np.ones(len(draws), bool), *(table.covers(slowest) for table in tables)], axis=0)
    starts = np.vstack([solution.theta, draws[within_tables][: count - 1]])
    return minimise_many(jax.tree_util.Partial(_residuals, likelihood, solution.sigma), jnp.asarray(starts))


def _residuals(
    likelihood: Likelihood, sigma: Float[Array, " channels"], theta: Float[Array, " parameters"]
) -> tuple[tuple[Array, ...], Array]:
    return likelihood.residuals(theta, sigma), likelihood.prior_residuals(theta)


def lower_optimum(optima: Optima, solution: LeastSquaresResult, min_separation: float = 0.5) -> dict[str, float] | None:
    """The parameters (SI) of a lower optimum, `min_separation` standard errors from the one found; None: none is."""
    lowest = np.asarray(optima.minima.theta[0])
    apart = np.linalg.norm(np.asarray(optima.minima.jacobian[0]) @ (np.asarray(solution.theta) - lowest))
    if not apart > min_separation:
        return None
    return {name: math.exp(lowest[i]) for i, name in enumerate(solution.likelihood.prior.names)}
