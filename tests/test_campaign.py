"""Many records on Dask's workers: every one done once, whatever is killed, and the poisoned ones set aside."""

import csv
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import square_record

import fitact
import fitact.campaign as module
from fitact.campaign import JOURNAL, Journal, Task
from fitact.data.formats import write_csv

psutil = pytest.importorskip("psutil")
pytest.importorskip("distributed")

SCENE = '[drive]\nwaveform = "square"\npeak_to_peak = "360 V"\nfrequency = "100 Hz"\n'
RECORDS = 128
POISONED = 20


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Records of people, as files, and a scene."""
    folder = tmp_path_factory.mktemp("campaign")
    (folder / "scene.toml").write_text(SCENE)
    (folder / "records").mkdir()
    for number in range(RECORDS):
        scale = np.exp(0.3 * np.sin(np.arange(2) + number))
        record = square_record(noise=0.1, seed=number, per_period=500, Rsc=130e3 * scale[0], Csc=18e-9 * scale[1])
        record = fitact.Record.from_arrays(record.time, Vsc=record["Vsc"])
        write_csv(folder / "records" / f"f{number:03d}.csv", record)
    return folder


def paths(folder: Path) -> list[str]:
    return [str(path) for path in sorted((folder / "records").iterdir())]


def started(folder: Path, out: Path, *more: str) -> subprocess.Popen[str]:
    """A campaign on its way, in a process group of its own."""
    command = [sys.executable, "-c", "from fitact.cli import main; main()", "campaign", *paths(folder)]
    command += ["--scene", str(folder / "scene.toml"), "--out", str(out), *more]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)


def ended(process: subprocess.Popen[str]) -> None:
    output, errors = process.communicate(timeout=500)
    assert process.returncode == 0, errors
    assert "answers to be trusted" in output


def lines(out: Path) -> int:
    journal = out / JOURNAL
    return journal.read_bytes().count(b"\n") if journal.exists() else 0


def until(condition: Callable[[], Any], process: subprocess.Popen[str]) -> Any:
    """What the condition found, once it is true."""
    deadline = time.monotonic() + 300.0
    while not (found := condition()):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.05)
    return found


def workers(process: subprocess.Popen[str]) -> list["psutil.Process"]:
    """The spawned processes of a campaign that hold JAX."""
    found = []
    for child in psutil.Process(process.pid).children(recursive=True):
        try:
            if "spawn_main" in " ".join(child.cmdline()) and child.memory_info().rss > 200e6:
                found.append(child)
        except psutil.Error:
            continue
    return found


def table(out: Path) -> dict[str, list]:
    import pyarrow.parquet as pq

    return pq.read_table(out / "results.parquet").to_pydict()


@pytest.fixture(scope="module")
def undisturbed(folder: Path) -> Path:
    ended(started(folder, folder / "undisturbed", "--workers", "2"))
    return folder / "undisturbed"


def assert_done_once(out: Path, undisturbed: Path) -> None:
    """Each record in one line of the journal, and the tables the same to the last bit."""
    keys = [key for line in (out / JOURNAL).read_text().splitlines() for key in json.loads(line)]
    assert len(keys) == len(set(keys)) == RECORDS
    assert table(out) == table(undisturbed)


@pytest.mark.slow
def test_workers_are_killed_three_times(folder: Path, undisturbed: Path, tmp_path: Path):
    process = started(folder, tmp_path, "--workers", "2")
    for kills in range(3):
        alive = until(lambda: workers(process), process)
        victim = alive[kills % len(alive)]
        victim.kill()
        victim.wait()
    ended(process)
    assert_done_once(tmp_path, undisturbed)


@pytest.mark.slow
@pytest.mark.thorough
def test_everything_is_killed_and_goes_on(folder: Path, undisturbed: Path, tmp_path: Path):
    process = started(folder, tmp_path, "--workers", "2")
    until(lambda: lines(tmp_path) >= 1, process)
    tree = [process.pid, *(child.pid for child in psutil.Process(process.pid).children(recursive=True))]
    for pid in tree:
        os.kill(pid, signal.SIGKILL)
    process.wait()
    assert lines(tmp_path) < RECORDS / module.BATCH  # else nothing was left to do
    ended(started(folder, tmp_path, "--workers", "2"))
    assert_done_once(tmp_path, undisturbed)


@pytest.fixture
def port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def cluster(port: int) -> Iterator[subprocess.Popen[bytes]]:
    """A scheduler at that port, then a worker of it."""
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "start_new_session": True}
    dask = [sys.executable, "-m", "dask"]
    address = f"tcp://127.0.0.1:{port}"
    yield subprocess.Popen([*dask, "scheduler", "--port", str(port), "--host", "127.0.0.1", "--no-dashboard"], **quiet)
    yield subprocess.Popen([*dask, "worker", address, "--nthreads", "1", "--no-dashboard"], **quiet)


@pytest.mark.slow
@pytest.mark.thorough
def test_the_scheduler_is_killed_and_comes_back(folder: Path, undisturbed: Path, tmp_path: Path, port: int):
    running = list(cluster(port))
    try:
        process = started(folder, tmp_path, "--scheduler", f"tcp://127.0.0.1:{port}")
        until(lambda: lines(tmp_path) >= 1, process)
        for each in running:
            os.killpg(each.pid, signal.SIGKILL)
        assert lines(tmp_path) < RECORDS / module.BATCH
        running += list(cluster(port))
        ended(process)
    finally:
        for each in running:
            if each.poll() is None:
                os.killpg(each.pid, signal.SIGKILL)
            each.wait()
    assert_done_once(tmp_path, undisturbed)


def poisoned(place: Path) -> None:
    """Twenty files that no one can fit, of eight kinds."""
    header, rows = "time_s,Vsc_V", [f"{1e-5 * i},{i % 7}" for i in range(100)]
    contents = {
        "nan": "\n".join([header, *rows[:50], "5e-4,nan", *rows[51:]]),
        "truncated": "\n".join([header, *rows])[:-1] + ",",
        "unit": "\n".join(["time_s,Vsc_furlong", *rows]),
        "empty": "",
        "text": "no record at all",
        "short": "\n".join([header, *rows[:5]]),
        "constant": "\n".join([header, *(f"{1e-5 * i},1" for i in range(100))]),
    }
    for number in range(POISONED - 2):
        kind = list(contents)[number % len(contents)]
        (place / f"p{number:02d}_{kind}.csv").write_text(contents[kind])
    (place / "p18_directory.csv").mkdir()
    (place / "p19_nowhere.csv").symlink_to(place / "nothing_there")


@pytest.mark.slow
def test_poisoned_records_are_set_aside(folder: Path, undisturbed: Path, tmp_path: Path):
    (tmp_path / "records").symlink_to(folder / "records")
    own = tmp_path / "own" / "records"
    own.mkdir(parents=True)
    for path in paths(folder):
        (own / Path(path).name).symlink_to(path)
    poisoned(own)
    (own.parent / "scene.toml").write_text(SCENE)
    ended(started(own.parent, tmp_path / "out", "--workers", "2"))
    with (tmp_path / "out" / "failures.csv").open(newline="") as file:
        failures = list(csv.DictReader(file))
    assert len(failures) == POISONED
    assert {row["result"] for row in failures} == {"refused"}
    assert all(row["record"] in row["message"] for row in failures)
    found = table(tmp_path / "out")
    assert found["record"] == table(undisturbed)["record"]
    np.testing.assert_allclose(found["Rsc"], table(undisturbed)["Rsc"], rtol=1e-6)


def test_a_torn_line_is_dropped(tmp_path: Path):
    journal = Journal(tmp_path / JOURNAL)
    journal.add({"a": {"record": "a"}})
    journal.close()
    with (tmp_path / JOURNAL).open("a") as file:
        file.write('{"b": {"rec')  # as a kill leaves it
    again = Journal(tmp_path / JOURNAL)
    assert set(again.rows) == {"a"}
    again.add({"c": {"record": "c"}})
    again.close()
    last = Journal(tmp_path / JOURNAL)
    last.close()
    assert set(last.rows) == {"a", "c"}


def test_changed_inputs_and_settings_are_done_again(tmp_path: Path):
    path = tmp_path / "a.csv"
    task = Task(None, {}, None, 0)

    def key(task: Task = task) -> str:
        return module._keys([str(path)], task)[0]

    path.write_text("1")
    first = key()
    assert key() == first
    assert key(Task(None, {}, None, 1)) != first
    assert key(Task(None, {"scale": {"V": 2.0}}, None, 0)) != first
    path.write_text("2")
    assert key() != first
    os.unlink(path)
    assert key() != first


def test_a_file_named_twice_is_refused(tmp_path: Path):
    with pytest.raises(fitact.InputError, match="twice"):
        fitact.run_campaign([tmp_path / "a.csv", tmp_path / "a.csv"], tmp_path)


def test_a_scheduler_that_is_not_there_is_refused(tmp_path: Path, port: int):
    (tmp_path / "a.csv").write_text("1")
    with pytest.raises(fitact.InputError, match="not to be reached"):
        fitact.run_campaign([tmp_path / "a.csv"], tmp_path / "out", scheduler=f"tcp://127.0.0.1:{port}", progress=False)
