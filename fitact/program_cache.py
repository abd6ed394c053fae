"""Compiled programs on disk, for all processes of a user: bytes by key, in a private folder of bounded size.

The folder is `$XDG_CACHE_HOME/fitact` (default `~/.cache/fitact`). The environment variable `FITACT_CACHE` names
another one, or turns the cache off with "off". Programs run as code, so a folder that others can write to is not used.
"""

import contextlib
import functools
import hashlib
import itertools
import os
import stat
import sys
import tempfile
import time
from pathlib import Path

_SUFFIX = ".program"
_stores = itertools.count()


def load(key: str) -> bytes | None:
    """Return the content that was stored under `key`, or None if there is none or it is damaged."""
    folder = cache_folder()
    if folder is None:
        return None
    path = folder / (key + _SUFFIX)
    try:
        entry = path.read_bytes()
    except OSError:
        return None
    size = hashlib.sha256().digest_size
    content = entry[size:]
    if hashlib.sha256(content).digest() != entry[:size]:
        remove(key)
        return None
    with contextlib.suppress(OSError):
        os.utime(path)  # used now
    return content


def store(key: str, content: bytes, size_limit: int = 256 << 20, stores_per_cleanup: int = 50) -> None:
    """Store `content` under `key`; a process that is killed leaves no incomplete entry.

    Once in `stores_per_cleanup` times, the programs that were not used for longest are removed above `size_limit`
    bytes in the folder.
    """
    folder = cache_folder()
    if folder is None:
        return
    try:
        handle, temporary = tempfile.mkstemp(prefix=".", suffix=".tmp", dir=folder)
        try:
            with open(handle, "wb") as file:
                file.write(hashlib.sha256(content).digest() + content)
            os.replace(temporary, folder / (key + _SUFFIX))
        except BaseException:
            os.unlink(temporary)
            raise
        if next(_stores) % stores_per_cleanup == 0:
            _clean_up(folder, size_limit)
    except OSError as error:
        _note(f"compiled programs cannot be stored in {folder} ({error.strerror or error})")


def remove(key: str) -> None:
    """Remove an entry that cannot be used."""
    folder = cache_folder()
    if folder is not None:
        with contextlib.suppress(OSError):
            (folder / (key + _SUFFIX)).unlink()


def cache_folder() -> Path | None:
    """Return the folder, which is created with mode 0700; None if the cache is off or the folder cannot be used."""
    return _prepare_folder(os.environ.get("FITACT_CACHE"), os.environ.get("XDG_CACHE_HOME"))


@functools.cache
def _prepare_folder(own: str | None, caches: str | None) -> Path | None:
    if own is not None and own.lower() in ("", "0", "off"):
        return None
    folder = None
    try:
        # XDG: a relative path is invalid
        root = Path(caches) if caches and os.path.isabs(caches) else Path.home() / ".cache"
        folder = Path(own).expanduser() if own else root / "fitact"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = folder.stat()
    except (OSError, RuntimeError) as error:  # RuntimeError: there is no home
        _note(f"compiled programs cannot be stored in {folder or 'a home folder'} ({error})")
        return None
    if os.name == "posix" and (found.st_uid != os.geteuid() or found.st_mode & (stat.S_IWGRP | stat.S_IWOTH)):
        _note(f"compiled programs are not stored in {folder}, because other users can write to it")
        return None
    return folder


@functools.cache
def _note(reason: str) -> None:
    print(
        f"note: {reason}, so each start compiles them again; FITACT_CACHE names another folder, or is 'off'",
        file=sys.stderr,
    )


def _clean_up(folder: Path, size_limit: int, stale_age: float = 3600.0) -> None:
    """Remove what killed processes left, and the programs that were not used for longest if the folder is too large.

    A temporary file older than `stale_age` (s) was left by a process that was killed.
    """
    entries = []
    for entry in os.scandir(folder):
        with contextlib.suppress(OSError):  # another process may have removed it
            found = entry.stat()
            if entry.name.endswith(_SUFFIX):
                entries.append((found.st_mtime, found.st_size, entry.path))
            elif entry.name.endswith(".tmp") and found.st_mtime < time.time() - stale_age:
                os.unlink(entry.path)
    total = sum(size for _, size, _ in entries)
    for _, size, path in sorted(entries):
        if total <= size_limit:
            break
        with contextlib.suppress(OSError):
            os.unlink(path)
        total -= size
