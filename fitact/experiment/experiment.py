"""A candidate measurement: its records, its expected uncertainties, and its best settings."""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple, Self, TypeAlias

import numpy as np
import scipy
from jaxtyping import Float

from fitact.experiment.fisher import Experiment, covariance_factor, jacobian
from fitact.model.drive import Trapezoid
from fitact.model.skin import with_values
from fitact.units import format_engineering

FREQUENCY = "frequency"  # name of the setting for the drive's frequency
Gradient: TypeAlias = Float[np.ndarray, " parameters"]  # of the log mean force, in the free log-parameters


@dataclasses.dataclass(frozen=True)
class Setting:
    """A quantity that can be set to any value within bounds."""

    name: str  # unique in the candidate
    field: str  # field of the circuit, or `FREQUENCY`
    unit: str
    start: float  # present value
    low: float
    high: float
    experiment_indices: tuple[int, ...] = (0,)  # experiments of the candidate with this setting


@dataclasses.dataclass(frozen=True)
class CandidateDesign:
    """A candidate measurement of one finger."""

    experiments: tuple[Experiment, ...]  # records; they share the free parameters, except each one's own
    settings: tuple[Setting, ...] = ()  # still to be chosen
    names: tuple[str, ...] = ()  # names of the changes
    texts: tuple[str, ...] = ()  # changes in words, with a placeholder for each setting
    effort: float = 0.0  # total effort of the changes (docs/design_measurement.md)
    factor: float = 1.0  # by which uncertainties exceed those of the Fisher information

    @classmethod
    def from_fit(cls, experiment: Experiment, gradient: Gradient, force_sd: float) -> Self:
        """Return the measurement of a fit, whose uncertainties are in proportion to the `force_sd` of the fit.

        A fit may know less than its samples tell: some share the rounding of a converter, or lie beside corners of V.
        """
        as_it_is = cls((experiment,))
        try:
            now = evaluate_design(as_it_is, (), gradient)
        except np.linalg.LinAlgError:  # a failed fit may end at a circuit whose current overflows
            return as_it_is
        return dataclasses.replace(as_it_is, factor=force_sd / now.force_sd)

    def make_experiments(self, values: Sequence[float], *, keep_phase: bool = False) -> tuple[Experiment, ...]:
        """Return the experiments with their settings at `values`.

        With `keep_phase`, samples and edges keep their phase in the period, so the result is smooth in the frequency.
        """
        experiments = list(self.experiments)
        for setting, value in zip(self.settings, values, strict=True):
            for i in setting.experiment_indices:
                experiments[i] = _apply_setting(experiments[i], setting.field, value, keep_phase)
        return tuple(experiments)

    @property
    def start_values(self) -> tuple[float, ...]:
        """Present values of the settings."""
        return tuple(setting.start for setting in self.settings)

    def describe(self, values: Sequence[float]) -> str:
        """Return the changes in words."""
        shown = [format_engineering(v, setting.unit) for v, setting in zip(values, self.settings, strict=True)]
        return " and ".join(self.texts).format(*shown)


@dataclasses.dataclass(frozen=True)
class DesignOption:
    """A candidate at its best settings, with its expected uncertainties."""

    name: str
    text: str  # description in words
    settings: dict[str, float]  # chosen values, SI
    effort: float  # 1 means changing a setting of an existing instrument
    force_sd: float  # standard deviation of the log mean force; relative uncertainty where it is small
    contraction: float  # 1 - force_sd / its value before any measurement
    sd: dict[str, float]  # standard deviations of the log-parameters
    contractions: dict[str, float]  # 1 - sd / prior sd of the log-parameters
    gain: float  # ln(present force_sd / this force_sd)

    min_gain: ClassVar[float] = math.log(1.01)  # smallest that counts as an improvement

    @property
    def gain_per_effort(self) -> float:
        """Gain per effort; 0 without effort."""
        return self.gain / self.effort if self.effort else 0.0

    def to_dict(self) -> dict[str, Any]:
        """Return an entry of design.json."""
        return dataclasses.asdict(self) | {"gain_per_effort": self.gain_per_effort}


def evaluate_design(
    design: CandidateDesign, values: Sequence[float], gradient: Gradient, baseline_sd: float | None = None
) -> DesignOption:
    """Evaluate a candidate with its settings at `values`, rounded to three digits.

    `baseline_sd` is the standard deviation of the log force without any change.

    Raises:
        numpy.linalg.LinAlgError: the records have values beyond double precision.
    """
    values = [float(f"{value:.3g}") for value in values]
    experiments = design.make_experiments(values)
    free, prior = experiments[0].free, experiments[0].prior_factor
    root = design.factor * covariance_factor(_joint_jacobian(experiments), _joint_prior_factor(experiments))
    root = root[: len(free)]
    gradient = np.pad(gradient, (0, len(free) - len(gradient)))  # the force does not depend on an added gain
    sd, prior_sd = np.linalg.norm(root, axis=1), np.linalg.norm(prior, axis=1)
    force_sd = float(np.linalg.norm(gradient @ root))
    return DesignOption(
        name=" + ".join(design.names),
        text=design.describe(values),
        settings={setting.name: value for setting, value in zip(design.settings, values, strict=True)},
        effort=design.effort,
        force_sd=force_sd,
        contraction=1.0 - force_sd / float(np.linalg.norm(gradient @ prior)),
        sd=dict(zip(free, sd.tolist(), strict=True)),
        contractions=dict(zip(free, (1.0 - sd / prior_sd).tolist(), strict=True)),
        gain=0.0 if baseline_sd is None else math.log(baseline_sd / force_sd),
    )


class Optimum(NamedTuple):
    """Best settings, and the standard deviation of the log mean force on the grid."""

    values: tuple[float, ...]  # of the settings, SI
    grid: tuple[Float[np.ndarray, " points"], ...]  # along each setting
    force_sd: Float[np.ndarray, "*points"]  # at all combinations


def optimise(design: CandidateDesign, gradient: Gradient, starts: int = 3, min_improvement: float = 1e-3) -> Optimum:
    """Find the settings with the smallest uncertainty of the mean force.

    The descent starts from the `starts` lowest points of the grid. A setting moves only if the uncertainty falls by
    the fraction `min_improvement`.
    """
    bounds = [(setting.low, setting.high) for setting in design.settings]
    count = {1: 33, 2: 6}.get(len(bounds), 4)  # grid points along each setting, by the number of settings
    grid = tuple(np.geomspace(*pair, count) for pair in bounds)
    points = list(itertools.product(*grid))
    coarse = np.array([force_sd(design, point, gradient) for point in points])
    shape = (count,) * len(bounds)
    lowest = scipy.ndimage.minimum_filter(coarse.reshape(shape), 3, mode="nearest").ravel() == coarse
    order = [i for i in np.argsort(coarse) if lowest[i]][:starts]

    def log_sd(logs: np.ndarray) -> float:
        return float(np.log(force_sd(design, np.exp(logs), gradient)))

    optima = [(np.log(coarse[i]), points[i]) for i in order]
    for i in order:
        end = scipy.optimize.minimize(log_sd, np.log(points[i]), method="L-BFGS-B", bounds=np.log(bounds))
        optima.append((end.fun, tuple(np.exp(end.x))))
    best, values = min(optima)
    if force_sd(design, design.start_values, gradient) < (1.0 + min_improvement) * np.exp(best):
        values = design.start_values
    if len({setting.field for setting in design.settings}) == 1:  # the records are interchangeable
        values = sorted(values)
    return Optimum(tuple(map(float, values)), grid, coarse.reshape(shape))


def force_sd(design: CandidateDesign, values: Sequence[float], gradient: Gradient) -> float:
    """Return the standard deviation of the log mean force with the settings at `values`."""
    experiments = design.make_experiments(values, keep_phase=True)
    root = design.factor * covariance_factor(_joint_jacobian(experiments), _joint_prior_factor(experiments))
    return float(np.linalg.norm(gradient @ root[: gradient.size]))


def _joint_jacobian(experiments: Sequence[Experiment]) -> Float[np.ndarray, "rows parameters"]:
    """Return the `jacobian` of experiments on one finger; each one's own parameters follow the shared ones."""
    free, blocks = experiments[0].free, []
    next_own = len(free)
    total = next_own + sum(len(e.own_parameters) for e in experiments)
    for e in experiments:
        columns = np.arange(len(free))
        for name in e.own_parameters:
            columns[free.index(name)] = next_own
            next_own += 1
        own = jacobian(e)
        block = np.zeros((len(own), total))
        block[:, columns] = own
        blocks.append(block)
    return np.concatenate(blocks)


def _joint_prior_factor(experiments: Sequence[Experiment]) -> Float[np.ndarray, "parameters parameters"]:
    """Return a root of the prior's covariance; an experiment's own parameters are independent of the others."""
    own = [np.linalg.norm(e.prior_factor[e.free.index(name)]) for e in experiments for name in e.own_parameters]
    return scipy.linalg.block_diag(experiments[0].prior_factor, np.diag(own))


def _apply_setting(e: Experiment, field: str, value: float, keep_phase: bool) -> Experiment:
    if field != FREQUENCY:
        return dataclasses.replace(e, circuit=with_values(e.circuit, {field: value}))
    drive: Any = e.drive
    slower = float(drive.frequency) / value
    changed = dataclasses.replace(drive, frequency=value)
    if not keep_phase:  # a slower drive needs a longer record; a faster one keeps its length
        return dataclasses.replace(e, drive=changed, time=max(slower, 1.0) * e.time)
    if isinstance(drive, Trapezoid):
        changed = dataclasses.replace(changed, rise_time=slower * drive.rise_time)
    return dataclasses.replace(e, drive=changed, time=slower * e.time)
