"""Time of a whole fit and its posterior for records with one feature, relative to the same record without it.

    python benchmarks/features.py [--samples 20000 1000000] [--only NAME ...] [--rounds 3] [--draws 100000] [--json]

`NAME_N` is the time of `fitact.fit` and `fitact.sample`, once compiled, over that of a plain record of N samples with
the same kind of drive, in turn (medians). The record is a trapezoid of 100 Hz with edges of 20 us, sampled every 5 us,
with 0.06 V of noise; the drive is the recorded one, which begins after a rest, or a stated one. Records with a feature:

- `delay`: Vsc is recorded 2.3 samples late; `clock`: the recorder's clock is off by 3 samples at the end of the record;
- `ar1`, `spectrum`: noise with a correlation of 0.7, and of a resonance; `student`: one sample in fifty is an outlier,
  `student_and_delay`: the same, 2.3 samples late;
- `fractional`: a skin with a constant-phase element; `natural_ground`: with the capacitance of Z; `unequal_skins`.

With `--draws`, the posterior is compared with that of the full sum instead, from as many common draws of a proposal
with importance weights: `NAME_quantile` is the largest difference of the quantiles 0.05, 0.5 and 0.95 of a parameter,
in standard deviations; `NAME_error` the largest difference of the log-likelihood over the draws within the posterior.
"""

import argparse
import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from scipy.signal import lfilter
from timing import medians, show

import fitact
from fitact.likelihood.certificate import batched_log_prob
from fitact.sampling.proposal import Proposal

STEP, FREQUENCY, NOISE, REST = 5e-6, 100.0, 0.06, 2000
CIRCUIT = fitact.FinalCircuit(Rsc=160e3, Csc=22e-9, Ci=1.35e-9)
PRIOR = {"Rsc": {"relative_sd": 0.3}, "Csc": {"relative_sd": 0.3}, "Ci": {"relative_sd": 0.05}}
SKIN = {"Rsc": "160 kohm", "Csc": "22 nF"}
DRIVE = {"waveform": "trapezoid", "rise_time": "20 us", "peak_to_peak": "360 V", "frequency": "100 Hz"}


def make_scene(stated: bool = False, **sections: dict) -> fitact.Scene:
    """Return a scene with the drive as recorded or as stated."""
    drive = DRIVE if stated else {"waveform": "measured"}
    return fitact.Scene.from_dict(
        {"device": {"Ci": "1.35 nF"}, "skin": SKIN, "prior": PRIOR, "drive": drive} | sections
    )


def make_record(
    samples: int,
    *,
    circuit: Any = CIRCUIT,
    delay: float = 0.0,
    clock: float = 0.0,
    noise: Callable[[np.random.Generator, int], np.ndarray] | None = None,
    stated: bool = False,
) -> fitact.Record:
    """Return a record; `delay` in samples, `clock` in samples at its end. A recorded drive begins after a rest."""
    rng, t = np.random.default_rng(1), STEP * np.arange(samples)
    drive = fitact.Trapezoid(360.0, FREQUENCY, 20e-6)
    true = (t - delay * STEP) * (1.0 + clock / samples)
    v, rest = np.asarray(drive.value(t)), 0 if stated else REST
    if rest:
        # the drive as it was sampled is the drive
        v = np.append(np.zeros(rest), v[: samples - rest])
        begin = fitact.Sampled(t, v)
        vsc = fitact.response(circuit, begin, true, steady_state=False)
    else:
        vsc = fitact.response(circuit, drive, true)
    drawn = rng.standard_normal(samples) if noise is None else noise(rng, samples)
    return fitact.Record.from_arrays(t, V=v, Vsc=np.asarray(vsc) + NOISE * drawn)


def resonance(rng: np.random.Generator, size: int) -> np.ndarray:
    """Return noise of variance 1 around a twentieth of the sampling rate."""
    values = lfilter([1.0], [1.0, -1.8 * np.cos(0.1 * np.pi), 0.81], rng.standard_normal(size))
    return values / values.std()


def correlated(rng: np.random.Generator, size: int) -> np.ndarray:
    """Return AR(1) noise of variance 1."""
    return lfilter([np.sqrt(1.0 - 0.49)], [1.0, -0.7], rng.standard_normal(size))


def outliers(rng: np.random.Generator, size: int) -> np.ndarray:
    """Return normal noise in which one sample in fifty is ten times larger."""
    return rng.standard_normal(size) * np.where(rng.uniform(size=size) < 0.02, 10.0, 1.0)


def cases(samples: int) -> dict[str, tuple[fitact.Record, fitact.Scene]]:
    """Return record and scene by name; the first two are without a feature."""
    quiet = {"noise_model": "spectrum", "quiet": ["0 s", "9.9 ms"]}
    natural = make_scene(grounding={"connection": "natural", "Z": "1 Mohm", "Z_capacitance": "100 pF"})
    unequal = make_scene(grounding={"grounding_Rsc": "80 kohm", "grounding_Csc": "44 nF", "R_H": "500 ohm"})
    cpe = make_scene(
        True, skin=SKIN | {"level": "fractional", "alpha": 0.9}, prior=PRIOR | {"alpha": {"low": 0.5, "high": 1.0}}
    )
    return {
        "plain": (make_record(samples), make_scene()),
        "plain_stated": (make_record(samples, stated=True), make_scene(stated=True)),
        "delay": (make_record(samples, delay=2.3), make_scene()),
        "delay_stated": (make_record(samples, delay=2.3, stated=True), make_scene(stated=True)),
        "clock": (make_record(samples, clock=3.0, stated=True), make_scene(stated=True)),
        "delay_and_clock": (make_record(samples, delay=2.3, clock=3.0, stated=True), make_scene(stated=True)),
        "ar1": (make_record(samples, noise=correlated), make_scene(measurement={"noise_model": "ar1"})),
        "spectrum": (
            make_record(samples, noise=resonance),
            make_scene(measurement=quiet),
        ),
        "student": (make_record(samples, noise=outliers), make_scene(measurement={"noise_model": "student"})),
        "student_and_delay": (
            make_record(samples, delay=2.3, noise=outliers),
            make_scene(measurement={"noise_model": "student"}),
        ),
        "natural_ground": (make_record(samples, circuit=natural.make_circuit()), natural),
        "unequal_skins": (make_record(samples, circuit=unequal.make_circuit()), unequal),
        "fractional": (make_record(samples, circuit=cpe.make_circuit(), stated=True), cpe),
    }


def run(record: fitact.Record, scene: fitact.Scene) -> None:
    """Fit and sample."""
    fitact.sample(fitact.fit(record, scene), progress=False)


def compare_posteriors(record: fitact.Record, scene: fitact.Scene, draws: int) -> dict[str, float]:
    """Return how the posterior differs from that of the full sum."""
    fit = fitact.fit(record, scene)
    ours, full = (batched_log_prob(model, 128) for model in (fit.likelihood, fit.likelihood.without_compression()))
    proposal = Proposal.from_laplace(fit.point, fit.point_root, ours)
    points = proposal.draw(np.random.default_rng(0), draws)
    values, exact, density = ours(points), full(points), proposal.log_density(points)
    weights = [np.exp(each - density - np.max(each - density)) for each in (values, exact)]
    quantiles = [
        np.quantile(points, (0.05, 0.5, 0.95), axis=0, weights=each, method="inverted_cdf") for each in weights
    ]
    change = exact - values
    change -= np.median(change)
    inside = values > values.max() - 0.5 * (fit.point.size + 4.0 * np.sqrt(2.0 * fit.point.size))
    sd = np.linalg.norm(fit.point_root, axis=1)
    return {
        "quantile": float(np.max(np.abs(quantiles[0] - quantiles[1]) / sd)),
        "error": float(np.max(np.abs(change[inside]))),
    }


STATED = ("delay_stated", "clock", "delay_and_clock", "fractional")


def main() -> None:
    """Print the ratios."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--samples", type=int, nargs="+", default=[20_000])
    parser.add_argument("--only", nargs="+")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--draws", type=int)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    ratios = {}
    for samples in options.samples:
        records = cases(samples)
        names = options.only or [name for name in records if not name.startswith("plain")]
        if options.draws:
            for name in names:
                differences = compare_posteriors(*records[name], options.draws)
                ratios |= {f"{name}_{key}_{samples}": value for key, value in differences.items()}
            continue
        jobs = {name: functools.partial(run, *records[name]) for name in ("plain", "plain_stated", *names)}
        seconds = medians(jobs, options.rounds)
        for name in names:
            plain = "plain_stated" if name in STATED else "plain"
            ratios[f"{name}_{samples}"] = seconds[name] / seconds[plain]
    show(ratios, options.json)


if __name__ == "__main__":
    main()
