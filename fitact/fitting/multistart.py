"""Fits from several starting points, which show whether there are other optima."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from fitact.fitting.solution import Solution, solve_problem
from fitact.likelihood.certificate import draw_within_tables
from fitact.model.divider_coordinates import differentiate
from fitact.problem.build import Problem


class Optima(NamedTuple):
    """Fits from several starting points."""

    best: Solution  # the most probable of those that converged, if any did
    distinct: int  # number of optima that differ
    failed: int  # number of starts that did not converge
    has_rival: bool  # whether another optimum is almost as probable


def fit_from_starts(problem: Problem, tolerance: float, start: Mapping[str, float] | None, count: int) -> Optima:
    """Fit from `start`, and from draws of the prior, `count` points in all.

    One fit from the data's start is followed by another one from the skin of the prior if it leaves b open: the
    likelihood of such a record is curved, and may have another optimum. That counts if the standard errors do not cover
    it; where several starts are asked for, any other optimum does.
    """
    first = solve_problem(problem, tolerance, start)
    others: list[np.ndarray] = []
    if count > 1:
        others = _draw_starts(problem, first, count - 1)
    elif start is None and _leaves_b_open(first):
        others = [_start_at_prior(problem, first)]
    found = [first, *(solve_problem(problem._replace(start=each), tolerance, None) for each in others)]
    return compare_optima(found, separation=0.2 if count > 1 else 3.0)


def compare_optima(found: Sequence[Solution], separation: float, margin: float = 3.0, rounding: float = 1e-3) -> Optima:
    """Choose the most probable among fits of one problem, and count distinct optima.

    Of fits whose log-densities differ by a `rounding` at most, the first is chosen. Two are distinct if a parameter
    differs by more than `separation` standard errors of the better one. A rival has a log-density lower by a `margin`
    at most.
    """
    converged = [each for each in found if each.solved.result in ("successful", "rank_deficient")]
    candidates = converged or found
    highest = max(each.solved.log_density for each in candidates)
    # also where the log-density is not a number
    distinct = [next(each for each in candidates if not each.solved.log_density < highest - rounding)]
    for each in sorted(candidates, key=lambda each: -each.solved.log_density):
        if all(_distance(each, other) > separation for other in distinct):
            distinct.append(each)
    best, *others = distinct
    has_rival = any(best.solved.log_density - each.solved.log_density < margin for each in others)
    return Optima(best, len(distinct), len(found) - len(converged), has_rival)


def _distance(one: Solution, other: Solution) -> float:
    """Return the largest distance of a parameter between two fits, in standard errors of the `other`."""
    size = len(other.solved.likelihood.prior.names)
    away = one.solved.theta[:size] - other.solved.theta[:size]
    return float(np.max(np.abs(away) / np.linalg.norm(other.root[:size], axis=1)))


def _leaves_b_open(found: Solution, least_sd: float = 0.2) -> bool:
    """Return whether log b is uncertain by `least_sd` or more."""
    theta, places = found.solved.theta, found.solved.likelihood.elements
    return bool(places) and bool(np.linalg.norm((differentiate(theta, places) @ found.root)[places[0]]) > least_sd)


def _start_at_prior(problem: Problem, found: Solution) -> Float[np.ndarray, " circuit_parameters"]:
    """Return the start of a problem with the Rsc and Csc of the prior, and the fitted Ci."""
    Rsc, Csc, Ci = found.solved.likelihood.elements
    start = problem.start.copy()
    start[[Rsc, Csc]], start[Ci] = problem.likelihood.prior.log_mean[[Rsc, Csc]], found.solved.theta[Ci]
    return start


def _draw_starts(problem: Problem, found: Solution, count: int) -> list[Float[np.ndarray, " circuit_parameters"]]:
    """Return `count` draws of the prior that the tables of a fit cover, or as many as a hundred times as many hold."""
    likelihood, size = found.solved.likelihood.without_samples(), len(problem.likelihood.prior.names)
    draws = draw_within_tables(likelihood, found.solved.theta, count, draws=100 * (count + 1))
    return [np.append(draw[:size], problem.start[size:]) for draw in draws]
