"""Information criteria, for the choice between models of the same samples."""

import math

import numpy as np
from jaxtyping import Float

from fitact.likelihood.noise import STUDENT_DOF


def gaussian_log_likelihood(
    residuals: Float[np.ndarray, " samples"], weight: Float[np.ndarray, " samples"] | None
) -> float:
    """Return the Gaussian log-likelihood of residuals at its maximum over the noise sd, including all constants.

    `weight` is the inverse relative noise sd of each sample; 0 excludes a sample, and None means equal weights.
    """
    weight = np.ones(residuals.size) if weight is None else weight
    used = weight > 0.0
    mean = float(np.mean(np.square(residuals[used] * weight[used])))
    size = int(np.count_nonzero(used))
    return -0.5 * size * (math.log(2.0 * math.pi * max(mean, 1e-300)) + 1.0) + float(np.sum(np.log(weight[used])))


def student_log_likelihood(
    residuals: Float[np.ndarray, " samples"], weight: Float[np.ndarray, " samples"], scale: float
) -> float:
    """Return the log-likelihood of residuals under Student's t with `STUDENT_DOF` degrees of freedom and this scale."""
    used = weight > 0.0
    z = residuals[used] * weight[used] / scale
    constant = (
        math.lgamma(0.5 * (STUDENT_DOF + 1.0)) - math.lgamma(0.5 * STUDENT_DOF) - 0.5 * math.log(STUDENT_DOF * math.pi)
    )
    densities = constant - 0.5 * (STUDENT_DOF + 1.0) * np.log1p(z**2 / STUDENT_DOF) + np.log(weight[used] / scale)
    return float(np.sum(densities))


def criteria(log_likelihood: float, parameters: int, samples: int) -> dict[str, float]:
    """Return the information criteria AIC, AICc (AIC for few samples; infinite for too few) and BIC.

    Lower is better; only fits to the same samples can be compared. Sources: Akaike, IEEE Trans. Autom. Control 19
    (1974) 716; Hurvich and Tsai, Biometrika 76 (1989) 297; Schwarz, Ann. Statist. 6 (1978) 461.
    """
    aic, spare = 2.0 * parameters - 2.0 * log_likelihood, samples - parameters - 1
    return {
        "log_likelihood": log_likelihood,
        "parameters_counted": parameters,
        "aic": aic,
        "aicc": aic + 2.0 * parameters * (parameters + 1) / spare if spare > 0 else math.inf,
        "bic": parameters * math.log(samples) - 2.0 * log_likelihood,
    }
