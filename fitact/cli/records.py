"""Commands on records: what they hold, which model they prefer, what people they come from, what accuracy costs."""

from pathlib import Path
from typing import Annotated

import typer

import fitact
from fitact import report
from fitact.cli import internal, options
from fitact.cli.app import app
from fitact.cli.terminal import command_line, print_stderr, show
from fitact.files import write_json


@app.command()
def inspect(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A record, or any file of an oscilloscope.")],
    channel: options.Channels = None,
    scale: options.Scales = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="FILE", help="Drawing to write: .svg or .png.")] = None,
    json: options.Json = False,
) -> None:
    """Look at a file before fitting it: channels, rate, units, noise, clipping, frequency, and what is doubtful."""
    if internal.is_spectrum(file):
        spectrum = fitact.read_spectrum(file)
        show(str(spectrum), spectrum.to_dict(), json)
        return
    inspection = fitact.inspect(file, **options.column_options((channel, scale)))
    if out is not None:
        report.write_record(out, inspection)
    show(str(inspection), inspection.to_dict(), json)


@app.command()
def compare(
    records: options.RecordFiles,
    scenes: Annotated[
        list[Path], typer.Option("--scene", metavar="FILE", help="Scene (TOML) of one model; give two or more.")
    ],
    channel: options.Channels = None,
    scale: options.Scales = None,
    json: options.Json = False,
) -> None:
    """Fit the model of each scene to the same records, in full, and say which the data prefer."""
    alike = len({path.stem for path in scenes}) < len(scenes)
    models = {str(path) if alike else path.stem: fitact.Scene.load(path) for path in scenes}
    for model in models.values():
        model.require_available(fit=True)
    measured = list(options.LazyRecords(records, next(iter(models.values())), (channel, scale)))
    internal.use_compilation_cache()
    comparison = fitact.compare(measured, models)
    show(str(comparison), comparison.to_dict(), json, comparison.trusted)


@app.command()
def population(
    records: Annotated[list[Path], typer.Argument(metavar="RECORD...", help="One of each finger, on one panel.")],
    scene: options.CommonScene = None,
    channel: options.Channels = None,
    scale: options.Scales = None,
    covariates: Annotated[
        Path | None,
        typer.Option("--covariates", metavar="FILE", help="CSV: a column 'record', and one for each covariate."),
    ] = None,
    at: Annotated[
        list[str] | None, typer.Option("--at", metavar="NAME=VALUE", help="A covariate of the next finger.")
    ] = None,
    out: options.Out = None,
    seed: options.Seed = 0,
    fresh: options.Fresh = False,
    json: options.Json = False,
) -> None:
    """From one finger to people: how fingers differ, what force the next one will feel, and why.

    Into DIR it writes report.html, population.json, population.nc (the draws), population.svg, and chain.h5 (for
    going on).
    """
    stated = options.load_scene(scene)
    known = {} if covariates is None else internal.read_covariates(covariates, records)
    internal.use_compilation_cache()
    if fresh and out is not None:
        internal.delete_chains(out)
    people = fitact.population(
        options.LazyRecords(records, stated, (channel, scale)), stated, covariates=known,
        at=options.parse_numbers("--at moisture=0.4", at), folder=out, seed=seed,
    )  # fmt: skip
    content = people.to_dict()
    if out is not None:
        tree = people.to_datatree()
        write_json(out / "population.json", content)
        people.to_netcdf(out / "population.nc")
        report.write_population(out / "population.svg", tree, content)
        report.write_population_page(out / "report.html", tree, content)
    show(str(people), content, json, people.trusted)


@app.command()
def tradeoff(
    record: Annotated[
        Path | None, typer.Argument(metavar="[RECORD]", help="CSV with V and Vsc; absent: simulated from the scene.")
    ] = None,
    scene: Annotated[
        Path | None, typer.Option("--scene", metavar="FILE", help="Scene (TOML); absent: the paper's device.")
    ] = None,
    channel: options.Channels = None,
    scale: options.Scales = None,
    out: options.Out = None,
    json: options.Json = False,
) -> None:
    """Measure what each level of response, likelihood and uncertainty costs and is off by, on this machine.

    Takes a minute or two. With --out writes report.html, tradeoff.json and tradeoff.svg.
    """
    stated = options.load_scene(scene)
    measured = None if record is None else fitact.read(record, stated, **options.column_options((channel, scale)))
    try:
        costs = fitact.measure_tradeoff(measured, stated)
    except KeyboardInterrupt:
        print_stderr("fitact: interrupted; nothing was written")
        raise typer.Exit(130) from None
    if out is not None:
        report.write_folder(out, costs, command_line(), stated, [measured] if measured else [])
    show(str(costs), costs.to_dict(), json, costs.trusted)
