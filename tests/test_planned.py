"""Fits with planned models: what is left out is said, and a record that contradicts it is heard."""

import dataclasses
import json

import pytest

import fitact
from fitact.data.simulate import simulate
from fitact.inference import planned
from fitact.inference.planned import fit_planned

SCENE = {"grounding": {"R_H": "500 ohm"}}
# a skin at the ground that is thinner, and a tolerance that lets it go
UNEQUAL = {
    "grounding": {"grounding_Rsc": "100 kohm", "grounding_Csc": "30 nF"},
    "tolerance": {"force": 0.9},
    "measurement": {"noise_Vsc": "20 mV"},
}


@pytest.mark.slow
def test_the_planned_model_is_fitted_and_that_is_said():
    scene = fitact.Scene.from_dict(SCENE)
    found = fit_planned([simulate(scene, seed=2)], [scene], "planned")
    assert found.used == "planned"
    assert found.fit.trusted
    assert found.fit.model()["circuit"] == "final"
    assert found.sentence.startswith("Left out: R_H; that changes the peak of Vsc by 0.14 %")
    assert json.loads(json.dumps(found.to_dict()))["model"]["left_out"] == "R_H"
    divider = found.fit.derived()["g"]
    assert abs(divider["q50"] - 1.35 / 24.7) < 4.0 * divider["sd"]


@pytest.mark.slow
def test_a_record_that_contradicts_the_plan_gets_the_full_model():
    scene = fitact.Scene.from_dict(UNEQUAL)
    record = simulate(scene, seed=2)
    found = fit_planned([record], [scene], "planned")
    assert found.plan.left_out == ("grounding skin",)
    assert fitact.fit(record, found.plan.scene).result == "misfit"
    assert found.used == "full"
    assert found.fit.result == "successful"
    assert found.fit.model()["circuit"] == "direct"
    assert "contradicts the planned model, which leaves out grounding skin" in found.sentence
    assert any("contradicts" in warning for warning in found.fit.warnings)
    assert found.to_dict()["omissions"][0]["name"] == "grounding skin"


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Of a fit that was not made."""

    scene: fitact.Scene
    result: str
    warnings: tuple[str, ...] = ()


@pytest.mark.parametrize(
    ("of_planned", "of_full", "used"),
    [
        ("successful", "successful", "planned"),
        ("misfit", "successful", "full"),
        ("misfit", "misfit", "planned"),
        ("misfit", "on_bound", "full"),
        ("on_bound", "successful", "planned"),
    ],
)
def test_which_model_is_used(monkeypatch, of_planned: str, of_full: str, used: str):
    scene = fitact.Scene.from_dict(SCENE)

    def fit(records: object, fitted: fitact.Scene, **options: object) -> Outcome:
        return Outcome(fitted, of_full if fitted == scene else of_planned)

    monkeypatch.setattr(planned, "fit", fit)
    found = fit_planned([], [scene], "planned")
    assert found.used == used
    assert (found.fit.scene == scene) == (used == "full")
    assert len(found.fit.warnings) == (used == "full")
    assert found.plan.left_out == ("R_H",)


def test_where_nothing_is_planned_the_full_model_is_fitted(monkeypatch):
    fitted = []
    monkeypatch.setattr(planned, "fit", lambda records, scene, **options: fitted.append(scene))
    scene = fitact.Scene.from_dict(SCENE)
    measured = fitact.Scene.from_dict(SCENE | {"drive": {"waveform": "measured"}})
    for scenes, model, reason in [
        ([scene], "full", "asked for"),
        ([], "planned", "without a scene"),
        ([scene, scene], "planned", "several scenes"),
        ([measured], "planned", "measured drive"),
        ([fitact.Scene()], "planned", "names nothing"),
    ]:
        found = fit_planned([], scenes, model)
        assert found.used == "full"
        assert reason in found.sentence
        assert found.to_dict() == {"used": "full", "sentence": found.sentence}
    assert fitted == [scene, None, (scene, scene), measured, fitact.Scene()]
