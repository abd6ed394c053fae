"""The leak as an omission of a plan, and in the linear models of uncertainties, against the exact circuits."""

import jax
import numpy as np
import pytest

import fitact
from fitact.model.skin import circuit_parameters
from fitact.uncertainty.loop import LoopModel


def test_the_omission_of_a_leak():
    drive = {"waveform": "trapezoid", "rise_time": "1 ms", "offset": "60 V", "duty": 0.3}
    scene = fitact.Scene.from_dict({"device": {"Ri": "2 Mohm"}, "drive": drive})
    (omission,) = [each for each in fitact.plan(scene).omissions if each.name == "leak"]
    with jax.enable_x64(True):
        circuits = scene.make_circuit(), fitact.FinalCircuit(160e3, 22e-9, 1.35e-9)
        wave = scene.make_drive()
        square = [float(fitact.mean_square(each, wave)) for each in circuits]
        peak = [float(fitact.peak(each, wave)) for each in circuits]
    assert omission.kept
    assert omission.nominal.force_mean == pytest.approx(abs(square[1] / square[0] - 1.0), rel=1e-6)
    assert omission.nominal.Vsc_peak == pytest.approx(abs(peak[1] / peak[0] - 1.0), rel=1e-5)


@pytest.mark.parametrize("gap", [{}, {"Rgap": 2e6, "Cgap": 4e-10}, {"Cgap": 4e-10}], ids=["none", "gap", "open"])
def test_the_linear_model_of_the_loop(gap: dict[str, float]):
    circuit = fitact.DirectGround(160e3, 22e-9, 1.35e-9, R_H=2e4, Ri=3e6, **gap)
    omega = 2.0 * np.pi * np.logspace(-1, 5, 9)
    values = circuit_parameters(circuit)
    found = LoopModel(fitact.DirectGround).impedances(values, 1j * omega)
    with jax.enable_x64(True):
        for channel in ("Vsc", "I"):
            np.testing.assert_allclose(found.gain(channel), circuit.channel_gain(channel, omega), rtol=1e-12)
