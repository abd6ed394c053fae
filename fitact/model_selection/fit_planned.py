"""Fits with the model that a scene requires, and with the full one where the records contradict it."""

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal, TypeAlias

import jax

from fitact.data.record import Record
from fitact.errors import InputError
from fitact.fitting.drive_choice import choose_drive, whole_periods
from fitact.fitting.fit import Fit, fit
from fitact.model.drive import Sampled
from fitact.model_selection.omissions import named, without
from fitact.model_selection.plan import Plan, plan
from fitact.scene.scene import Scene

Model: TypeAlias = Literal["planned", "full"]

_FAILED = ("misfit", "not_at_optimum")  # how a fit ends whose model is too simple
_SAMPLES = 20_000  # of a measured drive that a plan looks at


@dataclasses.dataclass(frozen=True)
class PlannedFit:
    """A fit, and how its model came about.

    Attributes:
        fit: of the model that is used.
        used: which one that is.
        sentence: why, and what that costs.
        plan: None where there was nothing to plan.
    """

    fit: Fit
    used: Model
    sentence: str
    plan: Plan | None = None

    def to_dict(self) -> dict[str, Any]:
        """The entry `plan` of fit.json and summary.json."""
        stated = {"used": self.used, "sentence": self.sentence}
        return stated if self.plan is None else stated | self.plan.to_dict()


def fit_planned(records: Sequence[Record], scenes: Sequence[Scene], model: Model, **options: Any) -> PlannedFit:
    """Fit with the planned model of a scene; where that does not describe the records and the full one does, with it.

    Where the recorded V drives the fit, that is planned for, as it was recorded. Several scenes would each have their
    own plan: they get the full model.

    Args:
        records: as in `fitact.fit`.
        scenes: none, one for all, or one for each.
        model: "full" asks for the full one from the first.
        options: of `fitact.fit`.

    Raises:
        InputError: as `fitact.fit` and `fitact.plan`.
    """
    full = tuple(scenes) if len(scenes) > 1 else (scenes[0] if scenes else None)
    why, recorded = _no_plan(scenes, model), None
    if not why:  # only now is the record worth a look
        recorded = _recorded(records[0], scenes[0])
        if recorded is not None and scenes[0].skin.level != "constant":
            why = "a skin that depends on the frequency has no plan with a measured drive"
    if why:
        return PlannedFit(fit(records, full, **options), "full", f"The full model is fitted: {why}.")
    found = plan(scenes[0], recorded)
    fitted = fit(records, without(scenes[0], found.left_out), **options)
    if found.left_out and fitted.result in _FAILED:
        whole = _fitted_in_full(records, scenes[0], options)
        if whole is not None and whole.result not in _FAILED:
            said = (
                f"the record contradicts the planned model, which leaves out {', '.join(found.left_out)}: its fit does"
                " not describe it and that of the full model does, so the full model is fitted"
            )
            whole = dataclasses.replace(whole, warnings=(*whole.warnings, said))
            return PlannedFit(whole, "full", f"{said[0].upper()}{said[1:]}.", found)
    return PlannedFit(fitted, "planned", found.sentence, found)


def plan_for(record: Record, scene: Scene) -> Plan:
    """The plan for a record: of its V, where that is what drives the fit, else of the scene's drive.

    Raises:
        InputError: as `fitact.plan`, or the record does not fit the scene's drive.
    """
    return plan(scene, _recorded(record, scene))


def _no_plan(scenes: Sequence[Scene], model: Model) -> str:
    """Why the full model is fitted from the first, as a clause; "" where there is a plan."""
    if model == "full":
        return "it was asked for"
    if not scenes:
        return "without a scene it is the paper's final circuit, which has nothing to leave out"
    if len(scenes) > 1:
        return "several scenes have no common plan"
    return "" if named(scenes[0]) else "the scene names nothing that it could do without"


def _recorded(record: Record, scene: Scene) -> Sampled | None:
    """The beginning of the recorded V, where that drives the fit: whole periods of it where it holds some."""
    with jax.enable_x64(True):
        choice = choose_drive(record, scene)
    if choice.name != "measured":
        return None
    begin = Record(record.time[:_SAMPLES], {"V": choice.voltage[:_SAMPLES]}, record.source)
    kept, period = whole_periods(begin)
    return Sampled(begin.time[:kept], begin["V"][:kept], period)


def _fitted_in_full(records: Sequence[Record], scene: Scene, options: dict[str, Any]) -> Fit | None:
    """The full model's fit; None where this version cannot fit it."""
    try:
        scene.require_available(fit=True)
    except InputError:
        return None
    return fit(records, scene, **options)
