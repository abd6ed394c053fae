"""The design of a drive as a picture and as a page: who feels it, at which frequency, on which insulator."""

import os
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fitact.charts import interactive
from fitact.charts.figure import ALERT, DATA, GREEN, MODEL, ORANGE, PINK, PRIOR, SKY, log_ticks
from fitact.charts.interactive import Axis
from fitact.charts.picture import draw_plot
from fitact.design.drive_design import DriveDesign
from fitact.design.drive_option import FINGER_QUANTILES, DriveOption, quantile
from fitact.design.limits import NO_SAFETY_ASSESSMENT, format_quantity
from fitact.report.frame import Answer, PageSummary, Provenance, image, write_page
from fitact.units import format_engineering

_COLORS = {"sine": MODEL, "triangle": GREEN, "square": PINK, "trapezoid": DATA, "multitone": SKY}
_VOLTAGES = (
    "Set the amplitude in the first sentence. The table also gives its Monte Carlo error, which says how far another"
    " seed changes it"
)
_INTERVALS = ", and the median and 90 % interval, which say what is known of the amplitude that just suffices"


def draw_drive_design(design: DriveDesign) -> Figure:
    """Draw the drive curves and the required amplitudes."""
    figure = Figure(figsize=(11.0, 8.0), layout="constrained")
    (curves, frequencies), (thicknesses, permittivities) = figure.subplots(2, 2)
    draw_plot(_curve_plot(design), curves)
    draw_plot(_frequency_plot(design), frequencies)
    _note_if_empty(frequencies)
    _draw_both_insulators(thicknesses, permittivities, design)
    return figure


def _insulator_figure(design: DriveDesign) -> Figure:
    figure = Figure(figsize=(11.0, 4.0), layout="constrained")
    thicknesses, permittivities = figure.subplots(1, 2)
    _draw_both_insulators(thicknesses, permittivities, design)
    return figure


def _draw_both_insulators(thicknesses: Axes, permittivities: Axes, design: DriveDesign) -> None:
    thickness = [option.device.insulator_thickness for option in design.by_thickness]
    _draw_insulators(thicknesses, design, design.by_thickness, thickness)
    thicknesses.set(xscale="log", xlim=(0.8 * thickness[0], 1.25 * thickness[-1]), xlabel="insulator thickness")
    log_ticks(thicknesses.xaxis, "m", (1.0,))
    thicknesses.legend(fontsize=9)
    permittivity = [option.device.insulator_permittivity for option in design.by_permittivity]
    _draw_insulators(permittivities, design, design.by_permittivity, permittivity)
    permittivities.set_xlabel("insulator's relative permittivity")


def _order_waveforms(design: DriveDesign) -> list[str]:
    return sorted(design.options, key=lambda name: name != design.scene_waveform)


def _line_width(design: DriveDesign, name: str) -> float:
    """Return the line width; the scene's waveform is wider, so that it stays visible under other curves."""
    return 3.0 if name == design.scene_waveform else 1.3


def _draw_insulators(axes: Axes, design: DriveDesign, options: Sequence[DriveOption], at: Sequence[float]) -> None:
    color = _COLORS[design.scene_waveform]
    low, median, high = (_mask_infinite([float(quantile(o.amplitude, q)) for o in options]) for q in (0.05, 0.5, 0.95))
    axes.fill_between(at, low, high, color=color, alpha=0.25, lw=0)
    axes.plot(at, median, ".-", color=color, label=f"suffices for {100.0 * design.share:g} %")
    for what, quantity, limit, shade in (
        ("breakdown of the insulator", "insulator_peak", lambda o: o.breakdown_voltage, ALERT),
        ("your limit of the rms current", "current_rms", lambda o: o.device.current_limit_rms, ORANGE),
        ("your limit of the peak current", "current_peak", lambda o: o.device.current_limit_peak, PRIOR),
    ):
        amplitude = [_limit_amplitude(option, quantity, limit(option)) for option in options]
        if np.any(np.isfinite(amplitude)):
            axes.plot(at, amplitude, color=shade, lw=1.5, ls="--", label=what)
    axes.set_yscale("log")
    log_ticks(axes.yaxis, "V")
    _note_if_empty(axes)
    axes.set_ylabel(f"peak-to-peak amplitude, {design.scene_waveform}")


def _limit_amplitude(option: DriveOption, quantity: str, limit: float | None) -> float:
    """Return the amplitude (V) at which a limit is reached; currents and voltages are proportional to it."""
    reached = float(getattr(option.at_assured, quantity))
    return np.nan if limit is None or not np.isfinite(reached) else option.assured * limit / reached


def _mask_infinite(amplitude: Sequence[float] | Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Replace infinite amplitudes by NaN, which leaves a gap in the curve."""
    values = np.asarray(amplitude, dtype=float)
    return np.where(np.isfinite(values), values, np.nan)


def _note_if_empty(axes: Axes) -> None:
    if not any(np.isfinite(np.asarray(line.get_ydata(), dtype=float)).any() for line in axes.lines):
        axes.set(yscale="linear", yticks=[])
        axes.text(0.5, 0.5, "too few fingers feel it at any amplitude", transform=axes.transAxes, ha="center")


def write_drive_design_page(path: str | os.PathLike[str], design: DriveDesign, origin: Provenance) -> None:
    people = [("waveform", *(f"{100.0 * share:g} %" for share in FINGER_QUANTILES))]
    people += [
        (name, *(format_quantity(each, "V") for each in option.people)) for name, option in design.options.items()
    ]
    curves, frequencies = _curve_plot(design), _frequency_plot(design)
    switch = interactive.log_axis_button([frequencies], "xy", "logarithmic axes")
    write_page(
        path,
        "drive.html",
        frame=_frame(design),
        origin=origin,
        table=design.table,
        legend=design.legend,
        excluded=design.excluded,
        separated=design.people.has_separate_uncertainty,
        has_table=design.scene.perception.thresholds is not None,
        people=people,
        limits=design.limits_table,
        no_safety_assessment=NO_SAFETY_ASSESSMENT,
        notes=[note for note in design.notes if not note.startswith(NO_SAFETY_ASSESSMENT)],
        curves=interactive.chart(curves, controls=[interactive.log_axis_button([curves])]),
        frequencies=interactive.chart(frequencies, controls=[switch]),
        insulators=image(lambda: _insulator_figure(design)),
    )


def _frame(design: DriveDesign) -> PageSummary:
    smallest, findings = [sentence.split(": ", 1) for sentence in design.sentences], {}
    findings["What counts as felt"] = design.question
    findings["Body current and insulator"] = design.exposure
    recommended = design.recommended
    if recommended is not None:
        findings["Which voltage to set"] = f"{_VOLTAGES}{_INTERVALS * design.people.has_separate_uncertainty}."
        findings |= {f"{name[0].upper()}{name[1:]}": f"{answer}." for name, answer in smallest}
    return PageSummary(
        title=f"The smallest drive that {100.0 * design.share:g} % of fingers feel",
        subject=f"Peak-to-peak amplitude, power, current and insulator voltage of each waveform at"
        f" {format_engineering(design.options[design.scene_waveform].frequency, 'Hz', 3)}, at other frequencies and on"
        " other insulators.",
        trusted=design.trusted,
        verdict=design.recommendation.rstrip(".") if design.trusted else f"{'; '.join(design.warnings)}.",
        findings=findings,
        answers=[
            Answer(f"{name}, peak to peak", format_quantity(option.assured, "V"), _note(option, recommended))
            for name, option in design.options.items()
        ],
        warnings=design.warnings,
        has_reservation=recommended is None or any(each.exceeds_published for each in design.limits),
    )


def _note(option: DriveOption, recommended: DriveOption | None) -> str:
    if option is recommended:
        return "recommended"
    unbounded = not np.isfinite(option.at_assured.current_rms)
    return "excluded" if option.violations else "current unbounded" if unbounded else "alternative"


def _curve_plot(design: DriveDesign) -> interactive.Plot:
    curves = {name: design.curve(name) for name in _order_waveforms(design)}
    x = Axis.from_values("peak-to-peak amplitude", "V", curves[design.scene_waveform]["peak_to_peak"], log=True)
    y = Axis("fingers that feel it", "%", 0.01)
    traces = []
    for name, curve in curves.items():
        at, color = curve["peak_to_peak"], _COLORS[name]
        if design.people.has_separate_uncertainty:
            edges = (f"{name}, 5 %", f"{name}, 95 %", f"{name}, 90 % band")
            band = interactive.band(x, y, at, curve["q05"], curve["q95"], edges, color)
            traces += [each | {"showlegend": False} for each in band]
        traces.append(interactive.line(x, y, at, curve["q50"], name, color, width=_line_width(design, name)))
    at = curves[design.scene_waveform]["peak_to_peak"][[0, -1]]
    traces.append(interactive.line(x, y, at, [design.share] * 2, "required", ALERT, dash="dash"))
    plot = interactive.plot(x, (y, traces), size=420)
    plot["layout"]["legend"]["traceorder"] = "normal"  # plotly reverses the order where areas are filled
    return plot


def _frequency_plot(design: DriveDesign) -> interactive.Plot:
    medians = {
        name: _mask_infinite([float(quantile(option.amplitude, 0.5)) for option in options])
        for name, options in design.by_frequency.items()
    }
    own = design.by_frequency[design.scene_waveform]
    frequency, people = np.array([option.frequency for option in own]), np.stack([option.people for option in own])
    x = Axis.from_values("frequency of the drive", "Hz", frequency, log=True)
    y = Axis.from_values("peak-to-peak amplitude required", "V", medians[design.scene_waveform], log=True)
    traces = []
    for low, high, share in ((0, 4, 90), (1, 3, 50)):
        kept = np.isfinite(people[:, high])
        edges = (
            f"{50 - share // 2} % of fingers",
            f"{50 + share // 2} %",
            f"{share} % of fingers, {design.scene_waveform}",
        )
        traces += interactive.band(
            x, y, frequency[kept], people[kept, low], people[kept, high], edges, _COLORS[design.scene_waveform]
        )
    for name in _order_waveforms(design):
        at = [option.frequency for option in design.by_frequency[name]]
        width = _line_width(design, name)
        traces.append(interactive.line(x, y, at, medians[name], name, _COLORS[name], width=width))
    return interactive.plot(x, (y, traces), size=420)
