"""Priors of the resistance and capacitance of one skin layer, from published properties of skin."""

import math
from typing import Literal, NamedTuple, TypeAlias

from fitact.model.force import EPSILON_0, plate_capacitance, plate_resistance
from fitact.prior.distributions import Distribution, LogNormal, Uniform

PublishedTable: TypeAlias = Literal["gabriel-dry", "gabriel-wet", "paper"]

# S. Gabriel, R. W. Lau, C. Gabriel, Phys. Med. Biol. 41 (1996) 2271, table 1:
# conductivity (S/m) and dispersions (strength, time constant in s, Cole-Cole exponent alpha)
_GABRIEL = {
    "gabriel-dry": (2e-4, ((32.0, 7.234e-12, 0.0), (1100.0, 32.481e-9, 0.2))),
    "gabriel-wet": (
        4e-4,
        ((39.0, 7.958e-12, 0.1), (280.0, 79.577e-9, 0.0), (3e4, 1.592e-6, 0.16), (3e4, 1.592e-3, 0.2)),
    ),
}


class Layer(NamedTuple):
    """A skin layer under a contact: area (m^2), thickness (m), and frequency (Hz) of the properties."""

    area: float
    thickness: float
    frequency: float


def published_prior(table: PublishedTable, name: str, layer: Layer, factor: float = 6.0) -> Distribution:
    """Return the prior of a layer's resistance (`name` ends in Rsc) or capacitance from a table, eqs. (3) and (4).

    The state of a finger is less certain than the tables. Dry and wet skin each differ by a factor sqrt(40) in
    permittivity from their geometric mean; with this `factor`, each prior extends half-way to the other table.
    """
    is_resistance = name.endswith("Rsc")
    plate = plate_resistance if is_resistance else plate_capacitance
    if table == "paper":
        ends = (4e4, 1e5) if is_resistance else (2e3, 1e4)  # resistivity (ohm m), permittivity; from 10 to 1000 Hz
        return Uniform(*(plate(end, layer.area, layer.thickness) for end in ends))
    permittivity = skin_permittivity(table, layer.frequency)
    resistivity = -1.0 / (permittivity.imag * EPSILON_0 * 2.0 * math.pi * layer.frequency)
    middle = resistivity if is_resistance else permittivity.real
    return LogNormal.within_factor(plate(middle, layer.area, layer.thickness), factor)


def skin_permittivity(
    table: Literal["gabriel-dry", "gabriel-wet"], frequency: float, high_frequency: float = 4.0
) -> complex:
    """Return the relative complex permittivity of skin at `frequency` (Hz) (Cole-Cole), conduction included.

    `high_frequency`: the relative permittivity above all dispersions.
    """
    conductivity, dispersions = _GABRIEL[table]
    s = 2j * math.pi * frequency
    return (
        high_frequency
        + sum(height / (1.0 + (s * tau) ** (1.0 - alpha)) for height, tau, alpha in dispersions)
        + (conductivity / (s * EPSILON_0))
    )
