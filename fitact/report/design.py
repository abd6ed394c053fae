"""The next measurement as a page: expected uncertainty of the force by option and setting."""

import os

from fitact.charts.design import draw_design, settings_chart
from fitact.design.measurement import MeasurementDesign
from fitact.report.frame import Answer, PageSummary, Provenance, image, write_page
from fitact.units import format_percent


def write_design_page(path: str | os.PathLike[str], design: MeasurementDesign, origin: Provenance) -> None:
    best, now = design.best_for_effort, design.now
    (titles, *rows), content = design.table, design.to_dict()
    write_page(
        path,
        "design.html",
        frame=_frame(design),
        origin=origin,
        table=[("what is measured", *titles[1:]), *rows],
        parameters=[
            ("what is measured", *now.sd),
            *(
                (each.text, *(f"± {format_percent(each.sd[name])}" for name in now.sd))
                for each in (*design.options, now)
            ),
        ],
        best=best,
        curves=settings_chart(content),
        bars=image(lambda: draw_design(content, has_curves=False)),
    )


def _frame(design: MeasurementDesign) -> PageSummary:
    best, now, prior = design.best_for_effort, design.now, format_percent(design.prior_force_sd)
    most, *others = (
        design.sentences if best else ("No change reduces the uncertainty of the mean force.", *design.sentences)
    )
    answers = [Answer("as it stands", f"± {format_percent(now.force_sd)}", f"before any measurement: ± {prior}")]
    if best is not None:
        answers.append(Answer("largest gain per effort", f"± {format_percent(best.force_sd)}", best.text))
    least = design.options[0] if design.options else now
    if least not in (best, now):
        answers.append(Answer("smallest uncertainty", f"± {format_percent(least.force_sd)}", least.text))
    return PageSummary(
        title="What to measure next",
        subject="Expected uncertainty (1 sd) of the mean force after a change of the scene's measurement."
        " Calibration errors are not included.",
        trusted=design.trusted,
        verdict=most.rstrip(".") if design.trusted else f"{'; '.join(design.warnings)}.",
        findings={"Other changes": " ".join(others)} if others else {},
        answers=answers,
        warnings=design.warnings,
        has_reservation=best is None,
    )
