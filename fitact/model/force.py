"""The electrostatic force on the finger and the friction that is felt."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.model.circuit import Circuit
from fitact.model.drive import Drive
from fitact.model.steady import mean_square, peak

EPSILON_0 = 8.85e-12  # F/m, the paper's value


class Contact(eqx.Module):
    """The plate capacitor that finger and panel form; SI units.

    Attributes:
        area: contact area A, m^2.
        insulator_thickness: Ti, m.
        insulator_permittivity: relative, eps_i.
        skin_thickness: Tsc, m.
        skin_permittivity: relative, eps_sc.
    """

    area: ArrayLike
    insulator_thickness: ArrayLike
    insulator_permittivity: ArrayLike
    skin_thickness: ArrayLike
    skin_permittivity: ArrayLike

    @classmethod
    def from_capacitances(
        cls,
        Ci: ArrayLike,
        Csc: ArrayLike,
        area: ArrayLike,
        insulator_thickness: ArrayLike,
        skin_thickness: ArrayLike,
    ) -> "Contact":
        """The contact whose permittivities give the capacitances `Ci` and `Csc` (F) by eq. (3)."""
        unit = EPSILON_0 * jnp.asarray(area)
        return cls(
            area,
            insulator_thickness,
            Ci * insulator_thickness / unit,
            skin_thickness,
            Csc * skin_thickness / unit,
        )


def plate_capacitance(permittivity: ArrayLike, area: ArrayLike, thickness: ArrayLike) -> ArrayLike:
    """C = eps0 eps_r A / T in F, eq. (3); `area` in m^2, `thickness` in m."""
    return EPSILON_0 * permittivity * area / thickness


def plate_resistance(resistivity: ArrayLike, area: ArrayLike, thickness: ArrayLike) -> ArrayLike:
    """R = rho T / A in ohm, eq. (4); `resistivity` in ohm m, `area` in m^2, `thickness` in m."""
    return resistivity * thickness / area


def electrostatic_force(vsc: ArrayLike, contact: Contact) -> Float[Array, "*shape"]:
    """The electrostatic force in N for the skin voltage `vsc` (V), eqs. (1) and (22)."""
    vsc = jnp.asarray(vsc)
    return force_constant(contact) * vsc * vsc


def force_constant(contact: Contact) -> Array:
    """The electrostatic force per Vsc^2 in N/V^2, eqs. (1) and (22); 0 where a permittivity is 0."""
    insulator, skin = jnp.asarray(contact.insulator_permittivity), jnp.asarray(contact.skin_permittivity)
    gap = jnp.asarray(contact.insulator_thickness) + contact.skin_thickness
    layers = contact.insulator_thickness * skin + contact.skin_thickness * insulator
    return EPSILON_0 * contact.area / (2.0 * gap) * (insulator * (skin / layers))


def mean_force(circuit: Circuit, drive: Drive, contact: Contact) -> Float[Array, ""]:
    """The electrostatic force in N, averaged over a period of the steady state: exact, eqs. (1) and (22).

    Raises:
        InputError: the drive does not repeat.
    """
    return force_constant(contact) * mean_square(circuit, drive)


def peak_force(circuit: Circuit, drive: Drive, contact: Contact) -> Float[Array, ""]:
    """The largest electrostatic force in N over a period of the steady state: exact, eqs. (1) and (22).

    Raises:
        InputError: the drive does not repeat.
    """
    return electrostatic_force(peak(circuit, drive), contact)


def friction(force: ArrayLike, coefficient: ArrayLike, normal_force: ArrayLike) -> Float[Array, "*shape"]:
    """Friction in N from the electrostatic `force` and the finger's `normal_force` (N), eq. (2)."""
    return jnp.asarray(coefficient) * (jnp.asarray(force) + normal_force)


class ForceSummary(NamedTuple):
    """Mean, peak and root mean square of a force over time, N."""

    mean: Array
    peak: Array
    rms: Array


def summarize(force: Float[Array, " samples"], weight: Float[Array, " samples"]) -> ForceSummary:
    """Mean, peak and rms over samples that stand for the shares `weight` of the time (they add up to 1)."""
    return ForceSummary(jnp.sum(weight * force), jnp.max(force), jnp.sqrt(jnp.sum(weight * force**2)))
