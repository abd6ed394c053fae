"""Arguments and options that several commands share, and the functions that parse them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

import fitact
from fitact.errors import InputError
from fitact.files import require_folder
from fitact.units import parse_quantity

RecordFiles = Annotated[
    list[Path],
    typer.Argument(
        metavar="RECORD...",
        help="CSV with columns time_s, V_V, Vsc_V, I_A, or an oscilloscope file (assign its columns with --channel).",
    ),
]
Table = Annotated[
    Path | None,
    typer.Option(
        "--table",
        metavar="FILE",
        help="CSV in place of RECORD: a column 'record' with paths, columns of any of person, finger, session and"
        " repetition, and a column for each covariate.",
    ),
]
Pattern = Annotated[
    str | None,
    typer.Option(
        "--pattern",
        metavar="TEXT",
        help="Where the names of the records state who was measured, e.g. P{person}_r{repetition}.csv.",
    ),
]
_PAPER = "nominal device of the reference paper"
SceneFile = Annotated[Path, typer.Argument(metavar="SCENE", help="Scene file (TOML), or the name of a shipped scene.")]
CommonScene = Annotated[
    Path | None,
    typer.Option("--scene", metavar="FILE", help="Scene file (TOML).", show_default=_PAPER),
]
Channels = Annotated[
    list[str] | None,
    typer.Option(
        "--channel",
        metavar="NAME=COLUMN",
        help="Column that holds V, Vsc, I or Ft, e.g. Vsc=CH2; in a second file, V=OTHERFILE:CH1. May be repeated.",
    ),
]
Scales = Annotated[
    list[str] | None,
    typer.Option(
        "--scale",
        metavar="NAME=FACTOR",
        help="Factor for V, Vsc, I or Ft, e.g. Vsc=10 for a 10x probe. May be repeated.",
    ),
]
Rate = Annotated[
    str | None,
    typer.Option("--rate", metavar="RATE", help="Sampling rate, e.g. 48kHz, for times that were rounded when written."),
]
Segment = Annotated[
    str | None,
    typer.Option(
        "--segment",
        metavar="N",
        help="Number, from 1, of a run, step, frame or sheet in a file that holds several; of spectra also all.",
    ),
]
Shunt = Annotated[
    str | None,
    typer.Option(
        "--shunt", metavar="R", help="Resistor, e.g. 1kohm, over which a gain was recorded: gives an impedance."
    ),
]
Band = Annotated[
    str | None, typer.Option("--band", metavar="LOW..HIGH", help="Frequencies of a spectrum to use, e.g. 10Hz..100kHz.")
]
SceneFiles = Annotated[
    list[Path] | None,
    typer.Option(
        "--scene",
        metavar="FILE",
        help="Scene file (TOML). Give one for all records, or one for each.",
        show_default=_PAPER,
    ),
]
Out = Annotated[
    Path | None,
    typer.Option(
        "--out",
        metavar="DIR",
        help="Folder for the results.",
        show_default="write no files",
        callback=require_folder,
    ),
]
RecordOut = Annotated[
    Path | None,
    typer.Option(
        "--out", metavar="DIR", help="Folder for the results.", show_default="RECORD-fitact", callback=require_folder
    ),
]
Seed = Annotated[
    int,
    typer.Option("--seed", min=0, max=2**63 - 1, help="Random seed; equal seeds give equal draws."),
]
Verbose = Annotated[
    bool, typer.Option("--verbose", help="Print all quantities, what they rest on, diagnostics, notes and advice.")
]
Json = Annotated[bool, typer.Option("--json", help="Print only the result, as JSON, on standard output.")]
Tolerance = Annotated[
    float,
    typer.Option(
        "--tolerance",
        min=0.0,
        help="Largest error of the log-likelihood that compressing the record may cause; 0 turns compression off.",
    ),
]
Level = Annotated[
    Literal["emcee", "psis", "laplace"],
    typer.Option(
        "--level",
        help="Posterior method: emcee (MCMC run to convergence), psis (Pareto-smoothed importance sampling) or laplace"
        " (Gaussian approximation; fastest). Each reports its own diagnostics.",
    ),
]
Model = Annotated[
    Literal["planned", "full"],
    typer.Option(
        "--model",
        help="planned: drop the elements whose effect on the force is below the tolerance of the scene (see `fitact"
        " plan`); full: keep every element of the scene.",
    ),
]
Columns = tuple[list[str] | None, list[str] | None, str | None, str | None]  # --channel, --scale, --rate, --segment
SpectrumChoice = tuple[str | None, str | None, str | None]  # --segment, --shunt and --band as given
Results = Annotated[Path, typer.Argument(metavar="DIR", help="Folder with the results.")]
Fresh = Annotated[bool, typer.Option("--fresh", help="Start a new chain instead of resuming the one in DIR.")]


def load_study(records: Sequence[Path] | None, table: Path | None, pattern: str | None) -> "fitact.Study | None":
    """Read the table of --table, or names by --pattern; return None if neither is given.

    Raises:
        InputError: records are missing or given twice, or the table or the names are refused.
    """
    if table is None and not records:
        raise InputError("no records are given; name files (RECORD...), or a table of them with --table FILE")
    if table is not None and (records or pattern is not None):
        extra = f"also given: {records[0]}" if records else f"also given: --pattern {pattern}"
        raise InputError(f"--table {table}: names and labels all records ({extra}); give one of the two")
    if table is not None:
        return fitact.Study.from_table(table)
    return None if pattern is None else fitact.Study.from_pattern(pattern, records or ())


def load_scene(path: Path | str | None) -> "fitact.Scene | None":
    """Load the scene of --scene; return None if the option is absent."""
    return None if path is None else fitact.Scene.load(path)


def column_options(columns: Columns) -> dict[str, Any]:
    """Return the values of --channel, --scale, --rate and --segment as keyword arguments of `fitact.read`."""
    channels, scale, rate, segment = columns
    return {
        "channels": parse_pairs("--channel Vsc=CH2", channels),
        "scale": parse_numbers("--scale Vsc=10", scale),
        "rate": None if rate is None else parse_option("--rate", rate, "Hz"),
        "segment": None if segment == "all" else _parse_segment(segment),
    }


def _parse_segment(text: str | None) -> int | None:
    if text is not None and not (text.isdecimal() and int(text)):
        raise InputError(f"--segment {text}: write a number from 1, or all (of spectra)")
    return None if text is None else int(text)


def parse_option(name: str, text: str, unit: str) -> float:
    """Parse the quantity of an option."""
    try:
        return parse_quantity(text, unit)
    except InputError as error:
        raise InputError(f"{name}: {error}") from error


def read_spectra(path: Path, choice: SpectrumChoice) -> list["fitact.Spectrum"]:
    """Read the spectra of a file that --segment chooses, with --shunt and --band; all of them for "all"."""
    number, resistor, band = choice
    shunt = None if resistor is None else parse_option("--shunt", resistor, "ohm")
    if number == "all":
        spectra = list(fitact.read_spectra(path, shunt))
    else:
        spectra = [fitact.read_spectrum(path, _parse_segment(number), shunt)]
    if band is None:
        return spectra
    ends = [parse_option("--band", end, "Hz") for end in band.split("..")]
    if len(ends) != 2 or not ends[0] < ends[1]:
        raise InputError(f"--band {band}: write two frequencies, the lower first, e.g. 10Hz..100kHz")
    return [spectrum.select_band(*ends) for spectrum in spectra]


def parse_numbers(example: str, texts: list[str] | None) -> dict[str, float]:
    """Parse NAME=NUMBER texts; an error message quotes `example`, which begins with the option."""
    given = parse_pairs(example, texts)
    try:
        return {name: float(value) for name, value in given.items()}
    except ValueError as error:
        raise InputError(f"{example.split()[0]}: {error}; write a number, e.g. {example}") from error


def parse_pairs(example: str, texts: list[str] | None) -> dict[str, str]:
    """Parse NAME=VALUE texts; an error message quotes `example`, which begins with the option."""
    pairs = {}
    for text in texts or []:
        name, _, value = text.partition("=")
        if not name or not value:
            raise InputError(f"{example.split()[0]} {text}: write NAME=VALUE, e.g. {example}")
        pairs[name.strip()] = value.strip()
    return pairs
