"""Speed of `sample_many` against `fit` and `sample` record by record, in turn, once compiled.

`vs_alone` is the ratio of posteriors per second, and `ess_vs_alone` the ratio of effective draws per second (of each
record's worst quantity). `vs_sampling_alone` and `ess_vs_sampling_alone` are the same against `sample` without the fit.
`together` is the fraction of the records sampled together. `recorded_` begins the names of the same figures of records
with drives of their own, whose Vsc is 2.3 samples late and has an unknown charge and offset.

    python benchmarks/many_posteriors.py [--json] [--records 128] [--samples 2000]
"""

import argparse
import statistics
import time

from batch import RECORDED_SCENE, SCENE, simulate_recorded, simulate_records
from timing import show

import fitact

ALONE = 4  # records per round sampled one by one
ROUNDS = 5


def measure(records: list[fitact.Record], scene: fitact.Scene, prefix: str = "") -> dict[str, float]:
    """Return the medians of the rounds."""
    count = len(records)
    fitact.sample_many(records, scene, progress=False)  # compiles
    fitact.sample(fitact.fit(records[0], scene), progress=False)
    taken: dict[str, list[float]] = {"together": [], "fit": [], "sample": []}
    ess: dict[str, list[float]] = {"together": [], "sample": []}
    for turn in range(ROUNDS):
        start = time.perf_counter()
        rows = fitact.sample_many(records, scene, seed=turn, progress=False)
        taken["together"].append((time.perf_counter() - start) / count)
        ess["together"] += [row["ess_min"] for row in rows]
        some = [records[(turn * ALONE + i) % count] for i in range(ALONE)]
        start = time.perf_counter()
        fits = [fitact.fit(record, scene) for record in some]
        fitted = time.perf_counter()
        posteriors = [fitact.sample(fit, seed=turn, progress=False) for fit in fits]
        taken["fit"].append((fitted - start) / ALONE)
        taken["sample"].append((time.perf_counter() - fitted) / ALONE)
        ess["sample"] += [posterior.convergence.ess_min for posterior in posteriors]
    seconds = {name: statistics.median(values) for name, values in taken.items()}
    drawn = {name: statistics.mean(values) for name, values in ess.items()}
    alone, more = seconds["fit"] + seconds["sample"], drawn["together"] / drawn["sample"]
    found = {
        "posteriors_per_second": 1.0 / seconds["together"],
        "ess_per_second": drawn["together"] / seconds["together"],
        "ess_a_record": drawn["together"],
        "vs_alone": alone / seconds["together"],
        "vs_sampling_alone": seconds["sample"] / seconds["together"],
        "ess_vs_alone": more * alone / seconds["together"],
        "ess_vs_sampling_alone": more * seconds["sample"] / seconds["together"],
        "together": statistics.mean(row["level"] == "psis" for row in rows),
    }
    return {prefix + name: value for name, value in found.items()}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="one JSON object")
    parser.add_argument("--records", type=int, default=128, help="16 or more")
    parser.add_argument("--samples", type=int, default=2_000)
    options = parser.parse_args()
    size = options.records, options.samples
    found = measure(simulate_records(*size), SCENE)
    show(found | measure(simulate_recorded(*size), RECORDED_SCENE, "recorded_"), options.json)
