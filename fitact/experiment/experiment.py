"""A measurement that might be made: its records, and what it would tell."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.linalg
from jaxtyping import Float

from fitact.experiment.fisher import FREQUENCY, Experiment, covariance_factor, jacobian
from fitact.model.drive import Trapezoid
from fitact.model.skin import with_values
from fitact.units import format_engineering


@dataclasses.dataclass(frozen=True)
class Setting:
    """A quantity that can be set to any value within bounds."""

    name: str  # its own in the candidate
    field: str  # of the circuit, or `FREQUENCY`
    unit: str
    start: float  # where it stands
    low: float
    high: float
    experiment_indices: tuple[int, ...] = (0,)  # which of the candidate's experiments have it


@dataclasses.dataclass(frozen=True)
class CandidateDesign:
    """A measurement that might be made of one finger."""

    experiments: tuple[Experiment, ...]  # its records; they share the free parameters, but for those of their own
    settings: tuple[Setting, ...] = ()  # still to be chosen
    names: tuple[str, ...] = ()  # of the changes that lead to it
    texts: tuple[str, ...] = ()  # the same in words, with a place for each setting
    effort: float = 0.0  # what they cost together (docs/design_measurement.md)

    def make_experiments(self, values: Sequence[float], *, keep_phase: bool = False) -> tuple[Experiment, ...]:
        """The experiments with their settings at `values`.

        `keep_phase`: samples and edges stay where they are in the period, so that no frequency makes them jump.
        """
        experiments = list(self.experiments)
        for setting, value in zip(self.settings, values, strict=True):
            for i in setting.experiment_indices:
                experiments[i] = _apply_setting(experiments[i], setting.field, value, keep_phase)
        return tuple(experiments)

    @property
    def start_values(self) -> tuple[float, ...]:
        """Where the settings stand."""
        return tuple(setting.start for setting in self.settings)

    def describe(self, values: Sequence[float]) -> str:
        """The changes in words."""
        shown = [format_engineering(v, setting.unit) for v, setting in zip(values, self.settings, strict=True)]
        return " and ".join(self.texts).format(*shown)


@dataclasses.dataclass(frozen=True)
class DesignOption:
    """A candidate at its best settings, and the errors to expect of it."""

    name: str  # of what is done
    text: str  # that in words
    settings: dict[str, float]  # the values chosen, SI
    effort: float  # of it, where turning a knob of an instrument that is there is 1
    force_sd: float  # standard deviation of the mean force, in its logarithm; small, it is the relative one
    contraction: float  # 1 - that over the prior's
    sd: dict[str, float]  # of the parameters, in their logarithms
    contractions: dict[str, float]  # of those
    gain: float  # logarithm of the force_sd now over this one

    @property
    def gain_per_effort(self) -> float:
        """The gain over the effort; 0 of none."""
        return self.gain / self.effort if self.effort else 0.0

    def to_dict(self) -> dict[str, Any]:
        """An entry of design.json."""
        return dataclasses.asdict(self) | {"gain_per_effort": self.gain_per_effort}


def evaluate_design(
    design: CandidateDesign,
    values: Sequence[float],
    gradient: Float[np.ndarray, " parameters"],
    baseline_sd: float | None = None,
) -> DesignOption:
    """A candidate with its settings at `values`, rounded; numpy.linalg.LinAlgError where no double holds its records.

    `gradient` is that of the logarithm of the force asked for, in the logarithms of the first experiment's free
    parameters; `baseline_sd` its standard deviation without any change.
    """
    values = [float(f"{value:.3g}") for value in values]
    experiments = design.make_experiments(values)
    free, prior = experiments[0].free, experiments[0].prior_factor
    root = covariance_factor(joint_jacobian(experiments)[0], joint_prior_factor(experiments))[: len(free)]
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


def joint_jacobian(
    experiments: Sequence[Experiment], settings: Sequence[Setting] = ()
) -> Float[np.ndarray, "1+settings rows parameters"]:
    """The `jacobian` of experiments on one finger: the parameters of their own come after the shared ones."""
    free, blocks = experiments[0].free, []
    next_own = len(free)
    total = next_own + sum(len(e.own_parameters) for e in experiments)
    for i, e in enumerate(experiments):
        columns = np.arange(len(free))
        for name in e.own_parameters:
            columns[free.index(name)] = next_own
            next_own += 1
        here = [k for k, setting in enumerate(settings) if i in setting.experiment_indices]
        derivatives = jacobian(e, [settings[k].field for k in here])
        block = np.zeros((1 + len(settings), derivatives.shape[1], total))
        for k, derivative in zip((0, *(1 + k for k in here)), derivatives, strict=True):
            block[k][:, columns] = derivative
        blocks.append(block)
    return np.concatenate(blocks, axis=1)


def joint_prior_factor(experiments: Sequence[Experiment]) -> Float[np.ndarray, "parameters parameters"]:
    """A root of the prior's covariance; parameters of an experiment's own are independent of the others."""
    own = [np.linalg.norm(e.prior_factor[e.free.index(name)]) for e in experiments for name in e.own_parameters]
    return scipy.linalg.block_diag(experiments[0].prior_factor, np.diag(own))


def _apply_setting(e: Experiment, field: str, value: float, keep_phase: bool) -> Experiment:
    if field != FREQUENCY:
        return dataclasses.replace(e, circuit=with_values(e.circuit, {field: value}))
    drive: Any = e.drive
    slower = float(drive.frequency) / value
    changed = dataclasses.replace(drive, frequency=value)
    if not keep_phase:  # a slower drive needs a longer record for its periods, a faster one no shorter
        return dataclasses.replace(e, drive=changed, time=max(slower, 1.0) * e.time)
    if isinstance(drive, Trapezoid):
        changed = dataclasses.replace(changed, rise_time=slower * drive.rise_time)
    return dataclasses.replace(e, drive=changed, time=slower * e.time)
