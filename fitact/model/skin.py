"""Skin levels: how a skin layer's resistance and capacitance follow the frequency.

At each frequency any linear skin is a resistance and a capacitance in parallel, so a level is a map from
the constant Rsc, Csc and the frequency to R(f), C(f). `WithSkin` puts a level into a circuit; a circuit
without one has the constant level. Such a skin has no finite set of time constants, but a steady state,
harmonic by harmonic. A fractional one is causal, so a grid of time constants can follow it in any drive.
"""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Complex

from fitact.errors import InputError
from fitact.model.circuit import RC, Channel, Circuit, Element, Loop, Terms
from fitact.model.relaxation import Grid

# section 3.1 of the paper, where Rsc, Csc are those at 100 Hz
_FREQUENCY = np.array([10.0, 100.0, 1000.0])  # Hz
_RESISTANCE = np.array([200.0, 160.0, 80.0]) / 160.0
_CAPACITANCE = np.array([44.25, 22.0, 8.85]) / 22.0

TOP = float(_FREQUENCY[-1])  # Hz, above which a dispersive skin is constant

_PER_DECADE = 6  # time constants by which a fractional skin is followed at high frequency
_DECADES = 8
_NO_ELEMENT = 2.0  # exponents from which an impedance that goes as its power of frequency would turn its sign


class Skin(eqx.Module):
    """What every level offers."""

    def at(self, skin: Element, frequency: ArrayLike) -> Element:
        """R(f) and C(f) of a skin whose constant values are `skin`, at `frequency` (Hz, >= 0)."""
        raise NotImplementedError

    def count(self, frequency: ArrayLike) -> int:
        """How many harmonics of `frequency` (Hz) are taken one by one, before `above` stands for the rest."""
        raise NotImplementedError

    def above(self, circuit: "WithSkin", omega: ArrayLike, channel: Channel) -> Terms:
        """High-pass terms that stand for `circuit` at the angular frequency `omega` (rad/s) and above."""
        raise NotImplementedError


class Dispersive(Skin):
    """The paper's skin (section 3.1): 200, 160, 80 kohm and 44.25, 22, 8.85 nF at 10, 100, 1000 Hz.

    Taken as factors on the circuit's Rsc and Csc, which are thus the values at 100 Hz. Between the three
    frequencies straight lines in log-log, that is, powers of the frequency: monotone, and three points
    speak for no curvature. Below 10 Hz and above 1000 Hz, where the paper gives nothing, the end values
    are held.

    Attributes:
        harmonics: how many harmonics lie below 1000 Hz; None: taken from the drive's frequency, which a
            traced one does not allow. More than there are does no harm.
    """

    harmonics: int | None = eqx.field(static=True, default=None)

    def at(self, skin: Element, frequency: ArrayLike) -> Element:
        """R(f), C(f)."""
        where = jnp.log(jnp.clip(jnp.asarray(frequency, dtype=float), _FREQUENCY[0], _FREQUENCY[-1]))
        knots = np.log(_FREQUENCY)
        return Element(
            skin.R * jnp.exp(jnp.interp(where, knots, np.log(_RESISTANCE))),
            skin.C * jnp.exp(jnp.interp(where, knots, np.log(_CAPACITANCE))),
        )

    def count(self, frequency: ArrayLike) -> int:
        """The harmonics below 1000 Hz."""
        if self.harmonics is not None:
            return self.harmonics
        try:
            return int(_FREQUENCY[-1] / float(frequency))
        except jax.errors.ConcretizationTypeError:
            raise InputError(
                "the drive's frequency is traced, so the harmonics below 1000 Hz cannot be counted;"
                " state how many there are at most: Dispersive(harmonics=...)"
            ) from None

    def above(self, circuit: "WithSkin", omega: ArrayLike, channel: Channel) -> Terms:
        """Exact: above 1000 Hz the skin is constant."""
        return circuit.at(_FREQUENCY[-1]).terms_of(channel)


class Fractional(Skin):
    """A constant-phase element in parallel with a resistance (Cole): Z = Rsc / (1 + (j w Rsc Csc)^alpha).

    `alpha` = 1 is the constant skin. At zero frequency C(f) has no limit, but no effect either: the
    constant value stands there.

    A response takes `harmonics` one by one and fits time constants to the rest, up to 1e8 times higher.
    Measured, 128 harmonics against 1024, root mean square over that of the response: Vsc 3e-8 at the
    paper's values, a current limited by R_H = 500 ohm 1e-5; in float32 5e-5 of the peak. Exactly at an ideal
    jump Vsc is what those highest frequencies make of it (at alpha = 1, within 5e-7 of the peak).

    Attributes:
        alpha: 0 < alpha <= 1. The default is no measurement: take your skin's own.
        harmonics: how many harmonics a response takes one by one.
    """

    alpha: ArrayLike = 0.8
    harmonics: int = eqx.field(static=True, default=128)

    def at(self, skin: Element, frequency: ArrayLike) -> Element:
        """R(f) = 1 / Re(1/Z), C(f) = Im(1/Z) / w."""
        x = 2.0 * np.pi * jnp.asarray(frequency, dtype=float) * (jnp.asarray(skin.R) * skin.C)
        alpha = jnp.asarray(self.alpha)
        alpha = jnp.where(alpha < _NO_ELEMENT, alpha, jnp.nan)  # so that no step of a fit leads there
        power = jnp.where(x > 0.0, jnp.exp((alpha - 1.0) * jnp.log(jnp.where(x > 0.0, x, 1.0))), 1.0)
        angle = 0.5 * np.pi * (1.0 - alpha)  # from the missing part of alpha: exactly 0 at 1
        return Element(skin.R / (1.0 + x * power * jnp.sin(angle)), skin.C * power * jnp.cos(angle))

    def count(self, frequency: ArrayLike) -> int:
        """`harmonics`."""
        return self.harmonics

    def above(self, circuit: "WithSkin", omega: ArrayLike, channel: Channel) -> Terms:
        """Time constants spread evenly over the decades above `omega`, with weights fitted by least squares."""
        limited = channel != "I" or limits_current(circuit.circuit)
        omega = jnp.asarray(omega, dtype=float)
        tau, x, weights = spread(limited, omega.dtype == jnp.float64)
        gain = circuit.gain_of(channel, omega * x)
        gain = gain if limited else gain / x
        weight = jnp.dot(weights, jnp.concatenate([gain.real, gain.imag]), precision="highest")
        # an unlimited current still grows at the end of the fit: at a jump it has no value
        return Terms(tuple(weight), tuple(tau / omega), None if limited else 0.0)


@functools.cache
def spread(limited: bool, double: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time constants, frequencies (over omega) and the least-squares map from the gain there to the weights.

    A gain that is limited is fitted as it is, one that grows with the frequency in proportion to it. What
    the precision cannot tell apart is left out of the map, lest large weights cancel.
    """
    tau = np.logspace(-_DECADES - 1.0, 1.0, _PER_DECADE * (_DECADES + 2) + 1)
    x = np.logspace(0.0, _DECADES, 4 * _PER_DECADE * _DECADES + 1)
    terms = 1j * x[:, None] * tau / (1.0 + 1j * x[:, None] * tau)
    if not limited:
        terms = terms / x[:, None]
    return tau, x, np.linalg.pinv(np.concatenate([terms.real, terms.imag]), rcond=1e-12 if double else 1e-5)


class WithSkin(Circuit):
    """A circuit whose skins, the touching and the grounding one, follow a level.

    Attributes:
        circuit: final, direct or natural ground, with the constant values that the level refers to.
        skin: `Dispersive` or `Fractional`.
        grid: time constants to follow a fractional skin by; None: it has harmonics only.
    """

    circuit: RC
    skin: Skin
    grid: Grid | None = None

    @property
    def g(self) -> ArrayLike:
        """The divider that the constant values have."""
        return self.circuit.g

    @property
    def b(self) -> ArrayLike:
        """The slowest time constant that the constant values have, s."""
        return self.circuit.b

    def at(self, frequency: ArrayLike) -> Circuit:
        """The circuit with R(f), C(f) of `frequency` (Hz), which at this frequency is this one."""
        touching = Element(self.circuit.Rsc, self.circuit.Csc)
        skin = self.skin.at(touching, frequency)
        changed = {"Rsc": skin.R, "Csc": skin.C}
        given = {name: getattr(self.circuit, f"grounding_{name}", None) for name in ("Rsc", "Csc")}
        if any(value is not None for value in given.values()):
            R, C = (other if value is None else value for value, other in zip(given.values(), touching, strict=True))
            grounding = self.skin.at(Element(R, C), frequency)
            changed |= {"grounding_Rsc": grounding.R, "grounding_Csc": grounding.C}
        return dataclasses.replace(self.circuit, **changed)

    def terms(self) -> Terms:
        """Those of the grid.

        Raises:
            InputError: there is none.
        """
        return self._on_grid("Vsc")

    def current_terms(self) -> Terms:
        """As `terms`."""
        return self._on_grid("I")

    def gap_terms(self) -> Terms:
        """As `terms`."""
        return self._on_grid("Vgap")

    def _on_grid(self, channel: Channel) -> Terms:
        if self.grid is not None:
            return self.grid.terms(channel, limits_current(self.circuit), self.gain_of(channel, self.grid.omega))
        raise InputError(
            f"a {type(self.skin).__name__.lower()} skin has no finite set of time constants; ask for the steady"
            " state of a periodic drive (response) or for harmonics (harmonic_response)"
        )

    def transfer_function(self, omega: ArrayLike) -> Complex[Array, "*shape"]:
        """Vsc / V at the angular frequency `omega` (rad/s, >= 0)."""
        return jnp.vectorize(lambda w: self.at(w / (2.0 * np.pi)).transfer_function(w))(_floating(omega))

    def admittance(self, omega: ArrayLike) -> Complex[Array, "*shape"]:
        """I / V in siemens at the angular frequency `omega` (rad/s, >= 0)."""
        return jnp.vectorize(lambda w: self.at(w / (2.0 * np.pi)).admittance(w))(_floating(omega))

    def gap_transfer_function(self, omega: ArrayLike) -> Complex[Array, "*shape"]:
        """Vgap / V at the angular frequency `omega` (rad/s, >= 0); raises where there is no gap."""
        return jnp.vectorize(lambda w: self.at(w / (2.0 * np.pi)).gap_transfer_function(w))(_floating(omega))


def constant(circuit: Circuit) -> Circuit:
    """The circuit with constant skins that a level refers to; one without a level, as it is."""
    return circuit.circuit if isinstance(circuit, WithSkin) else circuit


def limits_current(circuit: Circuit) -> bool:
    """Whether a resistance is in series with the insulator; without one the current follows dV/dt."""
    inner = constant(circuit)
    return isinstance(inner, Loop) and inner.resistance() is not None


def has_time_constants(circuit: Circuit) -> bool:
    """Whether finitely many stand for it, its own or a grid's."""
    return not isinstance(circuit, WithSkin) or circuit.grid is not None


def parameters(circuit: Circuit) -> dict[str, Any]:
    """What can be known or unknown of a circuit, by name: its fields, and the exponent of a fractional skin."""
    inner = constant(circuit)
    found: dict[str, Any] = {
        field.name: getattr(inner, field.name) for field in dataclasses.fields(inner) if field.name != "probe"
    }
    if isinstance(circuit, WithSkin) and isinstance(circuit.skin, Fractional):
        found["alpha"] = circuit.skin.alpha
    return found


def with_values(circuit: Circuit, values: Mapping[str, ArrayLike]) -> Circuit:
    """The circuit with other values of its `parameters`."""
    if not isinstance(circuit, WithSkin):
        return dataclasses.replace(circuit, **values)
    inner, skin = dict(values), circuit.skin
    if isinstance(skin, Fractional):
        skin = dataclasses.replace(skin, alpha=inner.pop("alpha", skin.alpha))
    return dataclasses.replace(circuit, circuit=dataclasses.replace(circuit.circuit, **inner), skin=skin)


def _floating(omega: ArrayLike) -> Array:
    return jnp.asarray(omega, dtype=float)
