"""The report: verdict first, then the record, the parameters, the force, and how to repeat it."""

import json
import math
import os
import re
import shlex
from pathlib import Path
from typing import Any

import jinja2

from fitact.errors import InputError
from fitact.report.frame import write_page
from fitact.report.posterior import CHANNELS, make_charts
from fitact.summary import FORCE_DESCRIPTIONS, format_sd, load
from fitact.units import format_engineering

_LABELS = {
    "Rsc": "skin resistance Rsc",
    "Csc": "skin capacitance Csc",
    "Ci": "insulator capacitance Ci",
    "R_H": "body resistance R_H",
    "grounding_Rsc": "grounding skin's resistance",
    "grounding_Csc": "grounding skin's capacitance",
    "Z": "resistance to earth Z",
    "Z_capacitance": "capacitance to earth",
    "series_resistor": "series resistor",
    "Rgap": "gap's resistance Rgap",
    "Cgap": "gap's capacitance Cgap",
    "alpha": "exponent of the fractional skin",
    "gain": "gain of {}",
    "delay": "delay of {} against V",
    "clock": "drive's frequency over the stated one, less 1",
    "sigma": "noise of {}",
    "offset": "offset of {}",
    "drift": "drift of {} over half the record",
    "hum_50Hz_cos": "hum of {} at 50 Hz, cosine",
    "hum_50Hz_sin": "hum of {} at 50 Hz, sine",
    "hum_60Hz_cos": "hum of {} at 60 Hz, cosine",
    "hum_60Hz_sin": "hum of {} at 60 Hz, sine",
    "charge": "decaying charge in {} at the first sample",
    "charge_2": "second decaying charge in {} at the first sample",
    "charge_3": "third decaying charge in {} at the first sample",
    "charge_4": "fourth decaying charge in {} at the first sample",
    "g": "divider g = Ci / (2 Ci + Csc)",
    "b": "time constant b = Rsc (2 Ci + Csc)",
    "force_mean": "electrostatic force, mean",
    "force_peak": "electrostatic force, peak",
    "force_rms": "electrostatic force, rms",
    "friction_mean": "friction, mean",
}
_CIRCUITS = {
    "final": "the paper's final circuit",
    "direct": "direct ground with more than the paper's final circuit",
    "natural": "natural ground",
}


def write_report(path: str | os.PathLike[str], tree: Any, summary: dict[str, Any]) -> None:
    """Write the page from a posterior's DataTree and the content of summary.json.

    Raises:
        InputError: the place cannot be written, or the results are of another version.
    """
    try:
        write_page(
            path,
            "report.html",
            summary=summary,
            charts=make_charts(tree),
            label=_label,
            channels=CHANNELS,
            force=FORCE_DESCRIPTIONS[summary["model"].get("force", "paper")],
            circuits=_CIRCUITS,
            quantity=_format_quantity,
            width=format_sd,
            command=_command(summary),
            scene=json.dumps(summary["scene"], indent=2, ensure_ascii=False),
        )
    except (KeyError, jinja2.UndefinedError) as error:
        raise InputError(
            f"{path}: its results lack {error}, as of another version of fitact; make them anew"
        ) from error


def read_results(directory: str | os.PathLike[str]) -> tuple[Any, dict[str, Any]]:
    """Read what `write_report` needs from a folder that `fitact sample` or `fitact run` wrote.

    Raises:
        InputError: a file is missing or damaged.
    """
    import xarray as xr

    content = load(directory)
    try:
        with xr.open_datatree(Path(directory) / "posterior.nc", engine="h5netcdf") as tree:
            return tree.load(), content
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            f"{directory}: holds no complete results ({error}); make them with: fitact sample RECORD --out {directory}"
        ) from error


def _format_quantity(summary: dict[str, Any], key: str = "q50", digits: int = 4) -> str:
    """A number of a summary, with at least as many digits as tell its quantiles apart."""
    spread = summary["sd"] / abs(summary["mean"]) if summary["mean"] else 1.0
    needed = 1 + math.ceil(-math.log10(spread)) if 0.0 < spread < 1.0 else digits
    return format_engineering(summary[key], summary["unit"], min(max(digits, needed), 8))


def _label(name: str) -> str:
    """A quantity's name for people; a nuisance's ends in its trace's label, as "sigma_I_2"."""
    bare = name if name in _LABELS else re.sub(r"_\d+$", "", name)
    number = name[len(bare) + 1 :]
    label = _LABELS[bare.removesuffix("_I")].format("I" if bare.endswith("_I") else "Vsc")
    return label + (f", record {number}" if number else "")


def _command(summary: dict[str, Any]) -> str:
    """The command as it was typed; what comes near it of results from Python."""
    if "command" in summary:
        return summary["command"]
    scene = " --scene SCENE.toml" if summary["scene"] else ""
    records = " ".join(shlex.quote(each["source"]) for each in summary["record"]["sources"])
    return f"fitact run {records}{scene} --seed {summary['seed']}"
