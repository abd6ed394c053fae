"""The report: verdict first, then the record, the parameters, the force, and how to repeat it."""

import base64
import json
import os
import shlex
from pathlib import Path
from typing import Any

import jinja2
import matplotlib as mpl

from fitact.errors import InputError
from fitact.files import replacing
from fitact.inference.summary import width
from fitact.report import plots
from fitact.units import engineering

_LABELS = {
    "Rsc": "skin resistance Rsc",
    "Csc": "skin capacitance Csc",
    "Ci": "insulator capacitance Ci",
    "gain": "gain of the channel Vsc",
    "delay": "delay of Vsc against V",
    "sigma": "noise of Vsc",
    "offset": "offset of Vsc",
    "drift": "drift of Vsc over half the record",
    "hum_50Hz_cos": "hum at 50 Hz, cosine",
    "hum_50Hz_sin": "hum at 50 Hz, sine",
    "hum_60Hz_cos": "hum at 60 Hz, cosine",
    "hum_60Hz_sin": "hum at 60 Hz, sine",
    "charge": "decaying charge at the first sample",
    "g": "divider g = Ci / (2 Ci + Csc)",
    "b": "time constant b = Rsc (2 Ci + Csc)",
    "force_mean": "electrostatic force, mean",
    "force_peak": "electrostatic force, peak",
    "force_rms": "electrostatic force, rms",
    "friction_mean": "friction, mean",
}


def write_report(path: str | os.PathLike[str], tree: Any, summary: dict[str, Any]) -> None:
    """Write the page from a posterior's DataTree and the content of summary.json."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("fitact.report"), autoescape=True, undefined=jinja2.StrictUndefined
    )
    with mpl.rc_context(plots.style()):
        figures = _figures(tree)
    page = environment.get_template("report.html").render(
        summary=summary,
        figures=figures,
        labels=_LABELS,
        quantity=_quantity,
        width=width,
        command=_command(summary),
        scene=json.dumps(summary["scene"], indent=2, ensure_ascii=False),
    )
    with replacing(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def read_results(directory: str | os.PathLike[str]) -> tuple[Any, dict[str, Any]]:
    """What `write_report` needs, from a folder that `fitact sample` or `fitact run` wrote.

    Raises:
        InputError: a file is missing or damaged.
    """
    import xarray as xr

    directory = Path(directory)
    try:
        summary = json.loads((directory / "summary.json").read_text())
        with xr.open_datatree(directory / "posterior.nc", engine="h5netcdf") as tree:
            if not {"identifiability", "convergence", "fit", "model", "record"} <= set(summary):
                raise ValueError("summary.json is not fitact's")
            return tree.load(), summary
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            f"{directory}: holds no complete results ({error}); make them with: fitact sample RECORD --out {directory}"
        ) from error


def _figures(tree: Any) -> dict[str, str]:
    posterior = {str(name): values.values.ravel() for name, values in tree["posterior"].data_vars.items()}
    prior = {str(name): values.values.ravel() for name, values in tree["prior"].data_vars.items()}
    units = {str(name): values.attrs["units"] for name, values in tree["posterior"].data_vars.items()}
    predicted = tree["posterior_predictive"]["Vsc"]
    figures = {
        "record": plots.record_figure(
            tree["observed_data"]["time"].values,
            tree["observed_data"]["Vsc"].values,
            tree["constant_data"]["Vsc_fit"].values,
            predicted["time"].values,
            predicted.values.reshape(-1, predicted.sizes["time"]),
        ),
        "corner": plots.corner_figure(posterior, prior, units),
        "force": plots.force_figure(posterior),
    }
    # an SVG in an <img> cannot clash with another's ids, and carries its alt text
    return {
        name: "data:image/svg+xml;base64," + base64.b64encode(svg.encode()).decode() for name, svg in figures.items()
    }


def _quantity(summary: dict[str, Any], key: str = "q50", digits: int = 4) -> str:
    return engineering(summary[key], summary["unit"], digits)


def _command(summary: dict[str, Any]) -> str:
    scene = " --scene SCENE.toml" if summary["scene"] else ""
    return f"fitact run {shlex.quote(summary['record']['source'])}{scene} --seed {summary['seed']}"
