"""Portability: fitact needs no module or function that only Linux has, and writes UTF-8 everywhere."""

import os
import subprocess
import sys

# in a process of its own: other packages are imported first, as they have their own ways on each system
_SCRIPT = """
import asyncio, builtins, importlib, io, os, pkgutil, signal
import distributed, h5netcdf, h5py, jax, matplotlib.figure, optimistix, pandas, pyarrow.parquet, scipy.signal
import typer, xarray

lacking = {"fcntl", "grp", "posix", "pwd", "resource", "termios", "tty"}
real_import, real_open = builtins.__import__, builtins.open

def import_as_elsewhere(name, globals=None, *rest):
    if name.partition(".")[0] in lacking and str((globals or {}).get("__name__")).startswith("fitact"):
        raise ModuleNotFoundError(f"{globals['__name__']} imports {name}")
    return real_import(name, globals, *rest)

def open_as_elsewhere(path, *rest, **options):
    if str(path).startswith(("/proc", "/sys", "/dev")):
        raise FileNotFoundError(path)
    return real_open(path, *rest, **options)

for name in ("fork", "forkpty", "getloadavg", "getuid", "kill", "killpg", "sched_getaffinity", "uname", "wait3"):
    delattr(os, name)
for name in ("SIGALRM", "SIGHUP", "SIGKILL", "SIGUSR1", "alarm", "pthread_kill", "pthread_sigmask", "setitimer"):
    delattr(signal, name)
builtins.__import__, builtins.open = import_as_elsewhere, open_as_elsewhere

import fitact
modules = [module.name for module in pkgutil.walk_packages(fitact.__path__, "fitact.")]
for module in modules:
    importlib.import_module(module)

from fitact import compiled
from fitact.cli import _interrupt
from fitact.tradeoff.tradeoff import describe_machine
assert compiled.available_cores() == os.cpu_count()
assert describe_machine()["load"] is None
assert compiled.processor() == describe_machine.__globals__["platform"].processor() + os.environ["MACHINE"]
signal.signal(signal.SIGINT, signal.default_int_handler)  # also where the tests run in the background
try:
    _interrupt(0)
    raise SystemExit("not interrupted")
except KeyboardInterrupt:
    print(len(modules))
"""


def test_no_module_needs_linux():
    environment = os.environ | {"MACHINE": os.uname().machine}
    done = subprocess.run([sys.executable, "-c", _SCRIPT], capture_output=True, text=True, env=environment, timeout=300)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 200


def test_output_is_utf_8_on_a_console_of_another_encoding():
    """A redirected output on Windows would have an encoding that lacks the ohm sign and the minus sign."""
    script = "import sys; sys.argv[1:] = ['explain', 'prior-limited']; from fitact.cli import main; main()"
    environment = os.environ | {"PYTHONIOENCODING": "ascii"}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, env=environment, timeout=300)
    assert done.returncode == 0, done.stderr
    text = done.stdout.decode("utf-8")
    assert not text.isascii()
