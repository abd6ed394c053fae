"""Optimum of a problem: fits with compression, until effects of instruments and weights of spectra no longer change."""

from collections.abc import Mapping

import numpy as np

from fitact.fitting.instrument_effects import effects_would_change, fill_effects
from fitact.fitting.least_squares import LeastSquaresResult, solve
from fitact.fitting.multistart import choose_start
from fitact.fitting.row_updates import update_rows
from fitact.fitting.timing import shift_whole_steps, start_delays
from fitact.likelihood import certificate
from fitact.problem.build import Problem
from fitact.problem.spectra import update_weights


def solve_problem(
    problem: Problem,
    tolerance: float,
    start: Mapping[str, float] | None,
    max_rounds: int = 8,
    max_change: float = 0.3,
    max_skew: float = 0.05,
    max_steps: int = 1500,
) -> tuple[LeastSquaresResult, certificate.CertifiedLikelihood, np.ndarray]:
    """Fit, and fit again while effects of instruments for the new optimum would differ by more than `max_change`.

    Also after the noise of V was moved with Vsc, while weights of spectra change by more than a thousandth, or a
    current with a recorded drive by more than `max_skew` time steps, or the parameters with the estimate of its drive
    by more than `max_change` standard errors. It does not go on after `max_steps` of the search, of which a model that
    is wrong may need many. A current with a recorded drive that has not settled ends with its most probable fit.
    A delay that is known to a tenth of a step may change without end, by up to half a step, if the other parameters
    follow it by less than a twentieth of a standard error.
    """
    noise, theta = [source.noise for source in problem.sources], choose_start(problem, start)
    likelihood, end, best, steps = problem.likelihood, None, None, 0
    has_rows = any(channel.samples.charges is not None for channel in likelihood.channels)
    for round_number in range(max_rounds):
        before, likelihood = theta, fill_effects(likelihood, theta, noise, problem.sources)
        checked = not has_rows or round_number > 0
        problem = problem._replace(likelihood=likelihood)
        likelihood, reasons = problem.compress_likelihood(tolerance)  # what does not change stays compressed
        likelihood = start_delays(likelihood, theta) if round_number == 0 else likelihood
        end = _solve_with_effects(problem._replace(likelihood=likelihood), reasons, tolerance, theta, checked)
        places = [end[0].likelihood.names.index(name) for name in likelihood.names]
        theta, steps = end[0].theta[places], steps + end[0].steps
        if has_rows and checked and (best is None or end[0].log_density > best[0].log_density):
            best = end
        is_settled = effects_would_change(likelihood, before, theta, end[0].sigma) <= max_change
        if is_settled:
            influences = [jacobian @ end[2] for jacobian in end[0].jacobian]
            likelihood, change = update_weights(likelihood, theta, problem.sources, influences)
            is_settled = change <= 1e-3
        sd = np.linalg.norm(end[2][places], axis=1)
        shifted, theta = shift_whole_steps(likelihood, theta, sd)
        is_settled, likelihood = is_settled and shifted is likelihood, shifted
        if has_rows:
            moved = np.abs(theta - before) / sd
            skew = np.max(np.abs(theta), where=likelihood.follows_rows, initial=0.0)
            others = np.max(moved, where=~likelihood.follows_rows, initial=0.0)
            is_still = (skew <= max_skew and np.max(moved) <= max_change) or (skew <= 0.5 and others <= 0.05)
            is_settled = is_settled and checked and is_still
            if not is_settled:
                likelihood = update_rows(likelihood, end[0], problem.sources)
                theta = np.where(likelihood.follows_rows, 0.0, theta)  # their delays have moved into the rows
        if is_settled or (checked and steps > max_steps):
            break
    assert end is not None
    return end if is_settled or best is None else best


def _solve_with_effects(
    problem: Problem, reasons: tuple[str, ...], tolerance: float, theta_0: np.ndarray, checked: bool
) -> tuple[LeastSquaresResult, certificate.CertifiedLikelihood, np.ndarray]:
    """Fit with compression, and if that is `checked`, again without it where its error exceeds the tolerance.

    `reasons` say why channels are not compressed.
    """
    likelihood = problem.likelihood
    noise = np.array([source.noise for source in problem.sources])
    freeable = tuple(source.optional_nuisances for source in problem.sources)
    interpolated = [not certificate.reason_against_compression(each, tolerance) for each in likelihood.channels]
    while True:
        solved = solve(likelihood, theta_0, noise, freeable, tuple(interpolated))
        root = solved.covariance_factor()
        if not checked:
            return solved, certificate.CertifiedLikelihood(solved.likelihood, None, reasons), root
        certified = certificate.certify(solved.likelihood, reasons, solved.theta, root, solved.sigma, tolerance)
        pairs = zip(solved.likelihood.channels, certified.reasons, strict=True)
        failed = [bool(reason) and channel.compression is not None for channel, reason in pairs]
        if not any(failed):
            return solved, certified, root
        reasons = certified.reasons
        for i in (i for i, each in enumerate(failed) if each):
            interpolated[i] = False
            likelihood = likelihood.replace_channel(i, likelihood.channels[i].without_compression())
