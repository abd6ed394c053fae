"""Calibration on benches: V and I, or V, Vsc and I, as instruments record them, fitted with the recorded drive.

The design was fixed before the first run. Fingers come from `FINGER`, whose distributions the scene states, and a stray
capacitance from its stated one. Drives come from `DRIVES`, instruments from `INSTRUMENTS`. The records are made by
`data_synth`, which shares no code with fitact. The scene states neither noise nor delays nor bandwidths. Each record is
fitted by `fitact.fit`. The central 50, 90 and 95 % intervals of the budget (Laplace approximation) of reliable fits
must cover the truth within three binomial standard deviations. No fit may end in an exception. Unreliable fits are
counted by drive and instrument. Fits that are reliable and wrong, by more than `WRONG` standard uncertainties, are
listed.

The true mean force is that of a period without noise in the bandwidth of the instrument, which no scene can state. The
thickness of the skin is exact. The bound on the variances is that of the expected information at the true values; it
knows delay, offset, hum and first charge, so that no estimate reaches it.

    python -m tests.bench_calibration [--records 500] [--seed 1] [--workers 2] [--out out/bench_calibration]

Rows are saved in DIR/benches.jsonl, from which the next run of the same code resumes. Each record has its own seed, so
the first 100 are the same in every run.
"""

import argparse
import math
import os
import signal
import sys
import time
import traceback
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.stats

import data_synth.make
import data_synth.recipe
import data_synth.scene
import fitact
from data_synth.bench import Bench
from data_synth.keys import validate_sections
from fitact.experiment.fisher import Experiment, covariance_factor, jacobian
from fitact.model.drive import Sampled
from fitact.uncertainty.budget import Budget
from tests.calibration import collect

QUANTITIES = ("Rsc", "Csc", "Ci", "g", "b", "force_mean")
INTERVALS = (0.5, 0.9, 0.95)
SIGMAS = 3.0  # allowed deviation of a coverage, in binomial standard deviations
WRONG = 4.0  # error from which a reliable fit is wrong, in standard uncertainties
SLOW = 20.0  # duration from which a fit is listed, s

# log-normal: 95 % of Rsc within 90 to 600 kohm and of Csc within 5 to 30 nF, and Ci to 50 %; medians in ohm and F
FINGER: dict[str, dict[str, float]] = {
    "Rsc": {"median": 232e3, "factor": 2.58},
    "Csc": {"median": 12.2e-9, "factor": 2.45},
    "Ci": {"median": 0.75e-9, "relative_sd": 0.5},
}
STRAYS, STRAY_SD = (0.0, 100e-12, 300e-12), 0.02  # medians, F, and relative sd
HUM = (0.0, 50e-9, 200e-9)  # amplitude in I at 50 Hz, A
CHANNELS = (("I",), ("I",), ("Vsc", "I"))
DRIVES = ("triangle", "trapezoid", "multitone", "two tones")
THICKNESS = 201e-6  # of insulator and skin together, m
FINE = 8192  # samples of a period without noise


class Instrument(NamedTuple):
    """Recorder of all channels: converters, white noise (V, V, A), bandwidth (Hz), and how late I is, in time steps."""

    bits: int
    rate: float  # Hz
    noise: dict[str, float]
    late: float
    bandwidth: float | None


INSTRUMENTS = {
    "16 bits": Instrument(16, 100e3, {"V": 0.02, "Vsc": 0.01, "I": 20e-9}, 0.37, None),
    "12 bits": Instrument(12, 500e3, {"V": 0.1, "Vsc": 0.05, "I": 50e-9}, 0.0, 200e3),
    "14 bits": Instrument(14, 200e3, {"V": 0.5, "Vsc": 0.05, "I": 30e-9}, 0.25, 50e3),
}


# ------------------------------------------------------------------ records of known truth


class Simulated(NamedTuple):
    """Simulated record with its scene, its true values in SI units, its set-up in words, and the variances' bound."""

    record: fitact.Record
    scene: fitact.Scene
    truth: dict[str, float]
    setup: dict[str, Any]
    experiment: Experiment  # with noise and rounding as they are


def simulate(seed: int, number: int) -> Simulated:
    """Simulate record `number` with a random finger, drive and instrument."""
    rng = np.random.default_rng([seed, number])
    finger = {name: law["median"] * math.exp(log_sd(law) * rng.standard_normal()) for name, law in FINGER.items()}
    kind, name = str(rng.choice(DRIVES)), str(rng.choice(list(INSTRUMENTS)))
    instrument, nominal = INSTRUMENTS[name], float(rng.choice(STRAYS))
    stray = nominal * math.exp(log_sd({"relative_sd": STRAY_SD}) * rng.standard_normal())
    hum, channels = float(rng.choice(HUM)), CHANNELS[rng.integers(len(CHANNELS))]
    frequency = round(log_uniform(rng, 40.0, 200.0), 1)
    periods = float(rng.integers(2, 6) if rng.uniform() < 0.5 else rng.uniform(2.0, 5.0))
    drive = draw_drive(kind, frequency, log_uniform(rng, 75.0, 200.0), rng)
    amplifier = log_uniform(rng, 4e3, 16e3) if kind == "trapezoid" else None
    rate, channel_names = instrument.rate, ("V", "Vsc", "I")
    own = {
        "device": {"Ci": finger["Ci"]},
        "skin": {"Rsc": finger["Rsc"], "Csc": finger["Csc"]},
        "drive": drive,
        "measurement": {
            "channels": list(channels),
            "sampling_rate": rate,
            "duration": round(periods / frequency * rate) / rate,
        },
    }
    parts = {
        "delay": {"I": instrument.late / rate},
        "hum": {"I": hum, "harmonics": [1.0, 0.0, 0.3]},
        "white": instrument.noise,
        "converter": {"bits": instrument.bits, "auto": True},
        "bandwidth": dict.fromkeys(channel_names, instrument.bandwidth) if instrument.bandwidth else {},
        "amplifier": {"bandwidth": amplifier} if amplifier else {},
    }
    checked = validate_sections(parts, data_synth.recipe.KEYS, f"record {number}")
    bench = data_synth.scene.make_scene(own, {}, f"record {number}")
    bench["measurement"]["stray_capacitance"] = stray or None
    recipe = data_synth.recipe.Recipe("bench", "", bench, checked, tuple(parts), int(rng.integers(2**31)), "scipy")
    made = data_synth.make.make(recipe)["bench"]
    record = fitact.Record.from_arrays(made.time, **made.channels, source=f"record {number}")
    period = np.arange(FINE) / (FINE * frequency)
    bandwidth = checked["bandwidth"]
    V, Vsc, _ = data_synth.make.simulate_response(bench, period, bench=Bench(amplifier, bandwidth))
    truth = true_values(finger, float(np.mean(np.square(Vsc))))
    setup = {"drive": kind, "instrument": name, "channels": "+".join(channels), "stray": nominal, "hum": hum}
    setup |= {"frequency": frequency, "periods": periods, "amplitude": float(np.max(np.abs(V))), "samples": len(record)}
    scene = {
        "drive": {"waveform": "measured"},
        "measurement": {"channels": list(channels)},
        "skin": {"thickness": {"median": 200e-6, "relative_sd": 1e-6}},
        "prior": FINGER | ({"stray_capacitance": {"median": nominal, "relative_sd": STRAY_SD}} if nominal else {}),
    }
    peaks = {each: float(np.max(np.abs(values))) for each, values in made.channels.items()}
    noise = {
        each: math.hypot(instrument.noise[each], 2.6 * peak / 2**instrument.bits / math.sqrt(12.0))
        for each, peak in peaks.items()
    }
    thin = 2 ** math.ceil(
        math.log2(max(FINE * frequency / rate, 1.0))
    )  # the expected information takes no more samples than the record has
    free = tuple(finger) + ("stray_capacitance",) * bool(nominal)
    experiment = Experiment(
        circuit=fitact.FinalCircuit(**finger),
        free=free,
        prior_factor=np.diag([log_sd(FINGER.get(each, {"relative_sd": STRAY_SD})) for each in free]),
        drive=Sampled(period[::thin], V[::thin], 1.0 / frequency),
        time=made.time,
        channels=channels,
        noise=noise,
        stray_capacitance=stray,
    )
    return Simulated(record, fitact.Scene.from_dict(scene), truth, setup, experiment)


def log_sd(law: dict[str, float]) -> float:
    """Return the standard deviation of the logarithm of a log-normal quantity."""
    if "factor" in law:
        return float(np.log(law["factor"]) / scipy.stats.norm.ppf(0.975))
    return math.sqrt(math.log1p(law["relative_sd"] ** 2))


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number that is uniform in its logarithm."""
    return float(np.exp(rng.uniform(*np.log([low, high]))))


def draw_drive(kind: str, frequency: float, amplitude: float, rng: np.random.Generator) -> dict[str, Any]:
    """Return the section [drive] of a drive with a random phase and shape, and `amplitude` (V) as its peak."""
    phase = float(rng.uniform(0.0, 2.0 * np.pi))
    section = {"waveform": kind, "peak_to_peak": 2.0 * amplitude, "frequency": frequency}
    if kind == "triangle":
        return section | {"phase": phase}
    if kind == "trapezoid":
        return section | {"phase": phase, "rise_time": log_uniform(rng, 100e-6, 400e-6)}
    orders = np.array([1, 7])
    if kind == "multitone":  # the fundamental and some of the other odd harmonics
        orders = np.append(1, np.sort(rng.choice(np.arange(3, 21, 2), rng.integers(3, 9), replace=False)))
    phases = rng.uniform(0.0, 2.0 * np.pi, orders.size) + orders * phase
    turns = np.outer(np.arange(4096) / 4096, orders) * 2.0 * np.pi
    height = amplitude / np.max(np.abs(np.sum(np.sin(turns + phases), axis=1)))
    tones = [round(float(order * frequency), 1) for order in orders]
    return {
        "waveform": "multitone",
        "frequencies": tones,
        "amplitudes": [float(height)] * orders.size,
        "phases": phases.tolist(),
    }


def true_values(finger: dict[str, float], mean_square: float) -> dict[str, float]:
    """Return the true values of `QUANTITIES`; `mean_square` is that of Vsc, V^2."""
    Rsc, Csc, Ci = finger["Rsc"], finger["Csc"], finger["Ci"]
    force = mean_square * (Ci * Csc / (Ci + Csc)) / (2.0 * THICKNESS)  # eq. (22) with eq. (3) for the permittivities
    return finger | {"g": Ci / (2.0 * Ci + Csc), "b": Rsc * (2.0 * Ci + Csc), "force_mean": force}


# ------------------------------------------------------------------ fits


def measure(number: int, seed: int) -> dict[str, Any]:
    """Fit one record; return its errors in standard uncertainties and the probabilities below the truths."""
    simulated = simulate(seed, number)
    row: dict[str, Any] = {"record": number, **simulated.setup, "truth": simulated.truth}
    began = time.perf_counter()
    try:
        fit = fitact.fit(simulated.record, simulated.scene)
        row |= {"seconds": time.perf_counter() - began, "result": fit.result, "trusted": fit.trusted}
        row |= {"verdict": fit.identifiability.verdict, "quantities": compare(fit, simulated.truth)}
        row["figures"] = {each.label or "Vsc": each.figures["chi2_reduced"] for each in fit.traces}
        row["warnings"] = list(fit.warnings)
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        row["error"] = f"{type(error).__name__}: {error} ({place.filename}:{place.lineno})"
        return row | {"seconds": time.perf_counter() - began}
    return row | {"bound": bound(simulated.experiment)}


def compare(fit: fitact.Fit, truth: dict[str, float]) -> dict[str, dict[str, float]]:
    """Return for each quantity the error, its standard uncertainty, and the probability below the truth."""
    grid, found = np.linspace(1e-4, 1.0 - 1e-4, 4001), {}
    summaries = fit.parameters() | fit.derived()
    for name in QUANTITIES:
        # a default thickness is wrong by nothing here
        budget = Budget(tuple(each for each in fit.budgets[name].components if "default" not in each.source))
        estimate, factors = summaries[name]["q50"], budget.quantiles(grid)
        below = np.interp(truth[name], estimate * factors / np.interp(0.5, grid, factors), grid, left=0.0, right=1.0)
        found[name] = {"error": math.log(estimate / truth[name]), "u": budget.u, "below": float(below)}
    return found


def bound(experiment: Experiment) -> dict[str, float]:
    """Return the least standard deviations of the logarithms of the parameters."""
    root = covariance_factor(jacobian(experiment), experiment.prior_factor)
    return dict(zip(experiment.free, np.linalg.norm(root, axis=1).tolist(), strict=True))


# ------------------------------------------------------------------ what people look at


class Coverage(NamedTuple):
    """Coverage of one interval of one quantity, and its excess in binomial standard deviations."""

    quantity: str
    level: float
    share: float
    excess: float


def judge(rows: list[dict[str, Any]]) -> list[Coverage]:
    """Return the coverage of the intervals of reliable fits."""
    kept, found = [row["quantities"] for row in rows if row.get("trusted")], []
    for name in QUANTITIES if kept else ():
        below = np.array([each[name]["below"] for each in kept])
        for level in INTERVALS:
            share = float(np.mean(np.abs(below - 0.5) <= 0.5 * level))
            found.append(Coverage(name, level, share, (share - level) / math.sqrt(level * (1.0 - level) / below.size)))
    return found


def passes(rows: list[dict[str, Any]]) -> bool:
    """Return whether the coverage is right, and no fit ended in an exception."""
    judged = judge(rows)
    right = bool(judged) and all(abs(each.excess) <= SIGMAS for each in judged)
    return right and not any("error" in row for row in rows)


def worst(row: dict[str, Any]) -> float:
    """Return the largest error of a fit in standard uncertainties."""
    return max(abs(each["error"]) / each["u"] for each in row["quantities"].values())


def table(rows: list[dict[str, Any]]) -> str:
    """Format a row per quantity: coverage, errors in standard uncertainties, and the efficiency."""
    kept, judged = [row for row in rows if row.get("trusted")], judge(rows)
    heads = "".join(f"{f'{100 * level:.0f} %':>8}{'off by':>8}" for level in INTERVALS)
    lines = [f"{'':12}{heads}{'rms z':>8}{'max |z|':>9}{'median u':>10}{'efficiency':>12}"]
    for name in QUANTITIES if kept else ():
        cover = "".join(f"{100 * each.share:8.1f}{each.excess:+8.1f}" for each in judged if each.quantity == name)
        each = [row["quantities"][name] for row in kept]
        z, u = np.array([x["error"] / x["u"] for x in each]), float(np.median([x["u"] for x in each]))
        efficiency = ""
        if name in FINGER:  # from the median, since a few wrong fits decide a mean square
            ratio = [abs(row["quantities"][name]["error"]) / row["bound"][name] for row in kept]
            efficiency = f"{(scipy.stats.norm.ppf(0.75) / float(np.median(ratio))) ** 2:.2f}"
        spread = f"{np.sqrt(np.mean(z**2)):8.2f}{np.max(np.abs(z)):9.1f}{100.0 * u:8.3f} %"
        lines.append(f"{name:12}{cover}{spread}{efficiency:>12}")
    return "\n".join(lines)


def counts(rows: list[dict[str, Any]]) -> str:
    """Format the numbers of unreliable fits by drive and instrument, and list what went wrong."""
    done = [row for row in rows if "error" not in row]
    wrong = [row for row in done if row["trusted"] and worst(row) > WRONG]
    lines = [f"{'unreliable':12}" + "".join(f"{name:>12}" for name in INSTRUMENTS)]
    for kind in DRIVES:
        cells = []
        for name in INSTRUMENTS:
            here = [row for row in done if (row["drive"], row["instrument"]) == (kind, name)]
            cells.append(f"{sum(not row['trusted'] for row in here)} of {len(here)}")
        lines.append(f"{kind:12}" + "".join(f"{cell:>12}" for cell in cells))
    seconds = [row["seconds"] for row in rows]
    lines += [
        "",
        f"{len(rows)} records, reliable: {sum(row['trusted'] for row in done)}",
        f"fits by result: {dict(Counter(row['result'] for row in done))}",
        f"fits by verdict: {dict(Counter(row['verdict'] for row in done))}",
        f"seconds a fit: {np.median(seconds):.1f} (median), {np.max(seconds):.1f} (largest)",
        f"reliable and wrong: {len(wrong)}",
        *(f"  {describe(row)}, off by {worst(row):.1f} u" for row in wrong),
        f"slower than {SLOW:.0f} s: {sum(row['seconds'] > SLOW for row in rows)}",
        *(f"  {describe(row)}, {row['seconds']:.0f} s" for row in rows if row["seconds"] > SLOW),
        f"exceptions: {len(rows) - len(done)}",
        *(f"  {describe(row)}: {row['error']}" for row in rows if "error" in row),
    ]
    return "\n".join(lines)


def describe(row: dict[str, Any]) -> str:
    """Return the record with its set-up in words."""
    return (
        f"record {row['record']} ({row['drive']}, {row['instrument']}, {row['channels']}, {row['periods']:.2g} periods)"
    )


def main() -> None:
    """Print the tables; exit status 1 if a coverage is wrong, or a fit ended in an exception."""
    parser = argparse.ArgumentParser(description="calibration of fits of simulated benches")
    parser.add_argument("--records", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--out", type=Path, default=Path("out/bench_calibration"))
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as for Ctrl-C, so that the workers end too
    try:
        rows = collect(options.out / "benches.jsonl", options.records, options.seed, options.workers, measure)
    except KeyboardInterrupt:
        raise SystemExit("interrupted; the same command goes on from here") from None
    print(counts(rows), table(rows), sep="\n\n")
    passed = passes(rows)
    print("passed" if passed else "FAILED")
    sys.exit(not passed)


if __name__ == "__main__":
    main()
