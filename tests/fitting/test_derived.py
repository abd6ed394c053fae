"""Derived quantities of a fit: their gradients, in which unknown charges are to first order."""

import numpy as np
import pytest

import fitact
from fitact.compiled import jit
from fitact.fitting.derived import DerivedQuantities
from tests.conftest import RECORDS


@pytest.mark.parametrize("name", ["finger_direct", "finger_bench"])
def test_gradient_is_that_of_the_whole_model(name: str):
    """Compare with differences of the model, whose nuisances are fitted anew at each theta.

    V, Vsc and I of the bench have noise and rounding.
    """
    scene = fitact.Scene.load(RECORDS / f"{name}.toml")
    fit = fitact.fit(fitact.read(RECORDS / f"{name}.csv", scene), scene)
    assert fit.derive.charge
    evaluate, sigma = jit(DerivedQuantities.__call__), fit.laplace.sigmas
    logs, gradients = fit.laplace.log_derived
    np.testing.assert_allclose(np.log(evaluate(fit.derive, fit.theta, sigma)), logs, atol=1e-3 * fit.sd.min())
    steps = 1e-3 * np.diag(fit.sd)  # a larger step may move the peak from one edge of V to another
    differences = [
        np.log(evaluate(fit.derive, fit.theta + step, sigma) / evaluate(fit.derive, fit.theta - step, sigma))
        for step in steps
    ]
    expected = np.transpose(differences) / 2e-3
    scale = np.linalg.norm(expected, axis=1, keepdims=True)  # the standard error of each, were theta independent
    np.testing.assert_allclose(gradients * fit.sd / scale, expected / scale, atol=1e-4)
