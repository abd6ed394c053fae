"""The routes of data_synth against closed forms, scipy's integrators, ngspice and fitact."""

import shutil
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.integrate
import scipy.signal

import fitact
from data_synth import keys, make, recipe, scene
from data_synth.changing import make_course
from data_synth.errors import RecipeError
from data_synth.network import network, state_space
from data_synth.response import frequency_response
from fitact.data.simulate import simulate

R, C, CI = 160e3, 22e-9, 1.35e-9
G, B = CI / (2.0 * CI + C), R * (2.0 * CI + C)

needs_ngspice = pytest.mark.skipif(shutil.which("ngspice") is None, reason="ngspice is not installed")


def scene_of(**tables: dict[str, Any]) -> scene.Scene:
    return scene.make_scene(tables, {}, "scene")


def respond(
    time: np.ndarray, model: dict[str, Any] | None = None, route: str = "scipy", **tables: dict[str, Any]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return make.simulate_response(scene_of(**tables), time, model, route)


def even(count: int = 2000, step: float = 1e-5) -> np.ndarray:
    return np.arange(count) * step


# ------------------------------------------------------------------ closed forms


def skin_gain(omega: np.ndarray | float, Z: Callable[..., Any]) -> Any:
    """Return Vsc / V of two skins Z in series with Ci."""
    return Z(omega) / (2.0 * Z(omega) + 1.0 / (1j * omega * CI))


def test_a_sine_in_the_steady_state():
    time, omega = even(), 2.0 * np.pi * 130.0
    voltage, vsc, current = respond(
        time, drive={"waveform": "sine", "peak_to_peak": 300.0, "frequency": 130.0, "phase": "30 deg", "offset": 7.0}
    )
    gain = 1j * omega * R * CI / (1.0 + 1j * omega * B)
    wave = 150.0 * np.exp(1j * (omega * time + np.pi / 6.0))
    np.testing.assert_allclose(voltage, 7.0 + wave.imag, atol=1e-11)
    np.testing.assert_allclose(vsc, (gain * wave).imag, atol=1e-10)
    np.testing.assert_allclose(current, (gain * (1.0 / R + 1j * omega * C) * wave).imag, atol=1e-14)


def test_a_square_in_the_steady_state():
    """Vsc decays from 360 g / (1 + e^{-T/2b}) after each edge; a sample at an edge holds the right limit."""
    time = even(3000)
    voltage, vsc, current = respond(time)
    since, sign = time % 5e-3, np.where(np.arange(3000) % 1000 < 500, 1.0, -1.0)
    since[np.isclose(since, 5e-3, atol=1e-12) | (since < 1e-12)] = 0.0
    np.testing.assert_array_equal(voltage, 180.0 * sign)
    np.testing.assert_allclose(vsc, sign * 360.0 * G / (1.0 + np.exp(-5e-3 / B)) * np.exp(-since / B), atol=1e-10)
    assert np.all(np.isnan(current) == (since == 0.0))  # an impulse, if nothing limits the current


@pytest.mark.parametrize("shape", ["square", "triangle"])
def test_a_burst_from_rest(shape: str):
    """scipy.signal.lsim of the transfer function, with the corners on the sampling grid."""
    time = even(4000)
    drive = {"waveform": "burst", "shape": shape, "frequency": 200.0, "cycles": 3}
    voltage, vsc, _ = respond(time, drive=drive)
    held = shape == "square"
    expected = scipy.signal.lsim(([R * CI, 0.0], [B, 1.0]), voltage, time, interp=not held)[1]
    np.testing.assert_allclose(vsc, expected, atol=1e-9)
    assert np.all(voltage[1500:] == 0.0)


@pytest.mark.parametrize("spacing", ["linear", "logarithmic"])
def test_a_chirp_from_rest(spacing: str):
    """Convolution with the exponential of the circuit by scipy's quadrature."""
    drive = {"waveform": "chirp", "start_frequency": 50.0, "end_frequency": 400.0, "sweep_time": 0.02}
    frequency = {
        "linear": lambda t: 50.0 + 350.0 * t / 0.02,
        "logarithmic": lambda t: 50.0 * 8.0 ** (t / 0.02),
    }[spacing]

    def voltage(t: float) -> float:
        cycles = scipy.integrate.quad(frequency, 0.0, t, epsrel=1e-12)[0]
        return 180.0 * np.sin(2.0 * np.pi * cycles) if t < 0.02 else 0.0

    def expected(t: float) -> float:
        end = min(t, 0.02)
        past = scipy.integrate.quad(lambda s: np.exp((s - t) / B) * voltage(s), 0.0, end, epsrel=1e-9, limit=200)[0]
        return G * (voltage(t) - past / B)

    time = np.array([3.3e-3, 11.1e-3, 19.9e-3, 23e-3])
    _, vsc, _ = respond(time, drive=drive | {"spacing": spacing})
    np.testing.assert_allclose(vsc, [expected(t) for t in time], atol=1e-6)


def test_several_tones():
    """Sum of the tones' responses from scipy.signal.freqs; its period is longer than that of any tone."""
    time, tones = even(), np.array([80.0, 120.0, 300.0])
    drive = {"waveform": "multitone", "frequencies": tones.tolist(), "amplitudes": [9.0, 5.0, 2.0], "phases": [0, 1, 2]}
    _, vsc, _ = respond(time, drive=drive)
    gains = scipy.signal.freqs([R * CI, 0.0], [B, 1.0], 2.0 * np.pi * tones)[1]
    waves = np.array([9.0, 5.0, 2.0]) * np.exp(1j * (2.0 * np.pi * np.outer(time, tones) + np.arange(3.0)))
    np.testing.assert_allclose(vsc, (waves @ gains).imag, atol=1e-10)


def test_the_order_of_samples_and_their_steps_do_not_matter():
    time = even()
    drawn = np.random.default_rng(0).permutation(2000)[:500]  # any subset
    drive = {"waveform": "trapezoid", "rise_time": "30 us", "duty": 0.3, "phase": 1.0}
    for all_of_it, some in zip(respond(time, drive=drive), respond(time[drawn], drive=drive), strict=True):
        np.testing.assert_allclose(some, all_of_it[drawn], rtol=1e-8, atol=1e-9)


LOOPS: dict[str, tuple[dict[str, Any], Callable[[complex], tuple[complex, complex]]]] = {
    "natural ground, Z with capacitance, series resistor": (
        {
            "grounding": {"connection": "natural", "Z": 14.5e6, "Z_capacitance": 1e-10},
            "measurement": {"series_resistor": 1e5},
        },
        lambda s: (R / (1.0 + s * R * C), 1e5 + 14.5e6 / (1.0 + s * 14.5e6 * 1e-10)),
    ),
    "natural ground, no Z at all": (
        {"grounding": {"connection": "natural", "Z": 0.0}},
        lambda s: (R / (1.0 + s * R * C), 0.0),
    ),
    "gap, probe, R_H, unequal skins": (
        {
            "gap": {"thickness": "5 um", "resistance": "1 Mohm"},
            "grounding": {"R_H": 500.0, "grounding_Rsc": 80e3, "grounding_Csc": 44.25e-9},
            "measurement": {"probe_resistance": 10e6, "probe_capacitance": 10e-12},
        },
        lambda s: (
            1.0 / (1.0 / R + 1.0 / 10e6 + s * (C + 10e-12)),
            500.0 + 80e3 / (1.0 + s * 80e3 * 44.25e-9) + 1e6 / (1.0 + s * 1e6 * 8.85e-12 * 1e-4 / 5e-6),
        ),
    ),
    "gap that does not conduct": (
        {"gap": {"capacitance": "2 nF"}},
        lambda s: (R / (1.0 + s * R * C), R / (1.0 + s * R * C) + 1.0 / (s * 2e-9)),
    ),
}


@pytest.mark.parametrize("name", LOOPS)
def test_circuits_by_their_impedances(name: str):
    tables, impedances = LOOPS[name]
    system = state_space(network(scene_of(**tables)))
    for omega in (20.0, 600.0, 3e5):
        touching, rest = impedances(1j * omega)
        current = 1.0 / (touching + rest + 1.0 / (1j * omega * CI))
        np.testing.assert_allclose(frequency_response(system, omega), (1.0, touching * current, current), rtol=1e-9)


# ------------------------------------------------------------------ skins


def test_two_layers_of_skin():
    time, omega = even(), 2.0 * np.pi * 100.0
    skin = {"model": "two layers", "Rsc_2": 20e3, "Csc_2": 50e-9}
    _, vsc, _ = respond(time, skin, drive={"waveform": "sine"})
    gain = skin_gain(omega, lambda w: R / (1.0 + 1j * w * R * C) + 20e3 / (1.0 + 1j * w * 20e3 * 50e-9))
    np.testing.assert_allclose(vsc, 180.0 * (gain * np.exp(1j * omega * time)).imag, atol=1e-9)


@pytest.mark.parametrize("alpha", [0.6, 1.0])
def test_a_fractional_skin(alpha: float):
    """Vsc and I of a triangle against its Fourier series, summed far beyond the harmonics that data_synth uses."""
    time = np.array([0.3e-3, 2.4e-3, 4.4e-3, 9.9e-3])
    drive, skin = {"waveform": "triangle"}, {"level": "fractional", "alpha": alpha}
    _, vsc, current = respond(time, drive=drive, skin=skin)
    n = np.arange(1, 400_001, 2)
    omega, sign = 2.0 * np.pi * 100.0 * n, np.where(n % 4 == 1, 1.0, -1.0)
    heights = 180.0 * 8.0 / np.pi**2 * sign / n**2
    Z = R / (1.0 + (1j * omega * R * C) ** alpha)
    gain = Z / (2.0 * Z + 1.0 / (1j * omega * CI))
    for at, voltage, amperes in zip(time, vsc, current, strict=True):
        wave = heights * gain * np.exp(1j * omega * at)
        assert voltage == pytest.approx(np.sum(wave).imag, abs=1e-5)
        assert amperes == pytest.approx(np.sum(wave / Z).imag, abs=1e-4 * np.ptp(current))


@pytest.mark.parametrize(("frequency", "values"), [(10.0, (200e3, 44.25e-9)), (1e3, (80e3, 8.85e-9))])
def test_a_dispersive_skin(frequency: float, values: tuple[float, float]):
    """Values of the paper at its frequencies."""
    time, omega = even(), 2.0 * np.pi * frequency
    _, vsc, _ = respond(time, drive={"waveform": "sine", "frequency": frequency}, skin={"level": "dispersive"})
    gain = skin_gain(omega, lambda w: values[0] / (1.0 + 1j * w * values[0] * values[1]))
    np.testing.assert_allclose(vsc, 180.0 * (gain * np.exp(1j * omega * time)).imag, atol=1e-9)


def test_a_fractional_skin_takes_no_jumps():
    with pytest.raises(RecipeError, match="rise time"):
        respond(even(), skin={"level": "fractional"})


def test_levels_of_frequency_have_no_transient():
    for level in ("fractional", "dispersive"):
        with pytest.raises(RecipeError, match="steady state"):
            respond(even(), skin={"level": level}, drive={"waveform": "sine", "steady_state": False})


TRAPEZOID = {"waveform": "trapezoid", "rise_time": "50 us"}


def test_a_nonlinear_skin_becomes_linear_at_small_voltages():
    skin = {"model": "nonlinear", "half_voltage": 1e5}
    time = even(1500)
    for bent, plain in zip(respond(time, skin, drive=TRAPEZOID), respond(time, drive=TRAPEZOID), strict=True):
        np.testing.assert_allclose(bent, plain, atol=1e-7 * np.ptp(plain))


def test_half_open_pores_are_a_smaller_resistance():
    """If the width of the transition is far above all voltages, half of the pores are always open."""
    skin = {"model": "electroporated", "threshold": 1e-3, "width": 1e9, "time_constant": 1e-3, "factor": 4.0}
    time = even(1500)
    found, wanted = respond(time, skin, drive=TRAPEZOID), respond(time, drive=TRAPEZOID, skin={"Rsc": R / 2.5})
    np.testing.assert_allclose(found[1], wanted[1], atol=1e-6)
    closed = respond(time, skin | {"width": 1e-3, "threshold": 1e3}, drive=TRAPEZOID)
    np.testing.assert_allclose(closed[1], respond(time, drive=TRAPEZOID)[1], atol=1e-6)


def test_pores_open_only_where_the_voltage_is_high():
    """A skin whose pores open above 10 V discharges faster; at lower voltages it does not change."""
    skin = {"model": "electroporated", "threshold": 10.0, "width": 0.1, "time_constant": 1e-4, "factor": 5.0}
    time = even(1500)
    low, high = {**TRAPEZOID, "peak_to_peak": 36.0}, TRAPEZOID
    np.testing.assert_allclose(respond(time, skin, drive=low)[1], respond(time, drive=low)[1], atol=1e-6)
    assert respond(time, skin, drive=high)[1][-1] < 0.8 * respond(time, drive=high)[1][-1]


# ------------------------------------------------------------------ ngspice

SPICE: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "direct ground, trapezoid": ({}, {"drive": TRAPEZOID}),
    "natural ground, triangle": (
        {},
        {
            "drive": {"waveform": "triangle"},
            "grounding": {"connection": "natural", "Z": 14.5e6, "Z_capacitance": 1e-10},
        },
    ),
    "everything in the loop, square from rest": (
        {},
        {
            "drive": {"steady_state": False, "offset": 50.0, "duty": 0.3},
            "gap": {"thickness": "5 um", "resistance": "1 Mohm"},
            "grounding": {"R_H": 500.0, "grounding_Rsc": 80e3, "grounding_Csc": 44.25e-9},
            "measurement": {"series_resistor": 1e5, "probe_resistance": 10e6, "probe_capacitance": 10e-12},
        },
    ),
    "gap that does not conduct": ({}, {"drive": TRAPEZOID, "gap": {"capacitance": "2 nF"}}),
    "burst of sines": ({}, {"drive": {"waveform": "burst", "shape": "sine", "frequency": 200.0, "cycles": 2}}),
    "two layers": ({"model": "two layers", "Rsc_2": 20e3, "Csc_2": 50e-9}, {"drive": TRAPEZOID}),
    "nonlinear": ({"model": "nonlinear", "half_voltage": 10.0}, {"drive": TRAPEZOID}),
}


@needs_ngspice
@pytest.mark.parametrize("name", SPICE)
def test_against_ngspice(name: str):
    model, tables = SPICE[name]
    time = even() + 3.1e-6  # next to the jumps, which take 1 ns in ngspice
    ours, theirs = (respond(time, model, route, **tables) for route in ("scipy", "ngspice"))
    for channel, (found, expected) in enumerate(zip(ours, theirs, strict=True)):
        smooth = channel == 2 and "sines" in name  # for a polygon, ngspice's current follows the steps of dV/dt
        np.testing.assert_allclose(found, expected, atol=(1e-2 if smooth else 1e-4) * np.ptp(expected))


@needs_ngspice
def test_what_ngspice_has_not():
    for model, tables in (
        ({"model": "electroporated"}, {}),
        ({}, {"skin": {"level": "fractional"}, "drive": TRAPEZOID}),
    ):
        with pytest.raises(RecipeError, match="route = 'scipy'"):
            respond(even(), model, "ngspice", **tables)


# ------------------------------------------------------------------ and fitact


UNREAD: set[str] = set()


def test_scenes_have_the_keys_and_defaults_that_fitact_reads():
    sections = {name: section for name, section in fitact.Scene() if name not in ("description", "calibration")}
    assert set(sections) == set(scene.KEYS)
    for name, section in sections.items():
        assert set(type(section).model_fields) <= set(scene.KEYS[name])
        for key, kind in scene.KEYS[name].items():
            if not isinstance(kind, keys.IgnoredKey) and key not in UNREAD:
                assert getattr(section, key) == keys.default_value(kind), (name, key)


SHIPPED = sorted(path.stem for path in (Path(fitact.__file__).parent / "scenes").glob("*.toml"))


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_scenes_give_what_fitact_simulates(name: str):
    """Records without noise from two models that share no code."""
    quiet = {"noise_Vsc": 0.0, "noise_I": 0.0}
    tables = tomllib.loads((Path(fitact.__file__).parent / "scenes" / f"{name}.toml").read_text())
    tables["measurement"] = tables.get("measurement", {}) | quiet
    theirs = simulate(fitact.Scene.from_dict(tables | {"measurement": tables["measurement"] | {"noise_V": 0.0}}))
    ours = dict(zip(["V", "Vsc", "I"], respond(theirs.time, **tables), strict=True))
    for channel, values in theirs.channels.items():
        np.testing.assert_allclose(ours[channel], values, atol=1e-10 * np.ptp(values))


CHANGE = {
    "time": (0.0, 4e-3, 2e-2), "area": (1.0, 1.3, 0.8), "Rsc": (1.0, 0.6, 0.9), "Csc": (1.0, 1.2, 1.1),
    "walk_area": 0.0, "walk_Rsc": 0.0, "walk_Csc": 0.0, "lifted": (8e-3, 12e-3),
}  # fmt: skip
TRAPEZOID = {"waveform": "trapezoid", "rise_time": "200 us"}


def changing(at: np.ndarray, route: str, waveform: dict[str, Any], **change: Any) -> tuple[np.ndarray, ...]:
    course = make_course(CHANGE | change, (R, C, CI), 0.02, np.random.default_rng(0))
    return make.simulate_response(scene_of(drive=waveform), at, None, route, course)


@needs_ngspice
def test_changing_finger_equals_ngspice_with_changing_parts():
    time = even(1000, 2e-5)
    ours, theirs = (changing(time, route, TRAPEZOID) for route in ("scipy", "ngspice"))
    assert np.max(np.abs(ours[1] - theirs[1])) < 2e-3 * np.ptp(ours[1])
    # at corners of the drive and of Ci, ngspice takes steps of the current over a few time steps
    difference = np.abs(ours[2] - theirs[2]) / np.ptp(ours[2])
    assert np.quantile(difference, 0.8) < 1e-5


@pytest.mark.parametrize("waveform", [TRAPEZOID, {"waveform": "sine"}], ids=["trapezoid", "sine"])
def test_finger_that_does_not_change_is_the_usual_one(waveform):
    time = even()
    still = changing(time, "scipy", waveform, time=None, area=None, Rsc=None, Csc=None, lifted=())
    usual = make.simulate_response(scene_of(drive=waveform), time)
    for ours, theirs in zip(still, usual, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=2e-6 * np.ptp(theirs))


def test_changing_finger_solves_the_equation_of_its_charges():
    time = even()
    course = make_course(CHANGE | {"lifted": ()}, (R, C, CI), 0.02, np.random.default_rng(0))
    drive = make.make_drive(scene_of(drive=TRAPEZOID)["drive"])

    def change(at: float, y: np.ndarray) -> np.ndarray:
        Rsc, Csc, Ci = course.values(np.array(at))
        return -(y + Ci * drive.value(np.array(at))) / (Rsc * (Csc + 2.0 * Ci))

    _, Csc, Ci = course.values(time)
    V, Vsc, current = make.simulate_response(scene_of(drive=TRAPEZOID), time, None, "scipy", course)
    start = (Csc[0] + 2.0 * Ci[0]) * Vsc[0] - Ci[0] * V[0]
    solved = scipy.integrate.solve_ivp(
        change, (0.0, time[-1]), [start], t_eval=time, rtol=1e-9, atol=1e-16, max_step=5e-5
    ).y[0]
    np.testing.assert_allclose(Vsc, (solved + Ci * V) / (Csc + 2.0 * Ci), atol=1e-5 * np.ptp(Vsc))
    # the current charges Ci: its integral is the change of the charge Ci (V - 2 Vsc)
    V, Vsc, current = make.simulate_response(scene_of(drive={"waveform": "sine"}), time, None, "scipy", course)
    charge = Ci * (V - 2.0 * Vsc)
    flown = scipy.integrate.cumulative_trapezoid(current, time, initial=0.0)
    np.testing.assert_allclose(flown, charge - charge[0], atol=3e-4 * np.ptp(charge))


def test_change_is_refused_with_other_elements(tmp_path: Path):
    (tmp_path / "scene.toml").write_text('[grounding]\nR_H = "500 ohm"\n')
    path = tmp_path / "slide.recipe.toml"
    path.write_text('scene = "scene.toml"\n[change]\ntime = ["0 s", "1 s"]\narea = [1.0, 1.3]\n')
    with pytest.raises(RecipeError, match=r"\[change\] needs two equal skins"):
        recipe.load(path)


def test_truth_of_a_recipe_holds_the_course(tmp_path: Path):
    (tmp_path / "scene.toml").write_text(
        '[drive]\nwaveform = "trapezoid"\nrise_time = "200 us"\n[measurement]\nduration = "0.1 s"\n'
    )
    path = tmp_path / "slide.recipe.toml"
    path.write_text('scene = "scene.toml"\n[change]\ntime = ["0 s", "0.1 s"]\narea = [1.0, 1.3]\n')
    (made,) = make.make(recipe.load(path)).values()
    course = made.truth["course"]
    assert course["Ci"][-1] == pytest.approx(1.3 * CI, rel=1e-3)
    assert len(course["time_s"]) == len(course["Rsc"]) == 301
