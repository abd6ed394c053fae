"""Figures for print: shared style and colours, axes, and self-contained SVG."""

import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import matplotlib as mpl
import numpy as np
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter

from fitact.errors import InputError
from fitact.files import atomic_write

FigureMaker: TypeAlias = Callable[..., Figure]  # takes `figsize` and `layout`

# distinguishable by the colour-blind (Okabe & Ito 2008)
DATA, MODEL, PRIOR, ALERT = "#333333", "#0072B2", "#999999", "#D55E00"
GREEN, PINK, SKY, ORANGE = "#009E73", "#CC79A7", "#56B4E9", "#E69F00"
STYLE: Any = {  # style of all figures, for `matplotlib.rc_context`
    "font.size": 11.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "svg.fonttype": "path",
    "svg.hashsalt": "fitact",
    "path.simplify_threshold": 0.5,
}


def pyplot_figure(**options: Any) -> Figure:
    """Return a new figure that notebooks and `pyplot.show` display."""
    import matplotlib.pyplot as plt

    return plt.figure(**options)


def robust_limits(values: np.ndarray) -> tuple[float, float]:
    """Return axis limits that exclude a few extreme samples, such as current spikes at edges."""
    low, high = np.quantile(values, [0.02, 0.98])
    whole = float(values.min()), float(values.max())
    if whole[1] - whole[0] > 20.0 * (high - low):
        whole = float(low), float(high)
    margin = 0.06 * (whole[1] - whole[0])
    return whole[0] - margin, whole[1] + margin


def log_ticks(axis: Axis, unit: str, subs: tuple[float, ...] = (1.0, 2.0, 5.0)) -> None:
    """Set ticks of a logarithmic axis at the multiples `subs` of powers of ten, with prefixed units."""
    axis.set_major_locator(LogLocator(subs=subs))
    axis.set_major_formatter(EngFormatter(unit))
    axis.set_minor_formatter(NullFormatter())


def write_figure(path: str | os.PathLike[str], draw: Callable[[], Figure]) -> None:
    """Write a figure in the shared style as SVG or PNG, by the suffix of `path`; refuse any other."""
    kind = Path(path).suffix[1:]
    if kind not in ("svg", "png"):
        raise InputError(f"{path}: the figure is written as .svg or .png; choose one of these endings")
    metadata = {"Date": None} if kind == "svg" else {}
    with mpl.rc_context(STYLE), atomic_write(path) as temporary:
        draw().savefig(temporary, format=kind, dpi=150, metadata=metadata)


def svg(figure: Figure) -> str:
    """Return a figure as an SVG element of a page."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", dpi=150, metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]
