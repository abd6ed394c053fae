"""Comparison of models by their data. References: records and refits by scipy; chi-square, normal and Student's t."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.integrate
import scipy.optimize
import scipy.stats

import fitact
from fitact.model_selection.comparison import Comparison, ModelScore
from fitact.model_selection.cross_validation import (
    CrossValidation,
    _LinearisedChannel,
    _LinearisedModel,
    block_indices,
    cross_validate,
)
from tests.fitting.test_joint import SKIN, free, record, scene

PRIOR = {"Rsc": (160e3, 3.0), "Csc": (22e-9, 3.0), "Ci": (1.35e-9, 1.5)}  # median, and a factor that contains 95 %
AMPLITUDE, OMEGA, SAMPLES = 180.0, 2.0 * np.pi * 100.0, 400


def sine_record(seed: int, noise: float = 2.0) -> fitact.Record:
    rng, time = np.random.default_rng(seed), np.arange(SAMPLES) * (0.02 / SAMPLES)
    vsc = sine(np.log([130e3, 18e-9, 1.35e-9]), time) + noise * rng.standard_normal(SAMPLES)
    return fitact.Record.from_arrays(time, V=AMPLITUDE * np.sin(OMEGA * time), Vsc=vsc)


def sine(theta: np.ndarray, time: np.ndarray) -> np.ndarray:
    R, C, Ci = np.exp(theta)
    skin = R / (1.0 + 1j * OMEGA * R * C)
    gain = skin / (2.0 * skin + 1.0 / (1j * OMEGA * Ci))
    return AMPLITUDE * np.imag(gain * np.exp(1j * OMEGA * time))


def sine_scene(waveform: str = "sine", **measurement: object) -> fitact.Scene:
    prior = {name: {"median": median, "factor": factor} for name, (median, factor) in PRIOR.items()}
    drive = {"waveform": waveform, "peak_to_peak": 2.0 * AMPLITUDE}
    return fitact.Scene.from_dict({"drive": drive, "prior": prior, "measurement": measurement})


def predicted_by_scipy(made: fitact.Record) -> np.ndarray:
    """Return log-densities of 40 blocks, each from a refit without its fold, integrated over its normal posterior."""
    mean = np.log([median for median, _ in PRIOR.values()])
    sd = np.log([factor for _, factor in PRIOR.values()]) / 1.959963984540054
    block = np.arange(SAMPLES) // 10
    fold = np.random.default_rng(0).permutation(40) % 10
    found = np.zeros(40)
    for number in range(10):
        kept, sigma, theta = fold[block] != number, 2.0, mean
        for _ in range(4):  # the noise is estimated from the residuals

            def residuals(theta: np.ndarray, kept: np.ndarray = kept, sigma: float = sigma) -> np.ndarray:
                left = (made["Vsc"] - sine(theta, made.time))[kept] / sigma
                return np.concatenate([left, (theta - mean) / sd])

            theta = scipy.optimize.least_squares(residuals, theta, xtol=1e-14, ftol=1e-14, gtol=1e-14).x
            left = made["Vsc"] - sine(theta, made.time)
            sigma = math.sqrt(np.sum(left[kept] ** 2) / (kept.sum() - 3))
        step = 1e-5 * np.eye(3)
        slope = np.stack([(sine(theta + h, made.time) - sine(theta - h, made.time)) / 2e-5 for h in step], axis=1)
        covariance = np.linalg.inv(slope[kept].T @ slope[kept] / sigma**2 + np.diag(sd**-2.0))
        for each in np.flatnonzero(fold == number):
            some = block == each
            spread = sigma**2 * np.eye(10) + slope[some] @ covariance @ slope[some].T
            found[each] = scipy.stats.multivariate_normal.logpdf(left[some], cov=spread)
    return found


@pytest.mark.slow
def test_blocks_left_out_are_predicted_as_by_scipys_refits():
    made = sine_record(0)
    ours = cross_validate(fitact.fit(made, sine_scene()))
    assert (ours.folds, ours.folds_failed) == (10, 0)
    # the noise converges to 1 %, which changes a block of ten samples by 1e-3
    np.testing.assert_allclose(ours.log_density, predicted_by_scipy(made), atol=5e-3)


@pytest.mark.parametrize("student", [False, True])
def test_a_block_is_integrated_over_what_the_rest_leaves_open(student: bool):
    """One parameter, against quadrature; under Student's t to the error of the Laplace approximation."""
    z, slope, precision = np.array([0.3, -1.2, 2.0, 0.1]), np.array([1.5, -0.9, 0.6, 1.2]), 300.0
    channel = _LinearisedChannel(z, slope[:, None], np.zeros(4), student)
    near = _LinearisedModel([channel], np.array([[precision]]))
    law = scipy.stats.t(4) if student else scipy.stats.norm()

    def density(x: float) -> float:
        return math.exp(law.logpdf(z + slope * x).sum()) * scipy.stats.norm.pdf(x, scale=precision**-0.5)

    expected = math.log(scipy.integrate.quad(density, -0.6, 0.6, epsabs=0.0, epsrel=1e-10)[0])
    # without the integral the error is 2e-3
    assert near.log_density([np.ones(4, bool)]) == pytest.approx(expected, abs=1e-4 if student else 1e-9)


@pytest.mark.parametrize(("periods", "count"), [(2, 40), (19, 40), (20, 20), (40, 40), (100, 34)])
def test_blocks_are_whole_periods_where_there_are_many(periods: int, count: int):
    time = np.arange(100 * periods) * 1e-4
    made = fitact.Record.from_arrays(time, V=np.sin(2.0 * np.pi * 100.0 * time), Vsc=np.cos(2.0 * np.pi * 100.0 * time))
    found = block_indices(made)
    assert found[0] == 0
    assert set(np.diff(found)) == {0, 1}
    assert found[-1] == count - 1
    if periods >= 20:
        assert np.all(found.reshape(-1, 100) == found[::100, None])


def scored(name: str, log_density: list[float], bic: float, result: str = "successful") -> ModelScore:
    fit = SimpleNamespace(
        figures={"bic": bic, "aic": bic, "aicc": bic, "log_likelihood": 0.0, "parameters_counted": 5, "samples": 100},
        trusted=result == "successful", result=result, message="Poor fit.",
    )  # fmt: skip
    return ModelScore(name, fit, CrossValidation(np.array(log_density), 10, 0))


def ranked(*models: ModelScore) -> Comparison:
    return Comparison(tuple(sorted(models, key=lambda model: -model.elpd)))


FLAT = [1.0] * 16
NOISY = [1.0 + (-1.0) ** i for i in range(16)]  # the same sum; the standard error of the difference is 4.13


def test_verdicts():
    better = ranked(scored("a", FLAT, 0.0), scored("b", [x - 1.0 for x in NOISY], -50.0))
    assert better.preferred == "a"  # by 16 ± 4.1, whatever the criterion says
    assert better.verdict == "a is preferred: it predicts the held-out blocks better than b, by an elpd of 16.0 ± 4.1."
    simpler = ranked(scored("a", FLAT, 15.0), scored("b", [x - 0.1 for x in NOISY], 0.0))
    assert simpler.preferred == "b"
    assert simpler.verdict == (
        "b is preferred because of its BIC: a predicts the held-out blocks better by an elpd of only"
        " 1.6 ± 4.1, and b has a BIC that is lower by 15."
    )
    tied = ranked(scored("a", FLAT, 5.0), scored("b", [x - 0.1 for x in NOISY], 0.0))
    assert tied.preferred is None
    assert tied.verdict.startswith(
        "b and a cannot be distinguished: a predicts the held-out blocks better by an elpd of"
    )
    assert all(found.trusted for found in (better, simpler, tied))


def test_a_preferred_model_that_is_a_misfit_is_not_trusted():
    found = ranked(scored("a", FLAT, 0.0, "misfit"), scored("b", [x - 1.0 for x in NOISY], 0.0))
    assert found.preferred == "a"
    assert not found.trusted
    assert "The fit of a is unreliable: Poor fit." in found.verdict
    other = ranked(scored("a", FLAT, 0.0), scored("b", [x - 1.0 for x in NOISY], 0.0, "misfit"))
    assert other.trusted
    assert other.warnings == ("b: Poor fit.",)


def test_refused():
    made = sine_record(0)
    with pytest.raises(fitact.InputError, match="1 scene to compare: give two or more"):
        fitact.compare(made, [sine_scene()])
    with pytest.raises(fitact.InputError, match="scene 1 models Vsc, scene 2 models I and Vsc: only models of the"):
        fitact.compare(made, [sine_scene(), sine_scene(channels=["Vsc", "I"])])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("other", "excluded"),
    [({"noise_model": "ar1"}, 1), ({"waveform": "measured"}, 12)],
    ids=["ar1", "recorded drive"],
)
def test_models_that_leave_out_different_samples_are_compared_by_those_of_both(other, excluded):
    ideal, rng = sine_record(0), np.random.default_rng(1)
    noisy = {"V": ideal["V"] + 0.1 * rng.standard_normal(SAMPLES), "Vsc": ideal["Vsc"]}
    rounded = {name: np.round(values / 0.05) * 0.05 for name, values in noisy.items()}
    made = fitact.Record.from_arrays(ideal.time, **rounded)
    found = fitact.compare(made, {"first": sine_scene(), "other": sine_scene(**other)})
    counts = [int(model.fit.likelihood.channels[0].count) for model in found.models]
    assert counts == [SAMPLES - excluded] * 2
    assert found.preferred != "other"  # another model of the same noise, or a noisy drive, is no better


RGAP, CGAP = 2e6, 443e-12
RESISTOR = {"channels": ["Vsc", "I"], "series_resistor": 100e3}
WITH = scene(measurement=RESISTOR, gap={"resistance": RGAP, "capacitance": CGAP}, prior=free(Rgap=100.0, Cgap=100.0))


@pytest.mark.slow
@pytest.mark.parametrize("gap", [True, False])
def test_a_gap_is_preferred_where_there_is_one_and_only_there(gap: bool):
    made = record([SKIN, SKIN, *[(RGAP, CGAP)] * gap], 100e3)
    found = fitact.compare(made, {"plain": scene(measurement=RESISTOR), "gap": WITH})
    if gap:
        assert found.preferred == "gap"
        assert found.trusted
        assert found.models[1].elpd_difference(found.models[0])[0] > 1000.0
    else:
        assert found.preferred in ("plain", None)


@pytest.mark.slow
def test_nested_models_differ_by_the_chi_square_law():
    """Twice the gain in log-likelihood by one more parameter is chi-square (1 dof); the AIC changes by 2 less that."""
    measured = {"channels": ["Vsc", "I"]}
    fixed, freed = (
        scene(measurement=measured, prior={"Ci": belief}) for belief in ({"fixed": "1.35 nF"}, {"factor": 100.0})
    )
    gains = []
    for seed in range(40):
        made = record([SKIN, SKIN], seed=seed)
        small, large = (fitact.fit(made, each).figures for each in (fixed, freed))
        gains.append(small["aic"] - large["aic"] + 2.0)
        assert large["parameters_counted"] == small["parameters_counted"] + 1
    # false-alarm probability 1e-4
    assert scipy.stats.kstest(gains, scipy.stats.chi2(1).cdf).pvalue > 1e-4
