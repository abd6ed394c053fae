"""Result of a population fit: draws of the population parameters, the next finger, and its variance by source."""

import dataclasses
import functools
import importlib.metadata
import os
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from fitact import charts, result_text, summary
from fitact.compiled import BatchEvaluator, jit
from fitact.files import atomic_write
from fitact.populations.contact_area import ContactAreaTest
from fitact.populations.covariates import Covariates
from fitact.populations.exact_likelihood import MAX_INTEGRATION_ERROR
from fitact.populations.finger import SHARED_PARAMETER, SKIN, Finger
from fitact.populations.hierarchy import AREA, Hierarchy
from fitact.populations.next_finger import (
    NAMES,
    NewFingerModel,
    draw_thicknesses,
    finger_variance_fraction,
    redrawn_variance_fraction,
)
from fitact.populations.population_parameters import COMPONENTS, PopulationParameters, level_endings
from fitact.populations.population_text import (
    SHARES_LEGEND,
    UNIT_NAMES,
    VARIANCE_QUANTITIES,
    describe_factor,
    describe_units,
    population_table,
    study_table,
    variance_sentences,
)
from fitact.populations.repeatability import LevelVariances
from fitact.populations.sobol import SobolIndices, variance_shares
from fitact.populations.within_finger import WithinFinger
from fitact.readers.study import Nesting
from fitact.sampling.convergence import Convergence
from fitact.sampling.posterior import convert_to_arviz
from fitact.scene.scene import Scene
from fitact.tables import Display, align_table, join_lines, to_dataframe, to_dataset, to_datatree
from fitact.units import format_engineering, quantity_unit

QUANTILES = tuple(summary.PROBABILITIES.values())  # of the force in time
ADVICE = "use track"  # in the message of a fit that shows a finger that changes


@dataclasses.dataclass(frozen=True, repr=False)
class Population(Display):
    """Draws of the population parameters, and of new fingers.

    Attributes:
        fingers: fit of each record by itself.
        nesting: person, finger, session and repetition of each record, as far as these are levels.
        hierarchy: posterior of the population parameters.
        points: draws in the coordinates of `hierarchy`.
        convergence: diagnostics of these draws.
        off: largest shift of a mean by the error of the records' likelihoods, in posterior standard deviations.
        finger: model of the next finger, under the first record's drive.
        covariates: covariates of the fingers; may be empty.
        at: covariates of the next finger, in standard deviations from the mean.
        scene: scene of all records.
        seed: seed of all random numbers.
        contact_area: test of the assumption that all have the same contact area.
        within: variation within tracked fingers; None means that none was tracked.
        laws, fingers_per_law: number of population samples for new fingers, and of new fingers for each.
    """

    fingers: tuple[Finger, ...]
    nesting: Nesting
    hierarchy: Hierarchy
    points: Float[np.ndarray, "ensembles draws n"]
    convergence: Convergence
    off: float
    finger: NewFingerModel
    covariates: Covariates
    at: Float[np.ndarray, " covariates"]
    scene: Scene
    seed: int
    contact_area: ContactAreaTest
    within: WithinFinger | None = None
    laws: int = 1000
    fingers_per_law: int = 32

    @property
    def description(self) -> str:
        """Records in a few words, e.g. "18 touches of 6 people"."""
        return describe_units([{"level": level.name, "units": len(level.units)} for level in self.nesting.levels])

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
                "the records' likelihoods are too far from normal for a population (means may shift by"
                f" {self.off:.2g} standard deviations); leave out the records that constrain Rsc and Csc least"
            )
        if self.hierarchy.area_varies and not self.contact_area.is_tested:
            sentences.append(
                "these records do not determine the contact area, so its standard deviation is the prior's; record I,"
                " too, or an impedance"
            )
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
            *self._nesting_sentences,
            f"the force is computed with [force] model = '{self.scene.force.model}', not measured; its intervals"
            f" exclude {excluded}",
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
        return (*sentences, *self._prior_sentences, self.contact_area.sentence)

    @property
    def _nesting_sentences(self) -> tuple[str, ...]:
        """Sentences on levels that are left out."""
        if self.nesting.omitted or self.nesting.levels[0].name != "finger" or len(self.nesting.levels) > 1:
            return self.nesting.omitted
        return ("each record counts as another finger; --table or --pattern (labels) state people and repetitions",)

    @property
    def _prior_sentences(self) -> Iterator[str]:
        """Sentences on spreads between few units that depend on their prior."""
        names, relevant = self.hierarchy.components, 0.3  # of the standard deviation
        where = " at the median area" if self.hierarchy.area_varies else ""
        for place, level in enumerate(self.nesting.levels):
            for component, name in enumerate(names):
                found = self._parameter_draws.log_sd[..., place, component]
                low, high = (self._median_with_prior_scale(place, component, scale) for scale in (0.5, 2.0))
                if high - low > relevant * float(np.std(found)):
                    units = f"{len(level.units)} {UNIT_NAMES[level.name][1]}"
                    what = f"{describe_factor(name)}{where * (name in SKIN)}"
                    yield (
                        f"with {units}, the spread of {what} between them depends on its prior: its median is"
                        f" {low:.2g} to {high:.2g} with half to twice the scale"
                    )

    def _median_with_prior_scale(self, level: int, component: int, scale: float) -> float:
        """Return the median of a log-standard deviation if its prior had `scale` times the scale."""
        draws = self._parameter_draws.log_sd[..., level, component].ravel()
        z = draws / self.hierarchy.log_sd_scale
        weights = np.exp(0.5 * np.square(z) - 0.5 * np.square(z / scale))
        order = np.argsort(draws)
        total = np.cumsum(weights[order])
        return float(draws[order][np.searchsorted(total, 0.5 * total[-1])])

    def parameters(self) -> dict[str, Float[np.ndarray, "ensembles draws"]]:
        """Return draws of the population parameters.

        These are the medians of Rsc (ohm) and Csc (F), Ci (F), log-standard deviations and correlations; those of the
        levels below the top have the level at the end of their name. With covariates also slopes: change of log Rsc
        and log Csc per unit of each covariate.
        """
        law = self._parameter_draws
        draws: dict[str, np.ndarray] = {}
        components = COMPONENTS[: law.mean.shape[-1]]
        endings = level_endings(self.hierarchy.levels)
        for place, ending in enumerate(endings):
            draws |= {f"log_sd_{name}{ending}": law.log_sd[..., place, i] for i, name in enumerate(components)}
        per_unit = law.slopes / self.covariates.sd[:, None]
        for i, name in enumerate(self.covariates.names):
            draws |= {f"slope_{each}_{name}": per_unit[..., i, j] for j, each in enumerate(components)}
        draws |= {f"correlation{ending}": law.correlation[..., place] for place, ending in enumerate(endings)}
        return draws | {k: np.exp(x) for k, x in log_medians(law).items()}

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
    def _moments(self) -> Float[np.ndarray, "touches laws fingers factors"]:
        """Factors of a touch of new fingers, and of others that share ever fewer levels with it.

        The second is another moment of the same touch if fingers were tracked.
        """
        random, levels = np.random.default_rng([self.seed, 1]), len(self.nesting.levels)
        shared = [levels, *([] if self.within is None else [levels]), *range(levels - 1, 0, -1)]
        law = draw_parameters(self, self.laws)
        deviates = random.standard_normal(
            (len(shared), self.laws, self.fingers_per_law, levels, len(self.hierarchy.components))
        )
        for touch, count in zip(deviates, shared, strict=True):
            touch[..., :count, :] = deviates[0, ..., :count, :]
        factors = self._add_thicknesses(law.make_factors(deviates), random)
        if self.within is not None:
            factors[..., :3] += self.within.draw_deviations(factors.shape[:3], random)
        return factors

    def _add_thicknesses(
        self, factors: Float[np.ndarray, "*touches laws fingers factors"], random: np.random.Generator
    ) -> Float[np.ndarray, "*touches laws fingers all_factors"]:
        """Append the thicknesses of fingers, which all their touches share."""
        thicknesses = draw_thicknesses(self.scene.thickness_sd(), factors.shape[-3:-1], random)
        thicknesses = np.broadcast_to(thicknesses, (*factors.shape[:-1], thicknesses.shape[-1]))
        return np.concatenate([factors, thicknesses], axis=-1)

    @property
    def prior_factors(self) -> Float[np.ndarray, "laws fingers factors"]:
        """Logarithms of the factors of fingers from the prior of the population parameters."""
        random = np.random.default_rng([self.seed, 4])
        law = self.hierarchy.sample_prior(random, self.laws).shift_means(self.at)
        deviates = random.standard_normal((self.laws, self.fingers_per_law, *law.log_sd.shape[1:]))
        return self._add_thicknesses(law.make_factors(deviates), random)

    @functools.cached_property
    def level_variances(self) -> LevelVariances:
        """Variances of logarithms of Rsc, Csc, area, g, b and the mean force by level."""
        return LevelVariances.from_parameters(draw_parameters(self, self.laws), self.nesting, self.finger)

    @functools.cached_property
    def forecasts(self) -> dict[str, dict[str, Float[np.ndarray, "laws fingers"]]]:
        """Draws of the values typical of a new unit of the top level, and of the next touch of each known finger.

        The first has the top level's name, with no effects of the levels below; the others are names of people or
        fingers, with their own covariates as far as these do not differ between its records. There are none if the
        records have a single level.
        """
        levels = self.nesting.levels
        if len(levels) < 2:
            return {}
        known = max(i for i, level in enumerate(levels[:-1]) if i == 0 or level.name != "session")
        units, numbers = levels[known].units, levels[known].unit_numbers
        laws, fingers, evaluations = self.laws, 4, 400_000
        laws = min(laws, max(laws // 8, evaluations // (fingers * len(units))))
        random, law = np.random.default_rng([self.seed, 9]), draw_parameters(self, laws, np.zeros_like(self.at))
        shape = (laws, fingers, len(levels), len(self.hierarchy.components))
        deviates = random.standard_normal(shape)
        deviates[:, :, 1:] = 0.0
        factors = {levels[0].name: law.shift_means(self.at).make_factors(deviates)}
        roots = np.asarray(law.effect_roots())[:, known + 1 :]
        sums = self._draw_known_sums(known, laws, random)
        for number, unit in enumerate(units):
            own = self.covariates.z_scores[numbers == number]
            mean = law.shift_means(np.where(np.ptp(own, axis=0) == 0.0, own[0], self.at)).mean
            lower = np.einsum("plij,pflj->pfi", roots, random.standard_normal(shape)[:, :, known + 1 :])
            factors[unit] = law.add_Ci(mean[:, None] + sums[:, number, None] + lower)
        values = {
            name: np.moveaxis(self.finger.evaluate(self._add_thicknesses(each, random)), -1, 0)
            for name, each in factors.items()
        }
        return {name: dict(zip(self.finger.names, each, strict=True)) for name, each in values.items()}

    def _draw_known_sums(
        self, level: int, laws: int, random: np.random.Generator
    ) -> Float[np.ndarray, "laws units components"]:
        """Draw the sums of the effects down to a level for the units of the records."""
        counts, components = self.hierarchy.effects.counts, len(self.hierarchy.components)
        deviates = (random.standard_normal((laws, units, components)) for units in counts)
        draw = BatchEvaluator(Hierarchy.draw_sums, self.hierarchy, sum(counts) * self.hierarchy.origin.size, batch=256)
        sums = draw(spread_points(self, laws), *deviates)
        first = sum(counts[:level])
        return sums[:, first : first + counts[level]]

    @functools.cached_property
    def _new_predictions(self) -> Float[np.ndarray, "moments laws fingers names"]:
        return self.finger.evaluate(self._moments)

    @functools.cached_property
    def _prior_predictions(self) -> Float[np.ndarray, "laws fingers names"]:
        return self.finger.evaluate(self.prior_factors[:, :8])  # the prior's wide range takes time

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
            shares: dict[str, Any] = {"people": people, "ignorance": 1.0 - people}
            others = [
                people * redrawn_variance_fraction(self._new_predictions[[0, j], ..., i])
                for j in range(1, len(self._new_predictions))
            ]
            if self.within is not None:
                within, *others = others
                shares |= {"within_finger": within, "between_fingers": people - within}
                shares |= {"population_parameters": 1.0 - people}
            if others:  # what differs below each level, from the lowest
                below = [people, *others[::-1], shares.get("within_finger", 0.0)]
                names = [level.name for level in self.nesting.levels]
                shares["levels"] = dict(zip(names, -np.diff(below), strict=True))
            new[name] = summary.summarize_draws(name, values) | {"variance": shares}
        return {
            "population": self._parameter_summaries(),
            "new_finger": new,
            "levels": self.level_variances.to_dict(),
            "forecasts": {
                name: {key: summary.summarize_draws(key, values[key]) for key in NAMES}
                for name, values in self.forecasts.items()
            },
            "next_studies": self.level_variances.plan_studies(self.seed),
            **({} if self.within is None else self.within.to_dict()),
            "variance_shares": self.shares,
            "variance_shares_prior": self.prior_shares,
            "fingers": [
                {"record": finger.source, "sha256": finger.fingerprint, "result": finger.result}
                | {"message": finger.message, "parameters": finger.parameters}
                | {"units": {level.name: level.units[level.unit_numbers[number]] for level in self.nesting.levels}}
                for number, finger in enumerate(self.fingers)
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
            | {
                each: {"slope": summary.summarize_draws("slope", draws[f"slope_{component}_{name}"])}
                for each, component in zip(self.hierarchy.components, COMPONENTS, strict=False)
            }
            for name, mean, sd, at in zip(
                self.covariates.names, self.covariates.mean, self.covariates.sd, self.at, strict=True
            )
        }
        return law

    def summary(self) -> str:
        """Return the table for people, the variance of the force by source, notes and warnings."""
        content = self.to_dict()
        rows = align_table(population_table(content))
        rows += [*variance_sentences(content), SHARES_LEGEND]
        if content["next_studies"]:
            rows += ["Larger studies, in brackets relative to this one:", *align_table(study_table(content))]
        rows += [str(self.convergence)]
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
            units = {
                name: "1" if name.startswith(("log_sd", "slope", "correlation")) else quantity_unit(name)
                for name in draws
            }
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
        return f"computed {result_text.FORCE_LAWS[self.scene.force.model]} and not measured"

    @property
    def _headline(self) -> str:
        law = self._parameter_draws
        medians = {name: summary.summarize_draws(name, np.exp(x)) for name, x in log_medians(law).items()}
        state = "reliable" if self.trusted else "unreliable"
        return f"{self.description}, medians {summary.format_estimates(medians)}, {state}"

    def _rows(self) -> tuple[tuple[str, ...], ...]:
        return population_table(self.to_dict())

    def _sentences(self) -> tuple[str, ...]:
        return str(self.convergence), f"Force on the next finger: {self._force_law}."

    def to_netcdf(self, path: str | os.PathLike[str]) -> None:
        """Write `to_datatree()` as NetCDF."""
        with atomic_write(path) as temporary:
            self.to_datatree().to_netcdf(temporary, engine="h5netcdf")


@jit
def evaluate_parameters(hierarchy: Hierarchy, points: Float[Array, "*shape n"]) -> PopulationParameters:
    evaluate = hierarchy.population_parameters
    for _ in range(points.ndim - 1):
        evaluate = jax.vmap(evaluate)
    return evaluate(points)


def spread_points(population: Population, count: int) -> Float[np.ndarray, "count n"]:
    """Take `count` points, spread over the chain."""
    flat = population.points.reshape(-1, population.points.shape[-1])
    return flat[np.linspace(0, len(flat) - 1, count).astype(int)]


def draw_parameters(
    population: Population, count: int, at: Float[np.ndarray, " covariates"] | None = None
) -> PopulationParameters:
    """Take `count` draws of the population parameters, spread over the chain, for fingers with standardized covariates.

    `at`: default, those of the next finger.
    """
    law = evaluate_parameters(population.hierarchy, spread_points(population, count))
    return jax.tree.map(np.asarray, law).shift_means(population.at if at is None else at)


def log_medians(parameters: PopulationParameters) -> dict[str, np.ndarray]:
    return {"Rsc": parameters.mean[..., 0], "Csc": parameters.mean[..., 1], SHARED_PARAMETER: parameters.log_Ci}
