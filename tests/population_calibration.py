"""Coverage of populations: parameters drawn from the hyperprior, fingers from each population, records of the fingers.

The design was fixed before the first run. Truths come from `PRIOR` and the hyperprior of docs/population.md. A record
is two steady-state periods of a triangle from scipy's state space, with `NOISE`. The place of a truth is the posterior
probability below it. Central intervals of 50 % and 90 % must cover within three binomial standard deviations, for the
population parameters and for the mean force of a new finger. Every population counts; a population that is refused has
no places, and fails the run.

    python -m tests.population_calibration [--populations 100] [--seed 1] [--workers 2] [--out out/population]

Places are saved in DIR/places.jsonl, from which the next run of the same code resumes. Each population has its own
seed, so the first 20 are the same in every run.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.stats

import fitact
from tests.calibration import PER_PERIOD as SAMPLES
from tests.calibration import THICKNESS, collect, steady, wave

FINGERS = 20
MEDIANS = {"Rsc": 130e3, "Csc": 20e-9, "Ci": 1.35e-9}  # ohm, F, F
FACTORS = {"Rsc": 2.0, "Csc": 2.0, "Ci": 1.2}  # factors that contain 95 %
PRIOR = {name: {"median": MEDIANS[name], "factor": FACTORS[name]} for name in MEDIANS}
SPREAD = 0.5  # half-normal scale of the log-standard deviations
NOISE = 0.3  # noise sd, V
FREQUENCY = 100.0  # Hz
QUANTITIES = ("Rsc", "Csc", "Ci", "log_sd_Rsc", "log_sd_Csc", "correlation", "force_mean")
INTERVALS = (0.5, 0.9)
SIGMAS = 3.0


class Simulated(NamedTuple):
    """Simulated records of several fingers with their scene and true values in SI units."""

    records: list[fitact.Record]
    scene: fitact.Scene
    truth: dict[str, float]


def simulate(seed: int, number: int, fingers: int = FINGERS, noise: float = NOISE) -> Simulated:
    """Simulate population `number`."""
    rng = np.random.default_rng([seed, number])
    Rsc, Csc, Ci = draw_medians(rng)
    spread = SPREAD * np.abs(rng.standard_normal(2))
    r = 2.0 * rng.beta(2.0, 2.0) - 1.0
    root = spread[:, None] * np.array([[1.0, 0.0], [r, np.sqrt(1.0 - r**2)]])
    skins = np.log([Rsc, Csc]) + rng.standard_normal((fingers + 1, 2)) @ root.T
    settled = [vsc(*np.exp(skin), Ci, rng) for skin in skins]
    records = [
        fitact.Record.from_arrays(
            np.arange(2 * SAMPLES) / (SAMPLES * FREQUENCY),
            V=np.tile(wave("triangle", rng), 2),
            Vsc=np.tile(values, 2) + noise * rng.standard_normal(2 * SAMPLES),
            source=f"finger {finger} of population {number}",
        )
        for finger, values in enumerate(settled[:-1])
    ]
    next_Csc = np.exp(skins[-1, 1])
    force = np.mean(settled[-1] ** 2) * (Ci * next_Csc / (Ci + next_Csc)) / (2.0 * THICKNESS)  # eqs. (3), (22)
    scene = fitact.Scene.from_dict({"drive": {"waveform": "triangle", "frequency": FREQUENCY}, "prior": PRIOR})
    return Simulated(records, scene, dict(zip(QUANTITIES, (Rsc, Csc, Ci, *spread, r, force), strict=True)))


def draw_medians(rng: np.random.Generator) -> tuple[float, float, float]:
    """Draw the medians of Rsc (ohm) and Csc (F), and Ci (F), from `PRIOR`."""
    score = scipy.stats.norm.ppf(0.975)
    Rsc, Csc, Ci = (MEDIANS[name] * FACTORS[name] ** (rng.standard_normal() / score) for name in MEDIANS)
    return Rsc, Csc, Ci


def vsc(Rsc: float, Csc: float, Ci: float, rng: np.random.Generator) -> np.ndarray:
    """Return one steady-state period of Vsc of a finger, V."""
    total = 2.0 * Ci + Csc
    return steady("triangle", FREQUENCY, wave("triangle", rng), Ci / total, Rsc * total)


def places(number: int, seed: int) -> dict[str, Any]:
    """Return the places of the true values of one population, and the warnings."""
    began = time.perf_counter()
    simulated = simulate(seed, number)
    row: dict[str, Any] = {"record": number}
    try:
        found = fitact.population(simulated.records, simulated.scene, seed=number, progress=False)
    except fitact.InputError as error:
        return row | {"refused": str(error)}
    draws = found.new_fingers() | found.parameters()  # Rsc and Csc are the medians
    row |= {"places": {name: float(np.mean(draws[name] < simulated.truth[name])) for name in QUANTITIES}}
    row |= {"trusted": found.trusted, "warnings": list(found.warnings), "integrals_off": found.off}
    return row | {"steps": found.convergence.steps, "seconds": time.perf_counter() - began}


def coverage(found: np.ndarray, share: float) -> tuple[float, float]:
    """Return the coverage of the central interval, and its excess in binomial standard deviations."""
    covered = float(np.mean(np.abs(found - 0.5) < 0.5 * share))
    return covered, float((covered - share) / np.sqrt(share * (1.0 - share) / found.size))


def show_coverage(
    rows: list[dict[str, Any]], quantities: Sequence[str], intervals: Sequence[float] = INTERVALS
) -> bool:
    """Print the coverage of each quantity; return whether all intervals cover, and no population was refused."""
    refused = [row["refused"] for row in rows if "refused" in row]
    answered = [row for row in rows if "refused" not in row]
    passed = not refused
    print(f"{'':18}" + "".join(f"{f'{100 * share:.0f} %':>8}{'off by':>8}" for share in intervals) + f"{'KS p':>8}")
    for name in quantities:
        found = np.array([row["places"][name] for row in answered])
        covered = [coverage(found, share) for share in intervals]
        passed &= all(abs(off) <= SIGMAS for _, off in covered)
        cells = "".join(f"{100.0 * each:8.1f}{off:+8.1f}" for each, off in covered)
        print(f"{name:18}{cells}{scipy.stats.kstest(found, 'uniform').pvalue:8.3f}")
    print(f"not trusted: {sum(not row['trusted'] for row in answered)} of {len(rows)}; refused: {len(refused)}")
    for sentence in [*refused, *(w for row in answered for w in row["warnings"])]:
        print(sentence)
    print("passed" if passed else "FAILED")
    return passed


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--populations", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("out/population"))
    chosen = parser.parse_args()
    rows = collect(chosen.out / "places.jsonl", chosen.populations, chosen.seed, chosen.workers, places)
    return 0 if show_coverage(rows, QUANTITIES) else 1


if __name__ == "__main__":
    sys.exit(main())
