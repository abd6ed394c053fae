import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from jax.test_util import check_grads

import fitact
from fitact import units
from fitact.model.response import highpass, knot_values
from tests.conftest import skin_voltage

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
        "triangle, 198 degrees ahead": fitact.Triangle(360.0, 100.0, offset=30.0, phase=1.1 * np.pi),
        "trapezoid, 90 degrees behind": fitact.Trapezoid(360.0, 100.0, rise_time=1e-3, duty=0.3, phase=-np.pi / 2.0),
    }
    SQUARES = {
        "square": fitact.Square(peak_to_peak=360.0, frequency=100.0),
        "square, duty 0.2, offset": fitact.Square(peak_to_peak=360.0, frequency=100.0, duty=0.2, offset=50.0),
        "square, 36 degrees ahead": fitact.Square(360.0, 100.0, duty=0.6, phase=units.parse_quantity("36 deg", "rad")),
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


@pytest.mark.parametrize("phase", [0.0, 1.0, -2.0, 7.5])
def test_sine_is_the_transfer_function(phase: float):
    drive = fitact.Sine(peak_to_peak=360.0, frequency=100.0, offset=20.0, phase=phase)
    phasor = 180.0 * np.asarray(CIRCUIT.transfer_function(2.0 * np.pi * 100.0)) * np.exp(1j * phase)
    np.testing.assert_allclose(
        fitact.response(CIRCUIT, drive, TIME), np.imag(phasor * np.exp(2j * np.pi * 100.0 * TIME)), atol=1e-12
    )
    np.testing.assert_allclose(drive.value(TIME), 20.0 + 180.0 * np.sin(200.0 * np.pi * TIME + phase), atol=1e-11)


@pytest.mark.parametrize("phase", [0.0, 1.0])
def test_sine_from_rest_against_scipy(phase: float):
    drive = fitact.Sine(peak_to_peak=360.0, frequency=100.0, phase=phase)
    fine = np.arange(20001) * 1e-6  # scipy's linear interpolation errs by (step)^2
    expected = skin_voltage(fine, np.asarray(drive.value(fine)), **VALUES)
    ours = fitact.response(CIRCUIT, drive, fine, steady_state=False)
    np.testing.assert_allclose(ours, expected, atol=1e-6)


@pytest.mark.parametrize("name", ["triangle", "trapezoid, duty 0.3", "square, duty 0.2, offset"])
def test_phase_is_an_earlier_start(name: str):
    wave = (LINEAR_DRIVES | SQUARES)[name]
    ahead = eqx.tree_at(lambda wave: wave.phase, wave, 2.0 * np.pi * 0.37)
    for channel in ("Vsc", "I"):
        shifted = fitact.response(CIRCUIT, wave, TIME + 3.7e-3, channel=channel)
        np.testing.assert_allclose(fitact.response(CIRCUIT, ahead, TIME, channel=channel), shifted, rtol=1e-9)


def test_first_peak_of_a_burst_is_deeper_than_in_the_steady_state():
    """Closed form: g (V0 e^{-T/2b} - 2 V0) against 2 V0 g / (1 + e^{-T/2b}), at ideal edges."""
    burst = fitact.Burst(fitact.Square(360.0, 100.0), 5)
    g, decay = 1.35 / 24.7, np.exp(-5e-3 / (160e3 * 24.7e-9))
    peak = fitact.response(CIRCUIT, burst, 5e-3, steady_state=False)
    assert float(peak) == pytest.approx(g * (180.0 * decay - 360.0), rel=1e-13)
    assert float(peak) == pytest.approx(-16.9, abs=0.005)
    assert float(fitact.response(CIRCUIT, burst.wave, 5e-3)) == pytest.approx(-360.0 * g / (1.0 + decay), rel=1e-13)


@pytest.mark.parametrize("name", ["sine", "square, duty 0.2, offset", "trapezoid, 90 degrees behind"])
def test_burst_against_scipy(name: str):
    wave = (LINEAR_DRIVES | SQUARES | {"sine": fitact.Sine(360.0, 100.0, 20.0, 1.0)})[name]
    time, voltage = many_periods(wave, 5)
    voltage = np.where(np.arange(time.size) < 3 * TIME.size, voltage, 0.0)
    burst = fitact.Burst(wave, 3)
    np.testing.assert_allclose(burst.value(time), voltage, atol=1e-11)
    held = name in SQUARES
    expected = skin_voltage(time, voltage, **VALUES, hold=held)
    ours = np.asarray(fitact.response(CIRCUIT, burst, time, steady_state=False))
    if not held:  # scipy turns the jump at the end into a ramp over the step before it
        last = 3 * TIME.size
        g, step = CIRCUIT.g * float(wave.value(0.0)), STEP / CIRCUIT.b
        expected[last:] -= g * (-np.expm1(-step) / step - 1.0) * -np.exp(-(time[last:] - time[last]) / CIRCUIT.b)
    np.testing.assert_allclose(ours, expected, atol=1e-4 if name == "sine" else 2e-10)
    assert np.all(np.asarray(fitact.response(CIRCUIT, burst, np.array([-1.0, -1e-9]), steady_state=False)) == 0.0)


def test_burst_has_no_steady_state_and_whole_cycles():
    wave = fitact.Square(360.0, 100.0)
    with pytest.raises(fitact.InputError, match="steady_state=False"):
        fitact.response(CIRCUIT, fitact.Burst(wave, 5), TIME)
    for cycles in (0, 2.5, True):
        with pytest.raises(fitact.InputError, match="cycles"):
            fitact.Burst(wave, cycles)
    with pytest.raises(fitact.InputError, match="not periodic"):
        fitact.Burst(fitact.Sampled(TIME, TIME), 1)


SWEEPS = {
    "up": fitact.Chirp(360.0, 20.0, 500.0, 0.1, offset=20.0, phase=0.7),
    "down": fitact.Chirp(360.0, 500.0, 20.0, 0.1, "logarithmic", phase=-2.0),
    "hardly": fitact.Chirp(360.0, 1.0, 1.1, 0.05, "logarithmic"),
    "not at all": fitact.Chirp(360.0, 100.0, 100.0, 0.03, "logarithmic", offset=20.0),
    "six decades": fitact.Chirp(360.0, 1e-3, 1e3, 0.05, "logarithmic", phase=1.0),
    "many cycles": fitact.Chirp(360.0, 10.0, 1000.0, 1.0),
}


def swept(chirp: fitact.Chirp, time: np.ndarray) -> np.ndarray:
    """Textbook formulas of the chirp."""
    f0, f1, T = chirp.start_frequency, chirp.end_frequency, chirp.duration
    if chirp.spacing == "linear":
        cycles = f0 * time + (f1 - f0) * time**2 / (2.0 * T)
    elif f0 == f1:
        cycles = f0 * time
    else:
        cycles = f0 * T / np.log(f1 / f0) * np.expm1(np.log(f1 / f0) * time / T)
    return chirp.offset + 180.0 * np.sin(2.0 * np.pi * cycles + chirp.phase)


@pytest.mark.parametrize("name", SWEEPS)
def test_chirp_against_gauss_legendre(name: str):
    """u(t) = V(t) - integral of V(s) e^{-(t - s) / tau} / tau, from 40 nodes on each eighth of a cycle."""
    chirp = SWEEPS[name]
    f_max, T = max(chirp.start_frequency, chirp.end_frequency), chirp.duration
    times = np.append(T * np.array([0.0, 0.013, 0.31, 0.77, 0.99]), [1.0001 * T, 1.2 * T])
    nodes, weights = np.polynomial.legendre.leggauss(40)
    np.testing.assert_allclose(chirp.value(times[:5]), swept(chirp, times[:5]), atol=1e-9)
    np.testing.assert_array_equal(chirp.value(np.array([-1e-9, T, 2.0 * T])), 0.0)
    for tau in (1e-5, 6e-4, 4e-3, 1.0, 1e4):
        expected = []
        for t in times:
            end = min(t, T)
            begin = max(0.0, end - 45.0 * tau)
            edges = np.linspace(begin, end, 2 + int(8.0 * f_max * (end - begin) + (end - begin) / tau))
            half = 0.5 * np.diff(edges)[:, None]
            s = edges[:-1, None] + half * (1.0 + nodes)
            past = np.sum(swept(chirp, s) * np.exp(-(t - s) / tau) * weights * half) / tau
            expected.append((swept(chirp, t) if t < T else 0.0) - past)
        ours = highpass(chirp, times, tau, steady_state=False)
        np.testing.assert_allclose(ours, expected, atol=1e-12 * 180.0 * max(1.0, f_max * T / 100.0))


@pytest.mark.slow
def test_chirp_in_single_precision():
    circuit, time = fitact.FinalCircuit(**VALUES), np.linspace(-0.01, 0.12, 500)
    exact = np.asarray(fitact.response(circuit, SWEEPS["up"], time, steady_state=False))
    with jax.enable_x64(False):
        single = np.asarray(fitact.response(circuit, SWEEPS["up"], time, steady_state=False))
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, exact, atol=5e-5 * np.abs(exact).max())  # phase over 26 cycles


@pytest.mark.slow
def test_chirp_differentiates_in_circuit_amplitude_and_frequencies():
    time = np.array([1.3e-3, 41e-3, 77e-3, 113e-3])

    def vsc(logs: jax.Array, peak_to_peak: jax.Array, x: jax.Array) -> jax.Array:
        # only small relative changes, because 26 cycles multiply the change of the phase
        changed = peak_to_peak, 20.0 * jnp.exp(0.01 * x[0]), 0.1 * jnp.exp(0.01 * x[1])
        chirp = eqx.tree_at(lambda c: (c.peak_to_peak, c.start_frequency, c.duration), SWEEPS["up"], changed)
        return fitact.response(fitact.FinalCircuit(*jnp.exp(logs)), chirp, time, steady_state=False)

    at = jnp.log(jnp.array([160e3, 22e-9, 1.35e-9])), jnp.array(1.0), jnp.zeros(2)
    check_grads(jax.jit(vsc), at, order=1, modes=("fwd", "rev"), rtol=1e-6)


@pytest.mark.parametrize("make", ["sine", "square", "triangle", "trapezoid", "burst", "chirp"])
def test_jit_and_vmap_over_amplitude_and_frequency(make: str):
    """The drive is vmapped as a pytree of numbers."""
    drives = [
        {
            "sine": lambda V, f: fitact.Sine(V, f, phase=1.0),
            "square": lambda V, f: fitact.Square(V, f, phase=1.0),
            "triangle": lambda V, f: fitact.Triangle(V, f),
            "trapezoid": lambda V, f: fitact.Trapezoid(V, f, 1e-3),
            "burst": lambda V, f: fitact.Burst(fitact.Square(V, f), 2),
            "chirp": lambda V, f: eqx.tree_at(lambda c: (c.peak_to_peak, c.end_frequency), SWEEPS["up"], (V, 4.0 * f)),
        }[make](V, f)
        for V, f in ((360.0, 100.0), (20.0, 73.0))
    ]
    time = TIME[::50] + 1e-6

    def vsc(drive: fitact.Square) -> jax.Array:
        return fitact.response(CIRCUIT, drive, time, steady_state=False)

    together = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(y) for y in x]), *drives)
    one_by_one = np.stack([vsc(drive) for drive in drives])
    np.testing.assert_allclose(jax.jit(jax.vmap(vsc))(together), one_by_one, rtol=1e-12, atol=1e-11)


@pytest.mark.parametrize(
    ("change", "words"),
    [({"spacing": "log"}, "logarithmic"), ({"start_frequency": 0.0}, "positive"), ({"duration": -1.0}, "positive")],
)
def test_impossible_chirp_is_refused(change: dict[str, object], words: str):
    given = {"peak_to_peak": 1.0, "start_frequency": 1.0, "end_frequency": 2.0, "duration": 1.0} | change
    with pytest.raises(fitact.InputError, match=words):
        fitact.Chirp(**given)
    with pytest.raises(fitact.InputError, match="outside jit"):
        jax.jit(lambda f: fitact.Chirp(1.0, f, 2.0, 1.0))(1.0)
    with pytest.raises(fitact.InputError, match="steady_state=False"):
        fitact.response(CIRCUIT, SWEEPS["up"], TIME)


CORNERS = np.array([0.0, 1e-3, 1e-3, 4e-3, 4e-3, 7e-3]), np.array([0.0, 100.0, -50.0, -50.0, 80.0, 30.0])


def test_polyline_against_scipy():
    """A jump is the difference between two polylines with a corner, each of which scipy computes."""
    times, voltages = CORNERS
    line = fitact.Polyline(times, voltages)
    time = np.arange(3001) * STEP
    steps = [(i, voltages[i + 1] - voltages[i]) for i in (1, 3)]
    held = sum(step * (time >= times[i] - 1e-9) for i, step in steps)
    np.testing.assert_allclose(line.value(time), np.interp(time, times[::1], voltages), atol=1e-9)
    continuous = np.asarray(line.value(time)) - held
    expected = skin_voltage(time, continuous, **VALUES) + skin_voltage(time, held, **VALUES, hold=True)
    ours = np.asarray(fitact.response(CIRCUIT, line, time, steady_state=False))
    np.testing.assert_allclose(ours, expected, atol=1e-11)
    later = np.asarray(fitact.response(CIRCUIT, line, np.array([-1.0, 1.0]), steady_state=False))
    np.testing.assert_allclose(later, 0.0, atol=1e-11)


def test_polyline_repeats_as_the_wave_it_draws():
    edges = PERIOD * np.array([0.0, 0.2, 0.2, 1.0])
    line = fitact.Polyline(edges, np.array([230.0, 230.0, -130.0, -130.0]), period=PERIOD)
    wave = SQUARES["square, duty 0.2, offset"]
    time = TIME + 7.0 * PERIOD
    np.testing.assert_array_equal(line.value(time), wave.value(time))
    np.testing.assert_array_equal(np.isnan(line.slope(time)), np.isnan(wave.slope(time)))
    for steady_state in (True, False):
        ours = fitact.response(CIRCUIT, line, time, steady_state=steady_state)
        np.testing.assert_allclose(ours, fitact.response(CIRCUIT, wave, time, steady_state=steady_state), atol=1e-11)


@pytest.mark.parametrize(
    ("time", "voltage", "period", "words"),
    [
        ([0.0, 2.0, 1.0], [0.0, 1.0, 2.0], None, "decrease"),
        ([0.0, 1.0], [0.0, 1.0, 2.0], None, "shape"),
        ([0.0, 1.0, 2.0], [0.0, 1.0, 2.0], 1.5, "period"),
    ],
)
def test_impossible_polyline_is_refused(time, voltage, period, words: str):
    with pytest.raises(fitact.InputError, match=words):
        fitact.Polyline(np.array(time), np.array(voltage), period)


def test_initial_charge_against_scipy():
    """scipy's state is Vsc without the part that jumps with V; any initial state is a charge that decays."""
    drive = fitact.Sampled(TIME, np.asarray(LINEAR_DRIVES["triangle"].value(TIME)))
    a, b = 160e3 * 1.35e-9, 160e3 * 24.7e-9
    system = scipy.signal.StateSpace([[-1.0 / b]], [[-a / b**2]], [[1.0]], [[a / b]])
    expected = scipy.signal.lsim(system, np.asarray(drive.samples), TIME, X0=[3.0])[1]
    ours = fitact.response(CIRCUIT, drive, TIME, steady_state=False, initial=[3.0])
    np.testing.assert_allclose(ours, expected, atol=1e-11)


def test_initial_charges_of_two_time_constants_against_scipy():
    circuit, drive = fitact.NaturalGround(**VALUES, Z=14.5e6), LINEAR_DRIVES["triangle"]
    # the states are Vsc and the voltage across Ci
    R, C, Ci, Z = 160e3, 22e-9, 1.35e-9, 14.5e6
    A = np.array([[-1.0 / (R * C) - 1.0 / (Z * C), -1.0 / (Z * C)], [-1.0 / (Z * Ci), -1.0 / (Z * Ci)]])
    system = scipy.signal.StateSpace(A, [[1.0 / (Z * C)], [1.0 / (Z * Ci)]], [[1.0, 0.0]], [[0.0]])
    voltage = np.asarray(drive.value(TIME))
    rates, modes = np.linalg.eig(A)
    order = np.argsort(-1.0 / rates)[np.argsort(np.argsort(circuit.terms().tau))]
    np.testing.assert_allclose(circuit.terms().tau, (-1.0 / rates)[order], rtol=1e-9)
    for charge in ([5.0, 0.0], [2.0, -40.0]):
        amplitudes = (modes[0] * np.linalg.solve(modes, charge))[order]
        expected = scipy.signal.lsim(system, voltage, TIME, X0=charge)[1]
        ours = fitact.response(circuit, drive, TIME, steady_state=False, initial=tuple(amplitudes))
        np.testing.assert_allclose(ours, expected, atol=1e-9)


def test_initial_charge_needs_a_start_and_one_value_for_each_time_constant():
    with pytest.raises(fitact.InputError, match="steady_state=False"):
        fitact.response(CIRCUIT, SQUARES["square"], TIME, initial=[1.0])
    with pytest.raises(fitact.InputError, match="1 time constants"):
        fitact.response(CIRCUIT, SQUARES["square"], TIME, steady_state=False, initial=[1.0, 2.0])


@pytest.mark.parametrize(
    "count",
    [2, 3, 50, *(pytest.param(count, marks=pytest.mark.slow) for count in (1000, 1001))],
)
def test_sampled_drive_against_scipy(count: int):
    voltage = np.random.default_rng(1).normal(size=count)
    time = np.arange(count) * 1e-4
    drive = fitact.Sampled(time, voltage)
    expected = skin_voltage(time, voltage, **VALUES)
    np.testing.assert_allclose(fitact.response(CIRCUIT, drive, time, steady_state=False), expected, atol=1e-13)
    np.testing.assert_allclose(fitact.response(CIRCUIT, drive, drive.time, steady_state=False), expected, atol=1e-13)


@pytest.mark.parametrize("part", [250, *(pytest.param(part, marks=pytest.mark.slow) for part in (333, 998, 999))])
def test_long_sampled_drive_is_followed_in_parts(part: int, monkeypatch):
    monkeypatch.setattr("fitact.model.response.knot_values", functools.partial(knot_values, part=part))
    test_sampled_drive_against_scipy(1000)


def test_sampled_drive_on_uneven_times_is_the_same_line():
    """A polyline is the same drive for any sampling; scipy computes it on an even grid."""
    rng = np.random.default_rng(2)
    kept = np.unique(np.concatenate([[0, 2000], rng.integers(0, 2001, 60)]))
    grid = np.arange(2001) * STEP
    knots = rng.normal(size=kept.size)
    line = np.interp(grid, grid[kept], knots)
    expected = skin_voltage(grid, line, **VALUES)
    ours = fitact.response(CIRCUIT, fitact.Sampled(grid[kept], knots), grid, steady_state=False)
    np.testing.assert_allclose(ours, expected, atol=1e-12)


def test_sampled_drive_with_gaps_is_a_straight_line_there_and_constant_outside():
    rng = np.random.default_rng(3)
    kept = np.r_[0:300, 900:1000, 1001, 1700:1800]
    voltage = rng.normal(size=kept.size)
    fine = np.arange(4001) * 0.5 * STEP
    expected = skin_voltage(fine, np.interp(fine, TIME[kept], voltage), **VALUES)
    ours = fitact.response(CIRCUIT, fitact.Sampled(TIME[kept], voltage), fine, steady_state=False)
    np.testing.assert_allclose(ours, expected, atol=1e-12)


def test_sampled_period_from_rest_goes_on():
    wave = LINEAR_DRIVES["trapezoid, duty 0.3"]
    line = fitact.Sampled(TIME, np.asarray(wave.value(TIME)), period=PERIOD)
    time = np.arange(-10, 7000) * STEP
    ours = fitact.response(CIRCUIT, line, time, steady_state=False)
    expected = np.asarray(fitact.response(CIRCUIT, wave, time, steady_state=False))
    np.testing.assert_allclose(ours[10:], expected[10:], atol=1e-10)


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
    """t f is rounded; of 1e6 samples, a naive t mod T assigns 1,250 to the wrong half-period."""
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


DIFFERENTIABLE = ["sine", "square", "trapezoid", "triangle", "sampled", "polyline", "burst"]
# the other cases use the same code
QUICK = [("sine", False), ("square", True), ("sampled", False)]


@pytest.mark.parametrize(
    ("name", "steady_state"),
    [
        pytest.param(name, steady, marks=[] if (name, steady) in QUICK else pytest.mark.slow)
        for name in DIFFERENTIABLE
        for steady in (True, False)
        if not (steady and name == "burst")
    ],
)
def test_differentiable_in_every_parameter(name: str, steady_state: bool):
    time = np.array([1.3e-3, 4.1e-3, 7.7e-3, 31.3e-3])
    samples = 100.0 * np.sin(2.0 * np.pi * 100.0 * TIME[::40])

    @jax.jit
    def vsc(logs: jax.Array, peak_to_peak: jax.Array, frequency: jax.Array, phase: jax.Array) -> jax.Array:
        period = 1.0 / frequency if steady_state else None
        drive = {
            "sine": lambda: fitact.Sine(peak_to_peak, frequency, phase=phase),
            "square": lambda: fitact.Square(peak_to_peak, frequency, duty=0.4, phase=phase),
            "trapezoid": lambda: fitact.Trapezoid(peak_to_peak, frequency, rise_time=1e-4, phase=phase),
            "triangle": lambda: fitact.Triangle(peak_to_peak, frequency, phase=phase),
            "sampled": lambda: fitact.Sampled(TIME[::40], samples * peak_to_peak, period),
            "polyline": lambda: fitact.Polyline(CORNERS[0] + 1e-4 * phase, CORNERS[1] * peak_to_peak, period),
            "burst": lambda: fitact.Burst(fitact.Square(peak_to_peak, frequency, offset=0.3, phase=phase), 2),
        }[name]()
        circuit = fitact.FinalCircuit(*jnp.exp(logs))
        initial = None if steady_state else [peak_to_peak]
        return fitact.response(circuit, drive, time, steady_state=steady_state, initial=initial)

    at = jnp.log(jnp.array([160e3, 22e-9, 1.35e-9])), jnp.array(1.0), jnp.array(100.0), jnp.array(0.2)
    check_grads(vsc, at, order=1, modes=("fwd", "rev"), rtol=1e-6)


def test_jit_and_vmap_change_nothing():
    logs = jnp.log(jnp.array([[160e3, 22e-9, 1.35e-9], [80e3, 9e-9, 3.45e-9]]))

    def vsc(logs: jax.Array) -> jax.Array:
        return fitact.response(fitact.FinalCircuit(*jnp.exp(logs)), LINEAR_DRIVES["trapezoid"], TIME)

    one_by_one = np.stack([vsc(row) for row in logs])
    np.testing.assert_allclose(jax.jit(jax.vmap(vsc))(logs), one_by_one, rtol=1e-13, atol=1e-13)
