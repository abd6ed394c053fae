"""Expected errors against finite differences of scipy's simulation, for the paper's device."""

import dataclasses
import functools

import numpy as np
import pytest
import scipy.signal

import fitact
from fitact.experiment.experiment import CandidateDesign, DesignOption, evaluate_design
from fitact.experiment.fisher import Experiment, covariance_factor, force_gradient

VALUES = {"Rsc": 160e3, "Csc": 22e-9, "Ci": 1.35e-9}
PRIOR_SD = np.array([0.3, 0.3, 0.05])
NOISE = {"Vsc": 0.1, "I": 20e-9}
COUNT, PERIODS = 4000, 2
SQUARE = fitact.Square(360.0, 100.0)
RESISTOR = fitact.DirectGround(**VALUES, series_resistor=100e3)
NOMINAL = Experiment(
    circuit=fitact.FinalCircuit(**VALUES),
    free=tuple(VALUES),
    prior_factor=np.diag(PRIOR_SD),
    drive=SQUARE,
    time=np.arange(COUNT) * (0.01 * PERIODS / COUNT),
    channels=("Vsc",),
    noise=NOISE,
)
BOTH = dataclasses.replace(NOMINAL, channels=("Vsc", "I"))


def expected_sd(experiment: Experiment) -> DesignOption:
    return evaluate_design(CandidateDesign((experiment,)), (), force_gradient(experiment))


@functools.cache
def scipy_vsc(Rsc: float, Csc: float, Ci: float, series: float) -> np.ndarray:
    """Settled periods of Vsc by scipy.signal.lsim, exact for a square whose edges are samples."""
    settle, half = 12, COUNT // PERIODS // 2
    voltage = np.tile(np.repeat([180.0, -180.0], half), settle + PERIODS)
    b = Rsc * (2.0 * Ci + Csc) + series * Ci
    system = ([Rsc * Ci, 0.0], [series * Ci * Rsc * Csc, b, 1.0] if series else [b, 1.0])
    return scipy.signal.lsim(system, voltage, np.arange(voltage.size) * NOMINAL.time[1], interp=False)[1][-COUNT:]


def scipy_current(Rsc: float, Csc: float, Ci: float, series: float) -> np.ndarray:
    """Return the current between the edges: Vsc / Rsc + Csc dVsc/dt, with Vsc falling at its time constant."""
    return scipy_vsc(Rsc, Csc, Ci, series) * (1.0 / Rsc - Csc / (Rsc * (2.0 * Ci + Csc)))


def scipy_log_force(Rsc: float, Csc: float, Ci: float, series: float) -> np.ndarray:
    """Eq. (22) with eq. (3), up to constants; the mean of a half period between its two ends."""
    vsc = scipy_vsc(Rsc, Csc, Ci, series)
    jump = 0.0 if series else 360.0 * Ci / (2.0 * Ci + Csc)
    mean = np.mean(vsc**2) + ((jump - vsc[0]) ** 2 - vsc[0] ** 2) / (COUNT // PERIODS)
    return np.log([Ci * Csc / (Ci + Csc) * mean])


def derivative(function, series: float, h: float = 1e-4) -> np.ndarray:
    values = np.array(list(VALUES.values()))
    columns = [
        function(*values * np.exp(h * e), series) - function(*values * np.exp(-h * e), series) for e in np.eye(3)
    ]
    return np.stack(columns, axis=1) / (2.0 * h)


def scipy_expected(channels: tuple[str, ...], series: float = 0.0) -> tuple[np.ndarray, float]:
    """Standard deviations of the log-parameters and of the log mean force: the inverse of the information."""
    index = np.arange(COUNT) % (COUNT // PERIODS // 2)
    away = (index >= 2) & (index < index.max() - 1)
    information = np.diag(PRIOR_SD**-2.0)
    if "Vsc" in channels:
        slope = derivative(scipy_vsc, series) / NOISE["Vsc"]
        information += slope.T @ slope
    if "I" in channels:
        slope = derivative(scipy_current, series)[away] / NOISE["I"]
        information += slope.T @ slope
    covariance, gradient = np.linalg.inv(information), derivative(scipy_log_force, series)[0]
    return np.sqrt(np.diag(covariance)), float(np.sqrt(gradient @ covariance @ gradient))


@pytest.fixture(scope="module")
def nominal() -> DesignOption:
    return expected_sd(NOMINAL)


def test_vsc_alone_leaves_the_prior_along_the_contact_area(nominal: DesignOption):
    """Where only (-1, 1, 1) t is open, t has the precision of the three priors together: 4.9 %."""
    along = np.sum(PRIOR_SD**-2.0) ** -0.5
    assert along == pytest.approx(0.0487, abs=5e-5)
    assert nominal.force_sd == pytest.approx(along, rel=1e-4)
    for sd in nominal.sd.values():
        assert sd == pytest.approx(along, rel=1e-4)
    gradient = derivative(scipy_log_force, 0.0)[0]
    assert nominal.contraction == pytest.approx(1.0 - along / np.linalg.norm(gradient * PRIOR_SD), rel=1e-4)


@pytest.mark.parametrize(
    ("experiment", "series", "percent"),
    [(BOTH, 0.0, 0.023), (dataclasses.replace(NOMINAL, circuit=RESISTOR), 100e3, 0.133)],
    ids=["current", "resistor"],
)
def test_remedies_that_see_the_contact_area(experiment: Experiment, series: float, percent: float):
    """The expectation is scipy's, for 4,000 samples in two periods, 0.1 V and 20 nA."""
    sd, force_sd = scipy_expected(experiment.channels, series)
    found = expected_sd(experiment)
    np.testing.assert_allclose(list(found.sd.values()), sd, rtol=1e-4)
    assert found.force_sd == pytest.approx(force_sd, rel=1e-4)
    assert 100.0 * found.force_sd == pytest.approx(percent, abs=6e-4)


def test_a_sine_cannot_use_the_resistor():
    """One frequency shows an amplitude and a phase, two numbers for three parameters."""
    sine = dataclasses.replace(NOMINAL, circuit=RESISTOR, drive=fitact.Sine(360.0, 100.0))
    assert expected_sd(sine).force_sd > 0.045


def test_between_ideal_edges_the_current_alone_shows_two_numbers_only():
    """A height and a time constant; what would give the third flows within the edges."""
    alone = expected_sd(dataclasses.replace(NOMINAL, channels=("I",)))
    _, force_sd = scipy_expected(("I",))
    assert force_sd > 0.04
    assert alone.force_sd == pytest.approx(force_sd, rel=1e-4)


def test_long_records_are_thinned_without_a_loss():
    """Fifty times the periods at twice the rate: a hundred times the information, and no step with the period."""
    long = dataclasses.replace(BOTH, time=np.arange(100 * COUNT) * (0.5 * NOMINAL.time[1]))
    assert expected_sd(long).force_sd == pytest.approx(0.1 * expected_sd(BOTH).force_sd, rel=0.03)


def test_four_records_halve_what_the_data_tell(nominal: DesignOption):
    once, four = expected_sd(BOTH), expected_sd(dataclasses.replace(BOTH, records=4.0))
    assert four.force_sd == pytest.approx(0.5 * once.force_sd, rel=1e-4)
    assert expected_sd(dataclasses.replace(NOMINAL, records=4.0)).force_sd == pytest.approx(nominal.force_sd, rel=1e-4)


def test_a_free_gain_of_vsc_is_known_from_the_prior_alone(nominal: DesignOption):
    root = np.diag([*PRIOR_SD, 0.02])
    freed = dataclasses.replace(NOMINAL, free=(*VALUES, "gain"), prior_factor=root)
    found = expected_sd(freed)
    assert found.sd["gain"] == pytest.approx(0.02, rel=0.01)
    # along that ridge Csc moves, and the mean force with it
    assert found.force_sd > nominal.force_sd


def measured(noise: float, periods: int) -> Experiment:
    """A drive recorded with noise, its edges within one step; the first half period finds it at rest."""
    time = np.arange(periods * COUNT // PERIODS) * NOMINAL.time[1]
    voltage = np.asarray(SQUARE.value(time)) + noise * np.random.default_rng(0).standard_normal(time.size)
    return dataclasses.replace(BOTH, drive=fitact.Sampled(time, voltage), time=time, steady_state=False)


def test_noise_of_a_measured_drive_tells_nothing():
    """Taken at its word, a slope of 0.1 V / 5 us would drive 20 uA through Ci, against 20 nA of noise."""
    clean, noisy = (expected_sd(measured(noise, 4)).force_sd for noise in (0.0, 0.1))
    assert noisy == pytest.approx(clean, rel=0.02)
    assert clean == pytest.approx(expected_sd(BOTH).force_sd * np.sqrt(2.0 / 3.5), rel=0.05)


def test_the_beginning_of_a_long_measured_drive_stands_for_all():
    long, short = (expected_sd(measured(0.0, periods)).force_sd for periods in (16, 4))
    assert long == pytest.approx(0.5 * short, rel=0.05)


def test_a_root_of_the_covariance_is_the_same_however_rounding_turns_the_singular_vectors():
    """Another machine's rounding: residuals in another order, and two directions without information."""
    random = np.random.default_rng(1)
    jacobian = random.standard_normal((50, 2)) @ random.standard_normal((2, 4)) * 1e4
    prior_factor = np.linalg.cholesky(np.cov(random.standard_normal((4, 40))))
    root = covariance_factor(jacobian, prior_factor)
    expected = np.linalg.inv(jacobian.T @ jacobian + np.linalg.inv(prior_factor @ prior_factor.T))
    np.testing.assert_allclose(root @ root.T, expected, rtol=1e-5)
    np.testing.assert_allclose(covariance_factor(-jacobian[::-1], prior_factor), root, atol=1e-9 * root.max())
