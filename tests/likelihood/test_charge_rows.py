"""Rows of charge against exact integrals, dense covariances, and simulated noise of V and I."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fitact.likelihood.charge_rows import (
    LAG,
    ChargeRows,
    RowCovariance,
    estimate_current_noise,
    mean_filter,
    step_means,
    whiten_rows,
)

STEP = 1e-5


def tone(time: np.ndarray) -> np.ndarray:
    return np.sin(2.0 * np.pi * 3e3 * time + 0.3) + 0.2 * np.cos(2.0 * np.pi * 7e3 * time)


def integral(time: np.ndarray) -> np.ndarray:
    return -np.cos(2.0 * np.pi * 3e3 * time + 0.3) / (2.0 * np.pi * 3e3) + 0.2 * np.sin(2.0 * np.pi * 7e3 * time) / (
        2.0 * np.pi * 7e3
    )


@pytest.mark.parametrize("delay", [0.0, 0.37, -1.6, 2.4])
def test_means_are_those_of_the_integral(delay: float):
    samples = np.arange(60, 90)
    begin, end = (samples + delay) * STEP, (samples + 1 + delay) * STEP
    exact = (integral(end) - integral(begin)) / STEP
    means = step_means(tone(STEP * np.arange(150)), delay)[samples + LAG]
    np.testing.assert_allclose(means, exact, atol=2e-5)


def test_compiled_means_are_the_same():
    values = tone(STEP * np.arange(100))
    rows = ChargeRows(*np.zeros((6, 100)))
    with jax.enable_x64(True):
        means = rows.means(jnp.pad(jnp.asarray(values), (rows.reach, 0)))
    np.testing.assert_allclose(means[2 * LAG :], step_means(values)[2 * LAG :], rtol=1e-12, atol=1e-14)


def test_whitening_is_that_of_the_dense_covariance():
    rng = np.random.default_rng(1)
    variance, neighbours = rng.uniform(3.0, 5.0, 40), rng.uniform(-1.5, 0.5, 40)
    excluded = np.isin(np.arange(40), [0, 1, 17, 18, 30])
    covariance = RowCovariance(variance, neighbours, excluded)
    used = np.flatnonzero(~excluded)
    dense = np.diag(variance) + np.diag(neighbours[1:], 1) + np.diag(neighbours[1:], -1)
    dense = dense[np.ix_(used, used)]
    rows = rng.standard_normal((3, 40))
    expected = np.linalg.solve(np.linalg.cholesky(dense), rows[:, used].T).T
    gain, decay = covariance.recursion(2.0)
    np.testing.assert_allclose(whiten_rows(gain, decay, rows)[:, used], 2.0 * expected, rtol=1e-12)
    assert np.all(whiten_rows(gain, decay, rows)[:, excluded] == 0.0)
    with jax.enable_x64(True):
        compiled = ChargeRows(*np.zeros((3, 40)), gain, decay, covariance.used * 1.0).whiten(jnp.asarray(rows))
    np.testing.assert_allclose(compiled[:, used], 2.0 * expected, rtol=1e-12)
    np.testing.assert_allclose(covariance.solve(rows[0])[used], np.linalg.solve(dense, rows[0, used]), rtol=1e-12)


@pytest.mark.parametrize("delay", [0.0, 0.37])
def test_the_noise_of_I_is_that_of_the_dense_conditional_mean(delay: float):
    """E[e | r] = Cov(e, r) Cov(r)^-1 r, where e is white and rows are means of e and something else."""
    rng, size, sd = np.random.default_rng(3), 60, 2.0
    variance, neighbours = rng.uniform(30.0, 50.0, size), rng.uniform(-15.0, 5.0, size)
    excluded = np.isin(np.arange(size), [*range(2 * LAG), 30])
    covariance = RowCovariance(variance, neighbours, excluded)
    gain, decay = covariance.recursion(sd)
    used = np.flatnonzero(~excluded)
    residuals = rng.standard_normal(size)
    means = step_means(np.eye(size), delay).T  # rows by samples
    dense = np.diag(variance) + np.diag(neighbours[1:], 1) + np.diag(neighbours[1:], -1)
    expected = sd**2 * means[used].T @ np.linalg.solve(dense[np.ix_(used, used)], residuals[used])
    white = covariance.used * whiten_rows(gain, decay, residuals)
    found = estimate_current_noise(gain, decay, white, *mean_filter(delay))
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


def test_rows_of_a_run_count_as_their_mean():
    rng = np.random.default_rng(2)
    variance, neighbours = rng.uniform(3.0, 5.0, 30), rng.uniform(-1.5, 0.5, 30)
    excluded, common, numbers = np.isin(np.arange(30), [0, 1, 20]), np.zeros(30), np.zeros(30, int)
    common[5:12], common[12:15], common[18:23] = 0.7, 0.4, 0.2
    numbers[5:12], numbers[12:15], numbers[18:23] = 1, 2, 3
    covariance = RowCovariance(variance, neighbours, excluded, numbers, common)
    groups = [[k] for k in range(2, 5)] + [list(range(5, 12)), list(range(12, 15))] + [[k] for k in range(15, 18)]
    groups += [[18, 19], [21, 22]] + [[k] for k in range(23, 30)]
    mean = np.zeros((len(groups), 30))
    for i, group in enumerate(groups):
        mean[i, group] = 1.0 / len(group)
    dense = np.diag(variance) + np.diag(neighbours[1:], 1) + np.diag(neighbours[1:], -1)
    dense[20], dense[:, 20] = 0.0, 0.0
    dense = mean @ dense @ mean.T + np.diag([common[group[0]] for group in groups])
    rows, last = rng.standard_normal((3, 30)), [group[-1] for group in groups]
    assert np.flatnonzero(covariance.used).tolist() == last
    gain, decay = covariance.recursion(2.0)
    expected = np.linalg.solve(np.linalg.cholesky(dense), mean @ rows.T).T
    np.testing.assert_allclose(whiten_rows(gain, decay, rows)[:, last], 2.0 * expected, rtol=1e-12)
    solved = mean.T @ np.linalg.solve(dense, mean @ rows[0])
    np.testing.assert_allclose(covariance.solve(rows[0]), solved, rtol=1e-12, atol=1e-15)
