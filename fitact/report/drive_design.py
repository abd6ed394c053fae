"""The design of a drive as a page: who feels it, at which frequency, on which insulator."""

import os

import numpy as np

from fitact.charts import interactive
from fitact.charts.drive_design import curve_plot, draw_insulators, frequency_plot
from fitact.design.drive_design import DriveDesign
from fitact.design.drive_option import FINGER_QUANTILES, DriveOption
from fitact.design.limits import NO_SAFETY_ASSESSMENT, format_quantity
from fitact.report.frame import Answer, PageSummary, Provenance, image, write_page
from fitact.units import format_engineering

_VOLTAGES = (
    "Set the amplitude in the first sentence. The table also gives its Monte Carlo error, which says how far another"
    " seed changes it"
)
_INTERVALS = ", and the median and 90 % interval, which say what is known of the amplitude that just suffices"


def write_drive_design_page(path: str | os.PathLike[str], design: DriveDesign, origin: Provenance) -> None:
    people = [("waveform", *(f"{100.0 * share:g} %" for share in FINGER_QUANTILES))]
    people += [
        (name, *(format_quantity(each, "V") for each in option.people)) for name, option in design.options.items()
    ]
    content, own = design.to_dict(), design.scene_waveform
    curves, frequencies = curve_plot(content, own), frequency_plot(content, own)
    switch = interactive.log_axis_button([frequencies], "xy", "logarithmic axes")
    write_page(
        path,
        "drive.html",
        frame=_frame(design),
        origin=origin,
        table=design.table,
        legend=design.legend,
        excluded=design.exclusions,
        separated=design.people.has_separate_uncertainty,
        has_table=design.scene.perception.thresholds is not None,
        people=people,
        limits=design.limits_table,
        no_safety_assessment=NO_SAFETY_ASSESSMENT,
        notes=[note for note in design.notes if not note.startswith(NO_SAFETY_ASSESSMENT)],
        curves=interactive.chart(curves, controls=[interactive.log_axis_button([curves])]),
        frequencies=interactive.chart(frequencies, controls=[switch]),
        insulators=image(lambda: draw_insulators(content, own)),
    )


def _frame(design: DriveDesign) -> PageSummary:
    smallest, findings = [sentence.split(": ", 1) for sentence in design.sentences], {}
    findings["What counts as felt"] = design.question
    findings["Body current and insulator"] = design.exposure
    recommended = design.recommended_option
    if recommended is not None:
        findings["Which voltage to set"] = f"{_VOLTAGES}{_INTERVALS * design.people.has_separate_uncertainty}."
        findings |= {f"{name[0].upper()}{name[1:]}": f"{answer}." for name, answer in smallest}
    return PageSummary(
        title=f"The smallest drive that {100.0 * design.share:g} % of {design.people.unit} feel",
        subject=f"Peak-to-peak amplitude, power, current and insulator voltage of each waveform at"
        f" {format_engineering(design.options[design.scene_waveform].frequency, 'Hz', 3)}, at other frequencies and on"
        " other insulators.",
        trusted=design.trusted,
        verdict=design.recommendation.rstrip(".") if design.trusted else f"{'; '.join(design.warnings)}.",
        findings=findings,
        answers=[
            Answer(f"{name}, peak to peak", format_quantity(option.assured, "V"), _note(option, recommended))
            for name, option in design.options.items()
        ],
        warnings=design.warnings,
        has_reservation=recommended is None or any(each.exceeds_published for each in design.limits),
    )


def _note(option: DriveOption, recommended: DriveOption | None) -> str:
    if option is recommended:
        return "recommended"
    unbounded = not np.isfinite(option.at_assured.current_rms)
    return "excluded" if option.violations else "current unbounded" if unbounded else "alternative"
