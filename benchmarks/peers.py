"""The posterior of `posterior.py` coded without fitact, and the samplers that fitact is compared with.

All draw (log Rsc, log Csc, log Ci, log sigma), with normal priors on the first three and a flat prior on the last.
"""

import contextlib
import math
import sys
import time
from collections.abc import Callable
from typing import Any

import blackjax
import emcee
import jax
import jax.numpy as jnp
import lmfit
import numpy as np
from arviz_stats.base import array_stats
from jax import Array
from likelihood import FREQUENCY, RATE, TRUTH, plain_log_likelihood, skin_voltage, square_phase
from numpyro.infer import MCMC, NUTS

import fitact

LOG_SD = np.sqrt(np.log1p(np.square([0.3, 0.3, 0.05])))
GAP = 201e-6  # between the plates, m
WALKERS, WARMUP = 32, 1000
LogProb = Callable[[np.ndarray], float]


def plain_log_prob(record: fitact.Record) -> LogProb:
    """Return the log-probability over all samples, computed from their times."""
    # shifted by a negligible time, so that rounding moves no sample over an edge
    t, y = record.time + 1e-9, record["Vsc"]
    return lambda point: plain_log_likelihood(point, t, y) + _log_prior(point)


def good_log_prob(record: fitact.Record) -> LogProb:
    """Return the log-probability from the closed form of one period for every period of the record."""
    period = round(RATE / FREQUENCY)
    sign, since = square_phase(record.time[:period])
    y = record["Vsc"].reshape(-1, period)

    def value(point: np.ndarray) -> float:
        residual = (y - skin_voltage(point, sign, since)).ravel()
        return -0.5 * float(residual @ residual) * math.exp(-2.0 * point[3]) - y.size * point[3] + _log_prior(point)

    return value


def raw_log_density(record: fitact.Record) -> Callable[[Array], Array]:
    """Return the log-density over all samples in JAX."""
    sign, since = (jnp.asarray(x) for x in square_phase(record.time))
    y = jnp.asarray(record["Vsc"])

    def value(point: Array) -> Array:
        R, C, Ci = jnp.exp(point[:3])
        g, b = Ci / (2.0 * Ci + C), R * (2.0 * Ci + C)
        residual = y - sign * 360.0 * g / (1.0 + jnp.exp(-0.5 / FREQUENCY / b)) * jnp.exp(-since / b)
        log_prior = -0.5 * jnp.sum(jnp.square((point[:3] - TRUTH[:3]) / LOG_SD))
        return log_prior - 0.5 * residual @ residual * jnp.exp(-2.0 * point[3]) - y.size * point[3]

    return value


def _log_prior(point: np.ndarray) -> float:
    return -0.5 * float(np.sum(((point[:3] - TRUTH[:3]) / LOG_SD) ** 2))


def mean_force(points: np.ndarray) -> np.ndarray:
    """Return the mean force (N) of eq. (22) for the settled square, with permittivities from Ci and Csc."""
    R, C, Ci = np.exp(np.moveaxis(points[..., :3], -1, 0))
    g, b = Ci / (2.0 * Ci + C), R * (2.0 * Ci + C)
    x = 1.0 / FREQUENCY / b
    return Ci * C / (Ci + C) / (2.0 * GAP) * 4.0 * 180.0**2 * g**2 * np.tanh(0.25 * x) / x


def importance_sds(log_prob: LogProb, point: np.ndarray, root: np.ndarray, draws: int = 40_000) -> np.ndarray:
    """Return the sd of log Rsc and the mean force by importance sampling from a Student-t, to 0.4 %."""
    rng, degrees = np.random.default_rng(5), 8.0
    tail = rng.chisquare(degrees, draws) / degrees
    white = rng.standard_normal((draws, 4)) / np.sqrt(tail)[:, None]
    points = point + white @ root.T
    log_density = -0.5 * (degrees + 4.0) * np.log1p(np.sum(white**2, axis=1) / degrees)
    log_weights = np.array([log_prob(p) for p in points]) - log_density
    weights = np.exp(log_weights - log_weights.max())
    seen = np.stack([points[:, 0], mean_force(points)])
    return np.sqrt(np.cov(seen, aweights=weights).diagonal())


class Peer:
    """Sampler that advances by `steps`; the first call compiles and burns in."""

    def __init__(self, steps: int) -> None:
        self.steps = steps
        self._chains: list[np.ndarray] = []
        self._advance()

    def _advance(self) -> np.ndarray:
        raise NotImplementedError

    def draw(self) -> float:
        """Advance; return the seconds per step."""
        began = time.perf_counter()
        self._chains.append(self._advance())
        return (time.perf_counter() - began) / self.steps

    @property
    def draws(self) -> np.ndarray:
        return np.concatenate(self._chains)

    def effective(self) -> float:
        """Return the effective draws of the mean force per step."""
        return WALKERS / float(emcee.autocorr.integrated_time(mean_force(self.draws), tol=0)[0])


class Ensemble(Peer):
    """Default emcee: stretch moves, one log-probability at a time."""

    def __init__(self, log_prob: LogProb, starts: np.ndarray, steps: int) -> None:
        self._sampler = emcee.EnsembleSampler(WALKERS, 4, log_prob)
        self._state = emcee.State(starts, random_state=np.random.RandomState(1).get_state())
        super().__init__(steps)

    def _advance(self) -> np.ndarray:
        self._state = self._sampler.run_mcmc(self._state, self.steps)
        chain = self._sampler.get_chain()
        self._sampler.reset()
        return chain


class Lmfit(Peer):
    """Sampler of `lmfit.emcee`."""

    def __init__(self, log_prob: LogProb, starts: np.ndarray, steps: int) -> None:
        params = lmfit.Parameters()
        names = ("log_Rsc", "log_Csc", "log_Ci", "log_sigma")
        for name, value in zip(names, TRUTH, strict=True):
            params.add(name, value=value)
        self._minimizer = lmfit.Minimizer(lambda p: log_prob(np.array([p[name].value for name in names])), params)
        self._last = starts
        super().__init__(steps)

    def _advance(self) -> np.ndarray:
        settings = {"nwalkers": WALKERS, "float_behavior": "posterior", "progress": False}
        with contextlib.redirect_stdout(sys.stderr):  # it prints a warning if the chain is short
            chain = self._minimizer.emcee(steps=self.steps, pos=self._last, **settings).chain
        self._last = chain[-1]
        return chain


class Nuts(Peer):
    """NUTS with one chain."""

    def effective(self) -> float:
        """Return the effective draws of the mean force per step, by ArviZ."""
        force = mean_force(self.draws)
        return float(array_stats.ess(force[None], chain_axis=0, draw_axis=1)) / force.size


class Numpyro(Nuts):
    """NUTS of numpyro with its default adaptation."""

    def __init__(self, log_density: Callable[[Array], Array], start: np.ndarray, steps: int) -> None:
        kernel = NUTS(potential_fn=lambda point: -log_density(point))
        self._mcmc = MCMC(kernel, num_warmup=WARMUP, num_samples=steps, progress_bar=False)
        self._mcmc.warmup(jax.random.PRNGKey(0), init_params=jnp.asarray(start))
        super().__init__(steps)

    def _advance(self) -> np.ndarray:
        self._mcmc.run(self._mcmc.post_warmup_state.rng_key)
        self._mcmc.post_warmup_state = self._mcmc.last_state
        return np.asarray(self._mcmc.get_samples())


class Blackjax(Nuts):
    """NUTS of blackjax in coordinates whitened by a Laplace approximation."""

    def __init__(self, log_density: Callable[[Array], Array], start: np.ndarray, root: np.ndarray, steps: int) -> None:
        self._start, self._root, self._key = start, root, jax.random.PRNGKey(0)

        def whitened_log_density(white: Array) -> Array:
            return log_density(start + jnp.asarray(root) @ white)

        adaptation = blackjax.window_adaptation(blackjax.nuts, whitened_log_density)
        (self._state, settings), _ = adaptation.run(jax.random.PRNGKey(1), jnp.zeros(4), num_steps=WARMUP)
        step = blackjax.nuts(whitened_log_density, **settings).step

        def one(state: Any, key: Array) -> tuple[Any, Array]:
            state, _ = step(key, state)
            return state, state.position

        self._scan = jax.jit(lambda state, key: jax.lax.scan(one, state, jax.random.split(key, steps)))
        super().__init__(steps)

    def _advance(self) -> np.ndarray:
        self._key, key = jax.random.split(self._key)
        self._state, white = self._scan(self._state, key)
        return self._start + np.asarray(white) @ self._root.T
