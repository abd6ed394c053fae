"""Equivalent circuits of a finger on an electrostatic display, as a few first-order high-pass filters.

An RC circuit has simple, real, negative poles, so the transfer function from the drive to the skin
voltage is, exactly,

    H(s) = sum_k weight_k  s tau_k / (1 + s tau_k),

and so is its admittance, plus a term s C where nothing resistive limits the current. Everything that
depends on time follows from these lists (`response.py`). High-pass terms rather than low-pass ones:
the insulator blocks direct current, so no dc term is left that would have to vanish by cancellation.

All circuits here are one loop: the drive, the insulator Ci, perhaps a resistance R0, and parallel
elements R‖C, of which an interface gap may be one. Scaled by square roots, its equations have a symmetric
matrix whose eigenvalues are the time constants, apart from each other even where two elements are equal:
the mode that they share then has weight zero.
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

Channel: TypeAlias = Literal["Vsc", "I", "Vgap"]  # Vgap is not recorded; the force may come from it


class HighpassTerms(NamedTuple):
    """sum_k weight[k] s tau[k] / (1 + s tau[k]) + rate s."""

    weight: tuple[ArrayLike, ...] | Array
    tau: tuple[ArrayLike, ...] | Array  # s
    rate: ArrayLike | None = None  # s times the weight's unit; None: there is no such term

    def stack(self) -> tuple[Array, Array]:
        """The weights, and the time constants, as arrays."""
        weight, tau = (
            jnp.stack(jnp.broadcast_arrays(*map(jnp.asarray, x))) if isinstance(x, tuple) else x
            for x in (self.weight, self.tau)
        )
        return weight, tau


class Circuit(eqx.Module):
    """A circuit, by its high-pass terms, and from them the transfer function."""

    @property
    def g(self) -> ArrayLike:
        """The capacitive divider: Vsc over a jump of V that no resistance delays."""
        raise NotImplementedError

    @property
    def b(self) -> ArrayLike:
        """The slowest time constant, s."""
        return self.terms().tau[0]

    def channel_terms(self, channel: Channel) -> HighpassTerms:
        """The high-pass terms of a channel over V: those of `terms`, `current_terms` or `gap_terms`."""
        raise NotImplementedError

    def channel_gain(self, channel: Channel, omega: ArrayLike) -> Complex[Array, "*shape"]:
        """A channel over V at the angular frequency `omega` (rad/s, >= 0)."""
        return gain_at(self.channel_terms(channel), omega)

    def terms(self) -> HighpassTerms:
        """The high-pass terms of Vsc / V: one for each element, and one more with a resistance in the loop."""
        return self.channel_terms("Vsc")

    def current_terms(self) -> HighpassTerms:
        """The high-pass terms of I / V, in siemens; `rate` is the term that follows dV/dt, in F."""
        return self.channel_terms("I")

    def gap_terms(self) -> HighpassTerms:
        """The high-pass terms of Vgap / V, the voltage across the gap between finger and panel; raises without one.

        A gap that does not conduct has one more than `terms`, so slow that it keeps the charge it had.
        """
        return self.channel_terms("Vgap")

    def _gap_missing(self) -> InputError:
        return InputError(f"this {type(self).__name__} has no gap between finger and panel; give it Cgap for Vgap")

    def transfer_function(self, omega: ArrayLike) -> Complex[Array, "*shape"]:
        """Vsc / V at the angular frequency `omega` (rad/s, >= 0)."""
        return self.channel_gain("Vsc", omega)

    def admittance(self, omega: ArrayLike) -> Complex[Array, "*shape"]:
        """I / V in siemens at the angular frequency `omega` (rad/s, >= 0)."""
        return self.channel_gain("I", omega)

    def gap_transfer_function(self, omega: ArrayLike) -> Complex[Array, "*shape"]:
        """Vgap / V at the angular frequency `omega` (rad/s, >= 0); raises as `gap_terms`."""
        return self.channel_gain("Vgap", omega)

    def amplitude(self, omega: ArrayLike) -> Float[Array, "*shape"]:
        """|Vsc / V| at the angular frequency `omega` (rad/s, >= 0), eq. (25)."""
        gain, size = _normalize_magnitude(self.transfer_function(omega))
        return size * jnp.sqrt(gain.real**2 + gain.imag**2)

    def phase(self, omega: ArrayLike) -> Float[Array, "*shape"]:
        """How far Vsc leads V at the angular frequency `omega` (rad/s, >= 0), rad; pi/2 at its zero, eq. (26)."""
        gain, size = _normalize_magnitude(self.transfer_function(omega))
        return jnp.where(size > 0.0, jnp.arctan2(gain.imag, gain.real), 0.5 * np.pi)


def _normalize_magnitude(gain: Array) -> tuple[Array, Array]:
    """A complex number as one near 1 (1 for 0) times its size: the squares of its parts neither vanish nor overflow."""
    size = lax.stop_gradient(jnp.maximum(jnp.abs(gain.real), jnp.abs(gain.imag)))
    some = size > 0.0
    return jnp.where(some, gain / jnp.where(some, size, 1.0), 1.0), size


class FinalCircuit(Circuit):
    """The paper's final circuit (Fig. 11): two equal skin layers Rsc‖Csc in series with Ci.

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
        """The divider a / b = Ci / (2 Ci + Csc), the gain at high frequency; at most 1/2."""
        Csc, Ci = jnp.asarray(self.Csc, dtype=float), jnp.asarray(self.Ci, dtype=float)
        # the smaller over the larger: log-derivatives neither cancel nor, where one overflows, end in NaN
        below = Csc <= Ci
        skin = jnp.where(below, Csc, 0.0) / jnp.where(below, Ci, 1.0)
        insulator = jnp.where(below, 0.0, Ci) / jnp.where(below, 1.0, Csc)
        return jnp.where(below, 1.0 / (2.0 + skin), insulator / (1.0 + 2.0 * insulator))

    @property
    def b(self) -> ArrayLike:
        """The time constant Rsc (2 Ci + Csc), s."""
        return self.Rsc * (2.0 * self.Ci + self.Csc)

    def channel_terms(self, channel: Channel) -> HighpassTerms:
        """One term with the time constant b; of Vsc its weight is g, and I also follows dV/dt."""
        if channel == "Vsc":
            return HighpassTerms((self.g,), (self.b,))
        if channel == "I":  # g (1 + s Rsc Csc) / Rsc: the high-pass of b, and what is left of it at high frequency
            return HighpassTerms((2.0 * self.g * self.g / self.Rsc,), (self.b,), self.g * self.Csc)
        raise self._gap_missing()

    def amplitude(self, omega: ArrayLike) -> Float[Array, "*shape"]:
        """|Vsc / V| at the angular frequency `omega` (rad/s, >= 0), eq. (25)."""
        return self.g * highpass_amplitude(jnp.asarray(omega) * self.b)

    def phase(self, omega: ArrayLike) -> Float[Array, "*shape"]:
        """The angle (rad) by which Vsc leads V at the angular frequency `omega` (rad/s, >= 0), eq. (26)."""
        return jnp.arctan2(1.0, jnp.asarray(omega) * self.b)


class Element(NamedTuple):
    """A resistance (ohm) with a capacitance (F) in parallel."""

    R: ArrayLike
    C: ArrayLike


class _Modes(NamedTuple):
    """Weights of each time constant in the elements' voltages and the current, and the current's rate (F)."""

    tau: Array
    voltages: Float[Array, "elements modes"]
    current: Array
    rate: ArrayLike | None = None


class Loop(Circuit):
    """The drive in series with Ci, perhaps a gap and a resistance, and parallel elements; Vsc is over the first."""

    Rsc: ArrayLike  # the touching skin, ohm
    Csc: ArrayLike  # F
    Ci: ArrayLike  # the insulator, F
    # the interface gap between finger and panel. Source: Shultz, Peshkin, Colgate, Haptics Symposium 2018
    Rgap: ArrayLike | None = eqx.field(default=None, kw_only=True)  # ohm, which sliding raises; None: does not conduct
    Cgap: ArrayLike | None = eqx.field(default=None, kw_only=True)  # in parallel with it, F; None: there is no gap

    def __check_init__(self) -> None:
        if self.Rgap is not None and self.Cgap is None:
            raise InputError("a gap of Rgap needs its Cgap; give both, or Cgap alone")

    def insulator(self) -> ArrayLike:
        """Ci in series with a gap that does not conduct, F."""
        return self.Ci if self.Cgap is None or self.Rgap is not None else self._gap_fraction() * self.Cgap

    def resistance(self) -> ArrayLike | None:
        """The resistance in the loop, ohm; None where there is none."""
        raise NotImplementedError

    def body(self) -> tuple[Element, ...]:
        """The parallel elements of skins and body, the touching skin first."""
        raise NotImplementedError

    def elements(self) -> tuple[Element, ...]:
        """Those of the body, and last a gap that conducts."""
        if self.Rgap is None or self.Cgap is None:
            return self.body()
        return (*self.body(), Element(self.Rgap, self.Cgap))

    @property
    def g(self) -> ArrayLike:
        """The capacitive divider: Vsc over a jump of V that no resistance delays."""
        ratios = [self.insulator() / C for _, C in self.elements()]
        return ratios[0] / (1.0 + sum(ratios))

    def channel_gain(self, channel: Channel, omega: ArrayLike) -> Complex[Array, "*shape"]:
        """A channel over V at the angular frequency `omega` (rad/s, >= 0), from impedances: they keep all digits."""
        ratios = self._impedance_ratios(omega)
        if channel == "Vsc":
            return ratios[0] / (1.0 + sum(ratios))
        if channel == "I":
            return 1j * jnp.asarray(omega) * self.insulator() / (1.0 + sum(ratios))
        gap = self._gap_fraction() if self.Rgap is None else ratios[len(self.elements()) - 1]
        return gap / (1.0 + sum(ratios))

    def _impedance_ratios(self, omega: ArrayLike) -> list[Array]:
        """The impedances around the loop, the touching skin's first, over the insulator's: no real part is negative."""
        charging = jnp.asarray(omega) * self.insulator()
        ratios = []
        for R, C in self.elements():
            x = jnp.asarray(omega) * R * C
            ratios.append(charging * R / (1.0 + x**2) * (x + 1j))
        R0 = self.resistance()
        return ratios if R0 is None else [*ratios, 1j * charging * R0]

    def channel_terms(self, channel: Channel) -> HighpassTerms:
        """The same number for each channel, but for a gap that does not conduct; I may also follow dV/dt."""
        tau, voltages, current, rate = self._modes()
        if channel == "I":
            return HighpassTerms(tuple(current), tuple(tau), rate)
        if channel == "Vsc":
            return HighpassTerms(tuple(voltages[0]), tuple(tau))
        if self.Rgap is not None:
            return HighpassTerms(tuple(voltages[-1]), tuple(tau))
        share, R0 = self._gap_fraction(), self.resistance()
        others = jnp.sum(voltages, axis=0) + (0.0 if R0 is None else R0 * current)
        return HighpassTerms((*(-share * others), share), (*tau, 1e15 * tau[0]))  # so slowly an open gap loses charge

    def _gap_fraction(self) -> ArrayLike:
        """The gap's share of the voltage over Ci and a gap that does not conduct; raises where there is no gap."""
        if self.Cgap is None:
            raise self._gap_missing()
        return self.Ci / (self.Ci + jnp.asarray(self.Cgap))

    def _modes(self) -> _Modes:
        Ci, R0 = self.insulator(), self.resistance()
        R, C = (jnp.stack(jnp.broadcast_arrays(*x)) for x in zip(*self.elements(), strict=True))
        C = jnp.maximum(C, 1e-12 * Ci)  # what a skin without capacitance counts as having: its time constant is not 0
        return _modes_without_resistance(Ci, R, C) if R0 is None else _modes_with_resistance(Ci, R0, R, C)


def _modes_without_resistance(Ci: ArrayLike, R: Array, C: Array) -> _Modes:
    """With x = v / sqrt(R) over the elements:  T x' + x = Ci sqrt(R) V',  T = diag(R C) + Ci sqrt(R) sqrt(R)^T."""
    root = jnp.sqrt(R)
    tau, modes = _gram_eigenmodes(jnp.vstack([jnp.diag(jnp.sqrt(R * C)), jnp.sqrt(Ci) * root]))
    drive = Ci * (modes.T @ root) / tau
    rate = Ci
    for capacitance in C:
        rate = rate * (capacitance / (rate + capacitance))
    return _Modes(tau, root[:, None] * modes * drive, drive**2, rate)


def _modes_with_resistance(Ci: ArrayLike, R0: ArrayLike, R: Array, C: Array) -> _Modes:
    """With x = sqrt(C) v over elements and Ci:  T x' + x = sqrt(Ci) V e_i,  T = sqrt(C) P sqrt(C).

    P holds the resistances that each capacitor's terminals see: its own R, for Ci the whole loop's.
    """
    root = jnp.sqrt(jnp.append(C, Ci))
    # each row is one resistance's current, times its square root
    in_elements = jnp.vstack([jnp.diag(root[:-1]), jnp.zeros_like(C)])
    in_Ci = jnp.append(jnp.full_like(R, -1.0), 1.0)[:, None] * root[-1]
    tau, modes = _gram_eigenmodes(jnp.sqrt(jnp.append(R, R0))[:, None] * jnp.hstack([in_elements, in_Ci]))
    voltages = -modes[:-1] * modes[-1] * (root[-1] / root[:-1, None])
    return _Modes(tau, voltages, Ci * modes[-1] ** 2 / tau)


@jax.custom_jvp
def _gram_eigenmodes(factor: Array) -> tuple[Array, Array]:
    """Eigenvalues and eigenvectors of factor^T factor: from the factor, small eigenvalues keep twice the digits."""
    _, sigma, modes = jnp.linalg.svd(factor, full_matrices=False)
    return sigma * sigma, modes.T


@_gram_eigenmodes.defjvp
def _gram_eigenmodes_jvp(
    primals: tuple[Array], tangents: tuple[Array]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """That of the singular value decomposition, but finite where modes are apart by no more than rounding.

    They then have one time constant, and only their sum matters, which their rotation into each other leaves alone.
    """
    left, sigma, right = jnp.linalg.svd(primals[0], full_matrices=False)
    modes, slope = right.T, left.T @ tangents[0] @ right.T
    gaps = sigma - sigma[:, None]
    distinct = jnp.abs(gaps) > 4.0 * jnp.finfo(sigma.dtype).eps * sigma[0]  # ulps that rounding makes of equal ones
    turn = jnp.where(distinct, 1.0 / jnp.where(distinct, gaps * (sigma + sigma[:, None]), 1.0), 0.0)
    scaled = sigma[:, None] * slope
    changes = 2.0 * sigma * jnp.diagonal(slope), modes @ (turn * (scaled + scaled.T))
    return (sigma * sigma, modes), changes


class Probe(eqx.Module):
    """The load of a voltage probe on the touching skin: R‖C (ohm, F; R may be infinite)."""

    R: ArrayLike
    C: ArrayLike

    def load_skin(self, circuit: Loop) -> Element:
        """The circuit's touching skin with the probe in parallel."""
        return Element(1.0 / (1.0 / jnp.asarray(circuit.Rsc) + 1.0 / self.R), circuit.Csc + jnp.asarray(self.C))


class DirectGround(Loop):
    """Direct ground (Fig. 3a): the touching skin, R_H, and the grounding skin in series with Ci, eq. (5).

    With equal skins and R_H this is the paper's simplified circuit (Fig. 7).

    Attributes:
        Rsc, Csc: the touching skin, ohm and F.
        Ci: the insulator, F.
        R_H: the body's inner resistance, ohm; None: left out.
        grounding_Rsc, grounding_Csc: the grounding skin; None: equal to the touching one.
        series_resistor: a known resistor in series, ohm; None: none.
        probe: the load across the touching skin; None: an ideal probe.
        Rgap, Cgap: the interface gap, ohm and F, by name; None: none (see `Loop`).
    """

    R_H: ArrayLike | None = None
    grounding_Rsc: ArrayLike | None = None
    grounding_Csc: ArrayLike | None = None
    series_resistor: ArrayLike | None = None
    probe: Probe | None = None

    def resistance(self) -> ArrayLike | None:
        """R_H and the series resistor, ohm."""
        return _series_resistance(self.R_H, self.series_resistor)

    def body(self) -> tuple[Element, ...]:
        """The touching skin (with the probe), and the grounding one."""
        grounding = Element(
            self.Rsc if self.grounding_Rsc is None else self.grounding_Rsc,
            self.Csc if self.grounding_Csc is None else self.grounding_Csc,
        )
        return Element(self.Rsc, self.Csc) if self.probe is None else self.probe.load_skin(self), grounding


class NaturalGround(Loop):
    """Natural ground (Fig. 3b): the touching skin and the environment Z in series with Ci, eq. (6).

    Attributes:
        Rsc, Csc: the touching skin, ohm and F.
        Ci: the insulator, F.
        Z: resistance to earth through shoes or chair, ohm; None: the body is at earth.
        Z_capacitance: in parallel with it, F; None: Z is a plain resistance.
        series_resistor: a known resistor in series, ohm; None: none.
        probe: the load across the touching skin; None: an ideal probe.
        Rgap, Cgap: the interface gap, ohm and F, by name; None: none (see `Loop`).
    """

    Z: ArrayLike | None
    Z_capacitance: ArrayLike | None = None
    series_resistor: ArrayLike | None = None
    probe: Probe | None = None

    def resistance(self) -> ArrayLike | None:
        """Z where it is a plain resistance, and the series resistor, ohm."""
        return _series_resistance(self.Z if self.Z_capacitance is None else None, self.series_resistor)

    def body(self) -> tuple[Element, ...]:
        """The touching skin (with the probe), and Z where it has a capacitance."""
        touching = Element(self.Rsc, self.Csc) if self.probe is None else self.probe.load_skin(self)
        return (touching,) if self.Z_capacitance is None else (touching, Element(self.Z, self.Z_capacitance))


RC: TypeAlias = FinalCircuit | DirectGround | NaturalGround  # those with constant skins, which can be fitted


def _series_resistance(*resistances: ArrayLike | None) -> ArrayLike | None:
    stated = [jnp.asarray(r) for r in resistances if r is not None]
    return sum(stated[1:], stated[0]) if stated else None


def gain_at(terms: HighpassTerms, omega: ArrayLike) -> Complex[Array, "*shape"]:
    """The sum of `terms` at s = j omega (rad/s, >= 0)."""
    omega = jnp.asarray(omega)
    total = jnp.zeros_like(omega, dtype=complex) if terms.rate is None else 1j * omega * terms.rate
    for weight, tau in zip(terms.weight, terms.tau, strict=True):
        total = total + weight * highpass_gain(omega * tau)
    return total


def highpass_gain(x: ArrayLike) -> Complex[Array, "*shape"]:
    """j x / (1 + j x) for x >= 0, without overflow at either end."""
    below, small, inverse = _split_range(x)
    low = small / (1.0 + small**2)  # (x^2 + j x) / (1 + x^2)
    high = 1.0 / (1.0 + inverse**2)
    return jnp.where(below, low * small + 1j * low, high + 1j * high * inverse)


def highpass_amplitude(x: ArrayLike) -> Float[Array, "*shape"]:
    """|j x / (1 + j x)| for x >= 0, in forms whose derivatives do not cancel."""
    below, small, inverse = _split_range(x)
    return jnp.where(below, small / jnp.sqrt(1.0 + small**2), 1.0 / jnp.sqrt(1.0 + inverse**2))


def _split_range(x: ArrayLike) -> tuple[Array, Array, Array]:
    """Whether x <= 1, x where it is, and 1/x where it is not; 1 elsewhere, which keeps gradients finite."""
    x = jnp.asarray(x)
    below = x <= 1.0
    return below, jnp.where(below, x, 1.0), 1.0 / jnp.where(below, 1.0, x)
