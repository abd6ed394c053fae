"""Fits of many records, each by itself: alike ones together, a failure kept apart from the others."""

import collections
import contextlib
import csv
import dataclasses
import functools
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

import jax
import numpy as np
from threadpoolctl import threadpool_limits

from fitact.batch.gauss_newton import Settled, Together
from fitact.data.readers.read import read
from fitact.data.record import Record
from fitact.errors import InputError
from fitact.files import replacing
from fitact.fitting import derived
from fitact.fitting.fit import GOOD, Fit, fitted
from fitact.fitting.identifiability import directions, from_prior, verdicts
from fitact.fitting.problem import pose
from fitact.progress import watched
from fitact.scene.scene import Scene

_TOGETHER = 256  # records; so many are stacked, whatever their number, and compiled for once
_FEW = 16  # alike ones, below which fits by themselves take less than compiling
_AHEAD = 4  # jobs for each core, so that a record that is fitted by itself keeps none waiting
_TRIES = 4  # records from which to learn what a group shares, since the first may be an odd one
_MATCH = 0.01  # relative rms difference between V and the scene's drive
_UNTESTED = "The fit is at its optimum and leaves no more than noise; what it leaves was not tested for structure."
_FORCE = derived.NAMES.index("force_mean")

Input = Record | str | os.PathLike[str]


@dataclasses.dataclass(frozen=True)
class Fits(Sequence[dict[str, Any]]):
    """Fits of many records as a table: a row for each, in the order in which they were given.

    Attributes:
        rows: of each record: `record` (its name), `result` (a member of `RESULTS`, "refused" or "crashed"), `trusted`,
            `message`, and where there is an answer `samples`, `noise` (V or A), `chi2_reduced`, `rms_residual`,
            `verdict`, `force_from_prior`, `freed`, and of each parameter and derived quantity the median, by its name
            (SI), and the standard deviation of its logarithm, by name_log_sd.
    """

    rows: tuple[dict[str, Any], ...]

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: Any) -> Any:
        return self.rows[index]

    @property
    def failures(self) -> tuple[dict[str, Any], ...]:
        """The rows without an answer."""
        return tuple(row for row in self.rows if "samples" not in row)

    @property
    def answered(self) -> "Fits":
        """The rows with an answer."""
        return Fits(tuple(row for row in self.rows if "samples" in row))

    @property
    def columns(self) -> dict[str, np.ndarray]:
        """The table by columns; NaN, or "", where a row has no answer."""
        samples = {name: next(row[name] for row in self.rows if name in row) for name in self._names}
        blank = {name: "" if isinstance(sample, str) else np.nan for name, sample in samples.items()}
        return {name: np.array([row.get(name, blank[name]) for row in self.rows]) for name in samples}

    @property
    def _names(self) -> list[str]:
        """Of the columns: as in the fullest row, then what others have beside."""
        return list(dict.fromkeys(name for row in sorted(self.rows, key=len, reverse=True) for name in row))

    def to_csv(self, path: str | os.PathLike[str], columns: Sequence[str] | None = None) -> None:
        """Write the table, or some of its columns, as CSV; empty where there is no answer.

        Raises:
            InputError: the place cannot be written.
        """
        with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(columns or self._names), extrasaction="ignore")
            writer.writeheader()
            writer.writerows(self.rows)

    def to_parquet(self, path: str | os.PathLike[str]) -> None:
        """Write the table as Parquet; needs `pip install 'fitact[campaign]'`.

        Raises:
            InputError: the place cannot be written, or pyarrow is not installed.
        """
        try:
            import pyarrow as pa
            import pyarrow.parquet as pq
        except ImportError as error:
            raise InputError(f"{path}: Parquet needs pyarrow; pip install 'fitact[campaign]', or write CSV") from error
        with replacing(path) as temporary:
            pq.write_table(pa.table({name: [row.get(name) for row in self.rows] for name in self._names}), temporary)

    def __str__(self) -> str:
        trusted = sum(bool(row["trusted"]) for row in self.rows)
        text = f"{len(self)} records: {trusted} answers to be trusted, {len(self) - len(self.failures) - trusted} not"
        return "\n".join([f"{text}, {len(self.failures)} without", *(row["message"] for row in self.failures)])


def fit_many(
    records: Iterable[Input],
    scene: Scene | None = None,
    *,
    channels: Mapping[str, str] | None = None,
    scale: Mapping[str, float] | None = None,
    whiteness: bool = True,
    progress: bool = True,
) -> Fits:
    """Fit each of many records by itself, as `fitact.fit` does, in one go.

    Records of Vsc on one time grid, under a drive that the scene names, are fitted together, which takes a hundredth
    of the time; those of them that are in any way doubtful, and all others, one after the other. A record that is
    refused or fails leaves the others alone; its row says why.

    Args:
        records: records, or the paths of files; taken one after the other.
        scene: of all of them.
        channels, scale: of files, as in `fitact.read`.
        whiteness: test the residuals of records that are fitted together for structure. Otherwise such a record is
            trusted where they are no larger than its noise, and its `message` says that no more was tested.
        progress: report on standard error.

    Raises:
        InputError: the scene asks for what is not available.
    """
    how = functools.partial(_rows, scene=scene, whiteness=whiteness)
    return tabulated(
        records, scene, {"channels": channels, "scale": scale}, how, "fitting the records" if progress else ""
    )


def tabulated(
    records: Iterable[Input],
    scene: Scene | None,
    columns: Mapping[str, Any],
    rows_of: Callable[[Iterable["Batch"]], Iterator[tuple[int, "Row"]]],
    doing: str,
) -> Fits:
    """The rows that batches of records give, by their numbers, and those of what cannot be read.

    `columns` as in `fitact.read`; what is under way is told as `doing`, if anything.
    """
    (scene or Scene()).require_available(fit=True)
    rows: dict[int, Row] = {}
    total = len(records) if isinstance(records, Sequence) else 0
    with jax.enable_x64(True), _LINEAR_ALGEBRA.in_one_thread():
        done = rows_of(_batches(_opened(records, scene, columns, rows), scene))
        for number, row in watched(done, doing, total) if doing and total else done:
            rows[number] = row
    return Fits(tuple(rows[number] for number in sorted(rows)))


def _rows(found: Iterable["Batch"], scene: Scene | None, whiteness: bool) -> Iterator[tuple[int, "Row"]]:
    for (_, members), (settled, _) in in_threads(found, functools.partial(settle, whiteness=whiteness)):
        for number, record in members:
            yield number, settled[number] if number in settled else _alone(record, scene)


class _Threads:
    """Those of the linear algebra, which would fight with those of `in_threads` for the cores."""

    def __init__(self) -> None:
        self._lock, self._users = threading.Lock(), 0

    @contextlib.contextmanager
    def in_one_thread(self) -> Iterator[None]:
        """The limit holds for the whole process: until the last of several calls at once has ended."""
        with self._lock:
            self._users += 1
            if self._users == 1:
                self._limits = threadpool_limits(1)
        try:
            yield
        finally:
            with self._lock:
                self._users -= 1
                if self._users == 0:
                    self._limits.restore_original_limits()


_LINEAR_ALGEBRA = _Threads()

Row = dict[str, Any]
Member = tuple[int, Record]
Batch = tuple[Together | None, list[Member]]


_Job = TypeVar("_Job")
_Done = TypeVar("_Done")


def _opened(
    records: Iterable[Input], scene: Scene | None, columns: Mapping[str, Any], rows: dict[int, Row]
) -> Iterator[Member]:
    """Records by their number; those that cannot be read become rows."""
    for number, given in enumerate(records):
        try:
            yield number, given if isinstance(given, Record) else read(given, scene, **columns)
        except Exception as error:
            rows[number] = failed(str(given), error)


def in_threads(jobs: Iterable[_Job], work: Callable[[_Job], _Done]) -> Iterator[tuple[_Job, _Done]]:
    """Jobs and what `work` makes of them, some ahead for each core. In double precision."""
    asked = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0]
    cores = int(asked) if asked.isdigit() else len(os.sched_getaffinity(0))
    under_way: collections.deque[tuple[_Job, Future[_Done]]] = collections.deque()

    def done(job: _Job) -> _Done:
        with jax.enable_x64(True):  # of each thread
            return work(job)

    with ThreadPoolExecutor(cores) as pool:
        for job in jobs:
            under_way.append((job, pool.submit(done, job)))
            if len(under_way) > _AHEAD * cores:
                first, result = under_way.popleft()
                yield first, result.result()
        yield from ((job, result.result()) for job, result in under_way)


class _Group:
    """Records of one time grid that wait for each other."""

    def __init__(self, time: np.ndarray) -> None:
        self.time, self.members, self.tries = time, list[Member](), 0
        self.together: Together | None = None
        self.voltage: np.ndarray | None = None

    def alike(self, scene: Scene | None) -> bool:
        """Whether they can be fitted together; learnt from some of them."""
        if len(self.members) < _FEW:
            return False
        for _, record in self.members[: _TRIES - self.tries]:
            if self.together is not None:
                break
            self.tries += 1
            try:
                problem = pose([record], [scene])
                self.together, self.voltage = Together.like(problem), problem.sources[0].choice.voltage
            except (InputError, np.linalg.LinAlgError):
                continue
        return self.together is not None


def _batches(records: Iterable[Member], scene: Scene | None) -> Iterator[Batch]:
    """Records to be fitted together, or each by itself."""
    groups: dict[tuple[float, ...], _Group] = {}
    for number, record in records:
        time = record.time
        key = time.size, time[0], time[1], time[-1]
        group = groups[key] = groups.get(key) or _Group(time)
        if time is not group.time and not np.array_equal(time, group.time):
            yield None, [(number, record)]
            continue
        group.members.append((number, record))
        if len(group.members) == _TOGETHER:
            yield from _sorted_out(group, scene)
    for group in groups.values():
        yield from _sorted_out(group, scene)


def _sorted_out(group: _Group, scene: Scene | None) -> Iterator[Batch]:
    if group.alike(scene):
        assert group.voltage is not None
        near = [member for member in group.members if _driven_alike(member[1], group.voltage)]
        yield group.together, near
        taken = {number for number, _ in near}
        group.members = [member for member in group.members if member[0] not in taken]
    yield None, group.members
    group.members = []


def _driven_alike(record: Record, voltage: np.ndarray) -> bool:
    """Whether the record has no V, or the scene's."""
    if "Vsc" not in record:
        return False
    if "V" not in record:
        return True
    off = record["V"] - voltage
    return bool(off @ off <= _MATCH**2 * (voltage @ voltage))


def settle(batch: Batch, whiteness: bool = True) -> tuple[dict[int, Row], Settled | None]:
    """Rows of those that are beyond doubt, and the optima of all; `whiteness` as of `fit_many`."""
    together, members = batch
    if together is None or not members:
        return {}, None
    padded = [*members, *members[-1:] * (_TOGETHER - len(members))]
    try:
        found = together.settle([record["Vsc"] for _, record in padded], whiteness)
        columns = {"record": [os.path.basename(record.source) for _, record in padded]}
        columns |= _columns(together, found, GOOD if whiteness else _UNTESTED)
    except np.linalg.LinAlgError:  # one of them spoils what is computed for all
        return {}, None
    rows = (dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True))
    # the others fill up
    return {number: row for (number, _), row, clear in zip(members, rows, found.clear, strict=False) if clear}, found


def _columns(together: Together, found: Settled, message: str) -> dict[str, list[Any]]:
    likelihood, count = together.likelihood, len(found.theta)
    free = likelihood.names
    force = found.gradients[:, _FORCE]
    shares, _, along = directions(free, found.root, together.prior_root, free)
    table: dict[str, Any] = {
        "result": ["successful"] * count,
        "trusted": [True] * count,
        "message": [message] * count,
        "samples": [together.samples] * count,
        "noise": found.sigma,
        "chi2_reduced": found.figures["chi2_reduced"],
        "rms_residual": found.figures["rms_residual"],
        "verdict": verdicts(shares, along),
        "force_from_prior": from_prior(found.root, together.prior_root, force),
        "freed": [""] * count,
    }
    spread = np.linalg.norm(found.root, axis=2)
    sd = np.linalg.norm(found.gradients @ found.root, axis=2)
    table |= _values(free, np.exp(found.theta).T, spread.T) | _values(derived.NAMES, np.exp(found.logs).T, sd.T)
    return {name: values.tolist() if isinstance(values, np.ndarray) else values for name, values in table.items()}


def _values(names: Sequence[str], medians: np.ndarray, log_sds: np.ndarray) -> dict[str, Any]:
    return {
        key: value
        for name, median, sd in zip(names, medians, log_sds, strict=True)
        for key, value in ((name, median), (f"{name}_log_sd", sd))
    }


def _alone(record: Record, scene: Scene | None) -> Row:
    """The row of a record that is fitted by itself."""
    try:
        return row_of(fitted(record, scene, remedies=False))
    except Exception as error:
        return failed(record.source, error)


def row_of(found: Fit) -> Row:
    """Of a fit."""
    of_circuit = found.identifiability.blind_direction
    free = [i for i, name in enumerate(found.names) if name in of_circuit]
    logs, gradients = found.derive.logs(found.theta, np.array([trace.sigma for trace in found.traces]))
    row = {
        "record": os.path.basename(found.record.source),
        "result": found.result,
        "trusted": found.trusted,
        "message": found.message,
        "samples": int(found.figures["samples"]),
        "noise": found.sigma,
        "chi2_reduced": found.figures["chi2_reduced"],
        "rms_residual": found.figures["rms_residual"],
        "verdict": found.identifiability.verdict,
        "force_from_prior": found.identifiability.force_from_prior,
        "freed": ", ".join(found.model()["freed"]),
    }
    row |= _values([found.names[i] for i in free], np.exp(found.theta[free]), found.sd[free])
    row |= _values(derived.NAMES, np.exp(logs), np.linalg.norm(gradients @ found.covariance_root, axis=1))
    return {name: value.item() if isinstance(value, np.generic) else value for name, value in row.items()}


def failed(source: str, error: Exception) -> Row:
    """The row of a record without an answer."""
    refused = isinstance(error, InputError)
    message = str(error) if refused else f"{source}: {type(error).__name__}: {error}"
    result = "refused" if refused else "crashed"
    return {"record": os.path.basename(source), "result": result, "trusted": False, "message": message}
