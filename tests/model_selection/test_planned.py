"""Fits with planned models: dropped elements are reported, and a record that contradicts the plan is refitted."""

import dataclasses
import json

import numpy as np
import pytest
import scipy.signal

import fitact
from fitact.data.simulate import simulate
from fitact.model_selection import fit_planned as module
from fitact.model_selection.fit_planned import fit_planned

SCENE = {"grounding": {"R_H": "500 ohm"}}
# a thinner skin at the ground, and a tolerance that allows dropping it
UNEQUAL = {
    "grounding": {"grounding_Rsc": "100 kohm", "grounding_Csc": "30 nF"},
    "tolerance": {"force": 0.9},
    "measurement": {"noise_Vsc": "20 mV"},
}


@pytest.mark.slow
def test_the_planned_model_is_fitted_and_that_is_said():
    scene = fitact.Scene.from_dict(SCENE)
    found = fit_planned([simulate(scene, seed=2)], [scene], "planned")
    assert found.model == "planned"
    assert found.fit.trusted
    assert found.fit.model()["circuit"] == "final"
    assert found.sentence.startswith("Neglected: R_H. This changes the peak of Vsc by 0.14 %")
    assert json.loads(json.dumps(found.to_dict()))["model"]["left_out"] == "R_H"
    divider = found.fit.derived()["g"]
    assert abs(divider["q50"] - 1.35 / 24.7) < 4.0 * divider["sd"]


@pytest.mark.slow
def test_a_record_that_contradicts_the_plan_gets_the_full_model():
    scene = fitact.Scene.from_dict(UNEQUAL)
    record = simulate(scene, seed=2)
    found = fit_planned([record], [scene], "planned")
    assert found.plan.left_out == ("grounding skin",)
    assert fitact.fit(record, found.plan.scene).result == "structure"  # the scene tolerates 90 % of the force
    assert found.model == "full"
    assert found.fit.result == "successful"
    assert found.fit.model()["circuit"] == "direct"
    assert "contradicts the planned model, which neglects grounding skin" in found.sentence
    assert any("contradicts" in warning for warning in found.fit.warnings)
    assert found.to_dict()["omissions"][0]["name"] == "grounding skin"


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Result of a fit, without the fit."""

    scene: fitact.Scene
    result: str
    warnings: tuple[str, ...] = ()


@pytest.mark.parametrize(
    ("of_planned", "of_full", "used"),
    [
        ("successful", "successful", "planned"),
        ("misfit", "successful", "full"),
        ("not_at_optimum", "successful", "full"),
        ("misfit", "not_at_optimum", "planned"),
        ("misfit", "misfit", "planned"),
        ("misfit", "on_bound", "full"),
        ("on_bound", "successful", "planned"),
    ],
)
def test_which_model_is_used(monkeypatch, of_planned: str, of_full: str, used: str):
    scene = fitact.Scene.from_dict(SCENE)

    def fit(records: object, scenes: tuple[fitact.Scene, ...], *_: object, **options: object) -> Outcome:
        (fitted,) = scenes
        return Outcome(fitted, of_full if fitted == scene else of_planned)

    monkeypatch.setattr(module, "fit_records", fit)
    found = fit_planned([simulate(scene)], [scene], "planned")
    assert found.model == used
    assert (found.fit.scene == scene) == (used == "full")
    assert len(found.fit.warnings) == (used == "full")
    assert found.plan.left_out == ("R_H",)


@pytest.mark.slow
def test_a_recorded_drive_is_planned_for_as_it_was_recorded():
    drive = {"waveform": "trapezoid", "rise_time": "0.5 ms", "peak_to_peak": "200 V", "frequency": "250 Hz"}
    body = {"grounding": {"R_H": "20 kohm"}}  # acts over 27 us, which samples at 1 us resolve
    # noise of V would be part of a recorded drive, and of its peaks
    measured = {"sampling_rate": "1 MHz", "noise_V": "0 V"}
    named = fitact.Scene.from_dict(body | {"drive": drive, "measurement": measured})
    record = simulate(named)
    stated = fitact.plan(named)
    (r_h, edges, _) = stated.omissions
    assert edges.name == "edges"
    for drive in ({}, {"drive": {"waveform": "measured", "steady_state": True}}):
        scene = fitact.Scene.from_dict(body | drive)
        found = module.plan_for_record(record, scene).omissions[0]
        assert found.name == "R_H"
        # a sum over samples, which do not include the peak
        assert tuple(found.nominal) == pytest.approx(tuple(r_h.nominal), rel=1e-3)
        assert tuple(found.q95) == pytest.approx(tuple(r_h.q95), rel=1e-3)
    assert module.plan_for_record(record, named).omissions == stated.omissions


def test_a_part_of_a_period_is_planned_for_from_its_first_sample():
    """Against scipy from zero charge, with one time constant, and with R_H = 0.5 Mohm as a second."""
    scene = fitact.Scene.from_dict({"grounding": {"R_H": "0.5 Mohm"}})
    time = np.linspace(0.0, 3e-3, 3001)
    voltage = 100.0 * np.sin(2.0 * np.pi * 60.0 * time**1.1)
    record = fitact.Record.from_arrays(time, V=voltage, Vsc=0.05 * voltage)
    found = module.plan_for_record(record, scene).omissions[0]
    Rsc, Csc, Ci, R_H = 160e3, 22e-9, 1.35e-9, 0.5e6

    def force(resistance: float) -> np.ndarray:
        # Rsc Ci s / ((1 + Rsc Csc s) (1 + R Ci s) + 2 Rsc Ci s)
        skin, rest = Rsc * Csc, resistance * Ci
        system = ([Rsc * Ci, 0.0], np.trim_zeros([skin * rest, skin + rest + 2.0 * Rsc * Ci, 1.0], "f"))
        return scipy.signal.lsim(system, voltage, time)[1] ** 2

    full, reduced = force(R_H), force(0.0)
    assert found.nominal.force_peak == pytest.approx(abs(reduced.max() / full.max() - 1.0), rel=1e-4)
    assert found.nominal.force_mean == pytest.approx(abs(reduced[:-1].sum() / full[:-1].sum() - 1.0), rel=1e-4)


def test_where_nothing_is_planned_the_full_model_is_fitted(monkeypatch):
    fitted = []
    monkeypatch.setattr(module, "fit_records", lambda records, scenes, *_, **options: fitted.append(scenes))
    scene = fitact.Scene.from_dict(SCENE)
    measured = fitact.Scene.from_dict({"skin": {"level": "dispersive"}, "drive": {"waveform": "measured"}})
    for scenes, model, reason in [
        ([scene], "full", "requested"),
        ([], "planned", "without a scene"),
        ([scene, scene], "planned", "several scenes"),
        ([measured], "planned", "cannot be planned with a measured drive"),
        ([fitact.Scene()], "planned", "has no circuit element"),
    ]:
        found = fit_planned([simulate(fitact.Scene())], scenes, model)
        assert found.model == "full"
        assert reason in found.sentence
        assert found.to_dict() == {"used": "full", "sentence": found.sentence}
    assert fitted == [(scene,), (None,), (scene, scene), (measured,), (fitact.Scene(),)]
