"""Fits of other circuits, of several records, and of fixed or correlated parameters; the records come from scipy."""

import functools
from collections.abc import Sequence

import numpy as np
import pytest
import scipy.signal

import fitact

TRUTH = {"Rsc": 130e3, "Csc": 18e-9, "Ci": 1.35e-9}
STEP, PERIOD = 10e-6, 1000  # s, samples
NOISE_V, NOISE_I = 0.05, 20e-9


def wave(kind: str, amplitude: float, per_period: int, periods: int) -> np.ndarray:
    """Return a trapezoid with edges of four steps, or a sine or triangle."""
    phase = np.arange(periods * per_period) % per_period / per_period
    if kind == "sine":
        return amplitude * np.sin(2.0 * np.pi * phase)
    edge, half = 4.0 / per_period, 0.5
    knots = [0.0, edge, half, half + edge, 1.0] if kind == "trapezoid" else [0.0, 0.25, 0.25, 0.75, 1.0]
    heights = [-1.0, 1.0, 1.0, -1.0, -1.0] if kind == "trapezoid" else [0.0, 1.0, 1.0, -1.0, 0.0]
    return amplitude * np.interp(phase, knots, heights)


def channels(
    voltage: np.ndarray, Ci: float, elements: Sequence[tuple[float, float]], R0: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return Vsc and I of a loop of Ci, R0 and RC elements, the sliding skin first, by scipy.signal.lsim from rest.

    V is linear between samples, so V' (from which I is computed) is constant there.
    """
    unit = 1e-3  # s, so that the coefficients of the polynomials are of order 1
    below = [np.poly1d([R * C / unit, 1.0]) for R, C in elements]
    s, one = np.poly1d([1.0, 0.0]), np.poly1d([1.0])

    def product(but: int = -1) -> np.poly1d:
        return functools.reduce(np.polymul, [p for k, p in enumerate(below) if k != but], one)

    around = product() * np.poly1d([R0 * Ci / unit, 1.0])
    for k, (R, _) in enumerate(elements):
        around = around + s * product(k) * (R * Ci / unit)
    time = np.arange(voltage.size) * STEP / unit
    skin = (s * product(0) * (elements[0][0] * Ci / unit)).coeffs
    vsc = scipy.signal.lsim((skin, around.coeffs), voltage, time)[1]
    slope = np.diff(voltage, append=voltage[-1]) / STEP
    current = scipy.signal.lsim(((Ci * product()).coeffs, around.coeffs), slope, time, interp=False)[1]
    return vsc, current


def record(
    elements: Sequence[tuple[float, float]],
    R0: float = 0.0,
    *,
    kind: str = "trapezoid",
    amplitude: float = 180.0,
    per_period: int = PERIOD,
    seed: int = 0,
    gain: float = 1.0,
    offset: float = 0.0,
    noise: float = NOISE_V,
) -> fitact.Record:
    """Return two steady-state periods of V, Vsc and I."""
    voltage = wave(kind, amplitude, per_period, 14)
    vsc, current = channels(voltage, TRUTH["Ci"], elements, R0)
    last, rng = slice(12 * per_period, None), np.random.default_rng(seed)
    vsc = gain * vsc[last] + offset + noise * rng.standard_normal(2 * per_period)
    current = current[last] + NOISE_I * rng.standard_normal(2 * per_period)
    return fitact.Record.from_arrays(np.arange(2 * per_period) * STEP, V=voltage[last], Vsc=vsc, I=current)


SKIN = (TRUTH["Rsc"], TRUTH["Csc"])


def scene(**sections: dict[str, object]) -> fitact.Scene:
    drive = {"waveform": "trapezoid", "rise_time": 4 * STEP}
    return fitact.Scene.from_dict({"drive": drive} | sections)


def free(**factors: float) -> dict[str, object]:
    """Return priors around the values of the scene; 95 % lie within these factors."""
    return {name: {"factor": factor} for name, factor in factors.items()}


def assert_true(fit: fitact.Fit, **truth: float) -> None:
    """Assert agreement within four standard deviations, in logarithms."""
    for name, value in truth.items():
        i = fit.names.index(name)
        assert abs(fit.theta[i] - np.log(value)) < 4.0 * fit.sd[i], name


GROUNDING = {"grounding_Rsc": 80e3, "grounding_Csc": 44e-9}
NATURAL = {"connection": "natural", "Z": 14.5e6}
EARTH = (14.5e6, 100e-12)
PROBED = (1.0 / (1.0 / SKIN[0] + 1.0 / 10e6), SKIN[1] + 10e-12)


@pytest.mark.slow
def test_known_series_resistor_identifies_all_three():
    fit = fitact.fit(record([SKIN, SKIN], 100e3), scene(measurement={"series_resistor": 100e3}))
    assert fit.trusted
    assert fit.identifiability.verdict == "identified"
    assert_true(fit, **TRUTH)
    assert np.all(fit.sd < 0.01)


@pytest.mark.slow
def test_unequal_skins_by_vsc_and_current():
    sections = {"grounding": GROUNDING, "prior": free(grounding_Rsc=10.0, grounding_Csc=10.0)}
    made = record([SKIN, tuple(GROUNDING.values())])
    fit = fitact.fit(made, scene(measurement={"channels": ["Vsc", "I"]}, **sections))
    assert fit.trusted
    assert fit.identifiability.verdict == "identified"
    assert_true(fit, **TRUTH, **GROUNDING)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("elements", "R0", "sections"),
    [
        ([SKIN, tuple(GROUNDING.values())], 500.0, {"grounding": GROUNDING | {"R_H": 500.0}}),
        ([SKIN, SKIN], 500.0, {"grounding": {"R_H": 500.0}}),
        ([SKIN, SKIN], 500.0, {"grounding": {"R_H": 500.0}, "prior": free(R_H=5.0)}),
        ([SKIN, SKIN], 0.0, {}),
        ([SKIN], 14.5e6, {"grounding": NATURAL}),
        ([SKIN], 14.5e6, {"grounding": NATURAL, "prior": free(Z=3.0)}),
        ([SKIN, EARTH], 0.0, {"grounding": NATURAL | {"Z_capacitance": EARTH[1]}}),
        (
            [SKIN, EARTH],
            0.0,
            {"grounding": NATURAL | {"Z_capacitance": EARTH[1]}, "prior": free(Z=3.0, Z_capacitance=3.0)},
        ),
        ([PROBED, SKIN], 0.0, {"measurement": {"probe_resistance": 10e6, "probe_capacitance": 10e-12}}),
    ],
    ids=["direct", "R_H", "free R_H", "final", "natural", "free Z", "natural with C", "free Z and C", "probe"],
)
def test_the_papers_circuits(elements, R0: float, sections):
    stated = scene(**sections)
    fit = fitact.fit(record(elements, R0), stated)
    assert fit.trusted
    nominal = stated.nominal_values()
    assert_true(fit, **{name: TRUTH.get(name, nominal[name]) for name in fit.names})


@pytest.mark.slow
def test_parameters_tied_to_others():
    ties = {"grounding_Rsc": {"tied": "Rsc", "ratio": 0.5}, "grounding_Csc": {"tied": "Csc", "ratio": 2.0}}
    made = record([SKIN, (0.5 * SKIN[0], 2.0 * SKIN[1])])
    fit = fitact.fit(made, scene(prior=ties))
    assert fit.trusted
    assert fit.names == ("Rsc", "Csc", "Ci")
    assert_true(fit, **TRUTH)


@pytest.fixture(scope="module")
def first() -> fitact.Record:
    return record([SKIN, SKIN])


@pytest.fixture(scope="module")
def alone(first: fitact.Record) -> fitact.Fit:
    return fitact.fit(first, scene())


@pytest.mark.slow
def test_a_held_insulator_leaves_nothing_to_the_prior(first: fitact.Record):
    fit = fitact.fit(first, scene(prior={"Ci": {"fixed": True}}))
    assert fit.names == ("Rsc", "Csc")
    assert fit.identifiability.verdict == "identified"
    assert_true(fit, Rsc=TRUTH["Rsc"], Csc=TRUTH["Csc"])
    assert all(fit.parameters()[name]["contraction"] > 0.99 for name in fit.names)
    assert fit.parameters()["Rsc"]["sd"] < 0.01 * TRUTH["Rsc"]


@pytest.mark.slow
def test_correlated_beliefs_show_along_the_blind_direction(first: fitact.Record):
    """For given g and b, t along (-1, 1, 1) is normal with precision d' S^-1 d, where S is the prior covariance."""
    sd, r = np.log([3.0, 3.0, 1.5]) / 1.959963984540054, 0.8
    beliefs = free(Rsc=3.0, Csc=3.0, Ci=1.5) | {"correlation": {"Csc-Ci": r}}
    fit = fitact.fit(first, scene(prior=beliefs))
    covariance = np.diag(sd**2)
    covariance[1, 2] = covariance[2, 1] = r * sd[1] * sd[2]
    d, precision = np.array([-1.0, 1.0, 1.0]), np.linalg.inv(covariance)
    np.testing.assert_allclose(fit.sd, (d @ precision @ d) ** -0.5, rtol=2e-3)
    mean = np.log([160e3, 22e-9, 1.35e-9])
    assert d @ precision @ (fit.theta - mean) == pytest.approx(0.0, abs=0.02 * np.sqrt(d @ precision @ d))


def known(fit: fitact.Fit, name: str) -> float:
    return fit.derived()[name]["sd"] / fit.derived()[name]["mean"]


@pytest.mark.slow
def test_two_equal_records_are_worth_twice_one(first: fitact.Record, alone: fitact.Fit):
    both = fitact.fit([first, record([SKIN, SKIN], seed=1)], scene())
    assert both.trusted
    for name in ("g", "b"):
        assert known(both, name) == pytest.approx(known(alone, name) / np.sqrt(2.0), rel=0.05)


@pytest.mark.slow
def test_records_of_different_drives_noises_gains_and_offsets(first: fitact.Record):
    """A measured trapezoid, and a named sine of another amplitude and frequency."""
    sine = record(
        [SKIN, SKIN], kind="sine", amplitude=50.0, per_period=500, seed=2, gain=1.03, offset=0.3, noise=2.0 * NOISE_V
    )
    drive = {"waveform": "sine", "peak_to_peak": 100.0, "frequency": 200.0}
    gained = fitact.Scene.from_dict({"drive": drive, "measurement": {"gain_relative_sd": 0.05}})
    measured = fitact.Scene.from_dict({"drive": {"waveform": "measured"}})
    both, alone = fitact.fit([first, sine], [measured, gained]), fitact.fit(first, measured)
    assert both.trusted
    assert both.traces[0].sigma == pytest.approx(NOISE_V, rel=0.1)
    assert both.traces[1].sigma == pytest.approx(2.0 * NOISE_V, rel=0.15)
    assert both.linear["offset_2"] == pytest.approx(0.3, abs=0.02)
    assert_true(both, gain_2=1.03)
    assert known(both, "b") < known(alone, "b")
    assert abs(both.derived()["b"]["q50"] / (130e3 * 20.7e-9) - 1.0) < 4.0 * known(both, "b")
