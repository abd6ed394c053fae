"""The best values of a trial's settings: a coarse grid, and from its lowest points downhill by exact gradients."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.ndimage
import scipy.optimize
from jaxtyping import Float

from fitact.experiment.experiment import Trial, joint_jacobian, joint_prior
from fitact.experiment.fisher import covariance_root
from fitact.model.skin import has_time_constants

_POINTS = {1: 33, 2: 6}  # of the grid along each of so many settings; along more, 4
_STARTS = 3  # of its lowest points
_WORTH = 1e-3  # of the error: by so much, at least, it must fall for a setting to be moved


class Optimum(NamedTuple):
    """The best settings found, and the standard deviation of the log mean force on the way.

    Attributes:
        values: of the settings, SI.
        grid: along each setting.
        force_sd: at all combinations.
    """

    values: tuple[float, ...]
    grid: tuple[Float[np.ndarray, " points"], ...]
    force_sd: Float[np.ndarray, "*points"]


def optimise(trial: Trial, gradient: Float[np.ndarray, " parameters"]) -> Optimum:
    """The settings that tell most of a force, by its `gradient` in the logarithms of the free parameters.

    A skin without time constants has no derivatives in the settings here: the best of the grid is taken.
    """
    bounds = [(setting.low, setting.high) for setting in trial.settings]
    count = _POINTS.get(len(bounds), 4)
    grid = tuple(np.geomspace(*pair, count) for pair in bounds)
    points = list(itertools.product(*grid))
    coarse = np.array([force_sd(trial, point, gradient) for point in points])
    shape = (count,) * len(bounds)
    lowest = scipy.ndimage.minimum_filter(coarse.reshape(shape), 3, mode="nearest").ravel() == coarse
    order = [i for i in np.argsort(coarse) if lowest[i]][:_STARTS]
    found = [(coarse[i], points[i]) for i in order]
    if all(has_time_constants(e.circuit) for e in trial.experiments):
        found += [_downhill(trial, gradient, points[i], bounds) for i in order]
    best, values = min(found)
    if force_sd(trial, trial.starts, gradient) < (1.0 + _WORTH) * best:
        values = trial.starts
    if len({setting.field for setting in trial.settings}) == 1:  # of records alike but for it
        values = sorted(values)
    return Optimum(tuple(map(float, values)), grid, coarse.reshape(shape))


def force_sd(trial: Trial, values: Sequence[float], gradient: Float[np.ndarray, " parameters"]) -> float:
    """The standard deviation of the log mean force with the settings at `values`."""
    experiments = trial.at(values, in_step=True)
    root = covariance_root(joint_jacobian(experiments)[0], joint_prior(experiments))
    return float(np.linalg.norm(gradient @ root[: gradient.size]))


def log_force_sd_slope(
    trial: Trial, values: Sequence[float], gradient: Float[np.ndarray, " parameters"]
) -> tuple[float, Float[np.ndarray, " settings"]]:
    """The logarithm of `force_sd`, and its derivatives in the logarithms of the settings.

    The variance is g C g with 1 / C = J J + 1 / prior: its derivative is -2 (J v) (J' v) with v = C g.
    """
    experiments = trial.at(values, in_step=True)
    jacobian, *slopes = joint_jacobian(experiments, trial.settings)
    root = covariance_root(jacobian, joint_prior(experiments))
    half = gradient @ root[: gradient.size]
    moved = root @ half
    variance = float(half @ half)
    found = [-float((jacobian @ moved) @ (slope @ moved)) / variance for slope in slopes]
    return 0.5 * float(np.log(variance)), np.array(found)


def _downhill(
    trial: Trial, gradient: np.ndarray, start: Sequence[float], bounds: list[tuple[float, float]]
) -> tuple[float, tuple[float, ...]]:
    def objective(logs: np.ndarray) -> tuple[float, np.ndarray]:
        return log_force_sd_slope(trial, np.exp(logs), gradient)

    end = scipy.optimize.minimize(objective, np.log(start), jac=True, method="L-BFGS-B", bounds=np.log(bounds))
    return float(np.exp(end.fun)), tuple(np.exp(end.x))
