import functools
import math
import re
from pathlib import Path

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import fitact
from fitact import units
from fitact.data.simulate import simulate
from fitact.scene.prior_predictive import prior_predictive
from fitact.scene.section import field_unit
from fitact.scene.toml import shipped_scenes, value_text

CONTRACT = """
[device]
Ci = "1.35 nF"
insulator_thickness = "1 um"
insulator_permittivity = 3.9
contact_area = "1 cm^2"
[skin]
Rsc = "160 kohm"
Csc = "22 nF"
thickness = "200 um"
level = "constant"
[grounding]
connection = "direct"
R_H = "500 ohm"
grounding_Rsc = "80 kohm"
grounding_Csc = "44.25 nF"
Z = "14.5 Mohm"
[drive]
waveform = "trapezoid"
peak_to_peak = "360 V"
frequency = "100 Hz"
rise_time = "20 us"
steady_state = true
[measurement]
channels = ["Vsc"]
series_resistor = "0 ohm"
probe_resistance = "10 Mohm"
probe_capacitance = "10 pF"
sampling_rate = "200 kHz"
duration = "20 ms"
noise_Vsc = "0.1 V"
noise_I = "20 nA"
gain_relative_sd = 0.0
[friction]
coefficient = 0.5
normal_force = "0.5 N"
[prior]
Rsc = {median = "130 kohm", factor = 3}
Csc = {low = "8.85 nF", high = "44.25 nF"}
Ci  = {median = "1.35 nF", relative_sd = 0.05}
[force]
model = "paper"
[perception]
friction_change = 0.1
[population]
contact_area = "common"
[tolerance]
force = 0.01
"""

BURST = """
[drive]
waveform = "burst"
shape = "sine"
cycles = 3
phase = "90 deg"
offset = "5 V"
"""
CHIRP = """
[drive]
waveform = "chirp"
start_frequency = "10 Hz"
end_frequency = "1 kHz"
sweep_time = "0.5 s"
spacing = "logarithmic"
"""
TONES = """
[drive]
waveform = "multitone"
frequencies = ["100 Hz", "250 Hz", "1 kHz"]
amplitudes = ["36 V", 40, "5 V"]
phases = ["0 deg", "45 deg", 1.0]
offset = "-3 V"
"""
NATURAL = '[grounding]\nconnection = "natural"\nZ = "14.5 Mohm"\n'
BELIEFS = """
[grounding]
R_H = "500 ohm"
[prior]
Rsc = {low = "10 kohm", high = "1 Mohm", scale = "log"}
Csc = {factor = 3, high = "50 nF", above = "Ci"}
Ci = {nominal = "1.3 nF", tolerance = "10 %"}
R_H = {fixed = true}
grounding_Rsc = {tied = "Rsc", ratio = 2}
grounding_Csc = {table = "paper"}
sigma = {factor = 2}
[prior.correlation]
Rsc-Csc = -0.6
"""


def load(tmp_path: Path, text: str) -> fitact.Scene:
    path = tmp_path / "scene.toml"
    path.write_text(text)
    return fitact.Scene.load(path)


def test_every_key_of_the_contract_is_read(tmp_path: Path):
    scene = load(tmp_path, CONTRACT)
    assert scene.grounding.Z == 14.5e6
    assert scene.drive.rise_time == 20e-6
    assert scene.measurement.noise_I == 20e-9
    assert scene.device.contact_area == 1e-4
    prior = scene.make_prior()
    assert isinstance(prior["Csc"], fitact.Uniform)
    assert prior["Rsc"] == fitact.LogNormal.within_factor(130e3, 3.0)


def test_empty_file_is_the_nominal_scene(tmp_path: Path):
    scene = load(tmp_path, "")
    assert scene == fitact.Scene()
    assert (scene.skin.Rsc, scene.skin.Csc, scene.device.Ci) == (160e3, 22e-9, 1.35e-9)
    assert (scene.drive.peak_to_peak, scene.drive.frequency, scene.drive.waveform) == (360.0, 100.0, "square")


def test_default_skin_prior_reaches_published_whole_skin_values():
    prior = fitact.Scene().make_prior()
    for Rsc, Csc in [(10e3, 5e-9), (4.3e3, 200e-9), (80e3, 44.25e-9), (200e3, 8.85e-9)]:
        assert 160e3 / 50 < Rsc < 160e3 * 50
        assert abs(math.log(Rsc) - prior["Rsc"].log_mean) < 2.0 * prior["Rsc"].log_sd
        assert abs(math.log(Csc) - prior["Csc"].log_mean) < 2.0 * prior["Csc"].log_sd


def test_every_form_of_belief_is_read(tmp_path: Path):
    scene = load(tmp_path, BELIEFS)
    prior = scene.make_prior()
    assert prior.names == ("Rsc", "Csc", "Ci", "grounding_Csc", "sigma")
    assert prior["Rsc"] == fitact.LogUniform(10e3, 1e6)
    assert prior["Csc"] == fitact.TruncatedLogNormal(22e-9, math.log(3.0) / 1.959963984540054, 0.0, 50e-9)
    assert (prior["Ci"].low, prior["Ci"].high) == pytest.approx((1.17e-9, 1.43e-9))
    assert (prior["grounding_Csc"].low, prior["grounding_Csc"].high) == pytest.approx((8.85e-9, 44.25e-9))
    assert prior["sigma"].median == 0.1
    assert prior.correlation[0, 1] == -0.6
    assert scene.fixed_values() == {"R_H": 500.0}
    assert scene.prior.ties() == {"grounding_Rsc": ("Rsc", 2.0)}
    assert prior.order_constraints == scene.prior.order_constraints() == (("Ci", "Csc"),)
    scene.require_available(fit=True)


def test_order_alone_keeps_the_default_density(tmp_path: Path):
    scene = load(tmp_path, '[prior]\nCsc = {above = "Ci"}')
    assert scene.make_prior()["Csc"] == fitact.Scene().make_prior()["Csc"]
    assert scene.prior.order_constraints() == (("Ci", "Csc"),)


@pytest.mark.parametrize(
    ("table", "frequency", "Rsc", "Csc"),
    [
        # whole-skin values for 1 cm^2 and 200 um that the default prior must cover
        ("gabriel-dry", 100.0, 10e3, 5e-9),
        ("gabriel-wet", 100.0, 4.3e3, 200e-9),
        # conductivity (S/m) and permittivity in table 3 of doi:10.1186/s12938-018-0473-9, which quotes Gabriel
        ("gabriel-dry", 1e5, 2.0 / 0.00045, 1119.2 * 4.425e-12),
        ("gabriel-wet", 1e5, 2.0 / 0.0658, 15357 * 4.425e-12),
        ("gabriel-dry", 1e6, 2.0 / 0.0132, 990.76 * 4.425e-12),
        ("gabriel-wet", 1e6, 2.0 / 0.2214, 1832.8 * 4.425e-12),
    ],
)
def test_published_tables(tmp_path: Path, table: str, frequency: float, Rsc: float, Csc: float):
    text = f'[prior]\nRsc = {{table = "{table}"}}\nCsc = {{table = "{table}"}}\n[drive]\nfrequency = {frequency}\n'
    prior = load(tmp_path, text).make_prior()
    assert prior["Rsc"].median == pytest.approx(Rsc, rel=0.01)
    assert prior["Csc"].median == pytest.approx(Csc, rel=1e-3 if frequency > 100.0 else 0.02)
    wider = load(tmp_path, text + '[device]\ncontact_area = "2 cm^2"\n[skin]\nthickness = "400 um"').make_prior()
    assert wider["Csc"].median == pytest.approx(prior["Csc"].median)
    wider = load(tmp_path, text + '[device]\ncontact_area = "2 cm^2"').make_prior()
    assert wider["Rsc"].median == pytest.approx(0.5 * prior["Rsc"].median)


def test_circuit_at_other_values(tmp_path: Path):
    scene = fitact.Scene()
    assert scene.make_circuit({"Rsc": 1e5}) == fitact.FinalCircuit(1e5, 22e-9, 1.35e-9)
    assert scene.make_circuit({"R_H": 500.0}) == fitact.DirectGround(160e3, 22e-9, 1.35e-9, 500.0)


def measuring(**measurement: object) -> fitact.Scene:
    return fitact.Scene.from_dict({"measurement": {"channels": ["Vsc", "I"]} | measurement})


STRAY_SPEC = {"median": "100 pF", "relative_sd": 0.1}


def test_noise_of_V_is_stated_or_that_of_12_bits_over_the_swing():
    assert measuring(noise_V="50 mV").noise_V() == 0.05
    assert measuring(noise_V=0.0).noise_V() == 0.0
    for drive in ({"offset": "50 V"}, {"waveform": "measured"}, {"waveform": "burst", "shape": "sine"}):
        scene = fitact.Scene.from_dict({"drive": drive | {"peak_to_peak": "300 V"}})
        assert scene.noise_V() == pytest.approx(300.0 / 4096 / math.sqrt(12.0), rel=1e-12)
    tones = {"waveform": "multitone", "frequencies": [100.0, 300.0], "amplitudes": [90.0, 10.0], "offset": 20.0}
    swing = 2.0 * np.max(90.0 * np.sin(t := np.linspace(0.0, 2.0 * np.pi, 100_001)) + 10.0 * np.sin(3.0 * t))
    found = fitact.Scene.from_dict({"drive": tones}).noise_V()
    assert found == pytest.approx(swing / 4096 / math.sqrt(12.0), rel=1e-5)


def test_stray_capacitance_is_a_value_a_distribution_or_absent():
    absent, zero, known = measuring(), measuring(stray_capacitance=0.0), measuring(stray_capacitance="100 pF")
    assert [each.stray_capacitance() for each in (absent, zero, known)] == [0.0, 0.0, 1e-10]
    assert [each.states_stray_capacitance() for each in (absent, zero, known)] == [False, True, True]
    assert "stray_capacitance" not in known.make_prior().names
    uncertain = measuring(stray_capacitance=STRAY_SPEC)
    assert uncertain.stray_capacitance() == 1e-10
    assert uncertain.make_prior()["stray_capacitance"] == fitact.LogNormal.with_relative_sd(1e-10, 0.1)
    for other in ({"current_lead": "ground"}, {"channels": ["Vsc"]}):
        assert "stray_capacitance" not in measuring(stray_capacitance=STRAY_SPEC, **other).make_prior().names
    assert measuring(stray_capacitance="100 pF", current_lead="ground").stray_capacitance() == 0.0
    assert fitact.Scene.from_json(uncertain.to_json()) == uncertain


def test_prior_of_the_stray_capacitance_overrules_the_distribution_that_is_simulated():
    content = {"measurement": {"channels": ["I"], "stray_capacitance": STRAY_SPEC}}
    scene = fitact.Scene.from_dict(content | {"prior": {"stray_capacitance": {"median": "80 pF", "factor": 2}}})
    assert scene.make_prior()["stray_capacitance"] == fitact.LogNormal.within_factor(80e-12, 2.0)
    assert scene.stray_capacitance() == 1e-10
    around = fitact.Scene.from_dict(content | {"prior": {"stray_capacitance": {"relative_sd": 0.3}}})
    assert around.make_prior()["stray_capacitance"] == fitact.LogNormal.with_relative_sd(1e-10, 0.3)
    only = {"measurement": {"channels": ["I"]}, "prior": {"stray_capacitance": {"median": "80 pF", "factor": 2}}}
    assert fitact.Scene.from_dict(only).stray_capacitance() == pytest.approx(80e-12)
    # the loop, its prior predictive and its designs are those without it
    assert prior_predictive(scene, 20).parameters["stray_capacitance"].shape == (20,)
    assert scene.make_circuit() == fitact.Scene().make_circuit()


@pytest.mark.parametrize(
    ("measurement", "spec", "message"),
    [
        ({}, STRAY_SPEC, "needs 'I' among [measurement] channels"),
        ({"channels": ["I"], "current_lead": "ground"}, STRAY_SPEC, "needs [measurement] current_lead = 'drive'"),
        ({"channels": ["I"]}, {"fixed": "100 pF"}, "state its value as [measurement] stray_capacitance"),
        ({"channels": ["I"]}, {"factor": 2}, "needs a median"),
    ],
)
def test_prior_of_a_stray_capacitance_that_no_channel_contains(measurement, spec, message):
    with pytest.raises(fitact.InputError, match=re.escape(message)):
        fitact.Scene.from_dict({"measurement": measurement, "prior": {"stray_capacitance": spec}})


def test_calibration_record_without_the_finger():
    scene = fitact.Scene.from_dict({"calibration": [{"record": "open.csv", "circuit": "open"}]})
    assert scene.calibration[0].circuit == "open"
    assert fitact.Scene.from_json(scene.to_json()) == scene
    for circuit in ("closed", {"Rsc": {"nominal": 1.0, "tolerance": 0.1}}):
        with pytest.raises(fitact.InputError, match="circuit lacks"):
            fitact.Scene.from_dict({"calibration": [{"record": "open.csv", "circuit": circuit}]})


def test_Ci_from_the_layer_only_where_it_is_absent(tmp_path: Path):
    layer = 'insulator_thickness = "1 um"\ninsulator_permittivity = 3.9\n'
    assert load(tmp_path, "[device]\n" + layer).device.Ci == pytest.approx(3.4515e-9)
    assert load(tmp_path, '[device]\nCi = "2 nF"\n' + layer).device.Ci == 2e-9
    assert load(tmp_path, '[device]\ninsulator_thickness = "2 um"\n').device.Ci == 1.35e-9


def test_round_trip(tmp_path: Path):
    for text in (
        CONTRACT,
        BELIEFS,
        "",
        '[drive]\nwaveform = "measured"\n',
        BURST,
        CHIRP,
        TONES,
        *shipped_scenes().values(),
    ):
        scene = load(tmp_path, text)
        printed = load(tmp_path, str(scene))
        assert printed == scene
        assert str(printed) == str(scene)
        assert printed.to_json() == scene.to_json()  # keys that were not given are still not given
        again = fitact.Scene.from_json(scene.to_json())
        assert again == scene
        assert again.to_json() == scene.to_json()
        assert again.states_waveform() == scene.states_waveform()


@given(st.floats(1e-15, 1e15), st.sampled_from(["ohm", "F", "V", "m", "m^2", "Hz", "s", "rad", ""]))
def test_quantities_are_written_to_their_last_digit(value: float, unit: str):
    value = units.parse_quantity(value, unit)
    assert units.parse_quantity(units.format_exact(value, unit), unit) == value


def test_quantities_are_written_as_people_do():
    written = [
        units.format_exact(*quantity) for quantity in ((160e3, "ohm"), (1.35e-9, "F"), (1e-6, "m"), (1e-4, "m^2"))
    ]
    assert written == ["160 kohm", "1.35 nF", "1 um", "0.0001 m^2"]


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ('[drive]\nwaveform = "sine"\nfrequency = 5\nduty = 0.3', 4),  # the error concerns the section as a whole
        ('[skin]\nlevel = "constant"\n[device]\nlevel = 1', 4),  # the same key in another section
        ('[prior]\nCi = {fixed = true}\nRsc = {factor = 3, hihg = "1 Mohm"}', 3),
        ("drive.frequency = 1\ndrive.duty = 3", 2),
        ("[prior]\nRsc = {factor = 3}\n[prior.correlation]\nRsc-Csc = -1.6", 4),
        ('[grounding]\nconnection = "direct"\n\n[prior]\n# Z = 1\nZ = {factor = 2}', 6),
    ],
)
def test_line_of_what_is_wrong(tmp_path: Path, text: str, line: int):
    with pytest.raises(fitact.InputError, match=f"scene.toml, line {line}: "):
        load(tmp_path, text)


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ('[device]\nCj = "1 nF"', ["[device]", "Cj"]),
        ("[skn]\n", ["skn", "skin"]),
        ('[drive]\nfrequncy = "1 Hz"', ["frequncy", "frequency"]),
        ('[device]\nCi = "1 nV"', ["[device] Ci", "1 nV", "F"]),
        ('[device]\nCi = "much"', ["[device] Ci", "much"]),
        ('[device]\nCi = "-1 nF"', ["[device] Ci", "greater than 0"]),
        ("[device]\nCi = nan", ["[device] Ci", "finite"]),
        ("[device]\nCi = true", ["[device] Ci"]),
        ('[drive]\nwaveform = "sqare"', ["[drive] waveform", "sqare", "did you mean 'square'"]),
        ('[drive]\nwaveform = "trapezoid"', ["[drive]", "rise_time"]),
        ('[drive]\nrise_time = "1 us"', ["[drive]", "rise_time"]),
        ('[drive]\nwaveform = "trapezoid"\nrise_time = "6 ms"', ["[drive]", "shorter"]),
        ('[drive]\nwaveform = "sine"\nduty = 0.3', ["duty", "sine"]),
        ('[drive]\nphase = "1 m"', ["[drive] phase", "rad"]),
        ('[drive]\nwaveform = "measured"\nphase = 1', ["phase", "measured"]),
        ("[drive]\ncycles = 3", ["cycles", "burst", "square"]),
        ('[drive]\nwaveform = "burst"\ncycles = 0', ["[drive] cycles", "1"]),
        ('[drive]\nwaveform = "burst"\ncycles = 2.5', ["[drive] cycles", "integer"]),
        ('[drive]\nwaveform = "burst"\nshape = "sine"\nduty = 0.3', ["duty", "square"]),
        ('[drive]\nwaveform = "burst"\nsteady_state = true', ["burst", "steady_state"]),
        (TONES + "peak_to_peak = 3", ["peak_to_peak", "multitone"]),
        (TONES + 'frequency = "1 Hz"', ["frequency", "multitone"]),
        ('[drive]\nwaveform = "multitone"\nfrequencies = ["1 Hz"]', ["frequencies and amplitudes"]),
        (TONES.replace('"5 V"', '"5 V", "6 V"'), ["amplitudes has 4 values for 3"]),
        (TONES.replace("250 Hz", "1 kHz"), ["frequencies must differ"]),
        (TONES.replace("250 Hz", "250.1 Hz"), ["multiples", "0.1 Hz"]),
        (TONES.replace("36 V", "-36 V"), ["[drive] amplitudes", "greater than 0"]),
        ("[device]\ninsulator_permittivity = 0.9", ["insulator_permittivity", "1"]),
        ("[prior]\nZ_capacitance = {factr = 3}", ["Z_capacitance.factr", "did you mean 'factor'"]),
        ("device = 3", ["[device]", "table"]),
        ('[measurement]\nchannels = ["Vsk"]', ["[measurement] channels", "did you mean 'Vsc'"]),
        ('[drive]\nwaveform = "chirp"\nstart_frequency = "1 Hz"', ["end_frequency"]),
        ('[drive]\nwaveform = "chirp"\nfrequency = "1 Hz"', ["frequency", "chirp"]),
        ("[prior]\nRsc = {factor = 0.5}", ["[prior] Rsc.factor", "1"]),
        ('[prior]\nRsc = {median = "1 V", factor = 2}', ["[prior] Rsc", "ohm"]),
        ('[prior]\nRsc = {low = "2 ohm", high = "1 ohm"}', ["[prior] Rsc", "low"]),
        ("[prior]\nRsc = {factor = inf}", ["[prior] Rsc.factor"]),
        ("[prior]\nRsc = {relative_sd = 1e300}", ["[prior] Rsc.relative_sd"]),
        ("[friction]\ncoefficient = inf", ["[friction] coefficient"]),
        ("[prior]\nRsc = {median = 3}", ["[prior] Rsc", "factor"]),
        ("[device", ["TOML"]),
        ('[prior]\nCi = {tolerance = "10 V"}', ["[prior] Ci", "number"]),
        ("[prior]\nCi = {tolerance = 1.5}", ["[prior] Ci.tolerance", "less than 1"]),
        ('[prior]\nCi = {table = "paper"}', ["[prior] Ci", "table", "grounding_Rsc"]),
        ('[prior]\nRsc = {table = "gabriel"}', ["[prior] Rsc.table", "gabriel-dry"]),
        ('[prior]\nRsc = {factor = 3, low = "80 Mohm"}', ["[prior] Rsc", "median"]),
        ("[prior]\nRsc = {factor = 3, tolerance = 0.1}", ["[prior] Rsc", "{tied}"]),
        ("[prior]\nCi = {fixed = false}", ["[prior] Ci", "true"]),
        ('[prior]\nCi = {fixed = "1 V"}', ["[prior] Ci", "F"]),
        ("[prior]\nR_H = {fixed = true}", ["[prior] R_H", "scene has no R_H"]),
        ("[prior]\nR_H = {factor = 2}", ["[prior] R_H", "median"]),
        ("[prior]\nZ = {factor = 2}", ["[prior] Z", "natural"]),
        (NATURAL + "[prior]\nR_H = {factor = 2}", ["[prior] R_H", "direct"]),
        ("[prior]\nsigma_I = {factor = 2}", ["[prior] sigma_I", "channels"]),
        ('[prior]\ngrounding_Rsc = {tied = "Csc"}', ["[prior] grounding_Rsc", "ohm", "F"]),
        ('[prior]\nRsc = {tied = "Rsc"}', ["[prior] Rsc", "other"]),
        (NATURAL + '[prior]\nRsc = {tied = "Z"}\nZ = {tied = "Rsc"}', ["tied itself"]),
        ('[prior]\nCi = {fixed = true, below = "Csc"}', ["[prior] Ci", "below", "fixed"]),
        ('[prior]\nCi = {fixed = true}\nCsc = {above = "Ci"}', ["Ci", "free"]),
        ('[prior]\nR_H = {below = "Rsc"}', ["[prior] R_H", "density"]),
        ('[prior]\nCsc = {above = "Ci"}\nCi = {above = "Csc"}', ["order", "Csc < Ci < Csc"]),
        ('[measurement]\nchannels = ["Ft"]', ["the friction alone", "add Vsc or I"]),
        (
            '[perception]\nthreshold_force = "1 mN"\nfriction_change = 0.1',
            ["threshold_force and friction_change", "leave out the others"],
        ),
        ("[prior.correlation]\nRsc-Csc = -1.6", ["correlation", "-1"]),
        ("[prior.correlation]\nRsc-R_H = 0.5", ["[prior]", "R_H", "free"]),
        ("[prior.correlation]\nRsc = 0.5", ["correlation", "Rsc-Csc"]),
        ("[prior.correlation]\nRsc-Csc = 0.5\nCsc-Rsc = 0.4", ["Csc-Rsc", "once"]),
        ("[prior.correlation]\nRsc-Csc = -0.9\nCsc-Ci = -0.9\nRsc-Ci = -0.9", ["positive definite"]),
    ],
)
def test_what_is_not_understood_is_refused_by_name(tmp_path: Path, text: str, names: list[str]):
    with pytest.raises(fitact.InputError) as error:
        load(tmp_path, text)
    message = str(error.value)
    assert "scene.toml" in message
    assert "\n" not in message
    for name in names:
        assert name in message


def test_circuit_is_the_simplest_that_has_what_the_scene_names(tmp_path: Path):
    assert type(fitact.Scene().make_circuit()) is fitact.FinalCircuit
    direct = load(tmp_path, '[grounding]\nR_H = "500 ohm"\n[measurement]\nseries_resistor = "100 kohm"').make_circuit()
    assert isinstance(direct, fitact.DirectGround)
    assert (direct.R_H, direct.series_resistor, direct.grounding_Rsc, direct.probe) == (500.0, 100e3, None, None)
    probed = load(tmp_path, '[measurement]\nprobe_capacitance = "10 pF"').make_circuit()
    assert (math.inf, 10e-12) == (probed.probe.R, probed.probe.C)
    assert np.isfinite(abs(probed.transfer_function(600.0)))
    natural = load(tmp_path, '[grounding]\nconnection = "natural"\nZ = "14.5 Mohm"').make_circuit()
    assert isinstance(natural, fitact.NaturalGround)
    assert natural.Z == 14.5e6
    dispersive = load(tmp_path, '[skin]\nlevel = "dispersive"\n[grounding]\nR_H = "500 ohm"').make_circuit()
    assert isinstance(dispersive.skin, fitact.Dispersive)
    assert dispersive.circuit.R_H == 500.0
    assert load(tmp_path, '[skin]\nlevel = "fractional"').make_circuit().skin.alpha == 0.8
    assert load(tmp_path, '[skin]\nlevel = "fractional"\nalpha = 0.7').make_circuit().skin.alpha == 0.7
    with pytest.raises(fitact.InputError, match=r"alpha.*fractional"):
        load(tmp_path, "[skin]\nalpha = 0.7")


def test_what_is_not_modelled_or_fitted_yet_is_refused_not_ignored(tmp_path: Path):
    load(tmp_path, '[skin]\nlevel = "dispersive"').require_available(fit=True)
    rest = "[drive]\nsteady_state = false"
    with pytest.raises(fitact.InputError, match="dispersive"):
        load(tmp_path, f'[skin]\nlevel = "dispersive"\n{rest}').require_available(fit=True)
    load(tmp_path, f'[skin]\nlevel = "fractional"\n{rest}').require_available(fit=True)
    with pytest.raises(fitact.InputError, match="fractional"):
        load(tmp_path, f'[skin]\nlevel = "fractional"\n{rest}').make_circuit()
    with pytest.raises(fitact.InputError, match=r"dispersive.*steady_state"):
        load(tmp_path, '[skin]\nlevel = "dispersive"\n[drive]\nsteady_state = false').make_circuit()
    load(tmp_path, '[grounding]\nR_H = "500 ohm"').require_available(fit=True)
    with pytest.raises(fitact.InputError, match="Z"):
        load(tmp_path, '[grounding]\nconnection = "natural"')


def test_burst_and_chirp_start_from_rest(tmp_path: Path):
    burst, chirp = load(tmp_path, BURST), load(tmp_path, CHIRP)
    assert not burst.drive.steady_state
    assert not chirp.drive.steady_state
    drive = burst.make_drive()
    assert isinstance(drive, fitact.Burst)
    assert drive.wave == fitact.Sine(360.0, 100.0, 5.0, pytest.approx(math.pi / 2.0, rel=1e-14))
    assert drive.cycles == 3
    default = load(tmp_path, '[drive]\nwaveform = "burst"\nduty = 0.3').make_drive()
    assert default == fitact.Burst(fitact.Square(360.0, 100.0, 0.3), 5)
    assert chirp.make_drive() == fitact.Chirp(360.0, 10.0, 1000.0, 0.5, "logarithmic")


@pytest.mark.parametrize("waveform", ["sine", "triangle", "square", "trapezoid"])
def test_phase_of_a_wave(tmp_path: Path, waveform: str):
    rise = 'rise_time = "1 ms"\n' if waveform == "trapezoid" else ""
    scene = load(tmp_path, f'[drive]\nwaveform = "{waveform}"\n{rise}phase = "90 deg"')
    unshifted = load(tmp_path, f'[drive]\nwaveform = "{waveform}"\n{rise}')
    with jax.enable_x64(True):
        time = np.arange(17) * 1.1e-3
        ahead = unshifted.make_drive().value(time + 2.5e-3)
        np.testing.assert_allclose(scene.make_drive().value(time), ahead, atol=1e-9)


def test_tones_of_a_scene(tmp_path: Path):
    scene = load(tmp_path, TONES)
    drive = scene.make_drive()
    assert (drive.frequency, drive.orders) == (50.0, (2, 5, 20))
    assert (drive.amplitudes, drive.offset) == ((36.0, 40.0, 5.0), -3.0)
    assert drive.phases == pytest.approx((0.0, math.pi / 4.0, 1.0))
    assert scene.drive.lowest_frequency == 50.0


SHIPPED = ("burst", "fast-edge", "gabriel-dry", "gabriel-wet", "multitone", "natural-ground", "paper", "phone")


def test_all_shipped_scenes_are_known():
    assert tuple(sorted(shipped_scenes())) == SHIPPED
    described = (Path(__file__).parents[2] / "docs" / "scene.md").read_text()
    assert all(f"`{name}`" in described for name in SHIPPED)


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_scenes_are_simulated_and_respond(name: str):
    scene = fitact.Scene.load(name)
    scene.require_available(fit=True)
    record = simulate(scene, seed=1)
    with jax.enable_x64(True):
        clean = fitact.response(
            scene.make_circuit(), scene.make_drive(), record.time, steady_state=scene.drive.steady_state
        )
    noise = record["Vsc"] - np.asarray(clean)
    assert np.std(noise) == pytest.approx(scene.measurement.noise_Vsc, rel=0.1)
    assert np.ptp(clean) > 50.0 * scene.measurement.noise_Vsc


def test_phone_is_a_capacitive_divider():
    """Far above 1/b of the skin, the whole loop is capacitive: stray capacitance, panel and finger in series."""
    phone = fitact.Scene.load("phone")
    whole = 1.0 / (1.0 / 1.35e-9 + 1.0 / 22e-9 + 1.0 / 9.4e-12)
    with jax.enable_x64(True):
        assert float(phone.make_circuit().amplitude(1e6)) == pytest.approx(whole / 22e-9, rel=1e-3)


def test_a_file_goes_before_a_shipped_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    assert fitact.Scene.load("phone").grounding.connection == "natural"
    (tmp_path / "phone").write_text('[skin]\nRsc = "1 kohm"')
    assert fitact.Scene.load("phone").skin.Rsc == 1e3
    with pytest.raises(fitact.InputError, match="or the shipped scene 'paper'"):
        fitact.Scene.load("papper")


@functools.cache
def documented() -> dict[tuple[str, str], list[str]]:
    """Return the rows of docs/scene.md: (section, key) -> default, unit, meaning, source."""
    rows, section = {}, ""
    for line in (Path(__file__).parents[2] / "docs" / "scene.md").read_text().splitlines():
        if header := re.fullmatch(r"## \[(\w+)\]", line):
            section = header[1]
        elif line.startswith("| `") and section:
            key, *cells = (cell.strip() for cell in line.strip("|").split(" | "))
            rows[section, key.strip("`")] = cells
    return rows


@pytest.mark.parametrize("name", sorted({*fitact.Scene.model_fields} - {"description", "calibration"}))
def test_every_key_is_documented_with_its_default_and_unit(name: str):
    section = getattr(fitact.Scene(), name)
    fields = type(section).model_fields
    assert [key for of, key in documented() if of == name] == list(fields)
    for key, field in fields.items():
        default, unit, *_ = documented()[name, key]
        value = getattr(section, key)
        assert default == ("absent" if value is None else f"`{value_text(value, field_unit(field))}`")
        assert unit == (field_unit(field) or "")
