"""Bar chart of uncertainty budgets."""

from typing import Any

from matplotlib.figure import Figure

from fitact.charts.figure import ALERT, MODEL, FigureMaker


def draw_budgets(entries: dict[str, Any], bars: int = 5, make: FigureMaker = Figure) -> Figure:
    """Draw the largest components of each quantity, in per cent; `entries` is `budget` of summary.json."""
    columns, rows = 2, -(-len(entries) // 2)
    figure = make(figsize=(9.0, 0.6 + 1.5 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).flat
    for (name, entry), axes in zip(entries.items(), panels, strict=False):
        largest = [each for each in entry["components"] if each["share"] >= 0.001][:bars][::-1]
        sources, sizes = [each["source"] for each in largest], [100.0 * each["u"] for each in largest]
        axes.barh(sources, sizes, color=[ALERT if each["type"] == "A" else MODEL for each in largest])
        axes.set_title(f"{name}: u = {100.0 * entry['u']:.2g} %", fontsize=10.0, loc="left")
        axes.tick_params(labelsize=8.0)
        axes.set_xlabel("component of u, %", fontsize=8.0)
        axes.grid(axis="y", visible=False)
    for axes in panels:
        axes.set_axis_off()
    return figure
