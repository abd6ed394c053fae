"""The next measurement as a picture and as a page: expected uncertainty of the force by option and setting."""

import os

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fitact.charts import interactive
from fitact.charts.figure import ALERT, GREEN, MODEL, PRIOR
from fitact.charts.interactive import Axis
from fitact.charts.picture import draw_plots
from fitact.design.measurement import MeasurementDesign
from fitact.report.frame import Answer, PageSummary, Provenance, image, write_page
from fitact.units import format_percent

_SETTINGS = {
    "series_resistor": "series resistor",
    "frequency": "frequency of the drive",
    "second_Ci": "second panel's capacitance",
}


def draw_design(design: MeasurementDesign, has_curves: bool = True) -> Figure:
    """Draw bars of the expected uncertainties, above the curves along the continuous settings."""
    chart = _chart(design) if has_curves else None
    heights = [0.6 + 0.34 * (2 + len(design.options)), *([3.2] if chart else [])]
    figure = Figure(figsize=(9.0, sum(heights)), layout="constrained")
    parts = figure.subfigures(len(heights), 1, squeeze=False, height_ratios=heights)[:, 0]
    _draw_bars(parts[0].add_subplot(), design)
    if chart:
        draw_plots(parts[1], chart["plots"])
    return figure


def _draw_bars(axes: Axes, design: MeasurementDesign) -> None:
    best, shown = design.best_for_effort, [*reversed(design.options), design.now]
    colors = [PRIOR if option is design.now else GREEN if option == best else MODEL for option in shown]
    efforts = [f", effort {option.effort:g}" if option.effort else "" for option in shown]
    sizes = [100.0 * option.force_sd for option in shown]
    bars = axes.barh(range(len(shown)), sizes, color=colors, height=0.65)
    axes.bar_label(bars, [f"{size:.2g} %{effort}" for size, effort in zip(sizes, efforts, strict=True)], padding=6)
    axes.set(xscale="log", xlim=(0.5 * min(sizes), 8.0 * max(sizes)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set_yticks(range(len(shown)), [option.name for option in shown])
    axes.get_yticklabels()[-1].set_fontweight("bold")
    axes.grid(axis="y", visible=False)
    axes.set_xlabel(
        "expected uncertainty of the mean force, %" + ("" if best is None else " (green: largest gain per effort)")
    )


def write_design_page(path: str | os.PathLike[str], design: MeasurementDesign, origin: Provenance) -> None:
    best, now = design.best_for_effort, design.now
    titles, *rows = design.table
    write_page(
        path,
        "design.html",
        frame=_frame(design),
        origin=origin,
        table=[("what is measured", *titles[1:]), *rows],
        parameters=[
            ("what is measured", *now.sd),
            *(
                (each.text, *(f"± {format_percent(each.sd[name])}" for name in now.sd))
                for each in (*design.options, now)
            ),
        ],
        best=best,
        curves=_chart(design),
        bars=image(lambda: draw_design(design, has_curves=False)),
    )


def _frame(design: MeasurementDesign) -> PageSummary:
    best, now, prior = design.best_for_effort, design.now, format_percent(design.prior_force_sd)
    most, *others = (
        design.sentences if best else ("No change reduces the uncertainty of the mean force.", *design.sentences)
    )
    answers = [Answer("as it stands", f"± {format_percent(now.force_sd)}", f"before any measurement: ± {prior}")]
    if best is not None:
        answers.append(Answer("largest gain per effort", f"± {format_percent(best.force_sd)}", best.text))
    least = design.options[0] if design.options else now
    if least not in (best, now):
        answers.append(Answer("smallest uncertainty", f"± {format_percent(least.force_sd)}", least.text))
    return PageSummary(
        title="What to measure next",
        subject="Expected uncertainty (1 sd) of the mean force after a change of the scene's measurement."
        " Calibration errors are not included.",
        trusted=design.trusted,
        verdict=most.rstrip(".") if design.trusted else f"{'; '.join(design.warnings)}.",
        findings={"Other changes": " ".join(others)} if others else {},
        answers=answers,
        warnings=design.warnings,
        has_reservation=best is None,
    )


def _chart(design: MeasurementDesign) -> interactive.Chart | None:
    """Make the chart of the uncertainty along each setting; None without continuous settings."""
    if not design.curves:
        return None
    plots: list[interactive.Plot] = []
    reached = [sd for curve in design.curves for sd in curve.force_sd]
    limits = (0.7 * min(reached), 1.4 * max(*reached, design.now.force_sd))
    for curve in design.curves:
        x = Axis.from_values(_SETTINGS[curve.setting], curve.unit, curve.values, log=True)
        y = Axis("uncertainty of the mean force", "%", 0.01, log=True, limits=limits)
        ends = (curve.values[0], curve.values[-1])
        now = (design.now.force_sd, design.now.force_sd)
        alone = [option for option in design.options if list(option.settings) == [curve.setting]]
        chosen = [option for option in alone if "+" not in option.name]
        at, sds = [option.settings[curve.setting] for option in chosen], [option.force_sd for option in chosen]
        names = [option.text for option in chosen]
        traces = [
            interactive.line(x, y, ends, now, "as it stands", PRIOR, dash="dash"),
            interactive.line(x, y, curve.values, curve.force_sd, "expected", MODEL),
            interactive.points(x, y, at, sds, "chosen", ALERT, size=9.0, names=names),
        ]
        plots.append(interactive.plot(x, (y, traces), legend=False))
    return interactive.chart(*plots, controls=[interactive.log_axis_button(plots, "xy", "logarithmic axes")])
