"""The statistic of `make calibration`: exact for uniform ranks, and sensitive to wrong ones."""

import jax
import numpy as np
import pytest

import fitact
from tests import calibration


def ranks_of(truths: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return ranks of truths among draws of a standard normal."""
    return np.sum(rng.standard_normal((len(truths), calibration.DRAWS)) < truths[:, None], axis=1)


def test_false_alarms_come_as_often_as_stated():
    """Simulated uniform ranks; 4,000 sets distinguish 5 % from 6.4 % by four standard errors."""
    rng, sets = np.random.default_rng(), 4000
    low, high = calibration.band(50, 0.01)
    found = rng.integers(calibration.VALUES, size=(sets, 50))
    below = np.sum(found[:, :, None] < np.arange(1, calibration.VALUES), axis=1)
    share = np.mean(np.any((below < low) | (below > high), axis=1))
    expected = calibration.leaving(50, 0.01)
    assert abs(share - expected) < 4.5 * np.sqrt(expected * (1.0 - expected) / sets)


def test_p_values_are_no_smaller_than_uniform():
    """They are discrete, so at most one in ten lies below 0.1."""
    rng, sets = np.random.default_rng(), 200
    p = np.array([calibration.p_value(rng.integers(calibration.VALUES, size=40)) for _ in range(sets)])
    assert np.mean(p <= 0.1) < 0.1 + 4.5 * np.sqrt(0.09 / sets)
    assert np.mean(p <= 0.5) > 0.3


@pytest.mark.parametrize(
    ("shift", "spread", "passes"),
    [(0.0, 1.0, True), (0.3, 1.0, False), (0.0, 1.25, False), (0.0, 0.75, False)],
    ids=["right", "biased", "over-confident", "under-confident"],
)
def test_wrong_posteriors_are_found(shift: float, spread: float, passes: bool):
    """Truths not distributed like the draws; the seed is fixed, because 1 of 20 correct sets fails in coverage."""
    rng = np.random.default_rng(4)
    found = np.stack([ranks_of(shift + spread * rng.standard_normal(1000), rng) for _ in range(7)], axis=1)
    assert calibration.judge(found).passed == passes


def test_ranks_that_repeat_are_found():
    """Ranks that are uniform in the mean and in coverage, but clustered."""
    assert calibration.p_value(np.repeat(np.arange(5, 100, 10), 100)) < 1e-6


def test_holm():
    """Holm 1979: the smallest times 3, the next times 2, never decreasing."""
    np.testing.assert_allclose(calibration.holm(np.array([0.04, 0.01, 0.03])), [0.06, 0.03, 0.06])


def test_coverage_counts_whole_intervals():
    """Every rank occurs once, so 50 of 100 are inside, and 90 of 100."""
    for share in calibration.INTERVALS:
        assert calibration.off(np.arange(calibration.VALUES), share) == 0.0


@pytest.mark.parametrize("waveform", ["square", "sine", "triangle", "trapezoid", "measured"])
def test_simulated_records_are_of_the_model(waveform: str):
    """Vsc and the force agree between two routes: scipy's state space or closed forms, and fitact."""
    simulated = (calibration.simulate(1, number) for number in range(100))
    record, scene, truth = next(s for s in simulated if s.scene.drive.waveform == waveform)
    with jax.enable_x64(True):
        circuit = fitact.FinalCircuit(*(truth[name] for name in ("Rsc", "Csc", "Ci")))
        settled = waveform != "measured"
        drive = scene.make_drive() if settled else fitact.Sampled(record.time, record["V"])
        left = record["Vsc"] - np.asarray(fitact.response(circuit, drive, record.time, steady_state=settled))
        if settled:  # the mean square of the samples of a triangle equals that of the waveform to (step / b)^2
            contact = fitact.Contact.from_capacitances(circuit.Ci, circuit.Csc, 1e-4, 1e-6, 200e-6)
            assert fitact.mean_force(circuit, drive, contact) == pytest.approx(truth["force_mean"], rel=1e-3)
    # white noise of the stated sd, to 4.5 standard errors
    assert abs(np.mean(left**2) / truth["sigma"] ** 2 - 1.0) < 4.5 * np.sqrt(2.0 / left.size)
    assert abs(np.mean(left[1:] * left[:-1])) / truth["sigma"] ** 2 < 4.5 / np.sqrt(left.size)


def test_records_can_be_made_one_by_one():
    again, first, other = (calibration.simulate(seed, 5) for seed in (1, 1, 2))
    assert again.record.fingerprint == first.record.fingerprint != other.record.fingerprint
    assert again.truth == first.truth
