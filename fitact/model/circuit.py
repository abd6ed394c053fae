"""Equivalent circuits of a finger on an electrostatic display, as a few first-order high-pass filters.

An RC circuit has simple, real, negative poles, so the transfer function from the drive to the skin
voltage is, exactly,

    H(s) = sum_k weight_k  s tau_k / (1 + s tau_k),

The admittance has the same form, plus a term s C if no resistance limits the current. The time response
follows from these terms (`response.py`). The terms are high-pass, not low-pass, because the insulator
blocks direct current: a sum of low-pass terms would need a constant that cancels at zero frequency.

All circuits here are one loop of the drive, the insulator Ci, optionally a resistance R0, and parallel
elements R‖C, one of which may be an interface gap. Scaled by square roots, the equations have a symmetric
matrix whose eigenvalues are the time constants. The eigenvalues remain distinct if two elements are equal:
the mode that these share then has weight zero.
"""

from typing import Literal, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Complex, Float

from fitact.errors import InputError

FINGER_PARAMETERS = ("Rsc", "Csc", "Ci")  # of every circuit
# Vgap is not recorded, but the force may come from it; Ft is no voltage or current of the circuit
Channel: TypeAlias = Literal["Vsc", "I", "Vgap", "Ft"]


class HighpassTerms(NamedTuple):
    """sum_k weight[k] s tau[k] / (1 + s tau[k]) + rate s."""

    weight: tuple[ArrayLike, ...] | Array
    tau: tuple[ArrayLike, ...] | Array  # s
    rate: ArrayLike | None = None  # s times the weight's unit; None means no such term

    def stack(self) -> tuple[Array, Array]:
        """Return the weights and the time constants as arrays."""
        weight, tau = (
            jnp.stack(jnp.broadcast_arrays(*map(jnp.asarray, x))) if isinstance(x, tuple) else x
            for x in (self.weight, self.tau)
        )
        return weight, tau


class Circuit(eqx.Module):
    """A circuit, described by the high-pass terms of its transfer functions."""

    @property
    def g(self) -> ArrayLike:
        """Capacitive divider ratio: the jump of Vsc over the jump of V, without resistance in the loop."""
        raise NotImplementedError

    @property
    def b(self) -> ArrayLike:
        """Slowest time constant, s."""
        return self.terms().tau[0]

    def channel_terms(self, channel: Channel) -> HighpassTerms:
        """Return the high-pass terms of a channel over V, i.e. `terms`, `current_terms` or `gap_terms`."""
        raise NotImplementedError

    def channel_gain(self, channel: Channel, omega: ArrayLike) -> Complex[Array, "*shape"]:
        """Return the ratio of a channel to V at the angular frequency `omega` (rad/s, >= 0)."""
        return gain_at(self.channel_terms(channel), omega)

    def terms(self) -> HighpassTerms:
        """Return the high-pass terms of Vsc / V, one for each element, plus one with a resistance in the loop."""
        return self.channel_terms("Vsc")

    def current_terms(self) -> HighpassTerms:
        """Return the high-pass terms of I / V in siemens; `rate` (F) is the coefficient of dV/dt."""
        return self.channel_terms("I")

    def gap_terms(self) -> HighpassTerms:
        """Return the high-pass terms of Vgap / V, where Vgap is the voltage across the gap between finger and panel.

        A non-conducting gap adds one term that is so slow that the gap keeps its charge.

        Raises:
            InputError: the circuit has no gap.
        """
        return self.channel_terms("Vgap")

    def _gap_missing(self) -> InputError:
        return InputError(f"this {type(self).__name__} has no gap between finger and panel; Vgap needs Cgap")

    def transfer_function(self, omega: ArrayLike) -> Complex[Array, "*shape"]:
        """Return Vsc / V at the angular frequency `omega` (rad/s, >= 0)."""
        return self.channel_gain("Vsc", omega)

    def admittance(self, omega: ArrayLike) -> Complex[Array, "*shape"]:
        """Return I / V in siemens at the angular frequency `omega` (rad/s, >= 0)."""
        return self.channel_gain("I", omega)

    def gap_transfer_function(self, omega: ArrayLike) -> Complex[Array, "*shape"]:
        """Return Vgap / V at the angular frequency `omega` (rad/s, >= 0); see `gap_terms`."""
        return self.channel_gain("Vgap", omega)

    def amplitude(self, omega: ArrayLike) -> Float[Array, "*shape"]:
        """Return |Vsc / V| at the angular frequency `omega` (rad/s, >= 0), eq. (25)."""
        gain, size = _normalize_magnitude(self.transfer_function(omega))
        return size * jnp.sqrt(gain.real**2 + gain.imag**2)

    def phase(self, omega: ArrayLike) -> Float[Array, "*shape"]:
        """Return the phase lead (rad) of Vsc over V at `omega` (rad/s, >= 0), eq. (26); pi/2 where Vsc / V is 0."""
        gain, size = _normalize_magnitude(self.transfer_function(omega))
        return jnp.where(size > 0.0, jnp.arctan2(gain.imag, gain.real), 0.5 * np.pi)


def _normalize_magnitude(gain: Array) -> tuple[Array, Array]:
    """Return the gain over its magnitude (1 for 0), and the magnitude, so that no square under- or overflows."""
    size = lax.stop_gradient(jnp.maximum(jnp.abs(gain.real), jnp.abs(gain.imag)))
    some = size > 0.0
    return jnp.where(some, gain / jnp.where(some, size, 1.0), 1.0), size


class FinalCircuit(Circuit):
    """Final circuit of the reference paper (Fig. 11): two equal skin layers Rsc‖Csc in series with Ci.

    H(s) = a s / (1 + b s) with a = Rsc Ci and b = Rsc (2 Ci + Csc), eqs. (20)-(21).

    Attributes:
        Rsc: resistance of one skin layer, ohm.
        Csc: capacitance of one skin layer, F.
        Ci: capacitance of the insulator, F.
    """

    Rsc: ArrayLike
    Csc: ArrayLike
    Ci: ArrayLike

    @property
    def g(self) -> ArrayLike:
        """High-frequency gain a / b = Ci / (2 Ci + Csc), at most 1/2."""
        Csc, Ci = jnp.asarray(self.Csc, dtype=float), jnp.asarray(self.Ci, dtype=float)
        # dividing the smaller by the larger avoids cancellation in log-derivatives, and NaN from overflow
        is_smaller = Csc <= Ci
        skin = jnp.where(is_smaller, Csc, 0.0) / jnp.where(is_smaller, Ci, 1.0)
        insulator = jnp.where(is_smaller, 0.0, Ci) / jnp.where(is_smaller, 1.0, Csc)
        return jnp.where(is_smaller, 1.0 / (2.0 + skin), insulator / (1.0 + 2.0 * insulator))

    @property
    def b(self) -> ArrayLike:
        """Time constant Rsc (2 Ci + Csc), s."""
        return self.Rsc * (2.0 * self.Ci + self.Csc)

    def channel_terms(self, channel: Channel) -> HighpassTerms:
        """Return one term with time constant b; the weight for Vsc is g, and I has a term in dV/dt."""
        if channel == "Vsc":
            return HighpassTerms((self.g,), (self.b,))
        if channel == "I":  # g s (1 + s Rsc Csc) / Rsc, split into a high-pass of b and its limit at high frequency
            return HighpassTerms((2.0 * self.g * self.g / self.Rsc,), (self.b,), self.g * self.Csc)
        raise self._gap_missing()

    def amplitude(self, omega: ArrayLike) -> Float[Array, "*shape"]:
        """Return |Vsc / V| at the angular frequency `omega` (rad/s, >= 0), eq. (25)."""
        return self.g * highpass_amplitude(jnp.asarray(omega) * self.b)

    def phase(self, omega: ArrayLike) -> Float[Array, "*shape"]:
        """Return the phase lead (rad) of Vsc over V at the angular frequency `omega` (rad/s, >= 0), eq. (26)."""
        return jnp.arctan2(1.0, jnp.asarray(omega) * self.b)


class Element(NamedTuple):
    """A resistance (ohm) with a capacitance (F) in parallel."""

    R: ArrayLike
    C: ArrayLike


class _Modes(NamedTuple):
    """Time constants, their weights in the element voltages and in the current, and the rate of the current (F)."""

    tau: Array
    voltages: Float[Array, "elements modes"]
    current: Array
    rate: ArrayLike | None = None


class Loop(Circuit):
    """Loop of Ci, parallel elements, and optionally a gap and a resistance; Vsc is across the first element."""

    Rsc: ArrayLike  # the touching skin, ohm
    Csc: ArrayLike  # F
    Ci: ArrayLike  # the insulator, F
    # the interface gap between finger and panel. Source: Shultz, Peshkin, Colgate, Haptics Symposium 2018
    Rgap: ArrayLike | None = eqx.field(default=None, kw_only=True)  # ohm, larger while sliding; None: non-conducting
    Cgap: ArrayLike | None = eqx.field(default=None, kw_only=True)  # F, in parallel with Rgap; None: no gap

    def __check_init__(self) -> None:
        if self.Rgap is not None and self.Cgap is None:
            raise InputError("Rgap is given without Cgap; give both, or Cgap alone")

    def insulator(self) -> ArrayLike:
        """Return the capacitance of Ci in series with a non-conducting gap, F."""
        return self.Ci if self.Cgap is None or self.Rgap is not None else self._gap_fraction() * self.Cgap

    def resistance(self) -> ArrayLike | None:
        """Return the resistance in the loop, ohm, or None."""
        raise NotImplementedError

    def body(self) -> tuple[Element, ...]:
        """Return the parallel elements of skins and body, the touching skin first."""
        raise NotImplementedError

    def elements(self) -> tuple[Element, ...]:
        """Return the elements of the body, followed by a conducting gap."""
        if self.Rgap is None or self.Cgap is None:
            return self.body()
        return (*self.body(), Element(self.Rgap, self.Cgap))

    @property
    def g(self) -> ArrayLike:
        """Capacitive divider ratio: the jump of Vsc over the jump of V, without resistance in the loop."""
        ratios = [self.insulator() / C for _, C in self.elements()]
        return ratios[0] / (1.0 + sum(ratios))

    def channel_gain(self, channel: Channel, omega: ArrayLike) -> Complex[Array, "*shape"]:
        """Return the ratio of a channel to V at `omega` (rad/s, >= 0), from impedances, which keep all digits."""
        ratios = self._impedance_ratios(omega)
        if channel == "Vsc":
            return ratios[0] / (1.0 + sum(ratios))
        if channel == "I":
            return 1j * jnp.asarray(omega) * self.insulator() / (1.0 + sum(ratios))
        gap = self._gap_fraction() if self.Rgap is None else ratios[len(self.elements()) - 1]
        return gap / (1.0 + sum(ratios))

    def _impedance_ratios(self, omega: ArrayLike) -> list[Array]:
        """Return the loop's impedances over the insulator's, touching skin first; their real parts are >= 0."""
        charging = jnp.asarray(omega) * self.insulator()
        ratios = []
        for R, C in self.elements():
            x = jnp.asarray(omega) * R * C
            ratios.append(charging * R / (1.0 + x**2) * (x + 1j))
        R0 = self.resistance()
        return ratios if R0 is None else [*ratios, 1j * charging * R0]

    def channel_terms(self, channel: Channel) -> HighpassTerms:
        """Return as many terms for each channel, but one more with a non-conducting gap; I may have a rate."""
        tau, voltages, current, rate = self._modes()
        if channel == "I":
            return HighpassTerms(tuple(current), tuple(tau), rate)
        if channel == "Vsc":
            return HighpassTerms(tuple(voltages[0]), tuple(tau))
        if self.Rgap is not None:
            return HighpassTerms(tuple(voltages[-1]), tuple(tau))
        share, R0 = self._gap_fraction(), self.resistance()
        others = jnp.sum(voltages, axis=0) + (0.0 if R0 is None else R0 * current)
        # the last is so long that an open gap keeps its charge
        return HighpassTerms((*(-share * others), share), (*tau, 1e15 * tau[0]))

    def _gap_fraction(self) -> ArrayLike:
        """Return the fraction of the voltage across Ci and a non-conducting gap that is across the gap."""
        if self.Cgap is None:
            raise self._gap_missing()
        return self.Ci / (self.Ci + jnp.asarray(self.Cgap))

    def _modes(self) -> _Modes:
        Ci, R0 = self.insulator(), self.resistance()
        R, C = (jnp.stack(jnp.broadcast_arrays(*x)) for x in zip(*self.elements(), strict=True))
        C = jnp.maximum(C, 1e-12 * Ci)  # a skin without capacitance gets this one, so that its time constant is not 0
        return _modes_without_resistance(Ci, R, C) if R0 is None else _modes_with_resistance(Ci, R0, R, C)


def _modes_without_resistance(Ci: ArrayLike, R: Array, C: Array) -> _Modes:
    """Solve T x' + x = Ci sqrt(R) V',  T = diag(R C) + Ci sqrt(R) sqrt(R)^T,  with x = v / sqrt(R)."""
    root = jnp.sqrt(R)
    tau, modes = _gram_eigenmodes(jnp.vstack([jnp.diag(jnp.sqrt(R * C)), jnp.sqrt(Ci) * root]))
    drive = Ci * (modes.T @ root) / tau
    rate = Ci
    for capacitance in C:
        rate = rate * (capacitance / (rate + capacitance))
    return _Modes(tau, root[:, None] * modes * drive, drive**2, rate)


def _modes_with_resistance(Ci: ArrayLike, R0: ArrayLike, R: Array, C: Array) -> _Modes:
    """Solve T x' + x = sqrt(Ci) V e_i,  T = sqrt(C) P sqrt(C),  with x = sqrt(C) v over the elements and Ci.

    P holds the resistance between the terminals of each capacitor: its own R, and for Ci that of the whole loop.
    """
    root = jnp.sqrt(jnp.append(C, Ci))
    # each row is the current of one resistance times its square root
    in_elements = jnp.vstack([jnp.diag(root[:-1]), jnp.zeros_like(C)])
    in_Ci = jnp.append(jnp.full_like(R, -1.0), 1.0)[:, None] * root[-1]
    tau, modes = _gram_eigenmodes(jnp.sqrt(jnp.append(R, R0))[:, None] * jnp.hstack([in_elements, in_Ci]))
    voltages = -modes[:-1] * modes[-1] * (root[-1] / root[:-1, None])
    return _Modes(tau, voltages, Ci * modes[-1] ** 2 / tau)


@jax.custom_jvp
def _gram_eigenmodes(factor: Array) -> tuple[Array, Array]:
    """Return eigenvalues and eigenvectors of factor^T factor; using the factor doubles the digits of small ones."""
    _, sigma, modes = jnp.linalg.svd(factor, full_matrices=False)
    return sigma * sigma, modes.T


@_gram_eigenmodes.defjvp
def _gram_eigenmodes_jvp(
    primals: tuple[Array], tangents: tuple[Array]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return the derivative of the singular value decomposition, finite also where modes differ only by rounding.

    Such modes have one time constant, and only their sum matters, which is invariant under their rotation.
    """
    left, sigma, right = jnp.linalg.svd(primals[0], full_matrices=False)
    modes, slope = right.T, left.T @ tangents[0] @ right.T
    gaps = sigma - sigma[:, None]
    distinct = jnp.abs(gaps) > 4.0 * jnp.finfo(sigma.dtype).eps * sigma[0]  # equal ones differ by rounding
    turn = jnp.where(distinct, 1.0 / jnp.where(distinct, gaps * (sigma + sigma[:, None]), 1.0), 0.0)
    scaled = sigma[:, None] * slope
    changes = 2.0 * sigma * jnp.diagonal(slope), modes @ (turn * (scaled + scaled.T))
    return (sigma * sigma, modes), changes


class Probe(eqx.Module):
    """Load of a voltage probe on the touching skin, R‖C (ohm, F; R may be infinite)."""

    R: ArrayLike
    C: ArrayLike

    def load_skin(self, circuit: Loop) -> Element:
        """Return the circuit's touching skin with the probe in parallel."""
        return Element(1.0 / (1.0 / jnp.asarray(circuit.Rsc) + 1.0 / self.R), circuit.Csc + jnp.asarray(self.C))


class DirectGround(Loop):
    """Direct ground (Fig. 3a): touching skin, R_H and grounding skin in series with Ci, eq. (5).

    With equal skins and R_H this is the simplified circuit of the reference paper (Fig. 7).

    Attributes:
        Rsc, Csc: the touching skin, ohm and F.
        Ci: the insulator, F.
        R_H: internal resistance of the body, ohm; None omits it.
        grounding_Rsc, grounding_Csc: the grounding skin; None means equal to the touching one.
        series_resistor: a known resistor in series, ohm, or None.
        probe: the load across the touching skin; None means an ideal probe.
        Rgap, Cgap: the interface gap, ohm and F, keyword-only; None means no gap (see `Loop`).
    """

    R_H: ArrayLike | None = None
    grounding_Rsc: ArrayLike | None = None
    grounding_Csc: ArrayLike | None = None
    series_resistor: ArrayLike | None = None
    probe: Probe | None = None

    def resistance(self) -> ArrayLike | None:
        """Return the sum of R_H and the series resistor, ohm."""
        return _series_resistance(self.R_H, self.series_resistor)

    def body(self) -> tuple[Element, ...]:
        """Return the touching skin (with the probe) and the grounding skin."""
        grounding = Element(
            self.Rsc if self.grounding_Rsc is None else self.grounding_Rsc,
            self.Csc if self.grounding_Csc is None else self.grounding_Csc,
        )
        return Element(self.Rsc, self.Csc) if self.probe is None else self.probe.load_skin(self), grounding


class NaturalGround(Loop):
    """Natural ground (Fig. 3b): touching skin and environment Z in series with Ci, eq. (6).

    Attributes:
        Rsc, Csc: the touching skin, ohm and F.
        Ci: the insulator, F.
        Z: resistance to earth through shoes or chair, ohm; None means that the body is at earth potential.
        Z_capacitance: capacitance in parallel with Z, F; None means that Z is a resistance.
        series_resistor: a known resistor in series, ohm, or None.
        probe: the load across the touching skin; None means an ideal probe.
        Rgap, Cgap: the interface gap, ohm and F, keyword-only; None means no gap (see `Loop`).
    """

    Z: ArrayLike | None
    Z_capacitance: ArrayLike | None = None
    series_resistor: ArrayLike | None = None
    probe: Probe | None = None

    def resistance(self) -> ArrayLike | None:
        """Return the series resistor, plus Z if it has no capacitance, ohm."""
        return _series_resistance(self.Z if self.Z_capacitance is None else None, self.series_resistor)

    def body(self) -> tuple[Element, ...]:
        """Return the touching skin (with the probe), and Z if it has a capacitance."""
        touching = Element(self.Rsc, self.Csc) if self.probe is None else self.probe.load_skin(self)
        return (touching,) if self.Z_capacitance is None else (touching, Element(self.Z, self.Z_capacitance))


RC: TypeAlias = FinalCircuit | DirectGround | NaturalGround  # circuits with constant skins, which can be fitted


def _series_resistance(*resistances: ArrayLike | None) -> ArrayLike | None:
    stated = [jnp.asarray(r) for r in resistances if r is not None]
    return sum(stated[1:], stated[0]) if stated else None


def gain_at(terms: HighpassTerms, omega: ArrayLike) -> Complex[Array, "*shape"]:
    """Return the sum of `terms` at s = j omega (rad/s, >= 0)."""
    omega = jnp.asarray(omega)
    total = jnp.zeros_like(omega, dtype=complex) if terms.rate is None else 1j * omega * terms.rate
    for weight, tau in zip(terms.weight, terms.tau, strict=True):
        total = total + weight * highpass_gain(omega * tau)
    return total


def highpass_gain(x: ArrayLike) -> Complex[Array, "*shape"]:
    """Return j x / (1 + j x) for x >= 0, without overflow at either end."""
    is_small, small, inverse = _split_range(x)
    low = small / (1.0 + small**2)  # (x^2 + j x) / (1 + x^2)
    high = 1.0 / (1.0 + inverse**2)
    return jnp.where(is_small, low * small + 1j * low, high + 1j * high * inverse)


def highpass_amplitude(x: ArrayLike) -> Float[Array, "*shape"]:
    """Return |j x / (1 + j x)| for x >= 0, in forms whose derivatives do not cancel."""
    is_small, small, inverse = _split_range(x)
    return jnp.where(is_small, small / jnp.sqrt(1.0 + small**2), 1.0 / jnp.sqrt(1.0 + inverse**2))


def _split_range(x: ArrayLike) -> tuple[Array, Array, Array]:
    """Return whether x <= 1, x where it is (else 1), and 1/x where it is not (else 1); the 1s keep gradients finite."""
    x = jnp.asarray(x)
    is_small = x <= 1.0
    return is_small, jnp.where(is_small, x, 1.0), 1.0 / jnp.where(is_small, 1.0, x)
