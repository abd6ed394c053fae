"""How far long work is, on standard error."""

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from rich.progress import Progress  # slow to import

_Item = TypeVar("_Item")


def track_progress(
    items: Iterable[_Item],
    description: str,
    total: float,
    completed: Callable[[], float] | None = None,
    *,
    patience: float = 3.0,
    line_interval: float = 10.0,
    bar_interval: float = 0.1,
) -> Iterator[_Item]:
    """The items; once they take a while, `description` is said to be under way, and how much of `total` is done.

    That is how many items there were, unless `completed` tells it. A bar where standard error is a terminal, else
    lines. Nothing is said within `patience`, then no sooner than a `line_interval` or `bar_interval` apart, s.
    """
    terminal, bar, next_look = sys.stderr.isatty(), None, time.monotonic() + patience
    try:
        for count, item in enumerate(items):
            now = time.monotonic()
            if now >= next_look:
                share = (count if completed is None else completed()) / max(total, 1.0)
                if terminal:
                    bar = bar or open_bar(description)
                    bar.update(bar.task_ids[0], completed=share)
                else:
                    print(f"{description}: {share:.0%}", file=sys.stderr)
                next_look = now + (bar_interval if terminal else line_interval)
            yield item
    finally:
        if bar is not None:
            bar.stop()


def open_bar(label: str, status: str = "") -> "Progress":
    """Return a bar with one task, out of 1; it goes when stopped, unless it shows a `status` beside the share done."""
    from rich import console, markup, progress

    columns = [progress.TextColumn(markup.escape(label)), progress.BarColumn()]
    if status:
        columns += [progress.TextColumn("{task.description}"), progress.TimeElapsedColumn()]
    else:
        columns += [progress.TaskProgressColumn(), progress.TimeRemainingColumn()]
    bar = progress.Progress(*columns, console=console.Console(stderr=True), transient=not status)
    bar.add_task(status, total=1.0)
    bar.start()
    return bar
