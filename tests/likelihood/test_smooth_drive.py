"""A delay of Vsc against a noisy recorded V: what smoothing leaves, and fits of records of known skew."""

import jax
import numpy as np
import pytest
import scipy.signal

import fitact
from fitact.data.tones import Tones
from fitact.likelihood.smooth_drive import (
    corner_errors,
    curve_drive,
    curve_tones,
    lasting_bend,
    missing_curve,
    smooth_drive,
)
from fitact.model.loop_modes import HighpassTerms

STEP, FINE = 6.25e-6, 8  # s, and fine steps of the truth in a step
SKIN = np.array([160e3, 24e-9, 1.35e-9])


def test_a_cubic_and_edges_stay_as_they_are():
    k = np.arange(4000.0)
    cubic = 1e-9 * (k - 1500.0) ** 3 - 0.01 * k
    jumps = cubic + 50.0 * (k > 2000.0)
    np.testing.assert_allclose(smooth_drive(cubic, 0.1)[260:-260], cubic[260:-260], atol=1e-9)
    np.testing.assert_allclose(smooth_drive(jumps, 1e-3)[1990:2010], jumps[1990:2010], atol=5e-3)
    np.testing.assert_allclose(smooth_drive(cubic, 0.0), cubic, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(("period", "level", "slope"), [(1600, 0.2, 0.04), (500, 0.3, 0.08), (160, 0.6, 0.2)])
def test_noise_and_its_slope_are_removed(period: int, level: float, slope: float):
    """White noise has differences of 1.41 sd; a parabola over nine samples leaves 0.51 and 0.28 (SciPy)."""
    noise = np.random.default_rng(0).standard_normal(16_000)
    taps = scipy.signal.savgol_coeffs(9, 2)
    assert np.linalg.norm(taps) == pytest.approx(0.505, abs=1e-3)
    assert np.linalg.norm(np.diff(taps)) == pytest.approx(0.281, abs=1e-3)
    sine = 180.0 * np.sin(2.0 * np.pi * np.arange(noise.size) / period)
    error = (smooth_drive(sine + 0.1 * noise, 0.1) - sine)[300:-300] / 0.1
    assert np.std(error) < level
    assert np.std(np.diff(error)) < slope


def test_compiled_and_without():
    V = np.random.default_rng(0).standard_normal((2, 700))
    with jax.enable_x64(True):
        compiled = jax.jit(smooth_drive)(V, np.array([[1.0], [0.5]]))
    np.testing.assert_allclose(compiled, smooth_drive(V, np.array([[1.0], [0.5]])), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("knows_tones", [False, True])
@pytest.mark.parametrize("late", [0.0, 0.3])
@pytest.mark.parametrize("lag", [0.1, 0.4])
def test_a_low_pass_reads_curves_between_samples(lag: float, late: float, knows_tones: bool):
    """A late sine of 20 samples a period through a low-pass, by its gain, and the lines between samples by SciPy."""
    k, omega, fine = np.arange(400.0), 2.0 * np.pi / 20.0, 40
    sine, steps = np.sin(omega * k), np.arange(0.0, 399.0, 1.0 / fine)
    tones, low_pass = Tones.from_samples(sine, np.array([omega])), HighpassTerms((-1.0,), (lag,), None, 1.0)
    curved = curve_tones(tones, late, low_pass) if knows_tones else curve_drive(sine, late, lag)

    def error(drive: np.ndarray) -> float:
        lines = scipy.signal.lsim(([1.0], [lag, 1.0]), np.interp(steps, k, drive), steps, X0=[0.0])[1]
        found = np.interp(k[100:300] - late, steps, lines)
        return float(np.max(np.abs(found - (np.exp(1j * omega * (k[100:300] - late)) / (1.0 + 1j * omega * lag)).imag)))

    assert error(curved) < (1e-3 if knows_tones else 0.12) * error(sine)


@pytest.mark.parametrize("tau", [0.4, 3.0, None])
@pytest.mark.parametrize("late", [0.0, 0.3, -1.4, 2.5])
def test_lines_between_samples_are_the_tones(late: float, tau: float | None):
    """Sinusoids of 4.5 and 20 samples a period, plain and through a high-pass, by its gain; lines by SciPy."""
    k, omega, fine = np.arange(400.0), 2.0 * np.pi / np.array([4.5, 20.0]), 100
    V, gain = 3.0 + np.cos(np.outer(omega, k)).sum(axis=0), 1j * omega * (tau or 1.0)
    terms = HighpassTerms((), (), None, 1.0) if tau is None else HighpassTerms((1.0,), (tau,))
    steps, gain = np.arange(0.0, 399.0, 1.0 / fine), np.ones(2) if tau is None else gain / (1.0 + gain)
    made = curve_tones(Tones.from_samples(V, omega), late, terms)
    lines = np.interp(steps, k, made)
    if tau is not None:
        lines = scipy.signal.lsim(([tau, 0.0], [tau, 1.0]), lines, steps)[1]
    read, exact = np.interp(k - late, steps, lines), (gain @ np.exp(1j * np.outer(omega, k - late))).real
    np.testing.assert_allclose(read[100:300], exact[100:300] + (3.0 if tau is None else 0.0), atol=1e-9)


def record(
    seed: int,
    skew: int,
    noise_V: float,
    noise_Vsc: float = 0.02,
    bits: int = 14,
    waveform: str = "triangle",
    R_H: float = 0.0,
    offset: float = 0.0,
) -> fitact.Record:
    """Return two periods of a slow drive, rounded, with Vsc late by `skew` eighths of a step, and with an offset."""
    rng, fine = np.random.default_rng(seed), STEP / FINE * np.arange(3 * 1600 * FINE)
    turns = 2.0 * np.pi * 100.0 * fine
    V = 180.0 * (np.sin(turns) if waveform == "sine" else scipy.signal.sawtooth(turns, 0.5))
    V = np.clip(5.0 * V, -180.0, 180.0) if waveform == "trapezoid" else V
    V = 90.0 * (np.sin(turns) + np.sin(41.0 * turns)) if waveform == "tones" else V
    V = 90.0 * np.sin(100.0 * turns) * (1.0 - np.cos(turns)) if waveform == "carrier" else V
    if waveform == "corners":  # edges of 16 steps, which begin and end within one
        V = np.clip(9000.0 * scipy.signal.sawtooth(turns + 2.0 * np.pi * 37.5 * STEP, 0.5), -180.0, 180.0)
    if waveform == "slewed":  # edges of 16 steps, with a pole of 3
        pole = np.exp(-1.0 / (3 * FINE))
        V = scipy.signal.lfilter([1.0 - pole], [1.0, -pole], np.clip(50.0 * V, -180.0, 180.0))
    Rsc, Csc, Ci = SKIN
    # of Rsc‖Csc, 1 / (s Ci) and R_H in the loop, exactly for linear pieces
    b, lag = Rsc * (2.0 * Ci + Csc), R_H * Ci
    system = scipy.signal.lti([Ci * Rsc, 0.0], [*([lag * Rsc * Csc] if R_H else []), b + lag, 1.0])
    _, Vsc, _ = scipy.signal.lsim(system, V, fine)
    kept = np.arange(1600 * FINE, 3 * 1600 * FINE, FINE)
    channels = {"V": V[kept], "Vsc": Vsc[kept - skew] + offset}
    for name, sd in (("V", noise_V), ("Vsc", noise_Vsc)):
        noisy = channels[name] + sd * rng.standard_normal(kept.size)
        lsb = 1.2 * np.ptp(noisy) / 2**bits
        channels[name] = lsb * np.round(noisy / lsb)
    return fitact.Record.from_arrays(STEP * np.arange(kept.size), **channels)


SCENE = fitact.Scene.from_dict(
    {
        "drive": {"waveform": "measured"},
        "prior": {"Ci": {"relative_sd": 0.1}},
        "instrument": {"V": ["daq-16bit:D/1"], "Vsc": ["daq-16bit:D/2"]},  # scans, so that the delay is free
    }
)


@pytest.mark.parametrize(("skew", "noise_V"), [(2, 0.1), (5, 0.1), (2, 0.3)])
def test_a_delay_is_not_drawn_between_two_samples(skew: int, noise_V: float):
    """Without the smooth drive, delays were off by 2 to 4 standard errors, and b by as many."""
    fits = [fitact.fit(record(seed, skew, noise_V), SCENE) for seed in range(6)]
    b = SKIN[0] * (2.0 * SKIN[2] + SKIN[1])
    errors = {"delay": [], "b": []}
    for fit in fits:
        assert fit.trusted
        assert fit.compression_error is not None
        delay, found = fit.parameters()["delay"], fit.derived()["b"]
        errors["delay"].append((delay["q50"] - skew * STEP / FINE) / delay["sd"])
        errors["b"].append(np.log(found["q50"] / b) / (found["sd"] / found["mean"]))
    for name, each in errors.items():
        assert np.max(np.abs(each)) < 3.5, name
        assert abs(np.mean(each)) < 3.5 / np.sqrt(len(each)), name


@pytest.mark.parametrize("late", [0.1, 0.5, 1.7])
def test_a_curved_drive_lies_on_the_curve_between_samples_and_corners_stay(late: float):
    k = np.arange(200.0)
    sine = np.sin(0.3 * k)
    curved = sine + missing_curve(late) * lasting_bend(sine)
    missed, left = (np.interp(k - late, k, each) - np.sin(0.3 * (k - late)) for each in (sine, curved))
    assert np.max(np.abs(left[5:-5])) < 0.1 * np.max(np.abs(missed[5:-5]))
    for corners in (np.abs(k - 100.0), np.abs(k - 100.4), np.clip(k - 100.0, 0.0, 2.0), 1.0 * (k > 100.0)):
        assert not lasting_bend(corners).any()


@pytest.mark.parametrize("lag", [0.0, 0.4])
@pytest.mark.parametrize("late", [0.1, -0.5, 1.7])
def test_corners_between_samples_are_missed_by_so_much(late: float, lag: float):
    """Straight edges less the lines between their samples, behind a low-pass by SciPy, which 16 delays stand for."""
    k, steps = np.arange(60.0), np.arange(0.0, 59.0, 1.0 / 400)
    V, exact = (np.interp(each, [10.3, 20.8, 35.15, 47.9], [0.0, 90.0, 90.0, -90.0]) for each in (k, steps))
    missed = exact - np.interp(steps, k, V)
    if lag:
        missed = scipy.signal.lsim(([1.0], [lag, 1.0]), missed, steps)[1]
    read = np.abs(np.interp(k - late, steps, missed))
    np.testing.assert_allclose(corner_errors(V, late, lag)[4:-4], read[4:-4], atol=(0.07 if lag else 0.01) * read.max())


@pytest.mark.parametrize(("skew", "bits"), [(3, 14), (12, 10)])
def test_samples_that_read_corners_between_samples_are_left_out(skew: int, bits: int):
    """Eight were outliers, and the residuals of 14 bits had structure."""
    fit = fitact.fit(record(0, skew, 0.1, 0.005, bits, "corners"), SCENE)
    b, found = SKIN[0] * (2.0 * SKIN[2] + SKIN[1]), fit.derived()["b"]
    assert fit.result == "successful"
    assert fit.figures["outliers"] == 0
    assert abs(np.log(found["q50"] / b)) < 4.0 * found["sd"] / found["mean"]
    assert fit.figures["samples"] > 0.99 * 3200


@pytest.mark.parametrize("skew", [3, 4, 13])
def test_a_fast_tone_is_not_cut_between_samples(skew: int):
    """Lines cut 0.3 % of a tone of 39 samples per period: g was off by 0.16 %, and noise and errors were larger."""
    scene = fitact.Scene.from_dict({"drive": {"waveform": "measured"}, "prior": {"Ci": {"relative_sd": 0.1}}})
    fit, truth = fitact.fit(record(0, skew, 0.02, waveform="tones"), scene), SKIN[2] / (2.0 * SKIN[2] + SKIN[1])
    found, delay = fit.derived()["g"], fit.parameters()["delay"]
    assert fit.result == "successful"
    assert fit.sigma == pytest.approx(0.02, rel=0.05)
    assert found["u"] < 2e-4
    assert abs(np.log(found["q50"] / truth)) < 3.5 * found["u"]
    assert abs(delay["q50"] - skew * STEP / FINE) < 3.5 * delay["sd"]


def test_the_noise_of_V_says_nothing_of_a_gain():
    """The data know the product of gain and g alone. A smaller gain that made the noise smaller was off by 22 u."""
    scene = fitact.Scene.from_dict({"drive": {"waveform": "measured"}, "measurement": {"gain_relative_sd": 0.01}})
    fit = fitact.fit(record(0, 2, 1.0, bits=9), scene)
    gain, found, (Rsc, Csc, Ci) = fit.names.index("gain"), fit.derived()["g"], np.exp(fit.theta[:3])
    assert abs(fit.theta[gain]) < 0.1 * fit.sd[gain]
    assert abs(np.log(found["q50"] / SKIN[2] * (2.0 * SKIN[2] + SKIN[1]))) < 3.5 * found["u"]
    smaller = np.array(fit.point)  # of the same b and product
    smaller[gain] -= 0.03
    total = np.exp(-0.03) * (2.0 * Ci + Csc)
    smaller[:3] = np.log([Rsc * np.exp(0.03), total - 2.0 * Ci, Ci])
    for likelihood in (fit.likelihood, fit.likelihood.without_compression()):
        with jax.enable_x64(True):
            equal, other = (float(likelihood.log_likelihood(each)) for each in (fit.point, smaller))
        assert other == pytest.approx(equal, abs=1e-4)


@pytest.mark.parametrize("bits", [9, 12])
@pytest.mark.parametrize("waveform", ["triangle", "sine"])
def test_a_skew_that_nobody_stated_is_in_the_uncertainty(waveform: str, bits: int):
    """Skews from none to half a step: with a fixed delay, b of the triangle was off by 8 to 27 u, and by 7 u in 9 bits.

    One sine does not tell a delay from b, which then is as uncertain as a delay of a step makes it.
    """
    scene = fitact.Scene.from_dict({"drive": {"waveform": "measured"}, "prior": {"Ci": {"relative_sd": 0.1}}})
    b, off = SKIN[0] * (2.0 * SKIN[2] + SKIN[1]), []
    for seed, skew in ((seed, skew) for skew in (0, 1, 4) for seed in range(3)):
        fit = fitact.fit(record(seed, skew, 0.1, bits=bits, waveform=waveform), scene)
        found, delay = fit.derived()["b"], fit.parameters()["delay"]
        assert fit.trusted
        assert found["u"] < (0.002 if waveform == "triangle" else 0.02)
        assert abs(delay["q50"] - skew * STEP / FINE) < 3.5 * delay["sd"]
        off.append(np.log(found["q50"] / b) / found["u"])
    assert np.max(np.abs(off)) < 3.0
    assert np.sqrt(np.mean(np.square(off))) < 1.6  # a chi-square of 9 degrees of freedom exceeds 2.56 x 9 in 0.6 %


@pytest.mark.parametrize(("R_H", "skew"), [(500.0, -6), (500.0, 6), (500.0, 14), (1.6e3, 6)])
def test_a_time_constant_far_below_the_step_with_a_delay(R_H: float, skew: int):
    """0.1 and 0.3 steps. When the noise of V went back in time with the response, g was off by 5 to 10 u."""
    scene = fitact.Scene.from_dict({"drive": {"waveform": "measured"}, "grounding": {"R_H": R_H}})
    Rsc, Csc, Ci = SKIN
    made = record(0, skew, 0.1, waveform="trapezoid", R_H=R_H)
    compressed, full = fitact.fit(made, scene), fitact.fit(made, scene, tolerance=0.0)
    assert compressed.trusted
    assert compressed.compression_error is not None
    assert compressed.compression_error < 1e-3
    assert (compressed.theta - full.theta) / full.sd == pytest.approx(np.zeros(full.theta.size), abs=1e-2)
    slow, _ = np.sort(-1.0 / np.roots([R_H * Ci * Rsc * Csc, Rsc * (2.0 * Ci + Csc) + R_H * Ci, 1.0]))[::-1]
    for name, truth in {"g": Ci / (2.0 * Ci + Csc), "b": slow}.items():
        found = compressed.derived()[name]
        assert abs(np.log(found["q50"] / truth)) < 3.5 * found["sd"] / found["mean"], name


@pytest.mark.parametrize(("waveform", "rel"), [("triangle", 0.02), ("sine", 0.004)])
def test_the_force_is_that_of_the_drive_without_its_noise(waveform: str, rel: float):
    """It is in proportion to Vsc^2. With the noise of V, of 2 V in 180 V, the peak of a sine was too high by 5 %."""
    force = fitact.fit(record(0, 2, 2.0, waveform=waveform), SCENE).derived()
    square = record(0, 2, 0.0, 0.0, bits=24, waveform=waveform)["Vsc"] ** 2
    assert force["force_peak"]["q50"] / force["force_mean"]["q50"] == pytest.approx(
        square.max() / square.mean(), rel=rel
    )


@pytest.mark.parametrize("waveform", ["carrier", "tones"])
def test_the_force_does_not_depend_on_the_curve_between_samples(waveform: str):
    """Half a step late, V is curved to be right between its samples; the force of a carrier was 3.9 % too large."""
    scene = fitact.Scene.from_dict({"drive": {"waveform": "measured"}, "prior": {"Ci": {"relative_sd": 1e-4}}})
    forces = []
    for skew in (0, 4):
        fit = fitact.fit(record(0, skew, 0.02, waveform=waveform), scene)
        found = fit.derived()
        forces.append(found["force_mean"]["q50"] / found["g"]["q50"] ** 2)
    assert forces[1] == pytest.approx(forces[0], rel=1e-3)


def test_the_noise_of_one_sine_is_no_information_on_a_delay():
    """V is known from all its samples, so that its noise is as good as that of Vsc. What smoothing left drew b."""
    scene = fitact.Scene.from_dict({"drive": {"waveform": "measured"}, "prior": {"Ci": {"relative_sd": 0.1}}})
    g, b = SKIN[2] / (2.0 * SKIN[2] + SKIN[1]), SKIN[0] * (2.0 * SKIN[2] + SKIN[1])
    for seed in range(3):
        fit = fitact.fit(record(seed, 2, 2.0, noise_Vsc=0.02, waveform="sine"), scene)
        alike = fitact.fit(record(seed, 2, 1e-2, noise_Vsc=np.hypot(0.02, 2.0 * g), waveform="sine"), scene)
        delay, found = fit.names.index("delay"), fit.derived()["b"]
        assert fit.sd[delay] == pytest.approx(alike.sd[delay], rel=0.05)
        assert found["u"] == pytest.approx(alike.derived()["b"]["u"], rel=0.05)
        assert abs(np.log(found["q50"] / b)) < 3.5 * found["u"]


@pytest.mark.parametrize(("skew", "bits"), [(0, 14), (3, 12), (4, 10)])
def test_a_carrier_tells_g_and_little_of_b(skew: int, bits: int):
    """Vsc has an offset. A charge with b of seconds took its place, and b was off by 10 u; a misfit or g off, too."""
    scene = fitact.Scene.from_dict({"drive": {"waveform": "measured"}, "prior": {"Ci": {"relative_sd": 0.1}}})
    truth = {"g": SKIN[2] / (2.0 * SKIN[2] + SKIN[1]), "b": SKIN[0] * (2.0 * SKIN[2] + SKIN[1])}
    for seed in range(3):
        fit = fitact.fit(record(seed, skew, 0.1, bits=bits, waveform="carrier", offset=0.15), scene)
        assert fit.result == "successful"
        errors = {name: np.log(fit.derived()[name]["q50"] / value) for name, value in truth.items()}
        u = {name: fit.derived()[name]["u"] for name in truth}
        assert abs(errors["g"]) < 3.5 * u["g"] < 1e-2
        assert u["b"] > 0.1
        assert abs(errors["b"]) < max(3.5 * u["b"], 2.0)  # log b is far from normal


def test_the_table_and_the_full_sum_shift_alike():
    made = record(1, 11, 0.1)  # more than a step, by which the noise of V is moved, too
    compressed, full = fitact.fit(made, SCENE), fitact.fit(made, SCENE, tolerance=0.0)
    assert compressed.compression_error is not None
    assert compressed.compression_error < 1e-3
    assert (compressed.theta - full.theta) / full.sd == pytest.approx(np.zeros(full.theta.size), abs=1e-3)
    assert compressed.sd == pytest.approx(full.sd, rel=1e-3)
