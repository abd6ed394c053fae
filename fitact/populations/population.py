"""The answer for a population: draws of the law that fingers follow, the next finger, what its force depends on."""

import dataclasses
import functools
import importlib.metadata
import os
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from fitact import summary
from fitact.files import atomic_write
from fitact.populations.covariates import Covariates
from fitact.populations.finger import SHARED_PARAMETER, SKIN, Finger
from fitact.populations.finger_likelihoods import PopulationParameters
from fitact.populations.hierarchy import Hierarchy
from fitact.populations.next_finger import AREA, NAMES, NewFingerModel, VarianceDecomposition, draw_factors
from fitact.populations.sobol import SobolIndices, variance_shares
from fitact.sampling.convergence import Convergence
from fitact.scene.scene import Scene
from fitact.tables import align_rows, join_lines
from fitact.units import format_engineering, quantity_unit

QUANTILES = tuple(summary.PROBABILITIES.values())  # of the force in time
MAX_INTEGRATION_ERROR = 0.1  # standard deviations of a mean that the fingers' tables may shift it by
VARIANCE_QUANTITIES = ("force_mean", "force_peak")  # whose variance is shared out
SHARES_LEGEND = "factors: the share of the variance that goes once each is known (that stays if only it is not)"


@dataclasses.dataclass(frozen=True)
class Population:
    """Draws of the law that fingers follow, and of fingers to come.

    Attributes:
        fingers: each record's fit by itself.
        hierarchy: the law's posterior.
        points: draws in the coordinates of `hierarchy`.
        convergence: how far they can be trusted.
        off: by how much, at most, the integrals over the fingers shift any mean, in standard deviations.
        finger: the next one, under the first record's drive.
        covariates: of the fingers; may be none.
        at: those of the next finger, in standard deviations from the mean.
        scene: of all records.
        seed: of every random number here.
        laws, fingers_per_law: that new fingers are drawn of.
    """

    fingers: tuple[Finger, ...]
    hierarchy: Hierarchy
    points: Float[np.ndarray, "ensembles draws n"]
    convergence: Convergence
    off: float
    finger: NewFingerModel
    covariates: Covariates
    at: Float[np.ndarray, " covariates"]
    scene: Scene
    seed: int
    laws: int = 1000
    fingers_per_law: int = 32

    @property
    def trusted(self) -> bool:
        """Whether nothing stands against the answer; one finger's misfit is named among the warnings."""
        return self.convergence.converged and self.off <= MAX_INTEGRATION_ERROR

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences."""
        sentences = [f"{finger.source}: {finger.message}" for finger in self.fingers if finger.result != "successful"]
        if self.convergence.warning:
            sentences.append(self.convergence.warning)
        if not self.off <= MAX_INTEGRATION_ERROR:
            sentences.append(
                f"the integrals over the fingers may shift means by {self.off:.2g} standard deviations; leave out the"
                " records that leave Rsc and Csc most open"
            )
        if self.hierarchy.area_varies and "I" not in self.scene.measurement.channels:
            sentences.append("Vsc alone does not show the contact area, so its spread is the prior's; record I, too")
        return tuple(sentences)

    def parameters(self) -> dict[str, Float[np.ndarray, "ensembles draws"]]:
        """Draws of the law: medians of Rsc (ohm) and Csc (F), Ci (F), log-standard deviations, correlation.

        Where there are covariates, also slopes: by how much log Rsc and log Csc change per unit of each.
        """
        law = self._parameter_draws
        draws = {f"log_sd_{name}": law.log_sd[..., i] for i, name in enumerate(SKIN)}
        draws |= {} if law.area is None else {"log_sd_area": law.area}
        if law.slopes is not None:
            per_unit = law.slopes / self.covariates.sd[:, None]
            for i, name in enumerate(self.covariates.names):
                draws |= {f"slope_{skin}_{name}": per_unit[..., i, j] for j, skin in enumerate(SKIN)}
        return draws | {"correlation": law.correlation} | {k: np.exp(x) for k, x in log_medians(law).items()}

    @functools.cached_property
    def _parameter_draws(self) -> PopulationParameters:
        return evaluate_parameters(self.hierarchy, self.points)

    def new_fingers(self) -> dict[str, Float[np.ndarray, "laws fingers"]]:
        """Draws of fingers to come, some of each of many laws: Rsc, Csc, g, b, force and friction, SI units."""
        return {name: self._new_predictions[..., i] for i, name in enumerate(self.finger.names)}

    @functools.cached_property
    def factors(self) -> Float[np.ndarray, "laws fingers factors"]:
        """Logarithms of what makes the new fingers, in the order of `finger.factors`."""
        return self._draw_factors(np.random.default_rng([self.seed, 1]), draw_parameters(self, self.laws))

    @property
    def prior_factors(self) -> Float[np.ndarray, "laws fingers factors"]:
        """Logarithms as in `factors`, of fingers of laws that are believed before any record is seen."""
        random = np.random.default_rng([self.seed, 4])
        laws = self.hierarchy.sample_prior(random, self.laws).shift_medians(self.at)
        return self._draw_factors(random, laws)

    def _draw_factors(
        self, random: np.random.Generator, parameters: PopulationParameters
    ) -> Float[np.ndarray, "laws fingers factors"]:
        return draw_factors(parameters, self.scene.population.thickness_sd, self.fingers_per_law, random)

    @functools.cached_property
    def _new_predictions(self) -> Float[np.ndarray, "laws fingers names"]:
        return self.finger.evaluate(self.factors)

    @functools.cached_property
    def _prior_predictions(self) -> Float[np.ndarray, "laws fingers names"]:
        return self.finger.evaluate(self.prior_factors)

    @functools.cached_property
    def shares(self) -> SobolIndices:
        """Shares of each factor in the variance of the next finger's force; see `variance_shares`."""
        return self._sobol_indices(self.factors)

    @functools.cached_property
    def prior_shares(self) -> SobolIndices:
        """Shares as `shares` has them, before any record is seen."""
        return self._sobol_indices(self.prior_factors)

    def _sobol_indices(self, factors: Float[np.ndarray, "laws fingers factors"]) -> SobolIndices:
        return variance_shares(self.finger, factors.reshape(-1, factors.shape[-1]), VARIANCE_QUANTITIES, self.seed)

    def to_dict(self) -> dict[str, Any]:
        """Make the content of population.json, which `fitact population --json` prints."""
        new: dict[str, dict[str, Any]] = {}
        for name, values in self.new_fingers().items():
            people = VarianceDecomposition.from_draws(values).between_finger_fraction
            shares = {"people": people, "ignorance": 1.0 - people}
            new[name] = summary.summarize_draws(name, values) | {"variance": shares}
        return {
            "population": self._parameter_summaries(),
            "new_finger": new,
            "variance_shares": self.shares,
            "variance_shares_prior": self.prior_shares,
            "fingers": [
                {
                    "record": finger.source,
                    "sha256": finger.fingerprint,
                    "result": finger.result,
                    "message": finger.message,
                    "parameters": finger.parameters,
                }
                for finger in self.fingers
            ],
            "convergence": dataclasses.asdict(self.convergence) | {"sentence": str(self.convergence)},
            "integrals_off": self.off,
            "warnings": list(self.warnings),
            "trusted": self.trusted,
            "seed": self.seed,
            "scene": self.scene.model_dump(mode="json", exclude_unset=True),
            "versions": summary.versions(),
        }

    def _parameter_summaries(self) -> dict[str, Any]:
        draws = self.parameters()
        law: dict[str, Any] = {
            name: {
                "median": summary.summarize_draws(name, draws[name]),
                "log_sd": summary.summarize_draws("log_sd", draws[f"log_sd_{name}"]),
            }
            for name in SKIN
        }
        law |= {name: summary.summarize_draws(name, draws[name]) for name in (SHARED_PARAMETER, "correlation")}
        if self.hierarchy.area_varies:
            law[AREA] = {"log_sd": summary.summarize_draws("log_sd", draws["log_sd_area"])}
        law["covariates"] = {
            name: {"mean": float(mean), "sd": float(sd), "next_finger": float(mean + at * sd)}
            | {skin: {"slope": summary.summarize_draws("slope", draws[f"slope_{skin}_{name}"])} for skin in SKIN}
            for name, mean, sd, at in zip(
                self.covariates.names, self.covariates.mean, self.covariates.sd, self.at, strict=True
            )
        }
        return law

    def summary(self) -> str:
        """A table for people, what the force's variance depends on, and warnings."""
        content = self.to_dict()
        rows = align_rows(population_table(content), (26, 12, 14, 12))
        rows += [*variance_sentences(content), SHARES_LEGEND, str(self.convergence)]
        return join_lines(rows, self.warnings)

    __str__ = summary

    @functools.cached_property
    def force_in_time(self) -> tuple[Float[np.ndarray, " times"], Float[np.ndarray, "quantiles times"]]:
        """Times (s) of a period (all of a drive without one), and `QUANTILES` of the next finger's force (N)."""
        factors = self.factors.reshape(-1, len(self.finger.factors))
        some = factors[:: max(1, len(factors) // 4000)]  # enough for the outermost quantiles
        time, force = self.finger.force_in_time(some, count=256)
        return time, np.quantile(force, QUANTILES, axis=0)

    def to_datatree(self) -> Any:
        """An `xarray.DataTree`: the law's draws in ArviZ's `posterior`, and `new_fingers` with their `factors`.

        Beside them the force of fingers before any record, `prior_new_fingers`, and of those to come, `force_in_time`.
        """
        import xarray as xr

        def dataset(draws: dict[str, np.ndarray], dims: tuple[str, str]) -> xr.Dataset:
            return xr.Dataset({name: (dims, values, {"units": _unit(name)}) for name, values in draws.items()})

        new_fingers = dataset(self.new_fingers(), ("law", "finger"))
        new_fingers["log_factors"] = ("law", "finger", "factor"), self.factors
        prior = {name: self._prior_predictions[..., self.finger.names.index(name)] for name in VARIANCE_QUANTITIES}
        time, force = self.force_in_time
        friction = {
            "friction_coefficient": float(self.finger.derive.coefficient),
            "normal_force": float(self.finger.derive.normal_force),
            "periodic": int(self.finger.frequency is not None),
        }
        in_time = xr.Dataset(
            {"force": (("quantile", "time"), force, {"units": "N"})},
            {"quantile": list(QUANTILES), "time": ("time", time, {"units": "s"})},
            friction,
        )
        about = {
            "inference_library": "fitact",
            "inference_library_version": importlib.metadata.version("fitact"),
            "scene": self.scene.to_json(),
            "seed": self.seed,
        }
        return xr.DataTree.from_dict(
            {
                "/": xr.Dataset(attrs=about),
                "posterior": dataset(self.parameters(), ("chain", "draw")),
                "new_fingers": new_fingers.assign_coords(factor=list(self.finger.factors)),
                "prior_new_fingers": dataset(prior, ("law", "finger")),
                "force_in_time": in_time,
            }
        )

    def to_netcdf(self, path: str | os.PathLike[str]) -> None:
        """Write `to_datatree()` as NetCDF."""
        with atomic_write(path) as temporary:
            self.to_datatree().to_netcdf(temporary, engine="h5netcdf")


def population_table(content: dict[str, Any]) -> tuple[tuple[str, ...], ...]:
    """Lay out titles, then the law and the next finger of what population.json holds, for people."""
    law, new = content["population"], content["new_finger"]
    shown = {f"{name}, {key}": s for name in SKIN for key, s in law[name].items()}
    shown |= {name: law[name] for name in (SHARED_PARAMETER, "correlation")}
    if AREA in law:
        shown["contact area, log_sd"] = law[AREA]["log_sd"]
    shown |= {f"{skin}, slope in {name}": x[skin]["slope"] for name, x in law["covariates"].items() for skin in SKIN}
    shown |= {f"next finger, {name}": new[name] for name in NAMES}
    rows = (
        (name, *(format_engineering(s[q], s["unit"]) for q in ("q50", "q025", "q975"))) for name, s in shown.items()
    )
    return (f"{len(content['fingers'])} fingers", "median", "2.5 %", "97.5 %"), *rows


def variance_sentences(content: dict[str, Any]) -> tuple[str, ...]:
    """Say what the variance of the next finger's force comes from, by what population.json holds."""
    sentences = []
    for name in VARIANCE_QUANTITIES:
        people = 100.0 * content["new_finger"][name]["variance"]["people"]
        parts = (
            f"{factor} {100.0 * share['first']:.0f} % ({100.0 * share['total']:.0f} %)"
            for factor, share in content["variance_shares"][name].items()
        )
        sentences.append(f"variance of {name}: {people:.0f} % people, the rest ignorance; {', '.join(parts)}")
    return tuple(sentences)


def evaluate_parameters(hierarchy: Hierarchy, points: Float[np.ndarray, "chains draws n"]) -> PopulationParameters:
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, jax.jit(jax.vmap(jax.vmap(hierarchy.population_parameters)))(points))


def draw_parameters(population: Population, count: int) -> PopulationParameters:
    """Take `count` draws of the law that the next finger follows, spread over the chain; leaves (count, 1)."""
    flat = population.points.reshape(-1, population.points.shape[-1])
    points = flat[np.linspace(0, len(flat) - 1, count).astype(int), None]
    return evaluate_parameters(population.hierarchy, points).shift_medians(population.at)


def log_medians(parameters: PopulationParameters) -> dict[str, np.ndarray]:
    return {"Rsc": parameters.median[..., 0], "Csc": parameters.median[..., 1], SHARED_PARAMETER: parameters.log_Ci}


def _unit(name: str) -> str:
    return "1" if name.startswith(("log_sd", "slope")) else quantity_unit(name)
