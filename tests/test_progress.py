"""Progress of long work: reported on standard error after a while, without any effect on the result."""

import sys

from fitact import progress


def test_short_work_says_nothing(capfd):
    assert list(progress.track_progress("abc", "spelling", 3)) == ["a", "b", "c"]
    assert capfd.readouterr() == ("", "")


def test_long_work_says_how_much_is_done(capfd):
    at_once = {"patience": 0.0, "line_interval": 0.0}
    assert list(progress.track_progress(range(4), "counting", 4, **at_once)) == [0, 1, 2, 3]
    assert capfd.readouterr() == ("", "counting: 0%\ncounting: 25%\ncounting: 50%\ncounting: 75%\n")
    read = iter([10.0, 80.0])
    list(progress.track_progress("ab", "reading", 100.0, lambda: next(read), **at_once))
    assert capfd.readouterr().err == "reading: 10%\nreading: 80%\n"


def test_a_bar_on_a_terminal_goes_when_the_work_ends(monkeypatch):
    bars, make = [], progress.open_bar
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(progress, "open_bar", lambda what: bars.append(make(what)) or bars[0])
    for _ in progress.track_progress(range(4), "counting", 4, patience=0.0, bar_interval=0.0):
        pass
    assert len(bars) == 1
    assert bars[0].tasks[0].completed == 0.75
    assert not bars[0].live.is_started
