"""Properties that hold for all values.

The examples are drawn from a fixed seed, so a run in CI can be repeated. The tests look for errors that affect a whole
region of values; to look for rare failures, increase `max_examples`.
"""

import itertools

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import fitact

PERIOD = 0.01
TIME = (np.arange(64) + 0.5) * (PERIOD / 64)


def logarithmic(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(np.log(low), np.log(high)).map(lambda x: float(np.clip(np.exp(x), low, high)))


SKINS = st.tuples(logarithmic(1e3, 1e7), logarithmic(1e-10, 1e-6), logarithmic(1e-11, 1e-7))
EXTREMES = st.tuples(logarithmic(1.0, 1e12), logarithmic(1e-18, 1e-3), logarithmic(1e-18, 1e-6))


@pytest.fixture(autouse=True, scope="module")
def _double_precision():
    with jax.enable_x64(True):
        yield


@jax.jit
def sampled_response(values: jax.Array, samples: jax.Array) -> jax.Array:
    drive = fitact.Sampled(np.arange(16) * (PERIOD / 16), samples, period=PERIOD)
    return fitact.response(fitact.FinalCircuit(*values), drive, TIME)


@jax.jit
def trapezoid_response(values: jax.Array, time: jax.Array) -> jax.Array:
    drive = fitact.Trapezoid(360.0, 1.0 / PERIOD, rise_time=1e-3, duty=0.3, offset=40.0)
    return fitact.response(fitact.FinalCircuit(*values), drive, time)


@given(
    SKINS,
    st.lists(st.floats(-100.0, 100.0), min_size=32, max_size=32),
    st.floats(-3.0, 3.0),
    st.floats(-3.0, 3.0),
)
def test_response_is_linear_in_the_drive(
    values: tuple[float, float, float], samples: list[float], first: float, second: float
):
    one, two = np.array(samples[:16]), np.array(samples[16:])
    at = jnp.array(values)
    together = np.asarray(sampled_response(at, first * one + second * two))
    apart = first * np.asarray(sampled_response(at, one)) + second * np.asarray(sampled_response(at, two))
    scale = 0.5 * (abs(first) * np.abs(one).max() + abs(second) * np.abs(two).max())  # |Vsc| < |V| / 2
    np.testing.assert_allclose(together, apart, rtol=0.0, atol=1e-12 * scale)


@given(SKINS)
def test_steady_state_has_no_mean(values: tuple[float, float, float]):
    """No net charge passes the insulator. The integral uses Gauss points on each linear piece, denser at its start."""
    knots = np.array([0.0, 0.1, 0.3, 0.4, 1.0]) * PERIOD
    nodes, weights = np.polynomial.legendre.leggauss(12)
    mean, size = 0.0, 0.0
    for low, high in itertools.pairwise(knots):
        # cells that double in width from the start, where the response decays with time constant b
        edges = low + (high - low) * np.append(0.0, np.logspace(-30.0, 0.0, 31, base=2.0))
        half = 0.5 * np.diff(edges)[:, None]
        vsc = np.asarray(trapezoid_response(jnp.array(values), edges[:-1, None] + half * (1.0 + nodes)))
        mean += np.sum(half * weights * vsc)
        size = max(size, np.abs(vsc).max())
    assert abs(mean) / PERIOD < 1e-12 * size


@given(SKINS, logarithmic(1e-3, 1e3))
def test_vsc_cannot_see_the_contact_area_but_the_force_can(values: tuple[float, float, float], k: float):
    Rsc, Csc, Ci = values
    small = np.asarray(trapezoid_response(jnp.array(values), TIME))
    large = np.asarray(trapezoid_response(jnp.array([Rsc / k, k * Csc, k * Ci]), TIME))
    peak = np.abs(small).max()
    np.testing.assert_allclose(large, small, rtol=0.0, atol=1e-13 * peak)
    forces = [
        np.asarray(
            fitact.electrostatic_force(vsc, fitact.Contact.from_capacitances(s * Ci, s * Csc, 1e-4, 1e-6, 200e-6))
        )
        for vsc, s in ((small, 1.0), (large, k))
    ]
    np.testing.assert_allclose(forces[1], k * forces[0], rtol=0.0, atol=3e-13 * k * forces[0].max())


@settings(max_examples=300)
@given(EXTREMES, logarithmic(1e-6, 1e9))
def test_gain_is_at_most_the_divider(values: tuple[float, float, float], frequency: float):
    circuit = fitact.FinalCircuit(*values)
    omega = 2.0 * np.pi * frequency
    with mpmath.workdps(50):
        Rsc, Csc, Ci = map(mpmath.mpf, values)
        bound = Ci / (2 * Ci + Csc)
        limit = float(bound) * (1.0 + 4.0 * np.finfo(float).eps)
        x = mpmath.mpf(omega) * Rsc * (2 * Ci + Csc)
        expected = float(bound * x / mpmath.sqrt(1 + x**2)), float(mpmath.atan2(1, x))
    assert float(np.abs(np.asarray(circuit.transfer_function(omega)))) <= limit
    assert float(circuit.amplitude(omega)) <= limit
    assert float(circuit.amplitude(omega)) == pytest.approx(expected[0], rel=1e-14)
    assert float(circuit.phase(omega)) == pytest.approx(expected[1], rel=1e-14)


@given(st.floats(80e3, 200e3), st.floats(8.85e-9, 44.25e-9), st.floats(0.69e-9, 3.45e-9), logarithmic(10.0, 1000.0))
def test_natural_ground_is_weaker_at_the_values_of_the_paper(Rsc: float, Csc: float, Ci: float, frequency: float):
    omega = 2.0 * np.pi * frequency
    direct = fitact.FinalCircuit(Rsc, Csc, Ci).amplitude(omega)
    assert fitact.NaturalGround(Rsc, Csc, Ci, Z=14.5e6).amplitude(omega) < direct


def test_natural_ground_is_not_weaker_in_general():
    omega = 2.0 * np.pi * 10.0
    direct = fitact.FinalCircuit(20e6, 1e-9, 0.69e-9).amplitude(omega)
    assert fitact.NaturalGround(20e6, 1e-9, 0.69e-9, Z=14.5e6).amplitude(omega) > direct
