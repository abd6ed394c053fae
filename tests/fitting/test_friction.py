"""Friction as a channel: fits of records that data_synth simulates on its own, and what the tables say of the law."""

import math
from pathlib import Path

import numpy as np
import pytest

import fitact
from data_synth import make, recipe
from fitact import Fit, Record, Scene
from fitact.data.simulate import simulate as simulate_scene
from fitact.design.measurement import experiment_from_scene
from fitact.errors import InputError
from fitact.fitting.sensation import FeltDrive
from fitact.result_text import estimate_table

SCENE = """
[measurement]
channels = {channels}
sampling_rate = "20 kHz"
duration = "{duration}"
noise_Ft = "{noise}"
[drive]
waveform = "trapezoid"
rise_time = "0.5 ms"
peak_to_peak = "360 V"
frequency = "100 Hz"
[friction]
coefficient = 0.6
normal_force = "0.5 N"
sensor_frequency = "500 Hz"
sensor_damping = 0.05
[prior]
sensor_frequency = {{relative_sd = 0.1}}
sensor_damping = {{factor = 2}}
"""
MEASURED = '[drive]\nwaveform = "measured"\npeak_to_peak = "360 V"\nfrequency = "100 Hz"\n'
GAP = '[gap]\nthickness = "2 um"\n[force]\nmodel = "{law}"\n'


def simulate(folder: Path, added: str = "", seed: int = 1, law: str = "", **form: str) -> tuple[Record, str]:
    """Return a record by data_synth, and its scene with the drive stated."""
    text = SCENE.format(**{"channels": '["Vsc", "Ft"]', "duration": "100 ms", "noise": "0.02 mN"} | form)
    (folder / "scene.toml").write_text(text + law)
    (folder / "record.recipe.toml").write_text(f'scene = "scene.toml"\nseed = {seed}\n{added}')
    made = make.make(recipe.load(folder / "record.recipe.toml"))["record"]
    return Record.from_arrays(made.time, **made.channels), text


def load(folder: Path, text: str) -> Scene:
    (folder / "used.toml").write_text(text)
    return Scene.load(folder / "used.toml")


def pulls(fit: Fit, **truth: float) -> dict[str, float]:
    """Return the distances of parameters from the truth, in standard errors."""
    sd = np.linalg.norm(fit.laplace.covariance_root, axis=1)
    places = {name: fit.names.index(name) for name in truth}
    return {name: float((fit.theta[i] - math.log(truth[name])) / sd[i]) for name, i in places.items()}


def replace_drive(text: str) -> str:
    before, after = text.split("[drive]")
    return before + MEASURED + "[friction]" + after.split("[friction]")[1]


@pytest.mark.parametrize("is_measured", [pytest.param(False, marks=pytest.mark.slow), True])
def test_scale_and_sensor_are_recovered(tmp_path: Path, is_measured: bool) -> None:
    """Any seed serves: a pull beyond 4 has a probability below 1e-4."""
    record, text = simulate(tmp_path, "[friction]\nforce_scale = 3.0\n")
    fit = fitact.fit(record, load(tmp_path, replace_drive(text) if is_measured else text))
    assert fit.result == "successful"
    found = pulls(fit, mu=0.6, force_scale=3.0, sensor_frequency=500.0, sensor_damping=0.05)
    assert max(map(abs, found.values())) < 4.0
    sd = dict(zip(fit.names, np.linalg.norm(fit.laplace.covariance_root, axis=1), strict=True))
    assert sd["mu"] < 1e-4
    assert sd["force_scale"] == pytest.approx(0.05, rel=0.05)  # that of Ci, which Vsc does not determine


@pytest.mark.slow
def test_friction_determines_what_the_electrical_channels_do_not(tmp_path: Path) -> None:
    """If the law is known, the size of the force determines the contact area and thus Ci."""
    record, text = simulate(tmp_path)
    fit = fitact.fit(record, load(tmp_path, text + "force_scale = {fixed = true}\nmu = {fixed = true}\n"))
    sd = dict(zip(fit.names, np.linalg.norm(fit.laplace.covariance_root, axis=1), strict=True))
    assert sd["Ci"] < 0.005
    assert abs(pulls(fit, Ci=1.35e-9)["Ci"]) < 4.0
    assert fit.identifiability.verdict == "identified"


def test_tables_say_whether_the_law_holds(tmp_path: Path) -> None:
    record, text = simulate(tmp_path, "[friction]\nforce_scale = 3.0\n")
    fit = fitact.fit(record, load(tmp_path, text))
    summary, content = " ".join(fit.summary(verbose=True).split()), fit.to_dict()
    assert "they differ, so the law, the contact area, a thickness or the normal force is wrong" in summary
    assert "do not test that law" not in summary
    assert content["force_basis"]["tested_by_data"]
    assert ("mu", "about 0.6", "", "unstated sensor", "coefficient of friction mu") in estimate_table(content)
    # the thickness of the skin, which nobody stated, is as uncertain for the scale as for the force
    u = {
        name: content["parameters" if name == "force_scale" else "derived"][name]["u"]
        for name in ("force_scale", "force_mean")
    }
    assert u["force_scale"] == pytest.approx(u["force_mean"], rel=0.02)
    agreeing = fitact.fit(simulate(tmp_path)[0], load(tmp_path, text))
    assert "they agree" in " ".join(agreeing.summary(verbose=True).split())
    assert agreeing.to_dict()["derived"]["friction_mean"]["q50"] == pytest.approx(0.6 * (0.5 + 271e-6), rel=1e-3)


def test_friction_that_does_not_fit_makes_the_fit_unreliable(tmp_path: Path) -> None:
    record, text = simulate(tmp_path)
    turned = Record.from_arrays(record.time, Vsc=record["Vsc"], Ft=-record["Ft"])
    fit = fitact.fit(turned, load(tmp_path, text))
    assert fit.result == "misfit"
    assert any("the common model fits Ft poorly" in each and "check the sign" in each for each in fit.warnings)
    assert "they agree" not in " ".join(fit.summary().split())


def test_what_is_felt_follows_from_the_measured_friction(tmp_path: Path) -> None:
    """The friction of data_synth is 0.6 times 3 times the force of eq. (22), of which the scene states neither."""
    record, text = simulate(tmp_path, "[friction]\nforce_scale = 3.0\n")
    table = '[perception]\nthresholds = {frequencies = ["150 Hz", "450 Hz"], forces = ["1 mN", "1 mN"]}\n'
    scene = load(tmp_path, text.replace("coefficient = 0.6", "coefficient = 0.5") + table)
    fit = fitact.fit(record, scene)
    felt = FeltDrive.from_draws(fit.derive, fit.likelihood, scene, 100.0, fit.point[None, None], 0)
    time = np.arange(10_000) / 10_000 / 100.0
    voltage = np.asarray(fitact.response(fitact.FinalCircuit(160e3, 22e-9, 1.35e-9), scene.drive.make(), time))
    force = voltage**2 / (2.0 * (1.0 / 1.35e-9 + 1.0 / 22e-9) * 201e-6)
    harmonics = [2.0 * abs(np.mean(force * np.exp(-2j * np.pi * n * 100.0 * time))) for n in (2, 4)]
    assert felt.times_threshold.item() == pytest.approx(0.6 * 3.0 * math.hypot(*harmonics) / 1e-3, rel=0.01)


@pytest.mark.slow
def test_crosstalk_of_the_drive_is_freed(tmp_path: Path) -> None:
    record, text = simulate(tmp_path, "[friction]\ncrosstalk = 2e-6\n")
    fit = fitact.fit(record, load(tmp_path, text))
    assert fit.result == "successful"
    assert fit.linear["crosstalk_Ft"] == pytest.approx(2e-6 * 180.0, rel=0.05)
    assert max(map(abs, pulls(fit, mu=0.6, force_scale=1.0).values())) < 4.0


@pytest.mark.slow
def test_current_beside_the_friction_leaves_the_scale_to_the_noise(tmp_path: Path) -> None:
    """The contact area follows from I, so that the scale no longer rests on the prior of Ci."""
    form = {"channels": '["Vsc", "I", "Ft"]'}
    record, text = simulate(tmp_path, "[friction]\nforce_scale = 3.0\n", **form)
    fit = fitact.fit(record, load(tmp_path, text))
    assert fit.result == "successful"
    assert fit.identifiability.verdict == "identified"
    sd = dict(zip(fit.names, np.linalg.norm(fit.laplace.covariance_root, axis=1), strict=True))
    assert sd["force_scale"] < 0.02
    assert max(map(abs, pulls(fit, mu=0.6, force_scale=3.0, Ci=1.35e-9, Rsc=160e3, Csc=22e-9).values())) < 4.0


@pytest.mark.slow  # two models, each fitted again without a tenth of the record, ten times
@pytest.mark.parametrize(("noise", "preferred"), [("1 mN", "gap"), ("30 N", None)])
def test_laws_are_told_apart_only_where_they_differ_by_more_than_the_noise(
    tmp_path: Path, noise: str, preferred: str | None
) -> None:
    record, text = simulate(tmp_path, law=GAP.format(law="gap"), noise=noise)
    laws = {law: load(tmp_path, text + GAP.format(law=law)) for law in ("gap", "paper")}
    found = fitact.compare(record, laws)
    assert found.preferred == preferred
    (right,) = (model.fit for model in found.models if model.name == "gap")
    assert right.result == "successful"
    assert abs(pulls(right, force_scale=1.0)["force_scale"]) < 4.0
    assert ("cannot be distinguished" in found.verdict) == (preferred is None)
    assert "only the shape of the force in time tells the force laws apart" in found.verdict


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (('normal_force = "0.5 N"\n', ""), "channel Ft needs the normal force"),
        (("coefficient = 0.6", "coefficient = {median = 0.6, relative_sd = 0.1}"), r"\[prior\] mu"),
        (('sensor_frequency = "500 Hz"\n', ""), "sensor_damping belongs to sensor_frequency"),
        (('channels = ["Vsc", "Ft"]', 'channels = ["Vsc"]'), r"\[prior\] sensor_frequency needs 'Ft'"),
    ],
)
def test_incomplete_scenes_are_refused(tmp_path: Path, change: tuple[str, str], sentence: str) -> None:
    text = SCENE.format(channels='["Vsc", "Ft"]', duration="100 ms", noise="0.02 mN")
    assert change[0] in text
    with pytest.raises(InputError, match=sentence):
        load(tmp_path, text.replace(*change))


def test_records_that_cannot_serve_are_refused(tmp_path: Path) -> None:
    record, text = simulate(tmp_path)
    kept = np.flatnonzero(np.arange(len(record)) % 7 != 3)
    uneven = Record.from_arrays(record.time[kept], **{name: record[name][kept] for name in record.channels})
    with pytest.raises(InputError, match="Ft needs uniform time steps"):
        fitact.fit(uneven, load(tmp_path, text))
    short = Record.from_arrays(record.time[:800], **{name: record[name][:800] for name in record.channels})
    with pytest.raises(InputError, match="unknown charge of the skin has decayed"):
        fitact.fit(short, load(tmp_path, replace_drive(text)))


def test_what_does_not_use_the_friction_refuses_it(tmp_path: Path) -> None:
    record, text = simulate(tmp_path)
    scene = load(tmp_path, text)
    with pytest.raises(InputError, match="a design does not count the friction"):
        experiment_from_scene(scene)
    with pytest.raises(InputError, match="a track does not use the friction"):
        fitact.track(record, load(tmp_path, replace_drive(text)), window=0.02)


@pytest.mark.slow  # a fit for each of 40 records
def test_errors_of_mu_and_scale_are_those_stated(tmp_path: Path) -> None:
    """Sums of squared pulls over 40 records stay within the 99.99 % range of chi-squared, for any seeds."""
    found = []
    for seed in range(40):
        record, text = simulate(tmp_path, seed=seed)
        scene = load(tmp_path, text + "Ci = {fixed = true}\n")  # otherwise its prior hides the noise
        found.append([*pulls(fitact.fit(record, scene), mu=0.6, force_scale=1.0, sensor_frequency=500.0).values()])
    squares = np.sum(np.square(found), axis=0)
    assert np.all((squares > 14.0) & (squares < 86.0))


def test_a_scene_with_the_channel_simulates_it(tmp_path: Path) -> None:
    """The simulation of fitact agrees with that of data_synth, apart from noise of 20 µN."""
    record, text = simulate(tmp_path, duration="40 ms")
    ours = simulate_scene(load(tmp_path, text.replace('duration = "100 ms"', 'duration = "40 ms"')))
    difference = ours["Ft"] - record["Ft"]
    assert np.sqrt(np.mean(difference**2)) == pytest.approx(math.sqrt(2.0) * 2e-5, rel=0.1)
