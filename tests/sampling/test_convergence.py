"""Convergence diagnostics against closed forms."""

import emcee
import numpy as np
import pytest
from arviz_stats.base import array_stats

from fitact.sampling.convergence import (
    ImportanceWeights,
    _split_rhat,
    diagnose_chain,
    diagnose_weights,
    integrated_time,
    pareto_smooth,
)
from fitact.sampling.ensemble import make_moves
from fitact.sampling.importance import systematic_resample
from fitact.sampling.proposal import Proposal, TabulatedMarginal

COVARIANCE = np.array([[1.0, 0.6, -0.3], [0.6, 2.0, 0.5], [-0.3, 0.5, 0.7]])
PRECISION = np.linalg.inv(COVARIANCE)
ROOT = np.linalg.cholesky(COVARIANCE)


def log_normal_density(points: np.ndarray) -> np.ndarray:
    return -0.5 * np.einsum("ni,ij,nj->n", points, PRECISION, points)


def log_box_density(points: np.ndarray) -> np.ndarray:
    """Log-density that is uniform between -1 and 2 in the first coordinate, standard normal in the others."""
    inside = (points[:, 0] > -1.0) & (points[:, 0] < 2.0)
    return np.where(inside, -0.5 * np.sum(points[:, 1:] ** 2, axis=1), -np.inf)


def log_banana_density(points: np.ndarray) -> np.ndarray:
    """Log-density of a standard normal x, and of y and z whose means and widths depend on it, and z's on both."""
    x, y, z = points.T
    across = (y - 3.0 * x**2) / np.exp(0.3 * x)
    return -0.5 * (x**2 + across**2 + (z - 2.0 * x * across + x**3) ** 2) - 0.3 * x


PROPOSALS = {
    "student": (Proposal.from_laplace(np.zeros(3), ROOT, log_normal_density), log_normal_density),
    "table": (Proposal.from_laplace(np.array([3.0, 0.0, 0.0]), np.eye(3), log_box_density), log_box_density),
    "ridge": (Proposal.from_laplace(np.zeros(3), np.eye(3), log_banana_density), log_banana_density),
}


@pytest.mark.parametrize("move", range(2))
@pytest.mark.slow
def test_every_move_reproduces_a_normals_variance(move: int):
    """Accurate to 1 %, which is 3.5 standard errors for the effective number of draws, sqrt(2 / (3 n)) each."""
    offered = make_moves(PROPOSALS["student"][0])[move][0]
    independent = isinstance(offered, emcee.moves.MHMove)
    walkers, steps = (256, 1500) if independent else (512, 6000)
    sampler = emcee.EnsembleSampler(walkers, 3, log_normal_density, moves=offered, vectorize=True)
    start = np.random.default_rng(0).standard_normal((walkers, 3)) @ ROOT.T
    sampler.run_mcmc(emcee.State(start, random_state=np.random.RandomState(11).get_state()), steps)
    chain = sampler.get_chain(flat=True)
    effective = chain.shape[0] / np.max(emcee.autocorr.integrated_time(sampler.get_chain(), tol=0))
    assert 3.5 * np.sqrt(2.0 / (3.0 * effective)) < 0.01
    # variances along the three axes of the normal, pooled
    assert np.mean(np.linalg.solve(ROOT, chain.T) ** 2) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("name", PROPOSALS)
def test_proposal_draws_what_its_density_says(name: str):
    """Importance weights have the target's normalising constant as their mean, and give the target's moments."""
    proposal, target = PROPOSALS[name]
    points = proposal.draw(np.random.default_rng(2), 200_000)
    weights = np.exp(target(points) - proposal.log_density(points))
    normal = (2.0 * np.pi) ** 1.5
    constant = {"student": normal * np.sqrt(np.linalg.det(COVARIANCE)), "table": 3.0 * 2.0 * np.pi, "ridge": normal}
    error = np.std(weights) / np.sqrt(weights.size)
    scale = np.prod(np.linalg.svd(ROOT)[1]) if name == "student" else 1.0
    assert np.mean(weights) * scale == pytest.approx(constant[name], abs=5.0 * error * scale)
    assert (name == "table") == bool(proposal.tables)
    assert (name == "ridge") == bool(proposal.ridges)
    first = weights @ points[:, 0] / weights.sum()
    assert first == pytest.approx(0.5 if name == "table" else 0.0, abs=0.02)


@pytest.mark.parametrize("factor", [1.0, 1.5])
def test_a_proposal_with_a_ridge_is_close_to_a_curved_density(factor: float):
    """Without the ridge, 1 % of its draws are effective."""
    proposal = PROPOSALS["ridge"][0].scale_width(factor)
    points = proposal.draw(np.random.default_rng(2), 100_000)
    weights = np.exp(log_banana_density(points) - proposal.log_density(points))
    assert np.sum(weights) ** 2 / np.sum(weights**2) / weights.size > {1.0: 0.7, 1.5: 0.4}[factor]
    moments = weights @ np.column_stack([points[:, 1], points[:, 2], points[:, 0] ** 2]) / weights.sum()
    np.testing.assert_allclose(moments, [3.0, 0.0, 1.0], atol=0.1)


def test_table_is_the_density_and_ends_where_it_does():
    table = TabulatedMarginal.from_log_density(0.0, 0.01, -np.linspace(0.0, 10.0, 1001))  # exponential on 0 to 10
    values = np.random.default_rng(1).uniform(0.0, 9.9, 1000)
    np.testing.assert_allclose(table.log_density(values), -values, atol=0.011)
    assert np.all(table.log_density(np.array([-0.1, 10.1])) == -np.inf)
    draws = table.draw(np.random.default_rng(1), 100_000)
    assert np.mean(draws) == pytest.approx(1.0, abs=0.02)
    assert table.median == pytest.approx(np.log(2.0), abs=0.01)


def autoregressive(rho: float, shape: tuple[int, int, int], rng: np.random.Generator) -> np.ndarray:
    """Return normal series with autocorrelation time (1 + rho) / (1 - rho), shape (ensembles, steps, walkers)."""
    noise = np.sqrt(1.0 - rho**2) * rng.standard_normal(shape)
    values = np.empty(shape)
    values[:, 0] = rng.standard_normal((shape[0], shape[2]))
    for i in range(1, shape[1]):
        values[:, i] = rho * values[:, i - 1] + noise[:, i]
    return values


@pytest.fixture(scope="module")
def chain() -> np.ndarray:
    return autoregressive(0.8, (4, 2000, 32), np.random.default_rng(0))[..., None]


ACCEPTED = np.full((4, 32), 1000)


def test_autocorrelation_time_and_effective_size(chain: np.ndarray):
    c = diagnose_chain(("x",), chain, ACCEPTED, {})
    assert c.converged
    assert c.tau["x"] == pytest.approx(9.0, rel=0.05)
    assert c.burn == np.ceil(5.0 * c.tau_max)
    assert c.acceptance == pytest.approx(0.5)
    kept = chain[:, c.burn :, :, 0].transpose(0, 2, 1).reshape(128, -1)
    assert c.ess["x"] == pytest.approx(array_stats.ess(kept, chain_axis=0, draw_axis=1), rel=0.1)


@pytest.mark.parametrize("apart", [0.0, 0.3], ids=["agreeing", "apart"])
def test_split_rhat_is_that_of_arviz(chain: np.ndarray, apart: float):
    """R-hat of all draws after the burn-in; rejected moves repeat values."""
    walked = np.repeat(chain[:, ::2], 2, axis=1) + apart * np.arange(4)[:, None, None, None]
    c = diagnose_chain(("x",), walked, ACCEPTED, {}, rhat_draws=10**9)
    kept = walked[:, c.burn :].reshape(4, -1)
    assert c.rhat_max - 1.0 == pytest.approx(array_stats.rhat(kept, chain_axis=0, draw_axis=1) - 1.0, rel=1e-3)


def test_autocorrelation_time_is_that_of_emcee(chain: np.ndarray):
    for scale, steps in ((1.0, 100), (1.0, 1999), (0.01, 160)):
        values = 5.0 + scale * chain[0, :steps, :, 0]
        assert integrated_time(values) == pytest.approx(emcee.autocorr.integrated_time(values, tol=0)[0], rel=1e-9)


def test_chain_that_is_short_or_parted_is_not_converged(chain: np.ndarray):
    assert not diagnose_chain(("x",), chain[:, :300], ACCEPTED, {}).converged  # shorter than 50 autocorrelation times
    parted = chain.copy()
    parted[0] += 0.5
    assert diagnose_chain(("x",), parted, ACCEPTED, {}).rhat_max > 1.01
    assert not diagnose_chain(("x",), parted, ACCEPTED, {}).converged
    # derived quantities count like coordinates
    assert not diagnose_chain(("x",), chain, ACCEPTED, {"force_mean": parted[..., :4, 0]}).converged


def test_a_constant_quantity_neither_converges_nor_prevents_it(chain: np.ndarray):
    """Test the divider g where Csc and Ci are fixed, constant to rounding."""
    g = np.full((4, 2000, 4), 0.0652)
    for rounding in (0.0, 1e-16):
        c = diagnose_chain(("x",), chain, ACCEPTED, {"g": g + rounding * chain[..., :4, 0]})
        assert c.converged
        assert set(c.tau) == {"x"}
    x = np.random.default_rng(0).standard_normal(1000)
    weights = ImportanceWeights(np.full(1000, 1e-3), 0.0)
    assert set(diagnose_weights("laplace", weights, {"x": x, "g": np.full(1000, 0.0652)}, 500).ess) == {"x"}


def test_stuck_walker_is_named(chain: np.ndarray):
    stuck = chain.copy()
    stuck[2, 900:, 7] = stuck[2, 900, 7]
    c = diagnose_chain(("x",), stuck, ACCEPTED, {})
    assert c.stuck_walkers == ("walker 7 of ensemble 2",)
    assert not c.converged
    assert "walker 7 of ensemble 2" in c.warning
    stuck[2, :, 7] = 0.3  # from the first step to the last
    assert diagnose_chain(("x",), stuck, ACCEPTED, {}).stuck_walkers == c.stuck_walkers


@pytest.mark.parametrize(("rate", "accepted"), [(2.0, True), (5.0, False)])
def test_pareto_shape_of_exponential_weights(rate: float, accepted: bool):
    """Exp(1) by importance sampling from Exp(rate): P(w > t) ~ t^(-rate / (rate - 1)), so the shape is 1 - 1 / rate."""
    x = np.random.default_rng(3).exponential(1.0 / rate, 40_000)
    weighted = pareto_smooth((rate - 1.0) * x)
    assert weighted.k_hat == pytest.approx(1.0 - 1.0 / rate, abs=0.08)
    c = diagnose_weights("psis", weighted, {"x": x}, 10_000)
    assert c.converged == accepted
    assert ("accepted:" in str(c)) == accepted
    assert ("level emcee" in c.warning) != accepted


def test_draws_resampled_from_equal_weights_carry_the_variance_of_both():
    x = np.random.default_rng(0).standard_normal(1000)
    equal = ImportanceWeights(np.full(1000, 1e-3), 0.0)
    assert diagnose_weights("psis", equal, {"x": x}, 500).ess["x"] == pytest.approx(1.0 / (1 / 1000 + 1 / 500))


def test_weights_without_a_tail_are_refused():
    log_weights = np.full(10_000, -np.inf)
    log_weights[:5] = 0.0
    assert not diagnose_weights("psis", pareto_smooth(log_weights), {"x": np.arange(10_000.0)}, 1000).converged


def test_laplace_says_what_it_is_off_by():
    """Draws of N(0, 1) for N(m, s^2): the error is -m / s in the mean, and 1 / s - 1 in the sd."""
    x, m, s = np.random.default_rng(4).standard_normal(40_000), 0.3, 0.9
    weighted = pareto_smooth(-0.5 * ((x - m) / s) ** 2 + 0.5 * x**2)
    c = diagnose_weights("laplace", weighted, {"x": x}, x.size)
    assert c.shift["x"] == pytest.approx(-m / s, abs=0.02)
    assert c.widening["x"] == pytest.approx(1.0 / s - 1.0, abs=0.02)
    assert not c.converged
    assert "largest error of a mean 0.33 sd" in str(c)
    # half of the draws are outside the prior, so the method is refused although the moments of the others agree
    forbidden = np.where(np.arange(x.size) % 2, 0.0, -np.inf) + 1e-9 * x
    assert not diagnose_weights("laplace", pareto_smooth(forbidden), {"x": x}, x.size).converged


def test_systematic_resampling_rounds_each_count():
    weights = np.random.default_rng(5).exponential(size=1000)
    weights /= weights.sum()
    counts = np.bincount(systematic_resample(weights, 500, 0.37), minlength=1000)
    assert counts.sum() == 500
    assert np.all((counts == np.floor(500 * weights)) | (counts == np.ceil(500 * weights)))


def test_rhat_of_few_draws_is_that_of_arviz():
    draws = np.random.default_rng(0).standard_normal((4, 6, 1))
    found = _split_rhat(draws, rhat_draws=10**9)
    assert found == pytest.approx(array_stats.rhat(draws[..., 0], chain_axis=0, draw_axis=1), rel=1e-9)
