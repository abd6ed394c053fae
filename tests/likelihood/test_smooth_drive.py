"""A delay of Vsc against a noisy recorded V: smoothing against SciPy, and fits of records of known skew."""

import numpy as np
import pytest
import scipy.signal

import fitact
from fitact.likelihood.smooth_drive import smooth_drive

STEP, FINE = 6.25e-6, 8  # s, and fine steps of the truth in a step
SKIN = np.array([160e3, 24e-9, 1.35e-9])


def test_smooth_parts_are_those_of_savitzky_and_golay_and_edges_stay_as_they_are():
    rng = np.random.default_rng(0)
    V = 100.0 * np.sin(2.0 * np.pi * np.arange(4000) / 800.0) + 0.1 * rng.standard_normal(4000)
    V[2000:] += 50.0
    smooth = smooth_drive(V, 0.1)
    inside = np.r_[4:1990, 2010:3996]
    reference = scipy.signal.savgol_filter(V, 9, 2)[inside]
    np.testing.assert_allclose(
        smooth[inside][np.abs(V[inside] - reference) < 0.39],
        reference[np.abs(V[inside] - reference) < 0.39],
        rtol=1e-12,
    )
    np.testing.assert_array_equal(smooth[1996:2004], V[1996:2004])
    assert np.std(np.diff(smooth[10:1990])) < np.std(np.diff(V[10:1990]))
    np.testing.assert_array_equal(smooth_drive(V, 0.0), V)


def record(seed: int, skew: int, noise_V: float, noise_Vsc: float = 0.02, bits: int = 14) -> fitact.Record:
    """Return two periods of a slow triangle, rounded, with Vsc late by `skew` eighths of a step."""
    rng, fine = np.random.default_rng(seed), STEP / FINE * np.arange(3 * 1600 * FINE)
    V = 180.0 * scipy.signal.sawtooth(2.0 * np.pi * 100.0 * fine, 0.5)
    Rsc, Csc, Ci = SKIN
    # (2 Ci + Csc) Rsc dVsc/dt + Vsc = Ci Rsc dV/dt, exactly for linear pieces
    system = scipy.signal.lti([Ci * Rsc, 0.0], [(2.0 * Ci + Csc) * Rsc, 1.0])
    _, Vsc, _ = scipy.signal.lsim(system, V, fine)
    kept = np.arange(1600 * FINE, 3 * 1600 * FINE, FINE)
    channels = {"V": V[kept], "Vsc": Vsc[kept - skew]}
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


@pytest.mark.parametrize(("bits", "noise_V"), [(12, 0.1), (12, 0.03), (14, 0.03)])
def test_a_delay_that_nobody_stated_is_found_in_a_rounded_drive(bits: int, noise_V: float):
    """Half a step: not found while V was not smooth where it is rounded to its noise, b was off by 24 to 27 u."""
    scene = fitact.Scene.from_dict({"drive": {"waveform": "measured"}, "prior": {"Ci": {"relative_sd": 0.1}}})
    b = SKIN[0] * (2.0 * SKIN[2] + SKIN[1])
    for seed in range(3):
        fit = fitact.fit(record(seed, 4, noise_V, bits=bits), scene)
        found, delay = fit.derived()["b"], fit.parameters()["delay"]
        assert abs(np.log(found["q50"] / b)) < 3.5 * found["sd"] / found["mean"]
        assert abs(delay["q50"] - 0.5 * STEP) < 3.5 * delay["sd"]


def test_a_skew_too_small_to_be_fitted_is_in_the_uncertainty():
    """An eighth of a step, and none: b is off by up to 8 u of the fit, which has no delay in most of these records."""
    given = {"drive": {"waveform": "measured"}, "prior": {"Ci": {"relative_sd": 0.1}}}
    scene = fitact.Scene.from_dict(given)
    b, off, kept = SKIN[0] * (2.0 * SKIN[2] + SKIN[1]), [], []
    for seed, skew in ((seed, skew) for skew in (0, 1) for seed in range(4)):
        fit = fitact.fit(record(seed, skew, 0.1, bits=12), scene)
        found = fit.derived()["b"]
        off.append(np.log(found["q50"] / b) / found["combined"]["u"])
        if "delay" not in fit.names:
            kept.append(np.log(found["q50"] / b) / found["u"])
            (delay,) = [each for each in fit.calibration_entry("b")["not_stated"] if each["source"] == "skew"]
            assert 0.0 < delay["input_u"] < STEP
    assert np.max(np.abs(kept)) > 5.0
    assert np.max(np.abs(off)) < 3.0
    stated = {"instrument": {"V": ["scope-8bit:S"], "Vsc": ["scope-8bit:S"]}}
    instrument = fitact.fit(record(0, 1, 0.1), fitact.Scene.from_dict(given | stated))
    assert all(each["source"] != "skew" for each in instrument.calibration_entry("b")["not_stated"])


def test_the_table_and_the_full_sum_shift_alike():
    made = record(1, 11, 0.1)  # more than a step, by which the noise of V is moved, too
    compressed, full = fitact.fit(made, SCENE), fitact.fit(made, SCENE, tolerance=0.0)
    assert compressed.compression_error is not None
    assert compressed.compression_error < 1e-3
    assert (compressed.theta - full.theta) / full.sd == pytest.approx(np.zeros(full.theta.size), abs=1e-3)
    assert compressed.sd == pytest.approx(full.sd, rel=1e-3)
