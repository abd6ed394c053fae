"""Kalman filter and smoother of a random walk that is observed as averages over windows, beside constants.

A window sees the average of the walk, not its value at one time. End, average and middle of a window are therefore
states of their own, whose joint distribution, given the end of the window before, is that of Brownian motion.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

# covariances of Brownian motion of rate 1 over a window of length 1: at its end, its average, at its middle
_WINDOW = np.array([[1.0, 1.0 / 2.0, 1.0 / 2.0], [1.0 / 2.0, 1.0 / 3.0, 3.0 / 8.0], [1.0 / 2.0, 3.0 / 8.0, 1.0 / 2.0]])


class WindowInformation(NamedTuple):
    """Information of windows: `factor @ (average of the walk, constants) ~ N(target, 1)`.

    A direction that a window does not see has a zero in the factor; a window without data has zeros only.
    """

    factor: Float[np.ndarray, "windows rows states"]
    target: Float[np.ndarray, "windows rows"]


class WindowTimes(NamedTuple):
    """Lengths of the windows and of the gaps before them, s, and additional variance where the walk may jump."""

    length: Float[np.ndarray, " windows"]
    gap: Float[np.ndarray, " windows"]
    jump_variance: Float[np.ndarray, " windows"]


class SmoothedWalk(NamedTuple):
    """Mean and covariance, given all windows, of the walk in the middle and on average, and of the constants."""

    middle: Float[np.ndarray, "windows states"]  # the walk in the middle of each window, then the constants
    average: Float[np.ndarray, "windows states"]
    covariance: Float[np.ndarray, "windows states states"]  # of `middle`
    filtered: Float[np.ndarray, "windows states"]  # of `middle`, given no later window


class _Pass(NamedTuple):
    filtered_mean: np.ndarray  # (windows, n)
    filtered_covariance: np.ndarray
    factor: np.ndarray  # rows of the observation in all states
    log_likelihood: np.ndarray  # (*batch)


def log_likelihood(
    information: WindowInformation,
    timing: WindowTimes,
    walk_covariance: Float[np.ndarray, "*batch walk walk"],
    prior: tuple[Float[np.ndarray, " states"], Float[np.ndarray, "states states"]],
) -> Float[np.ndarray, "*batch"]:
    """Return the log-likelihood of covariances of the walk per second, up to a constant."""
    return _filter(information, timing, walk_covariance, prior, keep=False).log_likelihood


def smooth(
    information: WindowInformation,
    timing: WindowTimes,
    walk_covariance: Float[np.ndarray, "walk walk"],
    prior: tuple[Float[np.ndarray, " states"], Float[np.ndarray, "states states"]],
) -> SmoothedWalk:
    """Return the smoothed walk; `prior` is the mean and covariance of the walk at the start and of the constants."""
    passed = _filter(information, timing, walk_covariance, prior, keep=True)
    count, size = passed.filtered_mean.shape
    walk = walk_covariance.shape[-1]
    transition = _transition(walk, size)
    middle = [*range(2 * walk, 3 * walk), *range(3 * walk, size)]
    average = [*range(walk, 2 * walk), *range(3 * walk, size)]
    identity, noise = np.eye(size), _walk_noise(walk_covariance, size)
    # what later windows tell, in information form, which sums without cancellation even where nothing is known
    M, m = np.zeros((size, size)), np.zeros(size)
    means, covariances = np.empty((count, size)), np.empty((count, size, size))
    for k in range(count - 1, -1, -1):
        x, P, H = passed.filtered_mean[k], passed.filtered_covariance[k], passed.factor[k]
        V = np.linalg.solve(identity + P @ M, P)
        covariances[k] = 0.5 * (V + V.T)
        means[k] = x + covariances[k] @ (m - M @ x)
        known, toward = H.T @ H + M, H.T @ information.target[k] + m
        through = np.linalg.solve(identity + known @ noise(timing, k), np.column_stack([known, toward]))
        M, m = transition.T @ through[:, :size] @ transition, transition.T @ through[:, size]
        M = 0.5 * (M + M.T)
    covariance = covariances[:, middle][:, :, middle]
    return SmoothedWalk(means[:, middle], means[:, average], covariance, passed.filtered_mean[:, middle])


def find_jumps(
    information: WindowInformation,
    has_data: Bool[np.ndarray, " windows"],
    contact: Bool[np.ndarray, " windows"],
    to_walks: Float[np.ndarray, "walks parameters"],
    ratio: float = 12.0,
    min_errors: float = 5.0,
) -> Bool[np.ndarray, " windows"]:
    """Return the windows before which a walk changes by far more than elsewhere, and by more than its errors.

    The changes from one window with data to the next are compared with their median. A new contact is no jump.
    """
    count, size = len(information.factor), to_walks.shape[1]
    states, errors = np.zeros((count, size)), np.zeros((count, len(to_walks)))
    for k in np.flatnonzero(has_data).tolist():
        factor = information.factor[k]
        covariance = np.linalg.pinv(factor.T @ factor, rcond=1e-12, hermitian=True)
        states[k] = (covariance @ factor.T @ information.target[k])[:size]
        errors[k] = np.sqrt(np.einsum("ij,jk,ik->i", to_walks, covariance[:size, :size], to_walks))
    changes, limits, last = np.zeros(errors.shape), np.zeros(errors.shape), -1
    for k in np.flatnonzero(has_data).tolist():
        if last >= 0 and contact[last:k].all():
            changes[k] = np.abs(to_walks @ (states[k] - states[last])) / np.sqrt(k - last)
            limits[k] = min_errors * np.hypot(errors[k], errors[last])
        last = k
    followed = limits.any(axis=1)
    if np.count_nonzero(followed) < 4:
        return np.zeros(count, bool)
    usual = np.median(changes[followed], axis=0)
    return np.any(changes > np.maximum(ratio * usual, limits), axis=1) & followed


def _transition(walk: int, size: int) -> np.ndarray:
    """Return the matrix from the states of one window to the mean of those of the next: all begin at its end."""
    matrix = np.eye(size)
    matrix[: 3 * walk, : 3 * walk] = np.kron(np.array([[1.0, 0.0, 0.0]] * 3), np.eye(walk))
    return matrix


def _walk_noise(walk_covariance: np.ndarray, size: int) -> Callable[[WindowTimes, int], np.ndarray]:
    """Return the covariance that a window, with the gap and the jump before it, adds to all states, as a function."""
    walk, batch = walk_covariance.shape[-1], walk_covariance.shape[:-2]

    def expand(times: np.ndarray, covariance: np.ndarray) -> np.ndarray:
        whole = np.zeros((*batch, size, size))
        whole[..., : 3 * walk, : 3 * walk] = np.kron(times, covariance)
        return whole

    everywhere = np.ones((3, 3))
    within, gap = expand(_WINDOW, walk_covariance), expand(everywhere, walk_covariance)
    jump = expand(everywhere, np.eye(walk))
    return lambda timing, k: timing.length[k] * within + timing.gap[k] * gap + timing.jump_variance[k] * jump


def _filter(
    information: WindowInformation, timing: WindowTimes, walk_covariance: np.ndarray, prior: tuple, keep: bool
) -> _Pass:
    mean, covariance = prior
    walk, batch = walk_covariance.shape[-1], walk_covariance.shape[:-2]
    constants, size = mean.size - walk, mean.size + 2 * walk
    transition = _transition(walk, size)
    # the start lies in the place of an end before the first window
    places = [*range(walk), *range(3 * walk, size)]
    x, P = np.zeros((*batch, size)), np.zeros((*batch, size, size))
    x[..., places] = mean
    P[..., np.array(places)[:, None], places] = covariance
    factor = np.zeros((*information.factor.shape[:2], size))
    factor[..., walk : 2 * walk] = information.factor[..., :walk]
    if constants:
        factor[..., 3 * walk :] = information.factor[..., walk:]
    noise = _walk_noise(walk_covariance, size)
    total, kept = np.zeros(batch), []
    identity = np.eye(information.factor.shape[1])
    for k, H in enumerate(factor):
        x, P = x @ transition.T, transition @ P @ transition.T + noise(timing, k)
        cross = P @ H.T
        F = np.linalg.inv(H @ cross + identity)
        v = information.target[k] - x @ H.T
        gain = cross @ F
        total = total - 0.5 * np.einsum("...i,...ij,...j->...", v, F, v) + 0.5 * np.linalg.slogdet(F)[1]
        x = x + np.einsum("...ij,...j->...i", gain, v)
        reduced = np.eye(size) - gain @ H  # Joseph's form keeps the covariance positive
        P = reduced @ P @ np.swapaxes(reduced, -1, -2) + gain @ np.swapaxes(gain, -1, -2)
        if keep:
            kept.append((x, P))
    means, covariances = map(np.array, zip(*kept, strict=True)) if keep else (np.empty(0), np.empty(0))
    return _Pass(means, covariances, factor, total)
