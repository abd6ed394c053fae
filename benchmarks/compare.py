"""Error rate of `fitact.compare`: records simulated with and without a gap, fitted with both models.

    python benchmarks/compare.py [--records N] [--json]

Vsc and I of a 360 Vpp square at 100 Hz through 100 kohm, two periods of 1,000 samples; noise 0.1 V and 20 nA; the
nominal finger, with another seed for each record. The fitted gap has wide priors (95 % within a factor of 100) around
2 Mohm parallel to 2 um of air, the largest simulated gap; smaller ones have the same time constant.
"""

import argparse
import dataclasses
from collections import Counter

from timing import show

import fitact
from fitact.data.simulate import simulate

MEASURED = {
    "channels": ["Vsc", "I"],
    "series_resistor": "100 kohm",
    "sampling_rate": "50 kHz",
    "duration": "20 ms",
}
RGAP, CGAP = 2e6, 443e-12
WIDE = {"prior": {"Rgap": {"factor": 100}, "Cgap": {"factor": 100}}}
SIZES = {"no gap": 0.0, "gap of 10 %": 1e-1, "whole gap": 1.0}


def scene(size: float, **more: dict) -> fitact.Scene:
    """Return a scene whose gap has this fraction of the largest gap's impedance."""
    gap = {"gap": {"resistance": RGAP * size, "capacitance": CGAP / size}} if size else {}
    return fitact.Scene.from_dict({"measurement": MEASURED} | gap | more)


def verdicts(size: float, records: int) -> Counter:
    """Count how often each model is preferred."""
    models = {"plain": scene(0.0), "gap": scene(1.0, **WIDE)}
    found: Counter = Counter()
    for seed in range(records):
        made = dataclasses.replace(simulate(scene(size), seed), source=f"seed {seed}")
        comparison = fitact.compare(made, models)
        found[comparison.preferred or "neither"] += 1
        found["best elpd: gap"] += comparison.models[0].name == "gap"
    return found


def main() -> None:
    """Run the comparison for each size of the gap."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--records", type=int, default=30, help="without a gap; with one, a quarter as many")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    ratios = {}
    for name, size in SIZES.items():
        records = options.records if size == 0.0 else -(-options.records // 4)
        found = verdicts(size, records)
        for verdict in ("plain", "gap", "neither", "best elpd: gap"):
            ratios[f"{name}, {records} records: {verdict}"] = found[verdict] / records
    show(ratios, options.json)


if __name__ == "__main__":
    main()
