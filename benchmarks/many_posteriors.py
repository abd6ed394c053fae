"""Speed of `sample_many` against `fit` and `sample` record by record, in turn, once compiled.

`vs_alone` is the ratio of posteriors per second, and `ess_vs_alone` the ratio of effective draws per second (of each
record's worst quantity). `vs_sampling_alone` and `ess_vs_sampling_alone` are the same against `sample` without the fit.
`together` is the fraction of the records sampled together.

    python benchmarks/many_posteriors.py [--json] [--records 128] [--samples 2000]
"""

import argparse
import statistics
import time

from batch import SCENE, simulate_records
from timing import show

import fitact
from fitact.batch.metropolis import WALKERS

ALONE = 4  # records per round sampled one by one
ROUNDS = 5


def measure(count: int, samples: int) -> dict[str, float]:
    """Return the medians of the rounds."""
    records = simulate_records(count, samples)
    fitact.sample_many(records[:300], SCENE, progress=False)  # compiles
    fitact.sample(fitact.fit(records[0], SCENE), progress=False)
    taken: dict[str, list[float]] = {"together": [], "fit": [], "sample": []}
    ess: dict[str, list[float]] = {"together": [], "sample": []}
    for turn in range(ROUNDS):
        start = time.perf_counter()
        rows = fitact.sample_many(records, SCENE, seed=turn, progress=False)
        taken["together"].append((time.perf_counter() - start) / count)
        ess["together"] += [row["ess_min"] for row in rows]
        some = [records[(turn * ALONE + i) % count] for i in range(ALONE)]
        start = time.perf_counter()
        fits = [fitact.fit(record, SCENE) for record in some]
        fitted = time.perf_counter()
        posteriors = [fitact.sample(fit, seed=turn, progress=False) for fit in fits]
        taken["fit"].append((fitted - start) / ALONE)
        taken["sample"].append((time.perf_counter() - fitted) / ALONE)
        ess["sample"] += [posterior.convergence.ess_min for posterior in posteriors]
    seconds = {name: statistics.median(values) for name, values in taken.items()}
    drawn = {name: statistics.mean(values) for name, values in ess.items()}
    alone, more = seconds["fit"] + seconds["sample"], drawn["together"] / drawn["sample"]
    return {
        "posteriors_per_second": 1.0 / seconds["together"],
        "ess_per_second": drawn["together"] / seconds["together"],
        "ess_a_record": drawn["together"],
        "vs_alone": alone / seconds["together"],
        "vs_sampling_alone": seconds["sample"] / seconds["together"],
        "ess_vs_alone": more * alone / seconds["together"],
        "ess_vs_sampling_alone": more * seconds["sample"] / seconds["together"],
        "together": statistics.mean(row["walkers"] == WALKERS for row in rows),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="one JSON object")
    parser.add_argument("--records", type=int, default=128, help="16 or more")
    parser.add_argument("--samples", type=int, default=2_000)
    options = parser.parse_args()
    show(measure(options.records, options.samples), options.json)
