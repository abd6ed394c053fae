"""Sums of squares that added regressors explain, against least squares with and without them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fitact.fitting.score_test import explained_squares, orthonormalise

RANDOM = np.random.default_rng(0)
RESIDUALS, FITTED = RANDOM.standard_normal(50), RANDOM.standard_normal((4, 50))
NEARLY = FITTED[1] + 1e-6 * RANDOM.standard_normal(50)  # hardly another than what is fitted
CANDIDATES = {
    "one": RANDOM.standard_normal((1, 50)),
    "two": RANDOM.standard_normal((2, 50)),
    "zero": np.zeros((1, 50)),
    "fitted": FITTED[:1] + FITTED[2:3],
    "dependent": RANDOM.standard_normal((1, 50)) * [[1.0], [-2.0]],
    "nearly": NEARLY[None],
}


def sum_of_squares(rows: np.ndarray) -> float:
    """Return the residual sum of squares beside rows, by LAPACK's singular values."""
    left = RESIDUALS - np.linalg.lstsq(rows.T, RESIDUALS, rcond=1e-12)[0] @ rows
    return float(left @ left)


@pytest.mark.parametrize("fitted", [FITTED, np.zeros((0, 50)), np.array([*FITTED, FITTED[0], np.zeros(50)])])
def test_explained_squares_are_differences_of_sums_of_squares(fitted: np.ndarray):
    explained = explained_squares(RESIDUALS, fitted, CANDIDATES)
    for name, rows in CANDIDATES.items():
        expected = sum_of_squares(fitted) - sum_of_squares(np.concatenate([fitted, rows]))
        assert explained[name] == pytest.approx(expected, rel=1e-9, abs=1e-9), name


def test_a_program_gives_the_same():
    with jax.enable_x64(True):
        found = jax.jit(explained_squares)(jnp.array(RESIDUALS), FITTED, CANDIDATES)
    expected = explained_squares(RESIDUALS, FITTED, CANDIDATES)
    np.testing.assert_allclose([found[name] for name in CANDIDATES], list(expected.values()), rtol=1e-9, atol=1e-9)


def test_nearly_dependent_rows_become_orthonormal():
    basis = orthonormalise(np.array([*FITTED, NEARLY]))
    np.testing.assert_allclose(basis @ basis.T, np.eye(5), atol=1e-14)
