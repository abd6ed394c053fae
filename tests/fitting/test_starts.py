"""Given starts and multiple starts; optima that differ by an exchange of two skins count as two."""

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

import fitact
from fitact.fitting.least_squares import LeastSquaresResult
from fitact.fitting.multistart import compare_optima
from fitact.fitting.solution import Solution
from fitact.likelihood.certificate import CertifiedLikelihood
from tests.conftest import SQUARE
from tests.fitting.test_joint import SKIN, STEP, free, record, scene


@pytest.fixture
def fit(square_fit: fitact.Fit) -> fitact.Fit:
    return square_fit


def end_point(Rsc: float, log_density: float, result: str = "successful", sd: float = 1.0) -> Solution:
    """Return a fit of two parameters, of which the second one is the same in all."""
    prior = SimpleNamespace(names=("Rsc", "Csc"))
    solved = SimpleNamespace(
        theta=np.array([Rsc, 0.0]), log_density=log_density, result=result, likelihood=SimpleNamespace(prior=prior)
    )
    return Solution(cast(LeastSquaresResult, solved), cast(CertifiedLikelihood, None), sd * np.eye(2))


@pytest.mark.parametrize(
    ("away", "lower", "distinct", "has_rival"),
    [(3.1, 2.9, 2, True), (3.1, 3.1, 2, False), (2.9, 2.9, 1, False), (-3.1, 0.0, 2, True)],
)
def test_rivals_are_almost_as_probable_and_beyond_the_standard_errors(
    away: float, lower: float, distinct: int, has_rival: bool
):
    """The narrow optimum at the other one's place has standard errors that do not count."""
    found = compare_optima([end_point(away, -lower, sd=0.1), end_point(0.0, 0.0), end_point(0.01, -0.01)], 3.0)
    assert (found.distinct, found.has_rival, found.failed) == (distinct, has_rival, 0)
    assert found.best.solved.log_density == 0.0


def test_the_best_optimum_is_one_that_converged():
    ends = [end_point(9.0, 5.0, "nonlinear_max_steps_reached"), end_point(0.0, 0.0), end_point(0.0, -50.0)]
    found = compare_optima(ends, 3.0)
    assert (found.best.solved.log_density, found.distinct, found.failed, found.has_rival) == (0.0, 1, 1, False)
    assert compare_optima(ends[:1], 3.0).best is ends[0]
    lost = end_point(np.nan, np.nan, "nonfinite")
    assert compare_optima([lost], 3.0).best is lost


def test_a_ridge_is_one_optimum():
    ends = [end_point(place, 0.0, "rank_deficient", sd=1e9) for place in np.linspace(-2.0, 2.0, 8)]
    found = compare_optima(ends, 3.0)
    assert (found.distinct, found.failed, found.has_rival) == (1, 0, False)


FAR = [[1e3, 1e-3, 1e-3], [1e-3, 1e3, 1e3], [1e3, 1e3, 1e-3], [38.0, 1.5e-3, 21.0]]


@pytest.mark.parametrize("factors", [pytest.param(f, id=" ".join(f"{x:g}" for x in f)) for f in FAR])
def test_from_far_starts_beyond_the_table(fit: fitact.Fit, factors: list[float]):
    """Each parameter, and thus b, is far from the truth; the last start once led to a circuit beyond double range."""
    start = dict(zip(fit.names, np.exp(fit.theta) * factors, strict=True))
    found = fitact.fit(fit.record, SQUARE, start=start)
    assert found.trusted
    np.testing.assert_allclose(found.theta, fit.theta, atol=1e-3 * fit.sd.min())


@pytest.mark.slow
def test_a_start_where_the_circuit_gives_no_signal(fit: fitact.Fit):
    """The time constant is far below a sample step, so without the prior no step leads away."""
    start = {"Rsc": 1e-6 * np.exp(fit.theta[0])}
    found = fitact.fit(fit.record, SQUARE, start=start, prior=False)
    assert found.result == "rank_deficient"
    assert found.derived()["b"]["q50"] == pytest.approx(fit.derived()["b"]["q50"], rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("prior", [True, False])
def test_a_hundred_starts_reach_the_optimum(fit: fitact.Fit, prior: bool):
    """Without the prior, the optimum is a line on which g and b are constant."""
    rng = np.random.default_rng(3)
    for _ in range(100):
        theta = fit.theta + rng.uniform(-1.0, 1.0, 3) * np.log(1000.0)
        start = dict(zip(fit.names, np.exp(theta), strict=True))
        found = fitact.fit(fit.record, SQUARE, start=start, prior=prior)
        assert found.result == ("successful" if prior else "rank_deficient")
        for name in ("g", "b"):
            assert found.derived()[name]["q50"] == pytest.approx(fit.derived()[name]["q50"], rel=1e-6)


@pytest.mark.slow
def test_one_optimum_from_many_starts(fit: fitact.Fit):
    found = fitact.fit(fit.record, SQUARE, starts=8)
    assert found.trusted
    assert found.figures["optima"] == 1
    assert found.figures["starts_failed"] == 0
    np.testing.assert_array_equal(found.theta, fit.theta)


def test_starts_with_a_delay(finger_fit: fitact.Fit):
    """A delay against the recorded V is free in each."""
    found = fitact.fit(finger_fit.record, finger_fit.scene, starts=3)
    assert found.figures["optima"] == 1
    np.testing.assert_array_equal(found.theta, finger_fit.theta)


@pytest.mark.slow
def test_the_current_alone_cannot_tell_which_skin_is_which():
    """The admittance does not change if the two skins are exchanged, and their priors are equal."""
    made = record([SKIN, (80e3, 44e-9)], per_period=250)
    skins = {"grounding": {"grounding_Rsc": 160e3, "grounding_Csc": 22e-9}}
    beliefs = free(Rsc=10.0, Csc=10.0, grounding_Rsc=10.0, grounding_Csc=10.0)
    drive = {"waveform": "trapezoid", "rise_time": 4 * STEP, "frequency": 400.0}
    stated = scene(drive=drive, measurement={"channels": ["I"]}, prior=beliefs, **skins)
    found = fitact.fit(made, stated, starts=8)
    assert found.result == "several_optima"
    assert found.figures["optima"] >= 2
    assert not found.trusted


@pytest.mark.parametrize("start", [{"Z": 1e6}, {"Rsc": -1.0}, {"Ci": np.nan}])
def test_a_start_that_is_none_is_refused(fit: fitact.Fit, start: dict[str, float]):
    with pytest.raises(fitact.InputError, match="start"):
        fitact.fit(fit.record, SQUARE, start=start)
