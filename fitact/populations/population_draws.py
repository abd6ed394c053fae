"""Draws of a population for a design: from a fit, or from the folder that `fitact population` left."""

import json
import os
from typing import Any, NamedTuple, Self

import numpy as np

from fitact.files import complete_folder, read_datatree
from fitact.populations.finger import SHARED_PARAMETER, SKIN
from fitact.populations.population import Population, draw_parameters
from fitact.populations.population_parameters import COMPONENTS, PopulationParameters, level_endings
from fitact.populations.population_text import describe_units
from fitact.summary import TRUSTED_RESULTS


class PopulationDraws(NamedTuple):
    """Draws of the population parameters, and what is said of them."""

    law: PopulationParameters  # at the covariates of the next finger
    levels: tuple[str, ...]  # names, from the top
    description: str  # "8 fingers"
    trusted: bool  # whether the fit is reliable, and most of its records are fitted well
    warnings: tuple[str, ...]

    @classmethod
    def from_population(cls, population: Population, count: int) -> Self:
        """Take `count` draws, spread over the chain."""
        results = [finger.result for finger in population.fingers]
        names = tuple(level.name for level in population.nesting.levels)
        trusted = population.trusted and _are_mostly_good(results)
        return cls(draw_parameters(population, count), names, population.description, trusted, population.warnings)

    @classmethod
    def from_folder(cls, path: str | os.PathLike[str], count: int) -> Self:
        """Read `count` draws from population.nc and population.json.

        Raises:
            InputError: the folder holds no complete population.
        """
        with complete_folder(path, "population") as folder:
            content = json.loads((folder / "population.json").read_text(encoding="utf-8"))
            posterior = read_datatree(folder / "population.nc")["posterior"].to_dataset()
            names = tuple(level["level"] for level in content["levels"])
            law = _read_parameters(posterior, names, content["population"]["covariates"], count)
            trusted = content["trusted"] and _are_mostly_good([each["result"] for each in content["fingers"]])
            return cls(law, names, describe_units(content["levels"]), trusted, tuple(content["warnings"]))


def _are_mostly_good(results: list[str]) -> bool:
    return 2 * sum(result not in TRUSTED_RESULTS for result in results) <= len(results)


def _read_parameters(
    posterior: Any, levels: tuple[str, ...], covariates: dict[str, dict[str, float]], count: int
) -> PopulationParameters:
    """Rebuild the parameters from an `xarray.Dataset` with the names of `Population.parameters`."""
    size = posterior[SHARED_PARAMETER].size
    chosen = np.linspace(0, size - 1, count).astype(int)
    draws = {str(name): values.values.ravel()[chosen] for name, values in posterior.data_vars.items()}
    components = [name for name in COMPONENTS if f"log_sd_{name}" in draws]
    endings = level_endings(levels)
    mean = np.zeros((count, len(components)))
    mean[:, :2] = np.log(np.stack([draws[name] for name in SKIN], axis=-1))
    for name, each in covariates.items():
        away = each["next_finger"] - each["mean"]
        mean += away * np.stack([draws[f"slope_{component}_{name}"] for component in components], axis=-1)
    log_sd = [np.stack([draws[f"log_sd_{each}{ending}"] for each in components], axis=-1) for ending in endings]
    correlation = np.stack([draws[f"correlation{ending}"] for ending in endings], axis=-1)
    slopes = np.zeros((count, 0, len(components)))
    return PopulationParameters(mean, np.stack(log_sd, axis=1), correlation, np.log(draws[SHARED_PARAMETER]), slopes)
