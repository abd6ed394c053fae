"""Cost of stated instruments: fits of one record with and without `[instrument]`, timed in turn.

python benchmarks/instruments.py [--rounds 9] [--json]
"""

import argparse
import functools

from timing import medians, show

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
        jobs = {
            "plain": functools.partial(fitact.fit, record, plain),
            "stated": functools.partial(fitact.fit, record, stated),
            "stated and written": lambda record=record, stated=stated: fitact.fit(record, stated).to_dict(),
        }
        seconds = medians(jobs, arguments.rounds)
        base = seconds.pop("plain")
        for name, each in seconds.items():
            ratios[f"{name}, {samples} samples, over a fit without instruments"] = each / base
    show(ratios, arguments.json)


if __name__ == "__main__":
    main()
