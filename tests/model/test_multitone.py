"""Sums of sines against scipy (frequency response, piecewise-linear simulation) and brute-force extremes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.signal
from jax.test_util import check_grads

import fitact
from fitact.model.harmonic import fourier_coefficients
from tests.conftest import skin_voltage

F0, OFFSET = 100.0, 12.0
ORDERS, HEIGHTS, PHASES = (1, 3, 10), (60.0, 100.0, 30.0), (0.4, -2.0, 7.0)
R, C, CI = 160e3, 22e-9, 1.35e-9
PERIOD = 1.0 / F0
CONTACT = fitact.Contact(1e-4, 1e-6, 3.9, 200e-6, 2000.0)
TIME = np.linspace(0.0, 3.0 * PERIOD, 701)


@pytest.fixture(autouse=True)
def _double_precision():
    with jax.enable_x64(True):
        yield


def multitone(phase: float = 0.0) -> fitact.Multitone:
    return fitact.Multitone(F0, ORDERS, HEIGHTS, PHASES, OFFSET, phase)


def tones(time: np.ndarray, gain: np.ndarray | None = None, phase: float = 0.0) -> np.ndarray:
    """Return the sum of the tones in NumPy, each multiplied by its complex gain."""
    gain = np.ones(len(ORDERS)) if gain is None else gain
    return sum(
        np.imag(g * height * np.exp(1j * (2.0 * np.pi * n * F0 * time + n * phase + p)))
        for n, height, p, g in zip(ORDERS, HEIGHTS, PHASES, gain, strict=True)
    )


def scipy_gain() -> np.ndarray:
    omega = 2.0 * np.pi * F0 * np.array(ORDERS)
    return scipy.signal.freqs([R * CI, 0.0], [R * (2.0 * CI + C), 1.0], omega)[1]


@pytest.mark.parametrize("phase", [0.0, 1.3])
def test_value_and_slope(phase: float):
    drive = multitone(phase)
    np.testing.assert_allclose(drive.value(TIME), OFFSET + tones(TIME, phase=phase), atol=1e-10)
    rate = 2j * np.pi * F0 * np.array(ORDERS)
    np.testing.assert_allclose(drive.slope(TIME), tones(TIME, rate, phase), atol=1e-7)
    assert np.isnan(drive.slope(0.0, steady_state=False))  # the drive does not start from 0


@pytest.mark.parametrize("phase", [0.0, 1.3])
def test_steady_state_against_scipys_frequency_response(phase: float):
    ours = fitact.response(fitact.FinalCircuit(R, C, CI), multitone(phase), TIME)
    np.testing.assert_allclose(ours, tones(TIME, scipy_gain(), phase), atol=1e-11)


def test_from_rest_against_scipy():
    fine = np.arange(30001) * 1e-6
    ours = fitact.response(fitact.FinalCircuit(R, C, CI), multitone(), fine, steady_state=False)
    # piecewise-linear interpolation errs by step^2 / 8 times V'' = 30 V (2 pi 1 kHz)^2 + ..., times the divider 0.055
    np.testing.assert_allclose(ours, skin_voltage(fine, OFFSET + tones(fine), R, C, CI), atol=1e-5)


def test_fourier_coefficients_against_a_fast_transform():
    samples = OFFSET + tones(np.arange(64) * (PERIOD / 64))
    np.testing.assert_allclose(fourier_coefficients(multitone(), 20), np.fft.rfft(samples)[1:21] / 64, atol=1e-12)
    assert np.asarray(fourier_coefficients(multitone(), 2)).shape == (2,)  # tones above the second harmonic are ignored
    skin = fitact.WithSkin(fitact.FinalCircuit(R, C, CI), fitact.Fractional(1.0))  # exponent 1: constant R and C
    np.testing.assert_allclose(fitact.response(skin, multitone(), TIME), tones(TIME, scipy_gain()), atol=1e-9)


@pytest.mark.parametrize("channel", ["Vsc", "I"])
def test_mean_square_and_peak_by_brute_force(channel: str):
    circuit, drive = fitact.DirectGround(R, C, CI, R_H=5e5), multitone(0.7)
    omega = 2.0 * np.pi * F0 * np.array(ORDERS)
    skin = R / (1.0 + 1j * omega * R * C)
    current = 1.0 / (1.0 / (1j * omega * CI) + 2.0 * skin + 5e5)
    gain = current * skin if channel == "Vsc" else current
    time = np.arange(4096) * (PERIOD / 4096)
    wave = tones(time, gain, 0.7)
    assert float(fitact.mean_square(circuit, drive, channel)) == pytest.approx(np.mean(wave**2), rel=1e-12)
    at = time[np.argmax(np.abs(wave))]
    step = time[1]
    best = scipy.optimize.minimize_scalar(
        lambda t: -abs(tones(np.array([t]), gain, 0.7)[0]), bounds=(at - step, at + step), options={"xatol": 1e-12}
    )
    assert float(fitact.peak(circuit, drive, channel)) == pytest.approx(-best.fun, rel=1e-12)


@pytest.mark.slow
def test_peaks_are_the_largest_whatever_the_tones():
    rng = np.random.default_rng(0)
    time = np.arange(20000) * (PERIOD / 20000)
    for _ in range(6):
        orders = tuple(int(n) for n in rng.choice(np.arange(1, 40), size=4, replace=False))
        drive = fitact.Multitone(F0, orders, tuple(rng.uniform(1.0, 9.0, 4)), tuple(rng.uniform(0.0, 7.0, 4)))
        brute = np.max(np.abs(np.asarray(fitact.response(fitact.FinalCircuit(R, C, CI), drive, time))))
        peak = float(fitact.peak(fitact.FinalCircuit(R, C, CI), drive))
        assert brute <= peak * (1.0 + 1e-12)
        assert peak <= brute * (1.0 + 2e-5)  # (pi 39 / 20000)^2 / 2 is the decrease of a peak between two grid points


@pytest.mark.slow
def test_gradients():
    def force(logs: jax.Array) -> jax.Array:
        circuit = fitact.FinalCircuit(*jnp.exp(logs[:3]))
        drive = fitact.Multitone(F0, ORDERS, tuple(jnp.exp(logs[3:])), PHASES)
        vsc = fitact.response(circuit, drive, TIME[:5], steady_state=False)
        return jnp.append(
            vsc, 1e3 * jnp.stack([f(circuit, drive, CONTACT) for f in (fitact.mean_force, fitact.peak_force)])
        )

    check_grads(force, (jnp.log(jnp.array([R, C, CI, *HEIGHTS])),), order=1, modes=("fwd", "rev"), rtol=1e-5)


@pytest.mark.parametrize("orders", [(), (1, 1), (0,), (251,), (1.5,)])
def test_impossible_orders_are_refused(orders: tuple):
    with pytest.raises(fitact.InputError, match="orders"):
        fitact.Multitone(F0, orders, (1.0,) * len(orders))


def test_one_amplitude_and_phase_for_each_tone():
    for amplitudes, phases in [((1.0,), ()), ((1.0, 2.0), (0.1,))]:
        with pytest.raises(fitact.InputError, match="one amplitude"):
            fitact.Multitone(F0, (1, 2), amplitudes, phases)


@pytest.mark.slow
def test_a_record_of_tones_is_fitted():
    """Fit data from scipy's frequency response; the shipped scene holds the drive, with a clock error of 2e-4."""
    scene = fitact.Scene.load("multitone")
    time, noise = np.arange(8000) * 5e-6, 0.02
    omega = 2.0 * np.pi * 100.02 * np.array([1, 3, 5, 7, 10])
    phasors = 36.0 * np.exp(-1j * np.radians([0.0, 72.0, 216.0, 432.0, 720.0]))
    gain = scipy.signal.freqs([90e3 * CI, 0.0], [90e3 * (2.0 * CI + 30e-9), 1.0], omega)[1]
    waves = np.exp(1j * np.outer(omega, time))
    vsc = np.imag((phasors * gain) @ waves) + noise * np.random.default_rng(5).standard_normal(time.size)
    fit = fitact.fit(fitact.Record.from_arrays(time, V=np.imag(phasors @ waves), Vsc=vsc), scene)
    assert fit.trusted, fit
    assert fit.model()["drive"] == "multitone"
    for name, truth in {"g": CI / (2.0 * CI + 30e-9), "b": 90e3 * (2.0 * CI + 30e-9)}.items():
        found = fit.derived()[name]
        assert abs(found["q50"] - truth) < 4.0 * found["sd"]
        assert found["sd"] < 0.01 * truth
