"""`python -m fitact.cli.warm`: a process for the commands of a page, which does its slow imports while it waits.

It answers each line on standard input, `{"folder": ..., "arguments": [...]}`, with a line
`{"code": ..., "out": ..., "error": ...}`, and `{}` with the keys of scenes and the names of shipped scenes.

With `"last": true` the output goes to `output.txt` and `messages.txt` in the folder, and the process ends with the exit
status of the command. The end of standard input interrupts this command as Ctrl-C does. Thus the process that holds the
other end of the pipe interrupts the command, on every system, and so does its death.
"""

import contextlib
import importlib
import io
import json
import os
import queue
import signal
import sys
import threading
from typing import Any

from fitact.cli import end_process, run_command
from fitact.cli.app import app
from fitact.scene.fields import describe_fields
from fitact.scene.toml import shipped_scenes

# in the order in which a page needs them: pictures, `fitact run`, `fitact population`
_SLOW_IMPORTS = (
    "fitact.report.record", "scipy.signal", "optimistix", "fitact.fitting.fit",
    "fitact.model_selection.fit_planned", "xarray", "fitact.sampling.ensemble", "fitact.report.page", "h5netcdf",
    "fitact.populations.fit_population",
)  # fmt: skip
_questions: queue.SimpleQueue[bytes] = queue.SimpleQueue()
_can_interrupt = threading.Event()  # the last command runs


def main() -> None:
    """Answer questions until the last command, or the end of standard input."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # also where the parent process ignores it
    threading.Thread(target=_read_questions, daemon=True).start()
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # whatever else prints does not disturb the answers
    while line := _next_question():
        question = json.loads(line)
        if question.pop("last", False):
            end_process(_run_last(**question))
        answer = _answer(**question) if question else {"fields": describe_fields(), "scenes": sorted(shipped_scenes())}
        print(json.dumps(answer), file=answers, flush=True)


def _read_questions() -> None:
    with open(0, "rb", buffering=0, closefd=False) as lines:  # a buffer's lock would abort Python at its exit
        for line in lines:
            _questions.put(line)
    _questions.put(b"")
    _can_interrupt.wait()
    if os.name == "posix":
        os.kill(os.getpid(), signal.SIGINT)  # to the process, so that a blocked main thread wakes up
    else:
        signal.raise_signal(signal.SIGINT)


def _next_question() -> bytes:
    for module in _SLOW_IMPORTS:
        if not _questions.empty():
            break
        importlib.import_module(module)
    return _questions.get()


def _answer(folder: str, arguments: list[str]) -> dict[str, Any]:
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as error:
        code = _run(folder, arguments)
    return {"code": code, "out": out.getvalue(), "error": error.getvalue()}


def _run_last(folder: str, arguments: list[str]) -> int:
    for descriptor, name in ((1, "output.txt"), (2, "messages.txt")):
        with open(os.path.join(folder, name), "wb") as file:
            os.dup2(file.fileno(), descriptor)
    return _run(folder, arguments, is_last=True)


def _run(folder: str, arguments: list[str], is_last: bool = False) -> int:
    def command() -> Any:
        if is_last:
            _can_interrupt.set()
        return app(args=arguments, standalone_mode=False)

    os.chdir(folder)
    sys.argv = ["fitact", *arguments]
    return run_command(command)


if __name__ == "__main__":
    main()
