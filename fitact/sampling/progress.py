"""How far sampling is, on standard error."""

import sys

from fitact.sampling.convergence import Convergence


class Reporter:
    """Progress on standard error: a bar where it is a terminal, else a line now and then."""

    def __init__(self, on: bool) -> None:
        self._bar = None
        self._on = on
        self._lines = 0
        if on and sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

            columns = (
                TextColumn("sampling"),
                BarColumn(),
                TextColumn("{task.description}"),
                TimeElapsedColumn(),
            )
            self._bar = Progress(*columns, console=Console(stderr=True))
            self._bar.start()
            self._task = self._bar.add_task("starting", total=1.0)

    def __call__(self, steps: int, c: Convergence) -> None:
        """Show the steps taken, and what the last look said of them."""
        if not self._on:
            return
        judged = f", tau {c.tau_max:.1f}, R-hat {c.rhat_max:.4f}" if c.ess else ""
        text = f"{steps} steps{judged}"
        if self._bar is not None:
            self._bar.update(self._task, completed=c.progress, description=text)
        elif steps == c.steps:
            if self._lines in (0, 1, 2, 5, 10) or self._lines % 20 == 0 or c.converged:
                print(f"sampling: {text}", file=sys.stderr)
            self._lines += 1

    def close(self) -> None:
        if self._bar is not None:
            self._bar.stop()
