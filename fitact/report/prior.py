"""Picture of the prior predictive distribution of skin voltage and force."""

import html
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from fitact.charts.figure import DATA, MODEL, STYLE, svg, write_figure
from fitact.errors import InputError
from fitact.files import atomic_write
from fitact.scene.prior_predictive import PriorPredictive


def write_prior(path: Path, predicted: PriorPredictive) -> None:
    """Write voltage and force of a prior to `path`: SVG or PNG by its suffix, or HTML with the table."""
    if path.suffix not in (".html", ".svg", ".png"):
        raise InputError(f"{path}: the figure can be written as .html, .svg or .png; choose one of these suffixes")
    if path.suffix != ".html":
        write_figure(path, lambda: _figure(predicted))
    else:
        with mpl.rc_context(STYLE), atomic_write(path) as temporary:
            temporary.write_text(_page(_figure(predicted), predicted), encoding="utf-8")


def _figure(predicted: PriorPredictive) -> Figure:
    figure = Figure(figsize=(9.0, 6.0), layout="constrained")
    grid = figure.add_gridspec(2, 2, height_ratios=[1.4, 1.0])
    above = figure.add_subplot(grid[0, :])
    for outer, alpha in ((0.05, 0.25), (0.25, 0.35)):
        low, high = np.quantile(predicted.Vsc, [outer, 1.0 - outer], axis=0)
        label = f"{100.0 * (1.0 - 2.0 * outer):.0f} % of fingers"
        above.fill_between(predicted.time, low, high, color=MODEL, alpha=alpha, lw=0, label=label)
    above.plot(predicted.time, np.median(predicted.Vsc, axis=0), color=DATA, lw=1.2, label="median")
    above.xaxis.set_major_formatter(EngFormatter("s"))
    above.yaxis.set_major_formatter(EngFormatter("V"))
    above.set(xlim=(predicted.time[0], predicted.time[-1]), xlabel="time", ylabel="skin voltage Vsc")
    above.legend(loc="upper right", framealpha=0.9)
    for column, (name, title) in enumerate({"force_mean": "mean force", "force_peak": "peak force"}.items()):
        force = predicted.derived[name]
        low, high = np.quantile(force, [0.002, 0.998])
        below = figure.add_subplot(grid[1, column])
        below.hist(force, bins=np.geomspace(0.98 * low, 1.02 * high, 50).tolist(), color=MODEL, alpha=0.75)
        below.axvline(float(np.median(force)), color=DATA)
        below.set_xscale("log")
        below.xaxis.set_major_formatter(EngFormatter("N"))
        below.set_yticks([])
        below.set_xlabel(title)
    return figure


def _page(figure: Figure, predicted: PriorPredictive) -> str:
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>fitact: the prior</title>'
        f"<h1>Predictions of the prior, before any data</h1>{svg(figure)}"
        f"<pre>{html.escape(str(predicted))}</pre></html>\n"
    )
