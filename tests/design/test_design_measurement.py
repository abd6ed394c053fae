"""The next measurement, against Fisher information from scipy's transfer functions and against posteriors."""

import dataclasses
import functools
import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.signal

import fitact
from fitact.cli import main
from fitact.design.measurement import experiment_from_scene
from fitact.experiment.experiment import CandidateDesign, DesignOption, evaluate_design, force_sd, optimise
from fitact.experiment.fisher import Experiment, force_gradient
from fitact.experiment.options import changes, suggest_measurements
from tests.experiment.test_expected import BOTH, NOMINAL, PRIOR_SD, RESISTOR

VALUES = {"Rsc": 160e3, "Csc": 22e-9, "Ci": 1.35e-9}
LOGS = np.log(list(VALUES.values()))
RATE, COUNT, HALF = 250e3, 5000, 180.0  # Hz, samples, V
NOISE_VSC, NOISE_I = 0.1, 20e-9
RELATIVE = {name: math.sqrt(math.expm1(sd * sd)) for name, sd in zip(VALUES, PRIOR_SD, strict=True)}
PAPER = {
    "measurement": {"sampling_rate": RATE, "noise_Vsc": NOISE_VSC},
    "prior": {name: {"relative_sd": sd} for name, sd in RELATIVE.items()},
}
SCENE = fitact.Scene.from_dict(PAPER)


@functools.cache
def shown(
    Rsc: float,
    Csc: float,
    Ci: float,
    *,
    series: float = 0.0,
    probe: float = 0.0,
    second: float = 1.0,
    steps: int = 1250,
    step: float = 1.0 / RATE,
) -> tuple[np.ndarray, np.ndarray]:
    """Vsc and I over one settled half period of the square, its edge first, from scipy's zero-order hold.

    `probe` (ohm) is in parallel with the touching skin; the `second` skin has so much of its resistance, or is
    absent (0). Without a resistance in series I is what flows between edges.
    """
    ms = 1e3  # of time, so that the polynomials' coefficients are alike in size
    loaded, grounding = 1.0 / (1.0 / Rsc + (1.0 / probe if probe else 0.0)), second * float(Rsc)
    skin, other, charging = (
        np.poly1d([ms * float(tau), on]) for tau, on in ((loaded * Csc, 1), (grounding * Csc, 1), (Ci, 0))
    )
    loop = skin * other + charging * (other * float(loaded) + skin * grounding + skin * other * series)
    A, B, C, D = scipy.signal.tf2ss((charging * other * float(loaded)).coeffs, loop.coeffs)
    a, b, *_ = scipy.signal.cont2discrete((A, B, C, D), ms * step, method="zoh")
    one = np.eye(len(a))
    held = np.linalg.solve(one - a, b) * HALF  # where the state tends to
    half = np.linalg.matrix_power(a, steps)
    left = -np.linalg.solve(one + half, (one - half) @ held) - held  # it ends at minus where it begins
    while left.shape[1] < steps:
        left, a = np.hstack([left, a @ left]), a @ a
    states = held + left[:, :steps]
    vsc, slope = (C @ states + D * HALF)[0], (C @ (A @ states + B * HALF))[0] * ms
    return vsc, vsc / loaded + Csc * slope


def log_force(Rsc: float, Csc: float, Ci: float) -> float:
    """Eq. (22) with eq. (3), up to constants: the square's mean of Vsc^2 in closed form."""
    b, g = Rsc * (2.0 * Ci + Csc), Ci / (2.0 * Ci + Csc)
    x = 0.01 / b
    return math.log(Ci * Csc / (Ci + Csc) * 4.0 * g * g * math.tanh(x / 4.0) / x)


def derivative(function, h: float = 1e-4) -> np.ndarray:
    """Return derivatives in the logarithms of Rsc, Csc and Ci, one row for each."""
    return np.array([
        (np.asarray(function(*np.exp(LOGS + h * e))) - np.asarray(function(*np.exp(LOGS - h * e)))) / (2.0 * h)
        for e in np.eye(3)
    ])  # fmt: skip


GRADIENT = derivative(log_force)


def information(channels: str = "Vsc", count: float = COUNT, noise: float = NOISE_VSC, **circuit: Any) -> np.ndarray:
    """Fisher information of so many samples in Rsc, Csc, Ci."""

    def vsc(*values: float) -> np.ndarray:
        return shown(*values, **circuit)[0]

    slope = derivative(vsc) / noise
    total = slope @ slope.T * (count / slope.shape[1])
    if "I" in channels:
        slope = derivative(lambda *values: shown(*values, **circuit)[1]) / NOISE_I
        kept = slope if circuit.get("series") else slope[:, 2:-2]  # beside an edge no sample counts
        total += kept @ kept.T * (count / slope.shape[1])
    return total


def standard_deviations(total: np.ndarray, prior_sd: np.ndarray = PRIOR_SD) -> np.ndarray:
    """Return the standard deviations of the logarithms of Rsc, Csc, Ci and the mean force."""
    covariance = np.linalg.inv(total + np.diag(prior_sd**-2.0))
    return np.sqrt([*np.diag(covariance)[:3], GRADIENT @ covariance[:3, :3] @ GRADIENT])


def predicted(option: DesignOption) -> np.ndarray:
    return np.array([*option.sd.values(), option.force_sd])


@pytest.fixture(scope="module")
def design() -> fitact.MeasurementDesign:
    return fitact.design_measurement(SCENE)


@pytest.fixture(scope="module")
def options(design: fitact.MeasurementDesign) -> dict[str, DesignOption]:
    return {option.name: option for option in design.options}


def test_the_paper_s_measurement(design: fitact.MeasurementDesign, options: dict[str, DesignOption]):
    """4.9 % from Vsc alone, 0.13 % with a known resistor in series, 0.02 % with the current."""
    np.testing.assert_allclose(predicted(design.now), standard_deviations(information()), rtol=1e-3)
    assert design.now.force_sd == pytest.approx(0.0487, abs=5e-5)
    before = np.linalg.norm(GRADIENT * PRIOR_SD)
    assert design.prior_force_sd == pytest.approx(before, rel=1e-5)
    assert design.now.contraction == pytest.approx(1.0 - design.now.force_sd / before, rel=1e-4)
    sizes = [option.force_sd for option in design.options]
    assert sizes == sorted(sizes)
    assert design.best_for_effort is not None
    assert design.best_for_effort.name == "series resistor"
    assert options["frequency"].settings == {"frequency": 100.0}  # nothing is gained by another


def second_panel(Ci: float) -> np.ndarray:
    """Return the information on Rsc, Csc, Ci and the second panel's Ci, which its own samples determine."""
    scale = Ci / VALUES["Ci"]
    total = np.zeros((4, 4))
    total[:3, :3] += information()
    slope = derivative(lambda Rsc, Csc, own: shown(Rsc, Csc, scale * own)[0]) / NOISE_VSC
    total[np.ix_([0, 1, 3], [0, 1, 3])] += slope @ slope.T * (COUNT / slope.shape[1])
    return standard_deviations(total, np.append(PRIOR_SD, PRIOR_SD[2]))


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("current", lambda _: standard_deviations(information("Vsc, I"))),
        ("series resistor", lambda at: standard_deviations(information(series=at["series_resistor"]))),
        ("better Ci", lambda _: standard_deviations(information(), PRIOR_SD * [1.0, 1.0, 0.5])),
        ("longer record", lambda _: standard_deviations(4.0 * information())),
        ("higher sampling rate", lambda _: standard_deviations(information(count=4 * COUNT))),
        ("second panel", lambda at: second_panel(at["second_Ci"])),
    ],
)
def test_each_option_as_scipy_has_it(options: dict[str, DesignOption], name: str, expected):
    option = options[name]
    np.testing.assert_allclose(predicted(option), expected(option.settings), rtol=2e-3)


def test_the_resistor_is_the_best_there_is(options: dict[str, DesignOption]):
    found = options["series resistor"]
    grid = [standard_deviations(information(series=series))[3] for series in np.geomspace(2e4, 2e6, 25)]
    assert found.force_sd < 1.001 * min(grid)
    assert found.force_sd < standard_deviations(information(series=100e3))[3]


def trial_of(experiment: Experiment, *names: str, steps: dict | None = None) -> CandidateDesign:
    trial = CandidateDesign((experiment,))
    for change in changes(steps):
        if change.name in names:
            trial = change(trial)
    return trial


PROBED = fitact.Scene.from_dict(PAPER | {"measurement": PAPER["measurement"] | {"probe_resistance": "1 Mohm"}})


@pytest.mark.parametrize(
    ("names", "values", "expected"),
    [
        ((), (), lambda: information(probe=1e6)),
        (("lighter probe",), (), lambda: information(probe=1e7)),
        (("no probe load",), (), information),
        (("finer converter",), (), lambda: information(probe=1e6, noise=0.08)),
        (("frequency",), (500.0,), lambda: information(probe=1e6, steps=250)),
        (
            ("two frequencies",),
            (125.0, 1e3),
            lambda: information(probe=1e6, steps=1000) + information(probe=1e6, steps=125),
        ),
    ],
)
def test_probes_frequencies_and_converters_as_scipy_has_them(
    names: tuple[str, ...], values: tuple[float, ...], expected
):
    """The probe's known load gives the scale away; the force asked for stays that of the scene, at 100 Hz."""
    experiment = experiment_from_scene(PROBED)
    trial = trial_of(experiment, *names, steps={"Vsc": 0.06 * math.sqrt(12.0)})
    found = evaluate_design(trial, values, force_gradient(experiment))

    def log_force(Rsc: float, Csc: float, Ci: float) -> float:
        return math.log(Ci * Csc / (Ci + Csc) * np.mean(shown(Rsc, Csc, Ci, probe=1e6)[0] ** 2))

    covariance, gradient = np.linalg.inv(expected() + np.diag(PRIOR_SD**-2.0)), derivative(log_force)
    sd = np.sqrt([*np.diag(covariance), gradient @ covariance @ gradient])
    np.testing.assert_allclose(predicted(found), sd, rtol=2e-3)


def test_what_is_tied_follows():
    """A grounding skin of half the resistance."""
    prior = PAPER["prior"] | {"grounding_Rsc": {"tied": "Rsc", "ratio": 0.5}}
    experiment = experiment_from_scene(fitact.Scene.from_dict(PAPER | {"prior": prior}))
    found = evaluate_design(CandidateDesign((experiment,)), (), force_gradient(experiment))
    expected = standard_deviations(information(second=0.5))
    np.testing.assert_allclose(predicted(found)[:3], expected[:3], rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("names", [("frequency", "series resistor"), ("frequency", "current"), ("two frequencies",)])
def test_no_random_setting_is_better(names: tuple[str, ...]):
    experiment = experiment_from_scene(scene(**NATURAL))
    trial, gradient = trial_of(experiment, *names), force_gradient(experiment)
    best = force_sd(trial, optimise(trial, gradient).values, gradient)
    low, high = (np.log([getattr(setting, bound) for setting in trial.settings]) for bound in ("low", "high"))
    points = np.exp(np.random.default_rng(0).uniform(low, high, (200, len(low))))
    assert best < 1.001 * min(force_sd(trial, point, gradient) for point in points)


def test_remedies_are_the_quick_changes_best_first():
    found = {
        option.name: option for option in suggest_measurements(CandidateDesign((NOMINAL,)), force_gradient(NOMINAL))
    }
    assert list(found) == ["current", "series resistor", "better Ci", "longer record"]
    assert found["current"].text == "the loop current I also recorded (20 nA rms noise)"
    assert found["series resistor"].text == "a known resistor of 100 kΩ in series"
    assert found["better Ci"].force_sd == pytest.approx((2.0 / 0.09 + 4.0 / 0.0025) ** -0.5, rel=1e-4)
    noisier = dataclasses.replace(NOMINAL, noise={"Vsc": 0.1, "I": 40e-9})
    assert "the loop current I also recorded (40 nA rms noise)" in {
        o.text for o in suggest_measurements(CandidateDesign((noisier,)), force_gradient(NOMINAL))
    }


def test_no_remedy_that_was_taken():
    done = dataclasses.replace(BOTH, circuit=RESISTOR, free=("Rsc", "Csc"), prior_factor=np.diag(PRIOR_SD[:2]))
    assert [option.name for option in suggest_measurements(CandidateDesign((done,)), force_gradient(done))] == [
        "longer record"
    ]


def test_remedies_at_a_circuit_whose_current_overflows():
    """A fit that failed may end there; what can be computed is still told."""
    far = dataclasses.replace(NOMINAL, circuit=fitact.FinalCircuit(Rsc=1e-200, Csc=1e-8, Ci=1e-10))
    with np.errstate(all="ignore"):
        found = [option.name for option in suggest_measurements(CandidateDesign((far,)), force_gradient(NOMINAL))]
    assert "current" not in found


def test_a_record_s_values_and_noise(finger_fit: fitact.Fit, monkeypatch):
    """The fit's own; one of the changes is enough here."""
    monkeypatch.setattr("fitact.design.measurement.fit", lambda records, scene: finger_fit)
    monkeypatch.setattr("fitact.design.measurement.changes", lambda steps: changes(steps)[-2:-1])
    found = fitact.design_measurement(finger_fit.scene, finger_fit.record)
    known = finger_fit.identifiability
    assert found.now.force_sd == pytest.approx(known.force_sd, rel=0.01)
    assert found.now.contraction == pytest.approx(known.force_contraction, rel=0.01)
    assert list(found.now.sd.values()) == pytest.approx(finger_fit.sd[:3].tolist(), rel=0.02)  # the last is a delay
    assert found.trusted


def test_what_cannot_be_asked():
    with pytest.raises(fitact.InputError, match="waveform = 'measured'"):
        fitact.design_measurement(fitact.Scene.from_dict({"drive": {"waveform": "measured"}}))
    held = {"prior": {name: {"fixed": True} for name in VALUES}}
    with pytest.raises(fitact.InputError, match="frees no parameter"):
        fitact.design_measurement(fitact.Scene.from_dict(held))
    with pytest.raises(fitact.InputError, match="noise_Vsc is 0"):
        fitact.design_measurement(fitact.Scene.from_dict({"measurement": {"noise_Vsc": 0.0}}))


def test_stated_noise_of_V_and_an_uncertain_stray_capacitance_are_counted():
    content = {"drive": {"waveform": "trapezoid", "rise_time": "400 us"}}
    current = {"channels": ["I"], "stray_capacitance": {"median": "100 pF", "relative_sd": 0.1}}
    experiment = experiment_from_scene(fitact.Scene.from_dict(content | {"measurement": current | {"noise_V": 0.5}}))
    assert experiment.noise["V"] == 0.5
    assert experiment.free == (*VALUES, "stray_capacitance")
    assert np.linalg.norm(experiment.prior_factor[3]) == pytest.approx(math.sqrt(math.log1p(0.01)))
    assert "V" not in experiment_from_scene(fitact.Scene.from_dict(content | {"measurement": current})).noise
    gradient = force_gradient(experiment)
    assert gradient[3] == 0.0
    # I that is added brings the unknown with it
    skin = experiment_from_scene(fitact.Scene.from_dict(content | {"measurement": current | {"channels": ["Vsc"]}}))
    assert skin.free == tuple(VALUES)
    (added,) = trial_of(skin, "current").experiments
    assert added.free == experiment.free
    sd = evaluate_design(trial_of(skin, "current"), (), gradient[:3]).sd["stray_capacitance"]
    assert sd < 0.1


def test_command_line(design: fitact.MeasurementDesign, tmp_path: Path, monkeypatch, capsys):
    (tmp_path / "scene.toml").write_text(str(SCENE))
    monkeypatch.setattr("fitact.design.measurement.design_measurement", lambda scene, records: design)
    monkeypatch.setattr(
        sys,
        "argv",
        ["fitact", "design", "measurement", str(tmp_path / "scene.toml"), "--json", "--out", str(tmp_path / "out")],
    )
    with pytest.raises(SystemExit, match="0"):
        main()
    printed = json.loads(capsys.readouterr().out)
    assert next(iter(printed)) == "now"
    assert printed == json.loads((tmp_path / "out" / "design.json").read_text())
    assert printed["now"]["force_sd"] == design.now.force_sd
    assert [option["name"] for option in printed["options"]] == [option.name for option in design.options]
    assert all(
        {"name", "force_sd", "contraction", "effort", "settings"} <= set(option) for option in printed["options"]
    )
    assert "<svg" in (tmp_path / "out" / "design.svg").read_text()


NATURAL = {"grounding": {"connection": "natural", "Z": 14.5e6}}


def record(
    vsc: np.ndarray, step: float = 1.0 / RATE, current: np.ndarray | None = None, seed: int = 0
) -> fitact.Record:
    """Make as many samples as the scene has, with noise, from one half period of each channel."""
    rng, half = np.random.default_rng(seed), len(vsc)

    def whole(values: np.ndarray) -> np.ndarray:
        return np.tile(np.append(values, -values), COUNT // (2 * half))

    channels = {"V": whole(np.full(half, HALF)), "Vsc": whole(vsc) + NOISE_VSC * rng.standard_normal(COUNT)}
    if current is not None:
        channels["I"] = whole(current) + NOISE_I * rng.standard_normal(COUNT)
    return fitact.Record.from_arrays(np.arange(COUNT) * step, **channels)


def scene(**sections: dict[str, Any]) -> fitact.Scene:
    merged = {name: PAPER.get(name, {}) | sections.get(name, {}) for name in {*PAPER, *sections, "drive"}}
    return fitact.Scene.from_dict(merged | {"drive": {"waveform": "square"} | merged["drive"]})


def logs_of(records: list[fitact.Record], scenes: list[fitact.Scene], seed: int) -> np.ndarray:
    """Draws of the logarithms of Rsc, Csc, Ci from the posterior of records, fitted jointly and sampled."""
    fit = fitact.fit(records, scenes)
    assert fit.trusted
    drawn = fitact.sample(fit, seed=seed, progress=False).parameters()
    return np.log([drawn[name].ravel() for name in VALUES])


def vsc_alone(seed: int) -> np.ndarray:
    return logs_of([record(shown(**VALUES)[0], seed=seed)], [scene()], seed)


def with_resistor(seed: int) -> np.ndarray:
    known = scene(measurement={"series_resistor": 166e3})
    return logs_of([record(shown(**VALUES, series=166e3)[0], seed=seed)], [known], seed)


def with_current(seed: int) -> np.ndarray:
    vsc, current = shown(**VALUES)
    both = scene(measurement={"channels": ["Vsc", "I"]})
    return logs_of([record(vsc, current=current, seed=seed)], [both], seed)


def at_two_frequencies(seed: int) -> np.ndarray:
    """Naturally grounded, 10 and 100 Hz."""
    steps = [10.0 / RATE, 1.0 / RATE]
    records = [
        record(shown(**VALUES, series=14.5e6, second=0.0, step=step)[0], step, seed=2 * seed + k)
        for k, step in enumerate(steps)
    ]
    scenes = [scene(**NATURAL, drive={"frequency": 4e-4 / step}) for step in steps]
    return logs_of(records, scenes, seed)


def on_two_panels(seed: int) -> np.ndarray:
    """The second panel's posterior of the skin is the prior for the first."""
    own = 10.0 * VALUES["Ci"]
    other = scene(device={"Ci": own})
    skin = logs_of([record(shown(VALUES["Rsc"], VALUES["Csc"], own)[0], seed=1000 + seed)], [other], seed)[:2]
    believed = {
        name: {"median": math.exp(np.mean(log)), "relative_sd": math.sqrt(math.expm1(np.var(log)))}
        for name, log in zip(("Rsc", "Csc"), skin, strict=True)
    }
    first = scene(prior=believed | {"correlation": {"Rsc-Csc": float(np.corrcoef(skin)[0, 1])}})
    return logs_of([record(shown(**VALUES)[0], seed=seed)], [first], seed)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("drawn", "stated", "names", "values"),
    [
        (vsc_alone, SCENE, (), ()),
        pytest.param(with_resistor, SCENE, ("series resistor",), (166e3,), marks=pytest.mark.slow),
        pytest.param(with_current, SCENE, ("current",), (), marks=pytest.mark.slow),
        pytest.param(at_two_frequencies, scene(**NATURAL), ("two frequencies",), (10.0, 100.0), marks=pytest.mark.slow),
        pytest.param(on_two_panels, SCENE, ("second panel",), (13.5e-9,), marks=pytest.mark.slow),
    ],
)
def test_posteriors_are_as_wide_as_was_to_be_expected(drawn, stated: fitact.Scene, names, values):
    """To 3 % in the standard deviations of the logarithms and of the force, in the mean of three records."""
    experiment = experiment_from_scene(stated)
    gradient = force_gradient(experiment)
    found = evaluate_design(trial_of(experiment, *names), values, gradient)
    sd = []
    for seed in range(3):  # any would do
        logs = drawn(seed)
        sd.append([*np.std(logs, axis=1), np.std(gradient @ logs)])
    np.testing.assert_allclose(np.mean(sd, axis=0), predicted(found), rtol=0.03)
    before = np.append(PRIOR_SD, np.linalg.norm(gradient * PRIOR_SD))
    contraction = np.append(list(found.contractions.values()), found.contraction)
    np.testing.assert_allclose(1.0 - np.mean(sd, axis=0) / before, contraction, atol=0.005)
