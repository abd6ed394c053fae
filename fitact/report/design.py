"""What to measure next as a picture and as a page: the error to expect of the force by each option and setting."""

import os

from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from matplotlib.ticker import EngFormatter

from fitact.charts import interactive as charts
from fitact.charts.figure import write_svg
from fitact.charts.interactive import Axis
from fitact.design.measurement import Curve, MeasurementDesign
from fitact.experiment.experiment import Option
from fitact.report.frame import Answer, Frame, Origin, image, write_page
from fitact.units import percent

_NOW, _OPTION, _BEST, _CHOSEN = "#999999", "#0072B2", "#009E73", "#D55E00"
_SETTINGS = {
    "series_resistor": "series resistor",
    "frequency": "frequency of the drive",
    "second_Ci": "second panel's capacitance",
}


def write_design(path: str | os.PathLike[str], design: MeasurementDesign) -> None:
    """Draw a design's expected errors of the mean force as SVG at `path`.

    Raises:
        InputError: the place cannot be written.
    """
    write_svg(path, lambda: _figure(design))


def _figure(design: MeasurementDesign) -> Figure:
    bars = _bars_height(design)
    if not design.curves:
        return _bars_figure(design)
    figure = Figure(figsize=(9.0, bars + 3.2), layout="constrained")
    above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=(bars, 3.2))[:, 0]
    _bars(above.add_subplot(), design)
    _curves(below, design)
    return figure


def _bars_figure(design: MeasurementDesign) -> Figure:
    figure = Figure(figsize=(9.0, _bars_height(design)), layout="constrained")
    _bars(figure.add_subplot(), design)
    return figure


def _curves_figure(design: MeasurementDesign) -> Figure:
    figure = Figure(figsize=(9.0, 3.2), layout="constrained")
    _curves(figure, design)
    return figure


def _bars_height(design: MeasurementDesign) -> float:
    return 0.6 + 0.34 * (2 + len(design.options))


def _curves(figure: FigureBase, design: MeasurementDesign) -> None:
    panels = figure.subplots(1, len(design.curves), sharey=True, squeeze=False)[0]
    for axes, curve in zip(panels, design.curves, strict=True):
        _along(axes, curve, design)
    panels[0].set_ylabel("error of the mean force, %")


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
        if _set_alone(option, curve):
            axes.plot(option.settings[curve.setting], 100.0 * option.force_sd, "o", color=_CHOSEN)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter("")
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.set_xlabel(f"{_SETTINGS[curve.setting]}, {curve.unit}")


def _set_alone(option: Option, curve: Curve) -> bool:
    """Whether an option changes nothing but what a curve is along."""
    return list(option.settings) == [curve.setting] and "+" not in option.name


def write_design_page(path: str | os.PathLike[str], design: MeasurementDesign, origin: Origin) -> None:
    """Write a design's page.

    Raises:
        InputError: the place cannot be written.
    """
    best, now = design.best_for_effort, design.now
    titles, *rows = design.table
    write_page(
        path,
        "design.html",
        _frame(design),
        origin,
        table=[("what is measured", *titles[1:]), *rows],
        parameters=[
            ("what is measured", *now.sd),
            *((each.text, *(f"± {percent(each.sd[name])}" for name in now.sd)) for each in (*design.options, now)),
        ],
        best=best,
        curves=_chart(design) if design.curves else None,
        bars=image(lambda: _bars_figure(design)),
        along=image(lambda: _curves_figure(design)) if design.curves else None,
    )


def _frame(design: MeasurementDesign) -> Frame:
    best, now, prior = design.best_for_effort, design.now, percent(design.prior_force_sd)
    most, *others = (
        design.sentences if best else ("Nothing that can be changed tells more of the force.", *design.sentences)
    )
    answers = [Answer("as it stands", f"± {percent(now.force_sd)}", f"before any measurement: ± {prior}")]
    if best is not None:
        answers.append(Answer("most for its effort", f"± {percent(best.force_sd)}", best.text))
    least = design.options[0] if design.options else now
    if least not in (best, now):
        answers.append(Answer("least error", f"± {percent(least.force_sd)}", least.text))
    return Frame(
        title="What to measure next",
        subject="How well the mean force would be known by what might be measured in place of the scene's measurement:"
        " standard deviations to expect.",
        trusted=design.trusted,
        verdict=most.rstrip(".") if design.trusted else f"{'; '.join(design.warnings)}.",
        findings={"What else": " ".join(others)} if others else {},
        answers=answers,
        warnings=design.warnings,
        reserved=best is None,
    )


def _chart(design: MeasurementDesign) -> charts.Chart:
    """The error along each setting, and the settings chosen."""
    plots: list[charts.Plot] = []
    reached = [sd for curve in design.curves for sd in curve.force_sd]
    limits = (0.7 * min(reached), 1.4 * max(*reached, design.now.force_sd))
    for curve in design.curves:
        x = Axis.of(_SETTINGS[curve.setting], curve.unit, curve.values, log=True)
        y = Axis("error of the mean force", "%", 0.01, log=True, limits=limits)
        ends = (curve.values[0], curve.values[-1])
        now = (design.now.force_sd, design.now.force_sd)
        chosen = [option for option in design.options if _set_alone(option, curve)]
        at, sds = [option.settings[curve.setting] for option in chosen], [option.force_sd for option in chosen]
        names = [option.text for option in chosen]
        traces = [
            charts.line(x, y, ends, now, "as it stands", _NOW, dash="dash"),
            charts.line(x, y, curve.values, curve.force_sd, "expected", _OPTION),
            charts.points(x, y, at, sds, "chosen", _CHOSEN, size=9.0, names=names),
        ]
        plots.append(charts.plot(x, (y, traces), legend=False))
    return charts.chart(*plots, controls=[charts.logarithmic(plots, "xy", "logarithmic axes")])
