"""Where a search for a minimum ended, and the names and sentences of the reasons.

Needs no optimistix, because a program from the disk does without it.
"""

import equinox as eqx
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

RESULTS = {
    "successful": "The fit converged, and the residuals are consistent with the noise.",
    "did_not_move": (
        "The optimiser did not move from its starting point, which is not a minimum; check the units of the record."
    ),
    "not_at_optimum": (
        "The optimiser stopped before it reached a minimum; check the units of the record, or state a narrower prior."
    ),
    "rank_deficient": (
        "The data do not determine all parameters, and many values fit equally well; state a prior, or record another"
        " channel."
    ),
    "on_bound": (
        "The best fit violates a bound or an order that the prior states; check the units of the record, or widen it."
    ),
    "several_optima": (
        "The fit has several optima that are almost equally good; state a narrower prior, or sample the posterior."
    ),
    "misfit": (
        "Poor fit: the residuals are larger than the noise or correlated. Inspect them in the report, then add the"
        " missing circuit element (a gap, R_H, …) to the scene or, if it names a waveform, fit with the measured drive."
    ),
    "structure": "The residuals are more than noise, but can hardly move the results.",
    "nonfinite": "The search met values that are not finite; check the record, or state a narrower prior.",
    "nonlinear_max_steps_reached": (
        "The search ended before it reached an optimum; state a narrower prior, or start elsewhere."
    ),
    "nonlinear_divergence": "The search diverged; state a narrower prior, or start elsewhere.",
}
"""Sentence for each reason why a fit ended: those of optimistix, and others that make a fit unreliable."""
RESULT_NAMES = tuple(RESULTS)


def result_name(index: Int[ArrayLike, ""]) -> str:
    """Return the name of a result in `RESULT_NAMES`."""
    return RESULT_NAMES[int(index)]


class Minimum(eqx.Module):
    """Point at which Levenberg-Marquardt ended."""

    theta: Float[Array, " parameters"]
    cost: Float[Array, ""]  # half of the sum of squared residuals
    jacobian: Float[Array, "rows parameters"]  # Jacobian of the residuals, in the order of their pytree
    steps: Array  # trial steps taken
    result: Int[Array, ""]  # index in `RESULT_NAMES`
