"""Distributions of thicknesses, permittivities, area and friction: prior of Ci, conditional draws, force, table."""

import math
from pathlib import Path

import numpy as np
import pytest
import scipy.integrate
import scipy.stats

import fitact
from fitact.data.simulate import simulate
from fitact.fitting.geometry import Capacitances, UncertainGeometry
from fitact.result_text import force_sentences
from fitact.units import format_engineering
from tests.conftest import RECORDS

EPSILON_0 = 8.85e-12
MEASURED = {"drive": {"waveform": "measured"}}
UNIFORM_AREA = {"low": "80 mm^2", "high": "120 mm^2"}
LAYER = {
    "insulator_thickness": {"median": "1 um", "relative_sd": 0.05},
    "insulator_permittivity": {"median": 3.9, "relative_sd": 0.03},
    "contact_area": {"median": "1 cm^2", "relative_sd": 0.1},
}


def log_sd(relative_sd: float) -> float:
    return math.sqrt(math.log1p(relative_sd**2))


def scene_with(**sections: dict) -> fitact.Scene:
    return fitact.Scene.from_dict(MEASURED | sections)


@pytest.fixture(scope="module")
def record() -> fitact.Record:
    return fitact.read(RECORDS / "finger_direct.csv")


@pytest.mark.parametrize(
    "stated",
    [
        {"median": "1 um", "relative_sd": 0.05},
        {"median": "1 um", "factor": 1.5},
        {"low": "0.8 um", "high": "1.2 um"},
        {"low": "0.5 um", "high": "2 um", "scale": "log"},
        {"nominal": "1 um", "tolerance": "10 %"},
    ],
)
def test_a_distribution_is_a_number_and_survives_both_formats(stated: dict, tmp_path: Path):
    scene = scene_with(device={"insulator_thickness": stated})
    path = tmp_path / "scene.toml"
    path.write_text(str(scene))
    for other in (fitact.Scene.load(path), fitact.Scene.from_json(scene.to_json())):
        assert other == scene
        assert other.geometry_distributions() == scene.geometry_distributions()
    assert float(scene.device.insulator_thickness) == pytest.approx(1e-6)
    assert type(scene.geometry().insulator_thickness) is float
    assert scene != scene_with(device={"insulator_thickness": "1 um"})


@pytest.mark.parametrize(
    ("section", "content", "message"),
    [
        ("device", {"insulator_thickness": {"relative_sd": 0.1}}, "insulator_thickness: write {median, relative_sd}"),
        ("device", {"contact_area": {"fixed": True}}, "contact_area: write {median, relative_sd}"),
        ("device", {"contact_area": {"medain": 1e-4, "factor": 2}}, "contact_area.medain is not a key .* 'median'"),
        ("device", {"insulator_permittivity": {"low": 0.5, "high": 3}}, "insulator_permittivity = 0.5"),
        ("skin", {"thickness": {"nominal": "200 um", "tolerance": -0.1}}, "thickness.tolerance = -0.1"),
        ("skin", {"thickness": {"median": "200 s", "factor": 2}}, "not in a unit of m"),
        ("skin", {"Csc": "20 nF", "permittivity": 5000}, "Csc and permittivity state the same"),
    ],
)
def test_an_impossible_distribution_is_refused_in_one_sentence(section: str, content: dict, message: str):
    with pytest.raises(fitact.InputError, match=message):
        scene_with(**{section: content})


def test_the_prior_of_a_derived_capacitance_is_that_of_the_product():
    marginal = scene_with(device=LAYER).make_prior()["Ci"]
    assert marginal.log_mean == pytest.approx(math.log(EPSILON_0 * 3.9 * 1e-4 / 1e-6), rel=1e-12)
    assert marginal.log_sd == pytest.approx(math.hypot(log_sd(0.05), log_sd(0.03), log_sd(0.1)), rel=1e-12)
    alone = {"insulator_thickness": "1 um", "insulator_permittivity": 3.9}
    assert scene_with(device=alone).make_prior()["Ci"].log_sd == pytest.approx(log_sd(0.05))  # the default


def test_the_prior_of_a_product_with_a_uniform_area_is_that_by_quadrature():
    """P(ln C < u) = E over the uniform area of Phi((u - ln(eps0 3.9 A / 1 um)) / s)."""
    thickness = {"median": "1 um", "relative_sd": 0.1}
    device = {"insulator_thickness": thickness, "insulator_permittivity": 3.9, "contact_area": UNIFORM_AREA}
    marginal = scene_with(device=device).make_prior()["Ci"]
    for z in (-2.0, -0.5, 0.0, 1.0, 2.5):
        u = float(marginal.from_standard_normal(z))

        def below(area: float, u: float = u) -> float:
            return float(scipy.stats.norm.cdf((u - math.log(EPSILON_0 * 3.9 * area / 1e-6)) / log_sd(0.1)))

        expected = scipy.integrate.quad(below, 0.8e-4, 1.2e-4, epsabs=1e-12)[0] / 0.4e-4
        assert scipy.stats.norm.cdf(z) == pytest.approx(expected, abs=2e-4)  # 2048 cells over 20 sd


def test_two_capacitances_share_the_area():
    """The correlation of ln Ci and ln Csc is the variance of ln A over the product of their standard deviations."""
    skin = {"permittivity": {"median": 5000, "relative_sd": 0.2}, "thickness": {"median": "200 um", "relative_sd": 0.2}}
    scene = scene_with(device=LAYER, skin=skin)
    assert scene.skin.Csc == pytest.approx(EPSILON_0 * 5000 * 1e-4 / 200e-6)
    prior = scene.make_prior()
    variances = [log_sd(0.05) ** 2 + log_sd(0.03) ** 2 + log_sd(0.1) ** 2, 2.0 * log_sd(0.2) ** 2 + log_sd(0.1) ** 2]
    places = [prior.names.index(name) for name in ("Ci", "Csc")]
    expected = log_sd(0.1) ** 2 / math.sqrt(math.prod(variances))
    assert prior.correlation[places[0], places[1]] == pytest.approx(expected, rel=1e-9)
    assert fitact.Scene.from_json(scene.to_json()) == scene


def draws_given(scene: fitact.Scene, Ci: float, Csc: float = 22e-9, n: int = 20_000) -> dict[str, np.ndarray]:
    capacitances = Capacitances(np.full(n, Ci), np.full(n, Csc))
    return UncertainGeometry.from_scene(scene).draw_logs(capacitances, (n,), seed=0)


def test_log_normal_quantities_given_Ci_are_gaussian_conditionals():
    """x | ln Ci: mean m + D p (u - p m) / (p D p), covariance D - D p p' D / (p D p). 20,000 draws: 2.8 % of an sd is
    four standard errors of a mean."""
    names, powers = list(LAYER), np.array([-1.0, 1.0, 1.0])
    logs = draws_given(scene_with(device=LAYER), 4e-9)
    drawn = np.stack([logs[name] for name in names])
    assert np.allclose(powers @ drawn + math.log(EPSILON_0), math.log(4e-9), atol=1e-12)
    mean = np.log([1e-6, 3.9, 1e-4])
    covariance = np.diag([log_sd(0.05), log_sd(0.03), log_sd(0.1)]) ** 2
    gain = covariance @ powers / (powers @ covariance @ powers)
    expected = mean + gain * (math.log(4e-9 / EPSILON_0) - powers @ mean)
    rest = covariance - np.outer(gain, powers @ covariance)
    sds = np.sqrt(np.diag(rest))
    assert np.allclose(drawn.mean(axis=1), expected, atol=0.03 * sds)
    assert np.allclose(np.cov(drawn) / np.outer(sds, sds), rest / np.outer(sds, sds), atol=0.05)


@pytest.mark.parametrize("Ci", [3.0e-9, 3.4e-9, 4.1e-9])
def test_bounded_quantities_given_Ci_are_those_of_brute_force_rejection(Ci: float):
    """Kolmogorov-Smirnov of thickness and area at 0.1 %, against draws of both within 0.1 % of Ci, at fixed seeds."""
    thickness = {"nominal": "1 um", "tolerance": 0.15}
    device = {"insulator_thickness": thickness, "insulator_permittivity": 3.9, "contact_area": UNIFORM_AREA}
    logs = draws_given(scene_with(device=device), Ci, n=5000)
    rng = np.random.default_rng(1)
    Ti, area = rng.uniform(0.85e-6, 1.15e-6, 3_000_000), rng.uniform(0.8e-4, 1.2e-4, 3_000_000)
    kept = np.abs(np.log(EPSILON_0 * 3.9 * area / Ti / Ci)) < 1e-3
    assert np.count_nonzero(kept) > 4000
    for name, values in {"insulator_thickness": Ti, "contact_area": area}.items():
        assert scipy.stats.ks_2samp(np.exp(logs[name]), values[kept]).pvalue > 1e-3


def test_an_area_that_both_capacitances_share_is_drawn_as_by_rejection():
    """Log-normal area and thicknesses; rejection within a tenth of an sd of both capacitances."""
    device = {"insulator_thickness": LAYER["insulator_thickness"], "insulator_permittivity": 3.9}
    skin = {"permittivity": 5000, "thickness": {"median": "200 um", "relative_sd": 0.1}}
    scene = scene_with(device=device | {"contact_area": LAYER["contact_area"]}, skin=skin)
    Ci, Csc = 3.6e-9, 24e-9
    logs = draws_given(scene, Ci, Csc, n=4000)
    rng, n = np.random.default_rng(2), 4_000_000
    area, Ti, Tsc = (
        median * np.exp(log_sd(spread) * rng.standard_normal(n))
        for median, spread in ((1e-4, 0.1), (1e-6, 0.05), (2e-4, 0.1))
    )
    kept = np.abs(np.log(EPSILON_0 * 3.9 * area / Ti / Ci)) < 0.01
    kept &= np.abs(np.log(EPSILON_0 * 5000 * area / Tsc / Csc)) < 0.01
    assert np.count_nonzero(kept) > 2000
    for name, values in {"insulator_thickness": Ti, "skin_thickness": Tsc, "contact_area": area}.items():
        assert scipy.stats.ks_2samp(np.exp(logs[name]), values[kept]).pvalue > 1e-3


@pytest.mark.parametrize("area", [UNIFORM_AREA, LAYER["contact_area"]])
def test_a_shared_area_without_closed_form_is_refused(area: dict):
    """A uniform area; and one that alone would set both capacitances."""
    device = {"insulator_thickness": "1 um", "insulator_permittivity": 3.9, "contact_area": area}
    with pytest.raises(fitact.InputError, match="contact_area sets Ci and Csc together"):
        scene_with(device=device, skin={"permittivity": 5000})


@pytest.fixture(scope="module")
def plain_fit(record: fitact.Record) -> fitact.Fit:
    return fitact.fit(record, scene_with())


@pytest.fixture(scope="module")
def uncertain_fit(record: fitact.Record) -> fitact.Fit:
    """Skin thickness and friction with distributions, and a contact area that changes nothing."""
    skin = {"thickness": {"median": "200 um", "relative_sd": 0.2}}
    friction = {"coefficient": {"median": 0.5, "relative_sd": 0.1}}
    return fitact.fit(record, scene_with(skin=skin, friction=friction, device={"contact_area": UNIFORM_AREA}))


def relative_sd(summary: dict) -> float:
    """Return the sd of the logarithm of a log-normal quantity."""
    return math.sqrt(math.log1p((summary["sd"] / summary["mean"]) ** 2))


def test_the_error_of_the_force_is_the_root_of_the_sum_of_squares(plain_fit: fitact.Fit, uncertain_fit: fitact.Fit):
    """Eq. (22): d ln F / d ln Tsc = -Tsc / (Ti + Tsc). The sd of 10,000 draws has an error of 0.7 %."""
    slope = 200.0 / 201.0
    before, after = plain_fit.derived()["force_mean"], uncertain_fit.derived()["force_mean"]
    expected = math.hypot(relative_sd(before), slope * log_sd(0.2))
    assert relative_sd(after) == pytest.approx(expected, rel=1e-6)
    assert after["q50"] == pytest.approx(before["q50"], rel=1e-9)
    assert uncertain_fit.derived()["g"] == plain_fit.derived()["g"]
    posterior = fitact.sample(uncertain_fit, level="laplace", seed=0)
    draws, parameters = posterior.derived(), posterior.parameters()
    assert np.std(np.log(draws["force_mean"])) == pytest.approx(expected, rel=0.03)
    friction = parameters["friction_coefficient"] * (draws["force_mean"] + 0.5)
    assert np.allclose(draws["friction_mean"], friction, rtol=1e-12)
    nominal = fitact.sample(plain_fit, level="laplace", seed=0).derived()["force_mean"]
    assert np.allclose(draws["force_mean"], nominal * 201e-6 / (1e-6 + parameters["skin_thickness"]), rtol=1e-9)
    tree = posterior.to_datatree()
    assert tree["posterior"]["skin_thickness"].attrs["units"] == "m"
    assert list(posterior.summary()["parameters"])[:3] == ["Rsc", "Csc", "Ci"]


def test_what_changes_nothing_is_noted_once(plain_fit: fitact.Fit, uncertain_fit: fitact.Fit):
    notes = [note for note in uncertain_fit.notes if "has no effect" in note]
    assert len(notes) == 1
    assert "contact area A" in notes[0]
    assert "skin" not in notes[0]
    assert not any("has no effect" in note for note in plain_fit.notes)


def test_the_sentence_names_the_distributions_that_the_errors_include(plain_fit: fitact.Fit, uncertain_fit: fitact.Fit):
    included = "includes that of the prior, of the stated distributions (Tsc, mu) and of Tsc"
    assert included in force_sentences(uncertain_fit.force_basis)[1]
    assert "includes that of the prior and of Tsc, but of no other" in force_sentences(plain_fit.force_basis)[1]
    assert "Tsc = 200 µm ± 20 % (scene)" in uncertain_fit.summary(verbose=True)


def test_an_assumed_distribution_is_listed_but_changes_no_error(plain_fit: fitact.Fit):
    entries = plain_fit.geometry_contributions()
    (entry,) = entries["force_mean"]
    assert (entry.name, entry.stated, entry.relative_sd) == ("skin_thickness", False, 0.25)
    assert entry.sensitivity == pytest.approx(-200.0 / 201.0, rel=1e-6)
    assert "default: " in entry.source
    assert entries["g"][0].sensitivity == entries["Ci"][0].sensitivity == 0.0
    assert set(entries) >= {"g", "b", "Rsc", "Csc", "Ci", "force_mean", "force_peak", "force_rms", "friction_mean"}
    assert "skin_thickness" not in fitact.sample(plain_fit, level="laplace", seed=0).parameters()


@pytest.fixture(scope="module")
def derived_fit(record: fitact.Record) -> fitact.Fit:
    return fitact.fit(record, scene_with(device=LAYER, skin={"thickness": {"median": "200 um", "relative_sd": 0.2}}))


def test_components_of_a_derived_Ci_add_up(derived_fit: fitact.Fit):
    """Vsc determines neither Ci nor the layer: ln Ci has slopes 1, 1 and -1, and the force those of Ci plus its own.

    The wide priors of Rsc and Csc, sd 2.0 and 1.5 in logarithms against 0.115 of Ci, take 1 % of them.
    """
    entries = derived_fit.geometry_contributions()
    slopes = {entry.name: entry.sensitivity for entry in entries["Ci"]}
    assert slopes["contact_area"] == pytest.approx(1.0, abs=0.015)
    assert slopes["insulator_permittivity"] == pytest.approx(1.0, abs=0.015)
    assert slopes["insulator_thickness"] == pytest.approx(-1.0, abs=0.015)
    assert all(abs(entry.sensitivity) < 0.01 for entry in entries["g"])
    for name in ("Ci", "force_mean"):
        total = relative_sd((derived_fit.parameters() | derived_fit.derived())[name])
        parts = [entry.relative_sd * entry.sensitivity for entry in entries[name]]
        assert math.hypot(*parts) == pytest.approx(total, rel=0.01)
    posterior = fitact.sample(derived_fit, level="laplace", seed=0)
    logs = {name: np.log(x).ravel() for name, x in (posterior.parameters() | posterior.derived()).items()}
    for entry in entries["force_mean"]:
        covariance = np.cov(logs["force_mean"], logs[entry.name])  # of 10,000 draws
        assert covariance[0, 1] / covariance[1, 1] == pytest.approx(entry.sensitivity, abs=0.1)


def test_a_stated_prior_of_Ci_wins(record: fitact.Record):
    scene = scene_with(device=LAYER, prior={"Ci": {"median": "1.35 nF", "relative_sd": 0.02}})
    fit = fitact.fit(record, scene)
    assert scene.make_prior()["Ci"].log_sd == pytest.approx(log_sd(0.02))
    assert any("[prior] Ci is stated, so its prior is that" in note for note in fit.notes)
    slopes = {entry.name: entry.sensitivity for entry in fit.geometry_contributions()["Ci"]}
    assert set(slopes.values()) == {0.0}


@pytest.mark.slow
def test_the_current_updates_the_thickness():
    """The loop current determines Ci, so ln Ti | data has variance u^2 - u^4 / s^2 + (u^2 / s^2)^2 sd(ln Ci)^2, and its
    mean moves by -u^2 / s^2 (ln Ci - ln Ci nominal), with u of ln Ti and s^2 the sum of the three variances."""
    common = {"measurement": {"channels": ["Vsc", "I"], "sampling_rate": "50 kHz"}, "grounding": {"R_H": "10 kohm"}}
    record = simulate(fitact.Scene.from_dict(common | {"device": {"Ci": "4 nF"}}), seed=3)
    fit = fitact.fit(record, fitact.Scene.from_dict(common | {"device": LAYER}))
    place = fit.names.index("Ci")
    assert fit.sd[place] < 0.01  # the prior's is 0.115
    draws = np.log(fitact.sample(fit, level="laplace", seed=0).parameters()["insulator_thickness"])
    u, s2 = log_sd(0.05), log_sd(0.05) ** 2 + log_sd(0.03) ** 2 + log_sd(0.1) ** 2
    variance = u**2 - u**4 / s2 + (u**2 / s2 * fit.sd[place]) ** 2
    assert np.std(draws) == pytest.approx(math.sqrt(variance), rel=0.03)
    mean = math.log(1e-6) - u**2 / s2 * (fit.theta[place] - math.log(EPSILON_0 * 3.9 * 1e-4 / 1e-6))
    assert np.mean(draws) == pytest.approx(mean, abs=0.04 * u)


def test_in_the_gap_law_the_area_counts(record: fitact.Record):
    """F = eps0 A V^2 / (2 d^2): d = eps0 A / Cgap gives the power -1 of the area; a stated d gives +1."""
    values = np.ones(6)
    at = Capacitances(1.35e-9, 22e-9, 440e-12)
    for gap, power in (({"capacitance": "440 pF"}, -1.0), ({"capacitance": "440 pF", "thickness": "2 um"}, 1.0)):
        scene = scene_with(gap=gap, force={"model": "gap"}, device={"contact_area": UNIFORM_AREA})
        geometry = UncertainGeometry.from_scene(scene)
        changed = geometry.change_derived(at, {"contact_area": math.log(2e-4)}, values)
        assert changed[2:5] == pytest.approx(2.0**power)
        assert geometry.notes(scene, fitact.fit(record, scene).likelihood, np.log([160e3, 22e-9, 1.35e-9])) == ()


def test_fits_of_many_records_have_the_same_error(record: fitact.Record, uncertain_fit: fitact.Fit):
    (row,) = fitact.fit_many([record], uncertain_fit.scene, progress=False)
    expected = relative_sd(uncertain_fit.derived()["force_mean"])
    assert row["force_mean_log_sd"] == pytest.approx(expected, rel=1e-6)


def test_a_population_varies_the_skin_by_its_distribution():
    skin = {"thickness": {"median": "200 um", "relative_sd": 0.2}}
    assert scene_with(skin=skin).thickness_sd() == {"skin_thickness": pytest.approx(log_sd(0.2))}
    assert scene_with(skin=skin, population={"skin_thickness_relative_sd": 0.0}).thickness_sd() == {}
    assert scene_with(population={"skin_thickness_relative_sd": 0.3}).thickness_sd() == {
        "skin_thickness": pytest.approx(log_sd(0.3))
    }


def test_a_skin_thickness_that_Csc_updates_moves_force_and_friction(record: fitact.Record):
    """The scene's layers give a Csc of half of what the record has, so the thickness is a third below its median.

    Laplace and emcee agree: sds within 2 % (10,000 draws: 0.7 %) and medians within 4 % of an sd (draws: 1.3 %).
    """
    skin = {"permittivity": {"median": 5000, "relative_sd": 0.2}, "thickness": {"median": "200 um", "relative_sd": 0.2}}
    device = LAYER | {"insulator_permittivity": 3.9}
    fit = fitact.fit(record, scene_with(device=device, skin=skin, friction={"normal_force": "1 mN"}))
    posterior = fitact.sample(fit, seed=0, progress=False)
    drawn = posterior.parameters()
    capacitance = EPSILON_0 * drawn["skin_permittivity"] * drawn["contact_area"] / drawn["skin_thickness"]
    assert np.allclose(capacitance, drawn["Csc"], rtol=1e-9)
    assert np.median(drawn["skin_thickness"]) < 160e-6
    for name, draws in posterior.derived().items():
        logs, expected = np.log(draws), fit.derived()[name]
        assert np.std(logs) == pytest.approx(relative_sd(expected), rel=0.02)
        assert np.median(logs) == pytest.approx(math.log(expected["q50"]), abs=0.04 * np.std(logs))


def test_an_area_is_printed_with_the_prefix_squared():
    assert format_engineering(1e-4, "m^2") == "100 mm^2"
    assert format_engineering(2.5, "m^2") == "2.5 m^2"
