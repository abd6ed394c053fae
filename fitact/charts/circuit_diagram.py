"""Circuit and wiring diagrams as SVG in the colour and font of the page.

The elements stand in one column: insulator, gap, touching finger, body, and the return to the source. Only elements
with a value are drawn.
"""

import itertools
from collections.abc import Collection, Mapping
from html import escape
from typing import Any, ClassVar, Literal, NamedTuple, TypeAlias

import lazy_loader

schemdraw = lazy_loader.load("schemdraw")  # not loaded by `import fitact`

Grounding: TypeAlias = Literal["direct", "natural"]
Lead: TypeAlias = Literal["drive", "ground"]
Point: TypeAlias = tuple[float, float]


class _Columns(NamedTuple):
    """The x of what stands above each other, in units of length."""

    source: float = 0.0
    stray: float = -0.3  # a stray capacitance; the source is further to the left then
    caption: float = 0.6
    left: float = 4.1  # of two elements in parallel
    middle: float = 4.75  # of a single element
    right: float = 5.4


_X = _Columns()


class Diagram:
    """Diagram and its connections."""

    pixels: ClassVar[float] = 36.0  # of one unit of length
    font: ClassVar[float] = 13.0  # px, at the drawing's own width
    small_font: ClassVar[float] = 11.0

    def __init__(self) -> None:
        self.parts: dict[str, tuple[Point, Point]] = {}  # both ends of each element, by its name in a scene
        self.wires: list[tuple[Point, Point]] = []  # both ends of each straight wire
        self.terminals: dict[str, Point] = {}  # points between which Vsc is measured, "Vsc+" and "Vsc-"
        style = {
            "color": "currentColor",
            "lw": 1.5,
            "fontsize": self.font,
            "margin": 0.25,
            "inches_per_unit": self.pixels / 72,
        }
        self._drawing: Any = schemdraw.Drawing(canvas="svg", show=False, font="inherit")
        self._drawing.config(**style)

    def add(self, element: Any) -> Any:
        """Add an element of schemdraw; return it."""
        return self._drawing.add(element)

    def part(self, name: str, kind: Any, start: Point, end: Point, label: str = "", side: str = "right") -> None:
        """Add an element between two points; `side` of its label: right, left, top or bottom."""
        self.add(kind.endpoints(start, end))
        self.parts[name] = start, end
        dx, dy = {"right": (0.36, 0.0), "left": (-0.36, 0.0), "top": (0.0, 0.34), "bottom": (0.0, -0.34)}[side]
        self.text(label, ((start[0] + end[0]) / 2 + dx, (start[1] + end[1]) / 2 + dy), side)

    def wire(self, *points: Point) -> None:
        """Connect points by straight wires."""
        for start, end in itertools.pairwise(points):
            self.add(schemdraw.elements.Line().endpoints(start, end))
            self.wires.append((start, end))

    def text(self, text: str, at: Point, side: str = "right", is_small: bool = False) -> None:
        """Write `text`, which may have several lines, to one side of a point, or over it (side "center")."""
        across = {"right": "left", "left": "right"}.get(side, "center")
        along = {"top": "bottom", "bottom": "top"}.get(side, "center")
        if text:
            size = self.small_font if is_small else self.font
            element = schemdraw.elements.Element().at(at).theta(0)  # it would turn with what was drawn before
            element.segments.append(schemdraw.SegmentText((0, 0), text, align=(across, along), fontsize=size))
            self.add(element)

    def svg(self, title: str, *, is_file: bool = False) -> str:
        """Return an SVG element with a title, as wide as its container; `is_file`: dark lines on white for a file."""
        mode = schemdraw.svgconfig.text
        schemdraw.svgconfig.text = "text"  # so that the page's font applies
        try:
            figure = self._drawing.draw(show=False)
            content = figure.getimage().decode()
        finally:
            schemdraw.svgconfig.text = mode
        body = content[content.index(">", content.index("<svg")) + 1 :].replace("stroke-dasharray:-;", "")
        left, top = figure.bbox.xmin * self.pixels, -figure.bbox.ymax * self.pixels
        width, height = figure.pxwidth, figure.pxheight
        if is_file:
            look = f'width="{width:.0f}" height="{height:.0f}" color="#1c2733" font-family="system-ui, sans-serif"'
            body = f'<rect x="{left:.1f}" y="{top:.1f}" width="100%" height="100%" fill="#fff"/>{body}'
        else:
            look = f'style="width:100%;max-width:{1.2 * width:.0f}px;height:auto"'
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" role="img" aria-label="{escape(title)}"'
            f' viewBox="{left:.1f} {top:.1f} {width:.1f} {height:.1f}" {look}><title>{escape(title)}</title>{body}'
        )


def lay_out_circuit(
    values: Mapping[str, str], grounding: Grounding = "direct", current_lead: Lead | None = None
) -> Diagram:
    """Lay out the elements of a circuit, with a text for each part by its name in a scene.

    A part without a value is left out. The grounding skin is equal to the touching one where its own values are absent.
    A shunt is in the lead in which the current is recorded.
    """
    diagram, has_stray = Diagram(), "stray_capacitance" in values
    bottom = _add_column(diagram, values, grounding)
    x = _X.stray - 3.5 if has_stray else _X.source
    source = (x, bottom / 2 - 0.6), (x, bottom / 2 + 0.6)
    diagram.part("source", schemdraw.elements.SourceV(), *source)
    diagram.text("V", (x - 0.6, bottom / 2), "left")
    diagram.wire(source[1], (x, 0.0))
    in_lead = current_lead == "drive"
    if has_stray:
        _add_stray(diagram, values["stray_capacitance"], x, bottom - 0.3, in_lead)
        x, in_lead = _X.stray, False
    diagram.wire((x, 0.0), (1.1, 0.0))
    measured = "\nI = its voltage / R" if in_lead else ""
    if "series_resistor" in values:
        label = f"series resistor\n{values['series_resistor']}{measured}"
        diagram.part("series_resistor", schemdraw.elements.ResistorIEC(), (1.1, 0.0), (2.9, 0.0), label, "top")
    elif in_lead:
        diagram.part("shunt", schemdraw.elements.ResistorIEC(), (1.1, 0.0), (2.9, 0.0), f"shunt R{measured}", "top")
    else:
        diagram.wire((1.1, 0.0), (2.9, 0.0))
    diagram.wire((2.9, 0.0), (_X.middle, 0.0))
    if not (has_stray and current_lead == "drive"):
        _add_current(diagram, 4.3)
    _add_return(diagram, bottom, grounding, source[0], current_lead == "ground")
    return diagram


def _add_current(diagram: Diagram, x: float) -> None:
    """Draw the arrow of I in the drive lead."""
    diagram.add(schemdraw.elements.Arrowhead(headwidth=0.26, headlength=0.3).at((x, 0.0)).theta(0))
    diagram.text("I", (x - 0.1, 0.2), "top")


def _add_stray(diagram: Diagram, value: str, x: float, base: float, current: bool) -> None:
    """Draw the stray capacitance from the drive lead down to `base`, with the shunt between source (at `x`) and it."""
    if current:
        shunt = (x + 0.5, 0.0), (x + 2.3, 0.0)
        diagram.wire((x, 0.0), shunt[0])
        label = "shunt R\nI = its voltage / R"
        diagram.part("shunt", schemdraw.elements.ResistorIEC(), *shunt, label, "top")
        diagram.wire(shunt[1], (_X.stray, 0.0))
        _add_current(diagram, _X.stray - 0.4)
    else:
        diagram.wire((x, 0.0), (_X.stray, 0.0))
    label = f"stray\n{value}".strip()
    diagram.part("stray_capacitance", schemdraw.elements.Capacitor(), (_X.stray, 0.0), (_X.stray, base), label, "left")


def _add_column(diagram: Diagram, values: Mapping[str, str], grounding: Grounding) -> float:
    """Draw from the insulator down to the body's last part; return the height at which the column ends."""
    if "Ri" in values:
        diagram.wire((_X.middle, 0.0), (_X.middle, -0.5))
        y = _add_layer(diagram, ("Ri", "Ci"), values, -0.5, "insulator")
    else:
        y = _add_single(diagram, "Ci", schemdraw.elements.Capacitor(), values, 0.0, "insulator")
    if "Cgap" in values:
        y = _add_layer(diagram, ("Rgap", "Cgap"), values, y, "gap")
    y = _add_touching_skin(diagram, values, y)
    if grounding == "natural":
        if "Z" in values:
            y = _add_layer(diagram, ("Z", "Z_capacitance"), values, y, "shoes,\nchair")
        return y
    if "R_H" in values:
        y = _add_single(diagram, "R_H", schemdraw.elements.ResistorIEC(), values, y, "body")
    equal = not {"grounding_Rsc", "grounding_Csc"} & set(values)
    skin = {f"grounding_{name}": values[name] for name in ("Rsc", "Csc")} | dict(values)
    caption = "grounding\nhand" + (",\nequal" if equal else "")
    return _add_layer(diagram, ("grounding_Rsc", "grounding_Csc"), skin, y, caption)


def _add_single(diagram: Diagram, name: str, kind: Any, values: Mapping[str, str], y: float, caption: str) -> float:
    """Draw a part alone in the column from the height `y` on; return the height at which it ends."""
    end = y - 1.7
    diagram.part(name, kind, (_X.middle, y), (_X.middle, end), f"{name} {values[name]}".strip())
    diagram.text(caption, (_X.caption, (y + end) / 2), is_small=True)
    return end


def _add_layer(
    diagram: Diagram, names: tuple[str, str], values: Mapping[str, str], y: float, caption: str, height: float = 2.0
) -> float:
    """Draw a resistance and a capacitance in parallel, or the one of them that has a value."""
    end = y - height
    present = [name for name in names if name in values]
    for name in present:
        left = name == names[0]
        x = _X.middle if len(present) == 1 else _X.left if left else _X.right
        short = {"Z_capacitance": "C"}.get(name, name.removeprefix("grounding_"))
        separator = " " if len(present) == 1 else "\n"
        side = "left" if left and len(present) == 2 else "right"
        kind = schemdraw.elements.ResistorIEC() if left else schemdraw.elements.Capacitor()
        diagram.part(name, kind, (x, y), (x, end), f"{short}{separator}{values[name]}".strip(), side)
    if len(present) == 2:
        diagram.wire((_X.left, y), (_X.middle, y), (_X.right, y))
        diagram.wire((_X.left, end), (_X.middle, end), (_X.right, end))
    diagram.text(caption, (_X.caption, (y + end) / 2), is_small=True)
    diagram.wire((_X.middle, end), (_X.middle, end - 0.5))
    return end - 0.5


def _add_touching_skin(diagram: Diagram, values: Mapping[str, str], y: float) -> float:
    """Draw the skin that touches the panel with the points that Vsc is measured between, and the probe across it."""
    shown = dict(values)
    if "alpha" in values:
        shown["Csc"] += f"\nalpha {values['alpha']}"
    below = _add_layer(diagram, ("Rsc", "Csc"), shown, y, "touching\nfinger", height=2.4)
    probe = [name for name in ("probe_resistance", "probe_capacitance") if name in values]
    end, x = y - 2.4, 8.1 if probe else 7.6
    for name in probe:
        kind = schemdraw.elements.ResistorIEC() if name == "probe_resistance" else schemdraw.elements.Capacitor()
        diagram.part(name, kind, (x, y), (x, end))
        x += 0.75
    if probe:
        diagram.text("\n".join(["probe", *(values[name] for name in probe)]), (x - 0.4, (y + end) / 2))
        x += 1.1
    for name, at, place, side in (("Vsc+", y, "skin's surface", "top"), ("Vsc-", end, "inside the finger", "bottom")):
        diagram.wire((_X.right, at), (x, at))
        diagram.add(schemdraw.elements.Dot(open=True, radius=0.09).at((x, at)))
        diagram.terminals[name] = x, at
        diagram.text("+" if name == "Vsc+" else "−", (x + 0.2, at))
        diagram.text(place, ((_X.right + 7.2) / 2 + 0.1, at + (0.12 if side == "top" else -0.12)), side, is_small=True)
    diagram.text("Vsc", (x + 0.1, (y + end) / 2))
    return below


def _add_return(diagram: Diagram, bottom: float, grounding: Grounding, source: Point, current: bool) -> None:
    """Draw the way from the column's end back to the source, with the shunt if the `current` is recorded there."""
    base = bottom - 0.3
    diagram.wire((_X.middle, bottom), (_X.middle, base), (3.4, base))
    if current:
        diagram.part("shunt", schemdraw.elements.ResistorIEC(), (3.4, base), (1.6, base), "shunt R", "top")
        diagram.text("I = its voltage / R", (2.5, base - 0.4), "bottom", is_small=True)
    else:
        diagram.wire((3.4, base), (1.6, base))
    diagram.wire((1.6, base), (source[0], base), source)
    ground = (_X.middle, "earth") if grounding == "natural" else (source[0], "ground electrode")
    diagram.add(schemdraw.elements.Ground().at((ground[0], base)))
    diagram.text(ground[1], (_X.middle + 0.35, base - (0.3 if grounding == "natural" else 0.0)), is_small=True)


def lay_out_wiring(
    grounding: Grounding,
    channels: Collection[str] = ("Vsc", "I"),
    series_resistor: bool = False,
    current_lead: Lead | None = None,
) -> Diagram:
    """Lay out the wiring of a bench: oscilloscope channel 1 on V, 2 on Vsc, and 3 on the current.

    `channels` are recorded besides V; `series_resistor`: whether a known resistor is in the lead to the electrode;
    `current_lead`: the lead in which the current is recorded, if it is.
    """
    diagram, elements, direct = Diagram(), schemdraw.elements, grounding == "direct"
    for (x, y), (width, height), text in (
        ((0.0, -2.4), (2.0, 2.6), "amplifier"),
        ((5.6, -0.8), (3.8, 0.55), "electrode"),
        ((5.6, -0.25), (3.8, 0.5), "insulator"),
        ((6.4, 0.25), (2.4, 1.25), "finger"),
        ((5.8, -2.9), (3.6, 0.8), "other hand" if direct else "shoes, chair"),
        ((5.8, -3.4), (3.6, 0.5), "ground electrode" if direct else "earth"),
    ):
        diagram.add(elements.Rect((0.0, 0.0), (width, height)).at((x, y)).theta(0))
        diagram.text(text, (x + width / 2, y + height / 2), "center")
    diagram.wire((8.8, 0.9), (9.9, 0.9), (9.9, -2.5), (9.4, -2.5))
    diagram.text("body", (10.0, -0.8))
    in_lead = "series\nresistor" if series_resistor else "shunt" if current_lead == "drive" else ""
    start, end = (2.9, -0.5), (4.9, -0.5)
    diagram.wire((2.0, -0.5), start)
    if in_lead:
        diagram.part(in_lead, elements.ResistorIEC(), start, end, in_lead, "top")
    else:
        diagram.wire(start, end)
    diagram.wire(end, (5.6, -0.5))
    start, end = (5.8, -3.15), (3.8, -3.15)
    if current_lead == "ground":
        diagram.part("shunt", elements.ResistorIEC(), start, end, "shunt", "top")
    else:
        diagram.wire(start, end)
    diagram.wire(end, (2.9, -3.15), (2.9, -1.9), (2.0, -1.9))
    diagram.add(elements.Ground().at((2.9, -3.15)))
    diagram.text("common\nground", (2.55, -3.6), "left")
    taps = [((2.55, -0.5), 1.2, "1: V")]
    if current_lead == "ground":
        taps += [((5.45, -3.15), -0.8, "3: I × shunt")]
    elif current_lead == "drive":
        taps += [((2.55, -0.5), -0.7, "3 +"), ((5.2, -0.5), -0.7, "3 −: I × resistance")]
    for (x, y), length, text in taps:
        _add_tap(diagram, (x, y), (x, y + length), text, "top" if length > 0.0 else "bottom")
    if "Vsc" in channels:
        _add_tap(diagram, (6.4, 0.4), (5.6, 1.1), "2 +: Vsc", "left")
        _add_tap(diagram, (7.6, 1.5), (7.6, 2.1), "2 −: Vsc", "top")
    return diagram


def _add_tap(diagram: Diagram, start: Point, end: Point, text: str, side: str) -> None:
    """Draw the lead of an oscilloscope's channel."""
    diagram.wire(start, end)
    diagram.add(schemdraw.elements.Dot(open=True, radius=0.09).at(end))
    dx, dy = {"top": (0.0, 0.14), "bottom": (0.0, -0.14), "left": (-0.16, 0.0)}[side]
    diagram.text(text, (end[0] + dx, end[1] + dy), side)
