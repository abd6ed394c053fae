"""The keys in docs/contracts.md against those that the commands print: all of them, and no others."""

import contextlib
import io
import json
import re
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import typer

import fitact.cli
from fitact.cli.app import app

ROOT = Path(__file__).parents[2]
RECORDS = ROOT / "data_synth" / "records"
FINGER = (str(RECORDS / "finger_direct.csv"), "--scene", str(RECORDS / "finger_direct.toml"))
TYPES: dict[str, tuple[type, ...]] = {
    "number": (int, float, type(None)),
    "text": (str, type(None)),
    "true/false": (bool,),
    "list": (list,),
    "object": (dict, type(None)),
}
SUMMARY = (
    "unit",
    "mean",
    "sd",
    "q025",
    "q05",
    "q25",
    "q50",
    "q75",
    "q95",
    "q975",
    "contraction",
    "from_prior",
    "u",
    "combined",
)


class Stated(NamedTuple):
    """Key as stated on the page; `always` means that it is always present."""

    pattern: str
    types: str
    always: bool

    def covers(self, path: str, value: Any) -> bool:
        there = re.fullmatch(re.escape(self.pattern).replace(r"\*", r"[^.]+"), path)
        return bool(there) and any(isinstance(value, TYPES[name]) for name in self.types.split(" or "))


def stated(command: str) -> list[Stated]:
    """Return the rows of the section whose heading begins with the command."""
    page = (ROOT / "docs" / "contracts.md").read_text(encoding="utf-8")
    section = next(part for part in page.split("\n## ") if part.startswith(f"`fitact {command} --json`"))
    found = []
    for keys, types, meaning in re.findall(r"^- (`.*?`): ([^;\n]+)(?:; (.*))?$", section, re.MULTILINE):
        for key in re.findall(r"`(.+?)`", keys):
            always = not meaning.startswith("where ")
            if types == "summary":
                found += [Stated(f"{key}.{name}", _part(name), always and name not in SUMMARY[10:]) for name in SUMMARY]
            else:
                found.append(Stated(key, types, always))
    return found


def _part(name: str) -> str:
    return {"unit": "text", "combined": "object"}.get(name, "number")


def leaves(path: str, value: Any, known: list[Stated]):
    """Yield the paths and values of all leaves, where a value that a stated key covers as a whole is one leaf."""
    if isinstance(value, dict) and value and not any(key.covers(path, value) for key in known):
        for name, inner in value.items():
            yield from leaves(f"{path}.{name}" if path else name, inner, known)
    elif (
        isinstance(value, list)
        and value
        and isinstance(value[0], dict)
        and any(f"{path}[]" in k.pattern for k in known)
    ):
        for inner in value:
            yield from leaves(f"{path}[]", inner, known)
    elif value != {}:
        yield path, value


OWN = pytest.mark.slow  # commands that other tests also run
CASES = [
    pytest.param("fit", [*FINGER], id="fit"),
    pytest.param("fit", [*FINGER, "--intervals"], id="fit --intervals", marks=OWN),
    pytest.param("fit", ["z.csv"], id="fit a spectrum"),
    pytest.param("inspect", [FINGER[0]], id="inspect"),
    pytest.param("inspect study.csv", [], id="inspect a table"),
    pytest.param("plan", ["natural-ground"], id="plan"),
    pytest.param("simulate", ["phone", "--out", "phone.csv"], id="simulate"),
    pytest.param("prior", ["paper"], id="prior", marks=OWN),
    pytest.param("reproduce", ["--out", "out"], id="reproduce", marks=OWN),
    pytest.param("run", [*FINGER, "--out", "out", "--level", "laplace", "--seed", "1"], id="run laplace", marks=OWN),
    pytest.param("run", [*FINGER, "--out", "out", "--seed", "1"], id="run", marks=OWN),
    pytest.param("design measurement", ["paper"], id="design measurement", marks=OWN),
    pytest.param("design drive", ["felt.toml"], id="design drive", marks=OWN),
    pytest.param(
        "compare",
        [FINGER[0], "--scene", FINGER[2], "--scene", str(RECORDS / "trapezoid.toml")],
        id="compare",
        marks=OWN,
    ),
    pytest.param(
        "population",
        [*(str(RECORDS / "fingers" / f"finger0{i}.csv.gz") for i in (0, 1)), *FINGER[1:], "--seed", "1"],
        id="population",
        marks=OWN,
    ),
    pytest.param("tradeoff", [*FINGER], id="tradeoff", marks=OWN),
]


@pytest.mark.filterwarnings("error::UserWarning")  # warnings that users would see
@pytest.mark.parametrize(("command", "arguments"), CASES)
def test_keys_are_those_of_the_page(command, arguments, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("felt.toml").write_text('[perception]\nthreshold_force = "0.1 mN"\n')
    Path("study.csv").write_text(f"record,person,age\n{FINGER[0]},P1,23\n{FINGER[2]},P2,31\n")
    frequency = np.geomspace(1.0, 1e5, 30)
    z = 3e5 / (1.0 + 1j * frequency / 50.0) - 1e8j / frequency
    np.savetxt("z.csv", np.column_stack([frequency, z.real, z.imag]), delimiter=",", header="f,Z',Z''", comments="")
    monkeypatch.setattr(sys, "argv", ["fitact", *command.split(), *arguments, "--json"])
    with contextlib.redirect_stdout(io.StringIO()) as printed, pytest.raises(SystemExit) as end:
        fitact.cli.main()
    assert end.value.code == 0
    known, content = stated(command), json.loads(printed.getvalue())
    found = list(leaves("", content, known))
    unknown = [path for path, value in found if not any(key.covers(path, value) for key in known)]
    assert not unknown, "not on the page"
    missing = [key.pattern for key in known if key.always and not any(key.covers(path, value) for path, value in found)]
    assert not missing, "not in the output"


def test_every_command_has_its_place():
    page = (ROOT / "docs" / "contracts.md").read_text(encoding="utf-8")
    printing = {name.split(" --json")[0] for name in re.findall(r"`fitact (.+?)`", page)}
    assert printing >= set(names(typer.main.get_command(app)))


def names(command: Any) -> list[str]:
    """Yield the names of all commands, including those of groups."""
    found = []
    for name, inner in command.commands.items():
        found += [f"{name} {last}" for last in names(inner)] if hasattr(inner, "commands") else [name]
    return found
