"""Posteriors by direct quadrature on a grid, with models in NumPy that share no code with fitact."""

import math
from collections.abc import Callable, Sequence

import numpy as np
import scipy.interpolate

import fitact

PROBABILITIES = np.array([0.05, 0.25, 0.5, 0.75, 0.95])
# The fraction of draws below a quantile has a binomial standard error. With 9,000 effective draws (a posterior keeps
# 10,000), four of them are 0.05 posterior sd at the median of a normal density and 0.09 sd at its quantile of 5 %.
QUANTILE_TOLERANCE = 4.0  # standard errors
LEAST_DRAWS = 9_000  # effective draws, of which a posterior must have more
LOG_DENSITY_TOLERANCE = 0.01

RSC, CSC, CI, STEP = 130e3, 18e-9, 1.35e-9, 10e-6
Z95 = 1.959963984540054

LogDensity = Callable[..., np.ndarray]


def integrate(
    log_density: LogDensity, box: Sequence[tuple[float, float]], counts: Sequence[int], rounds: int = 4
) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """Return the midpoints of a grid in `box`, as arrays that broadcast, and the probability of each cell.

    Between rounds, the box shrinks to the cells whose log-density is within 20 of the largest, and one more.
    """
    for _ in range(rounds):
        edges = [np.linspace(*ends, count + 1) for ends, count in zip(box, counts, strict=True)]
        mesh = np.ix_(*(0.5 * (e[1:] + e[:-1]) for e in edges))
        values = log_density(*mesh)
        likely, box = values > values.max() - 20.0, []
        for i, edge in enumerate(edges):
            kept = np.flatnonzero(likely.any(axis=tuple(j for j in range(len(edges)) if j != i)))
            box.append((edge[max(kept[0] - 1, 0)], edge[min(kept[-1] + 2, edge.size - 1)]))
    weights = np.exp(values - values.max())
    return mesh, weights / weights.sum()


def quantiles(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the quantiles of weighted values at `PROBABILITIES`."""
    distinct, cell = np.unique(np.broadcast_to(values, weights.shape), return_inverse=True)
    masses = np.bincount(cell.ravel(), weights.ravel())
    if distinct.size > 1000:  # a function of several coordinates
        return np.interp(PROBABILITIES, np.cumsum(masses) - 0.5 * masses, distinct)
    edges = np.interp(np.arange(distinct.size + 1) - 0.5, np.arange(distinct.size), distinct)
    edges[[0, -1]] = 1.5 * distinct[[0, -1]] - 0.5 * distinct[[1, -2]]
    total = scipy.interpolate.PchipInterpolator(edges, np.append(0.0, np.cumsum(masses)))
    fine = np.linspace(edges[0], edges[-1], 20_001)
    return np.interp(PROBABILITIES, total(fine), fine)


def assert_quantiles(posterior: fitact.Posterior, weights: np.ndarray, **expected: np.ndarray) -> None:
    """Assert that the quantiles of logarithms of parameters or of b, or of delays in steps, are those expected."""
    convergence, draws = posterior.convergence, posterior.parameters()
    assert convergence.converged
    logs = {
        name: values.ravel() / STEP if name == "delay" else np.log(values.ravel()) for name, values in draws.items()
    }
    if "b" in expected:
        logs["b"] = logs["Rsc"] + np.log(2.0 * CI + np.exp(logs["Csc"]))
    for name, values in expected.items():
        # b of all draws is more accurate than b of the few walkers whose derived quantities are diagnosed
        effective = min(convergence.ess["Rsc" if name == "b" else name], logs[name].size)
        assert effective > LEAST_DRAWS
        below = np.mean(logs[name][:, None] <= quantiles(values, weights), axis=0)
        errors = (below - PROBABILITIES) / np.sqrt(PROBABILITIES * (1.0 - PROBABILITIES) / effective)
        assert np.max(np.abs(errors)) < QUANTILE_TOLERANCE, (name, errors)


def assert_log_density(posterior: fitact.Posterior, log_density: LogDensity, count: int = 200) -> None:
    """Assert that the log-densities of draws differ from `log_density` of (theta, log sigma) by a constant only."""
    points, values = posterior.points.reshape(-1, posterior.points.shape[-1]), posterior.log_prob.ravel()
    some = np.linspace(0, len(points) - 1, count).astype(int)
    differences = values[some] - np.array([log_density(*point) for point in points[some]])
    assert np.ptp(values[some]) > 5.0  # the draws reach the flanks of the density
    np.testing.assert_allclose(differences, np.median(differences), rtol=0.0, atol=LOG_DENSITY_TOLERANCE)


def normal(u: np.ndarray, mean: float, sd: float) -> np.ndarray:
    """Return the logarithm of a normal density, up to a constant."""
    return -0.5 * np.square((u - mean) / sd)


def default_prior(log_Rsc: np.ndarray, log_Csc: np.ndarray) -> np.ndarray:
    """Return the log-density of the default priors: 95 % within factors of 50 and 20 of the reference paper's skin."""
    return log_Rsc_prior(log_Rsc) + log_Csc_prior(log_Csc)


def log_Rsc_prior(u: np.ndarray) -> np.ndarray:
    """Return the log-density of the default prior of Rsc."""
    return normal(u, math.log(160e3), math.log(50.0) / Z95)


def log_Csc_prior(u: np.ndarray) -> np.ndarray:
    """Return the log-density of the default prior of Csc."""
    return normal(u, math.log(22e-9), math.log(20.0) / Z95)


def gaussian(squares: np.ndarray, count: float, log_sigma: float | None = None) -> np.ndarray:
    """Return the log-likelihood of a sum of squared residuals of white Gaussian noise.

    Without `log_sigma`, the noise is integrated out: the integral of s^-n exp(-S / (2 s^2)) over log s is proportional
    to S^(-n / 2).
    """
    if log_sigma is None:
        return -0.5 * count * np.log(squares)
    return -0.5 * squares * np.exp(-2.0 * log_sigma) - count * log_sigma


def square_response(time: np.ndarray, b: np.ndarray, half: float = 5e-3) -> np.ndarray:
    """Return the steady-state response of s b / (1 + s b) to 360 Vpp with ideal edges at multiples of `half` (s)."""
    number = np.floor(time / half + 1e-9)
    decays = np.exp(-(time - number * half) / b) / (1.0 + np.exp(-half / b))
    return np.where(number % 2 == 0, 360.0, -360.0) * decays


def square_vsc(time: np.ndarray, log_Rsc: float, log_Csc: float, half: float = 5e-3) -> np.ndarray:
    """Return the skin voltage, in V, for the same drive."""
    total = 2.0 * CI + np.exp(log_Csc)
    return CI / total * square_response(time, np.exp(log_Rsc) * total, half)
