"""Cost and error of each level of the model, measured on one record, in one run, on this machine."""

import dataclasses
import os
import platform
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, TypeAlias

import jax

from fitact.data.record import Record
from fitact.data.simulate import simulate
from fitact.errors import InputError
from fitact.fitting.fit import Fit, fit
from fitact.scene.scene import Scene
from fitact.tables import align_row
from fitact.tradeoff import timings
from fitact.tradeoff.timings import BenchmarkResult
from fitact.units import format_engineering

Kind: TypeAlias = Literal["response", "likelihood", "uncertainty"]

_DEFAULT_TOLERANCE = 1e-3  # of `fitact.fit`, on which the levels of uncertainty stand
_WIDTHS = [24, 10, 11, 9, 11, 10, 11]
COLUMNS = ("level", "error", "time", "ratio", "gradient", "compile", "memory")
KINDS: dict[Kind, str] = {
    "response": "error of Vsc, relative rms; time of one evaluation",
    "likelihood": "error of its logarithm; time of one evaluation, of many at once",
    "uncertainty": "error in posterior standard deviations; time of one effective draw",
}


@dataclasses.dataclass(frozen=True)
class BenchmarkedMethod:
    """One level as measured."""

    kind: Kind
    name: str  # "exact", "harmonic(100)", "compressed(1e-3)", "psis", ...
    error: float  # against the kind's reference; see `Tradeoff`
    seconds: float  # of one evaluation (of one walker in a batch), or of one effective draw of the mean force
    ratio: float  # `seconds` over those of the exact level
    gradient_seconds: float | None  # of one gradient; None: it has none
    compile_seconds: float  # before the first evaluation, beyond its time
    memory: int | None  # bytes that an evaluation takes, or that the draws do; None: not known
    dominated_by: str  # a level that is off by no more and costs no more, one of both less; "": it is on the front
    details: dict[str, Any]  # figures of its own

    @property
    def cells(self) -> tuple[str, ...]:
        """A row of a table of `COLUMNS`, for people."""
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
        row = align_row(self.cells, _WIDTHS)
        return f"{row:{sum(_WIDTHS)}}  dominated by {self.dominated_by}" if self.dominated_by else row


@dataclasses.dataclass(frozen=True)
class Tradeoff:
    """Levels of response, likelihood and uncertainty: error against the best reference, and cost.

    A response's error is the rms difference of Vsc from the exact one over that one's rms; a likelihood's the
    largest difference of the log-posterior from the full sum, over draws around the optimum and up to a constant;
    an uncertainty's the largest difference, in posterior standard deviations, of mean, sd and 5, 50 and 95 %
    quantiles of log Rsc and log force from those of emcee on the full sum.

    Attributes:
        levels: all that were measured.
        record: what they were measured on, in words.
        resolution: errors of an uncertainty below it cannot be told from 0 by so many draws, and count as alike.
        trusted: whether the record's fit and the reference's draws are.
        machine: what ran it.
        notes: sentences.
    """

    levels: tuple[BenchmarkedMethod, ...]
    record: str
    resolution: float
    trusted: bool
    machine: dict[str, Any]
    notes: tuple[str, ...]

    def of(self, kind: Kind) -> tuple[BenchmarkedMethod, ...]:
        """Return the levels of one kind."""
        return tuple(level for level in self.levels if level.kind == kind)

    def front(self, kind: Kind) -> tuple[BenchmarkedMethod, ...]:
        """Return the Pareto front of one kind, cheapest first."""
        return tuple(sorted((level for level in self.of(kind) if not level.dominated_by), key=lambda x: x.seconds))

    def to_dict(self) -> dict[str, Any]:
        """Return what `fitact tradeoff --json` prints and tradeoff.json holds."""
        return dataclasses.asdict(self)

    def __str__(self) -> str:
        rows = [f"{self.record}; {self.machine['cpu']}, {self.machine['cores']} cores", ""]
        for kind, title in KINDS.items():
            rows += [f"{kind}: {title}", align_row(COLUMNS, _WIDTHS), *map(str, self.of(kind)), ""]
        return "\n".join([*rows, self.resolved, *self.notes])

    @property
    def resolved(self) -> str:
        """From where on errors of an uncertainty mean something."""
        return f"errors of uncertainty below {self.resolution:.2g} cannot be told from 0"


def measure_tradeoff(
    record: Record | None = None,
    scene: Scene | None = None,
    *,
    progress: bool = True,
    tolerances: Sequence[float] = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6),
    runs: int = 3,
) -> Tradeoff:
    """Measure every level's error and cost on a record (V and Vsc), or on one simulated from the scene.

    Times are medians of interleaved rounds. Takes a minute or two.

    Args:
        record: None: simulated.
        scene: None: the paper's.
        progress: tell it on standard error.
        tolerances: of the compressed log-likelihood; 1e-3 must be among them.
        runs: of each level of uncertainty, after one that compiles.

    Raises:
        InputError: the record or the scene cannot be fitted, or the scene does not measure Vsc.
    """
    stated = scene or Scene()
    if "Vsc" not in stated.measurement.channels:
        raise InputError("scene: [measurement] channels has no Vsc, which the levels are compared on; add it")
    if stated.skin.level != "constant":
        raise InputError(
            f"scene: [skin] level = '{stated.skin.level}': the levels are those of a constant skin; leave it out"
        )
    stated.require_available(fit=True)

    def say(text: str) -> None:
        if progress:
            print(f"tradeoff: {text}", file=sys.stderr)

    measured = record or simulate(stated)
    say(f"fitting {measured.source} at {len(tolerances)} tolerances and without compression")
    fits = {tolerance: fit(measured, scene if record else stated, tolerance=tolerance) for tolerance in tolerances}
    full = fit(measured, scene if record else stated, tolerance=0.0)
    with jax.enable_x64(True):
        say("responses")
        responses = timings.benchmark_responses(full)
        say("likelihoods")
        likelihoods = timings.benchmark_likelihoods(full, fits)
    say("uncertainties")
    draws, resolution, converged = timings.benchmark_uncertainties(full, fits[_DEFAULT_TOLERANCE], say, runs)
    return Tradeoff(
        levels=(
            *_rank_results("response", responses, 1e-12),  # what docs/numerics.md guarantees of Vsc
            *_rank_results("likelihood", likelihoods, 0.0),
            *_rank_results("uncertainty", draws, resolution),
        ),
        record=f"{os.path.basename(measured.source)}: {len(measured):,} samples, drive {full.choice.name}",
        resolution=resolution,
        trusted=full.trusted and converged,
        machine=describe_machine(),
        notes=_notes(full, fits, converged),
    )


def _rank_results(kind: Kind, rows: Sequence[BenchmarkResult], resolution: float) -> list[BenchmarkedMethod]:
    """Add ratios to the reference, which comes first, and who dominates whom; errors below `resolution` are alike."""
    better = dominators([row.seconds for row in rows], [max(row.error, resolution) for row in rows])
    names = ["" if j is None else rows[j].name for j in better]
    return [
        BenchmarkedMethod(kind=kind, ratio=row.seconds / rows[0].seconds, dominated_by=name, **vars(row))
        for row, name in zip(rows, names, strict=True)
    ]


def dominators(costs: Sequence[float], errors: Sequence[float]) -> list[int | None]:
    """Return for each level the one on the Pareto front that dominates it, the cheapest of several; None: it is on it.

    One dominates another when neither its cost nor its error is larger, and one of both is smaller. Of equal
    levels none dominates the other.
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
        notes.append(f"the fit that the levels stand on must not be trusted: {full.message}")
    if not converged:
        notes.append("emcee on the full sum, the reference of the uncertainties, has not converged")
    for tolerance, fitted in fits.items():
        if fitted.compression_error is None:
            notes.append(f"not compressed at {timings.format_tolerance(tolerance)}, since {fitted.full_because}")
    return tuple(notes)


def describe_machine() -> dict[str, Any]:
    """Describe what a result was measured on, so that runs can be compared."""
    return {
        "cpu": _cpu(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "platform": platform.platform(),
        "device": jax.devices()[0].device_kind,
        "python": platform.python_version(),
        **{package: version(package) for package in ("fitact", "jax", "jaxlib", "numpy", "scipy", "emcee")},
    }


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())
