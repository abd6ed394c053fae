import math

import jax
import numpy as np
import pytest
import scipy.signal

import fitact
from fitact.model.circuit import HighpassTerms
from fitact.model.response_table import ResponseTable

TIME = np.cumsum(np.r_[0.0, np.random.default_rng(0).uniform(2e-6, 8e-6, 1999)])  # the grid need not be uniform
UNIFORM = 5e-6 * np.arange(2000)
VOLTAGE = 180.0 * np.sign(np.sin(2.0 * np.pi * 230.0 * UNIFORM + 0.3)) + np.random.default_rng(1).standard_normal(2000)


@pytest.fixture(autouse=True)
def _double_precision():
    with jax.enable_x64(True):
        yield


def scipy_highpass(tau: float) -> np.ndarray:
    """Return the response of s tau / (1 + s tau) to `VOLTAGE`, which rises from 0 at the first sample."""
    voltage = VOLTAGE - VOLTAGE[0]
    system = scipy.signal.lti([tau, 0.0], [tau, 1.0])
    return scipy.signal.lsim(system, voltage, UNIFORM)[1] + VOLTAGE[0] * np.exp(-UNIFORM / tau)


@pytest.mark.parametrize("tau_range", [(2e-3, 2e-3), (2e-3, 2.69e-3), (3e-4, 2e-2), (1e-6, 1e-1)])
def test_any_time_constant_in_the_range_is_scipys(tau_range: tuple[float, float]):
    table = ResponseTable.from_drive(fitact.Sampled(UNIFORM, VOLTAGE), UNIFORM, 0.0, tau_range, False)
    assert table is not None
    for tau in np.geomspace(*tau_range, 7):
        np.testing.assert_allclose(table.response(HighpassTerms((1.0,), (tau,))), scipy_highpass(tau), atol=3e-9)
        np.testing.assert_allclose(table.decays((tau,), np.ones(1)), np.exp(-UNIFORM / tau), atol=1e-11)


@pytest.mark.parametrize("own_ranges", [False, True])
@pytest.mark.parametrize("steady_state", [False, True])
def test_terms_are_superposed_like_the_exact_response(steady_state: bool, own_ranges: bool):
    drive = fitact.Sampled(TIME, VOLTAGE, period=TIME[-1] + 5e-6 if steady_state else None)
    circuit = fitact.DirectGround(160e3, 22e-9, 1.35e-9, R_H=500.0, grounding_Rsc=80e3, Cgap=4e-9)
    taus = np.array(circuit.terms().tau)
    tau_range = np.stack([taus, 1.01 * taus]) if own_ranges else (float(min(taus)), float(max(taus)))
    table = ResponseTable.from_drive(drive, TIME, 0.0, tau_range, steady_state)
    assert table is not None
    for channel in ("Vsc", "Vgap"):  # a gap that does not conduct has a time constant far beyond the table
        exact = fitact.response(circuit, drive, TIME, steady_state=steady_state, channel=channel)
        size = np.max(np.abs(exact))
        np.testing.assert_allclose(table.response(circuit.channel_terms(channel)), exact, atol=1e-11 * size)
    decays = np.exp(-TIME / taus[:, None])
    np.testing.assert_allclose(table.decays(tuple(taus), np.ones(3)), decays.sum(axis=0), atol=1e-11)


def test_derivatives_in_the_time_constant_are_those_of_the_exact_response():
    drive, tau = fitact.Sampled(TIME, VOLTAGE), 3e-3
    table = ResponseTable.from_drive(drive, TIME, 0.0, (tau, tau), False)
    assert table is not None
    slope = jax.jacfwd(lambda log_tau: table.response(HighpassTerms((1.0,), (jax.numpy.exp(log_tau),))))(math.log(tau))
    step = 1e-3
    later, earlier = (
        np.asarray(
            fitact.response(fitact.FinalCircuit(tau * factor / 1e-9, 0.0, 0.5e-9), drive, TIME, steady_state=False)
        )
        for factor in (math.exp(step), math.exp(-step))
    )
    # the gain of this circuit is 1/2; a central difference is off by step^2 / 6 of the third derivative
    np.testing.assert_allclose(slope, (later - earlier) / step, atol=1e-5 * np.max(np.abs(slope)))


@pytest.mark.parametrize("tau_range", [(1e-9, 1e9), (math.nan, 1e-3)])
def test_a_range_without_a_table(tau_range: tuple[float, float]):
    assert ResponseTable.from_drive(fitact.Sampled(TIME, VOLTAGE), TIME, 0.0, tau_range, False) is None


def test_many_times_have_no_table():
    time = 1e-6 * np.arange(400_000)
    drive = fitact.Sampled(time, np.sin(time))
    assert ResponseTable.from_drive(drive, time, 0.0, (1e-3, 1e-3), False) is None
