"""Coverage of experiments with repetitions: parameters drawn from the hyperprior, people and their touches from these.

The design was fixed before the first run. Truths come from the hyperprior of docs/population.md: medians and Ci from
`PRIOR`, each standard deviation from its half-normal prior, each correlation from its density. A study has
6 people of 3 touches, or 12 people of 2 sessions of 2 touches. A record has five steady-state periods of a triangle
with the exact currents of the circuit, noise in V, Vsc and I, 12 bits in each channel, and a skew of both channels.
Central intervals of 50 %, 90 % and 95 % must cover within three binomial standard deviations, for the parameters, for
the mean force of a touch of a new person, and for the next touch of a person of the study. Every study counts.

    python -m tests.study_calibration [--studies 200] [--seed 1] [--workers 2] [--out out/study]

Places are saved in DIR/places.jsonl, from which the next run of the same code resumes. Odd numbers have sessions.
"""

import argparse
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import fitact
from fitact.readers.study import nest_levels
from tests.calibration import AMPLITUDE, THICKNESS, collect, skin_voltage
from tests.population_calibration import FREQUENCY, PRIOR, SPREAD, draw_medians, show_coverage

LEVELS = (("person", "repetition"), ("person", "session", "repetition"))
COUNTS = ((6, 3), (12, 2, 2))
FINE, EACH, PERIODS = 3200, 8, 5  # steps of a period, steps of a sample, periods
NOISE = {"V": 0.05, "Vsc": 0.05, "I": 2e-7}  # noise sd, V and A
BITS = 12
SKEW = {"V": 0, "Vsc": 1, "I": 2}  # delays, fine steps of 3.1 us
COMPONENTS = ("Rsc", "Csc", "area")
INTERVALS = (0.5, 0.9, 0.95)


class Simulated(NamedTuple):
    """Records of a study with labels, scene and true values in SI units."""

    records: list[fitact.Record]
    labels: dict[str, list[str]]
    scene: fitact.Scene
    truth: dict[str, float]


def simulate(seed: int, number: int) -> Simulated:
    """Simulate study `number`."""
    rng = np.random.default_rng([seed, number])
    counts = COUNTS[number % 2]
    Rsc, Csc, Ci = draw_medians(rng)
    log_sd = SPREAD * np.abs(rng.standard_normal((len(counts), 3)))
    r = 2.0 * rng.beta(2.0, 2.0, len(counts)) - 1.0

    def draw_effect(level: int) -> np.ndarray:
        z = rng.standard_normal(3)
        z[1] = r[level] * z[0] + np.sqrt(1.0 - r[level] ** 2) * z[1]
        return log_sd[level] * z

    # units of each level within those above it, then the next touch of the first person, and a touch of a new one
    places = [(i,) for i in range(counts[0])]
    effects = {place: draw_effect(0) for place in places}
    for level, count in enumerate(counts[1:], 1):
        places = [(*place, i) for place in places for i in range(count)]
        effects |= {place: draw_effect(level) for place in places}
    sums = [sum(effects[place[: k + 1]] for k in range(len(counts))) for place in places]
    below = [sum(draw_effect(level) for level in range(1, len(counts))) for _ in range(2)]
    known, new = effects[(0,)] + below[0], draw_effect(0) + below[1]

    def touch(effect: np.ndarray) -> tuple[float, float, float]:
        area = np.exp(effect[2])
        return Rsc * np.exp(effect[0]) / area, Csc * np.exp(effect[1]) * area, Ci * area

    names = ["P" + "_".join(str(i) for i in place) for place in places]
    records = [record(*touch(effect), name, rng) for effect, name in zip(sums, names, strict=True)]
    labels = {name: [str(place[k]) for place in places] for k, name in enumerate(LEVELS[number % 2])}
    scene = fitact.Scene.from_dict(
        {
            "drive": {"waveform": "measured"},
            "measurement": {"channels": ["Vsc", "I"], "noise_V": NOISE["V"], "current_lead": "ground"},
            "prior": PRIOR,
            "population": {"contact_area": "varies"},
        }
    )
    truth = {"Rsc": Rsc, "Csc": Csc, "Ci": Ci}
    for level, ending in enumerate(endings(number)):
        truth |= {f"log_sd_{name}{ending}": sd for name, sd in zip(COMPONENTS, log_sd[level], strict=True)}
        truth[f"correlation{ending}"] = r[level]
    truth |= {"force_new": force(*touch(new)), "force_known": force(*touch(known))}
    return Simulated(records, labels, scene, {name: float(value) for name, value in truth.items()})


def endings(number: int) -> tuple[str, ...]:
    """Return the endings of the names of a study's levels."""
    return ("", *(f"_{name}" for name in LEVELS[number % 2][1:]))


def settle(Rsc: float, Csc: float, Ci: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return V, Vsc (V) and I (A) over one steady-state period of a triangle, on the fine grid."""
    phase = np.arange(FINE + 1) / FINE
    V = AMPLITUDE * np.interp(phase, [0.0, 0.25, 0.75, 1.0], [0.0, 1.0, -1.0, 0.0])
    total, time = 2.0 * Ci + Csc, phase / FREQUENCY
    g, b = Ci / total, Rsc * total
    charge = (V[-1] - skin_voltage(time, V, g, b, 0.0)[-1] / g) / -np.expm1(-time[-1] / b)
    Vsc = skin_voltage(time, V, g, b, charge)[:-1]
    slope = 4.0 * AMPLITUDE * FREQUENCY * np.where((phase[:-1] < 0.25) | (phase[:-1] >= 0.75), 1.0, -1.0)
    return V[:-1], Vsc, Vsc / Rsc + Csc * (g * slope - Vsc / b)  # b Vsc' = g b V' - Vsc


def record(Rsc: float, Csc: float, Ci: float, name: str, rng: np.random.Generator) -> fitact.Record:
    """Return a record as a bench writes it."""
    channels = {}
    for channel, values in zip(NOISE, settle(Rsc, Csc, Ci), strict=True):
        whole = np.tile(np.roll(values, SKEW[channel])[::EACH], PERIODS)
        whole = whole + NOISE[channel] * rng.standard_normal(whole.size)
        step = 2.6 * np.max(np.abs(whole)) / 2**BITS
        channels[channel] = step * np.round(whole / step)
    time = np.arange(PERIODS * FINE // EACH) * EACH / (FINE * FREQUENCY)
    return fitact.Record.from_arrays(time, **channels, source=name)


def force(Rsc: float, Csc: float, Ci: float) -> float:
    """Return the mean force, N, eqs. (3) and (22)."""
    _, Vsc, _ = settle(Rsc, Csc, Ci)
    return float(np.mean(Vsc**2) * (Ci * Csc / (Ci + Csc)) / (2.0 * THICKNESS))


def places(number: int, seed: int) -> dict[str, Any]:
    """Return the places of the true values of one study, and the warnings."""
    began = time.perf_counter()
    simulated = simulate(seed, number)
    row: dict[str, Any] = {"record": number}
    try:
        found = fitact.population(
            simulated.records, simulated.scene, labels=simulated.labels, seed=number, progress=False
        )
    except fitact.InputError as error:
        return row | {"refused": str(error)}
    draws = found.parameters() | {"force_new": found.new_fingers()["force_mean"]}
    first = nest_levels(simulated.labels, len(simulated.records)).levels[0].units[0]
    draws["force_known"] = found.forecasts[first]["force_mean"]
    row |= {"places": {name: float(np.mean(draws[name] < value)) for name, value in simulated.truth.items()}}
    row |= {"trusted": found.trusted, "warnings": list(found.warnings), "integrals_off": found.off}
    row |= {"results": [finger.result for finger in found.fingers]}
    return row | {"steps": found.convergence.steps, "seconds": time.perf_counter() - began}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--studies", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("out/study"))
    chosen = parser.parse_args()
    rows = collect(chosen.out / "places.jsonl", chosen.studies, chosen.seed, chosen.workers, places, recycled=4)
    passed = True
    for kind in (0, 1):
        some = [row for row in rows if row["record"] % 2 == kind]
        if some:
            print(f"{len(some)} studies of {' x '.join(map(str, COUNTS[kind]))}")
            levels = [f"{name}{ending}" for ending in endings(kind) for name in ("log_sd_Rsc", "log_sd_Csc",
                      "log_sd_area", "correlation")]  # fmt: skip
            quantities = ["Rsc", "Csc", "Ci", *levels, "force_new", "force_known"]
            passed &= show_coverage(some, quantities, INTERVALS)
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
