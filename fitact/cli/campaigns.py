"""The command on many records."""

from pathlib import Path
from typing import Annotated

import typer

import fitact
from fitact import report
from fitact.cli import internal
from fitact.cli.app import app
from fitact.cli.options import Channels, CommonScene, Json, Scales, Seed, column_options, load_scene
from fitact.cli.terminal import command_line, show


@app.command()
def campaign(
    records: Annotated[list[Path], typer.Argument(metavar="RECORD...", help="One of each finger or condition.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the results; the same one goes on.")],
    scene: CommonScene = None,
    channel: Channels = None,
    scale: Scales = None,
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", metavar="ADDRESS", help="Of a Dask scheduler, as tcp://host:8786."),
    ] = None,
    workers: Annotated[
        int | None, typer.Option("--workers", min=1, help="Workers of this machine; absent: one for each core.")
    ] = None,
    memory: Annotated[str, typer.Option("--memory", help="What each of these may take.")] = "2 GiB",
    posteriors: Annotated[
        bool, typer.Option("--posteriors", help="Sample the posterior of each, alike records together.")
    ] = False,
    reports: Annotated[
        bool, typer.Option("--reports", help="Sample the posterior of each by itself, and write its report.")
    ] = False,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Fit many records, each by itself, on this machine's cores or any Dask cluster; nothing is lost or done twice.

    Into DIR it writes results.parquet, failures.csv and index.html. The same command goes on after any interruption.
    Exit code 0: every record has an answer or a reason why not.
    """
    stated = load_scene(scene)
    internal.use_compilation_cache()
    fits = fitact.run_campaign(
        records, out, stated, **column_options((channel, scale)),
        scheduler=scheduler, workers=workers, memory=memory, posteriors=posteriors,
        reports=reports, seed=seed,
    )  # fmt: skip
    page = report.write_campaign(out, fits, report.Provenance.from_inputs(command_line(), stated))
    counts = {"records": len(fits), "answers": len(fits.answered), "failures": len(fits.failures)}
    show(f"{fits}\nopen {page}", counts | {"page": str(page)}, json)
