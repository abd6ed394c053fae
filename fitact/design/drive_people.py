"""The fingers that a drive is designed for: drawn from a fitted population, or from the scene's prior."""

import dataclasses
from typing import Any, Self

import numpy as np
import scipy
from jaxtyping import Float

from fitact.populations.finger import SHARED_PARAMETER, SKIN
from fitact.populations.next_finger import factors_from_normal
from fitact.populations.population import Population, draw_parameters
from fitact.scene.prior_predictive import sample_prior
from fitact.scene.scene import Scene
from fitact.summary import TRUSTED_RESULTS


@dataclasses.dataclass(frozen=True)
class FingerSample:
    """Fingers of each of some samples of the population parameters."""

    values: dict[str, Float[np.ndarray, "laws fingers"]]  # Rsc, Csc, Ci and other free parameters of the circuit, SI
    source: str  # description of the fingers for people
    trusted: bool = True  # whether the population fit is reliable, and most of its fingers are fitted well
    warnings: tuple[str, ...] = ()  # of the population fit

    @property
    def shape(self) -> tuple[int, int]:
        """Number of population samples, and of fingers in each."""
        laws, fingers = self.values[SHARED_PARAMETER].shape
        return laws, fingers

    @property
    def has_separate_uncertainty(self) -> bool:
        """Whether variability between fingers is separated from uncertainty of the population parameters."""
        return self.shape[0] > 1

    @classmethod
    def from_population(cls, population: Population, scene: Scene, seed: int = 0) -> Self:
        """Draw new fingers from a population; a larger contact area raises both capacitances and lowers Rsc.

        Parameters that the scene fixes or ties follow; all others are the scene's.
        """
        laws, fingers = 512, 128  # powers of 2, so that one Sobol sequence covers each population sample evenly
        uniform = scipy.stats.qmc.Sobol(3, rng=np.random.default_rng([seed, 2])).random(laws * fingers)
        z = scipy.special.ndtri(uniform).reshape(laws, fingers, 3)
        Rsc, Csc, Ci, *areas = np.moveaxis(factors_from_normal(draw_parameters(population, laws), z), -1, 0)
        area = areas[0] if areas else 0.0
        values = {SKIN[0]: np.exp(Rsc - area), SKIN[1]: np.exp(Csc + area), SHARED_PARAMETER: np.exp(Ci + area)}
        fixed = {name: np.full((laws, fingers), value) for name, value in scene.fixed_values().items()}
        known: dict[str, Any] = {**scene.nominal_values(), **fixed, **values}
        tied = {name: ratio * known[other] for name, (other, ratio) in scene.prior.ties().items()}
        contact = "each with its own contact area" if areas else "assumed to have the same contact area"
        source = f"the population of {len(population.fingers)} fingers, {contact}"
        poor = sum(finger.result not in TRUSTED_RESULTS for finger in population.fingers)
        trusted = population.trusted and 2 * poor <= len(population.fingers)
        return cls(_circuit_values(fixed | tied | values), source, trusted)

    @classmethod
    def from_prior(cls, scene: Scene, seed: int = 0, fingers: int = 4096) -> Self:
        """Draw fingers from the scene's prior, which mixes variability between fingers with lack of knowledge."""
        values = {name: x[None] for name, x in sample_prior(scene, np.random.default_rng(seed), fingers).items()}
        nominal = {name: np.full((1, fingers), scene.nominal_values()[name]) for name in (*SKIN, SHARED_PARAMETER)}
        return cls(_circuit_values(nominal | values), "the scene's prior")


def _circuit_values(values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name: x for name, x in values.items() if name not in ("sigma", "sigma_I")}
