"""Command that opens the page in the browser: app."""

from pathlib import Path
from typing import Annotated

import typer

from fitact.cli import internal
from fitact.cli.app import app
from fitact.errors import InputError


@app.command("app")
def open_app(
    port: Annotated[
        int, typer.Option("--port", min=0, max=65535, help="Port of the address.", show_default="a free one")
    ] = 0,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Only print the address of the page.")] = False,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Folder for all analyses.", show_default="fitact-results at home"),
    ] = None,
) -> None:
    """Open a page in the browser, for the whole job from a file to the report.

    Prints the address of the page first; only this machine reaches it, and only with this address. Ctrl-C ends it.
    """
    commands = internal.WarmCommands()
    commands.prepare()  # it imports while the server does
    try:
        serve = internal.serve
    except ImportError as error:
        raise InputError(f"fitact app needs Starlette and uvicorn ({error}); pip install 'fitact[app]'") from error
    serve(out or Path.home() / "fitact-results", port, not no_browser, commands)
