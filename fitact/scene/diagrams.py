"""Values of the elements in the circuit diagram of a scene."""

from collections.abc import Mapping

from fitact.model.force import FRICTION_PARAMETERS
from fitact.scene.sections import Measurement
from fitact.summary import Summary, format_estimate
from fitact.units import format_engineering, quantity_unit

_NOT_PARTS = {"sigma", "sigma_I", "sigma_Ft", *FRICTION_PARAMETERS}


def describe_parts(
    parts: Mapping[str, float | None],
    ties: Mapping[str, tuple[str, float]],
    measured: Measurement,
    values: Mapping[str, Summary],
) -> dict[str, str]:
    """Return each part's value (SI) with its unit, by name, of `values` with their standard deviation.

    `ties` are the (name, ratio) of parts proportional to another. A part without a value is "".
    """
    described = {
        name: "" if value is None else format_engineering(value, quantity_unit(name), 3)
        for name, value in parts.items()
        if name not in _NOT_PARTS
    }
    described |= {name: _write_estimate(each) for name, each in values.items() if name in described}
    for name, (other, ratio) in ties.items():
        if other in values:
            tied = {key: ratio * float(values[other][key]) for key in ("q50", "sd", "mean")}
            described[name] = _write_estimate(tied | {"unit": quantity_unit(name)})
        elif (known := parts.get(other)) is not None:
            described[name] = format_engineering(ratio * known, quantity_unit(name), 3)
    for name, value, unit in (
        ("probe_resistance", measured.probe_resistance, "ohm"),
        ("probe_capacitance", measured.probe_capacitance, "F"),
    ):
        if value is not None:
            described[name] = format_engineering(value, unit, 3)
    return described


def _write_estimate(each: Summary) -> str:
    """Return the median above its standard deviation, which is short enough for a drawing."""
    return format_estimate(each).replace(" ±", "\n±")
