"""Output that all commands share: results on standard output, messages on standard error."""

import shlex
import sys
from collections.abc import Sequence
from typing import Any

import typer

from fitact.files import to_json


def command_line() -> str:
    """Return the command line as the user typed it."""
    return shlex.join(["fitact", *sys.argv[1:]])


def show(text: str, content: dict[str, Any], as_json: bool, trusted: bool = True) -> None:
    """Print a result as text or JSON; an unreliable result ends the command with exit status 1."""
    sys.stdout.write(to_json(content) if as_json else text + "\n")
    sys.stdout.flush()
    if not trusted:
        print_stderr("fitact: the results are unreliable; see the warnings")
        raise typer.Exit(1)


def print_stderr(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def announce(action: str, paths: Sequence[object]) -> None:
    """Tell a person at a terminal at once what a command does; the imports that follow take a second.

    Elsewhere nothing is printed, because programs read a refusal as the only line.
    """
    if sys.stderr.isatty():
        print_stderr(f"{action} {paths[0]}" + f" and {len(paths) - 1} more" * (len(paths) > 1))
