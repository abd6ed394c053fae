"""Progress of the sampling, on standard error."""

import sys

from fitact.progress import open_bar
from fitact.sampling.convergence import Convergence


class Reporter:
    """Progress on standard error: a bar on a terminal, otherwise occasional lines."""

    def __init__(self, show: bool) -> None:
        self._show, self._lines = show, 0
        self._bar = open_bar("sampling", status="starting") if show and sys.stderr.isatty() else None

    def __call__(self, steps: int, convergence: Convergence) -> None:
        """Show the number of steps and the latest diagnostics."""
        if not self._show:
            return
        diagnosis = f", tau {convergence.tau_max:.1f}, R-hat {convergence.rhat_max:.4f}" if convergence.ess else ""
        text = f"{steps} steps{diagnosis}"
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], completed=convergence.progress, description=text)
        elif steps == convergence.steps:
            if self._lines in (0, 1, 2, 5, 10) or self._lines % 20 == 0 or convergence.converged:
                print(f"sampling: {text}", file=sys.stderr)
            self._lines += 1

    def close(self) -> None:
        if self._bar is not None:
            self._bar.stop()
