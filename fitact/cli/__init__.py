"""Command line. Heavy imports are deferred until a command needs them."""

import _thread
import gc
import io
import os
import signal
import sys
import threading
from collections.abc import Callable
from typing import Any, NoReturn

import typer

from fitact.cli.app import app
from fitact.cli.terminal import print_stderr
from fitact.errors import InputError

# `fitact --help` lists the commands in the order of this import
# isort: off
from fitact.cli import one_finger, records, scenes, page  # noqa: F401

# isort: on

_INTERRUPTED = 130


def main() -> None:
    """Run the command line and end the process."""
    if os.environ.get("FITACT_DEVICE", "cpu").startswith("cpu"):
        os.environ.setdefault("JAX_PLATFORMS", "cpu")  # to start a GPU takes longer than a fit
    end_process(run_command(lambda: app(standalone_mode=False)))


def end_process(code: int) -> NoReturn:
    """End the process with an exit status, without Python's searches for garbage, which take 2 s after a fit."""
    gc.freeze()
    raise SystemExit(code)


def _resend_interrupt(unraisable: "sys.UnraisableHookArgs") -> None:
    """Repeat a Ctrl-C that arrived where Python discards exceptions, e.g. in the callback of a weak reference."""
    if issubclass(unraisable.exc_type, KeyboardInterrupt):
        main = threading.main_thread().ident or 0
        # 0.01 s later, when Python has left the place that discarded it
        threading.Timer(0.01, _interrupt, (main,)).start()
    else:
        sys.__unraisablehook__(unraisable)


def _interrupt(main: int) -> None:
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(main, signal.SIGINT)
    else:  # Windows; a waiting call of the system ends first there
        _thread.interrupt_main()


def run_command(command: Callable[[], Any]) -> int:
    """Return the exit status of a command; report every error in one line."""
    sys.unraisablehook = _resend_interrupt
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(encoding="utf-8")  # units and JSON, whatever the system's own encoding is
    try:
        result = command()
        if result == _INTERRUPTED:  # the exit status into which typer turns Ctrl-C
            raise KeyboardInterrupt
        return result if isinstance(result, int) else 0
    except InputError as error:
        print_stderr(f"fitact: {error}")
        return 2
    except typer.exceptions.TyperException as error:  # a wrong option or argument
        error.show()  # type: ignore[attr-defined]
        return 2
    except (KeyboardInterrupt, typer.Abort):
        print_stderr("fitact: interrupted; the same command resumes from the last checkpoint, if there is one")
        return _INTERRUPTED
    except BrokenPipeError:
        return 0
    except Exception as error:
        if os.environ.get("FITACT_DEBUG"):
            raise
        print_stderr(
            f"fitact: internal error ({type(error).__name__}: {error}); run the command again with FITACT_DEBUG=1"
            " and report the traceback"
        )
        return 3
