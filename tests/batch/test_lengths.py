"""Records of any length use the same compiled functions, and padding does not change a result."""

import functools

import jax
import numpy as np
import pytest
import scipy.optimize

import fitact
from fitact import compiled
from fitact.data.simulate import simulate

NAMES = ("Rsc", "Csc", "Ci")
WAVE = {"peak_to_peak": 360.0, "frequency": 100.0}
SQUARE = {"drive": WAVE | {"waveform": "square"}}
EDGED = {"drive": WAVE | {"waveform": "trapezoid", "rise_time": 3e-4}}
FROM_REST = {"drive": EDGED["drive"] | {"steady_state": False}}
MEASURED = {"drive": {"waveform": "measured"}}
REPEATING = {"drive": {"waveform": "measured", "steady_state": True}}
WITH_I = {"measurement": {"channels": ["Vsc", "I"]}}
STUDENT = {"measurement": {"noise_model": "student"}}
COLOURED = {"measurement": {"noise_model": "ar1"}}
FRACTIONAL = {"skin": {"level": "fractional"}}

# record, scene of the fit, sampling rate and length
KINDS = {
    "named": (SQUARE, SQUARE, 1e5, 4000),
    "with V": (SQUARE, SQUARE, 1e5, 4000),
    "period of no other": (SQUARE, SQUARE, 1.01e5, 4000),
    "measured": (FROM_REST, MEASURED, 1e5, 4000),
    "measured, repeating": (EDGED, REPEATING, 1e5, 4000),
    "from rest": (FROM_REST, FROM_REST, 1e5, 4000),
    "clipped": (SQUARE, SQUARE, 1e5, 4000),
    "offset": (SQUARE, SQUARE, 1e5, 4000),
    "current": (EDGED | WITH_I, EDGED | WITH_I, 1e5, 4000),
    "short": (SQUARE, SQUARE, 1e4, 300),
    "short, measured": (FROM_REST, MEASURED, 1e4, 300),
    "long": (SQUARE, SQUARE, 1e5, 80_000),
    "long, measured": (FROM_REST, MEASURED, 1e5, 30_000),
    "student": (SQUARE, SQUARE | STUDENT, 1e5, 4000),
    "coloured": (SQUARE, SQUARE | COLOURED, 1e5, 4000),
    "fractional": (EDGED | FRACTIONAL, EDGED | FRACTIONAL, 1e5, 4000),
}


@functools.cache
def whole(kind: str) -> fitact.Record:
    made, _, rate, length = KINDS[kind]
    samples = {"sampling_rate": rate, "duration": length / rate}
    return simulate(fitact.Scene.from_dict(made | {"measurement": made.get("measurement", {}) | samples}), seed=1)


def record(kind: str, missing: int = 0) -> fitact.Record:
    """Return a record of one kind, shortened by some samples at its end."""
    given, kept = whole(kind), slice(len(whole(kind)) - missing)
    channels = {name: np.array(given[name][kept]) for name in given.channels if name != "V" or _keeps_drive(kind)}
    if kind == "clipped":
        channels["Vsc"] = np.minimum(channels["Vsc"], 0.8 * channels["Vsc"].max())
    if kind == "offset":
        channels["Vsc"] += 3.0
    return fitact.Record.from_arrays(given.time[kept], **channels)


def _keeps_drive(kind: str) -> bool:
    return "measured" in kind or kind in ("with V", "current")


def scene(kind: str) -> fitact.Scene:
    return fitact.Scene.from_dict(KINDS[kind][1])


@pytest.mark.parametrize("samples", [20, 64, 65, 500, 513, 1000, 1024, 1025, 99_999, 1_048_576])
def test_little_is_added_and_lengths_are_few(samples: int):
    length = compiled.padded_length(samples)
    assert samples <= length <= max(1.125 * samples, samples + 63)
    octave = {compiled.padded_length(n) for n in range(samples, 2 * samples, 1 + samples // 1000)}
    assert len(octave) <= 9 or samples > 500_000


def test_the_longest_records_are_left_as_they_are():
    assert compiled.padded_length(1_048_577) == 1_048_577


def test_the_last_sample_is_repeated_without_weight():
    values = np.arange(65.0)
    assert np.array_equal(compiled.pad_samples(values), np.minimum(np.arange(128.0), 64.0))
    assert np.array_equal(compiled.pad_weight(np.ones(65)), np.arange(128) < 65)
    assert compiled.pad_samples(values[:10], 65).size == 128


def compiled_for(kind: str, caplog: pytest.LogCaptureFixture) -> list[str]:
    """Return what is compiled for fits of other lengths after the first."""
    given = scene(kind)
    fitact.fit(record(kind), given)
    caplog.clear()
    with jax.log_compiles():
        for missing in (7, 23, 41):
            assert fitact.fit(record(kind, missing), given).result == "successful"
    return [each.getMessage() for each in caplog.records if each.getMessage().startswith("Compiling")]


@pytest.mark.parametrize("kind", ["named", pytest.param("measured", marks=pytest.mark.slow)])
def test_another_length_compiles_nothing_anew(kind: str, caplog: pytest.LogCaptureFixture):
    assert compiled_for(kind, caplog) == []


@pytest.mark.slow
@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in ("named", "measured")])
def test_another_length_of_other_kinds_compiles_nothing_anew(kind: str, caplog: pytest.LogCaptureFixture):
    assert compiled_for(kind, caplog) == []


@pytest.mark.slow
def test_other_lengths_fitted_together_compile_nothing_anew(caplog: pytest.LogCaptureFixture):
    def rows(missing: int) -> fitact.Fits:
        made = record("named", missing)
        noise = np.random.default_rng(missing).standard_normal((16, len(made)))
        alike = [fitact.Record.from_arrays(made.time, Vsc=made["Vsc"] + 0.05 * each) for each in noise]
        return fitact.fit_many(alike, scene("named"), progress=False)

    rows(0)
    caplog.clear()
    with jax.log_compiles():
        assert all(row["trusted"] for missing in (7, 23, 41) for row in rows(missing))
    assert [each for each in caplog.records if each.getMessage().startswith("Compiling")] == []


def optimum(made: fitact.Record, fit: fitact.Fit) -> np.ndarray:
    """Return the optimum by MINPACK, from the closed form of a steady-state square."""
    half = np.floor(made.time * 200.0 + 1e-9)
    sign, since = np.where(half % 2 == 0.0, 1.0, -1.0), made.time - half / 200.0
    mean, sd = fit.likelihood.prior.log_mean, fit.likelihood.prior.log_sd

    def residuals(theta):
        R, C, Ci = np.exp(theta)
        g, b = Ci / (2.0 * Ci + C), R * (2.0 * Ci + C)
        model = sign * 360.0 * g / (1.0 + np.exp(-0.005 / b)) * np.exp(-since / b)
        return np.append((made["Vsc"] - model) / fit.sigma, (theta - mean) / sd)

    tight = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15}
    return scipy.optimize.least_squares(residuals, mean, method="lm", jac="3-point", **tight).x


@pytest.mark.parametrize("tolerance", [1e-3, 0.0])
@pytest.mark.parametrize("missing", [pytest.param(0, marks=pytest.mark.slow), 33, 148])
def test_an_answer_is_that_of_the_recorded_samples_alone(missing: int, tolerance: float):
    made = record("named", missing)
    fit = fitact.fit(made, scene("named"), tolerance=tolerance)
    assert fit.figures["samples"] == fit.residuals.size == len(made)
    assert np.abs(fit.theta - optimum(made, fit)).max() < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_filling_up_changes_no_answer(kind: str, monkeypatch: pytest.MonkeyPatch):
    made, given = record(kind, 33), scene(kind)
    filled = fitact.fit(made, given)
    monkeypatch.setattr(compiled, "padded_length", lambda samples: samples)
    plain = fitact.fit(made, given)
    # rounding may end least squares one step earlier; then the results differ by the distance to the optimum
    same = 1e-9 if filled.figures["steps"] == plain.figures["steps"] else 1e-5
    assert np.abs(filled.theta - plain.theta).max() < same * plain.sd.min()
    assert np.allclose(filled.residuals, plain.residuals, rtol=0.0, atol=same * plain.sigma)
    assert filled.warnings == plain.warnings
    for name in ("chi2_reduced", "rms_residual", "samples", "runs_z", "spectrum_p", "aic", "degrees_of_freedom"):
        assert filled.figures[name] == pytest.approx(plain.figures[name], rel=1e-5), name
