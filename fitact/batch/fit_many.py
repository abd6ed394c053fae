"""Separate fits of many records, in batches of similar records; a failure does not affect other records."""

import collections
import csv
import dataclasses
import functools
import itertools
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np

from fitact.batch.batch_problem import BatchFit, BatchProblem, split_rows
from fitact.batch.recorded_drive import RecordedDriveProblem
from fitact.batch.stated_drive import StatedDriveProblem
from fitact.blas import limit_to_one_thread
from fitact.compiled import available_cores, double_precision
from fitact.data.record import Record
from fitact.data.spectrum import Spectrum
from fitact.errors import InputError
from fitact.files import atomic_write, write_parquet
from fitact.fitting import derived
from fitact.fitting.fit import fit
from fitact.fitting.identifiability import information_directions, prior_variance_fraction, verdicts
from fitact.fitting.outcome import RESULTS
from fitact.fitting.result import Fit
from fitact.model.skin import circuit_parameters
from fitact.problem.build import build_problem
from fitact.progress import track_progress
from fitact.readers.read import read_any
from fitact.scene.scene import Scene

_GROUP_RECORDS = 256  # records that are collected for batches
_SINGLE_RECORDS = 8  # records of a job in which each is fitted separately
_UNTESTED_MESSAGE = (
    "The fit converged, and the residuals are no larger than the noise; they were not tested for structure."
)
_FIT_COLUMNS = (
    *("result", "trusted", "message", "samples", "noise", "chi2_reduced", "rms_residual", "verdict"),
    *("force_from_prior", "freed"),
)

_Item = Record | Spectrum | str | os.PathLike[str]
Input = _Item | Sequence[_Item]  # a sequence is fitted jointly
Finger = Record | Spectrum | tuple[Record | Spectrum, ...]
Row = dict[str, Any]
Member = tuple[int, Any]  # number, and what `fit` takes of a finger: a record in a batch
Batch = tuple[BatchProblem | None, list[Member]]
_Job = TypeVar("_Job")
_Done = TypeVar("_Done")


@dataclasses.dataclass(frozen=True)
class Fits(Sequence[Row]):
    """Table of the fits of many records, with one row for each record in the given order.

    Attributes:
        rows: one dictionary for each record: `record` (its name), `result` (a member of `RESULTS`, "refused" or
            "crashed"), `trusted` and `message`. Successful fits add `samples`, `noise` (V or A), `chi2_reduced`,
            `rms_residual`, `verdict`, `force_from_prior`, `freed`, and the median (SI) of each parameter and derived
            quantity by its name, with the standard deviation of its logarithm by name_log_sd.
    """

    rows: tuple[Row, ...]

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: Any) -> Any:
        return self.rows[index]

    @property
    def failures(self) -> tuple[Row, ...]:
        """Rows of records without a result."""
        return tuple(row for row in self.rows if "samples" not in row)

    @property
    def results(self) -> "Fits":
        """Rows of records with a result."""
        return Fits(tuple(row for row in self.rows if "samples" in row))

    @property
    def columns(self) -> dict[str, np.ndarray]:
        """Columns of the table; NaN, or "", for rows without a result."""
        samples = {name: next(row[name] for row in self.rows if name in row) for name in self._column_names}
        blank = {name: "" if isinstance(sample, str) else np.nan for name, sample in samples.items()}
        return {name: np.array([row.get(name, blank[name]) for row in self.rows]) for name in samples}

    @property
    def _column_names(self) -> list[str]:
        """Names of the columns: the keys of the longest row, then additional keys of other rows."""
        return list(dict.fromkeys(name for row in sorted(self.rows, key=len, reverse=True) for name in row))

    def to_csv(self, path: str | os.PathLike[str], columns: Sequence[str] | None = None) -> None:
        """Write the table, or some of its columns, as CSV; cells without a result are empty.

        Raises:
            InputError: the path cannot be written.
        """
        with atomic_write(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(columns or self._column_names), extrasaction="ignore")
            writer.writeheader()
            writer.writerows(self.rows)

    def to_parquet(self, path: str | os.PathLike[str]) -> None:
        """Write the table as Parquet; needs `pip install 'fitact[campaign]'`.

        Raises:
            InputError: the path cannot be written, or pyarrow is not installed.
        """
        write_parquet(path, {name: [row.get(name) for row in self.rows] for name in self._column_names})

    def __str__(self) -> str:
        trusted = sum(bool(row["trusted"]) for row in self.rows)
        text = f"{len(self)} records: {trusted} reliable fits, {len(self) - len(self.failures) - trusted} unreliable"
        return "\n".join([f"{text}, {len(self.failures)} failed", *(row["message"] for row in self.failures)])


def fit_many(
    records: Iterable[Input],
    scene: Scene | None = None,
    *,
    channels: Mapping[str, str] | None = None,
    scale: Mapping[str, float] | None = None,
    rate: float | None = None,
    segment: int | None = None,
    whiteness: bool = True,
    progress: bool = True,
) -> Fits:
    """Fit each of many records separately, like `fitact.fit`.

    Records of Vsc on a common time grid, with the drive of the scene or with recorded drives, are fitted in batches,
    which takes a hundredth of the time. Doubtful ones among them, and all other records, are fitted one by one. A
    record that is refused or fails does not affect the others, and its row states the reason.

    Args:
        records: records, spectra, or paths of files; consumed one by one. A sequence of them is fitted jointly, as the
            records of one finger.
        scene: scene of all records.
        channels, scale, rate, segment: channels, sampling rate and segment of the files, as in `fitact.read`.
        whiteness: whether to test the residuals of batches for structure. Without this test, a record is trusted if
            its residuals are no larger than its noise, and its `message` mentions the missing test.
        progress: whether to report the progress on standard error.

    Raises:
        InputError: the scene requests an unsupported option.
    """
    make_rows = functools.partial(_fit_rows, scene=scene, whiteness=whiteness)
    title = "fitting the records" if progress else ""
    columns = {"channels": channels, "scale": scale, "rate": rate, "segment": segment}
    return tabulate_records(records, scene, columns, make_rows, title)


def tabulate_records(
    records: Iterable[Input],
    scene: Scene | None,
    columns: Mapping[str, Any],
    make_rows: Callable[[Iterable[Batch]], Iterator[tuple[int, Row]]],
    progress_title: str,
) -> Fits:
    """Collect the rows of batches and of files that cannot be read; `columns` as in `read`."""
    (scene or Scene()).require_available(fit=True)
    rows: dict[int, Row] = {}
    total = len(records) if isinstance(records, Sequence) else 0
    with double_precision(), limit_to_one_thread():
        numbered_rows = make_rows(_group_records(_read_records(records, scene, columns, rows), scene))
        if progress_title and total:
            numbered_rows = track_progress(numbered_rows, progress_title, total)
        rows.update(numbered_rows)
    return Fits(tuple(rows[number] for number in sorted(rows)))


def _fit_rows(batches: Iterable[Batch], scene: Scene | None, whiteness: bool) -> Iterator[tuple[int, Row]]:
    def fit_members(batch: Batch) -> dict[int, Row]:
        rows, _ = fit_batch(batch, whiteness)
        return {number: rows.get(number) or _fit_single(record, scene) for number, record in batch[1]}

    for _, rows in run_in_threads(batches, fit_members):
        yield from rows.items()


def _read_records(
    records: Iterable[Input], scene: Scene | None, columns: Mapping[str, Any], rows: dict[int, Row]
) -> Iterator[Member]:
    """Yield numbered records; add failure rows for files that cannot be read."""
    for number, record in enumerate(records):
        try:
            yield number, read_finger(record, scene, columns)
        except Exception as error:
            rows[number] = failure_row(record, error)


def read_finger(given: Input, scene: Scene | None, columns: Mapping[str, Any]) -> Finger:
    """Return what `fit` takes of one finger; `columns` as in `read`."""
    if isinstance(given, (Record, Spectrum)):
        return given
    if isinstance(given, (str, os.PathLike)):
        return read_any(given, scene, **columns)
    return tuple(each if isinstance(each, (Record, Spectrum)) else read_any(each, scene, **columns) for each in given)


def run_in_threads(
    jobs: Iterable[_Job], work: Callable[[_Job], _Done], jobs_per_core: int = 4, max_cores: int = 8
) -> Iterator[tuple[_Job, _Done]]:
    """Yield each job with the result of `work`, computed in double precision.

    `jobs_per_core` jobs are in flight for each core, so that a record that is fitted separately delays no others. More
    than `max_cores` would wait for Python's lock: on 16 cores, 8 threads fit 8,900 records per second, 16 7,800.
    """
    requested = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0]
    cores = int(requested) if requested.isdigit() else min(available_cores(), max_cores)
    under_way: collections.deque[tuple[_Job, Future[_Done]]] = collections.deque()

    def run_job(job: _Job) -> _Done:
        with double_precision():  # x64 is a setting of each thread
            return work(job)

    pool = ThreadPoolExecutor(cores)
    try:
        for job in jobs:
            under_way.append((job, pool.submit(run_job, job)))
            if len(under_way) > jobs_per_core * cores:
                first, result = under_way.popleft()
                yield first, result.result()
        yield from ((job, result.result()) for job, result in under_way)
    finally:
        pool.shutdown(cancel_futures=True)  # after an interruption, what has not begun


@dataclasses.dataclass
class RecordGroup:
    """Records on one time grid that are collected for a batch.

    Attributes:
        min_records: minimum size of a batch; separate fits of fewer records take less time than compilation.
        tries: number of records that may serve as the template of the batch, since the first may be unusual.
    """

    time: np.ndarray
    min_records: int = 16
    tries: int = 4
    members: list[Member] = dataclasses.field(default_factory=list)
    batch_problem: BatchProblem | None = None

    def is_batchable(self, scene: Scene | None) -> bool:
        """Return whether the records can be fitted in batches, as determined from some of them."""
        if len(self.members) < self.min_records:
            return False
        for _, record in self.members[: self.tries]:
            if self.batch_problem is not None:
                break
            self.tries -= 1
            try:
                self.batch_problem = _make_batch_problem(record, scene, len(self.members))
            except (InputError, np.linalg.LinAlgError):
                continue
        return self.batch_problem is not None


def _group_records(records: Iterable[Member], scene: Scene | None) -> Iterator[Batch]:
    """Yield batches of records to fit together, or single records."""
    groups: dict[tuple[float, ...], RecordGroup] = {}
    for number, record in records:
        if not isinstance(record, Record):
            yield None, [(number, record)]
            continue
        time = record.time
        key = time.size, time[0], time[1], time[-1]
        group = groups[key] = groups.get(key) or RecordGroup(time)
        if time is not group.time and not np.array_equal(time, group.time):
            yield None, [(number, record)]
            continue
        group.members.append((number, record))
        if len(group.members) == _GROUP_RECORDS:
            yield from _split_group(group, scene)
    for group in groups.values():
        yield from _split_group(group, scene)


def _split_group(group: RecordGroup, scene: Scene | None) -> Iterator[Batch]:
    if group.is_batchable(scene):
        assert group.batch_problem is not None
        alike = [group.batch_problem.includes(record) for _, record in group.members]
        for members in split_rows(list(itertools.compress(group.members, alike)), group.batch_problem.unit):
            yield group.batch_problem, members
        group.members = [member for member, same in zip(group.members, alike, strict=True) if not same]
    for members in split_rows(group.members, _SINGLE_RECORDS):
        yield None, members
    group.members = []


def _make_batch_problem(record: Record, scene: Scene | None, count: int) -> BatchProblem | None:
    """Return the problem for `count` records like this one, or None if they cannot be fitted in batches."""
    if scene is not None and (scene.geometry_distributions() or "Ft" in scene.measurement.channels):
        return None  # batches draw no geometry, and have no friction
    problem = build_problem([record], [scene])
    if problem.likelihood.channels[0].effect_sizes:  # whose functions differ between records
        return None
    if problem.sources[0].choice.name != "measured":
        return StatedDriveProblem.from_problem(problem, count)
    return RecordedDriveProblem.from_fit(fit(record, scene), problem, count)


def fit_batch(batch: Batch, whiteness: bool = True) -> tuple[dict[int, Row], BatchFit | None]:
    """Fit a batch; return rows of the accepted records, and the optima of all; `whiteness` as in `fit_many`."""
    problem, members = batch
    if problem is None or not members:
        return {}, None
    padded = problem.pad_records(members)
    try:
        optima = problem.fit(padded, whiteness)
        columns = {"record": [os.path.basename(record.source) for record in padded]}
        columns |= _fit_columns(problem, optima, RESULTS["successful"] if whiteness else _UNTESTED_MESSAGE)
    except np.linalg.LinAlgError:  # one record may make the joint computation fail
        return {}, None
    rows = {
        member[0]: dict(zip(columns, values, strict=True))
        for member, accepted, *values in zip(
            members, optima.accepted, *columns.values(), strict=False
        )  # without padding
        if accepted
    }
    return rows, optima


def _fit_columns(problem: BatchProblem, result: BatchFit, message: str) -> dict[str, list[Any]]:
    names, count, factor = problem.likelihood.names, len(result.theta), result.covariance_factor
    free = [name for name in names if name in circuit_parameters(problem.likelihood.template)]
    force = result.gradients[:, derived.DERIVED_NAMES.index("force_mean")]
    shares, _, along = information_directions(names, factor, problem.prior_factor, free)
    values = (
        *([value] * count for value in ("successful", True, message, problem.samples)),
        *(result.sigma, result.figures["chi2_reduced"], result.figures["rms_residual"], verdicts(shares, along)),
        *(prior_variance_fraction(factor, result.prior_factor, force), result.freed),
    )
    table: dict[str, Any] = dict(zip(_FIT_COLUMNS, values, strict=True))
    places = [names.index(name) for name in free]
    table |= _median_columns(free, np.exp(result.theta).T[places], np.linalg.norm(factor, axis=2).T[places])
    log_sds = np.linalg.norm(result.gradients @ factor, axis=2).T
    table |= _median_columns(derived.DERIVED_NAMES, np.exp(result.logs).T, log_sds)
    return {name: values.tolist() if isinstance(values, np.ndarray) else values for name, values in table.items()}


def _median_columns(names: Sequence[str], medians: np.ndarray, log_sds: np.ndarray) -> dict[str, Any]:
    return {
        key: value
        for name, median, sd in zip(names, medians, log_sds, strict=True)
        for key, value in ((name, median), (f"{name}_log_sd", sd))
    }


def _fit_single(record: Finger, scene: Scene | None) -> Row:
    try:
        return row_from_fit(fit(record, scene))
    except Exception as error:
        return failure_row(record, error)


def row_from_fit(fit: Fit) -> Row:
    free = [i for i, name in enumerate(fit.names) if name in fit.identifiability.blind_direction]
    values = (
        *(fit.result, fit.trusted, fit.message, int(fit.figures["samples"]), fit.sigma, fit.figures["chi2_reduced"]),
        *(fit.figures["rms_residual"], fit.identifiability.verdict, fit.identifiability.force_from_prior),
        ", ".join(fit.model()["freed"]),
    )
    row = {"record": name_row(fit.records)} | dict(zip(_FIT_COLUMNS, values, strict=True))
    row |= _median_columns([fit.names[i] for i in free], np.exp(fit.theta[free]), fit.sd[free])
    logs, log_sds, _ = fit.laplace.derived_moments()
    row |= _median_columns(derived.DERIVED_NAMES, np.exp(logs), log_sds)
    return {name: value.item() if isinstance(value, np.generic) else value for name, value in row.items()}


def failure_row(given: Input, error: BaseException, reason: str = "") -> Row:
    """Return the row of records without a result; `reason` in place of that of a crash."""
    result, message = "refused", str(error)
    if not isinstance(error, InputError):
        result, message = "crashed", f"{list_sources(given)[0]}: {reason or f'{type(error).__name__}: {error}'}"
    return {"record": name_row(given), "result": result, "trusted": False, "message": message}


def name_row(given: Input) -> str:
    """Return the names of the files, without folders."""
    return ", ".join(os.path.basename(source) for source in list_sources(given))


def list_sources(given: Input) -> list[str]:
    """Return the names of records, or their paths as given."""
    if isinstance(given, (Record, Spectrum)):
        return [given.source]
    if isinstance(given, (str, os.PathLike)):
        return [os.fspath(given)]
    return [source for each in given for source in list_sources(each)]
