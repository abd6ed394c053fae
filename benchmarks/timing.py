"""The stopwatch of the benchmarks, and how they tell what they found."""

import json
import statistics
import time
from collections.abc import Callable


def medians(
    jobs: dict[str, Callable[[], object]], rounds: int, calls: dict[str, int] | None = None
) -> dict[str, float]:
    """Median seconds of a call of each job, run in turn; `calls`: how many a round, 1 where it is silent."""
    return {name: statistics.median(times) for name, times in _call_seconds(jobs, rounds, calls).items()}


def minima(jobs: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """The least seconds of a call of each job, run in turn: what else the machine does only adds to it."""
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


def show(ratios: dict[str, float], as_json: bool) -> None:
    """Print named ratios, a line each or as one JSON object."""
    if as_json:
        print(json.dumps(ratios))
        return
    for name, value in ratios.items():
        print(f"{name:36}{value:12.4g}")
