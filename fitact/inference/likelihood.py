"""The log-probability of a record: Gaussian noise, with the linear nuisances integrated out.

The record is  Vsc = gain * response(t - delay) + A beta + noise.  The columns of A are an offset, a
drift and, for a measured drive, the decays of the unknown charge at the first sample. Their
coefficients have wide normal priors and are integrated out exactly, so the chain holds only the
parameters that matter: the logarithms of Rsc, Csc, Ci (and gain), the delay, and log sigma.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.linalg import cho_solve, solve_triangular
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.model.circuit import FinalCircuit
from fitact.model.drive import Drive
from fitact.model.prior import Prior
from fitact.model.response import response

_BATCH_SAMPLES = 4_000_000  # evaluated at a time, which bounds memory

LINEAR = ("offset", "drift", "charge")


class Likelihood(eqx.Module):
    """Record, drive and prior, as a function of the parameters.

    A point theta holds, in the order of `names`, logarithms of positive parameters, and the delay in
    units of `time_step`. Built by `fitact.inference.fit`.

    Attributes:
        time: s.
        observed: Vsc, V.
        drive: what drives the circuit.
        prior: of the circuit's parameters.
        linear_sd: prior standard deviations of offset, drift (over half the record) and charge, V; 0 leaves
            one out.
        shift: the drive starts this much later than the record's t = 0, s.
        time_step: s.
        delay_sd: prior standard deviation of the delay, in time steps.
        steady_state: or from rest.
        free_delay: whether the delay is a parameter.
    """

    time: Float[Array, " samples"]
    observed: Float[Array, " samples"]
    drive: Drive
    prior: Prior
    linear_sd: Float[Array, " 3"]
    shift: ArrayLike
    time_step: ArrayLike
    delay_sd: ArrayLike
    steady_state: bool = eqx.field(static=True)
    free_delay: bool = eqx.field(static=True)

    @property
    def prior_sd(self) -> np.ndarray:
        """Standard deviations of theta by the prior."""
        return np.append(self.prior.log_sd, float(self.delay_sd)) if self.free_delay else self.prior.log_sd

    @property
    def names(self) -> tuple[str, ...]:
        """The coordinates of theta."""
        return (*self.prior.names, "delay") if self.free_delay else self.prior.names

    def circuit(self, theta: Float[Array, " parameters"]) -> FinalCircuit:
        """The circuit at theta."""
        return FinalCircuit(*jnp.exp(theta[:3]))

    def gain(self, theta: Float[Array, " parameters"]) -> ArrayLike:
        """Gain of the channel Vsc."""
        return 1.0 if self.prior.gain is None else jnp.exp(theta[3])

    def signal(self, theta: Float[Array, " parameters"], later: ArrayLike = 0.0) -> Float[Array, " samples"]:
        """Vsc as recorded (V), but for linear nuisances and noise; `later` (s) delays it further."""
        delay = self.shift + later + (theta[-1] * self.time_step if self.free_delay else 0.0)
        vsc = response(self.circuit(theta), self.drive, self.time - delay, steady_state=self.steady_state)
        return self.gain(theta) * vsc

    def shapes(self, theta: Float[Array, " parameters"]) -> Float[Array, "3 samples"]:
        """The linear nuisances' shapes in time, each of height 1."""
        middle = 0.5 * (self.time[0] + self.time[-1])
        ramp = (self.time - middle) / (self.time[-1] - middle)
        return jnp.stack([jnp.ones_like(ramp), ramp, self.decay(theta, self.time)])

    def decay(self, theta: Float[Array, " parameters"], time: Float[Array, " times"]) -> Float[Array, " times"]:
        """How an unknown charge at the first sample decays."""
        (tau,) = self.circuit(theta).terms().tau
        return jnp.exp(-(time - self.time[0]) / tau)

    def linear(
        self, theta: Float[Array, " parameters"], sigma: ArrayLike
    ) -> tuple[Float[Array, " samples"], Float[Array, " 3"], Float[Array, "3 3"]]:
        """What theta leaves of the record, and the nuisances' posterior given theta.

        Gives the remainder (V) after the best nuisances, their coefficients in prior standard
        deviations, and the Cholesky factor of their posterior precision.
        """
        remainder = self.observed - self.signal(theta)
        A = self.linear_sd[:, None] * self.shapes(theta)
        # keep XLA from computing both once per use
        remainder, A = lax.optimization_barrier((remainder, A))
        factor = jnp.linalg.cholesky(jnp.eye(3) + A @ A.T / sigma**2)
        beta = cho_solve((factor, True), A @ remainder / sigma**2)
        return remainder - beta @ A, beta, factor

    def drawn(
        self, theta: Float[Array, " parameters"], sigma: ArrayLike, deviate: ArrayLike = 0.0
    ) -> Float[Array, " 3"]:
        """The nuisances' coefficients, in prior standard deviations, as three standard normal numbers draw them.

        With a `deviate` of 0, their posterior mean given theta.
        """
        _, beta, factor = self.linear(theta, sigma)
        return beta + solve_triangular(factor.T, jnp.zeros(3) + deviate)

    def residuals(self, theta: Float[Array, " parameters"], sigma: ArrayLike) -> Float[Array, " samples+3"]:
        """Whitened residuals, nuisances' priors included: half their square is -log-likelihood."""
        remainder, beta, _ = self.linear(theta, sigma)
        return jnp.concatenate([remainder / sigma, beta])

    def prior_residuals(self, theta: Float[Array, " parameters"]) -> Float[Array, " parameters"]:
        """The prior as residuals: normal in theta, with the moments of the stated prior."""
        scale = (theta[: len(self.prior.names)] - self.prior.log_mean) / self.prior.log_sd
        return jnp.append(scale, theta[-1] / self.delay_sd) if self.free_delay else scale

    def log_prob(self, point: Float[Array, " parameters+1"]) -> Float[Array, ""]:
        """Log-posterior of (theta, log sigma), up to a constant; sigma's prior is flat in its logarithm.

        Anything that is not finite counts as impossible.
        """
        theta, log_sigma = point[:-1], point[-1]
        remainder, beta, factor = self.linear(theta, jnp.exp(log_sigma))
        misfit = jnp.sum(jnp.square(remainder)) * jnp.exp(-2.0 * log_sigma) + jnp.sum(jnp.square(beta))
        value = -0.5 * misfit - self.observed.size * log_sigma - jnp.sum(jnp.log(jnp.diagonal(factor)))
        value = value + self.prior.log_density(theta[: len(self.prior.names)])
        if self.free_delay:
            value = value - 0.5 * jnp.square(theta[-1] / self.delay_sd)
        return jnp.where(jnp.isfinite(value), value, -jnp.inf)


def in_batches(
    function: Callable[..., Array],
    model: eqx.Module,
    arrays: tuple[np.ndarray, ...],
    samples: int,
    batch: int = 32,
) -> np.ndarray:
    """`function(model, *rows)` over the rows of arrays of one length, a batch at a time.

    Batches have one size, so that they compile once, and shrink where `samples`, the length of the record,
    is large, which bounds memory. Call it in double precision.
    """
    count = len(arrays[0])
    batch = max(1, min(batch, count, _BATCH_SAMPLES // samples))
    padded = [np.concatenate([a, np.repeat(a[-1:], -count % batch, axis=0)]) for a in arrays]
    parts = [
        np.asarray(_batch(function, model, tuple(jnp.asarray(a[i : i + batch]) for a in padded)))
        for i in range(0, count, batch)
    ]
    return np.concatenate(parts)[:count]


@eqx.filter_jit
def _batch(function: Callable[..., Array], model: eqx.Module, rows: tuple[Array, ...]) -> Array:
    return jax.vmap(lambda *row: function(model, *row))(*rows)


def natural(likelihood: Likelihood, theta: np.ndarray) -> dict[str, np.ndarray]:
    """Points (..., parameters) in SI units, by name; the delay is that of Vsc against the drive, in all."""
    start, step = float(likelihood.shift), float(likelihood.time_step)
    return {
        name: start + theta[..., i] * step if name == "delay" else np.exp(theta[..., i])
        for i, name in enumerate(likelihood.names)
    }
