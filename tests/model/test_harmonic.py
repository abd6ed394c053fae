import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from jax.test_util import check_grads

import fitact
from fitact.model.harmonic import fourier_coefficients

CIRCUIT = fitact.FinalCircuit(Rsc=160e3, Csc=22e-9, Ci=1.35e-9)
PERIOD = 0.01
TIME = (np.arange(200) + 0.37) * (PERIOD / 200)

with jax.enable_x64(True):
    KNOTS = np.array([2e-3, 3e-3, 4.5e-3, 9e-3, 11e-3])
    DRIVES = {
        "sine": fitact.Sine(360.0, 100.0, offset=20.0),
        "square": fitact.Square(360.0, 100.0),
        "square, duty 0.2": fitact.Square(360.0, 100.0, duty=0.2, offset=-7.0),
        "triangle": fitact.Triangle(360.0, 100.0, offset=5.0),
        "trapezoid": fitact.Trapezoid(360.0, 100.0, rise_time=1e-3, duty=0.3),
        "sampled": fitact.Sampled(KNOTS, np.array([1.0, -3.0, 50.0, 2.0, 7.0]), period=PERIOD),
    }
BREAKS = sorted({0.0, 1e-3, 2e-3, 2.5e-3, 3e-3, 4e-3, 4.5e-3, 5e-3, 7.5e-3, 9e-3, PERIOD})


@pytest.fixture(autouse=True)
def _double_precision():
    with jax.enable_x64(True):
        yield


@pytest.mark.parametrize("name", DRIVES)
def test_coefficients_against_quadrature(name: str):
    drive = DRIVES[name]
    start = float(drive.time[0]) if name == "sampled" else 0.0
    ours = np.asarray(fourier_coefficients(drive, 7))
    for k in range(1, 8):
        total = 0.0
        for low, high in itertools.pairwise(BREAKS):  # 16 Gauss points on each smooth piece
            total += scipy.integrate.fixed_quad(
                lambda t, k=k: np.asarray(drive.value(t)) * np.exp(-2j * np.pi * k * (t - start) / PERIOD),
                low,
                high,
                n=16,
            )[0]
        assert ours[k - 1] == pytest.approx(total / PERIOD, abs=1e-11)


def test_high_coefficients_keep_their_digits():
    """Coefficients against the textbook's sums, to 1e-11 of each (square) and 1e-14 of the largest (triangle)."""
    k = np.arange(1, 20002, 2)
    square, triangle = (np.asarray(fourier_coefficients(DRIVES[name], 20001))[::2] for name in ("square", "triangle"))
    np.testing.assert_allclose(square, -1j * 360.0 / (np.pi * k), rtol=1e-11)
    expected = -1j * 4.0 * 180.0 / (np.pi * k) ** 2 * np.where(k % 4 == 1, 1.0, -1.0)
    np.testing.assert_allclose(triangle, expected, rtol=0.0, atol=1e-14 * 73.0)
    assert np.abs(np.asarray(fourier_coefficients(DRIVES["square"], 20000))[1::2]).max() < 1e-13


@pytest.mark.parametrize(
    ("name", "ground"),
    [
        *((name, "direct") for name in DRIVES),
        # the drive and the circuit enter as factors, so not every pair must be tested
        *(pytest.param(n, "natural", marks=[] if n == "trapezoid" else pytest.mark.slow) for n in DRIVES),
    ],
)
def test_stated_error_is_the_error(name: str, ground: str):
    """The stated error equals the rms error against the exact response on a fine grid."""
    circuit = CIRCUIT if ground == "direct" else fitact.NaturalGround(160e3, 22e-9, 1.35e-9, Z=14.5e6)
    time = (np.arange(20000) + 0.5) * (PERIOD / 20000)
    exact = np.asarray(fitact.response(circuit, DRIVES[name], time))
    for harmonics in (1, 5, 30):
        sum_ = np.asarray(fitact.harmonic_response(circuit, DRIVES[name], time, harmonics))
        found = np.sqrt(np.mean((sum_ - exact) ** 2) / np.mean(exact**2))
        stated = float(fitact.harmonic_error(circuit, DRIVES[name], harmonics))
        # the mean over the grid is accurate to a few 1e-4 if the response jumps
        assert found == pytest.approx(stated, rel=2e-3, abs=1e-8)


def test_error_of_a_square_against_closed_form():
    """Mean square 4 V0^2 g^2 tanh(x/4) / x with x = T/b; the retained harmonics are summed separately."""
    g, b = CIRCUIT.g, CIRCUIT.b
    x, k = PERIOD / b, np.arange(1, 41, 2)
    total = 4.0 * 180.0**2 * g**2 * np.tanh(0.25 * x) / x
    kept = np.sum(
        2.0 * (2.0 * 180.0 / (np.pi * k)) ** 2 * (g * 2.0 * np.pi * k / x) ** 2 / (1.0 + (2.0 * np.pi * k / x) ** 2)
    )
    stated = float(fitact.harmonic_error(CIRCUIT, DRIVES["square"], 40))
    assert stated == pytest.approx(np.sqrt(1.0 - kept / total), rel=1e-6)


def test_sine_needs_one_harmonic():
    np.testing.assert_allclose(
        fitact.harmonic_response(CIRCUIT, DRIVES["sine"], TIME, 1),
        fitact.response(CIRCUIT, DRIVES["sine"], TIME),
        atol=1e-13,
    )
    assert float(fitact.harmonic_error(CIRCUIT, DRIVES["sine"], 1)) == 0.0


@pytest.mark.parametrize("name", ["triangle", "trapezoid", "sampled"])
def test_many_harmonics_are_the_exact_response(name: str):
    ours = fitact.harmonic_response(CIRCUIT, DRIVES[name], TIME + 3.0 * PERIOD, 4000)
    exact = np.asarray(fitact.response(CIRCUIT, DRIVES[name], TIME + 3.0 * PERIOD))
    np.testing.assert_allclose(ours, exact, rtol=0.0, atol=1e-5 * np.abs(exact).max())


def test_current_of_a_trapezoid():
    drive = DRIVES["trapezoid"]
    circuit = fitact.DirectGround(160e3, 22e-9, 1.35e-9, R_H=500.0)
    ours = fitact.harmonic_response(circuit, drive, TIME, 20000, channel="I")
    exact = np.asarray(fitact.response(circuit, drive, TIME, channel="I"))
    np.testing.assert_allclose(ours, exact, rtol=0.0, atol=2e-4 * np.abs(exact).max())


@pytest.mark.parametrize(
    "name",
    [
        "sine",
        "square",
        *(pytest.param(n, marks=pytest.mark.slow) for n in ("trapezoid", "triangle", "sampled")),
    ],
)
def test_differentiable_in_every_parameter(name: str):
    def vsc(logs: jax.Array, peak_to_peak: jax.Array, frequency: jax.Array) -> jax.Array:
        drive = {
            "sine": fitact.Sine(peak_to_peak, frequency),
            "square": fitact.Square(peak_to_peak, frequency, duty=0.4),
            "trapezoid": fitact.Trapezoid(peak_to_peak, frequency, rise_time=1e-4),
            "triangle": fitact.Triangle(peak_to_peak, frequency),
            "sampled": fitact.Sampled(KNOTS, peak_to_peak * jnp.array([1.0, -3.0, 5.0, 2.0, 7.0]), 1.0 / frequency),
        }[name]
        return fitact.harmonic_response(fitact.FinalCircuit(*jnp.exp(logs)), drive, TIME[:3], 5)

    at = jnp.log(jnp.array([160e3, 22e-9, 1.35e-9])), jnp.array(1.0), jnp.array(100.0)
    check_grads(jax.jit(vsc), at, order=1, modes=("fwd", "rev"), rtol=1e-6)


def test_memory_does_not_grow_with_the_harmonics():
    time = np.linspace(0.0, PERIOD, 10000)

    def needed(harmonics: int) -> int:
        def loss(Rsc: float) -> jax.Array:
            circuit = fitact.FinalCircuit(Rsc, 22e-9, 1.35e-9)
            return jnp.sum(fitact.harmonic_response(circuit, DRIVES["square"], time, harmonics) ** 2)

        return jax.jit(jax.grad(loss)).lower(160e3).compile().memory_analysis().temp_size_in_bytes

    assert needed(400) < 1.5 * needed(10)


def test_only_a_period_has_harmonics():
    with pytest.raises(fitact.InputError, match="period"):
        fitact.harmonic_response(CIRCUIT, fitact.Sampled(TIME, TIME), TIME, 3)
