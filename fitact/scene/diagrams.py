"""Circuit and wiring diagrams of a scene, with the values of its elements."""

from collections.abc import Mapping

from markupsafe import Markup

from fitact.charts.circuit_diagram import Grounding, Lead, lay_out_circuit, lay_out_wiring
from fitact.model.force import FRICTION_PARAMETERS
from fitact.scene.sections import Measurement
from fitact.summary import Summary, format_estimate
from fitact.units import format_engineering, quantity_unit

_NOT_PARTS = {"sigma", "sigma_I", "sigma_Ft", *FRICTION_PARAMETERS}


def draw_circuit(parts: Mapping[str, str], grounding: Grounding, lead: Lead | None, *, is_file: bool) -> Markup:
    """Draw a circuit, whose `parts` have these values, as an SVG element, or as a file."""
    svg = lay_out_circuit(parts, grounding, lead).svg(f"The circuit with {grounding} ground", is_file=is_file)
    return Markup(svg)


def draw_wiring(measured: Measurement, grounding: Grounding, lead: Lead | None, *, is_file: bool) -> Markup:
    """Draw how a record is measured, as an SVG element, or as a file."""
    diagram = lay_out_wiring(grounding, measured.channels, measured.series_resistor > 0.0, lead)
    return Markup(diagram.svg(f"The wiring with {grounding} ground", is_file=is_file))


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
