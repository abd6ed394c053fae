"""The plan against independent models: Kirchhoff's laws with their eigenvectors, and ngspice."""

import itertools
import math
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
import scipy.signal
import scipy.stats

import fitact
from fitact.model_selection import omissions
from tests.model.test_ngspice import JUMP, simulate

PAPER = {"grounding": {"R_H": "500 ohm"}}
NATURAL = {"grounding": {"connection": "natural", "Z": "14.5 Mohm"}}
BURST = {"drive": {"waveform": "burst", "cycles": 2}}
_GRID = 1e-5  # relative error of a peak on the time grid below


def planned(**scene: dict) -> fitact.Plan:
    return fitact.plan(fitact.Scene.from_dict(scene))


# --- independent route ------------------------------------------------------------------------------------------------


def state_space(scene: fitact.Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return A, B, E of x' = A x + B V + E V'; x holds the voltages across the sliding skin, other elements, and Ci."""
    ground, measured, Ci = scene.grounding, scene.measurement, scene.device.Ci
    probe = 1.0 / (measured.probe_resistance or math.inf), measured.probe_capacitance or 0.0
    conductances, capacitances = [1.0 / scene.skin.Rsc + probe[0]], [scene.skin.Csc + probe[1]]
    series = measured.series_resistor
    if ground.connection == "direct":
        series += ground.R_H or 0.0
        conductances.append(1.0 / (ground.grounding_Rsc or scene.skin.Rsc))
        capacitances.append(ground.grounding_Csc or scene.skin.Csc)
    elif ground.Z_capacitance:
        conductances.append(1.0 / ground.Z)
        capacitances.append(ground.Z_capacitance)
    else:
        series += ground.Z
    if scene.gap.capacitance:
        conductances.append(1.0 / (scene.gap.resistance or math.inf))
        capacitances.append(scene.gap.capacitance)
    G, C = np.diag(conductances), np.diag(capacitances)
    one = np.ones(len(conductances))
    if series == 0.0:  # Ci (V - sum x)' flows through every element
        nodes = np.linalg.inv(C + Ci * np.outer(one, one))
        return -nodes @ G, 0.0 * one, nodes @ one * Ci
    C, G, one = scipy.linalg.block_diag(C, Ci), scipy.linalg.block_diag(G, 0.0), np.append(one, 1.0)
    return -np.linalg.solve(C, G + np.outer(one, one) / series), np.linalg.solve(C, one) / series, 0.0 * one


def lines(scene: fitact.Scene) -> list[tuple[float, float, float]]:
    """Return (length, V at the start, V at the end) of each linear piece of a period."""
    d = scene.drive
    T, high = 1.0 / d.frequency, 0.5 * d.peak_to_peak
    wave = d.shape if d.waveform == "burst" else d.waveform
    if wave == "square":
        return [(d.duty * T, high, high), ((1.0 - d.duty) * T, -high, -high)]
    if wave == "triangle":
        return [(0.25 * T, 0.0, high), (0.5 * T, high, -high), (0.25 * T, -high, 0.0)]
    rise = d.rise_time
    return [
        (rise, -high, high),
        (d.duty * T - rise, high, high),
        (rise, high, -high),
        ((1.0 - d.duty) * T - rise, -high, -high),
    ]


def window(scene: fitact.Scene) -> list[tuple[float, float, float]]:
    """Return the linear pieces over one period, or over the duration from rest."""
    if scene.drive.steady_state:
        return lines(scene)
    left, found = scene.measurement.duration, []
    cycles = scene.drive.cycles if scene.drive.waveform == "burst" else 10_000
    for length, start, end in itertools.chain(lines(scene) * cycles, [(math.inf, 0.0, 0.0)]):
        taken = min(length, left)
        found.append((taken, start, start + (end - start) * taken / length if taken < math.inf else end))
        left -= taken
        if left <= 1e-12:
            return found
    raise AssertionError


def grid(length: float) -> np.ndarray:
    return length * np.concatenate([[0.0], np.geomspace(1e-8, 0.1, 4000), np.linspace(0.1, 1.0, 1000)[1:]])


def skin_voltage(scene: fitact.Scene, lengths: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Return times and Vsc over consecutive intervals without corners."""
    A, B, E = state_space(scene)
    n, inverse = len(A), np.linalg.inv(A)
    rates, modes = np.linalg.eig(A)

    def steps(
        drive: list[tuple[float, float, float]], x: np.ndarray, before: float
    ) -> tuple[list[np.ndarray], np.ndarray]:
        found = []
        for length, start, end in drive:
            # on a linear piece: a linear solution, and a decaying difference from it
            slope = (end - start) / length
            line = -inverse @ B * slope
            level = inverse @ (line - B * start - E * slope)
            free = np.linalg.solve(modes, x + E * (start - before) - level)
            t = grid(length)[:, None]
            path = level + line * t + (np.exp(rates * t) * free) @ modes.T
            found.append(path[:, 0])
            x, before = path[-1], end
        return found, x

    begin, before = np.zeros(n), 0.0
    if scene.drive.steady_state:
        period = lines(scene)
        before = period[-1][2]
        offset = steps(period, begin, before)[1]
        slope = np.column_stack([steps(period, unit, before)[1] - offset for unit in np.eye(n)])
        begin = np.linalg.solve(np.eye(n) - slope, offset)
    times = [grid(length) + sum(lengths[:i]) for i, length in enumerate(lengths)]
    return np.concatenate(times), np.concatenate(steps(cut(window(scene), lengths), begin, before)[0])


def cut(drive: list[tuple[float, float, float]], lengths: list[float]) -> list[tuple[float, float, float]]:
    """Return the linear pieces cut at `lengths` and at their corners, repeated to fill these."""
    found, source = [], itertools.cycle(drive)
    left, start, end = next(source)
    for length in lengths:
        if left < 1e-9 * length:
            left, start, end = next(source)
        there = start + (end - start) * length / left
        found.append((length, start, there))
        left, start = left - length, there
    return found


def true_errors(full: fitact.Scene, reduced: fitact.Scene) -> np.ndarray:
    lengths = [length for length, *_ in window(full)]
    t, vsc = skin_voltage(full, lengths)
    _, other = skin_voltage(reduced, lengths)
    mean = np.trapezoid(vsc**2, t)
    peak = np.abs(other).max() / np.abs(vsc).max()
    return np.array([
        math.sqrt(np.trapezoid((other - vsc) ** 2, t) / mean),
        abs(peak - 1.0),
        abs(np.trapezoid(other**2, t) / mean - 1.0),
        abs(peak**2 - 1.0),
    ])  # fmt: skip


def random_scene(rng: np.random.Generator) -> fitact.Scene:
    def between(low: float, high: float) -> float:
        return math.exp(rng.uniform(math.log(low), math.log(high)))

    frequency = between(20.0, 1000.0)
    grounding: dict = {"connection": "natural", "Z": between(1e4, 1e8)}
    if rng.random() < 0.75:
        grounding = {"R_H": between(30.0, 3e3)} if rng.random() < 0.8 else {}
        if rng.random() < 0.5:
            grounding |= {"grounding_Rsc": between(150e3, 170e3), "grounding_Csc": between(20e-9, 25e-9)}
    elif rng.random() < 0.5:
        grounding["Z_capacitance"] = between(1e-13, 1e-9)
    measurement: dict = {"duration": between(0.7, 3.0) / frequency}
    if rng.random() < 0.5:
        measurement |= {"probe_resistance": between(1e7, 1e9), "probe_capacitance": between(1e-12, 1e-10)}
    if rng.random() < 0.4:
        measurement["series_resistor"] = between(10.0, 1e4)
    drive: dict = {"frequency": frequency, "waveform": str(rng.choice(["square", "trapezoid", "triangle", "burst"]))}
    if drive["waveform"] == "trapezoid":
        drive |= {"rise_time": between(1e-4, 0.05) / frequency, "duty": rng.uniform(0.2, 0.8)}
    if drive["waveform"] == "burst":
        drive["cycles"] = int(rng.integers(1, 4))
    elif rng.random() < 0.3:
        drive["steady_state"] = False
    skin = {"Rsc": between(50e3, 300e3), "Csc": between(5e-9, 50e-9)}
    content = {"grounding": grounding, "measurement": measurement, "drive": drive, "skin": skin}
    return fitact.Scene.from_dict(content | {"tolerance": {"force": between(1e-3, 0.1)}})


def check_random_scenes(count: int, seed: int) -> int:
    """Return how many plans have a cheaper model within the tolerance; assert that each plan is within it."""
    rng, dearer = np.random.default_rng(seed), 0
    for _ in range(count):
        scene = random_scene(rng)
        plan, tolerance = fitact.plan(scene), scene.tolerance.force
        errors = true_errors(scene, plan.scene)
        np.testing.assert_allclose(plan.nominal, errors, rtol=2e-3, atol=_GRID, err_msg=scene.to_json())
        assert errors[2:].max() <= tolerance * (1.0 + 2e-3), scene.to_json()
        free = [name for name in omissions.applicable_omissions(scene) if not omissions.reason_to_keep(scene, name)]
        for size in range(1, len(free) + 1):
            others = [omissions.reduce_scene(scene, names) for names in itertools.combinations(free, size)]
            cheaper = [
                other for other in others if omissions.evaluation_cost(other) < omissions.evaluation_cost(plan.scene)
            ]
            if any(true_errors(scene, other)[2:].max() < tolerance * (1.0 - 2e-3) for other in cheaper):
                dearer += 1
                break
    return dearer


# --- tests --------------------------------------------------------------------------------------------------------


def test_the_papers_scene_leaves_R_H_out_at_one_per_cent_and_keeps_it_at_a_tenth():
    plan = planned(**PAPER)
    assert plan.left_out == ("R_H",)
    assert type(plan.scene.make_circuit()) is fitact.FinalCircuit
    assert f"{plan.nominal.force_peak:.2g} {plan.nominal.force_mean:.1g}" == "0.0028 0.0003"
    strict = planned(**PAPER, tolerance={"force": 0.001})
    assert strict.left_out == ()
    assert strict.scene.make_circuit().R_H == 500.0
    assert strict.nominal.force == 0.0


GAP = {"gap": {"resistance": 2e6, "capacitance": 4e-10}}


@pytest.mark.parametrize(
    "scene",
    [
        GAP,
        {"gap": {"resistance": 1e5, "capacitance": 4e-8}, **PAPER},
        GAP | NATURAL | {"measurement": {"series_resistor": 1e3}},
    ],
)
def test_what_leaving_out_the_gap_changes(scene: dict):
    full = fitact.Scene.from_dict(scene)
    (omission,) = (each for each in fitact.plan(full).omissions if each.name == "gap")
    expected = true_errors(full, omissions.reduce_scene(full, ("gap",)))
    np.testing.assert_allclose(omission.nominal, expected, rtol=2e-3, atol=_GRID)


@pytest.mark.skipif(shutil.which("ngspice") is None, reason="ngspice is not installed (apt-get install ngspice)")
@pytest.mark.parametrize(("Ci", "stated"), [("1.35n", "0.0014"), ("3.45n", "0.0025")])
def test_error_of_the_peak_against_ngspice(Ci: str, stated: str, tmp_path: Path):
    source = f"PULSE(-180 180 0 {JUMP} {JUMP} {5e-3 - JUMP} 10m)"
    peaks = []
    for inner in (["R2 below 0 160k", "C2 below 0 22n"], ["RH below b 500", "R2 b 0 160k", "C2 b 0 22n"]):
        netlist = [f"Ci in skin {Ci}", "R1 skin below 160k", "C1 skin below 22n", *inner]
        peaks.append(np.abs(simulate(netlist, source, tmp_path, start=0.14)[1]).max())
    error = planned(**PAPER, device={"Ci": Ci + "F"}).omissions[0].nominal.Vsc_peak
    assert f"{error:.2g}" == f"{abs(peaks[0] / peaks[1] - 1.0):.2g}" == stated


def test_natural_ground_keeps_Z():
    for tolerance in (0.001, 0.1, 0.9):
        plan = planned(**NATURAL, tolerance={"force": tolerance})
        assert plan.left_out == ()
        assert plan.omissions[0].name == "Z"
    assert plan.omissions[0].nominal.force > 10.0


def test_a_burst_never_gets_the_steady_state():
    plan = planned(**BURST, tolerance={"force": 0.9})
    assert [o.name for o in plan.omissions] == ["transient", "float64"]
    assert plan.omissions[0].kept
    assert plan.scene.drive.waveform == "burst"
    # at the second edge, 360 V add to the rest of the first response: g (360 - 180 e^{-x}) and 360 g / (1 + e^{-x})
    left = math.exp(-5e-3 / (160e3 * 24.7e-9))
    assert plan.omissions[0].nominal.Vsc_peak == pytest.approx(
        1.0 - 1.0 / ((1.0 + left) * (1.0 - 0.5 * left)), rel=1e-6
    )


def test_ten_random_scenes_against_kirchhoffs_laws():
    assert check_random_scenes(10, seed=5) == 0


@pytest.mark.slow
def test_two_hundred_random_scenes():
    assert check_random_scenes(200, seed=6) == 0


def test_errors_are_judged_together():
    """Each of two resistors could be dropped, but not both; only the one that saves time is dropped."""
    scene = {"grounding": {"R_H": 300.0, "grounding_Rsc": 160e3}, "measurement": {"series_resistor": 300.0}}
    alone = [o.nominal.force for o in planned(**scene).omissions if o.name in ("R_H", "series resistor")]
    plan = planned(**scene, tolerance={"force": 1.5 * alone[0]})
    assert max(alone) < plan.full.tolerance.force
    assert set(plan.left_out).isdisjoint({"R_H", "series resistor"})
    assert set(planned(**scene, tolerance={"force": 2.5 * alone[0]}).left_out) >= {"R_H", "series resistor"}


def dispersive_skin(f: np.ndarray) -> np.ndarray:
    """Return the impedance of the paper's skin, interpolated log-log between its three frequencies."""
    knots = np.log([10.0, 100.0, 1000.0])
    where = np.log(np.minimum(f, 1000.0))
    R = np.exp(np.interp(where, knots, np.log([200e3, 160e3, 80e3])))
    C = np.exp(np.interp(where, knots, np.log([44.25e-9, 22e-9, 8.85e-9])))
    return R / (1.0 + 2j * np.pi * f * R * C)


def fractional_skin(f: np.ndarray) -> np.ndarray:
    """Return the impedance of a Cole element."""
    return 160e3 / (1.0 + (2j * np.pi * f * 160e3 * 22e-9) ** 0.7)


@pytest.mark.parametrize(
    ("skin", "impedance"),
    [({"level": "dispersive"}, dispersive_skin), ({"level": "fractional", "alpha": 0.7}, fractional_skin)],
)
def test_dispersion_against_a_sum_of_harmonics(skin: dict, impedance: Callable[[np.ndarray], np.ndarray]):
    """The rms values of the difference and of Vsc by Parseval."""
    plan = planned(skin=skin, drive={"waveform": "trapezoid", "rise_time": "50 us"})
    k = np.arange(1, 20_001)
    f = 100.0 * k
    s = 2j * np.pi * f
    drive = np.sin(0.5 * np.pi * k) * np.sinc(k * 0.005) / k  # up to a factor
    full, constant = (
        drive * skin / (2.0 * skin + 1.0 / (s * 1.35e-9)) for skin in (impedance(f), 160e3 / (1.0 + s * 160e3 * 22e-9))
    )
    full_square, square, difference = (np.sum(np.abs(x) ** 2) for x in (full, constant, full - constant))
    errors = {o.name: o.nominal for o in plan.omissions}["dispersion"]
    assert errors.Vsc_rms == pytest.approx(math.sqrt(difference / full_square), rel=1e-4)
    assert errors.force_mean == pytest.approx(abs(square / full_square - 1.0), rel=1e-4)
    assert plan.model()["skin"] == skin["level"]


def test_quantiles_are_those_of_the_prior():
    """Fingers drawn from the prior are planned one by one; the fraction with larger errors agrees with the quantile."""
    prior = {"Rsc": {"fixed": True}, "Ci": {"fixed": True}, "Csc": {"low": "5 nF", "high": "50 nF"}}
    stated = planned(**PAPER, prior=prior).omissions[0].q95.force_peak
    shares = np.linspace(0.005, 0.995, 12)
    held = prior | {"Csc": {"fixed": True}}
    alone = [
        planned(**PAPER, prior=held, skin={"Csc": 5e-9 + 45e-9 * p}).omissions[0].nominal.force_peak for p in shares
    ]
    assert stated == pytest.approx(np.interp(0.05, shares, alone), rel=0.03)  # the error decreases with Csc


def test_what_is_known_to_matter_is_kept():
    freed = planned(**PAPER, prior={"R_H": {"factor": 2}}, tolerance={"force": 0.5})
    assert freed.left_out == ()
    fixed = planned(grounding={}, prior={"R_H": {"fixed": "500 ohm"}})
    assert fixed.left_out == ("R_H",)
    assert "R_H" not in fixed.scene.prior.specs()
    assert planned(**PAPER, measurement={"channels": ["Vsc", "I"]}, tolerance={"force": 0.5}).left_out == ()
    tied = {"grounding_Rsc": {"tied": "R_H", "ratio": 300}, "R_H": {"fixed": "500 ohm"}}
    assert "R_H" not in planned(**PAPER, prior=tied, tolerance={"force": 0.5}).left_out


def test_only_what_the_scene_names_is_an_omission():
    assert [o.name for o in planned().omissions] == ["float64"]
    everything = planned(
        grounding={"R_H": 500, "grounding_Csc": 30e-9},
        measurement={"series_resistor": 100, "probe_capacitance": 1e-11},
        drive={"waveform": "trapezoid", "rise_time": "20 us", "steady_state": False},
    )
    names = ["R_H", "grounding skin", "series resistor", "probe", "edges", "transient", "float64"]
    assert [o.name for o in everything.omissions] == names
    natural = {"grounding": NATURAL["grounding"] | {"Z_capacitance": 1e-10}, "drive": {"waveform": "sine"}}
    assert [o.name for o in planned(**natural).omissions] == ["Z", "Z capacitance", "float64"]
    with pytest.raises(fitact.InputError, match="measured"):
        planned(drive={"waveform": "measured"})


@pytest.mark.slow
def test_a_chirp_against_scipy():
    chirp = {"waveform": "chirp", "start_frequency": 50, "end_frequency": 500, "sweep_time": "15 ms"}
    scene = {"grounding": {"R_H": "20 kohm"}, "measurement": {"duration": "15 ms"}, "drive": chirp}
    errors = planned(**scene).omissions[0].nominal
    t = np.linspace(0.0, 15e-3, 30_001)
    drive = np.sin(2.0 * np.pi * (50.0 * t + 0.5 * 450.0 / 15e-3 * t**2))
    Rsc, Csc, Ci = 160e3, 22e-9, 1.35e-9

    def vsc(R: float) -> np.ndarray:
        # Rsc Ci s / ((1 + Rsc Csc s) (1 + R Ci s) + 2 Rsc Ci s)
        polynomial = [Rsc * Csc * R * Ci, Rsc * Csc + R * Ci + 2.0 * Rsc * Ci, 1.0]
        return scipy.signal.lsim(([Rsc * Ci, 0.0], np.trim_zeros(polynomial, "f")), drive, t)[1]

    full, reduced = vsc(20e3), vsc(0.0)
    mean_square, peak = np.mean(full**2), np.abs(full).max()
    assert errors.Vsc_rms == pytest.approx(math.sqrt(np.mean((full - reduced) ** 2) / mean_square), rel=1e-3)
    assert errors.Vsc_peak == pytest.approx(abs(np.abs(reduced).max() / peak - 1.0), rel=1e-3)
    assert errors.force_mean == pytest.approx(abs(np.mean(reduced**2) / mean_square - 1.0), rel=1e-3)


def test_a_second_plan_takes_no_time():
    planned(**PAPER)
    begin = time.process_time()
    planned(**PAPER, device={"Ci": "3.45 nF"}, drive={"frequency": "60 Hz"})
    assert time.process_time() - begin < 1.0


def test_a_body_at_earth():
    """Z = 0 leaves one skin in series with Ci."""
    at_earth = fitact.Scene.from_dict({"grounding": {"connection": "natural", "Z": 0}}).make_circuit()
    s = 2j * np.pi * 100.0
    skin = 160e3 / (1.0 + s * 160e3 * 22e-9)
    found = complex(at_earth.transfer_function(2.0 * np.pi * 100.0))
    assert found == pytest.approx(skin / (skin + 1.0 / (s * 1.35e-9)), rel=1e-5)
    with pytest.raises(fitact.InputError, match="shorts"):
        fitact.Scene.from_dict({"grounding": {"connection": "natural", "Z": 0, "Z_capacitance": 1e-10}})


def test_draws_are_spread_evenly_over_the_prior():
    prior = fitact.Prior.from_marginals(Rsc=fitact.LogNormal(1e5, 0.5), Csc=fitact.Uniform(1e-9, 3e-9))
    drawn = prior.sample_qmc(500)
    shares = scipy.stats.norm.cdf(np.log(drawn["Rsc"] / 1e5) / 0.5), (drawn["Csc"] - 1e-9) / 2e-9
    # independent draws give 0.03, a lattice in two dimensions 0.02
    assert scipy.stats.qmc.discrepancy(np.column_stack(shares), method="L2-star") < 0.01
    np.testing.assert_array_equal(prior.sample_qmc(500)["Csc"], drawn["Csc"])


def test_a_multitone_by_phasors():
    """Without R_H, tone by tone; peaks on a fine grid."""
    tones, amplitudes, phases = (
        np.array([100.0, 300.0, 700.0]),
        np.array([100.0, 60.0, 40.0]),
        np.array([0.2, 1.0, -0.5]),
    )
    drive = {
        "waveform": "multitone",
        "frequencies": list(tones),
        "amplitudes": list(amplitudes),
        "phases": list(phases),
    }
    scene = fitact.Scene.from_dict({"drive": drive, "grounding": {"R_H": 5e3}, "tolerance": {"force": 0.5}})
    found = {omission.name: omission for omission in fitact.plan(scene).omissions}["R_H"].nominal
    s = 2j * np.pi * tones
    skin = 1.0 / (1.0 / 160e3 + s * 22e-9)
    waves = []
    for R_H in (5e3, 0.0):
        phasors = amplitudes * np.exp(1j * phases) * skin / (2.0 * skin + R_H + 1.0 / (s * 1.35e-9))
        waves.append(np.imag(phasors @ np.exp(s[:, None] * np.linspace(0.0, 0.01, 200_001)[:-1])))
    full, without = waves
    assert found.Vsc_rms == pytest.approx(np.sqrt(np.mean((without - full) ** 2) / np.mean(full**2)), rel=1e-6)
    assert found.Vsc_peak == pytest.approx(abs(np.abs(without).max() / np.abs(full).max() - 1.0), rel=1e-3)
    assert found.force_mean == pytest.approx(abs(np.mean(without**2) / np.mean(full**2) - 1.0), rel=1e-6)
