"""Results of `inspect`, and the refusal to fit a foreign file before its columns are assigned."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

import fitact
from tests.data.test_scope_files import SCOPE


@pytest.fixture
def command(tmp_path: Path):
    def call(*arguments: object) -> subprocess.CompletedProcess[str]:
        line = [sys.executable, "-c", "from fitact.cli import main; main()", *map(str, arguments)]
        environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path)}
        return subprocess.run(line, capture_output=True, text=True, cwd=tmp_path, env=environment)

    return call


def test_the_shipped_record(finger_path: Path, finger_truth: dict[str, float]):
    content = fitact.inspect(finger_path).to_dict()
    table = np.loadtxt(finger_path, delimiter=",", skiprows=1)
    assert content["samples"] == len(table)
    assert content["time_start"] == table[0, 0]
    assert content["time_step"] == pytest.approx(5e-6, rel=1e-9)
    assert content["frequency"] == pytest.approx(100.0, rel=1e-3)
    assert content["warnings"] == []
    for channel, column, name in zip(content["channels"], table.T[1:], ("V", "Vsc"), strict=True):
        assert (channel["name"], channel["unit"], channel["clipped"]) == (name, "V", False)
        assert (channel["min"], channel["max"]) == (column.min(), column.max())
        assert channel["noise"] == pytest.approx(finger_truth[f"noise_{name}"], rel=0.05)


def test_drift_and_hum_are_measured(tmp_path: Path):
    """2 V of 50 Hz and 4 V of drift on 18 V of 130 Hz are measured to the digits shown; otherwise nothing is shown."""
    time = np.arange(20_000) * 2e-5
    drive = 180.0 * np.sin(2.0 * np.pi * 130.0 * time)
    clean = 0.1 * drive + 0.02 * np.random.default_rng(2).normal(size=time.size)  # any seed; 1 % of the hum
    spoilt = clean + 2.0 * np.sin(2.0 * np.pi * 50.0 * time + 1.0) + 10.0 * time
    for values, expected in (
        (clean, []),
        (spoilt, [r"Vsc contains mains hum \(50 Hz, amplitude (1\.99|2) V\)", r"Vsc drifts by (3\.9\d|4)\b"]),
    ):
        path = tmp_path / "record.csv"
        np.savetxt(path, np.c_[time, drive, values], delimiter=",", header="time_s,V_V,Vsc_V", comments="")
        found = fitact.inspect(path).warnings
        assert len(found) == len(expected)
        assert all(re.match(pattern, sentence) for pattern, sentence in zip(expected, found, strict=True))


def test_inspect_shows_all_channels_and_draws_them(command, tmp_path: Path):
    done = command("inspect", SCOPE / "keysight_scope_0.csv", "--json", "--out", "record.png")
    assert (done.returncode, done.stderr) == (0, "")
    content = json.loads(done.stdout)
    assert [channel["name"] for channel in content["channels"]] == ["1", "2"]
    assert content["time_start"] == -0.01
    assert "fitact fit" in content["notes"][-1]
    assert matplotlib.image.imread(tmp_path / "record.png").std() > 0.05
    done = command(
        "inspect", SCOPE / "keysight_scope_0.csv", "--channel", "Vsc=CH2", "--scale", "Vsc=10", "--out", "a.jpg"
    )
    assert done.returncode == 2
    assert "choose one of these endings" in done.stderr


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ((), "not guessed (found: 1, 2)"),
        (("--channel", "Vsc"), "write NAME=VALUE, e.g. --channel Vsc=CH2"),
        (("--channel", "Vsc=2", "--scale", "Vsc=ten"), "write a number, e.g. --scale Vsc=10"),
    ],
)
def test_it_must_be_said_which_is_which(command, options: tuple[str, ...], words: str):
    done = command("inspect" if options else "fit", SCOPE / "keysight_scope_0.csv", *options)
    assert done.returncode == 2
    assert words in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.slow
def test_a_fit_of_an_oscilloscopes_file(command):
    """Steady-state square of period T: Vsc jumps to 360 V g / (1 + exp(-T / 2b)) and decays as exp(-t / b)."""
    path = SCOPE / "keysight_scope_0.csv"
    done = command("fit", path, "--channel", "V=1", "--channel", "Vsc=2", "--json")
    assert done.returncode == 0, done.stderr
    content = json.loads(done.stdout)
    fall = np.loadtxt(path, delimiter=",", skiprows=2)[:100]
    slope, level = np.polyfit(fall[:, 0] - fall[0, 0], np.log(fall[:, 2]), 1)
    assert content["derived"]["b"]["mean"] == pytest.approx(-1.0 / slope, rel=0.01)
    assert content["derived"]["g"]["mean"] == pytest.approx(
        np.exp(level) * (1.0 + np.exp(slope * 5e-3)) / 360.0, rel=0.01
    )
    assert any("Vsc read from column '2' (unit Volt); the file" in note for note in content["notes"])
