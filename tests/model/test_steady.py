"""Means and peaks over a period against harmonic sums of impedances (NumPy), which do not use time constants."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

import fitact
from fitact.model.drive import Drive
from fitact.model.force import force_constant
from fitact.model.response import half_langevin, log_phi_derivative, phi, psi
from fitact.model.steady import _rectangle


@pytest.fixture(autouse=True)
def double_precision():
    with jax.enable_x64(True):
        yield


V, F = 360.0, 100.0
R, C, CI = 160e3, 22e-9, 1.35e-9
CONTACT = fitact.Contact(1e-4, 1e-6, 3.9, 200e-6, 2000.0)
SAMPLES = np.random.default_rng(3).normal(size=7)

Impedance = Callable[[np.ndarray], np.ndarray]


def element(resistance: float, capacitance: float) -> Impedance:
    return lambda w: resistance / (1.0 + 1j * w * resistance * capacitance)


# circuit, impedance of the sliding finger's skin, impedance of the rest in series with Ci
CIRCUITS = {
    "final": (fitact.FinalCircuit(R, C, CI), element(R, C), element(R, C)),
    "unequal skins": (
        fitact.DirectGround(R, C, CI, grounding_Rsc=20e3, grounding_Csc=1e-9),
        element(R, C),
        element(20e3, 1e-9),
    ),
    "R_H": (
        fitact.DirectGround(R, C, CI, R_H=5e5, grounding_Rsc=8e6, grounding_Csc=44e-9),
        element(R, C),
        lambda w: element(8e6, 44e-9)(w) + 5e5,
    ),
    "natural": (
        fitact.NaturalGround(R, C, CI, Z=14.5e6, Z_capacitance=1e-10),
        element(R, C),
        element(14.5e6, 1e-10),
    ),
}
DRIVES: dict[str, Drive] = {
    "sine": fitact.Sine(V, F, offset=10.0),
    "square": fitact.Square(V, F, duty=0.2, offset=-7.0),
    "triangle": fitact.Triangle(V, F),
    "trapezoid": fitact.Trapezoid(V, F, rise_time=1e-3, duty=0.3),
    "steep trapezoid": fitact.Trapezoid(V, F, rise_time=1e-5),
}
with jax.enable_x64(True):
    DRIVES["sampled"] = fitact.Sampled(np.array([0.0, 1.0, 1.5, 4.0, 4.2, 7.0, 9.0]) * 1e-3, SAMPLES, period=1.0 / F)
COUNT = 1 << 17
OMEGA = 2.0 * np.pi * F * np.arange(1, COUNT)


def coefficients(drive: Drive, omega: np.ndarray) -> np.ndarray:
    """Return c_n of V = sum c_n e^{j n w t}, n = 1, 2, ..., from the kinks and jumps of the linear pieces."""
    if isinstance(drive, fitact.Sine):
        return np.where(omega < 1.5 * omega[0], 0.25 * V / 1j, 0.0)
    knots, start, end = (np.asarray(x) for x in drive.pieces())
    slope = (end - start) / np.diff(knots)
    total = np.zeros(omega.size, dtype=complex)
    for time, jump, kink in zip(knots[:-1], start - np.roll(end, 1), slope - np.roll(slope, 1), strict=True):
        total += F * np.exp(-1j * omega * time) * (jump / (1j * omega) - kink / omega**2)
    return total


def limits(drive: Drive) -> tuple[float, float]:
    """Return the variance of V and the mean square of dV/dt in closed form."""
    if isinstance(drive, fitact.Sine):
        return V**2 / 8.0, 0.5 * (np.pi * F * V) ** 2
    knots, start, end = (np.asarray(x) for x in drive.pieces())
    length = np.diff(knots) * F
    mean = np.sum(length * 0.5 * (start + end))
    square = np.sum(length * (start * start + start * end + end * end) / 3.0)
    return square - mean**2, np.sum(length * ((end - start) / np.diff(knots)) ** 2)


@pytest.mark.parametrize("drive", DRIVES)
@pytest.mark.parametrize("circuit", CIRCUITS)
def test_mean_squares_are_harmonic_sums(circuit: str, drive: str):
    model, touching, rest = CIRCUITS[circuit]
    power = 2.0 * np.abs(coefficients(DRIVES[drive], OMEGA)) ** 2
    current = 1.0 / (1.0 / (1j * OMEGA * CI) + touching(OMEGA) + rest(OMEGA))
    variance, slope = limits(DRIVES[drive])
    # the limit of the gain is summed in closed form; the remaining terms decrease as n^-4
    last = 1e3 * OMEGA[-1]
    last_current = 1.0 / (1.0 / (1j * last * CI) + touching(last) + rest(last))
    gain, capacitance = abs(touching(last) * last_current), last_current.imag / last
    vsc = gain**2 * variance + np.sum(power * (np.abs(touching(OMEGA) * current) ** 2 - gain**2))
    assert float(fitact.mean_square(model, DRIVES[drive])) == pytest.approx(vsc, rel=1e-10)
    rms = float(fitact.body_current(model, DRIVES[drive]).rms)
    if circuit == "R_H":
        conductance = abs(last_current) ** 2
        expected = conductance * variance + np.sum(power * (np.abs(current) ** 2 - conductance))
    else:
        expected = capacitance**2 * slope + np.sum(power * (np.abs(current) ** 2 - (capacitance * OMEGA) ** 2))
    if drive == "square" and circuit != "R_H":
        assert rms == np.inf
    else:
        assert rms == pytest.approx(np.sqrt(expected), rel=1e-8)


@pytest.mark.parametrize("drive", ["sine", "triangle", "trapezoid", "sampled"])
@pytest.mark.parametrize("circuit", CIRCUITS)
def test_peaks_are_those_of_the_harmonic_sum(circuit: str, drive: str):
    """Knots lie on the grid; an extreme between grid points is missed by (step)^2.

    The limit of the gain multiplies the drive itself, so the remaining harmonics decrease as n^-3.
    """
    model, touching, rest = CIRCUITS[circuit]
    omega = np.append(OMEGA, 1e3 * OMEGA[-1])
    gain = touching(omega) / (1.0 / (1j * omega * CI) + touching(omega) + rest(omega))
    last = gain[-1].real
    spectrum = np.append(0.0, coefficients(DRIVES[drive], OMEGA) * (gain[:-1] - last))
    grid = 400_000
    voltage = np.asarray(DRIVES[drive].value(np.arange(grid) / (grid * F)))
    expected = np.max(np.abs(np.fft.irfft(spectrum, grid) * grid + last * (voltage - voltage.mean())))
    ours = float(fitact.peak(model, DRIVES[drive]))
    force = float(fitact.peak_force(model, DRIVES[drive], CONTACT))
    constant = float(force_constant(CONTACT))
    assert ours == pytest.approx(expected, rel=2e-8)
    assert force == pytest.approx(constant * ours**2, rel=1e-14)


def test_peak_of_a_square_is_just_after_its_edge():
    """Closed form: 2 V0 g / (1 + e^{-T/2b})."""
    circuit = fitact.FinalCircuit(R, C, CI)
    expected = V * (1.35 / 24.7) / (1.0 + np.exp(-0.5 / F / (R * 24.7e-9)))
    assert float(fitact.peak(circuit, fitact.Square(V, F, offset=5.0))) == pytest.approx(expected, rel=1e-14)


def test_peak_between_the_knots_far_closer_to_one_than_to_the_other():
    """Time constants from 1 ns to 1 s after a jump; the extreme is a zero of a sum of exponentials (Newton)."""
    circuit = fitact.DirectGround(1e3, 1e-12, 1e-9, R_H=10.0, grounding_Rsc=1e9, grounding_Csc=1e-9)
    drive = fitact.Square(2.0, 1.0)
    ours = float(fitact.peak(circuit, drive))
    time = np.geomspace(1e-14, 0.4, 400_001)
    fine = float(np.abs(fitact.response(circuit, drive, time)).max())
    assert ours == pytest.approx(fine, rel=1e-8)
    assert ours >= fine * (1.0 - 1e-12)


def test_current_peak_of_the_final_circuit_includes_the_edge():
    """I = Vsc / Rsc + Csc dVsc/dt at the end of the rise, where Vsc is largest."""
    drive = DRIVES["steep trapezoid"]
    b, g = R * (2.0 * CI + C), CI / (2.0 * CI + C)
    rise, half = 1e-5, 0.5 / F
    # the waveform is antisymmetric: u at the start of a rise is minus u at the start of the fall
    ramp = V * b / rise * -np.expm1(-rise / b)
    u0 = -ramp * np.exp(-(half - rise) / b) / (1.0 + np.exp(-half / b))
    before, after = u0, u0 * np.exp(-rise / b) + ramp
    currents = [g * u / R + C * g * (V / rise - u / b) for u in (before, after)]
    ours = fitact.body_current(fitact.FinalCircuit(R, C, CI), drive)
    assert float(ours.peak) == pytest.approx(max(currents), rel=1e-12)
    assert np.isfinite(float(ours.rms))


def test_no_capacitance_no_impulse():
    ours = fitact.body_current(fitact.FinalCircuit(R, 0.0, CI), DRIVES["square"])
    vsc = fitact.peak(fitact.FinalCircuit(R, 0.0, CI), DRIVES["square"])
    assert float(ours.peak) == pytest.approx(float(vsc) / R, rel=1e-14)


def test_what_does_not_repeat_is_refused():
    drive = fitact.Sampled(np.arange(4.0), np.arange(4.0))
    for function in (fitact.mean_square, fitact.peak, fitact.body_current):
        with pytest.raises(fitact.InputError, match="period"):
            function(fitact.FinalCircuit(R, C, CI), drive)


@pytest.mark.parametrize(
    "name", ["sine", "square", "triangle", pytest.param("trapezoid", marks=pytest.mark.slow), "sampled"]
)
@pytest.mark.slow
def test_differentiable_in_every_parameter(name: str):
    def force(logs: jax.Array, peak_to_peak: jax.Array, frequency: jax.Array, shape: jax.Array) -> jax.Array:
        drive = {
            "sine": fitact.Sine(peak_to_peak, frequency),
            "square": fitact.Square(peak_to_peak, frequency, duty=shape),
            "triangle": fitact.Triangle(peak_to_peak, frequency),
            "trapezoid": fitact.Trapezoid(peak_to_peak, frequency, rise_time=0.01 * shape / frequency, duty=shape),
            "sampled": fitact.Sampled(np.arange(7) * 1e-3, SAMPLES * peak_to_peak, period=1.0 / frequency),
        }[name]
        circuit = fitact.FinalCircuit(*jnp.exp(logs))
        return jnp.stack([fitact.mean_force(circuit, drive, CONTACT), fitact.peak_force(circuit, drive, CONTACT)])

    at = jnp.log(jnp.array([R, C, CI])), jnp.array(300.0), jnp.array(110.0), jnp.array(0.3)
    check_grads(jax.jit(force), at, order=1, modes=("rev",), rtol=1e-6)
    batch = jax.vmap(lambda x: force(x, *at[1:]))(at[0] + jnp.arange(2.0)[:, None])
    np.testing.assert_allclose(batch[0], force(*at), rtol=1e-12)


@pytest.mark.parametrize("x", [1e-3, 1.0, 3.0, 50.0])
@pytest.mark.slow
def test_second_derivatives(x: float):
    check_grads(lambda x: jnp.stack([phi(x), psi(x), _rectangle(0.2, x)]), (x,), order=2, rtol=1e-4, atol=1e-7)


@pytest.mark.slow
def test_differentiable_with_several_time_constants():
    def figures(logs: jax.Array) -> jax.Array:
        Rsc, Csc, Ci, R_H, grounding_Rsc = jnp.exp(logs)
        circuit = fitact.DirectGround(Rsc, Csc, Ci, R_H=R_H, grounding_Rsc=grounding_Rsc)
        drive = DRIVES["trapezoid"]
        current = fitact.body_current(circuit, drive)
        return jnp.stack([fitact.mean_square(circuit, drive), fitact.peak(circuit, drive), *current])

    check_grads(jax.jit(figures), (jnp.log(jnp.array([R, C, CI, 5e5, 8e6])),), order=1, modes=("rev",), rtol=1e-6)


@pytest.mark.parametrize("x", [0.0, 1e-300, 1e-12, 1e-3, 0.5, 1.99, 2.0, 2.01, 30.0, 1e3, 1e12, 1e300])
def test_relaxation_functions_against_mpmath(x: float):
    """Values and derivatives against mpmath with additional digits for 1 - 1 + x - x^2 ..."""
    import mpmath

    with mpmath.workdps(1300 if 0.0 < x < 1e-100 else 80):
        y = mpmath.mpf(x)
        if x == 0.0:
            expected = [1.0, -0.5, 0.5, -1.0 / 6.0, -0.5, 1.0 / 12.0, 0.0, 1.0 / 12.0]
        else:
            e = mpmath.exp(-y)
            p, dp = (1 - e) / y, (e * (1 + y) - 1) / y**2
            s, ds = e / (1 - e) - 1 / y, 1 / y**2 - e / (1 - e) ** 2
            expected = [p, dp, (1 - p) / y, -dp / y - (1 - p) / y**2, s, ds, s + 0.5, ds]
        ours = [part for f in (phi, psi, log_phi_derivative, half_langevin) for part in jax.value_and_grad(f)(x)]
        for value, truth in zip(ours, expected, strict=True):
            truth = float(truth)
            if abs(truth) > 1e-290:
                assert float(value) == pytest.approx(truth, rel=1e-13)
            else:
                assert float(value) == pytest.approx(0.0, abs=1e-290)


@pytest.mark.parametrize(
    "circuit",
    [fitact.FinalCircuit(R, C, CI), fitact.DirectGround(R, C, CI, R_H=500.0)],
    ids=["final", "R_H"],
)
@pytest.mark.parametrize("kind", ["polyline", "trapezoid"])
def test_pieces_without_length_are_jumps(circuit, kind: str):
    drive = {
        "polyline": fitact.Polyline(
            np.array([0.0, 0.005, 0.005, 0.01, 0.01]), np.array([180.0, 180.0, -180.0, -180.0, 180.0]), period=0.01
        ),
        "trapezoid": fitact.Trapezoid(360.0, 100.0, 0.0),
    }[kind]
    square = fitact.Square(360.0, 100.0)
    assert float(fitact.peak(circuit, drive)) == pytest.approx(float(fitact.peak(circuit, square)), rel=1e-12)
    np.testing.assert_allclose(fitact.body_current(circuit, drive), fitact.body_current(circuit, square), rtol=1e-9)
