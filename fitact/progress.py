"""How far long work is, on standard error."""

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from rich.progress import Progress  # slow to import

_Item = TypeVar("_Item")

_PATIENCE = 3.0  # s, within which nothing is said
_APART = 10.0  # s between lines where standard error is no terminal
_SHOWN = 0.1  # s between changes of a bar


def watched(
    items: Iterable[_Item], what: str, total: float, done: Callable[[], float] | None = None
) -> Iterator[_Item]:
    """The items; once they take a while, `what` is said to be under way, and how much of `total` is done.

    That is how many items there were, unless `done` tells it. A bar where standard error is a terminal, else lines.
    """
    terminal, bar, next_look = sys.stderr.isatty(), None, time.monotonic() + _PATIENCE
    try:
        for count, item in enumerate(items):
            now = time.monotonic()
            if now >= next_look:
                share = (count if done is None else done()) / max(total, 1.0)
                if terminal:
                    bar = bar or _bar(what)
                    bar.update(bar.task_ids[0], completed=share)
                else:
                    print(f"{what}: {share:.0%}", file=sys.stderr)
                next_look = now + (_SHOWN if terminal else _APART)
            yield item
    finally:
        if bar is not None:
            bar.stop()


def _bar(what: str) -> "Progress":
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = TextColumn(escape(what)), BarColumn(), TaskProgressColumn(), TimeRemainingColumn()
    bar = Progress(*columns, console=Console(stderr=True), transient=True)
    bar.add_task(what, total=1.0)
    bar.start()
    return bar
