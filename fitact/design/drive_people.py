"""Who a panel is designed for: fingers of a population's laws, or of a scene's prior."""

import dataclasses
from typing import Any, Self

import numpy as np
import scipy.special
import scipy.stats
from jaxtyping import Float

from fitact.populations.finger import SHARED_PARAMETER, SKIN
from fitact.populations.next_finger import factors_from_normal
from fitact.populations.population import Population, draw_parameters
from fitact.scene.prior_predictive import sample_prior
from fitact.scene.scene import Scene


@dataclasses.dataclass(frozen=True)
class FingerSample:
    """Fingers under each of some laws that people may follow."""

    values: dict[
        str, Float[np.ndarray, "laws fingers"]
    ]  # SI: Rsc, Csc, Ci and whatever else is believed of the circuit
    source: str  # for people to read
    trusted: bool = True  # whether nothing stands against them

    @property
    def shape(self) -> tuple[int, int]:
        """Laws, fingers of each."""
        laws, fingers = self.values[SHARED_PARAMETER].shape
        return laws, fingers

    @property
    def has_separate_uncertainty(self) -> bool:
        """Whether how people differ is told apart from what is not known of them."""
        return self.shape[0] > 1

    @classmethod
    def from_population(
        cls, population: Population, scene: Scene, seed: int = 0, laws: int = 512, fingers: int = 128
    ) -> Self:
        """Draw fingers to come; an area that varies scales both capacitances up and the resistance down.

        What the scene holds or ties to these follows; all else is the scene's. Sobol's sequence, which spreads the
        `fingers` evenly within each of `laws` and over all, wants powers of 2 of both.
        """
        uniform = scipy.stats.qmc.Sobol(3, rng=np.random.default_rng([seed, 2])).random(laws * fingers)
        z = scipy.special.ndtri(uniform).reshape(laws, fingers, 3)
        Rsc, Csc, Ci, *areas = np.moveaxis(factors_from_normal(draw_parameters(population, laws), z), -1, 0)
        area = areas[0] if areas else 0.0
        values = {SKIN[0]: np.exp(Rsc - area), SKIN[1]: np.exp(Csc + area), SHARED_PARAMETER: np.exp(Ci + area)}
        fixed = {name: np.full((laws, fingers), value) for name, value in scene.fixed_values().items()}
        known: dict[str, Any] = {**scene.nominal_values(), **fixed, **values}
        tied = {name: ratio * known[other] for name, (other, ratio) in scene.prior.ties().items()}
        source = f"the population of {len(population.fingers)} fingers"
        return cls(_circuit_values(fixed | tied | values), source, population.trusted)

    @classmethod
    def from_prior(cls, scene: Scene, seed: int = 0, fingers: int = 4096) -> Self:
        """Draw fingers that the scene believes possible, which stand for people and for ignorance alike."""
        values = {name: x[None] for name, x in sample_prior(scene, np.random.default_rng(seed), fingers).items()}
        nominal = {name: np.full((1, fingers), scene.nominal_values()[name]) for name in (*SKIN, SHARED_PARAMETER)}
        return cls(_circuit_values(nominal | values), "the scene's prior")


def _circuit_values(values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name: x for name, x in values.items() if name not in ("sigma", "sigma_I")}
