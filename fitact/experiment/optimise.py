"""Optimization of a measurement's settings: a coarse grid, then descent with exact gradients."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.ndimage
import scipy.optimize
from jaxtyping import Float

from fitact.experiment.experiment import CandidateDesign, Gradient, joint_jacobian, joint_prior_factor
from fitact.experiment.fisher import covariance_factor
from fitact.model.skin import has_time_constants


class Optimum(NamedTuple):
    """Best settings, and the standard deviation of the log mean force on the grid."""

    values: tuple[float, ...]  # of the settings, SI
    grid: tuple[Float[np.ndarray, " points"], ...]  # along each setting
    force_sd: Float[np.ndarray, "*points"]  # at all combinations


def optimise(design: CandidateDesign, gradient: Gradient, starts: int = 3, min_improvement: float = 1e-3) -> Optimum:
    """Find the settings with the smallest uncertainty of the mean force.

    The descent starts from the `starts` lowest points of the grid. It is skipped for a skin without time constants,
    which has no derivatives in the settings. A setting moves only if the uncertainty falls by the
    fraction `min_improvement`.
    """
    bounds = [(setting.low, setting.high) for setting in design.settings]
    count = {1: 33, 2: 6}.get(len(bounds), 4)  # grid points along each setting, by the number of settings
    grid = tuple(np.geomspace(*pair, count) for pair in bounds)
    points = list(itertools.product(*grid))
    coarse = np.array([force_sd(design, point, gradient) for point in points])
    shape = (count,) * len(bounds)
    lowest = scipy.ndimage.minimum_filter(coarse.reshape(shape), 3, mode="nearest").ravel() == coarse
    order = [i for i in np.argsort(coarse) if lowest[i]][:starts]
    optima = [(coarse[i], points[i]) for i in order]
    if all(has_time_constants(e.circuit) for e in design.experiments):
        optima += [_minimise(design, gradient, points[i], bounds) for i in order]
    best, values = min(optima)
    if force_sd(design, design.start_values, gradient) < (1.0 + min_improvement) * best:
        values = design.start_values
    if len({setting.field for setting in design.settings}) == 1:  # the records are interchangeable
        values = sorted(values)
    return Optimum(tuple(map(float, values)), grid, coarse.reshape(shape))


def force_sd(design: CandidateDesign, values: Sequence[float], gradient: Gradient) -> float:
    """Return the standard deviation of the log mean force with the settings at `values`."""
    experiments = design.make_experiments(values, keep_phase=True)
    root = covariance_factor(joint_jacobian(experiments)[0], joint_prior_factor(experiments))
    return float(np.linalg.norm(gradient @ root[: gradient.size]))


def log_force_sd_slope(
    design: CandidateDesign, values: Sequence[float], gradient: Gradient
) -> tuple[float, Float[np.ndarray, " settings"]]:
    """Return the logarithm of `force_sd`, and its derivatives in the logarithms of the settings.

    The variance is g C g with 1 / C = J J + 1 / prior; its derivative is -2 (J v) (J' v) with v = C g.
    """
    experiments = design.make_experiments(values, keep_phase=True)
    jacobian, *slopes = joint_jacobian(experiments, design.settings)
    root = covariance_factor(jacobian, joint_prior_factor(experiments))
    half = gradient @ root[: gradient.size]
    moved = root @ half
    variance = float(half @ half)
    slope = [-float((jacobian @ moved) @ (slope @ moved)) / variance for slope in slopes]
    return 0.5 * float(np.log(variance)), np.array(slope)


def _minimise(
    design: CandidateDesign, gradient: Gradient, start: Sequence[float], bounds: list[tuple[float, float]]
) -> tuple[float, tuple[float, ...]]:
    def objective(logs: np.ndarray) -> tuple[float, np.ndarray]:
        return log_force_sd_slope(design, np.exp(logs), gradient)

    end = scipy.optimize.minimize(objective, np.log(start), jac=True, method="L-BFGS-B", bounds=np.log(bounds))
    return float(np.exp(end.fun)), tuple(np.exp(end.x))
