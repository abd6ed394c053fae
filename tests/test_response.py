import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import skin_voltage
from jax.test_util import check_grads

import fitact

VALUES = {"Rsc": 160e3, "Csc": 22e-9, "Ci": 1.35e-9}
CIRCUIT = fitact.FinalCircuit(**VALUES)
PERIOD = 0.01
STEP = 5e-6
TIME = np.arange(2000) * STEP

with jax.enable_x64(True):
    LINEAR_DRIVES = {
        "triangle": fitact.Triangle(peak_to_peak=360.0, frequency=100.0),
        "triangle with offset": fitact.Triangle(peak_to_peak=100.0, frequency=100.0, offset=30.0),
        "trapezoid": fitact.Trapezoid(peak_to_peak=360.0, frequency=100.0, rise_time=20e-6),
        "trapezoid, duty 0.3": fitact.Trapezoid(peak_to_peak=360.0, frequency=100.0, rise_time=1e-3, duty=0.3),
    }
    SQUARES = {
        "square": fitact.Square(peak_to_peak=360.0, frequency=100.0),
        "square, duty 0.2, offset": fitact.Square(peak_to_peak=360.0, frequency=100.0, duty=0.2, offset=50.0),
    }


@pytest.fixture(autouse=True)
def _double_precision():
    with jax.enable_x64(True):
        yield


def many_periods(drive: fitact.Square, count: int) -> tuple[np.ndarray, np.ndarray]:
    time = np.arange(count * TIME.size) * STEP
    return time, np.tile(np.asarray(drive.value(TIME)), count)


@pytest.mark.parametrize("name", [*LINEAR_DRIVES, *SQUARES])
def test_steady_state_against_scipy_after_many_periods(name: str):
    hold = name in SQUARES
    drive = SQUARES[name] if hold else LINEAR_DRIVES[name]
    time, voltage = many_periods(drive, 15)  # 15 periods are 38 time constants
    settled = skin_voltage(time, voltage, **VALUES, hold=hold)[-TIME.size :]
    np.testing.assert_allclose(fitact.response(CIRCUIT, drive, TIME), settled, atol=2e-10)


@pytest.mark.parametrize("name", [*LINEAR_DRIVES, *SQUARES])
def test_from_rest_against_scipy(name: str):
    hold = name in SQUARES
    drive = SQUARES[name] if hold else LINEAR_DRIVES[name]
    time, voltage = many_periods(drive, 3)
    expected = skin_voltage(time, voltage, **VALUES, hold=hold)
    ours = fitact.response(CIRCUIT, drive, time, steady_state=False)
    np.testing.assert_allclose(ours, expected, atol=2e-10)
    assert np.all(np.asarray(fitact.response(CIRCUIT, drive, np.array([-1.0, -1e-9]), steady_state=False)) == 0.0)


def test_sine_is_the_transfer_function():
    drive = fitact.Sine(peak_to_peak=360.0, frequency=100.0, offset=20.0)
    phasor = 180.0 * np.asarray(CIRCUIT.transfer_function(2.0 * np.pi * 100.0))
    np.testing.assert_allclose(
        fitact.response(CIRCUIT, drive, TIME), np.imag(phasor * np.exp(2j * np.pi * 100.0 * TIME)), atol=1e-12
    )


def test_sine_from_rest_against_scipy():
    drive = fitact.Sine(peak_to_peak=360.0, frequency=100.0)
    fine = np.arange(20001) * 1e-6  # scipy's straight lines err by (step)^2
    expected = skin_voltage(fine, np.asarray(drive.value(fine)), **VALUES)
    ours = fitact.response(CIRCUIT, drive, fine, steady_state=False)
    np.testing.assert_allclose(ours, expected, atol=1e-6)


@pytest.mark.parametrize("count", [2, 3, 50, 1000, 1001])
def test_sampled_drive_against_scipy(count: int):
    voltage = np.random.default_rng(1).normal(size=count)
    time = np.arange(count) * 1e-4
    drive = fitact.Sampled(time, voltage)
    expected = skin_voltage(time, voltage, **VALUES)
    np.testing.assert_allclose(fitact.response(CIRCUIT, drive, time, steady_state=False), expected, atol=1e-13)


def test_sampled_drive_on_uneven_times_is_the_same_line():
    """A broken line is the same drive however it is sampled; scipy computes it on an even grid."""
    rng = np.random.default_rng(2)
    kept = np.unique(np.concatenate([[0, 2000], rng.integers(0, 2001, 60)]))
    grid = np.arange(2001) * STEP
    knots = rng.normal(size=kept.size)
    line = np.interp(grid, grid[kept], knots)
    expected = skin_voltage(grid, line, **VALUES)
    ours = fitact.response(CIRCUIT, fitact.Sampled(grid[kept], knots), grid, steady_state=False)
    np.testing.assert_allclose(ours, expected, atol=1e-12)


def test_sampled_period_is_the_waveform_it_samples():
    trapezoid = LINEAR_DRIVES["trapezoid"]
    sampled = fitact.Sampled(TIME, np.asarray(trapezoid.value(TIME)), period=PERIOD)
    later = TIME + 3.0 * PERIOD + 1.7e-6
    np.testing.assert_allclose(
        fitact.response(CIRCUIT, sampled, later), fitact.response(CIRCUIT, trapezoid, later), atol=1e-9
    )


def test_sampled_without_period_has_no_steady_state():
    with pytest.raises(fitact.InputError, match="period"):
        fitact.response(CIRCUIT, fitact.Sampled(TIME, TIME), TIME)


def test_every_sample_lies_on_its_side_of_the_edge():
    """t f is rounded; of 1e6 samples a naive t mod T puts 1,250 on the wrong half-period."""
    index = np.arange(1_000_000)
    voltage = np.asarray(fitact.Square(peak_to_peak=2.0, frequency=100.0).value(index / 100e3))
    np.testing.assert_array_equal(voltage, np.where(index % 1000 < 500, 1.0, -1.0))


@pytest.mark.parametrize("x", [1e-12, 1e-6, 1e-3, 1.0, 1e3, 1e9])
def test_steady_square_far_from_the_period(x: float):
    """Closed form: just after an edge |Vsc| = 2 V0 g / (1 + e^{-T/2b}), T / b = x."""
    circuit = fitact.FinalCircuit(Rsc=PERIOD / x / 24.7e-9, Csc=22e-9, Ci=1.35e-9)
    drive = SQUARES["square"]
    expected = 360.0 * (1.35 / 24.7) / (1.0 + np.exp(-0.5 * x))
    assert float(fitact.response(circuit, drive, 0.0)) == pytest.approx(expected, rel=1e-13)


@pytest.mark.parametrize("name", ["sine", "square", "trapezoid", "triangle", "sampled"])
@pytest.mark.parametrize("steady_state", [True, False])
def test_differentiable_in_every_parameter(name: str, steady_state: bool):
    time = np.array([1.3e-3, 4.1e-3, 7.7e-3])
    samples = 100.0 * np.sin(2.0 * np.pi * 100.0 * TIME[::40])

    def vsc(logs: jax.Array, peak_to_peak: jax.Array, frequency: jax.Array) -> jax.Array:
        drive = {
            "sine": fitact.Sine(peak_to_peak, frequency),
            "square": fitact.Square(peak_to_peak, frequency, duty=0.4),
            "trapezoid": fitact.Trapezoid(peak_to_peak, frequency, rise_time=1e-4),
            "triangle": fitact.Triangle(peak_to_peak, frequency),
            "sampled": fitact.Sampled(TIME[::40], samples * peak_to_peak, 1.0 / frequency if steady_state else None),
        }[name]
        return fitact.response(fitact.FinalCircuit(*jnp.exp(logs)), drive, time, steady_state=steady_state)

    at = jnp.log(jnp.array([160e3, 22e-9, 1.35e-9])), jnp.array(1.0), jnp.array(100.0)
    check_grads(vsc, at, order=1, modes=("fwd", "rev"), rtol=1e-6)


def test_jit_and_vmap_change_nothing():
    logs = jnp.log(jnp.array([[160e3, 22e-9, 1.35e-9], [80e3, 9e-9, 3.45e-9]]))

    def vsc(logs: jax.Array) -> jax.Array:
        return fitact.response(fitact.FinalCircuit(*jnp.exp(logs)), LINEAR_DRIVES["trapezoid"], TIME)

    one_by_one = np.stack([vsc(row) for row in logs])
    np.testing.assert_allclose(jax.jit(jax.vmap(vsc))(logs), one_by_one, rtol=1e-13, atol=1e-13)
