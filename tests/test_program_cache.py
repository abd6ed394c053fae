"""Compiled programs on disk: found by other processes, and never in the way."""

import os
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from fitact import program_cache

KEY = "0" * 64


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("FITACT_CACHE", str(tmp_path / "programs"))
    return tmp_path / "programs"


@pytest.fixture(autouse=True)
def _forget_folders():
    yield
    program_cache._prepare_folder.cache_clear()
    program_cache._note.cache_clear()


def test_what_was_stored_is_loaded_from_a_private_folder(folder):
    assert program_cache.load(KEY) is None
    program_cache.store(KEY, b"program")
    assert program_cache.load(KEY) == b"program"
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


def test_a_damaged_entry_is_removed(folder):
    program_cache.store(KEY, b"program")
    (entry,) = folder.iterdir()
    entry.write_bytes(entry.read_bytes()[:-1])
    assert program_cache.load(KEY) is None
    assert not entry.exists()


def test_the_folder_follows_xdg_and_can_be_turned_off(tmp_path, monkeypatch):
    monkeypatch.delenv("FITACT_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert program_cache.cache_folder() == tmp_path / "xdg" / "fitact"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")  # invalid by the XDG specification
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert program_cache.cache_folder() == tmp_path / "home" / ".cache" / "fitact"
    monkeypatch.setenv("FITACT_CACHE", "off")
    assert program_cache.cache_folder() is None
    program_cache.store(KEY, b"program")
    assert program_cache.load(KEY) is None


def test_programs_unused_for_longest_go_first(folder):
    keys = [str(i) * 64 for i in range(3)]
    for age, key in zip((300.0, 200.0, 100.0), keys, strict=True):
        program_cache.store(key, bytes(1000), size_limit=2500, stores_per_cleanup=1)
        if key == keys[2]:
            break
        os.utime(folder / f"{key}.program", (time.time() - age,) * 2)
    assert [program_cache.load(key) is not None for key in keys] == [False, True, True]


@pytest.mark.parametrize("reason", ["read-only", "others"])
def test_a_folder_that_cannot_be_used_gives_one_note(reason, tmp_path, monkeypatch, capsys):
    place = tmp_path / "file" / "programs"
    (tmp_path / "file").write_text("")  # no folder can be made in a file, not even by root
    if reason == "others":
        place = tmp_path / "shared"
        place.mkdir()
        place.chmod(0o777)
    monkeypatch.setenv("FITACT_CACHE", str(place))
    for _ in range(2):
        program_cache.store(KEY, b"program")
        assert program_cache.load(KEY) is None
    assert capsys.readouterr().err.count("note:") == 1
    if reason == "others":
        assert not list(place.iterdir())


@pytest.mark.skipif(sys.platform == "win32", reason="SIGKILL")
def test_a_process_killed_while_it_writes_leaves_whole_entries_only(folder):
    program = "from fitact import program_cache\nwhile True: program_cache.store('1' * 64, b'x' * 20_000_000)"
    process = subprocess.Popen([sys.executable, "-c", program])
    deadline = time.monotonic() + 30.0
    while time.monotonic() < deadline and not list(folder.glob(".*.tmp")):
        time.sleep(0.001)  # it is in the middle of writing
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert program_cache.load("1" * 64) in (None, b"x" * 20_000_000)
    for path in folder.glob(".*.tmp"):
        os.utime(path, (0.0, 0.0))
    program_cache.store(KEY, b"program")
    program_cache._clean_up(folder, size_limit=1 << 20)
    assert program_cache.load(KEY) == b"program"
    assert not list(folder.glob(".*.tmp"))
