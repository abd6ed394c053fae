"""What to measure next as a picture: the force's expected error of each option, and along what can be set."""

import os

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from fitact.inference.design import Curve, MeasurementDesign
from fitact.report.plots import write_svg

_NOW, _OPTION, _BEST, _CHOSEN = "#999999", "#0072B2", "#009E73", "#D55E00"
_LABELS = {
    "series_resistor": "series resistor, ohm",
    "frequency": "frequency of the drive, Hz",
    "second_Ci": "second panel's capacitance, F",
}


def write_design(path: str | os.PathLike[str], design: MeasurementDesign) -> None:
    """Draw a design's expected errors of the mean force as SVG at `path`.

    Raises:
        InputError: the place cannot be written.
    """
    write_svg(path, lambda: _figure(design))


def _figure(design: MeasurementDesign) -> Figure:
    bars = 0.34 * (2 + len(design.options))
    figure = Figure(figsize=(9.0, bars + (3.2 if design.curves else 0.6)), layout="constrained")
    if not design.curves:
        _bars(figure.add_subplot(), design)
        return figure
    grid = figure.add_gridspec(2, len(design.curves), height_ratios=(bars, 2.6))
    _bars(figure.add_subplot(grid[0, :]), design)
    first: Axes | None = None
    for column, curve in enumerate(design.curves):
        axes = figure.add_subplot(grid[1, column], sharey=first)
        _along(axes, curve, design)
        if first is None:
            first = axes
            axes.set_ylabel("error of the mean force, %")
        else:
            axes.tick_params(which="both", labelleft=False)
    return figure


def _bars(axes: Axes, design: MeasurementDesign) -> None:
    best, shown = design.best_for_effort, [*reversed(design.options), design.now]
    for place, option in enumerate(shown):
        colour = _NOW if option is design.now else _BEST if option == best else _OPTION
        axes.barh(place, 100.0 * option.force_sd, color=colour, height=0.65)
        effort = f", effort {option.effort:g}" if option.effort else ""
        label = f"{100.0 * option.force_sd:.2g} %{effort}"
        axes.annotate(label, (100.0 * option.force_sd, place), (6, 0), textcoords="offset points", va="center")
    sizes = [100.0 * option.force_sd for option in shown]
    axes.set_xscale("log")
    axes.set_xlim(0.5 * min(sizes), 8.0 * max(sizes))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set_yticks(range(len(shown)), [option.name for option in shown])
    axes.get_yticklabels()[-1].set_fontweight("bold")
    axes.grid(axis="y", visible=False)
    axes.set_xlabel("expected error of the mean force, %" + ("" if best is None else " (green: most for its effort)"))


def _along(axes: Axes, curve: Curve, design: MeasurementDesign) -> None:
    axes.plot(curve.values, [100.0 * sd for sd in curve.force_sd], color=_OPTION)
    axes.axhline(100.0 * design.now.force_sd, color=_NOW, ls="--")
    for option in design.options:
        if list(option.settings) == [curve.setting] and "+" not in option.name:
            axes.plot(option.settings[curve.setting], 100.0 * option.force_sd, "o", color=_CHOSEN)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter("")
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.set_xlabel(_LABELS[curve.setting])
