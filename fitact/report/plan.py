"""Page of a plan: the error of each omission, compared with the tolerance."""

import os

from fitact.charts import draw_plan
from fitact.model_selection.plan import LEGEND, Plan
from fitact.report.frame import Answer, PageSummary, Provenance, image, write_page
from fitact.units import format_percent


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
    shown = {
        "table": plan.table,
        "legend": LEGEND,
        "model": plan.model(),
        "picture": image(lambda: draw_plan(plan.to_dict())),
    }
    write_page(path, "plan.html", frame=frame, origin=origin, **shown)
