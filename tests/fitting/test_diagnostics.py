"""Residual tests: no alarms for correct models, alarms for a second skin layer. The references are from scipy."""

import math

import numpy as np
import pytest
import scipy.optimize
import scipy.signal
import scipy.stats

import fitact
from fitact.data.noise import white_noise_sds
from fitact.fitting.residual_statistics import is_misfit, outliers
from fitact.fitting.residual_tests import PhaseBins, ResidualTestStatistics, p_values

SQUARE = fitact.Scene.from_dict({"drive": {"waveform": "square"}})
NOISE, PERIOD = 0.05, 2000


def two_layers(R2: float, C2: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return time, V and Vsc (s, V, V) of steady-state periods over two layers in series, by scipy's state space."""
    R, C, Ci = 160e3, 22e-9, 1.35e-9
    time = np.arange(14 * PERIOD) * (0.01 / PERIOD)
    voltage = np.where(np.arange(time.size) % PERIOD < PERIOD // 2, 180.0, -180.0)
    first, second = np.poly1d([R * C * 1e3, 1.0]), np.poly1d([R2 * C2 * 1e3, 1.0])  # time in ms
    skin = R * second + R2 * first
    s_Ci = np.poly1d([Ci * 1e3, 0.0])
    system = (s_Ci * skin).coeffs, (first * second + 2.0 * s_Ci * skin).coeffs
    vsc = scipy.signal.lsim(system, voltage, time * 1e3, interp=False)[1]
    kept = slice(12 * PERIOD, None)
    return time[: 2 * PERIOD], voltage[kept], vsc[kept]


def significance(vsc: np.ndarray) -> float:
    """Return the sum of squares, in units of the noise variance, that the best single layer leaves, by scipy."""
    since = (np.arange(vsc.size) % (PERIOD // 2)) * (0.01 / PERIOD)
    sign = np.where(np.arange(vsc.size) % PERIOD < PERIOD // 2, 1.0, -1.0)

    def left(log: np.ndarray) -> np.ndarray:
        g, b = np.exp(log)
        return (sign * 360.0 * g / (1.0 + np.exp(-5e-3 / b)) * np.exp(-since / b) - vsc) / NOISE

    return 2.0 * float(scipy.optimize.least_squares(left, np.log([0.05, 4e-3]), xtol=1e-12, ftol=1e-12).cost)


@pytest.mark.parametrize(
    ("R2", "C2"),
    [
        pytest.param(20e3, 5e-9, marks=pytest.mark.slow),
        (20e3, 0.5e-6),
        *(pytest.param(*each, marks=pytest.mark.slow) for each in ((5e3, 50e-9), (15e3, 0.5e-6), (3e3, 0.5e-6))),
    ],
)
def test_a_second_skin_layer_is_misfit_wherever_it_shows(R2: float, C2: float):
    time, voltage, vsc = two_layers(R2, C2)
    assert significance(vsc) > 75.0  # the value that an F test of 32 phases detects at 1e-7 nearly always
    noise = NOISE * np.random.default_rng(0).standard_normal(vsc.size)
    fit = fitact.fit(fitact.Record.from_arrays(time, V=voltage, Vsc=vsc + noise), SQUARE)
    assert fit.result == "misfit"


def test_a_second_layer_that_noise_hides_is_no_misfit():
    time, voltage, vsc = two_layers(8e3, 0.5e-6)
    assert significance(vsc) < 5.0
    noise = NOISE * np.random.default_rng(0).standard_normal(vsc.size)
    assert fitact.fit(fitact.Record.from_arrays(time, V=voltage, Vsc=vsc + noise), SQUARE).result == "successful"


def test_the_shipped_record_is_no_misfit_and_shows_no_structure(finger_fit: fitact.Fit):
    assert finger_fit.trusted
    assert min(finger_fit.figures[name] for name in ("folded_p", "spectrum_p", "line_p")) > 1e-3


def residual_p_values(
    residuals: np.ndarray, time: np.ndarray, frequency: float, precision=np.float32
) -> dict[str, np.ndarray]:
    """Return the p-values of residuals, by default in the precision that fits use."""
    of_time = PhaseBins.from_times(time, frequency)
    return p_values(ResidualTestStatistics.from_residuals(residuals.astype(precision), of_time), time.size, of_time)


def test_structure_that_rounding_explains_does_not_count():
    """A ramp in steps above its noise, with more; rounding has a third of the power, and a sine would have another."""
    k, rng = np.arange(6000), np.random.default_rng(5)
    ramp = 0.1 * np.abs((k + 1500) % 3000 - 1500.0) + 0.1 * rng.standard_normal(k.size)
    residuals = ramp - np.round(ramp) + 0.4 * rng.standard_normal(k.size)

    def line_p(values: np.ndarray, rounding: float = 1.0 / math.sqrt(12.0)) -> float:
        statistics, share = ResidualTestStatistics.from_residuals(values, None), rounding**2 / np.mean(values**2)
        return float(p_values(statistics.without_share(share, k.size, with_means=False), k.size, None)["line_p"])

    assert line_p(residuals, 0.0) < 1e-9
    assert line_p(residuals) > 1e-3
    assert line_p(residuals + 0.5 * np.sin(2.0 * np.pi * k / 12.0)) < 1e-9


def test_false_alarms_of_white_noise_are_as_many_as_stated():
    """Each test at 1 % rejects about 1 % of 2,000 records (up to 4 times as many for the folded tests)."""
    time, rng = np.arange(1000) * 1e-4, np.random.default_rng(0)
    of_time = PhaseBins.from_times(time, 37.3)
    found = p_values(
        ResidualTestStatistics.from_residuals(rng.standard_normal((2000, time.size)), of_time), time.size, of_time
    )
    alarms = {name: np.count_nonzero(p < 0.01) for name, p in found.items()}
    assert 20 - 15 <= alarms["folded_p"] <= 80 + 15
    assert alarms["spectrum_p"] <= 20 + 15  # the asymptotic distribution is slightly conservative
    assert 20 - 15 <= alarms["line_p"] <= 20 + 15


def test_noise_alone_is_never_larger_than_expected():
    """The noise estimate is uncertain, too: of 20,000 records, none may be a misfit at one in a million each."""
    rng, samples = np.random.default_rng(4), 500
    noise = rng.standard_normal((20_000, samples))
    of_residuals = {"rounding_noise": 0.0, "interpolation_error": 0.0, "runs_z": 0.0, "rms_residual": 1.0}
    figures = of_residuals | dict.fromkeys(("folded_p", "spectrum_p", "line_p"), 1.0)
    figures |= {
        "chi2_reduced": np.mean(noise**2, axis=1) / white_noise_sds(noise) ** 2,
        "degrees_of_freedom": np.full(len(noise), samples),
    }
    assert not is_misfit(figures).any()
    larger = figures | {"chi2_reduced": 3.0 * figures["chi2_reduced"]}
    assert is_misfit(larger).mean() > 0.99


def test_folding_is_the_F_test_of_the_phase_means():
    """scipy's F distribution, for a record so short that only one number of phases is tested."""
    time, rng = np.arange(64) * 1e-3, np.random.default_rng(1)
    residuals = rng.standard_normal(64) + 0.5 * np.sin(2.0 * np.pi * time / 8e-3)
    means = residuals.reshape(8, 8).mean(axis=0)
    between = 8.0 * float(means @ means)
    within = float(residuals @ residuals) - between
    p8 = scipy.stats.f.sf((between / 8) / (within / 56), 8, 56)
    assert residual_p_values(residuals, time + 1e-9, 125.0, float)["folded_p"] == pytest.approx(p8, rel=1e-10)


def test_hum_and_colour_are_seen_and_a_million_samples_are_no_trouble():
    time, rng = np.arange(1_000_000) * 1e-5, np.random.default_rng(2)
    noise = rng.standard_normal(time.size)
    hum = noise + 0.015 * np.sin(2.0 * np.pi * 333.3 * time)
    coloured = scipy.signal.lfilter([1.0], [1.0, -0.02], noise)
    square = np.sign(np.sin(2.0 * np.pi * 100.0 * time))
    assert min(residual_p_values(noise, time, 100.0).values()) > 1e-3
    assert residual_p_values(hum, time, 100.0)["line_p"] < 1e-7
    assert residual_p_values(coloured, time, 100.0)["spectrum_p"] < 1e-7
    assert residual_p_values(noise + 0.01 * square, time, 100.0)["folded_p"] < 1e-7


def test_outliers_are_counted_and_placed():
    time, rng = np.arange(4000) * 1e-5, np.random.default_rng(3)
    noise = rng.standard_normal(4000)
    assert outliers(noise, time, 1.0) == {"outliers": 0}
    noise[[70, 500, 900]] += 20.0
    assert outliers(noise, time, 1.0) == {"outliers": 3, "first_outlier": pytest.approx(70e-5)}


def test_runs_are_stretches_on_one_side():
    found = ResidualTestStatistics.from_residuals(np.array([[1.0, 2.0, -1.0, 3.0], [1.0, 1.0, 1.0, 1.0]]), None)
    np.testing.assert_array_equal(found.n_positive, [3, 4])
    np.testing.assert_array_equal(found.n_runs, [3, 1])
