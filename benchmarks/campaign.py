"""Cost of a campaign: two workers against one, overhead, a model of its time, and an estimate for a million records.

Workers are running and have compiled; that time is stated separately. There are two kinds of records: alike ones, of
Vsc under a named drive, which a worker fits 32 at a time, and records with a measured drive, each fitted separately.
Names are hard links to 250 files.

    python benchmarks/campaign.py [--json] [--quick]
"""

import argparse
import contextlib
import json
import math
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import psutil
import scipy.optimize
from timing import show

import fitact
from fitact.batch import campaign, fit_many, gauss_newton
from fitact.report.campaign import write_campaign
from fitact.report.frame import Provenance

V0, FREQUENCY, NOISE = 180.0, 100.0, 0.1  # V, Hz, V
SCENE = fitact.Scene.from_dict({"drive": {"waveform": "square", "peak_to_peak": 2.0 * V0, "frequency": FREQUENCY}})
FILES, SAMPLES = 250, 1_000
LEAST_ALIKE, LONGEST_ALIKE = (
    fit_many.RecordGroup.min_records,
    gauss_newton.GaussNewton.max_samples,
)  # records, samples: a batch that fit_many fits together
ROUNDS, REPEATS = 5, 3
NEW_LENGTHS = 5
PADDED = (1_100, 1_250, 1_400)  # samples: padded lengths besides that of `SAMPLES`
MILLION = 1e6


class Extent(NamedTuple):
    """Extent of the measurement.

    Attributes:
        counts: records per campaign, by kind.
        longer: records and samples of campaigns with more samples.
        pair: records for the comparison of two workers with one.
        reported: records with reports.
        walkers: numbers of walkers of the sampler.
        stubbed: records without fits.
    """

    counts: dict[str, tuple[int, ...]]
    longer: dict[str, tuple[tuple[int, int], ...]]
    pair: dict[str, int]
    reported: int
    walkers: tuple[int, ...]
    stubbed: int


WHOLE = Extent(
    counts={"alike": (1, 10, 96, 1_024, 10_016), "own": (1, 10, 96, 1_024)},
    longer={"alike": ((320, 10_000), (96, 50_000)), "own": ((192, 10_000), (64, 100_000))},
    pair={"alike": 1_024, "own": 128},
    reported=8,
    walkers=(32, 64, 128, 256),
    stubbed=100_000,
)
QUICK = Extent(
    counts={"alike": (1, 10, 96, 512), "own": (1, 10, 64)},
    longer={"alike": ((64, 10_000),), "own": ((32, 10_000),)},
    pair={"alike": 256, "own": 64},
    reported=2,
    walkers=(64, 128),
    stubbed=10_000,
)


def write_records(folder: Path, kind: str, count: int, samples: int = SAMPLES) -> list[str]:
    """Write records, two settled periods of fingers under a square in closed form, and return their names."""
    place = folder / f"{kind}-{samples}"
    place.mkdir(exist_ok=True)
    names = [place / f"finger{i:06d}.csv" for i in range(count)]
    for i, name in enumerate(names):
        if name.exists():
            continue
        if i >= FILES:
            os.link(names[i % FILES], name)
            continue
        random = np.random.default_rng([i, samples])
        R, C = np.exp(np.log([130e3, 18e-9]) + 0.2 * random.standard_normal(2))
        time = np.arange(samples) * (2.0 / FREQUENCY / samples)
        half = np.floor(time * 2.0 * FREQUENCY + 1e-9)
        sign, since = np.where(half % 2 == 0.0, 1.0, -1.0), time - half / (2.0 * FREQUENCY)
        g, b = 1.35e-9 / (2.7e-9 + C), R * (2.7e-9 + C)
        vsc = sign * (2.0 * V0 * g / (1.0 + np.exp(-0.5 / FREQUENCY / b))) * np.exp(-since / b)
        columns = {"time_s": time, "V_V": V0 * sign, "Vsc_V": vsc + NOISE * random.standard_normal(samples)}
        if kind == "alike":
            del columns["V_V"]
        table = np.column_stack(list(columns.values()))
        np.savetxt(name, table, "%.7g", ",", header=",".join(columns), comments="")
    return [str(name) for name in names]


def campaign_scene(kind: str) -> fitact.Scene | None:
    return SCENE if kind == "alike" else None


def workers(count: int) -> contextlib.AbstractContextManager[Any]:
    """Yield a client of workers started as by the command."""
    return campaign._open_client(None, count, "2 GiB", False, 0.0)


class Cost(NamedTuple):
    """Wall and processor seconds of a campaign, in the command and in the workers, and bytes that it wrote."""

    wall: float
    here: float
    there: float
    left: dict[str, int]


def cost(client: Any, paths: list[str], kind: str, **more: Any) -> Cost:
    def processors() -> np.ndarray:
        return np.array([time.process_time(), sum(client.run(time.process_time).values())])

    with tempfile.TemporaryDirectory() as folder:
        before, start = processors(), time.perf_counter()
        found = campaign.run_campaign(
            paths, folder, campaign_scene(kind), scheduler=client.scheduler.address, progress=False, **more
        )
        write_campaign(folder, found, Provenance.from_inputs("fitact campaign", campaign_scene(kind)))
        wall = time.perf_counter() - start
        here, there = processors() - before
        left = {path.name: _size(path) for path in Path(folder).iterdir()}
    if not all(row["trusted"] for row in found):
        raise SystemExit(str(found))
    return Cost(wall, float(here), float(there), left)


def _size(path: Path) -> int:
    return path.stat().st_size if path.is_file() else sum(_size(inner) for inner in path.iterdir())


def fit_seconds(paths: list[str], kind: str) -> float:
    """Return the seconds of the same fits without a campaign."""
    start = time.perf_counter()
    fitact.fit_many(paths, campaign_scene(kind), progress=False)
    return time.perf_counter() - start


def compile_on_workers(paths: list[str], kind: str, *clients: Any) -> None:
    """Compile on every worker what such records need."""
    for client in clients:
        client.run(fit_seconds, paths[: campaign.BATCH], kind)
        client.run(fit_seconds, paths[:1], kind)


def compare_workers(folder: Path, one: Any, two: Any, pair: dict[str, int]) -> dict[str, float]:
    """Return the throughput, and the overhead of a one-worker campaign over the same fits in that worker, in turn."""
    found: dict[str, float] = {}
    for kind, count in pair.items():
        paths = write_records(folder, kind, count)
        gains, overheads = [], []
        compile_on_workers(paths, kind, one, two)
        for _ in range(ROUNDS):
            alone, both = cost(one, paths, kind).wall, cost(two, paths, kind).wall
            fits = one.submit(fit_seconds, paths, kind, pure=False).result()
            gains.append(alone / both)
            overheads.append(1e3 * (alone - fits) / count)
        found[f"throughput_{kind}_2_workers_vs_1"] = statistics.median(gains)
        found[f"overhead_{kind}_ms"] = statistics.median(overheads)
    return found


def busiest_worker_records(count: int, workers: int) -> int:
    """Return the number of records of the busiest worker."""
    return min(count, campaign.BATCH * math.ceil(math.ceil(count / campaign.BATCH) / workers))


def terms(kind: str, count: int, samples: int, workers: int) -> list[float]:
    """Return the terms of the linear model of a campaign's time, with non-negative coefficients."""
    together = kind == "alike" and count >= LEAST_ALIKE and samples <= LONGEST_ALIKE
    most = busiest_worker_records(count, workers)
    of_kind = [most * together, most * samples * together, most * (not together), most * samples * (not together)]
    return [1.0, *map(float, of_kind), float(count)]


def scale(folder: Path, one: Any, two: Any, extent: Extent) -> dict[str, float]:
    """Fit the model of a campaign's time by relative least squares to all campaigns; return it and its errors."""
    points = [(kind, count, SAMPLES) for kind, counts in extent.counts.items() for count in counts]
    points += [(kind, *length) for kind, lengths in extent.longer.items() for length in lengths]
    rows, walls, found = [], [], {}
    for kind, count, samples in points:
        paths = write_records(folder, kind, count, samples)
        compile_on_workers(paths, kind, one, two)
        for number, client in ((1, one), (2, two)):
            taken = [cost(client, paths, kind) for _ in range(REPEATS if count * samples < 200_000 else 1)]
            walls.append(statistics.median(each.wall for each in taken))
            rows.append(terms(kind, count, samples, number))
            found[f"seconds_{kind}_{count}_records_{samples}_samples_{number}_workers"] = walls[-1]
            cores = statistics.median(each.here + each.there for each in taken)
            found[f"core_ms_{kind}_{samples}_samples"] = 1e3 * cores / count  # core time of the bulk of the records
    relative = np.array(rows) / np.array(walls)[:, None]
    model, _ = scipy.optimize.nnls(relative, np.ones(len(walls)))
    off = relative @ model - 1.0
    names = ("start_s", "alike_ms", "alike_us_a_sample", "own_ms", "own_us_a_sample", "serial_ms")
    units = np.array([1.0, 1e3, 1e6, 1e3, 1e6, 1e3])
    found |= {f"model_{name}": float(value) for name, value in zip(names, model * units, strict=True)}
    return found | {"model_rms_error": float(np.sqrt(np.mean(off**2))), "model_worst_error": float(np.abs(off).max())}


def sampling_seconds(path: str, walkers: int) -> tuple[float, int]:
    """Return the seconds to sample a record's posterior, and the draws kept."""
    found = fitact.fit(fitact.read(path))
    fitact.sample(found, walkers=walkers, seed=1, progress=False)  # compiles
    start = time.perf_counter()
    posterior = fitact.sample(found, walkers=walkers, seed=1, progress=False)
    return time.perf_counter() - start, posterior.points[..., 0].size


def reports(folder: Path, two: Any, extent: Extent) -> dict[str, float]:
    """Return the cost of posteriors and reports, and of sampling with more walkers."""
    paths = write_records(folder, "own", extent.reported + 2)
    cost(two, paths[:2], "own", reports=True)  # compiles
    taken = cost(two, paths[2:], "own", reports=True)
    found = {
        "reports_core_s": (taken.here + taken.there) / extent.reported,
        "reports_mb": taken.left["reports"] / extent.reported / 1e6,
    }
    for walkers in extent.walkers:
        seconds, draws = two.submit(sampling_seconds, paths[0], walkers, pure=False).result()
        found |= {f"sampling_{walkers}_walkers_s": seconds, f"sampling_{walkers}_walkers_draws": float(draws)}
    return found


def fit_cost(paths: list[str]) -> tuple[float, float]:
    """Return processor seconds and MB of a fit."""
    before, start = psutil.Process().memory_info().rss, time.process_time()
    fitact.fit_many(paths, progress=False)
    seconds, more = time.process_time() - start, psutil.Process().memory_info().rss - before
    return seconds / len(paths), more / len(paths) / 1e6


def length_costs(known: list[str], new: list[str], padded: list[str]) -> dict[str, float]:
    """Return the cost of fits of new lengths padded to a known length and to new ones, without clearing JAX's cache."""
    jax.config.update("jax_enable_compilation_cache", False)
    fitact.fit_many(known, progress=False)  # some need an offset, some do not
    found = {"known_length_core_s": fit_cost(known)[0]}
    for name, paths in (("new_length", new), ("padded_length", padded)):
        found[f"{name}_core_s"], found[f"{name}_mb"] = fit_cost(paths)
    return found


def lengths(folder: Path) -> dict[str, float]:
    """Return the cost of records of different lengths."""
    # rounded time steps, because uneven steps compile separately
    first, *new = (SAMPLES + 2 * i for i in range(1, NEW_LENGTHS + 2))
    others = [write_records(folder, "own", 1, samples)[0] for samples in (*new, *PADDED)]
    with workers(1) as client:
        known = write_records(folder, "own", campaign.BATCH, first)
        return client.submit(length_costs, known, others[:NEW_LENGTHS], others[NEW_LENGTHS:]).result()


def peak() -> float:
    """Return the peak memory of this process, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024.0 / 1e6


def stub_fits(path: str) -> None:
    """Make a worker return distinct rows without fitting."""
    (row,) = fitact.fit_many([path], SCENE, progress=False)
    numbers = [name for name, value in row.items() if isinstance(value, float)]

    def rows(self: campaign.Task, paths: list[str]) -> list[dict[str, Any]]:
        own = [{name: row[name] * (1.0 + 1e-6 * i) for name in numbers} for i in range(len(paths))]
        return [row | {"record": os.path.basename(path)} | values for path, values in zip(paths, own, strict=True)]

    campaign.Task.rows = rows


@contextlib.contextmanager
def record_time(found: dict[str, float], name: str, count: int) -> Iterator[None]:
    start = time.perf_counter()
    yield
    found[name] = 1e3 * (time.perf_counter() - start) / count


def measure_parent(folder: Path, count: int) -> dict[str, float]:
    """Return the cost of the command per record, with Dask's scheduler and without fits."""
    found: dict[str, float] = {}
    paths, out = write_records(folder, "alike", count), folder / f"parent-{count}"
    with workers(2) as client:
        client.run(stub_fits, paths[0])
        before = peak()
        for name in ("parent_ms", "replay_ms"):
            with record_time(found, name, count):
                fits = None  # one copy at a time
                fits = campaign.run_campaign(paths, out, SCENE, scheduler=client.scheduler.address, progress=False)
        with record_time(found, "tables_ms", count):
            write_campaign(out, fits, Provenance.from_inputs("fitact campaign", SCENE))
        found["parent_kb"] = 1e3 * (peak() - before) / count
    found |= {f"{path.stem}_bytes": path.stat().st_size / count for path in out.iterdir()}
    found["page_bytes"] = found.pop("index_bytes") * count
    return found


def run_in_process(folder: Path, count: int) -> dict[str, float]:
    command = [sys.executable, __file__, "--parent", str(folder), str(count)]
    return json.loads(subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout)


def million(found: dict[str, float]) -> dict[str, float]:
    """Return the extrapolation to a million records of 1,000 samples."""
    needs = {
        f"million_core_hours_{kind}": MILLION * found[f"core_ms_{kind}_{SAMPLES}_samples"] / 3.6e6
        for kind in ("alike", "own")
    }
    return needs | {
        "million_core_hours_if_all_lengths_differ": MILLION * found["new_length_core_s"] / 3600.0,
        "million_core_hours_reports": MILLION * found["reports_core_s"] / 3600.0,
        "million_hours_of_the_command": MILLION * (found["parent_ms"] + found["tables_ms"]) / 3.6e6,
        "million_workers_that_the_command_feeds_alike": found[f"core_ms_alike_{SAMPLES}_samples"] / found["parent_ms"],
        "million_workers_that_the_command_feeds_own": found[f"core_ms_own_{SAMPLES}_samples"] / found["parent_ms"],
        "million_gb_of_memory_of_the_command": MILLION * found["parent_kb"] / 1e6,
        "million_gb_of_journal_and_tables": MILLION * (found["journal_bytes"] + found["results_bytes"]) / 1e9,
        "million_tb_of_reports": MILLION * found["reports_mb"] / 1e6,
    }


def measure(folder: Path, extent: Extent) -> dict[str, float]:
    start = time.perf_counter()
    with workers(2) as client:
        cost(client, write_records(folder, "own", 1), "own")
        found = {"startup_s": time.perf_counter() - start}
        for kind, count in extent.pair.items():
            cost(client, write_records(folder, kind, count), kind)
        found["worker_mb"] = max(client.run(peak).values())
    found |= lengths(folder)
    with workers(1) as one, workers(2) as two:
        found |= compare_workers(folder, one, two, extent.pair)
        found |= scale(folder, one, two, extent)
        found["worker_of_long_records_mb"] = max(two.run(peak).values())
        found |= reports(folder, two, extent)
        found["worker_with_reports_mb"] = max(two.run(peak).values())
    tenth, whole = (run_in_process(folder, count) for count in (extent.stubbed // 10, extent.stubbed))
    found |= whole | {"parent_ms_vs_a_tenth_of_the_records": whole["parent_ms"] / tenth["parent_ms"]}
    return found | million(found)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="one JSON object")
    parser.add_argument("--quick", action="store_true", help="fewer and smaller campaigns")
    parser.add_argument("--parent", nargs=2, metavar=("FOLDER", "RECORDS"), help="the command alone")
    asked = parser.parse_args()
    if asked.parent:
        print(json.dumps(measure_parent(Path(asked.parent[0]), int(asked.parent[1]))))
        sys.exit()
    with tempfile.TemporaryDirectory() as place:
        show(measure(Path(place), QUICK if asked.quick else WHOLE), asked.json)
