"""Processes for commands, one of which waits with its slow imports done (`fitact.cli.warm`)."""

import asyncio
import json
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple


class CommandResult(NamedTuple):
    """Exit status and output of a command."""

    code: int
    out: str
    error: str

    @property
    def sentence(self) -> str:
        """Last line of the messages, as the command line prints it, without the program's name."""
        return (self.error.strip().splitlines() or [""])[-1].removeprefix("fitact: ")


class WarmCommands:
    """Process that runs quick commands one after the other, and at last one whose results take long.

    Another process takes its place when it is needed, also after it has died.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._scenes: dict[str, Any] = {}

    def prepare(self) -> None:
        """Start the process if there is none."""
        if self._lock.acquire(blocking=False):
            self._find_process()
            self._lock.release()

    async def describe_scenes(self) -> dict[str, Any]:
        """Return `fields`, the keys of a scene (`describe_fields`), and `scenes`, the names of shipped scenes."""
        if not self._scenes:
            self._scenes = await asyncio.to_thread(self._ask, {})
        return self._scenes

    async def run(self, folder: Path, *arguments: str) -> CommandResult:
        """Run `fitact ARGUMENTS` in a folder."""
        try:
            question = {"folder": str(folder), "arguments": arguments}
            return CommandResult(**await asyncio.to_thread(self._ask, question))
        except (ConnectionError, json.JSONDecodeError):  # killed, e.g. for its memory
            sentence = f"fitact: the process that read {arguments[1]} has died; try the command line"
            return CommandResult(3, "", sentence)

    def start(self, folder: Path, arguments: Sequence[str]) -> subprocess.Popen[bytes]:
        """Start `fitact ARGUMENTS` in a process of its own, which ends with it; closing its input interrupts it.

        Its output goes to `output.txt` and `messages.txt` in the folder.
        """
        if self._lock.acquire(blocking=False):
            process, self._process = self._find_process(), None
            self._lock.release()
        else:  # it is busy
            process = _start_process()
        _send(process, {"folder": str(folder), "arguments": arguments, "last": True})
        return process

    def stop(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()

    def _ask(self, question: dict[str, Any]) -> Any:
        with self._lock:
            process = self._find_process()
            _send(process, question)
            assert process.stdout is not None
            return json.loads(process.stdout.readline())

    def _find_process(self) -> subprocess.Popen[bytes]:
        if self._process is None or self._process.poll() is not None:
            self._process = _start_process()
        return self._process


def _start_process() -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "fitact.cli.warm"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip


def _send(process: subprocess.Popen[bytes], question: dict[str, Any]) -> None:
    assert process.stdin is not None
    process.stdin.write(json.dumps(question).encode() + b"\n")
    process.stdin.flush()
