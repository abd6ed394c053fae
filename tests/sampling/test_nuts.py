"""The posterior methods against a long run of another sampler, NUTS of blackjax."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arviz_stats.base import array_stats

import fitact
from fitact.sampling.convergence import Convergence

CHAINS, STEPS = 4, 10_000


@pytest.fixture(scope="module")
def reference(finger_fit: fitact.Fit) -> fitact.Posterior:
    """Run NUTS in coordinates that the fit standardises, so that mass matrix and step size need no adaptation."""
    import blackjax

    with jax.enable_x64(True):
        point, root = jnp.asarray(finger_fit.point), jnp.asarray(finger_fit.point_root)
        likelihood = finger_fit.likelihood.without_samples()
        kernel = blackjax.nuts(lambda z: likelihood.log_prob(point + root @ z), 0.5, jnp.ones(point.size))

        def chain(key: jax.Array, start: jax.Array) -> jax.Array:
            def step(state, key):
                state, _ = kernel.step(key, state)
                return state, state.position

            return jax.lax.scan(step, kernel.init(start), jax.random.split(key, STEPS))[1]

        starts = 2.0 * jax.random.normal(jax.random.key(1), (CHAINS, point.size))
        white = jax.jit(jax.vmap(chain))(jax.random.split(jax.random.key(0), CHAINS), starts)[:, STEPS // 10 :]
        points = np.asarray(point + white @ root.T)
    for values in np.moveaxis(points, -1, 0):
        assert array_stats.rhat(values, chain_axis=0, draw_axis=1) < 1.01
        assert array_stats.ess(values, chain_axis=0, draw_axis=1) > 35_000
    flat = points.reshape(-1, points.shape[-1])
    return fitact.Posterior.from_draws(finger_fit, flat, np.zeros(len(flat)), Convergence(), 0)


@pytest.mark.slow
@pytest.mark.parametrize(("level", "runs"), [("emcee", 4), ("psis", 6)])
def test_widths_are_those_of_nuts(level: str, runs: int, finger_fit: fitact.Fit, reference: fitact.Posterior):
    """Accurate to 2 %: for 40,000 effective draws on both sides these are four standard errors, 1 / sqrt(2 n) each."""
    posteriors = [fitact.sample(finger_fit, level=level, seed=seed, progress=False) for seed in range(runs)]
    assert sum(min(p.convergence.ess_min, p.points[..., 0].size) for p in posteriors) > 35_000
    for quantity in ("Rsc", "force_mean"):
        expected, *found = ((p.parameters() | p.force())[quantity] for p in (reference, *posteriors))
        assert np.std(found) == pytest.approx(np.std(expected), rel=0.02)
        assert np.mean(found) == pytest.approx(np.mean(expected), abs=4.0 * np.std(expected) * np.sqrt(2.0 / 35_000))
