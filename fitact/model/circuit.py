"""Equivalent circuits of a finger on an electrostatic display, as a few first-order high-pass filters.

An RC circuit has simple, real, negative poles, so the transfer function from the drive to the skin
voltage is, exactly,

    H(s) = dc + sum_k weight_k  s tau_k / (1 + s tau_k).

Everything that depends on time follows from that list (`response.py`). High-pass terms are used
rather than low-pass ones because the insulator blocks direct current: the dc term vanishes by
itself instead of by cancellation.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Complex


class Terms(NamedTuple):
    """H(s) = dc + sum_k weight[k] s tau[k] / (1 + s tau[k])."""

    dc: ArrayLike
    weight: tuple[ArrayLike, ...]
    tau: tuple[ArrayLike, ...]  # s


class Circuit(eqx.Module):
    """What every circuit offers: its high-pass terms, and from them the transfer function."""

    def terms(self) -> Terms:
        """The high-pass terms of Vsc / V."""
        raise NotImplementedError

    def transfer_function(self, omega: ArrayLike) -> Complex[Array, "*shape"]:
        """Vsc / V at the angular frequency `omega` (rad/s, >= 0)."""
        dc, weights, taus = self.terms()
        total = jnp.asarray(dc, dtype=complex)
        for weight, tau in zip(weights, taus, strict=True):
            total = total + weight * highpass_gain(jnp.asarray(omega) * tau)
        return total


def highpass_gain(x: ArrayLike) -> Complex[Array, "*shape"]:
    """j x / (1 + j x) for x >= 0, without overflow at either end."""
    x = jnp.asarray(x)
    below = x <= 1.0
    small = jnp.where(below, x, 1.0)
    inverse = 1.0 / jnp.where(below, 1.0, x)
    low = small / (1.0 + small**2)  # (x^2 + j x) / (1 + x^2)
    high = 1.0 / (1.0 + inverse**2)
    return jnp.where(below, low * small + 1j * low, high + 1j * high * inverse)


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
        """The divider a / b = Ci / (2 Ci + Csc), the gain at high frequency; below 1/2."""
        return self.Ci / (2.0 * self.Ci + self.Csc)

    @property
    def b(self) -> ArrayLike:
        """The time constant Rsc (2 Ci + Csc), s."""
        return self.Rsc * (2.0 * self.Ci + self.Csc)

    def terms(self) -> Terms:
        """One term: the divider g with the time constant b."""
        return Terms(0.0, (self.g,), (self.b,))
