"""Profile intervals and information criteria against scipy, normal theory and closed forms."""

import json

import numpy as np
import pytest
import scipy.optimize
import scipy.stats
from typer.testing import CliRunner

import fitact
from fitact.cli import app
from fitact.compiled import pad_weight
from fitact.fitting.channel_fit import criteria, log_likelihood
from tests.conftest import SQUARE, square_record


@pytest.fixture
def fit(summed_fit: fitact.Fit) -> fitact.Fit:
    return summed_fit


@pytest.fixture(scope="module")
def noisy() -> fitact.Fit:
    """Return a fit so noisy that g and b are known to several per cent, and the interval of b is asymmetric."""
    return fitact.fit(square_record(per_period=200, noise=13.0), SQUARE)


def brute_force(fit: fitact.Fit, level: float) -> tuple[float, float]:
    """Return the interval of b from the data alone, by scipy; for each b the best g is linear."""
    record, sigma = fit.record, fit.sigma
    V, phase = record["V"], (record.time + 1e-9) % 5e-3

    def left(b: float) -> float:
        shape = np.sign(V) * 360.0 * np.exp(-phase / b) / (1.0 + np.exp(-5e-3 / b))
        return float(np.sum((record["Vsc"] - shape * (shape @ record["Vsc"]) / (shape @ shape)) ** 2)) / sigma**2

    best = scipy.optimize.minimize_scalar(left, bounds=(1e-3, 8e-3), method="bounded", options={"xatol": 1e-12})
    rise = scipy.stats.chi2.ppf(level, 1)
    sides = ((5e-4, best.x), (best.x, 5e-2))
    low, high = (scipy.optimize.brentq(lambda b: left(b) - best.fun - rise, *side) for side in sides)
    return low, high


@pytest.mark.parametrize("level", [pytest.param(0.5, marks=pytest.mark.slow), 0.95])
def test_interval_of_b_against_a_brute_force_profile(noisy: fitact.Fit, level: float):
    low, high = brute_force(noisy, level)
    found = noisy.profile("b", level, prior=False)
    np.testing.assert_allclose([found.low, found.high], [low, high], rtol=5e-4)


@pytest.mark.slow
def test_along_the_blind_direction_the_profile_is_the_priors_normal(fit: fitact.Fit):
    """The problem is linear and Gaussian in this direction: ± z standard deviations, z from scipy's chi-square."""
    z = np.sqrt(scipy.stats.chi2.ppf(0.9, 1))
    for name, found in fit.intervals(0.9).items():
        if name in fit.names:
            i = fit.names.index(name)
            np.testing.assert_allclose(
                np.log([found.low, found.high]), fit.theta[i] + z * fit.sd[i] * np.array([-1.0, 1.0]), atol=1e-4
            )


@pytest.mark.slow
def test_the_records_alone_leave_the_contact_area_open(fit: fitact.Fit):
    found = fit.intervals(prior=False)
    for name in ("Rsc", "Csc", "Ci", "force_mean"):
        assert found[name].open == "both"
        assert (found[name].low, found[name].high) == (0.0, np.inf)
        assert found[name].to_dict()["high"] is None
    for name in ("g", "b"):
        assert not found[name].open
        assert found[name].low < fit.derived()[name]["q50"] < found[name].high


@pytest.mark.parametrize(
    ("name", "level", "words"), [("Z", 0.95, "no interval is available for Z"), ("Ci", 1.0, "between 0 and 1")]
)
def test_what_has_no_interval_is_refused(fit: fitact.Fit, name: str, level: float, words: str):
    with pytest.raises(fitact.InputError, match=words):
        fit.profile(name, level)


@pytest.mark.slow
def test_without_the_prior_vsc_alone_is_rank_deficient(fit: fitact.Fit):
    alone = fitact.fit(fit.record, SQUARE, prior=False)
    assert alone.result == "rank_deficient"
    assert alone.identifiability.verdict == "unidentified"
    assert np.all(np.isfinite(alone.sd))
    assert np.all(alone.sd > 5.0)  # in logarithms
    assert alone.derived()["b"]["q50"] == pytest.approx(fit.derived()["b"]["q50"], rel=1e-6)
    assert alone.derived()["b"]["sd"] == pytest.approx(fit.derived()["b"]["sd"], rel=1e-3)
    assert "contraction" not in alone.parameters()["Rsc"]
    assert "undetermined" in str(alone)
    with pytest.raises(fitact.InputError, match="prior=False"):
        fitact.sample(alone)


@pytest.mark.slow
def test_the_command_line_adds_them(finger_path, tmp_path):
    record = fitact.read(finger_path)
    few = tmp_path / "few.csv"
    table = np.column_stack([record.time, record["V"], record["Vsc"]])[:500]
    np.savetxt(few, table, delimiter=",", header="time_s,V_V,Vsc_V", comments="")
    result = CliRunner().invoke(app, ["fit", str(few), "--intervals", "--json"])
    content = json.loads(result.stdout)
    assert content["intervals"]["Ci"]["without_prior"]["open"] == "both"
    assert content["intervals"]["Ci"]["with_prior"]["low"] < 1.35e-9 < content["intervals"]["Ci"]["with_prior"]["high"]
    assert content["fit"]["bic"] > content["fit"]["aic"]


def test_criteria_of_a_regression_in_closed_form():
    """Sum of scipy's normal log-densities at the maximum-likelihood noise."""
    rng = np.random.default_rng(5)
    x = rng.standard_normal(40)
    y = 2.0 * x + 0.3 * rng.standard_normal(40)
    residuals = y - (x @ y) / (x @ x) * x
    likelihood = scipy.stats.norm.logpdf(residuals, scale=np.sqrt(np.mean(residuals**2))).sum()
    found = criteria(likelihood, 2, 40)
    assert found["log_likelihood"] == pytest.approx(likelihood, rel=1e-12)
    assert found["aic"] == pytest.approx(4.0 - 2.0 * likelihood, rel=1e-12)
    assert found["aicc"] == pytest.approx(4.0 - 2.0 * likelihood + 12.0 / 37.0, rel=1e-12)
    assert found["bic"] == pytest.approx(2.0 * np.log(40.0) - 2.0 * likelihood, rel=1e-12)


def test_log_likelihood_of_unequal_noise(fit: fitact.Fit):
    rng = np.random.default_rng(6)
    residuals = rng.standard_normal(fit.residuals.size)
    weight = rng.choice([1.0, 0.5, 0.0, 2.0], residuals.size)
    kept = weight > 0.0
    channel = fit.likelihood.channels[0].replace_samples(weight=pad_weight(weight))
    scale = np.sqrt(np.mean((residuals * weight)[kept] ** 2))
    expected = scipy.stats.norm.logpdf(residuals[kept], scale=scale / weight[kept]).sum()
    found = log_likelihood(channel, residuals, (residuals * weight)[kept], 1.0)
    assert found == pytest.approx(expected, rel=1e-12)


def test_a_fits_criteria_count_what_was_freed(fit: fitact.Fit):
    """The count includes three parameters and a noise sd."""
    residuals = fit.residuals
    likelihood = scipy.stats.norm.logpdf(residuals, scale=np.sqrt(np.mean(residuals**2))).sum()
    assert fit.figures["aic"] == pytest.approx(2.0 * 4 - 2.0 * likelihood, rel=1e-12)
