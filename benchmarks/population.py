"""Cost of a population of 1,000 fingers, memory against record length, and cost of Sobol indices.

Each run is a separate process, to measure its peak memory; records are made on demand.

    python benchmarks/population.py [--json] [--fingers 1000]
"""

import argparse
import contextlib
import io
import json
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from timing import medians, show

import fitact
from fitact.populations.sobol import Surrogate, sobol_indices

SAMPLES = 500
LONGER = 10  # factor in record length
FREQUENCY, AMPLITUDE, NOISE = 100.0, 180.0, 0.3  # Hz, V, V
SCENE: dict[str, Any] = {
    "drive": {"waveform": "triangle", "frequency": FREQUENCY},
    "prior": {
        "Rsc": {"median": 130e3, "factor": 2.0},
        "Csc": {"median": 20e-9, "factor": 2.0},
        "Ci": {"median": 1.35e-9, "factor": 1.2},
    },
}
NAMES = ("force_mean", "force_peak")


class SimulatedRecords(Sequence[fitact.Record]):
    """Two settled periods of fingers with log-normal Rsc and Csc, by 200 harmonics of the triangle."""

    def __init__(self, fingers: int, samples: int) -> None:
        self._skins = np.log([130e3, 20e-9]) + np.random.default_rng(0).standard_normal((fingers, 2)) * [0.25, 0.35]
        order = np.arange(1, 400, 2)
        self._time = np.arange(samples) / samples * 2.0 / FREQUENCY
        self._tones = (
            np.exp(2j * np.pi * FREQUENCY * np.outer(self._time, order)) * 8.0 * AMPLITUDE / (np.pi * order) ** 2
        )
        self._s = 2j * np.pi * FREQUENCY * order

    def __len__(self) -> int:
        return len(self._skins)

    def __getitem__(self, index: Any) -> Any:
        if not 0 <= index < len(self):
            raise IndexError(index)
        (Rsc, Csc), Ci = np.exp(self._skins[index]), 1.35e-9
        gain = Rsc * Ci * self._s / (1.0 + Rsc * (2.0 * Ci + Csc) * self._s)
        noise = NOISE * np.random.default_rng([1, index]).standard_normal(self._time.size)
        return fitact.Record.from_arrays(
            self._time, V=self._tones.real.sum(axis=1), Vsc=(self._tones @ gain).real + noise, source=f"finger {index}"
        )


def fit_simulated(fingers: int, samples: int) -> fitact.Population:
    return fitact.population(SimulatedRecords(fingers, samples), fitact.Scene.from_dict(SCENE), seed=1, progress=False)


def measure_run(fingers: int, samples: int) -> dict[str, float]:
    """Return the seconds, including all output, and the peak memory (MB) of this process."""
    began = time.perf_counter()
    with contextlib.redirect_stdout(io.StringIO()):
        print(fit_simulated(fingers, samples))
    seconds = time.perf_counter() - began
    return {"seconds": seconds, "memory": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0}


def run_in_process(fingers: int, samples: int) -> dict[str, float]:
    command = [sys.executable, __file__, "--one", str(fingers), str(samples)]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


def shares() -> dict[str, float]:
    """Return the time of Saltelli's design on the model relative to the surrogate, for the posterior's factors."""
    population = fit_simulated(12, SAMPLES)
    factors = population.factors.reshape(-1, len(population.finger.factors))
    columns = [population.finger.names.index(name) for name in NAMES]
    count = {"exact": 0}

    def exact(points: np.ndarray) -> np.ndarray:
        count["exact"] += len(points)
        return population.finger.evaluate(points)[:, columns]

    surrogate = Surrogate.from_model(population.finger, factors, NAMES)
    named = population.finger.factors, factors, NAMES, 1
    brute, near = sobol_indices(exact, *named), sobol_indices(surrogate.predict, *named)
    shifts = [
        abs(brute[name][factor][key] - near[name][factor][key])
        for name in NAMES
        for factor in brute[name]
        for key in ("first", "total")
    ]
    rng = np.random.default_rng(2)
    points = {n: factors[rng.integers(len(factors), size=n)] for n in (count["exact"], surrogate.evaluations)}
    seconds = medians({str(n): lambda at=at: population.finger.evaluate(at) for n, at in points.items()}, 5)
    return {
        "shares_evaluations_exact_vs_surrogate": count["exact"] / surrogate.evaluations,
        "shares_model_seconds_exact_vs_surrogate": seconds[str(count["exact"])] / seconds[str(surrogate.evaluations)],
        "shares_largest_shift": max(shifts),
        "shares_shift_certified": float(np.max(surrogate.cross_validation_error)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--fingers", type=int, default=1000)
    parser.add_argument("--one", type=int, nargs=2, metavar=("FINGERS", "SAMPLES"), help="one run alone")
    given = parser.parse_args()
    if given.one:
        print(json.dumps(measure_run(*given.one)))
        return
    tenth = run_in_process(given.fingers // 10, SAMPLES)
    whole = run_in_process(given.fingers, SAMPLES)
    longer = run_in_process(given.fingers // 10, LONGER * SAMPLES)
    show(
        {
            f"seconds_{given.fingers}_fingers": whole["seconds"],
            f"memory_mb_{given.fingers}_fingers": whole["memory"],
            "seconds_vs_a_tenth_of_the_fingers": whole["seconds"] / tenth["seconds"],
            "memory_vs_a_tenth_of_the_fingers": whole["memory"] / tenth["memory"],
            "memory_vs_a_tenth_of_the_samples": longer["memory"] / tenth["memory"],
        }
        | shares(),
        given.json,
    )


if __name__ == "__main__":
    main()
