"""Result of a population fit: draws of the population parameters, the next finger, and its variance by source."""

import dataclasses
import functools
import importlib.metadata
import math
import os
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from fitact import charts, summary
from fitact.compiled import jit
from fitact.files import atomic_write
from fitact.populations.contact_area import ContactAreaTest
from fitact.populations.covariates import Covariates
from fitact.populations.finger import SHARED_PARAMETER, SKIN, Finger
from fitact.populations.finger_likelihoods import PopulationParameters
from fitact.populations.hierarchy import Hierarchy
from fitact.populations.next_finger import (
    AREA,
    NAMES,
    NewFingerModel,
    draw_factors,
    finger_variance_fraction,
    intrafinger_variance_fraction,
)
from fitact.populations.sobol import SobolIndices, variance_shares
from fitact.populations.within_finger import WithinFinger
from fitact.sampling.convergence import Convergence
from fitact.sampling.posterior import convert_to_arviz
from fitact.scene.scene import Scene
from fitact.tables import Display, align_table, join_lines, to_dataframe, to_dataset, to_datatree
from fitact.units import choose_prefixed_unit, format_engineering, format_percent, quantity_unit

QUANTILES = tuple(summary.PROBABILITIES.values())  # of the force in time
MAX_INTEGRATION_ERROR = 0.1  # largest shift of a mean by the fingers' tables, in posterior standard deviations
VARIANCE_QUANTITIES = ("force_mean", "force_peak")  # quantities with Sobol indices
ADVICE = "use track"  # in the message of a fit that shows a finger that changes
SHARES_LEGEND = "Parameters: Sobol indices, first-order (total)."


@dataclasses.dataclass(frozen=True, repr=False)
class Population(Display):
    """Draws of the population parameters, and of new fingers.

    Attributes:
        fingers: fit of each record by itself.
        hierarchy: posterior of the population parameters.
        points: draws in the coordinates of `hierarchy`.
        convergence: diagnostics of these draws.
        off: largest shift of a mean by the integrals over the fingers, in posterior standard deviations.
        finger: model of the next finger, under the first record's drive.
        covariates: covariates of the fingers; may be empty.
        at: covariates of the next finger, in standard deviations from the mean.
        scene: scene of all records.
        seed: seed of all random numbers.
        within: variation within tracked fingers; None means that none was tracked.
        laws, fingers_per_law: number of population samples for new fingers, and of new fingers for each.
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
    within: WithinFinger | None = None
    laws: int = 1000
    fingers_per_law: int = 32

    @property
    def trusted(self) -> bool:
        """Whether the result is reliable; a misfit of one finger is a warning only."""
        return self.convergence.converged and self.off <= MAX_INTEGRATION_ERROR

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences on conditions that may change the result."""
        sentences = [
            f"{finger.source}: {finger.message}"
            for finger in self.fingers
            if finger.result not in summary.TRUSTED_RESULTS or ADVICE in finger.message
        ]
        if self.convergence.warning:
            sentences.append(self.convergence.warning)
        if not self.off <= MAX_INTEGRATION_ERROR:
            sentences.append(
                f"the integrals over the fingers may shift means by {self.off:.2g} standard deviations; leave out the"
                " records that constrain Rsc and Csc least"
            )
        if self.hierarchy.area_varies and not self.contact_area.is_tested:
            sentences.append(
                "these records do not determine the contact area, so its standard deviation is the prior's; record I,"
                " too, or an impedance"
            )
        if self.contact_area.disagrees:
            sentences.append(self.contact_area.sentence)
        return tuple(sentences)

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences that inform."""
        skin = self.scene.skin
        origin = "stated" if "thickness" in skin.model_fields_set else "the default"
        thickness = f"the skin thickness {format_engineering(skin.thickness, 'm')} ({origin})"
        excluded = (
            f"the uncertainty of that law; {thickness} varies between fingers"
            if "skin_thickness" in self.scene.thickness_sd()
            else f"the uncertainty of that law and of {thickness}"
        )
        sentences = [
            f"the force is computed with [force] model = '{self.scene.force.model}', not measured; its intervals"
            f" exclude {excluded}"
        ]
        if "friction" not in self.scene.model_fields_set:
            friction = self.scene.friction
            sentences.append(
                f"friction uses the default coefficient {friction.coefficient:g} and normal force"
                f" {format_engineering(friction.normal_force, 'N')}, which the scene does not state"
            )
        measured = self.scene.measurement
        if self.scene.instrument.is_stated or measured.gain_relative_sd or measured.gain_I_relative_sd:
            sentences.append(
                "errors of the instruments are the same for all fingers: they do not add to the differences between"
                " fingers, and the medians and forces do not include them (fitact fit of one record gives their size)"
            )
        if self.within is not None:
            sentences += self.within.describe_assumptions(len(self.fingers))
        area = self.contact_area
        return tuple(sentences) if area.disagrees else (*sentences, area.sentence)

    @functools.cached_property
    def contact_area(self) -> ContactAreaTest:
        """Test of the assumption that all fingers have the same contact area."""
        prior, scene = self.hierarchy.prior[SHARED_PARAMETER], self.scene
        return ContactAreaTest.from_fingers(
            self.fingers, prior, scene.population.contact_area, math.log1p(scene.tolerance.force)
        )

    def parameters(self) -> dict[str, Float[np.ndarray, "ensembles draws"]]:
        """Return draws of the population parameters.

        These are the medians of Rsc (ohm) and Csc (F), Ci (F), log-standard deviations and correlation. With covariates
        also slopes: change of log Rsc and log Csc per unit of each covariate.
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
        """Return draws of new fingers from each population sample: Rsc, Csc, g, b, force and friction, SI units."""
        return {name: self._new_predictions[0, ..., i] for i, name in enumerate(self.finger.names)}

    @property
    def factors(self) -> Float[np.ndarray, "laws fingers factors"]:
        """Logarithms of the factors of new fingers, in the order of `finger.factors`; of tracked ones at one moment."""
        return self._moments[0]

    @functools.cached_property
    def _moments(self) -> Float[np.ndarray, "moments laws fingers factors"]:
        """Factors of new fingers at one moment, and of the same fingers at another one if fingers were tracked."""
        random = np.random.default_rng([self.seed, 1])
        factors = self._draw_factors(random, draw_parameters(self, self.laws))
        if self.within is None:
            return factors[None]
        moments = np.stack([factors, factors])
        moments[..., :3] += self.within.draw_deviations(moments.shape[:3], random)
        return moments

    @property
    def prior_factors(self) -> Float[np.ndarray, "laws fingers factors"]:
        """Logarithms of the factors of fingers from the prior of the population parameters."""
        random = np.random.default_rng([self.seed, 4])
        laws = self.hierarchy.sample_prior(random, self.laws).shift_medians(self.at)
        return self._draw_factors(random, laws)

    def _draw_factors(
        self, random: np.random.Generator, parameters: PopulationParameters
    ) -> Float[np.ndarray, "laws fingers factors"]:
        return draw_factors(parameters, self.scene.thickness_sd(), self.fingers_per_law, random)

    @functools.cached_property
    def _new_predictions(self) -> Float[np.ndarray, "moments laws fingers names"]:
        return self.finger.evaluate(self._moments)

    @functools.cached_property
    def _prior_predictions(self) -> Float[np.ndarray, "laws fingers names"]:
        return self.finger.evaluate(self.prior_factors)

    @functools.cached_property
    def shares(self) -> SobolIndices:
        """Sobol indices of the next finger's force; see `variance_shares`."""
        return self._sobol_indices(self.factors)

    @functools.cached_property
    def prior_shares(self) -> SobolIndices:
        """Sobol indices before any record, from the prior."""
        return self._sobol_indices(self.prior_factors)

    def _sobol_indices(self, factors: Float[np.ndarray, "laws fingers factors"]) -> SobolIndices:
        return variance_shares(self.finger, factors.reshape(-1, factors.shape[-1]), VARIANCE_QUANTITIES, self.seed)

    def to_dict(self) -> dict[str, Any]:
        """Return the content of population.json, which `fitact population --json` prints."""
        new: dict[str, dict[str, Any]] = {}
        for i, (name, values) in enumerate(self.new_fingers().items()):
            people = finger_variance_fraction(values)
            shares = {"people": people, "ignorance": 1.0 - people}
            if self.within is not None:
                within = people * intrafinger_variance_fraction(self._new_predictions[..., i])
                shares |= {"within_finger": within, "between_fingers": people - within}
                shares |= {"population_parameters": 1.0 - people}
            new[name] = summary.summarize_draws(name, values) | {"variance": shares}
        return {
            "population": self._parameter_summaries(),
            "new_finger": new,
            **({} if self.within is None else self.within.to_dict()),
            "variance_shares": self.shares,
            "variance_shares_prior": self.prior_shares,
            "fingers": [
                {"record": finger.source, "sha256": finger.fingerprint, "result": finger.result}
                | {"message": finger.message, "parameters": finger.parameters}
                for finger in self.fingers
            ],
            "convergence": dataclasses.asdict(self.convergence) | {"sentence": str(self.convergence)},
            "integrals_off": self.off,
            "contact_area": self.contact_area.to_dict(),
            "warnings": list(self.warnings),
            "notes": list(self.notes),
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
        """Return the table for people, the variance of the force by source, notes and warnings."""
        content = self.to_dict()
        rows = align_table(population_table(content))
        rows += [*variance_sentences(content), SHARES_LEGEND, str(self.convergence)]
        return join_lines(rows, self.warnings, self.notes)

    __str__ = summary

    @functools.cached_property
    def force_in_time(self) -> tuple[Float[np.ndarray, " times"], Float[np.ndarray, "quantiles times"]]:
        """Times (s) of one period, or of a whole aperiodic drive, and `QUANTILES` of the next finger's force (N)."""
        factors = self.factors.reshape(-1, len(self.finger.factors))
        some = factors[:: max(1, len(factors) // 4000)]  # enough draws for the outermost quantiles
        time, force = self.finger.force_in_time(some, count=256)
        return time, np.quantile(force, QUANTILES, axis=0)

    def to_datatree(self) -> Any:
        """Return an `xarray.DataTree` with ArviZ's `posterior`, and `new_fingers` with their `factors`.

        It also holds the force of fingers from the prior, `prior_new_fingers`, and of new fingers, `force_in_time`.
        """

        def dataset(draws: dict[str, np.ndarray], dims: tuple[str, str]) -> Any:
            units = {name: "1" if name.startswith(("log_sd", "slope")) else quantity_unit(name) for name in draws}
            return to_dataset({name: (dims, values, {"units": units[name]}) for name, values in draws.items()})

        new_fingers = dataset(self.new_fingers(), ("law", "finger"))
        new_fingers["log_factors"] = ("law", "finger", "factor"), self.factors
        prior = {name: self._prior_predictions[..., self.finger.names.index(name)] for name in VARIANCE_QUANTITIES}
        time, force = self.force_in_time
        friction = {
            "friction_coefficient": float(self.finger.derive.coefficient),
            "normal_force": float(self.finger.derive.normal_force),
            "periodic": int(self.finger.frequency is not None),
        }
        in_time = to_dataset(
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
        return to_datatree(
            {
                "/": to_dataset({}, attributes=about),
                "posterior": dataset(self.parameters(), ("chain", "draw")),
                "new_fingers": new_fingers.assign_coords(factor=list(self.finger.factors)),
                "prior_new_fingers": dataset(prior, ("law", "finger")),
                "force_in_time": in_time,
            }
        )

    def to_arviz(self) -> Any:
        """Return ArviZ's object of `to_datatree()`: an `InferenceData`, or from ArviZ 1 on the DataTree itself."""
        return convert_to_arviz(self.to_datatree())

    def to_dataframe(self) -> Any:
        """Return a pandas DataFrame with a row for each finger, fitted by itself.

        The index is the record; columns are the result, and for Rsc, Csc and Ci the median (SI) and, with the ending
        _sd, the standard deviation.
        """
        rows = {}
        for finger in self.fingers:
            estimates = {name: finger.parameters[name] for name in (*SKIN, SHARED_PARAMETER)}
            columns = [(name, each["q50"], each["sd"]) for name, each in estimates.items()]
            values = {key: x for name, median, sd in columns for key, x in ((name, median), (f"{name}_sd", sd))}
            rows[finger.source] = {"result": finger.result, **values}
        return to_dataframe(rows, orient="index")

    def plot(self) -> Any:
        """Draw the fingers, the force on the next one and over time, and the sources of variance; return the axes."""
        figure = charts.draw_population(self.to_datatree(), self.to_dict(), make=charts.pyplot_figure)
        figure.supxlabel(f"Force: {self._force_law}.", fontsize=9.0)
        return np.array(figure.axes)

    @property
    def _force_law(self) -> str:
        return f"computed {summary.FORCE_LAWS[self.scene.force.model]} and not measured"

    @property
    def _headline(self) -> str:
        law = self._parameter_draws
        medians = {name: summary.summarize_draws(name, np.exp(x)) for name, x in log_medians(law).items()}
        state = "reliable" if self.trusted else "unreliable"
        return f"{len(self.fingers)} fingers, medians {summary.format_estimates(medians)}, {state}"

    def _rows(self) -> tuple[tuple[str, ...], ...]:
        return population_table(self.to_dict())

    def _sentences(self) -> tuple[str, ...]:
        return str(self.convergence), f"Force on the next finger: {self._force_law}."

    def to_netcdf(self, path: str | os.PathLike[str]) -> None:
        """Write `to_datatree()` as NetCDF."""
        with atomic_write(path) as temporary:
            self.to_datatree().to_netcdf(temporary, engine="h5netcdf")


def population_table(content: dict[str, Any]) -> tuple[tuple[str, ...], ...]:
    """Return titles, then rows of the population and the next finger from population.json, for people."""
    law, new = content["population"], content["new_finger"]
    shown = {f"{name}, {key}": s for name in SKIN for key, s in law[name].items()}
    shown |= {name: law[name] for name in (SHARED_PARAMETER, "correlation")}
    if AREA in law:
        shown["contact area, log_sd"] = law[AREA]["log_sd"]
    shown |= {f"{skin}, slope in {name}": x[skin]["slope"] for name, x in law["covariates"].items() for skin in SKIN}
    within = content.get("within_finger", {})
    shown |= {f"within a finger, {name}, log_sd": each["log_sd"] for name, each in within.items()}
    shown |= {f"next finger, {name}": new[name] for name in NAMES}
    rows = [(name, *format_quantiles(s)) for name, s in shown.items()]
    if "friction" not in content["scene"]:  # two defaults give it, so more digits would mislead
        name, s = "next finger, friction_mean", new["friction_mean"]
        cells = (format_engineering(float(f"{s[key]:.2g}"), s["unit"], 3) for key in ("q50", "q025", "q975"))
        rows = [(name, *cells) if row[0] == name else row for row in rows]
    if AREA not in law:
        rows.insert(len(rows) - len(NAMES), ("contact area", "common", "(assumed)", ""))
    return (f"{len(content['fingers'])} fingers", "median", "2.5 % quantile", "97.5 % quantile"), *rows


def format_quantiles(s: dict[str, Any], keys: Sequence[str] = ("q50", "q025", "q975")) -> list[str]:
    """Format quantiles of a summary to the place of the second digit of its standard deviation, at most 4 digits."""
    median, sd, unit = float(s["q50"]), float(s["sd"]), s["unit"]
    if not 0.0 < sd <= 0.5 * abs(median):
        return [format_engineering(float(f"{s[key]:.2g}"), unit, 3) for key in keys]
    digits = min(4, math.floor(math.log10(abs(median))) - math.floor(math.log10(float(f"{sd:.1e}"))) + 2)
    size, symbol = choose_prefixed_unit(median, unit)
    places = max(0, digits - 1 - math.floor(math.log10(abs(median) / size)))
    return [f"{float(s[key]) / size:.{places}f} {symbol}".rstrip() for key in keys]


def format_variance_part(fraction: float) -> str:
    """Format a part of a variance in whole per cent, and a smaller one with two digits."""
    return format_percent(fraction) if 0.0 < fraction < 0.01 else f"{100.0 * fraction:.0f} %"


def variance_sentences(content: dict[str, Any]) -> tuple[str, ...]:
    """Return sentences on the sources of variance of the next finger's force, from population.json."""
    sentences = []
    for name in VARIANCE_QUANTITIES:
        variance = content["new_finger"][name]["variance"]
        sources = {
            "within_finger": "from changes within a finger",
            "between_fingers" if "within_finger" in variance else "people": "from differences between fingers",
            "ignorance": "from uncertainty of the population parameters",
        }
        sizes = ", ".join(
            f"{format_variance_part(variance[part])} {text}" for part, text in sources.items() if part in variance
        )
        parts = (
            f"{factor} {round(100.0 * share['first'])} % ({round(100.0 * share['total'])} %)"
            for factor, share in content["variance_shares"][name].items()
        )
        sentences.append(f"Variance of {name}: {sizes}; Sobol indices {', '.join(parts)}")
    return tuple(sentences)


@jit
def evaluate_parameters(hierarchy: Hierarchy, points: Float[Array, "chains draws n"]) -> PopulationParameters:
    return jax.vmap(jax.vmap(hierarchy.population_parameters))(points)


def draw_parameters(population: Population, count: int) -> PopulationParameters:
    """Take `count` draws of the next finger's population parameters, spread over the chain; leaves (count, 1)."""
    flat = population.points.reshape(-1, population.points.shape[-1])
    points = flat[np.linspace(0, len(flat) - 1, count).astype(int), None]
    return evaluate_parameters(population.hierarchy, points).shift_medians(population.at)


def log_medians(parameters: PopulationParameters) -> dict[str, np.ndarray]:
    return {"Rsc": parameters.median[..., 0], "Csc": parameters.median[..., 1], SHARED_PARAMETER: parameters.log_Ci}
