"""Fits with the planned model of a scene, or with the full model if the records contradict it."""

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal, TypeAlias

from fitact.data.record import Record
from fitact.data.spectrum import Spectrum
from fitact.fitting.fit import fit_records
from fitact.fitting.result import Fit
from fitact.model.drive import Sampled
from fitact.model_selection.omissions import applicable_omissions, reduce_scene
from fitact.model_selection.plan import Plan, plan
from fitact.problem.drive_choice import DriveModel, choose_drive, whole_periods
from fitact.scene.scene import Scene

Model: TypeAlias = Literal["planned", "full"]

# results of a fit whose model is too simple, the worst last
_FAILED_RESULTS = ("structure", "misfit", "not_at_optimum")


@dataclasses.dataclass(frozen=True)
class PlannedFit:
    """A fit, and the choice of its model."""

    fit: Fit
    model: Model  # model in use
    sentence: str  # reason for the choice, and the error that it causes
    plan: Plan | None = None  # None if nothing was planned

    @property
    def omits_elements(self) -> bool:
        """Whether elements of the scene are neglected."""
        return self.model == "planned" and self.plan is not None and bool(self.plan.left_out)

    def to_dict(self) -> dict[str, Any]:
        """Return the entry `plan` of fit.json and summary.json."""
        entry = {"used": self.model, "sentence": self.sentence}
        return entry if self.plan is None else entry | self.plan.to_dict()


def fit_planned(
    records: Sequence[Record | Spectrum], scenes: Sequence[Scene], model: Model, **options: Any
) -> PlannedFit:
    """Fit with the planned model of a scene, or with the full model if only that describes the records.

    If the recorded V drives the fit, the plan is made for the recorded V. `scenes` holds no scene, one for all records,
    or one for each record. Several scenes would have different plans, so they get the full model. `options` as in
    `fitact.fit`.
    """
    full: tuple[Scene | None, ...] = tuple(scenes) if len(scenes) > 1 else (*scenes, None)[:1] * len(records)
    why = _reason_for_full_model(records, scenes, model)
    drives: tuple[DriveModel, ...] = ()
    in_time = tuple(record for record in records if isinstance(record, Record))
    if not why:  # the drive is needed only for a plan
        drives = (choose_drive(in_time[0], scenes[0]),)
        if drives[0].name == "measured" and scenes[0].skin.level != "constant":
            why = "a frequency-dependent skin cannot be planned with a measured drive"
    if why:
        return PlannedFit(
            fit_records(tuple(records), full, drives, **options), "full", f"Fitted the full model: {why}."
        )
    planned = plan(scenes[0], _measured_part(in_time[0], drives[0]))
    reduced = reduce_scene(scenes[0], planned.left_out)
    same = reduced.drive == scenes[0].drive and reduced.drive.model_fields_set == scenes[0].drive.model_fields_set
    fitted = fit_records(in_time, (reduced,) * len(records), drives if same else (), **options)
    if planned.left_out and fitted.result in _FAILED_RESULTS:
        whole = fit_records(in_time, (scenes[0],) * len(records), drives, **options)
        if _failure_rank(whole) < _failure_rank(fitted):
            warning = (
                f"the record contradicts the planned model, which neglects {', '.join(planned.left_out)}: only the"
                " full model describes the record, so the full model was fitted"
            )
            whole = dataclasses.replace(whole, warnings=(*whole.warnings, warning))
            return PlannedFit(whole, "full", f"{warning[0].upper()}{warning[1:]}.", planned)
    return PlannedFit(fitted, "planned", planned.sentence, planned)


def _failure_rank(fitted: Fit) -> int:
    return _FAILED_RESULTS.index(fitted.result) if fitted.result in _FAILED_RESULTS else -1


def plan_for_record(record: Record, scene: Scene) -> Plan:
    """Make a plan for a record: for its V if this drives the fit, else for the scene's drive."""
    return plan(scene, _measured_part(record, choose_drive(record, scene)))


def _reason_for_full_model(records: Sequence[Record | Spectrum], scenes: Sequence[Scene], model: Model) -> str:
    """Return why the full model is fitted without a plan, as a clause; "" if a plan is made."""
    if any(isinstance(record, Spectrum) for record in records):
        return "a spectrum shows elements that hardly matter to the force"
    if model == "full":
        return "it was requested"
    if not scenes:
        return "without a scene it is the final circuit of the reference paper, which has no element to neglect"
    if len(scenes) > 1:
        return "several scenes have no common plan"
    return "" if applicable_omissions(scenes[0]) else "the scene has no circuit element that could be neglected"


def _measured_part(record: Record, choice: DriveModel, max_samples: int = 20_000) -> Sampled | None:
    """Return the beginning of the recorded V if it drives the fit, in whole periods if possible."""
    if choice.name != "measured":
        return None
    begin = Record(record.time[:max_samples], {"V": choice.voltage[:max_samples]}, record.source)
    samples, period = whole_periods(begin)
    return Sampled(begin.time[:samples], begin["V"][:samples], period)
