"""Posterior methods against closed forms, for a prior with bounds along the unidentified direction."""

import functools

import numpy as np
import pytest

import fitact
from fitact.likelihood import certificate
from tests.conftest import square_record

WIDE = {"Csc": ("0.1 nF", "900 nF"), "Ci": ("0.01 nF", "100 nF")}
BOXES = {
    "Rsc binds": WIDE | {"Rsc": ("80 kohm", "200 kohm")},
    "Rsc binds, wide": WIDE | {"Rsc": ("20 kohm", "1 Mohm")},
    "Csc binds": WIDE | {"Rsc": ("1 kohm", "10 Mohm"), "Csc": ("10 nF", "40 nF")},
    "Ci binds": WIDE | {"Rsc": ("1 kohm", "10 Mohm"), "Ci": ("1.2 nF", "1.5 nF")},
    "Rsc and Csc bind": WIDE | {"Rsc": ("100 kohm", "10 Mohm"), "Csc": ("8.85 nF", "44.25 nF")},
}
SHARES = np.array([0.05, 0.5, 0.95])
TOLERANCES = {"compressed": certificate.TOLERANCE, "full": 0.0}


@functools.cache
def box_fit(box: str, likelihood: str) -> fitact.Fit:
    prior = {name: {"low": low, "high": high} for name, (low, high) in BOXES[box].items()}
    scene = fitact.Scene.from_dict({"drive": {"waveform": "square"}, "prior": prior})
    fit = fitact.fit(square_record(per_period=400), scene, tolerance=TOLERANCES[likelihood])
    assert fit.model()["likelihood"] == likelihood
    assert fit.result == "successful"  # an optimum at the edge of the box is not a failure
    return fit


def limits_along_the_ridge(fit: fitact.Fit) -> tuple[float, float]:
    """Return the bounds of Rsc, ohm, where the line (Rsc/k, k Csc, k Ci) leaves the box of the prior."""
    Rsc, Csc, Ci = np.exp(fit.point[:3])
    prior = fit.scene.prior
    low = max(prior.Rsc.low, Rsc * Csc / prior.Csc.high, Rsc * Ci / prior.Ci.high)
    return low, min(prior.Rsc.high, Rsc * Csc / prior.Csc.low, Rsc * Ci / prior.Ci.low)


def deviations(posterior: fitact.Posterior) -> np.ndarray:
    """Return deviations of quantiles of Rsc from those of p(Rsc) ~ 1/Rsc^2 between its bounds, in standard errors.

    1/Rsc is uniform, so the quantile of probability q is Rsc = 1 / (1/low - q (1/low - 1/high)).
    """
    low, high = limits_along_the_ridge(posterior.fit)
    expected = 1.0 / (1.0 / low - SHARES * (1.0 / low - 1.0 / high))
    Rsc = posterior.parameters()["Rsc"].ravel()
    found = np.mean(Rsc[:, None] <= expected, axis=0)
    return (found - SHARES) / np.sqrt(SHARES * (1.0 - SHARES) / min(posterior.convergence.ess["Rsc"], Rsc.size))


@pytest.mark.slow
@pytest.mark.parametrize("box", BOXES)
@pytest.mark.parametrize("likelihood", TOLERANCES)
def test_uniform_priors_give_the_inverse_square_law_along_the_blind_direction(box: str, likelihood: str):
    fit = box_fit(box, likelihood)
    for level in ("emcee", "psis"):
        posterior = fitact.sample(fit, level=level, seed=5, progress=False)
        assert posterior.convergence.converged
        # four standard errors: one seed in a thousand fails
        assert np.max(np.abs(deviations(posterior))) < 4.0, level
    laplace = fitact.sample(fit, level="laplace", seed=5, progress=False).convergence
    assert not laplace.converged  # the Gaussian approximation ignores the bounds, which its diagnostic detects
    assert "REFUSED" in str(laplace)


@pytest.mark.slow
def test_autocorrelation_is_short_in_a_box():
    c = fitact.sample(box_fit("Rsc binds", "compressed"), seed=5, progress=False).convergence
    assert c.tau_max < 5.0
    assert c.steps < 1000


def test_published_quantiles_of_the_inverse_square_law():
    """82, 114, 186 kohm between 80 and 200 kohm."""
    low, high = limits_along_the_ridge(box_fit("Rsc binds", "compressed"))
    assert (low, high) == pytest.approx((80e3, 200e3))
    posterior = fitact.sample(box_fit("Rsc binds", "compressed"), seed=6, progress=False)
    np.testing.assert_allclose(np.quantile(posterior.parameters()["Rsc"], SHARES), [82e3, 114e3, 186e3], rtol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("level", ["laplace", "psis"])
def test_levels_agree_with_emcee_where_the_posterior_is_normal(
    level: str, finger_fit: fitact.Fit, finger_posterior: fitact.Posterior
):
    posterior = fitact.sample(finger_fit, level=level, seed=1, progress=False)
    c = posterior.convergence
    assert c.converged
    assert c.level == posterior.summary()["convergence"]["level"] == level
    assert c.k_hat < 0.7
    reference = finger_posterior.parameters() | finger_posterior.force()
    for name, draws in (posterior.parameters() | posterior.force()).items():
        size = min(c.ess_min, finger_posterior.convergence.ess_min, draws.size)
        mean, sd = np.mean(reference[name]), np.std(reference[name])
        assert abs(np.mean(draws) - mean) < 5.0 * sd * np.sqrt(2.0 / size), name
        assert np.std(draws) == pytest.approx(sd, rel=5.0 / np.sqrt(size)), name


@pytest.mark.slow
def test_independent_draws_repeat_and_hardly_any_twice(finger_fit: fitact.Fit):
    first, again, other = (fitact.sample(finger_fit, level="psis", seed=seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.points, again.points)
    assert not np.array_equal(first.points, other.points)
    flat = first.points.reshape(-1, first.points.shape[-1])
    assert len(np.unique(flat, axis=0)) > 0.95 * len(flat)


def test_unknown_level_is_refused(finger_fit: fitact.Fit):
    with pytest.raises(fitact.InputError, match="choose one of"):
        fitact.sample(finger_fit, level="exact")  # type: ignore[arg-type]
