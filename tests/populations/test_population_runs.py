"""Runs of populations as labs make them: interrupted and resumed, long records, areas that vary, covariates."""

import json
import math
import subprocess
import sys
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import fitact
from fitact.populations import fit_population
from fitact.populations.contact_area import ContactAreaTest
from fitact.populations.finger import Finger
from fitact.sampling.importance import AdaptedDraws, draw_adaptively
from tests.calibration import AMPLITUDE, PER_PERIOD, wave
from tests.population_calibration import FREQUENCY, NOISE, simulate, vsc

SEED = 3
STUDY = Path(__file__).parents[2] / "data_synth" / "records" / "study"


@pytest.fixture(scope="module")
def few() -> Any:
    return simulate(SEED, 0, fingers=6)


def fail_weights(*arguments: Any, **options: Any) -> AdaptedDraws:
    """Draw as a population does, with weights that are not to be relied on."""
    found = draw_adaptively(*arguments, **options)
    return found._replace(weighted=found.weighted._replace(k_hat=math.inf))


@pytest.mark.slow
def test_emcee_goes_on_where_weighted_draws_fail(few, monkeypatch):
    """Means and standard deviations agree within four standard errors."""
    weighted = fitact.population(few.records, few.scene, seed=1, progress=False)
    assert weighted.convergence.level == "psis"
    monkeypatch.setattr(fit_population, "draw_adaptively", fail_weights)
    chain = fitact.population(few.records, few.scene, seed=1, progress=False)
    assert chain.convergence.level == "emcee"
    assert chain.trusted
    effective = 1.0 / (1.0 / weighted.convergence.ess_min + 1.0 / chain.convergence.ess_min)
    for name, values in weighted.parameters().items():
        mean, sd = np.mean(values), np.std(values)
        assert np.mean(chain.parameters()[name]) == pytest.approx(mean, abs=4.0 * sd / np.sqrt(effective)), name
        assert np.std(chain.parameters()[name]) == pytest.approx(sd, rel=0.1), name


@pytest.mark.slow
def test_a_population_goes_on_where_it_stopped(few, tmp_path, monkeypatch):
    """To the draws of an undisturbed run; a chain of another seed is refused."""
    monkeypatch.setattr(fit_population, "draw_adaptively", fail_weights)
    undisturbed = fitact.population(few.records, few.scene, seed=1, progress=False)
    stopped = fitact.population(few.records, few.scene, seed=1, folder=tmp_path, max_steps=30, progress=False)
    assert not stopped.trusted
    again = fitact.population(few.records, few.scene, seed=1, folder=tmp_path, progress=False)
    assert again.trusted
    np.testing.assert_array_equal(again.points, undisturbed.points)
    with pytest.raises(fitact.InputError, match="belongs to another"):
        fitact.population(few.records, few.scene, seed=2, folder=tmp_path, progress=False)


class Counted(Sequence[fitact.Record]):
    """Records made when they are asked for, `times` their samples; how many of them are held at once."""

    def __init__(self, records: Sequence[fitact.Record], times: int) -> None:
        self._records, self._times = records, times
        self._made: list[weakref.ref[fitact.Record]] = []
        self.most = 0

    def __len__(self) -> int:
        return len(self._records)

    def __getitem__(self, index: Any) -> Any:
        short = self._records[index]
        channels = {name: np.tile(short[name], self._times) for name in short.channels}
        rng = np.random.default_rng(index)
        channels["Vsc"] = channels["Vsc"] + 0.3 * rng.standard_normal(channels["Vsc"].size)
        time = np.arange(channels["V"].size) * (short.time[1] - short.time[0])
        record = fitact.Record.from_arrays(time, **channels, source=short.source)
        self._made.append(weakref.ref(record))
        self.most = max(self.most, sum(each() is not None for each in self._made))
        return record


@pytest.mark.slow
def test_records_are_not_held(few):
    """Two at most, the one at hand and the one before; and none of what is left has as many numbers as a record."""
    records = Counted(simulate(SEED, 0, fingers=6, noise=0.0).records, 10)
    found = fitact.population(records, few.scene, seed=1, progress=False)
    assert records.most <= 2
    sizes = [array.size for finger in found.fingers for array in arrays_of(finger.likelihood)]
    assert max(sizes) < 1000 < len(records[0])


def arrays_of(tree: Any) -> list[np.ndarray]:
    import jax

    return [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]


@pytest.mark.slow
def test_slopes_of_a_covariate_and_fingers_at_one_are_covered():
    """Log Rsc falls by 0.15 and log Csc rises by 0.05 with each unit of moisture; and stays easy to sample."""
    rng = np.random.default_rng(11)
    moisture, slopes, spread = rng.uniform(2.0, 8.0, 30), np.array([-0.15, 0.05]), np.array([0.15, 0.2])
    skins = np.log([130e3, 20e-9]) + (moisture - 5.0)[:, None] * slopes + spread * rng.standard_normal((30, 2))
    scene = simulate(SEED, 0, fingers=2).scene
    records = [record(np.exp(skin), 1.35e-9, i, rng) for i, skin in enumerate(skins)]
    found = fitact.population(
        records, scene, covariates={"moisture": moisture}, at={"moisture": 8.0}, seed=1, progress=False
    )
    assert found.trusted
    draws, new = found.parameters(), found.new_fingers()
    for name, slope, sd in zip(("Rsc", "Csc"), slopes, spread, strict=True):
        low, high = np.quantile(draws[f"slope_{name}_moisture"], [0.005, 0.995])
        assert low < slope < high
        assert high - low < 0.15
        low, high = np.quantile(draws[f"log_sd_{name}"], [0.005, 0.995])
        assert low < sd < high  # what moisture makes is not in it
    expected = np.log(130e3) - 0.45
    assert np.mean(np.log(new["Rsc"])) == pytest.approx(expected, abs=0.25)  # 0.45 less than at the mean


@pytest.mark.slow
@pytest.mark.parametrize("channels", [("I",), ("Vsc", "I")])
def test_areas_are_seen_by_the_current(channels: tuple[str, ...]):
    """Ten fingers whose areas differ by a factor of two and more: their spread and Ci, each within its 99 %."""
    rng = np.random.default_rng(12)
    spread, area_sd, Ci = np.array([0.15, 0.25]), 0.7, 1.35e-9
    areas = np.exp(area_sd * rng.standard_normal(10))
    skins = np.exp(np.log([130e3, 20e-9]) + spread * rng.standard_normal((10, 2)))
    records = [
        record(skin * [1.0 / area, area], area * Ci, i, rng, current=True)
        for i, (skin, area) in enumerate(zip(skins, areas, strict=True))
    ]
    few = simulate(SEED, 0, fingers=2)
    scene = few.scene.model_dump(exclude_unset=True) | {
        "measurement": {"channels": channels},
        "population": {"contact_area": "varies"},
    }
    found = fitact.population(records, fitact.Scene.from_dict(scene), seed=1, progress=False)
    assert found.trusted
    draws = found.parameters()
    known = {"log_sd_area": area_sd, "log_sd_Rsc": spread[0], "log_sd_Csc": spread[1], "Ci": Ci}
    for name, value in known.items():
        low, high = np.quantile(draws[name], [0.005, 0.995])
        assert low < value < high, name
    low, high = np.quantile(draws["log_sd_area"], [0.025, 0.975])
    assert high / low < 3.5  # ten fingers of known area: chi-square's 95 % are a factor of 2.7 apart


@pytest.mark.slow
@pytest.mark.parametrize("area_sd", [0.0, 0.3])
@pytest.mark.parametrize("channels", [("Vsc",), ("Vsc", "I")])
def test_records_disagree_with_one_area_where_areas_differ(channels: tuple[str, ...], area_sd: float):
    """Five simulated fingers fitted with `contact_area = "common"`: the current shows it, and Vsc alone cannot."""
    rng = np.random.default_rng(13)
    areas = np.exp(area_sd * rng.standard_normal(5))
    records = [
        record(np.array([130e3 / area, 20e-9 * area]), 1.35e-9 * area, i, rng, current=True)
        for i, area in enumerate(areas)
    ]
    sections = simulate(SEED, 0, fingers=2).scene.model_dump(exclude_unset=True) | {
        "measurement": {"channels": channels}
    }
    scene = fitact.Scene.from_dict(sections)
    with jax.enable_x64(True):
        fingers = [Finger.from_fit(fitact.fit(each, scene)) for each in records]
    found = ContactAreaTest.from_fingers(fingers, scene.make_prior()["Ci"], "common", 0.01)
    assert found.is_tested == ("I" in channels)
    assert found.disagrees == ("I" in channels and area_sd > 0.0)
    if found.disagrees:
        assert found.log_sd == pytest.approx(np.std(np.log(areas), ddof=1), rel=0.05)


def record(skin: np.ndarray, Ci: float, number: int, rng: np.random.Generator, current: bool = False) -> fitact.Record:
    """Two settled periods of a triangle; I = Vsc / Rsc + Csc dVsc/dt, with b Vsc' = a V' - Vsc."""
    settled = vsc(*skin, Ci, rng)
    channels = {"Vsc": np.tile(settled, 2) + NOISE * rng.standard_normal(2 * PER_PERIOD)}
    if current:
        (Rsc, Csc), phase = skin, np.arange(PER_PERIOD) / PER_PERIOD
        slope = 4.0 * AMPLITUDE * FREQUENCY * np.where((phase < 0.25) | (phase >= 0.75), 1.0, -1.0)
        flow = settled / Rsc + Csc * (Rsc * Ci * slope - settled) / (Rsc * (2.0 * Ci + Csc))
        channels["I"] = np.tile(flow, 2) + 1e-6 * rng.standard_normal(2 * PER_PERIOD)
    return fitact.Record.from_arrays(
        np.arange(2 * PER_PERIOD) / (PER_PERIOD * FREQUENCY),
        V=np.tile(wave("triangle", rng), 2),
        **channels,
        source=f"finger {number}",
    )


@pytest.fixture(scope="module")
def study_folder(tmp_path_factory) -> Path:
    """The output of the command for the shipped study: 6 people of 3 touches, with noise, rounding and skew."""
    folder = tmp_path_factory.mktemp("study") / "people"
    command = [sys.executable, "-c", "from fitact.cli import main; main()", "population"]
    command += ["--table", str(STUDY / "study.csv"), "--scene", str(STUDY.with_suffix(".toml")), "--seed", "1"]
    done = subprocess.run([*command, "--out", str(folder)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "between people, Rsc, log_sd" in done.stdout
    assert "touch of a new person, force_mean" in done.stdout
    return folder


@pytest.mark.slow
def test_a_study_tells_people_and_touches_apart(study_folder):
    """Each level's spread, and each person's next touch: the true values within 99 %."""
    found = json.loads((study_folder / "population.json").read_text())
    truth = json.loads((STUDY / "truth.json").read_text())
    values = np.log([[each[name] for name in ("Rsc", "Csc", "Ci")] for each in truth])
    by_person = values.reshape(6, 3, 3)
    assert [(level["level"], level["units"]) for level in found["levels"]] == [("person", 6), ("repetition", 18)]
    people, touches = found["levels"]
    within = by_person.var(axis=1, ddof=1).mean(axis=0)
    between = by_person.mean(axis=1).var(axis=0, ddof=1) - within / 3.0
    for i, name in enumerate(("Rsc", "Csc")):
        # of the drawn values: a chi-square's 95 % of 12 and of 5 degrees of freedom are factors of 1.9 and 3.9 apart
        assert touches["log_sd"][name]["q025"] < np.sqrt(within[i]) < touches["log_sd"][name]["q975"]
        assert people["log_sd"][name]["q025"] < np.sqrt(between[i]) < people["log_sd"][name]["q975"]
        assert people["intraclass_correlation"][name]["q025"] > 0.5
        assert found["population"][name]["median"]["q025"] < np.exp(values[:, i].mean())
        assert found["population"][name]["median"]["q975"] > np.exp(values[:, i].mean())
    assert set(found["forecasts"]) == {"person", *(f"P{i}" for i in range(1, 7))}
    for person, mean in zip(range(1, 7), by_person.mean(axis=1), strict=True):
        forecast = found["forecasts"][f"P{person}"]["Rsc"]
        assert forecast["q25"] < np.exp(mean[0]) < forecast["q75"]
        assert np.log(forecast["q975"] / forecast["q025"]) < 6.0 * np.sqrt(within[0])
    parts = found["new_finger"]["force_mean"]["variance"]
    assert sum(parts["levels"].values()) == pytest.approx(parts["people"])
    assert parts["levels"]["person"] > parts["levels"]["repetition"] > 0.0
    now, *larger = found["next_studies"]
    assert (now["units"], now["repetitions"], now["records"]) == (6, 3, 18)
    four_times = next(each for each in larger if each["units"] == 24)
    assert four_times["median_u"] == pytest.approx(0.5 * now["median_u"])  # people halve it, not repetitions
    assert all(each["median_u"] > 0.9 * now["median_u"] for each in larger if each["units"] == 6)


@pytest.mark.slow
def test_a_drive_for_the_study_needs_no_records(study_folder):
    """Read from the folder; some touches need more than the typical one, and all people more than most."""
    scene = fitact.Scene.from_dict({"perception": {"threshold_force": "20 uN"}})
    design = fitact.design_drive(scene, study_folder, 0.9, touches=0.9)
    assert design.question.startswith("To be felt by 90 % of people in 90 % of touches")
    assert "at least 90 % of people then feel it in 90 % of touches" in design.recommendation
    amplitude = design.options["sine"].assured
    assert fitact.design_drive(scene, study_folder, 0.9, touches=0.5).options["sine"].assured < amplitude
    assert fitact.design_drive(scene, study_folder, 0.5, touches=0.9).options["sine"].assured < amplitude
    with pytest.raises(fitact.InputError, match="holds no complete population"):
        fitact.design_drive(scene, study_folder.parent)


@pytest.mark.slow
def test_one_area_is_refused_where_records_contradict_it():
    study = fitact.Study.from_pattern("P{person}_r{repetition}.csv.gz", sorted(STUDY.glob("P[12]_*.csv.gz")))
    scene = fitact.Scene.load(STUDY.with_suffix(".toml")).model_dump(exclude_unset=True)
    common = fitact.Scene.from_dict(scene | {"population": {"contact_area": "common"}})
    with pytest.raises(
        fitact.InputError, match=r"contact_area = \"common\" is contradicted .* by 1\d % .*P2_r3.csv.gz most"
    ):
        fitact.population(study, common, progress=False)
