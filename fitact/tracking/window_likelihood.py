"""Likelihoods of windows, linearised in the parameters, and quantities that follow from these in a window."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from fitact.compiled import jit, pad_rows
from fitact.likelihood.compression import Compression
from fitact.likelihood.likelihood import Likelihood
from fitact.likelihood.observable import FIRST_CHARGE
from fitact.likelihood.window_compression import TrendInputs
from fitact.model.circuit import FinalCircuit, HighpassTerms, charge_ratios
from fitact.model.force import Geometry, force_constant
from fitact.tracking.compressed_windows import WindowData

QUANTITIES = ("g", "b", "force_mean")


class Linearization(NamedTuple):
    """Residuals of windows at points theta, and their derivatives."""

    residuals: Float[np.ndarray, "windows rows"]
    jacobian: Float[np.ndarray, "windows rows parameters"]
    squares: Float[np.ndarray, "windows channels"]  # sum of squares of each channel's residuals, in units of sigma


def linearize(
    likelihood: Likelihood,
    windows: WindowData,
    theta: Float[np.ndarray, "windows parameters"],
    sigma: Float[np.ndarray, " channels"],
    change: Float[np.ndarray, "windows rates"],
    batch: int = 64,
) -> Linearization:
    """Linearise the likelihoods of windows; `change` has the rates of log(Ci), log(Csc) and log(Rsc), 1/s."""
    return Linearization(*_map_windows(_linearize_batch, likelihood, (windows, change), theta, sigma, batch))


def evaluate_quantities(
    geometry: Geometry,
    likelihood: Likelihood,
    windows: WindowData,
    theta: Float[np.ndarray, "windows parameters"],
    sigma: Float[np.ndarray, " channels"],
    batch: int = 64,
) -> tuple[Float[np.ndarray, "windows quantities"], Float[np.ndarray, "windows quantities parameters"]]:
    """Return the logarithms of `QUANTITIES` in each window, and their gradients in theta."""
    return _map_windows(_quantities_batch, (likelihood, geometry), windows, theta, sigma, batch)


def _map_windows(function: Any, model: Any, windows: Any, theta: np.ndarray, sigma: np.ndarray, batch: int) -> Any:
    padded = jax.tree.map(lambda leaf: pad_rows(leaf, batch), (windows, theta))
    parts = []
    for first in range(0, len(padded[1]), batch):
        here = jax.tree.map(lambda leaf, first=first: leaf[first : first + batch], padded)
        parts.append(function(model, *here, sigma))
    return tuple(np.concatenate(each)[: len(theta)] for each in zip(*parts, strict=True))


def _insert(likelihood: Likelihood, compressions: tuple[Compression, ...]) -> Likelihood:
    pairs = zip(likelihood.channels, compressions, strict=True)
    return dataclasses.replace(likelihood, channels=tuple(dataclasses.replace(c, compression=x) for c, x in pairs))


@jit
def _linearize_batch(likelihood: Likelihood, windows: Any, theta: Array, sigma: Array) -> tuple[Array, Array, Array]:
    def one(window: Any, theta: Array) -> tuple[Array, Array, Array]:
        (compressions, trends, _), change = window
        model = _insert(likelihood, _subtract_changes(_insert(likelihood, compressions), trends, change, theta))

        def residuals(theta: Array) -> tuple[Array, tuple[Array, Array]]:
            parts = model.residuals(theta, sigma)
            values = jnp.concatenate(parts)
            return values, (values, jnp.stack([jnp.sum(jnp.square(part)) for part in parts]))

        jacobian, (values, squares) = jax.jacfwd(residuals, has_aux=True)(theta)
        return values, jacobian, squares

    return jax.vmap(one)(windows, theta)


def _subtract_changes(
    model: Likelihood, trends: tuple[TrendInputs, ...], change: Array, theta: Array
) -> tuple[Any, ...]:
    """Return the compressions without what a changing finger adds, to first order, in the final circuit.

    Values change within the window, charges lag behind them, and i = d(C v)/dt. With a = Ci'/Ci, r = b'/b, u the
    response to V, u1 and u2 its derivatives in log b, the lag is b g (a (V - u - u1) - r (u1 + u2) / 2) of v = g u.
    """
    found = []
    for channel, trend in zip(model.channels, trends, strict=True):
        V = trend.voltage
        compression, inputs = channel.compression, model.make_inputs(model.circuit(theta), theta, channel)
        circuit = inputs.circuit
        if not (isinstance(circuit, FinalCircuit) and isinstance(compression, Compression)):
            return tuple(each.compression for each in model.channels)
        g, b, Ci = circuit.g, circuit.b, circuit.Ci

        def respond(log_tau: Array, compression: Compression = compression) -> Array:
            return compression.response(HighpassTerms((1.0,), (jnp.exp(log_tau),)))

        def respond_slope(log_tau: Array, respond: Any = respond) -> tuple[Array, Array]:
            return jax.jvp(respond, (log_tau,), (jnp.ones(()),))

        (u, u1), (_, u2) = jax.jvp(respond_slope, (jnp.log(b),), (jnp.ones(()),))
        a, skin, resistance = change
        whole = 2.0 * g * a + (1.0 - 2.0 * g) * skin  # of 2 Ci + Csc
        r = resistance + whole
        if channel.channel == "Vsc":
            added = b * g * (a * (V - u - u1) - 0.5 * r * (u1 + u2))
        else:
            slope = g * ((a - whole) * u + r * u1 + a * u1 - 0.5 * r * (u1 - u2))  # of v, beyond that of g u
            added = -2.0 * Ci * slope + a * Ci * (V - 2.0 * g * u)
        late = dataclasses.replace(
            compression, signal=trend.signal, rate=trend.rate, steps=jnp.zeros((0, compression.observed.size))
        )

        def respond_late(
            logs: Array, late: Compression = late, circuit: Any = circuit, name: Any = channel.channel
        ) -> Array:
            parts = zip(("Ci", "Csc", "Rsc"), logs, strict=True)
            moved = FinalCircuit(**{part: getattr(circuit, part) * jnp.exp(log) for part, log in parts})
            return late.response(moved.channel_terms(name))

        added = added + jax.jvp(respond_late, (jnp.zeros(3),), (change,))[1]
        observed = compression.observed - inputs.gain * added
        found.append(dataclasses.replace(compression, observed=lax.stop_gradient(observed)))
    return tuple(found)


@jit
def _quantities_batch(
    model_and_geometry: tuple[Likelihood, Geometry], windows: Any, theta: Array, sigma: Array
) -> tuple[Array, Array]:
    likelihood, geometry = model_and_geometry

    def one(window: WindowData, theta: Array) -> tuple[Array, Array]:
        model = _insert(likelihood, window.compressions)

        def logs(theta: Array) -> tuple[Array, Array]:
            circuit = model.circuit(theta)
            finger = model.finger(circuit)
            contact = geometry.contact(finger)
            square = _mean_square(model, window.samples, circuit, theta, sigma, contact.channel)
            values = jnp.stack([finger.g, finger.b, force_constant(contact) * square])
            return jnp.log(values), jnp.log(values)

        gradients, values = jax.jacfwd(logs, has_aux=True)(theta)
        return values, gradients

    return jax.vmap(one)(windows, theta)


def _mean_square(
    model: Likelihood, samples: Compression | None, circuit: Any, theta: Array, sigma: Array, acting: Any
) -> Array:
    """Return the mean square of the voltage that generates the force, V^2, from inner products over the window."""
    channel = model.channels[0]
    compression, inputs = samples or channel.compression, model.make_inputs(circuit, theta, channel)
    assert isinstance(compression, Compression)
    terms = model.finger(circuit).channel_terms(acting)
    voltage = compression.response(terms)
    _, beta, _ = channel.fit_nuisances(inputs, sigma[0])
    sizes = dict(zip(channel.columns, beta * channel.column_sd, strict=True))
    recorded = circuit.channel_terms(channel.channel)
    decaying = recorded.without_fastest(compression.short).tau
    for index, (ratio, tau) in enumerate(zip(charge_ratios(terms, recorded), decaying, strict=False)):
        if FIRST_CHARGE + index in sizes:
            voltage = voltage + sizes[FIRST_CHARGE + index] / inputs.gain * ratio * compression.decays(tau, index)
    names, gains = model.names, channel.drive_gains
    scale = jnp.exp(sum((power * theta[names.index(name)] for name, power in gains), jnp.zeros(())))
    return jnp.sum(jnp.square(voltage)) / compression.samples / jnp.square(scale)
