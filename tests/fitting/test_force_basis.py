"""Basis of a computed force: law, defaults, the other law, the fraction of the prior, and the assumed Ci."""

import json

import numpy as np
import pytest

import fitact
from fitact.result_text import force_sentences, quantity_table
from tests.conftest import RECORDS, square_record

MEASURED = '[drive]\nwaveform = "measured"\n'
GAP = '[gap]\nthickness = "2 um"\n'


def fit_with(text: str, tmp_path, record: fitact.Record | None = None) -> fitact.Fit:
    path = tmp_path / "scene.toml"
    path.write_text(text)
    scene = fitact.Scene.load(path)
    return fitact.fit(record or fitact.read(RECORDS / "finger_direct.csv", scene), scene)


def origins(basis: dict) -> dict[str, str]:
    return {each["symbol"]: each["origin"] for each in basis["assumptions"]}


def test_each_value_that_nobody_stated_is_marked_as_a_default(tmp_path):
    """Only the skin thickness and fN are stated here."""
    fit = fit_with(MEASURED + '[skin]\nthickness = "100 um"\n[friction]\nnormal_force = "1 N"\n', tmp_path)
    assert origins(fit.force_basis) == {
        "Ci": "default", "relative sd of Ci": "default", "Ti": "default", "Tsc": "scene", "mu": "default",
        "fN": "scene",
    }  # fmt: skip
    text = fit.summary(verbose=True)
    assert "it was not measured, and these data do not test that law" in text
    assert "Tsc = 100 µm (scene), mu = 0.5 (default), fN = 1 N (scene)" in text
    assert json.loads(json.dumps(fit.to_dict()))["force_basis"] == json.loads(json.dumps(fit.force_basis))


def test_a_drive_of_the_scene_is_named_with_its_defaults(tmp_path):
    record = square_record()
    without_V = fitact.Record.from_arrays(record.time, Vsc=record["Vsc"])
    fit = fit_with('[drive]\npeak_to_peak = "360 V"\n', tmp_path, without_V)
    marks = origins(fit.force_basis)
    assert (marks["waveform"], marks["Vpp"], marks["f"]) == ("default", "scene", "default")


def test_the_force_by_the_other_law_is_that_of_a_fit_by_it(tmp_path):
    """The same circuit is fitted by both; eq. (22) and the gap law differ by three orders of magnitude."""
    by_paper = fit_with(MEASURED + GAP, tmp_path)
    by_gap = fit_with(MEASURED + GAP + '[force]\nmodel = "gap"\n', tmp_path)
    for fit, other in ((by_paper, by_gap), (by_gap, by_paper)):
        law = fit.force_basis["other_law"]
        assert law["law"] == other.force_basis["law"]
        assert law["force_mean"]["q50"] == pytest.approx(other.derived()["force_mean"]["q50"], rel=1e-6)
        assert law["force_mean"]["sd"] == pytest.approx(other.derived()["force_mean"]["sd"], rel=1e-4)
    # F = eps0 A Vgap^2 / (2 d^2), and Vgap = Vsc (Csc / Cgap) at high frequency bounds the order of magnitude
    assert by_gap.derived()["force_mean"]["q50"] > 1e3 * by_paper.derived()["force_mean"]["q50"]
    assert "Mean force by the other law" in by_paper.summary(verbose=True)


def test_without_a_gap_there_is_no_other_law(finger_fit: fitact.Fit):
    assert finger_fit.force_basis["other_law"] is None
    assert len(force_sentences(finger_fit.force_basis)) == 2


@pytest.mark.parametrize(
    ("text", "warned"),
    [
        ("", True),
        ('[device]\nCi = "1.3 nF"\n', False),
        ('[prior]\nCi = {median = "1.3 nF", relative_sd = 0.1}\n', False),
        ("[prior]\nCi = {relative_sd = 0.1}\n", True),
        ('[device]\ninsulator_thickness = "1 um"\ninsulator_permittivity = 2\ncontact_area = "80 mm^2"\n', False),
        ('[device]\ninsulator_thickness = "1 um"\ninsulator_permittivity = 2\n', True),  # with the default area
    ],
)
def test_a_scene_without_Ci_is_warned(text: str, warned: bool, tmp_path):
    fit = fit_with(MEASURED + text, tmp_path)
    assert any("the scene does not state Ci" in warning for warning in fit.warnings) == warned


def test_a_Ci_that_the_data_determine_is_only_noted():
    """The current determines Ci, so that an assumed one cannot change the result."""
    scene = fitact.Scene(drive={"waveform": "measured"}, measurement={"channels": ["Vsc", "I"]})
    path = sorted((RECORDS / "fingers").glob("*.csv.gz"))[0]
    fit = fitact.fit(fitact.read(path, scene), scene)
    # known to 1 %: the corners of V lie at one part of a step in every period, so that their errors do not average
    assert fit.parameters()["Ci"]["from_prior"] < 0.05
    assert not any("Ci" in warning for warning in fit.warnings)
    assert any("the data determine Ci" in note for note in fit.notes)
    assert "Ci" not in origins(fit.force_basis)  # the force no longer rests on the prior


def test_a_recorded_channel_that_is_not_fitted_is_named():
    path = sorted((RECORDS / "fingers").glob("*.csv.gz"))[0]
    for channels, named in ((["Vsc"], True), (["Vsc", "I"], False)):
        scene = fitact.Scene(drive={"waveform": "measured"}, measurement={"channels": channels})
        fit = fitact.fit(fitact.read(path, scene), scene)
        assert any("I is recorded but not fitted" in note for note in fit.notes) == named


def test_the_fraction_from_the_prior_is_that_of_the_information(finger_fit: fitact.Fit):
    """The prior contributes C P^-1 C to the variance C, the data contribute the rest."""
    covariance, prior = finger_fit.covariance, finger_fit.likelihood.prior_factor
    share = np.diag(covariance @ np.linalg.inv(prior @ prior.T) @ covariance) / np.diag(covariance)
    stated = [finger_fit.parameters()[name]["from_prior"] for name in finger_fit.names]
    np.testing.assert_allclose(stated, share, rtol=1e-6)
    assert finger_fit.derived()["g"]["from_prior"] < 1e-6
    assert finger_fit.derived()["force_mean"]["from_prior"] > 0.999


def test_friction_of_defaults_has_no_five_digits(finger_fit: fitact.Fit, tmp_path):
    row = next(row for row in quantity_table(finger_fit.to_dict()) if row[0] == "friction_mean")
    assert row[1] == "about 250 mN"
    assert row[5] == "default mu, default fN"
    assert "friction_mean" not in finger_fit.to_dict()["budget"]  # nobody measured it
    assert "u" not in finger_fit.derived()["friction_mean"]
    stated = fit_with(MEASURED + '[friction]\ncoefficient = 0.4\nnormal_force = "1 N"\n', tmp_path)
    row = next(row for row in quantity_table(stated.to_dict()) if row[0] == "friction_mean")
    assert "±" in row[1]


def test_the_shipped_record_says_that_it_is_simulated(finger_fit: fitact.Fit):
    assert any("simulated by ngspice" in note for note in finger_fit.notes)
    assert "note: The record is simulated" in str(finger_fit)
