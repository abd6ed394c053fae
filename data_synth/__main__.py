"""Command line: `python -m data_synth` makes records from scenes and recipes."""

import argparse
import os
import shlex
import sys
from pathlib import Path

RECORDS = Path(__file__).parent / "records"


def main() -> int:
    """Run the command; return 0, or 2 after one line on standard error for invalid input."""
    parser = argparse.ArgumentParser(prog="python -m data_synth", description="Synthetic records, by scipy or ngspice.")
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("make", help="make the records of recipes, or of plain scenes")
    one.add_argument("recipe", nargs="+", type=Path, help="TOML; data_synth/README.md lists the keys of recipes")
    one.add_argument("--seed", type=int, help="replaces the recipe's")
    one.add_argument("--route", choices=["scipy", "ngspice"], help="replaces the recipe's")
    one.add_argument("--format", default="csv.gz", choices=["csv.gz", "csv", "npz", "mat", "h5"])
    committed = commands.add_parser("committed", help="make the records in data_synth/records that have a recipe again")
    for command in (one, committed):
        command.add_argument("--out", type=Path, required=True, help="folder for NAME.csv.gz and NAME.json")
    chosen = parser.parse_args()

    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # small matrices: threads would only wait
    from data_synth.errors import RecipeError  # imported late, because what follows takes a second

    try:
        if chosen.command == "committed":
            for path in sorted(RECORDS.glob("*.recipe.toml")):
                if _is_route_available(path):
                    plain = path.with_name(path.name.replace(".recipe.toml", ".csv")).exists()
                    _make(path, chosen.out, "csv" if plain else "csv.gz", None, None)
            return 0
        for path in chosen.recipe:
            _make(path, chosen.out, chosen.format, chosen.seed, chosen.route)
        return 0
    except (RecipeError, OSError) as error:
        print(error, file=sys.stderr)
        return 2


def _is_route_available(path: Path) -> bool:
    """Return whether the recipe's route is installed; print a line if it is not."""
    from data_synth import recipe, spice

    there = recipe.load(path).route != "ngspice" or spice.is_installed()
    if not there:
        print(f"{path.name}: skipped, because ngspice is not installed", file=sys.stderr)
    return there


def _make(path: Path, out: Path, end: str, seed: int | None, route: str | None) -> None:
    from data_synth import files, recipe
    from data_synth.make import list_truth, make

    found = recipe.load(path)
    found = found._replace(seed=found.seed if seed is None else seed, route=route or found.route)
    folder = out / found.name if "population" in found.given else out
    options = f"--seed {found.seed} --route {found.route} --format {end}"
    command = f"python -m data_synth make {shlex.quote(path.name)} {options} --out DIR"
    records = make(found)
    for name, made in records.items():
        files.write_record(folder / f"{name}.{end}", made.time, made.channels)
        truth = {"record": f"{name}.{end}", **made.truth}
        truth["origin"]["command"] = command
        files.write_json(folder / f"{name}.json", truth)
        print(folder / f"{name}.{end}")
    if found.parts["population"]["people"] is not None:
        rows = [{"record": f"{name}.{end}", **made.labels} for name, made in records.items()]
        files.write_table(folder / "study.csv", rows)
        files.write_json(folder / "truth.json", [list_truth(name, made) for name, made in records.items()])


if __name__ == "__main__":
    sys.exit(main())
