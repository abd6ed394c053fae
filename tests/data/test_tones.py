"""Recorded drives of few sinusoids in noise and rounding, against the sinusoids of which they were made."""

import numpy as np
import pytest
import scipy.signal

import fitact
from fitact.data.noise import rounding_noise_sd
from fitact.data.tones import find_tones

# amplitude (V) and frequency (cycles per sample) of each tone
DRIVES = {
    "sine": [(100.0, 1 / 1000)],
    "two and a half periods": [(100.0, 1 / 2400)],
    "distorted": [(100.0, 1 / 1000), (1.0, 2 / 1000), (0.5, 3 / 1000)],
    "carrier": [(50.0, 0.1), (25.0, 0.1007), (25.0, 0.0993)],
    "two tones": [(90.0, 1 / 1600), (90.0, 41 / 1600)],
}


def record_tones(name: str, bits: int, noise: float, samples: int = 6000) -> tuple[np.ndarray, np.ndarray]:
    """Return V as recorded, and without noise and rounding."""
    rng, k = np.random.default_rng(0), np.arange(samples)
    V = sum((a * np.sin(2.0 * np.pi * f * k + rng.uniform(0.0, 6.0)) for a, f in DRIVES[name]), 0.3 * np.ones(samples))
    noisy = V + noise * rng.standard_normal(samples)
    step = 260.0 / 2**bits
    return step * np.round(noisy / step), V


@pytest.mark.parametrize("bits", [8, 14])
@pytest.mark.parametrize("name", list(DRIVES))
def test_tones_are_as_certain_as_noise_allows(name: str, bits: int):
    recorded, V = record_tones(name, bits, 0.2)
    tones = find_tones(recorded, min(f for _, f in DRIVES[name]), rounding_noise_sd(recorded))
    assert tones is not None
    assert len(tones.frequencies) == len(DRIVES[name])
    parameters, error = 1 + 3 * len(DRIVES[name]), np.std(recorded - V)
    # least squares with p parameters has an error of sd sqrt(p / n) of the noise (2.5: 1 of 10^6 for four parameters)
    assert np.sqrt(np.mean((tones.values() - V) ** 2)) < 2.5 * error * np.sqrt(parameters / V.size)
    basis = tones.basis()
    np.testing.assert_allclose(basis @ basis.T, np.eye(len(basis)), atol=1e-12)
    np.testing.assert_allclose((basis @ tones.values()) @ basis, tones.values(), atol=1e-9)


@pytest.mark.parametrize("channel", ["V", "Vsc"])
@pytest.mark.parametrize("name", ["sine", "carrier"])
def test_the_noise_of_a_carrier_is_that_beside_it(name: str, channel: str):
    """Third differences took a carrier of ten samples per period for noise: 20 times too much."""
    recorded, V = record_tones(name, 12, 0.2)
    time, Vsc = 1e-5 * np.arange(V.size), 0.1 * (V + 0.2 * np.random.default_rng(1).standard_normal(V.size))
    found = fitact.Record.from_arrays(time, V=recorded, Vsc=Vsc).noise(channel)
    assert found == pytest.approx(np.std(recorded - V if channel == "V" else Vsc - 0.1 * V), rel=0.04)


@pytest.mark.parametrize("periods", [3.2, 20.0])
@pytest.mark.parametrize("bits", [10, 14])
def test_a_multisine_has_many_tones(periods: float, bits: int):
    """Twenty odd harmonics of one height, the fastest with five samples in a period."""
    rng, k, f = np.random.default_rng(0), np.arange(round(200.0 * periods)), 1.0 / 200.0
    V = sum(20.0 * np.cos(2.0 * np.pi * n * f * k + np.pi * n * (n - 1) / 40.0) for n in range(1, 40, 2))
    step = 2.6 * np.max(np.abs(V)) / 2**bits
    recorded = step * np.round((V + 0.1 * rng.standard_normal(k.size)) / step)
    tones = find_tones(recorded, 1.0001 * f, rounding_noise_sd(recorded))
    assert tones is not None
    np.testing.assert_allclose(np.sort(tones.frequencies) / (2.0 * np.pi * f), np.arange(1.0, 40.0, 2.0), atol=1e-3)
    assert np.std(tones.values() - V) < 2.5 * np.std(recorded - V) * np.sqrt(61.0 / k.size)


@pytest.mark.parametrize("periods", [3.2, 20.0])
@pytest.mark.parametrize("shape", ["square", "trapezoid", "triangle"])
def test_edges_and_corners_are_no_tones(shape: str, periods: float):
    turns = np.arange(round(200.0 * periods)) / 200.0
    triangle = scipy.signal.sawtooth(2.0 * np.pi * turns, 0.5)
    V = 100.0 * np.clip({"square": 1e6, "trapezoid": 5.0, "triangle": 1.0}[shape] * triangle, -1.0, 1.0)
    assert find_tones(V + 0.05 * np.random.default_rng(0).standard_normal(V.size), 1.0 / 200.0) is None


def test_tones_of_other_samples():
    recorded, V = record_tones("carrier", 12, 0.2)
    tones = find_tones(recorded[:3000], np.inf)
    assert tones is not None
    later = tones.continue_with(recorded[3000:5000])
    assert later is not None
    np.testing.assert_allclose(later.values(), V[3000:5000], atol=0.05)
    changed = np.where(np.arange(2000) < 1000, recorded[3000:5000], 0.5 * recorded[3000:5000])
    assert tones.continue_with(changed) is None


@pytest.mark.parametrize("periods", [2.3, 6.4, 60.0])
def test_other_drives_have_no_tones(periods: float):
    k, rng = np.arange(6000), np.random.default_rng(1)
    turns = 2.0 * np.pi * periods * k / k.size
    sine = 100.0 * np.sin(turns)
    pole = np.exp(-1.0 / 30.0)
    drives = {
        "square": 100.0 * scipy.signal.square(turns),
        "slewed": scipy.signal.lfilter([1.0 - pole], [1.0, -pole], 100.0 * scipy.signal.square(turns)),
        "triangle": 100.0 * scipy.signal.sawtooth(turns, 0.5),
        "chirp": 100.0 * scipy.signal.chirp(k / k.size, periods, 1.0, 3.0 * periods),
        "burst": np.where(k < 4000, sine, 0.0),
        "a sine that grows": sine * (1.0 + 0.02 * (k / k.size) ** 2),
        "a sine that sticks": np.where(abs(k - 3000) < 60, sine[2940], sine),
    }
    for name, V in drives.items():
        assert find_tones(V + 0.1 * rng.standard_normal(k.size), periods / k.size) is None, name


@pytest.mark.parametrize("drive", ["square", "dead time", "triangle", "stairs"])
def test_few_levels_of_an_ideal_drive_are_no_rounding(drive: str):
    """The step between the two levels of a square was taken for that of a converter, and the square for a sine."""
    phase = np.arange(1000) % 500 / 500.0
    V = {
        "square": np.where(phase < 0.5, 180.0, -180.0),
        "dead time": np.where(phase % 0.5 < 0.1, 0.0, np.where(phase < 0.5, 180.0, -180.0)),
        "triangle": 180.0 * scipy.signal.sawtooth(2.0 * np.pi * np.round(20.0 * phase) / 20.0, 0.5),
        "stairs": np.round(3.0 * np.sin(2.0 * np.pi * phase)),
    }[drive]
    record = fitact.Record.from_arrays(2e-5 * np.arange(V.size), V=V, Vsc=0.1 * V)
    assert record.tones is None
    assert record.noise("V") < 1e-9
