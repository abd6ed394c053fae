"""Commands on one finger: fit, sample, report."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fitact.cli.app import app
from fitact.cli.options import (
    Channels,
    Columns,
    Fresh,
    Json,
    Level,
    Model,
    Out,
    RecordFiles,
    Results,
    Scales,
    SceneFiles,
    Seed,
    Tolerance,
    mapping,
)
from fitact.cli.terminal import finish, say, show, typed, use_compilation_cache
from fitact.files import write_json

if TYPE_CHECKING:
    from fitact.model_selection.fit_planned import PlannedFit
    from fitact.sampling.posterior import Posterior


@app.command()
def run(
    records: RecordFiles,
    scene: SceneFiles = None,
    channel: Channels = None,
    scale: Scales = None,
    out: Out = None,
    level: Level = "emcee",
    model: Model = "planned",
    seed: Seed = 0,
    tolerance: Tolerance = 1e-3,
    fresh: Fresh = False,
    json: Json = False,
) -> None:
    """Fit, sample and report: everything, into one folder.

    Writes fit.json, summary.json, posterior.nc (opens with ArviZ), chain.h5 (for going on) and report.html.
    """
    folder = out or _folder(records[0])
    posterior, content = _sampled(records, scene, (channel, scale), folder, level, model, seed, tolerance, fresh)
    page = folder / "report.html"
    say("writing the report")
    from fitact.report import write_report

    write_report(page, posterior.to_datatree(), content)
    show(f"{posterior}\nopen {page}", content, json)
    finish(posterior.trusted)


@app.command()
def fit(
    records: RecordFiles,
    scene: SceneFiles = None,
    channel: Channels = None,
    scale: Scales = None,
    out: Out = None,
    model: Model = "planned",
    tolerance: Tolerance = 1e-3,
    starts: Annotated[
        int, typer.Option("--starts", min=1, help="Starts: the record's own, and draws of the prior.")
    ] = 1,
    intervals: Annotated[
        bool, typer.Option("--intervals", help="Add 95 % profile-likelihood intervals, with and without the prior.")
    ] = False,
    json: Json = False,
) -> None:
    """Least squares only: parameters with errors, and the verdict, in seconds; of an impedance spectrum, too."""
    from fitact.data.spectrum import is_spectrum

    if len(records) == 1 and is_spectrum(records[0]):
        _fit_spectrum(records[0], scene, out, json)
        return
    planned = _fitted(records, scene, (channel, scale), model, tolerance, starts)
    fitted = planned.fit
    text, content = f"{fitted}\n{planned.sentence}", fitted.to_dict() | {"plan": planned.to_dict()}
    if intervals:
        from fitact.fitting.profile import table

        both = fitted.intervals(), fitted.intervals(prior=False)
        text = f"{text}\n{table(*both)}"
        content["intervals"] = {
            name: {"with_prior": of.to_dict(), "without_prior": both[1][name].to_dict()} for name, of in both[0].items()
        }
    if out is not None:
        write_json(out / "fit.json", content)
    show(text, content, json)
    finish(fitted.trusted)


def _fit_spectrum(path: Path, scenes: list[Path] | None, out: Path | None, json: bool) -> None:
    from fitact.data.spectrum import read_spectrum
    from fitact.scene.scene import Scene

    stated = Scene.load(scenes[0]) if scenes else None
    spectrum = read_spectrum(path)
    use_compilation_cache()
    from fitact.fitting.fit_spectrum import fit_spectrum

    fitted = fit_spectrum(spectrum, stated)
    if out is not None:
        write_json(out / "fit.json", fitted.to_dict())
    show(str(fitted), fitted.to_dict(), json)
    finish(fitted.trusted)


@app.command()
def sample(
    records: RecordFiles,
    scene: SceneFiles = None,
    channel: Channels = None,
    scale: Scales = None,
    out: Out = None,
    level: Level = "emcee",
    model: Model = "planned",
    seed: Seed = 0,
    tolerance: Tolerance = 1e-3,
    fresh: Fresh = False,
    json: Json = False,
) -> None:
    """Fit, then sample the posterior until it has converged; as `run`, without the report."""
    folder = out or _folder(records[0])
    posterior, content = _sampled(records, scene, (channel, scale), folder, level, model, seed, tolerance, fresh)
    show(f"{posterior}\nwrote {folder}; for a report: fitact report {folder}", content, json)
    finish(posterior.trusted)


@app.command()
def summary(directory: Results, json: Json = False) -> None:
    """Print the table of a folder of results again."""
    from fitact.summary import load, table, trusted

    content = load(directory)
    show(table(content), content, json)
    finish(trusted(content))


@app.command()
def report(directory: Results, json: Json = False) -> None:
    """Write the report of a folder of results again; of a population's, too."""
    page = directory / "report.html"
    if (directory / "population.json").exists():
        from fitact.report.population_page import read_population, write_population_page

        tree, content = read_population(directory)
        write_population_page(page, tree, content)
        trusted = bool(content["trusted"])
    else:
        from fitact.report import read_results, write_report
        from fitact.summary import trusted as is_trusted

        tree, content = read_results(directory)
        write_report(page, tree, content)
        trusted = is_trusted(content)
    show(f"open {page}", {"report": str(page), "trusted": trusted}, json)
    finish(trusted)


def _folder(record: Path) -> Path:
    return Path(f"{record.name.removesuffix('.gz').removesuffix('.csv')}-fitact")


def _fitted(
    records: list[Path],
    scenes: list[Path] | None,
    columns: Columns,
    model: Model,
    tolerance: float,
    starts: int = 1,
) -> "PlannedFit":
    from fitact.data.readers.read import read
    from fitact.scene.scene import Scene

    stated = [Scene.load(path) for path in scenes or []]
    for scene in stated:
        scene.require_available(fit=model == "full")
    of_each = stated if len(stated) == len(records) else [stated[0] if stated else None] * len(records)
    asked = mapping(columns)
    measured = [read(*pair, **asked) for pair in zip(records, of_each, strict=True)]  # refused before the slow imports
    use_compilation_cache()
    from fitact.model_selection.fit_planned import fit_planned

    for path, record in zip(records, measured, strict=True):
        say(f"fitting {path} ({len(record):,} samples)")
    return fit_planned(measured, stated, model, starts=starts, tolerance=tolerance)


def _sampled(
    records: list[Path],
    scene: list[Path] | None,
    columns: Columns,
    folder: Path,
    level: Level,
    model: Model,
    seed: int,
    tolerance: float,
    fresh: bool,
) -> "tuple[Posterior, dict[str, Any]]":
    """Fit and sample, and write all but the report, once the chain is known to belong there."""
    planned = _fitted(records, scene, columns, model, tolerance)
    say(planned.sentence)
    from fitact.sampling.ensemble import sample

    chain = folder / "chain.h5"
    if fresh:
        chain.unlink(missing_ok=True)
    posterior = sample(planned.fit, level=level, seed=seed, chain_file=chain)
    write_json(folder / "fit.json", planned.fit.to_dict() | {"plan": planned.to_dict()})
    posterior.to_netcdf(folder / "posterior.nc")
    content = posterior.summary() | {"plan": planned.to_dict(), "command": typed()}
    write_json(folder / "summary.json", content)
    return posterior, content
