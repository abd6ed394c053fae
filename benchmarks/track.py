"""Time and memory of `fitact track` on a long file, over the time in which pandas reads it.

    python benchmarks/track.py [--duration 30] [--rounds 3] [--json]

A slide at 200 kHz with V, Vsc and I (`data_synth`) is written as CSV. Processes run in turn; medians are compared. Cold
means that no compiled program is stored. Ratios: `cold` and `warm`, whole processes up to the page over the time of
`pandas.read_csv`; `memory`, the largest resident memory of the command, GB.
"""

import argparse
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pandas
from timing import process_seconds, show

from data_synth.changing import make_course
from data_synth.make import simulate_response
from data_synth.scene import make_scene

SCENE = '[drive]\nwaveform = "measured"\n[measurement]\nchannels = ["Vsc", "I"]\n'


def main() -> None:
    parser = argparse.ArgumentParser(description="Tracks of a long file, over pandas.")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--rounds", type=int, default=3, help="rounds, of which the median is taken")
    parser.add_argument("--duration", type=float, default=30.0, help="length of the record, s")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        file, scene = Path(folder, "slide.csv"), Path(folder, "scene.toml")
        write_slide(file, given.duration)
        scene.write_text(SCENE, encoding="utf-8")
        command = [
            str(Path(sys.executable).with_name("fitact")),
            "track",
            str(file),
            "--scene",
            str(scene),
            "--out",
            "out",
        ]
        reading = [sys.executable, "-c", f"import pandas; pandas.read_csv({str(file)!r})"]
        seconds: dict[str, list[float]] = {"pandas": [], "cold": [], "warm": []}
        for number in range(given.rounds):
            seconds["pandas"].append(read_seconds(reading))
            for name in ("cold", "warm"):
                seconds[name].append(process_seconds(command, Path(folder), Path(folder, f"cache{number}")))
    medians = {name: statistics.median(each) for name, each in seconds.items()}
    memory = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e6
    show(
        {"cold": medians["cold"] / medians["pandas"], "warm": medians["warm"] / medians["pandas"], "memory": memory},
        given.json,
    )


def read_seconds(command: list[str]) -> float:
    """Return the time of reading alone: a process that reads, less one that only imports pandas."""
    times = []
    for each in (command, [sys.executable, "-c", "import pandas"]):
        begin = time.perf_counter()
        subprocess.run(each, check=True)
        times.append(time.perf_counter() - begin)
    return times[0] - times[1]


def write_slide(path: Path, duration: float) -> None:
    drive = {"waveform": "trapezoid", "rise_time": "200 us"}
    scene = make_scene({"drive": drive, "measurement": {"channels": ["Vsc", "I"]}}, {}, "scene")
    walks = dict.fromkeys(("walk_area", "walk_Rsc", "walk_Csc"), 0.0)
    lifted = (0.57 * duration, 0.59 * duration)
    change = {"time": (0.0, duration), "area": (1.0, 1.3), "Rsc": (1.0, 0.6), "Csc": None, "lifted": lifted, **walks}
    rng = np.random.default_rng(0)
    course = make_course(change, (160e3, 22e-9, 1.35e-9), duration, rng)
    at = np.arange(round(200e3 * duration)) / 200e3
    V, Vsc, current = simulate_response(scene, at, None, "scipy", course)
    noisy = {"Vsc_V": Vsc + 0.1 * rng.standard_normal(at.size), "I_A": current + 20e-9 * rng.standard_normal(at.size)}
    pandas.DataFrame({"time_s": at, "V_V": V, **noisy}).to_csv(path, index=False, float_format="%.8g")


if __name__ == "__main__":
    main()
