"""The log-probability of one or several records: a circuit, and the traces that it made.

The chain holds only the parameters that matter: the logarithms of the circuit's free parameters and of the
channels' gains, the delays, and the logarithm of each trace's noise. What enters the traces linearly is
integrated out (`fitact.likelihood.channel`).
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from fitact.likelihood.channel import TIMING, Seen, Trace
from fitact.model.circuit import RC, Circuit
from fitact.model.skin import WithSkin, parameters, with_values
from fitact.prior.distributions import Distribution
from fitact.prior.prior import Prior

OPEN = math.log(1e6)  # in a logarithm: what leaves more open than this leaves it open
_HUGE = 70.0  # in a logarithm: beyond 1e30 or below 1e-30 SI units is no finger, and products overflow
_BATCH_ROWS = 4_000_000  # samples or coordinates evaluated at a time, which bounds memory


class Likelihood(eqx.Module):
    """Traces, a circuit and the prior, as a function of the parameters.

    A point theta holds, in the order of `names`, logarithms of positive parameters, and each trace's free delay and
    clock in its `timing_unit`. Built by `fitact.fitting.fit`.

    Attributes:
        traces: channels of records.
        template: the circuit; what the prior does not name keeps its value there.
        prior: of the circuit's free parameters and of free gains.
        sigma_prior: of each trace's noise; None: flat in its logarithm.
        tied: parameters that are a ratio times another: name, the other's, ratio.
        believed: whether the prior of the circuit counts, beside those of gains and delays.
    """

    traces: tuple[Trace, ...]
    template: RC | WithSkin
    prior: Prior
    sigma_prior: tuple[Distribution | None, ...]
    tied: tuple[tuple[str, str, float], ...] = eqx.field(static=True, default=())
    believed: bool = eqx.field(static=True, default=True)

    @property
    def names(self) -> tuple[str, ...]:
        """The coordinates of theta."""
        return (*self.prior.names, *(trace.named(name) for trace, name in self._timing))

    @property
    def _timing(self) -> list[tuple[Trace, str]]:
        """Free delays and clocks: the trace, and which."""
        return [(trace, name) for trace in self.traces for name in trace.timing]

    @property
    def timing_sd(self) -> list[ArrayLike]:
        """Their standard deviations by the prior."""
        return [trace.timing_sd[TIMING.index(name)] for trace, name in self._timing]

    @property
    def timing(self) -> dict[str, tuple[float, float]]:
        """By name, what they are (s, or a share of 1) where their coordinate is 0, and what 1 of that adds."""
        with jax.enable_x64(True):
            return {
                trace.named(name): (
                    float(trace.shift if name == "delay" else trace.clock),
                    float(trace.timing_unit(name)),
                )
                for trace, name in self._timing
            }

    @property
    def sigma_names(self) -> tuple[str, ...]:
        """The coordinates of a posterior's point after theta."""
        return tuple(trace.named("sigma") for trace in self.traces)

    @property
    def prior_root(self) -> Float[np.ndarray, "parameters parameters"]:
        """A root of theta's covariance by the prior; of a circuit without one, `OPEN` in each direction."""
        with jax.enable_x64(True):
            sd = np.append(self.prior.log_sd, np.array(self.timing_sd))
        size, root = len(self.prior.names), np.diag(sd)
        root[:size, :size] = np.linalg.cholesky(self.prior.covariance)
        return root if self.believed else np.where(self._of_circuit[:, None], OPEN * np.eye(len(root)), root)

    @property
    def _of_circuit(self) -> Bool[np.ndarray, " parameters"]:
        """Which coordinates of theta are the circuit's."""
        return np.array([name in parameters(self.template) for name in self.names])

    @property
    def rows(self) -> int:
        """How many numbers an evaluation runs over."""
        return sum(trace.rows for trace in self.traces)

    @property
    def count(self) -> ArrayLike:
        """How many samples count."""
        return sum(trace.count for trace in self.traces)

    def summed(self) -> "Likelihood":
        """Without compression."""
        return dataclasses.replace(self, traces=tuple(trace.summed() for trace in self.traces))

    def without_samples(self) -> "Likelihood":
        """With no more of the samples than their ends, where a compression stands for them."""
        return dataclasses.replace(self, traces=tuple(trace.without_samples() for trace in self.traces))

    def with_trace(self, index: int, trace: Trace) -> "Likelihood":
        """With another trace in that place."""
        traces = (*self.traces[:index], trace, *self.traces[index + 1 :])
        return dataclasses.replace(self, traces=traces)

    def circuit(self, theta: Float[Array, " parameters"]) -> Circuit:
        """The circuit at theta; NaN where no double could hold what follows from it, so that no step leads there."""
        theta = jnp.where(jnp.abs(theta) < _HUGE, theta, jnp.nan)
        known = parameters(self.template)
        values = {name: jnp.exp(theta[i]) for i, name in enumerate(self.prior.names) if name in known}
        for name, other, ratio in self.tied:
            values[name] = ratio * values.get(other, known[other])
        return with_values(self.template, values)

    def seen(self, theta: Float[Array, " parameters"], index: int = 0) -> Seen:
        """What the trace of that index needs of theta."""
        return self._seen(self.circuit(theta), theta, self.traces[index])

    def _seen(self, circuit: Circuit, theta: Array, trace: Trace) -> Seen:
        gain, names = trace.named("gain"), self.names
        timing = {name: theta[names.index(trace.named(name))] * trace.timing_unit(name) for name in trace.timing}
        return Seen(circuit, jnp.exp(theta[names.index(gain)]) if gain in names else 1.0, **timing)

    def each(self, theta: Float[Array, " parameters"]) -> Iterator[tuple[Trace, Seen]]:
        """The traces, and what they need of theta."""
        circuit = self.circuit(theta)
        return ((trace, self._seen(circuit, theta, trace)) for trace in self.traces)

    def residuals(
        self, theta: Float[Array, " parameters"], sigma: Float[Array, " traces"]
    ) -> tuple[Float[Array, " rows"], ...]:
        """Whitened residuals of each trace, nuisances' priors included: half their square is -log-likelihood."""
        return tuple(trace.residuals(seen, s) for (trace, seen), s in zip(self.each(theta), sigma, strict=True))

    def prior_residuals(self, theta: Float[Array, " parameters"]) -> Float[Array, " parameters"]:
        """The prior as residuals: normal in theta, with the moments of the stated prior; 0 for what has none."""
        size = len(self.prior.names)
        scaled = self.prior.residuals(theta[:size])
        found = jnp.concatenate([scaled, theta[size:] / jnp.asarray(self.timing_sd)]) if self._timing else scaled
        return found if self.believed else jnp.where(self._of_circuit, 0.0, found)

    def split(self, point: Float[Array, " coordinates"]) -> tuple[Float[Array, " parameters"], Float[Array, " traces"]]:
        """Theta and the logarithms of the noise."""
        return point[: -len(self.traces)], point[-len(self.traces) :]

    def log_likelihoods(self, point: Float[Array, " coordinates"]) -> Float[Array, " traces"]:
        """Log-likelihood of each trace at (theta, log sigma), up to a constant; NaN where its compression ends."""
        theta, log_sigma = self.split(point)
        parts = zip(self.each(theta), log_sigma, strict=True)
        return jnp.stack([trace.log_likelihood(seen, log) for (trace, seen), log in parts])

    def log_likelihood(self, point: Float[Array, " coordinates"]) -> Float[Array, ""]:
        """Log-likelihood of (theta, log sigma), up to a constant; NaN where a compression does not reach."""
        return jnp.sum(self.log_likelihoods(point))

    def log_prior(self, point: Float[Array, " coordinates"]) -> Float[Array, ""]:
        """Log-density of the prior, up to a constant: a noise is flat in its logarithm unless it has one."""
        theta, log_sigma = self.split(point)
        size = len(self.prior.names)
        value = self.prior.log_density(theta[:size])
        for off, sd in zip(theta[size:], self.timing_sd, strict=True):
            value = value - 0.5 * jnp.square(off / sd)
        for prior, log in zip(self.sigma_prior, log_sigma, strict=True):
            value = value if prior is None else value + prior.log_density(log)
        return value

    def log_prob(self, point: Float[Array, " coordinates"]) -> Float[Array, ""]:
        """Log-posterior of (theta, log sigma), up to a constant.

        Anything that is not finite counts as impossible, but it is NaN where a compression does not reach.
        """
        believed, value = self.log_prior(point), self.log_likelihood(point)
        compressed = any(trace.compression is not None for trace in self.traces)
        beyond = jnp.isnan(value) & jnp.all(jnp.isfinite(point)) & jnp.isfinite(believed) & compressed
        value = value + believed
        return jnp.where(jnp.isfinite(value) | beyond, value, -jnp.inf)

    def draws(self, theta: Float[np.ndarray, " parameters"], count: int) -> Float[np.ndarray, "count parameters"]:
        """Points of the prior, always the same; delays and clocks are those of `theta`."""
        points = np.tile(theta, (count, 1))
        drawn = self.prior.sample(np.random.default_rng(0), count)
        points[:, : len(drawn)] = np.log(list(drawn.values())).T
        return points

    def natural(self, theta: Float[np.ndarray, "*shape parameters"]) -> dict[str, Float[np.ndarray, "*shape"]]:
        """Points in SI units, by name; delays and clocks are those of the channel against the drive, in all."""
        found = {name: np.exp(theta[..., i]) for i, name in enumerate(self.prior.names)}
        for i, (name, (base, unit)) in enumerate(self.timing.items(), len(found)):
            found[name] = base + theta[..., i] * unit
        return found


class Batched:
    """`function(model, *rows)` over the rows of arrays of one length, a batch at a time.

    Batches have one size, filled up where rows are missing, so that they compile once; it shrinks where `rows`,
    the numbers that one evaluation runs over, are many, which bounds memory. What jit needs of the model is sorted
    out here once, since a call may take less time than that. Call it in double precision.
    """

    def __init__(self, function: Callable[..., Array], model: eqx.Module, rows: int, batch: int = 32) -> None:
        dynamic, static = eqx.partition(model, eqx.is_array)
        self._dynamic, treedef = jax.tree.flatten(dynamic)
        self._static = _Static(function, static, treedef)
        self.batch = max(1, min(batch, _BATCH_ROWS // rows))

    def __call__(self, *arrays: np.ndarray) -> np.ndarray:
        count = len(arrays[0])
        batch = self.batch
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
