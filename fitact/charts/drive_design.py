"""The design of a drive as a picture: who feels it, at which frequency, on which insulator.

`content` is that of drive.json; `waveform` is the scene's own.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fitact.charts import interactive
from fitact.charts.figure import ALERT, DATA, GREEN, MODEL, ORANGE, PINK, PRIOR, SKY, FigureMaker, log_ticks
from fitact.charts.interactive import Axis
from fitact.charts.picture import draw_plot

_COLORS = {"sine": MODEL, "triangle": GREEN, "square": PINK, "trapezoid": DATA, "multitone": SKY}

Content = dict[str, Any]


def draw_drive_design(content: Content, waveform: str, make: FigureMaker = Figure) -> Figure:
    """Draw the drive curves and the required amplitudes."""
    figure = make(figsize=(11.0, 8.0), layout="constrained")
    (curves, frequencies), insulators = figure.subplots(2, 2)
    draw_plot(curve_plot(content, waveform), curves)
    draw_plot(frequency_plot(content, waveform), frequencies)
    _note_if_empty(frequencies)
    _draw_both_insulators(insulators, content, waveform)
    return figure


def draw_insulators(content: Content, waveform: str) -> Figure:
    """Draw the required amplitudes over thickness and permittivity of the insulator."""
    figure = Figure(figsize=(11.0, 4.0), layout="constrained")
    _draw_both_insulators(figure.subplots(1, 2), content, waveform)
    return figure


def _draw_both_insulators(both: Sequence[Axes], content: Content, waveform: str) -> None:
    thicknesses, permittivities = both
    thickness = [option["insulator_thickness"] for option in content["thicknesses"]]
    _draw_insulators(thicknesses, content, waveform, content["thicknesses"], thickness)
    thicknesses.set(xscale="log", xlim=(0.8 * thickness[0], 1.25 * thickness[-1]), xlabel="insulator thickness")
    log_ticks(thicknesses.xaxis, "m", (1.0,))
    thicknesses.legend(fontsize=9)
    permittivity = [option["insulator_permittivity"] for option in content["permittivities"]]
    _draw_insulators(permittivities, content, waveform, content["permittivities"], permittivity)
    permittivities.set_xlabel("insulator's relative permittivity")


def _order_waveforms(content: Content, waveform: str) -> list[str]:
    return sorted(content["curves"], key=lambda name: name != waveform)


def _line_width(name: str, waveform: str) -> float:
    """Return the line width; the scene's waveform is wider, so that it stays visible under other curves."""
    return 3.0 if name == waveform else 1.3


def _amplitude(option: Content, key: str = "q50") -> float:
    """Return a quantile of the required amplitude (V); without population samples all are the median."""
    value = option["peak_to_peak"][key]
    return option["peak_to_peak"]["q50"] if value is None else value


def _draw_insulators(
    axes: Axes, content: Content, waveform: str, options: Sequence[Content], at: Sequence[float]
) -> None:
    color, device = _COLORS[waveform], content["scene"].get("device", {})
    low, median, high = (_mask_infinite([_amplitude(option, q) for option in options]) for q in ("q05", "q50", "q95"))
    axes.fill_between(at, low, high, color=color, alpha=0.25, lw=0)
    axes.plot(at, median, ".-", color=color, label=f"suffices for {100.0 * content['share']:g} %")
    for what, quantity, limits, shade in (
        ("breakdown of the insulator", "insulator_peak", [o["breakdown_voltage"] for o in options], ALERT),
        ("your limit of the rms current", "current_rms", [device.get("current_limit_rms")] * len(options), ORANGE),
        ("your limit of the peak current", "current_peak", [device.get("current_limit_peak")] * len(options), PRIOR),
    ):
        amplitude = [_limit_amplitude(o, quantity, limit) for o, limit in zip(options, limits, strict=True)]
        if np.any(np.isfinite(amplitude)):
            axes.plot(at, amplitude, color=shade, lw=1.5, ls="--", label=what)
    axes.set_yscale("log")
    log_ticks(axes.yaxis, "V")
    _note_if_empty(axes)
    axes.set_ylabel(f"peak-to-peak amplitude, {waveform}")


def _limit_amplitude(option: Content, quantity: str, limit: float | None) -> float:
    """Return the amplitude (V) at which a limit is reached; currents and voltages are proportional to it."""
    reached = option["at_assured"][quantity]
    return np.nan if limit is None or not np.isfinite(reached) else option["peak_to_peak"]["assured"] * limit / reached


def _mask_infinite(amplitude: Sequence[float] | Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Replace infinite amplitudes by NaN, which leaves a gap in the curve."""
    values = np.asarray(amplitude, dtype=float)
    return np.where(np.isfinite(values), values, np.nan)


def _note_if_empty(axes: Axes) -> None:
    if not any(np.isfinite(np.asarray(line.get_ydata(), dtype=float)).any() for line in axes.lines):
        axes.set(yscale="linear", yticks=[])
        axes.text(0.5, 0.5, "too few fingers feel it at any amplitude", transform=axes.transAxes, ha="center")


def curve_plot(content: Content, waveform: str) -> interactive.Plot:
    """Draw the fraction of fingers that feel each waveform over its amplitude."""
    curves, share = content["curves"], content["share"]
    x = Axis.from_values("peak-to-peak amplitude", "V", curves[waveform]["peak_to_peak"], log=True)
    y = Axis("fingers that feel it", "%", 0.01)
    traces = []
    for name in _order_waveforms(content, waveform):
        curve = curves[name]
        at, color = curve["peak_to_peak"], _COLORS[name]
        if content["options"][0]["peak_to_peak"]["q05"] is not None:
            edges = (f"{name}, 5 %", f"{name}, 95 %", f"{name}, 90 % band")
            band = interactive.band(x, y, at, curve["q05"], curve["q95"], edges, color)
            traces += [each | {"showlegend": False} for each in band]
        traces.append(interactive.line(x, y, at, curve["q50"], name, color, width=_line_width(name, waveform)))
    at = [curves[waveform]["peak_to_peak"][i] for i in (0, -1)]
    traces.append(interactive.line(x, y, at, [share] * 2, "required", ALERT, dash="dash"))
    plot = interactive.plot(x, (y, traces), size=420)
    plot["layout"]["legend"]["traceorder"] = "normal"  # plotly reverses the order where areas are filled
    return plot


def frequency_plot(content: Content, waveform: str) -> interactive.Plot:
    """Draw the required amplitude of each waveform over its frequency."""
    options = {
        name: [option for option in content["frequencies"] if option["waveform"] == name] for name in content["curves"]
    }
    medians = {name: _mask_infinite(list(map(_amplitude, each))) for name, each in options.items()}
    frequency = np.array([option["frequency"] for option in options[waveform]])
    people = {
        key: np.array([option["people"][key] for option in options[waveform]]) for key in ("q05", "q25", "q75", "q95")
    }
    x = Axis.from_values("frequency of the drive", "Hz", frequency, log=True)
    y = Axis.from_values("peak-to-peak amplitude required", "V", medians[waveform], log=True)
    traces = []
    for low, high, share in (("q05", "q95", 90), ("q25", "q75", 50)):
        kept = np.isfinite(people[high])
        edges = (
            f"{50 - share // 2} % of fingers",
            f"{50 + share // 2} %",
            f"{share} % of fingers, {waveform}",
        )
        traces += interactive.band(
            x, y, frequency[kept], people[low][kept], people[high][kept], edges, _COLORS[waveform]
        )
    for name in _order_waveforms(content, waveform):
        at = [option["frequency"] for option in options[name]]
        width = _line_width(name, waveform)
        traces.append(interactive.line(x, y, at, medians[name], name, _COLORS[name], width=width))
    return interactive.plot(x, (y, traces), size=420)
