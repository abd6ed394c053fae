import jax
import numpy as np
import pytest
import scipy.integrate

import fitact

PRIORS = {
    "factor": fitact.LogNormal.within_factor(130e3, 3.0),
    "relative sd": fitact.LogNormal.with_relative_sd(1.35e-9, 0.05),
    "uniform": fitact.Uniform(20e3, 1e6),
    "narrow uniform": fitact.Uniform(0.99, 1.01),
}


@pytest.mark.parametrize("name", PRIORS)
def test_density_of_the_logarithm_has_its_integral_and_moments(name: str):
    prior = PRIORS[name]
    span = prior.log_mean + np.array([-9.0, 9.0]) * prior.log_sd
    if isinstance(prior, fitact.Uniform):
        span = np.log([prior.low, prior.high])

    def moment(power: int) -> float:
        with jax.enable_x64(True):
            return scipy.integrate.quad(
                lambda u: (u - prior.log_mean) ** power * np.exp(float(prior.log_density(u))),
                *span,
                epsabs=1e-13,
            )[0]

    assert moment(0) == pytest.approx(1.0, abs=1e-8)
    assert moment(1) == pytest.approx(0.0, abs=1e-8)
    assert moment(2) == pytest.approx(prior.log_sd**2, rel=1e-6)


@pytest.mark.parametrize("name", PRIORS)
def test_draws_have_its_moments(name: str):
    prior = PRIORS[name]
    draws = np.log(prior.sample(np.random.default_rng(0), 100_000))  # fixed seed: 5 sigma bounds, met by nearly all
    assert draws.mean() == pytest.approx(prior.log_mean, abs=5.0 * prior.log_sd / np.sqrt(1e5))
    assert draws.std() == pytest.approx(prior.log_sd, rel=0.02)


def test_meaning_of_factor_and_relative_sd():
    draws = PRIORS["factor"].sample(np.random.default_rng(0), 100_000)
    assert np.mean((draws > 130e3 / 3.0) & (draws < 130e3 * 3.0)) == pytest.approx(0.95, abs=0.004)
    draws = PRIORS["relative sd"].sample(np.random.default_rng(0), 100_000)
    assert draws.std() / draws.mean() == pytest.approx(0.05, rel=0.02)


def test_uniform_is_impossible_outside():
    with jax.enable_x64(True):
        assert float(PRIORS["uniform"].log_density(np.log(19e3))) == -np.inf
        assert float(PRIORS["uniform"].log_density(np.log(1.1e6))) == -np.inf


@pytest.mark.parametrize("bad", [lambda: fitact.Uniform(2.0, 1.0), lambda: fitact.LogNormal.within_factor(1.0, 0.5)])
def test_nonsense_is_refused(bad):
    with pytest.raises(fitact.InputError):
        bad()
