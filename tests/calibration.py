"""Simulation-based calibration: records of known truth are fitted and sampled, and the truths are ranked.

The design was fixed before the first run. Truths come from `PRIOR`, drives and lengths from `DRIVES` and `LENGTHS`, and
Vsc from scipy's state space. A rank is that of the truth among 99 draws. For a correct posterior, the ranks of each
quantity are uniform over 0 to 99 (Talts et al. 2018). The statistic is the largest deviation of their empirical
distribution in either tail (Säilynoja, Bürkner, Vehtari 2022). Its p-value is exact, with Holm's correction for seven
quantities at 1 %. Central intervals of 50 % and 90 % must cover the truth within three binomial standard deviations.
emcee and psis must pass both tests. Laplace is shown for the same records: deviations common to all methods are
sampling noise of the data. Every record counts, also one whose fit is unreliable or whose posterior is refused, because
a selection by the data would bias the ranks. A record that `fitact.fit` refuses has no ranks, and fails the run.

    python -m tests.calibration [--records 1000] [--seed 1] [--workers 2] [--out out/calibration]

Ranks are saved in DIR/ranks.jsonl, from which the next run of the same code resumes. Each record has its own seed, so
the first 100 are the same in every run.
"""

import argparse
import concurrent.futures
import dataclasses
import hashlib
import inspect
import json
import multiprocessing
import os
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.optimize
import scipy.signal
import scipy.stats

import fitact
from fitact.files import atomic_write

QUANTITIES = ("Rsc", "Csc", "Ci", "a", "b", "sigma", "force_mean")
LEVELS = ("emcee", "psis", "laplace")
BINDING = ("emcee", "psis")
DRAWS = 99
VALUES = DRAWS + 1  # number of possible ranks
INTERVALS = (0.5, 0.9)
ERROR = 0.01  # false-alarm probability of all quantities of a method together
SIGMAS = 3.0  # allowed deviation of a coverage, in binomial standard deviations
RECYCLED = 150  # records per process: JAX keeps all compiled code, 10 MB a record, until the memory maps run out

MEDIANS = {"Rsc": 130e3, "Csc": 20e-9, "Ci": 1.35e-9}  # ohm, F, F
FACTORS = {"Rsc": 3.0, "Csc": 3.0, "Ci": 1.5}  # factors that contain 95 %
NOISE = (0.05, 2.0)  # bounds on the noise sd, V
PRIOR: dict[str, Any] = {name: {"median": MEDIANS[name], "factor": FACTORS[name]} for name in MEDIANS}
PRIOR["sigma"] = {"low": NOISE[0], "high": NOISE[1], "scale": "log"}
AMPLITUDE = 180.0  # half the peak-to-peak voltage, V
PER_PERIOD = 400  # samples per period
RISE = 0.05  # rise time of the trapezoid in periods
THICKNESS = 201e-6  # thickness of insulator and skin together in the default scene, m
LENGTHS = (700, 1000, 1500, 2200, 3000)  # numbers of samples
# so few that most records find their functions compiled
DRIVES = (
    ("square", 100.0),
    ("square", 250.0),
    ("sine", 100.0),
    ("sine", 40.0),
    ("triangle", 100.0),
    ("trapezoid", 100.0),
    ("measured", 100.0),
    ("measured", 250.0),
)


# ------------------------------------------------------------------ records of known truth


class Simulated(NamedTuple):
    """Simulated record with its scene and its true values in SI units."""

    record: fitact.Record
    scene: fitact.Scene
    truth: dict[str, float]


def simulate(seed: int, number: int) -> Simulated:
    """Simulate record `number` with random true values, drive and length."""
    rng = np.random.default_rng([seed, number])
    spread = scipy.stats.norm.ppf(0.975)
    Rsc, Csc, Ci = (MEDIANS[name] * FACTORS[name] ** (rng.standard_normal() / spread) for name in MEDIANS)
    sigma = float(np.exp(rng.uniform(*np.log(NOISE))))
    waveform, frequency = DRIVES[rng.integers(len(DRIVES))]
    count = int(rng.choice(LENGTHS))
    time = np.arange(count) / (PER_PERIOD * frequency)
    period = wave(waveform, rng)
    voltage = np.resize(period, count)
    g, b = Ci / (2.0 * Ci + Csc), Rsc * (2.0 * Ci + Csc)
    if waveform == "measured":
        vsc = skin_voltage(time, voltage, g, b, 0.0)
        mean_square = np.mean(vsc[: count // PER_PERIOD * PER_PERIOD] ** 2)
    else:
        settled = steady(waveform, frequency, period, g, b)
        vsc, mean_square = np.resize(settled, count), steady_mean_square(waveform, frequency, settled, g, b)
    drive = {"waveform": waveform, "frequency": frequency, "peak_to_peak": 2.0 * AMPLITUDE}
    drive |= {"rise_time": RISE / frequency} if waveform == "trapezoid" else {}
    drive |= {"steady_state": False} if waveform == "measured" else {}  # the record begins at rest
    record = fitact.Record.from_arrays(
        time, V=voltage, Vsc=vsc + sigma * rng.standard_normal(count), source=f"record {number}"
    )
    force = mean_square * (Ci * Csc / (Ci + Csc)) / (2.0 * THICKNESS)  # eq. (22) with eq. (3) for the permittivities
    truth = dict(zip(QUANTITIES, (Rsc, Csc, Ci, Rsc * Ci, b, sigma, force), strict=True))
    return Simulated(record, fitact.Scene.from_dict({"drive": drive, "prior": PRIOR}), truth)


def wave(waveform: str, rng: np.random.Generator) -> np.ndarray:
    """Return one period of the drive, V; a measured drive has random harmonics and a random amplitude."""
    phase = np.arange(PER_PERIOD) / PER_PERIOD
    if waveform == "measured":
        shares, phases = np.array([1.0, *rng.uniform(0.0, 0.3, 3)]), rng.uniform(0.0, 1.0, 4)
        turns = np.arange(1, 5)[:, None] * phase + phases[:, None]
        return AMPLITUDE * rng.uniform(0.5, 1.0) * shares @ np.sin(2.0 * np.pi * turns)
    if waveform == "sine":
        return AMPLITUDE * np.sin(2.0 * np.pi * phase)
    if waveform == "square":
        return np.where(phase < 0.5, AMPLITUDE, -AMPLITUDE)
    corners = {
        "triangle": ([0.0, 0.25, 0.75, 1.0], [0.0, 1.0, -1.0, 0.0]),
        "trapezoid": ([0.0, RISE, 0.5, 0.5 + RISE, 1.0], [-1.0, 1.0, 1.0, -1.0, -1.0]),
    }
    return AMPLITUDE * np.interp(phase, *corners[waveform])


def skin_voltage(
    time: np.ndarray, voltage: np.ndarray, g: float, b: float, charge: float, hold: bool = False
) -> np.ndarray:
    """Return Vsc for a drive that is linear (with hold, constant) between samples; `charge` is the initial state, V."""
    return scipy.signal.lsim((-1.0 / b, 1.0 / b, -g, g), voltage, time, charge, interp=not hold)[1]


def steady(waveform: str, frequency: float, period: np.ndarray, g: float, b: float) -> np.ndarray:
    """Return one period of Vsc in the steady state, V."""
    phase = np.arange(PER_PERIOD + 1) / PER_PERIOD
    if waveform == "sine":
        omega = 2.0 * np.pi * frequency
        gain = AMPLITUDE * g * 1j * omega * b / (1.0 + 1j * omega * b)
        return np.imag(gain * np.exp(2j * np.pi * phase[:-1]))
    time, hold, closed = phase / frequency, waveform == "square", np.append(period, period[0])
    # the charge after a period equals that before it: charge = reached from zero + charge e^{-T/b}
    reached = closed[-1] - skin_voltage(time, closed, g, b, 0.0, hold)[-1] / g
    charge = reached / -np.expm1(-time[-1] / b)
    return skin_voltage(time, closed, g, b, charge, hold)[:-1]


def steady_mean_square(waveform: str, frequency: float, settled: np.ndarray, g: float, b: float) -> float:
    """Return the mean square of Vsc over a period, V^2; closed form for a square, whose jumps samples do not show."""
    if waveform == "square":
        x = 1.0 / (frequency * b)
        return float(4.0 * (AMPLITUDE * g) ** 2 * np.tanh(x / 4.0) / x)
    return float(np.mean(settled**2))


# ------------------------------------------------------------------ ranks


def ranks(number: int, seed: int) -> dict[str, Any]:
    """Rank the true values of one record with every method; also return the warnings."""
    began = time.perf_counter()
    simulated = simulate(seed, number)
    row: dict[str, Any] = {"record": number, "drive": simulated.scene.drive.waveform, "samples": len(simulated.record)}
    try:
        fit = fitact.fit(simulated.record, simulated.scene)
    except fitact.InputError as error:
        return row | {"refused": str(error)}
    model = fit.model()
    row |= {"result": fit.result, "freed": model["freed"], "likelihood": model["likelihood"], "ranks": {}, "bad": []}
    for level in LEVELS:
        posterior = fitact.sample(fit, level=level, seed=number, progress=False)
        found = drawn(posterior, np.random.default_rng([seed, number, 1]))
        row["ranks"][level] = [int(np.sum(found[name] < simulated.truth[name])) for name in QUANTITIES]
        row["bad"] += [level] * (not posterior.convergence.converged)
    return row | {"seconds": time.perf_counter() - began}


def drawn(posterior: fitact.Posterior, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return so few of the draws that they are independent."""
    count = posterior.log_prob.size
    chosen = rng.choice(count, DRAWS, replace=False)
    few = dataclasses.replace(
        posterior,
        points=posterior.points.reshape(1, count, -1)[:, chosen],
        log_prob=posterior.log_prob.reshape(1, -1)[:, chosen],
    )
    draws = few.parameters() | few.derived()
    draws["a"] = draws["Rsc"] * draws["Ci"]
    return draws


def collect(
    path: Path,
    records: int,
    seed: int,
    workers: int,
    task: Callable[[int, int], dict[str, Any]] = ranks,
    recycled: int = RECYCLED,
) -> list[dict[str, Any]]:
    """Return the rows of `task` for records 0 to `records`; rows missing in the file are computed and appended."""
    header = {"seed": seed, "sources": sources(inspect.getfile(task))}
    lines = path.read_text().splitlines(keepends=True) if path.exists() else []
    whole = [json.loads(line) for line in lines if line.endswith("\n")]  # a killed run may leave an incomplete line
    if whole and whole[0] != header:
        print(f"{path} is of another seed or other code: begun anew", file=sys.stderr)
        whole = []
    rows = {row["record"]: row for row in whole[1:]}
    missing = [number for number in range(records) if number not in rows]
    with atomic_write(path) as temporary:
        temporary.write_text("".join(json.dumps(row) + "\n" for row in [header, *rows.values()]))
    began = time.monotonic()
    with path.open("a") as file:
        for done, row in enumerate(computed(missing, seed, workers, task, recycled), 1):
            rows[row["record"]] = row
            file.write(json.dumps(row) + "\n")
            file.flush()
            left = (time.monotonic() - began) / done * (len(missing) - done) / 60.0
            print(f"\r{len(rows)} of {records} records, {left:.0f} min left ", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return [rows[number] for number in range(records)]


def computed(
    numbers: list[int], seed: int, workers: int, task: Callable[[int, int], dict[str, Any]], recycled: int
) -> Iterator[dict[str, Any]]:
    """Yield the rows of the records in the order of completion."""
    each = recycled * workers
    for first in range(0, len(numbers), each):
        with pool(workers) as executor:
            futures = [executor.submit(task, number, seed) for number in numbers[first : first + each]]
            try:
                yield from (future.result() for future in concurrent.futures.as_completed(futures))
            except BaseException:  # also Ctrl-C
                executor.shutdown(cancel_futures=True)
                raise


def sources(script: str) -> str:
    """Return the SHA-256 of all code on which the rows depend."""
    files = sorted(Path(fitact.__file__).parent.rglob("*.py"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in [*files, Path(script)])).hexdigest()


def pool(workers: int) -> concurrent.futures.ProcessPoolExecutor:
    """Return a pool of spawned single-threaded processes."""
    threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    threads["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    os.environ.update(threads)
    return concurrent.futures.ProcessPoolExecutor(
        workers, multiprocessing.get_context("spawn"), signal.signal, (signal.SIGINT, signal.SIG_IGN)
    )


# ------------------------------------------------------------------ the statistic


def band(records: int, gamma: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds on the counts of ranks below 1, 2, ... whose two-sided binomial tail exceeds gamma."""
    z, tail = np.arange(1, VALUES) / VALUES, 0.5 * gamma * (1.0 + 1e-9)  # an equal tail counts as outside
    return scipy.stats.binom.ppf(tail, records, z).astype(int), scipy.stats.binom.isf(tail, records, z).astype(int)


def leaving(records: int, gamma: float) -> float:
    """Return the exact probability that uniform ranks leave the band, from the Markov chain of the counts."""
    at, inside = np.zeros(1, dtype=int), np.ones(1)
    for i, (low, high) in enumerate(zip(*band(records, gamma), strict=True)):
        onto = np.arange(low, high + 1)
        step = scipy.stats.binom.pmf(onto - at[:, None], records - at[:, None], 1.0 / (VALUES - i))
        at, inside = onto, inside @ step
    return float(1.0 - np.sum(inside))


def p_value(found: np.ndarray) -> float:
    """Return the p-value of ranks under uniformity over 0 to `DRAWS`."""
    z = np.arange(1, VALUES) / VALUES
    below = np.sum(found[:, None] < np.arange(1, VALUES), axis=0)
    law = scipy.stats.binom(found.size, z)
    gamma = 2.0 * min(np.min(law.cdf(below)), np.min(law.sf(below - 1)))
    if gamma < 1e-8:
        return DRAWS * gamma  # an upper bound, since the exact value takes long for a wide band
    return leaving(found.size, gamma) if gamma < 1.0 else 1.0


def holm(p: np.ndarray) -> np.ndarray:
    """Return p-values adjusted for their number (Holm 1979)."""
    order = np.argsort(p)
    adjusted = np.maximum.accumulate(p[order] * np.arange(p.size, 0, -1))
    out = np.empty_like(p)
    out[order] = np.minimum(adjusted, 1.0)
    return out


def off(found: np.ndarray, share: float) -> float:
    """Return the excess coverage of the central interval, in binomial standard deviations."""
    outside = 0.5 * (1.0 - share) * VALUES
    covered = np.mean((found >= outside) & (found < VALUES - outside))
    return float((covered - share) / np.sqrt(share * (1.0 - share) / found.size))


class Judged(NamedTuple):
    """Test results of one method by quantity: adjusted p-values, and the excess coverage of each of `INTERVALS`."""

    p: np.ndarray
    off: np.ndarray

    @property
    def passed(self) -> bool:
        return bool(np.all(self.p > ERROR) and np.all(np.abs(self.off) <= SIGMAS))


def judge(found: np.ndarray) -> Judged:
    """Test the ranks (records, quantities) of one method."""
    columns = found.T
    return Judged(
        holm(np.array([p_value(column) for column in columns])),
        np.array([[off(column, share) for share in INTERVALS] for column in columns]),
    )


# ------------------------------------------------------------------ what people look at


def table(found: dict[str, np.ndarray], judged: dict[str, Judged]) -> str:
    """Format a row per quantity and method; the last column is the mean rank less Laplace's, in standard errors."""
    heads = "".join(f"{f'{100 * share:.0f} %':>8}{'off by':>8}" for share in INTERVALS)
    rows = [f"{'':12}{'level':9}{'p (Holm)':>9}{heads}{'mean rank':>11}{'less Laplace':>14}"]
    for i, name in enumerate(QUANTITIES):
        for level in LEVELS:
            column, result = found[level][:, i], judged[level]
            cover = "".join(
                f"{100 * (share + sds * np.sqrt(share * (1 - share) / column.size)):8.1f}{sds:+8.1f}"
                for share, sds in zip(INTERVALS, result.off[i], strict=True)
            )
            pair = (column - found["laplace"][:, i]) / VALUES
            less = f"{np.mean(pair):+8.4f} ± {np.std(pair) / np.sqrt(pair.size):.4f}" if np.any(pair) else ""
            mean = (np.mean(column) + 0.5) / VALUES
            rows.append(f"{name:12}{level:9}{result.p[i]:9.3f}{cover}{mean:11.4f}{less:>19}")
    return "\n".join(rows)


def counts(rows: list[dict[str, Any]]) -> str:
    """Format the numbers of warnings; no result was excluded."""
    kept = [row for row in rows if "refused" not in row]
    bad = Counter(level for row in kept for level in row["bad"])
    lines = [
        f"{len(rows)} records, refused: {len(rows) - len(kept)}",
        f"fits by result: {dict(Counter(row['result'] for row in kept))}",
        f"nuisances freed: {dict(Counter(name for row in kept for name in row['freed']))}",
        f"likelihood: {dict(Counter(row['likelihood'] for row in kept))}",
        f"levels that refused themselves or did not converge: { {level: bad[level] for level in LEVELS} }",
        f"seconds a record: {np.median([row['seconds'] for row in kept]):.1f} (median)",
    ]
    return "\n".join([*lines, *(row["refused"] for row in rows if "refused" in row)])


def draw(found: dict[str, np.ndarray], path: Path) -> None:
    """Plot the empirical distribution of the ranks less the uniform one, with a band that 1 of 700 runs leaves."""
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams |= {"svg.fonttype": "none", "svg.hashsalt": "fitact"}  # small, reproducible files
    from matplotlib import pyplot as plt

    records = len(found["emcee"])
    gamma = scipy.optimize.brentq(lambda log: leaving(records, np.exp(log)) - ERROR / len(QUANTITIES), -16.0, -3.0)
    z = np.arange(VALUES + 1) / VALUES
    edges = [np.concatenate([[0], edge, [records]]) / records - z for edge in band(records, float(np.exp(gamma)))]
    figure, axes = plt.subplots(2, 4, figsize=(11, 5), sharex=True, sharey=True, layout="constrained")
    styles = dict(zip(LEVELS, ({"color": "C0"}, {"color": "C1"}, {"color": "k", "ls": ":"}), strict=True))
    for i, (name, axis) in enumerate(zip(QUANTITIES, axes.flat, strict=False)):
        axis.fill_between(z, *edges, color="0.88", step="mid")
        for level in LEVELS:
            below = np.searchsorted(np.sort(found[level][:, i]), np.arange(VALUES + 1)) / records
            axis.plot(z, below - z, lw=1.0, label=level, **styles[level])
        axis.set_title(name, fontsize=10)
    axes[1, 3].axis("off")
    axes[1, 3].legend(*axes[0, 0].get_legend_handles_labels(), loc="center", frameon=False)
    figure.supxlabel("rank of the truth among the draws, as a share")
    figure.supylabel("share of records below, less the uniform's")
    figure.savefig(path, metadata={"Date": None})


def main() -> None:
    """Print the table and write the plot; exit status 1 if emcee or psis fails, or a record was refused."""
    parser = argparse.ArgumentParser(description="simulation-based calibration of fit and sampler")
    parser.add_argument("--records", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--out", type=Path, default=Path("out/calibration"))
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as for Ctrl-C, so that the workers end too
    try:
        rows = collect(options.out / "ranks.jsonl", options.records, options.seed, options.workers)
    except KeyboardInterrupt:
        raise SystemExit("interrupted; the same command goes on from here") from None
    kept = [row for row in rows if "refused" not in row]
    found = {level: np.array([row["ranks"][level] for row in kept]) for level in LEVELS}
    judged = {level: judge(found[level]) for level in LEVELS}
    print(counts(rows), table(found, judged), sep="\n\n")
    print(*(f"{level}: {'passed' if judged[level].passed else 'FAILED'}" for level in LEVELS), sep="\n")
    draw(found, options.out / "calibration.svg")
    raise SystemExit(len(kept) < len(rows) or not all(judged[level].passed for level in BINDING))


if __name__ == "__main__":
    main()
