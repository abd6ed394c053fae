"""Commands on a scene: scene, prior, plan, simulate, reproduce, design."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

import fitact
from fitact import report
from fitact.cli import internal
from fitact.cli.app import app
from fitact.cli.options import (
    Channels,
    Json,
    Out,
    Pattern,
    Rate,
    Scales,
    SceneFile,
    Seed,
    Segment,
    Table,
    column_options,
    load_study,
)
from fitact.cli.terminal import announce, command_line, print_stderr, show


@app.command()
def scene(
    file: Annotated[
        str,
        typer.Argument(
            metavar="[SCENE]", help="Scene file (TOML), or the name of a shipped scene.", show_default="a template"
        ),
    ] = "",
    json: Json = False,
) -> None:
    """Print a scene with all keys and units; keys at their defaults are commented out."""
    loaded = fitact.Scene.load(file) if file else fitact.Scene()
    show(str(loaded).rstrip(), loaded.model_dump(mode="json"), json)


@app.command()
def prior(
    scene: SceneFile,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Figure to write (.html, .svg or .png).")
    ] = None,
    draws: Annotated[int, typer.Option("--draws", min=100, max=100_000, help="Number of fingers to draw.")] = 2000,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Predict Vsc and the force from the prior of a scene alone, before any data."""
    loaded = fitact.Scene.load(scene)
    announce("drawing from the prior of", [scene])
    predicted = internal.prior_predictive(loaded, draws, seed)
    if out is not None:
        report.write_prior(out, predicted)
    show(str(predicted), predicted.to_dict(), json)


@app.command()
def plan(
    scene: SceneFile,
    record: Annotated[
        Path | None,
        typer.Option("--record", metavar="RECORD", help="Record to fit; its V is used if it drives the fit."),
    ] = None,
    channel: Channels = None,
    scale: Scales = None,
    rate: Rate = None,
    segment: Segment = None,
    out: Out = None,
    json: Json = False,
) -> None:
    """Find the simplest model that meets the force tolerance of a scene.

    Lists the error and the speed-up of each simplification. With --out, writes report.html, plan.json and plan.svg into
    DIR.
    """
    announce("planning for", [scene])
    loaded = fitact.Scene.load(scene)
    measured = (
        None if record is None else fitact.read(record, loaded, **column_options((channel, scale, rate, segment)))
    )
    planned = fitact.plan(loaded) if measured is None else internal.plan_for_record(measured, loaded)
    if out is not None:
        report.write_folder(out, planned, command_line(), loaded, [measured] if measured else [])
    show(str(planned), planned.to_dict(), json)


@app.command()
def simulate(
    scene: SceneFile,
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="CSV file to write.")],
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Simulate a record of a scene, with noise, and write V and the measured channels to a CSV file."""
    loaded = fitact.Scene.load(scene)
    record = internal.simulate(loaded, seed)
    internal.write_csv(out, record)
    for warning in record.warnings:
        print_stderr(f"warning: {warning}")
    truth = {"Rsc": loaded.skin.Rsc, "Csc": loaded.skin.Csc, "Ci": loaded.device.Ci}
    content = {"file": str(out), "samples": len(record), "channels": list(record.channels), "seed": seed}
    show(f"wrote {out}: {len(record):,} samples of {', '.join(record.channels)}", content | {"truth": truth}, json)


@app.command()
def reproduce(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the results.")] = Path("reproduction"),
    json: Json = False,
) -> None:
    """Compute the equations, figures and numbers of the reference paper, and compare each with the printed value.

    Writes reproduction.json and reproduction.html into DIR.
    """
    announce("computing the claims of", ["the reference paper"])
    claims = internal.reproduce()
    page = report.write_reproduction(out, claims)
    lines = [f"{claim.verdict:8} {claim.id:24} {claim.claim}" for claim in claims]
    show("\n".join([*lines, f"open {page}"]), {"claims": [claim.to_dict() for claim in claims]}, json)


design = typer.Typer(
    name="design",
    no_args_is_help=True,
    help="Find the next measurement, or the drive that a given fraction of fingers feel.",
)
app.add_typer(design)


@design.command()
def measurement(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="Scene (TOML) of the present measurement.")],
    record: Annotated[
        list[Path] | None,
        typer.Option("--record", metavar="RECORD", help="Record whose fit gives values and noise; may be repeated."),
    ] = None,
    channel: Channels = None,
    scale: Scales = None,
    rate: Rate = None,
    segment: Segment = None,
    out: Out = None,
    json: Json = False,
) -> None:
    """Rank changes to the measurement by the expected uncertainty of the mean force.

    Writes report.html, design.json and design.svg into DIR.
    """
    announce("ranking measurements for", [scene])
    stated = fitact.Scene.load(scene)
    columns = column_options((channel, scale, rate, segment))
    measured = [fitact.read(path, stated, **columns) for path in record or ()]  # refused before the slow imports
    options = fitact.design_measurement(stated, measured)
    if out is not None:
        report.write_folder(out, options, command_line(), stated, measured)
    show(str(options), options.to_dict(), json, options.trusted)


@design.command()
def drive(
    scene: Annotated[
        str, typer.Argument(metavar="SCENE", help="Scene (TOML) with panel, drive, threshold and limits.")
    ],
    records: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[RECORD]...",
            help="Folder that fitact population left, or one record of each finger; default: the scene's prior is"
            " used.",
        ),
    ] = None,
    table: Table = None,
    pattern: Pattern = None,
    share: Annotated[
        float, typer.Option("--share", help="Fraction of fingers or people that should feel the drive.")
    ] = 0.95,
    touches: Annotated[
        float,
        typer.Option("--touches", help="Fraction of touches in which they should feel it, if records are repeated."),
    ] = 0.9,
    channel: Channels = None,
    scale: Scales = None,
    rate: Rate = None,
    segment: Segment = None,
    out: Out = None,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Find the smallest drive that a given fraction of fingers feel, by waveform, frequency and insulator.

    The threshold and your limits are stated in the scene. Writes report.html, drive.json and drive.svg into DIR.
    """
    announce("designing a drive for", [scene])
    stated = fitact.Scene.load(scene)
    internal.require_designable(stated, share, touches)  # refuses before the population is sampled
    study = None if table is None and pattern is None else load_study(records, table, pattern)
    paths = records or () if study is None else study.records
    people: Any = None
    fingers: Sequence[Any] = ()
    if study is None and len(paths) == 1 and (paths[0] / "population.json").exists():
        people = paths[0]
    elif paths:
        measured = internal.RecordFiles(paths, stated, **column_options((channel, scale, rate, segment)))
        labels, covariates = (None, None) if study is None else (study.labels, study.covariates)
        people = fitact.population(measured, stated, labels=labels, covariates=covariates, folder=out, seed=seed)
        fingers = people.fingers
    options = fitact.design_drive(stated, people, share, touches=touches, seed=seed)
    if out is not None:
        report.write_folder(out, options, command_line(), stated, fingers)
    show(str(options), options.to_dict(), json, options.trusted)
