"""Commands on a scene: what it says, what it believes, what it requires, and records of it."""

from pathlib import Path
from typing import Annotated

import typer

from fitact.cli.app import app
from fitact.cli.options import Channels, Json, Out, Scales, Seed, mapping
from fitact.cli.terminal import show, typed, use_compilation_cache
from fitact.files import write_json


@app.command()
def scene(
    file: Annotated[str, typer.Argument(metavar="[SCENE]", help="Scene (TOML), or the name of a shipped one.")] = "",
    json: Json = False,
) -> None:
    """Print a scene with every key, its unit and, as comments, the defaults; without one: a template to fill in."""
    from fitact.scene.scene import Scene

    stated = Scene.load(file) if file else Scene()
    show(str(stated).rstrip(), stated.model_dump(mode="json"), json)


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
    from fitact.scene.scene import Scene

    stated = Scene.load(scene)
    use_compilation_cache()
    from fitact.scene.prior_predictive import prior_predictive

    predicted = prior_predictive(stated, draws, seed)
    if out is not None:
        from fitact.report.prior import write_prior

        write_prior(out, predicted)
    show(str(predicted), predicted.to_dict(), json)


@app.command()
def plan(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="Scene (TOML).")],
    record: Annotated[
        Path | None,
        typer.Option("--record", metavar="RECORD", help="Plan for this record: for its V where that drives the fit."),
    ] = None,
    channel: Channels = None,
    scale: Scales = None,
    out: Out = None,
    json: Json = False,
) -> None:
    """What a scene requires of its model: what may be left out, what that changes, and what it saves.

    Into DIR it writes report.html, plan.json and plan.svg.
    """
    from fitact.scene.scene import Scene

    stated = Scene.load(scene)
    measured = None
    if record is not None:
        from fitact.data.readers.read import read

        measured = read(record, stated, **mapping((channel, scale)))
    use_compilation_cache()
    if measured is None:
        from fitact.model_selection.plan import plan as planned

        found = planned(stated)
    else:
        from fitact.model_selection.fit_planned import plan_for

        found = plan_for(measured, stated)
    if out is not None:
        from fitact.report.frame import Origin
        from fitact.report.plan import write_plan, write_plan_page

        write_json(out / "plan.json", found.to_dict())
        write_plan(out / "plan.svg", found)
        write_plan_page(out / "report.html", found, Origin.of(typed(), stated, [measured] if measured else []))
    show(str(found), found.to_dict(), json)


@app.command()
def simulate(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="Scene (TOML).")],
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="CSV to write.")],
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Simulate a record of a scene: V and what it measures (Vsc, I), with noise, as CSV."""
    from fitact.data.readers.read import write_csv
    from fitact.data.simulate import simulate as simulated
    from fitact.scene.scene import Scene

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
    show(f"wrote {out}: {len(record):,} samples of {', '.join(record.channels)}", content, json)


@app.command()
def reproduce(out: Out = Path("reproduction"), json: Json = False) -> None:
    """Every equation, figure and number of the paper, computed and judged.

    Into DIR it writes reproduction.json and reproduction.html.
    """
    use_compilation_cache()
    from fitact import paper
    from fitact.report.reproduction import write_reproduction

    claims = paper.reproduce()
    page = write_reproduction(out or Path(), claims)
    lines = [f"{claim.verdict:8} {claim.id:24} {claim.claim}" for claim in claims]
    show("\n".join([*lines, f"open {page}"]), {"claims": [claim.to_dict() for claim in claims]}, json)
