"""Readings of a force sensor, against scipy's simulation of its differential equation."""

import jax
import numpy as np
import pytest
import scipy.linalg
import scipy.signal

from fitact.model.force_sensor import ForceSensor, StepForce

STEP, COUNT = 2e-5, 4096


@pytest.mark.parametrize("damping", [0.02, 0.3, 0.9, None])
@pytest.mark.parametrize("frequency", [3.0, 400.0, 9e3])
def test_reading_follows_the_differential_equation(frequency: float, damping: float | None) -> None:
    """Together with its ringing, the reading is that of a sensor in any state at the first sample."""
    w = 2.0 * np.pi * frequency
    denominator = [1.0, w] if damping is None else [1.0, 2.0 * damping * w, w * w]
    system = scipy.signal.StateSpace(*scipy.signal.tf2ss([denominator[-1]], denominator))
    # the exact map over a step for a force that begins at f and rises by r
    size = len(system.A)
    whole = np.zeros((size + 2, size + 2))
    whole[:size, :size], whole[:size, size], whole[size, size + 1] = system.A * STEP, system.B[:, 0] * STEP, 1.0
    moved = scipy.linalg.expm(whole)[:size]
    mean, rise = np.random.default_rng(0).standard_normal((2, COUNT))  # any force serves
    state, expected = np.random.default_rng(1).standard_normal(size) / w, np.empty(COUNT)
    for n, (m, r) in enumerate(zip(mean, rise, strict=True)):
        state = moved @ np.concatenate([state, [m - 0.5 * r, r]])
        expected[n] = (system.C @ state)[0]
    with jax.enable_x64(True):
        sensor = ForceSensor(frequency, damping)
        reading, ringing = (
            sensor.respond(StepForce(mean, rise), STEP),
            np.asarray(sensor.ringing(STEP * np.arange(COUNT))),
        )
    difference = expected - np.asarray(reading)
    coefficients, *_ = np.linalg.lstsq(ringing.T, difference, rcond=None)
    assert np.max(np.abs(difference - coefficients @ ringing)) < 1e-9 * np.max(np.abs(expected))


def test_a_damping_of_one_or_more_is_not_finite() -> None:
    with jax.enable_x64(True):
        assert np.all(np.isnan(np.asarray(ForceSensor(100.0, 1.2).respond(StepForce(np.ones(16), np.zeros(16)), STEP))))
