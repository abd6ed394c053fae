"""The next measurement as a picture: expected uncertainty of the force by option and setting."""

from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fitact.charts import interactive
from fitact.charts.figure import ALERT, GREEN, MODEL, PRIOR, FigureMaker
from fitact.charts.interactive import Axis
from fitact.charts.picture import draw_plots

_SETTINGS = {
    "series_resistor": "series resistor",
    "frequency": "frequency of the drive",
    "second_Ci": "second panel's capacitance",
}


def draw_design(content: dict[str, Any], has_curves: bool = True, make: FigureMaker = Figure) -> Figure:
    """Draw the expected uncertainties, above curves along the continuous settings; `content` is that of design.json."""
    chart = settings_chart(content) if has_curves else None
    heights = [0.6 + 0.34 * (2 + len(content["options"])), *([3.2] if chart else [])]
    figure = make(figsize=(9.0, sum(heights)), layout="constrained")
    parts = figure.subfigures(len(heights), 1, squeeze=False, height_ratios=heights)[:, 0]
    _draw_bars(parts[0].add_subplot(), content)
    if chart:
        draw_plots(parts[1], chart["plots"])
    return figure


def _draw_bars(axes: Axes, content: dict[str, Any]) -> None:
    best, now, shown = content["best_for_effort"], content["now"], [*reversed(content["options"]), content["now"]]
    colors = [PRIOR if option is now else GREEN if option["name"] == best else MODEL for option in shown]
    efforts = [f", effort {option['effort']:g}" if option["effort"] else "" for option in shown]
    sizes = [100.0 * option["force_sd"] for option in shown]
    bars = axes.barh(range(len(shown)), sizes, color=colors, height=0.65)
    axes.bar_label(bars, [f"{size:.2g} %{effort}" for size, effort in zip(sizes, efforts, strict=True)], padding=6)
    axes.set(xscale="log", xlim=(0.5 * min(sizes), 8.0 * max(sizes)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set_yticks(range(len(shown)), [option["name"] for option in shown])
    axes.get_yticklabels()[-1].set_fontweight("bold")
    axes.grid(axis="y", visible=False)
    axes.set_xlabel(
        "expected uncertainty of the mean force, %" + ("" if best is None else " (green: largest gain per effort)")
    )


def settings_chart(content: dict[str, Any]) -> interactive.Chart | None:
    """Make the chart of the uncertainty along each setting; None without continuous settings."""
    if not content["curves"]:
        return None
    now_sd = content["now"]["force_sd"]
    plots: list[interactive.Plot] = []
    reached = [sd for curve in content["curves"] for sd in curve["force_sd"]]
    limits = (0.7 * min(reached), 1.4 * max(*reached, now_sd))
    for curve in content["curves"]:
        x = Axis.from_values(_SETTINGS[curve["setting"]], curve["unit"], curve["values"], log=True)
        y = Axis("uncertainty of the mean force", "%", 0.01, log=True, limits=limits)
        ends = (curve["values"][0], curve["values"][-1])
        now = (now_sd, now_sd)
        alone = [option for option in content["options"] if list(option["settings"]) == [curve["setting"]]]
        chosen = [option for option in alone if "+" not in option["name"]]
        at, sds = [option["settings"][curve["setting"]] for option in chosen], [option["force_sd"] for option in chosen]
        names = [option["text"] for option in chosen]
        traces = [
            interactive.line(x, y, ends, now, "as it stands", PRIOR, dash="dash"),
            interactive.line(x, y, curve["values"], curve["force_sd"], "expected", MODEL),
            interactive.points(x, y, at, sds, "chosen", ALERT, size=9.0, names=names),
        ]
        plots.append(interactive.plot(x, (y, traces), legend=False))
    return interactive.chart(*plots, controls=[interactive.log_axis_button(plots, "xy", "logarithmic axes")])
