"""Coloured noise, outliers, clipped and rounded samples: known truths, and scipy as the reference."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import scipy.optimize
import scipy.signal
import scipy.stats

import fitact
from fitact.data.clipping import clipping_mask, has_flat_levels
from fitact.likelihood.charge_rows import RowCovariance
from fitact.likelihood.noise import (
    Autoregression,
    Whitening,
    draw_noise,
    fit_ar_burg,
    scale_information,
    student_curvature,
    student_residual,
    student_weight,
)
from tests.conftest import skin_voltage, square_record

G, B = 1.35 / 20.7, 130e3 * 20.7e-9


def scene(waveform: str = "square", **measurement: object) -> fitact.Scene:
    drive = {"waveform": waveform} | ({"cycles": 2} if waveform == "burst" else {})
    return fitact.Scene.from_dict({"drive": drive, "measurement": measurement})


def with_vsc(record: fitact.Record, vsc: np.ndarray) -> fitact.Record:
    return fitact.Record.from_arrays(record.time, V=record["V"], Vsc=vsc)


def deviations(fits: list[fitact.Fit]) -> np.ndarray:
    """Return the errors of g and b in units of their stated standard deviations."""
    found = [fit.derived() for fit in fits]
    return np.array([[(d[n]["q50"] - truth) / d[n]["sd"] for n, truth in (("g", G), ("b", B))] for d in found])


def autoregressive(rng: np.random.Generator, size: int) -> np.ndarray:
    return np.sqrt(1.0 - 0.81) * scipy.signal.lfilter([1.0], [1.0, -0.9], rng.standard_normal(size + 200))[200:]


def test_student_residuals_are_the_t_density():
    z = np.array([-1e3, -3.0, -1e-4, 0.0, 1e-9, 0.7, 40.0])
    log = scipy.stats.t.logpdf(z, 4) - scipy.stats.t.logpdf(0.0, 4)
    np.testing.assert_allclose(-0.5 * np.asarray(student_residual(z)) ** 2, log, rtol=1e-5, atol=1e-12)
    mean_curvature, _ = scipy.integrate.quad(lambda x: scipy.stats.t.pdf(x, 4) * student_curvature(x), -np.inf, np.inf)
    mean_weight, _ = scipy.integrate.quad(lambda x: scipy.stats.t.pdf(x, 4) * student_weight(x), -np.inf, np.inf)
    assert mean_curvature == pytest.approx(5.0 / 7.0, rel=1e-5)  # (nu + 1) / (nu + 3), Fisher information of a location
    assert mean_weight == pytest.approx(1.0, rel=1e-5)


@pytest.mark.parametrize(("model", "law"), [("student", scipy.stats.t(4)), ("white", scipy.stats.norm())])
def test_information_on_a_scale_is_the_mean_square_of_its_score(model: str, law):
    def squared_score(x: float) -> float:
        up, down = (law.logpdf(x * np.exp(-step)) - step for step in (1e-5, -1e-5))
        return ((up - down) / 2e-5) ** 2

    mean, _ = scipy.integrate.quad(lambda x: law.pdf(x) * squared_score(x), -40.0, 40.0, points=[0.0], limit=200)
    assert scale_information(model) == pytest.approx(mean, rel=1e-4)


def test_student_noise_is_drawn_with_its_tails():
    drawn = draw_noise(np.random.default_rng(0), "student", None, (200, 1000))
    assert scipy.stats.kstest(drawn.ravel(), "t", (4,)).pvalue > 1e-3


@pytest.mark.parametrize("coefficients", [[0.9], [1.2, -0.5]])
@pytest.mark.parametrize("stride", [1, 3])
def test_coloured_noise_is_drawn_with_its_correlations(coefficients: list[float], stride: int):
    impulse = scipy.signal.lfilter([1.0], np.append(1.0, -np.array(coefficients)), np.eye(1, 400)[0])
    law = np.correlate(impulse, impulse, "full")[399:]
    process = Autoregression(np.array(coefficients), law[0] ** -0.5)
    whitening = process.whitening(np.ones(50 * stride, bool))
    drawn = draw_noise(np.random.default_rng(0), "spectrum", whitening, (20_000, 50), stride)
    found = drawn.T @ drawn / len(drawn)
    # also by position in the record; standard errors are at most 0.01
    expected = scipy.linalg.toeplitz(law[: 50 * stride : stride] / law[0])
    np.testing.assert_allclose(found, expected, atol=0.05)


def test_noise_that_a_pole_and_differences_colour_is_whitened():
    """Own white noise, and white noise n of V through u[k] = a u[k - 1] + g (n[k] - n[k - 1])."""
    size, a, g, own = 60, 0.7, 1.5, 0.4
    differences = g * scipy.linalg.toeplitz([1.0, -1.0, *np.zeros(size - 2)], np.eye(1, size)[0])
    taps = scipy.linalg.toeplitz([1.0, -a, *np.zeros(size - 2)], np.eye(1, size)[0])
    dense = (own**2 * taps @ taps.T + differences @ differences.T)[1:, 1:]
    variance, neighbours = np.diag(dense)[[0]] * np.ones(size), dense[0, 1] * np.ones(size)
    covariance = RowCovariance(variance, neighbours, np.arange(size) == 0)
    whitening = Whitening(np.array([1.0, -a]), covariance.used * 1.0, *covariance.recursion(own))
    values = np.random.default_rng(0).standard_normal((3, size))
    expected = own * np.linalg.solve(np.linalg.cholesky(dense), (values @ taps.T)[:, 1:].T).T
    with jax.enable_x64(True):
        white = np.asarray(whitening(jnp.asarray(values)))
    np.testing.assert_allclose(white[:, 1:], expected, rtol=1e-10)


def test_burg_finds_a_known_process():
    rng = np.random.default_rng(0)
    values = scipy.signal.lfilter([1.0], [1.0, -1.2, 0.5], rng.standard_normal(21_000))[1000:]
    found = fit_ar_burg(values)
    assert found.coefficients[:2] == pytest.approx([1.2, -0.5], abs=0.03)  # four standard errors
    # closed form: the variance of the process is (1 - a2) / (1 + a2) / ((1 - a2)^2 - a1^2) times the innovation's
    variance = 1.5 / 0.5 / (1.5**2 - 1.2**2)
    assert found.innovation_ratio**-2.0 == pytest.approx(variance, rel=0.05)


@pytest.mark.slow
def test_outliers_cost_student_little_and_white_much():
    record = square_record(per_period=200)
    rng = np.random.default_rng(5)
    spoilt = np.array(record["Vsc"])
    spoilt[rng.choice(spoilt.size, 4, replace=False)] += 20.0 * 0.05
    white = fitact.fit(with_vsc(record, spoilt), scene())
    student = fitact.fit(with_vsc(record, spoilt), scene(noise_model="student"))
    clean = fitact.fit(record, scene())
    assert white.result == "structure"  # four samples hardly move the result
    assert any("4 samples of Vsc" in warning and "student" in warning for warning in white.warnings)
    assert not any("outliers" in warning for warning in student.warnings)
    assert student.trusted
    assert "512 samples" in student.full_because
    for name in ("g", "b"):
        good, robust, plain = (fit.derived()[name] for fit in (clean, student, white))
        assert abs(robust["q50"] - good["q50"]) < 0.7 * good["sd"]
        assert robust["sd"] < 1.25 * good["sd"]
        assert plain["sd"] > 1.7 * good["sd"]
    # scale of the noise from scipy's fit of the density
    scale = scipy.stats.t.fit(student.residuals, fdf=4, floc=0.0)[2]
    assert student.sigma == pytest.approx(scale, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(("model", "covers"), [("ar1", True), ("white", False)])
def test_intervals_cover_under_autoregressive_noise(model: str, covers: bool):
    """Errors in units of their standard deviations have an rms of 1 ± 0.13 for 30 records."""
    record = square_record(per_period=200, noise=0.0)
    fits = []
    for seed in range(30):
        noise = 0.05 * autoregressive(np.random.default_rng(seed), len(record))
        fits.append(fitact.fit(with_vsc(record, record["Vsc"] + noise), scene(noise_model=model)))
    spread = np.sqrt(np.mean(deviations(fits) ** 2, axis=0))
    assert all(fit.trusted for fit in fits) == covers
    assert np.all((spread > 0.6) & (spread < 1.4)) if covers else np.all(spread > 2.0)


def burst_record() -> fitact.Record:
    """Return 40 ms of rest, three periods of a triangle and rest, at 20 kHz, by scipy, without noise: Vsc and I."""
    time = np.arange(-800, 1000) * 50e-6
    voltage = np.where(
        (time > 0.0) & (time < 0.03), 180.0 * np.interp(time % 0.01, [0.0, 2.5e-3, 7.5e-3, 0.01], [0, 1, -1, 0]), 0.0
    )
    slope = np.diff(voltage) / 50e-6
    rate = 0.5 * (np.append(slope, 0.0) + np.append(0.0, slope))
    # I = V s Ci (1 + s Rsc Csc) / (1 + s b): dV/dt through the three capacitances, and a part that decays with b
    at_once = 1.35e-9 * 18e-9 / 20.7e-9
    decaying = scipy.signal.lsim(([1.35e-9 - at_once, 0.0], [B, 1.0]), voltage, time - time[0])[1]
    vsc = skin_voltage(time - time[0], voltage, 130e3, 18e-9, 1.35e-9)
    return fitact.Record.from_arrays(time, V=voltage, Vsc=vsc, I=at_once * rate + decaying)


def pink(rng: np.random.Generator, size: int) -> np.ndarray:
    """Return noise of standard deviation 1 whose spectrum falls as 1/f above the lowest frequencies."""
    lines = np.fft.rfft(rng.standard_normal(4096))
    values = np.fft.irfft(lines / np.sqrt(np.arange(lines.size) + 3.0))
    return values[:size] / values.std()


@pytest.mark.slow
def test_a_measured_spectrum_widens_what_white_noise_would_make_too_narrow():
    """The rms of 12 normalised errors is 1 ± 0.2."""
    record = burst_record()
    stated = {"waveform": "measured"}, {"channels": ["Vsc"]}
    plain, quiet = (
        fitact.Scene.from_dict({"drive": stated[0], "measurement": stated[1] | more})
        for more in ({}, {"noise_model": "spectrum", "quiet": ["-40 ms", "-0.1 ms"]})
    )
    made = []
    for seed in range(12):
        noise = 1e-3 * np.ptp(record["Vsc"]) * pink(np.random.default_rng(seed), len(record))
        made.append(fitact.Record.from_arrays(record.time, V=record["V"], Vsc=record["Vsc"] + noise))
    fits = [fitact.fit(each, quiet) for each in made]
    assert not any("more than noise" in warning for fit in fits for warning in fit.warnings)
    assert np.all(np.sqrt(np.mean(deviations(fits) ** 2, axis=0)) < 1.7)
    assert np.sqrt(np.mean(deviations([fitact.fit(each, plain) for each in made[:4]]) ** 2)) > 2.0
    posterior = fitact.sample(fits[0], seed=1, progress=False)
    assert posterior.trusted
    for name, draws in posterior.derived().items():  # a delay has a kink at a sample, beside which Laplace is too wide
        assert draws.std() == pytest.approx(fits[0].derived()[name]["sd"], rel=0.15)


@pytest.mark.slow
def test_a_decay_in_the_quiet_stretch_is_noticed():
    record = burst_record()
    noise = 0.05 * pink(np.random.default_rng(7), len(record))
    fit = fitact.fit(
        with_vsc(record, record["Vsc"] + noise),
        scene("measured", noise_model="spectrum", quiet=["30.5 ms", "50 ms"]),
    )
    assert any("quiet contains more than noise" in warning for warning in fit.warnings)
    # noise as wide as that leaves the edges late by a hundredth of a step
    assert fit.figures["rms_residual"] < 0.2 < fit.sigma


@pytest.mark.slow
def test_student_noise_is_as_wide_as_sampled_and_predicted_with_its_tails():
    record, rng = square_record(per_period=200, noise=0.0), np.random.default_rng(3)
    noisy = record["Vsc"] + 0.05 * rng.standard_t(4, len(record))
    fit = fitact.fit(with_vsc(record, noisy), scene(noise_model="student"))
    posterior = fitact.sample(fit, seed=1, progress=False)
    assert posterior.trusted
    # 400 samples determine the information of a scale to 4 %; normal noise would give 0.76
    assert fit.point_root[-1, -1] == pytest.approx(np.log(posterior.parameters()["sigma"]).std(), rel=0.1)
    far = np.abs(scattered(posterior, "Vsc"))
    ratio = np.quantile(far, 0.99) / np.median(far)
    assert ratio == pytest.approx(scipy.stats.t.ppf(0.995, 4) / scipy.stats.t.ppf(0.75, 4), rel=0.05)  # normal: 3.8


@pytest.mark.slow
def test_autoregressive_noise_is_predicted_with_its_correlation():
    record = square_record(per_period=200, noise=0.0)
    noisy = record["Vsc"] + 0.05 * autoregressive(np.random.default_rng(3), len(record))
    fit = fitact.fit(with_vsc(record, noisy), scene(noise_model="ar1"))
    noise = scattered(fitact.sample(fit, level="laplace", seed=1), "Vsc")
    before, after = noise[:, :-1].ravel(), noise[:, 1:].ravel()
    assert np.corrcoef(before, after)[0, 1] == pytest.approx(0.9, abs=0.07)  # three standard errors of one record
    assert noise.std() == pytest.approx(fit.sigma, rel=0.1)


@pytest.mark.slow
def test_coloured_noise_of_a_current_with_a_recorded_drive_is_a_misfit():
    """Its noise model is white, which a warning says and the residuals show."""
    record = burst_record()
    noise = 1e-3 * np.ptp(record["I"]) * pink(np.random.default_rng(0), len(record))
    quiet = {"channels": ["I"], "noise_model": "spectrum", "quiet": ["-40 ms", "-0.1 ms"]}
    given = fitact.Scene.from_dict({"drive": {"waveform": "measured"}, "measurement": quiet})
    found = fitact.fit(fitact.Record.from_arrays(record.time, V=record["V"], I=record["I"] + noise), given)
    assert found.result == "misfit"
    assert any("noise_model is that of Vsc" in warning for warning in found.warnings)


@pytest.mark.slow
def test_noise_of_a_recorded_drive_is_not_in_the_predicted_current():
    """V is noisier after 5 ms, and I, which follows the true drive, is not."""
    record, rng = burst_record(), np.random.default_rng(3)
    noisy = record["V"] + 0.02 * rng.standard_normal(len(record)) * (record.time > -0.035)
    current = record["I"] + 5e-7 * rng.standard_normal(len(record))
    measured = {"drive": {"waveform": "measured"}, "measurement": {"channels": ["I"]}}
    fit = fitact.fit(fitact.Record.from_arrays(record.time, V=noisy, I=current), fitact.Scene.from_dict(measured))
    noise = scattered(fitact.sample(fit, level="laplace", seed=1), "I").std(axis=0)
    assert np.nanmedian(noise[110:]) == pytest.approx(5e-7, rel=0.1)
    assert np.nanmedian(noise[110:]) / np.nanmedian(noise[:90]) == pytest.approx(1.0, rel=0.05)


def scattered(posterior: fitact.Posterior, channel: str) -> np.ndarray:
    """Return predicted records less their mean."""
    predicted = posterior.to_datatree()["posterior_predictive"][channel].values.astype(float)
    predicted = predicted.reshape(-1, predicted.shape[-1])
    return predicted - predicted.mean(axis=0)


@pytest.mark.slow
def test_clipped_samples_are_left_out():
    record = square_record(noise=0.05)
    rail = 0.8 * float(np.max(np.abs(record["Vsc"])))
    railed = with_vsc(record, np.clip(record["Vsc"], -rail, rail))
    fit = fitact.fit(railed, scene())
    assert fit.trusted
    assert np.all(np.abs(deviations([fit])) < 4.0)
    assert fit.derived()["b"]["q50"] == pytest.approx(B, rel=1.5e-3)  # if ignored, b is biased by 10.5 % (scipy)
    assert any("clipped" in warning and "wider range" in warning for warning in fit.warnings)
    assert fit.traces[0].weight is not None
    assert not np.any(fit.traces[0].weight[np.abs(railed["Vsc"]) == rail])


@pytest.mark.parametrize("step", [0.01, 0.3])
def test_a_smooth_peak_however_rounded_is_not_clipped(step: float):
    phase = 2.0 * np.pi * np.arange(4000) / 2000.0
    assert not clipping_mask(np.round(23.0 * np.sin(phase) / step) * step).any()
    assert not clipping_mask(np.where(phase % 6.0 < 3.0, 1.0, -1.0)).any()


@pytest.mark.parametrize("step", [0.0, 3.0])
@pytest.mark.parametrize("duty", [0.1, 0.5])
def test_a_square_with_finite_edges_without_noise_or_rounded_above_it_is_not_clipped(step: float, duty: float):
    phase = np.arange(4000) / 1000.0 % 1.0
    square = np.interp(phase, [0.0, 0.004, duty, duty + 0.004, 1.0], [-180.0, 180.0, 180.0, -180.0, -180.0])
    if step:
        noisy = square + 0.1 * np.random.default_rng(0).standard_normal(4000)
        square = np.round((noisy + 0.4 * step) / step) * step
    assert has_flat_levels(square)
    assert not clipping_mask(square).any()
    assert clipping_mask(np.minimum(square + 0.3 * np.random.default_rng(1).standard_normal(4000), 180.1)).any()


def test_a_clipped_drive_is_refused():
    time = np.arange(4000) * 5e-6
    rng = np.random.default_rng(0)
    voltage = 180.0 * np.sin(2.0 * np.pi * 100.0 * time) + 0.4 * rng.standard_normal(4000)
    vsc = skin_voltage(time, voltage, 130e3, 18e-9, 1.35e-9)
    railed = fitact.Record.from_arrays(time, V=np.clip(voltage, -150.0, 150.0), Vsc=vsc)
    with pytest.raises(fitact.InputError, match="V_V is clipped"):
        fitact.fit(railed)


@pytest.mark.slow
@pytest.mark.parametrize("steps", [0.5, 2.0, 10.0])
def test_intervals_cover_rounded_samples(steps: float):
    """ADC steps of several noise sds, at any offset."""
    record, step = square_record(per_period=200, noise=0.0), 0.05 * steps
    fits = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        shifted = record["Vsc"] + 0.05 * rng.standard_normal(len(record)) - (start := step * rng.random())
        fits.append(fitact.fit(with_vsc(record, np.round(shifted / step) * step + start), scene()))
    assert all(fit.trusted for fit in fits)
    spread = np.sqrt(np.mean(deviations(fits) ** 2, axis=0))
    assert np.all((spread > 0.4) & (spread < 1.5))  # with coarse rounding, its errors average out better


@pytest.mark.parametrize(
    ("measurement", "words"),
    [
        ({"noise_model": "spectrum"}, "quiet"),
        ({"quiet": ["0 ms", "5 ms"]}, "go together"),
        ({"noise_model": "spectrum", "quiet": ["5 ms", "0 ms"]}, "earlier time first"),
        ({"noise_model": "pink"}, "noise_model"),
    ],
)
def test_scenes_that_cannot_be_meant_are_refused(measurement: dict[str, object], words: str):
    with pytest.raises(fitact.InputError, match=words):
        scene(**measurement)


def test_records_that_do_not_show_their_noise_are_refused():
    record = square_record()
    for quiet, words in ((["50 ms", "60 ms"], "0 samples"), (["1 ms", "9 ms"], "V_V varies")):
        with pytest.raises(fitact.InputError, match=words):
            fitact.fit(record, scene(noise_model="spectrum", quiet=quiet))
    with pytest.raises(fitact.InputError, match="V_V varies"):
        fitact.fit(burst_record(), scene("measured", noise_model="spectrum", quiet=["-20 ms", "0.8 ms"]))
    uneven = np.delete(np.arange(len(record)), [700])
    holed = fitact.Record.from_arrays(record.time[uneven], V=record["V"][uneven], Vsc=record["Vsc"][uneven])
    with pytest.raises(fitact.InputError, match="uniform time steps"):
        fitact.fit(holed, scene(noise_model="ar1"))


@pytest.mark.parametrize(("gain", "order"), [(1.5, 0), (3.0, 1)])
def test_an_order_is_taken_where_akaike_gains_more_than_its_price(gain: float, order: int):
    """For n samples with reflection coefficient r the AIC decreases by n r^2, and a coefficient costs 2."""
    z = np.random.default_rng(0).standard_normal(1001)

    def reflection(a: float) -> float:
        x = z[1:] + a * z[:-1]
        return float(2.0 * (x[1:] @ x[:-1]) / (x[1:] @ x[1:] + x[:-1] @ x[:-1]))

    a = scipy.optimize.brentq(lambda a: reflection(a) - np.sqrt(gain / 1000), -0.5, 0.5)
    assert fit_ar_burg(z[1:] + a * z[:-1], max_order=1).coefficients.size == order


@pytest.mark.parametrize(("run", "clipped"), [(3, False), (4, True)])
def test_a_rail_is_an_extreme_that_repeats_four_times_in_a_row(run: int, clipped: bool):
    values = np.concatenate(
        [np.concatenate([np.full(run, 1.0), np.linspace(0.99 - 0.001 * i, -1.0 - i, 20)]) for i in range(30)]
    )
    assert clipping_mask(values).any() == clipped
