"""The force's harmonics over their thresholds: against closed forms, and numpy.fft of a simulation by scipy."""

import math

import jax
import numpy as np
import pytest
import scipy.signal

import fitact
from fitact.model.steady_cycle import Sensation, sensation
from fitact.scene.threshold_table import ThresholdTable

R, C, CI, F = 160e3, 22e-9, 1.35e-9, 10.0
TIME_CONSTANT, GAIN = R * (2.0 * CI + C), CI / (2.0 * CI + C)
AREA, TI, TSC, HEIGHT = 1e-4, 1e-6, 200e-6, 360.0
CONSTANT = 1.0 / (2.0 * (1.0 / CI + 1.0 / C) * (TI + TSC))  # eq. (22) over Vsc^2, permittivities by eq. (3)
TABLE = ThresholdTable(frequencies=(10.0, 40.0, 250.0), forces=(2e-2, 1e-2, 1e-3))


def evaluate(drive: fitact.Square | fitact.Sine) -> Sensation:
    with jax.enable_x64(True):
        contact = fitact.Contact.from_capacitances(CI, C, AREA, TI, TSC)
        sensitivity = TABLE.harmonic_sensitivity(float(drive.frequency), 1.0)
        found = jax.jit(sensation)(fitact.FinalCircuit(R, C, CI), drive, contact, sensitivity)
        return Sensation(*(x.item() for x in found))


def test_a_sine_is_felt_at_twice_its_frequency():
    """Vsc = |H| V; the square of a sine of amplitude A has the amplitude A^2 / 2 at 2 f, far above the corner, too."""
    frequency, threshold = 100.0, np.exp(np.interp(np.log(200.0), np.log([40.0, 250.0]), np.log([1e-2, 1e-3])))
    omega = 2.0 * np.pi * frequency * TIME_CONSTANT
    amplitude = 0.5 * CONSTANT * (0.5 * HEIGHT * GAIN * omega) ** 2 / (1.0 + omega**2)
    found = evaluate(fitact.Sine(HEIGHT, frequency))
    assert found.times_threshold == pytest.approx(amplitude / threshold, rel=1e-12)
    assert found.strongest == 2
    assert found.outside == pytest.approx(0.0, abs=1e-12)


def test_a_square_s_harmonics_are_those_of_its_decay():
    """|Vsc| falls as exp(-t / b) in each half period, from 2 V0 g / (1 + exp(-T / 2 b))."""
    half, order = 0.5 / F, np.arange(1, 13)  # of 2 f, up to 240 Hz
    start = HEIGHT * GAIN / (1.0 + math.exp(-half / TIME_CONSTANT))
    rate = np.abs(2.0 / TIME_CONSTANT + 2j * np.pi * order / half)
    amplitude = CONSTANT * start**2 * 2.0 / half * (1.0 - math.exp(-2.0 * half / TIME_CONSTANT)) / rate
    ratio = amplitude * TABLE.sensitivity(order / half)
    found = evaluate(fitact.Square(HEIGHT, F))
    assert found.times_threshold == pytest.approx(math.hypot(*ratio), rel=1e-10)
    assert found.strongest == 2 * order[np.argmax(ratio)]


def test_a_trapezoid_is_numpys_fft_of_scipys_simulation():
    rise, points = 2e-3, 40_000
    time = np.arange(20 * points + 1) / points / F
    cycle = (time * F) % 1.0
    voltage = HEIGHT * np.interp(cycle, [0.0, rise * F, 0.5, 0.5 + rise * F, 1.0], [-0.5, 0.5, 0.5, -0.5, -0.5])
    system = scipy.signal.lti([GAIN * TIME_CONSTANT, 0.0], [TIME_CONSTANT, 1.0])
    force = CONSTANT * scipy.signal.lsim(system, voltage, time)[1][-points - 1 : -1] ** 2
    amplitude = 2.0 * np.abs(np.fft.rfft(force)) / points
    ratio = amplitude[1:26] * TABLE.sensitivity(F * np.arange(1.0, 26.0))
    found = evaluate(fitact.Trapezoid(HEIGHT, F, rise, phase=0.3))
    assert found.times_threshold == pytest.approx(math.hypot(*ratio), rel=1e-5)
    assert found.strongest == 1 + np.argmax(ratio)
    assert found.outside == pytest.approx(1.0 - np.sum(amplitude[1:26] ** 2) / np.sum(amplitude[1:] ** 2), rel=1e-4)


def test_a_force_outside_the_table_is_not_judged():
    found = evaluate(fitact.Sine(HEIGHT, 126.0))  # 252 Hz
    assert (found.times_threshold, found.strongest) == (0.0, 0)
    assert found.outside == 1.0
    on_the_end = evaluate(fitact.Sine(HEIGHT, 125.0))
    assert on_the_end.strongest == 2


def test_a_sum_of_tones_has_the_tones_of_their_differences():
    """Sines of 100 and 150 Hz: 50 Hz from their difference, 200 and 250 Hz inside, 300 Hz outside."""
    omega = 2.0 * np.pi * np.array([100.0, 150.0]) * 1j * TIME_CONSTANT
    first, second = GAIN * omega / (1.0 + omega) * np.array([60.0, 40.0])
    amplitude = CONSTANT * np.array([abs(first * second), 0.5 * abs(first) ** 2, abs(first * second)])
    ratio = amplitude * TABLE.sensitivity(np.array([50.0, 200.0, 250.0]))
    found = evaluate(fitact.Multitone(50.0, (2, 3), (60.0, 40.0), (0.3, 1.0)))
    assert found.times_threshold == pytest.approx(math.hypot(*ratio), rel=1e-12)
    outside = (0.5 * CONSTANT * abs(second) ** 2) ** 2
    assert found.outside == pytest.approx(outside / (outside + np.sum(amplitude**2)), rel=1e-12)
