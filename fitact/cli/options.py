"""Arguments and options that several commands have, and how they are read."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

import fitact
from fitact.errors import InputError

RecordFiles = Annotated[
    list[Path],
    typer.Argument(
        metavar="RECORD...",
        help="CSV with time_s, V_V, Vsc_V, I_A, or an oscilloscope's file with --channel. Several: fitted jointly.",
    ),
]
SceneFile = Annotated[Path, typer.Argument(metavar="SCENE", help="Scene (TOML).")]
CommonScene = Annotated[
    Path | None, typer.Option("--scene", metavar="FILE", help="Scene (TOML) of all; absent: the paper's device.")
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
Columns = tuple[list[str] | None, list[str] | None]  # --channel and --scale as given
Results = Annotated[Path, typer.Argument(metavar="DIR", help="Folder that `run` or `sample` wrote.")]
Fresh = Annotated[bool, typer.Option("--fresh", help="Start the chain anew instead of going on from one in DIR.")]


class LazyRecords(Sequence["fitact.Record"]):
    """Records of one scene, each read when it is asked for, with what --channel and --scale say of their columns."""

    def __init__(self, paths: Sequence[Path] | None, scene: "fitact.Scene | None", columns: Columns) -> None:
        self._paths, self._scene, self._columns = paths or (), scene, column_options(columns)

    def __len__(self) -> int:
        return len(self._paths)

    def __getitem__(self, index: Any) -> Any:
        return fitact.read(self._paths[index], self._scene, **self._columns)


def load_scene(path: Path | str | None) -> "fitact.Scene | None":
    """The scene that is stated; None: none."""
    return None if path is None else fitact.Scene.load(path)


def column_options(columns: Columns) -> dict[str, Any]:
    """The values of --channel and --scale, as `fitact.read` takes them."""
    channels, scale = columns
    return {"channels": parse_pairs("--channel Vsc=CH2", channels), "scale": parse_numbers("--scale Vsc=10", scale)}


def parse_numbers(example: str, texts: list[str] | None) -> dict[str, float]:
    """Pairs of a name and a number, as the option's `example` has them."""
    given = parse_pairs(example, texts)
    try:
        return {name: float(value) for name, value in given.items()}
    except ValueError as error:
        raise InputError(f"{example.split()[0]}: {error}; write a number, as {example}") from error


def parse_pairs(example: str, texts: list[str] | None) -> dict[str, str]:
    """Pairs of a name and a value, as the option's `example` has them."""
    found = {}
    for name, _, value in (text.partition("=") for text in texts or []):
        if not name or not value:
            raise InputError(f"'{name}{value}' after {example.split()[0]} lacks a side; write {example}")
        found[name.strip()] = value.strip()
    return found
