import math
from pathlib import Path

import numpy as np
import pytest

import fitact
from data_synth.make import simulate_response
from data_synth.scene import make_scene
from fitact.report.prior import write_prior
from fitact.scene.prior_predictive import prior_predictive, sample_prior

TIED = {
    "prior": {
        "Rsc": {"median": "130 kohm", "factor": 3},
        "Csc": {"table": "paper", "above": "Ci"},
        "Ci": {"tolerance": "10 %"},
        "grounding_Rsc": {"tied": "Rsc", "ratio": 2},
        "R_H": {"fixed": "500 ohm"},
        "correlation": {"Rsc-Csc": -0.6},
    }
}


@pytest.fixture(scope="module")
def predicted():
    return prior_predictive(
        fitact.Scene.from_dict({"prior": {"Rsc": {"factor": 3}, "Csc": {"factor": 3}}}), 200, seed=3
    )


def test_each_draw_is_the_circuit_at_its_parameters(predicted):
    """The steady state is computed with scipy's state space (data_synth), the force with eqs. (3) and (22)."""
    Rsc, Csc, Ci = (predicted.parameters[name] for name in ("Rsc", "Csc", "Ci"))
    time = np.arange(800) * 2.5e-5
    there = np.abs(predicted.time[:, None] - time).argmin(axis=0)
    for i in range(5):
        true = {"skin": {"Rsc": float(Rsc[i]), "Csc": float(Csc[i])}, "device": {"Ci": float(Ci[i])}}
        settled = simulate_response(make_scene(true, {}, "draw"), time)[1]
        np.testing.assert_allclose(predicted.Vsc[i][there], settled, atol=1e-6)
        derived = {name: draws[i] for name, draws in predicted.derived.items()}
        assert derived["Vsc_peak_to_peak"] == pytest.approx(np.ptp(settled), rel=1e-6)
        gap = 8.85e-12 * 1e-4 * (1.0 / Ci[i] + 1.0 / Csc[i])  # T_i / eps_i + T_sc / eps_sc
        per_square = 8.85e-12 * 1e-4 / (2.0 * gap * (1e-6 + 200e-6))
        assert derived["force_peak"] == pytest.approx(per_square * np.max(settled**2), rel=1e-6)
        g, x = Ci[i] / (Csc[i] + 2.0 * Ci[i]), 0.01 / (Rsc[i] * (Csc[i] + 2.0 * Ci[i]))
        mean_square = 4.0 * (180.0 * g) ** 2 * math.tanh(0.25 * x) / x  # square wave, steady state
        assert derived["force_mean"] == pytest.approx(per_square * mean_square, rel=1e-9)
        assert derived["b"] == pytest.approx(Rsc[i] * (Csc[i] + 2.0 * Ci[i]))
        assert derived["g"] == pytest.approx(Ci[i] / (Csc[i] + 2.0 * Ci[i]))


def test_summary_has_units_and_quantiles(predicted):
    content = predicted.to_dict()
    assert content["draws"] == 200
    assert content["parameters"]["Rsc"]["q50"] == pytest.approx(np.median(predicted.parameters["Rsc"]))
    assert {name: s["unit"] for name, s in content["derived"].items()} == {
        "g": "1", "b": "s", "Vsc_peak_to_peak": "V", "force_mean": "N", "force_peak": "N",
    }  # fmt: skip
    text = str(predicted)
    for word in ("Rsc", "kΩ", "force_mean", "µN", "95 %"):
        assert word in text


def test_fixed_tied_and_ordered_parameters_are_drawn_so():
    drawn = sample_prior(fitact.Scene.from_dict(TIED), np.random.default_rng(0), 5000)
    np.testing.assert_array_equal(drawn["grounding_Rsc"], 2.0 * drawn["Rsc"])
    assert set(drawn["R_H"]) == {500.0}
    assert np.all(drawn["Csc"] > drawn["Ci"])
    ranks = [np.argsort(np.argsort(drawn[name])) for name in ("Rsc", "Csc")]
    # the rank correlation of a normal copula (Pearson 1907); 5 standard errors of 5,000 draws
    assert np.corrcoef(ranks)[0, 1] == pytest.approx(6.0 / math.pi * math.asin(-0.3), abs=0.06)


@pytest.mark.parametrize(
    "drive",
    [
        pytest.param({"waveform": "trapezoid", "rise_time": "20 us"}, marks=pytest.mark.slow),
        {"waveform": "burst", "cycles": 1},
        {"steady_state": False},
    ],
)
def test_other_circuits_and_drives(drive: dict):
    predicted = prior_predictive(fitact.Scene.from_dict(TIED | {"drive": drive}), 100)
    assert set(predicted.derived) == {"Vsc_peak_to_peak", "force_mean", "force_peak"}
    assert np.all(np.isfinite(predicted.Vsc))
    peak = predicted.derived["force_peak"]
    assert np.all((predicted.derived["force_mean"] > 0.0) & (predicted.derived["force_mean"] < peak))
    Ci, Csc = predicted.parameters["Ci"], predicted.parameters["Csc"]
    ratio = peak / np.max(predicted.Vsc**2, axis=1) * (1.0 / Ci + 1.0 / Csc)  # constant for all draws, by eq. (22)
    np.testing.assert_allclose(ratio, 0.5 / 201e-6, rtol=0.01)


def test_dispersive_skin_and_measured_drive():
    scene = fitact.Scene.from_dict({"skin": {"level": "dispersive"}})
    assert np.all(np.isfinite(prior_predictive(scene, 100).derived["force_mean"]))
    with pytest.raises(fitact.InputError, match="measured"):
        prior_predictive(fitact.Scene.from_dict({"drive": {"waveform": "measured"}}))


def test_a_finger_that_is_known_has_a_figure_too(tmp_path: Path):
    known = {"Rsc": {"fixed": True}, "Csc": {"fixed": "20 nF"}, "Ci": {"fixed": True}}
    predicted = prior_predictive(fitact.Scene.from_dict({"prior": known}), 100)
    assert set(predicted.parameters["Csc"]) == {20e-9}
    write_prior(tmp_path / "known.png", predicted)


@pytest.mark.parametrize(("name", "start"), [("p.svg", b"<?xml"), ("p.png", b"\x89PNG"), ("p.html", b"<!doctype")])
def test_figure_is_written(predicted, tmp_path: Path, name: str, start: bytes):
    write_prior(tmp_path / name, predicted)
    content = (tmp_path / name).read_bytes()
    assert content.startswith(start)
    write_prior(tmp_path / f"again-{name}", predicted)
    assert (tmp_path / f"again-{name}").read_bytes() == content
    with pytest.raises(fitact.InputError, match=r"p\.pdf.*\.html"):
        write_prior(tmp_path / "p.pdf", predicted)
