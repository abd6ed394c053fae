"""Frequency-dependent skins against sums of a million harmonics with the impedances of the paper."""

import itertools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

import fitact
from tests.conftest import skin_voltage

R, C, CI = 160e3, 22e-9, 1.35e-9
RISE, PERIOD = 20e-6, 0.01
EPS = 1e-3  # step of finite differences: the weights of a fractional skin magnify rounding to 1e-10
TIME = np.array([1e-4, 0.3e-3, 1.1e-3, 4.9e-3, 5.01e-3, 8e-3])
OTHER = {"grounding_Rsc": 80e3, "grounding_Csc": 44.25e-9}
Impedance = Callable[[np.ndarray], np.ndarray]


@pytest.fixture(autouse=True)
def _double_precision():
    with jax.enable_x64(True):
        yield


def dispersive(omega: np.ndarray, scale_R: float = 1.0, scale_C: float = 1.0) -> np.ndarray:
    """Return the paper's values at 10, 100 and 1000 Hz, with power laws between them and constants outside."""
    log = np.log10(np.clip(omega / (2.0 * np.pi), 10.0, 1000.0))
    resistance = 10.0 ** np.interp(log, [1, 2, 3], np.log10([200e3, 160e3, 80e3]))
    capacitance = 10.0 ** np.interp(log, [1, 2, 3], np.log10([44.25e-9, 22e-9, 8.85e-9]))
    return 1.0 / (1.0 / (scale_R * resistance) + 1j * omega * scale_C * capacitance)


def fractional(alpha: float) -> Impedance:
    return lambda omega: R / (1.0 + (1j * omega * R * C) ** alpha)


def trapezoid_response(touching: Impedance, rest: Impedance, channel: str, time: np.ndarray) -> np.ndarray:
    """Sum the harmonics of a 360 Vpp trapezoid from textbook Fourier coefficients.

    The last half of the harmonics is tapered, so that the sum does not ring where the response is smooth.
    """
    k = np.arange(1, 2**19, 2)
    omega = 2.0 * np.pi * k / PERIOD
    drive = 720.0 * np.sinc(k * RISE / PERIOD) * np.exp(-1j * np.pi * k * RISE / PERIOD) / (1j * np.pi * k)
    current = drive / (1.0 / (1j * omega * CI) + touching(omega) + rest(omega))
    phasor = current * touching(omega) if channel == "Vsc" else current
    phasor = phasor * np.cos(0.5 * np.pi * np.clip(2.0 * k / k.max() - 1.0, 0.0, 1.0)) ** 2
    return np.array([np.sum((phasor * np.exp(2j * np.pi * np.mod(k * t / PERIOD, 1.0))).real) for t in time])


LEVELS = {
    "dispersive": (fitact.Dispersive(), dispersive),
    "fractional 0.8": (fitact.Fractional(0.8), fractional(0.8)),
    "fractional 0.5": (fitact.Fractional(0.5), fractional(0.5)),
}


def values(skin: fitact.Dispersive | fitact.Fractional, frequency: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    circuit = fitact.WithSkin(fitact.FinalCircuit(R, C, CI), skin).circuit_at_frequency(frequency)
    return np.asarray(circuit.Rsc), np.asarray(circuit.Csc)


def test_values_of_the_paper_are_met_and_held_beyond():
    resistance, capacitance = values(fitact.Dispersive(), np.array([0.0, 1e-300, 10.0, 100.0, 1000.0, 1e9]))
    np.testing.assert_allclose(resistance, [200e3, 200e3, 200e3, 160e3, 80e3, 80e3], rtol=1e-14)
    np.testing.assert_allclose(capacitance, [44.25e-9, 44.25e-9, 44.25e-9, 22e-9, 8.85e-9, 8.85e-9], rtol=1e-14)
    resistance, capacitance = values(fitact.Dispersive(), np.logspace(1, 3, 201))
    assert np.all(np.diff(resistance) < 0.0)
    assert np.all(np.diff(capacitance) < 0.0)
    np.testing.assert_allclose(resistance[[50, 150]], [np.sqrt(200e3 * 160e3), np.sqrt(160e3 * 80e3)], rtol=1e-14)


@pytest.mark.parametrize("alpha", [0.3, 0.8, 1.0])
def test_fractional_is_the_impedance_of_cole(alpha: float):
    frequency = np.logspace(-6, 9, 61)
    resistance, capacitance = values(fitact.Fractional(alpha), frequency)
    omega = 2.0 * np.pi * frequency
    np.testing.assert_allclose(
        1.0 / (1.0 / resistance + 1j * omega * capacitance), fractional(alpha)(omega), rtol=1e-12
    )


def test_alpha_of_one_is_the_constant_skin_exactly():
    resistance, capacitance = values(fitact.Fractional(1.0), np.logspace(-6, 9, 61))
    assert np.all(resistance == R)
    assert np.all(capacitance == C)


LOOPS = {
    "final": (fitact.FinalCircuit(R, C, CI), None),
    "direct, R_H": (fitact.DirectGround(R, C, CI, R_H=500.0), None),
    "direct, unequal skins": (fitact.DirectGround(R, C, CI, R_H=500.0, **OTHER), (0.5, 44.25 / 22.0)),
    "direct, only C unequal": (fitact.DirectGround(R, C, CI, grounding_Csc=44.25e-9), (1.0, 44.25 / 22.0)),
    "natural": (fitact.NaturalGround(R, C, CI, Z=14.5e6), None),
}


@pytest.mark.parametrize("name", LOOPS)
def test_both_skins_follow_the_level(name: str):
    circuit, scale = LOOPS[name]
    omega = 2.0 * np.pi * np.logspace(0, 4, 41).reshape(1, 41)
    touching = dispersive(omega)
    if name == "natural":
        rest = 14.5e6
    else:
        rest = dispersive(omega, *(scale or (1.0, 1.0))) + (500.0 if "R_H" in name or name.endswith("skins") else 0.0)
    current = 1.0 / (1.0 / (1j * omega * CI) + touching + rest)
    ours = fitact.WithSkin(circuit, fitact.Dispersive())
    np.testing.assert_allclose(ours.transfer_function(omega), touching * current, rtol=1e-11)
    np.testing.assert_allclose(ours.admittance(omega), current, rtol=1e-11)


@pytest.mark.parametrize("level", LEVELS)
def test_zero_frequency_is_the_limit(level: str):
    circuit = fitact.WithSkin(fitact.FinalCircuit(R, C, CI), LEVELS[level][0])
    assert circuit.transfer_function(0.0) == 0.0
    assert circuit.admittance(0.0) == 0.0

    def size(values: jax.Array) -> jax.Array:
        skinned = fitact.WithSkin(fitact.FinalCircuit(*values), LEVELS[level][0])
        return jnp.abs(skinned.transfer_function(0.0) + 1.0)

    assert np.all(np.isfinite(jax.grad(size)(jnp.array([R, C, CI]))))


# every circuit and channel with one skin, and every skin with one circuit and channel; other pairs are slow
GROUNDS = ["final", "direct, R_H", "natural"]
QUICK = {("fractional 0.8", ground, channel) for ground in GROUNDS for channel in ("Vsc", "I")}
QUICK |= {("dispersive", "direct, R_H", "I"), ("fractional 0.5", "final", "Vsc")}


@pytest.mark.parametrize(
    ("level", "ground", "channel"),
    [
        pytest.param(*case, marks=[] if case in QUICK else pytest.mark.slow)
        for case in itertools.product(LEVELS, GROUNDS, ["Vsc", "I"])
    ],
)
def test_steady_state_is_the_sum_of_its_harmonics(level: str, ground: str, channel: str):
    skin, impedance = LEVELS[level]
    rest = {
        "final": impedance,
        "direct, R_H": lambda w: impedance(w) + 500.0,
        "natural": lambda w: 14.5e6 + 0.0 * w,
    }[ground]
    drive = fitact.Trapezoid(360.0, 1.0 / PERIOD, RISE)
    ours = fitact.response(fitact.WithSkin(LOOPS[ground][0], skin), drive, TIME, channel=channel)
    expected = trapezoid_response(impedance, rest, channel, TIME)
    tolerance = (1e-7 if channel == "Vsc" else 3e-6) * np.abs(expected).max()
    np.testing.assert_allclose(ours, expected, rtol=0.0, atol=tolerance)


def test_constant_phase_of_one_against_scipy():
    """alpha = 1 is the constant skin; the difference is the error of the rational fit at high frequency."""
    time = np.arange(2000) * 5e-6
    voltage = np.where(np.arange(12 * 2000) % 2000 < 1000, 180.0, -180.0)
    settled = skin_voltage(np.arange(voltage.size) * 5e-6, voltage, R, C, CI, hold=True)[-2000:]
    circuit = fitact.WithSkin(fitact.FinalCircuit(R, C, CI), fitact.Fractional(1.0))
    ours = np.asarray(fitact.response(circuit, fitact.Square(360.0, 100.0), time))
    error = np.abs(ours - settled) / np.abs(settled).max()
    # at the jumps, the highest frequencies dominate; 4.3e-7 or 5.1e-7, as the libraries round in the rational fit
    assert error[[0, 1000]].max() < 6e-7
    assert np.delete(error, [0, 1000]).max() < 1e-7


@pytest.mark.parametrize("level", LEVELS)
def test_sine_is_the_transfer_function(level: str):
    skin, impedance = LEVELS[level]
    omega = np.array(2.0 * np.pi * 50.0)
    phasor = 180.0 * impedance(omega) / (2.0 * impedance(omega) + 1.0 / (1j * omega * CI))
    ours = fitact.response(fitact.WithSkin(fitact.FinalCircuit(R, C, CI), skin), fitact.Sine(360.0, 50.0, 30.0), TIME)
    np.testing.assert_allclose(ours, np.imag(phasor * np.exp(1j * omega * TIME)), atol=1e-12)


@pytest.mark.slow
def test_more_harmonics_change_no_more_than_the_stated_error():
    time = (np.arange(500) + 0.5) * 2e-5
    for circuit, channel, error in [
        (LOOPS["final"][0], "Vsc", 3e-8),
        (LOOPS["natural"][0], "Vsc", 3e-8),
        (LOOPS["direct, R_H"][0], "I", 1e-5),
    ]:
        few, many = (
            np.asarray(
                fitact.response(
                    fitact.WithSkin(circuit, fitact.Fractional(0.8, harmonics=n)),
                    fitact.Square(360.0, 100.0),
                    time,
                    channel=channel,
                )
            )
            for n in (128, 1024)
        )
        assert np.sqrt(np.mean((few - many) ** 2) / np.mean(many**2)) < error


@pytest.mark.parametrize(
    "skin", [fitact.Dispersive(), pytest.param(fitact.Fractional(0.8, harmonics=8), marks=pytest.mark.slow)]
)
@pytest.mark.slow
def test_differentiable_under_jit_and_vmap(skin: fitact.Dispersive | fitact.Fractional):

    @jax.jit
    def vsc(logs: jax.Array, peak_to_peak: jax.Array) -> jax.Array:
        circuit = fitact.WithSkin(fitact.DirectGround(*jnp.exp(logs), R_H=500.0), skin)
        return fitact.response(circuit, fitact.Square(peak_to_peak, 120.0), TIME[1:4])

    logs = jnp.log(jnp.array([R, C, CI]))
    check_grads(vsc, (logs, jnp.array(360.0)), order=1, modes=("rev",), rtol=1e-5, eps=EPS)
    rows = jnp.stack([logs, logs + 0.3])
    both = jax.jit(jax.vmap(lambda row: vsc(row, 360.0)))(rows)
    # the fitted weights of a fractional skin alternate in sign, which magnifies rounding to about 1e-10
    np.testing.assert_allclose(both, np.stack([vsc(row, 360.0) for row in rows]), rtol=1e-9)


@pytest.mark.slow
def test_exponent_is_differentiable_up_to_one():
    @jax.jit
    def vsc(alpha: jax.Array) -> jax.Array:
        circuit = fitact.WithSkin(fitact.FinalCircuit(R, C, CI), fitact.Fractional(alpha, harmonics=8))
        return fitact.response(circuit, fitact.Square(360.0, 100.0), TIME)

    check_grads(vsc, (jnp.array(0.8),), order=1, modes=("rev",), rtol=1e-5, eps=EPS)
    assert np.all(np.isfinite(jax.jacfwd(vsc)(jnp.array(1.0))))


@pytest.mark.parametrize(
    "level",
    [
        "dispersive",
        pytest.param("fractional 0.8", marks=pytest.mark.slow),
        pytest.param("fractional 0.5", marks=pytest.mark.slow),
    ],
)
def test_single_precision(level: str):
    def vsc() -> np.ndarray:
        circuit = fitact.WithSkin(fitact.FinalCircuit(R, C, CI), LEVELS[level][0])
        return np.asarray(fitact.response(circuit, fitact.Square(360.0, 100.0), TIME))

    double = vsc()
    with jax.enable_x64(False):
        single = vsc()
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, double, rtol=0.0, atol=5e-5 * np.abs(double).max())


def test_what_such_a_skin_cannot_do_is_said():
    circuit = fitact.WithSkin(fitact.FinalCircuit(R, C, CI), fitact.Dispersive())
    drive = fitact.Square(360.0, 100.0)
    with pytest.raises(fitact.InputError, match="no finite set of time constants"):
        circuit.terms()
    with pytest.raises(fitact.InputError, match="steady_state=True"):
        fitact.response(circuit, drive, TIME, steady_state=False)
    with pytest.raises(fitact.InputError, match="period"):
        fitact.response(circuit, fitact.Sampled(TIME, TIME), TIME)
    with pytest.raises(fitact.InputError, match="harmonics"):
        jax.grad(lambda f: fitact.response(circuit, fitact.Square(360.0, f), TIME)[0])(100.0)
    stated = fitact.WithSkin(circuit.circuit, fitact.Dispersive(harmonics=12))
    traced = jax.jit(lambda f: fitact.response(stated, fitact.Square(360.0, f), TIME))(100.0)
    np.testing.assert_allclose(traced, fitact.response(circuit, drive, TIME), rtol=1e-12)


def test_current_of_an_ideal_jump_has_no_value_there():
    for skin in (fitact.Dispersive(), fitact.Fractional(0.8)):
        circuit = fitact.WithSkin(fitact.FinalCircuit(R, C, CI), skin)
        current = fitact.response(circuit, fitact.Square(360.0, 100.0), np.array([0.0, 1e-3]), channel="I")
        assert np.array_equal(np.isnan(np.asarray(current)), [True, False])
