"""Mean currents beside the corners of a trapezoid, against the charges of the exact circuit."""

import math

import numpy as np
import pytest

from fitact.likelihood.charge_rows import LAG
from fitact.problem.jumps import Jumps

STEP, CAPACITANCE, RATE, RISE, PERIOD = 1e-5, 1e-9, 2e-6, 5.3, 101.7  # the last two in steps


def drive(time: np.ndarray) -> np.ndarray:
    """Return a trapezoid of 100 V in amplitude at times in steps."""
    turn = np.mod(time, PERIOD)
    return 200.0 * (np.clip(turn / RISE, 0.0, 1.0) - np.clip((turn - 0.5 * PERIOD) / RISE, 0.0, 1.0)) - 100.0


def slope(time: np.ndarray) -> np.ndarray:
    turn = np.mod(time, PERIOD)
    rising, falling = turn < RISE, (turn >= 0.5 * PERIOD) & (turn < 0.5 * PERIOD + RISE)
    return 200.0 / (RISE * STEP) * (rising.astype(float) - falling)


def bench(delay: float, noise_V: float, noise: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return V, I = C dV/dt + G V as a bench records it, and its exact mean over each step."""
    rng, time = np.random.default_rng(3), np.arange(4_000.0)
    current = CAPACITANCE * slope(time - delay) + RATE * drive(time - delay)
    fine = drive(np.arange(4_000 * 64 + 1) / 64.0)
    means = np.convolve(fine, np.append(np.append(0.5, np.ones(63)), 0.5) / 64.0, "valid")[::64]
    exact = CAPACITANCE * np.diff(drive(np.arange(4_001.0))) / STEP + RATE * means
    V, I = drive(time), current  # noqa: E741
    return V + noise_V * rng.standard_normal(4_000), I + noise * rng.standard_normal(4_000), exact


@pytest.mark.parametrize("delay", [0.0, 0.37, -0.4, 1.5])
def test_steps_beside_a_corner_have_exact_means(delay: float):
    V, current, exact = bench(delay, 0.02, 2e-8)
    jumps = Jumps.from_samples(V, current, (0.02, 2e-8))
    assert jumps.last.size == pytest.approx(4 * 4_000 / PERIOD, abs=6)
    means, variance = jumps.step_means(current, delay, 2e-8)
    rows = np.arange(60, 3_900)
    rows = rows[(rows > jumps.corner[0]) & (rows < jumps.corner[-1])]
    own = np.isin(rows, jumps.corner)
    error, stated = means[rows + LAG] - exact[rows], np.sqrt(variance[rows + LAG] + (2e-8) ** 2)
    assert np.max(np.abs(error[~own] / stated[~own])) < 5.0
    assert np.max(stated[~own]) < 0.05 * np.max(jumps.height)
    # of the step that holds the corner, the part after it is known to a step
    assert np.sqrt(np.mean(np.square(error[own] / stated[own]))) == pytest.approx(1.0, abs=0.25)
    assert abs(np.mean(error[own] * np.sign(np.diff(current)[jumps.last[np.isin(jumps.corner, rows)]]))) < 0.1 * np.max(
        jumps.height
    )


def test_the_row_of_a_corner_changes_with_the_delay_as_the_model_says():
    V, current, _ = bench(0.37, 0.02, 2e-8)
    jumps = Jumps.from_samples(V, current, (0.02, 2e-8))
    earlier, later = (jumps.step_means(current, delay, 2e-8)[0] for delay in (0.32, 0.42))
    modelled = jumps.differentiate(later)[jumps.corner + LAG]
    np.testing.assert_allclose((later - earlier)[jumps.corner + LAG] / 0.1, modelled, rtol=0.03)


def test_noise_of_V_that_hides_the_corner_leaves_three_steps_uncertain():
    V, current, _ = bench(0.0, 30.0, 2e-8)
    jumps = Jumps.from_samples(V, current, (30.0, 2e-8))
    variance = jumps.step_means(current, 0.0, 2e-8)[1]
    for k in (-1, 0, 1):
        np.testing.assert_allclose(np.sqrt(variance[jumps.corner + k + LAG]), jumps.height / math.sqrt(12.0), rtol=1e-6)


def test_a_smooth_current_has_no_jumps():
    time = np.arange(5_000.0)
    V, current = 100.0 * np.sin(time / 30.0), 1e-4 * np.cos(time / 30.0)
    assert Jumps.from_samples(V, current, (0.0, 1e-12)).last.size == 0
