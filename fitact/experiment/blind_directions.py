"""Blind directions, which no record can tell: combinations of parameters that leave what the channels show as it is.

Found from the model. A record without noise, of every frequency, shows each channel's gain over V as a function
of frequency, and no more; a direction in the log-parameters along which none of these gains changes is seen by
no record. The first derivatives of the gains' logarithms know it: it is their null space.
"""

import dataclasses
import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Complex, Float

from fitact.errors import InputError
from fitact.model.circuit import Channel, Circuit
from fitact.model.skin import circuit_parameters, constant_skin_circuit, with_values

_MIN_SINE = 1e-6  # of the angle between directions, below which they count as one


@dataclasses.dataclass(frozen=True)
class StructuralIdentifiability:
    """The directions that no record of these channels can see."""

    names: tuple[str, ...]  # the free parameters
    channels: tuple[Channel, ...]  # recorded beside V
    directions: Float[np.ndarray, "dimension parameters"]  # unit vectors in the log-parameters, at the circuit's values
    is_constant: bool  # whether they are the same for all values; if not, the ridges of equal answers curve

    @property
    def dimension(self) -> int:
        """How many independent combinations cannot be told."""
        return len(self.directions)

    def contains(self, direction: dict[str, float], *, max_sine: float = 0.1) -> bool:
        """Whether a direction in some of the log-parameters is one of those, whatever the others do along it."""
        if self.dimension == 0:
            return False
        part = self.directions[:, [self.names.index(name) for name in direction]]
        return _subspace_distance(part, np.array([list(direction.values())])) < max_sine

    def __str__(self) -> str:
        channels = " and ".join(self.channels)
        if self.dimension == 0:
            return f"A record of {channels} can tell {', '.join(self.names)}."
        what = "; ".join(name_direction(dict(zip(self.names, row, strict=True))) for row in self.directions)
        here = "" if self.is_constant else " (the direction at these values; elsewhere it differs)"
        return f"No record of {channels}{' alone' * (len(self.channels) == 1)} can tell {what}{here}."


def blind_directions(
    circuit: Circuit, free: Sequence[str], channels: Sequence[Channel], points: int = 8
) -> StructuralIdentifiability:
    """The directions in the logarithms of `free` that no record of `channels` can see.

    `free` names fields of the circuit, "gain" (of the channel Vsc) and "gain_I"; all else is known. A direction
    counts if it is blind at the circuit's values, which may be special (two equal skins), and at `points` at random
    around it, each up to a factor of 10 away.
    """
    free, channels = tuple(free), tuple(channels)
    spread = np.array([0.1 if name == "alpha" else math.log(10.0) for name in free])  # 1 bounds alpha
    offsets = spread * np.random.default_rng(0).uniform(-1.0, 1.0, (points, len(free)))  # any points would do
    thetas = log_values(circuit, free, channels) + np.vstack([np.zeros(len(free)), offsets])
    with jax.enable_x64(True):
        circuit = jax.tree.map(jnp.asarray, circuit)
        slopes = np.asarray(_log_gain_slopes(circuit, jnp.asarray(thetas), free, channels))
    null_spaces = [_null_space(np.concatenate([slope.real, slope.imag])) for slope in slopes]
    dimension = min(len(directions) for directions in null_spaces)
    generic = [directions for directions in null_spaces if len(directions) == dimension]
    constant = dimension == 0 or all(_subspace_distance(generic[0], other) < _MIN_SINE for other in generic)
    directions = _sparse_basis(generic[0])
    if "Ci" in free:
        directions[directions[:, free.index("Ci")] < -_MIN_SINE] *= -1.0
    return StructuralIdentifiability(free, channels, directions, constant)


def gain_names(channels: Sequence[Channel]) -> dict[str, Channel]:
    """The channels by the names that their gains have where they are free."""
    names: dict[str, Channel] = {"gain": "Vsc", "gain_I": "I"}
    return {name: channel for name, channel in names.items() if channel in channels}


def log_values(
    circuit: Circuit, free: Sequence[str], channels: Sequence[Channel]
) -> Float[np.ndarray, " circuit_parameters"]:
    """Logarithms of the parameters `free`, those of the circuit and gains of these channels; a gain is 1."""
    gains = dict.fromkeys(gain_names(channels), 1.0)
    known = gains | {name: float(value) for name, value in circuit_parameters(circuit).items() if value is not None}
    for name in free:
        if not known.get(name, 0.0) > 0.0:
            raise InputError(
                f"free: {name!r} has no value above zero in this {type(constant_skin_circuit(circuit)).__name__};"
                f" give it one, or free some of {', '.join(known)}"
            )
    return np.log([known[name] for name in free])


def with_parameters(
    circuit: Circuit, free: Sequence[str], channels: Sequence[Channel], theta: Float[Array, " circuit_parameters"]
) -> tuple[Circuit, list[ArrayLike]]:
    """The circuit and the gain of each channel where the parameters `free` have the logarithms `theta`."""
    values = dict(zip(free, jnp.exp(theta), strict=True))
    named = gain_names(channels)
    gains = {named[name]: values.pop(name) for name in free if name in named}
    return with_values(circuit, values), [gains.get(channel, 1.0) for channel in channels]


def name_direction(direction: dict[str, float]) -> str:
    """Describe a direction in the log-parameters."""
    area = {name: _area_power(name) for name in direction if not name.startswith("gain") and name != "alpha"}
    along = sum(power * direction[name] for name, power in area.items())
    if abs(along) > 0.99 * np.sqrt(len(area)) * np.linalg.norm(list(direction.values())):
        scaled = [name if power > 0.0 else f"1/{name}" for name, power in area.items()]
        return f"the contact area, which scales {', '.join(scaled[:-1])} and {scaled[-1]} alike"
    moves = ", ".join(f"{name} {value:+.2g}" for name, value in direction.items() if abs(value) > 1e-3)
    return f"the combination ({moves})"


def _area_power(name: str) -> float:
    """Return the power of the contact area that a circuit's parameter goes with: R ~ 1/A, C ~ A."""
    return 1.0 if name == "Ci" or name.endswith(("Csc", "capacitance", "Cgap")) else -1.0


@eqx.filter_jit
def _log_gain_slopes(
    circuit: Circuit,
    thetas: Float[Array, "n parameters"],
    free: tuple[str, ...],
    channels: tuple[Channel, ...],
    frequencies: int = 128,
    margin: float = 100.0,
) -> Complex[Array, "n rows parameters"]:
    """Derivatives of the channels' log gains, at frequencies `margin` times beyond the circuit's own at both ends."""

    def slopes(theta: Array) -> Array:
        tau = jnp.stack(constant_skin_circuit(with_parameters(circuit, free, channels, theta)[0]).terms().tau)
        omega = jnp.geomspace(1.0 / (margin * jnp.max(tau)), margin / jnp.min(tau), frequencies)

        def gain(theta: Array) -> tuple[Array, Array]:
            there, gains = with_parameters(circuit, free, channels, theta)
            parts = [g * there.channel_gain(channel, omega) for g, channel in zip(gains, channels, strict=True)]
            return jnp.concatenate(parts), jnp.concatenate(parts)

        slope, value = jax.jacfwd(gain, has_aux=True)(theta)
        return slope / value[:, None]

    return jax.vmap(slopes)(thetas)


def _null_space(
    sensitivity: Float[np.ndarray, "rows parameters"], rounding: float = 1e-11, gap: float = 1e-3
) -> Float[np.ndarray, "dimension parameters"]:
    """An orthonormal basis of the directions without effect.

    Of the largest singular value rounding leaves 1e-15, and what is real lies above 1e-5: those below `rounding` count
    as 0 if they lie below `gap` times the others; without that gap nothing is called structural. The frequencies reach
    all corners of the circuit, so that even the smallest resistance has its effect at some; what is left of the
    parameters' different sizes, the scaling to columns of one length takes out.
    """
    scale = np.linalg.norm(sensitivity, axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    _, sizes, directions = np.linalg.svd(sensitivity / scale, full_matrices=False)
    null = sizes < rounding * sizes[0]
    if not null.any() or sizes[null].max() > gap * sizes[~null].min():
        return np.zeros((0, scale.size))
    return np.linalg.qr((directions[null] / scale).T)[0].T


def _subspace_distance(
    directions: Float[np.ndarray, "n parameters"], others: Float[np.ndarray, "m parameters"]
) -> float:
    """Sine of the largest angle by which `others` stand out of the space of `directions`."""
    inside = others @ np.linalg.pinv(directions, rcond=1e-6) @ directions  # parts of directions may be parallel
    return float(np.linalg.norm((others - inside) / np.linalg.norm(others, axis=1, keepdims=True), 2))


def _sparse_basis(basis: Float[np.ndarray, "dimension parameters"]) -> Float[np.ndarray, "dimension parameters"]:
    """Unit vectors of the same space that move few parameters each, the circuit's own first: a reduced echelon form."""
    rows = basis.copy()
    for i in range(len(rows)):
        largest = np.max(np.abs(rows[i:]), axis=0)
        pivot = np.flatnonzero(largest > 0.5 * largest.max())[-1]  # of those that move much, the last
        best = i + int(np.argmax(np.abs(rows[i:, pivot])))
        rows[[i, best]] = rows[[best, i]]
        rows[i] /= rows[i, pivot]
        others = np.arange(len(rows)) != i
        rows[others] -= np.outer(rows[others, pivot], rows[i])
    return rows[::-1] / np.linalg.norm(rows[::-1], axis=1, keepdims=True)
