"""Error and cost of each response, likelihood and posterior method, measured on one record and this machine."""

import dataclasses
import os
import platform
import sys
from collections.abc import Sequence
from importlib.metadata import version
from typing import Any, ClassVar, Literal, TypeAlias

import jax

from fitact.compiled import available_cores, double_precision, processor
from fitact.data.record import Record
from fitact.data.simulate import simulate
from fitact.errors import InputError
from fitact.fitting.fit import fit
from fitact.fitting.result import Fit
from fitact.scene.scene import Scene
from fitact.tables import align_row
from fitact.tradeoff import timings
from fitact.tradeoff.timings import BenchmarkResult
from fitact.units import format_engineering

Kind: TypeAlias = Literal["answer", "response", "likelihood", "uncertainty"]

COLUMNS = ("method", "error", "time", "ratio", "gradient", "compile", "memory")
KINDS: dict[Kind, str] = {
    "answer": "error of the force and its 90 % interval, relative; wall time from the record to the force, compiled",
    "response": "error of Vsc, relative rms; time of one evaluation",
    "likelihood": "error of the log-likelihood; time of one evaluation in a batch",
    "uncertainty": "error in posterior standard deviations; time of one effective draw",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class BenchmarkedMethod(BenchmarkResult):
    """Error and cost of one method, compared with the others of its kind."""

    column_widths: ClassVar[tuple[int, ...]] = (24, 10, 11, 9, 11, 10, 11)  # of `COLUMNS` in a printed table

    kind: Kind
    ratio: float  # `seconds` over the time of the exact method
    dominated_by: str  # a method that is no less accurate and no slower, and better in one; "" on the Pareto front

    @property
    def cells(self) -> tuple[str, ...]:
        """Row of a table with `COLUMNS`, as text."""
        return (
            self.name,
            f"{self.error:.2g}",
            format_engineering(self.seconds, "s", 3),
            f"{self.ratio:.3g}",
            "" if self.gradient_seconds is None else format_engineering(self.gradient_seconds, "s", 3),
            f"{self.compile_seconds:.2f} s" if self.compile_seconds > 0.0 else "",
            "" if self.memory is None else format_engineering(self.memory, "B", 3),
        )

    def __str__(self) -> str:
        row = align_row(self.cells, self.column_widths)
        return f"{row:{sum(self.column_widths)}}  dominated by {self.dominated_by}" if self.dominated_by else row


@dataclasses.dataclass(frozen=True)
class Tradeoff:
    """Error and cost of the methods for the answer, response, likelihood and uncertainty (posterior).

    The error of an answer is the largest difference of median, 5 and 95 % quantile of the mean force to emcee on the
    full sum, over the median; a single run's, so that it includes the error of few draws.
    The error of a response is the rms difference to the exact Vsc over the rms of the exact Vsc. The error of a
    likelihood is the largest difference of the log-posterior to the full sum, up to a constant, over draws around the
    optimum. The error of an uncertainty is the largest difference to emcee on the full sum, in posterior standard
    deviations, of mean, sd and 5, 50 and 95 % quantiles of log Rsc and log force.

    Attributes:
        levels: results of all methods.
        record: description of the record.
        resolution: smallest significant error of an uncertainty, by the number of draws; smaller ones count as equal.
        trusted: whether the fit of the record is reliable and the reference chain has converged.
        machine: description of the machine.
        notes: notes as sentences.
    """

    levels: tuple[BenchmarkedMethod, ...]
    record: str
    resolution: float
    trusted: bool
    machine: dict[str, Any]
    notes: tuple[str, ...]

    def methods(self, kind: Kind) -> tuple[BenchmarkedMethod, ...]:
        """Return the methods of one kind."""
        return tuple(level for level in self.levels if level.kind == kind)

    def front(self, kind: Kind) -> tuple[BenchmarkedMethod, ...]:
        """Return the Pareto front of one kind, fastest first."""
        return tuple(sorted((level for level in self.methods(kind) if not level.dominated_by), key=lambda x: x.seconds))

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON output of `fitact tradeoff`, also written to tradeoff.json."""
        return dataclasses.asdict(self)

    def __str__(self) -> str:
        rows = [f"{self.record}; {self.machine['cpu']}, {self.machine['cores']} cores", ""]
        for kind, title in KINDS.items():
            rows += [
                f"{kind}: {title}",
                align_row(COLUMNS, BenchmarkedMethod.column_widths),
                *map(str, self.methods(kind)),
                "",
            ]
        return "\n".join([*rows, self.resolution_note, *self.notes])

    @property
    def resolution_note(self) -> str:
        """Smallest significant error of an uncertainty, as text."""
        return f"errors of uncertainty below {self.resolution:.2g} are not significant"


def measure_tradeoff(
    record: Record | None = None,
    scene: Scene | None = None,
    *,
    progress: bool = True,
    tolerances: Sequence[float] = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6),
    runs: int = 3,
) -> Tradeoff:
    """Measure the error and the cost of each method on a record (V and Vsc), or on one simulated from the scene.

    Times are medians of interleaved rounds. The measurement takes one or two minutes.

    Args:
        record: record, or None to simulate one.
        scene: scene, or None for the scene of the reference paper.
        progress: whether to report the progress on standard error.
        tolerances: errors allowed for the compressed log-likelihood; they must include 1e-3.
        runs: number of runs of each posterior method, after one that compiles.

    Raises:
        InputError: the record or the scene cannot be fitted, or the scene does not measure Vsc.
    """
    used_scene = scene or Scene()
    if "Vsc" not in used_scene.measurement.channels:
        raise InputError("scene: [measurement] channels has no Vsc, on which the methods are compared; add it")
    if used_scene.skin.level != "constant":
        raise InputError(
            f"scene: [skin] level = '{used_scene.skin.level}': methods are compared for a constant skin only; remove it"
        )
    used_scene.require_available(fit=True)

    def say(text: str) -> None:
        if progress:
            print(f"tradeoff: {text}", file=sys.stderr)

    measured = record or simulate(used_scene)
    say(f"fitting {measured.source} at {len(tolerances)} tolerances and without compression")
    fits = {tolerance: fit(measured, scene if record else used_scene, tolerance=tolerance) for tolerance in tolerances}
    full = fit(measured, scene if record else used_scene, tolerance=0.0)
    with double_precision():
        say("responses")
        responses = timings.benchmark_responses(full)
        say("likelihoods")
        likelihoods = timings.benchmark_likelihoods(full, fits)
    say("uncertainties")
    default = fits[1e-3]  # by the default tolerance of `fitact.fit`
    uncertainties = timings.benchmark_uncertainties(full, default, say, runs)
    answers = timings.benchmark_answers(measured, scene if record else used_scene, uncertainties, say)
    resolution, converged = uncertainties.resolution, uncertainties.converged
    return Tradeoff(
        levels=(
            *_rank_results("answer", answers, resolution * uncertainties.force_log_sd),
            *_rank_results("response", responses, 1e-12),  # accuracy of Vsc by docs/numerics.md
            *_rank_results("likelihood", likelihoods, 0.0),
            *_rank_results("uncertainty", uncertainties.levels, resolution),
        ),
        record=f"{os.path.basename(measured.source)}: {len(measured):,} samples, drive {full.choice.name}",
        resolution=resolution,
        trusted=full.trusted and converged,
        machine=describe_machine(),
        notes=_notes(full, fits, converged),
    )


def _rank_results(kind: Kind, rows: Sequence[BenchmarkResult], resolution: float) -> list[BenchmarkedMethod]:
    """Add time ratios to the first row (the reference), and dominance; errors below `resolution` count as equal."""
    better = dominators([row.seconds for row in rows], [max(row.error, resolution) for row in rows])
    names = ["" if j is None else rows[j].name for j in better]
    return [
        BenchmarkedMethod(kind=kind, ratio=row.seconds / rows[0].seconds, dominated_by=name, **vars(row))
        for row, name in zip(rows, names, strict=True)
    ]


def dominators(costs: Sequence[float], errors: Sequence[float]) -> list[int | None]:
    """Return for each method the fastest one on the Pareto front that dominates it; None on the front itself.

    A method dominates another if neither its cost nor its error is larger, and at least one is smaller. Equal methods
    do not dominate each other.
    """
    order = sorted(range(len(costs)), key=lambda i: (costs[i], errors[i]))
    dominator: list[int | None] = [None] * len(costs)
    front: list[int] = []
    for i in order:
        same = [j for j in front if (costs[j], errors[j]) == (costs[i], errors[i])]
        better = [j for j in front if errors[j] <= errors[i]]
        if same or not better:
            front.append(i)
        else:
            dominator[i] = better[0]
    return dominator


def _notes(full: Fit, fits: dict[float, Fit], converged: bool) -> tuple[str, ...]:
    notes = []
    if not full.trusted:
        notes.append(f"the fit used for the comparison is unreliable: {full.message}")
    if not converged:
        notes.append("emcee on the full sum, the reference for the uncertainties, has not converged")
    for tolerance, fitted in fits.items():
        if fitted.compression_error is None:
            notes.append(f"not compressed at {timings.format_tolerance(tolerance)}, because {fitted.full_because}")
    return tuple(notes)


def describe_machine() -> dict[str, Any]:
    """Return a description of the machine, so that runs can be compared."""
    model = next((line for line in processor().splitlines() if line.startswith("model name")), "")
    return {
        "cpu": model.partition(":")[2].strip() or platform.machine(),
        "cores": available_cores(),
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "platform": platform.platform(),
        "device": jax.devices()[0].device_kind,
        "python": platform.python_version(),
        **{package: version(package) for package in ("fitact", "jax", "jaxlib", "numpy", "scipy", "emcee")},
    }
