"""Command lines that answer at once: they run in a process that has the slow imports done (`fitact.cli.warm`)."""

import asyncio
import contextlib
import json
import sys
from pathlib import Path
from typing import Any, NamedTuple

_LONGEST_ANSWER = 2**26  # bytes of one line; an inspection has some kilobytes


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
    """Process that runs commands one after the other; it starts on first use, and anew after it has died."""

    def __init__(self) -> None:
        self._lock = asyncio.Lock()
        self._process: asyncio.subprocess.Process | None = None
        self._greeting: dict[str, Any] = {}

    async def describe_scenes(self) -> dict[str, Any]:
        """Return `fields`, the keys of a scene (`describe_fields`), and `scenes`, the names of shipped scenes."""
        async with self._lock:
            await self._start()
            return self._greeting

    async def run(self, folder: Path, *arguments: str) -> CommandResult:
        """Run `fitact ARGUMENTS` in a folder."""
        async with self._lock:
            process = await self._start()
            try:
                return CommandResult(**await _ask(process, {"folder": str(folder), "arguments": arguments}))
            except (ConnectionError, json.JSONDecodeError):  # killed, e.g. for its memory
                self._process = None
                return CommandResult(
                    3, "", f"fitact: the process that read {arguments[1]} has died; try the command line"
                )

    def stop(self) -> None:
        """End the process."""
        if self._process is not None:
            with contextlib.suppress(ProcessLookupError):
                self._process.kill()

    async def _start(self) -> asyncio.subprocess.Process:
        if self._process is None or self._process.returncode is not None:
            pipe = asyncio.subprocess.PIPE
            self._process = await asyncio.create_subprocess_exec(
                sys.executable, "-P", "-m", "fitact.cli.warm", stdin=pipe, stdout=pipe,
                stderr=asyncio.subprocess.DEVNULL, limit=_LONGEST_ANSWER, start_new_session=True,
            )  # fmt: skip
            self._greeting = await _ask(self._process)
        return self._process


async def _ask(process: asyncio.subprocess.Process, question: dict[str, Any] | None = None) -> dict[str, Any]:
    assert process.stdin is not None
    assert process.stdout is not None
    if question is not None:
        process.stdin.write(json.dumps(question).encode() + b"\n")
        await process.stdin.drain()
    return json.loads(await process.stdout.readline())
