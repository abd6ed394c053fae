"""Which factor makes the spread of a quantity of the next finger: shares of its variance, on a certified polynomial."""

import itertools
import math
from collections.abc import Callable
from typing import NamedTuple, Self

import numpy as np
import scipy.stats
from jaxtyping import Float, Int
from scipy.special import ndtri

from fitact.populations.next_finger import NewFinger

_BASE = 4096  # points of Sobol's sequence
_SAVED = 100  # times fewer evaluations of the model than those points ask for
_PER_TERM = 4  # evaluations that a coefficient has at least: with fewer, what lies in the tails runs away
_WIDER = 1.25  # than the factors are the points evaluated, for the tails, where the largest of y lie
_CLOSE = 5e-3  # as a share of a standard deviation, far below what Sobol's sequence leaves open
_FOLDS = 4  # that the evaluations are held out in, one after the other
_CHUNK = 1024  # points at which the polynomial is evaluated at a time, so that they stay in the processor's cache
_EDGE = 1e-12  # nearest to 0 and 1 that a uniform number may be
_ERRORS = ("S1_conf", "ST_conf")  # SALib's names

Shares = dict[str, dict[str, dict[str, float]]]


class Surrogate(NamedTuple):
    """Logarithms of quantities as polynomials of normal factors, by least squares; Hermite's, in whitened factors.

    Attributes:
        mean, root: of the factors, and of their covariance.
        powers: of each term.
        coefficients: of the terms.
        seen: least and largest logarithm that the model gave.
        off: of each quantity, sqrt(1 - r^2), where r is its correlation with the model's at points held out.
        evaluations: of the model that this took.
    """

    mean: Float[np.ndarray, " factors"]
    root: Float[np.ndarray, "factors factors"]
    powers: Int[np.ndarray, "terms factors"]
    coefficients: Float[np.ndarray, "terms quantities"]
    seen: Float[np.ndarray, "2 quantities"]
    off: Float[np.ndarray, " quantities"]
    evaluations: int

    @classmethod
    def of(cls, finger: NewFinger, factors: Float[np.ndarray, "fingers factors"], names: tuple[str, ...]) -> Self:
        """Of the lowest degree that is close at points held out, or the one that is closest there."""
        size = factors.shape[1]
        mean, root = factors.mean(axis=0), np.linalg.cholesky(np.cov(factors.T))
        count = _BASE * (size + 2) * size // _SAVED
        uniform = scipy.stats.qmc.Halton(size, rng=np.random.default_rng(0)).random(count)
        white = _WIDER * ndtri(np.clip(uniform, _EDGE, 1.0 - _EDGE))
        columns = [finger.names.index(name) for name in names]
        logs = np.log(finger.each(mean + white @ root.T)[:, columns])
        seen = np.stack([logs.min(axis=0), logs.max(axis=0)])
        found: list[Self] = []
        degree = 1
        while not found or (math.comb(size + degree, size) <= count / _PER_TERM and found[-1].off.max() > _CLOSE):
            powers = _powers(size, degree)
            terms = _hermite(white / _WIDER, powers)
            found.append(cls(mean, root, powers, _least_squares(terms, logs), seen, _off(terms, logs, white), count))
            degree += 1
        return min(found, key=lambda each: float(each.off.max()))

    def at(self, factors: Float[np.ndarray, "points factors"]) -> Float[np.ndarray, "points quantities"]:
        """The quantities themselves."""
        white = np.linalg.solve(_WIDER * self.root, (factors - self.mean).T).T
        chunks = (white[i : i + _CHUNK] for i in range(0, len(white), _CHUNK))
        logs = np.concatenate([_hermite(chunk, self.powers) @ self.coefficients for chunk in chunks])
        return np.exp(_within(self.seen, logs))


def _least_squares(
    terms: Float[np.ndarray, "points terms"], logs: Float[np.ndarray, "points quantities"]
) -> np.ndarray:
    """By the normal equations, which Hermite's polynomials leave well-conditioned."""
    return np.linalg.solve(terms.T @ terms, terms.T @ logs)


def _within(seen: Float[np.ndarray, "n quantities"], logs: Float[np.ndarray, "points quantities"]) -> np.ndarray:
    """Logarithms no further out than what was seen: beyond, a polynomial soon runs away."""
    return np.clip(logs, seen.min(axis=0), seen.max(axis=0))


def _off(
    terms: Float[np.ndarray, "points terms"],
    logs: Float[np.ndarray, "points quantities"],
    white: Float[np.ndarray, "points factors"],
) -> Float[np.ndarray, " quantities"]:
    """How far each quantity is from a polynomial that has not seen it: sqrt(1 - r^2), over the factors' density."""
    near = np.empty_like(logs)
    for fold in range(_FOLDS):
        out = np.arange(len(logs)) * _FOLDS // len(logs) == fold  # a stretch of Halton's sequence is spread evenly
        near[out] = _within(logs, terms[out] @ _least_squares(terms[~out], logs[~out]))
    weight = np.exp(-0.5 * (1.0 - _WIDER**-2) * np.sum(white**2, axis=1))
    found = []
    for exact, other in zip(logs.T, near.T, strict=True):
        covariance = np.cov(np.exp([exact, other]), aweights=weight)
        found.append(1.0 - covariance[0, 1] ** 2 / (covariance[0, 0] * covariance[1, 1]))
    return np.sqrt(np.maximum(found, 0.0))


def _powers(size: int, degree: int) -> Int[np.ndarray, "terms factors"]:
    every = itertools.product(range(degree + 1), repeat=size)
    return np.array([powers for powers in every if sum(powers) <= degree])


def _hermite(white: Float[np.ndarray, "points factors"], powers: Int[np.ndarray, "terms factors"]) -> np.ndarray:
    """Products of Hermite polynomials, of unit variance over normal factors."""
    degree = int(powers.max())
    norm = np.sqrt([float(math.factorial(n)) for n in range(degree + 1)])
    single = np.polynomial.hermite_e.hermevander(white, degree) / norm
    product = single[:, 0, powers[:, 0]]
    for factor in range(1, white.shape[1]):
        product = product * single[:, factor, powers[:, factor]]
    return product


def variance_shares(
    finger: NewFinger, factors: Float[np.ndarray, "fingers factors"], names: tuple[str, ...], seed: int
) -> Shares:
    """Shares of each factor in the variance of quantities `names`, as by `shares_of`, from a `Surrogate`.

    Each share is the mean square of a projection of y over that of y, so a surrogate whose correlation with y is r
    shifts none by more than sqrt(1 - r^2); the errors include that.
    """
    surrogate = Surrogate.of(finger, factors, names)
    found = shares_of(surrogate.at, finger.factors, factors, names, seed)
    for name, off in zip(names, surrogate.off.tolist(), strict=True):
        for share in found[name].values():
            for key, times in (("first_error", 1.0), ("total_error", 1.0), ("interaction_error", 2.0)):
                share[key] += times * off
    return found


def shares_of(
    model: Callable[[np.ndarray], np.ndarray],
    factor_names: tuple[str, ...],
    factors: Float[np.ndarray, "fingers factors"],
    names: tuple[str, ...],
    seed: int,
) -> Shares:
    """First-order, total and interaction shares of each factor in the variance of quantities, with 95 % errors.

    The factors are taken as normal with the mean and covariance of `factors`. Where they depend on each other, first
    is Var(E[y | x]) and total E[Var(y | others)] over the variance of y (Kucherenko, Tarantola, Annoni 2012): Sobol's
    indices, by SALib, of independent normal numbers that build the factors one after the other. That of the first
    holds what x shares with the others, that of the last what is x's alone (Mara, Tarantola 2012); of this, interaction
    is what x does together with others only.

    Args:
        model: the quantities (points, quantities) of points (points, factors).
    """
    import SALib.analyze.sobol
    import SALib.sample.sobol

    size = factors.shape[1]
    problem = {"num_vars": size, "names": list(factor_names), "bounds": [[0.0, 1.0]] * size}
    uniform = SALib.sample.sobol.sample(problem, _BASE, calc_second_order=False, seed=seed)
    white = ndtri(np.clip(uniform, _EDGE, 1.0 - _EDGE))
    mean, covariance = factors.mean(axis=0), np.cov(factors.T)
    found: Shares = {name: {factor: {} for factor in factor_names} for name in names}
    for turn in range(size):
        order = np.roll(np.arange(size), -turn)
        points = np.empty_like(white)
        points[:, order] = mean[order] + white @ np.linalg.cholesky(covariance[np.ix_(order, order)]).T
        for name, y in zip(names, model(points).T, strict=True):
            indices = SALib.analyze.sobol.analyze(problem, y / np.std(y), calc_second_order=False, seed=seed)
            (S1, ST), (S1_error, ST_error) = ([indices[key] for key in keys] for keys in (("S1", "ST"), _ERRORS))
            found[name][factor_names[order[0]]] |= {"first": float(S1[0]), "first_error": float(S1_error[0])}
            found[name][factor_names[order[-1]]] |= {
                "total": float(ST[-1]),
                "total_error": float(ST_error[-1]),
                "interaction": float(ST[-1] - S1[-1]),
                "interaction_error": float(np.hypot(ST_error[-1], S1_error[-1])),
            }
    return found
