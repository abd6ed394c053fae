"""Optimization of a measurement's settings: a coarse grid, then descent."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.ndimage
import scipy.optimize
from jaxtyping import Float

from fitact.experiment.experiment import CandidateDesign, Gradient, joint_jacobian, joint_prior_factor
from fitact.experiment.fisher import covariance_factor


class Optimum(NamedTuple):
    """Best settings, and the standard deviation of the log mean force on the grid."""

    values: tuple[float, ...]  # of the settings, SI
    grid: tuple[Float[np.ndarray, " points"], ...]  # along each setting
    force_sd: Float[np.ndarray, "*points"]  # at all combinations


def optimise(design: CandidateDesign, gradient: Gradient, starts: int = 3, min_improvement: float = 1e-3) -> Optimum:
    """Find the settings with the smallest uncertainty of the mean force.

    The descent starts from the `starts` lowest points of the grid. A setting moves only if the uncertainty falls by
    the fraction `min_improvement`.
    """
    bounds = [(setting.low, setting.high) for setting in design.settings]
    count = {1: 33, 2: 6}.get(len(bounds), 4)  # grid points along each setting, by the number of settings
    grid = tuple(np.geomspace(*pair, count) for pair in bounds)
    points = list(itertools.product(*grid))
    coarse = np.array([force_sd(design, point, gradient) for point in points])
    shape = (count,) * len(bounds)
    lowest = scipy.ndimage.minimum_filter(coarse.reshape(shape), 3, mode="nearest").ravel() == coarse
    order = [i for i in np.argsort(coarse) if lowest[i]][:starts]

    def log_sd(logs: np.ndarray) -> float:
        return float(np.log(force_sd(design, np.exp(logs), gradient)))

    optima = [(np.log(coarse[i]), points[i]) for i in order]
    for i in order:
        end = scipy.optimize.minimize(log_sd, np.log(points[i]), method="L-BFGS-B", bounds=np.log(bounds))
        optima.append((end.fun, tuple(np.exp(end.x))))
    best, values = min(optima)
    if force_sd(design, design.start_values, gradient) < (1.0 + min_improvement) * np.exp(best):
        values = design.start_values
    if len({setting.field for setting in design.settings}) == 1:  # the records are interchangeable
        values = sorted(values)
    return Optimum(tuple(map(float, values)), grid, coarse.reshape(shape))


def force_sd(design: CandidateDesign, values: Sequence[float], gradient: Gradient) -> float:
    """Return the standard deviation of the log mean force with the settings at `values`."""
    experiments = design.make_experiments(values, keep_phase=True)
    root = covariance_factor(joint_jacobian(experiments), joint_prior_factor(experiments))
    return float(np.linalg.norm(gradient @ root[: gradient.size]))
