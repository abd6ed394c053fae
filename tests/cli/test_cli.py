"""The command line from the user's side: output, files and exit status; in a separate process where that matters."""

import json
import math
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from fitact.cli import main, run_command
from fitact.cli.app import app

FILES = {"fit.json", "summary.json", "posterior.nc", "chain.h5", "report.html"}


INTERRUPTED = "fitact: interrupted; the same command resumes from the last checkpoint, if there is one\n"

# a program that can be interrupted even if the test runner passes on an ignored SIGINT
INTERRUPTIBLE = (
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); from fitact.cli import main; main()"
)


@pytest.fixture(scope="module")
def environment(tmp_path_factory) -> dict[str, str]:
    return os.environ | {"XDG_CACHE_HOME": str(tmp_path_factory.mktemp("cache"))}


@pytest.fixture
def fitact_process(environment, tmp_path):
    """Return a function that runs the command in a separate process."""

    def call(*arguments: object) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", "from fitact.cli import main; main()", *map(str, arguments)]
        done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=tmp_path)
        assert "Traceback" not in done.stderr
        return done

    return call


@pytest.fixture
def fitact_command(tmp_path, monkeypatch, capsys):
    """Return a function that runs the command in this process, where most is already compiled: ten times as fast."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)  # main() sets its own hook

    def call(*arguments: object) -> subprocess.CompletedProcess[str]:
        monkeypatch.setattr(sys, "argv", ["fitact", *map(str, arguments)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            main()
        printed = capsys.readouterr()
        assert "Traceback" not in printed.err
        return subprocess.CompletedProcess(sys.argv, ended.value.code, printed.out, printed.err)

    return call


@pytest.fixture(scope="module")
def results(
    environment, finger_path, finger_scene_path, tmp_path_factory
) -> tuple[Path, subprocess.CompletedProcess[str]]:
    folder = tmp_path_factory.mktemp("run") / "out"
    command = [
        sys.executable,
        "-c",
        "from fitact.cli import main; main()",
        "run",
        finger_path,
        "--scene",
        finger_scene_path,
    ]
    done = subprocess.run(
        [*map(str, command), "--out", str(folder), "--seed", "1"],
        capture_output=True,
        text=True,
        env=environment,
    )
    return folder, done


def test_run_leaves_everything_and_says_what_to_open(results):
    folder, done = results
    assert done.returncode == 0, done.stderr
    assert {path.name for path in folder.iterdir()} == FILES  # nothing half-written
    assert done.stdout.strip().splitlines()[-1] == f"open {folder / 'report.html'} (more here: --verbose)"
    assert "sampling" in done.stderr
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["identifiability"]["verdict"] == "prior-limited"
    assert summary["convergence"]["converged"] is True


@pytest.mark.parametrize("command", ["run", "fit", "track"])
def test_a_folder_that_cannot_be_written_is_refused_before_the_work(fitact_command, finger_path, tmp_path, command):
    (tmp_path / "file").touch()
    done = fitact_command(command, finger_path, "--out", tmp_path / "file" / "results")
    assert done.returncode == 2
    assert done.stderr.strip().endswith(f"cannot be written ({tmp_path / 'file'} is no folder); choose another path")
    assert done.stdout == ""
    assert "fitting" not in done.stderr + done.stdout


@pytest.mark.slow
def test_run_again_goes_on_from_the_chain_and_json_stands_alone(
    results, fitact_process, finger_path, finger_scene_path
):
    folder, _ = results
    before, fit_before = (folder / "posterior.nc").read_bytes(), (folder / "fit.json").read_bytes()
    done = fitact_process("run", finger_path, "--scene", finger_scene_path, "--out", folder, "--seed", 1, "--json")
    assert done.returncode == 0
    assert json.loads(done.stdout) == json.loads((folder / "summary.json").read_text())
    assert "sampling:" not in done.stderr  # the chain had already converged
    assert (folder / "posterior.nc").read_bytes() == before
    other = fitact_process("run", finger_path, "--scene", finger_scene_path, "--out", folder, "--seed", 2)
    assert other.returncode == 2
    assert "another record, scene, seed" in other.stderr
    assert (folder / "posterior.nc").read_bytes() == before
    assert (folder / "fit.json").read_bytes() == fit_before


def test_report_is_made_again_from_the_folder(results, fitact_command, tmp_path):
    folder, _ = results
    page = (folder / "report.html").read_text()
    (folder / "report.html").unlink()
    done = fitact_command("report", folder)
    assert done.returncode == 0
    assert (folder / "report.html").read_text() == page
    refused = fitact_command("report", tmp_path)
    assert refused.returncode == 2
    assert "fitact sample" in refused.stderr


def test_summary_is_printed_again_with_the_runs_exit_code(results, fitact_process, tmp_path):
    folder, done = results
    again = fitact_process("summary", folder)
    assert again.returncode == 0
    assert done.stdout == again.stdout + f"open {folder / 'report.html'} (more here: --verbose)\n"
    content = json.loads(fitact_process("summary", folder, "--json").stdout)
    assert content == json.loads((folder / "summary.json").read_text())
    content["convergence"]["converged"] = False
    (tmp_path / "summary.json").write_text(json.dumps(content))
    assert fitact_process("summary", tmp_path).returncode == 1
    (tmp_path / "summary.json").write_text("{}")
    refused = fitact_process("summary", tmp_path)
    assert refused.returncode == 2
    assert "fitact sample" in refused.stderr


def test_fit_json(fitact_command, finger_path):
    done = fitact_command("fit", finger_path, "--json", "--out", "here")
    assert done.returncode == 0
    content = json.loads(done.stdout)
    assert {"parameters", "derived", "identifiability", "fit", "model", "warnings"} <= set(content)
    assert any("no scene" in warning for warning in content["warnings"])


def test_misfit_is_exit_code_1_with_an_answer(fitact_command, finger_path, tmp_path):
    header, *rows = finger_path.read_text().splitlines()
    bent = [f"{t},{v},{20.0 * math.tanh(float(s) / 20.0)}" for t, v, s in (row.split(",") for row in rows)]
    (tmp_path / "saturating.csv").write_text("\n".join([header, *bent]))
    done = fitact_command("fit", "saturating.csv", "--json", "--out", "saturating")
    assert done.returncode == 1
    assert json.loads(done.stdout)["fit"]["misfit"] is True
    assert json.loads((tmp_path / "saturating" / "fit.json").read_text())["fit"]["result"] == "misfit"
    assert "the results are unreliable" in done.stderr


def test_scene_is_printed_as_a_file(fitact_command, tmp_path):
    done = fitact_command("scene", "phone")
    assert done.returncode == 0
    (tmp_path / "scene.toml").write_text(done.stdout)
    assert fitact_command("scene", "scene.toml").stdout == done.stdout
    assert 'Z_capacitance = "9.4 pF"\n' in done.stdout
    template = fitact_command("scene").stdout
    assert '# Rsc = "160 kohm"\n' in template
    assert json.loads(fitact_command("scene", "phone", "--json").stdout)["grounding"]["Z_capacitance"] == 9.4e-12
    (tmp_path / "scene.toml").write_text('[drive]\nwaveform = "sine"\nduty = 0.3')
    refused = fitact_command("scene", "scene.toml")
    assert refused.returncode == 2
    assert refused.stderr.startswith("fitact: scene.toml, line 3: [drive]")


@pytest.mark.slow
def test_tradeoff_is_written_or_ends_without_a_trace(fitact_process, environment, finger_path, tmp_path):
    command = [sys.executable, "-u", "-c", INTERRUPTIBLE, "tradeoff", str(finger_path)]
    running = subprocess.Popen(
        [*command, "--out", "cut"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
        env=environment,
    )
    while "round 1" not in running.stderr.readline():
        pass
    running.send_signal(signal.SIGINT)
    out, err = running.communicate(timeout=60)
    assert (running.returncode, out, err) == (130, "", INTERRUPTED)
    assert not (tmp_path / "cut").exists()
    done = fitact_process("tradeoff", finger_path, "--out", "whole", "--json")
    assert done.returncode == 0
    content = json.loads(done.stdout)
    assert json.loads((tmp_path / "whole" / "tradeoff.json").read_text()) == content
    assert {level["kind"] for level in content["levels"]} == {"answer", "response", "likelihood", "uncertainty"}
    assert (tmp_path / "whole" / "tradeoff.svg").read_text().startswith("<?xml")
    assert f"tradeoff {finger_path} --out whole" in (tmp_path / "whole" / "report.html").read_text()


def test_a_fit_imports_only_what_it_uses(finger_path: Path, finger_scene_path: Path):
    """Submodules are looked for, since a lazily imported package is in sys.modules before it is loaded."""
    code = """
import sys
from fitact.cli import main
try:
    main()
except SystemExit as end:
    assert not end.code, end.code
loaded = ["matplotlib.figure", "pandas", "arviz_stats", "dask", "h5py._hl", "plotly", "pint.registry", "emcee"]
print([name for name in loaded if name in sys.modules], file=sys.stderr)
"""
    command = [sys.executable, "-c", code, "fit", str(finger_path), "--scene", str(finger_scene_path)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.stderr.splitlines()[-1] == "[]"


@pytest.mark.skipif(sys.platform == "win32", reason="no pseudo-terminals")
def test_a_terminal_shows_at_once_what_is_read(finger_path: Path):
    """Before the record is read and anything heavy is imported: of a missing scene, the record's name comes first."""
    ours, theirs = os.openpty()
    command = [sys.executable, "-c", "from fitact.cli import main; main()", "fit", str(finger_path), "--scene", "none"]
    done = subprocess.run(command, stderr=theirs, stdout=subprocess.PIPE)
    os.close(theirs)
    shown = os.read(ours, 4096).decode().splitlines()
    os.close(ours)
    assert done.returncode == 2
    assert shown[0] == f"reading {finger_path}"
    assert "none" in shown[1]


def test_prior_is_shown_before_any_data(fitact_command, tmp_path):
    (tmp_path / "scene.toml").write_text('[prior]\nRsc = {median = "130 kohm", factor = 3}\n')
    done = fitact_command("prior", "scene.toml", "--draws", 500, "--seed", 1, "--out", "prior.html", "--json")
    assert done.returncode == 0, done.stderr
    content = json.loads(done.stdout)
    assert content["draws"] == 500
    assert {"Rsc", "Csc", "Ci"} == set(content["parameters"])
    assert 90e3 < content["parameters"]["Rsc"]["q50"] < 180e3
    assert content["derived"]["force_mean"]["unit"] == "N"
    assert "<svg" in (tmp_path / "prior.html").read_text()


def test_plan_is_a_table_json_and_a_picture(fitact_command, tmp_path):
    (tmp_path / "scene.toml").write_text('[grounding]\nR_H = "500 ohm"\n')
    done = fitact_command("plan", "scene.toml", "--out", "plan", "--json")
    assert done.returncode == 0, done.stderr
    content = json.loads(done.stdout)
    assert {each["name"]: each["kept"] for each in content["omissions"]} == {"R_H": False, "float64": True}
    assert content["model"]["circuit"] == "final"
    assert json.loads((tmp_path / "plan" / "plan.json").read_text()) == content
    assert "<svg" in (tmp_path / "plan" / "plan.svg").read_text()
    assert "fitact plan scene.toml --out plan --json" in (tmp_path / "plan" / "report.html").read_text()
    assert "Neglected: R_H. This changes the peak of Vsc by 0.14 %" in fitact_command("plan", "scene.toml").stdout
    (tmp_path / "measured.toml").write_text('[drive]\nwaveform = "measured"\n')
    assert fitact_command("plan", "measured.toml").returncode == 2


def test_simulated_current_needs_a_finite_one(fitact_command, tmp_path):
    (tmp_path / "ideal.toml").write_text('[measurement]\nchannels = ["Vsc", "I"]\n')
    refused = fitact_command("simulate", "ideal.toml", "--out", "ideal.csv")
    assert refused.returncode == 2
    assert "rise time" in refused.stderr
    assert not (tmp_path / "ideal.csv").exists()
    (tmp_path / "real.toml").write_text('[grounding]\nR_H = "500 ohm"\n[measurement]\nchannels = ["Vsc", "I"]\n')
    assert fitact_command("simulate", "real.toml", "--out", "real.csv").returncode == 0
    header, first, *_ = (tmp_path / "real.csv").read_text().splitlines()
    assert header == "time_s,V_V,Vsc_V,I_A"
    # just after the edge only R_H limits the current, with the charge on Ci and the skins: below 360 V / 500 ohm
    assert 0.7 < float(first.split(",")[3]) < 0.72


def test_what_is_refused_leaves_nothing(fitact_command, finger_path, tmp_path):
    (tmp_path / "scene.toml").write_text("[devce]\n")
    (tmp_path / "file").write_text("")
    for arguments, words in {
        ("fit", finger_path, "--scene", "scene.toml"): "did you mean 'device'",
        ("run", "file", "--out", "out", "--json"): "fitact: file: the file holds no data",
        ("fit", finger_path, "--out", "file/below"): "cannot be written",
        ("run", finger_path, "--seed", "-1"): "seed",
        ("nonsense",): "nonsense",
    }.items():
        done = fitact_command(*arguments)
        assert (done.returncode, done.stdout) == (2, "")
        assert words in done.stderr
    assert not (tmp_path / "out").exists()


def test_help_is_a_page_to_start_from(fitact_process):
    done = fitact_process("--help")
    assert done.returncode == 0
    for word in (
        "fitact run finger.csv",
        "time_s,V_V,Vsc_V",
        "--scene",
        "run",
        "fit",
        "sample",
        "simulate",
        "report",
        "Exit status",
    ):
        assert word in done.stdout
    assert fitact_process().stdout.split() == done.stdout.split()


def test_ctrl_c_within_a_command_says_how_to_resume(monkeypatch, capsys, finger_path):
    """An interrupt inside the command-line library, which would end it without a word."""

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)
    monkeypatch.setattr("fitact.cli.one_finger._fit_records", interrupt)
    assert run_command(lambda: app(["fit", str(finger_path)], standalone_mode=False)) == 130
    assert capsys.readouterr().err.endswith(INTERRUPTED)


def test_an_interrupt_that_python_drops_comes_again(environment):
    """SIGINT within the callback of a weak reference, where Python prints the exception and continues."""
    script = """
import signal, time, weakref
import fitact.cli

class Thing: pass

def command(**_):
    thing = Thing()
    kept = weakref.ref(thing, lambda _: signal.raise_signal(signal.SIGINT))
    del thing
    time.sleep(60)

signal.signal(signal.SIGINT, signal.default_int_handler)
fitact.cli.app = command
fitact.cli.main()
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=environment, timeout=50)
    assert done.returncode == 130
    assert done.stderr == INTERRUPTED


@pytest.mark.slow
def test_an_interrupted_run_goes_on(environment, finger_path, finger_scene_path, results, tmp_path):
    """After SIGINT while sampling there is no traceback, and the same command finishes with the same draws."""
    folder = tmp_path / "out"
    command = [
        sys.executable,
        "-c",
        INTERRUPTIBLE,
        "run",
        finger_path,
        "--scene",
        finger_scene_path,
    ]
    command = [*map(str, command), "--out", str(folder), "--seed", "1"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment)
    assert process.stderr is not None
    for line in process.stderr:
        if line.startswith("sampling"):
            process.send_signal(signal.SIGINT)
            break
    _, rest = process.communicate()
    assert "Traceback" not in rest
    assert process.returncode in (1, 130)
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0
    whole = json.loads((results[0] / "summary.json").read_text())["parameters"]
    again = json.loads((folder / "summary.json").read_text())["parameters"]
    np.testing.assert_equal(again, whole)
