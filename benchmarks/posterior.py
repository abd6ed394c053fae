"""Effective draws of the mean force per second: `fitact.sample` against other samplers.

    pip install "fitact[bench]"; python benchmarks/posterior.py [--quick] [--json]

All sample one posterior: a settled 100 Hz square, 0.1 V of noise (also sampled), normal priors of 0.29, 0.29 and 0.05
on log Rsc, Csc and Ci. fitact is timed by the user's call `fitact.sample(fit)`, diagnostics included, once compiled.
The others are timed in turn with it (median of rounds), after burn-in or adaptation and compilation. All draws must
have the standard deviations of log Rsc and force from importance sampling, to 2 % or three standard errors (`--quick`:
a tenth of the steps).

- `ess_vs_plain_N`: against emcee on a plain NumPy time-domain log-probability, 32 walkers;
- `ess_vs_good_N`: against emcee on an optimised one (closed form of one period). At 1,000,000 samples the time of its
  steps is measured and its autocorrelation time taken from 5,000 samples, because stretch moves are affine-invariant
  and both posteriors are close to normal;
- `ess_vs_lmfit_N`: against lmfit.emcee on the optimised one;
- `ess_vs_numpyro_N`: against numpyro's NUTS on the samples, default adaptation;
- `ess_vs_blackjax_N`: against blackjax's NUTS on the samples, whitened by the Laplace approximation;
- `curved_vs_stretch`: effective draws of Csc per second, against emcee's stretch moves alone on the
  same compiled likelihood, for a posterior that lies along a curve: of V and I of a bench, with noise and rounding;
- `run_vs_lmfit_script`: time of `fitact run` relative to lmfit_script.py (fit, lmfit.emcee to the same effective size
  of the force, corner plot), both as processes; `cold_run_vs_lmfit_script`: the same for a first run, which
  compiles. `whole_vs_good_5000`: effective draws per second of the warm process, from start to end, relative to the
  optimised emcee, which neither reads, burns in nor reports.
"""

import argparse
import json
import statistics
import sys
import tempfile
import time
import tomllib
from pathlib import Path

import emcee
import jax
import numpy as np
from likelihood import record
from peers import (
    WALKERS,
    Blackjax,
    Ensemble,
    Lmfit,
    Numpyro,
    Peer,
    good_log_prob,
    importance_sds,
    mean_force,
    plain_log_prob,
    raw_log_density,
)
from timing import process_seconds, show

import fitact
from fitact.likelihood.certificate import batched_log_prob
from fitact.readers.read import write_csv
from fitact.sampling.ensemble import reject_nonfinite

RECORDS = Path(__file__).parents[1] / "data_synth" / "records"

SCENE = """[drive]
waveform = "square"
[prior]
Rsc = {median = "160 kohm", relative_sd = 0.3}
Csc = {median = "22 nF", relative_sd = 0.3}
Ci = {median = "1.35 nF", relative_sd = 0.05}
"""
ROUNDS = 5
STEPS = 5000  # per round


class FitactSampler:
    """Sampler that calls `fitact.sample` with another seed each time."""

    def __init__(self, fit: fitact.Fit, quantity: str = "force_mean") -> None:
        self._fit, self._posteriors, self._quantity = fit, [fitact.sample(fit, progress=False)], quantity

    def draw(self) -> float:
        """Return effective draws of the quantity per second."""
        began = time.perf_counter()
        posterior = fitact.sample(self._fit, seed=len(self._posteriors), progress=False)
        took = time.perf_counter() - began
        assert posterior.trusted, posterior.warnings
        self._posteriors.append(posterior)
        return posterior.convergence.ess[self._quantity] / took

    @property
    def draws(self) -> np.ndarray:
        return np.concatenate([posterior.points.reshape(-1, self._fit.point.size) for posterior in self._posteriors])


def check(name: str, draws: np.ndarray, effective: float, expected: np.ndarray) -> None:
    """Check that the draws have the posterior's standard deviations."""
    found = np.array([draws[..., 0].std(), mean_force(draws).std()])
    error = float(np.max(np.abs(found / expected - 1.0)))
    allowed = max(0.02, 3.0 / np.sqrt(2.0 * effective))
    print(f"{name}: effective {effective:,.0f}, sds within {100.0 * error:.1f} %", file=sys.stderr)
    assert error < allowed, f"{name} samples another posterior: its standard deviations are off by {error:.3f}"


def rates(data: fitact.Record, quick: bool) -> tuple[dict[str, float], dict[str, float]]:
    """Return effective draws per second of all samplers, and per step of the others."""
    fit = fitact.fit(data, fitact.Scene.from_dict(tomllib.loads(SCENE)))
    steps = STEPS // 10 if quick else STEPS
    starts = fit.point + np.random.default_rng(4).standard_normal((WALKERS, 4)) @ fit.point_root.T
    plain, good, raw = plain_log_prob(data), good_log_prob(data), raw_log_density(data)
    ours = FitactSampler(fit)
    peers: dict[str, Peer] = {
        "plain": Ensemble(plain, starts, steps),
        "good": Ensemble(good, starts, steps),
        "lmfit": Lmfit(good, starts, steps),
        "numpyro": Numpyro(raw, fit.point, steps),
        "blackjax": Blackjax(raw, fit.point, fit.point_root, steps),
    }
    seconds: dict[str, list[float]] = {name: [] for name in peers}
    own: list[float] = []
    for _ in range(ROUNDS):
        own += [ours.draw() for _ in range(4)]
        for name, peer in peers.items():
            seconds[name].append(peer.draw())
    expected = importance_sds(good, fit.point, fit.point_root)
    check("fitact", ours.draws, float(len(ours.draws)), expected)
    each = {name: peer.effective() for name, peer in peers.items()}
    for name, peer in peers.items():
        check(name, peer.draws, each[name] * ROUNDS * steps, expected)
    found = {name: each[name] / statistics.median(seconds[name]) for name in peers}
    low, middle, high = np.quantile(own, [0.1, 0.5, 0.9])
    print(f"fitact: {middle:,.0f} a second, {low:,.0f} to {high:,.0f} (10 to 90 %)", file=sys.stderr)
    return {"fitact": float(middle)} | found, each


def long_record(effective: float) -> float:
    """Return the ratio to the optimised emcee, `effective` draws per step, at 1,000,000 samples."""
    data = record(1_000_000)
    fit = fitact.fit(data, fitact.Scene.from_dict(tomllib.loads(SCENE)))
    starts = fit.point + np.random.default_rng(4).standard_normal((WALKERS, 4)) @ fit.point_root.T
    ours, good = FitactSampler(fit), Ensemble(good_log_prob(data), starts, 10)
    pairs = [(ours.draw(), good.draw()) for _ in range(ROUNDS)]
    own, step = (statistics.median(values) for values in zip(*pairs, strict=True))
    return own * step / effective


def curved_posterior(steps: int = 20_000, walkers: int = 128) -> float:
    """Return the ratio of effective draws per second to that of `steps` stretch moves, which last some 50 times tau."""
    scene = fitact.Scene.load(RECORDS / "bench_multisine.toml")
    fit = fitact.fit(fitact.read(RECORDS / "bench_multisine.csv.gz", scene), scene)
    ours, log_prob = FitactSampler(fit, "Csc"), reject_nonfinite(batched_log_prob(fit.likelihood, walkers))
    stretch = emcee.EnsembleSampler(walkers, fit.point.size, log_prob, vectorize=True)
    starts = np.random.default_rng(4).choice(ours.draws, walkers, replace=False)
    began = time.perf_counter()
    stretch.run_mcmc(emcee.State(starts, random_state=np.random.RandomState(1).get_state()), steps)
    took = time.perf_counter() - began
    tau = float(stretch.get_autocorr_time(tol=0)[fit.names.index("Csc")])
    print(f"curved: autocorrelation time of the stretch moves {tau:.0f}", file=sys.stderr)
    return statistics.median(ours.draw() for _ in range(ROUNDS)) * took / (steps * walkers / tau)


def processes(data: fitact.Record, each: float, quick: bool) -> tuple[dict[str, float], float]:
    """Return times of `fitact run` relative to lmfit's script, and its effective draws per second.

    `each` is the effective draws per step of lmfit. With `quick`, a tenth of its steps are run and the rest counted.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        cache = folder / "cache"
        (folder / "scene.toml").write_text(SCENE)
        write_csv(folder / "record.csv", data)
        fitact_run = [str(Path(sys.executable).with_name("fitact")), "run", "record.csv", "--scene", "scene.toml"]
        cold, *warm = (process_seconds([*fitact_run, "--out", str(i)], folder, cache) for i in range(4))
        content = json.loads((folder / "0" / "summary.json").read_text())
        effective, run = content["convergence"]["ess"]["force_mean"], statistics.median(warm)
        steps = round(effective / each)
        script = [sys.executable, str(Path(__file__).with_name("lmfit_script.py")), "record.csv"]
        if quick:
            start, tenth = (
                process_seconds([*script, str(count), "corner.png"], folder, cache) for count in (100, steps // 10)
            )
            lmfit = start + (tenth - start) * (steps - 100) / (steps // 10 - 100)
        else:
            lmfit = process_seconds([*script, str(steps), "corner.png"], folder, cache)
        print(f"fitact run: {run:.1f} s, first {cold:.1f} s; lmfit's script: {lmfit:.0f} s", file=sys.stderr)
        return {"run_vs_lmfit_script": run / lmfit, "cold_run_vs_lmfit_script": cold / lmfit}, effective / run


def main() -> None:
    parser = argparse.ArgumentParser(description="Effective draws per second against other samplers.")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--quick", action="store_true", help="a tenth of the peers' steps")
    given = parser.parse_args()
    data = record(5000)
    with jax.enable_x64(True):
        found, each = rates(data, given.quick)
        ratios = {f"ess_vs_{name}_5000": found["fitact"] / rate for name, rate in found.items() if name != "fitact"}
        ratios["ess_vs_good_1000000"] = long_record(each["good"])
        ratios["curved_vs_stretch"] = curved_posterior()
    print("a second: " + ", ".join(f"{name} {rate:,.0f}" for name, rate in found.items()), file=sys.stderr)
    whole, rate = processes(data, each["lmfit"], given.quick)
    ratios |= whole | {"whole_vs_good_5000": rate / found["good"]}
    show(ratios, given.json)


if __name__ == "__main__":
    main()
