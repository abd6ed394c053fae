"""What every command does with its answer, and where JAX keeps what it compiles."""

import os
import platform
import shlex
import sys
from pathlib import Path
from typing import Any

import typer

from fitact.files import to_json


def use_compilation_cache() -> None:
    """Keep what JAX compiles between calls, in the user's cache; a place that cannot be written is passed over."""
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    import jax

    try:
        root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        folder = root / "fitact" / f"jax-{jax.__version__}-{platform.node()}"
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # no home, or one that cannot be written
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)  # the many small ones take a second


def typed() -> str:
    """The command as it was typed."""
    return shlex.join(["fitact", *sys.argv[1:]])


def keep_compiled() -> None:
    """As `use_compilation_cache`, for this process's children."""
    use_compilation_cache()
    import jax

    folder = jax.config.jax_compilation_cache_dir
    if folder:
        os.environ["JAX_COMPILATION_CACHE_DIR"] = folder
        os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"


def show(text: str, content: dict[str, Any], as_json: bool) -> None:
    sys.stdout.write(to_json(content) if as_json else text + "\n")
    sys.stdout.flush()


def say(text: str) -> None:
    print(text, file=sys.stderr)


def finish(trusted: bool) -> None:
    if not trusted:
        say("fitact: this answer must not be trusted; see the warnings")
        raise typer.Exit(1)
