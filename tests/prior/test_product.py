"""Distributions of products, against quadrature by scipy and against closed forms."""

import numpy as np
import pytest
import scipy.integrate
import scipy.stats

from fitact.prior.distributions import LogNormal, Uniform
from fitact.prior.product import Product, multiply

P = np.array([0.001, 0.025, 0.25, 0.5, 0.75, 0.975, 0.999])


def test_log_normal_factors_give_a_log_normal():
    product = multiply([(LogNormal(2.0, 0.3), 1.0), (LogNormal(3.0, 0.4), -1.0)])
    assert isinstance(product, LogNormal)
    assert product.median == pytest.approx(2.0 / 3.0)
    assert product.spread == pytest.approx(0.5)


def cdf_of_two_uniforms(u: float, a: float, b: float, sign: float) -> float:
    """Return P(x y^sign < e^u) for x and y uniform within 1 ± a and 1 ± b."""

    def inner(y: float) -> float:
        return float(np.clip((np.exp(u) * y**-sign - (1.0 - a)) / (2.0 * a), 0.0, 1.0))

    return scipy.integrate.quad(inner, 1.0 - b, 1.0 + b, limit=200)[0] / (2.0 * b)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_two_limits_are_convolved(sign: float):
    product = multiply([(Uniform.with_tolerance(1.0, 0.03), 1.0), (Uniform.with_tolerance(1.0, 0.02), sign)])
    quantiles = np.asarray(product.from_standard_normal(scipy.stats.norm.ppf(P)))
    found = [cdf_of_two_uniforms(u, 0.03, 0.02, sign) for u in quantiles]
    assert found == pytest.approx(P, abs=5e-4)


def test_a_single_limit_stays_uniform():
    product, limits = multiply([(Uniform.with_tolerance(1.0, 0.03), 1.0)]), Uniform.with_tolerance(1.0, 0.03)
    assert isinstance(product, Product)
    u = np.linspace(np.log(0.9701), np.log(1.0299), 50)
    assert np.asarray(product.log_density(u)) == pytest.approx(np.asarray(limits.log_density(u)), abs=5e-4)
    assert np.all(np.isneginf(np.asarray(product.log_density(np.log([0.9699, 1.0301])))))


def test_normal_and_scores_are_inverse():
    product = multiply([(Uniform.with_tolerance(1.0, 0.03), 1.0), (LogNormal(1.0, 0.01), 1.0)])
    z = np.linspace(-3.0, 3.0, 13)
    assert np.asarray(product.to_standard_normal(product.from_standard_normal(z))) == pytest.approx(z, abs=1e-3)


def test_moments_are_those_of_the_density():
    factors = [(Uniform.with_tolerance(1.0, 0.2), 1.0), (Uniform.with_tolerance(1.0, 0.1), -1.0)]
    product = multiply(factors)
    u = np.linspace(float(product.edges[0]), float(product.edges[-1]), 20_001)
    density = np.exp(np.asarray(product.log_density(u)))
    mean = scipy.integrate.trapezoid(u * density, u) / scipy.integrate.trapezoid(density, u)
    variance = scipy.integrate.trapezoid((u - mean) ** 2 * density, u) / scipy.integrate.trapezoid(density, u)
    moments = float(product.log_mean), float(product.log_sd)
    assert (mean, np.sqrt(variance)) == pytest.approx(moments, abs=1e-4)
