"""The log-probability of a record: Gaussian noise, with the linear nuisances integrated out.

The record is  Vsc = gain * response(t - delay) + A beta + noise.  The columns of A are an offset, a
drift, mains hum and, for a measured drive, the decay of the unknown charge at the first sample. Their
coefficients have wide normal priors and are integrated out exactly, so the chain holds only the
parameters that matter: the logarithms of Rsc, Csc, Ci (and gain), the delay, and log sigma.

All this asks of the samples is lengths and angles, so it reads the same in the coordinates of a
`fitact.data.compress.Compression`, where there is one, as over the samples themselves.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.linalg import cho_solve, solve_triangular
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.data.compress import SLOW, Compression, slow_shapes
from fitact.model.circuit import FinalCircuit, Terms
from fitact.model.drive import Drive, Sampled
from fitact.model.prior import Prior
from fitact.model.response import response

_BATCH_ROWS = 4_000_000  # samples or coordinates evaluated at a time, which bounds memory

LINEAR = (*SLOW, "charge")
CHARGE = LINEAR.index("charge")


class Likelihood(eqx.Module):
    """Record, drive and prior, as a function of the parameters.

    A point theta holds, in the order of `names`, logarithms of positive parameters, and the delay in
    units of `time_step`. Built by `fitact.inference.fit`.

    Attributes:
        time: s.
        observed: Vsc, V.
        drive: what drives the circuit.
        prior: of the circuit's parameters.
        linear_sd: prior standard deviations of the `LINEAR` nuisances, V (drift: over half the record); 0
            leaves one out.
        shift: the drive starts this much later than the record's t = 0, s.
        time_step: s.
        delay_sd: prior standard deviation of the delay, in time steps.
        steady_state: or from rest.
        compression: the record's projection; None: the samples are summed.
        free_delay: whether the delay is a parameter.
        columns: which of `LINEAR` are looked at; the others' linear_sd is 0.
    """

    time: Float[Array, " samples"]
    observed: Float[Array, " samples"]
    drive: Drive
    prior: Prior
    linear_sd: Float[Array, " 7"]
    shift: ArrayLike
    time_step: ArrayLike
    delay_sd: ArrayLike
    compression: Compression | None
    steady_state: bool = eqx.field(static=True)
    free_delay: bool = eqx.field(static=True)
    columns: tuple[int, ...] = eqx.field(static=True)

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

    def shapes(self, theta: Float[Array, " parameters"]) -> Float[Array, "7 samples"]:
        """The linear nuisances' shapes in time, each of height 1."""
        middle, half = 0.5 * (self.time[0] + self.time[-1]), 0.5 * (self.time[-1] - self.time[0])
        return jnp.concatenate([slow_shapes(self.time, middle, half), self.decay(theta, self.time)[None]])

    def decay(self, theta: Float[Array, " parameters"], time: Float[Array, " times"]) -> Float[Array, " times"]:
        """How an unknown charge at the first sample decays."""
        (tau,) = self.circuit(theta).terms().tau
        return jnp.exp(-(time - self.time[0]) / tau)

    @property
    def count(self) -> ArrayLike:
        """How many samples there are."""
        return self.time.size if self.compression is None else self.compression.samples

    def without_samples(self) -> "Likelihood":
        """With no more of the samples than their ends, where a compression stands for them.

        What is compiled for it serves records of any length.
        """
        if self.compression is None:
            return self
        drive = self.drive
        if isinstance(drive, Sampled):
            drive = dataclasses.replace(drive, time=drive.time[:2], samples=drive.samples[:2])
        extremes = jnp.stack([jnp.min(self.observed), jnp.max(self.observed)])
        return dataclasses.replace(self, time=self.time[:2], observed=extremes, drive=drive)

    @property
    def rows(self) -> int:
        """How many numbers an evaluation runs over."""
        return self.time.size if self.compression is None else self.compression.observed.size

    @property
    def _places(self) -> np.ndarray:
        return np.array(self.columns, dtype=int)

    def before_linear(
        self, theta: Float[Array, " parameters"]
    ) -> tuple[Float[Array, " rows"], Float[Array, "columns rows"]]:
        """The record less the signal (V), and the shapes of the `columns`, over samples or coordinates."""
        if self.compression is None:
            remainder, shapes = self.observed - self.signal(theta), self.shapes(theta)
        else:
            terms = self.circuit(theta).terms()
            remainder = self.compression.observed - self.gain(theta) * self.compression.response(terms)
            shapes = jnp.concatenate([self.compression.slow, self.compression.decays(terms.tau[0])[None]])
        return remainder, shapes[self._places]

    def slope(self, theta: Float[Array, " parameters"]) -> Float[Array, " rows"]:
        """How a further delay changes the signal, V/s: over two time steps, so that ideal edges count."""
        if self.compression is None:
            step = self.time_step
            return (self.signal(theta, step) - self.signal(theta, -step)) / (2.0 * step)
        weight, tau, _ = self.circuit(theta).terms()  # u' = V' - u / tau
        falling = Terms(tuple(w / t for w, t in zip(weight, tau, strict=True)), tau)
        return self.gain(theta) * (self.compression.response(falling) - sum(weight) * self.compression.slope)

    def linear(
        self, theta: Float[Array, " parameters"], sigma: ArrayLike
    ) -> tuple[Float[Array, " rows"], Float[Array, " columns"], Float[Array, "columns columns"]]:
        """What theta leaves of the record, and the nuisances' posterior given theta.

        Gives the remainder (V) after the best nuisances, their coefficients in prior standard
        deviations, and the Cholesky factor of their posterior precision.
        """
        remainder, shapes = self.before_linear(theta)
        A = self.linear_sd[self._places, None] * shapes
        # keep XLA from computing both once per use
        remainder, A = lax.optimization_barrier((remainder, A))
        factor = jnp.linalg.cholesky(jnp.eye(len(A)) + A @ A.T / sigma**2)
        beta = cho_solve((factor, True), A @ remainder / sigma**2)
        return remainder - beta @ A, beta, factor

    def drawn(
        self, theta: Float[Array, " parameters"], sigma: ArrayLike, deviate: ArrayLike = 0.0
    ) -> Float[Array, " 7"]:
        """The nuisances' coefficients, in prior standard deviations, as seven standard normal numbers draw them.

        With a `deviate` of 0, their posterior mean given theta.
        """
        _, beta, factor = self.linear(theta, sigma)
        deviate = jnp.broadcast_to(deviate, len(LINEAR))[self._places]
        return jnp.zeros(len(LINEAR)).at[self._places].set(beta + solve_triangular(factor.T, deviate))

    def residuals(self, theta: Float[Array, " parameters"], sigma: ArrayLike) -> Float[Array, " rows+columns"]:
        """Whitened residuals, nuisances' priors included: half their square is -log-likelihood."""
        remainder, beta, _ = self.linear(theta, sigma)
        return jnp.concatenate([remainder / sigma, beta])

    def prior_residuals(self, theta: Float[Array, " parameters"]) -> Float[Array, " parameters"]:
        """The prior as residuals: normal in theta, with the moments of the stated prior."""
        scale = (theta[: len(self.prior.names)] - self.prior.log_mean) / self.prior.log_sd
        return jnp.append(scale, theta[-1] / self.delay_sd) if self.free_delay else scale

    def log_likelihood(self, point: Float[Array, " parameters+1"]) -> Float[Array, ""]:
        """Log-likelihood of (theta, log sigma), up to a constant; NaN where the compression does not reach."""
        theta, log_sigma = point[:-1], point[-1]
        remainder, beta, factor = self.linear(theta, jnp.exp(log_sigma))
        misfit = jnp.sum(jnp.square(remainder)) * jnp.exp(-2.0 * log_sigma) + jnp.sum(jnp.square(beta))
        value = -0.5 * misfit - self.count * log_sigma - jnp.sum(jnp.log(jnp.diagonal(factor)))
        if self.compression is None:
            return value
        return jnp.where(self.compression.holds(self.circuit(theta).terms().tau[0]), value, jnp.nan)

    def log_prob(self, point: Float[Array, " parameters+1"]) -> Float[Array, ""]:
        """Log-posterior of (theta, log sigma), up to a constant; sigma's prior is flat in its logarithm.

        Anything that is not finite counts as impossible, but it is NaN where the compression does not reach.
        """
        theta = point[:-1]
        value = self.log_likelihood(point) + self.prior.log_density(theta[: len(self.prior.names)])
        if self.free_delay:
            value = value - 0.5 * jnp.square(theta[-1] / self.delay_sd)
        beyond = jnp.isnan(value) & jnp.all(jnp.isfinite(point)) & (self.compression is not None)
        return jnp.where(jnp.isfinite(value) | beyond, value, -jnp.inf)


class Batched:
    """`function(model, *rows)` over the rows of arrays of one length, a batch at a time.

    Batches have one size, so that they compile once, and shrink where `rows`, the numbers that one evaluation
    runs over, are many, which bounds memory. What jit needs of the model is sorted out here once, since a call
    may take less time than that. Call it in double precision.
    """

    def __init__(self, function: Callable[..., Array], model: eqx.Module, rows: int, batch: int = 32) -> None:
        dynamic, static = eqx.partition(model, eqx.is_array)
        self._dynamic, treedef = jax.tree.flatten(dynamic)
        self._static = _Static(function, static, treedef)
        self._batch = max(1, min(batch, _BATCH_ROWS // rows))

    def __call__(self, *arrays: np.ndarray) -> np.ndarray:
        count = len(arrays[0])
        batch = min(self._batch, count)
        missing = -count % batch
        if missing:
            arrays = tuple(np.concatenate([a, np.repeat(a[-1:], missing, axis=0)]) for a in arrays)
        parts = [
            np.asarray(_evaluate(self._static, self._dynamic, tuple(a[i : i + batch] for a in arrays)))
            for i in range(0, count, batch)
        ]
        return (parts[0] if len(parts) == 1 else np.concatenate(parts))[:count]


class _Static:
    """A function, and a model but for its arrays; equal where their compiled forms are."""

    def __init__(self, function: Callable[..., Array], model: eqx.Module, arrays: Any) -> None:
        self.function, self.model, self.arrays = function, model, arrays
        leaves, treedef = jax.tree.flatten(model)
        self._key = (function, arrays, tuple(leaves), treedef)
        self._hash = hash(self._key)

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, _Static) and self._key == other._key)


@functools.partial(jax.jit, static_argnums=0)
def _evaluate(static: _Static, dynamic: list[Array], rows: tuple[Array, ...]) -> Array:
    model = eqx.combine(jax.tree.unflatten(static.arrays, dynamic), static.model)
    return jax.vmap(lambda *row: static.function(model, *row))(*rows)


def natural(likelihood: Likelihood, theta: np.ndarray) -> dict[str, np.ndarray]:
    """Points (..., parameters) in SI units, by name; the delay is that of Vsc against the drive, in all."""
    start, step = float(likelihood.shift), float(likelihood.time_step)
    return {
        name: start + theta[..., i] * step if name == "delay" else np.exp(theta[..., i])
        for i, name in enumerate(likelihood.names)
    }
