"""Commands on records: what they hold, which model they prefer, what people they come from, what accuracy costs."""

from pathlib import Path
from typing import Annotated

import typer

from fitact.cli.app import app
from fitact.cli.files import Files
from fitact.cli.options import Channels, Fresh, Json, Out, RecordFiles, Scales, Seed, mapping, numbers
from fitact.cli.terminal import finish, say, show, typed, use_compilation_cache
from fitact.files import write_json


@app.command()
def inspect(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A record, or any file of an oscilloscope.")],
    channel: Channels = None,
    scale: Scales = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="FILE", help="Drawing to write: .svg or .png.")] = None,
    json: Json = False,
) -> None:
    """Look at a file before fitting it: channels, rate, units, noise, clipping, frequency, and what is doubtful."""
    from fitact.data.inspection import inspect as inspected
    from fitact.data.spectrum import is_spectrum, read_spectrum

    if is_spectrum(file):
        spectrum = read_spectrum(file)
        show(str(spectrum), spectrum.to_dict(), json)
        return
    seen = inspected(file, **mapping((channel, scale)))
    if out is not None:
        from fitact.report.record import write_record

        write_record(out, seen)
    show(str(seen), seen.to_dict(), json)


@app.command()
def compare(
    records: RecordFiles,
    scenes: Annotated[
        list[Path], typer.Option("--scene", metavar="FILE", help="Scene (TOML) of one model; give two or more.")
    ],
    channel: Channels = None,
    scale: Scales = None,
    json: Json = False,
) -> None:
    """Fit the model of each scene to the same records, in full, and say which the data prefer."""
    from fitact.scene.scene import Scene

    alike = len({path.stem for path in scenes}) < len(scenes)
    stated = {str(path) if alike else path.stem: Scene.load(path) for path in scenes}
    for each in stated.values():
        each.require_available(fit=True)
    measured = list(Files(records, next(iter(stated.values())), (channel, scale)))
    use_compilation_cache()
    from fitact.model_selection.comparison import compare as compared

    found = compared(measured, stated)
    show(str(found), found.to_dict(), json)
    finish(found.trusted)


@app.command()
def population(
    records: Annotated[list[Path], typer.Argument(metavar="RECORD...", help="One of each finger, on one panel.")],
    scene: Annotated[
        Path | None, typer.Option("--scene", metavar="FILE", help="Scene (TOML) of all; absent: the paper's device.")
    ] = None,
    channel: Channels = None,
    scale: Scales = None,
    covariates: Annotated[
        Path | None,
        typer.Option("--covariates", metavar="FILE", help="CSV: a column 'record', and one for each covariate."),
    ] = None,
    at: Annotated[
        list[str] | None, typer.Option("--at", metavar="NAME=VALUE", help="A covariate of the next finger.")
    ] = None,
    out: Out = None,
    seed: Seed = 0,
    fresh: Fresh = False,
    json: Json = False,
) -> None:
    """From one finger to people: how fingers differ, what force the next one will feel, and why.

    Into DIR it writes report.html, population.json, population.nc (the draws), population.svg, and chain.h5 (for
    going on).
    """
    from fitact.populations.covariates import read_covariates
    from fitact.scene.scene import Scene

    stated = None if scene is None else Scene.load(scene)
    known = {} if covariates is None else read_covariates(covariates, records)
    use_compilation_cache()
    from fitact.populations.fit_population import forget
    from fitact.populations.fit_population import population as find_population

    if fresh and out is not None:
        forget(out)
    measured = Files(records, stated, (channel, scale))
    found = find_population(
        measured, stated, covariates=known, at=numbers("--at moisture=0.4", at), folder=out, seed=seed
    )
    content = found.to_dict()
    if out is not None:
        from fitact.report.population import write_population
        from fitact.report.population_page import write_population_page

        tree = found.to_datatree()
        write_json(out / "population.json", content)
        found.to_netcdf(out / "population.nc")
        write_population(out / "population.svg", tree, content)
        write_population_page(out / "report.html", tree, content)
    show(str(found), content, json)
    finish(found.trusted)


@app.command()
def tradeoff(
    record: Annotated[
        Path | None, typer.Argument(metavar="[RECORD]", help="CSV with V and Vsc; absent: simulated from the scene.")
    ] = None,
    scene: Annotated[
        Path | None, typer.Option("--scene", metavar="FILE", help="Scene (TOML); absent: the paper's device.")
    ] = None,
    channel: Channels = None,
    scale: Scales = None,
    out: Out = None,
    json: Json = False,
) -> None:
    """Measure what each level of response, likelihood and uncertainty costs and is off by, on this machine.

    Takes a minute or two. With --out writes report.html, tradeoff.json and tradeoff.svg.
    """
    from fitact.data.readers.read import read
    from fitact.scene.scene import Scene

    stated = None if scene is None else Scene.load(scene)
    measured = None if record is None else read(record, stated, **mapping((channel, scale)))
    from fitact.tradeoff.tradeoff import measure_tradeoff

    try:
        found = measure_tradeoff(measured, stated)
    except KeyboardInterrupt:
        say("fitact: interrupted; nothing was written")
        raise typer.Exit(130) from None
    if out is not None:
        from fitact.report.frame import Origin
        from fitact.report.tradeoff import write_tradeoff, write_tradeoff_page

        write_json(out / "tradeoff.json", found.to_dict())
        write_tradeoff(out / "tradeoff.svg", found)
        write_tradeoff_page(out / "report.html", found, Origin.of(typed(), stated, [measured] if measured else []))
    show(str(found), found.to_dict(), json)
    finish(found.trusted)
