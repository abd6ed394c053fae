"""The design of a drive: against scipy's state space, closed forms, and random fingers drawn by scipy."""

import dataclasses
import itertools
import json
import math
import types
from pathlib import Path

import jax
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import scipy.optimize
import scipy.signal
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

import fitact
from fitact.charts import draw_drive_design
from fitact.charts.figure import write_figure
from fitact.cli import run_command
from fitact.cli.app import app
from fitact.design.drive import _DriveEvaluator
from fitact.design.drive_option import DriveOption, quantile, quantile_error
from fitact.design.drive_people import FingerSample
from fitact.model.steady_cycle import period_quantities
from fitact.populations import population_draws
from fitact.populations.population_draws import PopulationDraws
from fitact.populations.population_parameters import PopulationParameters
from fitact.readers.study import nest_levels

EPS0, AREA, TI, TSC = 8.85e-12, 1e-4, 1e-6, 200e-6
R, C, CI, F, RISE = 160e3, 22e-9, 1.35e-9, 100.0, 50e-6
THRESHOLD = 1e-4  # N
TRAPEZOID = {"waveform": "trapezoid", "rise_time": RISE}
FINGERS = Path(__file__).parents[2] / "data_synth" / "records" / "fingers"

# the voltages of the elements and the insulator's: element R, C of each, and the resistance in the loop
CIRCUITS = {
    "final": (fitact.FinalCircuit(R, C, CI), [(R, C), (R, C)], None),
    "direct": (
        fitact.DirectGround(R, C, CI, R_H=40e3, grounding_Rsc=50e3, grounding_Csc=8e-9),
        [(R, C), (50e3, 8e-9)],
        40e3,
    ),
    "natural": (fitact.NaturalGround(R, C, CI, Z=2e6, Z_capacitance=1e-10), [(R, C), (2e6, 1e-10)], None),
}


def scene(**sections: dict) -> fitact.Scene:
    return fitact.Scene.from_dict({"perception": {"threshold_force": THRESHOLD}} | sections)


def per_square(Csc: float = C, Ci: float = CI, thickness: float = TI) -> float:
    """Eq. (22) over Vsc^2, permittivities by eq. (3)."""
    return 1.0 / (2.0 * (1.0 / Ci + 1.0 / Csc) * (thickness + TSC))


POINTS = 20_000  # of a period
CORNERS = [0, round(POINTS * RISE * F), POINTS // 2, POINTS // 2 + round(POINTS * RISE * F), POINTS]


def trapezoid() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, V and dV/dt (of the step that begins there) over one period of 1 Vpp."""
    voltage = np.interp(np.arange(POINTS + 1), CORNERS, [-0.5, 0.5, 0.5, -0.5, -0.5])
    slope = np.diff(voltage) * POINTS * F
    return np.arange(POINTS + 1) / POINTS / F, voltage, np.append(slope, slope[0])


def simulated(elements: list[tuple[float, float]], R0: float | None) -> dict[str, np.ndarray]:
    """Settled voltages and the current by scipy: C v' = I - v / R for each element, and Ci."""
    time, voltage, slope = trapezoid()
    resistances, capacitances = np.array(elements).T
    loss = np.diag(np.append(1.0 / resistances, 0.0))
    storage = np.diag(np.append(capacitances, CI))
    ones = np.ones(len(elements) + 1)
    if R0 is None:  # V' = sum v', so I follows from v and V'
        whole = 1.0 / np.sum(1.0 / np.diag(storage))
        leak = ones @ np.linalg.solve(storage, loss)
        gain, direct, source = whole * leak, whole, slope
    else:
        gain, direct, source = -ones / R0, 1.0 / R0, voltage
    inverse = np.linalg.inv(storage)
    A, B = inverse @ (np.outer(ones, gain) - loss), inverse @ (ones * direct)
    # the slope is constant along a step, the voltage straight
    step = lambda x0: scipy.signal.lsim(  # noqa: E731
        (A, B[:, None], np.eye(len(ones)), np.zeros((len(ones), 1))), source, time, X0=x0, interp=R0 is not None
    )[1]
    once = step(np.zeros(len(ones)))[-1]
    turn = scipy.linalg.expm(A / F)
    # without R0 the voltages add up to V, which the slope alone does not fix
    constraint = ones if R0 is None else np.zeros(len(ones))
    system = np.vstack([np.eye(len(ones)) - turn, constraint])
    begin = np.linalg.lstsq(system, np.append(once, constraint @ ones / len(ones) * voltage[0]), rcond=None)[0]
    states = step(begin)
    before = np.append(slope[-2], slope[:-1])
    current = states @ gain + direct * source
    left = current if R0 is not None else states @ gain + direct * before
    return {"time": time, "V": voltage, "Vsc": states[:, 0], "Vi": states[:, -1], "I": current, "I left": left}


def mean(values: np.ndarray, left: np.ndarray | None = None) -> float:
    """Over a period, from corner to corner; `left`: the limits from the left, where they differ."""
    total = 0.0
    for begin, end in itertools.pairwise(CORNERS):
        piece = values[begin : end + 1].copy()
        piece[-1] = values[end] if left is None else left[end]
        total += scipy.integrate.simpson(piece) / POINTS
    return float(total)


@pytest.fixture(scope="module")
def settled() -> dict[str, dict[str, np.ndarray]]:
    return {name: simulated(elements, R0) for name, (_, elements, R0) in CIRCUITS.items()}


@pytest.mark.parametrize("name", CIRCUITS)
def test_a_cycle_is_scipys(name: str, settled):
    """Force, insulator, power and current over a period, the two ends of each edge included."""
    seen = settled[name]
    time, force = seen["time"], per_square() * seen["Vsc"] ** 2
    with jax.enable_x64(True):
        contact = fitact.Contact.from_capacitances(CI, C, AREA, TI, TSC)
        drive = fitact.Trapezoid(1.0, F, RISE, phase=0.3)
        found = jax.jit(lambda: period_quantities(CIRCUITS[name][0], drive, contact))()
    average = mean(force)
    assert found.force_mean == pytest.approx(average, rel=1e-6)
    assert found.force_alternating == pytest.approx(math.sqrt(2.0 * mean((force - average) ** 2)), rel=1e-6)
    for order, amplitude in enumerate(np.asarray(found.force_harmonics), 1):
        angle = 2.0 * np.pi * order * F * time
        by_fourier = 2.0 * math.hypot(mean(force * np.cos(angle)), mean(force * np.sin(angle)))
        assert amplitude == pytest.approx(by_fourier, rel=1e-6, abs=1e-7 * average)
    assert found.insulator_peak == pytest.approx(np.abs(seen["Vi"]).max(), rel=1e-4)
    assert found.real_power == pytest.approx(mean(seen["V"] * seen["I"], seen["V"] * seen["I left"]), rel=1e-6)
    rms = math.sqrt(mean(seen["I"] ** 2, seen["I left"] ** 2))
    assert found.current_rms == pytest.approx(rms, rel=1e-6)
    assert found.current_peak == pytest.approx(max(np.abs(seen["I"]).max(), np.abs(seen["I left"]).max()), rel=1e-6)
    assert found.apparent_power == pytest.approx(math.sqrt(mean(seen["V"] ** 2)) * rms, rel=1e-6)


def test_peaks_between_corners_are_found():
    """A triangle's, exactly elsewhere; and of two tones, on a fine grid."""
    with jax.enable_x64(True):
        contact = fitact.Contact.from_capacitances(CI, C, AREA, TI, TSC)
        circuit, triangle = CIRCUITS["direct"][0], fitact.Triangle(360.0, F)
        found = jax.jit(lambda: period_quantities(circuit, triangle, contact))()
        exact = jax.jit(lambda: fitact.body_current(circuit, triangle))()
        assert found.current_peak == pytest.approx(float(exact.peak), rel=1e-4)
        tones = fitact.Multitone(F, (1, 7), (100.0, 30.0), (0.3, 1.0), offset=20.0)
        found = jax.jit(lambda: period_quantities(circuit, tones, contact))()
        s = 2j * np.pi * F * np.array([1, 7])
        whole = sum(R0 / (1.0 + s * R0 * C0) for R0, C0 in CIRCUITS["direct"][1]) + 40e3 + 1.0 / (s * CI)
        turns = np.exp(1j * (np.outer([1, 7], np.linspace(0.0, 2.0 * np.pi, 50_001)) + np.array([[0.3], [1.0]])))
        current = np.imag((np.array([100.0, 30.0]) / whole) @ turns)
        over = 20.0 + np.imag((np.array([100.0, 30.0]) / whole / (s * CI)) @ turns)
        assert found.current_peak == pytest.approx(np.abs(current).max(), rel=1e-4)
        assert found.insulator_peak == pytest.approx(np.abs(over).max(), rel=1e-4)
        assert found.current_rms == pytest.approx(math.sqrt(np.mean(current[:-1] ** 2)), rel=1e-9)


def one_finger(**values: float) -> FingerSample:
    """So often that one compiled program serves this and `LAWS`."""
    finger = {"Rsc": R, "Csc": C, "Ci": CI} | values
    return FingerSample({name: np.full((1, 512), x) for name, x in finger.items()}, "one finger")


@pytest.fixture(scope="module")
def one() -> fitact.DriveDesign:
    """The design for one finger, with a trapezoid."""
    return fitact.design_drive(scene(drive=TRAPEZOID), one_finger())


def test_the_amplitude_is_where_scipys_simulation_begins_to_be_felt(one, settled):
    vsc = settled["final"]["Vsc"]

    def felt(amplitude: float) -> float:
        force = per_square() * (amplitude * vsc) ** 2
        return math.sqrt(2.0 * mean((force - mean(force)) ** 2)) - THRESHOLD

    expected = scipy.optimize.brentq(felt, 1.0, 1e4, rtol=1e-12)
    assert one.options["trapezoid"].assured == pytest.approx(expected, rel=1e-6)
    assert one.options["trapezoid"].at_assured.force_alternating == pytest.approx(THRESHOLD)


def sine_amplitude(frequency: float, Ci: float = CI, thickness: float = TI) -> float:
    """fe = k |H|^2 (V / 2)^2 (1 - cos 2wt) / 2 for V peak to peak, eqs. (21) and (22)."""
    s = 2j * np.pi * frequency
    gain = abs(s * R * Ci / (1.0 + s * R * (2.0 * Ci + C)))
    return math.sqrt(8.0 * THRESHOLD / (per_square(Ci=Ci, thickness=thickness) * gain**2))


def test_a_sines_force_alternates_at_twice_its_frequency(one):
    options = [one.options["sine"], *one.by_frequency["sine"]]
    for option in options:
        assert option.assured == pytest.approx(sine_amplitude(option.frequency), rel=1e-12)
        np.testing.assert_allclose(
            option.at_assured.force_harmonics, [0.0, THRESHOLD, 0.0, 0.0], atol=1e-12 * THRESHOLD, rtol=1e-9
        )
    assert [option.frequency for option in options[1::4]] == pytest.approx([10.0, 100.0, 1000.0])


def test_insulators_follow_equations_3_and_22():
    """Ci by eq. (3) from permittivity and thickness, and what eq. (22) makes of them."""
    panel = {"insulator_thickness": TI, "insulator_permittivity": 3.9, "breakdown_field": 2e8}
    design = fitact.design_drive(scene(device=panel, drive={"waveform": "sine"}), one_finger(Ci=EPS0 * 3.9 * AREA / TI))
    options = (*design.by_thickness, *design.by_permittivity)
    assert len({option.device.insulator_thickness for option in options}) == 13
    for option in options:
        thickness = option.device.insulator_thickness
        Ci = EPS0 * option.device.insulator_permittivity * AREA / thickness
        assert option.assured == pytest.approx(sine_amplitude(F, Ci, thickness), rel=1e-9)
        s = 2j * np.pi * F
        left = abs(1.0 - 2.0 * s * R * Ci / (1.0 + s * R * (2.0 * Ci + C)))
        assert option.at_assured.insulator_peak == pytest.approx(0.5 * option.assured * left, rel=1e-9)
        assert option.breakdown_voltage == pytest.approx(2e8 * thickness)
        breaks = 0.5 * option.assured * left > 2e8 * thickness
        assert any("over the insulator" in each for each in option.violations) == breaks
    assert 0 < sum(bool(option.violations) for option in options) < len(options)


def drawn_by_scipy(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fingers of the prior below."""
    sd = np.log([2.0, 2.0]) / scipy.stats.norm.ppf(0.975)
    covariance = np.outer(sd, sd) * np.array([[1.0, -0.5], [-0.5, 1.0]])
    skins = scipy.stats.multivariate_normal(np.log([R, C]), covariance).rvs(count, random_state=5)
    return *np.exp(skins.T), scipy.stats.lognorm(math.sqrt(math.log1p(0.1**2)), scale=CI).rvs(count, random_state=6)


@pytest.fixture(scope="module")
def believed() -> fitact.DriveDesign:
    prior = {"Rsc": {"factor": 2}, "Csc": {"factor": 2}, "Ci": {"relative_sd": 0.1}, "correlation": {"Rsc-Csc": -0.5}}
    return fitact.design_drive(scene(prior=prior), share=0.9)


def test_the_share_is_that_of_fingers_drawn_by_scipy(believed):
    """The square in closed form: between jumps from -p to p the force decays as k p^2 e^(-2t/b)."""
    Rsc, Csc, Ci = drawn_by_scipy(100_000)
    x = 1.0 / (F * Rsc * (2.0 * Ci + Csc))
    p = Ci / (2.0 * Ci + Csc) / (1.0 + np.exp(-0.5 * x))
    second, fourth = p**2 * -np.expm1(-x) / x, p**4 * -np.expm1(-2.0 * x) / (2.0 * x)
    per_volt = per_square(Csc, Ci) * np.sqrt(2.0 * (fourth - second**2))
    needed = np.sqrt(THRESHOLD / per_volt)
    # five standard deviations of a share among 4096
    tolerance = 5.0 * math.sqrt(0.9 * 0.1 / 4096)
    assert np.mean(needed <= believed.options["square"].assured) == pytest.approx(0.9, abs=tolerance)
    # a quantile's error, from the density that scipy's fingers have there
    slope = (np.quantile(needed, 0.92) - np.quantile(needed, 0.88)) / 0.04
    error = math.sqrt(0.9 * 0.1 / 4096) * slope
    assert believed.options["square"].assured_error == pytest.approx(error, rel=0.3)
    curve = believed.curve("square")
    shares = np.mean(needed[:, None] <= curve["peak_to_peak"], axis=0)
    np.testing.assert_allclose(curve["q50"], shares, atol=5.0 * math.sqrt(0.25 / 4096))
    powers = believed.options["square"].assured ** 2 * 2.0 / Rsc * second  # of two skins
    assert believed.options["square"].at_assured.real_power == pytest.approx(np.median(powers), rel=0.03)


def test_a_prior_does_not_tell_people_from_ignorance(believed):
    assert not believed.people.has_separate_uncertainty
    assert any("cannot be separated" in warning for warning in believed.warnings)
    option = believed.to_dict()["options"][0]
    assert (option["peak_to_peak"]["q05"], option["peak_to_peak"]["q95"]) == (None, None)
    assert " to " not in str(believed).splitlines()[5]
    assert "no record supports this" in believed.recommendation


LAWS = FingerSample(
    {
        name: np.exp(np.random.default_rng(i).normal(math.log(x), [[0.2]] * 8 + [[0.5]] * 8, (16, 32)))
        for i, (name, x) in enumerate({"Rsc": R, "Csc": C, "Ci": CI}.items())
    },
    "sixteen laws",
)


@pytest.fixture(scope="module")
def laws() -> fitact.DriveDesign:
    return fitact.design_drive(scene(), LAWS, 0.8)


def test_four_times_the_force_takes_twice_the_voltage(laws):
    strong = fitact.design_drive(scene(perception={"threshold_force": 4.0 * THRESHOLD}), LAWS, 0.8)
    for name, option in laws.options.items():
        np.testing.assert_array_equal(strong.options[name].amplitude, 2.0 * option.amplitude)


@given(share=st.floats(0.05, 0.9), more=st.floats(0.001, 0.09))
def test_more_people_need_more(laws, share: float, more: float):
    for needed in laws.needed.values():
        few, many = (quantile(needed, each, axis=1) for each in (share, share + more))
        assert np.all(few < many)
        np.testing.assert_allclose(np.mean(needed <= few[:, None], axis=1), share, atol=0.5 / 32 + 1e-12)


def test_the_assured_amplitude_meets_the_share_under_95_percent_of_the_laws(laws):
    for name, option in laws.options.items():
        met = np.mean(laws.needed[name] <= option.assured, axis=1) >= 0.8 - 0.5 / 32
        assert 15 <= np.sum(met) <= 16
        assert option.assured > 1.1 * np.median(option.amplitude)


def test_quantiles_hold_where_some_never_feel_it():
    amplitude = np.array([1.0, 2.0, 4.0, np.inf, np.inf])
    assert quantile(amplitude, 0.3) == 2.0
    assert math.isinf(quantile(amplitude, 0.9))
    assert quantile(np.arange(1.0, 1001.0), 0.95) == pytest.approx(
        scipy.stats.mstats.mquantiles(np.arange(1.0, 1001.0), 0.95, 0.5, 0.5)[0], rel=1e-4
    )


@pytest.mark.parametrize("share", [0.05, 0.5, 0.95])
def test_the_error_of_a_quantile_is_that_of_an_order_statistic(share: float):
    """The k-th of n exponential draws has the variance 1/n^2 + ... + 1/(n - k + 1)^2 (Renyi)."""
    count = 2000
    at = scipy.stats.expon.ppf((np.arange(count) + 0.5) / count)
    expected = math.sqrt(np.sum(np.arange(count, count * (1.0 - share), -1.0) ** -2.0))
    assert quantile_error(at, share) == pytest.approx(expected, rel=0.02)


def test_the_error_of_a_quantile_where_some_never_feel_it():
    amplitude = np.array([1.0, 2.0, 4.0, np.inf, np.inf])
    assert 0.0 < quantile_error(amplitude, 0.3) < math.inf
    assert math.isinf(quantile_error(amplitude, 0.9))
    assert quantile_error(np.full(512, 300.0), 0.95) == pytest.approx(0.0, abs=1e-9)


def test_friction_changes_by_a_share_of_itself(tmp_path: Path):
    """Mean and amplitude of a sine's fe are equal: c (fe + fN) = fe; no amplitude changes friction by its mean."""
    few = fitact.design_drive(scene(perception={"friction_change": 2e-4}), one_finger()).options["sine"]
    fe = 2e-4 * 0.5 / (1.0 - 2e-4)
    assert few.assured == pytest.approx(sine_amplitude(F) * math.sqrt(fe / THRESHOLD), rel=1e-9)
    never = fitact.design_drive(scene(perception={"friction_change": 1.01}), one_finger())
    assert never.options["sine"].violations == ("too few fingers feel it at any amplitude",)
    assert never.options["sine"].to_dict()["peak_to_peak"]["assured"] == math.inf
    assert "unbounded" in str(never)
    assert never.smallest()["peak_to_peak"] == "triangle"  # whose force is more pointed
    nobody = fitact.design_drive(scene(perception={"friction_change": 5.0}), one_finger())
    assert nobody.smallest() == {"peak_to_peak": None, "real_power": None, "apparent_power": None}
    write_figure(tmp_path / "nobody.svg", lambda: draw_drive_design(nobody.to_dict(), nobody.scene_waveform))
    assert (tmp_path / "nobody.svg").stat().st_size > 0


def test_what_breaks_a_limit_is_named_and_not_the_smallest(one):
    free = one.smallest()
    assert free == {"peak_to_peak": "square", "real_power": "triangle", "apparent_power": "triangle"}
    peak = one.options["triangle"].at_assured.current_peak
    limited = fitact.design_drive(scene(drive=TRAPEZOID, device={"current_limit_peak": 1.01 * peak}), one_finger())
    assert limited.smallest() == dict.fromkeys(free, "triangle")
    assert "the peak current is unbounded, above" in str(limited)
    assert "trapezoid: excluded, the peak current is" in str(limited)
    assert [name for name, option in limited.options.items() if not option.violations] == ["triangle"]


def test_no_amplitude_above_a_published_limit_is_recommended(laws):
    """The sine needs a current above class ES1, which no scene has to state."""
    assert laws.options["sine"].at_assured.current_rms > 0.5e-3
    assert laws.recommended_option is None
    assert "times the limit of IEC 62368-1, class ES1" in laws.recommendation
    assert laws.to_dict()["recommendation"]["peak_to_peak"] is None


def test_one_sentence_says_what_to_set():
    """The smallest amplitude at a finite current, for the same fingers as in the table; in text and JSON alike."""
    laws = fitact.design_drive(scene(perception={"threshold_force": 0.1 * THRESHOLD}), LAWS, 0.8)
    settable = {name: option for name, option in laws.options.items() if name != "square"}
    name, option = min(settable.items(), key=lambda pair: pair[1].assured)
    assert laws.options["square"].assured < option.assured  # but its current is unbounded
    said = laws.to_dict()["recommendation"]
    assert said["waveform"] == name
    assert said["peak_to_peak"] == 2.0 * said["amplitude"] == option.assured
    met = np.mean(laws.needed[name] <= said["peak_to_peak"], axis=1) >= 0.8 - 0.5 / 32
    assert 15 <= np.sum(met) <= 16
    volts = [f"{x:.3g} V" for x in (said["amplitude"], said["peak_to_peak"])]
    sentence = (
        f"Set a {name} of {volts[0]} amplitude ({volts[1]} peak to peak) at 100 Hz: with 95 % probability, at least"
        " 80 % of fingers then feel it."
    )
    assert said["sentence"] == sentence == str(laws).splitlines()[0]


def test_no_amplitude_is_recommended_that_cannot_be_met_or_trusted():
    nobody = fitact.design_drive(scene(perception={"friction_change": 5.0}), one_finger())
    assert nobody.recommendation.startswith(
        "No amplitude is recommended, because no waveform meets all conditions (sine"
    )
    assert nobody.to_dict()["recommendation"]["peak_to_peak"] is None
    assert not any("times the limit" in warning for warning in nobody.warnings)
    assert nobody.exposure.startswith("No amplitude suffices")
    assert "friction that alternates by 500 % of its mean" in nobody.question
    tight = scene(device={"current_limit_rms": 1e-9})
    limited = fitact.design_drive(tight, one_finger())
    assert "sine: the rms current is" in limited.recommendation
    assert limited.exposure.startswith("At the square's amplitude the body current is unbounded, because the edges are")
    unreliable = fitact.design_drive(scene(), dataclasses.replace(one_finger(), trusted=False))
    assert "population is not reliable" in unreliable.recommendation
    assert unreliable.to_dict()["recommendation"]["amplitude"] is None


def test_a_threshold_without_a_source_is_an_example(one):
    assert "the same at all frequencies (example: [perception] states no source)" in one.question
    assert any("100 µN" in warning and "is an example" in warning for warning in one.warnings)
    assert one.to_dict()["threshold"] | {"sentence": ""} == {
        "threshold_force": THRESHOLD, "source": None, "frequency": "all", "sentence": "",
    }  # fmt: skip
    stated = scene(drive=TRAPEZOID, perception={"threshold_force": THRESHOLD, "source": "our own staircase, 12 people"})
    sourced = dataclasses.replace(one, scene=stated)
    assert "(source: our own staircase, 12 people)" in sourced.question
    assert not any("example" in warning for warning in sourced.warnings)


@pytest.mark.parametrize("frequency", [50.0, 400.0, 4000.0])
def test_current_and_field_stand_beside_published_limits_though_none_was_stated(frequency: float):
    """The current of a sine through two skins and Ci follows from the impedance."""
    thickness = 2e-6
    stated = scene(
        drive={"waveform": "sine", "frequency": frequency}, device={"insulator_thickness": thickness, "Ci": CI}
    )
    design = fitact.design_drive(stated, one_finger())
    assert design.recommended_option is design.options["sine"]
    s = 2j * np.pi * frequency
    peak = 0.5 * design.options["sine"].assured / abs(2.0 * R / (1.0 + s * R * C) + 1.0 / (s * CI))
    found = {(each["source"], each["quantity"]): each for each in design.to_dict()["limits"]}
    ES1 = found["IEC 62368-1, class ES1", "rms current"]
    assert (ES1["value"], ES1["limit"], ES1["unit"]) == (pytest.approx(peak / math.sqrt(2.0)), 0.5e-3, "A")
    assert ES1["ratio"] == pytest.approx(ES1["value"] / 0.5e-3)
    assert found["IEC 62368-1, class ES1", "peak current"]["value"] == pytest.approx(peak)
    field = found["data sheet of the insulator", "insulator field"]
    assert field["value"] == pytest.approx(peak / abs(s * CI) / thickness)
    assert (field["limit"], field["ratio"]) == (None, None)
    inside = {source for (source, _), each in found.items() if each["in_range"] and each["frequency_range"]}
    assert inside == {source for source, highest in HIGHEST.items() if frequency <= highest}
    exceeded = {source for source in inside if found[source, "rms current"]["ratio"] > 1.0}
    warned = {source for source in HIGHEST if any(f"the limit of {source}" in warning for warning in design.warnings)}
    assert warned == exceeded
    assert "no safety assessment" in str(design)
    assert "safe " not in str(design).replace("safety", "")


# the highest frequency that each standard's limit is stated for, Hz
HIGHEST = {
    "IEC 60479-1, zone AC-1": 100.0,
    "IEC 60479-1, zone AC-3": 100.0,
    "IEC 62368-1, class ES1": 1e3,
    "IEC 60601-1, patient leakage current": 1e3,
}


def test_an_ideal_edge_s_current_is_unbounded_and_said_to_be():
    square = fitact.design_drive(scene(), one_finger())
    limits = square.options["square"].limits
    assert all(math.isinf(each.value) for each in limits if each.unit == "A")
    assert all(each.row[3] == "unbounded" for each in limits if each.unit == "A")
    assert square.recommended_option is not square.options["square"]
    assert "square: not recommended, the current is unbounded at ideal edges; state [drive] rise_time." in square.notes


def test_an_offset_scales_with_the_drive_and_lies_over_the_insulator(one):
    lifted = fitact.design_drive(scene(drive=TRAPEZOID | {"offset": 180.0}), one_finger()).options["trapezoid"]
    plain = one.options["trapezoid"]
    assert lifted.assured == pytest.approx(plain.assured, rel=1e-12)
    raised = plain.at_assured.insulator_peak + 0.5 * plain.assured
    assert lifted.at_assured.insulator_peak == pytest.approx(raised, rel=1e-9)


def test_a_multitone_of_one_tone_is_a_sine(one):
    tones = {"waveform": "multitone", "frequencies": [50.0, 100.0], "amplitudes": [1e-9, 7.0]}
    found = fitact.design_drive(scene(drive=tones), one_finger())
    assert found.scene_waveform == "multitone"
    assert found.options["multitone"].assured == pytest.approx(one.options["sine"].assured, rel=1e-6)


TABLE = {"frequencies": [20.0, 250.0], "forces": [1e-2, 1e-3], "source": "test"}


def felt(waveform: str, frequency: float) -> DriveOption:
    stated = fitact.Scene.from_dict({"perception": {"thresholds": TABLE}, "friction": {"coefficient": 0.4}})
    return _DriveEvaluator(stated, one_finger(), 0.5, 0.9).evaluate(waveform, frequency)[0]


def test_a_table_of_thresholds_gives_the_amplitude_of_a_sine():
    """Friction of amplitude mu per_square (|H| A)^2 / 2 at 2 f, against a threshold that is linear in log-log."""
    s, option = 2j * np.pi * F, felt("sine", F)
    gain = abs(s * R * CI / (1.0 + s * R * (2.0 * CI + C)))
    threshold = 1e-2 * 10.0 ** (-math.log(2.0 * F / 20.0) / math.log(250.0 / 20.0))
    assert option.assured == pytest.approx(2.0 * math.sqrt(2.0 * threshold / (0.4 * per_square())) / gain, rel=1e-12)
    assert (option.strongest, option.violations) == (2.0 * F, ())
    assert option.to_dict()["outside"] == pytest.approx(0.0, abs=1e-12)


def test_no_detection_is_stated_where_the_table_has_none_of_the_force():
    option = felt("sine", 200.0)
    assert math.isinf(option.assured)
    assert option.violations == ("its force has no frequency in the table of thresholds, so no detection is stated",)
    assert option.to_dict()["strongest"] is None


def test_a_field_that_no_insulator_withstands_is_warned_of():
    found = fitact.design_drive(scene(perception={"threshold_force": 1.0}), one_finger())
    assert any("of the strongest thin films" in each for each in found.warnings)
    usual = fitact.design_drive(scene(), one_finger())
    assert not any("strongest thin films" in each for each in usual.warnings)


def test_no_probe_is_connected_to_what_is_designed(one):
    probe = {"probe_resistance": 1e5, "probe_capacitance": 1e-9}
    found = fitact.design_drive(scene(drive=TRAPEZOID, measurement=probe), one_finger())
    assert found.options["sine"].assured == one.options["sine"].assured


@pytest.mark.parametrize(
    ("sections", "share", "sentence"),
    [
        ({"perception": {}}, 0.95, r"\[perception\] must state a threshold, .*; write threshold_force = "),
        (
            {"perception": {"thresholds": TABLE}, "drive": {"frequency": 200.0, "rise_time": None}},
            0.95,
            r"200 Hz has no frequency in the table of thresholds \(20 Hz to 250 Hz\)",
        ),
        ({"perception": {"friction_change": 0.1}, "friction": {"normal_force": 0.0}}, 0.95, "normal_force"),
        (
            {"drive": {"waveform": "measured"}},
            0.95,
            "'measured': a drive is designed in the steady state; state a sine",
        ),
        ({"drive": {"waveform": "burst"}}, 0.95, "'burst'"),
        ({"drive": {"steady_state": False}}, 0.95, "steady_state"),
        ({"skin": {"level": "fractional"}}, 0.95, r"\[skin\] level = 'fractional'.*; write level = 'constant'"),
        ({}, 0.0, "share = 0: give a fraction of fingers from 0.01 to 0.99"),
        ({}, math.nan, "share = nan"),
    ],
)
def test_what_cannot_be_designed_is_refused(sections: dict, share: float, sentence: str):
    with pytest.raises(fitact.InputError, match=sentence) as refused:
        fitact.design_drive(scene(**sections), share=share)
    assert str(refused.value).count("\n") == 0


def command(*arguments: object) -> int:
    return run_command(lambda: app([*map(str, arguments)], standalone_mode=False))


@pytest.mark.slow
def test_the_command_writes_what_it_prints(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    file = tmp_path / "scene.toml"
    file.write_text('[perception]\nthreshold_force = "0.1 mN"\n[prior]\nRsc = {factor = 2}\nCsc = {factor = 2}\n')
    assert command("design", "drive", file, "--out", tmp_path / "out", "--seed", 3, "--json") == 0
    content = json.loads(capsys.readouterr().out)
    assert content == json.loads((tmp_path / "out" / "drive.json").read_text())
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"report.html", "drive.json", "drive.svg"}
    assert [option["waveform"] for option in content["options"]] == ["sine", "triangle", "square"]
    assert content["options"][2]["at_assured"]["current_peak"] is None  # unbounded at an ideal edge
    assert command("design", "drive", "paper") == 2
    assert "[perception] must state" in capsys.readouterr().err


@pytest.fixture(scope="module")
def eight() -> tuple[fitact.Population, fitact.DriveDesign]:
    """The population of ngspice's fingers, and a design for it."""
    stated = scene(
        drive=TRAPEZOID,
        measurement={"channels": ["Vsc", "I"]},
        prior={"Ci": {"relative_sd": 0.1}},
        device={"breakdown_field": "500 V/um"},
    )
    people = fitact.population(
        [fitact.read(path, stated) for path in sorted(FINGERS.glob("*.csv.gz"))], stated, seed=1, progress=False
    )
    return people, fitact.design_drive(stated, people, seed=1)


@pytest.mark.slow
def test_people_are_those_of_the_population(eight):
    """Other fingers of the same population samples feel a sine as often, by its closed form."""
    people, design = eight
    assert design.people.has_separate_uncertainty
    assert design.trusted
    assert "assumed to have the same contact area" in design.question
    laws = {name: x.reshape(-1) for name, x in people.parameters().items()}
    chosen = np.linspace(0, laws["Ci"].size - 1, 512).astype(int)
    of = {name: x[chosen, None] for name, x in laws.items()}
    one, other = np.random.default_rng(8).standard_normal((2, 512, 4000))
    other = of["correlation"] * one + np.sqrt(1.0 - of["correlation"] ** 2) * other
    Rsc, Csc = of["Rsc"] * np.exp(of["log_sd_Rsc"] * one), of["Csc"] * np.exp(of["log_sd_Csc"] * other)
    Ci = of["Ci"]
    s = 2j * np.pi * F
    gain = np.abs(s * Rsc * Ci / (1.0 + s * Rsc * (2.0 * Ci + Csc)))
    needed = np.sqrt(8.0 * THRESHOLD / (per_square(Csc, Ci) * gain**2))
    option = design.options["sine"]
    for mine, q in zip(option.people, (0.05, 0.25, 0.5, 0.75, 0.95), strict=True):
        assert np.mean(needed <= mine) == pytest.approx(q, abs=0.005)
    off = np.log(np.quantile(needed, 0.95, axis=1, method="hazen") / option.amplitude)
    assert np.mean(off) == pytest.approx(0.0, abs=0.01)
    # the error of so few fingers as it takes of each law widens the interval by less than 2 %
    assert np.std(off) < 0.2 * np.std(np.log(option.amplitude))


def draws_that_differ_in_area(*log_sds: float) -> PopulationDraws:
    """A population that differs in its contact area only, by one level for each standard deviation."""
    levels = ("person", "repetition")[: len(log_sds)]
    log_sd = np.tile([[0.0, 0.0, each] for each in log_sds], (512, 1, 1))
    mean = np.tile([math.log(R), math.log(C), 0.0], (512, 1))
    zeros = np.zeros((512, len(log_sds)))
    law = PopulationParameters(mean, log_sd, zeros, np.full(512, math.log(CI)), np.zeros((512, 0, 3)))
    return PopulationDraws(law, levels, "5 people", True, ())


@pytest.mark.parametrize(("poor", "trusted"), [(2, True), (3, False)])
def test_a_population_of_mostly_poor_fits_is_not_designed_for(poor: int, trusted: bool, monkeypatch):
    """Two of five fingers may be poor, three may not."""
    results = ["misfit"] * poor + ["successful"] * (5 - poor)
    fitted = types.SimpleNamespace(
        nesting=nest_levels({}, 5),
        description="5 fingers",
        fingers=[types.SimpleNamespace(result=result) for result in results],
        trusted=True,
        warnings=(),
    )
    monkeypatch.setattr(population_draws, "draw_parameters", lambda *_: draws_that_differ_in_area(0.3).law)
    assert PopulationDraws.from_population(fitted, 1).trusted == trusted


def test_an_area_scales_capacitances_up_and_the_resistance_down():
    """Fingers of one population sample differ in their area only; tied parameters follow."""
    tied = scene(prior={"grounding_Rsc": {"tied": "Rsc", "ratio": 3}, "R_H": {"fixed": "500 ohm"}})
    sample = FingerSample.from_population(draws_that_differ_in_area(0.3), tied)
    assert "each with its own contact area" in sample.source
    values = sample.values
    area = values["Ci"] / CI
    np.testing.assert_allclose(values["Csc"], C * area)
    np.testing.assert_allclose(values["Rsc"], R / area)
    assert np.std(np.log(area)) == pytest.approx(0.3, rel=1e-3)
    np.testing.assert_array_equal(values["grounding_Rsc"], 3.0 * values["Rsc"])
    assert np.all(values["R_H"] == 500.0)


def test_people_feel_it_in_a_share_of_their_touches():
    """The amplitude falls as a power of the area, nearly: its quantile over touches and people, by Monte Carlo."""
    stated = scene(drive={"waveform": "sine"})
    sample = FingerSample.from_population(draws_that_differ_in_area(0.2, 0.1), stated)
    option, _ = _DriveEvaluator(stated, sample, 0.8, 0.9).evaluate("sine", F)
    rng = np.random.default_rng(3)
    area = np.exp(0.2 * rng.standard_normal((2000, 1)) + 0.1 * rng.standard_normal((2000, 2000)))
    Rsc, Csc, Ci = R / area, C * area, CI * area
    s = 2j * np.pi * F
    gain = np.abs(s * Rsc * Ci / (1.0 + s * Rsc * (2.0 * Ci + Csc)))
    needed = np.quantile(np.sqrt(8.0 * THRESHOLD / (per_square(Csc, Ci) * gain**2)), 0.9, axis=1)
    # four standard errors of a quantile of 2,000 people are about 2 % of their spread of 0.2
    assert np.median(option.amplitude) == pytest.approx(np.quantile(needed, 0.8), rel=0.02)
    with pytest.raises(fitact.InputError, match=r"touches = 0: give a fraction of touches"):
        fitact.design_drive(stated, sample, touches=0.0)


@pytest.mark.slow
@pytest.mark.parametrize("ground", ["direct", "natural"])
def test_each_finger_of_a_prior_needs_what_its_impedances_say(ground: str):
    """A sine, all that the prior frees, holds or ties included."""
    skins = {"Rsc": {"factor": 3}, "Csc": {"factor": 3}, "Ci": {"relative_sd": 0.1}, "sigma": {"factor": 2}}
    other = {"grounding_Rsc": {"tied": "Rsc", "ratio": 2}, "R_H": {"fixed": "2 kohm"}}
    grounding = {"connection": ground} | ({"Z": "5 Mohm"} if ground == "natural" else {})
    if ground == "natural":
        other = {"Z": {"factor": 2}, "Z_capacitance": {"median": "100 pF", "factor": 2}}
    design = fitact.design_drive(scene(grounding=grounding, prior=skins | other, drive={"waveform": "sine"}))
    of, s = design.people.values, 2j * np.pi * F

    def element(resistance: np.ndarray, capacitance: np.ndarray) -> np.ndarray:
        return resistance / (1.0 + s * resistance * capacitance)

    skin = element(of["Rsc"], of["Csc"])
    back = (
        element(of["grounding_Rsc"], of["Csc"]) + 2e3 if ground == "direct" else element(of["Z"], of["Z_capacitance"])
    )
    gain = np.abs(skin / (skin + back + 1.0 / (s * of["Ci"])))
    needed = np.sqrt(8.0 * THRESHOLD / (per_square(of["Csc"], of["Ci"]) * gain**2))
    np.testing.assert_allclose(design.needed["sine"], needed, rtol=1e-9)
