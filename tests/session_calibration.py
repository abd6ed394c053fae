"""Calibration of stated uncertainties: simulated sessions whose instruments err as their classes allow.

In each session a finger, its panel, the geometry and one error of each piece of equipment are drawn from the
distributions that the scene states. All records of the session share them. They are simulated by transfer functions
over one period with NumPy, independent of fitact, and fitted jointly with `[instrument]`. The central 50, 90 and 95 %
intervals of the budget (Laplace approximation) must contain the truth as often as they say: by exact binomial tests
with Holm's correction at 1 % over all quantities, intervals, set-ups and numbers of records, and within four binomial
standard deviations. As a negative control the same sessions are fitted with each record's equipment named apart, as if
the errors were independent; its coverage of g must fail.

    python -m tests.session_calibration [--sessions 1000] [--seed 1] [--workers 2] [--out out/session_calibration]

Results are appended to DIR/sessions.jsonl, from which the next run resumes. Each session has its own seed.
"""

import argparse
import concurrent.futures
import json
import multiprocessing
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import scipy.signal
import scipy.stats

import fitact

QUANTITIES = ("g", "b", "Rsc", "Csc", "Ci", "force_mean")
INTERVALS = (0.5, 0.9, 0.95)
RECORDS = (1, 5, 10)  # in a session
ERROR = 0.01  # false-alarm probability of all tests together
SIGMAS = 4.0  # allowed deviation of a coverage, in binomial standard deviations

SETUPS: dict[str, dict[str, list[str]]] = {
    "Vsc": {"V": ["scope-8bit:A/CH1", "probe-10x:P1"], "Vsc": ["scope-8bit:A/CH2", "probe-10x:P2"]},
    "Vsc and I": {
        "V": ["scope-8bit:A/CH1", "probe-10x:P1"],
        "Vsc": ["scope-8bit:A/CH2", "probe-10x:P2"],
        "I": ["scope-8bit:A/CH3", "shunt-1%:S"],
    },
    "DAQ": {"V": ["daq-16bit:D/0", "probe-10x:P1"], "Vsc": ["daq-16bit:D/1", "probe-10x:P2"]},
}
# limits of the classes, as docs/uncertainty.md states them
GAIN = {"scope-8bit": 0.03, "daq-16bit": 0.0005, "probe-10x": 0.02, "shunt-1%": 0.01}
NONLINEARITY = {"scope-8bit": 1.0 / 256.0, "daq-16bit": 80e-6}
COMPENSATION, PROBE_TAU = 0.02, 110e-6
SKEW = {"daq-16bit": 1.0}  # sampling intervals
LOAD_R, LOAD_C = (10e6, 0.02), (12e-12, 0.25)

TONES = np.array([1, 2, 3, 5, 7, 10, 14, 19])  # multiples of the frequency
FREQUENCY, PER_PERIOD, PERIODS, RISE, HALF = 100.0, 2000, 2, 1e-4, 180.0
TIME = np.arange(PER_PERIOD) / (FREQUENCY * PER_PERIOD)  # of one period, s
LAPLACE = 2j * np.pi * np.maximum(np.fft.rfftfreq(PER_PERIOD, TIME[1]), 1e-9)  # j omega, rad/s
NOISE = {"Vsc": 0.1, "I": 5e-6}  # V, A: about a step of 8 bits
PRIOR = {"Rsc": ("160 kohm", 1.5), "Csc": ("22 nF", 1.5), "Ci": ("1.35 nF", 1.1)}
THICKNESS, THICKNESS_SD, PANEL = 200e-6, 0.2, 1e-6


def scene(setup: str, suffix: str = "") -> fitact.Scene:
    """Return the scene of a set-up; a `suffix` gives the channels of its oscilloscope other names."""
    return fitact.Scene.from_dict(
        {
            # in a stated steady state, the likelihood is not compressed where a delay is free
            "drive": {"waveform": "measured"} | ({} if setup == "DAQ" else {"steady_state": True}),
            "measurement": {"channels": [name for name in SETUPS[setup] if name != "V"]},
            "instrument": {
                channel: [p + suffix * p.startswith("scope") for p in pieces]
                for channel, pieces in SETUPS[setup].items()
            },
            "prior": {name: {"median": median, "factor": factor} for name, (median, factor) in PRIOR.items()},
            "skin": {"thickness": {"median": f"{THICKNESS} m", "relative_sd": THICKNESS_SD}},
        }
    )


def simulate(setup: str, seed: int, records: int) -> tuple[list[fitact.Record], dict[str, float]]:
    """Simulate the records of a session; return them and the true values."""
    rng = np.random.default_rng([seed, list(SETUPS).index(setup), records])
    z95 = scipy.stats.norm.ppf(0.975)
    medians = {"Rsc": 160e3, "Csc": 22e-9, "Ci": 1.35e-9}
    R, C, Ci = (medians[name] * PRIOR[name][1] ** (rng.standard_normal() / z95) for name in medians)
    skin = THICKNESS * np.exp(np.sqrt(np.log1p(THICKNESS_SD**2)) * rng.standard_normal())
    errors = draw_errors(setup, rng)
    found = [make_record(setup, (R, C, Ci), errors, rng, f"record {number}") for number in range(records)]
    vsc = respond(HALF * wave(setup, TIME), loop(R, C, Ci)[0])
    force = np.mean(vsc**2) / (2.0 * (PANEL + skin)) * Ci * C / (Ci + C)  # eq. (22) with eq. (3)
    truth = {"g": Ci / (2.0 * Ci + C), "b": R * (2.0 * Ci + C), "Rsc": R, "Csc": C, "Ci": Ci, "force_mean": force}
    return found, truth


def draw_errors(setup: str, rng: np.random.Generator) -> dict[str, Any]:
    """Draw the errors of each piece within the limits of its class, and the load of the probe on Vsc."""
    errors: dict[str, Any] = {}
    for pieces in SETUPS[setup].values():
        for piece in pieces:
            kind = piece.partition(":")[0]
            limits = GAIN[kind], 0.5 * NONLINEARITY.get(kind, 0.0), 0.5 * NONLINEARITY.get(kind, 0.0)
            drawn = rng.uniform(-1.0, 1.0, 4) * [*limits, COMPENSATION * (kind == "probe-10x")]
            errors[piece] = dict(zip(("gain", "even", "odd", "compensation"), drawn, strict=True))
    limit = max(SKEW.get(piece.partition(":")[0], 0.0) for piece in SETUPS[setup]["Vsc"]) * TIME[1]
    errors["skew"] = limit * rng.uniform(-1.0, 1.0)
    errors["load"] = [value * (1.0 + limit * rng.uniform(-1.0, 1.0)) for value, limit in (LOAD_R, LOAD_C)]
    return errors


def make_record(
    setup: str, parts: tuple[float, float, float], errors: dict[str, Any], rng: np.random.Generator, source: str
) -> fitact.Record:
    """Simulate a record of a circuit, or a dummy, whose `parts` are Rsc, Csc and Ci."""
    V = HALF * wave(setup, TIME)
    H, Y = loop(*parts, *errors["load"])
    true = {"V": V, "Vsc": respond(V, H), "I": respond(V, Y)}
    recorded = {}
    for channel, pieces in SETUPS[setup].items():
        signal = true[channel]
        for piece in pieces:
            compensation = errors[piece]["compensation"] * LAPLACE * PROBE_TAU / (1.0 + LAPLACE * PROBE_TAU)
            signal = (1.0 + errors[piece]["gain"]) * respond(signal, 1.0 + compensation)
        if channel == "Vsc":
            signal = respond(signal, np.exp(-LAPLACE * errors["skew"]))
        size = np.ptp(signal) / 0.8
        x = (2.0 * signal - signal.min() - signal.max()) / size
        even, odd = (sum(errors[piece][shape] for piece in pieces) for shape in ("even", "odd"))
        signal = signal + size * (even * 0.5 * (3.0 * x**2 - 1.0) + odd * 0.5 * (5.0 * x**3 - 3.0 * x))
        noise = NOISE.get(channel, 0.0) * rng.standard_normal(PERIODS * PER_PERIOD)
        recorded[channel] = np.tile(signal, PERIODS) + noise
    time = np.arange(PERIODS * PER_PERIOD) / (FREQUENCY * PER_PERIOD)
    return fitact.Record.from_arrays(time, **recorded, source=source)


def loop(R: float, C: float, Ci: float, load_R: float = np.inf, load_C: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return Vsc / V and I / V of two equal skins, the first with a load in parallel, in series with Ci."""
    skins = [1.0 / (1.0 / R + 1.0 / r + LAPLACE * (C + c)) for r, c in ((load_R, load_C), (np.inf, 0.0))]
    total = skins[0] + skins[1] + 1.0 / (LAPLACE * Ci)
    return skins[0] / total, 1.0 / total


def wave(setup: str, time: np.ndarray) -> np.ndarray:
    """Return one period of the drive: edges for Vsc alone, and tones for I, which would follow the slope of edges."""
    if "I" not in SETUPS[setup]:
        half = 0.5 / FREQUENCY
        return np.interp(time, [0.0, RISE, half, half + RISE, 2.0 * half], [-1.0, 1.0, 1.0, -1.0, -1.0])
    phases = np.random.default_rng(5).uniform(0.0, 2.0 * np.pi, len(TONES))  # any others would serve
    total = np.sum(np.cos(2.0 * np.pi * FREQUENCY * TONES[:, None] * time + phases[:, None]), axis=0)
    return total / np.max(np.abs(total))


def respond(values: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """Return the response of a transfer function to a periodic signal."""
    return np.fft.irfft(np.fft.rfft(values) * gain, values.size)


def evaluate(setup: str, seed: int, records: int, *, control: bool = False) -> dict[str, Any]:
    """Fit a session; return the probability that the budget gives to values below the truth, for each quantity."""
    measured, truth = simulate(setup, seed, records)
    scenes = [scene(setup, f"_{i}" if control else "") for i in range(records)]
    fit = fitact.fit(measured, scenes)
    below = {}
    grid = np.linspace(1e-4, 1.0 - 1e-4, 4001)
    medians = {**{n: x["q50"] for n, x in fit.derived().items()}}
    values = {name: float(np.exp(fit.theta[fit.names.index(name)])) for name in ("Rsc", "Csc", "Ci")} | medians
    for name in QUANTITIES:
        quantiles = values[name] * fit.budgets[name].quantiles(grid, only_posterior=True)
        quantiles *= values[name] / np.interp(0.5, grid, quantiles)
        below[name] = float(np.interp(truth[name], quantiles, grid, left=0.0, right=1.0))
    return {"setup": setup, "seed": seed, "records": records, "control": control, "result": fit.result, "below": below}


def judge(rows: Iterable[dict[str, Any]], intervals: tuple[float, ...] = INTERVALS) -> list[dict[str, Any]]:
    """Return the coverage of each quantity, set-up, number of records and interval, with its p-value."""
    groups: dict[tuple[str, int, bool], list[dict[str, float]]] = {}
    for row in rows:
        groups.setdefault((row["setup"], row["records"], row["control"]), []).append(row["below"])
    table = []
    for (setup, records, control), found in groups.items():
        for name in QUANTITIES:
            below = np.array([each[name] for each in found])
            for level in intervals:
                hits = int(np.count_nonzero(np.abs(below - 0.5) <= 0.5 * level))
                p = scipy.stats.binomtest(hits, below.size, level).pvalue
                z = (hits / below.size - level) / np.sqrt(level * (1.0 - level) / below.size)
                table.append(
                    {"setup": setup, "records": records, "control": control, "quantity": name, "level": level}
                    | {"coverage": hits / below.size, "sessions": below.size, "p": p, "z": float(z)}
                )
    return table


def passes(table: list[dict[str, Any]]) -> bool:
    """Return whether no coverage deviates, by Holm's procedure and by the limit of `SIGMAS`."""
    p = np.sort([row["p"] for row in table])
    holm = np.all(p >= ERROR / np.arange(p.size, 0, -1)) if p.size else True
    return bool(holm) and all(abs(row["z"]) <= SIGMAS for row in table)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--sessions", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("out/session_calibration"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / "sessions.jsonl"
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    done = {(row["setup"], row["seed"], row["records"], row["control"]) for row in rows}
    jobs = [
        (setup, 1_000_000 * arguments.seed + number, records, control)
        for number in range(arguments.sessions)
        for setup in SETUPS
        for records in RECORDS
        for control in ((False, True) if setup == "Vsc" and records == 5 else (False,))
    ]
    jobs = [job for job in jobs if job not in done]
    context = multiprocessing.get_context("spawn")
    with (
        path.open("a") as file,
        concurrent.futures.ProcessPoolExecutor(arguments.workers, mp_context=context) as pool,
    ):
        for number, row in enumerate(pool.map(_evaluate_job, jobs, chunksize=4), 1):
            rows.append(row)
            file.write(json.dumps(row) + "\n")
            file.flush()
            if number % 50 == 0:
                print(f"{number} of {len(jobs)} fits", flush=True)
    table = judge(rows)
    for row in table:
        print(
            f"{row['setup']:10} {row['records']:3} {'control ' if row['control'] else ''}{row['quantity']:10}"
            f" {100 * row['level']:.0f} %: {100 * row['coverage']:.1f} % of {row['sessions']} (z = {row['z']:+.1f})"
        )
    binding = [row for row in table if not row["control"]]
    control = [row for row in table if row["control"] and row["quantity"] == "g"]
    ends = {"passed": passes(binding), "control fails": not passes(control)}
    print(ends)
    if not all(ends.values()):
        raise SystemExit(1)


def _evaluate_job(job: tuple[str, int, int, bool]) -> dict[str, Any]:
    setup, seed, records, control = job
    return evaluate(setup, seed, records, control=control)


if __name__ == "__main__":
    main()
