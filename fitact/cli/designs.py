"""Commands on what to do next: which measurement would tell most, which drive is felt."""

from pathlib import Path
from typing import Annotated

import typer

import fitact
from fitact import report
from fitact.cli import internal
from fitact.cli.app import app
from fitact.cli.options import Channels, Json, LazyRecords, Out, Scales, Seed
from fitact.cli.terminal import command_line, show

design = typer.Typer(
    name="design",
    no_args_is_help=True,
    help="What to do next: which measurement would tell most, which drive enough people feel.",
)
app.add_typer(design)


@design.command()
def measurement(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="Scene (TOML): the measurement as it stands.")],
    record: Annotated[
        list[Path] | None,
        typer.Option(
            "--record", metavar="RECORD", help="A record of it, whose fit gives values and noise; may be repeated."
        ),
    ] = None,
    channel: Channels = None,
    scale: Scales = None,
    out: Out = None,
    json: Json = False,
) -> None:
    """Which measurement would tell most of the mean force: the error to expect of each option, best first.

    Into DIR it writes report.html, design.json and design.svg.
    """
    stated = fitact.Scene.load(scene)
    measured = list(LazyRecords(record, stated, (channel, scale)))  # refused before the slow imports
    internal.use_compilation_cache()
    options = fitact.design_measurement(stated, measured)
    if out is not None:
        report.write_folder(out, options, command_line(), stated, measured)
    show(str(options), options.to_dict(), json, options.trusted)


@design.command()
def drive(
    scene: Annotated[str, typer.Argument(metavar="SCENE", help="Scene (TOML): panel, drive, threshold and limits.")],
    records: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[RECORD]...", help="One of each finger; absent: the scene's prior stands for people."),
    ] = None,
    share: Annotated[float, typer.Option("--share", help="Of people, who are to feel it.")] = 0.95,
    channel: Channels = None,
    scale: Scales = None,
    out: Out = None,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """The smallest drive that enough people feel: by waveform, frequency and insulator, within stated limits.

    Into DIR it writes report.html, drive.json and drive.svg, and of records chain.h5 (for going on).
    """
    stated = fitact.Scene.load(scene)
    measured = LazyRecords(records, stated, (channel, scale))
    internal.use_compilation_cache()
    internal.require_designable(stated, share)  # before the people are sampled
    people = fitact.population(measured, stated, folder=out, seed=seed) if measured else None
    options = fitact.design_drive(stated, people, share, seed=seed)
    if out is not None:
        fingers = () if people is None else people.fingers
        report.write_folder(out, options, command_line(), stated, fingers)
    show(str(options), options.to_dict(), json, options.trusted)
