"""A leak Ri of the insulator, against impedances, data_synth's state space, mpmath and closed forms."""

import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

import fitact
from data_synth.make import simulate_response
from data_synth.scene import make_scene
from fitact.experiment.blind_directions import blind_directions, name_direction
from fitact.likelihood.compression import Compression
from fitact.model.circuit import HighpassTerms, gain_at
from fitact.model.steady_cycle import period_quantities, real_power
from tests.model.test_ngspice import DRIVES, away_from, computed, simulate

R, C, CI, RI = 160e3, 22e-9, 1.35e-9, 3e6
R2, C2, R0, Z = 80e3, 44.25e-9, 20e3, 14.5e6
RGAP, CGAP = 2e6, 4e-10
OTHER: dict[str, Any] = {"grounding_Rsc": R2, "grounding_Csc": C2}
OMEGA = np.append(0.0, 2.0 * np.pi * np.logspace(-2, 6, 25))
# our circuit, and R, C of the parallel elements in series with the leaky insulator, and the resistance in the loop
LOOPS: dict[str, tuple[Any, list[tuple[float, float]], float]] = {
    "final": (fitact.FinalCircuit(R, C, CI, Ri=RI), [(R, C), (R, C)], 0.0),
    "unequal skins": (fitact.DirectGround(R, C, CI, Ri=RI, **OTHER), [(R, C), (R2, C2)], 0.0),
    "R_H": (fitact.DirectGround(R, C, CI, R_H=R0, Ri=RI, **OTHER), [(R, C), (R2, C2)], R0),
    "natural": (fitact.NaturalGround(R, C, CI, Z=Z, Ri=RI), [(R, C)], Z),
    "gap": (
        fitact.DirectGround(R, C, CI, R_H=R0, Ri=RI, Rgap=RGAP, Cgap=CGAP),
        [(R, C), (R, C), (RGAP, CGAP)],
        R0,
    ),
    "open gap": (fitact.DirectGround(R, C, CI, R_H=R0, Ri=RI, Cgap=CGAP), [(R, C), (R, C), (1e300, CGAP)], R0),
}


@pytest.mark.parametrize("name", LOOPS)
def test_gains_are_those_of_the_impedances_in_series(name: str):
    circuit, elements, series = LOOPS[name]
    omega = OMEGA[1:] if name == "open gap" else OMEGA
    parts = [R / (1.0 + 1j * omega * R * C) for R, C in [*elements, (RI, CI)]]
    around = sum(parts) + series
    expected = {"Vsc": parts[0], "I": 1.0, "Vi": parts[-1]} | ({"Vgap": parts[2]} if "gap" in name else {})
    with jax.enable_x64(True):
        for channel, part in expected.items():
            gain = part / around
            terms = circuit.insulator_terms() if channel == "Vi" else circuit.channel_terms(channel)
            found = np.asarray(gain_at(terms, omega))
            # an open gap keeps its charge for 1e15 time constants, not for ever
            atol = (1e-11 if name == "open gap" else 1e-12) * np.abs(gain).max()
            np.testing.assert_allclose(found, gain, rtol=0.0, atol=atol)
            if channel != "Vi":
                np.testing.assert_allclose(circuit.channel_gain(channel, omega), gain, rtol=1e-13)


@pytest.mark.parametrize("name", [name for name in LOOPS if name != "open gap"])
def test_without_conduction_it_is_the_circuit_without_a_leak(name: str):
    circuit, _, _ = LOOPS[name]
    fields = {key: value for key, value in vars(circuit).items() if key != "Ri"}
    bare = type(circuit)(**fields)
    with jax.enable_x64(True):
        for Ri in (1e30, np.inf):
            leaky = type(circuit)(**fields, Ri=Ri)
            for channel in ("Vsc", "I", *(["Vgap"] if name == "gap" else [])):
                found, expected = leaky.channel_terms(channel), bare.channel_terms(channel)
                np.testing.assert_allclose(found.tau, expected.tau, rtol=1e-14)
                scale = np.abs(np.array(expected.weight)).max()
                np.testing.assert_allclose(found.weight, expected.weight, rtol=1e-13, atol=1e-15 * scale)
                assert (found.rate is None) == (expected.rate is None)
                np.testing.assert_allclose(found.rate or 0.0, expected.rate or 0.0, rtol=1e-15)
                assert abs(float(found.direct)) <= 1e-20


SCENES: dict[str, dict[str, Any]] = {
    "final": {},
    "R_H": {"grounding": {"R_H": R0, "grounding_Rsc": R2, "grounding_Csc": C2}},
    "natural": {"grounding": {"connection": "natural", "Z": Z}},
}


def synthetic(name: str, time: np.ndarray, drive: dict[str, Any]) -> tuple[np.ndarray, ...]:
    """Return V, Vsc and I of data_synth's network."""
    return simulate_response(make_scene({"device": {"Ri": RI}, "drive": drive} | SCENES[name], {}, "scene"), time)


@pytest.mark.parametrize("drive", ["trapezoid", "sine", "burst"])
@pytest.mark.parametrize("name", SCENES)
def test_responses_against_another_route(name: str, drive: str):
    """Trapezoid and sine with a mean in the steady state, and a burst from rest."""
    keys: dict[str, Any] = {"waveform": drive, "frequency": 130.0}
    keys |= {
        "trapezoid": {"rise_time": 3e-4, "duty": 0.3, "offset": 50.0},
        "sine": {"offset": 50.0, "phase": 1.0},
        "burst": {"shape": "triangle", "cycles": 2, "steady_state": False},
    }[drive]
    time = np.linspace(0.0, 0.03, 500)
    scene = fitact.Scene.from_dict({"device": {"Ri": RI}, "drive": keys} | SCENES[name])
    with jax.enable_x64(True):
        for channel, expected in zip(("Vsc", "I"), synthetic(name, time, keys)[1:], strict=True):
            found = fitact.response(
                scene.make_circuit(), scene.make_drive(), time, steady_state=drive != "burst", channel=channel
            )
            np.testing.assert_allclose(found, expected, atol=2e-9 * np.ptp(expected))


@pytest.mark.skipif(shutil.which("ngspice") is None, reason="ngspice is not installed (apt-get install ngspice)")
def test_responses_from_rest_against_ngspice(tmp_path: Path):
    wave, source, edges = DRIVES["trapezoid, duty 0.3"]
    netlist = ["Ci in skin 1.35n", "Ri in skin 3meg", "R1 skin below 160k", "C1 skin below 22n", "RH below b 20k"]
    time, vsc, current = simulate([*netlist, "R2 b 0 80k", "C2 b 0 44.25n"], source, tmp_path)
    away = away_from(edges, time)
    for channel, expected in (("Vsc", vsc), ("I", current)):
        found = computed(LOOPS["R_H"][0], wave, time, steady_state=False, channel=channel)
        np.testing.assert_allclose(found[away], expected[away], atol=5e-4 * np.ptp(expected))


@pytest.mark.parametrize("waveform", ["trapezoid", "triangle", "sine"])
@pytest.mark.parametrize("name", ["final", pytest.param("R_H", marks=pytest.mark.slow)])
def test_steady_state_quantities_against_a_fine_grid(name: str, waveform: str):
    keys: dict[str, Any] = {"waveform": waveform, "frequency": 130.0, "offset": -60.0}
    keys |= {"rise_time": 1e-3, "duty": 0.3} if waveform == "trapezoid" else {}
    scene = fitact.Scene.from_dict({"device": {"Ri": RI}, "drive": keys} | SCENES[name])
    voltage, vsc, current = synthetic(name, np.arange(40_000) / 40_000 / 130.0, keys)
    over = voltage - 2.0 * vsc  # of the final circuit's insulator
    with jax.enable_x64(True):
        circuit, drive = scene.make_circuit(), scene.make_drive()
        assert float(fitact.mean_square(circuit, drive)) == pytest.approx(np.mean(vsc**2), rel=1e-6)
        assert float(fitact.peak(circuit, drive)) == pytest.approx(np.abs(vsc).max(), rel=1e-6)
        assert float(fitact.mean_square(circuit, drive, "I")) == pytest.approx(np.mean(current**2), rel=1e-4)
        assert float(fitact.peak(circuit, drive, "I")) == pytest.approx(np.abs(current).max(), rel=1e-4)
        if name == "final":  # what its resistances dissipate
            power = 2.0 * np.mean(vsc**2) / R + np.mean(over**2) / RI
            assert float(real_power(circuit, drive)) == pytest.approx(power, rel=1e-6)
            quantities = period_quantities(circuit, drive, scene.geometry().contact(circuit))
            assert float(quantities.insulator_peak) == pytest.approx(np.abs(over).max(), rel=1e-3)
        else:
            assert float(real_power(circuit, drive)) == pytest.approx(np.mean(voltage * current), rel=1e-4)
        slope = jax.grad(lambda Ri: fitact.peak(eqx_replace(circuit, Ri), drive))(RI)
        step = 1e-4 * RI
        ends = [float(fitact.peak(eqx_replace(circuit, RI + side * step), drive)) for side in (1.0, -1.0)]
        assert float(slope) == pytest.approx((ends[0] - ends[1]) / (2.0 * step), rel=1e-4)


def eqx_replace(circuit: Any, Ri: Any) -> Any:
    return type(circuit)(**(vars(circuit) | {"Ri": Ri}))


def test_the_force_of_a_constant_voltage_and_of_harmonics():
    """A panel that leaks holds a finger by direct voltage: V d on the skin, and V Rgap / sum R across a gap."""
    circuit = fitact.DirectGround(R, C, CI, Ri=RI, Rgap=RGAP, Cgap=CGAP)
    drive, time = fitact.Sine(1e-3, 100.0, offset=200.0), np.linspace(0.0, 0.01, 7)
    contact = fitact.Contact(1e-4, 1e-6, 3.9, 200e-6, 2000.0)
    whole = 2.0 * R + RI + RGAP
    factor = 8.85e-12 * 1e-4 / (2.0 * (1e-6 / 3.9 + 200e-6 / 2000.0) * 201e-6)
    with jax.enable_x64(True):
        assert float(fitact.mean_force(circuit, drive, contact)) == pytest.approx(factor * (200.0 * R / whole) ** 2)
        gap = fitact.Scene.from_dict({"gap": {"thickness": 2e-6}, "force": {"model": "gap"}}).geometry()
        expected = 8.85e-12 * 1e-4 * (200.0 * RGAP / whole) ** 2 / (2.0 * (8.85e-12 * 1e-4 / CGAP) ** 2)
        assert float(fitact.peak_force(circuit, drive, gap.contact(circuit))) == pytest.approx(expected, rel=1e-4)
        summed = fitact.harmonic_response(circuit, drive, time, 3)
        np.testing.assert_allclose(summed, fitact.response(circuit, drive, time), rtol=1e-12)


def exact_gain(values: list[mpmath.mpf], omega: mpmath.mpf) -> mpmath.mpc:
    Rsc, Csc, Ci, Ri, series = values
    s = 1j * omega
    skin, insulator = Rsc / (1 + s * Rsc * Csc), Ri / (1 + s * Ri * Ci)
    return skin / (2 * skin + insulator + series)


@pytest.mark.parametrize("with_resistance", [False, True])
def test_extremes_against_mpmath(with_resistance: bool):
    """Ri over 18 decades: H at both ends, its terms in between, and derivatives in the logarithms."""
    rng = np.random.default_rng(4)
    points = 10.0 ** rng.uniform([2, -11, -12, -3, 0], [7, -6, -6, 15, 8], (150, 5))
    points[:, 4] *= with_resistance
    omega = 2.0 * np.pi * 10.0 ** rng.uniform(-3, 7, len(points))

    def gains(logs: jax.Array, point: jax.Array, omega: jax.Array) -> jax.Array:
        Rsc, Csc, Ci, Ri, series = point * jnp.exp(logs)
        if with_resistance:
            circuit: Any = fitact.DirectGround(Rsc, Csc, Ci, R_H=series, Ri=Ri)
        else:
            circuit = fitact.FinalCircuit(Rsc, Csc, Ci, Ri=Ri)
        direct, fitted = circuit.transfer_function(omega), gain_at(circuit.terms(), omega)
        return jnp.stack([direct.real, direct.imag, fitted.real, fitted.imag])

    with jax.enable_x64(True):
        arguments = jnp.zeros(5), points, omega
        values = np.asarray(jax.jit(jax.vmap(gains, (None, 0, 0)))(*arguments))
        slopes = np.asarray(jax.jit(jax.vmap(jax.jacfwd(gains), (None, 0, 0)))(*arguments))
    assert np.all(np.isfinite(values))
    assert np.all(np.isfinite(slopes))
    with mpmath.workdps(60):
        for value, slope, point, w in zip(values, slopes, points, omega, strict=True):
            numbers, w = [mpmath.mpf(x) for x in point], mpmath.mpf(w)
            exact = complex(exact_gain(numbers, w))
            assert abs(complex(*value[:2]) - exact) <= 1e-14 * abs(exact)
            assert abs(complex(*value[2:]) - exact) <= 2e-10 * max(abs(exact), 1e-6)
            for k in range(4 + with_resistance):
                h = mpmath.mpf(10) ** -20
                up, down = (
                    exact_gain([x * (1 + side * h * (i == k)) for i, x in enumerate(numbers)], w) for side in (1, -1)
                )
                derivative = complex((up - down) / (2 * h))
                assert abs(complex(*slope[:2, k]) - derivative) <= 1e-13 * abs(exact)
                assert abs(complex(*slope[2:, k]) - derivative) <= 1e-8 * max(abs(exact), 1e-6)


def test_the_area_stays_unidentified_by_vsc():
    """All resistances, Ri among them, go as 1 / area: Vsc has d, g and b of four parameters; I has the scale."""
    circuit, free = fitact.FinalCircuit(R, C, CI, Ri=RI), ("Rsc", "Csc", "Ci", "Ri")
    found = blind_directions(circuit, free, ("Vsc",))
    assert len(found) == 1
    np.testing.assert_allclose(found[0], [-0.5, 0.5, 0.5, -0.5], atol=1e-6)
    assert "the contact area" in name_direction(dict(zip(free, found[0], strict=True)))
    assert len(blind_directions(circuit, free, ("Vsc", "I"))) == 0
    faint = blind_directions(fitact.FinalCircuit(R, C, CI, Ri=1e14), free, ("Vsc",))
    assert len(faint) == 1  # a leak of 100 Tohm shows at zero frequency


def test_what_cannot_have_a_leak_is_refused():
    with pytest.raises(fitact.InputError, match=r"a leak of the insulator \(Ri\) is not modelled with a fractional"):
        fitact.WithSkin(fitact.FinalCircuit(R, C, CI, Ri=RI), fitact.Fractional())
    empty = np.zeros(3)
    arrays = 0.0, 1.0, np.zeros((1, 4)), np.zeros((3, 4)), np.zeros((6, 3)), empty, empty, empty, empty, 3.0
    table = Compression(*map(np.asarray, (*arrays, np.zeros((0, 3)), 0.0, 1.0)))
    with pytest.raises(TypeError, match="this compression holds no V"):
        table.response(HighpassTerms((1.0,), (1.0,), None, 0.1))
