"""The documentation: its code and commands run, its scenes load, and it covers all public names."""

import glob
import gzip
import json
import re
import shlex
import shutil
import sys
import tomllib
from pathlib import Path
from typing import NamedTuple

import jax
import pytest
import typer
from markdown_it import MarkdownIt

import fitact
import fitact.cli

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
PROGRAMS = ("fitact", "make", "python", "pytest")
# pages whose Python samples a posterior, fits often or compiles much
SLOW = ("README.md", "theory.md", "plan.md", "compare.md", "many.md")


class Block(NamedTuple):
    """Fenced block: its language, its file (`title="scene.toml"`), its text, and its lines in the page."""

    language: str
    title: str | None
    text: str
    begin: int
    end: int


def blocks(page: Path, *languages: str) -> list[Block]:
    found = []
    for token in MarkdownIt().parse(page.read_text(encoding="utf-8")):
        if token.type in ("fence", "code_block"):
            language, _, options = token.info.partition(" ")
            title = re.search(r'title="(.*?)"', options)
            found.append(Block(language, title and title[1], token.content, *token.map))
    return [block for block in found if block.language in languages] if languages else found


def commands(text: str) -> list[list[str]]:
    """Return the words of each command, without comments."""
    lines = (shlex.split(line, comments=True) for line in text.splitlines())
    return [[Path(words[0]).name, *words[1:]] for words in lines if words]


def mentioned(page: Path) -> list[list[str]]:
    """Return the commands of the page's shell blocks and of its text."""
    spans = [
        child.content
        for token in MarkdownIt().enable("table").parse(page.read_text(encoding="utf-8"))
        for child in token.children or []
        if child.type == "code_inline" and child.content.startswith(tuple(f"{name} " for name in PROGRAMS))
    ]
    texts = [block.text for block in blocks(page, "sh")] + spans
    return [command for text in texts for command in commands(text)]


def by_name(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.mark.parametrize("page", PAGES, ids=by_name)
def test_blocks_say_what_they_are_and_can_be_read(page):
    for block in blocks(page):
        assert block.language in {"python", "sh", "toml", "json", "text"}, block
        if block.language == "toml":
            fitact.Scene.from_dict(tomllib.loads(block.text))
        if block.language == "json":
            json.loads(block.text)


@pytest.mark.parametrize("page", PAGES, ids=by_name)
def test_commands_exist_with_their_options(page):
    for words in mentioned(page):
        check = {"fitact": has_options, "make": has_target}.get(words[0], names_files)
        check(words[1:])


def has_options(arguments: list[str]) -> None:
    """Return whether the command of `fitact` exists and has the options; elided arguments are ignored."""
    command, given = typer.main.get_command(fitact.cli.app), [word.strip("[]") for word in arguments]
    while commands_of := getattr(command, "commands", None):
        if not given or given[0].startswith("--"):
            break
        command = commands_of[given.pop(0)]
    known = {name for parameter in command.params for name in parameter.opts} | {"--help"}
    assert {word for word in given if word.startswith("--")} <= known


def has_target(arguments: list[str]) -> None:
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert set(arguments) <= set(targets)


def names_files(arguments: list[str]) -> None:
    """Return whether the files of tests and benchmarks exist and have the options."""
    files = [ROOT / word for word in arguments if word.endswith(".py")]
    for file in files:
        own = [word for word in arguments if word.startswith("--")]
        assert all(f'"{option}"' in file.read_text() for option in own), (file, own)


@pytest.fixture
def folder(page, tmp_path, monkeypatch):
    """Return a folder with the project's data and with the files that the page names."""
    records = ROOT / "data_synth" / "records"
    (tmp_path / "data_synth").symlink_to(ROOT / "data_synth")
    shown = "finger_bench.csv" if page.name == "README.md" else "finger_direct.csv"
    shutil.copy(records / shown, tmp_path / "finger.csv")
    for number in (0, 1):
        packed = (records / "fingers" / f"finger0{number}.csv.gz").read_bytes()
        (tmp_path / f"finger0{number}.csv").write_bytes(gzip.decompress(packed))
    device = (records / "finger_direct.toml").read_text().replace('waveform = "measured"', "")
    for name in ("scene.toml", "plain.toml"):
        (tmp_path / name).write_text(device)
    felt = '[drive]\nwaveform = "trapezoid"\nrise_time = "50 us"\n[perception]\nthreshold_force = "0.1 mN"\n'
    (tmp_path / "panel.toml").write_text(felt)
    (tmp_path / "gap.toml").write_text(f'{device}[gap]\ncapacitance = "10 nF"\n')
    monkeypatch.chdir(tmp_path)
    precision = jax.config.jax_enable_x64
    yield
    jax.config.update("jax_enable_x64", precision)  # a page may change this setting


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=by_name(page), marks=[pytest.mark.slow] * (page.name in SLOW))
        for page in PAGES
        if blocks(page, "python")
    ],
)
def test_python_runs(page, folder):
    """Run the blocks of a page in order, as a reader would paste them."""
    names: dict[str, object] = {}
    for block in blocks(page, "python", "toml"):
        if block.title:
            Path(block.title).write_text(block.text)
        elif block.language == "python":
            above = "\n" * (block.begin + 1)  # the traceback then shows the line of the page
            exec(compile(above + block.text, page, "exec"), names)


def shell_blocks():
    """Return each block with a command of `fitact` on files, and the output in the block that follows directly."""
    for page in PAGES:
        found = blocks(page)
        for block in found:
            own = [words for words in commands(block.text) if words[0] == "fitact"] if block.language == "sh" else []
            if own and "[" not in block.text and "FILE" not in block.text:  # other blocks list possible arguments
                printed = next((after.text for after in found if after.begin == block.end + 1), None)
                yield pytest.param(
                    page, own, printed, id=f"{by_name(page)}-{' '.join(own[0][:3])}", marks=pytest.mark.slow
                )


@pytest.mark.parametrize(("page", "lines", "printed"), list(shell_blocks()))
def test_commands_run(page, lines, printed, folder, monkeypatch, capsys):
    for block in blocks(page, "toml"):
        if block.title:
            Path(block.title).write_text(block.text)
    for _, *arguments in lines:
        expanded = [name for word in arguments for name in (sorted(glob.glob(word)) or [word])]
        monkeypatch.setattr(sys, "argv", ["fitact", *expanded])
        with pytest.raises(SystemExit) as end:
            fitact.cli.main()
        assert end.value.code == 0, arguments
    if printed:
        assert figures(capsys.readouterr().out) == figures(printed)


def figures(text: str) -> list[str]:
    """Return the figures of each line, except for the row of float64, whose rounding depends on the machine."""
    return [line for line in text.rstrip().splitlines() if not line.startswith("float64 ")]


def test_every_public_name_has_its_place_in_the_reference():
    listed = [
        name
        for page in (ROOT / "docs" / "api").glob("*.md")
        for name in re.findall(r"^::: fitact\.(\w+)$", page.read_text(), re.MULTILINE)
    ]
    assert sorted(listed) == sorted(fitact.__all__)
