"""Picture and page of a plan: the error of each omission, compared with the tolerance."""

import os

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from fitact.charts.figure import ALERT, DATA, MODEL, PRIOR
from fitact.model_selection.plan import LEGEND, Plan
from fitact.report.frame import Answer, PageSummary, Provenance, image, write_page
from fitact.units import format_percent


def draw_plan(plan: Plan) -> Figure:
    """Draw the force errors of a plan."""
    bars = [(o.name, o.nominal.force, o.q95.force, o.kept, o.speedup) for o in plan.omissions]
    if plan.left_out:
        bars.append(("planned model", plan.nominal.force, plan.q95.force, False, plan.speedup))
    names, nominal, q95, kept, speedup = zip(*reversed(bars), strict=True)
    least = 1e-8  # lower end of the logarithmic axis; smaller errors are negligible
    positions, shown = np.arange(len(bars)), np.maximum(nominal, least)
    figure = Figure(figsize=(9.0, 1.6 + 0.45 * len(bars)), layout="constrained")
    axes = figure.add_subplot()
    axes.barh(positions, shown, left=0.0, color=[PRIOR if each else MODEL for each in kept], height=0.6)
    axes.plot(np.maximum(q95, least), positions, "|", color=DATA, ms=14, mew=2, label="95 % quantile over the prior")
    axes.axvline(plan.full.tolerance.force, color=ALERT, label="tolerance")
    for at, error, faster in zip(positions, np.maximum(nominal, q95), speedup, strict=True):
        axes.annotate(f"{faster:.3g}×", (max(error, least), at), (8, 0), textcoords="offset points", va="center")
    axes.set(xscale="log", xlim=(0.3 * min(shown), 5.0 * max(*nominal, *q95, plan.full.tolerance.force)))
    axes.set_yticks(positions, names)
    axes.grid(axis="y", visible=False)
    axes.set_xlabel("relative error of the force (larger of mean and peak), and speed-up factor of the model")
    handles = [mpl.patches.Patch(color=MODEL, label="neglected"), mpl.patches.Patch(color=PRIOR, label="kept")]
    figure.legend(handles=[*handles, *axes.get_legend_handles_labels()[0]], loc="outside upper center", ncols=4)
    return figure


def write_plan_page(path: str | os.PathLike[str], plan: Plan, origin: Provenance) -> None:
    tolerance = format_percent(plan.full.tolerance.force)
    kept = "" if not plan.warnings else " at the nominal values, but not over the prior"
    frame = PageSummary(
        title="Simplest model of the scene",
        subject="Effect of each element of the scene on Vsc and force, and the fastest model within"
        f" [tolerance] force = {tolerance}.",
        trusted=True,
        verdict=f"The planned model is within the force tolerance of {tolerance}{kept}",
        findings={"Neglected elements": plan.sentence},
        answers=[
            *(
                Answer(title, format_percent(nominal), f"95 % quantile over the prior: {format_percent(q95)}")
                for title, nominal, q95 in (
                    ("mean force", plan.nominal.force_mean, plan.q95.force_mean),
                    ("peak force", plan.nominal.force_peak, plan.q95.force_peak),
                    ("peak of Vsc", plan.nominal.Vsc_peak, plan.q95.Vsc_peak),
                )
            ),
            Answer("speed", f"{plan.speedup:.3g}×", "relative to the full model"),
        ],
        warnings=plan.warnings,
        has_reservation=bool(plan.warnings),
    )
    shown = {"table": plan.table, "legend": LEGEND, "model": plan.model(), "picture": image(lambda: draw_plan(plan))}
    write_page(path, "plan.html", frame=frame, origin=origin, **shown)
