"""Whether a fit may be trusted, and what stands against it if not."""

import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitact.fitting.channel_fit import TraceFit
from fitact.fitting.least_squares import Solved
from fitact.fitting.levenberg_marquardt import Optima, result_name
from fitact.fitting.problem import Source
from fitact.fitting.residual_statistics import is_misfit
from fitact.likelihood.likelihood import Likelihood

_NOISE = 4.0  # standard deviations by which noise may put an exponent beyond its bound
_WITHIN = 1e-12
_ALONG = 6.0  # standard deviations along what is known least, within which a bounded prior must leave room


def verdict(
    solved: Solved,
    root: Float[np.ndarray, "parameters parameters"],
    traces: Sequence[TraceFit],
    sources: Sequence[Source],
    optima: Optima | None,
) -> str:
    """The name of the first of the `RESULTS` that stands against the fit; "successful" if none does.

    `root` is that of theta's covariance.
    """
    found = result_name(solved.result)
    if found != "successful":
        return found
    if is_out_of_bounds(solved.likelihood, np.asarray(solved.theta), np.asarray(solved.sigma), root):
        return "on_bound"
    if optima is not None and result_name(optima.result) == "several_optima":
        return "several_optima"
    doubtful = any(is_misfit(trace.figures) for trace in traces) or any(source.drowned for source in sources)
    return "misfit" if doubtful else "successful"


def is_out_of_bounds(
    likelihood: Likelihood,
    theta: Float[np.ndarray, " parameters"],
    sigma: Float[np.ndarray, " traces"],
    root: Float[np.ndarray, "parameters parameters"],
) -> bool:
    """Whether the records put the parameters where a bounded or ordered prior forbids them.

    Least squares take a prior by its mean and covariance. Along what the records do not see it may end beyond an
    edge, which the sampler mends; so what must be allowed is a point of that line. An exponent of 1 is a constant
    skin, which the records may well have: where their noise alone puts it beyond, the line goes through 1.
    """
    axes, sizes, _ = np.linalg.svd(root)
    along = np.linspace(-_ALONG, _ALONG, 241)[:, None] * (axes[:, 0] * sizes[0])
    points = np.hstack([_with_possible_exponent(likelihood, theta, root) + along, np.tile(np.log(sigma), (241, 1))])
    return not bool(_any_possible(likelihood.without_samples(), jnp.asarray(points)))


@eqx.filter_jit
def _any_possible(likelihood: Likelihood, points: Float[Array, "n coordinates"]) -> Array:
    return jnp.any(jnp.isfinite(jax.vmap(likelihood.log_prior)(points)))


def _with_possible_exponent(likelihood: Likelihood, theta: np.ndarray, root: np.ndarray) -> np.ndarray:
    """Theta, or the most probable point with a fractional skin's exponent at its bound, where noise explains that."""
    if "alpha" not in likelihood.prior.names:
        return theta
    place, high = likelihood.prior.names.index("alpha"), getattr(likelihood.prior["alpha"], "high", 1.0)
    excess, spread = theta[place] - math.log(high), np.linalg.norm(root[place])
    if not 0.0 < excess < _NOISE * spread:
        return theta
    moved = theta - root @ root[place] * (excess / spread**2)
    moved[place] = math.log(high) * (1.0 + _WITHIN) - _WITHIN  # rounding must not leave it beyond
    return moved


def misfits(traces: Sequence[TraceFit]) -> list[str]:
    """Which of several traces the model does not describe, in sentences."""
    return [
        f"{trace.record.source}: {trace.channel} is not described by the model that all records share (reduced"
        f" chi-square {trace.figures['chi2_reduced']:.3g}); fit it alone to see whether it belongs to this finger"
        for trace in traces
        if len(traces) > 1 and is_misfit(trace.figures)
    ]
