"""Interactive charts for plotly.js, as plain dictionaries.

A chart is one or more plots side by side under common controls. The page holds the numbers as floats in base64, in the
units of the axes; x has 64 bits, so that late samples of a record remain distinct.
"""

import base64
import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from fitact.charts.figure import DATA, MODEL
from fitact.units import choose_prefixed_unit

PlotlyTrace = dict[str, Any]
Plot = dict[str, Any]
Chart = dict[str, Any]

_FONT = {"family": "system-ui, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif", "size": 13, "color": "#1c2733"}
_AXIS = {
    "showline": True, "linecolor": "#51606f", "ticks": "outside", "tickcolor": "#51606f", "gridcolor": "#e3e7eb",
    "zeroline": False, "automargin": True, "exponentformat": "SI",
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Axis:
    """A quantity along an axis."""

    title: str  # name of the quantity
    symbol: str = ""  # displayed unit, with its prefix
    size: float = 1.0  # of the displayed unit, SI
    log: bool = False  # whether the axis is initially logarithmic
    limits: tuple[float, float] | None = None  # initial limits, SI; None means all data
    hides_numbers: bool = False  # whether the axis starts at 0 and has no numbers
    has_tick_prefixes: bool = False  # whether each tick has its own prefix (for many decades)
    # plotly.js labels powers of ten if there are fewer ticks than 1.4 for each decade, and otherwise 1, 2, 5 or all
    # digits, which overlap
    log_ticks: int = 3
    linear_ticks: ClassVar[int] = 6

    @classmethod
    def from_values(
        cls, title: str, unit: str, values: ArrayLike, *, log: bool = False, limits: tuple[float, float] | None = None
    ) -> Self:
        """Make an axis with a suitable prefix of `unit` (SI) for `values`."""
        sizes = np.abs(np.asarray(values, dtype=float))
        sizes = sizes[np.isfinite(sizes) & (sizes > 0.0)]
        # beyond four decades no single prefix is readable
        decades = float(np.log10(sizes.max() / sizes.min())) if log and sizes.size else 0.0
        wide = decades > 4.0
        middle = float(np.sqrt(sizes.min() * sizes.max()) if log else sizes.max()) if sizes.size and not wide else 0.0
        size, symbol = choose_prefixed_unit(middle, unit)
        ticks = min(max(cls.log_ticks, math.ceil(decades)), cls.linear_ticks)
        return cls(title, symbol, size, log, limits, has_tick_prefixes=wide, log_ticks=ticks)

    def encode(self, values: ArrayLike, dtype: str = "f4") -> dict[str, str]:
        """Return `values` (SI) in the displayed unit, encoded for plotly.js."""
        numbers = (np.asarray(values, dtype=float) / self.size).astype(f"<{dtype}")
        return {"dtype": dtype, "bdata": base64.b64encode(numbers.tobytes()).decode()}

    def layout(self) -> dict[str, Any]:
        """Return the axis layout for plotly.js."""
        title = f"{self.title} / {self.symbol}" if self.symbol else self.title
        layout = _AXIS | {"title": {"text": title, "standoff": 6}, "type": "log" if self.log else "linear"}
        layout["nticks"] = self.log_ticks if self.log else self.linear_ticks
        if self.has_tick_prefixes:
            layout["tickformat"] = "~s"
        if self.hides_numbers:
            layout |= {"showticklabels": False, "ticks": "", "showgrid": False, "rangemode": "tozero"}
        if self.limits is not None:
            ends = np.asarray(self.limits) / self.size
            layout["range"] = (np.log10(ends) if self.log else ends).tolist()
        return layout

    def hover(self, letter: str) -> str:
        """Return the hover template of a value with its unit."""
        if self.has_tick_prefixes:
            return f"%{{{letter}:.4~s}}{self.symbol}"
        return f"%{{{letter}:.5~g}} {self.symbol}".rstrip()


def line(
    x: Axis, y: Axis, x_values: ArrayLike, values: ArrayLike, name: str, color: str = MODEL, *, width: float = 1.8,
    dash: str = "solid",
) -> PlotlyTrace:  # fmt: skip
    """Return a curve; `dash` is a line style of plotly (solid, dash, dot)."""
    style = {"color": color, "width": width, "dash": dash, "simplify": False}
    return _trace(x, y, x_values, values, name) | {"mode": "lines", "line": style}


def points(
    x: Axis, y: Axis, x_values: ArrayLike, values: ArrayLike, name: str, color: str = DATA, *, size: float = 6.0,
    hollow: bool = False, names: Sequence[str] | None = None, opacity: float = 1.0,
) -> PlotlyTrace:  # fmt: skip
    """Return markers; `names` are shown on hover."""
    marker = {"color": color, "size": size, "symbol": "circle-open" if hollow else "circle", "opacity": opacity}
    trace = _trace(x, y, x_values, values, name) | {"mode": "markers", "marker": marker}
    if names is not None:
        place = f"{x.title}: {x.hover('x')}<br>{y.title}: {y.hover('y')}"
        trace |= {"text": list(names), "hovertemplate": f"%{{text}}<br>{place}<extra></extra>"}
    return trace


def band(
    x: Axis, y: Axis, x_values: ArrayLike, low: ArrayLike, high: ArrayLike, names: tuple[str, str, str],
    color: str = MODEL,
) -> list[PlotlyTrace]:  # fmt: skip
    """Return the area between two curves; `names` holds the names of lower edge, upper edge and area."""
    below, above, area = names
    edge = {"mode": "lines", "line": {"width": 0, "color": color}, "legendgroup": area}
    lower = _trace(x, y, x_values, low, below) | edge | {"showlegend": False}
    upper = _trace(x, y, x_values, high, area) | edge | {"fill": "tonexty", "fillcolor": _rgba(color)}
    return [lower, upper | {"hovertemplate": f"{above}: {y.hover('y')}<extra></extra>"}]


def density(x: Axis, draws: ArrayLike, name: str, color: str = MODEL, *, bins: int = 80) -> PlotlyTrace:
    """Return the density of positive draws, scaled to a peak of 1; hovering shows the fraction of draws below.

    The density refers to the axis as it is drawn: `log_axis_button` exchanges the densities of the linear and of the
    logarithmic axis.
    """
    values = np.asarray(draws, dtype=float).ravel()
    edges = np.geomspace(values.min(), values.max() * (1.0 + 1e-9), bins + 1)
    counts, _ = np.histogram(values, edges)
    below = np.concatenate([[0.0], np.cumsum(counts)]) / values.size
    heights = {"log": counts / counts.max(), "linear": counts / np.diff(edges)}
    heights["linear"] /= heights["linear"].max()
    plain = Axis("")
    encoded = {kind: plain.encode(np.append(values, 0.0)) for kind, values in heights.items()}
    return {
        "type": "scatter", "mode": "lines", "name": name, "x": x.encode(edges, "f8"),
        "y": encoded["log" if x.log else "linear"],
        "line": {"shape": "hv", "color": color, "width": 1.2}, "fill": "tozeroy", "fillcolor": _rgba(color),
        "customdata": plain.encode(below), "meta": encoded,
        "hovertemplate": f"{name}: %{{customdata:.1%}} below {x.hover('x')}<extra></extra>",
    }  # fmt: skip


def extremes(values: ArrayLike, columns: int = 2000) -> np.ndarray:
    """Return indices of minimum and maximum in each of `columns` intervals, which suffice to draw a series."""
    numbers = np.asarray(values, dtype=float)
    if numbers.size <= 2 * columns:
        return np.arange(numbers.size)
    stretches = np.array_split(np.arange(numbers.size), columns)
    ends = [index for part in stretches for index in (part[numbers[part].argmin()], part[numbers[part].argmax()])]
    return np.unique(ends)


def plot(
    x: Axis, *rows: tuple[Axis, Iterable[PlotlyTrace]], heights: Sequence[float] = (1.0,), title: str = "",
    size: int = 320, legend: bool = True, unified_hover: bool = False,
) -> Plot:  # fmt: skip
    """Return a plot of several rows (y axis, traces) over one x axis, `size` pixels high.

    With `unified_hover`, hovering shows all traces at this x, and else only the nearest point.
    """
    data: list[PlotlyTrace] = []
    layout: dict[str, Any] = {
        "font": _FONT, "height": size, "paper_bgcolor": "#fff", "plot_bgcolor": "#fff",
        "margin": {"l": 56, "r": 12, "t": 34 if legend else 12, "b": 44},
        "hovermode": "x unified" if unified_hover else "closest", "hoversubplots": "axis", "showlegend": legend,
        "legend": {"orientation": "h", "x": 0, "y": 1, "yanchor": "bottom"},
        "xaxis": x.layout() | {"hoverformat": ".5~g", "unifiedhovertitle": {"text": x.hover("x")}},
    }  # fmt: skip
    shares = np.cumsum([0.0, *heights[: len(rows)]])
    tops, gap = 1.0 - shares / shares[-1], 0.06 if len(rows) > 1 else 0.0
    for number, (y, traces) in enumerate(rows, start=1):
        suffix = "" if number == 1 else str(number)
        ends = [float(tops[number]) + (gap if number < len(rows) else 0.0), float(tops[number - 1])]
        layout[f"yaxis{suffix}"] = y.layout() | {"domain": ends}
        data += [trace | {"yaxis": f"y{suffix}"} for trace in traces]
    layout["xaxis"] |= {"anchor": "y" if len(rows) == 1 else f"y{len(rows)}"}
    label = " and ".join(y.title for y, _ in rows) + f" against {x.title}"
    return {"data": data, "layout": layout, "title": title, "label": f"{title}: {label}" if title else label}


def shade_interval(plot: Plot, x: Axis, low: float, high: float) -> Plot:
    """Return the plot with an interval of x shaded."""
    return _with_shape(plot, low / x.size, high / x.size, {"line": {"width": 0}, "fillcolor": _rgba(MODEL, 0.12)})


def mark_position(plot: Plot, x: Axis, position: float, color: str) -> Plot:
    """Return the plot with a dashed vertical line at one x."""
    at = position / x.size
    return _with_shape(plot, at, at, {"line": {"width": 1.2, "color": color, "dash": "dash"}})


def chart(*plots: Plot, controls: Sequence[dict[str, Any]] = ()) -> Chart:
    """Return a chart for the macro `chart` of templates/figures.html."""
    return {"plots": list(plots), "controls": list(controls)}


def visibility_button(label: str, plots: Sequence[Plot], name: str) -> dict[str, Any]:
    """Return a button that shows or hides the traces named `name`."""
    return {"label": label, "pressed": True, "updates": [_visibility_update(p, name) for p in plots]}


def log_axis_button(plots: Sequence[Plot], axes: str = "x", label: str = "logarithmic axis") -> dict[str, Any]:
    """Return a button that toggles logarithmic `axes` ("x", "y" or "xy"); all plots must start the same."""
    states = {kind: [_axis_type_update(p, axes, kind) for p in plots] for kind in ("log", "linear")}
    updates = [{"on": on, "off": off} for on, off in zip(states["log"], states["linear"], strict=True)]
    pressed = plots[0]["layout"][f"{axes[0]}axis"]["type"] == "log"
    return {"label": label, "pressed": pressed, "updates": updates}


def _with_shape(plot: Plot, low: float, high: float, style: dict[str, Any]) -> Plot:
    shape = {"type": "rect", "x0": low, "x1": high, "yref": "paper", "y0": 0, "y1": 1} | style
    shapes = [*plot["layout"].get("shapes", []), shape]
    return plot | {"layout": plot["layout"] | {"shapes": shapes}}


def _visibility_update(plot: Plot, name: str) -> dict[str, Any]:
    traces = [i for i, trace in enumerate(plot["data"]) if name in (trace["name"], trace.get("legendgroup"))]
    return {state: {"traces": traces, "restyle": {"visible": state == "on"}, "relayout": {}} for state in ("on", "off")}


def _axis_type_update(plot: Plot, axes: str, kind: str) -> dict[str, Any]:
    layout = plot["layout"]
    names = [name for name in layout if name[:5] in [f"{letter}axis" for letter in axes]]
    traces = [i for i, trace in enumerate(plot["data"]) if "x" in axes and "meta" in trace]
    ticks = {name: layout[name]["nticks"] if layout[name]["type"] == "log" else Axis.log_ticks for name in names}
    return {
        "traces": traces,
        "restyle": {"y": [plot["data"][i]["meta"][kind] for i in traces]} if traces else {},
        "relayout": {f"{name}.type": kind for name in names}
        | {f"{name}.nticks": ticks[name] if kind == "log" else Axis.linear_ticks for name in names},
    }


def _trace(x: Axis, y: Axis, x_values: ArrayLike, values: ArrayLike, name: str) -> PlotlyTrace:
    return {
        "type": "scatter", "x": x.encode(x_values, "f8"), "y": y.encode(values), "name": name,
        "hovertemplate": f"{name}: {y.hover('y')}<extra></extra>",
    }  # fmt: skip


def _rgba(color: str, opacity: float = 0.35) -> str:
    red, green, blue = (int(color[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},{opacity})"
