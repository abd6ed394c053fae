"""The verdict against the Fisher information, written out."""

import dataclasses

import numpy as np
import pytest
import scipy.linalg

from fitact.experiment.fisher import Experiment, covariance_factor
from fitact.fitting.identifiability import Identifiability, assess_identifiability
from tests.experiment.test_expected import (
    BOTH,
    NOMINAL,
    PRIOR_SD,
    RESISTOR,
    VALUES,
    derivative,
    scipy_current,
    scipy_log_force,
    scipy_vsc,
)


def judged(experiment: Experiment, jacobian: np.ndarray) -> Identifiability:
    root = covariance_factor(jacobian, experiment.prior_factor)
    return assess_identifiability(
        experiment.free,
        root,
        experiment.prior_factor,
        derivative(scipy_log_force, 0.0)[0],
        experiment.free,
        experiment.channels,
        experiment,
    )


def test_any_order_of_coordinates_correlated_priors_and_nuisances():
    """Eigenvalues and the prior's fraction of the force variance, by the Schur complement of the information."""
    rng = np.random.default_rng(0)  # any numbers would do
    names = ("delay", "Ci", "gain", "Rsc", "Csc")
    jacobian, mixing = rng.standard_normal((40, 5)) * [3.0, 0.3, 2.0, 1.0, 5.0], rng.standard_normal((3, 3))
    circuit, nuisances = [3, 4, 1], [0, 2]
    prior = np.diag([0.3, 1.0, 0.1, 1.0, 1.0])
    prior[np.ix_(circuit, circuit)] = mixing @ mixing.T + 0.1 * np.eye(3)
    experiment = dataclasses.replace(NOMINAL, free=("Rsc", "Csc", "Ci"))
    gradient = rng.standard_normal(5)
    prior_root = np.linalg.cholesky(prior)
    evidence = names, covariance_factor(jacobian, prior_root), prior_root, gradient
    found = assess_identifiability(*evidence, experiment.free, experiment.channels, experiment)

    data = jacobian.T @ jacobian
    known = data[np.ix_(nuisances, nuisances)] + np.linalg.inv(prior[np.ix_(nuisances, nuisances)])
    cross = data[np.ix_(circuit, nuisances)]
    marginal = data[np.ix_(circuit, circuit)] - cross @ np.linalg.solve(known, cross.T)
    values, vectors = scipy.linalg.eigh(marginal, np.linalg.inv(prior[np.ix_(circuit, circuit)]))
    np.testing.assert_allclose(found.eigenvalues, values / (1.0 + values), rtol=1e-9)
    blind = vectors[:, 0] / np.linalg.norm(vectors[:, 0]) * np.sign(vectors[2, 0])
    np.testing.assert_allclose(list(found.blind_direction.values()), blind, atol=1e-9)

    covariance = np.linalg.inv(data + np.linalg.inv(prior))
    variance = gradient @ covariance @ gradient
    of_data = gradient @ covariance @ data @ covariance @ gradient
    assert found.force_sd == pytest.approx(np.sqrt(variance), rel=1e-9)
    assert found.force_from_prior == pytest.approx(1.0 - of_data / variance, rel=1e-9)
    assert found.force_contraction == pytest.approx(1.0 - np.sqrt(variance / (gradient @ prior @ gradient)), rel=1e-9)


def test_no_record_of_vsc_alone():
    found = judged(NOMINAL, derivative(scipy_vsc, 0.0) / 0.1)
    assert found.verdict == "prior-limited"
    assert found.structural
    text = str(found)
    assert "Vsc alone cannot determine the contact area" in text
    assert "mean force: ± 4.9 % now. Expected after one change: ± 0.023 % with " in found.remedy
    assert "± 4.9 % with four times " in found.remedy
    assert "Expected" not in text  # a table has the figures
    first = found.to_dict()["remedies"][0]
    assert (first["u"], bool(first["needs"])) == (first["force_sd"], True)
    assert found.to_dict()["remedies"][0]["force_sd"] == found.remedies[0].force_sd


def test_a_record_that_only_is_too_noisy():
    """A record with a known resistor determines the contact area; a record with 1 kV of noise does not."""
    noisy = dataclasses.replace(NOMINAL, circuit=RESISTOR, noise={"Vsc": 1e3, "I": 20e-9})
    found = judged(noisy, derivative(scipy_vsc, 100e3) / 1e3)
    assert found.verdict == "prior-limited"
    assert not found.structural
    assert "does not constrain" in str(found)


def test_identified_with_the_current():
    jacobian = np.vstack([derivative(scipy_vsc, 0.0) / 0.1, derivative(scipy_current, 0.0) / 20e-9])
    found = judged(BOTH, jacobian)
    assert found.verdict == "identified"
    assert found.eigenvalues[0] > 0.999
    assert found.remedies == ()
    assert str(found) == "identified: the data determine Rsc, Csc and Ci."


def test_unidentified_where_no_prior_covers_the_direction():
    wide = dataclasses.replace(NOMINAL, prior_factor=np.diag([3.0, 3.0, 3.0]))
    found = judged(wide, derivative(scipy_vsc, 0.0) / 0.1)
    assert found.verdict == "unidentified"
    assert "state one for Ci" in found.remedy


def test_a_free_gain_is_named():
    freed = dataclasses.replace(NOMINAL, free=(*NOMINAL.free, "gain"), prior_factor=np.diag([*PRIOR_SD, 0.02]))
    vsc = derivative(scipy_vsc, 0.0)
    jacobian = np.column_stack([vsc, scipy_vsc(*VALUES.values(), 0.0)]) / 0.1
    root = covariance_factor(jacobian, freed.prior_factor)
    found = assess_identifiability(
        freed.free,
        root,
        freed.prior_factor,
        np.append(derivative(scipy_log_force, 0.0)[0], 0.0),
        NOMINAL.free,
        freed.channels,
        freed,
    )
    assert "free gain" in found.remedy
    assert set(found.blind_direction) == {"Rsc", "Csc", "Ci"}
    assert found.structural
