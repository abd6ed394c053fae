"""Information criteria: which of several models of the same samples they favour."""

import math

import numpy as np
from jaxtyping import Float

from fitact.likelihood.noise import STUDENT_DOF


def gaussian_log_likelihood(
    residuals: Float[np.ndarray, " samples"], weight: Float[np.ndarray, " samples"] | None
) -> float:
    """Log-likelihood of residuals at the noise that makes it largest, all constants included.

    `weight` is the inverse of each sample's noise relative to the others'; 0 leaves it out.
    """
    weight = np.ones(residuals.size) if weight is None else weight
    kept = weight > 0.0
    mean = float(np.mean(np.square(residuals[kept] * weight[kept])))
    size = int(np.count_nonzero(kept))
    return -0.5 * size * (math.log(2.0 * math.pi * max(mean, 1e-300)) + 1.0) + float(np.sum(np.log(weight[kept])))


def student_log_likelihood(
    residuals: Float[np.ndarray, " samples"], weight: Float[np.ndarray, " samples"], scale: float
) -> float:
    """Likewise under Student's t of `fitact.likelihood.noise.STUDENT_DOF` degrees, with its scale."""
    kept = weight > 0.0
    z = residuals[kept] * weight[kept] / scale
    constant = (
        math.lgamma(0.5 * (STUDENT_DOF + 1.0)) - math.lgamma(0.5 * STUDENT_DOF) - 0.5 * math.log(STUDENT_DOF * math.pi)
    )
    densities = constant - 0.5 * (STUDENT_DOF + 1.0) * np.log1p(z**2 / STUDENT_DOF) + np.log(weight[kept] / scale)
    return float(np.sum(densities))


def criteria(log_likelihood: float, parameters: int, samples: int) -> dict[str, float]:
    """Akaike's criterion, that for few samples (infinite for too few), and the Bayesian one; the least is best.

    Of fits to the same samples only. Sources: Akaike, IEEE Trans. Autom. Control 19 (1974) 716; Hurvich and Tsai,
    Biometrika 76 (1989) 297; Schwarz, Ann. Statist. 6 (1978) 461.
    """
    aic, spare = 2.0 * parameters - 2.0 * log_likelihood, samples - parameters - 1
    return {
        "log_likelihood": log_likelihood,
        "parameters_counted": parameters,
        "aic": aic,
        "aicc": aic + 2.0 * parameters * (parameters + 1) / spare if spare > 0 else math.inf,
        "bic": parameters * math.log(samples) - 2.0 * log_likelihood,
    }
