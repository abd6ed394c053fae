"""Numbers of a scene file that may be stated with a distribution."""

import dataclasses
import math
from collections.abc import Callable
from typing import Annotated, Any, Self

from pydantic import Field, GetCoreSchemaHandler
from pydantic_core import CoreSchema, core_schema

from fitact.prior.distributions import Distribution
from fitact.prior.published import Layer
from fitact.scene.prior_spec import QUANTITY_KEYS, PriorSpec, SpecUnit
from fitact.scene.section import Unit


class UncertainValue(float):
    """Number with a stated distribution; its value is the stated median or the middle between the limits."""

    spec: PriorSpec

    @classmethod
    def from_spec(cls, spec: PriorSpec) -> Self:
        low, high = spec.low or 0.0, spec.high or 0.0
        middle = math.sqrt(low * high) if spec.scale == "log" else 0.5 * (low + high)
        value = cls(spec.median or spec.nominal or middle)
        value.spec = spec
        return value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, UncertainValue) and self.spec == other.spec

    def __ne__(self, other: object) -> bool:
        return not self == other

    __hash__ = float.__hash__

    def distribution(self) -> Distribution:
        """Return the stated distribution."""
        return self.spec.distribution("", None, Layer(1.0, 1.0, 1.0))  # neither a table nor a default median


@dataclasses.dataclass(frozen=True)
class UncertainUnit(Unit):
    """SI unit of a number that may be stated with a distribution, as an annotation."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        serialization = core_schema.plain_serializer_function_ser_schema(_to_stated_form)
        return core_schema.no_info_wrap_validator_function(self._validate, handler(source), serialization=serialization)

    def _validate(self, value: Any, check_number: Callable[[Any], float]) -> float:
        if isinstance(value, UncertainValue):
            return value
        if not isinstance(value, dict):
            return check_number(self.parse(value))
        spec = PriorSpec.model_validate(SpecUnit(self.name).parse(value))
        forms = {"median", "relative_sd"}, {"median", "factor"}, {"low", "high"}, {"nominal", "tolerance"}
        if spec.model_fields_set - {"scale"} not in forms:
            raise ValueError("write {median, relative_sd}, {median, factor}, {low, high} or {nominal, tolerance}")
        for number in (getattr(spec, key) for key in QUANTITY_KEYS):
            if number is not None:
                check_number(number)
        return UncertainValue.from_spec(spec)


def _to_stated_form(value: float) -> float | dict[str, Any]:
    return value.spec.model_dump(mode="json", exclude_unset=True) if isinstance(value, UncertainValue) else value


UncertainMeter = Annotated[float, Field(gt=0), UncertainUnit("m")]
UncertainSquareMeter = Annotated[float, Field(gt=0), UncertainUnit("m^2")]
UncertainPermittivity = Annotated[float, Field(ge=1), UncertainUnit("")]
UncertainFarad = Annotated[float, Field(ge=0), UncertainUnit("F")]
UncertainCoefficient = Annotated[float, Field(gt=0), UncertainUnit("")]
