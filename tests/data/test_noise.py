"""Estimates of noise, on records with known noise, rounding and drive."""

import numpy as np
import pytest

import fitact
from fitact.data.noise import estimate_noise


@pytest.mark.parametrize("step", [0.0, 0.3, 0.8, 1.5, 2.5])
@pytest.mark.parametrize("shape", ["multitone", "triangle", "charging"])
def test_noise_counts_rounding(step: float, shape: str):
    """Steps of up to 2.5 times the noise; a median of third differences was wrong by a tenth at 1.5 times."""
    rng, time = np.random.default_rng(3), np.arange(20_000) / 1e5
    turns = 100.0 * time
    smooth = 3.0 * np.sin(2.0 * np.pi * turns) + np.sin(40.0 * np.pi * turns)
    triangle = 40.0 * np.abs(turns % 1.0 - 0.5)
    charging = 4.0 * np.exp(-(turns % 0.5) / 0.12) * np.where(turns % 1.0 < 0.5, 1.0, -1.0)  # jumps at the edges
    signal = {"multitone": smooth, "triangle": triangle, "charging": charging}[shape]
    values = signal + 0.02 * rng.standard_normal(time.size)
    values = np.round(values / (0.02 * step)) * 0.02 * step if step else values
    expected = 0.02 * np.hypot(1.0, step / np.sqrt(12.0))
    record = fitact.Record.from_arrays(time, V=signal, Vsc=values, I=1e-6 * values)
    assert record.noise("Vsc") == pytest.approx(expected, rel=0.06)
    assert record.noise("I") == pytest.approx(1e-6 * expected, rel=0.06)
    assert estimate_noise(values) == pytest.approx(expected, rel=0.04)
