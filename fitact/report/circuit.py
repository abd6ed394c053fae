"""The circuit of a scene as a drawing, each part with its value."""

from collections.abc import Mapping

from markupsafe import Markup

from fitact.charts.circuit_diagram import draw_circuit
from fitact.scene.scene import Scene
from fitact.units import format_engineering, quantity_unit

_NOT_PARTS = ("sigma", "sigma_I")
_GROUNDS = {"direct": "direct ground", "natural": "natural ground"}


def scene_circuit(scene: Scene, values: Mapping[str, float] | None = None) -> Markup:
    """Draw a scene's circuit as an SVG element.

    Args:
        values: by name, SI, such as a posterior's medians; what is absent has the scene's value.
    """
    measured, grounding = scene.measurement, scene.grounding.connection
    return Markup(
        draw_circuit(
            _describe_parts(scene, values or {}),
            grounding,
            current="I" in measured.channels,
            title=f"The circuit with {_GROUNDS[grounding]}",
        )
    )


def _describe_parts(scene: Scene, values: Mapping[str, float]) -> dict[str, str]:
    """Return each part's value with its unit, by name; "" where only a prior without a median describes it."""
    nominal, measured, specs = scene.nominal_values(), scene.measurement, scene.prior.specs()
    parts: dict[str, float | None] = {name: spec.median or spec.nominal for name, spec in specs.items()}
    parts |= {name: value for name, value in nominal.items() if value is not None} | scene.fixed_values()
    parts |= {name: value for name, value in values.items() if name in nominal}
    for name, (other, ratio) in scene.prior.ties().items():
        known = parts.get(other)
        parts[name] = None if known is None else ratio * known
    described = {
        name: "" if value is None else format_engineering(value, quantity_unit(name), 3)
        for name, value in parts.items()
        if name not in _NOT_PARTS
    }
    for name, value, unit in (
        ("probe_resistance", measured.probe_resistance, "ohm"),
        ("probe_capacitance", measured.probe_capacitance, "F"),
    ):
        if value is not None:
            described[name] = format_engineering(value, unit, 3)
    return described
