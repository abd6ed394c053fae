"""Section [prior] of a scene file: the prior of each parameter, correlations and order constraints."""

import math
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from fitact import units
from fitact.errors import InputError
from fitact.prior.distributions import Distribution, LogNormal, LogUniform, TruncatedLogNormal, Uniform
from fitact.prior.prior import Prior
from fitact.prior.published import Layer, PublishedTable, published_prior
from fitact.scene.sections import Section, Unit

_FORMS: tuple[tuple[set[str], set[str]], ...] = (  # required and optional keys of each form
    ({"factor"}, {"median", "low", "high"}),
    ({"relative_sd"}, {"median", "low", "high"}),
    ({"low", "high"}, {"scale"}),
    ({"tolerance"}, {"nominal"}),
    ({"table"}, set()),
    ({"fixed"}, set()),
    ({"tied"}, {"ratio"}),
)
_ORDER_KEYS = {"above", "below"}
QUANTITY_KEYS = ("median", "low", "high", "nominal", "fixed")  # keys in the unit of the parameter
_SKIN_PARAMETERS = ("Rsc", "Csc", "grounding_Rsc", "grounding_Csc")  # parameters in the published tables


class PriorSpec(Section):
    """Prior specification of one parameter; docs/priors.md lists the forms."""

    median: float | None = Field(default=None, gt=0)
    factor: float | None = Field(default=None, gt=1, le=1e6)
    relative_sd: float | None = Field(default=None, gt=0, le=10)
    low: float | None = Field(default=None, gt=0)
    high: float | None = Field(default=None, gt=0)
    scale: Literal["linear", "log"] = "linear"
    nominal: float | None = Field(default=None, gt=0)
    tolerance: float | None = Field(default=None, gt=0, lt=1)
    table: PublishedTable | None = None
    fixed: bool | float | None = None
    tied: str | None = None
    ratio: float = Field(default=1.0, gt=0)
    above: str | None = None
    below: str | None = None

    @model_validator(mode="after")
    def _check_form(self) -> Self:
        keys, ordered = self.model_fields_set - _ORDER_KEYS, self.model_fields_set & _ORDER_KEYS
        known = any(needs <= keys <= needs | takes for needs, takes in _FORMS)
        if not known and not (ordered and not keys):
            raise ValueError(
                "write {median, factor}, {median, relative_sd}, {low, high}, {nominal, tolerance}, {table}, {fixed}"
                " or {tied}"
            )
        if ordered and not self.is_free:
            raise ValueError("above and below apply to free parameters only; remove them from a fixed or tied one")
        if self.fixed is False or (self.fixed is not True and self.fixed is not None and self.fixed <= 0.0):
            raise ValueError("fixed is a value above 0, or true for the scene's")
        if self.low is not None and self.high is not None and not self.low < self.high:
            raise ValueError(f"low = {self.low:g} must be below high = {self.high:g}")
        return self

    @property
    def is_free(self) -> bool:
        """Whether the parameter has a density, and is not fixed or tied."""
        return self.fixed is None and self.tied is None

    @property
    def upper_bound(self) -> float:
        """Upper bound of the values by the specification, infinity if there is none."""
        if self.tolerance is not None:
            return (self.nominal or 0.0) * (1.0 + self.tolerance)
        if self.fixed is not None:
            return 0.0 if self.fixed is True else self.fixed
        return math.inf if self.high is None else self.high

    def distribution(self, name: str, nominal: float | None, layer: Layer) -> Distribution:
        """Return the density of the parameter `name`; its default median is the `nominal` value of the scene."""
        if self.table is not None:
            return published_prior(self.table, name, layer)
        if self.tolerance is not None:
            return Uniform.with_tolerance(_require_value(name, "nominal", self.nominal, nominal), self.tolerance)
        low, high = self.low or 0.0, self.high or math.inf
        if self.factor is None and self.relative_sd is None:  # _check_form ensures both bounds
            return (LogUniform if self.scale == "log" else Uniform)(low, high)
        median = _require_value(name, "median", self.median, nominal)
        if self.factor is not None:
            whole = LogNormal.within_factor(median, self.factor)
        else:
            whole = LogNormal.with_relative_sd(median, self.relative_sd or 0.0)
        if self.low is None and self.high is None:
            return whole
        try:
            return TruncatedLogNormal(whole.median, whole.spread, low, high)
        except InputError as error:
            raise InputError(f"[prior] {name}: {error}") from None


def _require_value(name: str, key: str, stated: float | None, nominal: float | None) -> float:
    if not (stated or nominal):
        raise InputError(f"[prior] {name} needs a {key}, since the scene states no value of {name}")
    return float(stated or nominal or 0.0)


class SpecUnit(Unit):
    """SI unit of the quantities in a prior specification."""

    def parse(self, value: Any) -> Any:
        """Return the keys of a prior specification with quantities in SI units."""
        if not isinstance(value, dict):
            return value
        key_units = dict.fromkeys(QUANTITY_KEYS, self.name) | {"tolerance": "", "ratio": ""}
        return {
            key: units.parse_quantity(x, key_units[key]) if key in key_units and not isinstance(x, bool) else x
            for key, x in value.items()
        }


PlainPriorSpec = Annotated[PriorSpec, SpecUnit("")]
OhmPriorSpec = Annotated[PriorSpec, SpecUnit("ohm")]
FaradPriorSpec = Annotated[PriorSpec, SpecUnit("F")]
VoltPriorSpec = Annotated[PriorSpec, SpecUnit("V")]
AmperePriorSpec = Annotated[PriorSpec, SpecUnit("A")]


class PriorSection(Section):
    """Prior specifications; the default median is the scene's value, and an absent parameter is not free.

    The 95 % intervals of the default skin priors extend from the values of the reference paper to published values of
    whole skin (10 kohm and 5 nF dry, 4.3 kohm and 200 nF wet). The default of the insulator, ± 5 %, is an assumption.
    Noise standard deviations (`sigma` of Vsc, `sigma_I` of I) have priors flat in their logarithm unless specified.
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
    Rgap: OhmPriorSpec | None = None
    Cgap: FaradPriorSpec | None = None
    alpha: PlainPriorSpec | None = None
    sigma: VoltPriorSpec | None = None
    sigma_I: AmperePriorSpec | None = None
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
            for key in ("tied", "above", "below"):
                other = getattr(belief, key)
                if other is not None:
                    self._check_pair(name, key, other)
        free = [name for name, belief in beliefs.items() if belief.is_free]
        Prior.of(self.correlations(), self.order_constraints(), **dict.fromkeys(free, LogNormal(1.0, 1.0)))
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
            if not belief.model_fields_set - _ORDER_KEYS:
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
