"""Simulated records: noise of V, and the current of a stray capacitance."""

import re

import numpy as np
import pytest

import fitact
from fitact.data.simulate import simulate

BENCH = {"channels": ["Vsc", "I"], "noise_V": "0.5 V", "stray_capacitance": "100 pF"}
SINE = {"waveform": "sine", "peak_to_peak": "300 V", "frequency": "70 Hz"}


def scene(**measurement: object) -> fitact.Scene:
    return fitact.Scene.from_dict({"drive": SINE, "measurement": BENCH | measurement})


def test_only_V_has_the_noise_of_V():
    noisy, exact = simulate(scene(), seed=3), simulate(scene(noise_V=0.0), seed=3)
    ideal = 150.0 * np.sin(2.0 * np.pi * 70.0 * exact.time)
    np.testing.assert_allclose(exact["V"], ideal, atol=1e-9)
    noise = noisy["V"] - ideal
    assert np.std(noise) == pytest.approx(0.5, rel=0.05)
    for channel in ("Vsc", "I"):
        np.testing.assert_array_equal(noisy[channel], exact[channel])
        assert abs(np.corrcoef(noise, exact[channel] - simulate(scene(), seed=4)[channel])[0, 1]) < 0.06


def test_I_in_the_drive_lead_has_the_current_of_the_stray_capacitance():
    whole, loop = simulate(scene()), simulate(scene(current_lead="ground"))
    rate = 300.0 * np.pi * 70.0 * np.cos(2.0 * np.pi * 70.0 * whole.time)
    np.testing.assert_allclose(whole["I"] - loop["I"], 1e-10 * rate, atol=1e-6 * 1e-10 * np.ptp(rate))
    np.testing.assert_array_equal(whole["Vsc"], loop["Vsc"])
    np.testing.assert_array_equal(loop["I"], simulate(scene(stray_capacitance=0.0))["I"])


def test_ideal_jumps_charge_a_stray_capacitance_at_once():
    content = {"grounding": {"R_H": "500 ohm"}, "measurement": BENCH, "drive": {"waveform": "square"}}
    with pytest.raises(fitact.InputError, match=re.escape("(waveform = 'trapezoid')") + "$"):
        simulate(fitact.Scene.from_dict(content))
