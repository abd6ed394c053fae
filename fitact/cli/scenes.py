"""Commands on a scene: what it says, what it believes, what it requires, and records of it."""

from pathlib import Path
from typing import Annotated

import typer

import fitact
from fitact import report
from fitact.cli import internal
from fitact.cli.app import app
from fitact.cli.options import Channels, Json, Out, Scales, SceneFile, Seed, column_options
from fitact.cli.terminal import command_line, show


@app.command()
def scene(
    file: Annotated[str, typer.Argument(metavar="[SCENE]", help="Scene (TOML), or the name of a shipped one.")] = "",
    json: Json = False,
) -> None:
    """Print a scene with every key, its unit and, as comments, the defaults; without one: a template to fill in."""
    stated = fitact.Scene.load(file) if file else fitact.Scene()
    show(str(stated).rstrip(), stated.model_dump(mode="json"), json)


@app.command()
def prior(
    scene: SceneFile,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Figure to write: .html, .svg or .png.")
    ] = None,
    draws: Annotated[int, typer.Option("--draws", min=100, max=100_000, help="Fingers to draw.")] = 2000,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """What a scene's prior means for Vsc and force, before any data."""
    stated = fitact.Scene.load(scene)
    internal.use_compilation_cache()
    predicted = internal.prior_predictive(stated, draws, seed)
    if out is not None:
        report.write_prior(out, predicted)
    show(str(predicted), predicted.to_dict(), json)


@app.command()
def plan(
    scene: SceneFile,
    record: Annotated[
        Path | None,
        typer.Option("--record", metavar="RECORD", help="Plan for this record: for its V where that drives the fit."),
    ] = None,
    channel: Channels = None,
    scale: Scales = None,
    out: Out = None,
    json: Json = False,
) -> None:
    """What a scene requires of its model: what may be left out, what that changes, and what it saves.

    Into DIR it writes report.html, plan.json and plan.svg.
    """
    stated = fitact.Scene.load(scene)
    measured = None if record is None else fitact.read(record, stated, **column_options((channel, scale)))
    internal.use_compilation_cache()
    planned = fitact.plan(stated) if measured is None else internal.plan_for_record(measured, stated)
    if out is not None:
        report.write_folder(out, planned, command_line(), stated, [measured] if measured else [])
    show(str(planned), planned.to_dict(), json)


@app.command()
def simulate(
    scene: SceneFile,
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="CSV to write.")],
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Simulate a record of a scene: V and what it measures (Vsc, I), with noise, as CSV."""
    stated = fitact.Scene.load(scene)
    record = internal.simulate(stated, seed)
    internal.write_csv(out, record)
    truth = {"Rsc": stated.skin.Rsc, "Csc": stated.skin.Csc, "Ci": stated.device.Ci}
    content = {"file": str(out), "samples": len(record), "channels": list(record.channels), "seed": seed}
    show(f"wrote {out}: {len(record):,} samples of {', '.join(record.channels)}", content | {"truth": truth}, json)


@app.command()
def reproduce(out: Out = Path("reproduction"), json: Json = False) -> None:
    """Every equation, figure and number of the paper, computed and judged.

    Into DIR it writes reproduction.json and reproduction.html.
    """
    internal.use_compilation_cache()
    claims = internal.reproduce()
    page = report.write_reproduction(out or Path(), claims)
    lines = [f"{claim.verdict:8} {claim.id:24} {claim.claim}" for claim in claims]
    show("\n".join([*lines, f"open {page}"]), {"claims": [claim.to_dict() for claim in claims]}, json)
