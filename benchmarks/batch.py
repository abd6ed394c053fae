"""Speed of `fit_many` against Python loops of lmfit and of scipy on the same records.

The other packages minimise the same sum of squares, prior included, in log-parameters from the prior's medians, with
the noise that fitact estimated; only fitact also computes diagnostics. lmfit runs with a direct model (`vs_lmfit`) and
with all constants precomputed (`vs_lmfit_good`, as for scipy). `untested_vs` are the same ratios without residual tests
(`whiteness=False`), and `optimum_vs` the ratios for the optimum alone, one batch after the other.

`recorded_vs_lmfit` is the ratio for records with drives of their own, whose Vsc is 2.3 samples late and has an unknown
charge and offset. lmfit filters the interpolated drive by `scipy.signal.lfilter`, from the nominal parameters.

    python benchmarks/batch.py [--json] [--records 10000] [--samples 5000]
"""

import argparse
import functools
import statistics
import time
from collections.abc import Callable

import jax
import lmfit
import numpy as np
import scipy.optimize
import scipy.signal
from threadpoolctl import threadpool_limits
from timing import show

import fitact
from fitact.batch.stated_drive import StatedDriveProblem
from fitact.problem.build import build_problem

V0, FREQUENCY, NOISE = 180.0, 100.0, 0.1  # V, Hz, V
NAMES = ("Rsc", "Csc", "Ci")
PRIOR = {
    "Rsc": {"median": 160e3, "relative_sd": 0.3},
    "Csc": {"median": 22e-9, "relative_sd": 0.3},
    "Ci": {"median": 1.35e-9, "relative_sd": 0.05},
}
DRIVE = {"waveform": "square", "peak_to_peak": 2.0 * V0, "frequency": FREQUENCY}
SCENE = fitact.Scene.from_dict({"drive": DRIVE, "prior": PRIOR})
RECORDED_SCENE = fitact.Scene.from_dict({"drive": {"waveform": "measured"}, "prior": PRIOR})
MEANS, SDS = np.log([160e3, 22e-9, 1.35e-9]), np.sqrt(np.log1p(np.square([0.3, 0.3, 0.05])))
PEERS = 60  # records per round that the other packages fit
ROUNDS = 5


Model = Callable[[np.ndarray], np.ndarray]  # function of the log-parameters


class Square:
    """Final circuit under a settled square, in closed form, for an integer number of samples per period."""

    def __init__(self, time: np.ndarray) -> None:
        self.time = time
        half = np.floor(time * 2.0 * FREQUENCY + 1e-9)
        self.sign, self.since = np.where(half % 2 == 0.0, 1.0, -1.0), time - half / (2.0 * FREQUENCY)

    def __call__(self, theta: np.ndarray) -> np.ndarray:
        R, C, Ci = np.exp(theta)
        g, b = Ci / (2.0 * Ci + C), R * (2.0 * Ci + C)
        return self.sign * (2.0 * V0 * g / (1.0 + np.exp(-0.5 / FREQUENCY / b))) * np.exp(-self.since / b)


def plain_model(time: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Return the same model without precomputed constants."""
    R, C, Ci = np.exp(theta)
    g, b = Ci / (2.0 * Ci + C), R * (2.0 * Ci + C)
    phase = np.mod(time + 1e-12, 1.0 / FREQUENCY)
    first = phase < 0.5 / FREQUENCY
    since = np.where(first, phase, phase - 0.5 / FREQUENCY)
    return np.where(first, 1.0, -1.0) * 2.0 * V0 * g / (1.0 + np.exp(-0.5 / FREQUENCY / b)) * np.exp(-since / b)


def simulate_records(count: int, samples: int) -> list[fitact.Record]:
    """Simulate fingers on one panel, two periods each."""
    time = np.arange(samples) * (2.0 / FREQUENCY / samples)
    model, random = Square(time), np.random.default_rng(1)
    truths = MEANS + random.standard_normal((count, 3)) * [0.3, 0.3, 0.0]
    return [
        fitact.Record.from_arrays(time, Vsc=model(truth) + NOISE * random.standard_normal(samples), source=f"{i}")
        for i, truth in enumerate(truths)
    ]


def fit_lmfit(model: Model, observed: np.ndarray, sigma: float) -> np.ndarray:
    """Fit with lmfit's default settings."""
    parameters = lmfit.Parameters()
    for name, mean in zip(NAMES, MEANS, strict=True):
        parameters.add(name, value=mean)

    def residuals(p: lmfit.Parameters) -> np.ndarray:
        theta = np.array([p[name].value for name in NAMES])
        return np.append((observed - model(theta)) / sigma, (theta - MEANS) / SDS)

    found = lmfit.minimize(residuals, parameters, scale_covar=False)
    return np.array([found.params[name].value for name in NAMES])


def fit_scipy(model: Model, observed: np.ndarray, sigma: float) -> np.ndarray:
    """Fit with MINPACK's Levenberg-Marquardt at its tightest tolerances."""

    def residuals(theta: np.ndarray) -> np.ndarray:
        return np.append((observed - model(theta)) / sigma, (theta - MEANS) / SDS)

    tight = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15}
    return scipy.optimize.least_squares(residuals, MEANS, method="lm", jac="3-point", **tight).x


def simulate_recorded(count: int, samples: int, delay: float = 2.3, offset: float = 0.2) -> list[fitact.Record]:
    """Simulate the same fingers with recorded drives; `delay` of Vsc in samples, `offset` (V) and charges differ."""
    time = np.arange(samples) * (2.0 / FREQUENCY / samples)
    drive, random = fitact.Trapezoid(2.0 * V0, FREQUENCY, 20e-6), np.random.default_rng(2)
    voltage = np.asarray(drive.value(time))
    recorded = fitact.Sampled(time, voltage)
    respond = jax.jit(lambda circuit, time: fitact.response(circuit, recorded, time, steady_state=False))
    records = []
    for number, truth in enumerate(MEANS + random.standard_normal((count, 3)) * [0.3, 0.3, 0.0]):
        circuit = fitact.FinalCircuit(*np.exp(truth))
        charge = random.standard_normal() * np.exp(-time / float(circuit.b)) + offset * random.standard_normal()
        vsc = np.asarray(respond(circuit, time - delay * time[1])) + charge + NOISE * random.standard_normal(samples)
        v = voltage + NOISE * random.standard_normal(samples)
        records.append(fitact.Record.from_arrays(time, V=v, Vsc=vsc, source=f"{number}"))
    return records


def fit_recorded_lmfit(record: fitact.Record, sigma: float) -> np.ndarray:
    """Fit the circuit, the delay, the charge and the offset with lmfit's default settings."""
    time, voltage, observed = record.time, record["V"], record["Vsc"]
    parameters = lmfit.Parameters()
    for name, mean in zip(NAMES, MEANS, strict=True):
        parameters.add(name, value=mean)
    for name, value in {"delay": 0.5, "charge": 0.0, "offset": 0.0}.items():
        parameters.add(name, value=value)

    def residuals(p: lmfit.Parameters) -> np.ndarray:
        theta = np.array([p[name].value for name in NAMES])
        R, C, Ci = np.exp(theta)
        g, b = Ci / (2.0 * Ci + C), R * (2.0 * Ci + C)
        x = time[1] / b
        rise = np.diff(np.interp(time - p["delay"].value * time[1], time, voltage), prepend=voltage[0])
        response = scipy.signal.lfilter([-np.expm1(-x) / x], [1.0, -np.exp(-x)], rise)
        model = g * response + p["charge"].value * np.exp(-time / b) + p["offset"].value
        return np.append((observed - model) / sigma, (theta - MEANS) / SDS)

    found = lmfit.minimize(residuals, parameters, scale_covar=False)
    return np.array([found.params[name].value for name in NAMES])


def measure_recorded(count: int, samples: int) -> dict[str, float]:
    """Return the ratio of fits per second for recorded drives, and the largest difference of g from lmfit's."""
    records = simulate_recorded(count, samples)
    fitact.fit_many(records[:300], RECORDED_SCENE, progress=False)  # compiles
    taken: dict[str, list[float]] = {"fitact": [], "lmfit": []}
    differences = []
    for turn in range(ROUNDS):
        start = time.perf_counter()
        fits = fitact.fit_many(records, RECORDED_SCENE, progress=False)
        taken["fitact"].append((time.perf_counter() - start) / count)
        some = [(turn * PEERS + i) % count for i in range(PEERS)]
        start = time.perf_counter()
        found = [fit_recorded_lmfit(records[i], fits[i]["noise"]) for i in some]
        taken["lmfit"].append((time.perf_counter() - start) / PEERS)
        for i, theta in zip(some, found, strict=True):
            _, C, Ci = np.exp(theta)
            differences.append(abs(np.log(Ci / (2.0 * Ci + C) / fits[i]["g"])) / fits[i]["g_log_sd"])
    ours, theirs = (statistics.median(values) for values in taken.values())
    return {
        "recorded_vs_lmfit": theirs / ours,
        "recorded_fits_per_second": 1.0 / ours,
        "recorded_apart_sd": float(np.median(differences)),
        "recorded_unreliable": float(np.mean([not row["trusted"] for row in fits])),
    }


def optimum_seconds(records: list[fitact.Record]) -> float:
    """Return the seconds per record for the optimum alone, with known noise."""
    batches = [np.stack([record["Vsc"] for record in records[i : i + 256]]) for i in range(0, len(records) - 255, 256)]
    with jax.enable_x64(True), threadpool_limits(1):
        together = StatedDriveProblem.from_problem(build_problem([records[0]], [SCENE]), 256)
        noise, least = np.full(256, NOISE), np.zeros(256)

        def find(batch: np.ndarray) -> None:
            inputs = together.make_inputs(together.basis.project(batch), least)
            jax.block_until_ready(together.find_optima(inputs, noise)[0])

        find(batches[0])
        start = time.perf_counter()
        for batch in batches:
            find(batch)
        return (time.perf_counter() - start) / (256 * len(batches))


def measure(count: int, samples: int) -> dict[str, float]:
    """Return ratios of fits per second, and the distance of the optima in the logarithms."""
    records = simulate_records(count, samples)
    good = Square(records[0].time)
    peers = {
        "lmfit": (fit_lmfit, functools.partial(plain_model, records[0].time)),
        "lmfit_good": (fit_lmfit, good),
        "scipy": (fit_scipy, good),
    }
    fitact.fit_many(records[:300], SCENE, progress=False)  # compiles
    taken: dict[str, list[float]] = {name: [] for name in ("fitact", "untested", *peers)}
    apart: dict[str, list[float]] = {name: [] for name in peers}
    optimum: list[float] = []
    for turn in range(ROUNDS):
        for name, whiteness in (("untested", False), ("fitact", True)):
            start = time.perf_counter()
            fits = fitact.fit_many(records, SCENE, whiteness=whiteness, progress=False)
            taken[name].append((time.perf_counter() - start) / count)
        some = [(turn * PEERS + i) % count for i in range(PEERS)]
        for name, (peer, model) in peers.items():
            start = time.perf_counter()
            found = [peer(model, records[i]["Vsc"], fits[i]["noise"]) for i in some]
            taken[name].append((time.perf_counter() - start) / PEERS)
            ours = np.log([[fits[i][key] for key in NAMES] for i in some])
            apart[name].append(float(np.max(np.abs(ours - found))))
        optimum.append(optimum_seconds(records))
    seconds = {name: statistics.median(values) for name, values in taken.items()}
    return {
        "fits_per_second": 1.0 / seconds["fitact"],
        **{f"vs_{name}": seconds[name] / seconds["fitact"] for name in peers},
        **{f"untested_vs_{name}": seconds[name] / seconds["untested"] for name in peers},
        **{f"optimum_vs_{name}": seconds[name] / statistics.median(optimum) for name in peers},
        **{f"apart_{name}": max(apart[name]) for name in peers},
        "alone": float(np.mean([row["freed"] != "" or not row["trusted"] for row in fits])),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="one JSON object")
    parser.add_argument("--records", type=int, default=10_000, help="256 or more")
    parser.add_argument("--samples", type=int, default=5_000)
    asked = parser.parse_args()
    show(measure(asked.records, asked.samples) | measure_recorded(asked.records // 4, asked.samples), asked.json)
