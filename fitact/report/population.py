"""A population as a picture: its fingers with its law, and the force of the next one."""

import os
from pathlib import Path

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter

from fitact.files import replacing
from fitact.inference.people import Population
from fitact.report.plots import style

_LAW, _FINGER = "#0072B2", "#333333"
_SHOWN = 4000  # new fingers


def write_population(path: str | os.PathLike[str], population: Population) -> None:
    """Draw the fingers, those to come, and the force of these as SVG at `path`.

    Raises:
        InputError: the place cannot be written.
    """
    with mpl.rc_context(style()), replacing(Path(path)) as temporary:
        _figure(population).savefig(temporary, format="svg", metadata={"Date": None})


def _figure(population: Population) -> Figure:
    figure = Figure(figsize=(11.0, 4.2), layout="constrained")
    skin, force = figure.subplots(1, 2)
    new = population.new_fingers()
    _draw_skin(skin, population, new["Rsc"].ravel()[:_SHOWN], new["Csc"].ravel()[:_SHOWN])
    for name, color, label in (("force_mean", _LAW, "mean"), ("force_peak", "#D55E00", "peak")):
        values = new[name].ravel()
        low, high = np.quantile(values, [0.002, 0.998])
        edges = np.geomspace(low, high, 60)
        force.hist(values, bins=edges.tolist(), color=color, alpha=0.6, label=label)
    force.set_xscale("log")
    force.xaxis.set_major_formatter(EngFormatter("N"))
    force.set_yticks([])
    force.set_xlabel("electrostatic force of the next finger")
    force.legend()
    return figure


def _draw_skin(
    axes: Axes, population: Population, Rsc: Float[np.ndarray, " fingers"], Csc: Float[np.ndarray, " fingers"]
) -> None:
    axes.plot(Rsc, Csc, ".", ms=2, color=_LAW, alpha=0.25, rasterized=True, label="fingers to come")
    for number, finger in enumerate(population.fingers):
        parameters = finger.parameters
        (x, y), (dx, dy) = (
            [np.array([parameters[name][key] for key in keys], dtype=float) for name in ("Rsc", "Csc")]
            for keys in (["q50"], ["q025", "q975"])
        )
        label = "fingers, 95 %" if number == 0 else None
        errors = {"xerr": np.abs(dx - x)[:, None], "yerr": np.abs(dy - y)[:, None]}
        axes.errorbar(x, y, **errors, fmt="o", ms=4, color=_FINGER, label=label)
    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis, unit in ((axes.xaxis, "Ω"), (axes.yaxis, "F")):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(EngFormatter(unit))
        axis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("Rsc")
    axes.set_ylabel("Csc")
    axes.legend(markerscale=2)
