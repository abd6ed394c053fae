"""Clock errors between recorder and generator, against closed forms."""

import jax
import numpy as np
import pytest

import fitact
from fitact.problem.drive_choice import choose_drive

RSC, CSC, CI = 130e3, 18e-9, 1.35e-9
G, B = CI / (2.0 * CI + CSC), RSC * (2.0 * CI + CSC)


def record(waveform: str, frequency: float, periods: int, per_period: int) -> fitact.Record:
    """Return Vsc in the steady state at 360 Vpp; the trigger comes 0.37 steps before the first sample."""
    time = (np.arange(periods * per_period) + 0.37) * 0.01 / per_period
    if waveform == "sine":
        s = 2j * np.pi * frequency
        vsc = 180.0 * np.imag(s * RSC * CI / (1.0 + s * B) * np.exp(s * time))
    else:
        half = 0.5 / frequency
        sign = np.where(time // half % 2 == 0, 1.0, -1.0)
        vsc = 360.0 * G * sign * np.exp(-(time % half) / B) / (1.0 + np.exp(-half / B))
    return fitact.Record.from_arrays(time, Vsc=vsc + 0.1 * np.random.default_rng(0).standard_normal(time.size))


def fitted(waveform: str, off: float, periods: int, per_period: int) -> fitact.Fit:
    scene = fitact.Scene.from_dict({"drive": {"waveform": waveform}})
    return fitact.fit(record(waveform, 100.0 * (1.0 + off), periods, per_period), scene)


@pytest.mark.parametrize(
    ("waveform", "off", "periods", "per_period"),
    [
        pytest.param("sine", 1e-5, 50, 400, marks=pytest.mark.slow),
        pytest.param("square", 3e-5, 50, 400, marks=pytest.mark.slow),  # no edge has passed a sample
        pytest.param("square", 3e-4, 5, 2000, marks=pytest.mark.slow),  # edges have passed samples
        pytest.param("square", 5e-4, 2, 25_000, marks=pytest.mark.slow),  # edges have passed many samples
    ],
)
def test_a_clock_is_found(waveform: str, off: float, periods: int, per_period: int):
    """An unnoticed 1e-5 over 50 periods biases b (sine) or g (square) by 13 standard errors or more."""
    fit = fitted(waveform, off, periods, per_period)
    assert fit.result == "successful"
    clock = fit.parameters()["clock"]
    frequency = float(fit.likelihood.channels[0].electrical.drive.frequency) * (1.0 + clock["q50"])
    assert abs(frequency / 100.0 - 1.0 - off) < 4.0 * clock["sd"]
    for name, truth in (("g", G), ("b", B)):
        assert abs(fit.derived()[name]["q50"] - truth) < 4.0 * fit.derived()[name]["sd"]


@pytest.mark.slow
def test_no_clock_where_there_is_none():
    fit = fitted("square", 0.0, 50, 400)
    assert fit.trusted
    assert fit.names == ("Rsc", "Csc", "Ci")


@pytest.mark.parametrize("periods", [2, 5])
@pytest.mark.parametrize("samples", [10_000, 50_000, pytest.param(400_000, marks=pytest.mark.slow)])
def test_a_fine_record_is_not_of_another_frequency(samples: int, periods: int):
    """The correlation that determines the frequency has its peak many small steps away from the period."""
    found = record("square", 100.0, periods, samples // periods)
    with jax.enable_x64(True):
        choice = choose_drive(found, fitact.Scene.from_dict({"drive": {"waveform": "square"}}))
    assert float(choice.drive.frequency) == 100.0
    assert choice.notes == ()


@pytest.mark.slow
def test_a_clock_is_sampled():
    fit = fitted("sine", 1e-5, 50, 400)
    posterior = fitact.sample(fit, seed=0, progress=False)
    assert posterior.trusted
    clock = posterior.parameters()["clock"]
    assert np.std(clock) == pytest.approx(fit.parameters()["clock"]["sd"], rel=0.1)
    low, high = (fit.profile("clock").low, fit.profile("clock").high)
    np.testing.assert_allclose(np.quantile(clock, [0.025, 0.975]), [low, high], atol=0.2 * np.std(clock))


def skewed(delay: float, samples: int = 6000) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return time, a recorded drive that begins after a rest, and Vsc without noise, late by `delay` (s)."""
    time, drive = 1e-5 * np.arange(samples), fitact.Trapezoid(360.0, 100.0, 30e-6)
    voltage = np.append(np.zeros(500), np.asarray(drive.value(time[:-500])))
    circuit = fitact.FinalCircuit(RSC, CSC, CI)
    signal = fitact.response(circuit, fitact.Sampled(time, voltage), time - delay, steady_state=False)
    return time, voltage, np.asarray(signal)


@pytest.mark.parametrize("steps", [0.03, -0.03, 1.02])
def test_a_skew_of_nearly_whole_steps_is_found(steps: float):
    """The fit starts where a sample lies on a corner of the drive, on either side of which the slope differs."""
    time, voltage, signal = skewed(steps * 1e-5)
    noise = np.random.default_rng(4).standard_normal((2, time.size))
    record = fitact.Record.from_arrays(time, V=voltage + 0.1 * noise[0], Vsc=signal + 0.02 * noise[1])
    fit = fitact.fit(record, fitact.Scene.from_dict({"drive": {"waveform": "measured"}}))
    assert fit.result == "successful"
    delay = fit.parameters()["delay"]
    assert delay["sd"] < 1e-7
    assert abs(delay["q50"] - steps * 1e-5) < 4.0 * delay["sd"]


@pytest.mark.parametrize("seed", range(6))
def test_a_skew_of_whole_steps_is_an_optimum_at_a_corner(seed: int):
    """The fit of some of these records starts at the corner, from where no step lowers the sum of squares."""
    time, voltage, signal = skewed(2e-5)
    noise = np.random.default_rng(seed).standard_normal(time.size)
    record = fitact.Record.from_arrays(time, V=voltage, Vsc=signal + 0.1 * noise)
    fit = fitact.fit(record, fitact.Scene.from_dict({"drive": {"waveform": "measured"}}))
    assert fit.result == "successful"
    assert abs(fit.parameters()["delay"]["q50"] - 2e-5) < 4.0 * fit.parameters()["delay"]["sd"]


@pytest.mark.slow
def test_a_skew_is_found_among_outliers():
    """Under Student's t, the samples at edges that a skew moves look like outliers; an unnoticed skew biases g.

    The oracle is the fit of the same record without outliers, under normal noise. The bounds are those of samples that
    differ: 5 % of them are outliers, and Student's t weights the others differently.
    """
    random, (time, voltage, signal) = np.random.default_rng(3), skewed(23e-6)
    noise = 0.1 * random.standard_normal(time.size)
    outliers = np.where(random.uniform(size=time.size) < 0.05, 10.0, 1.0)
    clean, spoilt = (fitact.Record.from_arrays(time, V=voltage, Vsc=signal + noise * each) for each in (1.0, outliers))
    scene = {"drive": {"waveform": "measured"}}
    normal = fitact.fit(clean, fitact.Scene.from_dict(scene))
    student = fitact.fit(spoilt, fitact.Scene.from_dict(scene | {"measurement": {"noise_model": "student"}}))
    assert (normal.trusted, student.trusted) == (True, True)
    assert student.full_because == ""
    assert 1e-3 < student.compression_error < 1e-2
    for name in ("g", "b"):
        ours, theirs = student.derived()[name], normal.derived()[name]
        assert abs(ours["q50"] - theirs["q50"]) < 4.0 * ours["sd"]
        assert 1.0 < ours["sd"] / theirs["sd"] < 1.6
    delay = student.parameters()["delay"]
    assert abs(delay["q50"] - 23e-6) < 4.0 * delay["sd"]
