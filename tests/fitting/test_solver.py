"""The least-squares engine on problems with closed-form solutions, and on the record of a finger."""

import functools
import operator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from jax import Array

import fitact
from fitact.fitting import minimum
from fitact.fitting.outcome import result_name
from fitact.likelihood.likelihood import Likelihood

TIME = np.linspace(0.0, 3.0, 40)


@pytest.fixture(autouse=True)
def double_precision():
    with jax.enable_x64(True):
        yield


def decay(theta: Array) -> Array:
    """Noise-free data of 2 exp(-1.5 t)."""
    return theta[0] * jnp.exp(-theta[1] * TIME) - 2.0 * np.exp(-1.5 * TIME)


def names(minima: minimum.Minimum) -> list[str]:
    each = [jax.tree.map(operator.itemgetter(i), minima.result) for i in range(len(minima.steps))]
    return [result_name(result) for result in each]


def test_exact_zero_residual_is_reached():
    end = minimum.minimise(decay, jnp.array([1.0, 0.3]))
    assert result_name(end.result) == "successful"
    np.testing.assert_allclose(end.theta, [2.0, 1.5], rtol=1e-12)
    assert end.cost < 1e-24


def test_a_start_at_the_optimum_is_successful():
    end = minimum.minimise(decay, jnp.array([2.0, 1.5]))
    assert result_name(end.result) == "successful"
    assert end.steps == 1


def test_linear_problem_against_normal_equations():
    """The residuals have two leaves, the second of which is a prior."""
    design = np.random.default_rng(0).standard_normal((30, 3)) * [1.0, 1e6, 1e-9]
    y, mean, sd = np.arange(30.0), np.array([1.0, 1e-6, 1e9]), np.array([0.1, 1e-7, 1e8])
    end = minimum.minimise(lambda theta: (design @ theta - y, {"prior": (theta - mean) / sd}), jnp.zeros(3))
    normal = design.T @ design + np.diag(sd**-2.0)
    expected = np.linalg.solve(normal * np.outer(sd, sd), sd * (design.T @ y + mean / sd**2)) * sd
    assert result_name(end.result) == "successful"
    np.testing.assert_allclose(end.theta, expected, rtol=1e-7)
    np.testing.assert_allclose(end.jacobian, np.vstack([design, np.diag(1.0 / sd)]))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_datum_that_is_not_finite(bad: float):
    spoilt = np.zeros(TIME.size)
    spoilt[7] = bad
    end = minimum.minimise(lambda theta: decay(theta) + spoilt, jnp.array([1.0, 0.3]))
    assert result_name(end.result) == "nonfinite"


def test_a_trial_that_is_not_finite_is_stepped_back_from():
    """The undamped first step from 0.05 leads to negative x."""
    end = minimum.minimise(lambda x: jnp.log(x) - jnp.log(5.0) + 0.0 * jnp.sqrt(x - 0.04), jnp.array([0.05]))
    assert result_name(end.result) == "successful"
    assert end.theta[0] == pytest.approx(5.0)


def test_redundant_parameters_are_rank_deficient():
    end = minimum.minimise(lambda theta: decay(jnp.array([theta[0] * theta[2], theta[1]])), jnp.array([1.0, 0.3, 1.0]))
    assert result_name(end.result) == "rank_deficient"
    assert end.theta[0] * end.theta[2] == pytest.approx(2.0)


def test_a_parameter_without_effect_is_rank_deficient():
    """For a distant start exp(-theta t) underflows, and the sum of squares is flat."""
    end = minimum.minimise(lambda theta: jnp.exp(-theta * TIME[1:]) - np.exp(-1.5 * TIME[1:]), jnp.array([1e5]))
    assert result_name(end.result) == "rank_deficient"


def admittance_residuals(theta: Array, xp) -> Array:
    """Return residuals of the current of one sine, which leaves a curved valley of Rsc, Csc and Ci, and of a prior."""

    def admittance(theta: Array) -> Array:
        Rsc, Csc, Ci = (xp.exp(theta[i]) for i in range(3))
        s = 200j * np.pi
        return 1.0 / (1.0 / (s * Ci) + 2.0 * Rsc / (1.0 + s * Rsc * Csc))

    expected = admittance(np.log([160e3, 22e-9, 1.35e-9]))
    off = (admittance(theta) - expected) / (1e-4 * abs(expected))
    return xp.concatenate(
        [xp.stack([off.real, off.imag]), (theta - np.log([300e3, 10e-9, 1e-9])) / np.array([2.0, 1.5, 0.5])]
    )


def test_coordinates_lead_along_a_curved_valley():
    """Logarithms of Rsc, Csc and Ci take three times as many steps."""
    start = np.log([59e3, 60e-9, 1.8e-9])
    straight, bent = (
        minimum.minimise(functools.partial(admittance_residuals, xp=jnp), start, elements=elements)
        for elements in ((0, 1, 2), ())
    )
    oracle = scipy.optimize.least_squares(
        admittance_residuals, start, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-12, kwargs={"xp": np}
    )
    for end in (straight, bent):
        assert result_name(end.result) == "successful"
        assert float(end.cost) == pytest.approx(oracle.cost, rel=1e-9)
        # the curvature along the valley is that of the prior
        errors = np.linalg.norm(np.linalg.inv(np.asarray(end.jacobian)[2:]), axis=1)
        assert np.max(np.abs(np.asarray(end.theta) - oracle.x) / errors) < 1e-3
        np.testing.assert_allclose(end.jacobian, oracle.jac, rtol=1e-4, atol=1e-4 * np.max(np.abs(oracle.jac)))
    assert 2 * int(straight.steps) < int(bent.steps)


def test_no_step_helps():
    """A derivative of the wrong sign: no trial step is accepted."""

    @jax.custom_jvp
    def wrong(x: Array) -> Array:
        return jnp.array([1.0 + x[0] ** 2])

    wrong.defjvp(lambda x, t: (wrong(*x), -10.0 * (x[0][:1] + 1.0) * t[0]))
    assert result_name(minimum.minimise(wrong, jnp.array([1.0])).result) == "did_not_move"


def test_out_of_steps():
    end = minimum.minimise(decay, jnp.array([1.0, 0.3]), max_steps=3)
    assert result_name(end.result) == "nonlinear_max_steps_reached"


@pytest.fixture
def finger(summed_fit: fitact.Fit) -> fitact.Fit:
    """Return a likelihood summed over samples, so that no table ends within the range of the starts."""
    return summed_fit


TRUTH = np.log([130e3, 18e-9, 1.35e-9])


def finger_ends(fit: fitact.Fit, with_prior: bool) -> minimum.Minimum:
    """Return the end points from a hundred starts within a factor of 1,000 of the truth."""
    starts = np.tile(np.append(TRUTH, fit.theta[3:]), (100, 1))
    starts[:, :3] += np.random.default_rng(3).uniform(-np.log(1e3), np.log(1e3), (100, 3))

    @eqx.filter_jit
    def ends(likelihood: Likelihood, sigma: Array, starts: np.ndarray) -> minimum.Minimum:
        def residuals(theta: Array) -> tuple[Array, ...]:
            data = likelihood.residuals(theta, sigma)
            return (data, likelihood.prior_residuals(theta)) if with_prior else (data,)

        return jax.vmap(lambda start: minimum.minimise(residuals, start))(starts)

    return ends(fit.likelihood, jnp.array([fit.sigma]), jnp.asarray(starts))


@pytest.mark.slow
def test_hundred_far_starts_with_the_prior(finger: fitact.Fit):
    """The reference is scipy's optimum from the truth."""
    ends = finger_ends(finger, with_prior=True)
    model = jax.jit(
        lambda theta: jnp.concatenate(
            [
                *finger.likelihood.residuals(theta, jnp.array([finger.sigma])),
                finger.likelihood.prior_residuals(theta),
            ]
        )
    )
    found = scipy.optimize.least_squares(
        lambda theta: np.asarray(model(theta)), np.append(TRUTH, finger.theta[3:]), xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    sd = np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac)))
    right = np.all(np.abs(ends.theta - found.x) < 1e-3 * sd, axis=1)
    successful = np.array(names(ends)) == "successful"
    assert np.all(right[successful])
    assert np.all(successful)


@pytest.mark.slow
def test_hundred_far_starts_without_a_prior(finger: fitact.Fit):
    """Vsc alone determines two of three parameters, so no end point is unique."""
    results = names(finger_ends(finger, with_prior=False))
    assert "successful" not in results
    assert results.count("rank_deficient") > 80  # the others ended on a plateau
