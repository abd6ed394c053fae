"""Posteriors of many records: the same as one by one and as an integral, independent of the other records."""

import dataclasses
import functools
from pathlib import Path

import numpy as np
import pytest
import scipy.stats

import fitact
from fitact.batch import sample_many as module
from fitact.batch.sample_many import sample_many
from fitact.summary import PROBABILITIES
from tests import calibration
from tests.conftest import square_record

COUNT, SAMPLES, FREQUENCY, AMPLITUDE = 18, 2000, 100.0, 180.0
OFFSET, BROKEN = 4, 7
MEDIANS = {"Rsc": 130e3, "Csc": 18e-9, "Ci": 1.35e-9}
LOG_SDS = {"Rsc": 0.5, "Csc": 0.5, "Ci": 0.05}
SCENE = fitact.Scene.from_dict(
    {
        "drive": {"waveform": "square", "peak_to_peak": 2.0 * AMPLITUDE, "frequency": FREQUENCY},
        "prior": {
            name: {"median": MEDIANS[name], "relative_sd": float(np.sqrt(np.expm1(LOG_SDS[name] ** 2)))}
            for name in MEDIANS
        },
    }
)
PROBABILITY = np.array(list(PROBABILITIES.values()))


def record(number: int) -> fitact.Record:
    scale = np.exp(0.3 * np.sin(np.arange(3) + number))
    skin = {"Rsc": 130e3 * scale[0], "Csc": 18e-9 * scale[1]}
    made = square_record(noise=0.05 + 0.02 * number, seed=number, per_period=SAMPLES // 2, **skin)
    return fitact.Record.from_arrays(made.time, Vsc=made["Vsc"], source=f"finger_{number}.csv")


@pytest.fixture(scope="module")
def given(tmp_path_factory) -> list:
    """Return similar records, one of which requires an offset, and a file that is refused."""
    found: list = [record(number) for number in range(COUNT)]
    found[OFFSET] = fitact.Record.from_arrays(found[OFFSET].time, Vsc=found[OFFSET]["Vsc"] + 2.0, source="offset")
    found[BROKEN] = tmp_path_factory.mktemp("records") / "broken.csv"
    found[BROKEN].write_text("time_s,Vsc_V\n0,1\n1,nan\n")
    return found


@pytest.fixture(scope="module")
def found(given) -> fitact.Fits:
    return sample_many(given, SCENE, seed=2, progress=False)


def quantiles(row: dict, name: str) -> np.ndarray:
    return np.array([row[f"{name}_{key}"] for key in PROBABILITIES])


def assert_alike(row: dict, other: dict, error: float) -> None:
    """Compare all entries of the first, numbers to a relative error; R-hat's ranks depend on rounding."""
    for name in row.keys() - {"rhat_max", "k_hat"}:
        value = row[name]
        assert other[name] == (value if isinstance(value, str) else pytest.approx(value, rel=error)), name


def effective(row: dict, name: str) -> float:
    """Return a lower bound on the effective number of draws; derived quantities of every fourth draw have fewer."""
    return row["ess_min"] / (1.0 if name in (*MEDIANS, "noise") else 4.0)


def assert_shares(shares: np.ndarray, draws: float) -> None:
    """Assert that the fractions below quantiles are binomial within 4.5 standard deviations."""
    error = np.sqrt(PROBABILITY * (1.0 - PROBABILITY) / draws)
    np.testing.assert_array_less(np.abs(shares - PROBABILITY) / error, 4.5)


def test_rows_are_those_of_fits_with_quantiles_beside(found, given):
    fits = fitact.fit_many(given, SCENE, progress=False)
    assert len(found) == len(given)
    for number, (row, fit) in enumerate(zip(found, fits, strict=True)):
        if number == BROKEN:
            assert row == fit
            continue
        assert_alike(fit, row, 1e-9)
        assert row["converged"]
        assert row["rhat_max"] < 1.01 if row["level"] == "emcee" else row["k_hat"] < 0.7
        for name in (*MEDIANS, "noise", "g", "b", "force_mean", "friction_mean"):
            assert np.all(np.diff(quantiles(row, name)) > 0.0), name


def test_alike_records_are_sampled_together_and_others_alone(found):
    together = [number for number, row in enumerate(found) if row.get("level") == "psis"]
    assert together == [number for number in range(COUNT) if number not in (OFFSET, BROKEN)]
    assert (found[OFFSET]["freed"], found[OFFSET]["level"]) == ("offset", "emcee")
    assert found[BROKEN]["result"] == "refused"
    assert "Rsc_q50" not in found[BROKEN]


def assert_quantiles_of_separate_posterior(row: dict, fitted: fitact.Fit) -> None:
    """Both are draws of the same posterior, so the error of each fraction is that of both."""
    posterior = fitact.sample(fitted, seed=5, progress=False)
    parameters, convergence = posterior.parameters(), posterior.convergence
    drawn = parameters | posterior.derived() | {"noise": parameters[fitted.likelihood.sigma_names[0]]}
    taken = (convergence.steps - convergence.burn) * convergence.walkers * convergence.ensembles
    ours = convergence.ess_min * posterior.log_prob.size / taken
    for name in (*MEDIANS, "noise", *module.derived.DERIVED_NAMES):
        shares = np.searchsorted(np.sort(drawn[name], axis=None), quantiles(row, name)) / drawn[name].size
        assert_shares(shares, 1.0 / (1.0 / ours + 1.0 / effective(row, name)))


@pytest.mark.parametrize("number", [0, OFFSET])
def test_quantiles_are_those_of_each_by_itself(found, given, number):
    assert_quantiles_of_separate_posterior(found[number], fitact.fit(given[number], SCENE))


def marginals(record: fitact.Record) -> dict:
    """Return cumulative distributions of a record's posterior by sums on a grid of (log g, log b), without fitact.

    The noise, flat in its logarithm, integrates out as (sum of squares)^(-n/2). So does the unidentified direction:
    given g and b, log Rsc and log Csc are log Ci plus constants, and three normals of log Ci multiply to one.
    """
    half = np.floor(record.time * 2.0 * FREQUENCY + 1e-9)
    sign, since = np.where(half % 2 == 0.0, 1.0, -1.0), record.time - half / (2.0 * FREQUENCY)

    def signal(log_g, log_b):
        g, b = np.exp(log_g)[..., None], np.exp(log_b)[..., None]
        return sign * 2.0 * AMPLITUDE * g / (1.0 + np.exp(-0.5 / FREQUENCY / b)) * np.exp(-since / b)

    def misfit(theta):
        return record["Vsc"] - signal(*theta)

    total = 2.0 * MEDIANS["Ci"] + MEDIANS["Csc"]
    best = scipy.optimize.least_squares(misfit, np.log([MEDIANS["Ci"] / total, MEDIANS["Rsc"] * total]), x_scale=0.1)
    root = np.linalg.cholesky(np.linalg.inv(best.jac.T @ best.jac)) * np.sqrt(2.0 * best.cost / SAMPLES)
    z = np.linspace(-7.0, 7.0, 71)
    log_g, log_b = best.x[:, None] + root @ np.stack(np.meshgrid(z, z, indexing="ij")).reshape(2, -1)
    squares = np.sum((record["Vsc"] - signal(log_g, log_b)) ** 2, axis=-1)
    log_ratio = np.log(np.exp(-log_g) - 2.0)  # log(Csc / Ci)
    # each prior as a normal distribution of log Ci
    means = np.stack(
        [
            log_b + log_g - np.log(MEDIANS["Rsc"]),
            np.log(MEDIANS["Csc"]) - log_ratio,
            np.full(log_g.size, np.log(MEDIANS["Ci"])),
        ]
    )
    precisions = np.array([LOG_SDS[name] ** -2 for name in ("Rsc", "Csc", "Ci")])
    mean, sd = precisions @ means / precisions.sum(), precisions.sum() ** -0.5
    log_weight = (
        -0.5 * SAMPLES * np.log(squares) - 0.5 * precisions @ (means - mean) ** 2 - np.log1p(-2.0 * np.exp(log_g))
    )
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()

    def of_ci(shift, sign, values):
        return np.array([weight @ scipy.stats.norm.cdf(np.log(v), shift + sign * mean, sd) for v in values])

    def of_grid(logs, values):
        order = np.argsort(logs)
        return np.interp(np.log(values), logs[order], np.cumsum(weight[order]) - 0.5 * weight[order])

    return {
        "g": functools.partial(of_grid, log_g),
        "b": functools.partial(of_grid, log_b),
        "Ci": functools.partial(of_ci, 0.0, 1.0),
        "Csc": functools.partial(of_ci, log_ratio, 1.0),
        "Rsc": functools.partial(of_ci, log_b + log_g, -1.0),
        "noise": lambda values: np.array([weight @ scipy.stats.chi2.sf(squares / v**2, SAMPLES) for v in values]),
    }


@pytest.mark.parametrize("number", [0, 5, 17])
def test_quantiles_against_an_integral(found, given, number):
    for name, cumulative in marginals(given[number]).items():
        assert_shares(cumulative(quantiles(found[number], name)), effective(found[number], name))


@pytest.mark.slow
def test_rows_do_not_depend_on_what_else_is_sampled(found, given):
    again = sample_many(given, SCENE, seed=2, progress=False)
    assert again.rows == found.rows
    others = sample_many([*reversed(given[8:]), *(record(n) for n in range(30, 37))], SCENE, seed=2, progress=False)
    for row, other in zip(reversed(found[8:]), others, strict=False):
        if row["record"] != "offset":
            assert_alike(row, other, 1e-6)
    another = sample_many([*given[8:], *given[:6]], SCENE, seed=3, progress=False)
    assert another[0]["Rsc"] == pytest.approx(found[8]["Rsc"], rel=1e-9)
    assert another[0]["Rsc_q50"] != found[8]["Rsc_q50"]


def test_what_has_not_converged_together_is_sampled_alone(given, monkeypatch):
    monkeypatch.setattr(module, "_sample_record", functools.partial(module._sample_record, min_effective=1e9))
    monkeypatch.setattr(module, "_alone", lambda record, scene, seed: {"record": record.source})
    rows = sample_many([each for each in given if isinstance(each, fitact.Record)], SCENE, progress=False)
    assert all(row.keys() == {"record"} for row in rows)


def test_what_has_not_converged_is_not_trusted(monkeypatch):
    short = functools.partial(fitact.sample, walkers=16, max_steps=60)
    monkeypatch.setattr(module, "sample", short)
    (row,) = sample_many([record(0)], SCENE, progress=False)
    assert (row["result"], row["trusted"], row["converged"], row["level"]) == ("successful", False, False, "emcee")
    assert "not converged" in row["message"]


@pytest.mark.slow  # a program for this prior
def test_a_prior_that_ends_within_the_posterior():
    """The prior of Csc ends at the truth of one record, far from those of the others."""
    heights = np.sin(np.arange(100) + 1.0)
    records = [record(n) for n in (int(np.argmin(heights)), *np.flatnonzero(heights > -0.2)[:16].tolist())]
    settings = SCENE.model_dump(mode="json", exclude_unset=True)
    low = 18e-9 * float(np.exp(0.3 * heights.min()))
    settings["prior"]["Csc"] = {"low": low, "high": 1e-7}
    scene = fitact.Scene.from_dict(settings)
    rows = sample_many(records, scene, progress=False)
    assert all(row["trusted"] for row in rows)
    assert low < rows[0]["Csc_q025"] < 1.01 * low
    assert_quantiles_of_separate_posterior(rows[0], fitact.fit(records[0], scene))


def test_crashes_of_the_sampler_stay_where_they_are(given, monkeypatch, tmp_path: Path):
    def breaks(*_, **__):
        raise ZeroDivisionError("of all things")

    monkeypatch.setattr(module, "sample", breaks)
    only_fitted, refused = sample_many([given[0], given[BROKEN]], SCENE, progress=False)
    assert (only_fitted["result"], refused["result"]) == ("successful", "refused")
    assert not only_fitted["trusted"]
    assert not only_fitted["converged"]
    assert "ZeroDivisionError: of all things" in only_fitted["message"]


def test_an_interrupted_chain_ends_the_call(given, monkeypatch):
    def interrupted(fit, **how):
        posterior = fitact.sample(fit, **how)
        judged = dataclasses.replace(posterior.convergence, interrupted=True)
        return dataclasses.replace(posterior, convergence=judged)

    monkeypatch.setattr(module, "sample", interrupted)
    with pytest.raises(KeyboardInterrupt):
        sample_many([given[0]], SCENE, progress=False)


def drawn_from_the_prior(number: int, time: np.ndarray) -> tuple[fitact.Record, dict[str, float]]:
    """Return a steady-state square by scipy's state space, its parameters drawn from `calibration.PRIOR`, and these."""
    rng = np.random.default_rng([8, number])
    spread = scipy.stats.norm.ppf(0.975)
    truth = {
        name: float(median * calibration.FACTORS[name] ** (rng.standard_normal() / spread))
        for name, median in calibration.MEDIANS.items()
    }
    truth["sigma"] = float(np.exp(rng.uniform(*np.log(calibration.NOISE))))
    total = 2.0 * truth["Ci"] + truth["Csc"]
    g, truth["b"] = truth["Ci"] / total, truth["Rsc"] * total
    settled = calibration.steady("square", FREQUENCY, calibration.wave("square", rng), g, truth["b"])
    vsc = np.resize(settled, time.size) + truth["sigma"] * rng.standard_normal(time.size)
    square = calibration.steady_mean_square("square", FREQUENCY, settled, g, truth["b"])
    series = truth["Ci"] * truth["Csc"] / (truth["Ci"] + truth["Csc"])
    truth["force_mean"] = square * series / (2.0 * calibration.THICKNESS)
    truth["a"] = truth["Rsc"] * truth["Ci"]
    return fitact.Record.from_arrays(time, Vsc=vsc, source=str(number)), truth


@pytest.mark.slow
def test_calibration(monkeypatch):
    """Rank 300 truths from the prior among 99 independent draws of each posterior, as `calibration` does."""
    time = np.arange(1000) / (calibration.PER_PERIOD * FREQUENCY)
    made = [drawn_from_the_prior(number, time) for number in range(300)]
    scene = fitact.Scene.from_dict(
        {"drive": {"waveform": "square", "peak_to_peak": 2.0 * AMPLITUDE, "frequency": FREQUENCY}}
        | {"prior": calibration.PRIOR}
    )
    ranks: dict[str, list[int]] = {}
    columns_of = module._posterior_columns

    def seen(row, draws, convergence, weights=None):
        number = int(row["record"])
        rng, truth = np.random.default_rng([9, number]), made[number][1]
        found = dict(draws) | {"a": draws["Rsc"] * draws["Ci"]}
        few = {}
        for name in calibration.QUANTITIES:
            values = found[name].ravel()
            shares = None if weights is None else weights.weights[: values.size] / weights.weights[: values.size].sum()
            few[name] = rng.choice(values, calibration.DRAWS, replace=False, p=shares)
        ranks[row["record"]] = [int(np.sum(few[name] < truth[name])) for name in calibration.QUANTITIES]
        return columns_of(row, draws, convergence, weights)

    monkeypatch.setattr(module, "_posterior_columns", seen)
    rows = sample_many([record for record, _ in made], scene, seed=1, progress=False)
    assert len(ranks) == len(rows) == 300
    assert sum(row["level"] == "psis" for row in rows) > 150
    judged = calibration.judge(np.array([ranks[str(number)] for number in range(300)]))
    assert judged.passed, judged
