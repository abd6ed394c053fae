"""Optimum of a problem: fits with compression, until effects of instruments and weights of spectra no longer change."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from fitact.errors import InputError
from fitact.fitting.instrument_effects import effects_would_change, fill_effects
from fitact.fitting.least_squares import LeastSquaresResult, solve
from fitact.fitting.row_updates import estimate_drives, update_rows
from fitact.fitting.timing import curve_drives, shift_whole_steps, start_delays
from fitact.likelihood import certificate
from fitact.likelihood.compression import Compression
from fitact.likelihood.likelihood import Likelihood
from fitact.problem.build import Problem
from fitact.problem.spectra import update_weights
from fitact.problem.starting_point import residual_objective


class Solution(NamedTuple):
    """Fit of a problem."""

    solved: LeastSquaresResult
    certified: certificate.CertifiedLikelihood
    root: Float[np.ndarray, "parameters parameters"]  # factor of the covariance


def solve_problem(
    problem: Problem,
    tolerance: float,
    start: Mapping[str, float] | None,
    max_rounds: int = 8,
    max_change: float = 0.3,
    max_skew: float = 0.05,
    max_steps: int = 1500,
    max_late: float = 5.0,
    max_restarts: int = 1,
) -> Solution:
    """Fit, and fit again while effects of instruments for the new optimum would differ by more than `max_change`.

    Also after the noise of V was moved with Vsc or V was curved, while weights of spectra change by more than a
    thousandth, or a current with a recorded drive by more than `max_skew` time steps, or the parameters with the
    estimate of its drive by more than `max_change` standard errors. It does not go on after `max_steps` of the search,
    of which a model that is wrong may need many. A current with a recorded drive that has not settled ends with its
    most probable fit. A delay that is known to a tenth of a step may change without end, by up to half a step, if the
    other parameters follow it by less than a twentieth of a standard error. Tables are verified at the end. If one does
    not reach far enough, they are made again around the optimum, as wide as possible; the samples of channels whose
    table still fails are summed from there on.

    A start far from the answer may lead delays astray, to where no table reaches. A search that fails with a delay of
    more than `max_late` prior standard deviations starts again from its circuit, without its delays, at most
    `max_restarts` times.
    """
    first = problem
    noise, theta = [source.noise for source in problem.sources], _choose_start(problem, start)
    likelihood, best, best_rank, steps = problem.likelihood, None, (False, -math.inf), 0
    likelihood = estimate_drives(likelihood, theta, problem.sources)
    full: dict[int, str] = {}  # channels whose table has failed, and why
    has_rows = any(channel.samples.has_drive_noise for channel in likelihood.channels)
    for round_number in range(max_rounds):
        before, likelihood = theta, fill_effects(likelihood, theta, noise, problem.sources)
        problem = problem._replace(likelihood=likelihood)
        likelihood, reasons = problem.compress_likelihood(tolerance, full)  # what does not change stays compressed
        likelihood = start_delays(likelihood, theta, problem.sources) if round_number == 0 else likelihood
        problem = problem._replace(likelihood=likelihood)
        solved = _solve(problem, tolerance, full, theta)
        if max_restarts and solved.result != "successful" and _largest_delay(solved) > max_late:
            circuit = len(first.likelihood.prior.names)
            again = first._replace(start=np.append(solved.theta[:circuit], first.start[circuit:]))
            return solve_problem(again, tolerance, None, max_restarts=max_restarts - 1)
        root, places = solved.covariance_factor(), _find_places(solved, likelihood)
        theta, steps = solved.theta[places], steps + solved.steps
        skew = np.max(np.abs(theta), where=likelihood.follows_rows, initial=0.0)
        # rows hold beside their delay only
        rank = bool(skew <= 2.0 * max_skew), solved.log_density
        if not has_rows or rank > best_rank:
            best, best_rank = (problem, reasons, solved), rank
        is_settled = effects_would_change(likelihood, before, theta, solved.sigma) <= max_change
        if is_settled:
            influences = [jacobian @ root for jacobian in solved.jacobian]
            likelihood, change = update_weights(likelihood, theta, problem.sources, influences)
            is_settled = change <= 1e-3
        sd = np.linalg.norm(root[places], axis=1)
        shifted, theta = shift_whole_steps(likelihood, theta, sd)
        curved = curve_drives(shifted, theta, solved.sigma, problem.sources)
        is_settled, likelihood = is_settled and curved is likelihood, curved
        if has_rows:
            moved = np.abs(theta - before) / sd
            others = np.max(moved, where=~likelihood.follows_rows, initial=0.0)
            is_still = (skew <= max_skew and np.max(moved) <= max_change) or (skew <= 0.5 and others <= 0.05)
            is_settled = is_settled and round_number > 0 and is_still
        if is_settled:
            certified, failed = _certify(solved, root, reasons, tolerance)
            if not failed:
                return Solution(solved, certified, root)
        else:  # what fits far outside a table is no optimum
            failed = _find_outside(solved)
        problem, full = _replace_tables(problem._replace(likelihood=likelihood), theta, full, failed)
        likelihood = problem.likelihood
        if has_rows and not is_settled:
            likelihood = update_rows(likelihood, solved, problem.sources)
            theta = np.where(likelihood.follows_rows, 0.0, theta)  # their delays have moved into the rows
        if steps > max_steps:
            break
    problem, reasons, solved = best or (problem, reasons, solved)
    root = solved.covariance_factor()
    certified, failed = _certify(solved, root, reasons, tolerance)
    while failed:
        theta = solved.theta[_find_places(solved, problem.likelihood)]
        problem, full = _replace_tables(problem, theta, full, failed)
        likelihood, reasons = problem.compress_likelihood(tolerance, full)
        problem = problem._replace(likelihood=likelihood)
        solved = _solve(problem, tolerance, full, theta)
        root = solved.covariance_factor()
        certified, failed = _certify(solved, root, reasons, tolerance)
    return Solution(solved, certified, root)


def _choose_start(problem: Problem, start: Mapping[str, float] | None) -> Float[np.ndarray, " parameters"]:
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


def _largest_delay(solved: LeastSquaresResult) -> float:
    """Return the largest delay or clock error of a solution, in standard deviations of its prior."""
    likelihood, (off_prior, _) = solved.likelihood, solved.prior
    timing = slice(len(likelihood.prior.names), len(likelihood.names))
    return float(np.max(np.abs(off_prior[timing]), initial=0.0))


def _solve(
    problem: Problem, tolerance: float, full: Mapping[int, str], theta: Float[np.ndarray, " parameters"]
) -> LeastSquaresResult:
    """Fit from `theta` on, without an interpolation of the channels whose samples are all summed (`full`)."""
    reasons = [certificate.reason_against_compression(each, tolerance) for each in problem.likelihood.channels]
    return solve(
        problem.likelihood,
        theta,
        np.array([source.noise for source in problem.sources]),
        tuple(source.optional_nuisances for source in problem.sources),
        tuple(not reason and i not in full for i, reason in enumerate(reasons)),
    )


def _certify(
    solved: LeastSquaresResult,
    root: Float[np.ndarray, "parameters parameters"],
    reasons: tuple[str, ...],
    tolerance: float,
) -> tuple[certificate.CertifiedLikelihood, dict[int, str]]:
    """Verify the compressions at a solution, and return also which failed, and why.

    `root` is a factor of its covariance. `reasons` say why channels are not compressed.
    """
    certified = certificate.certify(solved.likelihood, reasons, solved.theta, root, solved.sigma, tolerance)
    pairs = enumerate(zip(solved.likelihood.channels, certified.reasons, strict=True))
    return certified, {i: why for i, (channel, why) in pairs if why and channel.compression is not None}


def _find_outside(solved: LeastSquaresResult) -> dict[int, str]:
    """Return the channels whose table does not reach as far as a solution, and that this is why it fails."""
    tau = np.asarray(solved.likelihood.evaluate_circuit(solved.theta).tau)
    tables = {i: each for i, each in enumerate(solved.likelihood.channels) if isinstance(each.compression, Compression)}
    return {i: certificate.OUTSIDE for i, each in tables.items() if not certificate.covers(each, tau)}


def _replace_tables(
    problem: Problem, theta: Float[np.ndarray, " parameters"], full: dict[int, str], failed: Mapping[int, str]
) -> tuple[Problem, dict[int, str]]:
    """Return the problem without the tables that failed, and the channels without a table, and why.

    If that is only because they do not reach far enough, the next ones are made around `theta`, and wide.
    """
    outside = [i for i, why in failed.items() if why == certificate.OUTSIDE and not problem.is_wide]
    if outside:
        problem = problem._replace(start=theta, is_wide=True)
    full = full | {i: why for i, why in failed.items() if i not in outside}
    likelihood = problem.likelihood
    for i in failed:
        likelihood = likelihood.replace_channel(i, likelihood.channels[i].without_compression())
    return problem._replace(likelihood=likelihood), full


def _find_places(solved: LeastSquaresResult, likelihood: Likelihood) -> list[int]:
    """Return the places of a likelihood's parameters among those of a solution, which may have more."""
    return [solved.likelihood.names.index(name) for name in likelihood.names]
