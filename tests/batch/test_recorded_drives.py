"""Fits of many records with drives of their own: the same results as one by one, and unusual records among them."""

import jax
import numpy as np
import pytest
import scipy.optimize
import scipy.signal

import fitact
from fitact.batch.fit_many import RecordGroup
from tests.batch.test_many_posteriors import assert_quantiles_of_separate_posterior
from tests.likelihood.test_smooth_drive import SKIN
from tests.likelihood.test_smooth_drive import record as slow_record

NAMES = ("Rsc", "Csc", "Ci")
MEDIANS, RELATIVE_SDS = np.array([130e3, 18e-9, 1.35e-9]), np.array([0.5, 0.5, 0.05])
PRIOR = {n: {"median": m, "relative_sd": s} for n, m, s in zip(NAMES, MEDIANS.tolist(), RELATIVE_SDS, strict=True)}
SCENE = fitact.Scene.from_dict({"drive": {"waveform": "measured"}, "prior": PRIOR})
STEP, SAMPLES, NOISE = 1e-5, 2510, 0.1  # s, of which 2.5 periods, V
TIME = STEP * np.arange(SAMPLES)
DRIVE = fitact.Trapezoid(360.0, 100.0, 30e-6)


def record(number: int, delay: float = 2.3, offset: float = 0.0, drive: fitact.Trapezoid = DRIVE) -> fitact.Record:
    """Return a record whose Vsc is late by `delay` steps, with an unknown charge."""
    random = np.random.default_rng(number)
    circuit = fitact.FinalCircuit(*MEDIANS * np.exp(0.2 * np.sin(np.arange(3) + number)))
    v = np.asarray(drive.value(TIME + 1e-3))
    vsc = fitact.response(circuit, fitact.Sampled(TIME, v), TIME - delay * STEP, steady_state=False)
    charge = random.standard_normal() * np.exp(-TIME / float(circuit.b))
    noise = NOISE * random.standard_normal((2, SAMPLES))
    return fitact.Record.from_arrays(
        TIME, V=v + noise[0], Vsc=np.asarray(vsc) + charge + offset + noise[1], source=f"finger_{number}.csv"
    )


def change(number: int, **channels: np.ndarray) -> fitact.Record:
    """Return a record of which some channels are replaced."""
    made = record(number)
    return fitact.Record.from_arrays(TIME, **dict(made.channels) | channels, source=made.source)


def accepted(records: list[fitact.Record], scene: fitact.Scene = SCENE) -> np.ndarray:
    """Return which records a batch fits without separate fits."""
    group = RecordGroup(records[0].time, members=list(enumerate(records)))
    with jax.enable_x64(True):
        assert group.is_batchable(scene)
        assert group.batch_problem is not None
        padded = [*records, *records[-1:] * (-len(records) % group.batch_problem.unit)]
        return group.batch_problem.fit(padded).accepted[: len(records)]


def assert_equal_to_separate_fit(
    row: dict, made: fitact.Record, sd_error: float = 1e-3, error: float = 1e-6, figure_error: float = 5e-4
) -> None:
    alone = fitact.fit(made, SCENE)
    assert (row["result"], row["trusted"], row["samples"]) == (alone.result, alone.trusted, alone.figures["samples"])
    assert row["verdict"] == alone.identifiability.verdict
    assert row["freed"] == ", ".join(alone.model()["freed"])
    for i, name in enumerate(NAMES):
        assert row[name] == pytest.approx(np.exp(alone.theta[i]), rel=error)
        assert row[f"{name}_log_sd"] == pytest.approx(alone.sd[i], rel=1e-4)
    logs, log_sds = alone.laplace.log_derived[0], alone.laplace.derived_log_sd
    names = ("g", "b", "force_mean", "force_peak", "force_rms", "friction_mean")
    for name, log, log_sd in zip(names, logs, log_sds, strict=True):
        assert row[name] == pytest.approx(np.exp(log), rel=error)
        assert row[f"{name}_log_sd"] == pytest.approx(log_sd, rel=sd_error)
    assert row["force_from_prior"] == pytest.approx(alone.identifiability.force_from_prior, rel=1e-4)
    # the noise of V has the gain from which a fit starts, which differs by some per cent, and is 0.4 % of the variance
    assert row["chi2_reduced"] == pytest.approx(alone.figures["chi2_reduced"], rel=figure_error)


@pytest.fixture(scope="module")
def skewed() -> list[fitact.Record]:
    """Return records of one skew, with and without an offset, and unusual ones among them."""
    records = [record(number, offset=0.3 * (number % 2)) for number in range(20)]
    records[3] = change(3, Vsc=np.minimum(records[3]["Vsc"], 0.6 * records[3]["Vsc"].max()))
    records[4] = change(4, Vsc=records[4]["Vsc"] + 0.15 * np.sin(2.0 * np.pi * 730.0 * TIME))
    records[5] = record(5, delay=-2.0)
    records[6] = record(6, delay=0.0)
    records[7] = record(7, drive=fitact.Trapezoid(360.0, 103.0, 30e-6))
    records[8] = record(8, drive=fitact.Trapezoid(360.0, 100.0, 1e-9))
    records[9] = change(9, V=np.minimum(records[9]["V"], 180.0))
    return records


UNUSUAL = range(3, 10)


@pytest.mark.slow
def test_clear_records_are_fitted_together_and_unusual_ones_are_not(skewed):
    expected = [number not in UNUSUAL for number in range(20)]
    np.testing.assert_array_equal(accepted(skewed), expected)


def test_each_row_is_the_fit_of_its_record(skewed):
    rows = fitact.fit_many(skewed, SCENE, progress=False)
    assert [row["record"] for row in rows] == [each.source for each in skewed]
    assert rows[0]["freed"] == "charge, delay"
    assert rows[1]["freed"] == "offset, charge, delay"
    for number in (0, 1, 4, 5, 6, 7):
        assert_equal_to_separate_fit(rows[number], skewed[number])
    assert rows[4]["result"] == "structure"
    assert rows[9]["result"] == "refused"
    assert "clipped" in rows[9]["message"]


def test_optimum_is_that_of_scipy_on_the_samples():
    """Samples that follow V within a step of the record; a fit shifts V without most of its noise."""
    records = [record(number, delay=0.3) for number in range(16)]
    assert accepted(records).all()
    rows = fitact.fit_many(records, SCENE, progress=False)
    for number in (0, 7):
        assert rows[number]["freed"] == "charge, delay"
        assert_equal_to_separate_fit(rows[number], records[number])
    sigma, voltage, observed = rows[7]["noise"], records[7]["V"], records[7]["Vsc"]
    log_sds = np.sqrt(np.log1p(np.square(RELATIVE_SDS)))

    def residuals(parameters):
        """Filter the piecewise linear drive exactly, to a time within each step, and use the prior."""
        R, C, Ci = np.exp(parameters[:3])
        g, b = Ci / (2.0 * Ci + C), R * (2.0 * Ci + C)
        x = STEP / b
        gain = -np.expm1(-x) / x
        rise = np.diff(voltage)
        response, _ = scipy.signal.lfilter([gain], [1.0, -np.exp(-x)], rise, zi=[np.exp(-x) * voltage[0]])
        before, since = np.append(voltage[0], response)[:-1], (1.0 - parameters[4]) * x
        late = before * np.exp(-since) - np.expm1(-since) / x * rise
        model = (g * np.append(voltage[0], late) + parameters[3] * np.exp(-TIME / b))[6:-6]
        off_prior = np.append((parameters[:3] - np.log(MEDIANS)) / log_sds, parameters[4])
        return np.append((observed[6:-6] - model) / sigma, off_prior)

    start = np.append(np.log([rows[7][name] for name in NAMES]), [0.0, 0.3])
    tight = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15}
    scale = [0.05, 0.05, 0.05, 0.1, 0.1]
    optimum = np.exp(scipy.optimize.least_squares(residuals, start, jac="3-point", x_scale=scale, **tight).x[:3])
    total = 2.0 * optimum[2] + optimum[1]
    for name, value in (("g", optimum[2] / total), ("b", optimum[0] * total)):
        assert abs(np.log(rows[7][name] / value)) < 0.05 * rows[7][f"{name}_log_sd"]


def test_the_stated_errors_hold_for_a_skew_of_an_eighth_of_a_step():
    """It moves b by 8 standard errors of a fit without delay, which the BIC would prefer in half of these records."""
    scene = fitact.Scene.from_dict({"drive": {"waveform": "measured"}, "prior": {"Ci": {"relative_sd": 0.1}}})
    rows = fitact.fit_many([slow_record(seed, 1, 0.1, bits=12) for seed in range(16)], scene, progress=False)
    assert all(row["trusted"] for row in rows)
    b = SKIN[0] * (2.0 * SKIN[2] + SKIN[1])
    off = np.array([np.log(row["b"] / b) / row["b_log_sd"] for row in rows])
    assert np.max(np.abs(off)) < 3.5
    assert np.sqrt(np.mean(np.square(off))) < 1.5  # a chi-square of 16 degrees of freedom exceeds 2.25 x 16 in 0.3 %


def test_drives_that_curve_between_samples_are_curved_in_batches():
    """Lines between the samples of slewed edges moved b by 0.8 standard errors."""
    scene = fitact.Scene.from_dict({"drive": {"waveform": "measured"}, "prior": {"Ci": {"relative_sd": 0.1}}})
    records = [slow_record(seed, 3, 0.02, bits=14, waveform="slewed") for seed in range(16)]
    assert accepted(records, scene).all()
    rows = fitact.fit_many(records, scene, progress=False)
    alone = fitact.fit(records[5], scene)
    assert rows[5]["force_peak"] == pytest.approx(alone.derived()["force_peak"]["q50"], rel=1e-5)
    tones = slow_record(0, 3, 0.02, waveform="tones")  # which a fit knows between samples
    assert not RecordGroup(tones.time, members=[(i, tones) for i in range(16)]).is_batchable(scene)
    truth = {"g": SKIN[2] / (2.0 * SKIN[2] + SKIN[1]), "b": SKIN[0] * (2.0 * SKIN[2] + SKIN[1])}
    for name, value in truth.items():
        off = np.array([np.log(row[name] / value) / row[f"{name}_log_sd"] for row in rows])
        assert np.max(np.abs(off)) < 3.5
        assert np.sqrt(np.mean(np.square(off))) < 1.5  # a chi-square of 16 degrees of freedom exceeds 36 in 0.3 %
        assert np.log(rows[5][name] / alone.derived()[name]["q50"]) == pytest.approx(
            0.0, abs=0.1 * rows[5][f"{name}_log_sd"]
        )


def test_a_noisy_sine_is_smoothed_in_batches_as_alone():
    """Wavelets left noise of the sine, by which b seemed twice as certain."""
    scene = fitact.Scene.from_dict({"drive": {"waveform": "measured"}, "prior": {"Ci": {"relative_sd": 0.1}}})
    records = [slow_record(seed, 3, 2.0, bits=14, waveform="sine") for seed in range(16)]
    assert accepted(records, scene).all()
    rows = fitact.fit_many(records, scene, progress=False)
    for k in (0, 5):
        alone = fitact.fit(records[k], scene).derived()
        for name in ("g", "b"):
            assert rows[k][f"{name}_log_sd"] == pytest.approx(alone[name]["u"], rel=0.01)
            assert np.log(rows[k][name] / alone[name]["q50"]) == pytest.approx(0.0, abs=0.1 * alone[name]["u"])
        for name in ("force_mean", "force_peak"):
            assert rows[k][name] == pytest.approx(alone[name]["q50"], rel=5e-4)


def test_records_of_different_skew_are_fitted_together_within_a_step():
    """The table of a record reaches one step from the skew of the first."""
    records = [record(number, delay=2.3 + 0.04 * (number - 8)) for number in range(17)]
    assert accepted(records).all()
    rows = fitact.fit_many(records, SCENE, progress=False)
    assert_equal_to_separate_fit(rows[0], records[0])
    # the skew of the last rounds to another whole step, so that its fit takes the noise of V from another sample, which
    # moves estimates by some hundredths of a standard error
    assert_equal_to_separate_fit(rows[16], records[16], sd_error=3e-3, error=2e-5, figure_error=6e-3)


def test_edges_between_two_samples_free_a_gain():
    """Its prior sd is the time step over an estimate of b, which a skew makes wrong by some 5 % for a single record."""
    records = [record(number, drive=fitact.Trapezoid(360.0, 100.0, 5e-6)) for number in range(16)]
    assert accepted(records).all()
    rows = fitact.fit_many(records, SCENE, progress=False)
    for number in (0, 7):
        assert rows[number]["freed"] == "charge, gain, delay"
        assert_equal_to_separate_fit(rows[number], records[number], sd_error=0.1, error=3e-6)


@pytest.mark.slow  # simulates and fits records of 25,000 samples, for which programs of their own are compiled
def test_the_force_of_long_records_is_that_of_their_last_periods():
    time = STEP * np.arange(25_000)
    v = np.asarray(DRIVE.value(time + 1e-3))
    circuit = fitact.FinalCircuit(*MEDIANS)
    vsc = np.asarray(fitact.response(circuit, fitact.Sampled(time, v), time - 2.3 * STEP, steady_state=False))
    noise = NOISE * np.random.default_rng(1).standard_normal((16, 2, time.size))
    records = [fitact.Record.from_arrays(time, V=v + each[0], Vsc=vsc + each[1]) for each in noise]
    assert accepted(records).all()
    rows = fitact.fit_many(records, SCENE, progress=False)
    for number in (0, 15):
        assert_equal_to_separate_fit(rows[number], records[number])


def test_posteriors_are_those_of_each_by_itself():
    """The channels are noisy, late by a part of a step, and rounded to 14 bits of 800 V and 80 V."""
    records = []
    for number in range(18):
        made = record(number)
        rounded = {"V": np.round(made["V"] / 0.05) * 0.05, "Vsc": np.round(made["Vsc"] / 0.005) * 0.005}
        records.append(change(number, **rounded))
    rows = fitact.sample_many(records, SCENE, seed=1, progress=False)
    assert sum(row["level"] == "psis" for row in rows) >= 16
    assert all(row["trusted"] for row in rows)
    for number in (0, 7):
        assert rows[number]["level"] == "psis"
        assert_quantiles_of_separate_posterior(rows[number], fitact.fit(records[number], SCENE))
