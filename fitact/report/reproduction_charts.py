"""The charts of the paper's figures."""

from fitact.charts.figure import DATA
from fitact.charts.interactive import Axis, Chart, Plot, chart, line, logarithmic, marked, plot, points
from fitact.model.circuit import Circuit
from fitact.report import reproduction_curves
from fitact.report.reproduction_curves import COLORS, KNEES, OTHERS, OURS

_TIME = Axis.of("time", "s", 0.02)


def in_time(circuits: dict[str, Circuit]) -> Chart:
    """Figs. 4, 5, 6 and 10: Vsc of some circuits."""
    y = Axis("Vsc1", "V")
    traces = [
        line(_TIME, y, *reproduction_curves.in_time(circuit), name, color)
        for (name, circuit), color in zip(circuits.items(), COLORS, strict=False)
    ]
    return chart(plot(_TIME, (y, traces), together=True))


def insulator() -> Chart:
    """Fig. 12."""
    plots = []
    for each in reproduction_curves.insulator():
        x, y = Axis.of(each.title, each.unit, each.own[0]), Axis("mean force, normalised")
        own = points(x, y, [each.own[0]], [each.own[1]], "the paper's panel", COLORS[0], size=9.0)
        plots.append(plot(x, (y, [line(x, y, *each.force, "mean force", OURS), own]), together=True))
    return chart(*plots, controls=[logarithmic(plots), logarithmic(plots, "y", "logarithmic force")])


def frequencies(low: float, high: float) -> Chart:
    """Figs. 13 and 14."""
    curves = reproduction_curves.frequencies(low, high)
    x = Axis("frequency", "Hz", log=True, wide=True)
    amplitude, phase = Axis("|H|"), Axis("phase", "degrees")
    plots: list[Plot] = []
    for i, (y, knees) in enumerate(zip((amplitude, phase), KNEES.values(), strict=True)):
        traces = [
            line(x, y, *both[i], name, color)
            for (name, both), color in zip(curves.items(), (OURS, *OTHERS), strict=True)
        ]
        drawn = plot(x, (y, traces), together=True)
        for knee in knees if high <= 1e3 else ():
            drawn = marked(drawn, x, knee, COLORS[0])
        plots.append(drawn)
    controls = [logarithmic(plots, label="logarithmic frequency"), logarithmic(plots[:1], "y", "logarithmic |H|")]
    return chart(*plots, controls=controls)


def waveforms() -> Chart:
    """Fig. 15."""
    above, below = Axis("V", "V"), Axis("Vsc", "V", limits=(-2.8, 2.8))
    return chart(
        *(
            plot(
                _TIME,
                (above, [line(_TIME, above, *drive, "V", DATA)]),
                (below, [line(_TIME, below, *vsc, "Vsc", OURS)]),
                heights=(1.0, 1.0), title=name, size=420, legend=False, together=True,
            )
            for name, (drive, vsc) in reproduction_curves.waveforms().items()
        )
    )  # fmt: skip
