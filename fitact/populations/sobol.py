"""Sobol indices of a quantity of the next finger, from a polynomial surrogate with a cross-validated error."""

import functools
import itertools
import math
from collections.abc import Callable
from typing import NamedTuple, Self

import numpy as np
import scipy
from jaxtyping import Float, Int

from fitact.populations.next_finger import NewFingerModel

SobolIndices = dict[str, dict[str, dict[str, float]]]
Factors = Float[np.ndarray, "points factors"]
Quantities = Float[np.ndarray, "points quantities"]
Terms = Float[np.ndarray, "points terms"]


class Surrogate(NamedTuple):
    """Logarithms of quantities as Hermite polynomials of the whitened factors, by least squares."""

    mean: Float[np.ndarray, " factors"]
    covariance_factor: Float[np.ndarray, "factors factors"]  # root of the covariance of the factors
    tail_scale: float  # width of the evaluated points over the factors'; the largest values lie in the tails
    powers: Int[np.ndarray, "terms factors"]
    coefficients: Float[np.ndarray, "terms quantities"]
    log_range: Float[np.ndarray, "2 quantities"]  # smallest and largest logarithm of the evaluated model
    # sqrt(1 - r^2) of each quantity, where r is its correlation with the model at held-out points
    cross_validation_error: Float[np.ndarray, " quantities"]
    evaluations: int  # of the model

    @classmethod
    def from_model(cls, finger: NewFingerModel, factors: Factors, names: tuple[str, ...]) -> Self:
        """Fit the lowest degree within the tolerance at held-out points, or else the best one."""
        tail_scale, tolerance = 1.25, 5e-3  # largest cross-validation error, far below the error of the Sobol sequence
        evaluations_per_term = 4  # smallest ratio of evaluations to terms; with fewer, the tails diverge
        size = factors.shape[1]
        mean, covariance_factor = factors.mean(axis=0), np.linalg.cholesky(np.cov(factors.T))
        count = 4096 * (size + 2) * size // 100  # a hundredth of the evaluations in `sobol_indices`
        z = _to_normal(scipy.stats.qmc.Halton(size, rng=np.random.default_rng(0)).random(count))
        points = mean + tail_scale * z @ covariance_factor.T
        logs = np.log(finger.evaluate(points)[:, [finger.names.index(name) for name in names]])
        log_range = np.stack([logs.min(axis=0), logs.max(axis=0)])
        # density of the factors over the density of the points
        weight = np.exp(-0.5 * (tail_scale**2 - 1.0) * np.sum(z**2, axis=1))
        surrogates: list[Self] = []
        for degree in itertools.count(1):
            powers = np.array([n for n in itertools.product(range(degree + 1), repeat=size) if sum(n) <= degree])
            terms = _hermite(z, powers)
            error = _cross_validation_error(terms, logs, weight)
            coefficients = _least_squares(terms, logs)
            surrogates.append(cls(mean, covariance_factor, tail_scale, powers, coefficients, log_range, error, count))
            if error.max() <= tolerance or math.comb(size + degree + 1, size) > count / evaluations_per_term:
                break
        return min(surrogates, key=lambda surrogate: float(surrogate.cross_validation_error.max()))

    def predict(self, factors: Factors, chunk: int = 1024) -> Quantities:
        """Evaluate the quantities, `chunk` points at a time so that they fit the processor's cache."""
        z = np.linalg.solve(self.tail_scale * self.covariance_factor, (factors - self.mean).T).T
        parts = (z[i : i + chunk] for i in range(0, len(z), chunk))
        logs = np.concatenate([_hermite(part, self.powers) @ self.coefficients for part in parts])
        return np.exp(_clip_to_range(self.log_range, logs))


def _to_normal(uniform: np.ndarray) -> np.ndarray:
    return scipy.special.ndtri(np.clip(uniform, 1e-12, 1.0 - 1e-12))  # it is infinite at 0 and 1


def _least_squares(terms: Terms, logs: Quantities) -> np.ndarray:
    """Solve the normal equations, which are well-conditioned for Hermite polynomials."""
    return np.linalg.solve(terms.T @ terms, terms.T @ logs)


def _clip_to_range(reference: Quantities, logs: Quantities) -> Quantities:
    """Clip logarithms to the range of the reference, because a polynomial diverges beyond."""
    return np.clip(logs, reference.min(axis=0), reference.max(axis=0))


def _cross_validation_error(
    terms: Terms, logs: Quantities, weight: Float[np.ndarray, " points"], folds: int = 4
) -> Float[np.ndarray, " quantities"]:
    """Return sqrt(1 - r^2) between each quantity and its prediction at held-out points, weighted to the factors."""
    predictions = np.empty_like(logs)
    for fold in range(folds):
        is_out = np.arange(len(logs)) * folds // len(logs) == fold  # each section of a Halton sequence is spread evenly
        coefficients = _least_squares(terms[~is_out], logs[~is_out])
        predictions[is_out] = _clip_to_range(logs, terms[is_out] @ coefficients)
    squares = []
    for exact, other in zip(logs.T, predictions.T, strict=True):
        covariance = np.cov(np.exp([exact, other]), aweights=weight)
        squares.append(1.0 - covariance[0, 1] ** 2 / (covariance[0, 0] * covariance[1, 1]))
    return np.sqrt(np.maximum(squares, 0.0))


def _hermite(z: Factors, powers: Int[np.ndarray, "terms factors"]) -> Terms:
    """Return products of Hermite polynomials, which have unit variance over normal factors."""
    degree = int(powers.max())
    norm = np.sqrt([float(math.factorial(n)) for n in range(degree + 1)])
    single = np.polynomial.hermite_e.hermevander(z, degree) / norm
    return functools.reduce(np.multiply, (single[:, factor, column] for factor, column in enumerate(powers.T)))


def variance_shares(finger: NewFingerModel, factors: Factors, names: tuple[str, ...], seed: int) -> SobolIndices:
    """Compute `sobol_indices` of quantities `names` from a `Surrogate`.

    Each index is the mean square of a projection of y over the mean square of y. A surrogate whose correlation with y
    is r thus shifts no index by more than sqrt(1 - r^2), which the errors include.
    """
    surrogate = Surrogate.from_model(finger, factors, names)
    indices = sobol_indices(surrogate.predict, finger.factors, factors, names, seed)
    for name, error in zip(names, surrogate.cross_validation_error.tolist(), strict=True):
        for shares in indices[name].values():
            for key, times in (("first_error", 1.0), ("total_error", 1.0), ("interaction_error", 2.0)):
                shares[key] += times * error
    return indices


def sobol_indices(
    model: Callable[[Factors], Quantities],
    factor_names: tuple[str, ...],
    factors: Factors,
    names: tuple[str, ...],
    seed: int,
    count: int = 4096,
) -> SobolIndices:
    """Compute first-order, total and interaction Sobol indices of each factor, with 95 % errors.

    The factors are taken as normal with the mean and covariance of `factors`. For dependent factors, the first-order
    index is Var(E[y | x]) and the total index E[Var(y | others)], over the variance of y (Kucherenko, Tarantola, Annoni
    2012). SALib computes both from independent normal numbers that build the factors one after the other: the
    first-order index with x as the first factor, the total index with x as the last (Mara, Tarantola 2012). The
    interaction is the part of the total index that x contributes only together with others.
    """
    import SALib.analyze.sobol
    import SALib.sample.sobol

    size = factors.shape[1]
    problem = {"num_vars": size, "names": list(factor_names), "bounds": [[0.0, 1.0]] * size}
    z = _to_normal(SALib.sample.sobol.sample(problem, count, calc_second_order=False, seed=seed))
    mean, covariance = factors.mean(axis=0), np.cov(factors.T)
    shares: SobolIndices = {name: {factor: {} for factor in factor_names} for name in names}
    for turn in range(size):
        order = np.roll(np.arange(size), -turn)
        points = np.empty_like(z)
        points[:, order] = mean[order] + z @ np.linalg.cholesky(covariance[np.ix_(order, order)]).T
        for name, y in zip(names, model(points).T, strict=True):
            indices = SALib.analyze.sobol.analyze(problem, y / np.std(y), calc_second_order=False, seed=seed)
            S1, S1_error, ST, ST_error = (indices[key] for key in ("S1", "S1_conf", "ST", "ST_conf"))
            shares[name][factor_names[order[0]]] |= {"first": float(S1[0]), "first_error": float(S1_error[0])}
            shares[name][factor_names[order[-1]]] |= {
                "total": float(ST[-1]),
                "total_error": float(ST_error[-1]),
                "interaction": float(ST[-1] - S1[-1]),
                "interaction_error": float(np.hypot(ST_error[-1], S1_error[-1])),
            }
    return shares
