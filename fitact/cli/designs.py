"""Commands on what to do next: which measurement would tell most, which drive is felt."""

from pathlib import Path
from typing import Annotated

import typer

from fitact.cli.app import app
from fitact.cli.files import Files
from fitact.cli.options import Channels, Json, Out, Scales, Seed
from fitact.cli.terminal import finish, show, typed, use_compilation_cache
from fitact.files import write_json

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
    from fitact.scene.scene import Scene

    stated = Scene.load(scene)
    measured = list(Files(record, stated, (channel, scale)))  # refused before the slow imports
    use_compilation_cache()
    from fitact.design.measurement import design_measurement

    found = design_measurement(stated, measured)
    if out is not None:
        from fitact.report.design import write_design, write_design_page
        from fitact.report.frame import Origin

        write_json(out / "design.json", found.to_dict())
        write_design(out / "design.svg", found)
        write_design_page(out / "report.html", found, Origin.of(typed(), stated, measured))
    show(str(found), found.to_dict(), json)
    finish(found.trusted)


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
    from fitact.scene.scene import Scene

    stated = Scene.load(scene)
    measured = Files(records, stated, (channel, scale))
    use_compilation_cache()
    from fitact.design.drive import design_drive, require_designable

    require_designable(stated, share)  # before the people are sampled
    people = None
    if measured:
        from fitact.populations.fit_population import population

        people = population(measured, stated, folder=out, seed=seed)
    found = design_drive(stated, people, share, seed=seed)
    if out is not None:
        from fitact.report.drive_design import write_drive_design, write_drive_design_page
        from fitact.report.frame import Origin

        write_json(out / "drive.json", found.to_dict())
        write_drive_design(out / "drive.svg", found)
        fingers = () if people is None else people.fingers
        write_drive_design_page(out / "report.html", found, Origin.of(typed(), stated, fingers))
    show(str(found), found.to_dict(), json)
    finish(found.trusted)
