"""Timing and output of the benchmarks."""

import json
import os
import statistics
import subprocess
import time
from collections.abc import Callable
from pathlib import Path


def medians(
    jobs: dict[str, Callable[[], object]], rounds: int, calls: dict[str, int] | None = None
) -> dict[str, float]:
    """Return the median seconds per call of jobs run in turn; `calls` is the number per round, default 1."""
    return {name: statistics.median(times) for name, times in _call_seconds(jobs, rounds, calls).items()}


def minima(jobs: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Return the minimum seconds per call of jobs run in turn, which other load can only increase."""
    return {name: min(times) for name, times in _call_seconds(jobs, rounds, None).items()}


def _call_seconds(
    jobs: dict[str, Callable[[], object]], rounds: int, calls: dict[str, int] | None
) -> dict[str, list[float]]:
    taken: dict[str, list[float]] = {name: [] for name in jobs}
    for job in jobs.values():
        job()
    for _ in range(rounds):
        for name, job in jobs.items():
            count = (calls or {}).get(name, 1)
            start = time.perf_counter()
            for _ in range(count):
                job()
            taken[name].append((time.perf_counter() - start) / count)
    return taken


def program_environment(cache: Path) -> dict[str, str]:
    """Return the environment of a process whose caches are in `cache`."""
    left_out = ("JAX_", "PYTHONDONTWRITEBYTECODE")
    kept = {name: value for name, value in os.environ.items() if not name.startswith(left_out)}
    return kept | {"FITACT_CACHE": str(cache), "XDG_CACHE_HOME": str(cache)}


def process_seconds(command: list[str], folder: Path, cache: Path) -> float:
    """Return the seconds of a process in `folder` whose caches are in `cache`."""
    start = time.perf_counter()
    subprocess.run(command, env=program_environment(cache), cwd=folder, check=True, capture_output=True)
    return time.perf_counter() - start


def show(ratios: dict[str, float], as_json: bool) -> None:
    """Print named ratios, one per line or as one JSON object."""
    if as_json:
        print(json.dumps(ratios))
        return
    for name, value in ratios.items():
        print(f"{name:36}{value:12.4g}")
