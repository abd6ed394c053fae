"""A measurement that might be made: its records, what of it is still to be chosen, and what it would tell."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from fitact.experiment.fisher import FREQUENCY, Experiment, covariance_root, jacobian
from fitact.model.drive import Trapezoid
from fitact.model.skin import with_values
from fitact.units import engineering

_DIGITS = 3  # to which a setting is given


@dataclasses.dataclass(frozen=True)
class Setting:
    """What can be set to any value within bounds.

    Attributes:
        name: its own in the trial.
        field: of the circuit, or `FREQUENCY`.
        unit: of its values.
        start, low, high: where it stands, and its bounds.
        of: the trial's experiments that have it.
    """

    name: str
    field: str
    unit: str
    start: float
    low: float
    high: float
    of: tuple[int, ...] = (0,)


@dataclasses.dataclass(frozen=True)
class Trial:
    """A measurement that might be made of one finger.

    Attributes:
        experiments: its records; they share the free parameters, but for those of their own.
        settings: what is still to be chosen.
        names: of the changes that lead to it.
        texts: the same in words, with a place for each setting.
        effort: what they cost together (docs/design_measurement.md).
    """

    experiments: tuple[Experiment, ...]
    settings: tuple[Setting, ...] = ()
    names: tuple[str, ...] = ()
    texts: tuple[str, ...] = ()
    effort: float = 0.0

    def at(self, values: Sequence[float], *, in_step: bool = False) -> tuple[Experiment, ...]:
        """The experiments with their settings at `values`.

        `in_step`: samples and edges keep their place in the period, so that what they tell changes smoothly with
        the frequency.
        """
        found = list(self.experiments)
        for setting, value in zip(self.settings, values, strict=True):
            for i in setting.of:
                found[i] = _with(found[i], setting.field, value, in_step)
        return tuple(found)

    @property
    def starts(self) -> tuple[float, ...]:
        """Where the settings stand."""
        return tuple(setting.start for setting in self.settings)

    def describe(self, values: Sequence[float]) -> str:
        """What is done, in words."""
        shown = [engineering(v, setting.unit) for v, setting in zip(values, self.settings, strict=True)]
        return " and ".join(self.texts).format(*shown)


@dataclasses.dataclass(frozen=True)
class Option:
    """What a trial would tell.

    Attributes:
        name: of what is done.
        text: that in words.
        settings: the values chosen, SI.
        effort: of it, where turning a knob of an instrument that is there is 1.
        force_sd: standard deviation of the mean force, in its logarithm; small, it is the relative one.
        contraction: 1 - that over the prior's.
        sd: of the parameters, in their logarithms.
        contractions: of those.
        gain: logarithm of the force_sd now over this one.
    """

    name: str
    text: str
    settings: dict[str, float]
    effort: float
    force_sd: float
    contraction: float
    sd: dict[str, float]
    contractions: dict[str, float]
    gain: float

    @property
    def gain_per_effort(self) -> float:
        """The gain over the effort; 0 of none."""
        return self.gain / self.effort if self.effort else 0.0

    def to_dict(self) -> dict[str, Any]:
        """As in design.json."""
        return dataclasses.asdict(self) | {"gain_per_effort": self.gain_per_effort}


def judge(
    trial: Trial, values: Sequence[float], gradient: Float[np.ndarray, " parameters"], now: float | None = None
) -> Option:
    """What a trial would tell with its settings at `values`, rounded.

    `gradient` is that of the logarithm of the force asked for, in the logarithms of the first experiment's free
    parameters; `now` its standard deviation without any change.

    Raises:
        numpy.linalg.LinAlgError: no double holds what is recorded.
    """
    values = [float(f"{value:.{_DIGITS}g}") for value in values]
    experiments = trial.at(values)
    free, prior = experiments[0].free, experiments[0].prior_root
    root = covariance_root(joint_jacobian(experiments)[0], joint_prior(experiments))[: len(free)]
    sd, prior_sd = np.linalg.norm(root, axis=1), np.linalg.norm(prior, axis=1)
    force_sd = float(np.linalg.norm(gradient @ root))
    return Option(
        name=" + ".join(trial.names),
        text=trial.describe(values),
        settings={setting.name: value for setting, value in zip(trial.settings, values, strict=True)},
        effort=trial.effort,
        force_sd=force_sd,
        contraction=1.0 - force_sd / float(np.linalg.norm(gradient @ prior)),
        sd=dict(zip(free, sd.tolist(), strict=True)),
        contractions=dict(zip(free, (1.0 - sd / prior_sd).tolist(), strict=True)),
        gain=0.0 if now is None else math.log(now / force_sd),
    )


def joint_jacobian(
    experiments: Sequence[Experiment], settings: Sequence[Setting] = ()
) -> Float[np.ndarray, "1+settings rows parameters"]:
    """As `jacobian`, of experiments on one finger: the parameters of their own come after the shared ones."""
    free, found = experiments[0].free, []
    own = len(free)
    total = own + sum(len(e.own) for e in experiments)
    for i, e in enumerate(experiments):
        columns = np.arange(len(free))
        for name in e.own:
            columns[free.index(name)] = own
            own += 1
        fields = [setting.field for setting in settings if i in setting.of]
        value, *slopes = jacobian(e, fields)
        block = np.zeros((1 + len(settings), len(value), total))
        block[0][:, columns] = value
        for setting, slope in zip((k for k, s in enumerate(settings) if i in s.of), slopes, strict=True):
            block[1 + setting][:, columns] = slope
        found.append(block)
    return np.concatenate(found, axis=1)


def joint_prior(experiments: Sequence[Experiment]) -> Float[np.ndarray, "parameters parameters"]:
    """A root of the prior's covariance; parameters of an experiment's own are independent of the others."""
    first = experiments[0].prior_root
    own = [float(np.linalg.norm(e.prior_root[e.free.index(name)])) for e in experiments for name in e.own]
    root = np.diag([0.0] * len(first) + own)
    root[: len(first), : len(first)] = first
    return root


def _with(e: Experiment, field: str, value: float, in_step: bool) -> Experiment:
    if field != FREQUENCY:
        return dataclasses.replace(e, circuit=with_values(e.circuit, {field: value}))
    drive: Any = e.drive
    slower = float(drive.frequency) / value
    changed = dataclasses.replace(drive, frequency=value)
    if not in_step:  # a slower drive needs a longer record for its periods, a faster one no shorter
        return dataclasses.replace(e, drive=changed, time=max(slower, 1.0) * e.time)
    if isinstance(drive, Trapezoid):
        changed = dataclasses.replace(changed, rise_time=slower * drive.rise_time)
    return dataclasses.replace(e, drive=changed, time=slower * e.time)
