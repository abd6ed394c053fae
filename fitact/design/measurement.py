"""Which measurement would tell most of the mean force: what a user may change, the errors to expect, in order."""

import contextlib
import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from fitact.data.record import Record
from fitact.data.simulate import sample_times
from fitact.errors import InputError
from fitact.experiment.blind_directions import gain_names
from fitact.experiment.experiment import Option, Trial, judge
from fitact.experiment.fisher import Experiment, force_gradient, spans
from fitact.experiment.optimise import Optimum, optimise
from fitact.experiment.options import Change, changes
from fitact.fitting import derived
from fitact.fitting.fit import Fit, fit
from fitact.model.circuit import Channel
from fitact.model.skin import Dispersive, WithSkin, parameters
from fitact.prior.distributions import LogNormal
from fitact.scene.scene import Scene
from fitact.units import percent

_LEVELS = 256  # of an ordinary oscilloscope's converter, over what a channel reaches
_GAIN = math.log(1.01)  # from which an option counts as telling more


@dataclasses.dataclass(frozen=True)
class Curve:
    """How well the mean force is known along one setting, samples and edges keeping their place in the period.

    Attributes:
        setting, unit: what is set, and the unit of its values.
        values: SI.
        force_sd: as in `Option`.
    """

    setting: str
    unit: str
    values: tuple[float, ...]
    force_sd: tuple[float, ...]


@dataclasses.dataclass(frozen=True)
class MeasurementDesign:
    """What might be measured, and how well the mean force would then be known.

    Attributes:
        now: the measurement as it stands.
        options: what might be changed, the smallest error of the force first.
        curves: along the settings that can have any value.
        prior_force_sd: standard deviation of the log mean force before any measurement.
        trusted: whether nothing stands against the fit of the records; true without records.
        warnings: sentences.
    """

    now: Option
    options: tuple[Option, ...]
    curves: tuple[Curve, ...]
    prior_force_sd: float
    trusted: bool
    warnings: tuple[str, ...]

    @property
    def best_for_effort(self) -> Option | None:
        """The option that gives most for its effort; None where nothing gains one part in a hundred."""
        return max(self._telling, key=lambda option: option.gain_per_effort, default=None)

    @property
    def _telling(self) -> tuple[Option, ...]:
        return tuple(option for option in self.options if option.gain > _GAIN)

    def to_dict(self) -> dict[str, Any]:
        """As in design.json."""
        best = self.best_for_effort
        return {
            "now": self.now.to_dict(),
            "best_for_effort": None if best is None else best.name,
            "options": [option.to_dict() for option in self.options],
            "prior_force_sd": self.prior_force_sd,
            "curves": [dataclasses.asdict(curve) for curve in self.curves],
            "trusted": self.trusted,
            "warnings": list(self.warnings),
        }

    def __str__(self) -> str:
        """The table for people, what gives most for its effort, and what gives nothing."""
        rows = [
            f"{sd:>10} {known:>12}{effort:>8} {gain:>12}  {text}".rstrip()
            for text, sd, known, effort, gain in self.table
        ]
        return "\n".join([*rows, *self.sentences, *(f"warning: {warning}" for warning in self.warnings)])

    @property
    def table(self) -> tuple[tuple[str, ...], ...]:
        """Titles; then what each option that tells more, and the measurement as it stands, tell of the force."""
        rows = [("", "mean force", "contraction", "effort", "gain/effort")]
        for option in (*self._telling, self.now):
            cost = (f"{option.effort:.3g}", f"{option.gain_per_effort:.2f}") if option.effort else ("", "")
            rows.append((option.text, f"± {percent(option.force_sd)}", f"{option.contraction:.4f}", *cost))
        return tuple(rows)

    @property
    def sentences(self) -> tuple[str, ...]:
        """What gives most for its effort, and what gives nothing."""
        best, others = self.best_for_effort, [o.name for o in self.options if o not in self._telling]
        found = []
        if best is not None:
            known = f"from ± {percent(self.now.force_sd)} to ± {percent(best.force_sd)}"
            found.append(f"Most for its effort: {best.text}, {known}.")
        if others:
            found.append(f"Nothing is gained by: {', '.join(others)}.")
        return tuple(found)


def design_measurement(scene: Scene, records: Record | Sequence[Record] = ()) -> MeasurementDesign:
    """What might be measured in place of a scene's measurement, and how well its mean force would then be known.

    The force is that of the scene's circuit and drive, whatever they are changed to for the measurement. Settings
    that can have any value are optimised. Errors are those of the Laplace approximation, with neither offset,
    drift, delay nor charge unknown.

    Args:
        scene: the measurement as it stands.
        records: made in it; the values and noises of their joint fit stand for the scene's. Of several, the first
            is taken to be repeated.

    Raises:
        InputError: the scene frees no parameter, or gives no noise, or no drive and there is no record; as
            `fitact.fit`; or the fit ended where nothing can be computed.
    """
    records = (records,) if isinstance(records, Record) else tuple(records)
    if records:
        fitted = fit(records, scene)
        experiment, gradient = fitted.experiment, _force_gradient(fitted)
        steps = _steps(records[0], experiment)
        judgement = fitted.trusted, (*([] if fitted.trusted else [fitted.message]), *fitted.warnings)
    else:
        experiment, judgement = stated_experiment(scene), (True, ())
        gradient = force_gradient(experiment)
        steps = {channel: span / _LEVELS for channel, span in spans(experiment).items()}
    try:
        now = dataclasses.replace(judge(Trial((experiment,)), (), gradient), name="now", text="as it stands")
    except np.linalg.LinAlgError as error:
        raise InputError(
            f"what is recorded cannot be computed with at these values ({error}); check the scene's, or first get a"
            " fit of the record that is trusted"
        ) from error
    found, curves = _ranked(Trial((experiment,)), gradient, now, changes(steps))
    believed = float(np.linalg.norm(gradient @ experiment.prior_root))
    return MeasurementDesign(now, found, curves, believed, *judgement)


def stated_experiment(scene: Scene) -> Experiment:
    """The measurement that a scene states, at its own values.

    Raises:
        InputError: it has no drive, no noise or nothing free, or its sampling is out of bounds.
    """
    scene.require_available()
    measured, prior, nominal = scene.measurement, scene.make_prior(), scene.nominal()
    values = {name: math.exp(prior[name].log_mean) for name in prior.names if nominal[name] is None}
    values |= scene.fixed()
    tied = tuple((name, other, ratio) for name, (other, ratio) in scene.prior.tied().items())
    values |= {name: ratio * float(values.get(other) or nominal[other] or 0.0) for name, other, ratio in tied}
    noise = {"Vsc": measured.noise_Vsc, "I": measured.noise_I}
    silent = [channel for channel in measured.channels if noise[channel] == 0.0]
    if silent:
        raise InputError(
            f"scene: [measurement] noise_{silent[0]} is 0, and without noise every sample tells all; give the noise"
        )
    if not prior.names:
        raise InputError("scene: [prior] frees no parameter, so there is nothing to learn; give one a prior")
    circuit = scene.make_circuit(values)
    if isinstance(circuit, WithSkin) and isinstance(circuit.skin, Dispersive):
        # counted now, since what is compiled has its frequency traced
        circuit = dataclasses.replace(circuit, skin=Dispersive(circuit.skin.count(scene.drive.slowest)))
    believed = prior.without(*(name for name in prior.names if name not in parameters(circuit)))
    believed = believed.including(**_gains(scene))
    return Experiment(
        circuit=circuit,
        free=believed.names,
        prior_root=np.linalg.cholesky(believed.covariance),
        drive=scene.make_drive(),
        time=sample_times(scene),
        channels=measured.channels,
        noise=noise,
        steady_state=scene.drive.steady_state,
        geometry=scene.geometry(),
        tied=tied,
    )


def _gains(scene: Scene) -> dict[str, LogNormal]:
    """What the scene believes of the gains of its channels."""
    measured = scene.measurement
    stated = {"gain": measured.gain_relative_sd, "gain_I": measured.gain_I_relative_sd}
    return {
        name: LogNormal.with_relative_sd(1.0, stated[name])
        for name in gain_names(measured.channels)
        if stated[name] > 0.0
    }


def _force_gradient(fitted: Fit) -> Float[np.ndarray, " parameters"]:
    """That of the logarithm of a fit's mean force, in the free parameters of its experiment."""
    _, gradients = fitted.derive.logs(fitted.theta, np.array([trace.sigma for trace in fitted.traces]))
    rows = [fitted.names.index(name) for name in fitted.experiment.free]
    return gradients[derived.NAMES.index("force_mean"), rows]


def _steps(record: Record, experiment: Experiment) -> dict[Channel, float]:
    """The least difference between a record's values: the step of its converter, or less."""
    return {channel: float(np.diff(np.unique(record[channel])).min()) for channel in experiment.channels}


def _ranked(
    now: Trial, gradient: Float[np.ndarray, " parameters"], known: Option, offered: Sequence[Change]
) -> tuple[tuple[Option, ...], tuple[Curve, ...]]:
    """Each change's option, and that of the best two together, best first; the curves of those with one setting."""
    tried = {change.name: found for change in offered if (found := _tried(change(now), gradient, known)) is not None}
    curves = tuple(curve for _, curve in tried.values() if curve is not None)
    options = [option for option, _ in tried.values()]
    by_name: Mapping[str, Change] = {change.name: change for change in offered}
    best = [by_name[o.name] for o in sorted(options, key=_force_sd) if o.gain > _GAIN]
    partner = next((change for change in best[1:] if change.group != best[0].group), None)
    together = None if partner is None else _tried(_together(now, best[0], partner), gradient, known)
    if together is not None and together[0].gain > max(option.gain for option in options) + _GAIN:
        options.append(together[0])
    return tuple(sorted(options, key=_force_sd)), curves


def _force_sd(option: Option) -> float:
    return option.force_sd


def _together(trial: Trial, first: Change, second: Change) -> Trial | None:
    """Both changes; None where neither can be made after the other."""
    for one, other in ((first, second), (second, first)):
        begun = one(trial)
        found = None if begun is None else other(begun)
        if found is not None:
            return found
    return None


def _tried(
    trial: Trial | None, gradient: Float[np.ndarray, " parameters"], now: Option
) -> tuple[Option, Curve | None] | None:
    """What a trial would tell at its best settings; None where it cannot be made, or computed."""
    if trial is None:
        return None
    with contextlib.suppress(np.linalg.LinAlgError):
        if not trial.settings:
            return judge(trial, (), gradient, now.force_sd), None
        found = optimise(trial, gradient)
        return judge(trial, found.values, gradient, now.force_sd), _curve(trial, found)
    return None


def _curve(trial: Trial, found: Optimum) -> Curve | None:
    if len(trial.settings) > 1:
        return None
    (setting,), (values,) = trial.settings, found.grid
    return Curve(setting.name, setting.unit, tuple(values.tolist()), tuple(found.force_sd.tolist()))
