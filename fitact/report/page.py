"""Report of a posterior: verdict, record, parameters, force, and how to repeat it."""

import json
import os
import shlex
from typing import Any

import jinja2
from markdown_it import MarkdownIt
from markupsafe import Markup

from fitact.charts.bars import draw_budgets
from fitact.errors import InputError
from fitact.files import complete_folder, read_datatree
from fitact.report.frame import image, write_page
from fitact.report.posterior import make_charts
from fitact.result_text import (
    FORCE_LAWS,
    blind_table,
    budget_sentence,
    budget_table,
    describe_sources,
    next_measurements,
    next_step,
    quantity_table,
    result_names,
    result_sentences,
    verdict_sentence,
)
from fitact.scene.scene import Scene
from fitact.summary import format_estimate, format_interval, is_trusted, load
from fitact.what_now import explain

_CIRCUITS = {
    "final": "equal fingers, grounded hand",
    "direct": "grounded hand, with further elements",
    "natural": "ungrounded body",
}


def write_report(path: str | os.PathLike[str], tree: Any, summary: dict[str, Any]) -> None:
    """Write the page from a posterior's DataTree and the content of summary.json.

    Raises:
        InputError: the file cannot be written, or another version wrote the results.
    """
    try:
        scene = Scene.from_dict(summary["scene"])
        only_impedance = set(summary["model"]["channels"]) == {"impedance"}
        wirings = () if only_impedance else (scene.draw_wiring(),)
        write_page(
            path,
            "report.html",
            summary=summary,
            charts=make_charts(tree),
            drawings=(scene.draw_circuit(summary["parameters"]), *wirings),
            table=quantity_table(summary),
            panels=_panels(summary["fit"]["traces"]),
            budgets=[budget_table(name, summary) for name in summary["budget"]],
            verdict=verdict_sentence(summary),
            next_step=next_step(summary),
            measurements=next_measurements(summary),
            blind=blind_table(summary),
            budget_note=budget_sentence(summary),
            budget_picture=image(lambda: draw_budgets(summary)),
            force=result_sentences(summary),
            law=f"computed {FORCE_LAWS[summary['force_basis']['law']]}",
            circuits=_CIRCUITS,
            estimate=format_estimate,
            interval=format_interval,
            sources=describe_sources,
            trusted=is_trusted(summary),
            advice=[Markup(MarkdownIt("js-default").render(explain(name))) for name in result_names(summary)],
            command=_command(summary),
            scene=json.dumps(summary["scene"], indent=2, ensure_ascii=False),
        )
    except (KeyError, jinja2.UndefinedError) as error:
        raise InputError(
            f"{path}: the results lack {error}, because another version of fitact wrote them; compute them again"
        ) from error


def read_results(directory: str | os.PathLike[str]) -> tuple[Any, dict[str, Any]]:
    """Read what `write_report` needs from a folder of results; raise InputError if it is incomplete."""
    content = load(directory)
    with complete_folder(directory, "results") as folder:
        return read_datatree(folder / "posterior.nc"), content


def _panels(traces: list[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """Return the fitted channels of each record or spectrum, by the name of its chart."""
    panels: dict[str, list[dict[str, Any]]] = {}
    for trace in traces:
        number = trace["label"].rpartition("_")[2]
        axis = "frequency" if "structure_z" in trace else "time"
        panels.setdefault(f"{axis}_{number}" if number.isdigit() else axis, []).append(trace)
    return panels


def _command(summary: dict[str, Any]) -> str:
    """Return the command as typed, or an equivalent one for results from Python."""
    if "command" in summary:
        return summary["command"]
    scene = " --scene SCENE.toml" if summary["scene"] else ""
    records = " ".join(shlex.quote(each["source"]) for each in summary["record"]["sources"])
    return f"fitact run {records}{scene} --seed {summary['seed']}"
