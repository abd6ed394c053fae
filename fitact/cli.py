"""The command line: parses, calls, prints. Heavy imports wait until a command needs them."""

import os
import platform
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from fitact.errors import InputError
from fitact.files import to_json, write_json

if TYPE_CHECKING:
    from fitact.inference.planned import PlannedFit
    from fitact.inference.posterior import Posterior

app = typer.Typer(
    name="fitact",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    help="""
Skin and insulator parameters, and the electrostatic force, of an electrovibration display.

Start with a CSV of your oscilloscope whose header reads `time_s,V_V,Vsc_V` (drive and skin voltage):

    fitact run finger.csv

It fits the circuit, samples the posterior and writes a report to open in a browser. Say what you know of
the panel, the finger and the drive in a scene file (TOML) and add `--scene scene.toml`. With any other file of an
oscilloscope start with `fitact inspect FILE`.

Exit code 0: an answer. 1: an answer that must not be trusted (the files say why). 2: input was refused.
""",
)

RecordFiles = Annotated[
    list[Path],
    typer.Argument(
        metavar="RECORD...",
        help="CSV with time_s, V_V, Vsc_V, I_A, or an oscilloscope's file with --channel. Several: fitted jointly.",
    ),
]
Channels = Annotated[
    list[str] | None,
    typer.Option(
        "--channel",
        metavar="NAME=COLUMN",
        help="Which of the file's channels V, Vsc or I is: Vsc=CH2, V=OTHERFILE:CH1.",
    ),
]
Scales = Annotated[
    list[str] | None,
    typer.Option("--scale", metavar="NAME=FACTOR", help="What to multiply V, Vsc or I by, as for a probe: Vsc=10."),
]
SceneFiles = Annotated[
    list[Path] | None,
    typer.Option(
        "--scene", metavar="FILE", help="Scene (TOML); absent: the paper's device. Once for all records, or once each."
    ),
]
Out = Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Folder for the results.")]
Seed = Annotated[int, typer.Option("--seed", min=0, max=2**63 - 1, help="Same seed, same draws.")]
Json = Annotated[
    bool, typer.Option("--json", help="Print the result as JSON on standard output, and nothing else there.")
]
Tolerance = Annotated[
    float,
    typer.Option(
        "--tolerance", min=0.0, help="Error that compressing the record may cause in its log-likelihood; 0: none."
    ),
]
Level = Annotated[
    Literal["emcee", "psis", "laplace"],
    typer.Option(
        "--level",
        help="How uncertainty is found: sampled until converged; by importance weights (certified or refused); or by"
        " the fit's normal approximation (fast; says what it is off by).",
    ),
]
Model = Annotated[
    Literal["planned", "full"],
    typer.Option(
        "--model", help="What the scene's tolerance requires (see `plan`), or everything that the scene names."
    ),
]
Mapping = tuple[list[str] | None, list[str] | None]  # --channel and --scale as given
Results = Annotated[Path, typer.Argument(metavar="DIR", help="Folder that `run` or `sample` wrote.")]
Fresh = Annotated[bool, typer.Option("--fresh", help="Start the chain anew instead of going on from one in DIR.")]


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
    _say("writing the report")
    from fitact.report import write_report

    write_report(page, posterior.to_datatree(), content)
    _show(f"{posterior}\nopen {page}", content, json)
    _finish(posterior.trusted)


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
    """Least squares only: parameters with errors, and the verdict, in seconds."""
    planned = _fitted(records, scene, (channel, scale), model, tolerance, starts)
    fitted = planned.fit
    text, content = f"{fitted}\n{planned.sentence}", fitted.to_dict() | {"plan": planned.to_dict()}
    if intervals:
        from fitact.inference.profile import table

        both = fitted.intervals(), fitted.intervals(prior=False)
        text = f"{text}\n{table(*both)}"
        content["intervals"] = {
            name: {"with_prior": of.to_dict(), "without_prior": both[1][name].to_dict()} for name, of in both[0].items()
        }
    if out is not None:
        write_json(out / "fit.json", content)
    _show(text, content, json)
    _finish(fitted.trusted)


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
    _show(f"{posterior}\nwrote {folder}; for a report: fitact report {folder}", content, json)
    _finish(posterior.trusted)


@app.command()
def summary(directory: Results, json: Json = False) -> None:
    """Print the table of a folder of results again."""
    from fitact.inference.summary import load, table, trusted

    content = load(directory)
    _show(table(content), content, json)
    _finish(trusted(content))


@app.command()
def report(directory: Results, json: Json = False) -> None:
    """Write the report of a folder of results again."""
    from fitact.inference.summary import trusted as is_trusted
    from fitact.report import read_results, write_report

    tree, content = read_results(directory)
    page = directory / "report.html"
    write_report(page, tree, content)
    trusted = is_trusted(content)
    _show(f"open {page}", {"report": str(page), "trusted": trusted}, json)
    _finish(trusted)


@app.command()
def simulate(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="Scene (TOML).")],
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="CSV to write.")],
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Simulate a record of a scene: V and what it measures (Vsc, I), with noise, as CSV."""
    from fitact.data.formats import write_csv
    from fitact.data.simulate import simulate as simulated
    from fitact.model.scene import Scene

    stated = Scene.load(scene)
    record = simulated(stated, seed)
    write_csv(out, record)
    truth = {"Rsc": stated.skin.Rsc, "Csc": stated.skin.Csc, "Ci": stated.device.Ci}
    content = {
        "file": str(out),
        "samples": len(record),
        "channels": list(record.channels),
        "seed": seed,
        "truth": truth,
    }
    _show(f"wrote {out}: {len(record):,} samples of {', '.join(record.channels)}", content, json)


@app.command()
def prior(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="Scene (TOML).")],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Figure to write: .html, .svg or .png.")
    ] = None,
    draws: Annotated[int, typer.Option("--draws", min=100, max=100_000, help="Fingers to draw.")] = 2000,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """What a scene's prior means for Vsc and force, before any data."""
    from fitact.model.scene import Scene

    stated = Scene.load(scene)
    _use_compilation_cache()
    from fitact.inference.prior_predictive import prior_predictive

    predicted = prior_predictive(stated, draws, seed)
    if out is not None:
        from fitact.report.prior import write_prior

        write_prior(out, predicted)
    _show(str(predicted), predicted.to_dict(), json)


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

    Takes a minute or two. With --out writes tradeoff.json and tradeoff.svg.
    """
    from fitact.data.formats import read
    from fitact.model.scene import Scene

    stated = None if scene is None else Scene.load(scene)
    measured = None if record is None else read(record, stated, **_mapping((channel, scale)))
    from fitact.tradeoff import measure_tradeoff

    try:
        found = measure_tradeoff(measured, stated)
    except KeyboardInterrupt:
        _say("fitact: interrupted; nothing was written")
        raise typer.Exit(130) from None
    if out is not None:
        from fitact.report.tradeoff import write_tradeoff

        write_json(out / "tradeoff.json", found.to_dict())
        write_tradeoff(out / "tradeoff.svg", found)
    _show(str(found), found.to_dict(), json)
    _finish(found.trusted)


@app.command()
def compare(
    records: RecordFiles,
    scenes: Annotated[
        list[Path], typer.Option("--scene", metavar="FILE", help="Scene (TOML) of one model; give two or more.")
    ],
    json: Json = False,
) -> None:
    """Fit the model of each scene to the same records, in full, and say which the data prefer."""
    from fitact.data.formats import read
    from fitact.model.scene import Scene

    alike = len({path.stem for path in scenes}) < len(scenes)
    stated = {str(path) if alike else path.stem: Scene.load(path) for path in scenes}
    for each in stated.values():
        each.require_available(fit=True)
    measured = [read(record, next(iter(stated.values()))) for record in records]
    _use_compilation_cache()
    from fitact.inference.comparison import compare as compared

    found = compared(measured, stated)
    _show(str(found), found.to_dict(), json)
    _finish(found.trusted)


@app.command()
def population(
    records: Annotated[list[Path], typer.Argument(metavar="RECORD...", help="One CSV of each finger, on one panel.")],
    scene: Annotated[
        Path | None, typer.Option("--scene", metavar="FILE", help="Scene (TOML) of all; absent: the paper's device.")
    ] = None,
    out: Out = None,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """From one finger to people: how fingers differ, what force the next one will feel, and why.

    Into DIR it writes population.json and population.svg.
    """
    from fitact.data.formats import read
    from fitact.model.scene import Scene

    stated = None if scene is None else Scene.load(scene)
    measured = [read(path, stated) for path in records]
    _use_compilation_cache()
    from fitact.inference.population import population as find_population

    found = find_population(measured, stated, seed=seed)
    if out is not None:
        from fitact.report.population import write_population

        write_json(out / "population.json", found.to_dict())
        write_population(out / "population.svg", found)
    _show(str(found), found.to_dict(), json)
    _finish(found.trusted)


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

    seen = inspected(file, **_mapping((channel, scale)))
    if out is not None:
        from fitact.report.record import write_record

        write_record(out, seen)
    _show(str(seen), seen.to_dict(), json)


@app.command()
def scene(
    file: Annotated[str, typer.Argument(metavar="[SCENE]", help="Scene (TOML), or the name of a shipped one.")] = "",
    json: Json = False,
) -> None:
    """Print a scene with every key, its unit and, as comments, the defaults; without one: a template to fill in."""
    from fitact.model.scene import Scene

    stated = Scene.load(file) if file else Scene()
    _show(str(stated).rstrip(), stated.model_dump(mode="json"), json)


@app.command()
def plan(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="Scene (TOML).")],
    record: Annotated[
        Path | None, typer.Option("--record", help="Plan for this record: for its V where that drives the fit.")
    ] = None,
    out: Out = None,
    json: Json = False,
) -> None:
    """What a scene requires of its model: what may be left out, what that changes, and what it saves.

    Into DIR it writes plan.json and plan.svg.
    """
    from fitact.model.scene import Scene

    stated = Scene.load(scene)
    measured = None
    if record is not None:
        from fitact.data.formats import read

        measured = read(record, stated)
    _use_compilation_cache()
    if measured is None:
        from fitact.model.plan import plan as planned

        found = planned(stated)
    else:
        from fitact.inference.planned import plan_for

        found = plan_for(measured, stated)
    if out is not None:
        from fitact.report.plan import write_plan

        write_json(out / "plan.json", found.to_dict())
        write_plan(out / "plan.svg", found)
    _show(str(found), found.to_dict(), json)


def _folder(record: Path) -> Path:
    return Path(f"{record.name.removesuffix('.gz').removesuffix('.csv')}-fitact")


def _mapping(given: Mapping) -> dict[str, Any]:
    """What --channel and --scale say, as `fitact.read` takes it."""
    pairs: list[dict[str, str]] = []
    for option, texts in zip(("--channel Vsc=CH2", "--scale Vsc=10"), given, strict=True):
        parts = [text.partition("=") for text in texts or []]
        for name, _, value in parts:
            if not name or not value:
                raise InputError(f"'{name}{value}' after {option.split()[0]} lacks a side; write {option}")
        pairs.append({name.strip(): value.strip() for name, _, value in parts})
    try:
        factors = {name: float(value) for name, value in pairs[1].items()}
    except ValueError as error:
        raise InputError(f"--scale: {error}; write a number, as --scale Vsc=10") from error
    return {"channels": pairs[0], "scale": factors}


def _fitted(
    records: list[Path],
    scenes: list[Path] | None,
    mapping: Mapping,
    model: Model,
    tolerance: float,
    starts: int = 1,
) -> "PlannedFit":
    from fitact.data.formats import read
    from fitact.model.scene import Scene

    stated = [Scene.load(path) for path in scenes or []]
    for scene in stated:
        scene.require_available(fit=model == "full")
    of_each = stated if len(stated) == len(records) else [stated[0] if stated else None] * len(records)
    asked = _mapping(mapping)
    measured = [read(*pair, **asked) for pair in zip(records, of_each, strict=True)]  # refused before the slow imports
    _use_compilation_cache()
    from fitact.inference.planned import fit_planned

    for path, record in zip(records, measured, strict=True):
        _say(f"fitting {path} ({len(record):,} samples)")
    return fit_planned(measured, stated, model, starts=starts, tolerance=tolerance)


def _sampled(
    records: list[Path],
    scene: list[Path] | None,
    mapping: Mapping,
    folder: Path,
    level: Level,
    model: Model,
    seed: int,
    tolerance: float,
    fresh: bool,
) -> "tuple[Posterior, dict[str, Any]]":
    """Fit and sample, and write all but the report, once the chain is known to belong there."""
    planned = _fitted(records, scene, mapping, model, tolerance)
    _say(planned.sentence)
    from fitact.inference.sampling import sample

    chain = folder / "chain.h5"
    if fresh:
        chain.unlink(missing_ok=True)
    posterior = sample(planned.fit, level=level, seed=seed, chain_file=chain)
    write_json(folder / "fit.json", planned.fit.to_dict() | {"plan": planned.to_dict()})
    posterior.to_netcdf(folder / "posterior.nc")
    content = posterior.summary() | {"plan": planned.to_dict()}
    write_json(folder / "summary.json", content)
    return posterior, content


def _use_compilation_cache() -> None:
    """Keep what JAX compiles between calls, in the user's cache; a place that cannot be written is passed over."""
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    import jax

    try:
        root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        folder = root / "fitact" / f"jax-{jax.__version__}-{platform.node()}"
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # no home, or one that cannot be written
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)  # the many small ones take a second


def _show(text: str, content: dict[str, Any], as_json: bool) -> None:
    sys.stdout.write(to_json(content) if as_json else text + "\n")
    sys.stdout.flush()


def _say(text: str) -> None:
    print(text, file=sys.stderr)


def _finish(trusted: bool) -> None:
    if not trusted:
        _say("fitact: this answer must not be trusted; see the warnings")
        raise typer.Exit(1)


def main() -> None:
    """Entry point: every error becomes one line and an exit code."""
    raise SystemExit(_guarded(lambda: app(standalone_mode=False)))


def _guarded(command: Callable[[], Any]) -> int:
    try:
        result = command()
        return result if isinstance(result, int) else 0
    except InputError as error:
        _say(f"fitact: {error}")
        return 2
    except typer.exceptions.TyperException as error:  # a wrong option or argument; it knows how to show itself
        error.show()  # type: ignore[attr-defined]
        return 2
    except (KeyboardInterrupt, typer.Abort):
        _say("fitact: interrupted; the same command goes on from the last checkpoint")
        return 130
    except BrokenPipeError:
        return 0
    except Exception as error:
        if os.environ.get("FITACT_DEBUG"):
            raise
        _say(f"fitact: internal error ({type(error).__name__}: {error}); please report it, with FITACT_DEBUG=1 set")
        return 3
