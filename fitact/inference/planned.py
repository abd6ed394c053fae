"""Fits with the model that a scene requires, and with the full one where the records contradict it."""

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal, TypeAlias

from fitact.data.record import Record
from fitact.errors import InputError
from fitact.inference.fit import Fit, fit
from fitact.model.omissions import named
from fitact.model.plan import Plan, plan
from fitact.model.scene import Scene

Model: TypeAlias = Literal["planned", "full"]


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
    """Fit with the planned model of a scene; where that is a misfit and the full one is not, with the full one.

    A scene of a measured drive has no plan, and of several scenes each would have its own: they get the full model.

    Args:
        records: as in `fitact.fit`.
        scenes: none, one for all, or one for each.
        model: "full" asks for the full one from the first.
        options: of `fitact.fit`.

    Raises:
        InputError: as `fitact.fit` and `fitact.plan`.
    """
    full = tuple(scenes) if len(scenes) > 1 else (scenes[0] if scenes else None)
    why = _no_plan(scenes, model)
    if why:
        return PlannedFit(fit(records, full, **options), "full", f"The full model is fitted: {why}.")
    found = plan(scenes[0])
    fitted = fit(records, found.scene, **options)
    if found.left_out and fitted.result == "misfit":
        whole = _fitted_in_full(records, scenes[0], options)
        if whole is not None and whole.result != "misfit":
            said = (
                f"the record contradicts the planned model, which leaves out {', '.join(found.left_out)}: its fit is a"
                " misfit and that of the full model is not, so the full model is fitted"
            )
            whole = dataclasses.replace(whole, warnings=(*whole.warnings, said))
            return PlannedFit(whole, "full", f"{said[0].upper()}{said[1:]}.", found)
    return PlannedFit(fitted, "planned", found.sentence, found)


def _no_plan(scenes: Sequence[Scene], model: Model) -> str:
    """Why the full model is fitted from the first, as a clause; "" where there is a plan."""
    if model == "full":
        return "it was asked for"
    if not scenes:
        return "without a scene it is the paper's final circuit, which has nothing to leave out"
    if len(scenes) > 1:
        return "several scenes have no common plan"
    if scenes[0].drive.waveform == "measured":
        return "a measured drive cannot be planned for"
    return "" if named(scenes[0]) else "the scene names nothing that it could do without"


def _fitted_in_full(records: Sequence[Record], scene: Scene, options: dict[str, Any]) -> Fit | None:
    """The full model's fit; None where this version cannot fit it."""
    try:
        scene.require_available(fit=True)
    except InputError:
        return None
    return fit(records, scene, **options)
