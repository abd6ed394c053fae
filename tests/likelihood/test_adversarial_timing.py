"""Posteriors of a delay that cross samples at an edge or a corner of the drive; against direct quadrature."""

import math

import numpy as np
import pytest
import scipy.signal

import fitact
from fitact.likelihood.compression import Compression, Interpolation
from tests.likelihood.quadrature import (
    CI,
    CSC,
    RSC,
    STEP,
    assert_log_density,
    assert_quantiles,
    default_prior,
    gaussian,
    integrate,
    normal,
    square_response,
)

SAMPLES = 4000
TIME = STEP * np.arange(SAMPLES)
TOTAL = 2.0 * CI + CSC
G, B = CI / TOTAL, RSC * TOTAL
MARGIN = 6  # samples at each end of a record whose drive is not known after a delay


def scene(**drive: object) -> fitact.Scene:
    return fitact.Scene.from_dict({"device": {"Ci": CI}, "drive": drive, "prior": {"Ci": {"fixed": True}}})


def assert_posterior(
    fit: fitact.Fit,
    delay_prior: tuple[float, float],
    unit_response,
    used: slice,
    half_widths: tuple[float, float, float],
    counts,
) -> np.ndarray:
    """Assert that a posterior is that of the quadrature over log b, log Csc and the delay in steps; return its delays.

    `unit_response` is a function of b (s) and the delay in steps. The prior of the delay is normal, with the mean and
    the sd of `delay_prior`, in steps. The signal is proportional to g, so a grid in g needs no sum over the samples.
    """
    start, observed = fit.likelihood.timing["delay"][0] / STEP, fit.record["Vsc"][used]

    def log_prior(log_Rsc: np.ndarray, log_Csc: np.ndarray, delay: np.ndarray) -> np.ndarray:
        return default_prior(log_Rsc, log_Csc) + normal(delay, *delay_prior)

    def log_density(log_b: np.ndarray, log_Csc: np.ndarray, delay: np.ndarray) -> np.ndarray:
        total = 2.0 * CI + np.exp(log_Csc)
        g, shape = CI / total, (log_b.size, 1, delay.size)
        units = [[unit_response(b, late)[used] for late in delay.ravel()] for b in np.exp(log_b.ravel())]
        products = np.array([[u @ observed for u in row] for row in units]).reshape(shape)
        norms = np.array([[u @ u for u in row] for row in units]).reshape(shape)
        squares = observed @ observed - 2.0 * g * products + g**2 * norms
        return gaussian(squares, observed.size) + log_prior(log_b - np.log(total), log_Csc, delay)

    centers = math.log(B), math.log(CSC), start
    box = [(x - w, x + w) for x, w in zip(centers, half_widths, strict=True)]
    (log_b, log_Csc, delay), weights = integrate(log_density, box, counts, rounds=2)
    posterior = fitact.sample(fit, seed=1, progress=False)
    assert_quantiles(posterior, weights, b=log_b, Csc=log_Csc, delay=delay)

    def log_density_of_samples(log_Rsc: float, log_Csc: float, since: float, log_sigma: float) -> float:
        total = 2.0 * CI + math.exp(log_Csc)
        residuals = observed - CI / total * unit_response(math.exp(log_Rsc) * total, start + since)[used]
        prior = float(log_prior(np.asarray(log_Rsc), np.asarray(log_Csc), np.asarray(start + since)))
        return float(gaussian(residuals @ residuals, residuals.size, log_sigma)) + prior

    assert_log_density(posterior, log_density_of_samples)
    return posterior.parameters()["delay"].ravel() / STEP


SQUARES = {
    "between two samples": (2.5, 500.0, 1.0),
    "across samples": (2.5, 500.0, 25.0),
    "across one edge at a time": (2.3, 500.4, 8.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SQUARES)
def test_delay_of_an_ideal_square_wave(name: str):
    """Test edges that all pass samples at the same delays, and edges that do so at different delays."""
    late, half_steps, noise = SQUARES[name]
    half = half_steps * STEP
    voltage = np.where(np.floor((TIME - late * STEP) / half + 1e-9) % 2 == 0, 180.0, -180.0)

    def unit_response(b: float, late: float) -> np.ndarray:
        return square_response(TIME - late * STEP, b, half)

    vsc = G * unit_response(B, late) + noise * np.random.default_rng(1).standard_normal(SAMPLES)
    given = fitact.Record.from_arrays(TIME, V=voltage, Vsc=vsc)
    fit = fitact.fit(given, scene(waveform="square", frequency=0.5 / half))
    assert "delay" in fit.names
    assert fit.full_because == ""
    assert isinstance(fit.likelihood.channels[0].compression, Interpolation)
    width = 0.012 * noise + 0.02
    delays = assert_posterior(
        fit,
        (fit.likelihood.timing["delay"][0] / STEP, math.sqrt(1.0 / 12.0)),  # around the start of the fit
        unit_response,
        slice(None),
        (2.0 * width, width, 1.5),
        (25, 41, 1200),  # a density that jumps at a quantile needs a fine grid of delays
    )
    if name == "between two samples":
        assert np.floor(delays.min()) == np.floor(delays.max())
    if name == "across samples":
        outside = np.mean((delays < 2.0) | (delays > 3.0))
        assert 0.01 < outside < 0.5
    if name == "across one edge at a time":
        # relative to samples, the edges lie at 0, 0.4, 0.8 and 0.2 steps; the density jumps where one passes a sample
        assert np.ptp(delays) > 0.3


def measured_drive() -> np.ndarray:
    """Return a trapezoid of 360 Vpp at 100 Hz with edges of four steps, which begins from rest."""
    voltage = np.interp(np.arange(SAMPLES) % 1000, [0, 4, 500, 504, 1000], [-180.0, 180.0, 180.0, -180.0, -180.0])
    voltage[:40] = 0.0
    return voltage


def late_response(voltage: np.ndarray, b: float, late: float) -> np.ndarray:
    """Return the response of s b / (1 + s b) to the polyline of the samples, `late` steps late, by scipy."""
    decay = math.exp(-STEP / b)
    rise = np.diff(voltage, append=voltage[-1])
    at_samples = scipy.signal.lfilter([0.0, (1.0 - decay) * b / STEP], [1.0, -decay], rise)
    times = np.arange(SAMPLES) - late
    before = np.clip(np.floor(times), 0, SAMPLES - 1).astype(int)
    since = np.where(times < 0.0, 0.0, (times - before) * STEP)
    return at_samples[before] * np.exp(-since / b) - b / STEP * rise[before] * np.expm1(-since / b)


MEASURED = {
    "half a step": (0.5, 2.0, ""),
    "a whole step": (2.0, 5.0, ""),
    "at the end of the table": (5.9, 3.0, ""),
    "beyond the table": (8.3, 3.0, "lie outside the range of the compression"),
}


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n != "half a step")) for n in MEASURED])
def test_delay_of_a_measured_drive(name: str):
    """Test delays between samples, across one, across the end of the table of delays, and beyond it."""
    late, noise, reason = MEASURED[name]
    voltage = measured_drive()

    def unit_response(b: float, late: float) -> np.ndarray:
        return late_response(voltage, b, late)

    vsc = G * unit_response(B, late) + noise * np.random.default_rng(2).standard_normal(SAMPLES)
    given = fitact.Record.from_arrays(TIME, V=voltage, Vsc=vsc)
    fit = fitact.fit(given, scene(waveform="measured", steady_state=False))
    assert "delay" in fit.names
    assert reason in fit.full_because
    assert bool(fit.full_because) == bool(reason)
    assert isinstance(fit.likelihood.channels[0].compression, Compression) == (not reason)
    assert fit.result == "successful"
    used = slice(MARGIN, SAMPLES - MARGIN)
    half_widths = 0.03 * noise, 0.016 * noise, abs(late - fit.likelihood.timing["delay"][0] / STEP) + 0.4 * noise
    delays = assert_posterior(fit, (0.0, 1.0), unit_response, used, half_widths, (31, 41, 121))
    if name == "half a step":
        assert np.floor(delays.min()) == np.floor(delays.max())
    elif name != "beyond the table":
        corner = round(late)
        assert np.mean(delays < corner) > 0.01
        assert np.mean(delays > corner) > 0.01
