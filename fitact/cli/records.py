"""Commands on records: inspect, compare, population, track, campaign, tradeoff."""

from pathlib import Path
from typing import Annotated

import typer

import fitact
from fitact import report
from fitact.cli import internal, options
from fitact.cli.app import app
from fitact.cli.terminal import announce, command_line, show
from fitact.errors import InputError
from fitact.files import write_json


@app.command()
def inspect(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="Record, impedance spectrum, oscilloscope file or table.")
    ],
    channel: options.Channels = None,
    scale: options.Scales = None,
    rate: options.Rate = None,
    segment: options.Segment = None,
    shunt: options.Shunt = None,
    band: options.Band = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="FILE", help="Plot to write (.svg or .png).")] = None,
    json: options.Json = False,
) -> None:
    """Show the channels, units, sampling rate, noise, clipping and frequency of a file, and list possible problems.

    Of a table of an experiment (a CSV with a column 'record'), show people, repetitions and covariates. Of a file that
    is refused, show the columns, the first rows and a guess at the command that reads it.
    """
    try:
        _inspect(file, (channel, scale, rate, segment), (segment or "all", shunt, band), out, json)
    except InputError:
        if not json:
            stated = options.column_options((None, None, rate, segment))
            if shown := internal.preview(file, stated["rate"], stated["segment"]):
                print(shown, flush=True)
        raise


def _inspect(
    file: Path, columns: options.Columns, choice: options.SpectrumChoice, out: Path | None, json: bool
) -> None:
    if internal.is_study(file):
        if out is not None:
            raise InputError(f"--out {out}: draws a record, and {file} is a table of records; leave --out away")
        study = fitact.Study.from_table(file)
        show(str(study), study.to_dict(), json)
        return
    if internal.is_spectrum(file):
        spectra = options.read_spectra(file, choice)
        tests = [internal.check_kramers_kronig(each) for each in spectra]
        text = "\n".join(f"{each}\n{test}" for each, test in zip(spectra, tests, strict=True))
        entries = [
            each.to_dict() | {"kramers_kronig": test.to_dict()} for each, test in zip(spectra, tests, strict=True)
        ]
        if out is not None:
            report.write_spectra(out, spectra)
        show(text, entries[0] if len(entries) == 1 else {"source": str(file), "spectra": entries}, json)
        return
    inspection = fitact.inspect(file, **options.column_options(columns))
    if out is not None:
        report.write_record(out, inspection)
    show(str(inspection), inspection.to_dict(), json)


@app.command()
def compare(
    records: options.RecordFiles,
    scenes: Annotated[
        list[Path],
        typer.Option("--scene", metavar="FILE", help="Scene file (TOML) of one model; give two or more."),
    ],
    channel: options.Channels = None,
    scale: options.Scales = None,
    rate: options.Rate = None,
    segment: options.Segment = None,
    json: options.Json = False,
) -> None:
    """Fit the full model of each scene to the same records, and report which model predicts the data best."""
    announce("fitting", records)
    same_stems = len({path.stem for path in scenes}) < len(scenes)
    models = {str(path) if same_stems else path.stem: fitact.Scene.load(path) for path in scenes}
    for model in models.values():
        model.require_available(fit=True)
    first, columns = next(iter(models.values())), options.column_options((channel, scale, rate, segment))
    comparison = fitact.compare([internal.read_any(path, first, **columns) for path in records], models)
    show(str(comparison), comparison.to_dict(), json, comparison.trusted)


@app.command()
def population(
    records: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="RECORD",
            help="Records or spectra on one panel, one per finger, or folders that fitact track left.",
        ),
    ] = None,
    table: options.Table = None,
    pattern: options.Pattern = None,
    scene: options.CommonScene = None,
    channel: options.Channels = None,
    scale: options.Scales = None,
    rate: options.Rate = None,
    segment: options.Segment = None,
    covariates: Annotated[
        Path | None,
        typer.Option("--covariates", metavar="FILE", help="CSV with a column 'record' and a column per covariate."),
    ] = None,
    at: Annotated[
        list[str] | None,
        typer.Option(
            "--at", metavar="NAME=VALUE", help="Covariate of the predicted finger.", show_default="mean of the fingers"
        ),
    ] = None,
    out: options.Out = None,
    seed: options.Seed = 0,
    fresh: options.Fresh = False,
    json: options.Json = False,
) -> None:
    """Estimate how fingers vary from records of several fingers, and predict the force on a new finger.

    With --out, writes report.html, population.json, population.nc (the draws) and population.svg into DIR, and
    chain.h5, from which an interrupted run resumes, if the posterior is so far from normal that it needs emcee.
    """
    study = options.load_study(records, table, pattern)
    if table is not None and covariates is not None:
        raise InputError(f"--covariates {covariates}: {table} has a column for each; add those columns to it")
    paths = records or () if study is None else study.records
    announce("fitting", paths)
    loaded = options.load_scene(scene)
    covariate_values = {} if study is None else dict(study.covariates)
    if covariates is not None:
        covariate_values |= internal.read_covariates(covariates, paths)
    if fresh and out is not None:
        internal.delete_chains(out)
    fitted = fitact.population(
        internal.RecordFiles(paths, loaded, **options.column_options((channel, scale, rate, segment))), loaded,
        labels=None if study is None else study.labels, covariates=covariate_values,
        at=options.parse_numbers("--at moisture=0.4", at), folder=out, seed=seed,
    )  # fmt: skip
    content = fitted.to_dict()
    if out is not None:
        tree = fitted.to_datatree()
        write_json(out / "population.json", content)
        fitted.to_netcdf(out / "population.nc")
        report.write_population(out / "population.svg", tree, content)
        report.write_population_page(out / "report.html", tree, content)
    show(str(fitted), content, json, fitted.trusted)


@app.command()
def track(
    record: Annotated[
        str,
        typer.Argument(
            metavar="RECORD", help="Long record with V and the channels of the scene; - reads CSV from standard input."
        ),
    ],
    scene: options.CommonScene = None,
    channel: options.Channels = None,
    scale: options.Scales = None,
    rate: options.Rate = None,
    segment: options.Segment = None,
    out: options.Out = None,
    window: Annotated[
        str | None,
        typer.Option("--window", metavar="TIME", help="Length of a window, e.g. 50ms.", show_default="5 periods of V"),
    ] = None,
    follow: Annotated[
        str,
        typer.Option("--follow", metavar="TIME", help="Wait so long for more samples of a file that is being written."),
    ] = "0 s",
    json: options.Json = False,
) -> None:
    """Follow a finger along a long record: parameters, contact area and force over time, and lift-offs.

    With --out, writes track.parquet, summary.json, window.csv and report.html into DIR, which fitact population takes.
    After an interruption, run the same command again.

    With --follow, or from standard input, prints a line about every second while the record grows.
    """
    announce("tracking", [record])
    loaded = options.load_scene(scene)
    patience = options.parse_option("--follow", follow, "s")
    live = not json and (patience > 0.0 or record == "-")
    found = fitact.track(
        record, loaded, window=None if window is None else options.parse_option("--window", window, "s"),
        follow=patience, folder=out, update=(lambda track: print(track.describe_last(), flush=True)) if live else None,
        **options.column_options((channel, scale, rate, segment)),
    )  # fmt: skip
    content = found.to_dict() | {"command": command_line()}
    if out is not None:
        found.to_parquet(out / "track.parquet")
        write_json(out / "summary.json", content)
        internal.write_csv(out / "window.csv", found.fit.record)
        report.write_track(out / "report.html", found, report.Provenance.from_inputs(command_line(), loaded))
    end = "" if out is None else f"\nopen {out / 'report.html'}"
    show(f"{found}{end}", content, json, found.trusted)


@app.command()
def campaign(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the results, also to resume.")],
    records: Annotated[
        list[Path] | None,
        typer.Argument(metavar="RECORD", help="Records or spectra, each fitted independently."),
    ] = None,
    table: options.Table = None,
    pattern: options.Pattern = None,
    scene: options.CommonScene = None,
    channel: options.Channels = None,
    scale: options.Scales = None,
    rate: options.Rate = None,
    segment: options.Segment = None,
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
    seed: options.Seed = 0,
    json: options.Json = False,
) -> None:
    """Fit many records independently, on the cores of this machine or on a Dask cluster.

    Writes results.parquet, failures.csv and index.html into DIR. After an interruption, run the same command again:
    finished records are kept. Exit status 0 means that every record has a result or a reason for its failure.
    """
    study = options.load_study(records, table, pattern)
    announce("fitting", records or () if study is None else study.records)
    loaded = options.load_scene(scene)
    fits = fitact.run_campaign(
        study or records or (), out, loaded, **options.column_options((channel, scale, rate, segment)),
        scheduler=scheduler, workers=workers, memory=memory, posteriors=posteriors,
        reports=reports, seed=seed,
    )  # fmt: skip
    page = report.write_campaign(out, fits, report.Provenance.from_inputs(command_line(), loaded))
    counts = {"records": len(fits), "answers": len(fits.results), "failures": len(fits.failures)}
    show(f"{fits}\nopen {page}", counts | {"page": str(page)}, json)


@app.command()
def tradeoff(
    record: Annotated[
        Path | None,
        typer.Argument(metavar="[RECORD]", help="Record with V and Vsc.", show_default="simulated"),
    ] = None,
    scene: options.CommonScene = None,
    channel: options.Channels = None,
    scale: options.Scales = None,
    rate: options.Rate = None,
    segment: options.Segment = None,
    out: options.Out = None,
    json: options.Json = False,
) -> None:
    """Benchmark the error and run time of each response, likelihood and posterior method on this machine.

    Takes one or two minutes. With --out, writes report.html, tradeoff.json and tradeoff.svg into DIR.
    """
    announce("measuring", [record or scene or "the nominal scene"])
    loaded = options.load_scene(scene)
    measured = (
        None
        if record is None
        else fitact.read(record, loaded, **options.column_options((channel, scale, rate, segment)))
    )
    costs = fitact.measure_tradeoff(measured, loaded)
    if out is not None:
        report.write_folder(out, costs, command_line(), loaded, [measured] if measured else [])
    show(str(costs), costs.to_dict(), json, costs.trusted)
