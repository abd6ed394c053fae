"""Fits of the records that data_synth ships: the truth lies within the errors, or the fit reports why not."""

import functools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fitact

pytestmark = pytest.mark.slow

RECORDS = Path(__file__).parents[2] / "data_synth" / "records"
SIGMAS = 4.0
FREED = {"hum": "hum_60Hz_cos", "eight_bit": "offset", "late_trigger": "delay"}
WARNED = {"clipped": "is clipped", "eight_bit": "rounded to steps larger", "late_trigger": "not uniform"}


def shipped(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text())


@functools.cache
def fitted(name: str) -> fitact.Fit:
    scene = fitact.Scene.load(RECORDS / shipped(RECORDS / f"{name}.json")["scene"])
    return fitact.fit(fitact.read(RECORDS / f"{name}.csv.gz", scene), scene)


def truths(path: Path) -> dict[str, float]:
    """Return the true parameters and, if only the two skins are in series with Ci, g and b."""
    content = shipped(path)
    found = {name: entry["value"] for name, entry in content["truth"].items() if not name.startswith("noise")}
    gain = content["recipe"].get("gain", {}).get("Vsc", 1.0)
    if "Z" not in found and "alpha" not in found:
        total = 2.0 * found["Ci"] + found["Csc"]
        found |= {"g": gain * found["Ci"] / total, "b": found["Rsc"] * total}
    return found


def deviation(summary: dict[str, Any], truth: float) -> float:
    """Return the error in posterior standard deviations."""
    return (float(summary["q50"]) - truth) / float(summary["sd"])


@pytest.mark.parametrize(
    "name",
    [
        *("clean", "low_snr", "clipped", "eight_bit"),
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("hum", "late_trigger", "burst", "chirp")),
    ],
)
def test_vsc_alone_gives_g_and_b(name: str):
    """The gain of the probe is included in g, from which a record of Vsc cannot separate it."""
    fit, truth = fitted(name), truths(RECORDS / f"{name}.json")
    assert fit.trusted
    assert fit.identifiability.verdict == "prior-limited"
    for quantity in ("g", "b"):
        assert abs(deviation(fit.derived()[quantity], truth[quantity])) < SIGMAS
    assert FREED.get(name, "") in " ".join(fit.model()["freed"])
    assert WARNED.get(name, "") in " ".join((*fit.warnings, *fit.notes))


def test_little_signal_is_told_as_such():
    """Noise of 8 V instead of 1 mV, with all else equal: 8000 times the width, as for a linear fit."""
    loud, quiet = (fitted(name).derived() for name in ("low_snr", "clean"))
    for quantity in ("g", "b"):
        widths = [float(each[quantity]["sd"]) / float(each[quantity]["q50"]) for each in (loud, quiet)]
        assert widths[0] / widths[1] == pytest.approx(8000.0, rel=0.1)
    assert loud["g"]["sd"] > 0.01 * loud["g"]["q50"]


def test_a_late_trigger_is_found():
    recipe = shipped(RECORDS / "late_trigger.json")["recipe"]
    assert abs(deviation(fitted("late_trigger").parameters()["delay"], -recipe["clock"]["trigger_error"])) < SIGMAS


@pytest.mark.parametrize("name", ["natural_ground", pytest.param("fractional", marks=pytest.mark.slow)])
def test_vsc_and_current_give_everything(name: str):
    fit, truth = fitted(name), truths(RECORDS / f"{name}.json")
    assert fit.trusted
    assert fit.identifiability.verdict == "identified"
    for parameter, value in truth.items():
        assert abs(deviation(fit.parameters()[parameter], value)) < SIGMAS, parameter


@pytest.mark.parametrize("name", ["two_layers", "nonlinear"])
def test_another_skin_than_the_scene_says_is_noticed(name: str):
    fit = fitted(name)
    assert fit.result == "misfit"
    assert not fit.trusted


@pytest.mark.slow
def test_people_with_areas():
    """True values of each finger, and medians and log-sds of their population."""
    paths = sorted((RECORDS / "areas").glob("*.json"))
    scene = fitact.Scene.load(RECORDS / "areas.toml")
    records = [fitact.read(path.with_suffix(".csv.gz"), scene) for path in paths]
    found = fitact.population(records, scene, seed=1, progress=False)
    assert found.trusted
    for path, finger in zip(paths, found.fingers, strict=True):
        for parameter in ("Rsc", "Csc", "Ci"):
            assert abs(deviation(finger.parameters[parameter], truths(path)[parameter])) < SIGMAS
    law = shipped(paths[0])["recipe"]["population"]
    wanted = {"Rsc": 110e3, "Csc": 27e-9, "Ci": 1.41e-9} | {
        f"log_sd_{n}": law[f"log_sd_{n}"] for n in ("Rsc", "Csc", "area")
    }
    for name, draws in found.parameters().items():
        if name in wanted:
            low, high = np.quantile(draws, [0.005, 0.995])
            assert low < wanted[name] < high, name
