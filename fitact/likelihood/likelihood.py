"""Log-probability of one or several records of one circuit.

The parameters are the logarithms of the circuit's free parameters and of the channels' gains, the delays, and the
logarithm of each channel's noise. Linear nuisances are integrated out (`fitact.likelihood.channel`).
"""

import dataclasses
import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from fitact.compiled import BatchEvaluator, array_module, double_precision, jit
from fitact.experiment.blind_directions import STRAY
from fitact.likelihood.calibration import Calibration
from fitact.likelihood.channel import ChannelLikelihood
from fitact.likelihood.friction_observable import FrictionObservable
from fitact.likelihood.observable import TIMING_NUISANCES, ChannelInputs
from fitact.model.circuit import FINGER_PARAMETERS, RC, Channel, Circuit, HighpassTerms
from fitact.model.force import FRICTION_PARAMETERS
from fitact.model.skin import (
    WithSkin,
    circuit_parameters,
    constant_skin_circuit,
    has_time_constants,
    probe_parameters,
    with_probe,
    with_values,
)
from fitact.prior.distributions import Distribution
from fitact.prior.prior import Prior

UNCONSTRAINED_SD = math.log(1e6)  # in a log-parameter; a larger sd counts as no constraint


class CircuitValues(NamedTuple):
    """A circuit at a point theta, as NumPy arrays."""

    circuit: Circuit
    b: Array  # slowest time constant, s
    tau: Array  # all time constants, s; with a skin model, of the circuit without it
    terms: dict[Channel, HighpassTerms]  # of Vsc and I; empty for a skin without time constants


class Likelihood(eqx.Module):
    """Likelihood and prior of channels and a circuit, as functions of the parameters.

    A point theta holds, in the order of `names`, the logarithms of positive parameters, and the free delay and clock
    of each channel in its `timing_unit`. It is built by `fitact.fitting.fit`.
    """

    channels: tuple[ChannelLikelihood, ...]  # channels of all records
    template: RC | WithSkin  # the circuit with the values of parameters that are not free
    prior: Prior  # prior of the free circuit parameters, gains and the load of a probe
    sigma_prior: tuple[Distribution | None, ...]  # prior of each channel's noise; None means flat in its logarithm
    calibration: Calibration | None = eqx.field(default=None, kw_only=True)  # of the errors of instruments
    # parameters proportional to another: (name, name of the other, ratio)
    tied: tuple[tuple[str, str, float], ...] = eqx.field(static=True, default=())
    # whether the prior of the circuit applies, in addition to the priors of gains and delays
    use_prior: bool = eqx.field(static=True, default=True)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coordinates of theta."""
        return (*self.prior.names, *(channel.qualified_name(name) for channel, name in self._timing))

    @property
    def elements(self) -> tuple[int, ...]:
        """Places of log Rsc, log Csc and log Ci in theta; empty if one is not free, or no prior holds them all."""
        names = self.prior.names
        if not self.use_prior or not set(FINGER_PARAMETERS) <= set(names):
            return ()
        return tuple(map(names.index, FINGER_PARAMETERS))

    @property
    def _timing(self) -> list[tuple[ChannelLikelihood, str]]:
        """Free delays and clocks, as (channel, nuisance)."""
        return [(channel, name) for channel in self.channels for name in channel.timing.free]

    @property
    def timing_sd(self) -> list[ArrayLike]:
        """Prior standard deviations of free delays and clocks."""
        return [channel.timing.sd[TIMING_NUISANCES.index(name)] for channel, name in self._timing]

    @property
    def follows_rows(self) -> Bool[np.ndarray, " parameters"]:
        """Mask of the coordinates that are delays of rows of charge."""
        rows = [channel.samples.charges is not None for channel, _ in self._timing]
        return np.array([*[False] * len(self.prior.names), *rows])

    @property
    def timing_mean(self) -> list[ArrayLike]:
        """Prior means of free delays and clocks."""
        return [jnp.asarray(channel.timing_mean(name), dtype=float) for channel, name in self._timing]

    @property
    @double_precision()
    def timing(self) -> dict[str, tuple[float, float]]:
        """Origin and unit of the coordinate of each free delay (s) and clock (relative), by name."""
        found = {}
        for channel, name in self._timing:
            origin = channel.timing.shift if name == "delay" else channel.timing.clock
            found[channel.qualified_name(name)] = float(origin), float(channel.timing_unit(name))
        return found

    @property
    def sigma_names(self) -> tuple[str, ...]:
        """Names of the coordinates that follow theta in the posterior."""
        return tuple(channel.qualified_name("sigma") for channel in self.channels)

    @property
    def prior_factor(self) -> Float[np.ndarray, "parameters parameters"]:
        """Factor of the prior covariance of theta; `UNCONSTRAINED_SD` in each direction without a prior."""
        with double_precision():
            sd = np.append(self.prior.log_sd, np.array(self.timing_sd))
        size, root = len(self.prior.names), np.diag(sd)
        root[:size, :size] = np.linalg.cholesky(self.prior.covariance)
        if not self.use_prior:
            root[self._circuit_mask] = UNCONSTRAINED_SD * np.eye(len(root))[self._circuit_mask]
        return root

    @property
    def _circuit_mask(self) -> Bool[np.ndarray, " circuit_parameters"]:
        """Mask of the coordinates of theta that belong to the circuit."""
        return np.array([name in circuit_parameters(self.template) for name in self.names])

    @property
    def rows(self) -> int:
        """Number of rows (samples or coordinates) in an evaluation."""
        return sum(channel.rows for channel in self.channels)

    @property
    def count(self) -> ArrayLike:
        return sum(channel.count for channel in self.channels)

    def without_compression(self) -> "Likelihood":
        return dataclasses.replace(self, channels=tuple(channel.without_compression() for channel in self.channels))

    def without_samples(self) -> "Likelihood":
        """Return the likelihood with only two samples for each compressed channel."""
        return dataclasses.replace(self, channels=tuple(channel.without_samples() for channel in self.channels))

    def replace_channel(self, index: int, channel: ChannelLikelihood) -> "Likelihood":
        return dataclasses.replace(self, channels=(*self.channels[:index], channel, *self.channels[index + 1 :]))

    def circuit(self, theta: Float[Array, " circuit_parameters"]) -> Circuit:
        """Return the circuit at theta, with NaN for extreme values, so that no optimiser step leads there."""
        if isinstance(theta, np.ndarray):  # outside compiled functions
            return self.evaluate_circuit(theta).circuit
        # no finger exceeds 1e30 or falls below 1e-30 SI units, where products overflow
        theta = jnp.where(jnp.abs(theta) < 70.0, theta, jnp.nan)
        known = circuit_parameters(self.template)
        load = probe_parameters(self.template)
        values = {name: jnp.exp(theta[i]) for i, name in enumerate(self.prior.names) if name in known or name in load}
        for name, other, ratio in self.tied:
            values[name] = ratio * values.get(other, known[other])
        return with_values(self.template, values)

    def finger(self, circuit: Any) -> Any:
        """Return the circuit of the finger alone: without a probe whose load is a nuisance parameter."""
        is_nuisance = any(name in self.prior.names for name in probe_parameters(circuit))
        return with_probe(circuit, None) if is_nuisance else circuit

    def evaluate_circuit(self, theta: Float[np.ndarray, " circuit_parameters"]) -> CircuitValues:
        """Return the circuit at theta, outside compiled functions."""
        bare, kept = self.for_circuit()
        return _evaluate_circuit(bare, theta[kept])

    def evaluate_g_and_b(
        self, points: Float[np.ndarray, "n parameters"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Return the divider ratio g and the slowest time constant b (s) at many points theta."""
        finger = dataclasses.replace(self, template=self.finger(self.template))  # whose g and b cost less
        g, b, *_ = finger._evaluate_divider(points)
        return g, b

    def time_constants(self, points: Float[np.ndarray, "n parameters"]) -> Float[np.ndarray, "taus n"]:
        """Return the time constants (s) of the circuits at the points theta, the slowest first."""
        return self._evaluate_divider(points)[2:]

    def tau_range(self, points: Float[np.ndarray, "n parameters"]) -> Float[np.ndarray, "2 taus"]:
        """Return the least and the largest value (s) of each time constant of the circuits at the points theta."""
        tau = self.time_constants(points)
        return np.stack([tau.min(axis=1), tau.max(axis=1)])

    def _evaluate_divider(self, points: np.ndarray) -> Float[np.ndarray, "quantities n"]:
        bare, kept = self.for_circuit()
        return BatchEvaluator(_divider, bare, len(kept), batch=256, fast=False)(points[:, kept]).T

    def for_circuit(self, *others: str) -> tuple["Likelihood", list[int]]:
        """Return the likelihood without all that the circuit does not depend on, and its coordinates.

        One program then serves all likelihoods of a circuit. `others` are names of parameters to keep, too.
        """
        known = {*circuit_parameters(self.template), *probe_parameters(self.template), *others}
        kept = [i for i, name in enumerate(self.prior.names) if name in known]
        names = tuple(self.prior.names[i] for i in kept)
        return Likelihood((), self.template, Prior(names, ()), (), self.tied), kept

    def channel_inputs(self, theta: Float[Array, " circuit_parameters"], index: int = 0) -> ChannelInputs:
        """Return the inputs of the channel with this index at theta."""
        return self.make_inputs(self.circuit(theta), theta, self.channels[index])

    def make_inputs(self, circuit: Circuit, theta: Array, channel: ChannelLikelihood) -> ChannelInputs:
        """Return the inputs of a channel at theta, where the circuit is `circuit`."""
        places = {name: i for i, name in enumerate(self.names)}
        timing = {n: theta[places[channel.qualified_name(n)]] * channel.timing_unit(n) for n in channel.timing.free}
        xp = array_module(theta)

        def log_product(coordinates: tuple[tuple[str, float], ...]) -> Array:
            return sum(power * theta[places[name]] for name, power in coordinates)

        gain = xp.exp(log_product(channel.gains)) if channel.gains else 1.0
        sizes = [xp.expm1(xp.asarray(log_product(coordinates), float)) for _, coordinates in channel.effect_sizes]
        effects, stray = xp.stack(sizes) if sizes else None, self.stray_capacitance(theta, channel)
        inputs = ChannelInputs(circuit, gain, **timing, effects=effects, stray=stray)
        if not isinstance(channel.observable, FrictionObservable):
            return inputs
        drive_gain = xp.exp(log_product(channel.drive_gains))
        return dataclasses.replace(inputs, friction=self.friction_parameters(theta), drive_gain=drive_gain)

    def stray_capacitance(self, theta: Array, channel: ChannelLikelihood) -> ArrayLike | None:
        """Return the stray capacitance whose current a channel contains at theta (F), or None."""
        if channel.stray is None or STRAY not in self.prior.names:
            return channel.stray
        return array_module(theta).exp(theta[self.prior.names.index(STRAY)])

    def friction_parameters(self, theta: Array) -> dict[str, Array]:
        """Return the values of those `FRICTION_PARAMETERS` that are free."""
        xp, names = array_module(theta), self.names
        return {name: xp.exp(theta[names.index(name)]) for name in FRICTION_PARAMETERS if name in names}

    def channels_and_inputs(
        self, theta: Float[Array, " circuit_parameters"]
    ) -> Iterator[tuple[ChannelLikelihood, ChannelInputs]]:
        """Yield each channel and its inputs at theta."""
        circuit = self.circuit(theta)
        return ((channel, self.make_inputs(circuit, theta, channel)) for channel in self.channels)

    def residuals(
        self, theta: Float[Array, " circuit_parameters"], sigma: Float[Array, " channels"]
    ) -> tuple[Float[Array, " rows"], ...]:
        """Return the residuals of each channel; half their sum of squares is -log-likelihood (see `channel`)."""
        parts = zip(self.channels_and_inputs(theta), sigma, strict=True)
        return tuple(channel.residuals(inputs, s) for (channel, inputs), s in parts)

    def prior_residuals(self, theta: Float[Array, " circuit_parameters"]) -> Float[Array, " rows"]:
        """Return the prior as residuals, normal in theta with its moments (0 without a prior), then the calibration."""
        size = len(self.prior.names)
        scaled = self.prior.residuals(theta[:size])
        if self._timing:
            off = theta[size:] - jnp.asarray(self.timing_mean)
            scaled = jnp.concatenate([scaled, off / jnp.asarray(self.timing_sd)])
        scaled = scaled if self.use_prior else jnp.where(self._circuit_mask, 0.0, scaled)
        if self.calibration is None:
            return scaled
        return jnp.concatenate([scaled, self.calibration.residuals(theta, self.names)])

    @property
    def calibration_jacobian(self) -> Float[np.ndarray, "rows parameters"]:
        """Derivatives of the calibration's residuals in theta; no rows without a calibration."""
        return np.zeros((0, len(self.names))) if self.calibration is None else self.calibration.jacobian(self.names)

    def split(
        self, point: Float[Array, " coordinates"]
    ) -> tuple[Float[Array, " circuit_parameters"], Float[Array, " channels"]]:
        return point[: -len(self.channels)], point[-len(self.channels) :]

    def log_likelihoods(self, point: Float[Array, " coordinates"]) -> Float[Array, " channels"]:
        """Return each channel's log-likelihood at (theta, log sigma), up to a constant; NaN outside its compression."""
        theta, log_sigma = self.split(point)
        parts = zip(self.channels_and_inputs(theta), log_sigma, strict=True)
        return jnp.stack([channel.log_likelihood(inputs, log) for (channel, inputs), log in parts])

    def log_likelihood(self, point: Float[Array, " coordinates"]) -> Float[Array, ""]:
        """Return the log-likelihood of (theta, log sigma), up to a constant; NaN outside a compression."""
        return jnp.sum(self.log_likelihoods(point))

    def log_prior(self, point: Float[Array, " coordinates"]) -> Float[Array, ""]:
        """Return the log-density of the prior, up to a constant; noise without a prior is flat in its logarithm."""
        theta, log_sigma = self.split(point)
        size = len(self.prior.names)
        value = self.prior.log_density(theta[:size])
        for off, mean, sd in zip(theta[size:], self.timing_mean, self.timing_sd, strict=True):
            value = value - 0.5 * jnp.square((off - mean) / sd)
        for prior, log in zip(self.sigma_prior, log_sigma, strict=True):
            value = value if prior is None else value + prior.log_density(log)
        if self.calibration is not None:
            value = value - 0.5 * jnp.sum(jnp.square(self.calibration.residuals(theta, self.names)))
        return value

    def log_prob_parts(self, point: Float[Array, " coordinates"]) -> Float[Array, "channels+1"]:
        """Return the log-likelihood of each channel and the log-prior; see `combine_log_prob`."""
        return jnp.append(self.log_likelihoods(point), self.log_prior(point))

    def combine_log_prob(
        self, point: Float[Array, "*n coordinates"], parts: Float[Array, "*n channels+1"]
    ) -> Float[Array, "*n"]:
        """Return the log-posterior of points (theta, log sigma), up to a constant, from their `log_prob_parts`.

        A value that is not finite becomes -inf, but it is NaN outside a compression.
        """
        xp = array_module(parts)
        value, log_prior = xp.sum(parts[..., :-1], axis=-1), parts[..., -1]
        compressed = any(channel.compression is not None for channel in self.channels)
        beyond = xp.isnan(value) & xp.all(xp.isfinite(point), axis=-1) & xp.isfinite(log_prior) & compressed
        value = value + log_prior
        return xp.where(xp.isfinite(value) | beyond, value, -xp.inf)

    def log_prob(self, point: Float[Array, " coordinates"]) -> Float[Array, ""]:
        """Return the log-posterior of (theta, log sigma), up to a constant; see `combine_log_prob`."""
        return self.combine_log_prob(point, self.log_prob_parts(point))

    def sample_prior(
        self, theta: Float[np.ndarray, " circuit_parameters"], count: int, *, circuit_only: bool = False
    ) -> Float[np.ndarray, "count parameters"]:
        """Return deterministic draws from the prior, with the delays and clocks of `theta`.

        With `circuit_only`, the errors of instruments are those of `theta`, too.
        """
        prior, points = self.prior, np.tile(theta, (count, 1))
        if circuit_only:
            others = set(prior.names) - set(circuit_parameters(self.template))
            prior = prior.drop_marginals(*others) if others < set(prior.names) else prior
        for name, draws in prior.sample(np.random.default_rng(0), count).items():
            points[:, self.names.index(name)] = np.log(draws)
        return points

    def parameter_values(self, theta: Float[np.ndarray, "*shape parameters"]) -> dict[str, Any]:
        """Return all parameters of the circuit and its probe at points theta in SI units; None for absent elements."""
        values = circuit_parameters(self.template) | probe_parameters(self.template)
        values |= {name: np.exp(theta[..., i]) for i, name in enumerate(self.prior.names) if name in values}
        for name, other, ratio in self.tied:
            values[name] = ratio * values[other]
        return values

    def to_physical(self, theta: Float[np.ndarray, "*shape parameters"]) -> dict[str, Float[np.ndarray, "*shape"]]:
        """Return points in SI units by name; delays and clocks are the totals between channel and drive."""
        values = {name: np.exp(theta[..., i]) for i, name in enumerate(self.prior.names)}
        for i, (name, (base, unit)) in enumerate(self.timing.items(), len(values)):
            values[name] = base + theta[..., i] * unit
        return values


@jit
def _evaluate_circuit(likelihood: Likelihood, theta: Float[Array, " circuit_parameters"]) -> CircuitValues:
    circuit = likelihood.circuit(theta)
    channels: tuple[Channel, ...] = ("Vsc", "I") if has_time_constants(circuit) else ()
    terms = {channel: circuit.channel_terms(channel) for channel in channels}
    tau = jnp.stack(constant_skin_circuit(circuit).terms().tau)
    return jax.tree.map(jnp.asarray, CircuitValues(circuit, circuit.b, tau, terms))


def _divider(likelihood: Likelihood, theta: Float[Array, " circuit_parameters"]) -> Float[Array, " quantities"]:
    """Return g, b, and all time constants (s)."""
    circuit = likelihood.circuit(theta)
    return jnp.stack([circuit.g, circuit.b, *constant_skin_circuit(circuit).terms().tau])
