"""What is found of a population: draws of the law that fingers follow, the next finger, what its force depends on."""

import dataclasses
import functools
import importlib.metadata
import os
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from fitact import summary
from fitact.files import replacing
from fitact.populations.covariates import Covariates
from fitact.populations.finger import SHARED, SKIN, Finger
from fitact.populations.finger_likelihoods import Law
from fitact.populations.hierarchy import Hierarchy
from fitact.populations.next_finger import AREA, NAMES, NewFinger, Spread, draw_factors
from fitact.populations.sobol import Shares, variance_shares
from fitact.sampling.convergence import Convergence
from fitact.scene.scene import Scene
from fitact.units import engineering, unit_of

_LAWS, _FINGERS = 1000, 32  # that new fingers are drawn from, and of each
_IN_TIME, _TIMES = 4000, 256  # new fingers whose force is followed in time, and times
QUANTILES = (0.025, 0.05, 0.25, 0.5, 0.75, 0.95, 0.975)  # of it
OFF = 0.1  # standard deviations of a mean that the fingers' tables may shift it by
SHARED_OUT = ("force_mean", "force_peak")  # whose variance is
SHARES = "factors: the share of the variance that goes once each is known (that stays if only it is not)"


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
    """

    fingers: tuple[Finger, ...]
    hierarchy: Hierarchy
    points: Float[np.ndarray, "ensembles draws n"]
    convergence: Convergence
    off: float
    finger: NewFinger
    covariates: Covariates
    at: Float[np.ndarray, " covariates"]
    scene: Scene
    seed: int

    @property
    def trusted(self) -> bool:
        """Whether nothing stands against the answer; one finger's misfit is named among the warnings."""
        return self.convergence.converged and self.off <= OFF

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences."""
        found = [f"{each.source}: {each.message}" for each in self.fingers if each.result != "successful"]
        if self.convergence.warning:
            found.append(self.convergence.warning)
        if not self.off <= OFF:
            found.append(
                f"the integrals over the fingers may shift means by {self.off:.2g} standard deviations; leave out the"
                " records that leave Rsc and Csc most open"
            )
        if self.hierarchy.area_varies and "I" not in self.scene.measurement.channels:
            found.append("Vsc alone does not show the contact area, so its spread is the prior's; record I, too")
        return tuple(found)

    def parameters(self) -> dict[str, Float[np.ndarray, "ensembles draws"]]:
        """Draws of the law: medians of Rsc (ohm) and Csc (F), Ci (F), log-standard deviations, correlation.

        Where there are covariates, also slopes: by how much log Rsc and log Csc change per unit of each.
        """
        law = self._sampled
        found = {f"log_sd_{name}": law.log_sd[..., i] for i, name in enumerate(SKIN)}
        found |= {} if law.area is None else {"log_sd_area": law.area}
        if law.slopes is not None:
            per_unit = law.slopes / self.covariates.sd[:, None]
            for i, name in enumerate(self.covariates.names):
                found |= {f"slope_{skin}_{name}": per_unit[..., i, j] for j, skin in enumerate(SKIN)}
        return found | {"correlation": law.correlation} | {k: np.exp(x) for k, x in log_medians(law).items()}

    @functools.cached_property
    def _sampled(self) -> Law:
        return laws(self.hierarchy, self.points)

    def new_fingers(self) -> dict[str, Float[np.ndarray, "laws fingers"]]:
        """Draws of fingers to come, some of each of many laws: Rsc, Csc, g, b, force and friction, SI units."""
        return {name: self._new[..., i] for i, name in enumerate(self.finger.names)}

    @functools.cached_property
    def factors(self) -> Float[np.ndarray, "laws fingers factors"]:
        """Logarithms of what makes the new fingers, in the order of `finger.factors`."""
        random = np.random.default_rng([self.seed, 1])
        return draw_factors(drawn_laws(self, _LAWS), self._thickness_sd, _FINGERS, random)

    @property
    def prior_factors(self) -> Float[np.ndarray, "laws fingers factors"]:
        """As `factors`, of fingers of laws that are believed before any record is seen."""
        random = np.random.default_rng([self.seed, 4])
        return draw_factors(self.hierarchy.prior_laws(random, _LAWS).at(self.at), self._thickness_sd, _FINGERS, random)

    @property
    def _thickness_sd(self) -> dict[str, float]:
        return self.scene.population.thickness_sd

    @functools.cached_property
    def _new(self) -> Float[np.ndarray, "laws fingers names"]:
        return self.finger.each(self.factors)

    @functools.cached_property
    def _believed(self) -> Float[np.ndarray, "laws fingers names"]:
        return self.finger.each(self.prior_factors)

    @functools.cached_property
    def shares(self) -> Shares:
        """Of each factor in the variance of the next finger's force; see `variance_shares`."""
        return self._shares_of(self.factors)

    @functools.cached_property
    def prior_shares(self) -> Shares:
        """As `shares`, before any record is seen."""
        return self._shares_of(self.prior_factors)

    def _shares_of(self, factors: Float[np.ndarray, "laws fingers factors"]) -> Shares:
        return variance_shares(self.finger, factors.reshape(-1, factors.shape[-1]), SHARED_OUT, self.seed)

    def to_dict(self) -> dict[str, Any]:
        """What `fitact population --json` prints and population.json holds."""
        new: dict[str, dict[str, Any]] = {}
        for name, values in self.new_fingers().items():
            spread = Spread.of(values)
            shares = {"people": spread.share_of_people, "ignorance": 1.0 - spread.share_of_people}
            new[name] = summary.of_draws(name, values) | {"variance": shares}
        return {
            "population": self._law(),
            "new_finger": new,
            "variance_shares": self.shares,
            "variance_shares_prior": self.prior_shares,
            "fingers": [
                {
                    "record": each.source,
                    "sha256": each.fingerprint,
                    "result": each.result,
                    "message": each.message,
                    "parameters": each.parameters,
                }
                for each in self.fingers
            ],
            "convergence": dataclasses.asdict(self.convergence) | {"sentence": str(self.convergence)},
            "integrals_off": self.off,
            "warnings": list(self.warnings),
            "trusted": self.trusted,
            "seed": self.seed,
            "scene": self.scene.model_dump(mode="json", exclude_unset=True),
            "versions": summary.versions(),
        }

    def _law(self) -> dict[str, Any]:
        """Summaries of the law."""
        draws = self.parameters()
        law: dict[str, Any] = {
            name: {
                "median": summary.of_draws(name, draws[name]),
                "log_sd": summary.of_draws("log_sd", draws[f"log_sd_{name}"]),
            }
            for name in SKIN
        }
        law |= {name: summary.of_draws(name, draws[name]) for name in (SHARED, "correlation")}
        if self.hierarchy.area_varies:
            law[AREA] = {"log_sd": summary.of_draws("log_sd", draws["log_sd_area"])}
        law["covariates"] = {
            name: {"mean": float(mean), "sd": float(sd), "next_finger": float(mean + at * sd)}
            | {skin: {"slope": summary.of_draws("slope", draws[f"slope_{skin}_{name}"])} for skin in SKIN}
            for name, mean, sd, at in zip(
                self.covariates.names, self.covariates.mean, self.covariates.sd, self.at, strict=True
            )
        }
        return law

    def summary(self) -> str:
        """A table for people, what the force's variance depends on, and warnings."""
        content = self.to_dict()
        rows = [f"{name:26}{median:>12}{low:>14}{high:>12}" for name, median, low, high in table(content)]
        rows += [*variance_sentences(content), SHARES, str(self.convergence)]
        return "\n".join([*rows, *(f"warning: {warning}" for warning in self.warnings)])

    __str__ = summary

    @functools.cached_property
    def force_in_time(self) -> tuple[Float[np.ndarray, " times"], Float[np.ndarray, "quantiles times"]]:
        """Times (s) of a period (all of a drive without one), and `QUANTILES` of the next finger's force (N)."""
        factors = self.factors.reshape(-1, len(self.finger.factors))
        time, force = self.finger.force_in_time(factors[:: max(1, len(factors) // _IN_TIME)], _TIMES)
        return time, np.quantile(force, QUANTILES, axis=0)

    def to_datatree(self) -> Any:
        """An `xarray.DataTree`: the law's draws in ArviZ's `posterior`, and `new_fingers` with their `factors`.

        Beside them the force of fingers before any record, `prior_new_fingers`, and of those to come, `force_in_time`.
        """
        import xarray as xr

        def dataset(draws: dict[str, np.ndarray], dims: tuple[str, str]) -> xr.Dataset:
            return xr.Dataset({name: (dims, values, {"units": _unit(name)}) for name, values in draws.items()})

        drawn = dataset(self.new_fingers(), ("law", "finger"))
        drawn["log_factors"] = ("law", "finger", "factor"), self.factors
        prior = {name: self._believed[..., self.finger.names.index(name)] for name in SHARED_OUT}
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
                "new_fingers": drawn.assign_coords(factor=list(self.finger.factors)),
                "prior_new_fingers": dataset(prior, ("law", "finger")),
                "force_in_time": in_time,
            }
        )

    def to_netcdf(self, path: str | os.PathLike[str]) -> None:
        """Write `to_datatree()` as NetCDF."""
        with replacing(path) as temporary:
            self.to_datatree().to_netcdf(temporary, engine="h5netcdf")


def table(content: dict[str, Any]) -> tuple[tuple[str, ...], ...]:
    """Titles; then the law and the next finger of what population.json holds, for people."""
    law, new = content["population"], content["new_finger"]
    shown = {f"{name}, {key}": s for name in SKIN for key, s in law[name].items()}
    shown |= {name: law[name] for name in (SHARED, "correlation")}
    if AREA in law:
        shown["contact area, log_sd"] = law[AREA]["log_sd"]
    shown |= {f"{skin}, slope in {name}": of[skin]["slope"] for name, of in law["covariates"].items() for skin in SKIN}
    shown |= {f"next finger, {name}": new[name] for name in NAMES}
    rows = ((name, *(engineering(s[q], s["unit"]) for q in ("q50", "q025", "q975"))) for name, s in shown.items())
    return (f"{len(content['fingers'])} fingers", "median", "2.5 %", "97.5 %"), *rows


def variance_sentences(content: dict[str, Any]) -> tuple[str, ...]:
    """What the variance of the next finger's force comes from, by what population.json holds."""
    found = []
    for name in SHARED_OUT:
        people = 100.0 * content["new_finger"][name]["variance"]["people"]
        parts = (
            f"{factor} {100.0 * share['first']:.0f} % ({100.0 * share['total']:.0f} %)"
            for factor, share in content["variance_shares"][name].items()
        )
        found.append(f"variance of {name}: {people:.0f} % people, the rest ignorance; {', '.join(parts)}")
    return tuple(found)


def laws(hierarchy: Hierarchy, points: Float[np.ndarray, "chains draws n"]) -> Law:
    """At many points."""
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, jax.jit(jax.vmap(jax.vmap(hierarchy.law)))(points))


def drawn_laws(population: Population, count: int) -> Law:
    """So many draws of the law that the next finger follows, spread over the chain; leaves (count, 1)."""
    flat = population.points.reshape(-1, population.points.shape[-1])
    drawn = flat[np.linspace(0, len(flat) - 1, count).astype(int), None]
    return laws(population.hierarchy, drawn).at(population.at)


def log_medians(law: Law) -> dict[str, np.ndarray]:
    """Logarithms of Rsc, Csc and Ci."""
    return {"Rsc": law.median[..., 0], "Csc": law.median[..., 1], SHARED: law.log_Ci}


def _unit(name: str) -> str:
    return "1" if name.startswith(("log_sd", "slope")) else unit_of(name)
