"""The bench of data_synth against closed forms, phasors and scipy.signal.lsim: what instruments do to each channel."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.signal

from data_synth import make, recipe, scene
from data_synth.bench import Bench
from data_synth.changing import make_course
from data_synth.errors import RecipeError

R, C, CI = 160e3, 22e-9, 1.35e-9
B = R * (2.0 * CI + C)
RS, STRAY = 20e3, 1e-10
STEP = 5e-6
RECORDS = Path(__file__).parents[2] / "data_synth" / "records"

needs_ngspice = pytest.mark.skipif(shutil.which("ngspice") is None, reason="ngspice is not installed")


def written(folder: Path, text: str = "", drive: str = "", measured: str = "") -> recipe.Recipe:
    """Return the recipe `text` of a scene without noise that records V, Vsc and I."""
    (folder / "scene.toml").write_text(
        f'[drive]\n{drive}\n[measurement]\nchannels = ["Vsc", "I"]\nnoise_Vsc = 0\nnoise_I = 0\n{measured}\n'
    )
    (folder / "some.recipe.toml").write_text(f'scene = "scene.toml"\n{text}')
    return recipe.load(folder / "some.recipe.toml")


def made(*given: Any) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the times and channels of `written`."""
    (found,) = make.make(written(*given)).values()
    return found.time, found.channels


def respond(tables: dict[str, Any], bench: Bench, time: np.ndarray, model: Any = None, route: str = "scipy") -> Any:
    return make.simulate_response(scene.make_scene(tables, {}, "scene"), time, model, route, None, bench)


def loop_polynomials(series: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return numerator and denominator of I / V of two skins, Ci and a `series` resistor."""
    above = np.array([R * C * CI, CI, 0.0])
    return above, np.polyadd([B, 1.0], series * above)


SINE = 'waveform = "sine"\nfrequency = "700 Hz"\npeak_to_peak = "300 V"\nphase = "30 deg"'
REST = 'waveform = "triangle"\nfrequency = "250 Hz"\nsteady_state = false'  # corners on the grid of samples


def circuit_gains(omega: float) -> dict[str, complex]:
    loop = 1j * omega * CI / (1.0 + 1j * omega * B)
    return {"V": 1.0, "Vsc": R * loop, "I": loop * (1.0 + 1j * omega * R * C)}


# ------------------------------------------------------------------ delay and bandwidth


def test_a_sine_through_delays_and_bandwidths(tmp_path: Path):
    """Each channel has a phasor of its own; an early channel has a negative delay."""
    delays, bandwidths = {"V": 0.0, "Vsc": 1.7e-6, "I": -3.2e-5}, {"V": 2e3, "Vsc": 5e4, "I": 300.0}
    text = '[delay]\nVsc = "1.7 us"\nI = "-32 us"\n[bandwidth]\nV = "2 kHz"\nVsc = "50 kHz"\nI = "300 Hz"\n'
    time, channels = made(tmp_path, text, SINE)
    omega = 2.0 * np.pi * 700.0
    for name, gain in circuit_gains(omega).items():
        whole = 150.0 * gain / (1.0 + 1j * 700.0 / bandwidths[name])
        expected = (whole * np.exp(1j * (omega * (time - delays[name]) + np.pi / 6.0))).imag
        np.testing.assert_allclose(channels[name], expected, atol=1e-10 * abs(whole))


def test_delays_shift_corners_by_a_fraction_of_a_step(tmp_path: Path):
    time, channels = made(tmp_path, '[delay]\nV = "1.3 us"', 'waveform = "triangle"\nfrequency = "90 Hz"')
    cycles = 90.0 * (time - 1.3e-6)
    np.testing.assert_allclose(channels["V"], 180.0 * scipy.signal.sawtooth(2 * np.pi * cycles + np.pi / 2, 0.5))


def test_noise_is_not_delayed(tmp_path: Path):
    """A delay changes the signal beneath the noise, and not the noise."""
    late, hum = '[delay]\nI = "2.5 us"\n', '[hum]\nI = "1 uA"\n[white]\nI = "1 uA"\n'
    (plain, noisy), (shifted, both) = (
        (made(tmp_path, text, SINE)[1]["I"] for text in texts) for texts in (("", hum), (late, late + hum))
    )
    np.testing.assert_allclose(noisy - plain, both - shifted, atol=1e-15)
    assert np.max(np.abs(shifted - plain)) > 1e-6


def test_bandwidths_of_a_triangle_from_rest(tmp_path: Path):
    """I has a jump at each corner, which the filter sees when it happens."""
    text = '[bandwidth]\nV = "3 kHz"\nVsc = "8 kHz"\nI = "20 kHz"\n'
    time, channels = made(tmp_path, text, REST)
    drive = made(tmp_path, "", REST)[1]["V"]
    above, below = loop_polynomials()
    for name, limit, circuit in (
        ("V", 3e3, ([1.0], [1.0])), ("Vsc", 8e3, ([R * CI, 0.0], below)), ("I", 20e3, (above, below))
    ):  # fmt: skip
        pole = [1.0 / (2.0 * np.pi * limit), 1.0]
        expected = scipy.signal.lsim((circuit[0], np.polymul(circuit[1], pole)), drive, time)[1]
        np.testing.assert_allclose(channels[name], expected, atol=1e-9 * np.ptp(expected))


def test_an_ideal_jump_is_a_finite_current_behind_a_filter(tmp_path: Path):
    """The impulse of charge q becomes q rate exp(-rate t) in an instrument of that rate."""
    time, channels = made(tmp_path, '[bandwidth]\nI = "100 kHz"', 'frequency = "250 Hz"')
    charge, rate = 360.0 * CI * C / (2.0 * CI + C), 2.0 * np.pi * 1e5
    first = (time > 0.0) & (time < 3e-5)
    expected = charge * rate * np.exp(-rate * time[first])
    np.testing.assert_allclose(channels["I"][first], expected, atol=2e-5)  # 10 uA flow through the skin
    assert np.max(expected) > 1e-4


# ------------------------------------------------------------------ stray capacitance, shunt, amplifier


@pytest.mark.parametrize(
    ("text", "measured", "expected"),
    [
        ('[stray]\ncapacitance = "100 pF"', "", STRAY),
        ('[truth.measurement]\nstray_capacitance = "100 pF"', 'stray_capacitance = "90 pF"', STRAY),
        ("", 'stray_capacitance = "100 pF"\ncurrent_lead = "ground"', 0.0),
        ('[shunt]\nV = "behind"', 'stray_capacitance = "100 pF"\nseries_resistor = "20 kohm"', STRAY),
    ],
    ids=["recipe", "truth", "ground lead", "before the shunt"],
)
def test_stray_current_of_a_triangle(text: str, measured: str, expected: float, tmp_path: Path):
    """The stray capacitance adds Cp dV/dt of the drive to I, and changes nothing else."""
    drive = 'waveform = "triangle"\nfrequency = "90 Hz"'
    time, channels = made(tmp_path, text, drive, measured)
    still = "\n".join(line for line in measured.splitlines() if "stray" not in line and "lead" not in line)
    plain = made(tmp_path, text if "shunt" in text else "", drive, still)[1]
    slope = 4.0 * 180.0 * 90.0 * np.where(np.mod(90.0 * time + 0.25, 1.0) < 0.5, 1.0, -1.0)
    np.testing.assert_allclose(channels["I"] - plain["I"], expected * slope, atol=1e-13)
    for name in ("V", "Vsc"):
        np.testing.assert_allclose(channels[name], plain[name], atol=1e-10)


def test_v_before_and_behind_a_shunt(tmp_path: Path):
    above, below = loop_polynomials(RS)
    time, before = made(tmp_path, "", REST, f"series_resistor = {RS}")
    behind = made(tmp_path, '[shunt]\nV = "behind"', REST, f"series_resistor = {RS}")[1]
    drive = made(tmp_path, "", REST)[1]["V"]
    np.testing.assert_allclose(before["V"], drive, atol=1e-10)
    current = scipy.signal.lsim((above, below), drive, time)[1]
    for found in (before["I"], behind["I"]):
        np.testing.assert_allclose(found, current, atol=1e-9 * np.ptp(current))
    voltage = scipy.signal.lsim(([B, 1.0], below), drive, time)[1]
    np.testing.assert_allclose(behind["V"], voltage, atol=1e-9 * np.ptp(voltage))
    assert np.max(np.abs(voltage - drive)) > 0.5


def test_an_amplifier_of_finite_bandwidth(tmp_path: Path):
    """Three squares from rest: V, Vsc and I by lsim with steps at samples."""
    drive = 'waveform = "burst"\nfrequency = "250 Hz"\ncycles = 3'
    time, channels = made(tmp_path, '[amplifier]\nbandwidth = "5 kHz"', drive)
    stated = 180.0 * np.where(time < 0.012, np.where(np.floor(time / 2e-3 + 1e-6) % 2 == 0, 1.0, -1.0), 0.0)
    stated[np.isclose(time, 0.012)] = 0.0
    pole = [1.0 / (2.0 * np.pi * 5e3), 1.0]
    above, below = loop_polynomials()
    for name, circuit in (("V", ([1.0], [1.0])), ("Vsc", ([R * CI, 0.0], below)), ("I", (above, below))):
        system = (circuit[0], np.polymul(circuit[1], pole))
        expected = scipy.signal.lsim(system, stated, time, interp=False)[1]
        np.testing.assert_allclose(channels[name], expected, atol=1e-9 * np.ptp(expected), err_msg=name)


def test_a_slewed_square_in_the_steady_state(tmp_path: Path):
    """A line of slope s through a pole of time T lags by s T; after it, the rest decays."""
    drive = 'waveform = "trapezoid"\nfrequency = "70 Hz"\nrise_time = "200 us"'
    time, channels = made(tmp_path, '[amplifier]\nbandwidth = "8 kHz"', drive)
    T, slope = 1.0 / (2.0 * np.pi * 8e3), 360.0 / 2e-4
    rise = time <= 2e-4
    expected = -180.0 + slope * (time - T * -np.expm1(-time / T))
    np.testing.assert_allclose(channels["V"][rise], expected[rise], atol=1e-9)
    after = (time > 2e-4) & (time < 1e-3)
    left = slope * T * -np.expm1(-2e-4 / T)
    np.testing.assert_allclose(channels["V"][after], 180.0 - left * np.exp(-(time[after] - 2e-4) / T), atol=1e-9)


def test_an_amplifier_acts_before_the_friction(tmp_path: Path):
    """Cross-talk in Ft is in proportion to the amplified drive, whatever V's own instrument."""
    text = (
        '[amplifier]\nbandwidth = "500 Hz"\n[bandwidth]\nV = "100 Hz"\n[friction]\ncrosstalk = 1\n[delay]\nFt = "1 ms"'
    )
    (tmp_path / "scene.toml").write_text(
        f'[drive]\n{SINE}\n[measurement]\nchannels = ["Ft"]\nnoise_Ft = 0\n[friction]\nnormal_force = 0\n'
    )
    (tmp_path / "some.recipe.toml").write_text(f'scene = "scene.toml"\n{text}\n')
    (found,) = make.make(recipe.load(tmp_path / "some.recipe.toml")).values()
    wave = 150.0 / (1.0 + 1.4j) * np.exp(1j * (2.0 * np.pi * 700.0 * (found.time - 1e-3) + np.pi / 6.0))
    np.testing.assert_allclose(found.channels["Ft"], wave.imag, atol=2e-3)  # the friction itself is below 1 mN


# ------------------------------------------------------------------ other skins and routes

LIMITED = Bench(5e3, {"V": 3e3, "Vsc": 8e3, "I": 2e4}, behind=True)
LOADED = {"series_resistor": RS, "stray_capacitance": STRAY}
TRAPEZOID = {"waveform": "trapezoid", "rise_time": "50 us"}


@pytest.mark.parametrize("skin", ["fractional", "nonlinear"])
def test_other_skins_have_the_same_bench(skin: str):
    """Skins of exponent 1 and of a very high half voltage are plain ones, computed by another method."""
    time, tables = np.arange(600) * 2e-5, {"drive": TRAPEZOID, "measurement": LOADED}
    model = {"model": "nonlinear", "half_voltage": 1e5} if skin == "nonlinear" else None
    other = tables | ({"skin": {"level": "fractional", "alpha": 1.0}} if model is None else {})
    for found, plain in zip(respond(other, LIMITED, time, model), respond(tables, LIMITED, time), strict=True):
        np.testing.assert_allclose(found, plain, atol=1e-7 * np.ptp(plain))


def test_a_fractional_skin_through_the_bench():
    time, omega = np.arange(200) * 2e-5, 2.0 * np.pi * 700.0
    tables = {"drive": {"waveform": "sine", "frequency": 700.0}, "measurement": LOADED}
    found = respond(tables | {"skin": {"level": "fractional", "alpha": 0.7}}, LIMITED, time)
    Z = R / (1.0 + (1j * omega * R * C) ** 0.7)
    loop = 1.0 / (RS + 2.0 * Z + 1.0 / (1j * omega * CI))
    gains = (1.0 - RS * loop) / (1.0 + 0.7j / 3.0), Z * loop / (1.0 + 0.7j / 8.0)
    gains = (*gains, (loop + 1j * omega * STRAY) / (1.0 + 0.035j))
    for values, gain in zip(found, gains, strict=True):
        expected = (180.0 * gain / (1.0 + 0.14j) * np.exp(1j * omega * time)).imag
        np.testing.assert_allclose(values, expected, atol=1e-9 * np.ptp(expected))


def test_a_changing_finger_has_a_stray_capacitance():
    time = np.arange(1000) * 2e-5
    change = {"time": None, "area": None, "Rsc": None, "Csc": None, "lifted": (8e-3, 12e-3)}
    change |= {"walk_area": 0.0, "walk_Rsc": 0.0, "walk_Csc": 0.0}
    course = make_course(change, (R, C, CI), 0.02, np.random.default_rng(0))
    with_stray, without = (
        make.simulate_response(
            scene.make_scene({"drive": {"waveform": "triangle"}, "measurement": part}, {}, "scene"),
            time, None, "scipy", course,
        )[2]
        for part in ({"stray_capacitance": STRAY}, {})
    )  # fmt: skip
    sign = np.where(np.mod(100.0 * time + 0.25, 1.0) < 0.5 - 1e-9, 1.0, -1.0)
    np.testing.assert_allclose(with_stray - without, STRAY * 72e3 * sign, atol=1e-13)


@needs_ngspice
def test_stray_and_shunt_against_ngspice():
    time, tables = np.arange(2000) * 1e-5 + 3.1e-6, {"drive": TRAPEZOID, "measurement": LOADED}
    ours, theirs = (respond(tables, Bench(behind=True), time, None, route) for route in ("scipy", "ngspice"))
    for found, expected in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-4 * np.ptp(expected))


# ------------------------------------------------------------------ noise of V and converters


def test_noise_of_v_is_stated_by_the_scene(tmp_path: Path):
    quiet, noisy = (made(tmp_path, "", SINE, measured)[1]["V"] for measured in ("", "noise_V = 0.5"))
    assert np.std(noisy - quiet) == pytest.approx(0.5, rel=4.0 / np.sqrt(2.0 * quiet.size))
    (found,) = make.make(written(tmp_path, "", SINE, "noise_V = 0.5")).values()
    assert found.truth["truth"]["noise_V"] == {"value": 0.5, "unit": "V"}


def test_converters_with_automatic_spans(tmp_path: Path):
    """The largest value is at 1 / 1.3 of the range; a stated span and stated bits go before."""
    text = '[converter]\nauto = true\nbits = 9\nbits_I = 6\nVsc = "40 V"\n'
    raw, read = (made(tmp_path, given, SINE)[1] for given in ("", text))
    for name, span, bits in (("V", 390.0, 9), ("Vsc", 40.0, 9), ("I", 2.6 * np.max(np.abs(raw["I"])), 6)):
        step = span / 2**bits
        levels = read[name] / step
        np.testing.assert_allclose(levels, np.round(levels), atol=1e-3, err_msg=name)
        assert np.min(np.diff(np.unique(np.round(levels)))) == 1.0
        assert 0.4 * step < np.max(np.abs(read[name] - raw[name])) <= 0.5001 * step
    top = np.max(np.round(read["I"] * 2**6 / (2.6 * np.max(np.abs(raw["I"])))))
    assert top == np.round(2**5 / 1.3)


# ------------------------------------------------------------------ refusals

CHANGE = '[change]\ntime = ["0 s", "10 ms"]\narea = [1.0, 1.3]\n'
BAD = {
    "stray twice": ('[stray]\ncapacitance = "100 pF"', 'stray_capacitance = "90 pF"', "[stray] repeats the scene's"),
    "stray in the ground lead": ('[stray]\ncapacitance = "100 pF"', 'current_lead = "ground"', "[stray] has no effect"),
    "shunt without resistor": ('[shunt]\nV = "behind"', "", "needs a [measurement] series_resistor"),
    "unknown lead": ("", 'current_lead = "red"', "is not a choice"),
    "negative bandwidth": ("[bandwidth]\nV = -1", "", "must be above 0"),
    "bandwidth of Ft": ("[bandwidth]\nFt = 100", "", "[bandwidth] Ft is not a key"),
    "amplifier of a changing finger": (f"{CHANGE}[amplifier]\nbandwidth = 100", "", "excludes [amplifier]"),
    "filter by ngspice": ('route = "ngspice"\n[bandwidth]\nI = 100', "", "not available with ngspice"),
    "stray of a changing finger by ngspice": (
        f'route = "ngspice"\n{CHANGE}[stray]\ncapacitance = "100 pF"',
        "",
        "[change] with stray capacitance is not available with ngspice",
    ),
    "one bit": ("[converter]\nbits_V = 1", "", "at least 2"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_refused(name: str, tmp_path: Path):
    text, measured, words = BAD[name]
    with pytest.raises(RecipeError) as error:
        make.make(written(tmp_path, text, 'waveform = "triangle"', measured))
    assert words in str(error.value)
    assert "\n" not in str(error.value)


# ------------------------------------------------------------------ shipped records

BENCHES = {  # step and span of each channel's converter
    "finger_bench": {"V": (0.1, 409.6), "I": (0.25e-6, 4.096e-3)},
    "bench_three": {"V": (0.02, 327.68), "Vsc": (2e-3, 32.768), "I": (1e-8, 163.84e-6)},
    "bench_multisine": {"V": (0.02, 327.68), "I": (2e-7, 3.2768e-3)},
}


def shipped(name: str) -> tuple[Path, dict[str, Any], np.ndarray]:
    truth = json.loads((RECORDS / f"{name}.json").read_text())
    path = RECORDS / truth["record"]
    return path, truth, np.loadtxt(path, delimiter=",", skiprows=1)


@pytest.mark.parametrize("name", BENCHES)
def test_shipped_records_of_a_bench(name: str):
    """They hold levels of converters that do not saturate, and the recipe makes them again."""
    _, truth, table = shipped(name)
    (again,) = make.make(recipe.load(RECORDS / f"{name}.recipe.toml")).values()
    assert list(again.channels) == list(BENCHES[name])
    assert again.truth["truth"] == truth["truth"]
    np.testing.assert_array_equal(table[:, 0], again.time)
    for (channel, (step, span)), values in zip(BENCHES[name].items(), table[:, 1:].T, strict=True):
        np.testing.assert_allclose(values / step, np.round(values / step), atol=1e-6)
        assert np.max(np.abs(values)) < 0.49 * span
        np.testing.assert_allclose(values, again.channels[channel], rtol=1e-8, atol=1e-6 * step)


def test_the_first_record_is_small_and_shows_the_skin():
    """Between the edges I crosses ten levels and more; every line is one that a converter could have written."""
    path, _, table = shipped("finger_bench")
    assert path.stat().st_size < 300_000
    assert all(len(field) <= 11 for line in path.read_text().splitlines()[1:] for field in line.split(","))
    time, V, current = table.T
    half = np.flatnonzero(np.diff(np.sign(V)))[:2]
    plateau = current[half[0] + 60 : half[1] - 60]  # 300 us beside each edge of 200 us
    assert np.ptp(plateau) > 10.0 * 0.25e-6
    assert time[-1] == pytest.approx(4.0 / 70.0, rel=1e-3)
