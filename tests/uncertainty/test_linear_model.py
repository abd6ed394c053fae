"""Sensitivities by FFT against the derivatives of the likelihood's own residuals, by JAX."""

import jax
import numpy as np
import pytest

import fitact
from fitact.fitting.effects import channel_samples, linear_posterior
from fitact.uncertainty.channel_series import channel_series
from fitact.uncertainty.linear_model import LinearModel
from tests.uncertainty.simulation import NATURAL, SCENE, TIME, Case, trapezoid

UNKNOWN_CHARGE = {"drive": {"waveform": "measured"}}


def jacobian_of_likelihood(fit: fitact.Fit) -> np.ndarray:
    """Return the derivatives of the fitted signal in units of the noise, over the samples, without compression."""
    likelihood = fit.likelihood.without_compression()
    with jax.enable_x64(True):
        parts = jax.jacfwd(lambda theta: likelihood.residuals(theta, fit.laplace.sigmas))(fit.theta)
    return -np.concatenate([np.asarray(part)[: TIME.size] for part in parts])


def current_record() -> fitact.Record:
    """Return Vsc and I of a circuit whose current a resistor limits."""
    V, s = trapezoid(TIME), 2j * np.pi * np.fft.rfftfreq(TIME.size, TIME[1])
    skin = 160e3 / (1.0 + s * 160e3 * 22e-9)
    admittance = s * 1.35e-9 / (1.0 + s * 1.35e-9 * (2.0 * skin + 20e3))
    rng, lines = np.random.default_rng(0), np.fft.rfft(V)
    vsc, current = np.fft.irfft(skin * admittance * lines), np.fft.irfft(admittance * lines)
    noise = rng.standard_normal((2, TIME.size))
    return fitact.Record.from_arrays(TIME, V=V, Vsc=vsc + 0.1 * noise[0], I=current + 2e-8 * noise[1])


# the effects of what a model lacks are taken from the current of a stated drive only
RESISTOR = {
    "measurement": {"channels": ["Vsc", "I"], "series_resistor": "20 kohm"},
    "drive": {"waveform": "trapezoid", "peak_to_peak": 360.0, "frequency": 100.0, "rise_time": "100 us"},
}
CASES = {
    "steady": (Case("trapezoid", "none", 0.0, 1).record(), SCENE),
    "delay": (Case("trapezoid", "delay", 1.0, 1).record(), SCENE),
    "unknown charge": (Case("multisine", "none", 0.0, 1).record(), UNKNOWN_CHARGE),
    "natural ground": (Case("trapezoid", "none", 0.0, 1, ground="natural").record(), NATURAL),
    "current": (current_record(), SCENE | RESISTOR),
    "fractional": (
        Case("trapezoid", "dispersion", 5.0, 1).record(),
        SCENE | {"skin": {"level": "fractional", "alpha": 0.9}},
    ),
}


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] * (n not in ("delay", "unknown charge"))) for n in CASES]
)
def test_sensitivities_are_those_of_the_likelihood(name: str):
    record, scene = CASES[name]
    fit = fitact.fit(record, fitact.Scene.from_dict(scene))
    posterior = linear_posterior(fit.laplace)
    assert posterior is not None
    series = [channel_series(each, 100_000)[0] for each in channel_samples(fit.laplace, fit.traces)]
    model = LinearModel(posterior, series)
    width = fit.theta.size
    nuisances, _ = np.linalg.qr(model.design[: model.rows, width:])
    both = model.sensitivities(fit.theta), jacobian_of_likelihood(fit)
    ours, exact = (x - nuisances @ (nuisances.T @ x) for x in both)
    used = np.abs(exact).sum(axis=1) > 0.0
    size = np.linalg.norm(exact[used], axis=0)
    errors = np.linalg.norm((ours - exact)[used], axis=0) / size
    # V between samples differs; the slope at an edge is taken over two steps of 20 in an edge
    tolerance = np.where(np.array(fit.names) == "delay", 0.2, 2e-3)
    assert np.all(errors < tolerance), dict(zip(fit.names, errors, strict=True))
