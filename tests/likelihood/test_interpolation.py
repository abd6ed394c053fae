"""Records whose likelihood needs more than a table of time constants, against sums over all samples."""

import jax
import numpy as np
import pytest
import scipy.signal
import scipy.stats

import fitact
from fitact.likelihood import certificate
from fitact.likelihood.compression import Interpolation
from fitact.likelihood.noise import fit_student_scale

STEP, SAMPLES, NOISE = 5e-6, 12_000, 0.06
RSC, CSC, CI = 160e3, 22e-9, 1.35e-9
DRIVE = {"waveform": "trapezoid", "rise_time": "20 us", "peak_to_peak": "360 V", "frequency": "100 Hz"}


def trapezoid(time: np.ndarray) -> np.ndarray:
    """Return 360 Vpp at 100 Hz with edges of 20 us that begin at t = 0 and half a period later."""
    return np.interp(np.mod(time, 0.01), [0.0, 20e-6, 5e-3, 5.02e-3, 0.01], [-180.0, 180.0, 180.0, -180.0, -180.0])


def late_voltage(late: float, clock: float, edges_20us: bool = True) -> np.ndarray:
    """Return Vsc in the steady state by scipy, ten times finer, `late` samples late; `clock` in samples at the end."""
    settle, fine = 8_000, STEP / 20.0
    time = fine * np.arange(20 * (settle + SAMPLES + 8)) - 20 * settle * fine
    drive = trapezoid(time) if edges_20us else np.where(np.mod(time + 1e-9, 0.01) < 5e-3, 180.0, -180.0)
    system = ([RSC * CI, 0.0], [RSC * (2.0 * CI + CSC), 1.0])
    vsc = scipy.signal.lsim(system, drive, time - time[0], interp=edges_20us)[1]
    wanted = (STEP * np.arange(SAMPLES) - late * STEP) * (1.0 + clock / SAMPLES)
    if edges_20us:
        return np.interp(wanted, time, vsc)
    return vsc[np.floor((wanted - time[0]) / fine + 0.5).astype(int)]


def record(vsc: np.ndarray, measured: bool = True, noise: np.ndarray | None = None) -> fitact.Record:
    time = STEP * np.arange(SAMPLES)
    noise = np.random.default_rng(1).standard_normal(SAMPLES) if noise is None else noise
    return fitact.Record.from_arrays(time, V=trapezoid(time) if measured else None, Vsc=vsc + NOISE * noise)


def scene(stated: bool, **sections: dict) -> fitact.Scene:
    drive = DRIVE if stated else {"waveform": "measured"}
    return fitact.Scene.from_dict({"device": {"Ci": "1.35 nF"}, "drive": drive} | sections)


def assert_equals_full_sum(
    given: fitact.Record, stated: fitact.Scene, names: set[str], error: float = 2e-3
) -> fitact.Fit:
    """Check that the optimum, the errors and the log-probabilities up to 4 standard deviations are the full sum's."""
    ours, full = (fitact.fit(given, stated, tolerance=tolerance) for tolerance in (1e-3, 0.0))
    assert ours.full_because == ""
    assert full.full_because == "the full sum was requested"
    assert set(ours.names) - {"Rsc", "Csc", "Ci"} == names
    assert ours.compression_error < (1e-2 if stated.measurement.noise_model == "student" else 1e-3)
    for name, theirs in full.parameters().items():
        assert abs(ours.parameters()[name]["q50"] - theirs["q50"]) < 0.02 * theirs["sd"]
    np.testing.assert_allclose(ours.sd, full.sd, rtol=0.01)
    deviates = np.random.default_rng(6).standard_normal((24, ours.point.size))
    points = ours.point + np.linspace(0.1, 2.0, 24)[:, None] * deviates @ ours.point_root.T
    with jax.enable_x64(True):
        a, b = (
            certificate.batched_log_prob(model, 8)(points)
            for model in (ours.likelihood, ours.likelihood.without_compression())
        )
    # Student-t noise is expanded at the optimum, and a delay has a kink at each sample that an edge passes
    near = b - b[0] > (-10.0 if "delay" in names and stated.measurement.noise_model == "student" else -np.inf)
    np.testing.assert_allclose((a - a[0])[near], (b - b[0])[near], atol=error)
    assert np.ptp(b) > 10.0
    return ours


@pytest.mark.slow
@pytest.mark.parametrize(
    ("late", "clock", "names"),
    [
        (2.3, 0.0, {"delay"}),
        (0.0, 3.0, {"clock"}),
        (2.3, 3.0, {"delay", "clock"}),
    ],
)
def test_timing_of_a_stated_drive(late: float, clock: float, names: set[str]):
    fit = assert_equals_full_sum(record(late_voltage(late, clock)), scene(True), names)
    assert isinstance(fit.likelihood.channels[0].compression, Interpolation)
    assert fit.likelihood.rows < 100
    if names == {"delay"}:
        delay = fit.parameters()["delay"]
        assert abs(delay["q50"] - late * STEP) < 4.0 * delay["sd"]


@pytest.mark.slow
@pytest.mark.parametrize(("late", "noise_model"), [(2.3, "white"), (1.0, "white"), (2.3, "ar1")])
def test_delay_of_a_measured_drive(late: float, noise_model: str):
    """Test also a delay of whole samples, whose posterior lies on both sides of a corner of the response."""
    noise = np.random.default_rng(2).standard_normal(SAMPLES)
    noise = noise if noise_model == "white" else scipy.signal.lfilter([0.8], [1.0, -0.6], noise)
    fit = assert_equals_full_sum(
        record(late_voltage(late, 0.0), noise=noise), scene(False, measurement={"noise_model": noise_model}), {"delay"}
    )
    delay = fit.parameters()["delay"]
    assert abs(delay["q50"] - late * STEP) < 4.0 * delay["sd"]


@pytest.mark.slow
def test_an_ideal_edge_between_two_samples():
    """The posterior of the delay ends where an edge passes a sample; samples there are summed."""
    given = record(late_voltage(2.5, 0.0, edges_20us=False), measured=False)
    square = scene(True, drive={"waveform": "square", "peak_to_peak": "360 V", "frequency": "100 Hz"})
    fit = assert_equals_full_sum(given, square, {"delay"})
    posterior = fitact.sample(fit, seed=3, progress=False)
    assert posterior.convergence.converged
    delay = posterior.parameters()["delay"] / STEP
    assert np.min(delay) > 2.0 - 1e-6
    assert np.max(delay) < 3.0 + 1e-6
    for name, truth in (("g", CI / (2.0 * CI + CSC)), ("b", RSC * (2.0 * CI + CSC))):
        assert abs(np.mean(posterior.derived()[name]) - truth) < 4.0 * np.std(posterior.derived()[name])


@pytest.mark.slow
@pytest.mark.parametrize(("stated", "largest"), [(False, 10.0), (True, 10.0), (False, 100.0)])
def test_student_noise_with_outliers(stated: bool, largest: float):
    """Test one sample in twenty with an outlier on one side."""
    rng = np.random.default_rng(4)
    outliers = np.where(rng.uniform(size=SAMPLES) < 0.05, rng.uniform(5.0, largest, SAMPLES), 0.0)
    given = record(late_voltage(0.0, 0.0), noise=rng.standard_normal(SAMPLES) + outliers)
    freed = set() if stated else {"delay"}
    fit = assert_equals_full_sum(given, scene(stated, measurement={"noise_model": "student"}), freed, error=0.01)
    assert fit.likelihood.channels[0].expansion is not None
    for name, truth in (("g", CI / (2.0 * CI + CSC)), ("b", RSC * (2.0 * CI + CSC))):
        assert abs(fit.derived()[name]["q50"] - truth) < 5.0 * fit.derived()[name]["sd"]


@pytest.mark.slow
def test_student_noise_with_a_delay_is_summed():
    """Test a stated drive, for which Student-t noise with a delay has no expansion; the fit says so."""
    rng = np.random.default_rng(4)
    noise = rng.standard_normal(SAMPLES) * np.where(rng.uniform(size=SAMPLES) < 0.05, 10.0, 1.0)
    given = record(late_voltage(0.5, 0.0), measured=False, noise=noise)
    fit = fitact.fit(given, scene(True, measurement={"noise_model": "student"}))
    assert "delay" in fit.names
    assert "a delay or a clock error" in fit.full_because
    assert fit.trusted


def test_student_scale_is_that_of_scipy():
    values = 0.3 * np.random.default_rng(5).standard_t(4.0, 5000)
    assert fit_student_scale(values, values.size) == pytest.approx(
        scipy.stats.t.fit(values, fix_df=4, floc=0.0)[2], rel=1e-3
    )
