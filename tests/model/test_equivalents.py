import functools

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from jax.test_util import check_grads

import fitact
from fitact.model.force import plate_capacitance, plate_resistance

R, C, F = 160e3, 22e-9, 100.0
EXTREMES = [
    (10.0**r, 10.0**c, 10.0**f)
    for r in (0.0, 3.0, 5.2, 8.0, 12.0)
    for c in (-18.0, -12.0, -7.7, -3.0)
    for f in (-6.0, 2.0, 9.0)
]


@pytest.fixture(autouse=True)
def _double_precision():
    with jax.enable_x64(True):
        yield


def test_figures_of_the_paper():
    """Rx, Cx and Cx' agree to the printed digits; Q = 2.2112, 2.1911 (from rounded Rx', Cx') for 2.2117, 2.1915."""
    Rx, Cx = fitact.series_equivalent(R, C, F)
    assert float(Rx) == pytest.approx(27.16e3, abs=5.0)
    assert float(Cx) == pytest.approx(26.5e-9, abs=0.05e-9)
    assert float(2.0 * Rx) == pytest.approx(54.32e3, abs=5.0)
    assert float(0.5 * Cx) == pytest.approx(13.25e-9, abs=0.005e-9)
    with_R_H, without = fitact.quality_factor(R, C, F, R_H=500.0), fitact.quality_factor(R, C, F)
    assert (float(with_R_H), float(without)) == pytest.approx((2.19151, 2.21168), abs=5e-6)
    rounded = [1.0 / (2.0 * np.pi * F * 13.25e-9 * (54320.0 + R_H)) for R_H in (500.0, 0.0)]
    assert rounded == pytest.approx([2.1911, 2.2112], abs=1e-4)
    assert float(1.0 - with_R_H / without) == pytest.approx(0.00912, abs=5e-6)  # the paper states 0.909 %


# each function is compiled once, not once for every operation at every point
EQUIVALENT = jax.jit(fitact.series_equivalent)
QUALITY = jax.jit(functools.partial(fitact.quality_factor, R_H=500.0))
SLOPES = [
    jax.jit(jax.jacrev(lambda logs: jnp.log(jnp.stack(fitact.series_equivalent(*jnp.exp(logs)))))),
    jax.jit(jax.jacrev(lambda logs: jnp.log(fitact.quality_factor(*jnp.exp(logs), R_H=500.0)))),
]


@pytest.mark.parametrize("values", EXTREMES)
def test_series_equivalent_at_the_extremes(values: tuple[float, float, float]):
    resistance, capacitance, frequency = map(mpmath.mpf, values)
    omega = 2 * mpmath.pi * frequency
    impedance = resistance / (1 + 1j * omega * resistance * capacitance)
    Rx, Cx = EQUIVALENT(*values)
    assert float(Rx) == pytest.approx(float(impedance.real), rel=1e-14)
    assert float(Cx) == pytest.approx(float(-1 / (omega * impedance.imag)), rel=1e-14)
    total = 2 * impedance + 500
    ours = QUALITY(*values)
    assert float(ours) == pytest.approx(float(-total.imag / total.real), rel=1e-14)
    for slopes in SLOPES:
        assert np.all(np.isfinite(slopes(jnp.log(jnp.array(values)))))


def test_series_equivalent_is_differentiable():
    def both(logs: jax.Array) -> jax.Array:
        return jnp.log(jnp.stack(fitact.series_equivalent(*jnp.exp(logs))))

    check_grads(both, (jnp.log(jnp.array([R, C, F])),), order=1, modes=("fwd", "rev"), rtol=1e-6)
    check_grads(both, (jnp.log(jnp.array([R, C, 10.0])),), order=1, modes=("fwd", "rev"), rtol=1e-6)


def test_resistance_and_capacitance_of_the_paper_from_the_material():
    """Section 3.1: 4e4 to 1e5 ohm m and 2e3 to 1e4 over 200 um and 1 cm^2 are 80 to 200 kohm and 8.85 to 44.25 nF."""
    assert float(plate_resistance(4e4, 1e-4, 200e-6)) == pytest.approx(80e3, rel=1e-14)
    assert float(plate_resistance(1e5, 1e-4, 200e-6)) == pytest.approx(200e3, rel=1e-14)
    assert float(plate_capacitance(2e3, 1e-4, 200e-6)) == pytest.approx(8.85e-9, rel=1e-14)
    assert float(plate_capacitance(1e4, 1e-4, 200e-6)) == pytest.approx(44.25e-9, rel=1e-14)
