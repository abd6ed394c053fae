"""Changes of a measurement, ranked by the expected uncertainty of the mean force."""

import contextlib
import dataclasses
import math
import operator
from collections.abc import Sequence
from typing import Any

import numpy as np

from fitact import charts
from fitact.data.record import Record
from fitact.data.simulate import sample_times
from fitact.errors import InputError
from fitact.experiment.blind_directions import GAIN_CHANNELS, STRAY, gain_names
from fitact.experiment.experiment import CandidateDesign, DesignOption, Gradient, evaluate_design, optimise
from fitact.experiment.fisher import Experiment, force_gradient, signal_spans
from fitact.experiment.options import Change, changes
from fitact.fitting.fit import fit
from fitact.instrument.classes import typical_gain_u
from fitact.model.skin import circuit_parameters
from fitact.prior.distributions import LogNormal
from fitact.problem.skin_model import count_harmonics
from fitact.scene.scene import Scene
from fitact.tables import Display, align_row, join_lines
from fitact.units import format_percent


@dataclasses.dataclass(frozen=True)
class SettingCurve:
    """Expected uncertainty of the mean force along one setting; samples and edges keep their phase in the period."""

    setting: str
    unit: str
    values: tuple[float, ...]  # SI
    force_sd: tuple[float, ...]  # as in `DesignOption`


@dataclasses.dataclass(frozen=True, repr=False)
class MeasurementDesign(Display):
    """Possible changes of a measurement, and the expected uncertainty of the mean force.

    Attributes:
        now: measurement as it stands.
        options: changed measurements, the smallest uncertainty of the force first.
        curves: uncertainty along the continuous settings.
        prior_force_sd: standard deviation of the log mean force before any measurement.
        trusted: whether the fit of the records is reliable; true without records.
        warnings: sentences on conditions that may change the result.
    """

    now: DesignOption
    options: tuple[DesignOption, ...]
    curves: tuple[SettingCurve, ...]
    prior_force_sd: float
    trusted: bool
    warnings: tuple[str, ...]

    @property
    def best_for_effort(self) -> DesignOption | None:
        """Option with the largest gain per effort; None if no option gains 1 %."""
        return max(self._informative_options, key=lambda option: option.gain_per_effort, default=None)

    @property
    def _informative_options(self) -> tuple[DesignOption, ...]:
        return tuple(option for option in self.options if option.gain > option.min_gain)

    def to_dict(self) -> dict[str, Any]:
        """Return the content of design.json."""
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

    def plot(self) -> Any:
        """Draw the expected uncertainty of the mean force for each option, and along each setting; return the axes."""
        return np.array(charts.draw_design(self.to_dict(), make=charts.pyplot_figure).axes)

    @property
    def _headline(self) -> str:
        best, now = self.best_for_effort, format_percent(self.now.force_sd)
        after = "no change gains 1 %" if best is None else f"± {format_percent(best.force_sd)} with {best.text}"
        return f"mean force ± {now} as it stands, {after}"

    def _rows(self) -> tuple[tuple[str, ...], ...]:
        (_, *titles), *rows = self.table
        return ("what is measured", *titles), *rows

    def _sentences(self) -> tuple[str, ...]:
        return self.sentences

    def __str__(self) -> str:
        """Return the table for people, the option with the largest gain per effort, and the options without gain."""
        rows = [align_row(("", *cells, f"  {text}"), (0, 10, 13, 8, 13, 0)) for text, *cells in self.table]
        return join_lines([*rows, *self.sentences], self.warnings)

    @property
    def table(self) -> tuple[tuple[str, ...], ...]:
        """Titles, then rows of the options that gain and of the measurement as it stands."""
        rows = [("", "mean force", "contraction", "effort", "gain/effort")]
        for option in (*self._informative_options, self.now):
            cost = (f"{option.effort:.3g}", f"{option.gain_per_effort:.2f}") if option.effort else ("", "")
            rows.append((option.text, f"± {format_percent(option.force_sd)}", f"{option.contraction:.4f}", *cost))
        return tuple(rows)

    @property
    def sentences(self) -> tuple[str, ...]:
        """The option with the largest gain per effort, and the options without gain."""
        best, others = self.best_for_effort, [o.name for o in self.options if o not in self._informative_options]
        sentences = []
        if best is not None:
            errors = f"from ± {format_percent(self.now.force_sd)} to ± {format_percent(best.force_sd)}"
            sentences.append(f"Largest gain per effort: {best.text}; uncertainty of the mean force {errors}.")
        if others:
            sentences.append(f"No gain from: {', '.join(others)}.")
        return tuple(sentences)


def design_measurement(scene: Scene, records: Record | Sequence[Record] = ()) -> MeasurementDesign:
    """Rank changes of a scene's measurement by the expected uncertainty of the mean force.

    The force is always the one of the scene's circuit and drive; the changes apply to the measurement only. Continuous
    settings are optimized. Uncertainties come from the Laplace approximation, with no unknown offset, drift or initial
    charge. The drive is exact unless the scene states the noise of V; with this noise, V is what a fit knows of the
    drive, and each channel has an unknown delay against it.

    Args:
        scene: measurement as it stands.
        records: records of it; their joint fit replaces the scene's values and noise. Of several records, the first is
            the one that is changed.

    Raises:
        InputError: the scene frees no parameter, states no noise, or states no drive and there is no record; as
            `fitact.fit`; or the fit ended at values that cannot be computed with.
    """
    records = (records,) if isinstance(records, Record) else tuple(records)
    if records:
        fitted = fit(records, scene)
        experiment = fitted.experiment
        assert experiment is not None  # which only spectra have not
        gradient = fitted.identifiability.force_gradient
        assert gradient is not None
        # the smallest difference between a record's values is the LSB of its ADC, or less
        steps = {name: float(np.diff(np.unique(records[0][name])).min()) for name in experiment.channels}
        trial = CandidateDesign.from_fit(experiment, gradient, fitted.identifiability.force_sd)
        judgement = fitted.trusted, (*([] if fitted.trusted else [fitted.message]), *fitted.warnings)
    else:
        experiment, judgement = experiment_from_scene(scene), (True, ())
        trial = CandidateDesign((experiment,))
        gradient = force_gradient(experiment)
        # an ordinary oscilloscope has an ADC of 8 bits
        steps = {channel: span / 256 for channel, span in signal_spans(experiment).items()}
    try:
        now = dataclasses.replace(evaluate_design(trial, (), gradient), name="now", text="as it stands")
    except np.linalg.LinAlgError as error:
        raise InputError(
            f"the information of the records cannot be computed at these values ({error}); check the scene's values,"
            " or first get a reliable fit of the record"
        ) from error
    options, curves = _rank_options(trial, gradient, now, changes(steps))
    prior_sd = float(np.linalg.norm(gradient @ experiment.prior_factor))
    return MeasurementDesign(now, options, curves, prior_sd, *judgement)


def experiment_from_scene(scene: Scene) -> Experiment:
    """Make the experiment that a scene states, at its own values."""
    scene.require_available()
    if "Ft" in scene.measurement.channels:
        raise InputError("scene: a design does not count the friction; leave 'Ft' out of [measurement] channels")
    measured, prior, nominal = scene.measurement, scene.make_prior(), scene.nominal_values()
    values = {name: math.exp(prior[name].log_mean) for name in prior.names if nominal[name] is None}
    values |= scene.fixed_values()
    tied = tuple((name, other, ratio) for name, (other, ratio) in scene.prior.ties().items())
    values |= {name: ratio * float(values.get(other) or nominal[other] or 0.0) for name, other, ratio in tied}
    noise = {"Vsc": measured.noise_Vsc, "I": measured.noise_I}
    if measured.noise_V is not None:  # then the record of V is what a fit knows of the drive
        noise["V"] = measured.noise_V
    silent = [channel for channel in measured.channels if noise[channel] == 0.0]
    if silent:
        raise InputError(f"scene: [measurement] noise_{silent[0]} is 0, so the data would be exact; state the noise")
    if not prior.names:
        raise InputError("scene: [prior] frees no parameter, so there is nothing to estimate; give a parameter a prior")
    circuit, time = count_harmonics(scene.make_circuit(values), scene.drive.lowest_frequency), sample_times(scene)
    counted = {*circuit_parameters(circuit), STRAY}
    prior = prior.drop_marginals(*(name for name in prior.names if name not in counted))
    anonymous = {"gain": measured.gain_relative_sd, "gain_I": measured.gain_I_relative_sd}
    gain_sd = {name: math.hypot(anonymous[name], scene.gain_u(channel)) for name, channel in GAIN_CHANNELS.items()}
    gains = [name for name in gain_names(measured.channels) if gain_sd[name] > 0.0]
    prior = prior.replace_marginals(**{name: LogNormal.with_relative_sd(1.0, gain_sd[name]) for name in gains})
    return Experiment(
        circuit=circuit,
        free=prior.names,
        prior_factor=np.linalg.cholesky(prior.covariance),
        drive=scene.make_drive(),
        time=time,
        channels=measured.channels,
        noise=noise,
        steady_state=scene.drive.steady_state,
        geometry=scene.geometry(),
        ties=tied,
        stray_capacitance=scene.stray_capacitance(),
        new_stray_sd=_stray_sd(scene),
        new_gain_sd={c: scene.gain_u(c) or typical_gain_u(c) for c in ("Vsc", "I") if scene.instrument.is_stated},
        delay_sd={name: scene.delay_sd(name, float(np.median(np.diff(time)))) for name in ("Vsc", "I")},
    )


def _stray_sd(scene: Scene) -> float:
    """Return the standard deviation of log(stray capacitance) in I, if its distribution is stated; else 0."""
    prior = scene.with_channels("I").make_prior()
    return float(prior[STRAY].log_sd) if STRAY in prior.names else 0.0


def _rank_options(
    trial: CandidateDesign, gradient: Gradient, baseline: DesignOption, candidates: Sequence[Change]
) -> tuple[tuple[DesignOption, ...], tuple[SettingCurve, ...]]:
    """Evaluate each change, and the best two together, best first; also return curves along one setting."""
    evaluated = {
        change.name: result
        for change in candidates
        if (result := _evaluate_best_settings(change(trial), gradient, baseline)) is not None
    }
    curves = tuple(curve for _, curve in evaluated.values() if curve is not None)
    options = [option for option, _ in evaluated.values()]
    by_name, by_force_sd = {change.name: change for change in candidates}, operator.attrgetter("force_sd")
    best = [by_name[option.name] for option in sorted(options, key=by_force_sd) if option.gain > option.min_gain]
    partner = next((change for change in best[1:] if change.group != best[0].group), None)
    together = partner and _evaluate_best_settings(_combine_changes(trial, best[0], partner), gradient, baseline)
    if together and together[0].gain > max(option.gain for option in options) + DesignOption.min_gain:
        options.append(together[0])
    return tuple(sorted(options, key=by_force_sd)), curves


def _combine_changes(trial: CandidateDesign, first: Change, second: Change) -> CandidateDesign | None:
    """Make both changes, or return None if neither can follow the other."""
    for one, other in ((first, second), (second, first)):
        changed = one(trial)
        changed = None if changed is None else other(changed)
        if changed is not None:
            return changed
    return None


def _evaluate_best_settings(
    trial: CandidateDesign | None, gradient: Gradient, baseline: DesignOption
) -> tuple[DesignOption, SettingCurve | None] | None:
    """Evaluate a design at its best settings, or return None if it cannot be made or computed."""
    if trial is None:
        return None
    with contextlib.suppress(np.linalg.LinAlgError):
        if not trial.settings:
            return evaluate_design(trial, (), gradient, baseline.force_sd), None
        optimum = optimise(trial, gradient)
        option, (setting, *others) = evaluate_design(trial, optimum.values, gradient, baseline.force_sd), trial.settings
        if others:
            return option, None
        values, force_sd = tuple(optimum.grid[0].tolist()), tuple(optimum.force_sd.tolist())
        return option, SettingCurve(setting.name, setting.unit, values, force_sd)
    return None
