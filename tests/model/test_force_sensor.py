"""Readings of a force sensor, against scipy's simulation of its differential equation."""

import jax
import numpy as np
import pytest
import scipy.signal

from fitact.model.force_sensor import ForceSensor

STEP, COUNT = 2e-5, 4096


@pytest.mark.parametrize("damping", [0.02, 0.3, 0.9, None])
@pytest.mark.parametrize("frequency", [3.0, 400.0, 9e3])
def test_reading_follows_the_differential_equation(frequency: float, damping: float | None) -> None:
    """Together with its ringing, the reading is that of a sensor in any state at the first sample."""
    w = 2.0 * np.pi * frequency
    denominator = [1.0, w] if damping is None else [1.0, 2.0 * damping * w, w * w]
    system = scipy.signal.StateSpace(*scipy.signal.tf2ss([denominator[-1]], denominator))
    A, B, C, *_ = scipy.signal.cont2discrete((system.A, system.B, system.C, system.D), STEP)
    force = np.random.default_rng(0).standard_normal(COUNT)  # any force serves
    state, expected = np.random.default_rng(1).standard_normal(len(A)) / w, np.empty(COUNT)
    for n, f in enumerate(force):
        state = A @ state + B[:, 0] * f
        expected[n] = (C @ state)[0]
    with jax.enable_x64(True):
        sensor = ForceSensor(frequency, damping)
        reading, ringing = sensor.respond(force, STEP), np.asarray(sensor.ringing(STEP * np.arange(COUNT)))
    difference = expected - np.asarray(reading)
    coefficients, *_ = np.linalg.lstsq(ringing.T, difference, rcond=None)
    assert np.max(np.abs(difference - coefficients @ ringing)) < 1e-9 * np.max(np.abs(expected))


def test_a_damping_of_one_or_more_is_not_finite() -> None:
    with jax.enable_x64(True):
        assert np.all(np.isnan(np.asarray(ForceSensor(100.0, 1.2).respond(np.ones(16), STEP))))
