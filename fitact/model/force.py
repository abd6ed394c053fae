"""Electrostatic force on the finger, and the resulting friction."""

from typing import Any, ClassVar, Literal, NamedTuple, TypeAlias

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from fitact.errors import InputError
from fitact.model.circuit import Channel, Circuit
from fitact.model.drive import Drive
from fitact.model.skin import constant_skin_circuit
from fitact.model.steady import mean_square, peak

EPSILON_0 = 8.85e-12  # F/m, as in the reference paper

# coefficient, normal force (N) and force scale of eq. (2), and the sensor's natural frequency (Hz) and damping ratio
FRICTION_PARAMETERS = ("mu", "fN", "force_scale", "sensor_frequency", "sensor_damping")
ForceModel: TypeAlias = Literal["paper", "gap"]


class Contact(eqx.Module):
    """Plate capacitor formed by finger and panel, on which Vsc acts; SI units.

    Attributes:
        area: contact area A, m^2.
        insulator_thickness: Ti, m.
        insulator_permittivity: relative permittivity eps_i.
        skin_thickness: Tsc, m.
        skin_permittivity: relative permittivity eps_sc.
    """

    area: ArrayLike
    insulator_thickness: ArrayLike
    insulator_permittivity: ArrayLike
    skin_thickness: ArrayLike
    skin_permittivity: ArrayLike
    channel: ClassVar[Channel] = "Vsc"

    @classmethod
    def from_capacitances(
        cls, Ci: ArrayLike, Csc: ArrayLike, area: ArrayLike, insulator_thickness: ArrayLike, skin_thickness: ArrayLike
    ) -> "Contact":
        """Return the contact whose permittivities give the capacitances `Ci` and `Csc` (F) by eq. (3)."""
        unit: Any = EPSILON_0 * area
        return cls(
            area, insulator_thickness, Ci * insulator_thickness / unit, skin_thickness, Csc * skin_thickness / unit
        )


class AirGap(eqx.Module):
    """Air gap between finger and panel; the force on its faces follows from the voltage across it.

    Source: Shultz, Peshkin, Colgate, IEEE Trans. Haptics 11 (2018) 279; Ayyildiz et al., PNAS 115 (2018) 12668.
    """

    area: ArrayLike  # m^2
    thickness: ArrayLike  # m
    channel: ClassVar[Channel] = "Vgap"


class Geometry(eqx.Module):
    """Geometry that the force depends on in addition to the circuit."""

    area: ArrayLike = 1.0  # m^2
    insulator_thickness: ArrayLike = 1.0  # m
    skin_thickness: ArrayLike = 1.0  # m
    gap_thickness: ArrayLike | None = None  # m; None means eps0 A / Cgap
    model: ForceModel = eqx.field(static=True, default="paper")  # from Vsc, eq. (22), or from Vgap

    def contact(self, circuit: Circuit) -> "Contact | AirGap":
        """Return where the force acts; permittivities and a missing gap thickness follow from eq. (3)."""
        inner: Any = constant_skin_circuit(circuit)
        if self.model == "paper":
            layers = self.insulator_thickness, self.skin_thickness
            return Contact.from_capacitances(inner.Ci, inner.Csc, self.area, *layers)
        Cgap = getattr(inner, "Cgap", None)
        if Cgap is None:
            raise InputError("the force across a gap needs a circuit with a gap; give Cgap, or use the force from Vsc")
        return AirGap(self.area, EPSILON_0 * self.area / Cgap if self.gap_thickness is None else self.gap_thickness)


def plate_capacitance(permittivity: ArrayLike, area: ArrayLike, thickness: ArrayLike) -> ArrayLike:
    """Return C = eps0 eps_r A / T in F, eq. (3); `area` in m^2, `thickness` in m."""
    return EPSILON_0 * permittivity * area / thickness


def plate_resistance(resistivity: ArrayLike, area: ArrayLike, thickness: ArrayLike) -> ArrayLike:
    """Return R = rho T / A in ohm, eq. (4); `resistivity` in ohm m, `area` in m^2, `thickness` in m."""
    return resistivity * thickness / area


def electrostatic_force(voltage: ArrayLike, contact: Contact | AirGap) -> Float[Array, "*shape"]:
    """Return the electrostatic force (N) of the `voltage` (V): Vsc for a contact, eqs. (1) and (22), Vgap for a gap."""
    voltage = jnp.asarray(voltage)
    return force_constant(contact) * voltage * voltage


def force_constant(contact: Contact | AirGap) -> Any:
    """Return force / voltage^2 (N/V^2): eqs. (1) and (22) for a contact, eps0 A / (2 d^2) for a gap."""
    if isinstance(contact, AirGap):
        thickness: Any = contact.thickness
        return EPSILON_0 * contact.area / 2.0 / thickness / thickness
    insulator: Any = contact.insulator_permittivity
    skin: Any = contact.skin_permittivity
    gap: Any = contact.insulator_thickness + contact.skin_thickness
    layers = contact.insulator_thickness * skin + contact.skin_thickness * insulator
    return EPSILON_0 * contact.area / (2.0 * gap) * (insulator * (skin / layers))


def mean_force(circuit: Circuit, drive: Drive, contact: Contact | AirGap) -> Float[Array, ""]:
    """Return the exact mean electrostatic force (N) over a period of the steady state, eqs. (1) and (22).

    Raises:
        InputError: the drive is not periodic, or `contact` is a gap and the circuit has none.
    """
    return force_constant(contact) * mean_square(circuit, drive, contact.channel)


def peak_force(circuit: Circuit, drive: Drive, contact: Contact | AirGap) -> Float[Array, ""]:
    """Return the exact maximum electrostatic force (N) over a period of the steady state, eqs. (1) and (22).

    Raises:
        InputError: the drive is not periodic, or `contact` is a gap and the circuit has none.
    """
    return electrostatic_force(peak(circuit, drive, contact.channel), contact)


def friction(force: ArrayLike, coefficient: ArrayLike, normal_force: ArrayLike) -> Float[Array, "*shape"]:
    """Return the friction (N) for the electrostatic `force` (N) and the finger's `normal_force` (N), eq. (2)."""
    return jnp.asarray(coefficient) * (jnp.asarray(force) + normal_force)


class ForceSummary(NamedTuple):
    """Mean, peak and root mean square of a force over time, N."""

    mean: Array
    peak: Array
    rms: Array


def summarize(force: Float[Array, " samples"], weight: Float[Array, " samples"]) -> ForceSummary:
    """Return mean, peak and rms of samples; `weight` is the fraction of the time that each represents (sum 1)."""
    return ForceSummary(jnp.sum(weight * force), jnp.max(force), jnp.sqrt(jnp.sum(weight * force**2)))
