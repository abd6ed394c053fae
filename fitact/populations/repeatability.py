"""Variance of each quantity by level, repeatability, and what more people or repetitions would tell."""

import itertools
import math
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import Float

from fitact import summary
from fitact.populations.finger import SKIN
from fitact.populations.hierarchy import AREA
from fitact.populations.next_finger import NewFingerModel
from fitact.populations.population_parameters import PopulationParameters
from fitact.readers.study import Nesting

QUANTITIES = ("Rsc", "Csc", AREA, "g", "b", "force_mean")


class LevelVariances(NamedTuple):
    """Variances of logarithms by level, to first order about the median finger, for draws of the parameters.

    Rsc and Csc are those of the touch, with its area.
    """

    levels: tuple[str, ...]  # names, from the top
    counts: tuple[int, ...]  # units of each level
    variances: dict[str, Float[np.ndarray, "laws levels"]]

    @classmethod
    def from_parameters(cls, law: PopulationParameters, nesting: Nesting, finger: NewFingerModel) -> Self:
        """Compute the variances under the drive of `finger`."""
        middle = law.add_Ci(law.mean[:, None])[:, 0]
        middle = np.pad(middle, ((0, 0), (0, len(finger.factors) - middle.shape[1])))  # median thicknesses
        gradients = finger.log_gradients(middle)
        if law.area_varies:
            gradients[AREA] = np.tile(np.array(finger.factors) == AREA, (len(middle), 1)).astype(float)
        components = [finger.factors.index(name) for name in (*SKIN, AREA) if name in finger.factors]
        roots = np.asarray(law.effect_roots())
        variances = {
            name: np.sum(np.square(np.einsum("pi,plij->plj", gradients[name][:, components], roots)), axis=-1)
            for name in QUANTITIES
            if name in gradients
        }
        return cls(
            tuple(level.name for level in nesting.levels), tuple(len(x.units) for x in nesting.levels), variances
        )

    def intraclass_correlations(self, name: str) -> Float[np.ndarray, "laws levels"]:
        """Return the correlations of two touches that share the levels down to each one."""
        variances = self.variances[name]
        return np.cumsum(variances, axis=1) / np.sum(variances, axis=1, keepdims=True)

    def to_dict(self) -> list[dict[str, Any]]:
        """Return the entry `levels` of population.json."""
        entries = []
        for place, (level, count) in enumerate(zip(self.levels, self.counts, strict=True)):
            entry: dict[str, Any] = {"level": level, "units": count, "log_sd": {}}
            for name, values in self.variances.items():
                entry["log_sd"][name] = summary.summarize_draws("log_sd", np.sqrt(values[:, place]))
            if place + 1 < len(self.levels):
                entry["intraclass_correlation"] = {
                    name: summary.summarize_draws("correlation", self.intraclass_correlations(name)[:, place])
                    for name in self.variances
                }
            entries.append(entry)
        return entries

    def plan_studies(self, seed: int, name: str = "force_mean", simulations: int = 4000) -> list[dict[str, Any]]:
        """Return the uncertainty of the median of a quantity, and of its spread at the top level, for larger studies.

        Studies are simulated from the draws: the mean of each unit at the top level, and the variances between and
        within these, from which an analysis of variance estimates the spread. Errors of the records are left out. The
        first entry is the present study; there is none for a single level.
        """
        if len(self.levels) < 2:
            return []
        variances = self.variances[name][np.arange(simulations) % len(self.variances[name])]
        spread, top = np.sqrt(variances[:, 0]), self.counts[0]
        below = [lower / upper for upper, lower in itertools.pairwise(self.counts)]
        entries = []
        for more_units, more_touches in ((1, 1), (1, 2), (1, 4), (2, 1), (4, 1), (2, 2)):
            random, units = np.random.default_rng([seed, 8]), more_units * top
            touches = np.cumprod([*below[:-1], more_touches * below[-1]])  # units of each level in one of the top
            freedom = max(1, round(units * (touches[-1] - 1.0)))
            within = np.sum(variances[:, 1:] / touches, axis=1)  # of the mean of a unit about its own value
            between = (variances[:, 0] + within) * random.chisquare(units - 1, simulations) / (units - 1)
            known = within * random.chisquare(freedom, simulations) / freedom
            error = np.sqrt(np.maximum(between - known, 0.0)) - spread
            entries.append(
                {
                    "units": units,
                    "repetitions": round(more_touches * below[-1]),
                    "records": round(units * touches[-1]),
                    "median_u": math.sqrt(float(np.mean(variances[:, 0] + within)) / units),
                    "log_sd_u": math.sqrt(float(np.mean(np.square(error)))),
                }
            )
        return entries
