import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

import fitact


def divided(omega: np.ndarray, Rsc: float, Csc: float, Ci: float) -> np.ndarray:
    """Eqs. (18) and (19) as impedances."""
    skin = Rsc / (1.0 + 1j * omega * Rsc * Csc)
    return skin / (2.0 * skin + 1.0 / (1j * omega * Ci))


def test_transfer_function_is_the_voltage_divider_of_the_paper():
    omega = 2.0 * np.pi * np.logspace(0, 6, 61)
    for values in [(160e3, 22e-9, 1.35e-9), (4.3e3, 200e-9, 3.45e-9), (20e6, 1e-9, 0.69e-9)]:
        with jax.enable_x64(True):
            ours = np.asarray(fitact.FinalCircuit(*values).transfer_function(omega))
        np.testing.assert_allclose(ours, divided(omega, *values), rtol=1e-13)


@pytest.mark.parametrize("omega", [0.0, 1e-300, 1e300])
def test_transfer_function_and_gradient_are_finite_at_the_ends(omega: float):
    with jax.enable_x64(True):
        value, slope = jax.value_and_grad(
            lambda r: abs(fitact.FinalCircuit(r, 22e-9, 1.35e-9).transfer_function(omega) + 1e-3)
        )(160e3)
    assert np.isfinite(value)
    assert np.isfinite(slope)


@pytest.mark.parametrize("omega", [0.0, 1e-300, 1e-12, 1.0, 1e3, 1e12, 1e300])
def test_amplitude_and_phase_have_finite_gradients(omega: float):
    for make in (fitact.FinalCircuit, lambda *values: fitact.NaturalGround(*values, Z=14.5e6)):
        for name in ("amplitude", "phase"):
            with jax.enable_x64(True):
                values = jnp.array([160e3, 22e-9, 1.35e-9])
                value, slope = jax.value_and_grad(lambda v, make=make, name=name: getattr(make(*v), name)(omega))(
                    values
                )
            assert np.isfinite(value)
            assert np.all(np.isfinite(slope))


R, C, CI = 160e3, 22e-9, 1.35e-9
OTHER = {"grounding_Rsc": 80e3, "grounding_Csc": 44.25e-9}
PROBE = fitact.Probe(10e6, 10e-12)


def element(omega: np.ndarray, resistance: float, capacitance: float) -> np.ndarray:
    return resistance / (1.0 + 1j * omega * resistance * capacitance)


def loaded(omega: np.ndarray) -> np.ndarray:
    skin, probe = element(omega, R, C), element(omega, 10e6, 10e-12)
    return skin * probe / (skin + probe)


# circuit, impedance of the sliding finger's skin, impedance of the rest of the loop without Ci
LOOPS = {
    "final": (fitact.FinalCircuit(R, C, CI), lambda w: element(w, R, C), lambda w: element(w, R, C)),
    "equal skins": (fitact.DirectGround(R, C, CI), lambda w: element(w, R, C), lambda w: element(w, R, C)),
    "unequal skins": (
        fitact.DirectGround(R, C, CI, **OTHER),
        lambda w: element(w, R, C),
        lambda w: element(w, 80e3, 44.25e-9),
    ),
    "simplified, R_H": (
        fitact.DirectGround(R, C, CI, R_H=500.0),
        lambda w: element(w, R, C),
        lambda w: element(w, R, C) + 500.0,
    ),
    "everything": (
        fitact.DirectGround(R, C, CI, R_H=500.0, **OTHER, series_resistor=100e3, probe=PROBE),
        loaded,
        lambda w: element(w, 80e3, 44.25e-9) + 100.5e3,
    ),
    "probe": (fitact.DirectGround(R, C, CI, **OTHER, probe=PROBE), loaded, lambda w: element(w, 80e3, 44.25e-9)),
    "natural, Z": (fitact.NaturalGround(R, C, CI, Z=14.5e6), lambda w: element(w, R, C), lambda w: 14.5e6),
    "natural, Z with capacitance": (
        fitact.NaturalGround(R, C, CI, Z=14.5e6, Z_capacitance=100e-12, probe=PROBE),
        loaded,
        lambda w: element(w, 14.5e6, 100e-12),
    ),
}


@pytest.mark.parametrize("name", LOOPS)
def test_loops_are_their_impedances(name: str):
    circuit, touching, rest = LOOPS[name]
    omega = 2.0 * np.pi * np.logspace(-2, 5, 71)
    current = 1.0 / (1.0 / (1j * omega * CI) + touching(omega) + rest(omega))
    with jax.enable_x64(True):
        ours, admittance = np.asarray(circuit.transfer_function(omega)), np.asarray(circuit.admittance(omega))
        amplitude, phase = np.asarray(circuit.amplitude(omega)), np.asarray(circuit.phase(omega))
    expected = touching(omega) * current
    # with a resistance in the loop, Vsc decreases at high frequency, where terms cancel down to rounding errors
    np.testing.assert_allclose(ours, expected, rtol=1e-12, atol=1e-14 * np.abs(expected).max())
    np.testing.assert_allclose(admittance, current, rtol=1e-11)
    np.testing.assert_allclose(amplitude * np.exp(1j * phase), ours, rtol=1e-12, atol=1e-14 * amplitude.max())


def test_equal_skins_are_the_limit_of_unequal_ones_and_differentiable():
    """The case of the paper, in which two time constants of the elements coincide."""

    @jax.jit
    def gain(logs: jax.Array) -> jax.Array:
        Rsc, Csc, Ci, grounding_Rsc, grounding_Csc = jnp.exp(logs)
        circuit = fitact.DirectGround(Rsc, Csc, Ci, grounding_Rsc=grounding_Rsc, grounding_Csc=grounding_Csc)
        return jnp.abs(circuit.transfer_function(np.array([100.0, 628.0, 6e4])))

    with jax.enable_x64(True):
        equal = jnp.log(jnp.array([R, C, CI, R, C]))
        limit = gain(equal + 1e-11 * jnp.array([0.0, 0.0, 0.0, 1.0, -1.0]))
        np.testing.assert_allclose(gain(equal), limit, rtol=1e-10)
        reference = np.abs(np.asarray(fitact.FinalCircuit(R, C, CI).transfer_function(np.array([100.0, 628.0, 6e4]))))
        np.testing.assert_allclose(gain(equal), reference, rtol=1e-13)
        check_grads(gain, (equal,), order=1, modes=("fwd", "rev"), rtol=1e-6)


@pytest.mark.parametrize(("Ci", "ratio"), [(0.692e-9, 6.08), (1.35e-9, 11.2)])
def test_direct_against_natural_ground_of_the_paper(Ci: float, ratio: float):
    """For a sine at 100 Hz the paper's factor of six requires 0.692 nF; its 1.35 nF gives 11.2."""
    omega = 2.0 * np.pi * 100.0
    with jax.enable_x64(True):
        direct = abs(fitact.FinalCircuit(R, C, Ci).transfer_function(omega))
        natural = abs(fitact.NaturalGround(R, C, Ci, Z=14.5e6).transfer_function(omega))
    assert float(direct / natural) == pytest.approx(ratio, abs=0.06)


def test_knee_of_the_paper():
    """40.3 Hz for the paper's 1.35 nF (it states 40 Hz)."""
    with jax.enable_x64(True):
        knee = 1.0 / (2.0 * np.pi * fitact.FinalCircuit(160e3, 22e-9, 1.35e-9).b)
    assert knee == pytest.approx(40.27, abs=0.01)


@pytest.mark.parametrize("logs", [(-421.5, 599.1, -1070.7), (12.0, -1000.0, -20.0), (12.0, -20.0, 700.0)])
def test_divider_is_differentiable_where_a_fit_may_stray(logs: tuple[float, float, float]):
    """One capacitance underflows or overflows, and with it their quotient; the divider tends to 0 or 1/2."""
    with jax.enable_x64(True):
        value, slope = jax.value_and_grad(lambda x: fitact.FinalCircuit(*jnp.exp(x)).g)(jnp.array(logs))
    assert float(value) == pytest.approx(0.0 if logs[1] > logs[2] else 0.5)
    assert np.all(np.isfinite(slope))


def test_derivatives_are_finite_where_two_skins_share_a_time_constant():
    """The time constants of two equal skins with a far larger resistor differ by less than rounding errors."""

    def square_of_vsc(values: jax.Array) -> jax.Array:
        circuit = fitact.DirectGround(*values, series_resistor=100e3)
        return jnp.sum(jnp.square(fitact.response(circuit, fitact.Square(360.0, 100.0), jnp.linspace(0.0, 0.01, 9))))

    with jax.enable_x64(True):
        slopes = jax.jit(jax.jacfwd(square_of_vsc))  # compiled once for all
        for Rsc in (1e-18, 1e-3, 160e3):
            assert np.all(np.isfinite(slopes(jnp.array([Rsc, 18e-9, 1.35e-9])))), Rsc
