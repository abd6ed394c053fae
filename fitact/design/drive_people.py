"""Who a panel is designed for: fingers of a population's laws, or of a scene's prior."""

import dataclasses
from typing import Any, Self

import numpy as np
import scipy.special
import scipy.stats
from jaxtyping import Float

from fitact.populations.finger import SHARED, SKIN
from fitact.populations.next_finger import factors_of
from fitact.populations.population import Population, drawn_laws
from fitact.scene.prior_predictive import believed
from fitact.scene.scene import Scene

_LAWS, _FINGERS = 512, 128  # of a population, and of each; Sobol's sequence wants powers of 2
_BELIEVED = 4096  # fingers of a prior
_NOT_OF_THE_CIRCUIT = ("sigma", "sigma_I")


@dataclasses.dataclass(frozen=True)
class People:
    """Fingers under each of some laws that people may follow.

    Attributes:
        values: what the fingers have, SI, by name: Rsc, Csc, Ci and whatever else is believed of the circuit.
        source: where they come from, for people to read.
        trusted: whether nothing stands against them.
    """

    values: dict[str, Float[np.ndarray, "laws fingers"]]
    source: str
    trusted: bool = True

    @property
    def shape(self) -> tuple[int, int]:
        """Laws, fingers of each."""
        laws, fingers = self.values[SHARED].shape
        return laws, fingers

    @property
    def separated(self) -> bool:
        """Whether how people differ is told apart from what is not known of them."""
        return self.shape[0] > 1

    @classmethod
    def of_population(cls, population: Population, scene: Scene, seed: int = 0) -> Self:
        """Fingers to come; an area that varies scales both capacitances up and the resistance down.

        What the scene holds or ties to these follows; all else is the scene's.
        """
        Rsc, Csc, Ci, *areas = np.moveaxis(factors_of(drawn_laws(population, _LAWS), _standard_normal(seed)), -1, 0)
        area = areas[0] if areas else 0.0
        values = {SKIN[0]: np.exp(Rsc - area), SKIN[1]: np.exp(Csc + area), SHARED: np.exp(Ci + area)}
        held = {name: np.full((_LAWS, _FINGERS), value) for name, value in scene.fixed().items()}
        known: dict[str, Any] = {**scene.nominal(), **held, **values}
        tied = {name: ratio * known[other] for name, (other, ratio) in scene.prior.tied().items()}
        source = f"the population of {len(population.fingers)} fingers"
        return cls(_of_the_circuit(held | tied | values), source, population.trusted)

    @classmethod
    def of_prior(cls, scene: Scene, seed: int = 0) -> Self:
        """Fingers that the scene believes possible, which stand for people and for ignorance alike.

        Raises:
            InputError: the prior leaves nothing to draw.
        """
        drawn = believed(scene, np.random.default_rng(seed), _BELIEVED)
        values = {name: draws[None] for name, draws in drawn.items()}
        nominal = {name: np.full((1, _BELIEVED), scene.nominal()[name]) for name in (*SKIN, SHARED)}
        return cls(_of_the_circuit(nominal | values), "the scene's prior")


def _of_the_circuit(values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name: x for name, x in values.items() if name not in _NOT_OF_THE_CIRCUIT}


def _standard_normal(seed: int) -> Float[np.ndarray, "laws fingers 3"]:
    """Spread evenly within each law and over all."""
    uniform = scipy.stats.qmc.Sobol(3, rng=np.random.default_rng([seed, 2])).random(_LAWS * _FINGERS)
    return scipy.special.ndtri(uniform).reshape(_LAWS, _FINGERS, 3)
