"""The fingers that a drive is designed for: drawn from a fitted population, or from the scene's prior."""

import dataclasses
import math
from typing import Any, Self

import numpy as np
import scipy
from jaxtyping import Float

from fitact.populations.finger import SHARED_PARAMETER, SKIN
from fitact.populations.population_draws import PopulationDraws
from fitact.populations.population_parameters import PopulationParameters
from fitact.populations.population_text import UNIT_NAMES
from fitact.scene.prior_predictive import sample_prior
from fitact.scene.scene import Scene

LAWS = 512  # samples of the population parameters


@dataclasses.dataclass(frozen=True)
class FingerSample:
    """Fingers of each of some samples of the population parameters, each with one touch or several.

    Several touches of a finger are not drawn: they have the mean and the covariance of its touches.
    """

    # Rsc, Csc, Ci and other free parameters of the circuit, SI; the touches of a finger follow each other
    values: dict[str, Float[np.ndarray, "laws fingers*touches"]]
    source: str  # description of the fingers for people
    trusted: bool = True  # whether the population fit is reliable, and most of its records are fitted well
    warnings: tuple[str, ...] = ()  # of the population fit
    touches: int = 1  # of each finger
    unit: str = "fingers"  # what has the touches

    @property
    def shape(self) -> tuple[int, int]:
        """Number of population samples, and of the fingers' touches in each."""
        laws, touches = self.values[SHARED_PARAMETER].shape
        return laws, touches

    def reduce_touches(
        self, amplitude: Float[np.ndarray, "laws fingers*touches"], share: float
    ) -> Float[np.ndarray, "laws fingers"]:
        """Return the quantile of each finger's touches, whose logarithms are taken as normal."""
        if self.touches == 1:
            return amplitude
        logs = np.log(amplitude.reshape(len(amplitude), -1, self.touches))
        with np.errstate(invalid="ignore"):  # some may feel it at no amplitude
            found = np.mean(logs, axis=-1) + scipy.special.ndtri(share) * np.std(logs, axis=-1)
        return np.exp(np.where(np.isfinite(found), found, np.inf))

    @property
    def has_separate_uncertainty(self) -> bool:
        """Whether variability between fingers is separated from uncertainty of the population parameters."""
        return self.shape[0] > 1

    @classmethod
    def from_population(cls, population: PopulationDraws, scene: Scene, seed: int = 0) -> Self:
        """Draw new fingers from a population; a larger contact area raises both capacitances and lowers Rsc.

        With several levels, people (or what the top level is) have several touches each. Parameters that the scene
        fixes or ties follow; all others are the scene's.
        """
        law, several = population.law, len(population.levels) > 1
        if several:  # whose touches take time
            law = PopulationParameters(*(leaf[::2] for leaf in law))
        fingers = 64 if several else 128  # powers of 2, so that one Sobol sequence covers each population sample evenly
        laws, _, components = law.log_sd.shape
        uniform = scipy.stats.qmc.Sobol(components, rng=np.random.default_rng([seed, 2])).random(laws * fingers)
        z = scipy.special.ndtri(uniform).reshape(laws, fingers, 1, components)
        roots = law.effect_roots()
        logs = law.mean[:, None] + np.einsum("plij,pflj->pfi", roots[:, :1], z)
        if several:
            covariance = np.einsum("plij,plkj->pik", roots[:, 1:], roots[:, 1:])
            variances, vectors = np.linalg.eigh(covariance)  # which may be singular
            axes = np.swapaxes(vectors, 1, 2) * np.sqrt(np.maximum(variances, 0.0))[..., None]
            # corners of a simplex, with the mean and the covariance of the touches
            corners = math.sqrt(components + 1) * scipy.linalg.helmert(components + 1).T
            steps = np.einsum("ck,pki->pci", corners, axes)
            logs = (logs[:, :, None] + steps[:, None]).reshape(laws, -1, components)
        Rsc, Csc, Ci, *areas = np.moveaxis(law.add_Ci(logs), -1, 0)
        area = areas[0] if areas else 0.0
        values = {SKIN[0]: np.exp(Rsc - area), SKIN[1]: np.exp(Csc + area), SHARED_PARAMETER: np.exp(Ci + area)}
        fixed = {name: np.full(Ci.shape, value) for name, value in scene.fixed_values().items()}
        known: dict[str, Any] = {**scene.nominal_values(), **fixed, **values}
        tied = {name: ratio * known[other] for name, (other, ratio) in scene.prior.ties().items()}
        contact = "each with its own contact area" if areas else "assumed to have the same contact area"
        source = f"the population of {population.description}, {contact}"
        unit, touches = UNIT_NAMES[population.levels[0]][1], components + 1 if several else 1
        return cls(
            _circuit_values(fixed | tied | values), source, population.trusted, population.warnings, touches, unit
        )

    @classmethod
    def from_prior(cls, scene: Scene, seed: int = 0, fingers: int = 4096) -> Self:
        """Draw fingers from the scene's prior, which mixes variability between fingers with lack of knowledge."""
        values = {name: x[None] for name, x in sample_prior(scene, np.random.default_rng(seed), fingers).items()}
        nominal = {name: np.full((1, fingers), scene.nominal_values()[name]) for name in (*SKIN, SHARED_PARAMETER)}
        return cls(_circuit_values(nominal | values), "the scene's prior")


def _circuit_values(values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name: x for name, x in values.items() if name not in ("sigma", "sigma_I")}
