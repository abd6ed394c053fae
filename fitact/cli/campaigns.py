"""Command that fits many records: campaign."""

from pathlib import Path
from typing import Annotated

import typer

import fitact
from fitact import report
from fitact.cli.app import app
from fitact.cli.options import Channels, CommonScene, Json, Rate, Scales, Seed, column_options, load_scene
from fitact.cli.terminal import announce, command_line, show


@app.command()
def campaign(
    records: Annotated[list[Path], typer.Argument(metavar="RECORD...", help="Records, each fitted independently.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the results, also to resume.")],
    scene: CommonScene = None,
    channel: Channels = None,
    scale: Scales = None,
    rate: Rate = None,
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", metavar="ADDRESS", help="Address of a Dask scheduler, e.g. tcp://host:8786."),
    ] = None,
    workers: Annotated[
        int | None, typer.Option("--workers", min=1, help="Number of local workers.", show_default="one per core")
    ] = None,
    memory: Annotated[str, typer.Option("--memory", help="Memory limit of each local worker.")] = "2 GiB",
    posteriors: Annotated[
        bool,
        typer.Option("--posteriors", help="Sample every posterior; similar records are sampled together."),
    ] = False,
    reports: Annotated[
        bool, typer.Option("--reports", help="Sample every posterior separately, and write a report for each record.")
    ] = False,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Fit many records independently, on the cores of this machine or on a Dask cluster.

    Writes results.parquet, failures.csv and index.html into DIR. After an interruption, run the same command again:
    finished records are kept. Exit status 0 means that every record has a result or a reason for its failure.
    """
    announce("fitting", records)
    loaded = load_scene(scene)
    fits = fitact.run_campaign(
        records, out, loaded, **column_options((channel, scale, rate)),
        scheduler=scheduler, workers=workers, memory=memory, posteriors=posteriors,
        reports=reports, seed=seed,
    )  # fmt: skip
    page = report.write_campaign(out, fits, report.Provenance.from_inputs(command_line(), loaded))
    counts = {"records": len(fits), "answers": len(fits.answered), "failures": len(fits.failures)}
    show(f"{fits}\nopen {page}", counts | {"page": str(page)}, json)
