"""Commands that analyse one finger: run, fit, sample, summary, report."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import fitact
from fitact import report as reporting
from fitact import what_now
from fitact.cli import internal, options
from fitact.cli.app import app
from fitact.cli.terminal import announce, command_line, print_stderr, show
from fitact.errors import InputError
from fitact.files import write_json

if TYPE_CHECKING:
    from fitact.model_selection.fit_planned import PlannedFit


@app.command()
def run(
    context: typer.Context,
    records: options.RecordFiles,
    scene: options.SceneFiles = None,
    channel: options.Channels = None,
    scale: options.Scales = None,
    rate: options.Rate = None,
    segment: options.Segment = None,
    shunt: options.Shunt = None,
    band: options.Band = None,
    out: options.RecordOut = None,
    level: options.Level = "emcee",
    model: options.Model = "planned",
    seed: options.Seed = 0,
    tolerance: options.Tolerance = 1e-3,
    fresh: options.Fresh = False,
    verbose: options.Verbose = False,
    json: options.Json = False,
) -> None:
    """Fit records and spectra, sample the posterior and write a report, all into one folder.

    Writes fit.json, summary.json, posterior.nc (for ArviZ), chain.h5 (to resume sampling) and report.html into DIR.
    Several records or spectra are fitted jointly.
    """
    announce("reading", records)
    folder = out or Path(f"{records[0].name.removesuffix('.gz').removesuffix('.csv')}-fitact")
    choice = segment, shunt, band
    planned = _fit_records(records, scene, (channel, scale, rate, segment), choice, model, tolerance)
    if planned.omits_elements or verbose:
        print_stderr(planned.sentence)
    chain = folder / "chain.h5"
    if fresh:
        chain.unlink(missing_ok=True)
    # sampling comes before any file is written because it refuses a chain that belongs to another fit
    posterior = fitact.sample(planned.fit, level=level, seed=seed, chain_file=chain)
    write_json(folder / "fit.json", planned.fit.to_dict() | {"plan": planned.to_dict()})
    posterior.to_netcdf(folder / "posterior.nc")
    content = posterior.summary() | {"plan": planned.to_dict(), "command": command_line()}
    write_json(folder / "summary.json", content)
    if context.command.name == "sample":
        end = f"wrote {folder}; for the report: fitact report {folder}"
    else:
        reporting.write_report(folder / "report.html", posterior.to_datatree(), content)
        end = f"open {folder / 'report.html'}"
    text = internal.result_text.describe_summary(content, verbose=verbose)
    show(f"{text}\n{end}{'' if verbose else ' (more here: --verbose)'}", content, json, posterior.trusted)


@app.command()
def fit(
    records: options.RecordFiles,
    scene: options.SceneFiles = None,
    channel: options.Channels = None,
    scale: options.Scales = None,
    rate: options.Rate = None,
    segment: options.Segment = None,
    shunt: options.Shunt = None,
    band: options.Band = None,
    out: options.Out = None,
    model: options.Model = "planned",
    tolerance: options.Tolerance = 1e-3,
    starts: Annotated[
        int,
        typer.Option(
            "--starts",
            min=1,
            help="Number of starting points: one estimated from the data, the others drawn from the prior.",
        ),
    ] = 1,
    intervals: Annotated[
        bool,
        typer.Option("--intervals", help="Add 95 % profile-likelihood intervals, with and without the prior."),
    ] = False,
    verbose: options.Verbose = False,
    json: options.Json = False,
) -> None:
    """Fit records and spectra by least squares; print parameters, standard errors and identifiability.

    With --out, writes fit.json into DIR. Several records or spectra are fitted jointly.
    """
    announce("reading", records)
    choice = segment, shunt, band
    planned = _fit_records(records, scene, (channel, scale, rate, segment), choice, model, tolerance, starts)
    fitted = planned.fit
    text, content = fitted.summary(verbose=verbose), fitted.to_dict() | {"plan": planned.to_dict()}
    text += f"\n{planned.sentence}" if planned.omits_elements or verbose else ""
    text += "" if verbose else "\nbudget, nuisance parameters and notes: --verbose; posterior and report: fitact run"
    if intervals:
        with_prior, without = fitted.intervals(), fitted.intervals(prior=False)
        text = f"{text}\n{internal.table(with_prior, without)}"
        content["intervals"] = {
            name: {"with_prior": interval.to_dict(), "without_prior": without[name].to_dict()}
            for name, interval in with_prior.items()
        }
    if out is not None:
        write_json(out / "fit.json", content)
    show(text, content, json, fitted.trusted)


app.command("sample", help="Fit records and sample the posterior: the same as `run`, without the report.")(run)


@app.command()
def summary(directory: options.Results, verbose: options.Verbose = False, json: options.Json = False) -> None:
    """Print the results that `run` or `sample` wrote into DIR."""
    content = internal.summary.load(directory)
    text = internal.result_text.describe_summary(content, verbose=verbose)
    show(text, content, json, internal.summary.is_trusted(content))


@app.command()
def budget(
    directory: options.Results,
    quantity: Annotated[
        list[str] | None, typer.Option("--quantity", help="Quantity, e.g. force_mean; repeat for more. Default: all.")
    ] = None,
    json: options.Json = False,
) -> None:
    """Print the uncertainty budgets of the results in DIR: what each source of error contributes."""
    content = internal.summary.load(directory)
    names = quantity or list(content["budget"])
    for name in names:
        if name not in content["budget"]:
            raise InputError(f"--quantity {name}: there is no such budget; known: {', '.join(content['budget'])}")
    chosen = {name: content["budget"][name] for name in names}
    show(internal.result_text.budget_text(content, names), chosen, json, internal.summary.is_trusted(content))


@app.command()
def report(directory: options.Results, json: options.Json = False) -> None:
    """Write report.html from the results that `run`, `sample` or `population` wrote into DIR."""
    page = directory / "report.html"
    if (directory / "population.json").exists():
        tree, content = reporting.read_population(directory)
        reporting.write_population_page(page, tree, content)
        trusted = bool(content["trusted"])
    else:
        tree, content = reporting.read_results(directory)
        reporting.write_report(page, tree, content)
        trusted = internal.summary.is_trusted(content)
    show(f"open {page}", {"report": str(page), "trusted": trusted}, json, trusted)


@app.command()
def explain(
    words: Annotated[
        list[str] | None, typer.Argument(metavar="NAME", help="Result name, e.g. misfit or prior-limited.")
    ] = None,
    json: options.Json = False,
) -> None:
    """Explain a result name and what to try first; without a name, list all."""
    name = " ".join(words or [])
    content = {name: what_now.explain(name)} if name else what_now.advice_sections()
    show(content[name] if name else "\n".join(content), content, json)


def _fit_records(
    records: list[Path],
    scenes: list[Path] | None,
    columns: options.Columns,
    choice: options.SpectrumChoice,
    model: options.Model,
    tolerance: float,
    starts: int = 1,
) -> "PlannedFit":
    loaded = [fitact.Scene.load(path) for path in scenes or []]
    for scene in loaded:
        scene.require_available(fit=model == "full")
    paired = loaded if len(loaded) == len(records) else [loaded[0] if loaded else None] * len(records)
    column_kwargs = options.column_options(columns)
    # invalid files are refused before the slow imports
    measured: list[fitact.Record | fitact.Spectrum] = []
    given = []
    for path, stated in zip(records, paired, strict=True):
        found: list[fitact.Record | fitact.Spectrum]
        if internal.is_spectrum(path):
            found, unit = [*options.read_spectra(path, choice)], "points"
        else:
            found, unit = [fitact.read(path, stated, **column_kwargs)], "samples"
        print_stderr(f"fitting {path} ({', '.join(f'{len(each):,} {unit}' for each in found)})")
        measured += found
        given += [stated] * len(found)
    scenes_given = [each for each in given if each is not None] if len(loaded) > 1 else loaded
    return internal.fit_planned(measured, scenes_given, model, starts=starts, tolerance=tolerance)
