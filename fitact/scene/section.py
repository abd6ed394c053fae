"""Section of a scene file, and the units of its quantities. Inside, every number is in SI units."""

import dataclasses
from collections.abc import Iterator
from typing import Annotated, Any, get_args

import pydantic
from pydantic import BeforeValidator, ConfigDict, Field, GetCoreSchemaHandler
from pydantic.fields import FieldInfo
from pydantic_core import CoreSchema

from fitact import units


@dataclasses.dataclass(frozen=True)
class Unit:
    """SI unit of a field, as an annotation; "" for a ratio. Text with units is converted."""

    name: str

    def parse(self, value: Any) -> Any:
        """Return the value in the unit."""
        return units.parse_quantity(value, self.name)

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return BeforeValidator(self.parse).__get_pydantic_core_schema__(source, handler)


Ohm = Annotated[float, Unit("ohm"), Field(gt=0)]
AnyOhm = Annotated[float, Unit("ohm"), Field(ge=0)]
Farad = Annotated[float, Unit("F"), Field(gt=0)]
Meter = Annotated[float, Unit("m"), Field(gt=0)]
Second = Annotated[float, Unit("s"), Field(gt=0)]
AnySecond = Annotated[float, Unit("s")]
Hertz = Annotated[float, Unit("Hz"), Field(gt=0)]
Volt = Annotated[float, Unit("V"), Field(gt=0)]
AnyVolt = Annotated[float, Unit("V")]
NoiseVolt = Annotated[float, Unit("V"), Field(ge=0)]
NoiseAmpere = Annotated[float, Unit("A"), Field(ge=0)]
Ampere = Annotated[float, Unit("A"), Field(gt=0)]
Angle = Annotated[float, Unit("rad")]
Newton = Annotated[float, Unit("N"), Field(ge=0)]
Threshold = Annotated[float, Unit("N"), Field(gt=0)]
VoltPerMeter = Annotated[float, Unit("V/m"), Field(gt=0)]
Share = Annotated[float, Field(gt=0, lt=1)]
RelativeSD = Annotated[float, Field(ge=0, lt=1)]


def field_unit(field: FieldInfo) -> str | None:
    """Return the SI unit of a field; None if it is not a quantity."""
    parts = _walk_annotations(*field.metadata, field.annotation)
    return next((part.name for part in parts if isinstance(part, Unit)), None)


def field_section(field: FieldInfo) -> type["Section"] | None:
    """Return the section class of a field, or None if it is none."""
    parts = _walk_annotations(*field.metadata, field.annotation)
    return next((part for part in parts if isinstance(part, type) and issubclass(part, Section)), None)


def _walk_annotations(*annotations: Any) -> Iterator[Any]:
    for annotation in annotations:
        yield annotation
        yield from _walk_annotations(*get_args(annotation))


class Section(pydantic.BaseModel):
    """Section of a scene: frozen, without unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    def __dir__(self) -> list[str]:
        return sorted({name for name in super().__dir__() if name[0] != "_"} - set(dir(pydantic.BaseModel)))
