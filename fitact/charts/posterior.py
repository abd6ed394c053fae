"""Plots of a posterior: distributions of parameters and force, force over time, and what the data determine."""

import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from fitact.charts import interactive
from fitact.charts.figure import ALERT, DATA, MODEL, PRIOR
from fitact.charts.interactive import Axis, Plot
from fitact.units import quantity_unit

_FORCES = {"force_mean": "mean force", "force_rms": "rms force", "force_peak": "peak force"}
_DENSITY = Axis("density", hides_numbers=True)  # each density is scaled to its own maximum

Draws = Mapping[str, np.ndarray]


def corner_plots(posterior: Draws, prior: Draws, pairs: Sequence[str]) -> tuple[list[Plot], list[Plot]]:
    """Draw the distribution of each parameter that has a prior, and those named in `pairs` against each other (SI)."""
    axes = {
        name: Axis.from_values(name, quantity_unit(name), np.median(draws), log=True)
        for name, draws in posterior.items()
        if name in prior
    }
    both = (prior, "prior", PRIOR), (posterior, "posterior", MODEL)
    plots = []
    for name, x in axes.items():
        traces = [interactive.density(x, draws[name], label, color) for draws, label, color in both]
        plots.append(interactive.plot(x, (_DENSITY, traces), size=230, unified_hover=True))
    clouds = []
    for a, b in itertools.combinations([name for name in pairs if name in axes], 2):
        traces = []
        for draws, label, color in both:
            shown = slice(None, None, max(1, draws[a].size // 300))  # 300 points show the shape and keep the page small
            at = draws[a].ravel()[shown], draws[b].ravel()[shown]
            cloud = interactive.points(axes[a], axes[b], *at, label, color, size=4.0, opacity=0.6)
            traces.append(cloud | {"hovertemplate": f"{axes[a].hover('x')}, {axes[b].hover('y')}<extra></extra>"})
        clouds.append(interactive.plot(axes[a], (axes[b], traces)))
    return plots, clouds


def force_plots(posterior: Draws) -> list[Plot]:
    """Draw the distributions of mean, rms and peak force (N), with the 90 % interval shaded."""
    plots = []
    for name, title in _FORCES.items():
        draws = posterior[name]
        x, (low, high) = Axis.from_values(title, "N", np.median(draws)), np.quantile(draws, [0.05, 0.95])
        distribution = interactive.plot(
            x, (_DENSITY, [interactive.density(x, draws, title)]), size=230, legend=False, unified_hover=True
        )
        plots.append(interactive.shade_interval(distribution, x, float(low), float(high)))
    return plots


def force_in_time_plot(time: np.ndarray, quantiles: Mapping[float, np.ndarray]) -> Plot:
    """Draw the force (N) over time (s): its median, and the 90 % interval; `quantiles` by their probability."""
    x = Axis.from_values("time", "s", time, limits=(time[0], time[-1]))
    y = Axis.from_values("electrostatic force", "N", quantiles[0.95])
    area = interactive.band(x, y, time, quantiles[0.05], quantiles[0.95], ("5 %", "95 %", "90 % interval"))
    traces = [*area, interactive.line(x, y, time, quantiles[0.5], "median", DATA, width=1.2)]
    return interactive.plot(x, (y, traces), size=300, unified_hover=True)


def ellipse_plot(
    names: tuple[str, str], laws: Mapping[str, tuple[np.ndarray, np.ndarray]], direction: np.ndarray
) -> Plot:
    """Draw the 95 % regions of two parameters (SI), and the direction that the data constrain least.

    `laws` has the mean and the covariance of the two logarithms, of "prior" and "posterior".
    """
    x, y = (
        Axis.from_values(n, quantity_unit(n), np.exp(laws["posterior"][0][i]), log=True) for i, n in enumerate(names)
    )
    radius, circle = 2.4477, np.linspace(0.0, 2.0 * np.pi, 181)  # 95 % of a normal distribution: sqrt(-2 ln 0.05)
    traces = []
    for name, color in (("prior", PRIOR), ("posterior", MODEL)):
        mean, covariance = laws[name]
        values, vectors = np.linalg.eigh(covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        edge = np.exp(mean[:, None] + radius * root @ np.stack([np.cos(circle), np.sin(circle)]))
        traces.append(interactive.line(x, y, edge[0], edge[1], f"{name}, 95 %", color))
    mean, covariance = laws["posterior"]
    reach = 1.5 * radius * np.sqrt(np.trace(covariance)) * np.array([-1.0, 1.0])
    along = np.exp(mean[:, None] + direction[:, None] / np.linalg.norm(direction) * reach)
    traces.append(interactive.line(x, y, along[0], along[1], "least constrained direction", ALERT, dash="dash"))
    return interactive.plot(x, (y, traces), size=400)
