"""Circuit and wiring diagrams of a scene, with the values of its elements."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Literal

from markupsafe import Markup

from fitact.charts.circuit_diagram import lay_out_circuit, lay_out_wiring
from fitact.model.force import FRICTION_PARAMETERS
from fitact.summary import Summary, format_estimate
from fitact.units import format_engineering, quantity_unit

if TYPE_CHECKING:
    from fitact.scene.scene import Scene

_NOT_PARTS = {"sigma", "sigma_I", "sigma_Ft", *FRICTION_PARAMETERS}


def scene_circuit(scene: "Scene", values: Mapping[str, Summary] | None = None, *, is_file: bool = False) -> Markup:
    """Draw a scene's circuit as an SVG element, or as a file; `values`, by name, replace the scene's."""
    grounding = scene.grounding.connection
    diagram = lay_out_circuit(describe_parts(scene, values or {}), grounding, find_current_lead(scene))
    return Markup(diagram.svg(f"The circuit with {grounding} ground", is_file=is_file))


def scene_wiring(scene: "Scene", *, is_file: bool = False) -> Markup:
    """Draw how a scene's record is measured, as an SVG element, or as a file."""
    measured, grounding = scene.measurement, scene.grounding.connection
    diagram = lay_out_wiring(grounding, measured.channels, measured.series_resistor > 0.0, find_current_lead(scene))
    return Markup(diagram.svg(f"The wiring with {grounding} ground", is_file=is_file))


def find_current_lead(scene: "Scene") -> Literal["drive", "ground"] | None:
    """Return the lead in which I is recorded, or None without I; where it makes no difference, the usual one."""
    measured = scene.measurement
    if "I" not in measured.channels:
        return None
    if "current_lead" in measured.model_fields_set or scene.states_stray_capacitance():
        return measured.current_lead
    return "drive" if scene.grounding.connection == "natural" else "ground"  # the mains earth would bypass the other


def describe_parts(scene: "Scene", values: Mapping[str, Summary]) -> dict[str, str]:
    """Return each part's value with its unit, by name, of `values` with their standard deviation.

    It is "" where only a prior without a median describes the part.
    """
    nominal, measured, specs = scene.nominal_values(), scene.measurement, scene.prior.specs()
    parts: dict[str, float | None] = {name: spec.median or spec.nominal for name, spec in specs.items()}
    parts |= {name: value for name, value in nominal.items() if value is not None} | scene.fixed_values()
    described = {
        name: "" if value is None else format_engineering(value, quantity_unit(name), 3)
        for name, value in parts.items()
        if name not in _NOT_PARTS
    }
    described |= {name: _write_estimate(each) for name, each in values.items() if name in described}
    for name, (other, ratio) in scene.prior.ties().items():
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
