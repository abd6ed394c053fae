"""Posteriors sampled together, known normals of different widths and centers: accurate to 1 %, and independent."""

import numpy as np

from fitact.batch.metropolis import GaussianApproximations, sample_posteriors

COUNT, SIZE, STEPS, BURN = 48, 3, 800, 200
SCALES = 10.0 ** np.resize([0.0, 2.0, -1.0], COUNT)  # scales of neighbouring targets


def targets() -> tuple[np.ndarray, np.ndarray]:
    """Return centers and covariances."""
    rng = np.random.default_rng(5)
    centers = 30.0 * SCALES[:, None] * rng.standard_normal((COUNT, SIZE))
    mixed = np.eye(SIZE) + 0.5 * rng.standard_normal((COUNT, SIZE, SIZE))
    return centers, SCALES[:, None, None] ** 2 * mixed @ np.swapaxes(mixed, 1, 2)


def whitened(seeds: range) -> np.ndarray:
    """Return draws in standard deviations of each normal, shape (posteriors, ensembles, steps, walkers, n).

    The initial approximations are wrong by half a standard deviation in the center and by a fifth in width.
    """
    centers, covariances = (each[seeds] for each in targets())
    precisions, roots = np.linalg.inv(covariances), np.linalg.cholesky(covariances)

    def log_probs(points: np.ndarray) -> np.ndarray:
        off = points - centers[:, None]
        return -0.5 * np.einsum("kni,kij,knj->kn", off, precisions, off)

    near = GaussianApproximations.from_covariance_factors(centers + 0.5 * roots.sum(axis=2), 1.2 * roots)
    drawn = sample_posteriors(log_probs, near, STEPS, [[n] for n in seeds]).points
    return np.einsum("kij,keswj->keswi", np.linalg.inv(roots), drawn - centers[:, None, None, None])


def off_by(white: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return errors of means and second moments of standard normals, and their standard errors over the ensembles."""
    kept = white[:, :, BURN:].reshape(white.shape[0] * white.shape[1], -1, SIZE)
    second = np.einsum("eni,enj->eij", kept, kept) / kept.shape[1] - np.eye(SIZE)
    each = np.concatenate([kept.mean(axis=1), second.reshape(len(kept), -1)], axis=1)
    return each.mean(axis=0), each.std(axis=0) / np.sqrt(len(each))


def test_draws_are_those_of_known_normals():
    """The 192 ensembles are independent, so their scatter gives the standard error."""
    off, error = off_by(whitened(range(COUNT)))
    assert np.all(error < 0.0075)
    assert np.all(np.abs(off) < 0.01)


def test_draws_do_not_depend_on_neighbours():
    np.testing.assert_allclose(whitened(range(4, 6)), whitened(range(3, 8))[1:3], rtol=1e-9, atol=1e-12)
