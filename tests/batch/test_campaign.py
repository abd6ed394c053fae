"""Many records on Dask workers: each is processed once, whatever is killed, and invalid files are reported."""

import contextlib
import csv
import dataclasses
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fitact
import fitact.batch.campaign as module
from fitact.batch.campaign import JOURNAL, Journal, Task
from fitact.readers.read import write_csv
from tests.conftest import square_record

psutil = pytest.importorskip("psutil")
pytest.importorskip("distributed")

SCENE = '[drive]\nwaveform = "square"\npeak_to_peak = "360 V"\nfrequency = "100 Hz"\n'
POISONED = 20


@dataclasses.dataclass(frozen=True)
class Study:
    """Records in a folder, twenty of which cannot be fitted, with the results of an uninterrupted campaign."""

    folder: Path
    count: int

    @property
    def paths(self) -> list[str]:
        return [str(path) for path in sorted((self.folder / "records").iterdir())]

    @property
    def undisturbed(self) -> Path:
        return self.folder / "undisturbed"

    @property
    def batches(self) -> float:
        return self.count / module.BATCH

    def started(self, out: Path, *more: str) -> subprocess.Popen[str]:
        """Start a campaign in a separate process group."""
        command = [sys.executable, "-c", "from fitact.cli import main; main()", "campaign", *self.paths]
        command += ["--scene", str(self.folder / "scene.toml"), "--out", str(out), *more]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        return subprocess.Popen(command, text=True, start_new_session=True, **pipes)

    def assert_done_once(self, out: Path) -> None:
        """Assert that each record is in one line of the journal, tables agree bit for bit, and failures are listed."""
        keys = [key for line in (out / JOURNAL).read_text().splitlines() for key in json.loads(line)]
        assert len(keys) == len(set(keys)) == self.count
        assert table(out) == table(self.undisturbed)
        assert (out / "failures.csv").read_text() == (self.undisturbed / "failures.csv").read_text()
        names = [Path(path).name for path in self.paths]
        assert_reasons(out, names[-POISONED:])
        assert_truths(out, names[:-POISONED])


def skin_of(number: int) -> dict[str, float]:
    """Return the skin of a finger."""
    scale = np.exp(0.3 * np.sin(np.arange(2) + number))
    return {"Rsc": 130e3 * scale[0], "Csc": 18e-9 * scale[1]}


def study(folder: Path, count: int) -> Study:
    """Write the records, and run an uninterrupted campaign on them."""
    (folder / "scene.toml").write_text(SCENE)
    (folder / "records").mkdir()
    for number in range(count - POISONED):
        record = square_record(noise=0.1, seed=number, per_period=500, **skin_of(number))
        record = fitact.Record.from_arrays(record.time, Vsc=record["Vsc"])
        write_csv(folder / "records" / f"f{number:03d}.csv", record)
    poison(folder / "records")
    made = Study(folder, count)
    ended(made.started(made.undisturbed, "--workers", "2"))
    return made


def poison(place: Path) -> None:
    """Write twenty files that cannot be fitted, of nine kinds."""
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


@pytest.fixture(scope="module")
def few(tmp_path_factory) -> Study:
    return study(tmp_path_factory.mktemp("few"), 128)


@pytest.fixture(scope="module")
def many(tmp_path_factory) -> Study:
    return study(tmp_path_factory.mktemp("many"), 500)


def ended(process: subprocess.Popen[str]) -> None:
    output, errors = process.communicate(timeout=500)
    assert process.returncode == 0, errors
    assert "reliable fits" in output


def lines(out: Path) -> int:
    journal = out / JOURNAL
    return journal.read_bytes().count(b"\n") if journal.exists() else 0


def until(condition: Callable[[], Any], process: subprocess.Popen[str]) -> Any:
    """Wait until the condition returns a true value, and return it."""
    deadline = time.monotonic() + 300.0
    while not (found := condition()):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.02)
    return found


def workers(*parents: int) -> list["psutil.Process"]:
    """Return the spawned processes below these that have imported JAX."""
    found = []
    for child in (child for parent in parents for child in psutil.Process(parent).children(recursive=True)):
        try:
            if "spawn_main" in " ".join(child.cmdline()) and child.memory_info().rss > 200e6:
                found.append(child)
        except psutil.Error:
            continue
    return found


def kill_a_worker(turn: int, process: subprocess.Popen[str], *parents: int) -> None:
    alive = until(lambda: workers(*parents), process)
    victim = alive[turn % len(alive)]
    victim.kill()
    psutil.wait_procs([victim], timeout=30.0)


def kill_tree(pid: int) -> None:
    for process in [psutil.Process(pid), *psutil.Process(pid).children(recursive=True)]:
        with contextlib.suppress(psutil.NoSuchProcess):
            process.kill()


def table(out: Path) -> dict[str, list]:
    import pyarrow.parquet as pq

    return pq.read_table(out / "results.parquet").to_pydict()


def assert_reasons(out: Path, names: list[str]) -> None:
    with (out / "failures.csv").open(newline="") as file:
        failures = list(csv.DictReader(file))
    assert [row["record"] for row in failures] == names
    assert {row["result"] for row in failures} == {"refused"}
    assert all(row["record"] in row["message"] for row in failures)


def assert_truths(out: Path, names: list[str]) -> None:
    """Assert that each record has a result whose b and g agree with the truth within five standard errors."""
    answers = table(out)
    assert answers["record"] == names
    Rsc, Csc = np.transpose([list(skin_of(number).values()) for number in range(len(names))])
    for name, truth in (("g", 1.35e-9 / (2.7e-9 + Csc)), ("b", Rsc * (2.7e-9 + Csc))):
        off = (np.log(answers[name]) - np.log(truth)) / answers[f"{name}_log_sd"]
        assert np.abs(off).max() < 5.0


@pytest.mark.slow
def test_workers_are_killed_three_times(few: Study, tmp_path: Path):
    process = few.started(tmp_path, "--workers", "2")
    for turn in range(3):
        kill_a_worker(turn, process, process.pid)
    ended(process)
    few.assert_done_once(tmp_path)


@pytest.mark.slow
def test_everything_is_killed_and_goes_on(many: Study, tmp_path: Path):
    process = many.started(tmp_path, "--workers", "2")
    until(lambda: lines(tmp_path) >= 1, process)
    kill_tree(process.pid)
    process.wait()
    assert lines(tmp_path) < many.batches  # otherwise there would be nothing left to do
    ended(many.started(tmp_path, "--workers", "2"))
    many.assert_done_once(tmp_path)


@pytest.fixture
def port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def cluster(port: int) -> Iterator[subprocess.Popen[bytes]]:
    """Start a scheduler at that port, then two workers."""
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "start_new_session": True}
    dask = [sys.executable, "-m", "dask"]
    address = f"tcp://127.0.0.1:{port}"
    yield subprocess.Popen([*dask, "scheduler", "--port", str(port), "--host", "127.0.0.1", "--no-dashboard"], **quiet)
    for _ in range(2):
        yield subprocess.Popen([*dask, "worker", address, "--nthreads", "1", "--no-dashboard"], **quiet)


@pytest.mark.slow
def test_three_workers_and_the_scheduler_are_killed(many: Study, tmp_path: Path, port: int):
    running = list(cluster(port))
    try:
        process = many.started(tmp_path, "--scheduler", f"tcp://127.0.0.1:{port}")
        for turn in range(3):
            until(lambda turn=turn: lines(tmp_path) > turn, process)
            kill_a_worker(turn, process, *(each.pid for each in running[1:]))
        kill_tree(running[0].pid)
        assert lines(tmp_path) < many.batches
        running += list(cluster(port))
        ended(process)
    finally:
        for each in running:
            if each.poll() is None:
                kill_tree(each.pid)
            each.wait()
    many.assert_done_once(tmp_path)


def fill(size: float) -> None:
    """Make a worker allocate memory up to a total of `size` bytes, and keep it."""
    missing = int(size) - psutil.Process().memory_info().rss
    assert missing > 0
    sys.held = b"\1" * missing
    time.sleep(1.0)  # Dask checks ten times a second


@pytest.mark.slow
def test_a_worker_that_is_nearly_full_goes_on():
    with module._open_client(None, 1, "1 GiB", False, 0.0) as client:
        client.submit(fill, 0.88 * 2**30).result(timeout=60)  # Dask would pause the worker above 0.8
        assert client.submit(os.getpid).result(timeout=60) != os.getpid()


def test_compiled_code_is_dropped_once_it_is_much(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    dropped = []
    monkeypatch.setattr(module.jax, "clear_caches", lambda: dropped.append(1))
    task = Task(None, {}, None, 0, max_maps=10**9)
    assert [row["result"] for row in task.rows([str(tmp_path / "none.csv")])] == ["refused"]
    assert not dropped
    dataclasses.replace(task, max_maps=10).rows([str(tmp_path / "none.csv")])
    assert dropped


@pytest.mark.slow
@pytest.mark.parametrize("reports", [False, True], ids=["rows", "reports"])
def test_rows_of_posteriors_are_those_of_sample_many(reports: bool, tmp_path: Path):
    """The draws of a report are those of a record sampled alone, as they are here."""
    made = square_record(noise=0.1, per_period=500)
    path = tmp_path / "finger.csv"
    write_csv(path, fitact.Record.from_arrays(made.time, Vsc=made["Vsc"]))
    (tmp_path / "scene.toml").write_text(SCENE)
    scene = fitact.Scene.load(tmp_path / "scene.toml")
    task = Task(scene.to_json(), {}, str(tmp_path / "out") if reports else None, 3, posteriors=True)
    (row,) = task.rows([str(path)])
    (expected,) = fitact.sample_many([path], scene, seed=3, progress=False)
    place = row.pop("report", None)
    assert row == expected
    assert (tmp_path / str(place)).exists() == reports


def test_a_torn_line_is_dropped(tmp_path: Path):
    journal = Journal(tmp_path / JOURNAL)
    journal.add({"a": {"record": "a"}})
    journal.close()
    with (tmp_path / JOURNAL).open("a") as file:
        file.write('{"b": {"rec')  # an incomplete line, as after a kill
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
        return module._journal_keys([str(path)], task)[0]

    path.write_text("1")
    first = key()
    assert key() == first
    assert key(Task(None, {}, None, 1)) != first
    assert key(Task(None, {}, None, 0, posteriors=True)) != first
    assert key(Task(None, {"scale": {"V": 2.0}}, None, 0)) != first
    path.write_text("2")
    assert key() != first
    os.unlink(path)
    assert key() != first


@pytest.fixture
def fitted(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Replace the workers by rows made by hand, and return the paths that were fitted."""
    paths: list[str] = []

    def run(task: Task, batches: Any, journal: Journal, *_: object) -> None:
        for batch in batches:
            paths.extend(path for _, path in batch)
            failed = {"result": "refused", "trusted": False, "message": "no"}
            fitted = {"result": "successful", "trusted": True, "message": "yes", "samples": 9}
            rows = [{"record": Path(path).name} | (failed if "r2" in path else fitted) for _, path in batch]
            journal.add({key: row for (key, _), row in zip(batch, rows, strict=True)})

    monkeypatch.setattr(module, "_run_batches", run)
    return paths


def write_study(path: Path, rows: str, header: str = "record,person,age,side") -> fitact.Study:
    for name in ("r1.csv", "r2.csv"):
        (path.parent / name).write_text(name)
    path.write_text(f"{header}\n{rows}\n")
    return fitact.Study.from_table(path)


def test_a_study_adds_its_columns_and_a_changed_label_fits_nothing_again(fitted: list[str], tmp_path: Path):
    path = tmp_path / "study.csv"
    study = write_study(path, "r1.csv,P1,23,left\nr2.csv,P2,31,right")
    first = fitact.run_campaign(study, tmp_path / "out", progress=False)
    assert first[0] == {
        "record": "r1.csv", "person": "P1", "age": 23.0, "side": "left",
        "result": "successful", "trusted": True, "message": "yes", "samples": 9,
    }  # fmt: skip
    assert [(row["record"], row["person"], row["age"], row["side"]) for row in first.failures] == [
        ("r2.csv", "P2", 31.0, "right")
    ]
    assert list(first.columns)[:4] == ["record", "person", "age", "side"]
    assert [Path(name).name for name in fitted] == ["r1.csv", "r2.csv"]
    journal = (tmp_path / "out" / JOURNAL).read_bytes()
    study = write_study(path, "r1.csv,anna,23,left\nr2.csv,ben,32,right")
    second = fitact.run_campaign(study, tmp_path / "out", progress=False)
    assert [(row["person"], row["age"]) for row in second] == [("anna", 23.0), ("ben", 32.0)]
    assert len(fitted) == 2
    assert (tmp_path / "out" / JOURNAL).read_bytes() == journal
    plain = fitact.run_campaign(write_study(path, "r1.csv\nr2.csv", "record"), tmp_path / "out", progress=False)
    assert [list(row) for row in plain] == [["record", *list(first[0])[4:]], ["record", "result", "trusted", "message"]]


def test_a_covariate_with_the_name_of_a_result_is_refused(fitted: list[str], tmp_path: Path):
    study = write_study(tmp_path / "study.csv", "r1.csv,1\nr2.csv,2", "record,samples")
    with pytest.raises(fitact.InputError, match=r"study\.csv: samples is also a column of the results; rename it"):
        fitact.run_campaign(study, tmp_path / "out", progress=False)


def test_a_file_named_twice_is_refused(tmp_path: Path):
    with pytest.raises(fitact.InputError, match="twice"):
        fitact.run_campaign([tmp_path / "a.csv", tmp_path / "a.csv"], tmp_path)


@pytest.mark.slow
def test_a_scheduler_that_is_not_there_is_refused(tmp_path: Path, port: int):
    (tmp_path / "a.csv").write_text("1")
    with pytest.raises(fitact.InputError, match="cannot connect"):
        fitact.run_campaign([tmp_path / "a.csv"], tmp_path / "out", scheduler=f"tcp://127.0.0.1:{port}", progress=False)
