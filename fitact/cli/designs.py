"""Commands that design the next measurement, and the drive that is felt."""

from pathlib import Path
from typing import Annotated

import typer

import fitact
from fitact import report
from fitact.cli import internal
from fitact.cli.app import app
from fitact.cli.options import Channels, Json, LazyRecords, Out, Rate, Scales, Seed
from fitact.cli.terminal import announce, command_line, show

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
    out: Out = None,
    json: Json = False,
) -> None:
    """Rank changes to the measurement by the expected uncertainty of the mean force.

    Writes report.html, design.json and design.svg into DIR.
    """
    announce("ranking measurements for", [scene])
    stated = fitact.Scene.load(scene)
    measured = list(LazyRecords(record, stated, (channel, scale, rate)))  # refuses bad records before the slow imports
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
        typer.Argument(metavar="[RECORD]...", help="One record of each finger; default: the scene's prior is used."),
    ] = None,
    share: Annotated[float, typer.Option("--share", help="Fraction of fingers that should feel the drive.")] = 0.95,
    channel: Channels = None,
    scale: Scales = None,
    rate: Rate = None,
    out: Out = None,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Find the smallest drive that a given fraction of fingers feel, by waveform, frequency and insulator.

    The threshold and your limits are stated in the scene. Writes report.html, drive.json and drive.svg into DIR; with
    records also chain.h5, from which an interrupted run resumes.
    """
    announce("designing a drive for", [scene])
    stated = fitact.Scene.load(scene)
    measured = LazyRecords(records, stated, (channel, scale, rate))
    internal.require_designable(stated, share)  # refuses before the population is sampled
    people = fitact.population(measured, stated, folder=out, seed=seed) if measured else None
    options = fitact.design_drive(stated, people, share, seed=seed)
    if out is not None:
        fingers = () if people is None else people.fingers
        report.write_folder(out, options, command_line(), stated, fingers)
    show(str(options), options.to_dict(), json, options.trusted)
