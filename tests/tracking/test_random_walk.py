"""The filter and smoother against the joint normal distribution of a finely sampled Brownian motion."""

import numpy as np
import pytest

from fitact.tracking.random_walk import SmoothedWalk, WindowInformation, WindowTimes, find_jumps, log_likelihood, smooth

WINDOWS, FINE, LENGTH, GAP = 24, 60, 0.5, 0.7
WALK = np.array([[0.04, 0.01], [0.01, 0.09]])  # covariance per second
PRIOR = np.array([0.1, -0.2, 0.3]), np.diag([1.0, 0.5, 2.0])
GAP_BEFORE, LOST = 15, slice(6, 10)


class Case:
    """Windows that see averages of a walk with two components, and a constant; some see nothing."""

    def __init__(self) -> None:
        rng = np.random.default_rng(3)  # any seed gives a valid case, since the comparison is exact
        self.factor = 20.0 * rng.standard_normal((WINDOWS, 3, 3))
        self.factor[LOST] = 0.0
        self.factor[3, :, 0] = 0.0  # a window that is blind to one component
        self.target = rng.standard_normal((WINDOWS, 3)) * (np.abs(self.factor).sum(axis=2) > 0.0)
        gap = np.zeros(WINDOWS)
        gap[GAP_BEFORE] = GAP
        self.timing = WindowTimes(np.full(WINDOWS, LENGTH), gap, np.zeros(WINDOWS))
        self.information = WindowInformation(self.factor, self.target)

    def exact(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Return mean and covariance of (averages, middles, constant), and the log-likelihood."""
        step = LENGTH / FINE
        starts = LENGTH * np.arange(WINDOWS) + np.cumsum(self.timing.gap)
        inside = (starts[:, None] + step * (np.arange(FINE) + 0.5)).ravel()  # midpoints: the average to second order
        middles = starts + 0.5 * LENGTH
        times = np.concatenate([inside, middles])
        brownian = np.minimum.outer(times, times)
        to_averages = np.kron(np.eye(WINDOWS), np.full((1, FINE), 1.0 / FINE))
        select = np.block([
            [to_averages, np.zeros((WINDOWS, WINDOWS))],
            [np.zeros((WINDOWS, inside.size)), np.eye(WINDOWS)],
        ])  # fmt: skip
        kernel = select @ brownian @ select.T
        size = 4 * WINDOWS + 1
        covariance, mean = np.zeros((size, size)), np.append(np.tile(PRIOR[0][:2], 2 * WINDOWS), PRIOR[0][2])
        covariance[:-1, :-1] = np.kron(kernel, WALK) + np.kron(np.ones((2 * WINDOWS, 2 * WINDOWS)), PRIOR[1][:2, :2])
        covariance[-1, -1] = PRIOR[1][2, 2]
        H = np.zeros((3 * WINDOWS, size))
        for k in range(WINDOWS):
            H[3 * k : 3 * k + 3, 2 * k : 2 * k + 2] = self.factor[k, :, :2]
            H[3 * k : 3 * k + 3, -1] = self.factor[k, :, 2]
        z, S = self.target.ravel() - H @ mean, H @ covariance @ H.T + np.eye(3 * WINDOWS)
        gain = np.linalg.solve(S, H @ covariance).T
        likelihood = -0.5 * (z @ np.linalg.solve(S, z) + np.linalg.slogdet(S)[1])
        return mean + gain @ z, covariance - gain @ H @ covariance, float(likelihood)


@pytest.fixture(scope="module")
def case() -> Case:
    return Case()


@pytest.fixture(scope="module")
def smoothed(case: Case) -> SmoothedWalk:
    return smooth(case.information, case.timing, WALK, PRIOR)


def test_smoothed_values_are_those_of_the_joint_distribution(case: Case, smoothed: SmoothedWalk):
    mean, covariance, _ = case.exact()
    averages, middles = mean[:-1].reshape(2, WINDOWS, 2)
    # the sum over the fine grid leaves an error of its step squared
    np.testing.assert_allclose(smoothed.average[:, :2], averages, atol=2e-4)
    np.testing.assert_allclose(smoothed.middle[:, :2], middles, atol=2e-3)
    np.testing.assert_allclose(smoothed.middle[:, 2], mean[-1], atol=2e-4)
    exact = np.diag(covariance)[2 * WINDOWS : -1].reshape(WINDOWS, 2)
    found = np.diagonal(smoothed.covariance, axis1=1, axis2=2)[:, :2]
    np.testing.assert_allclose(found, exact, rtol=5e-3)
    np.testing.assert_allclose(smoothed.covariance[:, 2, 2], covariance[-1, -1], rtol=1e-3)


def test_log_likelihood_of_several_rates(case: Case):
    *_, exact = case.exact()
    found = log_likelihood(case.information, case.timing, np.stack([WALK, 0.01 * WALK]), PRIOR)
    assert found[0] == pytest.approx(exact, abs=1e-2)
    alone = log_likelihood(case.information, case.timing, 0.01 * WALK, PRIOR)
    assert found[1] == pytest.approx(float(alone), rel=1e-9)


def test_lost_windows_are_bridged_with_growing_uncertainty(smoothed: SmoothedWalk):
    variance = smoothed.covariance[:, 0, 0]
    first, middle, last = variance[LOST.start - 1], variance[LOST].max(), variance[LOST.stop]
    assert middle > 3.0 * max(first, last)
    assert np.all(np.diff(variance[LOST.start - 1 : LOST.start + 2]) > 0.0)


def test_last_filtered_value_is_the_smoothed_one(smoothed: SmoothedWalk):
    np.testing.assert_allclose(smoothed.filtered[-1], smoothed.middle[-1], rtol=1e-9)


def test_walk_of_rate_zero_is_a_constant(case: Case):
    walk = smooth(case.information, case.timing, np.zeros((2, 2)), PRIOR)
    assert np.ptp(walk.middle, axis=0) == pytest.approx(0.0, abs=1e-9)
    H, z = case.factor.reshape(-1, 3), case.target.ravel()
    precision = H.T @ H + np.linalg.inv(PRIOR[1])
    expected = np.linalg.solve(precision, H.T @ z + np.linalg.solve(PRIOR[1], PRIOR[0]))
    np.testing.assert_allclose(walk.middle[0], expected, rtol=1e-8)
    np.testing.assert_allclose(walk.covariance[5], np.linalg.inv(precision), rtol=1e-6)


def test_a_jump_is_found_where_it_is_and_a_new_contact_is_none():
    rng = np.random.default_rng(0)  # jumps of 60 standard deviations, whatever the noise
    states = 0.01 * np.cumsum(rng.standard_normal((40, 2)), axis=0)
    states[25:, 0] += 0.6
    factor = np.tile(100.0 * np.eye(2), (40, 1, 1))
    information = WindowInformation(factor, np.einsum("kij,kj->ki", factor, states))
    everywhere = np.ones(40, bool)
    assert np.flatnonzero(find_jumps(information, everywhere, everywhere, np.eye(2))).tolist() == [25]
    contact = everywhere.copy()
    contact[23:25] = False
    assert not find_jumps(information, contact, contact, np.eye(2)).any()
