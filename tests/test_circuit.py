import jax
import numpy as np
import pytest

import fitact


def divided(omega: np.ndarray, Rsc: float, Csc: float, Ci: float) -> np.ndarray:
    """Eqs. (18)-(19) as impedances."""
    skin = Rsc / (1.0 + 1j * omega * Rsc * Csc)
    return skin / (2.0 * skin + 1.0 / (1j * omega * Ci))


def test_transfer_function_is_the_voltage_divider_of_the_paper():
    omega = 2.0 * np.pi * np.logspace(0, 6, 61)
    for values in [(160e3, 22e-9, 1.35e-9), (4.3e3, 200e-9, 3.45e-9), (20e6, 1e-9, 0.69e-9)]:
        with jax.enable_x64(True):
            ours = np.asarray(fitact.FinalCircuit(*values).transfer_function(omega))
        np.testing.assert_allclose(ours, divided(omega, *values), rtol=1e-13)


@pytest.mark.parametrize("omega", [0.0, 1e-300, 1e300])
def test_transfer_function_and_gradient_are_finite_at_the_ends(omega: float):
    with jax.enable_x64(True):
        value, slope = jax.value_and_grad(
            lambda r: abs(fitact.FinalCircuit(r, 22e-9, 1.35e-9).transfer_function(omega) + 1e-3)
        )(160e3)
    assert np.isfinite(value)
    assert np.isfinite(slope)


def test_knee_of_the_paper():
    """40.3 Hz with the paper's 1.35 nF (it states 40 Hz)."""
    with jax.enable_x64(True):
        knee = 1.0 / (2.0 * np.pi * fitact.FinalCircuit(160e3, 22e-9, 1.35e-9).b)
    assert knee == pytest.approx(40.27, abs=0.01)
