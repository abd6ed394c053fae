"""Time of reading a record, relative to that of pandas for the same file.

    python benchmarks/read.py [--samples 1000000] [--rounds 9] [--json]

`read_KIND` is the time of `fitact.read`, with all its checks, over that of `pandas.read_csv`, in turn (medians), for a
CSV file of three columns: `plain`, with `crlf` at the ends of lines, or with a delimiter there (`trailing`).
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
import pandas
from timing import medians, show

import fitact

ENDS = {"plain": "\n", "crlf": "\r\n", "trailing": ",\n"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=1_000_000)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    rng, time = np.random.default_rng(0), 5e-6 * np.arange(given.samples)
    drive = 180.0 * np.sign(np.sin(628.0 * time)) + 0.1 * rng.standard_normal(time.size)
    skin = 9.0 * np.cos(628.0 * time) + 0.05 * rng.standard_normal(time.size)
    ratios = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "record.csv"
        for name, end in ENDS.items():
            np.savetxt(
                path, np.column_stack([time, drive, skin]), fmt=["%.7g", "%.4f", "%.4f"], delimiter=",", newline=end,
                header="time_s,V_V,Vsc_V", comments="",
            )  # fmt: skip
            jobs = {"read": lambda: fitact.read(path), "pandas": lambda: pandas.read_csv(path)}
            taken = medians(jobs, given.rounds)
            ratios[f"read_{name}"] = taken["read"] / taken["pandas"]
    show(ratios, given.json)


if __name__ == "__main__":
    main()
