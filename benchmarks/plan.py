"""Check of the plan's counted costs against measured times, and of its choice of models in hindsight.

    python benchmarks/plan.py [--scenes N] [--json]

Every kind of circuit, drive and regime is timed as `fitact.response` of 64 circuits, 4,000 samples each, in double
precision, and compared with the plan's cost. Then random scenes are planned, and the time of each plan's model is
compared with the shortest of all combinations of omissions within the tolerance. Rounds are interleaved.
"""

import argparse
import itertools
import math
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from timing import minima, show

import fitact
from fitact.model.drive import Sampled
from fitact.model_selection import omissions
from fitact.model_selection.model_errors import ReferenceModel

CIRCUITS, SAMPLES, ROUNDS = 64, 4000, 200
SAME = 1.1  # ratio of times below which they count as equal

GROUNDINGS = {
    "final": {},
    "unequal skins": {"grounding": {"grounding_Rsc": 80e3}},
    "R_H": {"grounding": {"R_H": 500}},
    "natural": {"grounding": {"connection": "natural", "Z": 14.5e6}},
    "natural, C, resistor": {
        "grounding": {"connection": "natural", "Z": 14.5e6, "Z_capacitance": 1e-10},
        "measurement": {"series_resistor": 1e3},
    },
}
DRIVES = {
    "square": {},
    "trapezoid": {"waveform": "trapezoid", "rise_time": 20e-6},
    "triangle": {"waveform": "triangle"},
    "sine": {"waveform": "sine"},
    "square from rest": {"steady_state": False},
    "trapezoid from rest": {"waveform": "trapezoid", "rise_time": 20e-6, "steady_state": False},
    "burst": {"waveform": "burst"},
    "chirp": {"waveform": "chirp", "start_frequency": 50, "end_frequency": 500, "sweep_time": 15e-3},
    "measured": {"waveform": "measured"},
}

Scene = fitact.Scene


def kind(scene: Scene) -> tuple:
    """Return the key that determines the time: circuits with equally many time constants run the same loop."""
    drive = scene.drive
    return omissions.count_time_constants(scene.make_rc_circuit()), drive.waveform, drive.shape, drive.steady_state


def job(scene: Scene, dtype: type = np.float64) -> Callable[[], object]:
    """Return a call that computes the response of many circuits."""
    steady, duration = scene.drive.steady_state, scene.measurement.duration
    time = duration * np.arange(SAMPLES) / SAMPLES
    with jax.enable_x64(dtype is np.float64):
        circuits = jax.tree.map(lambda x: jnp.full(CIRCUITS, x, dtype=dtype), scene.make_circuit())
        at = jnp.asarray(time, dtype=dtype)
        if scene.drive.waveform == "measured":
            drive = Sampled(time, np.sin(2.0 * np.pi * time / duration), duration)
        else:
            drive = scene.make_drive()
        drive = jax.tree.map(lambda x: jnp.asarray(x, dtype=dtype), drive)
        one = jax.jit(jax.vmap(lambda c, t: fitact.response(c, drive, t, steady_state=steady), in_axes=(0, None)))
        one(circuits, at)

    def call() -> object:
        with jax.enable_x64(dtype is np.float64):
            return one(circuits, at).block_until_ready()

    return call


def table() -> dict[str, tuple[float, float]]:
    """Return counted cost and measured nanoseconds per sample of each kind of model."""
    scenes = {
        f"{ground}, {drive}": Scene.from_dict(of | {"drive": DRIVES[drive]})
        for (ground, of), drive in itertools.product(GROUNDINGS.items(), DRIVES)
    }
    scenes["dispersive, square"] = Scene.from_dict({"skin": {"level": "dispersive"}})
    jobs = {name: job(scene) for name, scene in scenes.items()}
    jobs |= {f"{name}, float32": job(scenes[name], np.float32) for name in ("final, square", "R_H, square")}
    times = {name: 1e9 * seconds / CIRCUITS / SAMPLES for name, seconds in minima(jobs, ROUNDS).items()}
    costs = {name: omissions.evaluation_cost(scene) for name, scene in scenes.items()}
    costs |= {
        name: costs[name.removesuffix(", float32")] / omissions.FLOAT32_SPEEDUP for name in times if name not in costs
    }
    return {name: (costs[name], each) for name, each in times.items()}


def random_scene(rng: np.random.Generator) -> Scene:
    """Return a random scene."""

    def log_uniform(low: float, high: float) -> float:
        return math.exp(rng.uniform(math.log(low), math.log(high)))

    frequency = log_uniform(20.0, 1000.0)
    ground: dict = {"connection": "natural", "Z": log_uniform(1e4, 1e8)}
    if rng.random() < 0.75:
        ground = {"R_H": log_uniform(30.0, 3e3)} if rng.random() < 0.8 else {}
        ground |= {"grounding_Rsc": log_uniform(150e3, 170e3)} if rng.random() < 0.5 else {}
    elif rng.random() < 0.5:
        ground["Z_capacitance"] = log_uniform(1e-13, 1e-9)
    measured: dict = {"duration": 2.0 / frequency}
    measured |= {"probe_capacitance": log_uniform(1e-12, 1e-10)} if rng.random() < 0.5 else {}
    measured |= {"series_resistor": log_uniform(10.0, 1e4)} if rng.random() < 0.4 else {}
    drive: dict = {"frequency": frequency}
    drive["waveform"] = str(rng.choice(["square", "trapezoid", "triangle", "sine", "burst"]))
    drive |= {"rise_time": log_uniform(1e-4, 0.05) / frequency} if drive["waveform"] == "trapezoid" else {}
    drive |= {"steady_state": False} if drive["waveform"] != "burst" and rng.random() < 0.3 else {}
    tolerance = {"force": log_uniform(1e-3, 0.1)}
    return Scene.from_dict({"grounding": ground, "measurement": measured, "drive": drive, "tolerance": tolerance})


def admissible_scenes(scene: Scene) -> list[Scene]:
    """Return all reduced scenes within the tolerance."""
    values = {"Rsc": scene.skin.Rsc, "Csc": scene.skin.Csc, "Ci": scene.device.Ci}
    reference = ReferenceModel(scene, values)
    free = [name for name in omissions.applicable_omissions(scene) if not omissions.reason_to_keep(scene, name)]
    found = []
    for names in itertools.chain.from_iterable(itertools.combinations(free, n) for n in range(len(free) + 1)):
        reduced = omissions.reduce_scene(scene, names)
        if reference.compare(reduced, values)[2:, 0].max() <= scene.tolerance.force:
            found.append(reduced)
    return found


def hindsight(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the time of each plan's model relative to the fastest admissible one, and the planning time (s)."""
    rng = np.random.default_rng(0)
    scenes = [random_scene(rng) for _ in range(count)]
    plans, seconds = [], []
    for scene in scenes:
        begin = time.perf_counter()
        plans.append(fitact.plan(scene))
        seconds.append(time.perf_counter() - begin)
    choices = [admissible_scenes(scene) for scene in scenes]
    kinds = {kind(each): each for each in itertools.chain(*choices)}
    taken = minima({name: job(each) for name, each in kinds.items()}, ROUNDS)
    ratios = [
        taken[kind(plan.scene)] / min(taken[kind(each)] for each in of) for plan, of in zip(plans, choices, strict=True)
    ]
    return np.array(ratios), np.array(seconds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    ratio, seconds = hindsight(arguments.scenes)
    rows = table()
    share = np.array([ns / cost for cost, ns in rows.values()])
    ratios = {
        "cheapest_in_hindsight_share": float(np.mean(ratio < SAME)),
        "worst_against_hindsight": float(ratio.max()),
        "first_plan_seconds": float(seconds[0]),
        "median_plan_seconds": float(np.median(seconds)),
        "slowest_later_plan_seconds": float(seconds[1:].max()),
        "cost_in_ns_median": float(np.median(share)),
        "cost_off_by_factor_at_most": float(np.max(np.maximum(share / np.median(share), np.median(share) / share))),
    }
    if not arguments.json:
        print(f"{'model':44}{'cost':>8}{'ns a sample':>14}")
        for name, (cost, ns) in rows.items():
            print(f"{name:44}{cost:8.1f}{ns:14.1f}")
    show(ratios, arguments.json)


if __name__ == "__main__":
    main()
