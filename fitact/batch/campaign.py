"""Many records on many machines: a journal that loses nothing, batches that come back, poisoned records set aside.

The work is done by Dask's workers, in batches; what they give back is written by this process alone, a line for each
batch, so that a record is done once however often a worker, the scheduler or this process is killed.
"""

import contextlib
import dataclasses
import hashlib
import importlib.metadata
import json
import os
import sys
import time
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax

from fitact.batch.fit_many import Fits, fit_many
from fitact.errors import InputError
from fitact.files import to_line
from fitact.scene.scene import Scene

if TYPE_CHECKING:
    from distributed import Client

BATCH = 32  # records in a task, which take seconds; a batch is the least that is done again
_AHEAD = 3  # batches for each worker that the scheduler knows of
_KILLS = 3  # workers that a batch may lose before it is taken apart
_PATIENCE = 60.0  # s to wait for a scheduler that is gone
_SAY = 5.0  # s between lines of progress
_ONE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
    "MALLOC_TRIM_THRESHOLD_": "65536",  # bytes: what is freed goes back to the machine
}
# of the 65,530 areas of memory that Linux grants a process by default; a new length takes some 600, and a batch has 32
_MOST_MAPS = 20_000
JOURNAL = "journal.jsonl"

Row = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Task:
    """What a worker needs beside the records.

    Attributes:
        scene: as JSON; None: the paper's device.
        columns: `channels` and `scale` of files, as in `fitact.read`.
        reports: folder for a sampled posterior and a report of each record; None: none.
        seed: of the sampling.
        posteriors: whether rows are those of `sample_many`, or of `fit_many`.
    """

    scene: str | None
    columns: dict[str, Any]
    reports: str | None
    seed: int
    posteriors: bool = False

    @property
    def fingerprint(self) -> str:
        """What, beside a record, an answer depends on."""
        sampled = [bool(self.reports), self.posteriors, self.seed]
        settings = [importlib.metadata.version("fitact"), self.scene, self.columns, *sampled]
        return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()

    def rows(self, paths: Sequence[str]) -> list[Row]:
        """The rows of a batch; runs on a worker."""
        scene = None if self.scene is None else Scene.from_json(self.scene)
        _make_room()
        found = [dict(row) for row in self._table(paths, scene)]
        for path, row in zip(paths, found, strict=True):
            if row["result"] == "crashed":  # it may have been the machine
                row |= self._table([path], scene)[0]
            if self.reports is not None and "samples" in row:
                _make_room()
                row |= self._reported(path, scene, row)
        return found

    def _table(self, paths: Sequence[str], scene: Scene | None) -> Fits:
        from fitact.batch.sample_many import sample_many

        if self.posteriors and self.reports is None:  # reports sample each by itself
            return sample_many(paths, scene, **self.columns, seed=self.seed, progress=False)
        return fit_many(paths, scene, **self.columns, progress=False)

    def _reported(self, path: str, scene: Scene | None, row: Row) -> Row:
        from fitact.batch.sample_many import with_posterior
        from fitact.data.readers.read import read
        from fitact.fitting.fit import fit
        from fitact.sampling.ensemble import sample

        assert self.reports is not None
        place = Path(self.reports) / f"{Path(path).stem}-{hashlib.sha256(path.encode()).hexdigest()[:8]}"
        posterior = sample(fit(read(path, scene, **self.columns), scene), seed=self.seed, progress=False)
        posterior.to_netcdf(place / "posterior.nc")
        posterior.report(place / "report.html")
        told = with_posterior(row, posterior) if self.posteriors else row
        return told | {"report": f"{place.parent.name}/{place.name}/report.html", "trusted": posterior.trusted}


def _make_room() -> None:
    """Drop what JAX compiled once it is much: it compiles anew for every kind of record, and keeps it all."""
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > _MOST_MAPS:
        jax.clear_caches()


class Journal:
    """Rows by their key, in a file to which lines are only added."""

    def __init__(self, path: Path) -> None:
        self.rows: dict[str, Row] = {}
        path.parent.mkdir(parents=True, exist_ok=True)
        whole = 0  # bytes of whole lines: a kill may have left part of one
        if path.exists():
            with path.open("rb") as file:
                for line in file:
                    if not line.endswith(b"\n"):
                        break
                    self.rows |= json.loads(line)
                    whole += len(line)
        self._file = path.open("ab")
        self._file.truncate(whole)

    def add(self, rows: Mapping[str, Row]) -> None:
        """Rows of a batch, which are on disk when this returns."""
        self.rows |= rows
        self._file.write(to_line(rows).encode())
        self._file.flush()
        os.fsync(self._file.fileno())

    def close(self) -> None:
        self._file.close()


@dataclasses.dataclass(frozen=True)
class _Batch:
    keys: tuple[str, ...]
    paths: tuple[str, ...]

    def halves(self) -> "tuple[_Batch, ...]":
        middle = len(self.keys) // 2
        return tuple(_Batch(self.keys[part], self.paths[part]) for part in (slice(0, middle), slice(middle, None)))


def run_campaign(
    records: Sequence[str | os.PathLike[str]],
    folder: str | os.PathLike[str],
    scene: Scene | None = None,
    *,
    channels: Mapping[str, str] | None = None,
    scale: Mapping[str, float] | None = None,
    scheduler: str | None = None,
    workers: int | None = None,
    memory: str = "2 GiB",
    posteriors: bool = False,
    reports: bool = False,
    seed: int = 0,
    progress: bool = True,
) -> Fits:
    """Fit many files on Dask's workers, each once; the same call goes on where an interrupted one stopped.

    Into `folder` go journal.jsonl and the reports as the work proceeds; the tables are what comes back. A record counts
    as done when its content, the settings and fitact's version are those of the journal. A batch whose workers die is
    taken apart until the record that kills them is known, which is then set aside.

    Args:
        records: paths, which workers on other machines must see, too.
        folder: for the results.
        scene: of all of them.
        channels, scale: of files, as in `fitact.read`.
        scheduler: address of a Dask scheduler; absent: workers of this machine.
        workers: how many of these, of one thread each; absent: one for each core.
        memory: what each of these may take before it is started anew.
        posteriors: sample the posterior of each, as `fitact.sample_many` does.
        reports: sample the posterior of each by itself, and write its report.
        seed: of the sampling.
        progress: report on standard error.

    Raises:
        InputError: a file is named twice, Dask is not installed, the folder cannot be written, or the scheduler is
            not there.
    """
    (scene or Scene()).require_available(fit=True)
    paths = [os.path.abspath(path) for path in records]
    most = Counter(paths).most_common(1)
    if most and most[0][1] > 1:
        raise InputError(f"{most[0][0]}: is named twice; name each record once")
    place = Path(folder)
    columns = {"channels": dict(channels or {}), "scale": dict(scale or {})}
    stated = None if scene is None else scene.to_json()
    task = Task(stated, columns, str(place / "reports") if reports else None, seed, posteriors)
    try:
        journal = Journal(place / JOURNAL)
    except (OSError, ValueError) as error:
        raise InputError(f"{place / JOURNAL}: cannot be used ({error}); choose another folder") from error
    try:
        keys = _keys(paths, task)
        batches = _left(keys, paths, journal)
        if batches:
            _run(task, batches, journal, scheduler, workers, memory, _Progress(len(paths), progress))
    finally:
        journal.close()
    return Fits(tuple(journal.rows[key] for key in keys))


def _keys(paths: Sequence[str], task: Task) -> list[str]:
    """What a row is kept under: settings, name and content."""
    settings = task.fingerprint

    def key(path: str) -> str:
        try:
            with open(path, "rb") as file:
                content = hashlib.file_digest(file, "sha256").hexdigest()
        except OSError as error:
            content = f"unreadable: {error}"
        return hashlib.sha256("\0".join([settings, path, content]).encode()).hexdigest()

    with ThreadPoolExecutor() as pool:
        return list(pool.map(key, paths))


def _left(keys: Sequence[str], paths: Sequence[str], journal: Journal) -> deque[_Batch]:
    """Batches of what is not done: always the same ones, whatever was interrupted."""
    batches: deque[_Batch] = deque()
    for first in range(0, len(keys), BATCH):
        pairs = zip(keys[first : first + BATCH], paths[first : first + BATCH], strict=True)
        left = [(key, path) for key, path in pairs if key not in journal.rows]
        if left:
            batches.append(_Batch(*zip(*left, strict=True)))
    return batches


def _run(
    task: Task,
    batches: deque[_Batch],
    journal: Journal,
    scheduler: str | None,
    workers: int | None,
    memory: str,
    progress: "_Progress",
) -> None:
    progress.done = progress.total - sum(len(batch.keys) for batch in batches)
    deadline = time.monotonic()  # until which a scheduler is waited for: one that was there may come back
    while batches:
        with _connected(scheduler, workers, memory, progress, deadline) as client:
            under_way: dict[Any, _Batch] = {}
            try:
                for batch, rows in _answers(client, task, batches, under_way):
                    journal.add(dict(zip(batch.keys, rows, strict=True)))
                    progress.add(rows)
                return
            except (CancelledError, OSError) as error:  # the scheduler is gone, and with it what it knew
                if scheduler is None:
                    raise
                batches.extendleft(under_way.values())
                deadline = time.monotonic() + _PATIENCE
                progress.say(f"the scheduler at {scheduler} is gone ({type(error).__name__}); waiting for it")


def _answers(
    client: "Client", task: Task, batches: deque[_Batch], under_way: dict[Any, _Batch]
) -> Iterator[tuple[_Batch, list[Row]]]:
    """Batches as they are done; those that kill their workers are taken apart."""
    from distributed import as_completed
    from distributed.scheduler import KilledWorker

    done = as_completed()

    def submit() -> None:
        room = _AHEAD * max(1, len(client.scheduler_info(n_workers=-1)["workers"])) - len(under_way)
        for _ in range(min(room, len(batches))):
            batch = batches.popleft()
            future = client.submit(task.rows, list(batch.paths), pure=False)
            under_way[future] = batch
            done.add(future)

    submit()
    for future in done:
        batch = under_way[future]
        if future.cancelled():
            raise CancelledError
        error = future.exception()
        if error is None:
            yield batch, future.result()
        elif len(batch.keys) > 1:
            batches.extend(batch.halves())
        else:
            killed = isinstance(error, KilledWorker)
            why = f"killed the {_KILLS + 1} workers that tried it" if killed else f"{type(error).__name__}: {error}"
            name = os.path.basename(batch.paths[0])
            message = f"{batch.paths[0]}: {why}"
            yield batch, [{"record": name, "result": "crashed", "trusted": False, "message": message}]
        del under_way[future]
        future.release()
        submit()


@contextlib.contextmanager
def _connected(
    scheduler: str | None, workers: int | None, memory: str, progress: "_Progress", deadline: float
) -> Iterator["Client"]:
    """A client of the scheduler at that address, or of one with workers of its own."""
    try:
        import dask
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise InputError("campaign: needs Dask; pip install 'fitact[campaign]'") from error
    if scheduler is not None:
        with _client(scheduler, deadline) as client:
            yield client
        return
    settings = {
        "distributed.nanny.pre-spawn-environ": _ONE_THREAD,
        "distributed.worker.multiprocessing-method": "spawn",
        "distributed.scheduler.allowed-failures": _KILLS,
        # compiled code cannot be spilled: a worker that paused for it would wait for ever
        **{f"distributed.worker.memory.{name}": False for name in ("target", "spill", "pause")},
        "distributed.admin.log-format": "",
    }
    count = workers or len(os.sched_getaffinity(0))
    how: dict[str, Any] = {"n_workers": count, "threads_per_worker": 1, "memory_limit": memory.replace(" ", "")}
    with dask.config.set(settings), LocalCluster(**how, silence_logs=50) as cluster, Client(cluster) as client:
        progress.say(f"{count} workers of at most {memory} each; Dask's dashboard: {cluster.dashboard_link}")
        yield client


def _client(scheduler: str, deadline: float) -> "Client":
    """Of a scheduler, for which it waits until the deadline."""
    from distributed import Client

    while True:
        try:
            return Client(scheduler, timeout="5s")
        except (OSError, TimeoutError, ValueError) as error:
            if time.monotonic() >= deadline:
                raise InputError(
                    f"--scheduler {scheduler}: is not to be reached ({error}); what is done is kept, and the same"
                    " command goes on"
                ) from error
            time.sleep(1.0)


class _Progress:
    """How many records are done and failed, how fast, and for how long still; on standard error."""

    def __init__(self, total: int, on: bool) -> None:
        self.total, self.done, self.failed = total, 0, 0
        self._on, self._here, self._since, self._next = on, 0, 0.0, 0.0

    def say(self, text: str) -> None:
        if self._on:
            print(f"campaign: {text}", file=sys.stderr, flush=True)

    def add(self, rows: Sequence[Row]) -> None:
        """Count rows, and tell now and then."""
        self.done += len(rows)
        self.failed += sum("samples" not in row for row in rows)
        now = time.monotonic()
        if not self._since:  # before the first, workers start and compile
            self._since = now
        else:
            self._here += len(rows)
        if now < self._next and self.done < self.total:
            return
        self._next = now + _SAY
        text = f"{self.done:,} of {self.total:,} done, {self.failed:,} failed"
        if self._here:
            rate = self._here / max(now - self._since, 1e-3)
            text += f", {rate:.3g}/s, {(self.total - self.done) / rate:.0f} s left"
        self.say(text)
