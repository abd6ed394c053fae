"""Section [prior] of a scene file: the prior of each parameter, correlations and order constraints."""

from typing import Annotated, Self

from pydantic import Field, model_validator

from fitact import units
from fitact.errors import InputError
from fitact.prior.distributions import LogNormal
from fitact.prior.prior import Prior
from fitact.scene.prior_spec import (
    ORDER_KEYS,
    AmperePriorSpec,
    FaradPriorSpec,
    HertzPriorSpec,
    NewtonPriorSpec,
    OhmPriorSpec,
    PlainPriorSpec,
    PriorSpec,
    VoltPriorSpec,
)
from fitact.scene.section import Section

# of the friction, if it is measured and nothing is stated
FRICTION_PRIORS = {"mu": PriorSpec(factor=10.0), "force_scale": PriorSpec(factor=1e4)}
UNKNOWN_CI = PriorSpec(factor=20.0)  # where I is fitted, which determines Ci, and nothing is stated
_SKIN_PARAMETERS = ("Rsc", "Csc", "grounding_Rsc", "grounding_Csc")  # parameters in the published tables


class PriorSection(Section):
    """Prior specifications; the default median is the scene's value, and an absent parameter is not free.

    The 95 % intervals of the default skin priors extend from the values of the reference paper to published values of
    whole skin (10 kohm and 5 nF dry, 4.3 kohm and 200 nF wet). The default of the insulator, ± 5 %, is an assumption;
    where the current is fitted, which determines it, 95 % lie within a factor of 20.
    With the channel Ft, mu and force_scale are free within factors of 10 and 10,000 unless specified.
    Noise standard deviations (`sigma` of Vsc, `sigma_I` of I, `sigma_Ft` of Ft) have priors flat in their logarithm
    unless specified.
    """

    Rsc: OhmPriorSpec = PriorSpec(factor=50.0)
    Csc: FaradPriorSpec = PriorSpec(factor=20.0)
    Ci: FaradPriorSpec = PriorSpec(relative_sd=0.05)
    R_H: OhmPriorSpec | None = None
    grounding_Rsc: OhmPriorSpec | None = None
    grounding_Csc: FaradPriorSpec | None = None
    Z: OhmPriorSpec | None = None
    Z_capacitance: FaradPriorSpec | None = None
    series_resistor: OhmPriorSpec | None = None
    Ri: OhmPriorSpec | None = None
    Rgap: OhmPriorSpec | None = None
    Cgap: FaradPriorSpec | None = None
    alpha: PlainPriorSpec | None = None
    stray_capacitance: FaradPriorSpec | None = None
    sigma: VoltPriorSpec | None = None
    sigma_I: AmperePriorSpec | None = None
    sigma_Ft: NewtonPriorSpec | None = None
    mu: PlainPriorSpec | None = None
    fN: NewtonPriorSpec | None = None
    force_scale: PlainPriorSpec | None = None
    sensor_frequency: HertzPriorSpec | None = None
    sensor_damping: PlainPriorSpec | None = None
    correlation: dict[str, Annotated[float, Field(gt=-1, lt=1)]] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _check_specs(self) -> Self:
        beliefs = self.specs()
        for name, belief in beliefs.items():
            if belief.table is not None and name not in _SKIN_PARAMETERS:
                raise ValueError(
                    f"[prior] {name}: a table applies to skin parameters only: {', '.join(_SKIN_PARAMETERS)}"
                )
            if name == "alpha" and belief.upper_bound > 1.0:
                raise ValueError("[prior] alpha is an exponent of at most 1; add high = 1 or less")
            if "stray_capacitance" in (name, belief.tied) and not belief.is_free:
                raise ValueError(
                    f"[prior] {name}: a stray capacitance is not in the loop, so it cannot be fixed or tied here; state"
                    " its value as [measurement] stray_capacitance"
                )
            for key in ("tied", "above", "below"):
                other = getattr(belief, key)
                if other is not None:
                    self._check_pair(name, key, other)
        free = [name for name, belief in beliefs.items() if belief.is_free]
        Prior.from_marginals(self.correlations(), self.order_constraints(), **dict.fromkeys(free, LogNormal(1.0, 1.0)))
        return self

    def _check_pair(self, name: str, key: str, other: str) -> None:
        beliefs = self.specs()
        place = f"[prior] {name}: {key} = '{other}'"
        if other == name or other not in beliefs:
            raise ValueError(f"{place} is not another parameter with a prior; name one of {', '.join(beliefs)}")
        unit, other_unit = units.quantity_unit(name), units.quantity_unit(other)
        if unit != other_unit:
            raise ValueError(f"{place} compares {unit} with {other_unit}; name a parameter with the same unit")
        if key == "tied" and beliefs[other].tied is not None:
            raise ValueError(f"{place} is tied itself; name the parameter that {other} is tied to")

    def specs(self) -> dict[str, PriorSpec]:
        """Return the specifications by parameter; an order constraint alone keeps the default density."""
        beliefs = {name: belief for name, belief in self if isinstance(belief, PriorSpec)}
        for name, belief in beliefs.items():
            if not belief.model_fields_set - ORDER_KEYS:
                default = PriorSection.model_fields[name].default
                if default is None:
                    raise InputError(
                        f"[prior] {name}: give a density in addition to above or below, such as {{median, factor}}"
                    )
                beliefs[name] = default.model_copy(update=belief.model_dump(exclude_unset=True))
        return beliefs

    def ties(self) -> dict[str, tuple[str, float]]:
        """Return tied parameters: name -> (the other parameter, ratio to it)."""
        return {name: (b.tied, b.ratio) for name, b in self.specs().items() if b.tied is not None}

    def order_constraints(self) -> tuple[tuple[str, str], ...]:
        """Return order constraints as pairs of parameters (lower, higher)."""
        beliefs = self.specs().items()
        above = [(b.above, name) for name, b in beliefs if b.above is not None]
        return (*above, *((name, b.below) for name, b in beliefs if b.below is not None))

    def correlations(self) -> dict[tuple[str, str], float]:
        """Return the correlation of each pair of parameters."""
        by_pair: dict[tuple[str, str], float] = {}
        for key, value in self.correlation.items():
            pair = tuple(key.split("-"))
            if len(pair) != 2 or pair[::-1] in by_pair:
                raise InputError(f"correlation '{key}' must name each pair once, as in Rsc-Csc = -0.6")
            by_pair[pair[0], pair[1]] = value
        return by_pair
