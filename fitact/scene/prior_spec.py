"""Prior specification of one quantity of a scene file."""

import math
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from fitact import units
from fitact.errors import InputError
from fitact.prior.distributions import Distribution, LogNormal, LogUniform, TruncatedLogNormal, Uniform
from fitact.prior.published import Layer, PublishedTable, published_prior
from fitact.scene.section import Section, Unit

_FORMS: tuple[tuple[set[str], set[str]], ...] = (  # required and optional keys of each form
    ({"factor"}, {"median", "low", "high"}),
    ({"relative_sd"}, {"median", "low", "high"}),
    ({"low", "high"}, {"scale"}),
    ({"tolerance"}, {"nominal"}),
    ({"table"}, set()),
    ({"fixed"}, set()),
    ({"tied"}, {"ratio"}),
)
ORDER_KEYS = {"above", "below"}
QUANTITY_KEYS = ("median", "low", "high", "nominal", "fixed")  # keys in the unit of the parameter


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
        keys, ordered = self.model_fields_set - ORDER_KEYS, self.model_fields_set & ORDER_KEYS
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
NewtonPriorSpec = Annotated[PriorSpec, SpecUnit("N")]
HertzPriorSpec = Annotated[PriorSpec, SpecUnit("Hz")]
