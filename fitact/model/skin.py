"""Skin levels: how a skin layer's resistance and capacitance follow the frequency.

At each frequency any linear skin is a resistance and a capacitance in parallel, so a level is a map from
the constant Rsc, Csc and the frequency to R(f), C(f). `WithSkin` puts a level into a circuit; a circuit
without one has the constant level. Such a skin has no finite set of time constants, but a steady state,
harmonic by harmonic. A fractional one is causal, so a grid of time constants can follow it in any drive.
The paper's series equivalents of a constant skin, and their quality factor, stand at the end.
"""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, NamedTuple, Self, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Complex, Float

from fitact.errors import InputError
from fitact.model.circuit import RC, Channel, Circuit, DirectGround, Element, HighpassTerms, Loop

# section 3.1 of the paper, where Rsc, Csc are those at 100 Hz
_FREQUENCY = np.array([10.0, 100.0, 1000.0])  # Hz
_RESISTANCE = np.array([200.0, 160.0, 80.0]) / 160.0
_CAPACITANCE = np.array([44.25, 22.0, 8.85]) / 22.0

MAX_DISPERSION_FREQUENCY = float(_FREQUENCY[-1])  # Hz, above which a dispersive skin is constant


class SkinModel(eqx.Module):
    """A level: R(f) and C(f) of a skin, and how its steady state is split into harmonics and time constants."""

    def parallel_rc(self, skin: Element, frequency: ArrayLike) -> Element:
        """R(f) and C(f) of a skin whose constant values are `skin`, at `frequency` (Hz, >= 0)."""
        raise NotImplementedError

    def harmonic_count(self, frequency: ArrayLike) -> int:
        """How many harmonics of `frequency` (Hz) are taken one by one; `high_frequency_terms` are the rest."""
        raise NotImplementedError

    def high_frequency_terms(self, circuit: "WithSkin", omega: ArrayLike, channel: Channel) -> HighpassTerms:
        """High-pass terms that stand for `circuit` at the angular frequency `omega` (rad/s) and above."""
        raise NotImplementedError


class Dispersive(SkinModel):
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

    def parallel_rc(self, skin: Element, frequency: ArrayLike) -> Element:
        """R(f), C(f)."""
        where = jnp.log(jnp.clip(jnp.asarray(frequency, dtype=float), _FREQUENCY[0], _FREQUENCY[-1]))
        knots = np.log(_FREQUENCY)
        return Element(
            skin.R * jnp.exp(jnp.interp(where, knots, np.log(_RESISTANCE))),
            skin.C * jnp.exp(jnp.interp(where, knots, np.log(_CAPACITANCE))),
        )

    def harmonic_count(self, frequency: ArrayLike) -> int:
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

    def high_frequency_terms(self, circuit: "WithSkin", omega: ArrayLike, channel: Channel) -> HighpassTerms:
        """Exact: above 1000 Hz the skin is constant."""
        return circuit.circuit_at_frequency(_FREQUENCY[-1]).channel_terms(channel)


class Fractional(SkinModel):
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

    def parallel_rc(self, skin: Element, frequency: ArrayLike) -> Element:
        """R(f) = 1 / Re(1/Z), C(f) = Im(1/Z) / w."""
        x = 2.0 * np.pi * jnp.asarray(frequency, dtype=float) * (jnp.asarray(skin.R) * skin.C)
        alpha = jnp.asarray(self.alpha)
        # from 2 on the impedance would turn its sign: no step of a fit is to lead there
        alpha = jnp.where(alpha < 2.0, alpha, jnp.nan)
        power = jnp.where(x > 0.0, jnp.exp((alpha - 1.0) * jnp.log(jnp.where(x > 0.0, x, 1.0))), 1.0)
        angle = 0.5 * np.pi * (1.0 - alpha)  # from the missing part of alpha: exactly 0 at 1
        return Element(skin.R / (1.0 + x * power * jnp.sin(angle)), skin.C * power * jnp.cos(angle))

    def harmonic_count(self, frequency: ArrayLike) -> int:
        """`harmonics`."""
        return self.harmonics

    def high_frequency_terms(self, circuit: "WithSkin", omega: ArrayLike, channel: Channel) -> HighpassTerms:
        """Time constants spread evenly over the decades above `omega`, with weights fitted by least squares."""
        limited = channel != "I" or limits_current(circuit.circuit)
        omega = jnp.asarray(omega, dtype=float)
        tau, x, weights = high_frequency_basis(limited, omega.dtype == jnp.float64)
        gain = circuit.channel_gain(channel, omega * x)
        gain = gain if limited else gain / x
        weight = jnp.dot(weights, jnp.concatenate([gain.real, gain.imag]), precision="highest")
        # an unlimited current still grows at the end of the fit: at a jump it has no value
        return HighpassTerms(tuple(weight), tuple(tau / omega), None if limited else 0.0)


@functools.cache
def high_frequency_basis(
    is_limited: bool, double: bool, decades: int = 8, per_decade: int = 6
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time constants, frequencies (over omega) and the least-squares map from the gain there to the weights.

    A gain that is limited is fitted as it is, one that grows with the frequency in proportion to it. What
    the precision cannot tell apart is left out of the map, lest large weights cancel.
    """
    tau = np.logspace(-decades - 1.0, 1.0, per_decade * (decades + 2) + 1)
    x = np.logspace(0.0, decades, 4 * per_decade * decades + 1)
    terms = 1j * x[:, None] * tau / (1.0 + 1j * x[:, None] * tau)
    if not is_limited:
        terms = terms / x[:, None]
    return tau, x, np.linalg.pinv(np.concatenate([terms.real, terms.imag]), rcond=1e-12 if double else 1e-5)


FactoredMap: TypeAlias = tuple[Float[Array, "rows modes"], Float[Array, "modes parts"]]


class TimeConstantGrid(eqx.Module):
    """Time constants, and the least-squares map from a gain at the frequencies `omega` to their weights.

    Of any network of resistances, capacitances and fractional skins the gain is an integral over high-pass terms
    s tau / (1 + s tau), tau > 0 (its distribution of relaxation times). A sum over a grid of tau that is dense in the
    logarithm stands for it in time as in frequency. The weights are linear in the gain, and the time constants depend
    on no parameter. A map goes from real parts, then imaginary ones: the inner matrix's product with them goes into the
    outer one. Multiplied out they would lose the digits that the singular values between them span.
    """

    tau: Float[Array, " terms"]  # s
    omega: Float[Array, " frequencies"]  # rad/s, at which the gain is asked for
    voltage_map: FactoredMap  # for Vsc / V and Vgap / V
    limited_current_map: FactoredMap  # for I / V where a resistance limits it: the misfit counts in proportion to omega
    unlimited_current_map: FactoredMap  # where none does; with one row more, for the term that follows dV/dt

    @classmethod
    def from_frequency_range(cls, slowest: float, fastest: float, per_decade: int = 10, margin: float = 10.0) -> Self:
        """For a gain from `slowest` to `fastest` (rad/s), `margin` times beyond. Call it in double precision."""
        decades = np.log10(fastest / slowest * margin**2)
        tau = np.geomspace(1.0 / (margin * fastest), margin / slowest, 1 + int(np.ceil(per_decade * decades)))
        omega = np.geomspace(slowest, fastest, 2 * tau.size)
        x = 1j * omega[:, None] * tau
        terms, share = x / (1.0 + x), omega[:, None] / fastest
        voltage, limited = _pseudo_inverse(terms, np.ones_like(share)), _pseudo_inverse(terms, share)
        outer, inner = _pseudo_inverse(np.hstack([terms, 1j * share]), share)
        outer[-1] /= fastest
        return cls(*jax.tree.map(jnp.asarray, (tau, omega, voltage, limited, (outer, inner))))

    def terms(self, channel: Channel, is_limited: bool, gain: Complex[Array, " frequencies"]) -> HighpassTerms:
        """The terms that stand for a channel's `gain` at `omega`; `is_limited`: whether a resistance limits I."""
        current_map = self.limited_current_map if is_limited else self.unlimited_current_map
        outer, inner = current_map if channel == "I" else self.voltage_map
        fitted, size = outer @ (inner @ jnp.concatenate([gain.real, gain.imag])), self.tau.size
        return HighpassTerms(fitted[:size], self.tau, fitted[size] if fitted.size > size else None)


def _pseudo_inverse(terms: np.ndarray, share: np.ndarray, cutoff: float = 1e-13) -> FactoredMap:
    """The pseudo-inverse of what the terms are over `share`, in two factors, without small singular values.

    Those below `cutoff` of the largest are left out, lest large weights cancel.
    """
    scaled = terms / share
    modes, sizes, directions = np.linalg.svd(np.concatenate([scaled.real, scaled.imag]), full_matrices=False)
    kept = sizes > cutoff * sizes[0]
    return directions[kept].T / sizes[kept], modes[:, kept].T / np.tile(share[:, 0], 2)


class WithSkin(Circuit):
    """A circuit whose skins, the touching and the grounding one, follow a level.

    Attributes:
        circuit: final, direct or natural ground, with the constant values that the level refers to.
        skin: `Dispersive` or `Fractional`.
        grid: time constants to follow a fractional skin by; None: it has harmonics only.
    """

    circuit: RC
    skin: SkinModel
    grid: TimeConstantGrid | None = None

    @property
    def g(self) -> ArrayLike:
        """The divider that the constant values have."""
        return self.circuit.g

    @property
    def b(self) -> ArrayLike:
        """The slowest time constant that the constant values have, s."""
        return self.circuit.b

    def circuit_at_frequency(self, frequency: ArrayLike) -> Circuit:
        """The circuit with R(f), C(f) of `frequency` (Hz), which at this frequency is this one."""
        skin = self.skin.parallel_rc(Element(self.circuit.Rsc, self.circuit.Csc), frequency)
        changed = {"Rsc": skin.R, "Csc": skin.C}
        if isinstance(self.circuit, DirectGround):
            _, grounding = self.circuit.body()
            skin = self.skin.parallel_rc(grounding, frequency)
            changed |= {"grounding_Rsc": skin.R, "grounding_Csc": skin.C}
        return dataclasses.replace(self.circuit, **changed)

    def channel_terms(self, channel: Channel) -> HighpassTerms:
        """The grid's time constants with their weights; raises where there is no grid."""
        if self.grid is not None:
            return self.grid.terms(channel, limits_current(self.circuit), self.channel_gain(channel, self.grid.omega))
        raise InputError(
            f"a {type(self.skin).__name__.lower()} skin has no finite set of time constants; ask for the steady"
            " state of a periodic drive (response) or for harmonics (harmonic_response)"
        )

    def channel_gain(self, channel: Channel, omega: ArrayLike) -> Complex[Array, "*shape"]:
        """A channel over V at the angular frequency `omega` (rad/s, >= 0)."""

        def gain(w: Array) -> Array:
            return self.circuit_at_frequency(w / (2.0 * np.pi)).channel_gain(channel, w)

        return jnp.vectorize(gain)(jnp.asarray(omega, dtype=float))


def constant_skin_circuit(circuit: Circuit) -> Circuit:
    """The circuit with constant skins that a level refers to; one without a level, as it is."""
    return circuit.circuit if isinstance(circuit, WithSkin) else circuit


def limits_current(circuit: Circuit) -> bool:
    """Whether a resistance is in series with the insulator; without one the current follows dV/dt."""
    inner = constant_skin_circuit(circuit)
    return isinstance(inner, Loop) and inner.resistance() is not None


def has_time_constants(circuit: Circuit) -> bool:
    """Whether finitely many stand for it, its own or a grid's."""
    return not isinstance(circuit, WithSkin) or circuit.grid is not None


def circuit_parameters(circuit: Circuit) -> dict[str, Any]:
    """Parameters of a circuit, known or unknown, by name: its fields, and the exponent of a fractional skin."""
    inner = constant_skin_circuit(circuit)
    values = {field.name: getattr(inner, field.name) for field in dataclasses.fields(inner) if field.name != "probe"}
    if isinstance(circuit, WithSkin) and isinstance(circuit.skin, Fractional):
        values["alpha"] = circuit.skin.alpha
    return values


def with_values(circuit: Circuit, values: Mapping[str, ArrayLike]) -> Circuit:
    """The circuit with other values of its `parameters`."""
    if not isinstance(circuit, WithSkin):
        return dataclasses.replace(circuit, **values)
    inner, skin = dict(values), circuit.skin
    if isinstance(skin, Fractional):
        skin = dataclasses.replace(skin, alpha=inner.pop("alpha", skin.alpha))
    return dataclasses.replace(circuit, circuit=dataclasses.replace(circuit.circuit, **inner), skin=skin)


class SeriesElement(NamedTuple):
    """A resistance (ohm) in series with a capacitance (F)."""

    Rx: Float[Array, "*shape"]
    Cx: Float[Array, "*shape"]


def series_equivalent(Rsc: ArrayLike, Csc: ArrayLike, frequency: ArrayLike) -> SeriesElement:
    """Rx (ohm) and Cx (F) that in series are Rsc‖Csc at `frequency` (Hz, > 0), eqs. (10)-(13).

    Of two equal skins in series Rx' = 2 Rx, eq. (14), and Cx' = Cx / 2.
    """
    q = quality_factor(Rsc, Csc, frequency)
    below = q <= 1.0
    small, inverse = jnp.where(below, q, 1.0), 1.0 / jnp.where(below, 1.0, q)
    # 1 / (1 + q^2) and 1 + q^-2, without the square of what is large
    Rx = Rsc * jnp.where(below, 1.0 / (1.0 + small**2), inverse**2 / (1.0 + inverse**2))
    # C (1 + q^-2), where q is small as 1 / (w^2 R^2 C) + C
    wR = 2.0 * np.pi * jnp.asarray(frequency, dtype=float) * Rsc
    Cx = Csc + jnp.where(below, 1.0 / (jnp.where(below, wR, 1.0) * small), Csc * inverse**2)
    return SeriesElement(Rx, Cx)


def quality_factor(
    Rsc: ArrayLike, Csc: ArrayLike, frequency: ArrayLike, R_H: ArrayLike = 0.0
) -> Float[Array, "*shape"]:
    """Q of two equal skins in series with `R_H` (ohm) at `frequency` (Hz), eqs. (15)-(17).

    Without R_H it is that of one skin, w Rsc Csc; with it Xx' / (Rx' + R_H) = q / (1 + (1 + q^2) R_H / (2 Rsc)).
    """
    q = 2.0 * np.pi * jnp.asarray(frequency, dtype=float) * (jnp.asarray(Rsc) * Csc)
    share = 0.5 * jnp.asarray(R_H) / Rsc
    return q / (1.0 + share + (q * share) * q)
