"""The stopwatch of the benchmarks."""

import statistics
import time
from collections.abc import Callable


def medians(
    jobs: dict[str, Callable[[], object]], rounds: int, calls: dict[str, int] | None = None
) -> dict[str, float]:
    """Median seconds of a call of each job, run in turn; `calls`: how many a round, 1 where it is silent."""
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
    return {name: statistics.median(times) for name, times in taken.items()}
