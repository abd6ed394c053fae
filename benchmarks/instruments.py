"""Cost of stated instruments: fits of one record with and without `[instrument]`, timed in turn.

python benchmarks/instruments.py [--rounds 9] [--json]
"""

import argparse
import json
import statistics
import time

import fitact
from fitact.data.simulate import simulate

EQUIPMENT = {"V": ["scope-8bit:A/CH1", "probe-10x:P1"], "Vsc": ["scope-8bit:A/CH2", "probe-10x:P2"]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    ratios = {}
    for samples in (4_000, 1_000_000):
        source = fitact.Scene.from_dict(
            {
                "drive": {"waveform": "trapezoid", "rise_time": "100 us"},
                "measurement": {"duration": f"{samples / 200e3} s"},
            }
        )
        record = simulate(source, seed=1)
        plain = fitact.Scene.from_dict({"drive": {"waveform": "measured"}})
        stated = fitact.Scene.from_dict({"drive": {"waveform": "measured"}, "instrument": EQUIPMENT})
        seconds: dict[str, list[float]] = {"plain": [], "stated": [], "stated and written": []}
        for _ in range(arguments.rounds + 1):
            for name, scene in (("plain", plain), ("stated", stated)):
                start = time.perf_counter()
                fit = fitact.fit(record, scene)
                seconds[name].append(time.perf_counter() - start)
            start = time.perf_counter()
            fit.to_dict()
            seconds["stated and written"].append(seconds["stated"][-1] + time.perf_counter() - start)
        base, *others = (statistics.median(times[1:]) for times in seconds.values())  # the first round compiles
        for name, each in zip(list(seconds)[1:], others, strict=True):
            ratios[f"{name}, {samples} samples, over a fit without instruments"] = each / base
    if arguments.json:
        print(json.dumps(ratios))
    else:
        for name, ratio in ratios.items():
            print(f"{ratio:.2f}  {name}")


if __name__ == "__main__":
    main()
