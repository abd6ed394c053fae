"""Progress of long computations, on standard error."""

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
    """Yield the items, and show `description` and the completed fraction of `total`.

    The number of items counts as completed, unless `completed` returns another number. A bar is shown on a terminal,
    lines elsewhere: first after `patience`, then every `line_interval` or `bar_interval`, s.
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
    """Return a bar with one task of size 1; it disappears when stopped, unless it shows a `status`."""
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
