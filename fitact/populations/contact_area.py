"""Test of the assumption that all fingers have the same contact area, by each finger's own estimate of Ci.

The contact area multiplies Ci, Csc and 1/Rsc by a common factor. A record of the current determines a
finger's own Ci; a record of Vsc alone does not.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy

from fitact.populations.finger import Finger
from fitact.prior.distributions import Distribution
from fitact.units import format_percent


class ContactAreaTest(NamedTuple):
    """Result of a chi-square test that all fingers have the same Ci, and so the same contact area."""

    assumption: str  # `[population] contact_area`, "common" or "varies"
    fingers: int  # number of records that determines log Ci better than the prior does
    chi_square: float  # of their own log Ci about the weighted mean, with `fingers` - 1 degrees of freedom
    p_value: float  # probability of a larger one if all have the same Ci; NaN for fewer than two such fingers
    log_sd: float  # standard deviation of log Ci between fingers beyond the standard errors (Hedges & Olkin 1985)
    tolerance: float  # log_sd that changes the force by no more than `[tolerance] force`
    farthest: str = ""  # record whose Ci deviates most from the mean, in standard errors
    max_p_value: float = 0.01  # below which the fingers' own estimates disagree

    @classmethod
    def from_fingers(
        cls, fingers: Sequence[Finger], prior: Distribution, assumption: str, tolerance: float
    ) -> "ContactAreaTest":
        """Test the fingers whose record determines log Ci better than its `prior`."""
        informative = [finger for finger in fingers if finger.log_Ci_precision > prior.log_sd**-2]
        count, nan = len(informative), math.nan
        if count < 2:
            return cls(assumption, count, nan, nan, nan, tolerance)
        weight = np.array([finger.log_Ci_precision for finger in informative])
        log_Ci = np.array([finger.log_Ci for finger in informative])
        mean = np.average(log_Ci, weights=weight)
        chi_square = float(weight @ np.square(log_Ci - mean))
        excess = float(np.var(log_Ci, ddof=1) - np.mean(1.0 / weight))
        p_value = float(scipy.stats.chi2.sf(chi_square, count - 1))
        farthest = informative[int(np.argmax(weight * np.square(log_Ci - mean)))].source
        return cls(assumption, count, chi_square, p_value, math.sqrt(max(excess, 0.0)), tolerance, farthest)

    @property
    def is_tested(self) -> bool:
        """Whether at least two records determine their finger's own Ci."""
        return math.isfinite(self.p_value)

    @property
    def disagrees(self) -> bool:
        """Whether the fingers' own Ci differ significantly and relevantly, although one area is assumed."""
        return (
            self.assumption == "common"
            and self.is_tested
            and self.p_value < self.max_p_value
            and self.log_sd > self.tolerance
        )

    @property
    def sentence(self) -> str:
        """Sentence on the assumption and on the records' evidence about it."""
        if self.assumption == "varies":
            return '[population] contact_area = "varies": each finger has its own contact area.'
        assumed = 'assumed: all fingers have the same contact area ([population] contact_area = "common")'
        if not self.is_tested:
            return f"{assumed}; these records cannot test this, because Vsc alone does not determine a finger's own Ci."
        scatter = f"their own Ci differ by {format_percent(self.log_sd)} (1 sd) beyond their standard errors"
        if self.disagrees:
            chance = f"p = {self.p_value:.2g}" if self.p_value > 1e-9 else "p < 1e-9"
            return (
                f'[population] contact_area = "common" is contradicted by the records: {scatter} ({chance}),'
                f' {self.farthest} most; write contact_area = "varies", or leave that record out'
            )
        return f"{assumed}; the records agree with it: {scatter}."

    def to_dict(self) -> dict[str, Any]:
        """Return the entry `contact_area` of population.json."""
        figures = {name: getattr(self, name) for name in ("disagrees", "chi_square", "p_value", "log_sd")}
        return {
            "assumption": self.assumption,
            "tested": self.is_tested,
            "fingers": self.fingers,
            **(figures if self.is_tested else dict.fromkeys(figures)),
            "sentence": self.sentence,
        }
