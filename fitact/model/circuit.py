"""Equivalent circuits of a finger on an electrostatic display, as a few first-order high-pass filters.

An RC circuit has simple, real, negative poles, so the transfer function from the drive to the skin
voltage is, exactly,

    H(s) = direct + sum_k weight_k  s tau_k / (1 + s tau_k),

The admittance has the same form, plus a term s C if no resistance limits the current. The time response
follows from these terms (`response.py`). The terms are high-pass, not low-pass, because an insulator without a
leak blocks direct current: a sum of low-pass terms would need a constant that cancels at zero frequency. With
a leak, `direct` is the divider of the resistances.

All circuits here are one loop of the drive, the insulator Ci, optionally with a leak Ri in parallel, optionally a
resistance R0, and parallel elements R‖C, one of which may be an interface gap (`loop_modes.py`).
"""

from typing import Literal, NamedTuple, TypeAlias

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Complex, Float

from fitact.compiled import jit_inline
from fitact.errors import InputError
from fitact.model.loop_modes import HighpassTerms, Modes, modes_with_resistance, modes_without_resistance

FINGER_PARAMETERS = ("Rsc", "Csc", "Ci")  # of every circuit
INFINITE_RATIO = 1e15  # of the time constant that represents an infinite one, to the slowest of the circuit
# Vgap is not recorded, but the force may come from it; Ft is no voltage or current of the circuit
Channel: TypeAlias = Literal["Vsc", "I", "Vgap", "Ft"]


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

    def insulator_terms(self) -> HighpassTerms:
        """Return the high-pass terms of the voltage across the insulator over V; its `direct` is 1 without a leak."""
        raise NotImplementedError

    def transfer_function(self, omega: ArrayLike) -> Complex[Array, "*shape"]:
        """Return Vsc / V at the angular frequency `omega` (rad/s, >= 0)."""
        return self.channel_gain("Vsc", omega)

    def admittance(self, omega: ArrayLike) -> Complex[Array, "*shape"]:
        """Return I / V in siemens at the angular frequency `omega` (rad/s, >= 0)."""
        return self.channel_gain("I", omega)

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


@jit_inline
def _divider(Csc: ArrayLike, Ci: ArrayLike) -> Array:
    """Return Ci / (2 Ci + Csc)."""
    Csc, Ci = jnp.asarray(Csc, dtype=float), jnp.asarray(Ci, dtype=float)
    # dividing the smaller by the larger avoids cancellation in log-derivatives, and NaN from overflow
    is_smaller = Csc <= Ci
    skin = jnp.where(is_smaller, Csc, 0.0) / jnp.where(is_smaller, Ci, 1.0)
    insulator = jnp.where(is_smaller, 0.0, Ci) / jnp.where(is_smaller, 1.0, Csc)
    return jnp.where(is_smaller, 1.0 / (2.0 + skin), insulator / (1.0 + 2.0 * insulator))


class FinalCircuit(Circuit):
    """Final circuit of the reference paper (Fig. 11): two equal skin layers Rsc‖Csc in series with Ci.

    H(s) = a s / (1 + b s) with a = Rsc Ci and b = Rsc (2 Ci + Csc), eqs. (20)-(21). With a leak Ri,
    H(s) = d + (g - d) b s / (1 + b s) with d = Rsc / (2 Rsc + Ri), g = Ci / (2 Ci + Csc) and
    b = Rsc Ri (2 Ci + Csc) / (2 Rsc + Ri).

    Attributes:
        Rsc: resistance of one skin layer, ohm.
        Csc: capacitance of one skin layer, F.
        Ci: capacitance of the insulator, F.
        Ri: leak of the insulator, in parallel with Ci, ohm, keyword-only; None means none.
    """

    Rsc: ArrayLike
    Csc: ArrayLike
    Ci: ArrayLike
    Ri: ArrayLike | None = eqx.field(default=None, kw_only=True)

    @property
    def g(self) -> ArrayLike:
        """High-frequency gain a / b = Ci / (2 Ci + Csc), at most 1/2."""
        return _divider(self.Csc, self.Ci)

    @property
    def b(self) -> ArrayLike:
        """Time constant Rsc (2 Ci + Csc), s; a leak shortens it by the factor 1 + 2 Rsc / Ri."""
        b = self.Rsc * (2.0 * self.Ci + self.Csc)
        return b if self.Ri is None else b / (1.0 + 2.0 * (self.Rsc / jnp.asarray(self.Ri)))

    def channel_gain(self, channel: Channel, omega: ArrayLike) -> Complex[Array, "*shape"]:
        """Return the ratio of a channel to V at `omega` (rad/s, >= 0); with a leak from impedances."""
        leaky = self.Ri is not None and channel != "Vgap"
        return self.as_loop().channel_gain(channel, omega) if leaky else super().channel_gain(channel, omega)

    def channel_terms(self, channel: Channel) -> HighpassTerms:
        """Return one term with time constant b; without a leak the weight for Vsc is g. I has a term in dV/dt."""
        weight, inverse, direct, current = self.g, 1.0 / self.Rsc, None, None
        if self.Ri is not None:
            share = self.Rsc / jnp.asarray(self.Ri)
            direct, growth = 1.0 / (2.0 + self.Ri / jnp.asarray(self.Rsc)), 1.0 + 2.0 * share
            # g - d = (Ri Ci - Rsc Csc) / ((2 Ci + Csc) (2 Rsc + Ri)), whose difference is that of two time constants
            weight = (self.g - share * (self.Csc / (2.0 * self.Ci + jnp.asarray(self.Csc)))) / growth
            inverse, current = growth / self.Rsc, 1.0 / (2.0 * self.Rsc + self.Ri)
        if channel == "Vsc":
            return HighpassTerms((weight,), (self.b,), None, direct)
        if channel == "I":  # Vsc (1 + s Rsc Csc) / Rsc, split into direct, a high-pass of b, and the limit of the rest
            return HighpassTerms((2.0 * weight * weight * inverse,), (self.b,), self.g * self.Csc, current)
        raise self._gap_missing()

    def insulator_terms(self) -> HighpassTerms:
        """Return the terms of the insulator's voltage over V."""
        (weight,), tau, _, direct = self.channel_terms("Vsc")
        return HighpassTerms((-2.0 * weight,), tau, None, 1.0 if direct is None else 1.0 - 2.0 * direct)

    def as_loop(self) -> "DirectGround":
        """Return the same circuit as a direct ground of equal skins."""
        return DirectGround(self.Rsc, self.Csc, self.Ci, Ri=self.Ri)

    def amplitude(self, omega: ArrayLike) -> Float[Array, "*shape"]:
        """Return |Vsc / V| at the angular frequency `omega` (rad/s, >= 0), eq. (25)."""
        if self.Ri is not None:
            return super().amplitude(omega)
        return self.g * highpass_amplitude(jnp.asarray(omega) * self.b)

    def phase(self, omega: ArrayLike) -> Float[Array, "*shape"]:
        """Return the phase lead (rad) of Vsc over V at the angular frequency `omega` (rad/s, >= 0), eq. (26)."""
        if self.Ri is not None:
            return super().phase(omega)
        return jnp.arctan2(1.0, jnp.asarray(omega) * self.b)


class Element(NamedTuple):
    """A resistance (ohm) with a capacitance (F) in parallel."""

    R: ArrayLike
    C: ArrayLike


class Loop(Circuit):
    """Loop of Ci, parallel elements, and optionally a leak, a gap and a resistance; Vsc is across the first element."""

    Rsc: ArrayLike  # the touching skin, ohm
    Csc: ArrayLike  # F
    Ci: ArrayLike  # the insulator, F
    # the interface gap between finger and panel. Source: Shultz, Peshkin, Colgate, Haptics Symposium 2018
    Rgap: ArrayLike | None = eqx.field(default=None, kw_only=True)  # ohm, larger while sliding; None: non-conducting
    Cgap: ArrayLike | None = eqx.field(default=None, kw_only=True)  # F, in parallel with Rgap; None: no gap
    Ri: ArrayLike | None = eqx.field(default=None, kw_only=True)  # leak of the insulator, in parallel with Ci, ohm

    def __check_init__(self) -> None:
        if self.Rgap is not None and self.Cgap is None:
            raise InputError("Rgap is given without Cgap; give both, or Cgap alone")

    @property
    def _has_open_gap(self) -> bool:
        return self.Cgap is not None and self.Rgap is None

    def insulator(self) -> ArrayLike:
        """Return the capacitance of Ci in series with a non-conducting gap, F; of the gap alone if Ci has a leak."""
        return self._gap_fraction() * self.Cgap if self._has_open_gap else self.Ci

    def leak(self) -> ArrayLike | None:
        """Return the resistance in parallel with `insulator`, ohm, or None; a non-conducting gap has none."""
        return None if self._has_open_gap else self.Ri

    def resistance(self) -> ArrayLike | None:
        """Return the resistance in the loop, ohm, or None."""
        raise NotImplementedError

    def body(self) -> tuple[Element, ...]:
        """Return the parallel elements of skins and body, the touching skin first."""
        raise NotImplementedError

    def elements(self) -> tuple[Element, ...]:
        """Return the elements of the body, followed by a conducting gap, or by Ri‖Ci behind a non-conducting one."""
        if self.Rgap is not None:
            return (*self.body(), Element(self.Rgap, self.Cgap))
        return (*self.body(), Element(self.Ri, self.Ci)) if self._has_open_gap and self.Ri is not None else self.body()

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
            return self._insulator_admittance(omega) / (1.0 + sum(ratios))
        gap = self._gap_fraction() if self.Rgap is None else ratios[len(self.elements()) - 1]
        return gap / (1.0 + sum(ratios))

    def _insulator_admittance(self, omega: ArrayLike) -> Array:
        charging, Ri = 1j * jnp.asarray(omega) * self.insulator(), self.leak()
        return charging if Ri is None else charging + 1.0 / jnp.asarray(Ri)

    @jit_inline
    def _impedance_ratios(self, omega: ArrayLike) -> list[Array]:
        """Return the loop's impedances over the insulator's, touching skin first; their real parts are >= 0."""
        admittance = self._insulator_admittance(omega)
        ratios = []
        for R, C in self.elements():
            x = jnp.asarray(omega) * R * C
            ratios.append(admittance * R / (1.0 + x**2) * (1.0 - 1j * x))
        R0 = self.resistance()
        return ratios if R0 is None else [*ratios, admittance * R0]

    def channel_terms(self, channel: Channel) -> HighpassTerms:
        """Return as many terms for each channel, but one more with a non-conducting gap; I may have a rate."""
        modes = self._modes()
        if channel == "I":
            return HighpassTerms(tuple(modes.current), tuple(modes.tau), modes.rate, modes.direct_current)
        if channel == "Vsc":
            return modes.element_terms(0)
        if self.Rgap is not None:
            return modes.element_terms(len(self.elements()) - 1)
        share, rest = self._gap_fraction(), self._rest_terms(modes)
        # the last is so long that an open gap keeps its charge
        return HighpassTerms((*(share * jnp.stack(rest.weight)), share), (*rest.tau, INFINITE_RATIO * rest.tau[0]))

    def insulator_terms(self) -> HighpassTerms:
        """Return the terms of the insulator's voltage over V."""
        modes = self._modes()
        if not self._has_open_gap:
            return self._rest_terms(modes)
        if self.Ri is not None:
            return modes.element_terms(len(self.elements()) - 1)
        rest, gap = self._rest_terms(modes), self.channel_terms("Vgap")
        weights = (w - other for w, other in zip((*rest.weight, 0.0), gap.weight, strict=True))
        return HighpassTerms(tuple(weights), gap.tau, None, 1.0)

    def _rest_terms(self, modes: Modes) -> HighpassTerms:
        """Return the terms of V minus the voltages across all elements and the resistance, over V."""
        R0, direct = self.resistance(), 1.0 if modes.direct is None else modes.direct[-1]
        others = jnp.sum(modes.voltages, axis=0) + (0.0 if R0 is None else R0 * modes.current)
        return HighpassTerms(tuple(-others), tuple(modes.tau), None, direct)

    def _gap_fraction(self) -> ArrayLike:
        """Return the fraction of the voltage across `insulator` and a non-conducting gap that is across the gap."""
        if self.Cgap is None:
            raise self._gap_missing()
        if self.Ri is not None:
            return jnp.ones(())
        return self.Ci / (self.Ci + jnp.asarray(self.Cgap))

    def _modes(self) -> Modes:
        Ci, R0, Ri = self.insulator(), self.resistance(), self.leak()
        R, C = (jnp.stack(jnp.broadcast_arrays(*x)) for x in zip(*self.elements(), strict=True))
        C = jnp.maximum(C, 1e-12 * Ci)  # a skin without capacitance gets this one, so that its time constant is not 0
        return modes_without_resistance(Ci, Ri, R, C) if R0 is None else modes_with_resistance(Ci, Ri, R0, R, C)


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
        Ri: leak of the insulator, in parallel with Ci, ohm, keyword-only; None means none.
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
        Ri: leak of the insulator, in parallel with Ci, ohm, keyword-only; None means none.
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


def passes_direct_current(circuit: Circuit) -> bool:
    """Return whether the insulator has a leak and no open gap blocks it, so that a constant V acts on the skin."""
    return (circuit.leak() if isinstance(circuit, Loop) else getattr(circuit, "Ri", None)) is not None


def _series_resistance(*resistances: ArrayLike | None) -> ArrayLike | None:
    stated = [jnp.asarray(r) for r in resistances if r is not None]
    return sum(stated[1:], stated[0]) if stated else None


def charge_ratios(acting: HighpassTerms, recorded: HighpassTerms) -> list[Array]:
    """Return, term by term, the effect of a charge on one channel over its effect on the recorded one.

    The effect of a charge scales between channels like the response to a drive. A charge that the recorded channel does
    not show, such as a difference of equal skins in I, has no known effect: 0.
    """
    largest = jnp.max(jnp.abs(jnp.stack(recorded.weight)))
    return [
        jnp.where(jnp.abs(known) > 1e-9 * largest, weight / jnp.where(known == 0.0, 1.0, known), 0.0)
        for weight, known in zip(acting.weight, recorded.weight, strict=False)
    ]


@jit_inline
def gain_at(terms: HighpassTerms, omega: ArrayLike) -> Complex[Array, "*shape"]:
    """Return the sum of `terms` at s = j omega (rad/s, >= 0)."""
    omega = jnp.asarray(omega)
    total = jnp.zeros_like(omega, dtype=complex) if terms.rate is None else 1j * omega * terms.rate
    if terms.direct is not None:
        total = total + terms.direct
    for weight, tau in zip(terms.weight, terms.tau, strict=True):
        total = total + weight * highpass_gain(omega * tau)
    return total


@jit_inline
def highpass_gain(x: ArrayLike) -> Complex[Array, "*shape"]:
    """Return j x / (1 + j x) for x >= 0, without overflow at either end."""
    is_small, small, inverse = _split_range(x)
    low = small / (1.0 + small**2)  # (x^2 + j x) / (1 + x^2)
    high = 1.0 / (1.0 + inverse**2)
    return jnp.where(is_small, low * small + 1j * low, high + 1j * high * inverse)


@jit_inline
def highpass_amplitude(x: ArrayLike) -> Float[Array, "*shape"]:
    """Return |j x / (1 + j x)| for x >= 0, in forms whose derivatives do not cancel."""
    is_small, small, inverse = _split_range(x)
    return jnp.where(is_small, small / jnp.sqrt(1.0 + small**2), 1.0 / jnp.sqrt(1.0 + inverse**2))


def _split_range(x: ArrayLike) -> tuple[Array, Array, Array]:
    """Return whether x <= 1, x where it is (else 1), and 1/x where it is not (else 1); the 1s keep gradients finite."""
    x = jnp.asarray(x)
    is_small = x <= 1.0
    return is_small, jnp.where(is_small, x, 1.0), 1.0 / jnp.where(is_small, 1.0, x)
