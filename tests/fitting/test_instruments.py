"""Errors of instruments in fits: shared pieces, budgets, certificates and dummies; records are simulated with NumPy."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.stats

import fitact
from fitact.readers.read import write_csv
from fitact.result_text import budget_sentence, budget_text
from tests import session_calibration as session

PARTS = (150e3, 24e-9, 1.4e-9)  # Rsc, Csc, Ci
TRUE = {"g": 1.4e-9 / (2.8e-9 + 24e-9), "b": 150e3 * (2.8e-9 + 24e-9)}
NO_ERROR = {"gain": 0.0, "even": 0.0, "odd": 0.0, "compensation": 0.0}


def make(setup: str = "Vsc", seed: int = 0, parts: tuple[float, float, float] = PARTS, **changes: Any) -> fitact.Record:
    """Simulate a record without errors but those of `changes`: by piece, `load` and `skew` (s)."""
    pieces = [piece for channel in session.SETUPS[setup].values() for piece in channel]
    errors: dict[str, Any] = {piece: dict(NO_ERROR) for piece in pieces} | {"load": [10e6, 12e-12], "skew": 0.0}
    for name, change in changes.items():
        errors[name] = change if name in ("load", "skew") else errors[name] | change
    return session.make_record(setup, parts, errors, np.random.default_rng(seed), f"record {seed}")


def errors_of(fit: fitact.Fit, names: tuple[str, ...] = ("g", "b")) -> dict[str, float]:
    """Return the errors of the logarithms in units of the combined uncertainty."""
    derived = fit.derived()
    return {name: math.log(float(derived[name]["q50"]) / TRUE[name]) / float(derived[name]["u"]) for name in names}


def plain(setup: str = "Vsc", **sections: Any) -> fitact.Scene:
    stated = session.scene(setup).model_dump(mode="json", exclude_unset=True)
    return fitact.Scene.from_dict({k: v for k, v in stated.items() if k != "instrument"} | sections)


@pytest.fixture(scope="module")
def record() -> fitact.Record:
    return make(**{"scope-8bit:A/CH2": {"gain": 0.02}})


@pytest.fixture(scope="module")
def fit(record: fitact.Record) -> fitact.Fit:
    return fitact.fit(record, session.scene("Vsc"))


def test_components_add_up(fit: fitact.Fit):
    for name, budget in fit.budgets.items():
        assert sum(each.u**2 for each in budget.components) == pytest.approx(budget.u**2, rel=1e-9), name
    entry = fit.to_dict()["budget"]["g"]
    assert sum(row["share"] for row in entry["components"]) == pytest.approx(1.0)
    # two scopes of 3 % and two probes of 2 %, uniform, on a ratio of two channels
    assert entry["u"] == pytest.approx(math.sqrt(2.0 * (0.03**2 + 0.02**2) / 3.0), rel=0.02)


@pytest.mark.parametrize("name", ["gain", "gain_V", "nonlinearity_odd", "probe_resistance"])
def test_a_component_is_the_change_for_a_shifted_prior(fit: fitact.Fit, record: fitact.Record, name: str, monkeypatch):
    """Shift the center of one prior by its standard uncertainty, and fit again."""
    from fitact.fitting import fit as module

    build = module.build_problem

    def shifted(*args: Any) -> Any:
        problem = build(*args)
        prior = problem.likelihood.prior
        marginal = prior[name]
        moved = dataclasses.replace(marginal, mean=marginal.mean + marginal.sd, edges=marginal.edges + marginal.sd)
        likelihood = dataclasses.replace(problem.likelihood, prior=prior.replace_marginals(**{name: moved}))
        return problem._replace(likelihood=likelihood)

    monkeypatch.setattr(module, "build_problem", shifted)
    again = fitact.fit(record, session.scene("Vsc"))
    place = fit.names.index(name)
    sources = {each.source for each in fit.error_sources[place]}
    for quantity in ("g", "b", "force_mean"):
        rows = [each for each in fit.budgets[quantity].components if each.source in sources]
        component = math.hypot(*(each.u for each in rows))
        change = math.log(float(again.derived()[quantity]["q50"]) / float(fit.derived()[quantity]["q50"]))
        if component > 0.01 * fit.budgets[quantity].u:
            assert abs(change) == pytest.approx(component, rel=0.03)


def test_errors_lie_within_what_is_stated(fit: fitact.Fit):
    assert max(map(abs, errors_of(fit).values())) < 2.0


@pytest.mark.parametrize("change", [{"scope-8bit:A/CH2": {"gain": 0.02}}, {"load": [10e6, 12e-12]}])
def test_an_error_that_nobody_states_is_named(change: dict[str, Any]):
    silent = fitact.fit(make(**change), plain())
    assert max(map(abs, errors_of(silent).values())) > 10.0  # far beyond noise and prior
    content = silent.to_dict()
    assert "Not stated, so usual errors are included: V gain" in budget_sentence(content)
    assert "Vsc gain, not stated (usual: scope-8bit and probe-10x)" in budget_text(content, ["g"])
    assert not content["budget"]["g"]["stated"]
    added = math.hypot(*(each["u"] for each in content["budget"]["g"]["not_stated"]))
    assert added == pytest.approx(math.sqrt(2.0 * (0.03**2 + 0.02**2) / 3.0), rel=1e-3)
    # what one reads first includes usual errors, so that an error of this size is no surprise
    assert content["derived"]["g"]["combined"]["u"] == pytest.approx(
        math.hypot(added, content["derived"]["g"]["u"]), rel=1e-9
    )
    if "scope-8bit:A/CH2" in change:
        off = math.log(content["derived"]["g"]["q50"] / fitact.fit(make(), plain()).derived()["g"]["q50"])
        assert abs(off) < 2.0 * content["derived"]["g"]["combined"]["u"]


@pytest.mark.slow
def test_records_of_a_session_do_not_average_a_gain_away(fit: fitact.Fit):
    gained = {"scope-8bit:A/CH2": {"gain": 0.025}}
    records = [make(seed=seed, **gained) for seed in range(3)]
    joint = fitact.fit(records, session.scene("Vsc"))
    assert joint.derived()["g"]["u"] == pytest.approx(float(fit.derived()["g"]["u"]), rel=0.02)
    assert [name for name in joint.names if name.startswith("gain")] == ["gain", "gain_V"]


@pytest.mark.slow
def test_gain_relative_sd_is_one_error_of_the_session():
    scene = plain(measurement={"channels": ["Vsc"], "gain_relative_sd": 0.02})
    one, three = (fitact.fit([make(seed=seed) for seed in range(count)], scene) for count in (1, 3))
    assert three.names.count("gain") == 1
    assert three.derived()["g"]["u"] == pytest.approx(float(one.derived()["g"]["u"]), rel=0.02)


def test_the_ratio_of_two_fingers_holds_no_gain(fit: fitact.Fit):
    other = fitact.fit(make(seed=5, parts=(220e3, 18e-9, 1.4e-9)), session.scene("Vsc"))
    ratio = fit.budgets["g"].subtract(other.budgets["g"])
    gains = [each.u for each in ratio.components if " gain (" in each.source]
    assert max(gains) < 1e-4
    assert fit.budgets["g"].u > 0.02
    assert ratio.u < 0.4 * fit.budgets["g"].u  # what is left are the priors of two fingers


@pytest.mark.slow
def test_the_current_tells_the_ratio_of_gains(monkeypatch):
    monkeypatch.setitem(session.NOISE, "I", 1e-6)
    record = make("Vsc and I", **{"scope-8bit:A/CH2": {"gain": 0.025}, "scope-8bit:A/CH3": {"gain": -0.02}})
    fit = fitact.fit(record, session.scene("Vsc and I"))
    ratio = np.array([1.0 if n == "gain" else -1.0 if n == "gain_V" else 0.0 for n in fit.names])
    sd = np.linalg.norm(ratio @ fit.covariance_root)
    assert sd < 0.5 * math.sqrt(2.0 * (0.03**2 + 0.02**2) / 3.0)  # half of what the limits leave open
    assert ratio @ fit.theta == pytest.approx(math.log(1.025), abs=3.0 * sd)


def test_a_gain_beyond_its_limits_is_warned_of_where_the_data_show_it(monkeypatch):
    monkeypatch.setitem(session.NOISE, "I", 1e-6)
    wrong = {"scope-8bit:A/CH2": {"gain": 0.15}}  # three times the limits of scope and probe
    fit = fitact.fit(make("Vsc and I", **wrong), session.scene("Vsc and I"))
    assert any("the data put gain at" in warning for warning in fit.warnings)
    alone = fitact.fit(make(**wrong), session.scene("Vsc"))
    assert not any("the data put gain" in warning for warning in alone.warnings)


def test_gains_that_are_impossible_together_are_no_result(monkeypatch):
    """A factor of 1.5, as of a wrong scale, is beyond the limits of all pieces: no draw is possible."""
    monkeypatch.setitem(session.NOISE, "I", 1e-6)
    fit = fitact.fit(make("Vsc and I", **{"scope-8bit:A/CH2": {"gain": 0.5}}), session.scene("Vsc and I"))
    assert fit.result == "on_bound"
    with pytest.raises(fitact.InputError, match=r"limits of \[instrument\]"):
        fitact.sample(fit, progress=False)


def test_limits_keep_their_shape_in_the_quantiles(fit: fitact.Fit):
    """g is known up to the product of four uniform factors; noise is small."""
    rng = np.random.default_rng(1)
    scopes, probes = (1.0 + a * rng.uniform(-1.0, 1.0, (2, 400_000)) for a in (0.03, 0.02))
    ratio = scopes[0] * probes[0] / (scopes[1] * probes[1])
    levels = {"q025": 0.025, "q05": 0.05, "q25": 0.25, "q75": 0.75, "q95": 0.95, "q975": 0.975}
    expected = np.quantile(ratio / np.median(ratio), list(levels.values()))
    summary = fit.derived()["g"]
    found = [float(summary[key]) / float(summary["q50"]) for key in levels]
    # the priors of Rsc and Csc narrow g by 2 %
    assert np.log(found) == pytest.approx(np.log(expected), rel=0.03)


def test_the_posterior_has_the_limits(fit: fitact.Fit):
    posterior = fitact.sample(fit, seed=1, progress=False)
    drawn = posterior.parameters()
    assert np.ptp(np.log(drawn["gain"])) < math.log(1.03 * 1.02 / (0.97 * 0.98)) + 1e-9
    laplace, draws = fit.derived()["g"], posterior.summary()["derived"]["g"]
    for key in ("q05", "q25", "q75", "q95"):
        assert draws[key] / draws["q50"] == pytest.approx(float(laplace[key]) / float(laplace["q50"]), abs=1.5e-3)
    budget = posterior.summary()["budget"]["g"]
    assert math.hypot(*(row["u"] for row in budget["components"])) == pytest.approx(budget["u"], rel=1e-9)


@pytest.mark.parametrize("setup", ["Vsc", pytest.param("Vsc and I", marks=pytest.mark.slow)])
def test_compression_keeps_the_effects(setup: str):
    wrong = {"probe-10x:P2": {"compensation": 0.015}, "scope-8bit:A/CH2": {"odd": 0.0015, "even": -0.001}}
    record, scene = make(setup, **wrong), session.scene(setup)
    compressed, full = fitact.fit(record, scene), fitact.fit(record, scene, tolerance=0.0)
    assert compressed.compression_error is not None
    # rows of charge, whose signal is up to a million times the noise of V, may have a hundredfold error (`certify`)
    allowed, sd_error = (1e-3, 1e-3) if setup == "Vsc" else (0.1, 5e-3)
    assert compressed.compression_error < allowed
    assert (compressed.theta - full.theta) / full.sd == pytest.approx(np.zeros(full.theta.size), abs=0.02)
    assert compressed.sd == pytest.approx(full.sd, rel=sd_error)
    assert abs(compressed.theta[compressed.names.index("compensation")] - math.log(1.015)) < 4.0 * float(
        compressed.sd[compressed.names.index("compensation")]
    )
    assert compressed.result == "successful"


@pytest.mark.parametrize("setup", ["Vsc", "Vsc and I"])
@pytest.mark.parametrize("shape", ["even", "odd"])
def test_nonlinearity_of_V_is_an_error_of_all_channels(setup: str, shape: str):
    """The true size lies within four standard errors, as g and b do; without a word of it they do not."""
    record = make(setup, **{"scope-8bit:A/CH1": {shape: 0.0018}})
    fit = fitact.fit(record, session.scene(setup))
    place = fit.names.index(f"nonlinearity_V_{shape}")
    assert abs(fit.theta[place] - math.log(1.0018)) < 4.0 * fit.sd[place]
    assert max(map(abs, errors_of(fit).values())) < 2.0
    assert any(each.source == f"V nonlinearity, {shape} (scope-8bit:A/CH1)" for each in fit.budgets["b"].components)


@pytest.mark.slow
def test_a_certificate_of_nonlinearity_keeps_its_distribution():
    own = {"scope-8bit:A/CH2": {"nonlinearity": {"expanded": "0.2 %", "k": 2}}}
    scene = plain(instrument=INSTRUMENT | {"own": own}, measurement={"channels": ["Vsc"]})
    prior = fitact.fit(make(), scene).likelihood.prior
    assert isinstance(prior["nonlinearity_odd"], fitact.LogNormal)
    assert float(prior["nonlinearity_odd"].spread) == pytest.approx(0.0005)  # half for each shape
    assert float(prior["nonlinearity_V_odd"].log_sd) == pytest.approx(0.5 / 256.0 / math.sqrt(3.0), rel=1e-3)


@pytest.mark.slow
def test_a_scanning_converter_delays_channels():
    """Up to a sampling interval of 5 us, of which 3 us move b by 0.7 %."""
    fit = fitact.fit(make("DAQ", skew=3e-6), session.scene("DAQ"))
    delay = fit.parameters()["delay"]
    assert delay["q50"] == pytest.approx(3e-6, abs=4.0 * float(delay["sd"]))
    assert abs(errors_of(fit)["b"]) < 3.0
    assert fit.compression_error is not None
    stated = session.scene("DAQ").model_dump(mode="json", exclude_unset=True)
    stated["instrument"]["own"] = {f"daq-16bit:D/{i}": {"skew": "0 s"} for i in (0, 1)}
    assert "delay" not in fitact.fit(make("DAQ"), fitact.Scene.from_dict(stated)).names


def test_an_offset_within_the_limits_is_free(fit: fitact.Fit):
    assert "offset" in fit.linear
    assert "offset" not in fitact.fit(make(), plain()).linear


@pytest.mark.slow
@pytest.mark.parametrize("noise", ["ar1", "student"])
def test_effects_under_other_noise(noise: str):
    scene = session.scene("Vsc").model_dump(mode="json", exclude_unset=True)
    scene["measurement"] |= {"noise_model": noise}
    record = make(**{"probe-10x:P2": {"compensation": 0.015}})
    fit = fitact.fit(record, fitact.Scene.from_dict(scene))
    place = fit.names.index("compensation")
    assert (fit.compression_error is not None) == (noise == "ar1")  # the expansion of Student's t is not exact enough
    assert abs(fit.theta[place] - math.log(1.015)) < 4.0 * fit.sd[place]


def dummy_scene(folder: Path, wrong: float = 1.0, gain: float = 0.025) -> fitact.Scene:
    """Write the record of a dummy whose Csc is `wrong` times the stated value; return the scene that names it."""
    dummy = make(seed=9, parts=(160e3, wrong * 22e-9, 1.35e-9), **{"scope-8bit:A/CH2": {"gain": gain}})
    write_csv(folder / "dummy.csv", dummy)
    parts = {
        "Rsc": {"nominal": "160 kohm", "tolerance": "0.1 %"},
        "Csc": {"median": "22 nF", "relative_sd": 0.002},
        "Ci": {"median": "1.35 nF", "relative_sd": 0.002},
    }
    stated = session.scene("Vsc").model_dump(mode="json", exclude_unset=True)
    return fitact.Scene.from_dict(stated | {"calibration": [{"record": str(folder / "dummy.csv"), "circuit": parts}]})


@pytest.mark.slow
def test_a_dummy_calibrates_the_gain(tmp_path: Path):
    fit = fitact.fit(make(**{"scope-8bit:A/CH2": {"gain": 0.025}}), dummy_scene(tmp_path))
    assert float(fit.derived()["g"]["u"]) < 0.003
    assert max(map(abs, errors_of(fit).values())) < 3.0
    assert not any("dummy" in warning for warning in fit.warnings)
    assert math.hypot(*(each.u for each in fit.budgets["g"].components)) == pytest.approx(fit.budgets["g"].u, rel=1e-9)
    # as if both were one joint fit: the dummy tells the gain to the accuracy of its own divider
    divider = math.hypot(0.9 * 0.002, 0.9 * 0.002)  # of Ci / (2 Ci + Csc), by its two parts
    assert float(fit.derived()["g"]["u"]) == pytest.approx(divider, rel=0.2)


def test_a_dummy_of_wrong_value_is_named(tmp_path: Path):
    fit = fitact.fit(make(), dummy_scene(tmp_path, wrong=1.02, gain=0.0))
    assert any("the record puts Csc of the dummy at" in warning for warning in fit.warnings)


def test_a_scene_with_a_dummy_reads_back(tmp_path: Path):
    scene = dummy_scene(tmp_path)
    (tmp_path / "scene.toml").write_text(str(scene))
    assert fitact.Scene.load(tmp_path / "scene.toml") == scene
    assert fitact.Scene.from_json(scene.to_json()) == scene


INSTRUMENT = {"V": ["scope-8bit:A/CH1"], "Vsc": ["scope-8bit:A/CH2"]}


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ({"instrument": {"V": ["scope-8bit:A"], "Vsc": ["probe-10x:A"]}}, "piece 'A' is named with two classes"),
        ({"instrument": {"V": ["scope:A"]}}, "did you mean 'scope-8bit'"),
        ({"instrument": {"V": ["scope-8bit"]}}, "is not 'class:piece'"),
        ({"instrument": INSTRUMENT | {"own": {"scope-8bit:A/CH1": {"gain": {"expanded": "1 %"}}}}}, "{expanded, k}"),
        ({"instrument": INSTRUMENT | {"own": {"scope-8bit:A/CH1": {"gain": {"tolerance": "-1 %"}}}}}, "greater than 0"),
        ({"instrument": INSTRUMENT | {"own": {"scope-8bit:B": {"gain": {"tolerance": "1 %"}}}}}, "is no piece"),
        ({"instrument": INSTRUMENT, "measurement": {"probe_resistance": "10 Mohm"}}, "state it under [instrument.own]"),
        ({"instrument": INSTRUMENT, "calibration": [{"record": "dummy.csv"}]}, "needs a record and its circuit"),
        ({"instrument": INSTRUMENT, "calibration": [{"record": "d.csv", "circuit": {"Rsc": {"fixed": 1.0}}}]}, "lacks"),
    ],
)
def test_bad_input_is_one_sentence(content: dict[str, Any], sentence: str):
    with pytest.raises(fitact.InputError) as refused:
        fitact.Scene.from_dict(content)
    assert sentence in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_calibration_needs_instruments(tmp_path: Path, record: fitact.Record):
    stated = dummy_scene(tmp_path).model_dump(mode="json", exclude_unset=True)
    del stated["instrument"]
    with pytest.raises(fitact.InputError, match=r"state these too"):
        fitact.fit(record, fitact.Scene.from_dict(stated))


@pytest.mark.slow
def test_a_common_gain_of_an_oscilloscope_cancels_in_the_ratio():
    own = {f"scope-8bit:A/CH{i}": {"gain": {"tolerance": "0.1 %"}} for i in (1, 2)}
    own["scope-8bit:A"] = {"gain_common": {"tolerance": "3 %"}}
    fit = fitact.fit(make(), plain(instrument=INSTRUMENT | {"own": own}, measurement={"channels": ["Vsc"]}))
    common = [each for each in fit.budgets["g"].components if each.source.endswith("gain (scope-8bit:A)")]
    force = [each for each in fit.budgets["force_mean"].components if each.source.endswith("gain (scope-8bit:A)")]
    assert common[0].u < 1e-6
    assert force[0].u == pytest.approx(2.0 * 0.03 / math.sqrt(3.0), rel=0.01)  # the force goes as the square of V


# 240 fits of simulated sessions; the other set-ups have the same code with more coordinates
@pytest.mark.slow
@pytest.mark.parametrize("setup", session.SETUPS)
def test_intervals_contain_the_truth(setup: str):
    """The seeds were not chosen: the first 80 of the run that `make session-calibration` makes."""
    rows = [session.evaluate(setup, 1_000_000 + number, 1) for number in range(80)]
    assert session.passes(session.judge(rows))


def test_a_wrong_interval_would_be_noticed():
    """Independent gains of five records are taken for averaged: the coverage of g then falls to 62 % or less."""
    rng = np.random.default_rng(0)
    below = scipy.stats.norm.cdf(rng.standard_normal(200) * math.sqrt(5.0))
    names = dict.fromkeys(session.QUANTITIES, 0.0)
    rows = [{"setup": "Vsc", "records": 5, "control": True, "below": names | {"g": float(x)}} for x in below]
    table = [row for row in session.judge(rows) if row["quantity"] == "g"]
    assert next(row for row in table if row["level"] == 0.95)["coverage"] < 0.7
    assert not session.passes(table)
