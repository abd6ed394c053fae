import math

import jax
import numpy as np
import pytest
import scipy.stats

import fitact

SPREAD = math.log(3.0) / scipy.stats.norm.ppf(0.975)

# each prior with its scipy equivalent, a distribution of x or of log x
LAWS_OF_X = {
    "factor": (fitact.LogNormal.within_factor(130e3, 3.0), scipy.stats.lognorm(SPREAD, scale=130e3)),
    "relative sd": (
        fitact.LogNormal.with_relative_sd(1.35e-9, 0.05),
        scipy.stats.lognorm(math.sqrt(math.log1p(0.05**2)), scale=1.35e-9),
    ),
    "uniform": (fitact.Uniform(20e3, 1e6), scipy.stats.uniform(20e3, 980e3)),
    "narrow uniform": (fitact.Uniform(0.99, 1.01), scipy.stats.uniform(0.99, 0.02)),
    "tolerance": (fitact.Uniform.with_tolerance(100e3, 0.1), scipy.stats.uniform(90e3, 20e3)),
    "log-uniform": (fitact.LogUniform(1e-9, 1e-7), scipy.stats.loguniform(1e-9, 1e-7)),
}


def truncated(low: float, high: float, median: float = 22e-9):
    bounds = [(math.log(x) - math.log(median)) / SPREAD if x > 0.0 else -math.inf for x in (low, high)]
    ours = fitact.TruncatedLogNormal(median, SPREAD, low, high)
    return ours, scipy.stats.truncnorm(*bounds, loc=math.log(median), scale=SPREAD)


LAWS_OF_LOG = {
    "truncated": truncated(8.85e-9, 44.25e-9),
    "truncated below": truncated(8.85e-9, math.inf),
    "truncated above": truncated(0.0, 44.25e-9),
    "median outside": truncated(30e-9, 60e-9, median=20e-9),
    "narrow": truncated(21e-9, 21.1e-9),
}
LAWS = LAWS_OF_X | LAWS_OF_LOG


def of_logs(name: str, function: str, u: np.ndarray) -> np.ndarray:
    """Return scipy's log-density or distribution function of u = log x."""
    law = LAWS[name][1]
    if name in LAWS_OF_LOG:
        return getattr(law, function)(u)
    return law.logpdf(np.exp(u)) + u if function == "logpdf" else law.cdf(np.exp(u))


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


@pytest.mark.parametrize("name", LAWS)
def test_density_and_scores_are_those_of_scipy(name: str):
    prior, law = LAWS[name]
    u = np.asarray(law.ppf([0.001, 0.05, 0.4, 0.9, 0.999]))
    u = u if name in LAWS_OF_LOG else np.log(u)
    np.testing.assert_allclose(prior.log_density(u), of_logs(name, "logpdf", u), rtol=1e-9, atol=1e-9)
    z = scipy.stats.norm.ppf(of_logs(name, "cdf", u))
    np.testing.assert_allclose(prior.to_standard_normal(u), z, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(prior.from_standard_normal(z), u, rtol=1e-10)


@pytest.mark.parametrize("name", LAWS)
def test_density_of_the_logarithm_has_its_integral_and_moments(name: str):
    prior = LAWS[name][0]
    span = prior.log_mean + np.array([-9.0, 9.0]) * prior.log_sd
    if not isinstance(prior, fitact.LogNormal):
        bounds = [math.log(x) if 0.0 < x < math.inf else None for x in (prior.low, prior.high)]
        span = [end if bound is None else bound for end, bound in zip(span, bounds, strict=True)]
    nodes, weights = np.polynomial.legendre.leggauss(400)
    u = span[0] + 0.5 * (span[1] - span[0]) * (nodes + 1.0)
    share = 0.5 * (span[1] - span[0]) * weights * np.exp(np.asarray(prior.log_density(u)))
    assert share.sum() == pytest.approx(1.0, abs=1e-10)
    assert share @ (u - prior.log_mean) == pytest.approx(0.0, abs=1e-9)
    assert share @ (u - prior.log_mean) ** 2 == pytest.approx(prior.log_sd**2, rel=1e-6)


@pytest.mark.parametrize("name", LAWS)
def test_draws_follow_it(name: str):
    """Kolmogorov-Smirnov test at 1e-4; with a random seed, one run in a thousand would fail."""
    draws = np.log(LAWS[name][0].sample(np.random.default_rng(0), 20_000))
    assert scipy.stats.kstest(draws, lambda u: of_logs(name, "cdf", u)).pvalue > 1e-4


@pytest.mark.parametrize("name", LAWS)
def test_gradients_are_finite_inside_and_density_is_zero_outside(name: str):
    prior, law = LAWS[name]
    u = np.asarray(law.ppf([1e-9, 0.5, 1.0 - 1e-9]))
    u = u if name in LAWS_OF_LOG else np.log(u)
    for function in (prior.log_density, prior.to_standard_normal):
        assert np.all(np.isfinite(jax.vmap(jax.grad(function))(u)))
    for end, sign in (("low", -1.0), ("high", 1.0)):
        limit = getattr(prior, end, 0.0)
        if 0.0 < limit < math.inf:
            outside = math.log(limit) + sign * 1e-9
            assert float(prior.log_density(outside)) == -np.inf
            assert np.isfinite(float(jax.grad(prior.to_standard_normal)(outside)))


@pytest.mark.parametrize(
    "bad",
    [
        lambda: fitact.Uniform(2.0, 1.0),
        lambda: fitact.LogUniform(0.0, 1.0),
        lambda: fitact.Uniform.with_tolerance(1.0, 1.0),
        lambda: fitact.LogNormal.within_factor(1.0, 0.5),
        lambda: fitact.TruncatedLogNormal(1.0, 0.1, 2.0, 1.0),
        lambda: fitact.TruncatedLogNormal(1.0, 0.1, 5.0, 10.0),
        lambda: fitact.Prior.from_marginals({("Rsc", "Ci"): 0.5}, Rsc=fitact.LogNormal(1.0, 1.0)),
        lambda: three({("Rsc", "Csc"): 1.0}),
        lambda: three({("Rsc", "Csc"): math.nan}),
        lambda: three({("Rsc", "Csc"): 0.9, ("Csc", "Ci"): 0.9, ("Rsc", "Ci"): -0.9}),
    ],
)
def test_nonsense_is_refused(bad):
    with pytest.raises(fitact.InputError):
        bad()


def three(correlation: dict, uniform: bool = False) -> fitact.Prior:
    box = fitact.Uniform(8.85e-9, 44.25e-9)
    log_normal = fitact.LogNormal(22e-9, 0.7)
    return fitact.Prior.from_marginals(
        correlation,
        Rsc=fitact.LogNormal.within_factor(130e3, 3.0),
        Csc=box if uniform else log_normal,
        Ci=fitact.LogUniform(1e-9, 3e-9) if uniform else fitact.LogNormal(1.35e-9, 0.05),
    )


CORRELATION = {("Rsc", "Csc"): -0.6, ("Ci", "Csc"): 0.3}


def test_log_normals_are_multivariate_normal_in_the_logs():
    prior = three(CORRELATION)
    sd = np.array([SPREAD, 0.7, 0.05])
    covariance = np.array([[1.0, -0.6, 0.0], [-0.6, 1.0, 0.3], [0.0, 0.3, 1.0]]) * np.outer(sd, sd)
    law = scipy.stats.multivariate_normal(np.log([130e3, 22e-9, 1.35e-9]), covariance)
    u = law.rvs(20, random_state=1)
    np.testing.assert_allclose(prior.covariance, covariance, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(jax.vmap(prior.log_density)(u), law.logpdf(u), rtol=1e-10)
    squares = jax.vmap(lambda v: (prior.residuals(v) ** 2).sum())(u)  # minus half of these is the log-density
    np.testing.assert_allclose(-0.5 * squares, law.logpdf(u) - law.logpdf(law.mean), rtol=1e-8, atol=1e-10)


def test_copula_keeps_the_marginals_and_has_the_covariance_it_states():
    prior = three(CORRELATION, uniform=True)
    count = 400_000
    logs = np.log(list(prior.sample(np.random.default_rng(3), count).values()))  # 5 sd: nearly any seed passes
    assert scipy.stats.kstest(np.exp(logs[1]), scipy.stats.uniform(8.85e-9, 35.4e-9).cdf).pvalue > 1e-4
    np.testing.assert_allclose(logs.mean(axis=1), prior.log_mean, atol=5.0 * prior.log_sd.max() / math.sqrt(count))
    scale = np.outer(prior.log_sd, prior.log_sd)
    np.testing.assert_allclose(np.cov(logs) / scale, prior.covariance / scale, atol=5.0 * math.sqrt(2.0 / count))
    # Pearson's rank correlation of a normal copula, because the correlation here is not that of the logarithms
    rank = scipy.stats.spearmanr(logs[0], logs[1]).statistic
    assert rank == pytest.approx(6.0 / math.pi * math.asin(-0.3), abs=0.008)


def test_copula_density_integrates_to_one_and_is_differentiable():
    box = fitact.Prior.from_marginals({("x", "y"): -0.6}, x=fitact.Uniform(1.0, 5.0), y=fitact.LogNormal(1.0, 0.5))
    nodes, weights = np.polynomial.legendre.leggauss(200)
    x, y = 0.5 * math.log(5.0) * (nodes + 1.0), 4.0 * nodes
    points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    density = np.exp(jax.vmap(jax.vmap(box.log_density))(points))
    assert 0.5 * math.log(5.0) * weights @ density @ weights * 4.0 == pytest.approx(1.0, abs=1e-5)
    gradient = jax.grad(box.log_density)(np.array([1e-12, 0.3]))
    assert np.all(np.isfinite(gradient))
    assert float(box.log_density(np.array([-1e-12, 0.3]))) == -np.inf


def test_replacing_a_marginal_keeps_the_correlations():
    prior = three(CORRELATION).replace_marginals(Ci=fitact.LogNormal(2e-9, 0.1), gain=fitact.LogNormal(1.0, 0.02))
    assert prior.names == ("Rsc", "Csc", "Ci", "gain")
    assert prior["Ci"].median == 2e-9
    assert prior.covariance[1, 2] == pytest.approx(0.3 * 0.7 * 0.1, rel=1e-12)
    assert prior.correlation[3].tolist() == [0.0, 0.0, 0.0, 1.0]


def test_order_is_a_factor_of_0_or_1():
    """Either of two equal marginals is the lower with probability 1/2, so the accepted draws are order statistics."""
    alone = fitact.Prior.from_marginals(low=fitact.Uniform(1.0, 2.0), high=fitact.Uniform(1.0, 2.0))
    prior = fitact.Prior.from_marginals(
        None, (("low", "high"),), low=fitact.Uniform(1.0, 2.0), high=fitact.Uniform(1.0, 2.0)
    )
    u = np.log([1.2, 1.3])
    assert float(prior.log_density(u)) == float(alone.log_density(u))
    assert float(prior.log_density(u[::-1])) == -np.inf
    drawn = prior.sample(np.random.default_rng(1), 20_000)
    assert np.all(drawn["low"] < drawn["high"])
    assert scipy.stats.kstest(drawn["high"] - 1.0, scipy.stats.beta(2, 1).cdf).pvalue > 1e-4
    impossible = fitact.Prior.from_marginals(
        None, (("a", "b"),), a=fitact.Uniform(3.0, 4.0), b=fitact.Uniform(1.0, 2.0)
    )
    with pytest.raises(fitact.InputError, match="a < b"):
        impossible.sample(np.random.default_rng(1), 100)


def test_it_traces():
    prior = three(CORRELATION, uniform=True)
    u = prior.log_mean + 0.1
    np.testing.assert_allclose(jax.jit(prior.residuals)(u), prior.residuals(u), rtol=1e-12)
    np.testing.assert_allclose(jax.jit(prior.log_density)(u), prior.log_density(u), rtol=1e-12)
