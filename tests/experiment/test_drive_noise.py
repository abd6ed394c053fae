"""Information with noise of V, against the covariance of all samples as one matrix and against sums of harmonics."""

import dataclasses

import numpy as np
import pytest
import scipy.linalg

import fitact
from fitact.experiment.blind_directions import blind_directions
from fitact.experiment.experiment import CandidateDesign, evaluate_design
from fitact.experiment.fisher import Experiment, covariance_factor, force_gradient, jacobian
from fitact.experiment.options import changes

VALUES = {"Rsc": 180e3, "Csc": 18e-9, "Ci": 0.6e-9}
FREQUENCY, COUNT, RISE, STRAY = 70.0, 1000, 400e-6, 100e-12  # Hz, samples, s, F
OMEGA = 2.0 * np.pi * FREQUENCY
TRAPEZOID = fitact.Trapezoid(300.0, FREQUENCY, RISE)
SQUARE = fitact.Square(300.0, FREQUENCY, phase=np.pi / COUNT)  # its edges lie between two samples
BENCH = Experiment(
    circuit=fitact.FinalCircuit(**VALUES),
    free=tuple(VALUES),
    prior_factor=np.diag([3.0, 3.0, 3.0]),
    drive=TRAPEZOID,
    time=np.arange(COUNT) / (FREQUENCY * COUNT),
    channels=("I",),
    noise={"Vsc": 0.1, "I": 20e-9, "V": 0.5},
    records=4.0,
)
FREE = dataclasses.replace(
    BENCH,
    free=(*VALUES, "stray_capacitance"),
    stray_capacitance=STRAY,
    prior_factor=np.diag([3.0, 3.0, 3.0, 0.1]),
)


def gains(logs: np.ndarray, omega: np.ndarray) -> dict[str, np.ndarray]:
    """Return Vsc/V and I/V of two equal skins in series with Ci, beside a stray capacitance."""
    Rsc, Csc, Ci, stray = np.exp([*logs, -np.inf][:4])
    skin, s = Rsc / (1.0 + 1j * omega * Rsc * Csc), 1j * omega
    loop = s * Ci / (1.0 + 2.0 * s * Ci * skin)
    return {"Vsc": loop * skin, "I": loop + s * stray}


def harmonics(rise: float, count: int = 100_000) -> np.ndarray:
    """Return the Fourier coefficients of the drive, from its slope or its jumps."""
    omega = OMEGA * np.arange(1, count)
    half = 1.0 - np.exp(-1j * np.pi * np.arange(1, count))
    if rise:
        return 300.0 * FREQUENCY * half * -np.expm1(-1j * omega * rise) / rise / (1j * omega) ** 2
    return 300.0 * FREQUENCY * half / (1j * omega) * np.exp(1j * np.arange(1, count) * np.pi / COUNT)


def periodic(logs: np.ndarray, channel: str, rise: float) -> np.ndarray:
    """Return a period of a channel: the harmonics, of which those above half the sampling rate alias."""
    drive = harmonics(rise)
    order = np.arange(1, drive.size + 1)
    lines = np.zeros(COUNT, complex)
    np.add.at(lines, order % COUNT, gains(logs, OMEGA * order)[channel] * drive)
    return 2.0 * COUNT * np.fft.ifft(lines).real


def between_jumps(logs: np.ndarray, channel: str, rise: float) -> np.ndarray:
    """Return I between ideal jumps: what decays with the time constant b."""
    Rsc, Csc, Ci = np.exp(logs[:3])
    b, half = Rsc * (2.0 * Ci + Csc), 0.5 / FREQUENCY
    since = (np.arange(COUNT) + 0.5) / (FREQUENCY * COUNT)
    vsc = 300.0 * Ci / (2.0 * Ci + Csc) * np.exp(-(since % half) / b) / (1.0 + np.exp(-half / b))
    return np.where(since < half, 1.0, -1.0) * vsc * 2.0 * Ci / (Rsc * (2.0 * Ci + Csc))


def expected_sd(e: Experiment, signal=periodic, rise: float = RISE, used: np.ndarray | None = None) -> np.ndarray:
    """Standard deviations from the samples' covariance matrix: noise of the channels, and of V through the circuit."""
    logs = np.log([*VALUES.values(), STRAY])[: len(e.free)]
    steps = 1e-4 * np.eye(logs.size)
    responses, slopes = [], []
    for channel in e.channels:
        change = [signal(logs + d, channel, rise) - signal(logs - d, channel, rise) for d in steps]
        slopes.append(np.transpose(change) / 2e-4)
        gain = gains(logs, 2.0 * np.pi * np.fft.rfftfreq(COUNT, 1.0 / (FREQUENCY * COUNT)))[channel]
        responses.append(scipy.linalg.circulant(np.fft.irfft(gain, COUNT)))
    matrix, slope = np.concatenate(responses), np.concatenate(slopes)
    own = np.repeat([e.noise[channel] for channel in e.channels], COUNT)
    covariance = np.diag(own**2) + e.noise["V"] ** 2 * matrix @ matrix.T
    kept = np.ones(own.size, bool) if used is None else used
    information = e.records * slope[kept].T @ np.linalg.solve(covariance[np.ix_(kept, kept)], slope[kept])
    return np.sqrt(np.diag(np.linalg.inv(information + np.diag(np.diag(e.prior_factor) ** -2.0))))


def found_sd(e: Experiment) -> np.ndarray:
    return np.linalg.norm(covariance_factor(jacobian(e), e.prior_factor), axis=1)


@pytest.mark.parametrize("channels", [("I",), ("Vsc", "I"), ("I", "Vsc")], ids="+".join)
@pytest.mark.parametrize("noise", [0.5, 0.02])
@pytest.mark.parametrize("experiment", [BENCH, FREE], ids=["three", "stray"])
def test_noise_of_V_is_that_of_one_large_covariance_matrix(experiment: Experiment, channels, noise: float):
    given = dataclasses.replace(experiment, channels=channels, noise=experiment.noise | {"V": noise})
    np.testing.assert_allclose(found_sd(given), expected_sd(given), rtol=0.01)


def test_vsc_alone_with_noise_of_V():
    given = dataclasses.replace(BENCH, channels=("Vsc",), prior_factor=np.diag([0.5, 0.5, 0.05]))
    np.testing.assert_allclose(found_sd(given), expected_sd(given), rtol=0.01)


def test_samples_beside_a_jump_are_not_used():
    given = dataclasses.replace(BENCH, drive=SQUARE)
    index = np.arange(COUNT) % (COUNT // 2)
    used = (index >= 2) & (index < COUNT // 2 - 2)
    found, expected = found_sd(given), expected_sd(given, between_jumps, 0.0, used)
    assert expected.max() > 1.0  # two numbers for three parameters
    np.testing.assert_allclose(found, expected, rtol=0.02)


def test_unknown_stray_capacitance_is_not_told_from_the_circuit_by_I():
    """Three numbers, C at low and at high frequency and b, for four unknowns."""
    assert len(blind_directions(BENCH.circuit, FREE.free, ("I",), STRAY)) == 1
    assert len(blind_directions(BENCH.circuit, FREE.free, ("Vsc", "I"), STRAY)) == 0
    assert found_sd(FREE)[3] == pytest.approx(0.1, rel=1e-3)
    assert np.all(found_sd(FREE)[:3] > 2.0 * found_sd(BENCH))
    with pytest.raises(fitact.InputError, match="no value above zero"):
        found_sd(dataclasses.replace(FREE, channels=("Vsc",)))


def test_known_stray_capacitance_lets_more_noise_of_V_through():
    """I has the gain Y + j w Cp then; only the noise rises."""
    known = dataclasses.replace(BENCH, stray_capacitance=10.0 * STRAY)
    assert np.all(found_sd(known) > found_sd(BENCH))


@pytest.mark.parametrize("seed", range(3))  # any
def test_recorded_drive_counts_as_the_drive_that_it_is(seed: int):
    """Eight periods of V with its noise; the noise itself would be a known drive of much information."""
    time = np.arange(8 * COUNT) / (FREQUENCY * COUNT)
    clean = np.asarray(TRAPEZOID.value(time))
    recorded = clean + 0.5 * np.random.default_rng(seed).standard_normal(time.size)
    known = dataclasses.replace(BENCH, time=time, records=1.0)
    drive = fitact.Sampled(time, recorded, 8.0 / FREQUENCY)
    np.testing.assert_allclose(found_sd(dataclasses.replace(known, drive=drive)), found_sd(known), rtol=0.03)
    start = dataclasses.replace(known, drive=fitact.Sampled(time, recorded), steady_state=False)
    np.testing.assert_allclose(found_sd(start), found_sd(known), rtol=0.25)  # rest before the first sample


def test_quieter_V_is_an_option_where_its_noise_is_stated():
    gradient = force_gradient(BENCH)
    (change,) = (each for each in changes() if each.name == "quieter V")
    design = CandidateDesign((BENCH,))
    option = evaluate_design(change(design), (), gradient)
    half = dataclasses.replace(BENCH, noise=BENCH.noise | {"V": 0.25})
    assert option.text == "V recorded with half the noise (250 mV rms)"
    assert option.force_sd == pytest.approx(evaluate_design(CandidateDesign((half,)), (), gradient).force_sd)
    stated = dataclasses.replace(BENCH, noise=BENCH.noise | {"V": 0.0})
    assert change(CandidateDesign((stated,))) is None


def test_a_recorded_drive_serves_samples_between_its_own():
    """The information of twice as many samples is that with the same drive, recorded twice as fast."""
    bench = dataclasses.replace(BENCH, channels=("Vsc", "I"), steady_state=False)
    found = []
    for each in (1, 2):
        time = np.arange(2 * COUNT * each) / (FREQUENCY * COUNT * each)
        noise = 1e-3 * np.random.default_rng(0).standard_normal(time.size)
        drive = fitact.Sampled(time, np.asarray(TRAPEZOID.value(time)) + noise)
        finer = np.arange(4 * COUNT - 2) / (2.0 * FREQUENCY * COUNT)
        rows = jacobian(dataclasses.replace(bench, drive=drive, time=finer, noise=BENCH.noise | {"V": 1e-3}))
        found.append(rows.T @ rows)
    np.testing.assert_allclose(*map(np.diagonal, found), rtol=0.01)


@pytest.mark.parametrize("channels", [("Vsc",), ("I",), ("Vsc", "I")], ids="+".join)
@pytest.mark.parametrize("late", [1e-7, 1e-5, 1e-3])
def test_unknown_delays_take_the_phases_of_a_sine(channels, late: float):
    """A sine has one line, whose information on the circuit and the delays is a sum over the channels' phasors."""
    amplitude = 150.0
    given = dataclasses.replace(
        BENCH,
        drive=fitact.Sine(2.0 * amplitude, FREQUENCY),
        channels=channels,
        prior_factor=np.diag([0.5, 0.5, 0.05]),
        delay_sd=dict.fromkeys(channels, late),
    )
    logs = np.log(list(VALUES.values()))

    def phasors(theta: np.ndarray) -> np.ndarray:
        found = gains(theta[:3], OMEGA)
        return np.array([found[name] for name in channels]) * np.exp(-1j * OMEGA * theta[3:])

    center, steps = np.append(logs, np.zeros(len(channels))), np.array([1e-4] * 3 + [1e-7] * len(channels))
    differences = [phasors(center + d) - phasors(center - d) for d in np.diag(steps)]
    slope = np.transpose(differences) / (2.0 * steps)
    gain = phasors(center)
    covariance = np.diag([given.noise[name] ** 2 for name in channels]) + 0.5**2 * np.outer(gain, gain.conj())
    samples = given.records * COUNT
    information = 0.5 * samples * amplitude**2 * (slope.conj().T @ np.linalg.solve(covariance, slope)).real
    prior = np.diag([0.5, 0.5, 0.05] + [late] * len(channels))
    # in units of the prior, since the delays are small numbers
    expected = prior @ np.linalg.inv(np.eye(len(prior)) + prior @ information @ prior) @ prior
    # the derivatives in time are differences between neighbouring samples
    np.testing.assert_allclose(found_sd(given), np.sqrt(np.diag(expected))[:3], rtol=2e-3)
