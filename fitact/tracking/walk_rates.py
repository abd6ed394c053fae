"""How fast the finger changes: rates of independent random walks in the contact area and in the skin per area.

The walks are in log(Ci), which follows the contact area, in log(Rsc Ci), the resistance of the skin times the area, and
in log(Csc / Ci), its capacitance over the area. Vsc sees the last two alone.
"""

import math
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float

from fitact.model.circuit import FINGER_PARAMETERS
from fitact.tracking.random_walk import WindowInformation, WindowTimes, log_likelihood

WALKS = {  # name of a walk -> its powers of the parameters
    "contact_area": {"Ci": 1.0},
    "skin_resistivity": {"Rsc": 1.0, "Ci": 1.0},
    "skin_capacitance_per_area": {"Csc": 1.0, "Ci": -1.0},
}


class WalkRates(NamedTuple):
    """Rates of the walks: the standard deviation of the logarithm after 1 s."""

    names: tuple[str, ...]
    to_walks: Float[np.ndarray, "walks parameters"]  # from the logarithms of the parameters
    rate: Float[np.ndarray, " walks"]  # posterior means
    lower: Float[np.ndarray, " walks"]  # 95 %, from the likelihood; 0 where it does not exclude that nothing changes
    upper: Float[np.ndarray, " walks"]

    @property
    def covariance(self) -> Float[np.ndarray, "parameters parameters"]:
        """Covariance of the parameters' logarithms after 1 s."""
        return walk_covariance(self.to_walks, self.rate)


def walk_matrix(parameters: tuple[str, ...]) -> tuple[tuple[str, ...], Float[np.ndarray, "walks parameters"]]:
    """Return names and matrix of the walks of these parameters; each walks by itself if not all three are free."""
    if set(parameters) != set(FINGER_PARAMETERS):
        return parameters, np.eye(len(parameters))
    return tuple(WALKS), np.array([[powers.get(name, 0.0) for name in parameters] for powers in WALKS.values()])


def walk_covariance(to_walks: np.ndarray, rate: Float[np.ndarray, "*batch walks"]) -> np.ndarray:
    """Return the covariance of the parameters' logarithms per second."""
    back = np.linalg.inv(to_walks)
    return (back * np.square(rate)[..., None, :]) @ back.T


def estimate_rates(
    information: WindowInformation,
    timing: WindowTimes,
    prior: tuple[np.ndarray, np.ndarray],
    parameters: tuple[str, ...],
    *,
    prior_rate: float = 0.1,
    sweeps: int = 5,
    points: int = 11,
) -> WalkRates:
    """Estimate the rates from the windows, with half-normal priors of scale `prior_rate` (1 per root of a second).

    The default allows a contact area that grows by half in 20 s, the time in which the contact of a finger with glass
    settles (Dzidek et al., PNAS 114 (2017) 10864). Where the windows do not see a walk, as the contact area by Vsc
    alone, its rate is that of the prior.
    """
    names, to_walks = walk_matrix(parameters)
    size, low, high = len(names), math.log(1e-6), math.log(1.0)
    centers, half = np.full(size, math.log(prior_rate) - 1.5), np.full(size, 0.5 * (high - low))
    rate = lower = upper = np.zeros(size)
    for _ in range(sweeps):
        grid = np.clip(centers[:, None] + half[:, None] * np.linspace(-1.0, 1.0, points), low, high)
        grid = np.concatenate([grid, np.full((size, 1), -np.inf)], axis=1)  # and one that does not change
        candidates = np.tile(np.exp(centers), (size, points + 1, 1))
        for i in range(size):
            candidates[i, :, i] = np.exp(grid[i])
        covariances = walk_covariance(to_walks, candidates.reshape(-1, size))
        logs = log_likelihood(information, timing, covariances, prior).reshape(size, points + 1)
        rates = np.exp(grid)
        within = logs > np.max(logs, axis=1, keepdims=True) - 1.92  # half of the 95 % quantile of chi-squared
        bounds = scipy.ndimage.binary_dilation(within[:, :-1], [[1, 1, 1]])  # and the next point on either side
        lower = np.where(within[:, -1], 0.0, np.min(np.where(bounds, rates[:, :-1], np.inf), axis=1))
        upper = np.max(np.where(bounds, rates[:, :-1], 0.0), axis=1)
        posterior = (logs - 0.5 * np.square(rates / prior_rate))[:, :-1] + grid[:, :-1]  # per log(rate)
        weight = np.exp(posterior - np.max(posterior, axis=1, keepdims=True))
        mean = np.sum(weight * rates[:, :-1], axis=1) / np.sum(weight, axis=1)
        spread = np.sqrt(np.sum(weight * np.square(grid[:, :-1] - np.log(mean)[:, None]), axis=1) / weight.sum(axis=1))
        rate, centers = mean, np.log(mean)
        is_inside = np.argmax(posterior, axis=1) % (points - 1) > 0
        half = np.where(is_inside, np.clip(4.0 * spread, 4.0 * half / (points - 1), half), half)
    return WalkRates(names, to_walks, rate, lower, upper)
