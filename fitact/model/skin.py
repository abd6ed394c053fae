"""Skin models: resistance and capacitance of a skin layer as functions of frequency.

At each frequency any linear skin is a resistance and a capacitance in parallel, so a skin model maps the constant
Rsc, Csc and the frequency to R(f), C(f). `WithSkin` adds a skin model to a circuit; other circuits have a constant
skin. A frequency-dependent skin has no finite set of time constants, so its steady state is computed harmonic by
harmonic. A fractional skin is causal, so a grid of time constants can represent it for any drive.
The last functions give the series equivalents of a constant skin, and their quality factor (reference paper).
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
from fitact.model.circuit import (
    FINGER_PARAMETERS,
    RC,
    Channel,
    Circuit,
    DirectGround,
    Element,
    FinalCircuit,
    HighpassTerms,
    Loop,
    Probe,
    passes_direct_current,
)

# section 3.1 of the reference paper, with its Rsc, Csc at 100 Hz
_FREQUENCY = np.array([10.0, 100.0, 1000.0])  # Hz
_RESISTANCE = np.array([200.0, 160.0, 80.0]) / 160.0
_CAPACITANCE = np.array([44.25, 22.0, 8.85]) / 22.0

MAX_DISPERSION_FREQUENCY = float(_FREQUENCY[-1])  # Hz; a dispersive skin is constant above


class SkinModel(eqx.Module):
    """A skin model: R(f) and C(f), and the division of the steady state into harmonics and time constants."""

    def parallel_rc(self, skin: Element, frequency: ArrayLike) -> Element:
        """Return R(f) and C(f) at `frequency` (Hz, >= 0) of a skin with the constant values `skin`."""
        raise NotImplementedError

    def harmonic_count(self, frequency: ArrayLike) -> int:
        """Return the number of single harmonics of `frequency` (Hz); `high_frequency_terms` cover higher ones."""
        raise NotImplementedError

    def high_frequency_terms(self, circuit: "WithSkin", omega: ArrayLike, channel: Channel) -> HighpassTerms:
        """Return high-pass terms that represent `circuit` at and above the angular frequency `omega` (rad/s)."""
        raise NotImplementedError


class Dispersive(SkinModel):
    """Skin of the reference paper (section 3.1): 200, 160, 80 kohm and 44.25, 22, 8.85 nF at 10, 100, 1000 Hz.

    The values are used as factors on Rsc and Csc of the circuit, which therefore apply at 100 Hz. Between the three
    frequencies, R and C are powers of the frequency (linear in log-log, monotone; three points do not determine a
    curvature). Below 10 Hz and above 1000 Hz, where the paper gives no values, R and C are constant.

    Attributes:
        harmonics: number of harmonics below 1000 Hz, or more; None means that the drive's frequency gives it, which
            fails if this frequency is traced.
    """

    harmonics: int | None = eqx.field(static=True, default=None)

    def parallel_rc(self, skin: Element, frequency: ArrayLike) -> Element:
        """Return R(f) and C(f)."""
        where = jnp.log(jnp.clip(jnp.asarray(frequency, dtype=float), _FREQUENCY[0], _FREQUENCY[-1]))
        knots = np.log(_FREQUENCY)
        return Element(
            skin.R * jnp.exp(jnp.interp(where, knots, np.log(_RESISTANCE))),
            skin.C * jnp.exp(jnp.interp(where, knots, np.log(_CAPACITANCE))),
        )

    def harmonic_count(self, frequency: ArrayLike) -> int:
        """Return the number of harmonics below 1000 Hz."""
        if self.harmonics is not None:
            return self.harmonics
        try:
            return int(_FREQUENCY[-1] / float(frequency))
        except jax.errors.ConcretizationTypeError:
            raise InputError(
                "the drive's frequency is traced, so the harmonics below 1000 Hz cannot be counted;"
                " give an upper limit: Dispersive(harmonics=...)"
            ) from None

    def high_frequency_terms(self, circuit: "WithSkin", omega: ArrayLike, channel: Channel) -> HighpassTerms:
        """Return the terms of the constant skin above 1000 Hz, which are exact."""
        return circuit.circuit_at_frequency(_FREQUENCY[-1]).channel_terms(channel)


class Fractional(SkinModel):
    """A constant-phase element in parallel with a resistance (Cole): Z = Rsc / (1 + (j w Rsc Csc)^alpha).

    `alpha` = 1 is the constant skin. At zero frequency C(f) has no limit, but also no effect, so the constant
    value is used there.

    A response sums the first `harmonics` and fits time constants to the rest, up to frequencies 1e8 times higher.
    Measured rms difference between 128 and 1024 harmonics, relative to the rms of the response: 3e-8 for Vsc with
    the values of the reference paper, 1e-5 for a current limited by R_H = 500 ohm; 5e-5 of the peak in float32.
    Exactly at an ideal jump, Vsc depends on the highest of these frequencies (at alpha = 1, within 5e-7 of the peak).

    Attributes:
        alpha: exponent, 0 < alpha <= 1. The default is not a measured value; use the value of your skin.
        harmonics: number of harmonics that a response sums.
    """

    alpha: ArrayLike = 0.8
    harmonics: int = eqx.field(static=True, default=128)

    def parallel_rc(self, skin: Element, frequency: ArrayLike) -> Element:
        """Return R(f) = 1 / Re(1/Z), C(f) = Im(1/Z) / w."""
        x = 2.0 * np.pi * jnp.asarray(frequency, dtype=float) * (jnp.asarray(skin.R) * skin.C)
        alpha = jnp.asarray(self.alpha)
        # from 2 on the impedance would change its sign, so a fit must not step there
        alpha = jnp.where(alpha < 2.0, alpha, jnp.nan)
        power = jnp.where(x > 0.0, jnp.exp((alpha - 1.0) * jnp.log(jnp.where(x > 0.0, x, 1.0))), 1.0)
        angle = 0.5 * np.pi * (1.0 - alpha)  # from 1 - alpha, so that it is exactly 0 at alpha = 1
        return Element(skin.R / (1.0 + x * power * jnp.sin(angle)), skin.C * power * jnp.cos(angle))

    def harmonic_count(self, frequency: ArrayLike) -> int:
        """Return `harmonics`."""
        return self.harmonics

    def high_frequency_terms(self, circuit: "WithSkin", omega: ArrayLike, channel: Channel) -> HighpassTerms:
        """Return time constants on a logarithmic grid above `omega`, with weights fitted by least squares."""
        limited = channel != "I" or limits_current(circuit.circuit)
        omega = jnp.asarray(omega, dtype=float)
        tau, x, weights = high_frequency_basis(limited, omega.dtype == jnp.float64)
        gain = circuit.channel_gain(channel, omega * x)
        gain = gain if limited else gain / x
        weight = jnp.dot(weights, jnp.concatenate([gain.real, gain.imag]), precision="highest")
        # an unlimited current still grows at the highest fitted frequency, so it has no value at a jump
        return HighpassTerms(tuple(weight), tuple(tau / omega), None if limited else 0.0)


@functools.cache
def high_frequency_basis(is_limited: bool, double: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return time constants, frequencies (over omega) and the least-squares map from the gain to the weights.

    The fit minimises the absolute error of a limited gain, and the relative error of a gain that grows with the
    frequency. The map omits singular values below the precision, which would produce large cancelling weights.
    """
    decades, per_decade = 8, 6
    tau = np.logspace(-decades - 1.0, 1.0, per_decade * (decades + 2) + 1)
    x = np.logspace(0.0, decades, 4 * per_decade * decades + 1)
    terms = 1j * x[:, None] * tau / (1.0 + 1j * x[:, None] * tau)
    if not is_limited:
        terms = terms / x[:, None]
    return tau, x, np.linalg.pinv(np.concatenate([terms.real, terms.imag]), rcond=1e-12 if double else 1e-5)


FactoredMap: TypeAlias = tuple[Float[Array, "rows modes"], Float[Array, "modes parts"]]


class TimeConstantGrid(eqx.Module):
    """Time constants, and the least-squares map from a gain at the frequencies `omega` to their weights.

    The gain of any network of resistances, capacitances and fractional skins is an integral over high-pass terms
    s tau / (1 + s tau), tau > 0 (its distribution of relaxation times). A sum over a grid of tau that is dense in
    log tau approximates it, both in time and in frequency. The weights are linear in the gain, and the time constants
    depend on no parameter. A map applies an inner and then an outer matrix to the real parts followed by the imaginary
    parts. The product of the two matrices would lose the digits that the range of their singular values spans.
    """

    tau: Float[Array, " terms"]  # s
    omega: Float[Array, " frequencies"]  # rad/s, where the gain is evaluated
    voltage_map: FactoredMap  # for Vsc / V and Vgap / V
    limited_current_map: FactoredMap  # for I / V limited by a resistance; minimises the misfit times omega
    unlimited_current_map: FactoredMap  # for unlimited I / V; one more row for the term in dV/dt

    @classmethod
    @functools.lru_cache(maxsize=16)  # the records of a campaign share one
    def from_frequency_range(cls, slowest: float, fastest: float, per_decade: int = 10, margin: float = 10.0) -> Self:
        """Return a grid from `slowest` to `fastest` (rad/s), extended by the factor `margin`. Use double precision."""
        decades = np.log10(fastest / slowest * margin**2)
        tau = np.geomspace(1.0 / (margin * fastest), margin / slowest, 1 + int(np.ceil(per_decade * decades)))
        omega = np.geomspace(slowest, fastest, 2 * tau.size)
        x = 1j * omega[:, None] * tau
        terms, share = x / (1.0 + x), omega[:, None] / fastest
        voltage, limited = _pseudo_inverse(terms, np.ones_like(share)), _pseudo_inverse(terms, share)
        outer, inner = _pseudo_inverse(np.hstack([terms, 1j * share]), share)
        outer[-1] /= fastest
        return cls(*jax.tree.map(np.asarray, (tau, omega, voltage, limited, (outer, inner))))

    def terms(self, channel: Channel, is_limited: bool, gain: Complex[Array, " frequencies"]) -> HighpassTerms:
        """Return terms that represent the `gain` of a channel at `omega`; `is_limited`: a resistance limits I."""
        current_map = self.limited_current_map if is_limited else self.unlimited_current_map
        outer, inner = current_map if channel == "I" else self.voltage_map
        fitted, size = outer @ (inner @ jnp.concatenate([gain.real, gain.imag])), self.tau.size
        return HighpassTerms(fitted[:size], self.tau, fitted[size] if fitted.size > size else None)


def _pseudo_inverse(terms: np.ndarray, share: np.ndarray) -> FactoredMap:
    """Return the pseudo-inverse of the terms over `share`, in two factors."""
    scaled = terms / share
    modes, sizes, directions = np.linalg.svd(np.concatenate([scaled.real, scaled.imag]), full_matrices=False)
    kept = sizes > 1e-13 * sizes[0]  # smaller ones would produce large cancelling weights
    return directions[kept].T / sizes[kept], modes[:, kept].T / np.tile(share[:, 0], 2)


class WithSkin(Circuit):
    """A circuit whose touching and grounding skins follow a skin model.

    Attributes:
        circuit: final circuit, direct or natural ground, with the constant values that the skin model scales.
        skin: `Dispersive` or `Fractional`.
        grid: time constants that represent a fractional skin; None means harmonics only.
    """

    circuit: RC
    skin: SkinModel
    grid: TimeConstantGrid | None = None

    def __check_init__(self) -> None:
        if passes_direct_current(self.circuit):
            raise InputError(
                f"a leak of the insulator (Ri) is not modelled with a {type(self.skin).__name__.lower()} skin; use"
                " constant skins, or leave Ri out"
            )

    @property
    def g(self) -> ArrayLike:
        """Capacitive divider ratio of the constant values."""
        return self.circuit.g

    @property
    def b(self) -> ArrayLike:
        """Slowest time constant of the constant values, s."""
        return self.circuit.b

    def circuit_at_frequency(self, frequency: ArrayLike) -> Circuit:
        """Return the circuit with constant skins R(f), C(f), equivalent at `frequency` (Hz)."""
        skin = self.skin.parallel_rc(Element(self.circuit.Rsc, self.circuit.Csc), frequency)
        changed = {"Rsc": skin.R, "Csc": skin.C}
        if isinstance(self.circuit, DirectGround):
            _, grounding = self.circuit.body()
            skin = self.skin.parallel_rc(grounding, frequency)
            changed |= {"grounding_Rsc": skin.R, "grounding_Csc": skin.C}
        return dataclasses.replace(self.circuit, **changed)

    def channel_terms(self, channel: Channel) -> HighpassTerms:
        """Return the time constants of the grid with their weights, or raise InputError without a grid."""
        if self.grid is not None:
            return self.grid.terms(channel, limits_current(self.circuit), self.channel_gain(channel, self.grid.omega))
        raise InputError(
            f"a {type(self.skin).__name__.lower()} skin has no finite set of time constants; use the steady"
            " state of a periodic drive (response) or harmonics (harmonic_response)"
        )

    def channel_gain(self, channel: Channel, omega: ArrayLike) -> Complex[Array, "*shape"]:
        """Return the ratio of a channel to V at the angular frequency `omega` (rad/s, >= 0)."""

        def gain(w: Array) -> Array:
            return self.circuit_at_frequency(w / (2.0 * np.pi)).channel_gain(channel, w)

        return jnp.vectorize(gain)(jnp.asarray(omega, dtype=float))


def constant_skin_circuit(circuit: Circuit) -> Circuit:
    """Return the circuit with constant skins, without its skin model if it has one."""
    return circuit.circuit if isinstance(circuit, WithSkin) else circuit


def limits_current(circuit: Circuit) -> bool:
    """Return whether a resistance is in series with the insulator; otherwise the current follows dV/dt."""
    inner = constant_skin_circuit(circuit)
    return isinstance(inner, Loop) and inner.resistance() is not None


def has_time_constants(circuit: Circuit) -> bool:
    """Return whether the circuit has finitely many time constants, exact or of a grid."""
    return not isinstance(circuit, WithSkin) or circuit.grid is not None


def circuit_parameters(circuit: Circuit) -> dict[str, Any]:
    """Return all parameters of a circuit by name: its fields, and the exponent of a fractional skin."""
    inner = constant_skin_circuit(circuit)
    values = {field.name: getattr(inner, field.name) for field in dataclasses.fields(inner) if field.name != "probe"}
    if isinstance(circuit, WithSkin) and isinstance(circuit.skin, Fractional):
        values["alpha"] = circuit.skin.alpha
    return values


def probe_parameters(circuit: Circuit) -> dict[str, ArrayLike]:
    """Return the parameters of a circuit's probe by name, if it has one."""
    probe = getattr(constant_skin_circuit(circuit), "probe", None)
    return {} if probe is None else {"probe_resistance": probe.R, "probe_capacitance": probe.C}


def with_probe(circuit: Any, probe: Probe | None) -> Any:
    """Return the circuit with another probe; without one, a direct ground of equal skins is a `FinalCircuit`."""
    if isinstance(circuit, WithSkin):
        return dataclasses.replace(circuit, circuit=with_probe(circuit.circuit, probe))
    if probe is None and isinstance(circuit, FinalCircuit):
        return circuit
    changed = dataclasses.replace(circuit, probe=probe)
    extras = [field.name for field in dataclasses.fields(changed) if field.name not in (*FINGER_PARAMETERS, "Ri")]
    if isinstance(changed, DirectGround) and all(getattr(changed, name) is None for name in extras):
        return FinalCircuit(changed.Rsc, changed.Csc, changed.Ci, Ri=changed.Ri)
    return changed


def with_values(circuit: Circuit, values: Mapping[str, ArrayLike]) -> Circuit:
    """Return the circuit with some of its `circuit_parameters` or `probe_parameters` replaced."""
    if known := probe_parameters(circuit):
        R, C = (values.get(name, value) for name, value in known.items())
        circuit = with_probe(circuit, Probe(R, C))
        values = {name: value for name, value in values.items() if name not in known}
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
    """Return Rx (ohm) and Cx (F) in series that equal Rsc‖Csc at `frequency` (Hz, > 0), eqs. (10)-(13).

    Two equal skins in series have Rx' = 2 Rx, eq. (14), and Cx' = Cx / 2.
    """
    q = quality_factor(Rsc, Csc, frequency)
    is_small = q <= 1.0
    small, inverse = jnp.where(is_small, q, 1.0), 1.0 / jnp.where(is_small, 1.0, q)
    # 1 / (1 + q^2) and 1 + q^-2, without squaring a large number
    Rx = Rsc * jnp.where(is_small, 1.0 / (1.0 + small**2), inverse**2 / (1.0 + inverse**2))
    # C (1 + q^-2), computed for small q as 1 / (w^2 R^2 C) + C
    wR = 2.0 * np.pi * jnp.asarray(frequency, dtype=float) * Rsc
    Cx = Csc + jnp.where(is_small, 1.0 / (jnp.where(is_small, wR, 1.0) * small), Csc * inverse**2)
    return SeriesElement(Rx, Cx)


def quality_factor(
    Rsc: ArrayLike, Csc: ArrayLike, frequency: ArrayLike, R_H: ArrayLike = 0.0
) -> Float[Array, "*shape"]:
    """Return Q of two equal skins in series with `R_H` (ohm) at `frequency` (Hz), eqs. (15)-(17).

    Without R_H it equals w Rsc Csc; with R_H it is Xx' / (Rx' + R_H) = q / (1 + (1 + q^2) R_H / (2 Rsc)).
    """
    q = 2.0 * np.pi * jnp.asarray(frequency, dtype=float) * (jnp.asarray(Rsc) * Csc)
    share = 0.5 * jnp.asarray(R_H) / Rsc
    return q / (1.0 + share + (q * share) * q)
