"""How every command gives its answer."""

import shlex
import sys
from typing import Any

import typer

from fitact.files import to_json


def command_line() -> str:
    """The command as it was typed."""
    return shlex.join(["fitact", *sys.argv[1:]])


def show(text: str, content: dict[str, Any], as_json: bool, trusted: bool = True) -> None:
    """Print an answer as text or JSON; one that is not to be trusted ends the command with exit code 1."""
    sys.stdout.write(to_json(content) if as_json else text + "\n")
    sys.stdout.flush()
    if not trusted:
        print_stderr("fitact: this answer must not be trusted; see the warnings")
        raise typer.Exit(1)


def print_stderr(text: str) -> None:
    print(text, file=sys.stderr)
