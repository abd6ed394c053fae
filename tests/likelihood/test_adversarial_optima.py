"""Posteriors with two optima: a current does not tell which of two skins slides; against direct quadrature.

The admittance does not change if the two skins are exchanged. If also their priors are equal, so is the posterior.
"""

import math

import numpy as np
import pytest

import fitact
from tests.likelihood.quadrature import CI, STEP, Z95, assert_log_density, assert_quantiles, gaussian, integrate, normal

CAPACITANCE, MEDIAN, FACTOR = 22e-9, 150e3, 10.0
TIME = STEP * np.arange(2000)
OMEGA = 2.0 * np.pi * np.array([100.0, 300.0, 700.0, 2000.0])
HEIGHTS = np.array([60.0, 50.0, 40.0, 30.0])
WAVES = np.exp(1j * np.outer(TIME, OMEGA))
SIGNALS = np.hstack([WAVES.real, WAVES.imag])
FAR_APART, NEARLY_EQUAL = (200e3, 120e3), (170e3, 150e3)


def amplitudes(log_R1: np.ndarray, log_R2: np.ndarray) -> np.ndarray:
    """Return the amplitudes of `SIGNALS` in the current, by the impedances of Ci and two skins in series."""
    skins = [np.exp(u)[..., None] / (1.0 + 1j * OMEGA * CAPACITANCE * np.exp(u)[..., None]) for u in (log_R1, log_R2)]
    current = HEIGHTS / (1.0 / (1j * OMEGA * CI) + skins[0] + skins[1])
    return np.concatenate([current.imag, current.real], axis=-1)


def fit_two_skins(resistances: tuple[float, float], noise: float, starts: int = 1) -> fitact.Fit:
    deviates = np.random.default_rng(1).standard_normal(TIME.size)
    current = SIGNALS @ amplitudes(*np.log(resistances)) + noise * deviates
    given = fitact.Record.from_arrays(TIME, V=WAVES.imag @ HEIGHTS, I=current)
    fixed = {name: {"fixed": True} for name in ("Ci", "Csc", "grounding_Csc")}
    belief = {"median": MEDIAN, "factor": FACTOR}
    scene = fitact.Scene.from_dict(
        {
            "device": {"Ci": CI},
            "drive": {
                "waveform": "multitone",
                "frequencies": (OMEGA / (2.0 * np.pi)).tolist(),
                "amplitudes": HEIGHTS.tolist(),
            },
            "skin": {"Csc": CAPACITANCE},
            "grounding": {"grounding_Rsc": MEDIAN, "grounding_Csc": CAPACITANCE},
            "measurement": {"channels": ["I"]},
            "prior": fixed | {"Rsc": belief, "grounding_Rsc": belief},
        }
    )
    fit = fitact.fit(given, scene, starts=starts)
    assert fit.full_because == ""
    assert fit.compression_error < 1e-3
    return fit


def log_density(fit: fitact.Fit, log_R1: np.ndarray, log_R2: np.ndarray, log_sigma: float | None = None) -> np.ndarray:
    """Return the log-density by sums over the samples that are not excluded at an edge."""
    used = fit.likelihood.channels[0].samples.weights[: TIME.size] > 0.0
    assert used.sum() > TIME.size - 5
    signals, observed, sizes = SIGNALS[used], fit.record["I"][used], amplitudes(log_R1, log_R2)
    squares = observed @ observed - 2.0 * sizes @ (signals.T @ observed)
    squares = squares + np.einsum("...i,ij,...j", sizes, signals.T @ signals, sizes)
    sd = math.log(FACTOR) / Z95
    prior = normal(log_R1, math.log(MEDIAN), sd) + normal(log_R2, math.log(MEDIAN), sd)
    return gaussian(squares, used.sum(), log_sigma) + prior


def assert_posterior(fit: fitact.Fit, box: list[tuple[float, float]]) -> np.ndarray:
    """Assert that the posterior is that of a quadrature in `box`; return the draws of both resistances, ohm."""
    (log_R1, log_R2), weights = integrate(lambda *mesh: log_density(fit, *mesh), box, (161, 161))
    posterior = fitact.sample(fit, seed=1, progress=False)
    assert "g" not in posterior.convergence.tau  # g is constant, since Csc and Ci are fixed
    assert_quantiles(posterior, weights, Rsc=log_R1, grounding_Rsc=log_R2)
    assert_log_density(posterior, lambda *point: float(log_density(fit, *map(np.asarray, point))))
    return np.array([posterior.parameters()[name].ravel() for name in ("Rsc", "grounding_Rsc")])


@pytest.mark.slow  # a chain that changes between optima takes a minute
def test_two_optima_that_overlap():
    """Test that draws reach both optima equally often, though the fit knows one of them."""
    fit = fit_two_skins(NEARLY_EQUAL, 2e-7)
    assert fit.result == "successful"
    posterior = fitact.sample(fit, level="psis", seed=1, progress=False)
    if posterior.convergence.converged:  # else the proposal is that of one optimum, which its diagnostic detects
        swapped = posterior.parameters()["Rsc"] > posterior.parameters()["grounding_Rsc"]
        assert 0.4 < np.mean(swapped) < 0.6
    first, second = assert_posterior(fit, [(math.log(30e3), math.log(800e3))] * 2)
    assert 0.4 < np.mean(first > second) < 0.6
    assert np.mean(np.abs(np.log(first / second)) < 0.05) < 0.25


@pytest.mark.slow
def test_two_optima_far_apart():
    """Test that draws stay at one of them, that several starts find both, and that the fit is then not trusted."""
    fit = fit_two_skins(FAR_APART, 5e-8)
    low, high = fit.theta - 0.2, fit.theta + 0.2
    first, second = assert_posterior(fit, list(zip(low, high, strict=True)))
    assert np.all(first > second) or np.all(first < second)
    assert log_density(fit, *fit.theta[::-1]) == pytest.approx(float(log_density(fit, *fit.theta)), abs=1e-6)
    several = fit_two_skins(FAR_APART, 5e-8, starts=8)
    assert several.result == "several_optima"
    assert several.figures["optima"] == 2
    assert not several.trusted
