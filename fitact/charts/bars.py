"""Bar charts: the errors of a plan's omissions, and uncertainty budgets."""

import math
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from fitact.charts.figure import ALERT, DATA, MODEL, PRIOR, FigureMaker
from fitact.result_text import list_components


def draw_plan(content: dict[str, Any], make: FigureMaker = Figure) -> Figure:
    """Draw the force errors of each omission; `content` is that of plan.json."""
    model = content["model"]
    rows = [*content["omissions"], *([model | {"name": "planned model", "kept": False}] if model["left_out"] else [])]
    names, kept, speedup = ([row[key] for row in reversed(rows)] for key in ("name", "kept", "speedup"))
    nominal, q95 = (
        [max(row[f"error_force_mean{end}"], row[f"error_force_peak{end}"]) for row in reversed(rows)]
        for end in ("", "_q95")
    )
    least = 1e-8  # lower end of the logarithmic axis; smaller errors are negligible
    positions, shown = np.arange(len(rows)), np.maximum(nominal, least)
    figure = make(figsize=(9.0, 1.6 + 0.45 * len(rows)), layout="constrained")
    axes = figure.add_subplot()
    axes.barh(positions, shown, left=0.0, color=[PRIOR if each else MODEL for each in kept], height=0.6)
    axes.plot(np.maximum(q95, least), positions, "|", color=DATA, ms=14, mew=2, label="95 % quantile over the prior")
    axes.axvline(model["tolerance"], color=ALERT, label="tolerance")
    for at, error, faster in zip(positions, np.maximum(nominal, q95), speedup, strict=True):
        axes.annotate(f"{faster:.3g}×", (max(error, least), at), (8, 0), textcoords="offset points", va="center")
    axes.set(xscale="log", xlim=(0.3 * min(shown), 5.0 * max(*nominal, *q95, model["tolerance"])))
    axes.set_yticks(positions, names)
    axes.grid(axis="y", visible=False)
    axes.set_xlabel("relative error of the force (larger of mean and peak), and speed-up factor of the model")
    handles = [mpl.patches.Patch(color=MODEL, label="neglected"), mpl.patches.Patch(color=PRIOR, label="kept")]
    figure.legend(handles=[*handles, *axes.get_legend_handles_labels()[0]], loc="outside upper center", ncols=4)
    return figure


def draw_budgets(content: dict[str, Any], bars: int = 5, make: FigureMaker = Figure) -> Figure:
    """Draw the largest components of each combined uncertainty, in per cent; `content` is that of summary.json."""
    names = list(content["budget"])
    columns, rows = 2, -(-len(names) // 2)
    figure = make(figsize=(9.0, 0.6 + 1.5 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).flat
    for name, axes in zip(names, panels, strict=False):
        components = list_components(name, content)
        largest = [each for each in components if each["share"] >= 0.001][:bars][::-1]
        sources = [each["source"].partition(" (")[0] for each in largest]
        sizes = [100.0 * each["u"] for each in largest]
        axes.barh(sources, sizes, color=[ALERT if each["type"] == "A" else MODEL for each in largest])
        u = math.hypot(*(each["u"] for each in components))
        axes.set_title(f"{name}: u = {100.0 * u:.2g} %", fontsize=10.0, loc="left")
        axes.tick_params(labelsize=8.0)
        axes.set_xlabel("component of u, %", fontsize=8.0)
        axes.grid(axis="y", visible=False)
    for axes in panels:
        axes.set_axis_off()
    return figure
