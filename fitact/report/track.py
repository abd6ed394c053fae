"""A track as a page: values over time with their bands."""

import os
from typing import Any

import numpy as np

from fitact.charts import interactive
from fitact.charts.series import track_plot
from fitact.report.frame import Answer, PageSummary, Provenance, write_page
from fitact.summary import describe_quantity
from fitact.tracking.track import Track
from fitact.units import format_engineering, format_percent, quantity_unit

_PAIRS = (("Rsc", "Csc"), ("contact_area", "force_mean"), ("g", "b"))


def write_track(path: str | os.PathLike[str], track: Track, origin: Provenance) -> None:
    """Write the page of a track at `path`."""
    columns = track.to_columns()
    panels = [
        (
            " and ".join(map(describe_quantity, names)),
            interactive.chart(*(track_plot(columns, name, track.jumps) for name in names)),
        )
        for names in _PAIRS
        if all(name in track.values for name in names)
    ]
    state = track.to_dict()
    times = [format_engineering(state[end]["time_s"], "s", 3) if state[end] else "" for end in ("start", "end")]
    rows: list[tuple[str, ...]] = [
        ("", f"median at {times[0]}", f"at {times[1]}", "variation (sd of the logarithm)", "alike over")
    ]
    for name, within in track.within_finger.items():
        if name not in state["start"] or name not in state["end"]:
            continue
        unit = quantity_unit(name)
        cells = [
            f"{format_engineering(state[end][name]['median'], unit)} ± {format_percent(state[end][name]['u'])}"
            for end in ("start", "end")
        ]
        scale = format_engineering(within["time_scale_s"], "s", 3)
        rows.append((describe_quantity(name), *cells, format_percent(within["log_sd"]), scale))
    rates = [("walk", "log-sd after 1 s", "95 % interval")]
    for name, rate in state["rates"].items():
        interval = f"{format_percent(rate['lower'])} to {format_percent(rate['upper'])}"
        rates.append((name.replace("_", " "), format_percent(rate["log_sd_per_root_s"]), interval))
    write_page(path, "track.html", frame=_frame(track, state), origin=origin, panels=panels, table=rows, rates=rates)


def _frame(track: Track, state: dict[str, Any], max_u: float = 0.5) -> PageSummary:
    """Return what the page says first; changes of quantities that are known to better than `max_u`."""
    answers, start, end = [], state["start"], state["end"]
    for name in ("contact_area", "Rsc", "force_mean"):
        if name in start and name in end and max(start[name]["u"], end[name]["u"]) < max_u:
            change = 100.0 * (end[name]["median"] / start[name]["median"] - 1.0)
            spread = format_percent(track.within_finger[name]["log_sd"])
            u = format_percent(max(start[name]["u"], end[name]["u"]))
            note = f"from start to end, each ± {u}; varies by {spread}"
            answers.append(Answer(describe_quantity(name), f"{change:+.3g} %", note))
    findings = {"Identifiability": str(track.fit.identifiability)}
    if track.lifted:
        spans = ", ".join(f"{begin:.4g} to {end:.4g} s" for begin, end in track.lifted)
        findings["No contact"] = f"{spans}; these windows are left out."
    if track.jumps:
        findings["Jumps"] = f"at {', '.join(f'{jump:.4g} s' for jump in track.jumps)}; nothing is smoothed over them."
    count = int(np.count_nonzero(track.reliable))
    return PageSummary(
        title="A finger over time",
        subject=f"{count:,} windows of {format_engineering(track.window, 's')}, joined by random walks.",
        trusted=track.trusted,
        verdict="The finger is followed along the record" if track.trusted else f"{track.fit.message}",
        findings=findings,
        answers=answers,
        warnings=track.warnings,
        has_reservation=track.fit.identifiability.verdict != "identified",
    )
