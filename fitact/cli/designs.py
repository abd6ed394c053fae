"""Commands on what to do next: which measurement would tell most."""

from pathlib import Path
from typing import Annotated

import typer

from fitact.cli.app import app
from fitact.cli.options import Channels, Json, Out, Scales, mapping
from fitact.cli.terminal import finish, show, use_compilation_cache
from fitact.files import write_json

design = typer.Typer(name="design", no_args_is_help=True, help="What to do next: which measurement would tell most.")
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

    Into DIR it writes design.json and design.svg.
    """
    from fitact.model.scene import Scene

    stated, asked, measured = Scene.load(scene), mapping((channel, scale)), []
    if record:
        from fitact.data.formats import read

        measured = [read(path, stated, **asked) for path in record]  # refused before the slow imports
    use_compilation_cache()
    from fitact.inference.design import design_measurement

    found = design_measurement(stated, measured)
    if out is not None:
        from fitact.report.design import write_design

        write_json(out / "design.json", found.to_dict())
        write_design(out / "design.svg", found)
    show(str(found), found.to_dict(), json)
    finish(found.trusted)
