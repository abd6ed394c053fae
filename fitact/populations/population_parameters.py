"""Parameters of the distribution of fingers, with a spread at each level of the experiment, and draws from it."""

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from jaxtyping import Array, Float

from fitact.compiled import array_module

COMPONENTS = ("Rsc", "Csc", "area")  # of a touch, as the names of the parameters' draws have them


def level_endings(levels: Sequence[str]) -> tuple[str, ...]:
    """Return the ends of the names of the draws that belong to each level; the top level has none."""
    return ("", *(f"_{level}" for level in levels[1:]))


class PopulationParameters(NamedTuple):
    """Parameters of the distribution of fingers.

    A touch has log Rsc and log Csc at the median contact area and, if areas vary, the logarithm of its area. Each is
    the sum of `mean` and of independent normal effects of the levels, e.g. of its person and of the touch itself.
    """

    mean: Float[Array, "*laws components"]  # of log Rsc, log Csc and, if areas vary, log area (0 at mean covariates)
    log_sd: Float[Array, "*laws levels components"]  # standard deviations of the effects, the top level first
    correlation: Float[Array, "*laws levels"]  # of log Rsc and log Csc at each level
    log_Ci: Float[Array, "*laws"]  # log Ci of the panel, for the median contact area
    # change of `mean` per standard deviation of each covariate; `mean` is at their mean
    slopes: Float[Array, "*laws covariates components"]

    @property
    def area_varies(self) -> bool:
        return self.mean.shape[-1] > 2

    def shift_means(self, covariates: Float[np.ndarray, " covariates"]) -> Self:
        """Return the parameters for fingers with these (standardized) covariates."""
        return self._replace(mean=self.mean + np.einsum("c,...ck->...k", covariates, self.slopes))

    def effect_roots(self) -> Float[Array, "*laws levels components components"]:
        """Return lower triangular roots of the covariances of the levels."""
        xp = array_module(self.log_sd)
        Rsc, Csc, *area = xp.moveaxis(self.log_sd, -1, 0)
        along, zero = self.correlation * Csc, xp.zeros_like(Rsc)
        across = xp.sqrt(xp.maximum(1.0 - xp.square(self.correlation), 0.0)) * Csc
        if not area:
            return xp.stack([xp.stack([Rsc, zero], -1), xp.stack([along, across], -1)], -2)
        rows = ([Rsc, zero, zero], [along, across, zero], [zero, zero, area[0]])
        return xp.stack([xp.stack(row, -1) for row in rows], -2)

    def make_factors(
        self, deviates: Float[np.ndarray, "*shape laws fingers levels components"]
    ) -> Float[np.ndarray, "*shape laws fingers factors"]:
        """Turn standard normal numbers of each level into logarithms of Rsc, Csc, Ci and, if it varies, area."""
        effects = np.einsum("plij,...pflj->...pfi", self.effect_roots(), deviates)
        return self.add_Ci(self.mean[:, None] + effects)

    def add_Ci(self, logs: Float[np.ndarray, "*shape laws fingers components"]) -> Float[np.ndarray, "*shape factors"]:
        """Insert log Ci of the panel behind log Rsc and log Csc."""
        log_Ci = np.broadcast_to(self.log_Ci[:, None], logs.shape[:-1])
        return np.concatenate([logs[..., :2], log_Ci[..., None], logs[..., 2:]], axis=-1)


def finger_loadings(components: int) -> Float[np.ndarray, "3 components"]:
    """Return the derivatives of log Rsc, log Csc and log Ci of a touch in its components; area scales all three."""
    return np.column_stack([np.eye(3)[:, :2], [-1.0, 1.0, 1.0]])[:, :components]
