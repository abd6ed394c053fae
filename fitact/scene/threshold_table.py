"""Detection threshold of an alternating force on the skin, over its frequency."""

import csv
import importlib.resources
import itertools
from pathlib import Path
from typing import Any, Self

import numpy as np
from jaxtyping import Float
from pydantic import model_validator

from fitact.errors import InputError
from fitact.scene.section import Hertz, Section, Threshold
from fitact.units import format_engineering

_COLUMNS = ["frequency_Hz", "force_N"]
_FORM = 'write {frequencies = ["10 Hz", "250 Hz"], forces = ["20 mN", "1 mN"]}, or a CSV file with these columns:'


class ThresholdTable(Section):
    """Smallest amplitude of a sine of friction that is felt, at some frequencies; between them linear in log-log.

    Attributes:
        frequencies: of the force, not of the drive, Hz; rising.
        forces: amplitude (not rms, nor peak to peak) at the threshold, N.
        source: where the values come from.
    """

    frequencies: tuple[Hertz, ...]
    forces: tuple[Threshold, ...]
    source: str | None = None

    @model_validator(mode="before")
    @classmethod
    def _read_file(cls, content: Any) -> Any:
        if isinstance(content, str):
            return _read_csv(content)
        if isinstance(content, dict) and not {"frequencies", "forces"} <= set(content):
            raise ValueError(f"the table needs frequencies and forces; {_FORM} {','.join(_COLUMNS)}")
        return content

    @model_validator(mode="after")
    def _check(self) -> Self:
        firm_touch = 2.0  # N
        if max(self.forces, default=0.0) > firm_touch:
            raise ValueError(
                f"a threshold of {max(self.forces):g} N is more than a finger is pressed with; check the unit, N"
            )
        if len(self.forces) != len(self.frequencies):
            raise ValueError(f"{len(self.frequencies)} frequencies and {len(self.forces)} forces; give one for each")
        if len(self.frequencies) < 2:
            raise ValueError("the table has fewer than two frequencies; give its two ends at least")
        if any(low >= high for low, high in itertools.pairwise(self.frequencies)):
            raise ValueError("the frequencies must rise from each to the next; sort them, and drop repeated ones")
        return self

    def sensitivity(self, frequency: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return 1 / threshold (1/N) at frequencies (Hz); 0 outside the table, which is not extrapolated."""
        log = np.interp(np.log(frequency), np.log(self.frequencies), -np.log(self.forces))
        rounding = 1e-9  # relative; keeps a multiple of the drive's frequency that lies on an end of the table
        low, high = self.frequencies[0] * (1.0 - rounding), self.frequencies[-1] * (1.0 + rounding)
        inside = (frequency >= low) & (frequency <= high)
        return np.where(inside, np.exp(log), 0.0)

    def harmonic_sensitivity(self, frequency: float, coefficient: float) -> Float[np.ndarray, " harmonics"]:
        """Return friction coefficient / threshold (1/N) at all multiples of a frequency (Hz) in the table.

        Multiples outside have 0; their number is one of a few, since each is another compiled program.

        Raises:
            InputError: more than 256 multiples are in the table.
        """
        count, largest = int(self.frequencies[-1] / frequency * (1.0 + 1e-9)), 256
        if count > largest:
            raise InputError(
                f"scene: [perception] thresholds reach to {count} times the drive's {frequency:.4g} Hz; end the table"
                f" at {largest} times, or raise the frequency"
            )
        size = next(size for size in (4, 16, 64, largest) if size >= count)
        return coefficient * self.sensitivity(frequency * np.arange(1.0, size + 1.0))

    @property
    def range_text(self) -> str:
        """Range of the table for people, such as "10 Hz to 250 Hz"."""
        return " to ".join(format_engineering(self.frequencies[end], "Hz", 3) for end in (0, -1))


def resolve_table_path(name: str, folder: Path) -> str:
    """Return the path of a file beside the scene in `folder`; the name of a shipped table stays."""
    return name if name in shipped_tables() else str(folder / name)


def shipped_tables() -> dict[str, str]:
    """Return the tables shipped with fitact: name -> text."""
    folder = importlib.resources.files("fitact") / "thresholds"
    return {file.name.removesuffix(".csv"): file.read_text(encoding="utf-8") for file in folder.iterdir()}


def _read_csv(name: str) -> dict[str, Any]:
    try:
        text = shipped_tables().get(name) or Path(name).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = "no such file" if isinstance(error, FileNotFoundError) else "cannot be read as UTF-8 text"
        raise ValueError(f"{reason}; {_FORM} {','.join(_COLUMNS)}; shipped: {', '.join(shipped_tables())}") from error
    comments = [line.lstrip("# ") for line in text.splitlines() if line.startswith("#")]
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    header, *rows = csv.reader(lines) if lines else [[]]
    if [title.strip() for title in header] != _COLUMNS or any(len(row) != len(_COLUMNS) for row in rows):
        raise ValueError(
            f"the file must have the columns {','.join(_COLUMNS)}, with a frequency in Hz and a force in N in each row,"
            " as 250,1e-3"
        )
    try:
        numbers = [[float(cell) for cell in row] for row in rows]
    except ValueError as error:
        raise ValueError(f"{error}; write plain numbers in Hz and N") from error
    label = f"{Path(name).name}: {comments[0]}" if comments else None
    return {"frequencies": [row[0] for row in numbers], "forces": [row[1] for row in numbers], "source": label}
