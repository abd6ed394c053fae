"""One layout: who writes it, what is taken from it, what it needs, and a file in it."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

SCOPE = Path(__file__).parents[1] / "data" / "scope"
REAL = Path(__file__).parents[3] / "shared" / "real"  # files of other people's instruments, which are not shipped

STEP, COUNT = 20e-6, 300
TIME = STEP * np.arange(COUNT)
V = 120.0 * np.sin(2.0 * np.pi * 330.0 * TIME) - 3.25
VSC = 11.0 * np.cos(2.0 * np.pi * 330.0 * TIME) + 0.5


@dataclasses.dataclass(frozen=True)
class Layout:
    """A row of the table.

    Attributes:
        program: who writes such files.
        ending: of the names of the files.
        taken: what the reader takes from the file besides the values.
        write: writes TIME, V and VSC, or a spectrum, in this layout into a folder, and returns the path.
        options: arguments of `fitact.read` that the file needs.
        kind: of file.
        extra: of fitact that reads it.
        real: files in SCOPE or REAL that a program wrote; other tests compare their values.
        resolution: of the values in the file, relative to the largest.
    """

    program: str
    ending: str
    taken: str
    write: Callable[[Path], Path] | None = None
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    kind: Literal["text", "binary", "array", "sound", "sheet", "spectrum"] = "text"
    extra: str = ""
    real: tuple[str, ...] = ()
    resolution: float = 1e-7

    @property
    def needs(self) -> str:
        """Options of the command line, which are the arguments without a plural s, and the extra to install."""
        shown = [f"`--{name.rstrip('s')}`" for name in self.options]
        return ", ".join(shown + [f"`fitact[{self.extra}]`"] * bool(self.extra)) or "-"

    @property
    def endings(self) -> list[str]:
        """Endings that the table names: those of other files than CSV."""
        return [ending for ending in self.ending.split(", ") if ending != ".csv"]

    @property
    def line(self) -> tuple[str, str, str]:
        """Cells that programs on one line of the table share."""
        return self.kind, self.taken, self.needs


def text(content: str, encoding: str = "utf-8", name: str = "record.csv") -> Callable[[Path], Path]:
    """Return the writer of a text."""

    def write(folder: Path) -> Path:
        path = folder / name
        path.write_text(content, encoding=encoding, newline="")
        return path

    return write


def rows(*columns: np.ndarray, form: str = "%.5f", delimiter: str = ",") -> list[str]:
    return [delimiter.join(form % x for x in row) for row in zip(*columns, strict=True)]
