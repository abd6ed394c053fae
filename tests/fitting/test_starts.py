"""Given starts and multiple starts; optima that differ by an exchange of two skins count as two."""

import numpy as np
import pytest

import fitact
from tests.conftest import SQUARE
from tests.fitting.test_joint import SKIN, STEP, free, record, scene


@pytest.fixture
def fit(square_fit: fitact.Fit) -> fitact.Fit:
    return square_fit


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
