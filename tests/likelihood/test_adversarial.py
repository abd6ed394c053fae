"""Posteriors that are far from normal: cut by a bound, or of noise with heavy tails; against direct quadrature."""

import math

import numpy as np
import pytest
import scipy.special

import fitact
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
    log_Csc_prior,
    log_Rsc_prior,
    square_vsc,
)

NOISE = 0.5  # V
AROUND = [(math.log(RSC) - 0.03, math.log(RSC) + 0.03), (math.log(CSC) - 0.03, math.log(CSC) + 0.03)]
DEFAULTS = {"Rsc": log_Rsc_prior, "Csc": log_Csc_prior}


def times(samples: int) -> np.ndarray:
    return STEP * np.arange(samples)


def scene(prior: dict[str, object], **measurement: object) -> fitact.Scene:
    return fitact.Scene.from_dict(
        {
            "device": {"Ci": CI},
            "drive": {"waveform": "square"},
            "prior": {"Ci": {"fixed": True}} | prior,
            "measurement": measurement,
        }
    )


def record(noise: np.ndarray) -> fitact.Record:
    time = times(noise.size)
    return fitact.Record.from_arrays(time, Vsc=square_vsc(time, math.log(RSC), math.log(CSC)) + NOISE * noise)


# the estimates without bounds are 130.08 kohm ± 0.22 kohm and 18.013 nF ± 0.018 nF
BOUNDS = {
    "Csc just below the estimate": {"Csc": (10e-9, 18.01e-9)},
    "Csc 3.5 sd below the estimate": {"Csc": (10e-9, 17.95e-9)},
    "Rsc within 1.5 sd of a bound": {"Rsc": (129.8e3, 1e6)},
    "Rsc 2.4 sd above the estimate": {"Rsc": (130.6e3, 1e6)},
    "Rsc and Csc, no axis meets the support": {"Rsc": (130.3e3, 1e6), "Csc": (10e-9, 17.98e-9)},
}


FIRST = next(iter(BOUNDS))


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n != FIRST)) for n in BOUNDS])
def test_a_bound_cuts_what_the_data_determine(name: str):
    """Test that the quantiles are those of the truncated law, and that the fit says if its optimum is forbidden."""
    bounds = BOUNDS[name]
    given = record(np.random.default_rng(1).standard_normal(4000))
    time, observed = given.time, given["Vsc"]
    fit = fitact.fit(given, scene({key: {"low": low, "high": high} for key, (low, high) in bounds.items()}))
    assert fit.full_because == ""
    assert fit.compression_error < 1e-3
    assert fit.result == ("on_bound" if "Csc" in bounds else "successful")

    def log_prior(log_Rsc: np.ndarray, log_Csc: np.ndarray) -> np.ndarray:
        parts = []
        for key, u in (("Rsc", log_Rsc), ("Csc", log_Csc)):
            if key in bounds:
                low, high = np.log(bounds[key])
                parts.append(np.where((u >= low) & (u <= high), u, -np.inf))  # uniform in the value
            else:
                parts.append(DEFAULTS[key](u))
        return parts[0] + parts[1]

    def log_density(log_Rsc: np.ndarray, log_Csc: np.ndarray) -> np.ndarray:
        squares = [
            np.sum(np.square(observed[:, None] - square_vsc(time[:, None], u, log_Csc.ravel())), axis=0)
            for u in log_Rsc.ravel()
        ]
        return gaussian(np.array(squares), time.size) + log_prior(log_Rsc, log_Csc)

    box = []
    for (low, high), key in zip(AROUND, ("Rsc", "Csc"), strict=True):
        ends = np.log(bounds[key]) if key in bounds else (low, high)
        box.append((max(low, ends[0]), min(high, ends[1])))
    (log_Rsc, log_Csc), weights = integrate(log_density, box, (61, 61))
    posterior = fitact.sample(fit, seed=1, progress=False)
    assert_quantiles(posterior, weights, Rsc=log_Rsc, Csc=log_Csc)
    assert_log_density(
        posterior,
        lambda log_Rsc, log_Csc, log_sigma: (
            gaussian(np.sum(np.square(observed - square_vsc(time, log_Rsc, log_Csc))), time.size, log_sigma)
            + log_prior(log_Rsc, log_Csc)
        ),
    )


def student(residuals: np.ndarray, log_sigma: float) -> float:
    """Return the log-likelihood under Student's t with 4 degrees of freedom, up to a constant."""
    squares = np.square(residuals * np.exp(-log_sigma)) / 4.0
    return float(-2.5 * np.sum(scipy.special.log1p(squares)) - residuals.size * log_sigma)


def normal_noise(residuals: np.ndarray, log_sigma: float) -> float:
    return float(gaussian(residuals @ residuals, residuals.size, log_sigma))


HEAVY = {  # noise model, samples, tolerance: part of the reason for the full sum, result
    ("white", 2000, 1e-3): ("", "structure"),  # outliers widen the errors, and bias nothing
    ("student", 2000, 1e-3): ("", "successful"),
    ("student", 2000, 1e-4): ("error of the compressed log-likelihood", "successful"),
    ("student", 12_000, 1e-3): ("", "successful"),
}


def heavy_record(samples: int) -> fitact.Record:
    """Return a record in which the noise of one sample in twenty is ten times as large."""
    rng = np.random.default_rng(2)
    return record(rng.standard_normal(samples) * np.where(rng.uniform(size=samples) < 0.05, 10.0, 1.0))


@pytest.mark.slow
@pytest.mark.parametrize(("model", "samples", "tolerance"), HEAVY)
def test_one_sample_in_twenty_is_an_outlier(model: str, samples: int, tolerance: float):
    """Test Student-t noise, whose expansion must hold to ten tolerances, and what normal noise gives."""
    reason, result = HEAVY[model, samples, tolerance]
    given = heavy_record(samples)
    time, observed = given.time, given["Vsc"]
    fit = fitact.fit(given, scene({}, noise_model=model), tolerance=tolerance)
    assert fit.result == result
    assert reason in fit.full_because
    assert (fit.compression_error is None) == bool(reason)
    log_likelihood = student if model == "student" else normal_noise

    def log_density(log_Rsc: float, log_Csc: float, log_sigma: float) -> float:
        residuals = observed - square_vsc(time, log_Rsc, log_Csc)
        return log_likelihood(residuals, log_sigma) + float(default_prior(log_Rsc, log_Csc))

    def on_grid(*mesh: np.ndarray) -> np.ndarray:
        points = np.broadcast_arrays(*mesh)
        return np.array([log_density(*map(float, p)) for p in zip(*map(np.ravel, points), strict=True)]).reshape(
            points[0].shape
        )

    sd = np.linalg.norm(fit.point_root, axis=1)
    box = list(zip(fit.point - 7.0 * sd, fit.point + 7.0 * sd, strict=True))
    mesh, weights = integrate(on_grid, box, (17, 17, 17), rounds=1)
    posterior = fitact.sample(fit, seed=1, progress=False)
    assert_quantiles(posterior, weights, **dict(zip(("Rsc", "Csc", "sigma"), mesh, strict=True)))
    assert_log_density(posterior, log_density)


def test_what_student_noise_gains_on_outliers():
    """Test that errors of normal noise grow with its rms, by sqrt(0.95 + 0.05 * 100) = 2.44, and Student's hardly."""
    fits = {model: fitact.fit(heavy_record(2000), scene({}, noise_model=model)) for model in ("white", "student")}
    assert any("outliers for Gaussian noise" in warning for warning in fits["white"].warnings)
    clean = fitact.fit(record(np.random.default_rng(2).standard_normal(2000)), scene({}))
    ratios = {model: float(np.mean(fit.sd / clean.sd)) for model, fit in fits.items()}
    assert ratios["white"] == pytest.approx(math.sqrt(0.95 + 0.05 * 100.0), rel=0.15)
    assert ratios["student"] < 1.35


TONES, HEIGHTS = 2.0 * np.pi * np.array([100.0, 300.0, 700.0, 2000.0]), np.array([60.0, 50.0, 40.0, 30.0])


@pytest.mark.slow  # compiles a structure that no other test has, and samples it for half a minute
def test_an_exponent_at_its_bound():
    """Test a skin that is constant within the errors, so that the bound of the exponent, 1, cuts its posterior."""
    time = times(2000)
    waves = np.exp(1j * np.outer(time, TONES))
    signals = np.hstack([waves.real, waves.imag])

    def amplitudes(log_Rsc: np.ndarray, log_Csc: np.ndarray, log_alpha: np.ndarray) -> np.ndarray:
        Rsc, Csc, exponent = (np.exp(u)[..., None] for u in (log_Rsc, log_Csc, log_alpha))
        skin = Rsc / (1.0 + (1j * TONES * Rsc * Csc) ** exponent)
        vsc = HEIGHTS * skin / (1.0 / (1j * TONES * CI) + 2.0 * skin)
        return np.concatenate([vsc.imag, vsc.real], axis=-1)

    true = signals @ amplitudes(*map(np.asarray, (math.log(RSC), math.log(CSC), 0.0)))
    observed = true + 0.02 * np.random.default_rng(3).standard_normal(time.size)
    given = fitact.Record.from_arrays(time, V=waves.imag @ HEIGHTS, Vsc=observed)
    drive = {"waveform": "multitone", "frequencies": (TONES / (2.0 * np.pi)).tolist(), "amplitudes": HEIGHTS.tolist()}
    stated = fitact.Scene.from_dict(
        {
            "device": {"Ci": CI},
            "drive": drive,
            "skin": {"level": "fractional"},
            "prior": {"Ci": {"fixed": True}, "alpha": {"low": 0.3, "high": 1.0}},
        }
    )
    fit = fitact.fit(given, stated)
    assert fit.full_because == ""
    assert fit.compression_error < 1e-3
    assert fit.result == "successful"
    order = [fit.names.index(name) for name in ("Rsc", "Csc", "alpha")]

    def log_density(log_Rsc, log_Csc, log_alpha, log_sigma=None) -> np.ndarray:
        sizes = amplitudes(*np.broadcast_arrays(log_Rsc, log_Csc, log_alpha))
        squares = observed @ observed - 2.0 * sizes @ (signals.T @ observed)
        squares = squares + np.einsum("...i,ij,...j", sizes, signals.T @ signals, sizes)
        allowed = np.where((log_alpha <= 0.0) & (log_alpha >= math.log(0.3)), log_alpha, -np.inf)
        return gaussian(squares, time.size, log_sigma) + default_prior(log_Rsc, log_Csc) + allowed

    centers, widths = fit.theta[order], 7.0 * fit.sd[order]
    box = [(x - w, x + w) for x, w in zip(centers, widths, strict=True)]
    box[2] = box[2][0], 0.0
    mesh, weights = integrate(log_density, box, (41, 41, 81))
    posterior = fitact.sample(fit, seed=1, progress=False)
    assert_quantiles(posterior, weights, **dict(zip(("Rsc", "Csc", "alpha"), mesh, strict=True)))
    assert_log_density(
        posterior, lambda *point: float(log_density(*(np.asarray(point[i]) for i in order), log_sigma=point[3]))
    )
