"""Fits of many records on many machines, with a journal, repeated batches, and isolation of records that crash workers.

Dask workers compute batches of records, and this process alone writes the results to the journal. A record is
therefore computed once, no matter how often a worker, the scheduler or this process is killed.
"""

import contextlib
import dataclasses
import hashlib
import importlib.metadata
import json
import logging
import os
import sys
import time
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax

from fitact.batch.fit_many import Fits, Row, failure_row, fit_many, list_sources, read_finger
from fitact.batch.sample_many import add_posterior, sample_many
from fitact.compiled import available_cores
from fitact.errors import InputError
from fitact.files import to_json
from fitact.fitting.fit import fit
from fitact.progress import track_progress
from fitact.readers.study import Study
from fitact.sampling.ensemble import sample
from fitact.scene.scene import Scene

if TYPE_CHECKING:
    from distributed import Client

BATCH = 32  # records in a task, which takes seconds; a lost batch is computed again as a whole
_ONE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
    "MALLOC_TRIM_THRESHOLD_": "65536",  # bytes; freed memory returns to the system
}
JOURNAL = "journal.jsonl"

Paths = str | tuple[str, ...]  # of a record, or of records that are fitted jointly
Batch = tuple[tuple[str, Paths], ...]  # (key of the journal, paths) of each row


@dataclasses.dataclass(frozen=True)
class Task:
    """Input of a worker in addition to the records."""

    scene: str | None  # scene as JSON; None means the device of the reference paper
    columns: dict[str, Any]  # `channels`, `scale`, `rate` and `segment` of files, as in `fitact.read`
    reports: str | None  # folder for a posterior and a report of each record, or None
    seed: int  # seed of the sampling
    posteriors: bool = False  # whether rows are made by `sample_many` instead of `fit_many`
    # number of memory maps above which compiled code is dropped; Linux allows a process 65,530 by default, a new length
    # of records needs some 600, and a batch has 32
    max_maps: int = 20_000

    @property
    def fingerprint(self) -> str:
        """Hash of everything that determines a result, except the record."""
        sampled = [bool(self.reports), self.posteriors, self.seed]
        settings = [importlib.metadata.version("fitact"), self.scene, self.columns, *sampled]
        return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()

    def rows(self, paths: Sequence[Paths]) -> list[Row]:
        """Compute the rows of a batch; runs on a worker."""
        scene = None if self.scene is None else Scene.from_json(self.scene)
        self._clear_large_caches()
        rows = [dict(row) for row in self._fit_or_sample(paths, scene)]
        for path, row in zip(paths, rows, strict=True):
            if row["result"] == "crashed":  # the machine may be the cause
                row |= self._fit_or_sample([path], scene)[0]
            if self.reports is not None and "samples" in row:
                self._clear_large_caches()
                row |= self._write_record_report(Path(self.reports), path, scene, row)
        return rows

    def _fit_or_sample(self, paths: Sequence[Paths], scene: Scene | None) -> Fits:
        if self.posteriors and self.reports is None:  # reports sample each record separately
            return sample_many(paths, scene, **self.columns, seed=self.seed, progress=False)
        return fit_many(paths, scene, **self.columns, progress=False)

    def _write_record_report(self, reports: Path, paths: Paths, scene: Scene | None, row: Row) -> Row:
        first, *others = list_sources(paths)
        place = reports / f"{Path(first).stem}-{hashlib.sha256(chr(0).join([first, *others]).encode()).hexdigest()[:8]}"
        fitted = fit(read_finger(paths, scene, self.columns), scene)
        posterior = sample(fitted, seed=self.seed, progress=False)
        posterior.to_netcdf(place / "posterior.nc")
        posterior.report(place / "report.html")
        row = add_posterior(row, posterior) if self.posteriors else row
        return row | {"report": f"{reports.name}/{place.name}/report.html", "trusted": posterior.trusted}

    def _clear_large_caches(self) -> None:
        """Drop code compiled by JAX if there is much of it, since JAX keeps the code for every kind of record."""
        maps = Path("/proc/self/maps")
        if maps.exists() and maps.read_bytes().count(b"\n") > self.max_maps:
            jax.clear_caches()


class Journal:
    """Rows by key, in an append-only file."""

    def __init__(self, path: Path) -> None:
        self.rows: dict[str, Row] = {}
        path.parent.mkdir(parents=True, exist_ok=True)
        size = 0  # bytes of complete lines; a killed run may leave an incomplete one
        if path.exists():
            with path.open("rb") as file:
                for line in file:
                    if not line.endswith(b"\n"):
                        break
                    self.rows |= json.loads(line)
                    size += len(line)
        self._file = path.open("ab")
        self._file.truncate(size)

    def add(self, rows: Mapping[str, Row]) -> None:
        """Add the rows of a batch and flush them to disk."""
        self.rows |= rows
        self._file.write(to_json(rows, indent=None).encode())
        self._file.flush()
        os.fsync(self._file.fileno())

    def close(self) -> None:
        self._file.close()


def run_campaign(
    records: Sequence[str | os.PathLike[str] | Sequence[str | os.PathLike[str]]] | Study,
    folder: str | os.PathLike[str],
    scene: Scene | None = None,
    *,
    channels: Mapping[str, str] | None = None,
    scale: Mapping[str, float] | None = None,
    rate: float | None = None,
    segment: int | None = None,
    scheduler: str | None = None,
    workers: int | None = None,
    memory: str = "2 GiB",
    posteriors: bool = False,
    reports: bool = False,
    seed: int = 0,
    progress: bool = True,
) -> Fits:
    """Fit many files on Dask workers, each once; the same call resumes an interrupted one.

    The journal (journal.jsonl) and the reports are written to `folder` during the work, and the table is returned. A
    record is done if its content, the settings and fitact's version agree with the journal. If a batch has killed four
    workers, it is split until the offending record is isolated; this record is reported as failed.

    Args:
        records: paths, which must be accessible to workers on other machines. Paths in a sequence are fitted jointly,
            as the records of one finger. The rows of a `Study` have its labels and covariates, too.
        folder: folder for the results.
        scene: scene of all records.
        channels, scale, rate, segment: channels, sampling rate and segment of the files, as in `fitact.read`.
        scheduler: address of a Dask scheduler; None starts workers on this machine.
        workers: number of these workers, with one thread each; None means one for each core.
        memory: memory limit of each of these workers, above which it is restarted.
        posteriors: whether to sample the posterior of each record, like `fitact.sample_many`.
        reports: whether to sample the posterior of each record separately and write its report.
        seed: seed of the sampling.
        progress: whether to report the progress on standard error.

    Raises:
        InputError: a file is named twice, Dask is not installed, the folder cannot be written, the scheduler cannot
            be reached, or a column of the study is also one of the results.
    """
    (scene or Scene()).require_available(fit=True)
    study = records if isinstance(records, Study) else None
    paths = [_make_absolute(each) for each in (records.records if isinstance(records, Study) else records)]
    for path, count in Counter(path for each in paths for path in list_sources(each)).most_common(1):
        if count > 1:
            raise InputError(f"{path}: is given twice; give each record once")
    out = Path(folder)
    columns = {"channels": dict(channels or {}), "scale": dict(scale or {}), "rate": rate, "segment": segment}
    stated = None if scene is None else scene.to_json()
    task = Task(stated, columns, str(out / "reports") if reports else None, seed, posteriors)
    try:
        journal = Journal(out / JOURNAL)
    except (OSError, ValueError) as error:
        raise InputError(f"{out / JOURNAL}: cannot be used ({error}); choose another folder") from error
    try:
        keys = _journal_keys(paths, task)
        batches = _pending_batches(keys, paths, journal)
        if batches:
            _run_batches(task, batches, journal, scheduler, workers, memory, progress)
    finally:
        journal.close()
    rows = tuple(journal.rows[key] for key in keys)
    return Fits(rows if study is None else _add_study(rows, study))


def _add_study(rows: Sequence[Row], study: Study) -> tuple[Row, ...]:
    """Return the rows with the labels and covariates of their records after the name.

    Raises:
        InputError: a covariate has the name of a result.
    """
    columns = study.columns
    for name in columns:
        if any(name in row for row in rows):
            raise InputError(
                f"{study.source}: {name} is also a column of the results; rename it, and run the campaign again, which"
                " keeps the finished records"
            )
    return tuple(
        {"record": row["record"]} | {name: column[number] for name, column in columns.items()} | row
        for number, row in enumerate(rows)
    )


def _make_absolute(given: str | os.PathLike[str] | Sequence[str | os.PathLike[str]]) -> Paths:
    if isinstance(given, (str, os.PathLike)):
        return os.path.abspath(given)
    return tuple(os.path.abspath(path) for path in given)


def _journal_keys(paths: Sequence[Paths], task: Task) -> list[str]:
    """Return the key of each row in the journal, a hash of settings, names and contents."""
    settings = task.fingerprint

    def digest(path: str) -> str:
        try:
            with open(path, "rb") as file:
                return hashlib.file_digest(file, "sha256").hexdigest()
        except OSError as error:
            return f"unreadable: {error}"

    def key(given: Paths) -> str:
        parts = [part for path in list_sources(given) for part in (path, digest(path))]
        return hashlib.sha256("\0".join([settings, *parts]).encode()).hexdigest()

    with ThreadPoolExecutor() as pool:
        return list(pool.map(key, paths))


def _pending_batches(keys: Sequence[str], paths: Sequence[Paths], journal: Journal) -> deque[Batch]:
    """Return the batches of pending records, identical after any interruption."""
    pairs = list(zip(keys, paths, strict=True))
    parts = (pairs[first : first + BATCH] for first in range(0, len(pairs), BATCH))
    batches = (tuple(pair for pair in part if pair[0] not in journal.rows) for part in parts)
    return deque(filter(None, batches))


def _run_batches(
    task: Task,
    batches: deque[Batch],
    journal: Journal,
    scheduler: str | None,
    workers: int | None,
    memory: str,
    progress: bool,
    patience: float = 60.0,
) -> None:
    """Run all batches; wait up to `patience` seconds for a lost scheduler."""
    total, known = sum(map(len, batches)), len(journal.rows)
    deadline = time.monotonic()  # how long to wait for a scheduler, which may return once it was reached
    while batches:
        with _open_client(scheduler, workers, memory, progress, deadline) as client:
            futures: dict[Any, Batch] = {}
            try:
                done = _completed_batches(client, task, batches, futures)
                if progress:
                    done = track_progress(done, "fitting the records", total, lambda: len(journal.rows) - known)
                for batch, rows in done:
                    journal.add({key: row for (key, _), row in zip(batch, rows, strict=True)})
                return
            except (CancelledError, OSError) as error:  # the scheduler and its state are lost
                if scheduler is None:
                    raise
                batches.extendleft(futures.values())
                deadline = time.monotonic() + patience
                if progress:
                    print(f"lost the scheduler at {scheduler} ({type(error).__name__}); waiting", file=sys.stderr)


def _completed_batches(
    client: "Client", task: Task, batches: deque[Batch], futures: dict[Any, Batch], per_worker: int = 3
) -> Iterator[tuple[Batch, list[Row]]]:
    """Yield finished batches, with `per_worker` batches in flight; split batches that kill their workers."""
    completed = _import_distributed().as_completed()

    def submit() -> None:
        workers = client.scheduler_info(n_workers=-1)["workers"]  # all workers of the scheduler
        for _ in range(min(per_worker * max(1, len(workers)) - len(futures), len(batches))):
            batch = batches.popleft()
            future = client.submit(task.rows, [path for _, path in batch], pure=False)
            futures[future] = batch
            completed.add(future)

    submit()
    for future in completed:
        batch, half = futures[future], len(futures[future]) // 2
        if future.cancelled():
            raise CancelledError
        error = future.exception()
        if error is None:
            yield batch, future.result()
        elif half:
            batches.extend((batch[:half], batch[half:]))
        else:
            yield batch, [_crash_row(batch[0][1], error)]
        del futures[future]
        future.release()
        submit()


def _crash_row(paths: Paths, error: BaseException) -> Row:
    if isinstance(error, _import_distributed().scheduler.KilledWorker):
        return failure_row(paths, error, f"killed {error.allowed_failures + 1} workers")
    return failure_row(paths, error)


def _import_distributed() -> Any:
    try:
        import distributed
    except ImportError as error:
        raise InputError("campaign: needs Dask; pip install 'fitact[campaign]'") from error
    return distributed


@contextlib.contextmanager
def _open_client(
    scheduler: str | None, workers: int | None, memory: str, progress: bool, deadline: float
) -> Iterator["Client"]:
    """Connect to the scheduler at this address, or start one with workers on this machine."""
    distributed = _import_distributed()
    if scheduler is not None:
        with _connect_scheduler(scheduler, deadline) as client:
            yield client
        return
    settings = {
        "distributed.nanny.pre-spawn-environ": _ONE_THREAD,
        "distributed.worker.multiprocessing-method": "spawn",
        "distributed.scheduler.allowed-failures": 3,  # workers that a batch may kill before it is split
        # compiled code cannot be spilled, so a worker that paused because of it would never resume
        **{f"distributed.worker.memory.{name}": False for name in ("target", "spill", "pause")},
        "distributed.admin.log-format": "",
    }
    count = workers or available_cores()
    with (
        distributed.dask.config.set(settings),
        distributed.LocalCluster(
            n_workers=count, threads_per_worker=1, memory_limit=memory.replace(" ", ""), silence_logs=logging.CRITICAL
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        if progress:
            print(f"{count} workers; Dask's dashboard: {cluster.dashboard_link}", file=sys.stderr)
        yield client


def _connect_scheduler(scheduler: str, deadline: float) -> "Client":
    while True:
        try:
            return _import_distributed().Client(scheduler, timeout="5s")
        except (OSError, TimeoutError, ValueError) as error:
            if time.monotonic() >= deadline:
                raise InputError(
                    f"--scheduler {scheduler}: cannot connect ({error}). Finished records are saved; run the same"
                    " command again to resume."
                ) from error
            time.sleep(1.0)
