"""Results of `inspect`, and the refusal to fit a foreign file before its columns are assigned."""

import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
import scipy.io

import fitact
from fitact.cli import main
from tests.layouts.layout import SCOPE


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


def table(header: str, *columns: np.ndarray, delimiter: str = ",", digits: str = "%.9g") -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        path = folder / "a record.csv"
        np.savetxt(path, np.column_stack(columns), digits, delimiter, header=header, comments="")
        return path

    return write


def write_sound(folder: Path) -> Path:
    scipy.io.wavfile.write(folder / "card.wav", 20_000, np.column_stack([V / 200.0, VSC / 20.0]))
    return folder / "card.wav"


def write_arrays(folder: Path) -> Path:
    np.savez(folder / "a.npz", drive=V, skin=VSC)
    return folder / "a.npz"


TIME = 5e-5 * np.arange(400)
V, VSC, CURRENT = 180.0 * np.sin(628.0 * TIME), 9.0 * np.cos(628.0 * TIME), 1e-6 * np.cos(628.0 * TIME)
FREQUENCY, COUNT = np.geomspace(1.0, 1e5, 400), np.arange(400.0)
BOTH = {"V": V, "Vsc": VSC}
# file whose columns are not assigned: what writes it, exit status, and channels by the command, or a part of the guess
UNASSIGNED = {
    "unknown names": (table("time_s,CH1,CH2", TIME, VSC, V), 0, BOTH),
    "blanks and quotes in names": (table("time_s,it's skin,my drive", TIME, VSC, V), 0, BOTH),
    "tabs, units": (table("t [ms]\tU1 [mV]\tU2", 1e3 * TIME, 1e3 * VSC, V, delimiter="\t"), 0, BOTH),
    "two times": (table("Time,Elapsed (s),a,b", TIME, TIME + 1.0, V, VSC), 0, BOTH),
    "a count beside the time": (table("time_s,pulses,a,b", TIME, COUNT, V, VSC), 0, BOTH),
    "another quantity": (table("time_s,a,T (deg),b", TIME, V, 1e3 * VSC, VSC), 0, BOTH),
    "a current": (table("time_s,U (V),shunt (uA)", TIME, V, 1e6 * CURRENT), 0, {"V": V, "I": CURRENT}),
    "one voltage": (table("time_s,CH1", TIME, VSC), 0, {"Vsc": VSC}),
    "V alone is named": (table("time_s,V_V,skin", TIME, V, VSC), 0, BOTH),
    "a shunt's voltage": (table("time_s,I_V,V_V", TIME, 1e3 * CURRENT, V), 2, {"V": V, "I": CURRENT}),
    "an unknown unit": (table("time_s,V_V,Vsc_div", TIME, V, 1e3 * VSC), 2, BOTH),
    "sound": (write_sound, 0, {"V": V / 20.0, "Vsc": VSC / 2.0}),
    "no time": (table("skin;drive", VSC, V, delimiter=";"), 2, BOTH),
    "no names": (table("", V, VSC), 2, BOTH),
    "one column of values": (table("", VSC), 2, {"Vsc": VSC}),
    "no header": (table("", TIME, V, VSC), 2, BOTH),
    "no header, two times": (table("", TIME, TIME + 1.0, V, VSC), 2, BOTH),
    "a count, no time": (table("n,a,b", COUNT, V, VSC), 2, BOTH),
    "arrays without time": (write_arrays, 2, BOTH),
    "rounded times": (table("time_s,a,b", TIME, V, VSC, digits="%.4f"), 2, BOTH),
    "two segments": (table("t (s),a,b", np.tile(TIME, 2), np.tile(VSC, 2), np.tile(V, 2)), 2, BOTH),
    "two segments with names": (table("time_s,V_V,Vsc_V", np.tile(TIME, 2), np.tile(V, 2), np.tile(VSC, 2)), 2, BOTH),
    "frequencies": (table("freq,A,B", FREQUENCY, V, VSC), 2, "guess by 'freq': a spectrum; name its columns"),
    "frequencies, no header": (table("", FREQUENCY, V, VSC, CURRENT), 2, "guess by 'column 1': a spectrum"),
    "a spectrum without units": (table("f_Hz,magnitude,phase", FREQUENCY, V, VSC), 2, "f_Hz,magnitude,phase"),
    "times alone": (table("time_s", TIME), 2, "begins with:\n  time_s\n  0\n  5e-05"),
    "nothing that varies": (table("a,b", 0.0 * V, COUNT), 2, "no other column is a voltage or a current"),
}  # fmt: skip


@pytest.mark.parametrize("name", UNASSIGNED)
def test_a_file_that_is_not_assigned_is_shown_with_the_command_that_reads_it(
    name: str, tmp_path: Path, monkeypatch, capsys
):
    write, code, expected = UNASSIGNED[name]
    path = write(tmp_path)

    def run(*arguments: str) -> tuple[int, str]:
        monkeypatch.setattr("sys.argv", ["fitact", *arguments])
        with pytest.raises(SystemExit) as ended:
            main()
        return int(str(ended.value.code)), capsys.readouterr().out

    ended, shown = run("inspect", str(path))
    assert ended == code
    if isinstance(expected, str):
        assert expected in shown
        assert "fitact fit" not in shown
        return
    rows = [line.split() for line in shown.splitlines()]
    assert any(f"{V[1]:.6g}" in row or f"{VSC[1]:.6g}" in row for row in rows) or name in ("sound", "rounded times")
    (command,) = re.findall(r"fitact ((?:inspect|fit) .*)", shown)
    found = {}

    def stop(records: list[fitact.Record], *_: object, **__: object) -> None:
        found.update(records[0].channels)
        raise fitact.InputError("read")

    monkeypatch.setattr("fitact.cli.internal.fit_planned", stop, raising=False)
    arguments = shlex.split(command)
    ended, shown = run(*arguments, *(["--json"] if arguments[0] == "inspect" else []))
    if arguments[0] == "inspect":
        assert ended == 0
        found = {channel["name"]: channel["max"] for channel in json.loads(shown)["channels"]}
        assert found == pytest.approx({channel: values.max() for channel, values in expected.items()}, rel=1e-6)
        return
    for channel, values in expected.items():
        np.testing.assert_allclose(found[channel], values, rtol=1e-6, atol=1e-4 if name == "rounded times" else 1e-9)


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
