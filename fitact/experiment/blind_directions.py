"""Unidentified directions: combinations of parameters that no record of the channels determines.

They follow from the model. A noise-free record of all frequencies determines the gain of each channel over V as a
function of frequency, and nothing else. A direction in the log-parameters that changes none of these gains is not
identified. Such directions are the null space of the first derivatives of the gains' logarithms.
"""

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Complex, Float

from fitact.compiled import as_arrays, double_precision, jit
from fitact.errors import InputError
from fitact.model.circuit import Channel, Circuit, passes_direct_current
from fitact.model.skin import circuit_parameters, constant_skin_circuit, with_values

GAIN_CHANNELS: dict[str, Channel] = {"gain": "Vsc", "gain_I": "I"}  # channels by the names of their gains
STRAY = "stray_capacitance"  # name of the parameter of panel and cable, whose current I includes


def blind_directions(
    circuit: Circuit,
    free: Sequence[str],
    channels: Sequence[Channel],
    stray_capacitance: float = 0.0,
    min_sine: float = 1e-6,
) -> Float[np.ndarray, "dimension parameters"]:
    """Find the directions in the logarithms of `free` that no record of `channels` determines, as unit vectors.

    `free` names fields of the circuit, "gain" (of the channel Vsc), "gain_I" and "stray_capacitance", which has this
    value (F); all else is known. The circuit's values may be special (two equal skins). A direction therefore counts
    only if it is unidentified there and at `points` random values around them, each up to a factor of 10 away.
    They are those at the circuit's values, and elsewhere may differ. Ci increases along them, unless it changes by less
    than `min_sine`.
    """
    free, channels, points = tuple(free), tuple(channels), 8
    spread = np.array([0.1 if name == "alpha" else math.log(10.0) for name in free])  # alpha is at most 1
    offsets = spread * np.random.default_rng(0).uniform(-1.0, 1.0, (points, len(free)))  # any other points would serve
    thetas = log_values(circuit, free, channels, stray_capacitance) + np.vstack([np.zeros(len(free)), offsets])
    with double_precision():
        slopes = _log_gain_slopes(as_arrays(circuit), thetas, free, channels, np.asarray(stray_capacitance))
    null_spaces = [_null_space(np.concatenate([slope.real, slope.imag])) for slope in slopes]
    dimension = min(map(len, null_spaces))
    directions = _sparse_basis(next(each for each in null_spaces if len(each) == dimension))
    if "Ci" in free:
        directions[directions[:, free.index("Ci")] < -min_sine] *= -1.0
    return directions


def is_blind(
    directions: Float[np.ndarray, "dimension parameters"],
    free: Sequence[str],
    direction: dict[str, float],
    max_sine: float = 0.1,
) -> bool:
    """Return whether a direction in some of `free` lies in these `blind_directions`, for any change of the others."""
    if not len(directions):
        return False
    part, wanted = directions[:, [free.index(name) for name in direction]], np.array(list(direction.values()))
    inside = wanted @ np.linalg.pinv(part, rcond=1e-6) @ part  # projected directions may be parallel
    return bool(np.linalg.norm(wanted - inside) < max_sine * np.linalg.norm(wanted))


def gain_names(channels: Sequence[Channel]) -> dict[str, Channel]:
    """Return the channels by the parameter names of their gains."""
    return {name: channel for name, channel in GAIN_CHANNELS.items() if channel in channels}


def log_values(
    circuit: Circuit, free: Sequence[str], channels: Sequence[Channel], stray_capacitance: float = 0.0
) -> Float[np.ndarray, " circuit_parameters"]:
    """Return the logarithms of `free`: parameters of the circuit, the channels' gains, which are 1, and the stray."""
    known = dict.fromkeys(gain_names(channels), 1.0) | ({STRAY: stray_capacitance} if "I" in channels else {})
    known |= {name: float(value) for name, value in circuit_parameters(circuit).items() if value is not None}
    for name in free:
        if not known.get(name, 0.0) > 0.0:
            raise InputError(
                f"free: {name!r} has no value above zero in this {type(constant_skin_circuit(circuit)).__name__};"
                f" give it one, or free some of {', '.join(known)}"
            )
    return np.log([known[name] for name in free])


def with_parameters(
    circuit: Circuit,
    free: Sequence[str],
    channels: Sequence[Channel],
    theta: Float[Array, " circuit_parameters"],
    stray_capacitance: ArrayLike = 0.0,
) -> tuple[Circuit, list[ArrayLike], list[ArrayLike]]:
    """Return the circuit, and of each channel the gain and the stray capacitance (F), for logarithms of `free`."""
    values = dict(zip(free, jnp.exp(theta), strict=True))
    named = gain_names(channels)
    stray = values.pop(STRAY, stray_capacitance)
    gains = {named[name]: values.pop(name) for name in free if name in named}
    gain = [gains.get(channel, 1.0) for channel in channels]
    return with_values(circuit, values), gain, [stray if channel == "I" else 0.0 for channel in channels]


def recorded_gain(
    circuit: Circuit, channel: Channel, gain: ArrayLike, stray_capacitance: ArrayLike, omega: ArrayLike
) -> Complex[Array, "*shape"]:
    """Return a recorded channel over V at angular frequencies (rad/s)."""
    return gain * (circuit.channel_gain(channel, omega) + 1j * omega * jnp.asarray(stray_capacitance))


def name_direction(direction: dict[str, float]) -> str:
    """Describe a direction in the log-parameters."""
    area = {name: _area_power(name) for name in direction if not name.startswith("gain") and name != "alpha"}
    along = sum(power * direction[name] for name, power in area.items())
    if abs(along) > 0.99 * np.sqrt(len(area)) * np.linalg.norm(list(direction.values())):
        scaled = [name if power > 0.0 else f"1/{name}" for name, power in area.items()]
        return f"the contact area, which multiplies {', '.join(scaled[:-1])} and {scaled[-1]} by a common factor"
    moves = ", ".join(f"{name} {value:+.2g}" for name, value in direction.items() if abs(value) > 1e-3)
    return f"the combination ({moves})"


def _area_power(name: str) -> float:
    """Return the exponent of the contact area in a circuit's parameter: -1 for R, 1 for C."""
    return 1.0 if name == "Ci" or name.endswith(("Csc", "capacitance", "Cgap")) else -1.0


@jit
def _log_gain_slopes(
    circuit: Circuit,
    thetas: Float[Array, "n parameters"],
    free: tuple[str, ...],
    channels: tuple[Channel, ...],
    stray_capacitance: ArrayLike,
) -> Complex[Array, "n rows parameters"]:
    """Return derivatives of the log gains, at frequencies up to `margin` times beyond the circuit's at both ends."""
    frequencies, margin = 128, 100.0

    def slopes(theta: Array) -> Array:
        plain = constant_skin_circuit(with_parameters(circuit, free, channels, theta)[0])
        tau = jnp.stack(plain.terms().tau)
        omega = jnp.geomspace(1.0 / (margin * jnp.max(tau)), margin / jnp.min(tau), frequencies)
        if passes_direct_current(plain):  # however small the leak, a constant drive shows it
            omega = jnp.append(0.0, omega)

        def gain(theta: Array) -> tuple[Array, Array]:
            there, gains, strays = with_parameters(circuit, free, channels, theta, stray_capacitance)
            parts = [recorded_gain(there, *each, omega) for each in zip(channels, gains, strays, strict=True)]
            return jnp.concatenate(parts), jnp.concatenate(parts)

        slope, value = jax.jacfwd(gain, has_aux=True)(theta)
        return slope / value[:, None]

    return jax.vmap(slopes)(thetas)


def _null_space(sensitivity: Float[np.ndarray, "rows parameters"]) -> Float[np.ndarray, "dimension parameters"]:
    """Return an orthonormal basis of the directions without effect.

    Relative to the largest singular value, rounding leaves 1e-15, and real effects lie above 1e-5. Values below
    `rounding` count as 0 if they lie below `gap` times the others; without that gap no direction is structural. The
    frequencies cover all corner frequencies of the circuit, so even the smallest resistance has an effect at some.
    Columns are scaled to one length, which removes the parameters' different sizes.
    """
    rounding, gap = 1e-11, 1e-3
    scale = np.linalg.norm(sensitivity, axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    _, sizes, directions = np.linalg.svd(sensitivity / scale, full_matrices=False)
    null = sizes < rounding * sizes[0]
    if not null.any() or sizes[null].max() > gap * sizes[~null].min():
        return np.zeros((0, scale.size))
    return np.linalg.qr((directions[null] / scale).T)[0].T


def _sparse_basis(basis: Float[np.ndarray, "dimension parameters"]) -> Float[np.ndarray, "dimension parameters"]:
    """Return unit vectors of the same space that change few parameters each: a reduced echelon form."""
    rows = basis.copy()
    for i in range(len(rows)):
        largest = np.max(np.abs(rows[i:]), axis=0)
        pivot = np.flatnonzero(largest > 0.5 * largest.max())[-1]  # the last parameter with a large component
        best = i + int(np.argmax(np.abs(rows[i:, pivot])))
        rows[[i, best]] = rows[[best, i]]
        rows[i] /= rows[i, pivot]
        others = np.arange(len(rows)) != i
        rows[others] -= np.outer(rows[others, pivot], rows[i])
    return rows[::-1] / np.linalg.norm(rows[::-1], axis=1, keepdims=True)
