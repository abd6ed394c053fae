"""Analyses as folders: the files, their columns, the scene, and the command that makes the results."""

import itertools
import json
import os
import re
import secrets
import shlex
import shutil
import subprocess
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path

from fitact.app.warm_commands import WarmCommands
from fitact.errors import InputError
from fitact.files import write_json

CHANNELS = {"V": "drive voltage", "Vsc": "voltage across the skin", "I": "loop current", "Ft": "friction"}
_OPTIONS = ("rate", "segment", "shunt", "band")
_processes: dict[Path, subprocess.Popen[bytes]] = {}  # that this server started, by the analysis's folder


class Analysis:
    """Folder with the files in `records`, `scene.toml`, `analysis.json`, the command's output, and its `results`.

    Nothing is kept in memory but the process, so that the page, the server and the command line see the same.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.results = folder, folder / "results"
        content = json.loads((folder / "analysis.json").read_text(encoding="utf-8"))
        self.files: dict[str, str] = content["files"]  # name on disk -> the user's name
        self.options: dict[str, str] = content["options"]  # by the name of the form's field
        self.code: int | None = content["code"]  # exit status of the command

    @classmethod
    def create(cls, root: Path) -> "Analysis":
        """Make the folder of a new analysis."""
        folder = root / f"{time.strftime('%Y-%m-%d-%H%M%S')}-{secrets.token_hex(2)}"
        write_json(folder / "analysis.json", {"files": {}, "options": {}, "code": None})
        (folder / "records").mkdir()
        return cls(folder)

    @classmethod
    def find(cls, root: Path, name: str) -> "Analysis":
        """Return an analysis by the name of its folder; raise InputError if there is none."""
        if not re.fullmatch(r"[\w-]+", name) or not (root / name / "analysis.json").is_file():
            raise InputError("there is no such analysis; its folder may have been removed")
        return cls(root / name)

    @classmethod
    def iterate(cls, root: Path) -> "Iterator[Analysis]":
        """Yield all analyses, newest first; folders with anything else are skipped."""
        for folder in sorted(root.iterdir(), reverse=True):
            try:
                yield cls(folder)
            except (OSError, ValueError, KeyError, TypeError):
                continue

    @property
    def name(self) -> str:
        return self.folder.name

    @property
    def state(self) -> str:
        """One of set-up, running, stopping, stopped, finished."""
        process = _processes.get(self.folder)
        if process is not None and process.poll() is None:
            return "stopping" if process.stdin is None or process.stdin.closed else "running"
        if process is not None:
            del _processes[self.folder]
            self.code = process.returncode
            self.save()
        if (self.results / "report.html").exists() and not self._is_preliminary():
            return "finished"
        return "stopped" if self.results.exists() else "set-up"

    def _is_preliminary(self) -> bool:
        """Return whether the results are those of a chain that was interrupted, which the same command resumes."""
        for path in (self.results / "summary.json", self.results / "population.json"):
            if path.exists():
                return bool(json.loads(path.read_text(encoding="utf-8")).get("convergence", {}).get("interrupted"))
        return False

    def save(self) -> None:
        content = {"files": self.files, "options": self.options, "code": self.code}
        write_json(self.folder / "analysis.json", content)

    def require_editable(self) -> None:
        """Raise InputError if the command has begun to write results."""
        if self.state != "set-up":
            raise InputError("this analysis has results or is running; start another one with the same files")

    def add_file(self, temporary: Path, name: str, max_length: int = 80) -> str:
        """Move an uploaded file into the folder under a name of our own, which it returns.

        The name has at most `max_length` characters, which is below the limits of all file systems.
        """
        own = re.sub(r"[^A-Za-z0-9._-]+", "_", re.split(r"[/\\]", name)[-1])[-max_length:].lstrip("._-") or "file"
        taken = {each.casefold() for each in self.files}
        names = itertools.chain([own], (f"{number}_{own}" for number in itertools.count(2)))
        own = next(each for each in names if each.casefold() not in taken)
        os.replace(temporary, self.folder / "records" / own)
        self.files[own] = "".join(character if character.isprintable() else "�" for character in name)[:200]
        self.save()
        return own

    def remove_file(self, own: str) -> None:
        if self.files.pop(own, None) is not None:
            (self.folder / "records" / own).unlink(missing_ok=True)
            self.save()

    def copy(self) -> "Analysis":
        """Make another analysis with the same files, columns and scene."""
        other = Analysis.create(self.folder.parent)
        shutil.copytree(self.folder / "records", other.folder / "records", dirs_exist_ok=True, copy_function=_link)
        if (self.folder / "scene.toml").exists():
            shutil.copy(self.folder / "scene.toml", other.folder)
        other.files, other.options = self.files, self.options
        other.save()
        return other

    def column_options(self) -> list[str]:
        """Return --channel, --scale and the options of times and spectra, as the command line takes them."""
        chosen = []
        for option, field in (("--channel", "column"), ("--scale", "factor")):
            pairs = {channel: self.options.get(f"{field}.{channel}", "").strip() for channel in CHANNELS}
            chosen += [part for channel, value in pairs.items() if value for part in (option, f"{channel}={value}")]
        return chosen + [f"--{name}={self.options[name].strip()}" for name in _OPTIONS if self.options.get(name)]

    def arguments(self) -> list[str]:
        """Return the arguments of `fitact` that make the results, in the folder of the analysis."""
        records = [f"records/{own}" for own in self.files]
        scene = ["--scene", "scene.toml"] if (self.folder / "scene.toml").exists() else []
        command = "run" if len(records) < 2 else "population"
        return [command, *records, *scene, *self.column_options(), "--out", "results"]

    @property
    def command(self) -> str:
        return shlex.join(["fitact", *self.arguments()])

    def start(self, commands: WarmCommands) -> None:
        """Start the command, or resume it: the same one in the same folder."""
        if self.state not in ("set-up", "stopped") or not self.files:
            return
        (self.folder / "command.txt").write_text(f"{self.command}\n", encoding="utf-8")
        (self.folder / "messages.txt").unlink(missing_ok=True)  # of a run before
        _processes[self.folder] = commands.start(self.folder, self.arguments())

    def stop(self) -> None:
        """Interrupt the command as Ctrl-C does, so that it can resume."""
        process = _processes.get(self.folder)
        if process is not None and process.stdin is not None:
            process.stdin.close()

    def read(self, name: str) -> str:
        """Return what the command wrote: messages.txt is its standard error, output.txt its standard output."""
        path = self.folder / name
        return path.read_text(encoding="utf-8", errors="replace") if path.exists() else ""

    def result_files(self) -> list[Path]:
        """Return the files to download: results, scene and command."""
        inputs = [self.folder / name for name in ("scene.toml", "command.txt")]
        results = sorted(self.results.iterdir()) if self.results.exists() else []
        return [path for path in (*results, *inputs) if path.is_file() and not path.name.startswith(".")]

    def write_archive(self, path: Path) -> None:
        """Write everything from which the command can be repeated, and its results, as a zip file."""
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for each in (*self.result_files(), *(self.folder / "records" / own for own in self.files)):
                archive.write(each, Path(self.name) / each.relative_to(self.folder))


def _link(source: str, target: str) -> None:
    try:
        os.link(source, target)
    except OSError:  # a file system without links
        shutil.copy(source, target)
