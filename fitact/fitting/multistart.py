"""Where least squares start from beside the data's own start, and whether they have other optima than the one found."""

import math
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitact.errors import InputError
from fitact.fitting.least_squares import Solved, solve
from fitact.fitting.levenberg_marquardt import Optima, minimise_many
from fitact.fitting.problem import Problem, left
from fitact.likelihood.likelihood import Likelihood

_DRAWS = 100  # of the prior for each start, of which a table may hold few
_APART = 0.5  # standard errors from the lowest optimum, from which the one found is another


def begin(problem: Problem, start: Mapping[str, float] | None) -> Float[np.ndarray, " parameters"]:
    """The data's start, or what summing the samples makes of another (SI), since a table holds little but the data's.

    From far off it may make nothing of it, where the circuit gives no signal: an end that leaves more than the
    data's own start is no optimum, and that start is taken.

    Raises:
        InputError: one is no parameter of the fit, or not above zero.
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
    left_of_end, left_of_start = left(problem.likelihood, np.stack([end, problem.start]))
    return end if left_of_end < left_of_start else problem.start


def explore(solved: Solved, count: int) -> Optima:
    """The optima that the one found and `count` - 1 draws of the prior lead to, at the noise found.

    Where the record is compressed, it shows its time constant, and only draws within the table's reach are taken.
    """
    likelihood = solved.likelihood.without_samples()
    draws = likelihood.draws(np.asarray(solved.theta), _DRAWS * count)
    slowest = jax.vmap(lambda theta: likelihood.circuit(theta).b)(jnp.asarray(draws))
    tables = [trace.compression for trace in likelihood.traces if trace.compression is not None]
    held = np.all([np.ones(len(draws), bool), *(table.holds(slowest) for table in tables)], axis=0)
    starts = np.vstack([solved.theta, draws[held][: count - 1]])
    return minimise_many(jax.tree_util.Partial(_residuals, likelihood, solved.sigma), jnp.asarray(starts))


def _residuals(
    likelihood: Likelihood, sigma: Float[Array, " traces"], theta: Float[Array, " parameters"]
) -> tuple[tuple[Array, ...], Array]:
    return likelihood.residuals(theta, sigma), likelihood.prior_residuals(theta)


def better(optima: Optima, solved: Solved) -> dict[str, float] | None:
    """The parameters (SI) of a lower optimum than the one found; None: there is none."""
    lowest = np.asarray(optima.minima.theta[0])
    apart = np.linalg.norm(np.asarray(optima.minima.jacobian[0]) @ (np.asarray(solved.theta) - lowest))
    if not apart > _APART:
        return None
    return {name: math.exp(lowest[i]) for i, name in enumerate(solved.likelihood.prior.names)}
