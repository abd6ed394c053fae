"""Rounded values: thresholds that they pass are known, and errors of runs lie within the stated ones."""

import math

import numpy as np
import pytest

from fitact.problem.recorded_current import drive_variance
from fitact.problem.runs import RoundedSteps, least_step, run_lengths


def group_errors(current: np.ndarray, noise: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray, RoundedSteps]:
    """Return the errors of the means of groups of a rounded current with this noise (steps), and the stated ones."""
    rng = np.random.default_rng(seed)
    found = RoundedSteps.from_samples(np.round(current + noise * rng.standard_normal(current.size)), 1.0)
    begins = np.flatnonzero(np.diff(found.group, prepend=0) * (found.group > 0))
    ends = begins + np.unique(found.group[found.group > 0], return_counts=True)[1]
    pairs = list(zip(begins, ends + 1, strict=True))
    errors = np.array([np.mean(found.values[a:b]) - np.mean(current[a:b]) for a, b in pairs])
    return errors, np.sqrt(found.variance[begins]), found


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.03, 0.1])
def test_errors_of_groups_are_as_stated(noise: float):
    """A current that decays through nine values of a converter; where noise makes them alternate, no mean is taken."""
    time = np.arange(40_000)
    errors, stated, found = group_errors(9.3 * np.exp(-time / 6000.0), noise)
    assert np.all(np.abs(errors) < 3.5 * stated)
    assert np.sqrt(np.mean(np.square(errors / stated))) < 1.5
    assert np.count_nonzero(np.isclose(stated, 0.05)) >= 8  # thresholds that are passed
    assert np.mean(found.group > 0) > 0.9


def test_values_that_alternate_until_the_end_do_not_tell_the_mean():
    """A current that settles beside a threshold, by the noise: its values are off by half a step, all alike."""
    time = np.arange(6_000)
    errors, stated, found = group_errors(2.47 + 3.0 * np.exp(-time / 500.0), 0.03)
    assert np.all(np.abs(errors) < 3.5 * stated)
    begins = np.flatnonzero(np.diff(found.group, prepend=0) * (found.group > 0))
    later = begins > 2_500
    weights = 1.0 / (stated**2 * found.alike[begins])[later]
    assert abs(np.sum(weights * errors[later])) < 2.0 * np.sqrt(np.sum(weights))


def test_a_step_between_two_plateaus_is_no_passage():
    """Plateaus at 0 and 1, with 700 between them, lie beside each other in value, but not in time."""
    current = np.concatenate([np.full(500, 0.3), [250.0, 700.0, 400.0], np.full(500, 0.8)])
    _, stated, found = group_errors(current, 0.0)
    np.testing.assert_allclose(stated, 0.29)
    assert np.all(found.group[499:503] == 0)


def test_noise_of_a_quarter_step_makes_rounding_noise():
    errors, _, found = group_errors(3.0 * np.sin(np.arange(20_000) / 900.0), 0.4)
    assert errors.size == 0
    assert not found.group.any()


def test_runs_and_least_step():
    values = np.array([1.0, 1.0, 2.0, 2.0, 2.0, 5.0])
    np.testing.assert_array_equal(run_lengths(values), [2, 2, 3, 3, 3, 1])
    assert least_step(np.repeat(values, 4)) == 1.0
    assert least_step(np.arange(9.0) ** 2) == 0.0
    assert math.isclose(least_step(np.repeat([0.0, 0.25, 1.0], 40)), 0.25)


def test_rounding_of_V_is_an_offset_on_plateaus_only():
    """Not on a ramp of four samples a step, nor where V settles: there, I followed what V did not show, 60 sd away."""
    k = np.arange(800.0)
    V = np.round(np.minimum(0.25 * k, 100.0 - 3.0 * np.exp(-np.maximum(k - 388.0, 0.0) / 4.0)))
    white, rounding = 0.1, 1.0 / np.sqrt(12.0)
    variance = drive_variance(V, white, rounding)
    np.testing.assert_allclose(variance[:430], white**2 + rounding**2)
    np.testing.assert_allclose(variance[500:], white**2)
    np.testing.assert_allclose(drive_variance(V, rounding, rounding), 2.0 * rounding**2)
