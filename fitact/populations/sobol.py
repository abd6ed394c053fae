"""Sobol indices of a quantity of the next finger."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from scipy.special import ndtri

SobolIndices = dict[str, dict[str, dict[str, float]]]
Factors = Float[np.ndarray, "points factors"]
Quantities = Float[np.ndarray, "points quantities"]


def sobol_indices(
    model: Callable[[Factors], Quantities],
    factor_names: tuple[str, ...],
    factors: Factors,
    names: tuple[str, ...],
    seed: int,
    count: int = 2048,
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
    uniform = SALib.sample.sobol.sample(problem, count, calc_second_order=False, seed=seed)
    z = ndtri(np.clip(uniform, 1e-12, 1.0 - 1e-12))  # it is infinite at 0 and 1
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
