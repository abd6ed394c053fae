"""Coverage of populations of tracked fingers: how fingers differ, and how each changes, drawn and recovered.

The design was fixed before the first run. Medians, Ci, differences between fingers and their correlation come from the
hyperprior, as in `population_calibration`. Each finger's log Rsc and log Csc change as independent Ornstein-Uhlenbeck
processes, with standard deviations from a half-normal distribution of scale `CHANGE` and a time scale of 0.1 to 10
records, so that some look stationary and some like random walks. What belongs to a record's average counts as a
difference between fingers: the true values are those of averages over a record, and of the variance about them.

A window states log g and log b with normal errors (`summarize`); with `--complete`, records of `RATE` are simulated
with numpy, tracked and handed on. Intervals of 50 % and 90 % must cover within three binomial standard deviations.

    python -m tests.within_calibration [--populations 100] [--seed 1] [--workers 2] [--complete] [--still]

With `--still` no finger changes: the standard deviation within must be compatible with 0, and the differences between
fingers are those of the plain population of the same fingers.
"""

import argparse
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.stats

import fitact
from fitact.tracking.random_walk import WindowInformation
from fitact.tracking.time_average import average_windows
from fitact.tracking.tracked_finger import TrackedFinger
from tests.calibration import AMPLITUDE, THICKNESS, collect, wave
from tests.calibration import PER_PERIOD as SAMPLES
from tests.population_calibration import (
    FACTORS,
    FREQUENCY,
    MEDIANS,
    NOISE,
    PRIOR,
    SPREAD,
    show_coverage,
    vsc,
)

FINGERS, WINDOWS = 8, 40
CHANGE = 0.15  # half-normal scale of the standard deviations of changes
TIME_SCALES = (0.1, 10.0)  # of changes, in records
DURATION, RATE = 10.0, 5e3  # of a complete record, s and Hz
ERRORS = np.array([2e-3, 5e-3])  # of log g and log b in a window
FINE = 10  # steps of a path in a window
QUANTITIES = ("Rsc", "Csc", "Ci", "log_sd_Rsc", "log_sd_Csc", "correlation", "force_mean")
WITHIN = ("within_Rsc", "within_Csc", "within_force_mean")


class Law(NamedTuple):
    """A population, and how its fingers change: covariances over the steps of a record."""

    median: np.ndarray  # of log Rsc and log Csc
    log_Ci: float
    between: np.ndarray  # (2, 2), of levels
    change: np.ndarray  # (2,), standard deviations
    path: np.ndarray  # (steps, steps), correlation in time

    @classmethod
    def draw(cls, rng: np.random.Generator, change: float) -> "Law":
        score = scipy.stats.norm.ppf(0.975)
        medians = {name: MEDIANS[name] * FACTORS[name] ** (rng.standard_normal() / score) for name in MEDIANS}
        spread, r = SPREAD * np.abs(rng.standard_normal(2)), 2.0 * rng.beta(2.0, 2.0) - 1.0
        between = np.outer(spread, spread) * np.array([[1.0, r], [r, 1.0]])
        scale = np.exp(rng.uniform(*np.log(TIME_SCALES)))
        steps = np.arange(WINDOWS * FINE) / (WINDOWS * FINE)
        path = np.exp(-np.abs(steps[:, None] - steps) / scale)
        median = np.log([medians["Rsc"], medians["Csc"]])
        return cls(median, float(np.log(medians["Ci"])), between, change * np.abs(rng.standard_normal(2)), path)

    def fingers(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Return paths of log Rsc and log Csc, (fingers, steps, 2)."""
        levels = self.median + rng.standard_normal((count, 2)) @ np.linalg.cholesky(self.between).T
        root = np.linalg.cholesky(self.path + 1e-10 * np.eye(len(self.path)))
        moves = np.einsum("ij,fjp->fip", root, rng.standard_normal((count, len(root), 2)))
        return levels[:, None] + self.change * moves

    def truth(self, rng: np.random.Generator) -> dict[str, float]:
        """Return the true values over records."""
        windows = self.path.reshape(WINDOWS, FINE, WINDOWS, FINE).mean(axis=(1, 3))
        whole = np.mean(windows)
        about = np.square(self.change) * (np.mean(np.diag(windows)) - whole)
        averages = self.between + whole * np.diag(np.square(self.change))
        sd = np.sqrt(np.diag(averages))
        some = self.median + rng.standard_normal((100, 2)) @ np.linalg.cholesky(averages).T
        slopes = np.stack([gradient(skin, self.log_Ci) for skin in some])
        next_one = self.fingers(1, rng)[0, rng.integers(len(self.path))]
        values = (
            *np.exp(self.median),
            np.exp(self.log_Ci),
            *sd,
            averages[0, 1] / np.prod(sd),
            force(next_one, self.log_Ci),
        )
        within = (*np.sqrt(about), np.sqrt(np.mean(np.square(slopes) @ about)))
        return dict(zip((*QUANTITIES, *WITHIN), map(float, (*values, *within)), strict=True))


def force(skin: np.ndarray, log_Ci: float) -> float:
    """Return the mean force on a finger, N, eqs. (3), (20) and (22), by the triangle's Fourier series."""
    (Rsc, Csc), Ci, n = np.exp(skin), np.exp(log_Ci), np.arange(1.0, 400.0, 2.0)
    s = 2j * np.pi * FREQUENCY * n
    gain = s * Rsc * Ci / (1.0 + s * Rsc * (2.0 * Ci + Csc))
    mean_square = 0.5 * np.sum(np.square(8.0 * AMPLITUDE / (np.pi * n) ** 2 * np.abs(gain)))
    return float(mean_square * (Ci * Csc / (Ci + Csc)) / (2.0 * THICKNESS))


def gradient(skin: np.ndarray, log_Ci: float, step: float = 0.01) -> np.ndarray:
    """Return the derivatives of the logarithm of the force in log Rsc and log Csc."""
    ends = [[np.log(force(skin + sign * move, log_Ci)) for sign in (1.0, -1.0)] for move in step * np.eye(2)]
    return np.array([(upper - lower) / (2.0 * step) for upper, lower in ends])


def window_record(skin: np.ndarray, Ci: float, rng: np.random.Generator) -> fitact.Record:
    """Return two periods of a finger that does not change."""
    time, V = np.arange(2 * SAMPLES) / (SAMPLES * FREQUENCY), np.tile(wave("triangle", rng), 2)
    values = np.tile(vsc(*np.exp(skin), Ci, rng), 2)
    return fitact.Record.from_arrays(time, V=V, Vsc=values + NOISE * rng.standard_normal(time.size), source="window")


def summarize(paths: np.ndarray, log_Ci: float, rng: np.random.Generator) -> list[TrackedFinger]:
    """Return tracked fingers whose windows state log g and log b with `ERRORS`."""
    tracked, prior = [], (np.array([0.0, 0.0, np.log(MEDIANS["Ci"])]), 0.1**2 * np.eye(3))
    for number, path in enumerate(paths):
        theta = np.column_stack([path.reshape(WINDOWS, FINE, 2).mean(axis=1), np.full(WINDOWS, log_Ci)])
        g = 1.0 / (2.0 + np.exp(theta[:, 1] - log_Ci))
        one, zero = np.ones(WINDOWS), np.zeros(WINDOWS)
        rows = [[zero, 2.0 * g - 1.0, 1.0 - 2.0 * g], [one, 1.0 - 2.0 * g, 2.0 * g], [zero, zero, zero]]
        factor = np.moveaxis(np.array(rows), -1, 0)
        factor[:, :2] /= ERRORS[:, None]
        target = np.einsum("kij,kj->ki", factor, theta)
        target[:, :2] += rng.standard_normal((WINDOWS, 2))
        information, used = WindowInformation(factor, target), np.ones(WINDOWS, bool)
        names = ("Rsc", "Csc", "Ci")
        average = average_windows(information, used, names, prior, (), theta.mean(axis=0), DURATION)
        assert average is not None
        window = window_record(path.mean(axis=0), np.exp(log_Ci), rng)
        tracked.append(TrackedFinger(f"finger {number}", average, 1.0, window, ""))
    return tracked


def records_of_changing_fingers(paths: np.ndarray, log_Ci: float, rng: np.random.Generator) -> list[fitact.Record]:
    """Simulate y' = -Vsc / Rsc with y = (Csc + 2 Ci) Vsc - Ci V, with straight lines between the paths' steps."""
    time, substeps, Ci = np.arange(round(DURATION * RATE)) / RATE, 4, np.exp(log_Ci)
    fine = np.arange(-round(0.2 * RATE) * substeps, time.size * substeps) / (RATE * substeps)
    steps = (np.arange(paths.shape[1]) + 0.5) * DURATION / paths.shape[1]
    phase = fine * FREQUENCY
    V = AMPLITUDE * np.interp(phase % 1.0, [0.0, 0.25, 0.75, 1.0], [0.0, 1.0, -1.0, 0.0])
    records = []
    for number, path in enumerate(paths):
        Rsc, Csc = (np.exp(np.interp(fine, steps, each)) for each in path.T)
        total, middle = Csc + 2.0 * Ci, slice(None, -1)
        x = 1.0 / (RATE * substeps * Rsc * total)
        decay, pushed = np.exp(-x), Ci * np.expm1(-x) * (V + 0.5 * np.diff(V, append=V[-1]))
        y, values = 0.0, np.empty(fine.size)
        for k, (kept, added) in enumerate(zip(decay[middle].tolist(), pushed[middle].tolist(), strict=True)):
            values[k] = y
            y = kept * y + added
        values[-1] = y
        Vsc = ((values + Ci * V) / total)[-time.size * substeps :: substeps]
        recorded = {"V": V[-time.size * substeps :: substeps], "Vsc": Vsc + NOISE * rng.standard_normal(time.size)}
        records.append(fitact.Record.from_arrays(time, source=f"finger {number}", **recorded))
    return records


def places(number: int, seed: int, complete: bool = False, change: float = CHANGE) -> dict[str, Any]:
    """Return the places of the true values of one population, and the warnings."""
    began, rng = time.perf_counter(), np.random.default_rng([seed, number])
    law = Law.draw(rng, change)
    truth, paths = law.truth(rng), law.fingers(FINGERS, rng)
    scene = fitact.Scene.from_dict({"drive": {"waveform": "triangle", "frequency": FREQUENCY}, "prior": PRIOR})
    if complete:
        records = records_of_changing_fingers(paths, law.log_Ci, rng)
        tracked: list[Any] = [fitact.track(each, scene, window=DURATION / WINDOWS) for each in records]
    else:
        tracked = summarize(paths, law.log_Ci, rng)
    found = fitact.population(tracked, scene, seed=number, progress=False)
    assert found.within is not None
    draws = found.new_fingers() | found.parameters()  # Rsc and Csc are the medians
    draws |= {f"within_{name}": np.sqrt(each.variance) for name, each in found.within.pooled.items()}
    row = {"record": number, "places": {name: float(np.mean(draws[name] < truth[name])) for name in truth}}
    row |= {"may_be_zero": found.within.pooled["force_mean"].may_be_zero, "truth": truth}
    row |= {"sd": {name: float(np.median(draws[name])) for name in ("log_sd_Rsc", "log_sd_Csc", *WITHIN)}}
    if change == 0.0:
        still = [window_record(path[0], np.exp(law.log_Ci), rng) for path in paths]
        plain = fitact.population(still, scene, seed=number, progress=False).parameters()
        row["shift"] = {
            name: float((np.mean(draws[name]) - np.mean(plain[name])) / np.std(plain[name]))
            for name in ("log_sd_Rsc", "log_sd_Csc")
        }
    row |= {"trusted": found.trusted, "warnings": list(found.warnings), "integrals_off": found.off}
    return row | {"steps": found.convergence.steps, "seconds": time.perf_counter() - began}


def complete_places(number: int, seed: int) -> dict[str, Any]:
    return places(number, seed, complete=True)


def still_places(number: int, seed: int) -> dict[str, Any]:
    return places(number, seed, change=0.0)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--populations", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--complete", action="store_true")
    parser.add_argument("--still", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("out/within"))
    chosen = parser.parse_args()
    task = complete_places if chosen.complete else still_places if chosen.still else places
    path = chosen.out / f"{task.__name__}.jsonl"
    rows = collect(path, chosen.populations, chosen.seed, chosen.workers, task)
    passed = show_coverage(rows, QUANTITIES if chosen.still else (*QUANTITIES, *WITHIN))
    zero = sum(row["may_be_zero"] for row in rows)
    print(f"compatible with fingers that do not change: {zero} of {len(rows)}")
    if chosen.still:
        shifts = np.array([list(row["shift"].values()) for row in rows])
        print(f"standard deviations differ from a plain population's by {np.abs(shifts).max():.2f} sd at most")
        passed &= zero >= 0.9 * len(rows)
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
